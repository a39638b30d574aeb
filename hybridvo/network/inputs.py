"""Frame pairs -> what the networks read, assembled in one place.

The pictures are brought to the network's size by taking the nearest pixel, for flow and depth
alike. An average would blend a mover with what is behind it into flows and depths that belong to
neither; the nearest pixel keeps flow, depth and ray of one and the same measured point together.
The ray is that of the pixel that was taken, so nothing is rounded in what the network sees.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields

import torch

from hybridvo.errors import InputError
from hybridvo.types import FramePair, PairBatch

__all__ = [
    "FLOW_SCALE_PX",
    "NETWORK_SIZE",
    "NetworkInputs",
    "assemble_aligned",
    "assemble_inputs",
    "subsampled_intrinsics",
]

FLOW_SCALE_PX = 200.0
"""Flow is divided by this before it enters a network."""

NETWORK_SIZE = (128, 256)
"""Height and width of the paper's inputs."""

NEAREST_DEPTH = 1e-2
"""Depths below one centimetre are taken for damage: invalid."""


@dataclass(frozen=True, eq=False)
class NetworkInputs:
    """Inputs of a batch of pairs at the network's size (h, w).

    Args:
        flow: (B, 2, h, w) flow in pixels of this size divided by ``FLOW_SCALE_PX``, 0 if invalid.
        inverse_depth: (B, 2, h, w) 1 / metres, 0 if invalid. Channel 0 is the previous depth,
            channel 1 the current depth sampled at x + F: both stand on the grid of the previous
            frame, as in the paper's training data.
        rays: (B, 2, h, w) first two components of K^-1 x.
        valid: (B, h, w) bool, flow and previous depth are both usable.
        depth_prev, depth_curr: (B, h, w) metres, the depths of ``inverse_depth``; 0 if invalid.
        K_prev, K_curr: (B, 3, 3) intrinsics scaled to (h, w), pixel-centre convention.
    """

    flow: torch.Tensor
    inverse_depth: torch.Tensor
    rays: torch.Tensor
    valid: torch.Tensor
    depth_prev: torch.Tensor
    depth_curr: torch.Tensor
    K_prev: torch.Tensor
    K_curr: torch.Tensor

    @property
    def flow_px(self) -> torch.Tensor:
        """(B, 2, h, w) flow in pixels of the network's size; 0 if invalid."""
        return self.flow * FLOW_SCALE_PX

    @property
    def size(self) -> tuple[int, int]:
        """(h, w)."""
        return self.flow.shape[2], self.flow.shape[3]

    def __len__(self) -> int:
        return self.flow.shape[0]

    def __getitem__(self, index: slice) -> NetworkInputs:
        """Part of the batch."""
        return NetworkInputs(*(getattr(self, f.name)[index] for f in fields(self)))

    def subsample(self, stride: int) -> NetworkInputs:
        """Every ``stride``-th pixel of every ``stride``-th row, flow in their pixels."""
        if stride == 1:
            return self
        first = stride // 2
        pick = (..., slice(first, None, stride), slice(first, None, stride))
        return NetworkInputs(
            self.flow[pick] / stride,
            self.inverse_depth[pick],
            self.rays[pick],
            self.valid[pick],
            self.depth_prev[pick],
            self.depth_curr[pick],
            subsampled_intrinsics(self.K_prev, stride),
            subsampled_intrinsics(self.K_curr, stride),
        )

    def to(self, *args: object, **kwargs: object) -> NetworkInputs:
        """Copy on another device, or of another floating-point type; the mask stays boolean."""
        moved = {f.name: getattr(self, f.name).to(*args, **kwargs) for f in fields(self)}
        return NetworkInputs(**{**moved, "valid": moved["valid"].bool()})


