"""Inputs of the networks: frame pairs, resized by taking the nearest pixel.

An average would mix a moving object with what is behind it. The nearest pixel has flow,
depth and ray of one and the same measured point.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Self

import torch

from hybridvo.core.errors import InputError
from hybridvo.core.geometry import nearest_pixels
from hybridvo.core.types import FramePair, PairBatch
from hybridvo.solver.torch.tools import checked_batch

NETWORK_SIZE = (128, 256)
"""Height and width of the paper's inputs, pixels."""
MIN_DEPTH = 1e-2
"""Metres; a nearer point is a damaged measurement, or is behind the camera."""
MAP_DIMENSIONS = 3
"""Dimensions of a batch of maps, (B, H, W); what belongs to a sample has fewer."""
HALF_PIXEL = 0.5
"""From the centre of an outer pixel to the border of the image, pixels."""


class TensorBatch:
    """Base of dataclasses of tensors with a first axis of one length.

    Maps have one size (h, w). The names of flow maps contain ``flow``, those of
    intrinsics begin with ``K_``.
    """

    def __len__(self) -> int:
        return len(next(iter(vars(self).values())))

    def __getitem__(self, index: slice) -> Self:
        """Return a part of the batch."""
        return type(self)(**{name: x[index] for name, x in vars(self).items()})

    def repeated(self, count: int) -> Self:
        """Repeat every sample so many times, one after the other."""
        repeated = {
            name: x.repeat_interleave(count, dim=0)
            for name, x in vars(self).items()
        }
        return type(self)(**repeated)

    def subsample(self, stride: int) -> Self:
        """Take every n-th pixel of both axes; flow and intrinsics are in the new pixels."""
        if stride == 1:
            return self
        first = stride // 2
        every = slice(first, None, stride)
        sampled = {}
        for name, x in vars(self).items():
            if name.startswith("K_"):
                x = scaled_intrinsics(x, 1 / stride, -first / stride)
            elif x.ndim >= MAP_DIMENSIONS:
                x = x[..., every, every]
            if "flow" in name:
                x = x / stride
            sampled[name] = x
        return type(self)(**sampled)

    def to(self, *args: object, **kwargs: object) -> Self:
        """Return a copy on another device, or of another floating-point type.

        Masks stay boolean. The arguments are those of ``torch.Tensor.to``.
        """
        moved = {}
        for name, x in vars(self).items():
            y = x.to(*args, **kwargs)
            moved[name] = y.bool() if x.dtype is torch.bool else y
        return type(self)(**moved)


@dataclass(frozen=True, eq=False)
class NetworkInputs(TensorBatch):
    """Inputs of B pairs at the network's size (h, w); invalid values are 0.

    Attributes:
        flow: (B, 2, h, w) pixels of this size.
        inverse_depth: (B, 2, h, w) 1 / metres of the previous frame, and of the current
            one at x + F.
        rays: (B, 2, h, w) first two components of K^-1 x.
        valid: (B, h, w) bool, flow and previous depth are both usable.
        K_prev: (B, 3, 3) intrinsics of the previous camera at this size.
        K_curr: (B, 3, 3) intrinsics of the current camera at this size.
    """

    flow: torch.Tensor
    inverse_depth: torch.Tensor
    rays: torch.Tensor
    valid: torch.Tensor
    K_prev: torch.Tensor
    K_curr: torch.Tensor

    @property
    def pixels(self) -> torch.Tensor:
        """The coordinates x of the pixels, (B, 2, h, w)."""
        focal, centre = pinhole(self.K_prev)
        return self.rays * focal + centre

    def on_grid_of(self, maps: torch.Tensor) -> NetworkInputs:
        """Take the pixel of each cell of coarser maps (B, C, h', w')."""
        stride = round(self.flow.shape[2] / maps.shape[2])
        return self.subsample(max(1, stride))


