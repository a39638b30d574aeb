"""Covariance of a robust M-estimate, honest about errors that neighbouring pixels share.

Errors of flow and depth are correlated over tens of pixels, and over whole objects where a flow was
smoothed. The sandwich of Huber (1967) takes this in through its meat: the scores are summed over
blocks of the image before their outer products are taken (cluster-robust: Liang and Zeger, 1986),
and the blocks overlap, which is Bartlett's kernel of the heteroskedasticity- and autocorrelation-
consistent estimate in two dimensions (Newey and West, 1987; Conley, 1999). How the variance grows
from one size of block to the next tells whether the errors end within the blocks; where they do
not, the growth is continued to the size of the image (aggregated variance of processes with long-
range dependence: Beran, Statistics for Long-Memory Processes, 1994).
"""

from __future__ import annotations

import math

import numpy as np

from hybridvo.compilation import njit

NOTHING = np.diag([1e4] * 3 + [10.0] * 3)
"""Covariance that carries no information (m^2, rad^2)."""

FEW_TILES = 48
"""With fewer tiles the correlation between errors is hardly known; more of it is then assumed."""
CLUSTERED = 0.6
"""Share of the clustered matrix in the meat, the rest is that of independent errors scaled to the
same mean. Alone the few blocks make weak directions too certain at times (4 of 420 development
pairs of cells beyond 3 sigma, 0 with this share); the other makes all directions equally bad,
though errors of depth leave some of them alone."""
LONG_GROWTH = (1.7, 2.2)
"""Growth of the variance of sums over blocks four tiles wide (kept overlapping) against one tile's,
in units of independent errors, between which the errors come to count as reaching beyond the
blocks. Median and 95 % quantile over development pairs: 1.0 and 1.5 of independent noise,
1.0 to 1.3 and 1.8 to 2.7 of the cells (24 px in tiles of 64 px), 2.2 to 3.1 the median with DIS
flow. So every tenth to twentieth pair of noisy cells is doubted more than it should."""
ABSORBED = 2.0
"""The exponent of the growth is taken so much larger: what errors have in common over the whole
image the fit takes into the motion, so that the residuals show less of it than there is. On
development sequences with DIS flow (240 pairs) the median squared error in units of the covariance,
5.3 expected, was 12 with 1.5, 7 to 9 with 2 and 6 to 8 with 2.5."""
SMALLEST_REST = 0.25
"""Least share of the scores' variance that the fit is assumed to leave in the blocks."""

SIZES = np.array([[1, 1], [2, 1], [4, 2]])
"""Width of the blocks and distance between them, in tiles."""

UPPER = np.triu_indices(6)
"""Rows and columns of the 21 upper-triangle values of a symmetric matrix."""
ORDER = np.zeros((6, 6), np.intp)
"""Place of each entry of the matrix among them."""
ORDER[UPPER] = ORDER.T[UPPER] = np.arange(21)


def symmetric(upper: np.ndarray) -> np.ndarray:
    """(6, 6) from its 21 upper-triangle values, row by row."""
    return upper[ORDER]


@njit(error_model="numpy", cache=True, nogil=True)
def block_sums(scores, information, inverse, sizes, order, meats, lost):
    """Outer products of the scores summed over blocks of tiles, and what the fit took from them.

    Blocks reach over the border, so that every tile lies in as many of them; (width / step)^2 of
    them cover a tile, and each counts for that share. Under independent errors of the model's size
    a block with information H_b has scores of covariance H_b - H_b H^-1 H_b about the estimate:
    ``lost`` is the second term in units of the first, averaged over the directions.

    Args:
        scores: (rows, columns, 6) of the tiles.
        information: (rows, columns, 21) of the tiles.
        inverse: (6, 6) of the whole information.
        sizes: (S, 2) width and step of the blocks.
        order: :data:`ORDER`.
        meats: (S, 6, 6), set.
        lost: (S,), set.

    Returns:
        The number of tiles with a score.
    """
    rows, columns = scores.shape[:2]
    s = np.empty(6)
    h = np.empty(21)
    X = np.empty((6, 6))
    occupied = 0
    meats[:] = 0.0
    for k in range(len(sizes)):
        width, step = sizes[k, 0], sizes[k, 1]
        share = (step / width) ** 2
        trace = 0.0
        for v in range(step - width, rows, step):
            for u in range(step - width, columns, step):
                s[:] = 0.0
                h[:] = 0.0
                for i in range(max(v, 0), min(v + width, rows)):
                    for j in range(max(u, 0), min(u + width, columns)):
                        for p in range(6):
                            s[p] += scores[i, j, p]
                        for q in range(21):
                            h[q] += information[i, j, q]
                if not h[0] > 0.0:
                    continue
                occupied += width == 1
                for p in range(6):
                    for r in range(6):
                        meats[k, p, r] += share * s[p] * s[r]
                        x = 0.0
                        for m in range(6):
                            x += inverse[p, m] * h[order[m, r]]
                        X[p, r] = x
                for p in range(6):
                    for r in range(6):
                        trace += share * X[p, r] * X[r, p]
        lost[k] = trace / 6.0
    return occupied


