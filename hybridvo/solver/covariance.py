"""The covariance of a motion: every error that is in it, by name.

Of a motion by flow it is the sum of independent errors, :func:`motion_covariance`. Where several
sources determine a motion their information adds up, :func:`covariance_of_sources`; that of images
and depth maps is :mod:`hybridvo.solver.correlated_errors`'s. After the solver a covariance is only
widened by what is found against the motion, in :mod:`hybridvo.judge.verdict`.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np

from hybridvo.core.results import UNINFORMATIVE_COVARIANCE
from hybridvo.solver.depths import DepthAgreement
from hybridvo.solver.kernels import HESSIAN_SUMS
from hybridvo.solver.newton import positive_inverse
from hybridvo.solver.noise_estimation import Noise
from hybridvo.solver.score_blocks import (
    PLACES,
    BlockSums,
    block_sums,
    clustered_meat,
    symmetric,
)
from hybridvo.solver.shared_errors import (
    SharedErrors,
    parts_of_tiles,
    shared_covariance,
)

# Smallest eigenvalue of the full second derivative, as a fraction of that of Gauss-Newton's
# matrix, with which the curvature of the robust weights is believed: with few inliers it is
# noise.
MIN_CURVATURE_RATIO = 0.2

# The information is definite if its smallest eigenvalue is larger than this, and than this fraction
# of the largest.
MIN_EIGENVALUE = 1e-12
MIN_EIGENVALUE_RATIO = 1e-8
# Standard deviation of flow that single precision rounds, px: at a coordinate of 300. Without it
# pairs with true flow state 0.1 um, and of 30 in each of four kinds of heavy scenes 6 to 9 err by
# more than three times that.
FLOW_ROUNDING = 2e-5
# Name of the error that a seed has as well as the solution.
OF_DEPTHS = "of depths that differ"


class ScoreStatistics(NamedTuple):
    """What a robust fit leaves for its covariance, in metres and radians."""

    # (rows, columns, 27) upper triangle of the Hessian and score of each tile
    tiles: np.ndarray
    # (6, 6) of the robust weights: the Hessian less it is the derivative
    curvature: np.ndarray
    # (6, 6) covariance of the summed score if errors are independent
    meat: np.ndarray
    weight: float  # sum of the external weights
    shared: SharedErrors


class MotionCovariance(NamedTuple):
    """The covariance of a motion, and what decides whether it may be used."""

    # (6, 6) each, of the left perturbation by errors of one kind; m^2, m rad, rad^2
    errors: Mapping[str, np.ndarray]
    # (6,) of the information, rising, metres in units of typical depth
    eigenvalues: np.ndarray
    tiles: int  # with usable pixels; 0 where the information is not definite

    @property
    def covariance(self) -> np.ndarray:
        """(6, 6) of the left perturbation by all errors, which are independent."""
        return np.sum(list(self.errors.values()), axis=0)

    def of_seed(self, covariance: np.ndarray) -> MotionCovariance:
        """That of a seed (6, 6) in the place of the solution's, with the same depths."""
        kept = {k: v for k, v in self.errors.items() if k == OF_DEPTHS}
        return self._replace(errors={"of the seed": covariance, **kept})

    @property
    def is_definite(self) -> bool:
        """Whether it is positive definite."""
        return bool(np.linalg.eigvalsh(self.covariance)[0] > 0)


def unknown_motion(eigenvalues: np.ndarray) -> MotionCovariance:
    """Return the covariance of a motion of which a direction (or more) is undetermined."""
    errors = {"everything": UNINFORMATIVE_COVARIANCE.copy()}
    return MotionCovariance(errors, eigenvalues, 0)


def direction_is_known(T: np.ndarray, covariance: np.ndarray) -> bool:
    """Return whether a translation is longer than three of its own standard deviations."""
    largest = max(np.linalg.eigvalsh(covariance[:3, :3])[-1], 0.0)
    return bool(np.linalg.norm(T[:3, 3]) > 3 * np.sqrt(largest))


# -- of a motion by flow: errors add up ------------------------------------------------


def motion_covariance(
    statistics: ScoreStatistics,
    inverse_depth: float,
    focal: float,
    t: np.ndarray,
    noise: Noise,
    depths: DepthAgreement | None,
) -> MotionCovariance:
    """Return the covariance of the left perturbation of a motion by flow.

    Args:
        statistics: of the fit, at its solution.
        inverse_depth: 1 / typical depth, 1 / m: it turns metres into radians.
        focal: focal length, px.
        t: (3,) translation, metres.
        noise: of flow and depth.
        depths: how the depths of both frames compare along the motion, or None.

    Returns:
        The covariance; one without information, and no tiles, where a direction is undetermined.
    """
    at = _solution(statistics, inverse_depth)
    if not at.is_determined:
        return unknown_motion(at.eigenvalues)
    blocks = _blocks(statistics.tiles, at)
    parallax = focal * float(np.linalg.norm(t)) * inverse_depth
    errors = {
        "of neighbours": _of_neighbours(blocks, statistics.meat, at),
        "of parts of the view": _of_parts(statistics.shared, at),
        "of rounding": _of_rounding(statistics.weight, parallax, noise, at),
    }
    errors = {name: at.in_metres(each) for name, each in errors.items()}
    errors["of the mean of depth"] = _of_mean_depth(t, noise)
    errors[OF_DEPTHS] = _of_depths(t, depths)
    found = MotionCovariance(errors, at.eigenvalues, blocks.tiles)
    is_finite = bool(np.isfinite(found.covariance).all())
    return found if is_finite else unknown_motion(at.eigenvalues)


