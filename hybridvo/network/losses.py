"""Losses of PWVO and its baselines (paper, sections 3.2.2 and 3.4) in log form.

Four terms, each plain or weighed by uncertainty, with s = log U:

* rotation L^R and translation L^T: every pixel must name the pair's motion (distribution learning);
* ego flow L^F and depth L^D: the *selected* motion, applied to the true depth, must reproduce the
  flow and the next depth that the camera motion alone causes.

They are those of the published code, with three departures: pixels without depth are left out; a
point that the motion brings behind the camera is charged instead of projected through an absolute
value; and s may have a coarser grid than the flow, where each cell answers for its pixels.
"""

from __future__ import annotations

from dataclasses import dataclass, fields, replace

import torch
import torch.nn.functional as F
from kornia.geometry.camera import project_points
from kornia.geometry.depth import depth_to_3d_v2
from kornia.geometry.linalg import transform_points

from hybridvo.errors import InputError
from hybridvo.network.inputs import subsampled_intrinsics
from hybridvo.results import PixelwisePrediction

NetworkOutput = PixelwisePrediction | tuple[torch.Tensor, torch.Tensor]
"""What a network returns: maps, or (rotation_deg (B, 3), translation (B, 3)) of a VONet."""

EPSILON = 1e-12
"""Added under square roots, as published: their gradient stays finite at zero."""

MAX_EXPONENT = 30.0
"""exp(-s) goes on as a straight line beyond this."""

MIN_LAPLACE_LOG_SCALE = -11.5
"""log metres; a scale below 1e-5 m means nothing."""

MIN_DEPTH = 1e-2
"""Metres; a point nearer to the camera counts as behind it."""

MAX_BEHIND_PX = 20.0
"""Flow error that a point behind the camera is charged where ``flow_limit_px`` is infinite."""

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
        translation_form: ``direction`` (the paper's: direction and length) or ``laplace`` (L1 of
            each component in metres with its own s, so that exp(s) is in metres).
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
    translation_form: str = "direction"
    flow_limit_px: float = 20.0
    flow_log_scale: float = 0.1
    depth_log_scale: float = 0.25
    direction_floor: float = 1e-6

    def __post_init__(self) -> None:
        if self.translation_form not in ("direction", "laplace"):
            raise InputError(
                f"LossOptions.translation_form: expected direction or laplace, got "
                f"{self.translation_form!r}."
            )
        for name, value in vars(self).items():
            if isinstance(value, float) and not 0 <= value <= (
                float("inf") if name == "flow_limit_px" else 1e6
            ):
                raise InputError(f"LossOptions.{name}: expected 0 to 1e6, got {value}.")
        if not (self.pose or self.flow or self.depth):
            raise InputError("LossOptions: every term is off; nothing is left to learn from.")
        if self.direction_floor == 0 or self.flow_limit_px == 0:
            raise InputError("LossOptions: expected direction_floor and flow_limit_px above 0.")

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
    """Ground truth of a batch, at the network's input size (h, w).

    Args:
        rotation_deg: (B, 3) Euler angles X-Y-Z in degrees of T_curr_prev.
        translation: (B, 3) metres.
        ego_flow: (B, 2, h, w) px, flow that the camera motion alone causes; NaN does not count.
        depth_prev: (B, h, w) metres; not finite or not positive is invalid.
        depth_curr: (B, h, w) metres, next depth of the same scene point on the grid of t.
        K_prev, K_curr: (B, 3, 3).
    """

    rotation_deg: torch.Tensor
    translation: torch.Tensor
    ego_flow: torch.Tensor
    depth_prev: torch.Tensor
    depth_curr: torch.Tensor
    K_prev: torch.Tensor
    K_curr: torch.Tensor

    def subsample(self, stride: int) -> LossTargets:
        """The image of every ``stride``-th pixel of every ``stride``-th row, in its own pixels.

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
        )

    def to(self, *args: object, **kwargs: object) -> LossTargets:
        """Copy on another device, or of another floating-point type."""
        return LossTargets(*(getattr(self, f.name).to(*args, **kwargs) for f in fields(self)))


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
        (B, 2, h, w) ego flow in px, (B, h, w) depth in metres (below ``MIN_DEPTH`` behind the
        camera, 1 where ``depth_prev`` is invalid), and (B, h, w) bool: valid depth, and the moved
        point in front of the camera. Elsewhere the flow is finite and means nothing.
    """
    valid = torch.isfinite(depth_prev) & (depth_prev > 0)
    depth = torch.where(valid, depth_prev, torch.ones_like(depth_prev))
    batch, height, width = depth.shape
    with torch.autocast(depth.device.type, enabled=False):
        points = depth_to_3d_v2(depth, K_prev)
        moved = transform_points(T_curr_prev, points.reshape(batch, -1, 3))
        moved = moved.view(batch, height, width, 3)
        z = torch.where(valid, moved[..., 2], torch.ones_like(depth))
        front = z >= MIN_DEPTH
        # Replaced before the division: a masked quotient would still give NaN gradients.
        safe = torch.where(front, z, torch.ones_like(depth))
        pixels = project_points(
            torch.cat([moved[..., :2], safe[..., None]], dim=-1), K_curr[:, None, None]
        )
    v = torch.arange(height, dtype=depth.dtype, device=depth.device)[:, None]
    u = torch.arange(width, dtype=depth.dtype, device=depth.device)
    flow = torch.stack([pixels[..., 0] - u, pixels[..., 1] - v], dim=1)
    return flow, z, valid & front


