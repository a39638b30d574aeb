"""Frame pairs -> what the networks read, at their size by taking the nearest pixel.

An average would blend a mover with what is behind it; the nearest pixel keeps flow, depth and ray
of one and the same measured point together.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Self

import torch

from hybridvo.errors import InputError
from hybridvo.geometry import nearest_pixels
from hybridvo.refinement.torch_factors import checked_batch
from hybridvo.types import FramePair, PairBatch

NETWORK_SIZE = (128, 256)  # height and width of the paper's inputs
MIN_DEPTH = 1e-2  # metres; nearer is damage in a measurement, or behind the camera


class TensorBatch:
    """Base of dataclasses of tensors: maps of one size, flow among them, cameras as ``K_*``."""

    def __len__(self) -> int:
        return len(next(iter(vars(self).values())))

    def __getitem__(self, index: slice) -> Self:
        """Part of the batch."""
        return type(self)(**{name: x[index] for name, x in vars(self).items()})

    def repeated(self, count: int) -> Self:
        """Every sample so many times, one after the other."""
        return type(self)(
            **{k: x.repeat_interleave(count, dim=0) for k, x in vars(self).items()}
        )

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
    """Inputs of a batch of pairs at the network's size (h, w); what is invalid is 0."""

    flow: torch.Tensor  # (B, 2, h, w) pixels of this size
    # (B, 2, h, w) 1 / metres: previous, and current at x + F
    inverse_depth: torch.Tensor
    rays: torch.Tensor  # (B, 2, h, w) first two components of K^-1 x
    valid: torch.Tensor  # (B, h, w) bool: flow and previous depth are both usable
    K_prev: torch.Tensor  # (B, 3, 3) of this size
    K_curr: torch.Tensor

    @property
    def pixels(self) -> torch.Tensor:
        """(B, 2, h, w) coordinates x of the pixels."""
        focal, centre = pinhole(self.K_prev)
        return self.rays * focal + centre

    def on_grid_of(self, maps: torch.Tensor) -> NetworkInputs:
        """Every n-th pixel of the inputs, one for each cell of maps (B, C, h', w')."""
        return self.subsample(max(1, round(self.flow.shape[2] / maps.shape[2])))


def pinhole(K: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """Focal lengths and principal points (B, 2, 1, 1) of intrinsics (B, 3, 3)."""
    return K.diagonal(dim1=1, dim2=2)[:, :2, None, None], K[:, :2, 2, None, None]


def quantiles(
    x: torch.Tensor, mask: torch.Tensor, q: tuple[float, ...]
) -> torch.Tensor:
    """(len(q), B) quantiles of a (B, h, w) map over a mask; 1 where that is empty."""
    kept = torch.where(mask, x, torch.nan)[..., ::2, ::2]  # enough for a scale
    return torch.nanquantile(kept.flatten(1), kept.new_tensor(q), dim=1).nan_to_num(
        1.0, 1.0, 1.0
    )


def scaled_intrinsics(
    K: torch.Tensor, scale: float | torch.Tensor, offset: float | torch.Tensor
) -> torch.Tensor:
    """(B, 3, 3) intrinsics after pixel coordinates x became scale * x + offset, of both axes."""
    out = K.clone()
    out[:, :2] *= torch.as_tensor(scale).to(K).reshape(-1, 1)
    out[:, :2, 2] += offset
    return out


def assemble_inputs(
    pair: FramePair | PairBatch,
    size: tuple[int, int] | None = NETWORK_SIZE,
    *,
    is_aligned: bool = False,
) -> NetworkInputs:
    """Inputs of one pair or of a batch, of its own size where none is given.

    Missing or damaged values (no flow, no depth, NaN, inf, depth <= 0, masked pixels) become 0 and
    are marked in ``valid``. Float32 tensors on the CPU; for a batch, its type and device.
    ``is_aligned``: the current depth lies on the previous grid already, as in the paper's samples.
    """
    if isinstance(pair, FramePair):
        pair = PairBatch.from_pairs([pair])
    if not isinstance(pair, PairBatch):
        got = type(pair).__name__
        raise InputError(
            f"assemble_inputs: expected a FramePair or a PairBatch, got {got}."
        )
    batch = checked_batch(pair, where="assemble_inputs")[0]
    height, width = batch.flow.shape[1:3]
    size = size or (height, width)
    rows = torch.as_tensor(
        nearest_pixels(height, size[0]), device=batch.flow.device
    )
    cols = torch.as_tensor(nearest_pixels(width, size[1]), device=batch.flow.device)

    def pick(x: torch.Tensor) -> torch.Tensor:
        return x.index_select(1, rows).index_select(2, cols)

    flow = pick(batch.flow)
    prev = pick(batch.depth_prev)
    if batch.depth_curr is None:
        curr = torch.full_like(prev, torch.nan)
    elif is_aligned:
        curr = pick(batch.depth_curr)
    else:
        curr = _sample_at_flow(batch.depth_curr, flow, rows, cols)
    scale = flow.new_tensor([size[1] / width, size[0] / height])
    # pixel centres lie at whole coordinates: c' = s (c + 0.5) - 0.5
    cameras = (
        scaled_intrinsics(K, scale, 0.5 * scale - 0.5)
        for K in (batch.K_prev, batch.K_curr)
    )
    v, u = torch.meshgrid(rows, cols, indexing="ij")
    focal, centre = pinhole(batch.K_prev)
    rays = (torch.stack([u, v]).to(flow.dtype) - centre) / focal
    usable = (
        torch.ones_like(prev).bool() if batch.valid is None else pick(batch.valid)
    )
    flow_ok = torch.isfinite(flow).all(-1) & usable
    prev_ok = torch.isfinite(prev) & (prev >= MIN_DEPTH) & usable
    curr_ok = torch.isfinite(curr) & (curr >= MIN_DEPTH) & flow_ok
    inverse = [
        # no 1 / 0 in the gradient of what is not selected
        torch.where(ok, 1.0 / torch.where(ok, depth, 1.0), 0.0)
        for depth, ok in ((prev, prev_ok), (curr, curr_ok))
    ]
    flow = torch.where(flow_ok[..., None], flow * scale, 0.0).permute(0, 3, 1, 2)
    return NetworkInputs(
        flow, torch.stack(inverse, dim=1), rays, flow_ok & prev_ok, *cameras
    )


def _sample_at_flow(
    depth_curr: torch.Tensor,
    flow: torch.Tensor,
    rows: torch.Tensor,
    cols: torch.Tensor,
) -> torch.Tensor:
    """(B, h, w) current depth (B, H, W) at x + F, nearest pixel; NaN where that is not inside."""
    height, width = depth_curr.shape[1:]
    u = cols.to(flow.dtype) + flow[..., 0]
    v = rows.to(flow.dtype)[:, None] + flow[..., 1]
    inside = (u > -0.5) & (u < width - 0.5) & (v > -0.5) & (v < height - 0.5)
    # Comparisons with NaN are false, so what is looked up is finite and inside.
    col = torch.where(inside, u, 0.0).round().long().clamp(0, width - 1)
    row = torch.where(inside, v, 0.0).round().long().clamp(0, height - 1)
    sampled = (
        depth_curr.flatten(1).gather(1, (row * width + col).flatten(1)).view_as(u)
    )
    return torch.where(inside, sampled, torch.nan)
