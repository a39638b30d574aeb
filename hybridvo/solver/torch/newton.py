"""Newton steps of a batch of poses, or of the unknowns of a window: the loop for all of them."""

from __future__ import annotations

from collections.abc import Callable
from typing import Generic, NamedTuple, Protocol, TypeVar

import torch

from hybridvo.solver.newton import ROUNDED_STEP_STD
from hybridvo.solver.newton_kernels import DAMPING, MAX_STEP

# First steps of a batch with exact derivatives, none of which ends it as rounding.
FIRST_BATCH_STEPS = 3

S = TypeVar("S")


class Equations(Protocol):
    """The normal equations of a batch at a state, float64."""

    @property
    def H(self) -> torch.Tensor:
        """(B, n, n) Gauss-Newton approximation of the second derivative."""

    @property
    def g(self) -> torch.Tensor:
        """(B, n) negative gradient."""

    @property
    def weight(self) -> torch.Tensor:
        """(B,) sum of the weights of the pixels."""

    @property
    def curvature(self) -> torch.Tensor | None:
        """(B, n, n): H less it is the derivative of -g; None: only Gauss-Newton's steps."""

    @property
    def max_step_ratio(self) -> float:
        """A Newton step is taken if step^T H step is at most so many times its decrease."""


E = TypeVar("E", bound=Equations)


class Rest(NamedTuple):
    """When a sample has come to rest."""

    length2: float  # squared length of its last step, standard deviations
    # root mean square motion of the image by it, standard deviations; where it is not 0, only
    # exact Newton steps after the first ones may end as rounding
    moved: float = 0.0


class Rested(NamedTuple, Generic[S]):
    """Where a batch ended."""

    state: S
    converged: torch.Tensor  # (B,) whether each sample has come to rest
    # (B,) steps that were taken; a sample whose equations have no solution stays where it is
    iterations: torch.Tensor
    solved: bool  # whether every step existed


class NewtonStep(NamedTuple):
    """A step of every sample."""

    delta: torch.Tensor  # (B, n)
    is_newton: torch.Tensor  # (B,) whether it is Newton's
    exists: torch.Tensor  # (B,)


def newton(
    linearize: Callable[[int, S], E],
    moved: Callable[[S, torch.Tensor, E], S],
    state: S,
    steps: int,
    rest: Rest | None = None,
) -> Rested[S]:
    """Make Newton steps, each sample until it has come to rest.

    Args:
        linearize: the equations of a step's number, from 0, at a state.
        moved: the state after steps (B, n), and the equations that they solve.
        state: where to begin.
        steps: most of them.
        rest: when a sample has come to rest; None: every step is made.
    """
    at = linearize(0, state)
    shortest = torch.full_like(at.g[:, 0], torch.inf, dtype=torch.float64)
    converged = torch.zeros_like(shortest, dtype=torch.bool)
    done = converged
    solved = torch.ones_like(converged)
    iterations = torch.zeros_like(shortest, dtype=torch.long)
    for k in range(steps):
        if k > 0:
            at = linearize(k, state)
        step = newton_step(at)
        delta = torch.where(done[:, None], torch.zeros_like(step.delta), step.delta)
        state = moved(state, delta, at)
        iterations = iterations + (~done).long()
        solved = solved & (done | step.exists)
        if rest is None:
            continue
        length2 = energy(delta, at.H)
        # root mean square motion of the image, standard deviations
        image = (length2 / at.weight.clamp(min=1e-12)).sqrt()
        rounded = (image > 0.5 * shortest) & (image < ROUNDED_STEP_STD)
        if rest.moved > 0:
            rounded = rounded & step.is_newton & (k > FIRST_BATCH_STEPS)
        is_last = (length2 < rest.length2) | (image < rest.moved) | rounded
        converged = converged | (~done & step.exists & is_last)
        shortest = torch.where(done, shortest, torch.minimum(shortest, image))
        done = converged | ~step.exists
        if bool(done.all()):
            break
    return Rested(state, converged, iterations, bool(solved.all()))


def newton_step(at: Equations) -> NewtonStep:
    """Return Newton's step where it leads downhill, elsewhere that of Gauss-Newton.

    A robust kernel may bend so far that the full derivative is not definite.
    """
    plain, solved = solve_small(at.H, at.g, DAMPING)
    if at.curvature is None:
        return NewtonStep(plain, torch.zeros_like(solved), solved)
    newton, exists = solve_small(at.H - at.curvature, at.g)
    decrease = (newton * at.g).sum(dim=1)
    is_short = energy(newton, at.H) <= at.max_step_ratio * decrease
    is_newton = exists & (decrease > 0) & is_short
    return NewtonStep(
        torch.where(is_newton[:, None], newton, plain), is_newton, solved
    )


def energy(step: torch.Tensor, H: torch.Tensor) -> torch.Tensor:
    """Return step^T H step (B,)."""
    return torch.einsum("bi,bij,bj->b", step, H, step).clamp(min=0)


def small_inverse(
    A: torch.Tensor, damping: float = 0.0
) -> tuple[torch.Tensor, torch.Tensor]:
    """Invert A + damping diag A, (B, n, n): the inverse, and (B,) whether there is one.

    The inverse is zero where there is none; it carries no gradient.
    """
    A = A.detach().double()
    damped = A + damping * torch.diag_embed(A.diagonal(dim1=1, dim2=2))
    inverse, info = torch.linalg.inv_ex(damped)
    exists = (info == 0) & torch.isfinite(inverse).flatten(1).all(dim=1)
    zero = torch.zeros_like(inverse)
    return torch.where(exists[:, None, None], inverse, zero), exists


def solve_small(
    A: torch.Tensor, b: torch.Tensor, damping: float = 0.0
) -> tuple[torch.Tensor, torch.Tensor]:
    """Solve (A + damping diag A) x = b: x (B, n), and (B,) whether there is a solution.

    The solution is zero where there is none, or where it is absurdly long.
    """
    inverse, exists = small_inverse(A, damping)
    x = (inverse @ b.double()[..., None])[..., 0]
    exists = exists & (x.abs() < MAX_STEP).all(dim=1)
    return torch.where(exists[:, None], x, torch.zeros_like(x)), exists