def long_range(growth: float, tiles: int) -> float:
    """Factor on the variance of blocks two tiles wide for errors that reach beyond them.

    Args:
        growth: variance of the scores of blocks four tiles wide over that of single tiles, in units
            of independent errors.
        tiles: how many there are.
    """
    if not (growth > LONG_GROWTH[0] and np.isfinite(growth)):
        return 1.0
    low, high = (math.log2(g) for g in LONG_GROWTH)
    doubling = 0.5 * math.log2(growth)
    weight = min((2 * doubling - low) / (high - low), 1.0)
    # no faster than of errors that are the same everywhere: the area
    exponent = min(ABSORBED * doubling, 2.0) * weight
    return float(2.0 ** (exponent * max(0.0, 0.5 * math.log2(tiles / 4))))


def sandwich_covariance(
    total: np.ndarray,
    curvature: np.ndarray,
    meat: np.ndarray,
    scores: np.ndarray,
    information: np.ndarray,
    depth_scale: float,
    rounding: float = 0.0,
) -> tuple[np.ndarray, np.ndarray, bool]:
    """Covariance of the left perturbation, eigenvalues of the information, whether it is definite.

    Bread: the derivative of the estimating equation (Gauss-Newton Hessian less the curvature of the
    robust weights). Meat: :data:`CLUSTERED` from overlapping blocks two tiles wide, the rest from
    independent errors, scaled by how much the blocks exceed them on the average; both corrected for
    what the fit itself takes out of the residuals, and continued to the size of the image where
    the errors reach beyond the blocks.

    Args:
        total: (30,) sums of the normal equations over the full grid.
        curvature: (21,) curvature of the robust weights.
        meat: (21,) under independent errors.
        scores: (rows, columns, 6) scores summed over tiles.
        information: (rows, columns, 21) Gauss-Newton Hessian summed over tiles.
        depth_scale: 1 / m, turns metres of translation into radians of the image.
        rounding: what the rounding of exact data adds, in units of the model's own covariance.
    """
    scaling = np.array([1 / depth_scale] * 3 + [1.0] * 3)
    outer = np.outer(scaling, scaling)
    H = symmetric(total[:21]) * outer
    eigenvalues = np.linalg.eigvalsh(H) if np.isfinite(H).all() else np.zeros(6)
    if not eigenvalues[0] > max(1e-8 * eigenvalues[-1], 1e-12):
        return NOTHING.copy(), eigenvalues, False
    bread = H - symmetric(curvature) * outer
    if np.linalg.eigvalsh(bread)[0] <= 0.2 * eigenvalues[0]:
        bread = H  # too few inliers for the curvature to be believed
    inverse, model = np.linalg.inv(bread), np.linalg.inv(H)
    alone = symmetric(meat) * outer
    meats, lost = np.empty((len(SIZES), 6, 6)), np.empty(len(SIZES))
    tiles = block_sums(scores, information, model * outer, SIZES, ORDER, meats, lost)
    meats = meats * outer / np.maximum(1 - lost, SMALLEST_REST)[:, None, None]
    try:
        inflation = np.trace(np.linalg.solve(alone, meats), axis1=1, axis2=2) / 6
    except np.linalg.LinAlgError:
        inflation = np.ones(len(SIZES))  # residuals of zero: no doubt that could be compared
    reach = long_range(inflation[2] / inflation[0], tiles) if inflation[0] > 0 else 1.0
    clustered = CLUSTERED * meats[1] + (1 - CLUSTERED) * max(1.0, inflation[1]) * alone
    middle = reach * clustered + max(0.0, FEW_TILES / max(tiles, 1) - 1) * alone
    # exact data leave no residuals to learn from: a hundredth of the model's own covariance stays
    covariance = inverse @ middle @ inverse + (0.01 + rounding) * model
    covariance = 0.5 * (covariance + covariance.T) * outer
    if not np.isfinite(covariance).all():
        return NOTHING.copy(), eigenvalues, False
    return covariance, eigenvalues, True
