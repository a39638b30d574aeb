"""Losses of PWVO and its baselines (paper, sections 3.2.2 and 3.4) in log form.

Four terms, each plain or weighed by uncertainty, with s = log U:

* rotation L^R and translation L^T: every pixel must name the pair's motion (distribution learning);
* ego flow L^F and depth L^D: the *selected* motion, applied to the true depth, must reproduce the
  flow and the next depth that the camera motion alone causes.

The supplement that defines L^F and L^D is not public. ``form="published"`` computes what the
published code computes, with these two departures: pixels without depth, and points that the motion
brings behind the camera, are left out instead of projected through an absolute value; and s may
have a coarser grid than the flow, where each cell answers for its pixels.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, fields, replace
from typing import Any

import torch
import torch.nn.functional as F
from kornia.geometry.camera import project_points
from kornia.geometry.depth import depth_to_3d_v2
from kornia.geometry.linalg import transform_points

from hybridvo.errors import InputError
from hybridvo.network.inputs import subsampled_intrinsics
from hybridvo.types import PixelwisePrediction

__all__ = ["LossOptions", "LossTargets", "NetworkOutput", "reconstruct", "total_loss"]

NetworkOutput = PixelwisePrediction | tuple[torch.Tensor, torch.Tensor]
"""What a network returns: maps, or (rotation_deg (B, 3), translation (B, 3)) of a VONet."""

FORMS = ("published", "paper")

EPSILON = 1e-12
"""Added under square roots, as published: their gradient stays finite at zero."""

LARGEST_EXPONENT = 30.0
"""exp(-s) goes on as a straight line beyond this."""

NEAREST_DEPTH = 1e-2
"""Metres; points that end nearer to the camera, or behind it, are left out of L^F and L^D."""

FLOW_COUPLING = (0, 1, 2, 5)
"""Components whose s weighs both components of the flow error: rx, ry, rz, tz. The other two, tx
and ty, weigh the horizontal and the vertical error only."""

DEPTH_COUPLING = (0, 1, 5)
"""Components whose s weighs L^D: rx, ry and tz change the depth of a point."""


@dataclass(frozen=True)
class LossOptions:
    """Which terms are on, and how.

    Args:
        pose: L^R and L^T.
        pose_uncertainty: weigh them by U^R and U^T (distribution learning); off for VONet and for
            the paper's "pixel-wise" row.
        flow, depth: L^F and L^D.
        flow_uncertainty, depth_uncertainty: weigh them by U^F and U^D, which are exp of
            ``flow_log_scale`` and ``depth_log_scale`` times s.
        rotation_weight, translation_weight, flow_weight, depth_weight: factors of the four terms.
        form: ``published`` (published code: the data terms are halved, s^T is not) or ``paper``
            (printed equations: no halving, and the text's L2 norm of the flow error).
        flow_limit_px: flow errors of a component at or above this do not count. ``inf``: all do.
        flow_log_scale, depth_log_scale: factors that make U^F and U^D of s.
        direction_floor: metres; below this length of the translation its direction fades out.
            1e-6 as published; larger values calm the gradient near zero translation, which grows
            with 1 / length.

    Raises:
        InputError: a value that cannot be meant.
    """

    pose: bool = True
    pose_uncertainty: bool = True
    flow: bool = True
    depth: bool = True
    flow_uncertainty: bool = True
    depth_uncertainty: bool = True
    rotation_weight: float = 1.0
    translation_weight: float = 1.0
    flow_weight: float = 1.0
    depth_weight: float = 1.0
    form: str = "published"
    flow_limit_px: float = 20.0
    flow_log_scale: float = 0.1
    depth_log_scale: float = 0.25
    direction_floor: float = 1e-6

    def __post_init__(self) -> None:
        if self.form not in FORMS:
            raise InputError(f"LossOptions.form: {self.form!r} unknown; known: {', '.join(FORMS)}.")
        for field in fields(self):
            value = getattr(self, field.name)
            if field.type == "bool" and not isinstance(value, bool):
                raise InputError(f"LossOptions.{field.name}: expected a bool, got {value!r}.")
            if field.type == "float":
                number = isinstance(value, int | float) and not isinstance(value, bool)
                finite = number and (math.isfinite(value) or field.name == "flow_limit_px")
                if not finite or not value >= 0:
                    raise InputError(
                        f"LossOptions.{field.name}: expected a number >= 0, got {value!r}."
                    )
        if not (self.pose or self.flow or self.depth):
            raise InputError("LossOptions: every term is off; nothing is left to learn from.")
        if self.direction_floor == 0 or self.flow_limit_px == 0:
            raise InputError("LossOptions: direction_floor and flow_limit_px must be above 0.")

    @property
    def reconstructs(self) -> bool:
        """Whether a term needs the selected transform."""
        return self.flow or self.depth

    @property
    def needs_uncertainty(self) -> bool:
        """Whether a term needs the network's log scales."""
        return (
            (self.pose and self.pose_uncertainty)
            or (self.flow and self.flow_uncertainty)
            or (self.depth and self.depth_uncertainty)
        )


@dataclass(frozen=True, eq=False)
class LossTargets:
    """The truth of a batch, at the network's input size (h, w).

    Args:
        rotation_deg: (B, 3) Euler angles X-Y-Z in degrees of T_curr_prev.
        translation: (B, 3) metres.
        ego_flow: (B, 2, h, w) px, flow that the camera motion alone causes.
        depth_prev: (B, h, w) metres; not finite or not positive is invalid.
        depth_curr: (B, h, w) metres, next depth of the same scene point on the grid of t.
        K_prev, K_curr: (B, 3, 3).
        valid: (B, h, w) bool, pixels that count in L^F and L^D, or None for all.
    """

    rotation_deg: torch.Tensor
    translation: torch.Tensor
    ego_flow: torch.Tensor
    depth_prev: torch.Tensor
    depth_curr: torch.Tensor
    K_prev: torch.Tensor
    K_curr: torch.Tensor
    valid: torch.Tensor | None = None

    def subsample(self, stride: int) -> LossTargets:
        """The picture of every ``stride``-th pixel of every ``stride``-th row, in its own pixels.

        A cheap form of L^F and L^D: they fix six numbers a pair, which need not all of its pixels.
        """
        if stride == 1:
            return self
        first = stride // 2
        pick = (..., slice(first, None, stride), slice(first, None, stride))
        return replace(
            self,
            ego_flow=self.ego_flow[pick] / stride,
            depth_prev=self.depth_prev[pick],
            depth_curr=self.depth_curr[pick],
            K_prev=subsampled_intrinsics(self.K_prev, stride),
            K_curr=subsampled_intrinsics(self.K_curr, stride),
            valid=None if self.valid is None else self.valid[pick],
        )

    def to(self, *args: object, **kwargs: object) -> LossTargets:
        """Copy on another device, or of another floating-point type; the mask stays boolean."""
        moved: dict[str, Any] = {}
        for field in fields(self):
            value = getattr(self, field.name)
            moved[field.name] = None if value is None else value.to(*args, **kwargs)
        if moved["valid"] is not None:
            moved["valid"] = moved["valid"].bool()
        return LossTargets(**moved)


def reconstruct(
    depth_prev: torch.Tensor,
    T_curr_prev: torch.Tensor,
    K_prev: torch.Tensor,
    K_curr: torch.Tensor,
) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """Flow and depth that a camera motion causes (paper, equation 8), differentiable.

    F_ego = pi(K_curr, T_curr_prev D K_prev^-1 x) - x, and the depth of the moved point, on the grid
    of the previous frame. With the true motion it makes the targets of :class:`LossTargets`.

    Args:
        depth_prev: (B, h, w) metres.
        T_curr_prev: (B, 4, 4).
        K_prev: (B, 3, 3) intrinsics of the previous camera.
        K_curr: (B, 3, 3) intrinsics of the current camera.

    Returns:
        (B, 2, h, w) ego flow in px, (B, h, w) depth in metres, and (B, h, w) bool, where both are
        defined: valid depth, and a moved point at least 1 cm in front of the camera. Elsewhere the
        flow is finite and means nothing, and the depth is 1.
    """
    valid = torch.isfinite(depth_prev) & (depth_prev > 0)
    depth = torch.where(valid, depth_prev, torch.ones_like(depth_prev))
    batch, height, width = depth.shape
    with torch.autocast(depth.device.type, enabled=False):
        points = depth_to_3d_v2(depth, K_prev)
        moved = transform_points(T_curr_prev, points.reshape(batch, -1, 3))
        moved = moved.view(batch, height, width, 3)
        valid = valid & (moved[..., 2] >= NEAREST_DEPTH)
        # Replaced before the division: a masked quotient would still give NaN gradients.
        z = torch.where(valid, moved[..., 2], torch.ones_like(depth))
        pixels = project_points(
            torch.cat([moved[..., :2], z[..., None]], dim=-1), K_curr[:, None, None]
        )
    v = torch.arange(height, dtype=depth.dtype, device=depth.device)[:, None]
    u = torch.arange(width, dtype=depth.dtype, device=depth.device)
    flow = torch.stack([pixels[..., 0] - u, pixels[..., 1] - v], dim=1)
    return flow, z, valid


def total_loss(
    output: NetworkOutput,
    targets: LossTargets,
    options: LossOptions | None = None,
    T_curr_prev: torch.Tensor | None = None,
) -> tuple[torch.Tensor, dict[str, torch.Tensor]]:
    """Weighted sum of the terms that are on.

    Args:
        output: of a network.
        targets: the truth.
        options: which terms; the paper's PWVO by default. Outputs without uncertainty (VONet,
            pixel-wise) need the three ``*_uncertainty`` switches off.
        T_curr_prev: (B, 4, 4) the selected motion, as ``hybridvo.network.selection`` gives it:
            ``selected_transform(*select(prediction))``, for a VONet
            ``selected_transform(*output)``. Needed by L^F and L^D only.

    Returns:
        Scalar loss, and its unweighted terms without gradient under ``rotation``, ``translation``,
        ``flow`` and ``depth``.

    Raises:
        InputError: the selected motion or the uncertainty is missing, or shapes do not fit.

    Example:
        rotation_deg, translation = select(prediction)
        T = selected_transform(rotation_deg, translation)
        loss, parts = total_loss(prediction, targets, LossOptions(), T)
    """
    options = LossOptions() if options is None else options
    log_scale = _check(output, targets, options, T_curr_prev)
    parts: dict[str, torch.Tensor] = {}
    if options.pose:
        if isinstance(output, PixelwisePrediction):
            s_rotation, s_translation = None, None
            if log_scale is not None and options.pose_uncertainty:
                s_rotation, s_translation = log_scale[:, :3], log_scale[:, 3:]
            parts["rotation"] = _rotation_loss(
                output.rotation, targets.rotation_deg, s_rotation, options
            )
            parts["translation"] = _translation_loss(
                output.translation, targets.translation, s_translation, options
            )
        else:
            parts["rotation"] = (output[0] - targets.rotation_deg).abs().mean()
            parts["translation"] = (output[1] - targets.translation).abs().mean()
    if options.reconstructs and T_curr_prev is not None:
        flow, depth, defined = reconstruct(
            targets.depth_prev, T_curr_prev, targets.K_prev, targets.K_curr
        )
        if targets.valid is not None:
            defined = defined & targets.valid
        if options.flow:
            s = log_scale if options.flow_uncertainty else None
            parts["flow"] = _flow_loss(flow, targets.ego_flow, defined, s, options)
        if options.depth:
            s = log_scale if options.depth_uncertainty else None
            parts["depth"] = _depth_loss(depth, targets.depth_curr, defined, s, options)
    loss = torch.stack(
        [getattr(options, f"{name}_weight") * part for name, part in parts.items()]
    ).sum()
    return loss, {name: part.detach() for name, part in parts.items()}


def _inverse_scale(s: torch.Tensor) -> torch.Tensor:
    """exp(-s), continued as a straight line for very negative s: finite, with a gradient."""
    bounded = (-s).clamp(max=LARGEST_EXPONENT)
    return bounded.exp() * (1 + (-s - bounded))


def _norm(x: torch.Tensor, dim: int) -> torch.Tensor:
    return (x.square().sum(dim=dim, keepdim=True) + EPSILON).sqrt()


def _direction(x: torch.Tensor, dim: int, floor: float) -> torch.Tensor:
    return x * x.square().sum(dim=dim, keepdim=True).clamp(min=floor**2).rsqrt()


def _rotation_loss(
    rotation: torch.Tensor, target: torch.Tensor, s: torch.Tensor | None, options: LossOptions
) -> torch.Tensor:
    error = (target[:, :, None, None] - rotation).abs()
    if s is None:
        return error.mean()
    data, scale = (_inverse_scale(s) * error).mean(), s.mean()
    return data + scale if options.form == "paper" else 0.5 * (data + scale)


def _translation_loss(
    translation: torch.Tensor, target: torch.Tensor, s: torch.Tensor | None, options: LossOptions
) -> torch.Tensor:
    target = target[:, :, None, None]
    floor = options.direction_floor
    length = (_norm(target, 1) - _norm(translation, 1)).square()
    difference = _direction(target, 1, floor) - _direction(translation, 1, floor)
    error = length + _norm(difference, 1)
    if s is None:
        return error.mean()
    # One error per pixel against the three channels of s.
    data = (_inverse_scale(s) * error).mean()
    return (data if options.form == "paper" else 0.5 * data) + s.mean()


def _to_cells(x: torch.Tensor, cells: torch.Size) -> torch.Tensor:
    """Sum of a (B, h, w) map over the pixels of each cell of a coarser grid ``cells``."""
    height, width = x.shape[1:]
    side = -(-height // cells[0])
    if side == 1:
        return x
    x = F.pad(x, (0, cells[1] * side - width, 0, cells[0] * side - height))
    return F.avg_pool2d(x[:, None], side)[:, 0] * side**2


def _masked_mean(x: torch.Tensor, mask: torch.Tensor) -> torch.Tensor:
    return torch.where(mask, x, torch.zeros_like(x)).sum() / mask.sum().clamp(min=1)


def _flow_loss(
    flow: torch.Tensor,
    target: torch.Tensor,
    defined: torch.Tensor,
    s: torch.Tensor | None,
    options: LossOptions,
) -> torch.Tensor:
    """L^F; with s (B, 6, ..) weighed by 1 / U^F = exp(-0.1 s) as the coupling says."""
    defined = defined & torch.isfinite(target).all(dim=1)
    target = torch.where(defined[:, None], target, torch.zeros_like(target))
    difference = flow - target
    error = difference.abs()
    counts = defined[:, None] & (error < options.flow_limit_px)
    error = torch.where(counts, error, torch.zeros_like(error))
    if options.form == "paper":
        kept = torch.where(counts, difference, torch.zeros_like(difference))
        # The L2 norm of the text, half of it to each component.
        error = (_norm(kept, 1) - EPSILON**0.5).expand(-1, 2, -1, -1) / 2
    if s is None:
        total = _masked_mean(error[:, 0], defined) + _masked_mean(error[:, 1], defined)
        return total if options.form == "paper" else 0.5 * total
    count = defined.sum().clamp(min=1)
    a, b = (_to_cells(torch.where(defined, e, 0.0), s.shape[2:]) for e in error.unbind(1))
    pixels = _to_cells(defined.to(s.dtype), s.shape[2:])
    s = options.flow_log_scale * s
    inverse = _inverse_scale(s)
    data = (inverse[:, FLOW_COUPLING] * (a + b)[:, None]).sum()
    data = data + (inverse[:, 3] * a + inverse[:, 4] * b).sum()
    scale = (s[:, FLOW_COUPLING] * pixels[:, None]).sum()
    scale = scale + 0.5 * ((s[:, 3] + s[:, 4]) * pixels).sum()
    return (0.5 * data + scale) / count


def _depth_loss(
    depth: torch.Tensor,
    target: torch.Tensor,
    defined: torch.Tensor,
    s: torch.Tensor | None,
    options: LossOptions,
) -> torch.Tensor:
    """L^D, on inverse depth as published; ``paper``: on depth."""
    defined = defined & torch.isfinite(target) & (target >= NEAREST_DEPTH)
    target = torch.where(defined, target, torch.ones_like(target))
    depth = torch.where(defined, depth, torch.ones_like(depth))
    if options.form == "paper":
        error = (target - depth).abs()
    else:
        error = (1.0 / target - 1.0 / depth).abs()
    if s is None:
        return _masked_mean(error, defined)
    count = defined.sum().clamp(min=1)
    cells = _to_cells(torch.where(defined, error, 0.0), s.shape[2:])
    pixels = _to_cells(defined.to(s.dtype), s.shape[2:])
    s = options.depth_log_scale * s[:, DEPTH_COUPLING]
    return 0.5 * (_inverse_scale(s) * cells[:, None] + s * pixels[:, None]).sum() / count


def _check(
    output: NetworkOutput,
    targets: LossTargets,
    options: LossOptions,
    T_curr_prev: torch.Tensor | None,
) -> torch.Tensor | None:
    """Shapes at the door; the log scales as (B, 6, h, w) where the options use them."""
    batch, height, width = targets.depth_prev.shape
    if options.reconstructs:
        if T_curr_prev is None:
            raise InputError(
                "total_loss: L^F and L^D need T_curr_prev, the selected motion: pass "
                "selected_transform(*select(prediction)), or switch flow and depth off."
            )
        if tuple(T_curr_prev.shape) != (batch, 4, 4):
            raise InputError(
                f"total_loss: expected T_curr_prev of shape {(batch, 4, 4)} to match the targets, "
                f"got {tuple(T_curr_prev.shape)}."
            )
        if tuple(targets.ego_flow.shape) != (batch, 2, height, width):
            raise InputError(
                f"LossTargets.ego_flow: expected shape {(batch, 2, height, width)}, got "
                f"{tuple(targets.ego_flow.shape)}."
            )
    rotation = output.rotation if isinstance(output, PixelwisePrediction) else output[0]
    if rotation.shape[:2] != targets.rotation_deg.shape:
        raise InputError(
            f"total_loss: the output is of {tuple(rotation.shape)}, the targets' rotation of "
            f"{tuple(targets.rotation_deg.shape)}; expected (B, 3, ...) and (B, 3)."
        )
    scales = None
    if isinstance(output, PixelwisePrediction):
        scales = (output.log_scale_rotation, output.log_scale_translation)
    if not options.needs_uncertainty:
        return None
    if scales is None or scales[0] is None or scales[1] is None:
        raise InputError(
            "total_loss: the network's output has no uncertainty. Set pose_uncertainty, "
            "flow_uncertainty and depth_uncertainty to False."
        )
    log_scale = torch.cat([scales[0], scales[1]], dim=1)
    cells = log_scale.shape[2:]
    side = -(-height // cells[0])
    per_pixel = (options.flow and options.flow_uncertainty) or (
        options.depth and options.depth_uncertainty
    )
    if per_pixel and (-(-height // side), -(-width // side)) != tuple(cells):
        raise InputError(
            f"total_loss: a prediction of {tuple(cells)} does not divide the targets' size "
            f"{(height, width)} evenly; expected the network's input size or half of it."
        )
    return log_scale
