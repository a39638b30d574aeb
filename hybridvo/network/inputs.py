"""Frame pairs -> what the networks read, at their size by taking the nearest pixel.

An average would blend a mover with what is behind it; the nearest pixel keeps flow, depth and ray
of one and the same measured point together.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Self

import torch

from hybridvo.errors import InputError
from hybridvo.refinement.torch_factors import checked_batch
from hybridvo.types import FramePair, PairBatch

FLOW_SCALE_PX = 200.0
"""Flow is divided by this before it enters a network."""
NETWORK_SIZE = (128, 256)
"""Height and width of the paper's inputs."""
MIN_DEPTH = 1e-2
"""Metres; what is nearer is damage in a measurement, and behind the camera after a motion."""


class TensorBatch:
    """Base of dataclasses of tensors: maps of one size, flow among them, cameras as ``K_*``."""

    def __len__(self) -> int:
        return len(next(iter(vars(self).values())))

    def __getitem__(self, index: slice) -> Self:
        """Part of the batch."""
        return type(self)(**{name: x[index] for name, x in vars(self).items()})

    def subsample(self, stride: int) -> Self:
        """Every ``stride``-th pixel of every ``stride``-th row, flow in their pixels."""
        if stride == 1:
            return self
        every = slice(stride // 2, None, stride)
        out = {}
        for name, x in vars(self).items():
            if name.startswith("K_"):
                x = scaled_intrinsics(x, 1 / stride, -(stride // 2) / stride)
            elif x.ndim > 2:
                x = x[..., every, every]
            out[name] = x / stride if "flow" in name else x
        return type(self)(**out)

    def to(self, *args: object, **kwargs: object) -> Self:
        """Copy on another device, or of another floating-point type; masks stay boolean."""
        moved = {}
        for name, x in vars(self).items():
            y = x.to(*args, **kwargs)
            moved[name] = y.bool() if x.dtype is torch.bool else y
        return type(self)(**moved)


@dataclass(frozen=True, eq=False)
class NetworkInputs(TensorBatch):
    """Inputs of a batch of pairs at the network's size (h, w); what is invalid is 0.

    ``flow`` (B, 2, h, w): pixels of this size over ``FLOW_SCALE_PX``; ``inverse_depth``
    (B, 2, h, w): 1 / metres of the previous depth, and of the current one at x + F; ``rays``
    (B, 2, h, w): first two components of K^-1 x; ``valid`` (B, h, w): flow and previous depth are
    both usable; intrinsics (B, 3, 3) of this size.
    """

    flow: torch.Tensor
    inverse_depth: torch.Tensor
    rays: torch.Tensor
    valid: torch.Tensor
    K_prev: torch.Tensor
    K_curr: torch.Tensor

    @property
    def flow_px(self) -> torch.Tensor:
        """(B, 2, h, w) flow in pixels of the network's size; 0 if invalid."""
        return self.flow * FLOW_SCALE_PX

    @property
    def pixels(self) -> torch.Tensor:
        """(B, 2, h, w) coordinates x of the pixels."""
        focal, centre = pinhole(self.K_prev)
        return self.rays * focal + centre

    @property
    def size(self) -> tuple[int, int]:
        """(h, w)."""
        return self.flow.shape[2], self.flow.shape[3]


def pinhole(K: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """Focal lengths and principal points (B, 2, 1, 1) of intrinsics (B, 3, 3)."""
    return K.diagonal(dim1=1, dim2=2)[:, :2, None, None], K[:, :2, 2, None, None]


def scaled_intrinsics(
    K: torch.Tensor, scale: float | torch.Tensor, offset: float | torch.Tensor
) -> torch.Tensor:
    """(B, 3, 3) intrinsics after pixel coordinates x became scale * x + offset, of both axes."""
    out = K.clone()
    out[:, 0, 0], out[:, 1, 1] = (K.diagonal(dim1=1, dim2=2)[:, :2] * scale).unbind(1)
    out[:, :2, 2] = scale * K[:, :2, 2] + offset
    return out


def assemble_inputs(
    pair: FramePair | PairBatch, size: tuple[int, int] = NETWORK_SIZE
) -> NetworkInputs:
    """Inputs of one pair or of a batch.

    Missing or damaged values (no flow, no depth, NaN, inf, depth <= 0, masked pixels) become 0 and
    are marked in ``valid``. Float32 tensors on the CPU; for a batch, its type and device.

    Raises:
        InputError: another type, or shapes that do not fit each other.
    """
    if isinstance(pair, FramePair):
        pair = PairBatch.from_pairs([pair])
    if not isinstance(pair, PairBatch):
        got = type(pair).__name__
        raise InputError(f"assemble_inputs: expected a FramePair or a PairBatch, got {got}.")
    batch = checked_batch(pair, where="assemble_inputs")[0]
    height, width = batch.flow.shape[1:3]
    rows = _nearest(height, size[0]).to(batch.flow.device)
    cols = _nearest(width, size[1]).to(batch.flow.device)

    def pick(x: torch.Tensor) -> torch.Tensor:
        return x.index_select(1, rows).index_select(2, cols)

    flow, depth_curr = pick(batch.flow), None
    if batch.depth_curr is not None:
        depth_curr = _sample_at_flow(batch.depth_curr, flow, rows, cols)
    scale = flow.new_tensor([size[1] / width, size[0] / height])
    # pixel centres lie at whole coordinates: c' = s (c + 0.5) - 0.5
    K_prev, K_curr = (
        scaled_intrinsics(K, scale, 0.5 * scale - 0.5) for K in (batch.K_prev, batch.K_curr)
    )
    valid = None if batch.valid is None else pick(batch.valid)
    depth = pick(batch.depth_prev)
    resized = PairBatch(flow * scale, depth, K_prev, K_curr, depth_curr=depth_curr, valid=valid)
    return _normalize(resized, _rays(rows, cols, batch.K_prev))


def assemble_aligned(
    flow: torch.Tensor, depth_prev: torch.Tensor, depth_curr: torch.Tensor, K: torch.Tensor
) -> NetworkInputs:
    """Inputs from samples of the network's size, as the paper trains on.

    Flow (B, h, w, 2) px, depths (B, h, w) metres of the same scene points one step apart, both on
    the previous grid, K (B, 3, 3) of both frames.
    """
    batch = PairBatch(flow, depth_prev, K, K, depth_curr=depth_curr)
    batch = checked_batch(batch, where="assemble_aligned")[0]
    rows, cols = (torch.arange(n, device=flow.device) for n in flow.shape[1:3])
    return _normalize(batch, _rays(rows, cols, batch.K_prev))


def _rays(rows: torch.Tensor, cols: torch.Tensor, K: torch.Tensor) -> torch.Tensor:
    """(B, 2, h, w) first two components of K^-1 x at rows (h,) and columns (w,) of pixels."""
    v, u = torch.meshgrid(rows, cols, indexing="ij")
    focal, centre = pinhole(K)
    return (torch.stack([u, v]).to(K.dtype) - centre) / focal


def _nearest(native: int, target: int) -> torch.Tensor:
    """Native index of the pixel nearest to each target pixel's centre."""
    centre = (torch.arange(target, dtype=torch.float64) + 0.5) * native / target
    return centre.floor().long().clamp(max=native - 1)


def _sample_at_flow(
    depth_curr: torch.Tensor, flow: torch.Tensor, rows: torch.Tensor, cols: torch.Tensor
) -> torch.Tensor:
    """(B, h, w) current depth (B, H, W) at x + F, nearest pixel; NaN where that is not inside."""
    height, width = depth_curr.shape[1:]
    u = cols.to(flow.dtype) + flow[..., 0]
    v = rows.to(flow.dtype)[:, None] + flow[..., 1]
    inside = (u > -0.5) & (u < width - 0.5) & (v > -0.5) & (v < height - 0.5)
    # Comparisons with NaN are false, so what is looked up is finite and inside.
    col = torch.where(inside, u, 0.0).round().long().clamp(0, width - 1)
    row = torch.where(inside, v, 0.0).round().long().clamp(0, height - 1)
    sampled = depth_curr.flatten(1).gather(1, (row * width + col).flatten(1)).view_as(u)
    return torch.where(inside, sampled, torch.nan)


def _normalize(batch: PairBatch, rays: torch.Tensor) -> NetworkInputs:
    """Inputs of a batch of the network's size, whose pixels have the rays (B, 2, h, w)."""
    flow, prev, curr = batch.flow, batch.depth_prev, batch.depth_curr
    flow_ok = torch.isfinite(flow).all(-1)
    prev_ok = torch.isfinite(prev) & (prev >= MIN_DEPTH)
    if batch.valid is not None:
        flow_ok, prev_ok = flow_ok & batch.valid, prev_ok & batch.valid
    curr = torch.full_like(prev, torch.nan) if curr is None else curr
    curr_ok = torch.isfinite(curr) & (curr >= MIN_DEPTH) & flow_ok
    flow = torch.where(flow_ok[..., None], flow, 0.0).permute(0, 3, 1, 2) / FLOW_SCALE_PX
    inverse = [
        # no 1 / 0 in the gradient of what is not selected
        torch.where(ok, 1.0 / torch.where(ok, depth, 1.0), 0.0)
        for depth, ok in ((prev, prev_ok), (curr, curr_ok))
    ]
    depths, valid = torch.stack(inverse, dim=1), flow_ok & prev_ok
    return NetworkInputs(flow, depths, rays, valid, batch.K_prev, batch.K_curr)
