"""The pixels of a batch of pairs as the torch solver takes them, and sampled second depths."""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from typing import Any

import torch
from kornia.geometry.depth import unproject_meshgrid

from hybridvo.refinement import kernels
from hybridvo.types import PairBatch

__all__ = ["Pixels", "gather_pixels", "sample_depth", "sparse_subset"]

MIN_DEPTH = float(kernels.MIN_DEPTH)
MAX_VALUE = float(kernels.MAX_VALUE)
NEIGHBOUR_AGREEMENT = 1.05
"""Largest ratio of the four depths around a sampling point; beyond it lies an edge."""


@dataclass(frozen=True, eq=False)
class Pixels:
    """Pixels of a batch as the solver takes them, all (B, N); unusable ones have weight 0.

    Args:
        ray_x, ray_y: K_prev^-1 x. depth: metres. target_u, target_v: x + F, px.
        flow_variance, depth_variance: relative to the typical one of the sample.
        weight: external weight, 0 where the pixel cannot be used.
        K: (B, 4) fx, fy, cx, cy of the current camera.
        log_depth_curr: log D_curr(x + F), 0 where absent; None without the second depth.
        has_depth_curr: 1 where it is present, else 0.
    """

    ray_x: torch.Tensor
    ray_y: torch.Tensor
    depth: torch.Tensor
    target_u: torch.Tensor
    target_v: torch.Tensor
    flow_variance: torch.Tensor
    depth_variance: torch.Tensor
    weight: torch.Tensor
    K: torch.Tensor
    log_depth_curr: torch.Tensor | None = None
    has_depth_curr: torch.Tensor | None = None

    def _map(self, change: Any, camera: Any) -> Pixels:
        values = {}
        for item in fields(self):
            value = getattr(self, item.name)
            if value is not None:
                values[item.name] = camera(value) if item.name == "K" else change(value)
        return Pixels(**values)

    def repeat(self, times: int) -> Pixels:
        """Every sample ``times`` times in a row: (B times, N)."""

        def change(value: torch.Tensor) -> torch.Tensor:
            return value.repeat_interleave(times, dim=0)

        return self if times == 1 else self._map(change, change)

    def take(self, index: torch.Tensor, keep: torch.Tensor) -> Pixels:
        """The pixels at ``index`` (B, M); those with ``keep`` False get weight 0."""
        taken = self._map(lambda value: value.gather(1, index), lambda value: value)
        return replace(taken, weight=taken.weight * keep)

    def detach(self) -> Pixels:
        """The same without a graph."""
        return self._map(torch.Tensor.detach, torch.Tensor.detach)


def _typical(variance: torch.Tensor) -> torch.Tensor:
    """(B, 1, 1) 20 % quantile of the positive finite values on a sparse grid; 1 if none."""
    sparse = variance.detach()[:, ::7, ::7].flatten(1)
    good = (sparse > 0) & (sparse < MAX_VALUE)
    values = torch.where(good, sparse, torch.full_like(sparse, torch.nan))
    return torch.nan_to_num(torch.nanquantile(values, 0.2, dim=1), nan=1.0)[:, None, None]


def sample_depth(
    depth: torch.Tensor, u: torch.Tensor, v: torch.Tensor
) -> tuple[torch.Tensor, torch.Tensor]:
    """Bilinear depth at (u, v), where the four neighbours lie on one surface.

    Args:
        depth: (B, H, W) metres.
        u: (B, N) px; 0 is the centre of the leftmost pixel.
        v: (B, N) px; 0 is the centre of the topmost pixel.

    Returns:
        (B, N) metres and (B, N) bool. False (and depth 1) outside the picture, next to an invalid
        depth, and where the four depths differ by more than 5 %. Differentiable in all arguments.
    """
    batch, height, width = depth.shape
    inside = (u >= 0) & (u <= width - 1) & (v >= 0) & (v <= height - 1)
    zero = torch.zeros_like(u)
    u, v = torch.where(inside, u, zero), torch.where(inside, v, zero)
    u0 = u.detach().floor().clamp(max=max(width - 2, 0))
    v0 = v.detach().floor().clamp(max=max(height - 2, 0))
    right = 1 if width > 1 else 0
    below = width if height > 1 else 0
    at = (v0 * width + u0).long()
    flat = depth.reshape(batch, -1)
    corners = torch.stack([flat.gather(1, at + o) for o in (0, right, below, below + right)])
    good = ((corners > MIN_DEPTH) & (corners < MAX_VALUE)).all(dim=0) & inside
    corners = torch.where(good, corners, torch.ones_like(corners))
    good = good & (corners.amax(dim=0) <= NEIGHBOUR_AGREEMENT * corners.amin(dim=0))
    s, t = u - u0, v - v0
    top = corners[0] + s * (corners[1] - corners[0])
    bottom = corners[2] + s * (corners[3] - corners[2])
    sampled = top + t * (bottom - top)
    return torch.where(good, sampled, torch.ones_like(sampled)), good