def subsampled_intrinsics(K: torch.Tensor, stride: int) -> torch.Tensor:
    """(B, 3, 3) intrinsics of the pixels n // 2, n // 2 + n, .. of each axis, n = ``stride``."""
    out = K.clone()
    out[:, :2, :2] = K[:, :2, :2] / stride
    out[:, :2, 2] = (K[:, :2, 2] - stride // 2) / stride
    return out


def assemble_inputs(
    pair: FramePair | PairBatch | Sequence[FramePair], size: tuple[int, int] = NETWORK_SIZE
) -> NetworkInputs:
    """Inputs of one pair, of a batch, or of several pairs (of any sizes).

    Missing or damaged values (no flow, no depth, NaN, inf, depth <= 0, masked pixels) become 0 and
    are marked in ``valid``; a pair that has nothing to offer is all invalid and disturbs no other.

    Args:
        pair: numpy pair or pairs, or a :class:`~hybridvo.types.PairBatch` of tensors.
        size: (height, width) of the network's input.

    Returns:
        Float32 tensors (the type of the batch for a PairBatch) on the CPU or the batch's device.

    Raises:
        InputError: another type, shapes that do not fit each other, or a size that is not positive.
    """
    size = _check_size(size)
    if isinstance(pair, FramePair):
        return _from_batch(PairBatch.from_pairs([pair]), size)
    if isinstance(pair, PairBatch):
        _check_batch(pair)
        return _from_batch(pair, size)
    if isinstance(pair, Sequence) and pair and all(isinstance(p, FramePair) for p in pair):
        parts = [_from_batch(PairBatch.from_pairs([p]), size) for p in pair]
        return NetworkInputs(
            *(torch.cat([getattr(p, f.name) for p in parts]) for f in fields(NetworkInputs))
        )
    raise InputError(
        f"assemble_inputs: expected a FramePair, a PairBatch or a non-empty sequence of "
        f"FramePairs, got {type(pair).__name__}."
    )


def assemble_aligned(
    flow: torch.Tensor,
    depth_prev: torch.Tensor,
    depth_curr: torch.Tensor,
    K_prev: torch.Tensor,
    K_curr: torch.Tensor | None = None,
    valid: torch.Tensor | None = None,
) -> NetworkInputs:
    """Inputs from tensors that already have the network's size and stand on the previous grid.

    This is the form of the paper's training data, whose second depth is that of the same scene
    point one step later.

    Args:
        flow: (B, h, w, 2) px.
        depth_prev: (B, h, w) metres.
        depth_curr: (B, h, w) metres, on the grid of t like the previous one.
        K_prev: (B, 3, 3) intrinsics.
        K_curr: (B, 3, 3) intrinsics; the previous ones by default.
        valid: (B, h, w) bool or None.

    Raises:
        InputError: shapes that do not fit each other.
    """
    K_curr = K_prev if K_curr is None else K_curr
    batch = PairBatch(flow, depth_prev, K_prev, K_curr, depth_curr=depth_curr, valid=valid)
    _check_batch(batch)
    height, width = flow.shape[1:3]
    rows = torch.arange(height, device=flow.device)
    cols = torch.arange(width, device=flow.device)
    return _finish(flow, depth_prev, depth_curr, valid, K_prev, K_curr, K_prev, rows, cols)


def _from_batch(batch: PairBatch, size: tuple[int, int]) -> NetworkInputs:
    """Resize, bring the current depth onto the previous grid, normalise."""
    height, width = batch.flow.shape[1:3]
    rows, row_scale = _nearest(height, size[0], batch.flow.device)
    cols, col_scale = _nearest(width, size[1], batch.flow.device)

    def pick(x: torch.Tensor) -> torch.Tensor:
        return x.index_select(1, rows).index_select(2, cols)

    flow, depth_prev = pick(batch.flow), pick(batch.depth_prev)
    depth_curr = torch.full_like(depth_prev, torch.nan)
    if batch.depth_curr is not None:
        depth_curr = _sample_at_flow(batch.depth_curr, flow, rows, cols)
    valid = None if batch.valid is None else pick(batch.valid)
    scale = torch.tensor([col_scale, row_scale], dtype=flow.dtype, device=flow.device)
    K_prev, K_curr = (_scale_intrinsics(K, scale) for K in (batch.K_prev, batch.K_curr))
    return _finish(
        flow * scale, depth_prev, depth_curr, valid, K_prev, K_curr, batch.K_prev, rows, cols
    )


def _nearest(native: int, target: int, device: torch.device) -> tuple[torch.Tensor, float]:
    """Native index of the pixel nearest to each target pixel's centre, and the scale."""
    scale = target / native
    index = ((torch.arange(target, dtype=torch.float64) + 0.5) / scale).floor().long()
    return index.clamp(max=native - 1).to(device), scale


def _sample_at_flow(
    depth_curr: torch.Tensor, flow: torch.Tensor, rows: torch.Tensor, cols: torch.Tensor
) -> torch.Tensor:
    """Current depth at x + F, nearest pixel: interpolation would invent depths at edges.

    Args:
        depth_curr: (B, H, W) metres, at native size.
        flow: (B, h, w, 2) in native pixels.
        rows: (h,) native rows of the flow's pixels.
        cols: (w,) native columns.

    Returns:
        (B, h, w); NaN where x + F leaves the picture or the flow is not finite.
    """
    height, width = depth_curr.shape[1:]
    u = cols.to(flow.dtype) + flow[..., 0]
    v = rows.to(flow.dtype)[:, None] + flow[..., 1]
    inside = (u > -0.5) & (u < width - 0.5) & (v > -0.5) & (v < height - 0.5)
    # Comparisons with NaN are false, so what is looked up is finite and inside.
    col = torch.where(inside, u, torch.zeros_like(u)).round().long().clamp(0, width - 1)
    row = torch.where(inside, v, torch.zeros_like(v)).round().long().clamp(0, height - 1)
    sampled = depth_curr.flatten(1).gather(1, (row * width + col).flatten(1)).view_as(u)
    return torch.where(inside, sampled, torch.full_like(sampled, torch.nan))


def _scale_intrinsics(K: torch.Tensor, scale: torch.Tensor) -> torch.Tensor:
    """(B, 3, 3) intrinsics after resizing by (x, y) ``scale``: c' = s (c + 0.5) - 0.5."""
    out = K.clone()
    out[:, :2, :2] = K[:, :2, :2] * scale[:, None]
    out[:, :2, 2] = scale * (K[:, :2, 2] + 0.5) - 0.5
    return out


def _finish(
    flow: torch.Tensor,
    depth_prev: torch.Tensor,
    depth_curr: torch.Tensor,
    valid: torch.Tensor | None,
    K_prev: torch.Tensor,
    K_curr: torch.Tensor,
    K_pixels: torch.Tensor,
    rows: torch.Tensor,
    cols: torch.Tensor,
) -> NetworkInputs:
    """Mask, normalise and name the tensors; ``K_pixels`` belongs to the pixels (rows, cols)."""
    flow_ok = torch.isfinite(flow).all(-1)
    prev_ok = torch.isfinite(depth_prev) & (depth_prev >= NEAREST_DEPTH)
    if valid is not None:
        flow_ok, prev_ok = flow_ok & valid, prev_ok & valid
    curr_ok = torch.isfinite(depth_curr) & (depth_curr >= NEAREST_DEPTH) & flow_ok

    def keep(x: torch.Tensor, mask: torch.Tensor) -> torch.Tensor:
        return torch.where(mask, x, torch.zeros_like(x))

    def invert(x: torch.Tensor, mask: torch.Tensor) -> torch.Tensor:
        return torch.where(mask, 1.0 / torch.where(mask, x, torch.ones_like(x)), 0.0)

    shape = depth_prev.shape
    fx, fy, cx, cy = (K_pixels[:, i, j, None, None] for i, j in ((0, 0), (1, 1), (0, 2), (1, 2)))
    x = ((cols.to(flow.dtype) - cx) / fx).expand(shape)
    y = ((rows.to(flow.dtype)[:, None] - cy) / fy).expand(shape)
    return NetworkInputs(
        flow=keep(flow, flow_ok[..., None]).permute(0, 3, 1, 2) / FLOW_SCALE_PX,
        inverse_depth=torch.stack(
            [invert(depth_prev, prev_ok), invert(depth_curr, curr_ok)], dim=1
        ),
        rays=torch.stack([x, y], dim=1),
        valid=flow_ok & prev_ok,
        depth_prev=keep(depth_prev, prev_ok),
        depth_curr=keep(depth_curr, curr_ok),
        K_prev=K_prev,
        K_curr=K_curr,
    )


def _check_size(size: tuple[int, int]) -> tuple[int, int]:
    try:
        height, width = (int(s) for s in size)
        exact = (height, width) == tuple(size)
    except (TypeError, ValueError):
        exact = False
    if not exact or height < 1 or width < 1:
        raise InputError(
            f"assemble_inputs: expected size as two positive integers (height, width), got {size}."
        )
    return height, width


def _check_batch(batch: PairBatch) -> None:
    flow = batch.flow
    if not isinstance(flow, torch.Tensor) or flow.ndim != 4 or flow.shape[3] != 2:
        got = tuple(flow.shape) if isinstance(flow, torch.Tensor) else type(flow).__name__
        raise InputError(f"PairBatch.flow: expected a tensor of shape (B, H, W, 2), got {got}.")
    if not flow.is_floating_point() or 0 in flow.shape:
        raise InputError(
            f"PairBatch.flow: expected a non-empty floating-point tensor in pixels, got "
            f"{flow.dtype} of shape {tuple(flow.shape)}."
        )
    image, matrix = tuple(flow.shape[:3]), (flow.shape[0], 3, 3)
    expected = {
        "depth_prev": image,
        "depth_curr": image,
        "valid": image,
        "K_prev": matrix,
        "K_curr": matrix,
    }
    for name, shape in expected.items():
        value = getattr(batch, name)
        if value is None and name in ("depth_curr", "valid"):
            continue
        if not isinstance(value, torch.Tensor) or tuple(value.shape) != shape:
            found = tuple(value.shape) if isinstance(value, torch.Tensor) else type(value).__name__
            raise InputError(
                f"PairBatch.{name}: expected shape {shape} to match the flow, got {found}."
            )
        if name == "valid" and value.dtype != torch.bool:
            raise InputError(f"PairBatch.valid: expected bool, got {value.dtype}.")
        if name != "valid" and not value.is_floating_point():
            raise InputError(
                f"PairBatch.{name}: expected floating point, got {value.dtype}. "
                f"Depth is in metres, intrinsics in pixels."
            )
