"""Damped Newton steps on a sum of factors, and the small linear algebra around them.

A factor states its cost, gradient and second derivative at a state. Flow on all pixels, images,
depth maps and a prior are factors; :func:`newton` is the loop for all of them. Perturbations act
from the left, ``T <- Exp(delta) T``, delta = (translation, rotation).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Generic, NamedTuple, Protocol, TypeVar

import numpy as np

from hybridvo.solver.newton_kernels import (
    DAMPING,
    add_equations,
    inverse_or_nan,
    lowered,
    moved,
    newton_step,
    raised,
)

# Smallest and largest side of a tile of the covariance, px.
MIN_TILE_PX = 8
MAX_TILE_PX = 64
# Second derivative of the Geman-McClure cost at its minimum over the sum of its weights: 0.73 for
# normal residuals, less with outliers. A Newton step divides by it.
ROBUST_CURVATURE = 0.6

# Mean motion of the image, standard deviations, below which a step may be rounding: of a batch,
# where it is not half as long as the shortest before it; of a pair, where it is the one after the
# last.
ROUNDED_STEP_STD = 0.05
# A step that raises the cost is kept all the same where the square of the next one is smaller than
# this fraction of its own: noise may move the root of the gradient off the minimum.
MAX_NEXT_STEP2 = 0.5
UNCHANGED_LIGHT = np.array([1.0, 0.0])


class MotionState(NamedTuple):
    """What the factors of a pair depend on."""

    T_curr_prev: np.ndarray  # (4, 4)
    # (2,) gain of the current image over the previous one, offset in grey levels
    gain_offset: np.ndarray = UNCHANGED_LIGHT

    def moved(self, delta: np.ndarray) -> MotionState:
        """Return the state after a step: (6,) of the motion, or (8,) with gain and offset."""
        return MotionState(*moved(self.T_curr_prev, self.gain_offset, delta))


@dataclass(eq=False)
class Linearization:
    """Normal equations of a factor at a state, N = 6 or 8 unknowns.

    Attributes:
        H: (N, N) Gauss-Newton approximation of the cost's second derivative.
        g: (N,) negative gradient of the cost.
        cost: negative log likelihood.
        curvature: (N, N) of the robust weights: H less it is the derivative of -g.
    """

    H: np.ndarray
    g: np.ndarray
    cost: float
    curvature: np.ndarray


def robust_linearization(sums: np.ndarray, cost: float) -> Linearization:
    """Return the normal equations of residuals under a robust kernel.

    Args:
        sums: (1 + N, 1 + N) sums of the weighted products of residuals and their derivatives in
            N unknowns; the residuals come first.
        cost: of all residuals.
    """
    H = np.ascontiguousarray(sums[1:, 1:])
    g = -sums[1:, 0]
    return Linearization(H, g, cost, (1 - ROBUST_CURVATURE) * H)


L_co = TypeVar("L_co", bound=Linearization, covariant=True)


class Factor(Protocol[L_co]):
    """A part of the cost of a motion."""

    def linearize(self, state: MotionState) -> L_co:
        """Return the normal equations at a state."""
        ...


class FactorSum:
    """The sum of factors, of which the first depends on all unknowns, the others on some."""

    def __init__(self, factors: Sequence[Factor[Linearization]]) -> None:
        self._factors = factors

    def linearize(self, state: MotionState) -> Linearization:
        """Return the normal equations of all factors at a state."""
        first, *others = self._factors
        at = first.linearize(state)
        H = at.H.copy()
        g = at.g.copy()
        curvature = at.curvature.copy()
        cost = at.cost
        for factor in others:
            part = factor.linearize(state)
            add_equations(part.H, part.g, part.curvature, H, g, curvature)
            cost += part.cost
        return Linearization(H, g, cost, curvature)


@dataclass(frozen=True, eq=False)
class NewtonResult(Generic[L_co]):
    """Where Newton's method ended.

    Attributes:
        state: the last one.
        at: the last linearization: at that state, or one step before it.
        iterations: steps that were checked.
        last2: squared length of the step after these, standard deviations; infinite where there
            is none.
    """

    state: MotionState
    at: L_co
    iterations: int
    last2: float


def newton(
    factor: Factor[L_co], start: MotionState, iterations: int, tolerance: float
) -> NewtonResult[L_co]:
    """Find the state of least cost by damped Newton steps.

    A step is kept where the cost falls or the next step is clearly shorter: noise may move the
    root of the gradient off the minimum.

    Args:
        factor: the cost.
        start: where to begin.
        iterations: most steps that are checked.
        tolerance: a step shorter than this, in standard deviations, is the last.

    Returns:
        The state after the last step, which is not checked: where there are no more of them, it is
        taken if the one before was kept.

    Example:
        >>> class Distance:
        ...     def linearize(self, state):
        ...         away = np.zeros(6)
        ...         away[:3] = state.T_curr_prev[:3, 3] - [1.0, 2.0, 3.0]
        ...         nothing = np.zeros((6, 6))
        ...         return Linearization(np.eye(6), -away, away @ away / 2, nothing)
        >>> newton(Distance(), MotionState(np.eye(4)), 3, 1e-3).state.T_curr_prev[:3, 3].round(5)
        array([1., 2., 3.])
    """
    state = start
    damping = DAMPING
    at = factor.linearize(state)
    delta, length2 = _step(at, damping)
    is_kept = True
    for iteration in range(iterations):
        if not math.isfinite(length2):
            return NewtonResult(state, at, iteration, length2)
        ahead = state.moved(delta)
        if length2 < tolerance**2:
            return NewtonResult(ahead, at, iteration, length2)
        candidate = factor.linearize(ahead)
        following, following2 = _step(candidate, lowered(damping))
        falls = candidate.cost <= at.cost
        if falls or following2 < MAX_NEXT_STEP2 * length2:
            state = ahead
            at = candidate
            damping = lowered(damping)
            delta = following
            length2 = following2
            is_kept = True
        else:
            damping = raised(damping)
            delta, length2 = _step(at, damping)
            is_kept = False
    if is_kept and math.isfinite(length2):
        state = state.moved(delta)
    return NewtonResult(state, at, iterations, length2)


def _step(at: Linearization, damping: float) -> tuple[np.ndarray, float]:
    """A step (N,) and its squared length in standard deviations, infinite where there is none."""
    delta, length2 = newton_step(at.H, at.curvature, at.g, damping)
    return delta, length2


def positive_inverse(matrix: np.ndarray) -> np.ndarray | None:
    """Return the symmetric inverse of a matrix (N, N), or None if it is not positive definite."""
    inverse = inverse_or_nan(np.ascontiguousarray(matrix, np.float64))
    return inverse if np.isfinite(inverse[0, 0]) else None


def tile_size(shape: tuple[int, int], tiles: int) -> int:
    """Return the side, px, of the tiles that cut an image (H, W) into about ``tiles``."""
    side = round(np.sqrt(shape[0] * shape[1] / tiles))
    return int(np.clip(side, MIN_TILE_PX, MAX_TILE_PX))
