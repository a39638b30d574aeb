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
from dataclasses import dataclass, fields, replace
from functools import reduce
from typing import NamedTuple

import torch
import torch.nn.functional as F

from hybridvo.torch_geometry import (
    MAX_DEPTH,
    MIN_DEPTH,
    left_update,
    move,
    pixel_grid,
    pp,
    project,
    rays,
)
from hybridvo.types import PairBatch

MAX_VALUE = 1e9
"""Flows (px), weights and variances from which on a pixel is unusable."""
MAX_PRECISION = 1e6
MAX_DOUBT = 1e9
"""Largest inverse flow variance and largest depth variance relative to the typical ones."""
MAX_SHIFT = 0.3
"""Largest correction of log depth that an outlier may cause, as in the numba kernels."""
BEHIND_DISTANCE2 = 1e4
"""Squared Mahalanobis distance at which a pixel behind the camera is charged."""
SURFACE_RATIO = 1.05
"""Largest ratio of the four depths around a sampling point; beyond it lies an edge."""

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
class Pixels:
    """Pixels of a batch as the solver takes them; unusable ones have weight 0.

    Args:
        points: (B, 3, N) metres, in the previous camera.
        target: (B, 2, N) px, x + F on the current image.
        flow_variance, depth_variance: (B, N) relative to the typical one of the sample.
        weight: (B, N) external weight.
        K: (B, 3, 3) of the current camera.
        log_depth_curr: (B, N) log D_curr(x + F), 0 where absent; None without that depth.
        has_depth_curr: (B, N) 1 where it is present, else 0.
    """

    points: torch.Tensor
    target: torch.Tensor
    flow_variance: torch.Tensor
    depth_variance: torch.Tensor
    weight: torch.Tensor
    K: torch.Tensor
    log_depth_curr: torch.Tensor | None = None
    has_depth_curr: torch.Tensor | None = None

    def map(self, change: Callable[[torch.Tensor], torch.Tensor]) -> Pixels:
        """The same with every tensor but the intrinsics changed."""
        values = {f.name: getattr(self, f.name) for f in fields(self)}
        return Pixels(
            **{k: v if v is None or k == "K" else change(v) for k, v in values.items()}
        )  # fmt: skip

    def repeat(self, times: int) -> Pixels:
        """Every sample ``times`` times in a row: B times."""
        if times == 1:
            return self
        many = self.map(lambda x: x.repeat_interleave(times, dim=0))
        return replace(many, K=self.K.repeat_interleave(times, dim=0))

    def subset(self, count: int) -> Pixels:
        """About ``count`` usable pixels of each sample, spread evenly in their order.

        One pixel is taken from each of ``count`` equal runs, at a place in the run that follows the
        golden section, so that no regular structure of the image is met in step.
        """
        order = (self.weight > 0).long().cumsum(dim=1)
        total = order[:, -1:]
        count = min(count, order.shape[1])
        k = torch.arange(count, device=order.device, dtype=torch.float64)[None]
        spread = ((k + (k * 0.6180339887498949).frac()) * total / count).long()
        place = torch.where(total > count, spread, k.long().expand_as(spread))
        index = torch.searchsorted(order, place + 1).clamp(max=order.shape[1] - 1)

        def take(x: torch.Tensor) -> torch.Tensor:
            at = index if x.ndim == 2 else index[:, None].expand(-1, x.shape[1], -1)
            return x.gather(x.ndim - 1, at)

        taken = self.map(take)
        return replace(taken, weight=taken.weight * (place < total))


