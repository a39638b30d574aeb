"""Losses of PWVO and its baselines (paper, sections 3.2.2 and 3.4) in log form, s = log U.

Rotation L^R and translation L^T: every pixel must name the pair's motion. Ego flow L^F and depth
L^D: the *selected* motion, applied to the true depth, must reproduce what the camera motion causes.
As published, but without pixels of no depth, and a point brought behind the camera is charged.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Literal

import torch
import torch.nn.functional as F
from pydantic import Field

from hybridvo.network.inputs import MIN_DEPTH, TensorBatch
from hybridvo.options import Positive, option_group
from hybridvo.results import PixelwisePrediction
from hybridvo.torch_geometry import pixel_grid, reproject

Scales = torch.Tensor | None
MAX_EXPONENT = 30.0  # exp(-s) goes on as a straight line beyond this


@option_group
class LossOptions:
    """Which terms are on, and how."""

    # weigh L^R and L^T by U^R and U^T (distribution learning)
    pose_uncertainty: bool = True
    flow: bool = True
    depth: bool = True
    flow_uncertainty: bool = True  # weigh L^F by U^F = exp(0.1 s), as published
    depth_uncertainty: bool = True  # weigh L^D by U^D = exp(0.25 s)
    flow_weight: Annotated[float, Field(ge=0)] = 1.0
    # direction (the paper's: direction and length), or laplace: L1 of each component in metres with
    # its own s, so that exp(s) is in metres
    translation_form: Literal["direction", "laplace"] = "direction"
    # errors of a component at or above this do not count
    flow_limit_px: Positive = 20.0
    # metres; below this length of the translation its direction fades out: larger values than the
    # published one calm the gradient near zero translation
    direction_floor: Positive = 1e-6

    @property
    def needs_uncertainty(self) -> bool:
        """Whether a term needs the network's log scales."""
        flow = self.flow and self.flow_uncertainty
        depth = self.depth and self.depth_uncertainty
        return self.pose_uncertainty or flow or depth


@dataclass(frozen=True, eq=False)
class LossTargets(TensorBatch):
    """Ground truth of a batch, at the network's input size (h, w)."""

    # (B, 6) Euler angles X-Y-Z in degrees, then metres, of T_curr_prev
    motion: torch.Tensor
    # (B, 2, h, w) px by the camera motion alone; NaN does not count
    ego_flow: torch.Tensor
    depth_prev: torch.Tensor  # (B, h, w) metres of the same scene points,
    depth_curr: torch.Tensor  # both on the previous grid
    K_prev: torch.Tensor  # (B, 3, 3)
    K_curr: torch.Tensor

    def reconstruct(
        self, T: torch.Tensor
    ) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
        """Ego flow (B, 2, h, w), depth and validity (B, h, w) by a motion, as of ``reproject``."""
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
    """Weighted sum of the terms that are on, L^F and L^D of the selected motion (B, 4, 4); and
    they, unweighted and without gradient: rotation, translation, flow, depth.
    """
    s = output.log_scale
    parts = _pose_losses(
        output.motion, targets, s if options.pose_uncertainty else None, options
    )
    flow, depth, defined = targets.reconstruct(T_curr_prev)
    if options.flow:
        s_flow = s if options.flow_uncertainty else None
        parts["flow"] = _flow_loss(
            flow, defined, targets, s_flow, options.flow_limit_px
        )
    if options.depth:
        s_depth = s if options.depth_uncertainty else None
        parts["depth"] = _depth_loss(depth, targets, s_depth)
    loss = sum(
        (options.flow_weight if k == "flow" else 1.0) * x for k, x in parts.items()
    )
    return torch.as_tensor(loss), {
        name: part.detach() for name, part in parts.items()
    }


def _inverse_scale(s: torch.Tensor) -> torch.Tensor:
    """exp(-s), continued as a straight line for very negative s: finite, with a gradient."""
    bounded = (-s).clamp(max=MAX_EXPONENT)
    return bounded.exp() * (1 + (-s - bounded))


def _norm(x: torch.Tensor) -> torch.Tensor:
    # 1e-12 as published: the gradient stays finite at zero
    return (x.square().sum(dim=1, keepdim=True) + 1e-12).sqrt()


