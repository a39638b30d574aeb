"""What the torch refinement takes and gives: options, checked tensors, poses, statuses."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import torch

from hybridvo.errors import InputError
from hybridvo.options import RefineOptions
from hybridvo.refinement.torch_pixels import MAX_VALUE
from hybridvo.results import Reason, RelativePose, Status
from hybridvo.torch_geometry import MAX_DEPTH, MIN_DEPTH, pp, se3
from hybridvo.types import PairBatch

DEPTH_CURR_FLOOR = 2e-3
"""Smallest noise of log D_curr assumed: what bilinear sampling of a smooth surface is good to."""
DOUBTFUL_INLIER_RATIO = 0.2
"""Share of the weight below which a motion is degraded."""
DOUBTFUL_PROBABILITY = 0.8
"""Probability below which it is; 0.8 is a rival with half of the motion's own weight."""


@dataclass(frozen=True)
class BatchOptions:
    """Options of :func:`~hybridvo.refinement.torch_backend.refine_batch`.

    Args:
        cutoff: c of the robust kernel in standard deviations; None: that of the kernel.
        iterations: most Newton steps on all pixels.
        tolerance: a step that moves the image by less than this many standard deviations of the
            flow noise is the last. Where a gradient is wanted the solver goes on to the precision
            of the numbers.
        subset_pixels: pixels on which starts are refined and the noise is estimated.
        largest_px, smallest_px: largest start and the end of the graduated scale, px.
        min_pixels: fewer usable pixels are a failure.
        min_inlier_ratio: a smaller share of the weight within three standard deviations is one.
        tiles: about how many tiles (of 8 to 64 px) the image is cut into for the covariance.
        use_depth_curr: add the residual of the current frame's depth where it is known.
    """

    cutoff: float | None = None
    iterations: int = 20
    tolerance: float = 5e-3
    subset_pixels: int = 2048
    largest_px: float = 64.0
    smallest_px: float = 0.4
    min_pixels: int = 24
    min_inlier_ratio: float = 0.02
    tiles: int = 110
    use_depth_curr: bool = False

    @classmethod
    def of(cls, options: RefineOptions, kernel: str) -> BatchOptions:
        """Those that belong to the options of the refinement of one pair."""
        return cls(
            cutoff=options.cutoff if kernel == "geman-mcclure" else None,
            min_pixels=options.min_pixels,
            tiles=options.tiles,
            use_depth_curr=options.current_depth == "on",
        )

    def __post_init__(self) -> None:
        for name, value in vars(self).items():
            if name != "use_depth_curr" and value is not None and not value > 0:
                raise InputError(f"BatchOptions.{name}: expected a positive number, got {value!r}.")


