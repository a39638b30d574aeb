"""The ego-flow reprojection residual of a batch of pairs in torch, and its normal equations.

The same definition as :mod:`hybridvo.refinement.kernels`, formulas there; a test holds both equal.
With the current frame's depth a third row joins, ``r_z = log D_curr(x + F) - log Z'``.
"""

from __future__ import annotations

from typing import NamedTuple

import torch

from hybridvo.refinement.batch import Pixels
from hybridvo.refinement.coarse_fit import DAMPING
from hybridvo.refinement.kernels import MAX_SHIFT
from hybridvo.torch_geometry import (
    MIN_DEPTH,
    left_update,
    move,
    pp,
    project,
    projection_rows,
    weighted_median,
)

CUTOFF, FIT_STEPS = 1.5, 6
"""Scale of the kernel in typical residuals while these set it; Newton steps of a fit to pixels."""
BEHIND_DISTANCE2 = 1e4
"""Squared Mahalanobis distance at which a pixel behind the camera is charged."""


KERNELS = ("geman-mcclure", "cauchy", "huber", "l2")


class RobustNoise(NamedTuple):
    """How residuals are weighed: noise, cutoff and name of the kernel."""

    noise: torch.Tensor  # (B, n) sf px, sd, and sz with the current frame's depth
    cutoff: float = 3.0
    name: str = "geman-mcclure"

    def kernel(self, d2: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
        """Cost rho of squared distances, weight 2 rho', slope -2 weight' / weight."""
        c2 = self.cutoff**2
        share = c2 / (c2 + d2)
        if self.name == "geman-mcclure":
            return 0.5 * share * d2, share.square(), 4 * share / c2
        if self.name == "cauchy":
            return 0.5 * c2 * torch.log1p(d2 / c2), share, 2 * share / c2
        if self.name == "l2":
            return 0.5 * d2, torch.ones_like(d2), torch.zeros_like(d2)
        beyond = d2.clamp(min=c2)
        cost = torch.where(d2 <= c2, 0.5 * d2, (c2 * beyond).sqrt() - 0.5 * c2)
        return cost, (c2 / beyond).sqrt(), (d2 > c2) / beyond


class Residuals(NamedTuple):
    """What a pose says of every pixel."""

    ab: torch.Tensor  # (B, 2, N) X'/Z' and Y'/Z'
    i: torch.Tensor  # (B, N) 1/Z'
    r: torch.Tensor  # (B, R, N): 2 of the flow, or 3 with the log depth of the current frame
    t: torch.Tensor  # (B, 3, 1) of the pose
    front: torch.Tensor


def residuals(pixels: Pixels, T: pp.LieTensor) -> Residuals:
    """Residuals at pypose SE3 poses (B, 7)."""
    matrix = T.matrix().to(pixels.points.dtype)
    moved = move(matrix, pixels.points)
    front = moved[:, 2] > MIN_DEPTH
    moved = torch.where(front[:, None], moved, torch.ones_like(moved))
    r, i = pixels.target - project(moved, pixels.K), 1 / moved[:, 2]
    if pixels.log_depth_curr is not None:
        r = torch.cat([r, (pixels.log_depth_curr + i.log())[:, None]], 1)
    return Residuals(moved[:, :2] * i[:, None], i, r, matrix[:, :3, 3:], front)


def _focal(pixels: Pixels) -> torch.Tensor:
    return pixels.K.diagonal(dim1=1, dim2=2)[:, :2, None]


def sensitivity(pixels: Pixels, at: Residuals) -> torch.Tensor:
    """U = d prediction / d log Z (B, R, N): d pi(X') / d log Z, and d log Z' / d log Z."""
    u = _focal(pixels) * at.i[:, None] * (at.ab * at.t[:, 2:] - at.t[:, :2])
    if pixels.log_depth_curr is None:
        return u
    return torch.cat([u, (1 - at.t[:, 2] * at.i)[:, None]], 1)


def jacobian(pixels: Pixels, at: Residuals) -> torch.Tensor:
    """(B, R, 6, N): d pi(X') / d delta and, with the current depth, d log Z' / d delta."""
    a, b = at.ab.unbind(1)
    J = _focal(pixels)[:, :, None] * torch.stack([*projection_rows(a, b, at.i)], dim=1)
    if pixels.log_depth_curr is None:
        return J
    zero = torch.zeros_like(a)
    return torch.cat([J, torch.stack([zero, zero, at.i, b, -a, zero], dim=1)[:, None]], dim=1)


class Weighted(NamedTuple):
    """Residuals at the depths that they make most likely, and what they weigh.

    Their inverse covariance is diag(D) - kappa (D u)(D u)^T; ``right``: it times the residuals.
    """

    at: Residuals
    D: torch.Tensor
    u: torch.Tensor
    kappa: torch.Tensor
    right: torch.Tensor
    distance2: torch.Tensor
    robust: torch.Tensor


def weigh(pixels: Pixels, T: pp.LieTensor, how: RobustNoise) -> Weighted:
    """Residuals at poses (B, 7), weighed."""
    at, noise = residuals(pixels, T), how.noise[:, :, None]
    flow = 1 / (noise[:, 0].square() * pixels.flow_variance)
    D = torch.stack([flow, flow], 1)
    if pixels.has_depth_curr is not None:
        D = torch.cat([D, (pixels.has_depth_curr / noise[:, 2].square())[:, None]], 1)
    depth = noise[:, 1].square() * pixels.depth_variance

    def shift(u: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Kappa, and how far the log depth that the residuals make most likely lies away."""
        kappa = depth / (1 + depth * (D * u.square()).sum(dim=1))
        return kappa, kappa * (D * u * at.r).sum(dim=1)

    u = sensitivity(pixels, at)
    e = shift(u)[1].clamp(-float(MAX_SHIFT), float(MAX_SHIFT))
    ab = at.ab + u[:, :2] * e[:, None] / _focal(pixels)
    at = at._replace(ab=ab, i=at.i * (1 - (1 - at.t[:, 2] * at.i) * e))
    u = sensitivity(pixels, at)
    kappa, along = shift(u)
    right = D * (at.r - along[:, None] * u)
    distance2 = (right * at.r).sum(dim=1).clamp(min=0)
    usable = at.front & (pixels.weight > 0)
    robust = torch.where(usable, how.kernel(distance2)[1], torch.zeros_like(distance2))
    return Weighted(at, D, u, kappa, right, distance2, robust)


class Linearization(NamedTuple):
    """Weighted normal equations at a pose, in C runs of pixels (the tiles, if there are any)."""

    H: torch.Tensor  # (B, C, 6, 6) sum of w J^T Sigma^-1 J
    g: torch.Tensor  # (B, C, 6) sum of w J^T Sigma^-1 r
    cost: torch.Tensor  # (B,) robust, pixels behind the camera at the full one
    weight_sum: torch.Tensor  # (B,) of robust times external weights
    robust: torch.Tensor  # (B, N) robust weights
    distance2: torch.Tensor  # (B, N) squared Mahalanobis distances

    def total(self) -> tuple[torch.Tensor, torch.Tensor]:
        """(H (B, 6, 6), g (B, 6)) in float64: a float32 sum over an image loses its fifth digit."""
        return self.H.double().sum(dim=1), self.g.double().sum(dim=1)


def linearize(
    pixels: Pixels, T: pp.LieTensor, how: RobustNoise, run: int | None = None
) -> Linearization:
    """Normal equations at poses (B, 7), summed over runs of ``run`` pixels or of any length."""
    found = [_linearize(part, T, how, run) for part in pixels.parts(run or 1)]
    H, g, cost, weight_sum, robust, distance2 = zip(*found, strict=True)
    joined = [torch.cat(parts, dim=1) for parts in (H, g, robust, distance2)]
    total = [torch.stack(parts).sum(dim=0) for parts in (cost, weight_sum)]
    return Linearization(joined[0], joined[1], total[0], total[1], joined[2], joined[3])


def _linearize(pixels: Pixels, T: pp.LieTensor, how: RobustNoise, run: int | None) -> Linearization:
    found = weigh(pixels, T, how)
    w, runs = pixels.weight * found.robust, (-1, run or pixels.weight.shape[1])
    J = jacobian(pixels, found.at)
    g = _scores(J, w, found).unflatten(-1, runs).sum(dim=3).transpose(1, 2)
    across = (J * (found.D * found.u)[:, :, None]).sum(dim=1, keepdim=True)
    information = torch.cat([w[:, None] * found.D, (-w * found.kappa)[:, None]], 1)
    J = torch.cat([J, across], 1).unflatten(-1, runs)
    H = torch.einsum("brpcn,brqcn->bcpq", J * information.unflatten(-1, runs)[:, :, None], J)
    behind = torch.full_like(found.distance2, BEHIND_DISTANCE2)
    cost = how.kernel(torch.where(found.at.front, found.distance2, behind))[0]
    cost = (pixels.weight * cost).sum(dim=1)
    H = 0.5 * (H + H.transpose(2, 3))
    return Linearization(H, g, cost, w.sum(dim=1), found.robust, found.distance2)


def scores(pixels: Pixels, T: pp.LieTensor, how: RobustNoise) -> tuple[torch.Tensor, Weighted]:
    """(B, 6, N) w J^T Sigma^-1 r of each pixel; their sum is zero at the estimate."""
    found = weigh(pixels, T, how)
    return _scores(jacobian(pixels, found.at), pixels.weight * found.robust, found), found


def _scores(J: torch.Tensor, w: torch.Tensor, found: Weighted) -> torch.Tensor:
    return (J * (w[:, None] * found.right)[:, :, None]).sum(dim=1)


def newton_matrix(pixels: Pixels, T: pp.LieTensor, how: RobustNoise) -> torch.Tensor:
    """A = -dg / d xi, g the sum of the scores: (B, 6, 6), not symmetric."""
    how = how._replace(noise=how.noise.detach())
    A = torch.zeros(len(T), 6, 6, dtype=T.dtype, device=T.device)
    with torch.enable_grad():
        xi = torch.zeros(len(T), 6, dtype=T.dtype, device=T.device, requires_grad=True)
        for part in pixels.map(torch.Tensor.detach).parts():
            g = scores(part, left_update(xi, T), how)[0].sum(dim=2)
            rows = [torch.autograd.grad(g[:, k].sum(), xi, retain_graph=True)[0] for k in range(6)]
            A -= torch.stack(rows, dim=1)
    return A


def solve_small(
    A: torch.Tensor, b: torch.Tensor, damping: float = 0.0
) -> tuple[torch.Tensor, torch.Tensor]:
    """(B, 6) solutions of ((A + damping diag A) x = b) in float64, with a gradient in b; and (B,)
    bool: where False (singular, or not finite) they are zero.
    """
    A = A.detach().double()
    inverse, info = torch.linalg.inv_ex(A + damping * torch.diag_embed(A.diagonal(dim1=1, dim2=2)))
    good = (info == 0) & torch.isfinite(inverse).flatten(1).all(dim=1)
    inverse = torch.where(good[:, None, None], inverse, torch.zeros_like(inverse))
    x = (inverse @ b.double()[..., None])[..., 0]
    good = good & (x.abs() < 1e6).all(dim=1)
    return torch.where(good[:, None], x, torch.zeros_like(x)), good


def attached(
    T: pp.LieTensor, A: torch.Tensor, g: torch.Tensor, wanted: torch.Tensor | float = 1.0
) -> pp.LieTensor:
    """The same poses with the gradient A^-1 dg: a Newton step whose value is zero."""
    step = wanted * solve_small(A, g)[0]
    return left_update(step - step.detach(), T)


def stepped(
    pixels: Pixels, T: pp.LieTensor, how: RobustNoise, going: torch.Tensor | float = 1.0
) -> pp.LieTensor:
    """Poses after a Gauss-Newton step, times ``going``."""
    return left_update(going * solve_small(*linearize(pixels, T, how).total(), DAMPING)[0], T)


def flow_noise(scale: torch.Tensor, kernel: str = "geman-mcclure") -> RobustNoise:
    """A kernel of this width (B,) px around exact depths."""
    return RobustNoise(torch.stack([scale, torch.zeros_like(scale)], 1), 1.0, kernel)


def typical_residual(pixels: Pixels, T: pp.LieTensor) -> torch.Tensor:
    """(B,) weighted median of the length of the flow residuals of every third pixel."""
    at = residuals(pixels, T)
    r, weight = at.r[:, :2, ::3], (pixels.weight * at.front)[:, ::3]
    return weighted_median(r.norm(dim=1), weight, 1.0)


def fit_pixels(pixels: Pixels, start: pp.LieTensor, smallest: float) -> pp.LieTensor:
    """The motion (B, 7) that pixels agree on under their weights, or the start where that explains
    the median pixel as well.

    The scale of the kernel follows the residuals, down to ``smallest``. The gradient goes into the
    weights alone, from pixels far away with constant strength: they may be the world.
    """
    with torch.no_grad():
        T, fixed = start, pixels.map(torch.Tensor.detach)
        first = scale = typical_residual(fixed, T)
        for _ in range(FIT_STEPS):
            T = stepped(fixed, T, flow_noise((CUTOFF * scale).clamp(min=smallest)))
            scale = typical_residual(fixed, T)
        good = torch.isfinite(T.tensor()).all(dim=1) & (scale <= first)
        T = pp.SE3(torch.where(good[:, None], T.tensor(), start.tensor()))
        width = (CUTOFF * torch.where(good, scale, first)).clamp(min=smallest)
    if not pixels.weight.requires_grad:
        return T
    H, g = linearize(pixels, T, flow_noise(width, "huber")).total()
    return attached(T, H.detach(), g)
