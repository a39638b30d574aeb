"""How much the summed score of a fit varies where neighbouring pixels share errors.

Scores are summed over overlapping blocks of the image before their outer products are taken
(Liang and Zeger, 1986; Newey and West, 1987; Conley, 1999). Where the variance grows with the size
of the blocks as only a compromise between several motions makes it, the growth is extrapolated to
the whole image.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from hybridvo.solver.calibration import ABSORBED, CLUSTERED, LONG_GROWTH
from hybridvo.solver.kernels import HESSIAN_SUMS

# With fewer tiles the correlation between errors is hardly known; more of it is then assumed.
FEW_TILES = 48
# Smallest fraction of the scores' variance that the fit is taken to leave in blocks of tiles.
SMALLEST_LEFT_OVER = 0.25

# Rows and columns of the 21 upper-triangle values of a symmetric matrix.
UPPER = np.triu_indices(6)


def _places() -> np.ndarray:
    """Return (6, 6): which of the 21 upper-triangle values each entry of the matrix is."""
    places = np.zeros((6, 6), np.intp)
    places[UPPER] = np.arange(HESSIAN_SUMS)
    places.T[UPPER] = np.arange(HESSIAN_SUMS)
    return places


PLACES = _places()


class BlockSums(NamedTuple):
    """Scores summed over blocks one, two and four tiles wide (S = 3)."""

    meats: np.ndarray  # (S, 6, 6) sums of outer products
    # (S,) fraction of the scores' variance that the fit took away
    absorbed: np.ndarray
    tiles: int  # number of tiles with usable pixels


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


def clustered_meat(blocks: BlockSums, independent: np.ndarray) -> np.ndarray:
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