@dataclass(frozen=True, eq=False)
class BatchedPose:
    """Camera motions of a batch of pairs.

    Args:
        SE3: (B, 7) pypose SE3, ``T_curr_prev``; the identity where failed. Carries the gradient.
        covariance: (B, 6, 6) of the left perturbation (translation, rotation); no gradient.
        converged: (B,) bool. failed: (B,) bool.
        status: one per sample, with its reason.
        probability: (B,) of the motion being the camera's, by the weight of the motion that
            contradicts it most; 0 where failed.
        iterations: (B,) Newton steps on all pixels.
        cost: (B,) robust cost per unit of external weight.
        weights: (B, H, W) robust weights without the external ones, 0 where unusable.
        noise: (B, 2) flow noise in px and noise of log depth, estimated or as given; (B, 3) with
            that of the current frame's depth where it is used.
        inlier_ratio: (B,) share of the external weight within three standard deviations.
    """

    SE3: pp.LieTensor
    covariance: torch.Tensor
    converged: torch.Tensor
    failed: torch.Tensor
    status: list[Status]
    probability: torch.Tensor
    iterations: torch.Tensor
    cost: torch.Tensor
    weights: torch.Tensor
    noise: torch.Tensor
    inlier_ratio: torch.Tensor

    def __len__(self) -> int:
        return len(self.status)

    @property
    def T_curr_prev(self) -> torch.Tensor:
        """(B, 4, 4) points of the previous camera into the current one, metres."""
        return self.SE3.matrix().to(self.covariance.dtype)

    @property
    def T_prev_curr(self) -> torch.Tensor:
        """(B, 4, 4) inverse of ``T_curr_prev``."""
        return self.SE3.Inv().matrix().to(self.covariance.dtype)

    def one(self, index: int, method: str = "refine") -> RelativePose:
        """The motion of one sample as every estimator gives it, in numpy."""
        covariance = self.covariance[index].detach().double().cpu().numpy()
        noise = self.noise[index].tolist()
        common: dict[str, Any] = {
            "method": method,
            "probability": float(self.probability[index]),
            "inlier_ratio": min(1.0, float(self.inlier_ratio[index])),
            "iterations": int(self.iterations[index]),
            "cost": float(self.cost[index]),
            "residual_scale_px": noise[0],
            "depth_noise": noise[1],
            "weights": self.weights[index].detach().float().cpu().numpy(),
            "terms": ("flow", "depth") if len(noise) == 3 else ("flow",),
        }
        T = self.SE3[index].detach().matrix().double().cpu().numpy()
        spread = np.sqrt(max(np.linalg.eigvalsh(covariance[:3, :3])[-1], 0.0))
        return RelativePose(
            T_curr_prev=T,
            covariance=covariance,
            status=self.status[index],
            translation_direction_valid=bool(np.linalg.norm(T[:3, 3]) > 3 * spread),
            **common,
        )


def checked_batch(
    batch: PairBatch,
    weights: Any = None,
    use_depth_curr: bool = False,
    where: str = "refine_batch",
) -> tuple[PairBatch, torch.Tensor | None]:
    """The batch and its weights in one floating type, on one device.

    Raises:
        InputError: what does not fit, named.
    """
    flow, depth = batch.flow, batch.depth_prev
    for name, value in (("flow", flow), ("depth_prev", depth)):
        if not isinstance(value, torch.Tensor) or not value.is_floating_point():
            raise InputError(f"{where}: expected PairBatch.{name} as a floating-point tensor.")
    if flow.ndim != 4 or flow.shape[3] != 2 or flow.numel() == 0:
        raise InputError(
            f"{where}: expected PairBatch.flow of shape (B, H, W, 2), got {tuple(flow.shape)}."
        )
    if use_depth_curr and batch.depth_curr is None:
        raise InputError(f"{where}: use_depth_curr needs PairBatch.depth_curr, which is None.")
    dtype = torch.promote_types(flow.dtype, depth.dtype)
    dtype = dtype if dtype in (torch.float32, torch.float64) else torch.float32
    if weights is not None:
        weights = torch.as_tensor(weights, device=flow.device)
        weights = weights[None] if weights.ndim == 2 and len(flow) == 1 else weights
    shapes = {"flow": tuple(flow.shape), "K_prev": (len(flow), 3, 3), "K_curr": (len(flow), 3, 3)}
    values = {**vars(batch), "weights": weights}
    for name, value in values.items():
        if value is None and name not in shapes:
            continue
        shape = shapes.get(name, tuple(flow.shape[:3]))
        got = tuple(value.shape) if isinstance(value, torch.Tensor) else type(value).__name__
        if got != shape:
            raise InputError(f"{where}: expected {name} of shape {shape}, got {got}.")
        if value.device != flow.device:
            raise InputError(f"{where}: {name} is on {value.device}, the flow on {flow.device}.")
        if name == "valid" and value.dtype != torch.bool:
            raise InputError(f"{where}: expected PairBatch.valid as bool, got {value.dtype}.")
        values[name] = value if name == "valid" else value.to(dtype)
    weights = values.pop("weights")
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
    if T.shape == (4, 4) and batch == 1:
        T = T[None]
    if T.ndim == 3:
        T = T[:, None]
    if T.ndim != 4 or T.shape[0] != batch or T.shape[2:] != (4, 4):
        raise InputError(
            f"refine_batch: expected T_init of shape ({batch}, 4, 4) or ({batch}, S, 4, 4), "
            f"got {tuple(T.shape)}."
        )
    good = torch.isfinite(T).flatten(2).all(dim=2) & (T.abs().flatten(2).amax(dim=2) < 1e9)
    T = torch.where(good[:, :, None, None], T, unit)
    return se3(T if alone else torch.cat([identity, T], dim=1))