def _pose_losses(
    motion: torch.Tensor, targets: LossTargets, s: Scales, options: LossOptions
) -> dict[str, torch.Tensor]:
    """L^R and L^T of maps (B, 6, h, w), weighed by s unless it is None; as published."""
    true = targets.motion[:, :, None, None]
    errors = list((motion - true).abs().split(3, dim=1))
    # VONet, which names one motion: plain L1
    laplace = options.translation_form == "laplace" or motion.shape[2:] == (1, 1)
    if not laplace:
        found = motion[:, 3:]
        t = true[:, 3:]
        turn = [
            x
            * x.square()
            .sum(dim=1, keepdim=True)
            .clamp(min=options.direction_floor**2)
            .rsqrt()
            for x in (t, found)
        ]
        errors[1] = (_norm(t) - _norm(found)).square() + _norm(turn[0] - turn[1])
    if s is not None:
        halves = zip(
            errors, s.split(3, dim=1), (0.5, 0.5 if laplace else 1.0), strict=True
        )
        errors = [
            0.5 * _inverse_scale(x) * error + half * x for error, x, half in halves
        ]
    return {"rotation": errors[0].mean(), "translation": errors[1].mean()}


def _has_depth(targets: LossTargets) -> torch.Tensor:
    return torch.isfinite(targets.depth_prev) & (targets.depth_prev > 0)


def _flow_loss(
    flow: torch.Tensor,
    defined: torch.Tensor,
    targets: LossTargets,
    s: Scales,
    limit_px: float,
) -> torch.Tensor:
    """L^F; with s (B, 6, ..) weighed by 1 / U^F = exp(-0.1 s)."""
    target = targets.ego_flow
    known = _has_depth(targets) & torch.isfinite(target).all(dim=1)
    error = (flow - torch.where(known[:, None], target, 0.0)).abs()
    counts = (defined & known)[:, None] & (error < limit_px)
    error = torch.where(counts, error, 0.0) + (known & ~defined)[:, None] * limit_px
    if s is None:
        return 0.5 * error.sum() / known.sum().clamp(min=1)
    # rx, ry, rz and tz move both components, tx and ty one of them
    a, b = error.unbind(1)
    share = s.new_tensor([1.0, 1.0, 1.0, 0.5, 0.5, 1.0])[:, None, None]
    return _weighed(
        torch.stack([a + b, a + b, a + b, a, b, a + b], dim=1),
        known,
        0.1 * s,
        share,
    )


def _depth_loss(
    depth: torch.Tensor, targets: LossTargets, s: Scales
) -> torch.Tensor:
    """L^D of inverse depths; with s (B, 6, ..) weighed by 1 / U^D = exp(-0.25 s)."""
    target = targets.depth_curr
    known = _has_depth(targets) & torch.isfinite(target) & (target >= MIN_DEPTH)
    target = torch.where(known, target, 1.0)
    front = depth >= MIN_DEPTH
    exact = 1.0 / target - 1.0 / torch.where(front, depth, 1.0)
    # finite behind the camera
    error = torch.where(front, exact, (target - depth) / target.square()).abs()
    error = torch.where(known, error, 0.0)
    if s is None:
        return error.sum() / known.sum().clamp(min=1)
    # only rx, ry and tz change a depth
    return _weighed(error[:, None], known, 0.25 * s[:, [0, 1, 5]], 0.5)


def _weighed(
    error: torch.Tensor,
    known: torch.Tensor,
    s: torch.Tensor,
    share: torch.Tensor | float,
) -> torch.Tensor:
    """Errors (B, C, h, w) over their scales exp(s), which may have a coarser grid, plus s."""
    side = -(-error.shape[2] // s.shape[2])
    pad = (
        0,
        s.shape[3] * side - error.shape[3],
        0,
        s.shape[2] * side - error.shape[2],
    )
    # sums over the pixels of each cell
    error, pixels = (
        F.avg_pool2d(F.pad(x.to(s.dtype), pad), side) * side**2
        for x in (error, known[:, None])
    )
    return (
        0.5 * _inverse_scale(s) * error + share * s * pixels
    ).sum() / known.sum().clamp(min=1)
