"""The pixels of a batch of pairs as the torch refinement takes them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, fields, replace

import torch
import torch.nn.functional as F

from hybridvo.torch_geometry import MAX_DEPTH, MIN_DEPTH, pixel_grid, rays
from hybridvo.types import PairBatch

MAX_VALUE = 1e9
"""Flows (px), weights and variances from which on a pixel is unusable."""
MAX_PRECISION = 1e6
MAX_DOUBT = 1e9
"""Largest inverse flow variance and largest depth variance relative to the typical ones."""
SURFACE_RATIO = 1.05
"""Largest ratio of the four depths around a sampling point; beyond it lies an edge."""


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
