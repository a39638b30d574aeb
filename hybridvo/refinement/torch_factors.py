"""The ego-flow reprojection residual of a batch of pairs in torch, and its normal equations.

The same definition as the numba kernels; a test holds both equal. Per pixel, with X' = T X,
a = X'/Z', b = Y'/Z', i = 1/Z':

- residual r = (x + F) - pi(X') in px (paper, equations 6 and 8);
- Jacobian of pi(X') with respect to the left perturbation (translation, rotation):
  diag(fx, fy) [[i, 0, -a i, -a b, 1 + a^2, -b], [0, i, -b i, -(1 + b^2), a b, a]];
- u = q = d pi(X') / d log Z = (fx i (a tz - tx), fy i (b tz - ty));
- covariance Sigma = diag(sf^2 v_f, sf^2 v_f) + sd^2 v_d u u^T;
- a, b, i and u of the Jacobian and of Sigma (not of r) are taken at log Z + e, the posterior mean
  of the true log depth, e = sd^2 v_d u^T Sigma^-1 r (errors in variables: at the measured depth the
  translation comes out wrong by a share of about sd^2).

With the current frame's depth a third row joins, r_z = log D_curr(x + F) - log Z', with Jacobian
[0, 0, i, b, -a, 0] and sensitivity h = d log Z' / d log Z = 1 - tz i: u = (q, h) and
Sigma = diag(sf^2 v_f, sf^2 v_f, sz^2) + sd^2 v_d u u^T.

Sigma is inverted by the rank-one identity: with D the inverse of the diagonal, Sigma^-1 =
D - kappa (D u)(D u)^T, kappa = sd^2 v_d / (1 + sd^2 v_d u^T D u).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import reduce
from typing import NamedTuple

import torch

from hybridvo.refinement.batch import Pixels
from hybridvo.refinement.kernels import MAX_SHIFT
from hybridvo.torch_geometry import MIN_DEPTH, left_update, move, pp, project, projection_rows

BEHIND_DISTANCE2 = 1e4
"""Squared Mahalanobis distance at which a pixel behind the camera is charged."""

Rows = Sequence[torch.Tensor]


class Kernel(NamedTuple):
    """Robust kernel of the squared Mahalanobis distance d2 at the squared cutoff c2.

    Args:
        weight: 2 d rho / d d2, 1 at 0. cost: rho. curvature: -2 (d weight / d d2) / weight.
        cutoff: default c in standard deviations.
    """

    weight: Callable[[torch.Tensor, float], torch.Tensor]
    cost: Callable[[torch.Tensor, float], torch.Tensor]
    curvature: Callable[[torch.Tensor, float], torch.Tensor]
    cutoff: float


KERNELS = {
    "geman-mcclure": Kernel(
        lambda d2, c2: (c2 / (c2 + d2)).square(),
        lambda d2, c2: 0.5 * c2 * d2 / (c2 + d2),
        lambda d2, c2: 4 / (c2 + d2),
        3.0,
    ),
    "cauchy": Kernel(
        lambda d2, c2: c2 / (c2 + d2),
        lambda d2, c2: 0.5 * c2 * torch.log1p(d2 / c2),
        lambda d2, c2: 2 / (c2 + d2),
        2.385,
    ),
    "huber": Kernel(
        lambda d2, c2: (c2 / d2.clamp(min=c2)).sqrt(),
        lambda d2, c2: torch.where(d2 <= c2, 0.5 * d2, (c2 * d2.clamp(min=c2)).sqrt() - 0.5 * c2),
        lambda d2, c2: (d2 > c2) / d2.clamp(min=c2),
        1.345,
    ),
    "l2": Kernel(
        lambda d2, c2: torch.ones_like(d2),
        lambda d2, c2: 0.5 * d2,
        lambda d2, c2: torch.zeros_like(d2),
        1.0,
    ),
}
"""Cutoffs: 3 as in the numba solver; the 95 % efficient ones for Huber and Cauchy (P. J. Huber,
Robust Statistics)."""


@dataclass(frozen=True, eq=False)
class Residuals:
    """What a pose says of every pixel, (B, N) each; see this module's formulas."""

    a: torch.Tensor
    b: torch.Tensor
    i: torch.Tensor
    r: tuple[torch.Tensor, ...]
    u: tuple[torch.Tensor, ...]
    t: torch.Tensor
    front: torch.Tensor


def residuals(pixels: Pixels, T: pp.LieTensor) -> Residuals:
    """Residuals and their sensitivity to the depth at pypose SE3 poses (B, 7)."""
    matrix = T.matrix().to(pixels.points.dtype)
    moved = move(matrix, pixels.points)
    front = moved[:, 2] > MIN_DEPTH
    moved = torch.where(front[:, None], moved, torch.ones_like(moved))
    r = (pixels.target - project(moved, pixels.K)).unbind(1)
    i = 1 / moved[:, 2]
    if pixels.log_depth_curr is not None:
        r = (*r, pixels.log_depth_curr + i.log())
    a, b, t = moved[:, 0] * i, moved[:, 1] * i, matrix[:, :3, 3, None]
    return Residuals(a, b, i, r, _sensitivity(pixels, a, b, i, t), t, front)