def gather_pixels(
    pair: PairBatch, weights: torch.Tensor | None = None, use_second_depth: bool = False
) -> Pixels:
    """The pixels of a batch, flattened row by row; unusable ones get weight 0 and harmless values.

    Invalid values are replaced before anything is computed from them, so that neither they nor
    their gradients spread. Variances are divided by the typical one of their sample, which is held
    constant.

    Args:
        pair: tensors of one floating type on one device.
        weights: (B, H, W) external factors; values that are not positive and finite switch a pixel
            off.
        use_second_depth: sample ``depth_curr`` for the third residual.
    """
    flow, depth = pair.flow, pair.depth_prev
    height, width = depth.shape[1:]
    K_prev, good_prev = _usable_camera(pair.K_prev)
    K_curr, good_curr = _usable_camera(pair.K_curr)
    rays = unproject_meshgrid(height, width, K_prev, device=depth.device, dtype=depth.dtype)
    v, u = torch.meshgrid(
        torch.arange(height, device=depth.device, dtype=depth.dtype),
        torch.arange(width, device=depth.device, dtype=depth.dtype),
        indexing="ij",
    )
    target_u, target_v = u + flow[..., 0], v + flow[..., 1]
    usable = (depth > MIN_DEPTH) & (depth < MAX_VALUE) & (good_prev & good_curr)[:, None, None]
    usable = usable & (target_u.abs() < MAX_VALUE) & (target_v.abs() < MAX_VALUE)
    one, zero = torch.ones_like(depth), torch.zeros_like(depth)
    flow_variance = depth_variance = one
    if pair.flow_variance is not None:
        good = (pair.flow_variance > 0) & (pair.flow_variance < MAX_VALUE)
        typical = _typical(pair.flow_variance)
        flow_variance = torch.where(good, pair.flow_variance, typical) / typical
        flow_variance = flow_variance.clamp(min=1 / float(kernels.MAX_TRUST))
        usable = usable & good
    if pair.depth_variance is not None:
        good = (pair.depth_variance >= 0) & (pair.depth_variance < MAX_VALUE)
        typical = _typical(pair.depth_variance)
        depth_variance = torch.where(good, pair.depth_variance, typical) / typical
        depth_variance = depth_variance.clamp(max=float(kernels.MAX_DOUBT))
        usable = usable & good
    weight = one
    if weights is not None:
        good = (weights > 0) & (weights < MAX_VALUE)
        weight = torch.where(good, weights, zero)
    if pair.valid is not None:
        usable = usable & pair.valid
    weight = torch.where(usable, weight, zero)
    target_u = torch.where(usable, target_u, zero).flatten(1)
    target_v = torch.where(usable, target_v, zero).flatten(1)
    log_depth = present = None
    if use_second_depth and pair.depth_curr is not None:
        sampled, good = sample_depth(pair.depth_curr, target_u, target_v)
        log_depth, present = sampled.log(), (good & usable.flatten(1)).to(depth.dtype)
    return Pixels(
        ray_x=rays[..., 0].flatten(1),
        ray_y=rays[..., 1].flatten(1),
        depth=torch.where(usable, depth, one).flatten(1),
        target_u=target_u,
        target_v=target_v,
        flow_variance=flow_variance.flatten(1),
        depth_variance=depth_variance.flatten(1),
        weight=weight.flatten(1),
        K=torch.stack([K_curr[:, 0, 0], K_curr[:, 1, 1], K_curr[:, 0, 2], K_curr[:, 1, 2]], dim=1),
        log_depth_curr=log_depth,
        has_depth_curr=present,
    )


def _usable_camera(K: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """K with unusable samples replaced by the unit matrix, and which are usable (B,)."""
    good = torch.isfinite(K).all(dim=2).all(dim=1) & (K[:, 0, 0] > 0) & (K[:, 1, 1] > 0)
    unit = torch.eye(3, dtype=K.dtype, device=K.device).expand_as(K)
    return torch.where(good[:, None, None], K, unit), good


def sparse_subset(pixels: Pixels, count: int) -> Pixels:
    """About ``count`` usable pixels of each sample, spread evenly in raster order, all if fewer.

    One pixel is taken from each of ``count`` equal runs, at a place in the run that follows the
    golden section, so that no regular structure of the picture is met in step.
    """
    usable = pixels.weight > 0
    order = usable.long().cumsum(dim=1)
    total = order[:, -1:]
    count = min(count, usable.shape[1])
    k = torch.arange(count, device=usable.device, dtype=torch.float64)[None]
    spread = ((k + (k * 0.6180339887498949).frac()) * total / count).long()
    place = torch.where(total > count, spread, k.long().expand_as(spread))
    index = torch.searchsorted(order, place + 1).clamp(max=usable.shape[1] - 1)
    return pixels.take(index, place < total)
