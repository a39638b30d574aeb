"""Numba kernels of a damped Newton step, and the small linear algebra around it."""

from __future__ import annotations

import numpy as np

from hybridvo.compiled.numba_tools import njit, noinline
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
def unit_scale(matrix):
    """Return the factors (N,) of rows and columns that make a diagonal 1; 0 where it is 0.

    Metres and radians differ by orders of magnitude: a unit diagonal makes pivots comparable.
    """
    size = len(matrix)
    scale = np.zeros(size)
    for i in range(size):
        if matrix[i, i] > 0:
            scale[i] = 1.0 / np.sqrt(matrix[i, i])
    return scale


@njit(error_model="numpy", cache=True, nogil=True)
def all_finite(matrix):
    """Return whether every entry of a matrix is finite."""
    rows, columns = matrix.shape
    for i in range(rows):
        for j in range(columns):
            if not np.isfinite(matrix[i, j]):
                return False
    return True


@njit(error_model="numpy", cache=True, nogil=True)
def solve_definite(matrix, right_side, damping):
    """Solve (A + damping diag A) x = b for A (N, N) by LAPACK.

    With damping an unknown that nothing depends on, with zeros in its row, is 0.

    Returns:
        x (N,); NaN where A is not positive definite.
    """
    noinline()  # type: ignore[call-arg]
    size = len(right_side)
    unknown = np.full(size, np.nan)
    for i in range(size):
        if not matrix[i, i] >= 0:
            return unknown
    scale = unit_scale(matrix)
    scaled = np.empty((size, size))
    # a matrix, as in inverse_or_nan: numba compiles LAPACK's callers for one kind alone
    scaled_right_side = np.empty((size, 1))
    for i in range(size):
        for j in range(size):
            scaled[i, j] = matrix[i, j] * scale[j] * scale[i]
        scaled[i, i] += damping
        scaled_right_side[i, 0] = scale[i] * right_side[i]
    try:
        factor = np.linalg.cholesky(scaled)
        scaled_x = np.linalg.solve(scaled, scaled_right_side)
    except Exception:  # numba knows no other: not definite, or not finite
        return unknown
    x = np.empty(size)
    for i in range(size):
        x[i] = scale[i] * scaled_x[i, 0]
        pivot = factor[i, i] * factor[i, i]
        # False for numbers that are none
        if not (pivot > MIN_PIVOT and abs(x[i]) < MAX_STEP):
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
    noinline()  # type: ignore[call-arg]
    size = len(matrix)
    unknown = np.full((size, size), np.nan)
    if not all_finite(matrix):
        return unknown
    for i in range(size):
        if matrix[i, i] <= 0:
            return unknown
    scale = unit_scale(matrix)
    scaled = np.empty((size, size))
    for i in range(size):
        for j in range(size):
            scaled[i, j] = matrix[i, j] * (scale[i] * scale[j])
    try:
        factor = np.linalg.cholesky(scaled)
        half = np.linalg.solve(factor, np.eye(size))
    except Exception:  # numba knows no other: not definite
        return unknown
    inverse = half.T @ half
    for i in range(size):
        for j in range(size):
            inverse[i, j] *= scale[i] * scale[j]
    return inverse if all_finite(inverse) else unknown