def total_loss(
    output: NetworkOutput,
    targets: LossTargets,
    options: LossOptions = LossOptions(),
    T_curr_prev: torch.Tensor | None = None,
) -> tuple[torch.Tensor, dict[str, torch.Tensor]]:
    """Weighted sum of the terms that are on.

    Args:
        output: of a network.
        targets: ground truth.
        options: which terms; the paper's PWVO by default. Outputs without uncertainty (VONet,
            pixel-wise) need the three ``*_uncertainty`` switches off.
        T_curr_prev: (B, 4, 4) the selected motion; needed by L^F and L^D only.

    Returns:
        Scalar loss, and its unweighted terms without gradient under ``rotation``, ``translation``,
        ``flow`` and ``depth``.

    Raises:
        InputError: the selected motion or the uncertainty is missing, or shapes do not fit.
    """
    s = _log_scales(output, targets, options) if options.needs_uncertainty else None
    parts: dict[str, torch.Tensor] = {}
    if options.pose and isinstance(output, PixelwisePrediction):
        s_pose = s if options.pose_uncertainty else None
        parts |= _pose_losses(output, targets, s_pose, options)
    elif options.pose and isinstance(output, tuple):
        parts["rotation"] = (output[0] - targets.rotation_deg).abs().mean()
        parts["translation"] = (output[1] - targets.translation).abs().mean()
    if options.reconstructs:
        if T_curr_prev is None or T_curr_prev.shape != (len(targets.depth_prev), 4, 4):
            got = None if T_curr_prev is None else tuple(T_curr_prev.shape)
            raise InputError(
                f"total_loss: expected T_curr_prev, the selected motion, of shape "
                f"({len(targets.depth_prev)}, 4, 4) for L^F and L^D, got {got}."
            )
        flow, depth, defined = reconstruct(
            targets.depth_prev, T_curr_prev, targets.K_prev, targets.K_curr
        )
        known = torch.isfinite(targets.depth_prev) & (targets.depth_prev > 0)
        if options.flow:
            s_flow = s if options.flow_uncertainty else None
            error = (flow, targets.ego_flow, defined, known)
            parts["flow"] = _flow_loss(*error, s_flow, options)
        if options.depth:
            s_depth = s if options.depth_uncertainty else None
            parts["depth"] = _depth_loss(depth, targets.depth_curr, known, s_depth, options)
    loss = torch.stack(
        [getattr(options, f"{name}_weight") * part for name, part in parts.items()]
    ).sum()
    return loss, {name: part.detach() for name, part in parts.items()}