def given_noise(noise: Any, like: torch.Tensor, use_depth_curr: bool) -> torch.Tensor | None:
    """(B, 2) or (B, 3) noise as handed in."""
    if noise is None:
        return None
    if isinstance(noise, (tuple, list)):
        columns = [torch.as_tensor(x, dtype=like.dtype, device=like.device) for x in noise]
        value = torch.stack([x.expand(len(like)) for x in columns], dim=1)
    else:
        value = torch.as_tensor(noise, device=like.device).to(like.dtype)
    if value.ndim != 2 or len(value) != len(like) or value.shape[1] not in (2, 3):
        raise InputError(
            f"refine_batch: expected noise as (sf, sd), (sf, sd, sz) or a tensor of shape "
            f"({len(like)}, 2) or ({len(like)}, 3), got {tuple(value.shape)}."
        )
    known = value.detach()
    if not bool(torch.isfinite(known).all() & (known >= 0).all() & (known[:, 0] > 0).all()):
        raise InputError("refine_batch: expected finite noise, sf positive, sd not negative.")
    if use_depth_curr and value.shape[1] == 2:
        value = torch.cat([value, value[:, 1:].clamp(min=DEPTH_CURR_FLOOR)], dim=1)
    return value if use_depth_curr else value[:, :2]


def status_of(
    batch: PairBatch,
    k: int,
    options: BatchOptions,
    *,
    usable: int,
    definite: bool,
    converged: bool,
    inlier_ratio: float,
    rival_ratio: float,
    probability: float,
) -> Status:
    """Status of one sample of a solved batch."""
    needed = f"{options.min_pixels} needed"
    if usable < options.min_pixels:
        for name, K in (("K_prev", batch.K_prev[k]), ("K_curr", batch.K_curr[k])):
            if not bool(torch.isfinite(K).all()) or not bool((K.diagonal() > 0).all()):
                return Status.failed(Reason.NAN_INPUT, f"{name} is no camera matrix")
        depth, flow = batch.depth_prev[k], batch.flow[k]
        depths = int(((depth > MIN_DEPTH) & (depth < MAX_DEPTH)).sum())
        flows = int((flow.abs() < MAX_VALUE).all(dim=-1).sum())
        if depths < options.min_pixels:
            what = f"{depths} pixels with valid depth, {needed}"
            return Status.failed(Reason.NO_VALID_DEPTH, what)
        if flows < options.min_pixels:
            return Status.failed(Reason.NO_FLOW, f"{flows} pixels with valid flow, {needed}")
        return Status.failed(Reason.LOW_INLIERS, f"{usable} usable pixels, {needed}")
    if not definite:
        what = "the pixels leave a direction of the motion undetermined"
        return Status.failed(Reason.DEGENERATE_GEOMETRY, what)
    share = f"{100 * inlier_ratio:.1f} % of the pixels follow"
    if inlier_ratio < options.min_inlier_ratio:
        return Status.failed(Reason.LOW_INLIERS, f"{share} one motion")
    if not converged:
        what = f"not converged after {options.iterations} steps"
        return Status.degraded(Reason.SOLVER_DIVERGED, what)
    if probability < DOUBTFUL_PROBABILITY:
        what = f"{share} this motion, {100 * rival_ratio:.1f} % another one"
        return Status.degraded(Reason.AMBIGUOUS_MOTION, what)
    if inlier_ratio < DOUBTFUL_INLIER_RATIO:
        return Status.degraded(Reason.LOW_INLIERS, f"only {share} the motion")
    return Status()
