"""The motion of a pair by its two depth maps, from what is expected of it.

Points of the previous map are followed to the surface of the current one. Where the
view leaves a direction open, as along a wall, the expected motion fills it, each by its
information.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import scipy

from hybridvo.core.belief import resized
from hybridvo.core.geometry import invert, se3_exp, se3_log
from hybridvo.core.options import RefineOptions
from hybridvo.core.results import MotionPrior
from hybridvo.core.types import FramePair
from hybridvo.solver.calibration import MIN_FOLLOWING, MIN_STATIC_WEIGHT
from hybridvo.solver.covariance import covariance_of_sources
from hybridvo.solver.newton import ROBUST_CURVATURE
from hybridvo.solver.plane_kernels import PlanesAt
from hybridvo.solver.planes import WeightedPlanes, determined_step, planes_of
from hybridvo.solver.rows import PlaneRow

# Gauss-Newton steps from the expected motion at most, and the length of the last one in standard
# deviations
STEPS = 15
TOLERANCE = 0.1


class DepthEvidence(NamedTuple):
    """What speaks for a motion that no image confirms.

    Attributes:
        in_view: of the static weight, the fraction that is visible on a surface of the current map.
        inlier_ratio: of what is visible, the fraction that follows the motion.
    """

    in_view: float = 1.0
    inlier_ratio: float = 1.0


class DepthMotion(NamedTuple):
    """A motion by two depth maps and what was expected of it."""

    known: MotionPrior
    # (6, 6) of the depth maps alone
    information: np.ndarray
    evidence: DepthEvidence
    weights: np.ndarray  # (H, W) float32, 1 where a point follows the motion

    def rests_on(self, expected: MotionPrior) -> bool:
        """Whether what was expected decides a direction of the motion more than depth does."""
        by_expectation = np.linalg.inv(expected.covariance)
        shares = scipy.linalg.eigvalsh(self.information, by_expectation)
        return bool(shares[0] < 1)


def motion_by_depth(pair: FramePair, expected: MotionPrior) -> MotionPrior:
    """Return the motion by two depth maps and what was expected, each by its information.

    Args:
        pair: two frames; their images are not looked at.
        expected: the motion that the maps are followed from.
    """
    found = follow_depth(pair, expected)
    return expected if found is None else found.known


def follow_depth(
    pair: FramePair,
    expected: MotionPrior,
    weights: np.ndarray | None = None,
    options: RefineOptions | None = None,
) -> DepthMotion | None:
    """Follow two depth maps from what is expected of their motion.

    Args:
        pair: two frames; their images are not looked at.
        expected: the motion that the maps are followed from.
        weights: (H, W) static weights of the previous pixels, from 0 to 1; None: all count.
        options: of the refinement: cutoff of the robust kernel, number of tiles.

    Returns:
        The motion; None where a map is missing, or where they hardly overlap.
    """
    if pair.prev.depth is None or pair.curr.depth is None:
        return None
    if weights is None:
        weights = np.ones(pair.prev.camera.shape, np.float32)
    options = options or RefineOptions()
    planes = planes_of(pair).weighted(weights, MIN_STATIC_WEIGHT, options)
    prior = np.linalg.inv(expected.covariance)
    T = expected.T_curr_prev
    for _ in range(STEPS):
        at = planes.at(T)
        if not at.determine_motion:
            return None
        structure = planes.structure(at)
        information = structure.information + prior
        away = se3_log(T @ invert(expected.T_curr_prev))
        pull = structure.common @ determined_step(at) - prior @ away
        curvature = ROBUST_CURVATURE * structure.information + prior
        step = np.linalg.solve(curvature, pull)
        T = se3_exp(step) @ T
        if step @ information @ step < TOLERANCE**2:
            break
    covariance = covariance_of_sources(structure.information, prior)
    # what was expected determines all of it
    assert covariance is not None
    known = MotionPrior(T, covariance)
    return _seen(pair, planes, at, known, structure.information)


def _seen(
    pair: FramePair,
    planes: WeightedPlanes,
    at: PlanesAt,
    known: MotionPrior,
    information: np.ndarray,
) -> DepthMotion:
    """A motion, with the points that follow it."""
    is_seen = at.surface_depth > 0
    follows = is_seen & (at.rows[PlaneRow.ROBUST] > MIN_FOLLOWING)
    seen = int(np.count_nonzero(is_seen))
    mask = resized(planes.on_grid(follows), pair.prev.camera.shape)
    return DepthMotion(
        known,
        information,
        DepthEvidence(
            seen / max(len(planes.points), 1),
            int(np.count_nonzero(follows)) / max(seen, 1),
        ),
        mask,
    )