def _sensitivity(
    pixels: Pixels, a: torch.Tensor, b: torch.Tensor, i: torch.Tensor, t: torch.Tensor
) -> tuple[torch.Tensor, ...]:
    """U = d prediction / d log Z."""
    fx, fy = pixels.K[:, 0, 0, None], pixels.K[:, 1, 1, None]
    u = (fx * i * (a * t[:, 2] - t[:, 0]), fy * i * (b * t[:, 2] - t[:, 1]))
    return u if pixels.log_depth_curr is None else (*u, 1 - t[:, 2] * i)


class Whitening(NamedTuple):
    """D, kappa and D u of Sigma^-1 = diag(D) - kappa (D u)(D u)^T."""

    D: tuple[torch.Tensor, ...]
    kappa: torch.Tensor
    Du: tuple[torch.Tensor, ...]

    def apply(self, r: Rows) -> tuple[list[torch.Tensor], torch.Tensor]:
        """(Sigma^-1 r, squared Mahalanobis distance)."""
        along = self.kappa * _dot(self.Du, r)
        n = [d * x - along * v for d, x, v in zip(self.D, r, self.Du, strict=True)]
        return n, _dot(n, r).clamp(min=0)


def _dot(a: Rows, b: Rows) -> torch.Tensor:
    return reduce(torch.add, (x * y for x, y in zip(a, b, strict=True)))


def whitening(pixels: Pixels, at: Residuals, noise: torch.Tensor) -> Whitening:
    """Inverse covariance of each pixel, for noise (B, 2) sf px, sd; (B, 3) with sz."""
    flow = 1 / (noise[:, 0, None].square() * pixels.flow_variance)
    D: tuple[torch.Tensor, ...] = (flow, flow)
    if pixels.has_depth_curr is not None:
        D = (*D, pixels.has_depth_curr / noise[:, 2, None].square())
    Du = tuple(d * u for d, u in zip(D, at.u, strict=True))
    depth = noise[:, 1, None].square() * pixels.depth_variance
    return Whitening(D, depth / (1 + depth * _dot(Du, at.u)), Du)


def at_likely_depth(pixels: Pixels, at: Residuals, noise: torch.Tensor) -> Residuals:
    """The same at the depths that the residuals make most likely; the residuals stay.

    a + e q_u / fx, b + e q_v / fy, i (1 - h e).
    """
    white = whitening(pixels, at, noise)
    e = (white.kappa * _dot(white.Du, at.r)).clamp(-float(MAX_SHIFT), float(MAX_SHIFT))
    a = at.a + at.u[0] * e / pixels.K[:, 0, 0, None]
    b = at.b + at.u[1] * e / pixels.K[:, 1, 1, None]
    i = at.i * (1 - (1 - at.t[:, 2] * at.i) * e)
    return replace(at, a=a, b=b, i=i, u=_sensitivity(pixels, a, b, i, at.t))


def jacobian(pixels: Pixels, at: Residuals) -> tuple[torch.Tensor, ...]:
    """Rows d prediction / d delta, each (B, 6, N): u, v and, with the depth, log Z'."""
    u, v = projection_rows(at.a, at.b, at.i)
    rows = pixels.K[:, 0, 0, None, None] * u, pixels.K[:, 1, 1, None, None] * v
    if pixels.log_depth_curr is None:
        return rows
    zero = torch.zeros_like(at.a)
    return (*rows, torch.stack([zero, zero, at.i, at.b, -at.a, zero], dim=1))


class RobustNoise(NamedTuple):
    """How residuals are weighed: (B, 2) or (B, 3) noise, name of the kernel, its cutoff."""

    noise: torch.Tensor
    kernel: str = "geman-mcclure"
    cutoff: float = KERNELS["geman-mcclure"].cutoff


@dataclass(frozen=True, eq=False)
class Linearization:
    """Weighted normal equations at a pose, in C runs of pixels (the tiles, where there are tiles).

    Args:
        H: (B, C, 6, 6) sum of w J^T Sigma^-1 J. g: (B, C, 6) sum of w J^T Sigma^-1 r.
        cost: (B,) robust cost, pixels behind the camera at the full one.
        weights: (B, N) robust weights without the external ones, 0 where unusable.
        weight_sum: (B,) sum of robust times external weights.
        distance2: (B, N) squared Mahalanobis distances.
        scores: (B, 6, N) w J^T Sigma^-1 r per pixel where asked for, else None.
    """

    H: torch.Tensor
    g: torch.Tensor
    cost: torch.Tensor
    weights: torch.Tensor
    weight_sum: torch.Tensor
    distance2: torch.Tensor
    scores: torch.Tensor | None = None

    def total(self) -> tuple[torch.Tensor, torch.Tensor]:
        """(H (B, 6, 6), g (B, 6)) in float64: a float32 sum over an image loses its fifth digit."""
        return self.H.double().sum(dim=1), self.g.double().sum(dim=1)


