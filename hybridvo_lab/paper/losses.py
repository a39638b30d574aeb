"""Losses of PWVO and its baselines (paper, sections 3.2.2 and 3.4) in log form, s = log U.

Rotation L^R and translation L^T: every pixel must predict the motion of its pair. Ego flow
L^F and depth L^D: the *selected* motion, applied to the true depth, must reproduce the true
ego flow and the true current depth. All as published, except that pixels without depth do
not count, and that a point behind the camera costs the limit.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Literal

import torch
import torch.nn.functional as F
from pydantic import Field

from hybridvo.core.options import Positive, option_group
from hybridvo.core.results import PixelwisePrediction
from hybridvo.core.torch_geometry import pixel_grid, reproject
from hybridvo_lab.paper.inputs import MIN_DEPTH, TensorBatch
from hybridvo_lab.training import ranks

Scales = torch.Tensor | None
"""Log scales s (B, 6, h, w), or None for a loss without uncertainty."""
MAX_EXPONENT = 30.0
"""exp(-s) continues as a straight line where -s is larger."""
FLOW_EXPONENT = 0.1
"""U^F = exp(0.1 s), as published."""
DEPTH_EXPONENT = 0.25
"""U^D = exp(0.25 s), as published."""
DEPTH_CHANNELS = (0, 1, 5)
"""rx, ry and tz, the only components that change a depth."""


@option_group
class LossOptions:
    """Which terms the loss has, and their form.

    Attributes:
        pose_uncertainty: whether L^R and L^T are weighted by U^R and U^T (distribution
            learning).
        flow: whether there is L^F.
        depth: whether there is L^D.
        flow_uncertainty: whether L^F is weighted by U^F.
        depth_uncertainty: whether L^D is weighted by U^D.
        flow_weight: factor on L^F.
        translation_form: ``direction``: the paper's, of direction and length; ``laplace``:
            L1 of each component in metres with its own s, so that exp(s) is in metres.
        flow_limit_px: errors of a component at or above this do not count.
        direction_floor: metres; below this length of the translation its direction loses
            its weight. Larger values than the published one reduce the gradient near zero
            translation.
    """

    pose_uncertainty: bool = True
    flow: bool = True
    depth: bool = True
    flow_uncertainty: bool = True
    depth_uncertainty: bool = True
    flow_weight: Annotated[float, Field(ge=0)] = 1.0
    translation_form: Literal["direction", "laplace"] = "direction"
    flow_limit_px: Positive = 20.0
    direction_floor: Positive = 1e-6

    @property
    def needs_uncertainty(self) -> bool:
        """Whether a term needs the network's log scales."""
        flow = self.flow and self.flow_uncertainty
        depth = self.depth and self.depth_uncertainty
        return self.pose_uncertainty or flow or depth


@dataclass(frozen=True, eq=False)
class LossTargets(TensorBatch):
    """Ground truth of B pairs, at the network's input size (h, w).

    Attributes:
        motion: (B, 6) Euler angles X-Y-Z in degrees, then metres, of ``T_curr_prev``.
        ego_flow: (B, 2, h, w) px of the camera motion alone; NaN does not count.
        depth_prev: (B, h, w) metres.
        depth_curr: (B, h, w) metres of the same scene points, on the previous grid.
        K_prev: (B, 3, 3) intrinsics of the previous camera.
        K_curr: (B, 3, 3) intrinsics of the current camera.
    """

    motion: torch.Tensor
    ego_flow: torch.Tensor
    depth_prev: torch.Tensor
    depth_curr: torch.Tensor
    K_prev: torch.Tensor
    K_curr: torch.Tensor

    def reconstruct(
        self, T: torch.Tensor
    ) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
        """Reconstruct what a motion (B, 4, 4) causes.

        Returns:
            Ego flow (B, 2, h, w), depth (B, h, w), and where both are defined (B, h, w).
        """
        depth = self.depth_prev
        pixels, valid, z = reproject(depth, T, self.K_prev, self.K_curr, MIN_DEPTH)
        flow = pixels - pixel_grid(depth.shape[1], depth.shape[2], depth)
        return flow.permute(0, 3, 1, 2), z, valid


def total_loss(
    output: PixelwisePrediction,
    targets: LossTargets,
    options: LossOptions,
    T_curr_prev: torch.Tensor,
) -> tuple[torch.Tensor, dict[str, torch.Tensor]]:
    """Compute the loss of a prediction.

    Args:
        output: the network's maps.
        targets: ground truth.
        options: which terms the loss has.
        T_curr_prev: (B, 4, 4) the selected motions, for L^F and L^D.

    Returns:
        The weighted sum of the terms; and the terms without weight and gradient, by the
        names rotation, translation, flow and depth.
    """
    s = output.log_scale
    s_pose = s if options.pose_uncertainty else None
    parts = _pose_losses(output.motion, targets, s_pose, options)
    flow, depth, is_defined = targets.reconstruct(T_curr_prev)
    if options.flow:
        s_flow = s if options.flow_uncertainty else None
        parts["flow"] = _flow_loss(
            flow, is_defined, targets, s_flow, options.flow_limit_px
        )
    if options.depth:
        s_depth = s if options.depth_uncertainty else None
        parts["depth"] = _depth_loss(depth, targets, s_depth)
    weights = {name: 1.0 for name in parts} | {"flow": options.flow_weight}
    loss = sum(weights[name] * part for name, part in parts.items())
    detached = {name: part.detach() for name, part in parts.items()}
    return torch.as_tensor(loss), detached


