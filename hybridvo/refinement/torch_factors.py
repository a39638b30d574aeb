"""The ego-flow reprojection residual of a batch of pairs in torch, and its normal equations.

The same definition as :mod:`hybridvo.refinement.kernels`, formulas there; a test holds both equal.
With the current frame's depth a third row joins, ``r_z = log D_curr(x + F) - log Z'``.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import reduce
from typing import NamedTuple

import torch

from hybridvo.refinement.batch import Pixels
from hybridvo.refinement.kernels import MAX_SHIFT
from hybridvo.torch_geometry import MIN_DEPTH, left_update, move, pp, project, projection_rows

BEHIND_DISTANCE2 = 1e4
"""Squared Mahalanobis distance at which a pixel behind the camera is charged."""


def _geman_mcclure(d2: torch.Tensor, c2: float) -> Kernel:
    share = c2 / (c2 + d2)
    return Kernel(0.5 * share * d2, share.square(), 4 * share / c2)


def _cauchy(d2: torch.Tensor, c2: float) -> Kernel:
    share = c2 / (c2 + d2)
    return Kernel(0.5 * c2 * torch.log1p(d2 / c2), share, 2 * share / c2)


def _huber(d2: torch.Tensor, c2: float) -> Kernel:
    beyond = d2.clamp(min=c2)
    cost = torch.where(d2 <= c2, 0.5 * d2, (c2 * beyond).sqrt() - 0.5 * c2)
    return Kernel(cost, (c2 / beyond).sqrt(), (d2 > c2) / beyond)


def _l2(d2: torch.Tensor, c2: float) -> Kernel:
    return Kernel(0.5 * d2, torch.ones_like(d2), torch.zeros_like(d2))


class Kernel(NamedTuple):
    """Cost rho of squared distances d2, weight 2 rho', slope -2 weight' / weight."""

    cost: torch.Tensor
    weight: torch.Tensor
    slope: torch.Tensor


KERNELS = {"geman-mcclure": _geman_mcclure, "cauchy": _cauchy, "huber": _huber, "l2": _l2}
"""Robust kernels of the squared Mahalanobis distance, for a squared cutoff."""


class RobustNoise(NamedTuple):
    """How residuals are weighed: (B, 2) noise sf px, sd, or (B, 3) with sz; kernel and cutoff."""

    noise: torch.Tensor
    cutoff: float = 3.0
    name: str = "geman-mcclure"

    def kernel(self, distance2: torch.Tensor) -> Kernel:
        """The robust kernel at squared Mahalanobis distances."""
        return KERNELS[self.name](distance2, self.cutoff**2)


@dataclass(frozen=True, eq=False)
class Residuals:
    """What a pose says of every pixel: a, b, i (B, N), r and its sensitivity u (B, R, N).

    R is 2, the flow, or 3 with the log depth of the current frame.
    """

    a: torch.Tensor
    b: torch.Tensor
    i: torch.Tensor
    r: torch.Tensor
    u: torch.Tensor
    t: torch.Tensor
    front: torch.Tensor


def residuals(pixels: Pixels, T: pp.LieTensor) -> Residuals:
    """Residuals and their sensitivity to the log depth at pypose SE3 poses (B, 7)."""
    matrix = T.matrix().to(pixels.points.dtype)
    moved = move(matrix, pixels.points)
    front = moved[:, 2] > MIN_DEPTH
    moved = torch.where(front[:, None], moved, torch.ones_like(moved))
    r, i = pixels.target - project(moved, pixels.K), 1 / moved[:, 2]
    if pixels.log_depth_curr is not None:
        r = torch.cat([r, (pixels.log_depth_curr + i.log())[:, None]], 1)
    a, b, t = moved[:, 0] * i, moved[:, 1] * i, matrix[:, :3, 3, None]
    return Residuals(a, b, i, r, _sensitivity(pixels, a, b, i, t), t, front)


def _focal(pixels: Pixels) -> torch.Tensor:
    return pixels.K.diagonal(dim1=1, dim2=2)[:, :2, None]


def _sensitivity(
    pixels: Pixels, a: torch.Tensor, b: torch.Tensor, i: torch.Tensor, t: torch.Tensor
) -> torch.Tensor:
    """U = d prediction / d log Z: d pi(X') / d log Z, and d log Z' / d log Z."""
    q = [i * (a * t[:, 2] - t[:, 0]), i * (b * t[:, 2] - t[:, 1])]
    u = _focal(pixels) * torch.stack(q, 1)
    return u if pixels.log_depth_curr is None else torch.cat([u, (1 - t[:, 2] * i)[:, None]], 1)


def _information(
    pixels: Pixels, at: Residuals, noise: torch.Tensor
) -> tuple[torch.Tensor, torch.Tensor]:
    """(D (B, R, N), kappa (B, N)) of Sigma^-1 = diag(D) - kappa (D u)(D u)^T."""
    flow = 1 / (noise[:, 0, None].square() * pixels.flow_variance)
    rows = [flow, flow]
    if pixels.has_depth_curr is not None:
        rows.append(pixels.has_depth_curr / noise[:, 2, None].square())
    D = torch.stack(rows, 1)
    depth = noise[:, 1, None].square() * pixels.depth_variance
    return D, depth / (1 + depth * (D * at.u.square()).sum(dim=1))


def at_likely_depth(pixels: Pixels, at: Residuals, noise: torch.Tensor) -> Residuals:
    """The same at the depths that the residuals make most likely; the residuals stay."""
    D, kappa = _information(pixels, at, noise)
    e = (kappa * (D * at.u * at.r).sum(dim=1)).clamp(-float(MAX_SHIFT), float(MAX_SHIFT))
    a, b = (torch.stack([at.a, at.b], 1) + at.u[:, :2] * e[:, None] / _focal(pixels)).unbind(1)
    i = at.i * (1 - (1 - at.t[:, 2] * at.i) * e)
    return replace(at, a=a, b=b, i=i, u=_sensitivity(pixels, a, b, i, at.t))


def jacobian(pixels: Pixels, at: Residuals) -> tuple[torch.Tensor, ...]:
    """Rows (B, 6, N) of d pi(X') / d delta and, with the current depth, d log Z' / d delta."""
    u, v = projection_rows(at.a, at.b, at.i)
    f = _focal(pixels)
    rows = f[:, :1] * u, f[:, 1:] * v
    if pixels.log_depth_curr is None:
        return rows
    zero = torch.zeros_like(at.a)
    return (*rows, torch.stack([zero, zero, at.i, at.b, -at.a, zero], dim=1))


@dataclass(frozen=True, eq=False)
class Weighted:
    """Residuals at the likely depths; ``right`` (B, R, N): their inverse covariance times them."""

    at: Residuals
    D: torch.Tensor
    kappa: torch.Tensor
    right: torch.Tensor
    distance2: torch.Tensor
    robust: torch.Tensor


def weigh(pixels: Pixels, T: pp.LieTensor, how: RobustNoise) -> Weighted:
    """Residuals at pypose SE3 poses (B, 7), weighed."""
    at = at_likely_depth(pixels, residuals(pixels, T), how.noise)
    D, kappa = _information(pixels, at, how.noise)
    along = kappa * (D * at.u * at.r).sum(dim=1)
    right = D * (at.r - along[:, None] * at.u)
    distance2 = (right * at.r).sum(dim=1).clamp(min=0)
    usable = at.front & (pixels.weight > 0)
    robust = torch.where(usable, how.kernel(distance2).weight, torch.zeros_like(distance2))
    return Weighted(at, D, kappa, right, distance2, robust)


def _along(rows: tuple[torch.Tensor, ...], values: torch.Tensor) -> torch.Tensor:
    """(B, 6, N) sum of rows (B, 6, N) times values (B, R, N)."""
    each = (row * value[:, None] for row, value in zip(rows, values.unbind(1), strict=True))
    return reduce(torch.add, each)


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

    rows = jacobian(pixels, at)
    G = runs([*rows, _along(rows, found.D * at.u)], 3).transpose(1, 2)  # (B, C, 6, (R + 1) L)
    information = runs([*(w[:, None] * found.D).unbind(1), -w * found.kappa], 2)
    H = (G * information[:, :, None]) @ G.transpose(2, 3)
    right = runs(list((w[:, None] * found.right).unbind(1)), 2)
    g = (G[..., : right.shape[2]] @ right[..., None])[..., 0]
    behind = torch.full_like(found.distance2, BEHIND_DISTANCE2)
    cost = how.kernel(torch.where(at.front, found.distance2, behind)).cost
    cost = (pixels.weight * cost).sum(dim=1)
    return Linearization(0.5 * (H + H.transpose(2, 3)), g, cost, w.sum(dim=1), found)


def scores(pixels: Pixels, T: pp.LieTensor, how: RobustNoise) -> tuple[torch.Tensor, Weighted]:
    """(B, 6, N) w J^T Sigma^-1 r of each pixel; their sum is zero at the estimate."""
    found = weigh(pixels, T, how)
    right = (pixels.weight * found.robust)[:, None] * found.right
    return _along(jacobian(pixels, found.at), right), found


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
