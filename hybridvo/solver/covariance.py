"""Covariance of a robust M-estimate that counts errors which neighbouring pixels share.

The sandwich of Huber (1967), its scores summed over overlapping blocks of the image before their
outer products are taken (Liang and Zeger, 1986; Newey and West, 1987; Conley, 1999). Errors that
whole parts of the view share are added as :mod:`hybridvo.solver.shared_errors` models them.
Where the variance grows with the size of the blocks as only a compromise between several motions
makes it, the growth is extrapolated to the whole image.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from hybridvo.core.results import UNINFORMATIVE_COVARIANCE
from hybridvo.solver.calibration import (
    ABSORBED,
    CLUSTERED,
    FEW_TILES,
    LONG_GROWTH,
    MIN_CURVATURE_RATIO,
    MODEL_SHARE,
    SMALLEST_LEFT_OVER,
)
from hybridvo.solver.depths import DepthAgreement
from hybridvo.solver.kernels import HESSIAN_SUMS
from hybridvo.solver.noise_estimation import Noise
from hybridvo.solver.shared_errors import (
    SharedErrors,
    parts_of_tiles,
    shared_covariance,
)

# px: single precision at a coordinate of 300
FLOW_ROUNDING = 2e-5
# The information is definite if its smallest eigenvalue is larger than this, and than this fraction
# of the largest.
MIN_EIGENVALUE = 1e-12
MIN_EIGENVALUE_RATIO = 1e-8
# Rows and columns of the 21 upper-triangle values of a symmetric matrix.
UPPER = np.triu_indices(6)


def _places() -> np.ndarray:
    """Return (6, 6): which of the 21 upper-triangle values each entry of the matrix is."""
    places = np.zeros((6, 6), np.intp)
    places[UPPER] = np.arange(HESSIAN_SUMS)
    places.T[UPPER] = np.arange(HESSIAN_SUMS)
    return places


PLACES = _places()


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


class BlockSums(NamedTuple):
    """Scores summed over blocks one, two and four tiles wide (S = 3)."""

    meats: np.ndarray  # (S, 6, 6) sums of outer products
    # (S,) fraction of the scores' variance that the fit took away
    absorbed: np.ndarray
    tiles: int  # number of tiles with usable pixels


class MotionCovariance(NamedTuple):
    """The covariance of a motion, and what decides whether it may be used."""

    covariance: np.ndarray  # (6, 6) of the left perturbation; m^2, m rad, rad^2
    # (6,) of the information, rising, metres in units of typical depth
    eigenvalues: np.ndarray
    tiles: int  # with usable pixels; 0 where the information is not definite


def direction_is_known(T: np.ndarray, covariance: np.ndarray) -> bool:
    """Return whether a translation is longer than three of its own standard deviations."""
    largest = max(np.linalg.eigvalsh(covariance[:3, :3])[-1], 0.0)
    return bool(np.linalg.norm(T[:3, 3]) > 3 * np.sqrt(largest))


def symmetric(upper: np.ndarray) -> np.ndarray:
    """Return the matrix (6, 6) of its 21 upper-triangle values, row by row."""
    return upper[PLACES]


def block_sums(tiles: np.ndarray, inverse: np.ndarray) -> BlockSums:
    """Sum scores over overlapping blocks of tiles.

    Under independent errors a block with information H_b has scores of covariance
    H_b - H_b H^-1 H_b about the estimate: the second term is what the fit absorbed.

    Args:
        tiles: (rows, columns, 27) upper triangle of the Hessian and score of each tile.
        inverse: (6, 6) inverse of the sum of the Hessians.
    """
    two_wide = _windows_of_four(tiles, 1)
    # every second tile, so that these blocks overlap by half as well
    four_wide = _windows_of_four(two_wide, 2)[1::2, 1::2]
    # a tile is in one block of its own size, and in four of each other size
    levels = ((tiles, 1.0), (two_wide, 0.25), (four_wide, 0.25))
    meats = []
    absorbed = []
    for image, fraction in levels:
        blocks = image[image[..., 0] > 0]
        scores = blocks[:, HESSIAN_SUMS:]
        X = inverse @ blocks[:, PLACES]
        meats.append(fraction * scores.T @ scores)
        absorbed.append(fraction * np.einsum("bij,bji->", X, X) / 6)
    occupied = int(np.count_nonzero(tiles[..., 0] > 0))
    return BlockSums(np.array(meats), np.array(absorbed), occupied)


def _windows_of_four(image: np.ndarray, distance: int) -> np.ndarray:
    """Sum the four entries at the corners of squares ``distance`` wide; zeros lie outside."""
    rows, columns, depth = image.shape
    padded = np.zeros((rows + 2 * distance, columns + 2 * distance, depth))
    padded[distance:-distance, distance:-distance] = image
    return (
        padded[distance:, distance:]
        + padded[distance:, :-distance]
        + padded[:-distance, distance:]
        + padded[:-distance, :-distance]
    )


def long_range(growth: float, tiles: int) -> float:
    """Return the factor on the variance of blocks two tiles wide for errors that reach farther.

    Args:
        growth: of the variance, from single tiles to blocks four tiles wide.
        tiles: number of tiles with usable pixels.
    """
    if not (growth > LONG_GROWTH[0] and np.isfinite(growth)):
        return 1.0
    low = math.log2(LONG_GROWTH[0])
    high = math.log2(LONG_GROWTH[1])
    per_doubling = 0.5 * math.log2(growth)
    weight = min((2 * per_doubling - low) / (high - low), 1.0)
    # errors that are the same everywhere grow with the area: none grow faster
    exponent = min(ABSORBED * per_doubling, 2.0) * weight
    doublings = max(0.0, 0.5 * math.log2(tiles / 4))
    return float(2.0 ** (exponent * doublings))


def _clustered_meat(blocks: BlockSums, independent: np.ndarray) -> np.ndarray:
    """Return the covariance (6, 6) of the summed score, with what neighbouring errors share.

    :data:`CLUSTERED` of it comes from blocks two tiles wide, the rest from the matrix of
    ``independent`` errors (6, 6), scaled by how much the blocks exceed it.
    """
    left_over = np.maximum(1 - blocks.absorbed, SMALLEST_LEFT_OVER)
    meats = blocks.meats / left_over[:, None, None]
    inverse = np.linalg.pinv(independent)
    inflation = np.trace(inverse @ meats, axis1=1, axis2=2) / 6
    reach = 1.0
    if inflation[0] > 0:
        reach = long_range(inflation[2] / inflation[0], blocks.tiles)
    scaled = max(1.0, inflation[1]) * independent
    clustered = CLUSTERED * meats[1] + (1 - CLUSTERED) * scaled
    missing = max(0.0, FEW_TILES / max(blocks.tiles, 1) - 1)
    return reach * clustered + missing * independent


def motion_covariance(
    statistics: ScoreStatistics,
    inverse_depth: float,
    focal: float,
    t: np.ndarray,
    noise: Noise,
) -> MotionCovariance:
    """Return the covariance of the left perturbation of a motion.

    The bread of the sandwich is the Gauss-Newton Hessian less the curvature of the robust weights.

    Args:
        statistics: of the fit, at its solution.
        inverse_depth: 1 / typical depth, 1 / m: it turns metres into radians.
        focal: focal length, px.
        t: (3,) translation, metres.
        noise: of flow and depth.

    Returns:
        The covariance; one without information, and no tiles, where a direction is undetermined.
    """
    scaling = np.array([1 / inverse_depth] * 3 + [1.0] * 3)
    outer = np.outer(scaling, scaling)
    tiles = statistics.tiles
    total = tiles.sum(axis=(0, 1))
    H = symmetric(total[:HESSIAN_SUMS]) * outer
    eigenvalues = np.linalg.eigvalsh(H) if np.isfinite(H).all() else np.zeros(6)
    unknown = MotionCovariance(UNINFORMATIVE_COVARIANCE.copy(), eigenvalues, 0)
    smallest = max(MIN_EIGENVALUE_RATIO * eigenvalues[-1], MIN_EIGENVALUE)
    if not eigenvalues[0] > smallest:
        return unknown

    bread = H - statistics.curvature * outer
    if np.linalg.eigvalsh(bread)[0] <= MIN_CURVATURE_RATIO * eigenvalues[0]:
        bread = H
    inverse = np.linalg.inv(bread)
    model = np.linalg.inv(H)

    # scores of the tiles where all of them together are zero, to first order
    step = (model * outer) @ total[HESSIAN_SUMS:]
    upper = tiles[..., :HESSIAN_SUMS]
    scores = tiles[..., HESSIAN_SUMS:] - upper[..., PLACES] @ step
    centred = np.concatenate([upper, scores], axis=2)
    blocks = block_sums(centred, model * outer)
    scaled = blocks._replace(meats=blocks.meats * outer)
    meat = _clustered_meat(scaled, statistics.meat * outer)

    covariance = inverse @ meat @ inverse + _shared(
        statistics.shared, scaling, model
    )
    rounding = statistics.weight * _rounding_fraction(
        focal * float(np.linalg.norm(t)) * inverse_depth, noise
    )
    covariance = covariance + (MODEL_SHARE + rounding) * model
    covariance = 0.5 * (covariance + covariance.T) * outer
    # the mean of depth errors may be 0 in log depth, in depth or in its inverse: these differ by
    # half the variance of log depth, and so does the length of the translation
    covariance[:3, :3] += (0.5 * noise.log_depth**2) ** 2 * np.outer(t, t)
    if not np.isfinite(covariance).all():
        return unknown
    return MotionCovariance(covariance, eigenvalues, blocks.tiles)


def _shared(
    shared: SharedErrors, scaling: np.ndarray, model: np.ndarray
) -> np.ndarray:
    """Return the covariance (6, 6) by errors that whole parts of the view share.

    The robust weights turn such errors down as much as their curvature raises the effect of a
    score: the Hessian alone counts.
    """
    effects = shared.pulls * scaling @ model
    rows, columns = effects.shape[:2]
    effects = effects.reshape(rows * columns, -1, 6)
    part_of = parts_of_tiles(rows, columns)
    return shared.coherent * shared_covariance(effects, part_of)


def _rounding_fraction(parallax: float, noise: Noise) -> float:
    """Return the variance of rounding over that of a residual, at a parallax in px.

    Neighbours are rounded alike, so that an average over n pixels is no better than one.
    """
    variance = noise.flow_px**2 + (parallax * noise.log_depth) ** 2
    return FLOW_ROUNDING**2 / variance


def with_doubtful_length(
    covariance: np.ndarray, t: np.ndarray, depths: DepthAgreement | None
) -> np.ndarray:
    """Return a covariance (6, 6) with the length of its translation as uncertain as the depths.

    Args:
        covariance: of a motion.
        t: (3,) its translation, metres.
        depths: how the depths of both frames compare along the motion, or None.
    """
    if depths is None:
        return covariance
    doubtful = covariance.copy()
    doubtful[:3, :3] += depths.length_variance * np.outer(t, t)
    return doubtful