def gather_pixels(
    batch: PairBatch,
    weights: torch.Tensor | None = None,
    use_depth_curr: bool = False,
    tile: int | None = None,
) -> Pixels:
    """The pixels of a batch in raster order, or tile by tile where a tile's side is given.

    Invalid values are replaced before anything is computed from them, so that neither they nor
    their gradients spread. Variances are divided by the typical one of their sample, which is held
    constant.
    """
    flow, depth = batch.flow, batch.depth_prev
    height, width = depth.shape[1:]
    K_prev, good_prev = _usable_camera(batch.K_prev)
    K_curr, good_curr = _usable_camera(batch.K_curr)
    target = pixel_grid(height, width, depth) + flow
    usable = (depth > MIN_DEPTH) & (depth < MAX_DEPTH) & (good_prev & good_curr)[:, None, None]
    usable = usable & (target.abs() < MAX_VALUE).all(dim=3)
    one, zero = torch.ones_like(depth), torch.zeros_like(depth)
    flow_variance = depth_variance = one
    if batch.flow_variance is not None:
        good = (batch.flow_variance > 0) & (batch.flow_variance < MAX_VALUE)
        typical = _typical(batch.flow_variance)
        relative = torch.where(good, batch.flow_variance, typical) / typical
        flow_variance, usable = relative.clamp(min=1 / MAX_PRECISION), usable & good
    if batch.depth_variance is not None:
        good = (batch.depth_variance >= 0) & (batch.depth_variance < MAX_VALUE)
        typical = _typical(batch.depth_variance)
        relative = torch.where(good, batch.depth_variance, typical) / typical
        depth_variance, usable = relative.clamp(max=MAX_DOUBT), usable & good
    weight = one
    if weights is not None:
        weight = torch.where((weights > 0) & (weights < MAX_VALUE), weights, zero)
    if batch.valid is not None:
        usable = usable & batch.valid
    depth = torch.where(usable, depth, one)
    target = torch.where(usable[..., None], target, torch.zeros_like(target))
    log_depth = present = None
    if use_depth_curr and batch.depth_curr is not None:
        sampled, good = sample_depth(batch.depth_curr, target)
        log_depth, present = sampled.log(), (good & usable).to(depth.dtype)
    points = (rays(height, width, K_prev) * depth[..., None]).permute(0, 3, 1, 2)
    tile = tile or max(height, width)
    return Pixels(
        points=to_tiles(points, tile, 1.0),
        target=to_tiles(target.permute(0, 3, 1, 2), tile),
        flow_variance=to_tiles(flow_variance, tile, 1.0),
        depth_variance=to_tiles(depth_variance, tile, 1.0),
        weight=to_tiles(torch.where(usable, weight, zero), tile),
        K=K_curr,
        log_depth_curr=None if log_depth is None else to_tiles(log_depth, tile),
        has_depth_curr=None if present is None else to_tiles(present, tile),
    )


def to_tiles(x: torch.Tensor, tile: int, fill: float = 0.0) -> torch.Tensor:
    """(..., H, W) -> (..., N): the pixels of each tile side by side, tiles row by row.

    Tiles at the border are completed with ``fill``; a tile as large as the image is the image.
    """
    height, width = x.shape[-2:]
    if tile >= max(height, width):
        return x.flatten(-2)
    x = F.pad(x, (0, -width % tile, 0, -height % tile), value=fill)
    rows, columns = x.shape[-2] // tile, x.shape[-1] // tile
    x = x.reshape(*x.shape[:-2], rows, tile, columns, tile).transpose(-3, -2)
    return x.reshape(*x.shape[:-4], -1)


