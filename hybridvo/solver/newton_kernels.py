"""Numba kernels of a damped Newton step, and the small linear algebra around it."""

from __future__ import annotations

import numpy as np

from hybridvo.compiled.numba_tools import njit
from hybridvo.core.geometry import se3_exp
from hybridvo.solver.calibration import MAX_IMAGE_GAIN, MIN_IMAGE_GAIN
from hybridvo.solver.rows import MOTION_TERMS

# Levenberg's damping, as a fraction of the Hessian's diagonal: its smallest, which keeps a
# direction that nothing determines where it is; that after a first step that failed; the factors
# after a step that was kept and after one that was taken back.
DAMPING = 1e-6
FAILED_DAMPING = 1e-2
DAMPING_DECREASE = 0.1
DAMPING_INCREASE = 10.0
# Smallest pivot of the scaled Hessian with which it counts as definite.
MIN_PIVOT = 1e-13
# Predicted decrease g^T delta of the cost, as a ratio to delta^T H delta, below which a step with
# the full second derivative is not taken.
MIN_DECREASE = 0.25
# Longest step, in metres and radians, that is believed.
MAX_STEP = 1e6


@njit(error_model="numpy", cache=True, nogil=True)
def lowered(damping):
    """Return the damping after a step that was kept."""
    return max(DAMPING_DECREASE * damping, DAMPING)


@njit(error_model="numpy", cache=True, nogil=True)
def raised(damping):
    """Return the damping after a step that was taken back."""
    return max(DAMPING_INCREASE * damping, FAILED_DAMPING)


@njit(error_model="numpy", cache=True, nogil=True)
def newton_step(H, curvature, g, damping):
    """Return the step with the full second derivative; with Gauss-Newton's if that is no use.

    Args:
        H: (N, N) Gauss-Newton approximation of the second derivative.
        curvature: (N, N) what it lacks.
        g: (N,) negative gradient.
        damping: fraction of the diagonal that is added to it.

    Returns:
        The step (N,), and its squared length in standard deviations; infinite without a step.
    """
    for matrix in (H - curvature, H):
        delta = solve_definite(matrix, g, damping)
        decrease = np.sum(delta * g)
        # False where there is no step, and the numbers are none
        if MIN_DECREASE * np.sum(delta * (H @ delta)) <= decrease:
            return delta, decrease
    return np.zeros(len(g)), np.inf


@njit(error_model="numpy", cache=True, nogil=True)
def solve_definite(matrix, right_side, damping):
    """Solve (A + damping diag A) x = b for A (N, N) by LAPACK.

    With damping an unknown that nothing depends on, with zeros in its row, is 0.

    Returns:
        x (N,); NaN where A is not positive definite.
    """
    size = len(right_side)
    unknown = np.full(size, np.nan)
    diagonal = np.diag(matrix)
    if not np.all(diagonal >= 0):
        return unknown
    # metres and radians differ by orders of magnitude: a unit diagonal makes pivots comparable
    scale = np.zeros(size)
    for i in range(size):
        if diagonal[i] > 0:
            scale[i] = 1.0 / np.sqrt(diagonal[i])
    scaled = matrix * scale * scale.reshape(size, 1)
    for i in range(size):
        scaled[i, i] += damping
    try:
        pivots = np.diag(np.linalg.cholesky(scaled)) ** 2
        x = scale * np.linalg.solve(scaled, scale * right_side)
    except Exception:  # numba knows no other: not definite, or not finite
        return unknown
    # False for numbers that are none
    if not (np.all(pivots > MIN_PIVOT) and np.all(np.abs(x) < MAX_STEP)):
        return unknown
    return x


exponential = njit(error_model="numpy", cache=True, nogil=True)(se3_exp)


@njit(error_model="numpy", cache=True, nogil=True)
def moved(T, gain_offset, delta):
    """Return a motion (4, 4), gain and offset (2,) after a step.

    ``delta`` is (6,) of the motion, or (8,) with those of gain and offset.
    """
    after = gain_offset.copy()
    if len(delta) > MOTION_TERMS:
        after += delta[MOTION_TERMS:]
        after[0] = min(max(after[0], MIN_IMAGE_GAIN), MAX_IMAGE_GAIN)
    return exponential(delta[:MOTION_TERMS]) @ T, after


@njit(error_model="numpy", cache=True, nogil=True)
def add_equations(H, g, curvature, H_sum, g_sum, curvature_sum):
    """Add the normal equations of the first N unknowns to those of all of them."""
    for p in range(len(g)):
        g_sum[p] += g[p]
        for q in range(len(g)):
            H_sum[p, q] += H[p, q]
            curvature_sum[p, q] += curvature[p, q]


@njit(error_model="numpy", cache=True, nogil=True)
def inverse_or_nan(matrix):
    """Return the symmetric inverse of a matrix (N, N); NaN if it is not positive definite."""
    size = len(matrix)
    unknown = np.full((size, size), np.nan)
    diagonal = np.diag(matrix)
    if not (np.all(np.isfinite(matrix)) and np.all(diagonal > 0)):
        return unknown
    # metres and radians differ by orders of magnitude: a unit diagonal makes pivots comparable
    scale = 1.0 / np.sqrt(diagonal)
    scales = scale * scale.reshape(size, 1)
    try:
        factor = np.linalg.cholesky(matrix * scales)
        half = np.linalg.solve(factor, np.eye(size))
    except Exception:  # numba knows no other: not definite
        return unknown
    inverse = half.T @ half * scales
    return inverse if np.all(np.isfinite(inverse)) else unknown
