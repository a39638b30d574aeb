"""Covariance of a robust M-estimate, honest about errors that neighbouring pixels share.

The sandwich of Huber (1967), its scores summed over overlapping blocks of the image before their
outer products are taken (Liang and Zeger, 1986; Newey and West, 1987; Conley, 1999). Where the
variance still grows with the size of the blocks, the growth is continued to that of the image.
"""

from __future__ import annotations

import math

import numpy as np

from hybridvo.calibration import ABSORBED, CLUSTERED, FEW_TILES, LONG_GROWTH
from hybridvo.results import UNINFORMATIVE_COVARIANCE

# least share of the scores' variance that the fit leaves in the blocks
SMALLEST_REST = 0.25
FLOW_ROUNDING = 2e-5  # pixels: single precision at a coordinate of 300
# rows and columns of the 21 upper-triangle values of a symmetric matrix
UPPER = np.triu_indices(6)
ORDER = np.zeros((6, 6), np.intp)  # place of each entry of the matrix among them
ORDER[UPPER] = ORDER.T[UPPER] = np.arange(21)


def direction_is_known(T: np.ndarray, covariance: np.ndarray) -> bool:
    """Whether a translation is longer than three of its own standard deviations."""
    spread = np.sqrt(max(np.linalg.eigvalsh(covariance[:3, :3])[-1], 0.0))
    return bool(np.linalg.norm(T[:3, 3]) > 3 * spread)


def symmetric(upper: np.ndarray) -> np.ndarray:
    """(6, 6) from its 21 upper-triangle values, row by row."""
    return upper[ORDER]


def block_sums(
    tiles: np.ndarray, inverse: np.ndarray
) -> tuple[np.ndarray, np.ndarray, int]:
    """Outer products (S, 6, 6) of the scores summed over blocks of tiles, what the fit took from
    them (S,), and the number of tiles with a score.

    Under independent errors a block with information H_b has scores of covariance H_b - H_b H^-1
    H_b about the estimate: the second term, in units of the first, is what the fit took.
    """
    meats = []
    lost = []
    counts = []
    two = _widened(tiles, 1)
    # blocks one, two and four tiles wide, none, half and half of them overlapping
    for image, share in (
        (tiles, 1.0),
        (two, 0.25),
        (_widened(two, 2)[1::2, 1::2], 0.25),
    ):
        blocks = image[image[..., 0] > 0]
        X = inverse @ blocks[:, ORDER]
        meats.append(share * blocks[:, 21:].T @ blocks[:, 21:])
        lost.append(share * np.einsum("bij,bji->", X, X) / 6)
        counts.append(len(blocks))
    return np.array(meats), np.array(lost), counts[0]


def _widened(image: np.ndarray, gap: int) -> np.ndarray:
    """Sums of four entries ``gap`` apart, from outside of the image on, zeros there."""
    x = np.zeros((len(image) + 2 * gap, image.shape[1] + 2 * gap, image.shape[2]))
    x[gap:-gap, gap:-gap] = image
    return x[gap:, gap:] + x[gap:, :-gap] + x[:-gap, gap:] + x[:-gap, :-gap]


def long_range(growth: float, tiles: int) -> float:
    """Factor on the variance of blocks two tiles wide for errors that reach beyond them, from its
    ``growth`` from single tiles to blocks four tiles wide.
    """
    if not (growth > LONG_GROWTH[0] and np.isfinite(growth)):
        return 1.0
    low, high = (math.log2(g) for g in LONG_GROWTH)
    doubling = 0.5 * math.log2(growth)
    weight = min((2 * doubling - low) / (high - low), 1.0)
    # no faster than of errors that are the same everywhere: the area
    exponent = min(ABSORBED * doubling, 2.0) * weight
    return float(2.0 ** (exponent * max(0.0, 0.5 * math.log2(tiles / 4))))


def motion_covariance(
    tiles: np.ndarray,
    curvature: np.ndarray,
    meat: np.ndarray,
    depth_scale: float,
    weight: float,
    focal: float,
    t: np.ndarray,
    noise: tuple[float, float],
) -> tuple[np.ndarray, np.ndarray, int]:
    """Covariance of the left perturbation, eigenvalues of the information, number of tiles with
    usable pixels; 0 where the information is not definite.

    Bread: Gauss-Newton Hessian less the curvature of the robust weights (6, 6). Meat:
    :data:`CLUSTERED` from overlapping blocks two tiles wide, the rest from independent errors,
    ``meat`` (6, 6), scaled by how much the blocks exceed them.

    ``tiles`` (rows, columns, 27): upper triangle of the Hessian and scores; ``depth_scale`` (1 / m)
    turns metres of translation into radians; ``noise``: px, log depth.
    """
    scaling = np.array([1 / depth_scale] * 3 + [1.0] * 3)
    outer = np.outer(scaling, scaling)
    total = tiles.sum(axis=(0, 1))
    H = symmetric(total[:21]) * outer
    eigenvalues = np.linalg.eigvalsh(H) if np.isfinite(H).all() else np.zeros(6)
    if not eigenvalues[0] > max(1e-8 * eigenvalues[-1], 1e-12):
        return UNINFORMATIVE_COVARIANCE.copy(), eigenvalues, 0
    bread = H - curvature * outer
    if np.linalg.eigvalsh(bread)[0] <= 0.2 * eigenvalues[0]:
        bread = H  # too few inliers for the curvature to be believed
    inverse = np.linalg.inv(bread)
    model = np.linalg.inv(H)
    # scores of the tiles where all of them together are zero, to first order
    step = (model * outer) @ total[21:]
    scores = tiles[..., 21:] - tiles[..., :21][..., ORDER] @ step
    alone = meat * outer
    centred = np.concatenate([tiles[..., :21], scores], axis=2)
    meats, lost, occupied = block_sums(centred, model * outer)
    meats = meats * outer / np.maximum(1 - lost, SMALLEST_REST)[:, None, None]
    inflation = np.trace(np.linalg.pinv(alone) @ meats, axis1=1, axis2=2) / 6
    reach = (
        long_range(inflation[2] / inflation[0], occupied)
        if inflation[0] > 0
        else 1.0
    )
    clustered = (
        CLUSTERED * meats[1] + (1 - CLUSTERED) * max(1.0, inflation[1]) * alone
    )
    middle = reach * clustered + max(0.0, FEW_TILES / max(occupied, 1) - 1) * alone
    # rounding is the same for neighbours, so that an average over n pixels is no better than one
    parallax = focal * float(np.linalg.norm(t)) * depth_scale
    rounding = (
        weight * FLOW_ROUNDING**2 / (noise[0] ** 2 + (parallax * noise[1]) ** 2)
    )
    # exact data leave no residuals to learn from: a hundredth of the model's own covariance stays
    covariance = inverse @ middle @ inverse + (0.01 + rounding) * model
    covariance = 0.5 * (covariance + covariance.T) * outer
    # whether depth errs about its log, its value or its inverse is not known: the translation's
    # length is uncertain by half the variance of log depth
    covariance[:3, :3] += (0.5 * noise[1] ** 2) ** 2 * np.outer(t, t)
    if not np.isfinite(covariance).all():
        return UNINFORMATIVE_COVARIANCE.copy(), eigenvalues, 0
    return covariance, eigenvalues, occupied