class _Solution(NamedTuple):
    """The normal equations of a fit at its solution, metres in units of typical depth."""

    units: np.ndarray  # (6,) of the unknowns: typical depth, m, and 1 rad
    H: np.ndarray  # (6, 6) of Gauss and Newton
    curvature: np.ndarray  # (6, 6) of the robust weights
    eigenvalues: np.ndarray  # (6,) of H, rising

    @property
    def is_determined(self) -> bool:
        """Whether the information is definite."""
        smallest = max(MIN_EIGENVALUE_RATIO * self.eigenvalues[-1], MIN_EIGENVALUE)
        return bool(self.eigenvalues[0] > smallest)

    @property
    def model(self) -> np.ndarray:
        """(6, 6) covariance if all is as the noise model states."""
        return np.linalg.inv(self.H)

    @property
    def bread(self) -> np.ndarray:
        """(6, 6) by which a score moves the solution: H less the curvature where that is known."""
        bread = self.H - self.curvature
        smallest = MIN_CURVATURE_RATIO * self.eigenvalues[0]
        if np.linalg.eigvalsh(bread)[0] <= smallest:
            bread = self.H
        return np.linalg.inv(bread)

    def in_metres(self, covariance: np.ndarray) -> np.ndarray:
        """A covariance (6, 6) in metres and radians."""
        even = 0.5 * (covariance + covariance.T)
        return even * np.outer(self.units, self.units)


def _solution(statistics: ScoreStatistics, inverse_depth: float) -> _Solution:
    """The normal equations of a fit, from the sums over its tiles."""
    units = np.array([1 / inverse_depth] * 3 + [1.0] * 3)
    outer = np.outer(units, units)
    total = statistics.tiles.sum(axis=(0, 1))
    H = symmetric(total[:HESSIAN_SUMS]) * outer
    eigenvalues = np.linalg.eigvalsh(H) if np.isfinite(H).all() else np.zeros(6)
    return _Solution(units, H, statistics.curvature * outer, eigenvalues)


def _blocks(tiles: np.ndarray, at: _Solution) -> BlockSums:
    """Scores of blocks of tiles (rows, columns, 27) where all of them together are zero."""
    outer = np.outer(at.units, at.units)
    model = at.model * outer
    # to first order
    step = model @ tiles.sum(axis=(0, 1))[HESSIAN_SUMS:]
    upper = tiles[..., :HESSIAN_SUMS]
    scores = tiles[..., HESSIAN_SUMS:] - upper[..., PLACES] @ step
    blocks = block_sums(np.concatenate([upper, scores], axis=2), model)
    return blocks._replace(meats=blocks.meats * outer)


def _of_neighbours(
    blocks: BlockSums, independent: np.ndarray, at: _Solution
) -> np.ndarray:
    """Covariance (6, 6) by noise of flow and depth, of which neighbouring pixels share some.

    It is the sandwich of Huber (1967), whose bread is the Gauss-Newton Hessian less the curvature
    of the robust weights.

    Args:
        blocks: scores of blocks of tiles.
        independent: (6, 6) covariance of the summed score if errors are independent.
        at: the solution.
    """
    meat = clustered_meat(blocks, independent * np.outer(at.units, at.units))
    bread = at.bread
    return bread @ meat @ bread


def _of_parts(shared: SharedErrors, at: _Solution) -> np.ndarray:
    """Covariance (6, 6) by errors that whole parts of the view share.

    The robust weights turn such errors down as much as their curvature raises the effect of a
    score: the Hessian alone counts.
    """
    effects = shared.pulls * at.units @ at.model
    rows, columns = effects.shape[:2]
    effects = effects.reshape(rows * columns, -1, 6)
    part_of = parts_of_tiles(rows, columns)
    return shared.coherent * shared_covariance(effects, part_of)


def _of_rounding(
    weight: float, parallax: float, noise: Noise, at: _Solution
) -> np.ndarray:
    """Covariance (6, 6) by rounding of flow in single precision.

    Neighbours are rounded alike, so that an average over n pixels is no better than one.

    Args:
        weight: sum of the external weights.
        parallax: px by which a point moves for each unit of its log depth.
        noise: of flow and depth.
        at: the solution.
    """
    variance = noise.flow_px**2 + (parallax * noise.log_depth) ** 2
    fraction = weight * FLOW_ROUNDING**2 / variance
    return fraction * at.model


def _of_mean_depth(t: np.ndarray, noise: Noise) -> np.ndarray:
    """Covariance (6, 6) by what the errors of depth are 0 in the mean of.

    It may be log depth, depth or its inverse: these differ by half the variance of log depth, and
    so does the length of the translation (3,).
    """
    return _of_length(t, (0.5 * noise.log_depth**2) ** 2)


def _of_depths(t: np.ndarray, depths: DepthAgreement | None) -> np.ndarray:
    """Covariance (6, 6) by a length of the translation (3,) as uncertain as depths that differ."""
    return _of_length(t, 0.0 if depths is None else depths.length_variance)


def _of_length(t: np.ndarray, variance: float) -> np.ndarray:
    """Covariance (6, 6) by the relative variance of the length of a translation (3,)."""
    covariance = np.zeros((6, 6))
    covariance[:3, :3] = variance * np.outer(t, t)
    return covariance


# -- of a motion by several sources: information adds up --------------------------------


def covariance_of_sources(*information: np.ndarray) -> np.ndarray | None:
    """Return the covariance (6, 6) of a motion on which several sources agree.

    Args:
        information: (6, 6) of each: what was known before, images, depth maps.

    Returns:
        None where all together do not determine the motion.
    """
    return positive_inverse(np.sum(information, axis=0))