def _log_scales(output: NetworkOutput, targets: LossTargets, options: LossOptions) -> torch.Tensor:
    """(B, 6, h, w) log scales of an output that the options weigh by."""
    if (
        not isinstance(output, PixelwisePrediction)
        or output.log_scale_rotation is None
        or output.log_scale_translation is None
    ):
        raise InputError(
            "total_loss: the network's output has no uncertainty. Set pose_uncertainty, "
            "flow_uncertainty and depth_uncertainty to False."
        )
    s = torch.cat([output.log_scale_rotation, output.log_scale_translation], dim=1)
    height, width = targets.depth_prev.shape[1:]
    side = -(-height // s.shape[2])
    weighs_pixels = (options.flow and options.flow_uncertainty) or (
        options.depth and options.depth_uncertainty
    )
    if weighs_pixels and (-(-height // side), -(-width // side)) != tuple(s.shape[2:]):
        raise InputError(
            f"total_loss: expected a prediction that divides the targets' size {(height, width)} "
            f"evenly, got {tuple(s.shape[2:])}."
        )
    return s


def _inverse_scale(s: torch.Tensor) -> torch.Tensor:
    """exp(-s), continued as a straight line for very negative s: finite, with a gradient."""
    bounded = (-s).clamp(max=MAX_EXPONENT)
    return bounded.exp() * (1 + (-s - bounded))


def _norm(x: torch.Tensor) -> torch.Tensor:
    return (x.square().sum(dim=1, keepdim=True) + EPSILON).sqrt()


def _direction(x: torch.Tensor, floor: float) -> torch.Tensor:
    return x * x.square().sum(dim=1, keepdim=True).clamp(min=floor**2).rsqrt()


def _pose_losses(
    output: PixelwisePrediction, targets: LossTargets, s: torch.Tensor | None, options: LossOptions
) -> dict[str, torch.Tensor]:
    """L^R and L^T of pixel maps, weighed by s (B, 6, ..) unless it is None.

    As published, both halves of the rotation's term are halved, of the paper's translation term
    only that of the data, and the one error of a pixel stands against three channels of s.
    """
    error_r = (targets.rotation_deg[:, :, None, None] - output.rotation).abs()
    true_t = targets.translation[:, :, None, None]
    if options.translation_form == "laplace":
        error_t = (output.translation - true_t).abs()
    else:
        floor = options.direction_floor
        length = (_norm(true_t) - _norm(output.translation)).square()
        turn = _direction(true_t, floor) - _direction(output.translation, floor)
        error_t = length + _norm(turn)
    if s is None:
        return {"rotation": error_r.mean(), "translation": error_t.mean()}
    s_r, s_t = s[:, :3], s[:, 3:]
    rotation = 0.5 * ((_inverse_scale(s_r) * error_r).mean() + s_r.mean())
    if options.translation_form == "laplace":
        s_t = s_t.clamp(min=MIN_LAPLACE_LOG_SCALE)
        return {"rotation": rotation, "translation": 0.5 * (error_t * (-s_t).exp() + s_t).mean()}
    return {
        "rotation": rotation,
        "translation": 0.5 * (_inverse_scale(s_t) * error_t).mean() + s_t.mean(),
    }


def _to_cells(x: torch.Tensor, cells: torch.Size) -> torch.Tensor:
    """Sum of a (B, h, w) map over the pixels of each cell of a coarser grid ``cells``."""
    height, width = x.shape[1:]
    side = -(-height // cells[0])
    if side == 1:
        return x
    x = F.pad(x, (0, cells[1] * side - width, 0, cells[0] * side - height))
    return F.avg_pool2d(x[:, None], side)[:, 0] * side**2


def _flow_loss(
    flow: torch.Tensor,
    target: torch.Tensor,
    defined: torch.Tensor,
    known: torch.Tensor,
    s: torch.Tensor | None,
    options: LossOptions,
) -> torch.Tensor:
    """L^F; with s (B, 6, ..) weighed by 1 / U^F = exp(-0.1 s) as the coupling says."""
    known = known & torch.isfinite(target).all(dim=1)
    defined = (defined & known)[:, None]
    error = (flow - torch.where(known[:, None], target, torch.zeros_like(target))).abs()
    counts = defined & (error < options.flow_limit_px)
    error = torch.where(counts, error, torch.zeros_like(error))
    behind = known[:, None] & ~defined
    error = error + behind * min(options.flow_limit_px, MAX_BEHIND_PX)
    count = known.sum().clamp(min=1)
    if s is None:
        return 0.5 * error.sum() / count
    a, b = (_to_cells(e, s.shape[2:]) for e in error.unbind(1))
    pixels = _to_cells(known.to(s.dtype), s.shape[2:])
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
    known: torch.Tensor,
    s: torch.Tensor | None,
    options: LossOptions,
) -> torch.Tensor:
    """L^D on inverse depth. Behind the camera the error goes on as its tangent at the target: it
    stays finite, and its gradient brings the point back.
    """
    known = known & torch.isfinite(target) & (target >= MIN_DEPTH)
    target = torch.where(known, target, torch.ones_like(target))
    front = depth >= MIN_DEPTH
    exact = 1.0 / target - 1.0 / torch.where(front, depth, torch.ones_like(depth))
    error = torch.where(front, exact, (target - depth) / target.square()).abs()
    error = torch.where(known, error, torch.zeros_like(error))
    count = known.sum().clamp(min=1)
    if s is None:
        return error.sum() / count
    pixels = _to_cells(known.to(s.dtype), s.shape[2:])
    s = options.depth_log_scale * s[:, DEPTH_COUPLING]
    weighed = _inverse_scale(s) * _to_cells(error, s.shape[2:])[:, None]
    return 0.5 * (weighed + s * pixels[:, None]).sum() / count
