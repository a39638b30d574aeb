"""What a window of frames may solve for beside its poses.

Each of these unknowns has a prior with a stated standard deviation, and is counted in it, so that
the prior adds one to the diagonal of the normal equations::

    log focal length   focal_std v        one v for all frames
    log depth scale    scale_std_f v_f    one v_f for each frame
    log depth          noise_i u_i        one u_i for each pixel of each frame with flow

A factor on all depths and translations changes no flow: only the priors hold it. That is why the
scales are those of single frames, and why each has a prior.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
import torch

from hybridvo.core.checks import as_number, brief
from hybridvo.core.errors import InputError
from hybridvo.core.torch_geometry import pp
from hybridvo.core.types import PairBatch
from hybridvo.solver.torch.factors import Pixels, Weighted
from hybridvo.solver.torch.tools import as_tensor

# Largest relative difference of two depth maps of one frame.
SAME_DEPTH = 1e-3


class Unknowns(NamedTuple):
    """Which unknowns a window has beside its poses; None: it is known."""

    focal_std: float | None = None  # of the log of one factor on all focal lengths
    depth_scale_std: torch.Tensor | None = None  # (F,) of log depth scales, float64
    shared_depth: bool = False  # whether the depth of each pixel of a frame is one

    @property
    def has_focal(self) -> bool:
        """Whether the focal length is unknown."""
        return self.focal_std is not None

    @property
    def has_scales(self) -> bool:
        """Whether the scales of the frames' depths are unknown."""
        return self.depth_scale_std is not None

    @property
    def any(self) -> bool:
        """Whether anything but the poses is unknown."""
        return self.has_focal or self.has_scales or self.shared_depth

    def stds(self, like: torch.Tensor) -> torch.Tensor:
        """Return the standard deviations (m,) of focal length and scales, in their order."""
        parts = [like.new_zeros(0, dtype=torch.float64)]
        if self.focal_std is not None:
            parts.append(like.new_tensor([self.focal_std], dtype=torch.float64))
        if self.depth_scale_std is not None:
            parts.append(self.depth_scale_std.to(parts[0]))
        return torch.cat(parts)


class WindowState(NamedTuple):
    """Where a window is: poses, and the unknowns in standard deviations of their priors."""

    C: pp.LieTensor  # (F, 7) T_frame_first
    others: torch.Tensor  # (m,) focal length, then scales; float64
    depths: torch.Tensor  # (F, N) of the pixels; (F, 0) where they are not shared


class Edges(NamedTuple):
    """The pairs of frames with flow."""

    prev: torch.Tensor  # (K,) numbers of frames
    curr: torch.Tensor  # (K,)
    used: torch.Tensor  # (K,) whether it takes part
    frames: int

    def log_focal(self, unknowns: Unknowns, others: torch.Tensor) -> torch.Tensor:
        """Return the log of the factor on the focal lengths, a number."""
        if unknowns.focal_std is None:
            return others.new_zeros(())
        return unknowns.focal_std * others[0]

    def log_scales(self, unknowns: Unknowns, others: torch.Tensor) -> torch.Tensor:
        """Return the log depth scales (F,) of the frames."""
        if unknowns.depth_scale_std is None:
            return others.new_zeros(self.frames)
        stds = unknowns.depth_scale_std.to(others)
        return stds * others[int(unknowns.has_focal) :]

    def sum_by_frame(self, values: torch.Tensor) -> torch.Tensor:
        """Sum values (K, ...) of edges over those that begin at each frame: (F, ...)."""
        total = values.new_zeros(self.frames, *values.shape[1:])
        return total.index_add(0, self.prev, values)


def moved_pixels(
    pixels: Pixels,
    edges: Edges,
    unknowns: Unknowns,
    others: torch.Tensor,
    log_depth: torch.Tensor | None = None,
) -> Pixels:
    """Return the pixels of the edges at a focal length, depth scales and depths.

    Args:
        pixels: as they were measured.
        edges: of the window.
        unknowns: which there are.
        others: (m,) focal length and scales, in standard deviations of their priors.
        log_depth: (K, N) what is added to the log depth of each pixel; None: nothing.
    """
    longer = edges.log_scales(unknowns, others)[edges.prev, None]
    if log_depth is not None:
        longer = longer + log_depth
    factor = edges.log_focal(unknowns, others).exp().to(pixels.points)
    points = pixels.points * longer.exp().to(pixels.points)[:, None]
    across = points[:, :2] / factor
    # of [[fx, 0, cx], [0, fy, cy], [0, 0, 1]] the third column stays
    columns = torch.stack([factor, factor, torch.ones_like(factor)])
    return pixels._replace(
        points=torch.cat([across, points[:, 2:]], dim=1),
        weight=pixels.weight * edges.used[:, None],
        K=pixels.K * columns,
    )


