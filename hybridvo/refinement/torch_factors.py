"""The ego-flow reprojection residual of a batch of pairs in torch, and its normal equations.

The same definition as :mod:`hybridvo.refinement.kernels`, formulas there; a test holds both equal.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import NamedTuple

import torch

from hybridvo.refinement.batch import Pixels
from hybridvo.refinement.kernels import MAX_SHIFT
from hybridvo.torch_geometry import MIN_DEPTH, left_update, move, pp, project, projection_rows

BEHIND_DISTANCE2 = 1e4
"""Squared Mahalanobis distance at which a pixel behind the camera is charged."""


class RobustNoise(NamedTuple):
    """How residuals are weighed: (B, 2) noise sf px, sd; cutoff of the Geman-McClure kernel."""

    noise: torch.Tensor
    cutoff: float = 3.0

    def kernel(self, distance2: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
        """(cost rho, weight 2 d rho / d d2, its relative slope -2 (d weight / d d2) / weight)."""
        c2 = self.cutoff**2
        share = c2 / (c2 + distance2)
        return 0.5 * share * distance2, share.square(), 4 * share / c2


@dataclass(frozen=True, eq=False)
class Residuals:
    """What a pose says of every pixel: a, b, i (B, N), r and its sensitivity q (B, 2, N)."""

    a: torch.Tensor
    b: torch.Tensor
    i: torch.Tensor
    r: torch.Tensor
    q: torch.Tensor
    t: torch.Tensor
    front: torch.Tensor


def residuals(pixels: Pixels, T: pp.LieTensor) -> Residuals:
    """Residuals and their sensitivity to the log depth at pypose SE3 poses (B, 7)."""
    matrix = T.matrix().to(pixels.points.dtype)
    moved = move(matrix, pixels.points)
    front = moved[:, 2] > MIN_DEPTH
    moved = torch.where(front[:, None], moved, torch.ones_like(moved))
    r, i = pixels.target - project(moved, pixels.K), 1 / moved[:, 2]
    a, b, t = moved[:, 0] * i, moved[:, 1] * i, matrix[:, :3, 3, None]
    return Residuals(a, b, i, r, _sensitivity(pixels, a, b, i, t), t, front)


def _focal(pixels: Pixels) -> torch.Tensor:
    return pixels.K.diagonal(dim1=1, dim2=2)[:, :2, None]


def _sensitivity(
    pixels: Pixels, a: torch.Tensor, b: torch.Tensor, i: torch.Tensor, t: torch.Tensor
) -> torch.Tensor:
    """Q = d pi(X') / d log Z."""
    return _focal(pixels) * torch.stack(
        [i * (a * t[:, 2] - t[:, 0]), i * (b * t[:, 2] - t[:, 1])], 1
    )


def _information(
    pixels: Pixels, at: Residuals, noise: torch.Tensor
) -> tuple[torch.Tensor, torch.Tensor]:
    """(p, kappa) (B, N) of Sigma^-1 = p I - kappa p q (p q)^T."""
    p = 1 / (noise[:, 0, None].square() * pixels.flow_variance)
    depth = noise[:, 1, None].square() * pixels.depth_variance
    return p, depth / (1 + depth * p * at.q.square().sum(dim=1))


def at_likely_depth(pixels: Pixels, at: Residuals, noise: torch.Tensor) -> Residuals:
    """The same at the depths that the residuals make most likely; the residuals stay."""
    p, kappa = _information(pixels, at, noise)
    e = (kappa * p * (at.q * at.r).sum(dim=1)).clamp(-float(MAX_SHIFT), float(MAX_SHIFT))
    a, b = (torch.stack([at.a, at.b], 1) + at.q * e[:, None] / _focal(pixels)).unbind(1)
    i = at.i * (1 - (1 - at.t[:, 2] * at.i) * e)
    return replace(at, a=a, b=b, i=i, q=_sensitivity(pixels, a, b, i, at.t))


def jacobian(pixels: Pixels, at: Residuals) -> tuple[torch.Tensor, torch.Tensor]:
    """Both rows (B, 6, N) of d pi(X') / d delta."""
    u, v = projection_rows(at.a, at.b, at.i)
    f = _focal(pixels)
    return f[:, :1] * u, f[:, 1:] * v


@dataclass(frozen=True, eq=False)
class Weighted:
    """Residuals at the likely depths under their covariance and the robust kernel.

    Information p, kappa (B, N), Sigma^-1 r (B, 2, N), squared Mahalanobis distances (B, N), robust
    weights (B, N) without the external ones, 0 where unusable.
    """

    at: Residuals
    p: torch.Tensor
    kappa: torch.Tensor
    right: torch.Tensor
    distance2: torch.Tensor
    robust: torch.Tensor


def weigh(pixels: Pixels, T: pp.LieTensor, how: RobustNoise) -> Weighted:
    """Residuals at pypose SE3 poses (B, 7), weighed."""
    at = at_likely_depth(pixels, residuals(pixels, T), how.noise)
    p, kappa = _information(pixels, at, how.noise)
    along = kappa * p * (at.q * at.r).sum(dim=1)
    right = p[:, None] * (at.r - along[:, None] * at.q)
    distance2 = (right * at.r).sum(dim=1).clamp(min=0)
    usable = at.front & (pixels.weight > 0)
    robust = torch.where(usable, how.kernel(distance2)[1], torch.zeros_like(distance2))
    return Weighted(at, p, kappa, right, distance2, robust)


@dataclass(frozen=True, eq=False)
class Linearization:
    """Weighted normal equations at a pose, in C runs of pixels (the tiles, where there are tiles).

    Args:
        H: (B, C, 6, 6) sum of w J^T Sigma^-1 J. g: (B, C, 6) sum of w J^T Sigma^-1 r.
        cost: (B,) robust cost, pixels behind the camera at the full one.
        weight_sum: (B,) sum of robust times external weights.
        at: the residuals.
    """

    H: torch.Tensor
    g: torch.Tensor
    cost: torch.Tensor
    weight_sum: torch.Tensor
    at: Weighted

    def total(self) -> tuple[torch.Tensor, torch.Tensor]:
        """(H (B, 6, 6), g (B, 6)) in float64: a float32 sum over an image loses its fifth digit."""
        return self.H.double().sum(dim=1), self.g.double().sum(dim=1)


def linearize(
    pixels: Pixels, T: pp.LieTensor, how: RobustNoise, run: int | None = None
) -> Linearization:
    """Normal equations at pypose SE3 poses (B, 7), summed over runs of ``run`` pixels or all."""
    found = weigh(pixels, T, how)
    at, w, length = found.at, pixels.weight * found.robust, run or pixels.weight.shape[1]

    def runs(x: list[torch.Tensor], axis: int) -> torch.Tensor:
        """Values (B, N) or rows (B, 6, N) side by side, run by run."""
        return torch.cat([v.unflatten(-1, (-1, length)) for v in x], dim=axis)

    u, v = jacobian(pixels, at)
    pq = found.p[:, None] * at.q
    along = u * pq[:, :1] + v * pq[:, 1:]
    G = runs([u, v, along], 3).transpose(1, 2)  # (B, C, 6, 3 L)
    information = runs([w * found.p, w * found.p, -w * found.kappa], 2)
    H = (G * information[:, :, None]) @ G.transpose(2, 3)
    right = runs(list((w[:, None] * found.right).unbind(1)), 2)
    g = (G[..., : right.shape[2]] @ right[..., None])[..., 0]
    behind = torch.full_like(found.distance2, BEHIND_DISTANCE2)
    cost = how.kernel(torch.where(at.front, found.distance2, behind))[0]
    cost = (pixels.weight * cost).sum(dim=1)
    return Linearization(0.5 * (H + H.transpose(2, 3)), g, cost, w.sum(dim=1), found)


def scores(pixels: Pixels, T: pp.LieTensor, how: RobustNoise) -> tuple[torch.Tensor, Weighted]:
    """(B, 6, N) w J^T Sigma^-1 r of each pixel; their sum is zero at the estimate.

    It is not the gradient of the cost, since Sigma moves with the pose.
    """
    found = weigh(pixels, T, how)
    right = (pixels.weight * found.robust)[:, None] * found.right
    u, v = jacobian(pixels, found.at)
    return u * right[:, :1] + v * right[:, 1:], found


def newton_matrix(pixels: Pixels, T: pp.LieTensor, how: RobustNoise) -> torch.Tensor:
    """A = -dg / d xi, g the sum of the scores: (B, 6, 6), not symmetric; A xi = g is the step."""
    how = how._replace(noise=how.noise.detach())
    pixels = replace(pixels, K=pixels.K.detach())
    with torch.enable_grad():
        xi = torch.zeros(len(T), 6, dtype=T.dtype, device=T.device, requires_grad=True)
        g = scores(pixels, left_update(xi, T), how)[0].sum(dim=2)
        rows = [torch.autograd.grad(g[:, k].sum(), xi, retain_graph=True)[0] for k in range(6)]
    return -torch.stack(rows, dim=1)


def solve_small(
    A: torch.Tensor, b: torch.Tensor, damping: float = 0.0
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
    A = A / (scale[:, :, None] * scale[:, None, :]) + damping * unit
    x, info = torch.linalg.solve_ex(torch.where(good[:, None, None], A, unit), b / scale)
    x = x / scale
    good = good & (info == 0) & (x.abs() < 1e6).all(dim=1)
    return torch.where(good[:, None], x, torch.zeros_like(x)), good