def tile_grid(shape: tuple[int, int], tile: int) -> tuple[tuple[int, int], int]:
    """((rows, columns) of tiles, pixels in each) of an image (H, W)."""
    if tile >= max(shape):
        return (1, 1), shape[0] * shape[1]
    return (-(-shape[0] // tile), -(-shape[1] // tile)), tile * tile


def from_tiles(x: torch.Tensor, tile: int, height: int, width: int) -> torch.Tensor:
    """(B, N) -> (B, H, W), the inverse of :func:`to_tiles`."""
    if tile >= max(height, width):
        return x.reshape(-1, height, width)
    rows, columns = -(-height // tile), -(-width // tile)
    x = x.reshape(-1, rows, columns, tile, tile).transpose(2, 3)
    return x.reshape(-1, rows * tile, columns * tile)[:, :height, :width]


def sample_depth(depth: torch.Tensor, at: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """Bilinear depth (B, H, W) at (B, h, w, 2) px, where the four neighbours lie on one surface.

    Returns:
        (B, h, w) metres and (B, h, w) bool. False (and depth 1) outside the image, next to an
        invalid depth, and at edges (:data:`SURFACE_RATIO`). Differentiable in both arguments.
    """
    batch, height, width = depth.shape
    u, v = at.unbind(-1)
    inside = (u >= 0) & (u <= width - 1) & (v >= 0) & (v <= height - 1)
    u, v = (torch.where(inside, x, torch.zeros_like(x)) for x in (u, v))
    u0 = u.detach().floor().clamp(max=max(width - 2, 0))
    v0 = v.detach().floor().clamp(max=max(height - 2, 0))
    right, below = int(width > 1), width * int(height > 1)
    place = (v0 * width + u0).long().flatten(1)
    flat = depth.reshape(batch, -1)
    corners = torch.stack(
        [flat.gather(1, place + o).view_as(u) for o in (0, right, below, below + right)]
    )
    good = ((corners > MIN_DEPTH) & (corners < MAX_DEPTH)).all(dim=0) & inside
    corners = torch.where(good, corners, torch.ones_like(corners))
    good = good & (corners.amax(dim=0) <= SURFACE_RATIO * corners.amin(dim=0))
    s, t = u - u0, v - v0
    top = corners[0] + s * (corners[1] - corners[0])
    bottom = corners[2] + s * (corners[3] - corners[2])
    sampled = top + t * (bottom - top)
    return torch.where(good, sampled, torch.ones_like(sampled)), good


def _typical(variance: torch.Tensor) -> torch.Tensor:
    """(B, 1, 1) 20 % quantile of the positive finite values on a sparse grid; 1 if none."""
    sparse = variance.detach()[:, ::7, ::7].flatten(1)
    good = (sparse > 0) & (sparse < MAX_VALUE)
    values = torch.where(good, sparse, torch.full_like(sparse, torch.nan))
    return torch.nan_to_num(torch.nanquantile(values, 0.2, dim=1), nan=1.0)[:, None, None]


def _usable_camera(K: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """K with unusable samples replaced by the unit matrix, and which are usable (B,)."""
    good = torch.isfinite(K).flatten(1).all(dim=1) & (K[:, 0, 0] > 0) & (K[:, 1, 1] > 0)
    unit = torch.eye(3, dtype=K.dtype, device=K.device).expand_as(K)
    return torch.where(good[:, None, None], K, unit), good


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
    D = (flow, flow)
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
    e = (white.kappa * _dot(white.Du, at.r)).clamp(-MAX_SHIFT, MAX_SHIFT)
    a = at.a + at.u[0] * e / pixels.K[:, 0, 0, None]
    b = at.b + at.u[1] * e / pixels.K[:, 1, 1, None]
    i = at.i * (1 - (1 - at.t[:, 2] * at.i) * e)
    return replace(at, a=a, b=b, i=i, u=_sensitivity(pixels, a, b, i, at.t))


def jacobian(pixels: Pixels, at: Residuals) -> tuple[torch.Tensor, ...]:
    """Rows d prediction / d delta, each (B, 6, N): u, v and, with the depth, log Z'."""
    a, b, i = at.a, at.b, at.i
    fx, fy = pixels.K[:, 0, 0, None, None], pixels.K[:, 1, 1, None, None]
    zero, ab = torch.zeros_like(a), a * b
    rows = (
        fx * torch.stack([i, zero, -a * i, -ab, 1 + a * a, -b], dim=1),
        fy * torch.stack([zero, i, -b * i, -1 - b * b, ab, a], dim=1),
    )
    if pixels.log_depth_curr is None:
        return rows
    return (*rows, torch.stack([zero, zero, i, b, -a, zero], dim=1))


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
        pixels: of the batch. T: T_curr_prev. how: noise and kernel.
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