def _inverse_scale(s: torch.Tensor) -> torch.Tensor:
    """exp(-s), continued as a straight line for very negative s: finite, with a gradient."""
    bounded = (-s).clamp(max=MAX_EXPONENT)
    return bounded.exp() * (1 + (-s - bounded))


def _norm(x: torch.Tensor) -> torch.Tensor:
    # 1e-12 as published: the gradient stays finite at zero
    return (x.square().sum(dim=1, keepdim=True) + 1e-12).sqrt()


def _direction(t: torch.Tensor, floor: float) -> torch.Tensor:
    """Unit vectors along dimension 1; shorter ones for lengths below the floor."""
    squared = t.square().sum(dim=1, keepdim=True).clamp(min=floor**2)
    return t * squared.rsqrt()


def _pose_losses(
    motion: torch.Tensor, targets: LossTargets, s: Scales, options: LossOptions
) -> dict[str, torch.Tensor]:
    """L^R and L^T of maps (B, 6, h, w), as published."""
    true = targets.motion[:, :, None, None]
    rotation_error, translation_error = (motion - true).abs().split(3, dim=1)
    # VONet predicts one motion: plain L1
    is_laplace = options.translation_form == "laplace" or motion.shape[2:] == (1, 1)
    if not is_laplace:
        t = motion[:, 3:]
        t_true = true[:, 3:]
        floor = options.direction_floor
        turn = _direction(t_true, floor) - _direction(t, floor)
        length_error = (_norm(t_true) - _norm(t)).square()
        translation_error = length_error + _norm(turn)
    if s is not None:
        s_rotation, s_translation = s.split(3, dim=1)
        log_weight = 0.5 if is_laplace else 1.0
        rotation_error = (
            0.5 * _inverse_scale(s_rotation) * rotation_error + 0.5 * s_rotation
        )
        translation_error = (
            0.5 * _inverse_scale(s_translation) * translation_error
            + log_weight * s_translation
        )
    return {
        "rotation": rotation_error.mean(),
        "translation": translation_error.mean(),
    }


def _has_depth(targets: LossTargets) -> torch.Tensor:
    return torch.isfinite(targets.depth_prev) & (targets.depth_prev > 0)


def _flow_loss(
    flow: torch.Tensor,
    is_defined: torch.Tensor,
    targets: LossTargets,
    s: Scales,
    limit_px: float,
) -> torch.Tensor:
    """L^F; with log scales weighted by 1 / U^F."""
    target = targets.ego_flow
    is_known = _has_depth(targets) & torch.isfinite(target).all(dim=1)
    error = (flow - torch.where(is_known[:, None], target, 0.0)).abs()
    counts = (is_defined & is_known)[:, None] & (error < limit_px)
    is_behind = (is_known & ~is_defined)[:, None]
    error = torch.where(counts, error, 0.0) + is_behind * limit_px
    if s is None:
        return 0.5 * error.sum() / ranks.divisor(is_known.sum())
    # rx, ry, rz and tz move both components, tx and ty one of them
    error_u, error_v = error.unbind(1)
    both = error_u + error_v
    errors = torch.stack([both, both, both, error_u, error_v, both], dim=1)
    log_weights = s.new_tensor([1.0, 1.0, 1.0, 0.5, 0.5, 1.0])[:, None, None]
    return _scaled_loss(errors, is_known, FLOW_EXPONENT * s, log_weights)


def _depth_loss(
    depth: torch.Tensor, targets: LossTargets, s: Scales
) -> torch.Tensor:
    """L^D of inverse depths; with log scales weighted by 1 / U^D."""
    target = targets.depth_curr
    is_known = _has_depth(targets) & torch.isfinite(target)
    is_known &= target >= MIN_DEPTH
    target = torch.where(is_known, target, 1.0)
    in_front = depth >= MIN_DEPTH
    difference = 1.0 / target - 1.0 / torch.where(in_front, depth, 1.0)
    # behind the camera its linearisation, which is finite
    linear = (target - depth) / target.square()
    error = torch.where(in_front, difference, linear).abs()
    error = torch.where(is_known, error, 0.0)
    if s is None:
        return error.sum() / ranks.divisor(is_known.sum())
    s_depth = DEPTH_EXPONENT * s[:, list(DEPTH_CHANNELS)]
    return _scaled_loss(error[:, None], is_known, s_depth, 0.5)


def _scaled_loss(
    error: torch.Tensor,
    is_known: torch.Tensor,
    s: torch.Tensor,
    log_weight: torch.Tensor | float,
) -> torch.Tensor:
    """Mean over the known pixels of 0.5 error / exp(s) + log_weight s.

    Errors are (B, C, h, w). Log scales may have a coarser grid.
    """
    side = -(-error.shape[2] // s.shape[2])
    missing_columns = s.shape[3] * side - error.shape[3]
    missing_rows = s.shape[2] * side - error.shape[2]
    pad = (0, missing_columns, 0, missing_rows)

    def sum_of_cells(x: torch.Tensor) -> torch.Tensor:
        return F.avg_pool2d(F.pad(x.to(s.dtype), pad), side) * side**2

    errors = sum_of_cells(error)
    pixels = sum_of_cells(is_known[:, None])
    loss = 0.5 * _inverse_scale(s) * errors + log_weight * s * pixels
    return loss.sum() / ranks.divisor(is_known.sum())