def pinhole(K: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """Focal lengths and principal points (B, 2, 1, 1) of intrinsics (B, 3, 3)."""
    focal = K.diagonal(dim1=1, dim2=2)[:, :2, None, None]
    centre = K[:, :2, 2, None, None]
    return focal, centre


def scaled_intrinsics(
    K: torch.Tensor, scale: float | torch.Tensor, offset: float | torch.Tensor
) -> torch.Tensor:
    """Intrinsics (B, 3, 3) after pixel coordinates x became scale * x + offset."""
    scaled = K.clone()
    scaled[:, :2] *= torch.as_tensor(scale).to(K).reshape(-1, 1)
    scaled[:, :2, 2] += offset
    return scaled


def assemble_inputs(
    pair: FramePair | PairBatch,
    size: tuple[int, int] | None = NETWORK_SIZE,
    *,
    is_aligned: bool = False,
) -> NetworkInputs:
    """Assemble the inputs of a network from one pair or from a batch.

    Missing or damaged values (no flow, no depth, NaN, inf, depth <= 0, masked pixels)
    become 0 and are marked in ``valid``.

    Args:
        pair: frames with flow, and depth of the previous one.
        size: height and width of the inputs; None: those of the pair.
        is_aligned: whether the current depth lies on the previous grid already, as in the
            paper's samples. Otherwise it is taken at x + F.

    Returns:
        Float32 tensors on the CPU; for a batch, tensors of its type on its device.

    Raises:
        InputError: for what is neither a pair nor a batch, and for a damaged batch.
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
    device = batch.flow.device
    rows = torch.as_tensor(nearest_pixels(height, size[0]), device=device)
    columns = torch.as_tensor(nearest_pixels(width, size[1]), device=device)

    def pick(x: torch.Tensor) -> torch.Tensor:
        return x.index_select(1, rows).index_select(2, columns)

    flow = pick(batch.flow)
    depth_prev = pick(batch.depth_prev)
    if batch.depth_curr is None:
        depth_curr = torch.full_like(depth_prev, torch.nan)
    elif is_aligned:
        depth_curr = pick(batch.depth_curr)
    else:
        depth_curr = _sample_at_flow(batch.depth_curr, flow, rows, columns)
    if batch.valid is None:
        unmasked = torch.ones_like(depth_prev).bool()
    else:
        unmasked = pick(batch.valid)

    flow_ok = torch.isfinite(flow).all(-1) & unmasked
    prev_ok = _is_depth(depth_prev) & unmasked
    curr_ok = _is_depth(depth_curr) & flow_ok
    inverse_prev = _inverse(depth_prev, prev_ok)
    inverse_curr = _inverse(depth_curr, curr_ok)

    scale = flow.new_tensor([size[1] / width, size[0] / height])
    scaled_flow = torch.where(flow_ok[..., None], flow * scale, 0.0)
    # pixel centres lie at whole coordinates: c' = s (c + 0.5) - 0.5
    offset = 0.5 * scale - 0.5
    return NetworkInputs(
        flow=scaled_flow.permute(0, 3, 1, 2),
        inverse_depth=torch.stack([inverse_prev, inverse_curr], dim=1),
        rays=_rays(batch.K_prev, rows, columns, flow.dtype),
        valid=flow_ok & prev_ok,
        K_prev=scaled_intrinsics(batch.K_prev, scale, offset),
        K_curr=scaled_intrinsics(batch.K_curr, scale, offset),
    )


def _rays(
    K: torch.Tensor,
    rows: torch.Tensor,
    columns: torch.Tensor,
    dtype: torch.dtype,
) -> torch.Tensor:
    """(B, 2, h, w) first two components of K^-1 x of some rows and columns."""
    v, u = torch.meshgrid(rows, columns, indexing="ij")
    focal, centre = pinhole(K)
    return (torch.stack([u, v]).to(dtype) - centre) / focal


def _is_depth(depth: torch.Tensor) -> torch.Tensor:
    return torch.isfinite(depth) & (depth >= MIN_DEPTH)


def _inverse(depth: torch.Tensor, is_valid: torch.Tensor) -> torch.Tensor:
    """1 / depth; 0, without a gradient, where it is not valid."""
    safe = torch.where(is_valid, depth, 1.0)
    return torch.where(is_valid, 1.0 / safe, 0.0)


def _sample_at_flow(
    depth_curr: torch.Tensor,
    flow: torch.Tensor,
    rows: torch.Tensor,
    columns: torch.Tensor,
) -> torch.Tensor:
    """Current depth (B, H, W) at x + F, (B, h, w), nearest pixel; NaN outside."""
    height, width = depth_curr.shape[1:]
    u = columns.to(flow.dtype) + flow[..., 0]
    v = rows.to(flow.dtype)[:, None] + flow[..., 1]
    is_inside = (u > -HALF_PIXEL) & (u < width - HALF_PIXEL)
    is_inside &= (v > -HALF_PIXEL) & (v < height - HALF_PIXEL)
    # comparisons with NaN are false, so every coordinate that is kept is finite
    column = torch.where(is_inside, u, 0.0).round().long().clamp(0, width - 1)
    row = torch.where(is_inside, v, 0.0).round().long().clamp(0, height - 1)
    index = (row * width + column).flatten(1)
    sampled = depth_curr.flatten(1).gather(1, index).view_as(u)
    return torch.where(is_inside, sampled, torch.nan)
