"""Newton steps on all pixels of a pair, and the small linear algebra around them.

Perturbations act from the left, ``T <- Exp(delta) T``, delta = (translation, rotation).
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from hybridvo.compiled.numba_tools import njit
from hybridvo.core.geometry import se3_exp
from hybridvo.solver.calibration import (
    DAMPING_DECREASE,
    DAMPING_INCREASE,
    FAILED_DAMPING,
    MAX_TILE_PX,
    MIN_DECREASE,
    MIN_TILE_PX,
    ROUNDED_STEP_STD,
)


class Linearization(NamedTuple):
    """Robust normal equations at a motion, and what they were summed from."""

    # (6, 6) Gauss-Newton approximation of the cost's second derivative
    H: np.ndarray
    g: np.ndarray  # (6,) negative gradient of the cost
    cost: float  # negative log likelihood
    # (6, 6) of the robust weights: H less it is the derivative of -g
    curvature: np.ndarray
    meat: np.ndarray  # (6, 6) covariance of g if errors are independent
    tiles: np.ndarray  # (rows, columns, 27) upper triangle of H and g of each tile
    robust_sum: float  # sum of robust times external weights
    external_sum: float  # external weights of all usable pixels
    inlier_sum: float  # of those within the robust kernel's cutoff
    weights: np.ndarray  # (H, W) float32 robust weights, without the external ones


class NewtonResult(NamedTuple):
    """Where Newton's method ended."""

    T: np.ndarray  # (4, 4) motion
    at: Linearization  # the last one: at the motion, or one step below the tolerance before it
    iterations: int  # steps tried
    converged: bool  # whether the step that is left is short


class _Step(NamedTuple):
    """A Newton step."""

    delta: np.ndarray  # (6,)
    length2: float  # squared length in standard deviations; infinite where there is no step


def newton(
    linearize: Callable[[np.ndarray], Linearization],
    T_init: np.ndarray,
    iterations: int,
    tolerance: float,
) -> NewtonResult:
    """Find the motion of least cost by damped Newton steps.

    A step is kept where the cost falls or the next step is half as long: noise may move the root
    of the gradient off the minimum.

    Args:
        linearize: normal equations at a motion (4, 4).
        T_init: (4, 4) start.
        iterations: most steps.
        tolerance: a step shorter than this, in standard deviations, is the last. After the
            most steps, what is left may also be rounding.
    """
    T = T_init
    damping = 0.0
    at = linearize(T)
    step = _newton_step(at, damping)
    for iteration in range(iterations):
        if not np.isfinite(step.length2):
            return NewtonResult(T, at, iteration, converged=False)
        moved = se3_exp(step.delta) @ T
        if step.length2 < tolerance**2:
            return NewtonResult(moved, at, iteration, converged=True)
        candidate = linearize(moved)
        following = _newton_step(candidate, DAMPING_DECREASE * damping)
        falls = candidate.cost <= at.cost
        if falls or following.length2 < 0.5 * step.length2:
            T = moved
            at = candidate
            damping = DAMPING_DECREASE * damping
            step = following
        else:
            damping = max(DAMPING_INCREASE * damping, FAILED_DAMPING)
            step = _newton_step(at, damping)
    is_short = step.length2 < tolerance**2
    # root mean square motion of the image, standard deviations
    moved2 = step.length2 / max(at.robust_sum, 1e-12)
    return NewtonResult(T, at, iterations, is_short or moved2 < ROUNDED_STEP_STD**2)


def _newton_step(at: Linearization, damping: float) -> _Step:
    """Return the step with the full second derivative; with Gauss-Newton's if that is no use."""
    for H in (at.H - at.curvature, at.H):
        inverse = positive_inverse(H * (1 + damping * np.eye(6)))
        if inverse is None:
            continue
        delta = inverse @ at.g
        decrease = delta @ at.g
        if MIN_DECREASE * (delta @ at.H @ delta) <= decrease:
            return _Step(delta, float(decrease))
    return _Step(np.zeros(6), np.inf)


def positive_inverse(matrix: np.ndarray) -> np.ndarray | None:
    """Return the symmetric inverse of a matrix (N, N), or None if it is not positive definite."""
    inverse = inverse_or_nan(np.ascontiguousarray(matrix, np.float64))
    return inverse if np.isfinite(inverse[0, 0]) else None


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


def tile_size(shape: tuple[int, int], tiles: int) -> int:
    """Return the side, px, of the tiles that cut an image (H, W) into about ``tiles``."""
    side = round(np.sqrt(shape[0] * shape[1] / tiles))
    return int(np.clip(side, MIN_TILE_PX, MAX_TILE_PX))
