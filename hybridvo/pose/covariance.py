"""Covariance of a robust M-estimate, honest about correlated errors."""

from __future__ import annotations

import numpy as np

NOTHING = np.diag([1e4] * 3 + [10.0] * 3)
"""Covariance that carries no information (m^2, rad^2)."""

FEW_TILES = 24
"""With fewer tiles the correlation between errors cannot be estimated; it is then assumed."""

UPPER = np.triu_indices(6)
"""Rows and columns of the 21 upper-triangle values of a symmetric matrix."""
ORDER = np.zeros((6, 6), np.intp)
"""Place of each entry of the matrix among them."""
ORDER[UPPER] = ORDER.T[UPPER] = np.arange(21)


def symmetric(upper: np.ndarray) -> np.ndarray:
    """(6, 6) from its 21 upper-triangle values, row by row."""
    return upper[ORDER]


def sandwich_covariance(
    total: np.ndarray,
    curvature: np.ndarray,
    meat: np.ndarray,
    scores: np.ndarray,
    depth_scale: float,
    rounding: float = 0.0,
) -> tuple[np.ndarray, np.ndarray, bool]:
    """Covariance of the left perturbation, eigenvalues of the information, whether it is definite.

    Bread: the derivative of the estimating equation (Gauss-Newton Hessian less the curvature of the
    robust weights). Meat: half from outer products of the scores summed over tiles, so that errors
    correlated within a tile count as such (cluster-robust); half from independent errors, scaled by
    how much the tiles exceed them on the average. The tiles alone are few, and their matrix is too
    small in the directions that a handful of them decides.

    Args:
        total: (30,) sums of the normal equations over the full grid.
        curvature: (21,) curvature of the robust weights.
        meat: (21,) under independent errors.
        scores: (rows, columns, 6) scores summed over tiles.
        depth_scale: 1 / m, turns metres of translation into radians of the picture.
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
    inverse = np.linalg.inv(bread)
    independent = inverse @ (symmetric(meat) * outer) @ inverse
    flat = scores.reshape(-1, 6) * scaling
    flat = flat[np.abs(flat).max(axis=1) > 0]
    tiles = len(flat)
    covariance = independent
    if tiles >= FEW_TILES:
        clustered = inverse @ (flat.T @ flat) @ inverse * (tiles / (tiles - 6))
        try:
            inflation = np.trace(np.linalg.solve(independent, clustered)) / 6
        except np.linalg.LinAlgError:
            inflation = 1.0  # residuals of zero: no doubt that could be compared
        covariance = 0.5 * (clustered + max(1.0, inflation) * independent)
    else:
        covariance = independent * (1 + FEW_TILES / max(tiles, 1))
    # exact data leave no residuals to learn from: a hundredth of the model's own covariance stays
    covariance = covariance + (0.01 + rounding) * np.linalg.inv(H)
    covariance = 0.5 * (covariance + covariance.T) * outer
    if not np.isfinite(covariance).all():
        return NOTHING.copy(), eigenvalues, False
    return covariance, eigenvalues, True
