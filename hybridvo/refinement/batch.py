"""What the torch refinement takes and gives: checked tensors, pixels of a batch, poses."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any, NamedTuple

import torch
import torch.nn.functional as F

from hybridvo.errors import InputError
from hybridvo.refinement import kernels
from hybridvo.refinement.depth import SURFACE
from hybridvo.refinement.pixels import typical
from hybridvo.results import RelativePose, Status
from hybridvo.torch_geometry import MAX_DEPTH, MIN_DEPTH, pixel_grid, pp, rays, se3
from hybridvo.types import PairBatch

PART = 131_072
"""Pixels that are worked on at once: on a CPU half the time of all of them at once."""


@dataclass(frozen=True, eq=False)
class BatchedPose:
    """Camera motions of a batch of pairs, as in :class:`hybridvo.results.RelativePose`."""

    SE3: pp.LieTensor  # (B, 7) T_curr_prev; the identity where failed. Carries the gradient
    covariance: torch.Tensor  # (B, 6, 6) of the left perturbation (translation, rotation)
    converged: torch.Tensor  # (B,) bool
    failed: torch.Tensor  # (B,) bool
    status: list[Status]
    probability: torch.Tensor  # (B,) by the weight of the motion that contradicts it most
    iterations: torch.Tensor  # (B,) Newton steps on all pixels
    cost: torch.Tensor  # (B,) robust, per unit of weight
    weights: torch.Tensor  # (B, H, W) robust weights without the external ones, 0 where unusable
    noise: torch.Tensor  # (B, 2) px and log depth; (B, 3) with the current frame's log depth
    inlier_ratio: torch.Tensor  # (B,) share of the external weight within three standard deviations

    def __len__(self) -> int:
        return len(self.status)

    @property
    def T_curr_prev(self) -> torch.Tensor:
        """(B, 4, 4) points of the previous camera into the current one, metres."""
        return self.SE3.matrix().to(self.covariance.dtype)

    def one(self, index: int, method: str = "refine") -> RelativePose:
        """The motion of one sample as every estimator gives it, in numpy."""
        return RelativePose(
            T_curr_prev=self.SE3[index].detach().matrix().double().cpu().numpy(),
            covariance=self.covariance[index].detach().double().cpu().numpy(),
            status=self.status[index],
            inlier_ratio=min(1.0, float(self.inlier_ratio[index])),
            iterations=int(self.iterations[index]),
            cost=float(self.cost[index]),
            residual_scale_px=float(self.noise[index, 0]),
            depth_noise=float(self.noise[index, 1]),
            weights=self.weights[index].detach().float().cpu().numpy(),
            probability=float(self.probability[index]),
            method=method,
            terms=("flow",),
        )


class Pixels(NamedTuple):
    """Pixels of a batch as the solver takes them; variances are relative to the typical one."""

    points: torch.Tensor  # (B, 3, N) metres, in the previous camera
    target: torch.Tensor  # (B, 2, N) px, x + F on the current image
    flow_variance: torch.Tensor  # (B, N)
    depth_variance: torch.Tensor  # (B, N)
    weight: torch.Tensor  # (B, N) external weight, 0 where unusable
    K: torch.Tensor  # (B, 3, 3) of the current camera
    log_depth_curr: torch.Tensor | None = None  # (B, N) log D_curr(x + F), 0 where absent
    has_depth_curr: torch.Tensor | None = None  # (B, N) 1 where it is present, else 0

    def map(self, change: Callable[[torch.Tensor], torch.Tensor]) -> Pixels:
        """The same with every tensor changed."""
        return Pixels._make(x if x is None else change(x) for x in self)

    def parts(self, run: int = 1) -> Iterator[Pixels]:
        """All pixels, in whole runs of ``run``, few enough at once to stay in the cache."""
        batch, total = self.weight.shape
        step = run * max(1, PART // (batch * run))
        for k in range(0, total, step):
            piece = slice(k, k + step)
            yield self.map(lambda x, at=piece: x if x is self.K else x[..., at])  # type: ignore[misc]

    def subset(self, count: int) -> Pixels:
        """About ``count`` usable pixels of each sample, spread by the golden section."""
        order = (self.weight > 0).long().cumsum(dim=1)
        total = order[:, -1:]
        count = min(count, order.shape[1])
        k = torch.arange(count, device=order.device, dtype=torch.float64)[None]
        spread = ((k + (k * 0.6180339887498949).frac()) * (total / count).clamp(min=1)).long()
        index = torch.searchsorted(order, spread + 1).clamp(max=order.shape[1] - 1)

        def take(x: torch.Tensor) -> torch.Tensor:
            if x is self.K:
                return x
            at = index if x.ndim == 2 else index[:, None].expand(-1, x.shape[1], -1)
            return x.gather(x.ndim - 1, at)

        taken = self.map(take)
        return taken._replace(weight=taken.weight * (spread < total))


def gather_pixels(
    batch: PairBatch,
    weights: torch.Tensor | None = None,
    tile: int | None = None,
    with_depth: bool = False,
) -> Pixels:
    """The pixels of a batch in raster order, or tile by tile where a tile's side is given.

    Invalid values are replaced before anything is computed from them, so that neither they nor
    their gradients spread.
    """
    depth = batch.depth_prev
    height, width = depth.shape[1:]
    target = pixel_grid(height, width, depth) + batch.flow
    usable = (depth > MIN_DEPTH) & (depth < MAX_DEPTH) & (target.abs() < MAX_DEPTH).all(dim=3)
    cameras, unit = [], torch.eye(3, dtype=depth.dtype, device=depth.device)
    for K in (batch.K_prev, batch.K_curr):
        good = (torch.isfinite(K).flatten(1).all(dim=1) & (K[:, 0, 0] > 0) & (K[:, 1, 1] > 0))[
            :, None, None
        ]
        usable = usable & good
        cameras.append(torch.where(good, K, unit))
    one, zero = torch.ones_like(depth), torch.zeros_like(depth)
    flow_variance = depth_variance = weight = one
    if batch.flow_variance is not None:
        flow_variance, good = _relative(batch.flow_variance, batch.flow_variance > 0)
        flow_variance, usable = flow_variance.clamp(min=1 / float(kernels.MAX_TRUST)), usable & good
    if batch.depth_variance is not None:
        depth_variance, good = _relative(batch.depth_variance, batch.depth_variance >= 0)
        depth_variance, usable = depth_variance.clamp(max=float(kernels.MAX_DOUBT)), usable & good
    if weights is not None:
        weight = torch.where((weights > 0) & (weights < MAX_DEPTH), weights, zero)
    if batch.valid is not None:
        usable = usable & batch.valid
    depth = torch.where(usable, depth, one)
    target = torch.where(usable[..., None], target, torch.zeros_like(target))
    points = (rays(height, width, cameras[0]) * depth[..., None]).permute(0, 3, 1, 2)
    maps = {"points": points, "target": target.permute(0, 3, 1, 2)}
    maps |= {"flow_variance": flow_variance, "depth_variance": depth_variance}
    maps["weight"] = torch.where(usable, weight, zero)
    if with_depth and batch.depth_curr is not None:
        sampled, good = sample_depth(batch.depth_curr, target)
        maps |= {"log_depth_curr": sampled.log(), "has_depth_curr": (good & usable).to(depth.dtype)}
    fill = {"points": 1.0, "flow_variance": 1.0, "depth_variance": 1.0}
    tiles = {name: to_tiles(x, tile, fill.get(name, 0.0)) for name, x in maps.items()}
    return Pixels(**tiles, K=cameras[1])


def sample_depth(depth: torch.Tensor, at: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """Bilinear depth (B, h, w) of (B, H, W) at (B, h, w, 2) px; and bool: False, and depth 1,
    outside the image, next to an invalid depth, and at edges.
    """
    height, width = depth.shape[1:]
    u, v = at.unbind(-1)
    inside = (u >= 0) & (u <= width - 1) & (v >= 0) & (v <= height - 1)
    u, v = (torch.where(inside, x, torch.zeros_like(x)) for x in (u, v))
    u0 = u.detach().floor().clamp(max=max(width - 2, 0))
    v0 = v.detach().floor().clamp(max=max(height - 2, 0))
    right, below = int(width > 1), width * int(height > 1)
    place, flat = (v0 * width + u0).long().flatten(1), depth.flatten(1)
    corners = torch.stack(
        [flat.gather(1, place + o).view_as(u) for o in (0, right, below, below + right)]
    )
    good = ((corners > MIN_DEPTH) & (corners < MAX_DEPTH)).all(dim=0) & inside
    corners = torch.where(good, corners, torch.ones_like(corners))
    good = good & (corners.amax(dim=0) <= (1 + SURFACE) * corners.amin(dim=0))
    top = torch.lerp(corners[0], corners[1], u - u0)
    sampled = torch.lerp(top, torch.lerp(corners[2], corners[3], u - u0), v - v0)
    return torch.where(good, sampled, torch.ones_like(sampled)), good


def to_tiles(x: torch.Tensor, tile: int | None, fill: float = 0.0) -> torch.Tensor:
    """(..., H, W) -> (..., N): tile by tile, borders completed with ``fill``; or raster order."""
    if tile is None:
        return x.flatten(-2)
    x = F.pad(x, (0, -x.shape[-1] % tile, 0, -x.shape[-2] % tile), value=fill)
    x = x.unflatten(-1, (-1, tile)).unflatten(-3, (-1, tile)).transpose(-3, -2)
    return x.flatten(-4)


def from_tiles(x: torch.Tensor, tile: int, height: int, width: int) -> torch.Tensor:
    """(B, N) -> (B, H, W), the inverse of :func:`to_tiles`."""
    x = x.reshape(len(x), -(-height // tile), -(-width // tile), tile, tile).transpose(2, 3)
    return x.flatten(3).flatten(1, 2)[:, :height, :width]


def _relative(variance: torch.Tensor, good: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """A variance in units of the typical one of its sample, 1 where not good; what is good."""
    scales = [typical(one) for one in variance.detach().cpu().numpy()]
    scale, good = variance.new_tensor(scales)[:, None, None], good & (variance < MAX_DEPTH)
    return torch.where(good, variance, scale) / scale, good


def checked_batch(
    batch: PairBatch, weights: Any = None, where: str = "refine_batch"
) -> tuple[PairBatch, torch.Tensor | None]:
    """The batch and its weights in one floating type, on one device, or an InputError."""
    flow, depth = batch.flow, batch.depth_prev
    if not all(isinstance(x, torch.Tensor) and x.is_floating_point() for x in (flow, depth)):
        raise InputError(f"{where}: expected flow and depth_prev as floating-point tensors.")
    if flow.ndim != 4 or flow.shape[3] != 2 or flow.numel() == 0:
        raise InputError(
            f"{where}: expected PairBatch.flow of shape (B, H, W, 2), got {tuple(flow.shape)}."
        )
    dtype = torch.promote_types(flow.dtype, depth.dtype)
    dtype = dtype if dtype in (torch.float32, torch.float64) else torch.float32
    if weights is not None:
        weights = torch.as_tensor(weights, device=flow.device)
        weights = weights[None] if weights.ndim == 2 and len(flow) == 1 else weights
    values = {k: v for k, v in {**vars(batch), "weights": weights}.items() if v is not None}
    shapes = {"flow": flow.shape} | dict.fromkeys(("K_prev", "K_curr"), (len(flow), 3, 3))
    for name, value in values.items():
        shape, is_mask = tuple(shapes.get(name, flow.shape[:3])), name == "valid"
        fits = tuple(value.shape) == shape and value.device == flow.device
        if not fits or (is_mask and value.dtype != torch.bool):
            raise InputError(
                f"{where}: expected {name} of shape {shape} on {flow.device}{', bool' * is_mask}, "
                f"got {tuple(value.shape)} on {value.device}, {value.dtype}."
            )
        values[name] = value if is_mask else value.to(dtype)
    weights = values.pop("weights", None)
    return PairBatch(**values), weights


def initial_poses(T_init: Any, like: torch.Tensor, alone: bool) -> pp.LieTensor:
    """(B, S, 7) pypose SE3; ``alone``: without the identity beside what is handed in."""
    batch = len(like)
    unit = torch.eye(4, dtype=torch.float64, device=like.device)
    identity = unit.expand(batch, 1, 4, 4)
    if T_init is None:
        return se3(identity)
    if isinstance(T_init, pp.LieTensor):
        T_init = T_init.matrix()
    T = torch.as_tensor(T_init, device=like.device).detach().double()
    if T.ndim == 3 or (T.ndim == 2 and batch == 1):
        T = T.reshape(-1, 1, *T.shape[-2:])
    if T.ndim != 4 or T.shape[0] != batch or T.shape[2:] != (4, 4):
        raise InputError(
            f"refine_batch: expected T_init of shape ({batch}, 4, 4) or ({batch}, S, 4, 4), "
            f"got {tuple(T.shape)}."
        )
    good = (T.abs() < 1e9).flatten(2).all(dim=2)
    T = torch.where(good[:, :, None, None], T, unit)
    return se3(T if alone else torch.cat([identity, T], dim=1))
