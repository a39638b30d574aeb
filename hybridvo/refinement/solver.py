"""Newton steps of a cost that is linearized about motions, and what all refinements share.

Perturbations act from the left, ``T <- Exp(delta) T``, delta = (translation, rotation).
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from scipy.linalg.lapack import dpotrf, dpotrs

from hybridvo.geometry import se3_exp
from hybridvo.options import RefineOptions


class Linearization(NamedTuple):
    """Normal equations of a cost."""

    H: np.ndarray  # (6, 6) Gauss-Newton approximation of its second derivative
    g: np.ndarray  # (6,) its negative gradient, or what else is to become zero
    cost: float  # in units of the log likelihood
    # of the robust weights: H less it is the derivative of -g
    curvature: np.ndarray


def gauss_newton(
    linearize: Callable[[np.ndarray], Linearization],
    T_init: np.ndarray,
    iterations: int,
    tolerance: float,
) -> tuple[np.ndarray, int]:
    """Motion (4, 4) of least cost, by damped Newton steps from a start; steps tried.

    A step is kept where the cost falls or the next step is half as long: noise may move the root
    off the minimum. A step shorter than ``tolerance`` standard deviations is the last.
    """
    T = T_init
    damping = 0.0
    now = linearize(T)
    step, length = _step(now, damping)
    for iteration in range(iterations):
        if not np.isfinite(length):
            return T, iteration
        moved = se3_exp(step) @ T
        if length < tolerance**2:
            return moved, iteration
        then = linearize(moved)
        following, left = _step(then, 0.1 * damping)
        if then.cost <= now.cost or left < 0.5 * length:
            T = moved
            now = then
            damping = 0.1 * damping
            step = following
            length = left
        else:
            linearize(T)  # callers read what the last call left
            damping = max(10 * damping, 1e-2)
            step, length = _step(now, damping)
    return T, iterations


def _step(at: Linearization, damping: float) -> tuple[np.ndarray, float]:
    """(Newton step, its squared length in standard deviations); infinite where there is none."""
    for H in (at.H - at.curvature, at.H):
        inverse = positive_inverse(H * (1 + damping * np.eye(6)))
        if inverse is None:
            continue
        step = inverse @ at.g
        if step @ at.H @ step <= 4.0 * (step @ at.g):
            return step, float(step @ at.g)
    return np.zeros(6), np.inf


def positive_inverse(matrix: np.ndarray) -> np.ndarray | None:
    """Inverse of a positive definite matrix, symmetric, or None."""
    diagonal = np.diag(matrix)
    if not (np.isfinite(matrix).all() and (diagonal > 0).all()):
        return None
    scale = 1 / np.sqrt(diagonal)
    scales = scale[:, None] * scale
    factor, failed = dpotrf(matrix * scales)
    if failed:
        return None
    # LAPACK's own inverse wakes threads, which takes longer than a whole step
    solved = dpotrs(factor, np.eye(len(scale)))[0]
    inverse = 0.5 * (solved + solved.T) * scales
    return inverse if np.isfinite(inverse).all() else None


def tile_size(shape: tuple[int, int], tiles: int = RefineOptions.tiles) -> int:
    """Side, px, of the tiles that cut an image into about ``tiles``; 8 to 64."""
    return int(np.clip(round(np.sqrt(shape[0] * shape[1] / tiles)), 8, 64))