def camera_columns(
    at: Weighted,
    pixels: Pixels,
    T: torch.Tensor,
    edges: Edges,
    unknowns: Unknowns,
) -> list[torch.Tensor]:
    """Return how the pixels move with the focal length and with the scale of their depth.

    Args:
        at: the residuals at the motions.
        pixels: of the edges, moved to the state.
        T: (K, 4, 4) motions of the edges.
        edges: of the window.
        unknowns: which there are.

    Returns:
        For each unknown of an edge (K, 2, N) px, for a standard deviation of its prior.
    """
    columns = []
    if unknowns.focal_std is not None:
        columns.append(unknowns.focal_std * _by_focal(at, pixels, T))
    if unknowns.depth_scale_std is not None:
        stds = unknowns.depth_scale_std[edges.prev, None, None].to(at.q)
        columns.append(stds * at.q * at.stretch[:, None])
    return columns


def _by_focal(at: Weighted, pixels: Pixels, T: torch.Tensor) -> torch.Tensor:
    """Return how the pixels move with the log of the focal length of both images, (K, 2, N) px.

    The point (X, Y, Z) of the previous camera moves by -(X, Y, 0), so that X' in the current one
    moves by -R (X, Y, 0) = -(X' - t - Z R_3); and the current image is stretched about its centre.
    """
    T = T.to(at.q)
    i = at.i[:, None]
    depth = (pixels.points[:, 2] * (1 + at.shift))[:, None]
    # R (X, Y, 0) / Z'
    ahead = (T[:, :3, 3:] + T[:, :3, 2:3] * depth) * i
    across = at.ab - ahead[:, :2]
    along = 1 - ahead[:, 2:]
    return at.focal * (at.ab * (1 + along) - across)


def checked_unknowns(
    batch: PairBatch,
    numbers: np.ndarray,
    focal_std: Any,
    depth_scale_std: Any,
    shared_depth: Any,
) -> Unknowns:
    """Return the unknowns that a user asks for.

    Args:
        batch: the pairs.
        numbers: (K, 2) previous and current frame of each pair.
        focal_std: standard deviation, or None.
        depth_scale_std: one standard deviation, or (F,), or None.
        shared_depth: whether the depths are unknown.

    Raises:
        InputError: a value has another form, or a frame has two depth maps.
    """
    if focal_std is not None:
        focal_std = _checked_std(focal_std)
    frames = int(numbers.max()) + 1
    scales = _checked_stds(depth_scale_std, frames, batch.flow.device)
    if not isinstance(shared_depth, bool):
        raise InputError(
            f"refine_window.shared_depth: expected True or False, got "
            f"{brief(shared_depth)}."
        )
    if shared_depth:
        _check_depths(batch.depth_prev.detach(), numbers[:, 0])
    return Unknowns(focal_std, scales, shared_depth)


def _checked_std(value: Any) -> float:
    """The standard deviation of the log focal length."""
    number = as_number(value)
    if isinstance(value, bool) or not 0 < number < torch.inf:
        raise InputError(
            "refine_window.focal_std: expected a positive, finite standard deviation of the log "
            f"focal length, such as 0.05, or None, got {brief(value)}."
        )
    return number


def _checked_stds(
    value: Any, frames: int, device: torch.device
) -> torch.Tensor | None:
    """The standard deviations (F,) of the log depth scales, or None."""
    if value is None:
        return None
    stds = as_tensor(value, "depth_scale_std", device, "refine_window")
    stds = stds.detach().double()
    fits = tuple(stds.shape) in ((), (frames,))
    if not fits or not bool((stds >= 0).all() and torch.isfinite(stds).all()):
        raise InputError(
            f"refine_window.depth_scale_std: expected a standard deviation of log depth scales, or "
            f"one for each of {frames} frames (0: its scale is known), finite, got "
            f"{brief(value)}."
        )
    return stds.expand(frames)


def _check_depths(depth: torch.Tensor, prev: np.ndarray) -> None:
    """Refuse depth maps (K, H, W) that differ between pairs of one previous frame."""
    first: dict[int, int] = {}
    for edge, frame in enumerate(prev.tolist()):
        other = first.setdefault(frame, edge)
        apart = (depth[edge] / depth[other]).log().abs()
        differs = torch.isfinite(apart) & (apart > SAME_DEPTH)
        if bool(differs.any()):
            raise InputError(
                f"refine_window.shared_depth: expected one depth map of frame {frame}, got "
                f"another one in pair {edge} than in pair {other}. Hand in the same one, or leave "
                "shared_depth out."
            )