def linearize(
    pixels: Pixels,
    T: pp.LieTensor,
    how: RobustNoise,
    run: int | None = None,
    scores: bool = False,
) -> Linearization:
    """Normal equations of a batch at pypose SE3 poses (B, 7).

    Args:
        pixels: of the batch.
        T: T_curr_prev.
        how: noise and kernel.
        run: number of pixels in a run, a divisor of N; all of them by default.
        scores: whether the score of each pixel is asked for.
    """
    kernel, c2 = KERNELS[how.kernel], how.cutoff**2
    at = residuals(pixels, T)
    at = at_likely_depth(pixels, at, how.noise)
    white = whitening(pixels, at, how.noise)
    n, distance2 = white.apply(at.r)
    usable = at.front & (pixels.weight > 0)
    weights = torch.where(usable, kernel.weight(distance2, c2), torch.zeros_like(distance2))
    w = pixels.weight * weights
    rows = jacobian(pixels, at)
    batch, count = w.shape
    shape = (batch, -1, run or count)

    def runs(x: Rows, axis: int) -> torch.Tensor:
        """Columns (B, N) or rows (B, 6, N) side by side, run by run."""
        return torch.cat([v.reshape(*v.shape[:-1], *shape[1:]) for v in x], dim=axis)

    along = _dot(rows, [v[:, None] for v in white.Du])
    G = runs([*rows, along], 3).transpose(1, 2)  # (B, C, 6, rows * L)
    information = runs([*(w * d for d in white.D), -w * white.kappa], 2)
    H = (G * information[:, :, None]) @ G.transpose(2, 3)
    right = runs([w * m for m in n], 2)
    g = (G[..., : right.shape[2]] @ right[..., None])[..., 0]
    behind = distance2.new_full((), BEHIND_DISTANCE2)
    rho = torch.where(at.front, kernel.cost(distance2, c2), kernel.cost(behind, c2))
    return Linearization(
        H=0.5 * (H + H.transpose(2, 3)),
        g=g,
        cost=(pixels.weight * rho).sum(dim=1),
        weights=weights,
        weight_sum=w.sum(dim=1),
        distance2=distance2,
        scores=_dot(rows, [(w * m)[:, None] for m in n]) if scores else None,
    )


def score_sum(
    pixels: Pixels, T: pp.LieTensor, how: RobustNoise, xi: torch.Tensor | None = None
) -> torch.Tensor:
    """(B, 6) estimating equation g = sum of w J^T Sigma^-1 r at Exp(xi) T, for differentiation.

    The pose that solves g = 0 is the estimate; g is not the gradient of the cost, since Sigma moves
    with the pose.
    """
    at = residuals(pixels, T if xi is None else left_update(xi, T))
    at = at_likely_depth(pixels, at, how.noise)
    n, distance2 = whitening(pixels, at, how.noise).apply(at.r)
    w = torch.where(at.front & (pixels.weight > 0), pixels.weight, torch.zeros_like(distance2))
    w = w * KERNELS[how.kernel].weight(distance2, how.cutoff**2)
    return _dot(jacobian(pixels, at), [(w * m)[:, None] for m in n]).sum(dim=2)


def newton_matrix(pixels: Pixels, T: pp.LieTensor, how: RobustNoise) -> torch.Tensor:
    """A = -dg / d xi at pypose SE3 poses, (B, 6, 6), not symmetric; A xi = g is the Newton step."""
    how = how._replace(noise=how.noise.detach())
    pixels = replace(pixels, K=pixels.K.detach())
    with torch.enable_grad():
        xi = torch.zeros(len(T), 6, dtype=T.dtype, device=T.device, requires_grad=True)
        g = score_sum(pixels, T, how, xi)
        rows = [torch.autograd.grad(g[:, k].sum(), xi, retain_graph=True)[0] for k in range(6)]
    return -torch.stack(rows, dim=1)


def solve_small(
    A: torch.Tensor, b: torch.Tensor, damping: torch.Tensor | float = 0.0
) -> tuple[torch.Tensor, torch.Tensor]:
    """Solve ((A + damping diag A) x = b) for (B, 6, 6) systems in float64, each for itself.

    Returns:
        (B, 6) float64 solutions and (B,) bool; where False (singular, or not finite) they are zero.
    """
    A, b = A.double(), b.double()
    unit = torch.eye(A.shape[1], dtype=A.dtype, device=A.device)
    scale = A.diagonal(dim1=1, dim2=2).abs().sqrt()
    good = torch.isfinite(A).flatten(1).all(dim=1) & torch.isfinite(b).all(dim=1)
    good = good & (scale > 1e-15).all(dim=1)
    scale = torch.where(good[:, None], scale, torch.ones_like(scale))
    b = torch.where(good[:, None], b, torch.zeros_like(b))
    damping = torch.as_tensor(damping, dtype=A.dtype, device=A.device).reshape(-1, 1, 1)
    A = A / (scale[:, :, None] * scale[:, None, :]) + damping * unit
    x, info = torch.linalg.solve_ex(torch.where(good[:, None, None], A, unit), b / scale)
    x = x / scale
    good = good & (info == 0) & (x.abs() < 1e6).all(dim=1)
    return torch.where(good[:, None], x, torch.zeros_like(x)), good
