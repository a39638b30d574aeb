"""The refinement of a batch of pairs in torch: CPU or GPU, float32 or float64, differentiable.

The torch twin of :mod:`hybridvo.refinement.refine` with the residual of
:mod:`hybridvo.pose.residuals`. Every start is refined side by side on a sparse set of pixels under
a kernel whose scale is graduated; the start of least cost at one common scale is fitted on the
whole grid. Samples never see each other: damping, acceptance, convergence and failure are per
sample.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import torch

from hybridvo.errors import InputError
from hybridvo.pose.batch_covariance import sandwich_covariance
from hybridvo.pose.batch_solver import (
    SECOND_DEPTH_FLOOR,
    Solution,
    estimate_noise,
    flow_only,
    gauss_newton,
    graduate,
    masked_median,
    tighten,
    with_second_depth,
)
from hybridvo.pose.implicit import attach_gradient
from hybridvo.pose.pixels import MAX_VALUE, MIN_DEPTH, Pixels, gather_pixels, sparse_subset
from hybridvo.pose.residuals import CUTOFFS, KERNELS, normal_equations
from hybridvo.types import PairBatch, Reason, Status

__all__ = ["BatchOptions", "BatchedPose", "refine_batch"]

NO_INFORMATION = (1e4, 1e4, 1e4, 10.0, 10.0, 10.0)
"""Diagonal of the covariance of a failed estimate."""
INLIER_DISTANCE2 = 9.0


@dataclass(frozen=True)
class BatchOptions:
    """Options of :func:`refine_batch`.

    Args:
        cutoff: c of the robust kernel in standard deviations; None: that of the kernel.
        iterations: most Gauss-Newton steps on the whole grid.
        tolerance: the solve has converged when a step moves the picture by less than this many
            standard deviations of the noise.
        tight: go on until the step is at the precision of the numbers, which gradients need. None:
            exactly where a gradient is wanted.
        sparse_pixels: pixels on which starts are refined and the noise is estimated.
        largest_px, smallest_px: largest start and the end of the graduated scale, px.
        levels: Gauss-Newton steps between them.
        minimum_pixels: fewer usable pixels are a failure.
        tile: side of the tiles, px; errors may be correlated over two (sandwich covariance).
    """

    cutoff: float | None = None
    iterations: int = 20
    tolerance: float = 1e-3
    tight: bool | None = None
    sparse_pixels: int = 2048
    largest_px: float = 64.0
    smallest_px: float = 0.4
    levels: int = 15
    minimum_pixels: int = 24
    tile: int = 32

    def __post_init__(self) -> None:
        for name in (
            "cutoff", "iterations", "tolerance", "sparse_pixels", "largest_px", "smallest_px",
            "levels", "minimum_pixels", "tile",
        ):  # fmt: skip
            value = getattr(self, name)
            if value is not None and not value > 0:
                raise InputError(f"BatchOptions.{name}: expected a positive number, got {value!r}.")


@dataclass(frozen=True, eq=False)
class BatchedPose:
    """Camera motions of a batch of pairs.

    Args:
        T_curr_prev: (B, 4, 4) points of the previous camera into the current one, metres; the
            identity where failed. Carries the gradient.
        covariance: (B, 6, 6) of the left perturbation (translation, rotation); no gradient.
        converged: (B,) bool. Where False the gradient of the sample is zero.
        failed: (B,) bool. status: one per sample, with its reason.
        iterations: (B,) Gauss-Newton steps on the whole grid.
        cost: (B,) robust cost per unit of external weight.
        weights: (B, H, W) robust weights without the external ones, 0 where unusable.
        noise: (B, 2) flow noise in px and noise of log depth, estimated or as given; (B, 3) with
            the noise of the second log depth where that is used.
        inlier_ratio: (B,) share of the external weight within three standard deviations.
    """

    T_curr_prev: torch.Tensor
    covariance: torch.Tensor
    converged: torch.Tensor
    failed: torch.Tensor
    status: list[Status]
    iterations: torch.Tensor
    cost: torch.Tensor
    weights: torch.Tensor
    noise: torch.Tensor
    inlier_ratio: torch.Tensor

    @property
    def T_prev_curr(self) -> torch.Tensor:
        """(B, 4, 4) inverse of ``T_curr_prev``."""
        R = self.T_curr_prev[:, :3, :3].transpose(1, 2)
        top = torch.cat([R, -R @ self.T_curr_prev[:, :3, 3:]], dim=2)
        return torch.cat([top, self.T_curr_prev[:, 3:]], dim=1)


def refine_batch(
    pair: PairBatch,
    T_init: Any = None,
    weights: Any = None,
    *,
    noise: Any = None,
    kernel: str = "geman-mcclure",
    options: BatchOptions | None = None,
    differentiable: bool = True,
    use_second_depth: bool = False,
) -> BatchedPose:
    """Camera motion of every pair of a batch by robust dense reprojection.

    Works in the floating type of the flow and depth (half types are raised to float32), outside
    autocast. The noise scales are constants for the gradient.

    Args:
        pair: see :class:`~hybridvo.types.PairBatch`.
        T_init: (B, 4, 4) or (B, S, 4, 4) T_curr_prev, starts beside the identity. A start that is
            not finite is replaced by the identity.
        weights: (B, H, W) factors on the information; what is not positive and finite switches a
            pixel off.
        noise: (sf, sd) flow noise in px and noise of log depth, or (sf, sd, sz) with that of the
            second depth; numbers, or a (B, 2) or (B, 3) tensor. None: estimated per sample.
        kernel: ``geman-mcclure``, ``cauchy``, ``huber`` or ``l2``.
        options: see :class:`BatchOptions`.
        differentiable: attach the gradient, see :mod:`hybridvo.pose.implicit`.
        use_second_depth: add the residual of ``depth_curr`` where it is present.

    Returns:
        Poses with covariance and a status per sample. Bad data give a failed status for that very
        sample, never an exception and never a pose that is not finite.

    Raises:
        InputError: shapes, types or options that cannot be used.
    """
    options = options or BatchOptions()
    if kernel not in KERNELS:
        raise InputError(f"refine_batch: unknown kernel {kernel!r}; known: {', '.join(KERNELS)}.")
    pair, weights = _checked_pair(pair, weights, use_second_depth)
    cutoff = CUTOFFS[kernel] if options.cutoff is None else float(options.cutoff)
    second = use_second_depth and pair.depth_curr is not None
    starts = _starts(T_init, pair.flow)
    fixed = _fixed_noise(noise, pair.flow, second)
    inputs = (
        pair.flow, pair.depth_prev, pair.K_prev, pair.K_curr, weights, fixed, pair.flow_variance,
        pair.depth_variance, pair.depth_curr if second else None,
    )  # fmt: skip
    wanted = differentiable and torch.is_grad_enabled()
    wanted = wanted and any(value is not None and value.requires_grad for value in inputs)
    tight = wanted if options.tight is None else options.tight
    with torch.autocast(pair.flow.device.type, enabled=False):
        with torch.no_grad():
            pixels = gather_pixels(pair, weights, second)
            solution = _solve(pixels, starts, fixed, kernel, cutoff, options, tight)
            result = _finish(pair, pixels, solution, kernel, cutoff, options, tight)
        if not wanted:
            return result
        T = attach_gradient(
            result.T_curr_prev, result.converged & ~result.failed, pair, weights,
            result.noise if fixed is None else fixed, kernel, cutoff, second,
        )  # fmt: skip
    return replace(result, T_curr_prev=T)


def _checked_pair(
    pair: PairBatch, weights: Any, use_second_depth: bool
) -> tuple[PairBatch, torch.Tensor | None]:
    """The batch in one floating type, on one device."""
    where = "refine_batch"
    flow, depth = pair.flow, pair.depth_prev
    for name, image_like in (("flow", flow), ("depth_prev", depth)):
        if not isinstance(image_like, torch.Tensor) or not image_like.is_floating_point():
            raise InputError(f"{where}: expected PairBatch.{name} as a floating-point tensor.")
    if flow.ndim != 4 or flow.shape[3] != 2 or flow.numel() == 0:
        raise InputError(
            f"{where}: expected PairBatch.flow of shape (B, H, W, 2), got {tuple(flow.shape)}."
        )
    batch, image = flow.shape[0], tuple(flow.shape[:3])
    dtype = torch.promote_types(flow.dtype, depth.dtype)
    if dtype not in (torch.float32, torch.float64):
        dtype = torch.float32
    values: dict[str, Any] = {}
    if weights is not None:
        weights = torch.as_tensor(weights, device=flow.device)
        if weights.ndim == 2 and batch == 1:
            weights = weights[None]
    checked: tuple[tuple[str, Any, tuple[int, ...]], ...] = (
        ("flow", flow, (*image, 2)),
        ("depth_prev", depth, image),
        ("K_prev", pair.K_prev, (batch, 3, 3)),
        ("K_curr", pair.K_curr, (batch, 3, 3)),
        ("depth_curr", pair.depth_curr, image),
        ("flow_variance", pair.flow_variance, image),
        ("depth_variance", pair.depth_variance, image),
        ("weights", weights, image),
        ("valid", pair.valid, image),
    )
    for name, value, shape in checked:
        if value is None and name not in ("K_prev", "K_curr"):
            values[name] = None
            continue
        got = tuple(value.shape) if isinstance(value, torch.Tensor) else type(value).__name__
        if got != shape:
            raise InputError(f"{where}: expected {name} of shape {shape}, got {got}.")
        if value.device != flow.device:
            raise InputError(f"{where}: {name} is on {value.device}, the flow on {flow.device}.")
        if name == "valid":
            if value.dtype != torch.bool:
                raise InputError(f"{where}: expected PairBatch.valid as bool, got {value.dtype}.")
            values[name] = value
        else:
            values[name] = value.to(dtype)
    if use_second_depth and pair.depth_curr is None:
        raise InputError(f"{where}: use_second_depth needs PairBatch.depth_curr, which is None.")
    weights = values.pop("weights")
    return PairBatch(**values), weights


def _starts(T_init: Any, like: torch.Tensor) -> torch.Tensor:
    """(B, S + 1, 4, 4) float64: the identity and the rigid parts of the handed-in starts."""
    batch = like.shape[0]
    unit = torch.eye(4, dtype=torch.float64, device=like.device)
    starts = unit.expand(batch, 1, 4, 4)
    if T_init is None:
        return starts
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
    good = torch.isfinite(T).flatten(2).all(dim=2) & (T.abs().flatten(2).amax(dim=2) < MAX_VALUE)
    T = torch.where(good[:, :, None, None], T, unit)
    U, _, Vh = torch.linalg.svd(T[:, :, :3, :3])
    U = torch.cat([U[..., :2], U[..., 2:] * torch.linalg.det(U @ Vh)[..., None, None]], dim=-1)
    rigid = unit.expand_as(T).clone()
    rigid[:, :, :3, :3] = U @ Vh
    rigid[:, :, :3, 3] = T[:, :, :3, 3]
    return torch.cat([starts, rigid], dim=1)


def _fixed_noise(noise: Any, like: torch.Tensor, second: bool) -> torch.Tensor | None:
    """(B, 2) or (B, 3) noise as handed in."""
    if noise is None:
        return None
    if isinstance(noise, (tuple, list)):
        columns = [
            torch.as_tensor(value, dtype=like.dtype, device=like.device).expand(like.shape[0])
            for value in noise
        ]
        value = torch.stack(columns, dim=1)
    else:
        value = torch.as_tensor(noise, device=like.device).to(like.dtype)
    if value.ndim != 2 or value.shape[0] != like.shape[0] or value.shape[1] not in (2, 3):
        raise InputError(
            f"refine_batch: expected noise as (sf, sd), (sf, sd, sz) or a tensor of shape "
            f"({like.shape[0]}, 2) or ({like.shape[0]}, 3), got {tuple(value.shape)}."
        )
    known = value.detach()
    if not bool(torch.isfinite(known).all() & (known >= 0).all() & (known[:, 0] > 0).all()):
        raise InputError("refine_batch: expected finite noise, sf positive, sd not negative.")
    if second and value.shape[1] == 2:
        value = torch.cat([value, value[:, 1:].clamp(min=SECOND_DEPTH_FLOOR)], dim=1)
    return value if second else value[:, :2]


def _solve(
    pixels: Pixels,
    starts: torch.Tensor,
    fixed: torch.Tensor | None,
    kernel: str,
    cutoff: float,
    options: BatchOptions,
    tight: bool,
) -> Solution:
    """From the starts to the pose of every sample."""
    dtype = pixels.depth.dtype
    batch, count = starts.shape[:2]
    sparse = sparse_subset(pixels, options.sparse_pixels)
    planar = flow_only(sparse)
    end = pixels.depth.new_full((batch,), options.smallest_px)
    if fixed is not None:
        end = torch.maximum(end, fixed[:, 0])
    many = planar.repeat(count)
    many_end = end.repeat_interleave(count)
    T = graduate(
        many, starts.reshape(-1, 4, 4), kernel, many_end, options.largest_px, options.levels
    )
    T = T.reshape(batch, count, 4, 4)
    if count > 1:
        scale = torch.stack([many_end, torch.zeros_like(many_end)], dim=1)
        cost = normal_equations(many, T.reshape(-1, 4, 4).to(dtype), scale, kernel, 1.0).cost
        best = torch.nan_to_num(cost, nan=torch.inf).reshape(batch, count).argmin(dim=1)
        T = T[torch.arange(batch, device=T.device), best]
    else:
        T = T[:, 0]
    if fixed is None:
        noise = torch.tensor([0.7, 0.01], dtype=dtype, device=T.device).repeat(batch, 1)
        for _ in range(3):
            noise = estimate_noise(planar, T, noise[:, :2])
            noise = with_second_depth(sparse, T, noise)
            T = gauss_newton(sparse, T, noise, kernel, cutoff, 3, options.tolerance).T
        noise = with_second_depth(sparse, T, estimate_noise(planar, T, noise[:, :2]))
    else:
        noise = fixed.detach()
        T = gauss_newton(sparse, T, noise, kernel, cutoff, 6, options.tolerance).T
    solution = gauss_newton(
        pixels, T, noise, kernel, cutoff, options.iterations, options.tolerance
    )  # fmt: skip
    return tighten(pixels, solution, kernel, cutoff) if tight else solution


def _finish(
    pair: PairBatch,
    pixels: Pixels,
    solution: Solution,
    kernel: str,
    cutoff: float,
    options: BatchOptions,
    tight: bool,
) -> BatchedPose:
    """Covariance, weights and status of every sample."""
    batch, height, width = pair.depth_prev.shape
    dtype = pixels.depth.dtype
    T = solution.T.to(dtype)
    system = normal_equations(pixels, T, solution.noise, kernel, cutoff, with_scores=True)
    usable = pixels.weight > 0
    count = usable.sum(dim=1)
    total = pixels.weight.sum(dim=1).clamp(min=1e-30)
    near = (system.weights > 0) & (system.distance2 <= INLIER_DISTANCE2)
    share = (pixels.weight * near).sum(dim=1) / total
    depth = masked_median(pixels.depth, usable, 1.0).double()
    covariance, definite = sandwich_covariance(
        system, pixels, kernel, cutoff, depth, options.tile, height
    )
    finite = torch.isfinite(T).flatten(1).all(dim=1)
    few = count < options.minimum_pixels
    lost = (near.sum(dim=1) < 6) | (share < 0.02)
    failed = few | ~definite | ~finite | lost
    nothing = torch.diag(covariance.new_tensor(NO_INFORMATION))
    unit = torch.eye(4, dtype=dtype, device=T.device)
    converged = solution.converged & ~failed
    noise = torch.where(
        torch.isfinite(solution.noise), solution.noise, torch.ones_like(solution.noise)
    )
    status = [
        _status(pair, k, options, *facts)
        for k, facts in enumerate(
            zip(
                count.tolist(), few.tolist(), (definite & finite).tolist(), lost.tolist(),
                share.tolist(), converged.tolist(), strict=True,
            )
        )
    ]  # fmt: skip
    return BatchedPose(
        T_curr_prev=torch.where(failed[:, None, None], unit, T),
        covariance=torch.where(failed[:, None, None], nothing, covariance),
        converged=converged,
        failed=failed,
        status=status,
        iterations=solution.iterations,
        cost=torch.nan_to_num(system.cost / total),
        weights=torch.nan_to_num(system.weights).reshape(batch, height, width),
        noise=noise,
        inlier_ratio=torch.nan_to_num(share),
    )


def _status(
    pair: PairBatch,
    k: int,
    options: BatchOptions,
    count: int,
    few: bool,
    definite: bool,
    lost: bool,
    share: float,
    converged: bool,
) -> Status:
    """Status of one sample."""
    if few:
        for name, K in (("K_prev", pair.K_prev[k]), ("K_curr", pair.K_curr[k])):
            if not bool(torch.isfinite(K).all()) or not bool((K.diagonal() > 0).all()):
                return Status.failed(Reason.NAN_INPUT, f"{name} is no camera matrix")
        depth, flow = pair.depth_prev[k], pair.flow[k]
        depths = int(((depth > MIN_DEPTH) & (depth < MAX_VALUE)).sum())
        flows = int((flow.abs() < MAX_VALUE).all(dim=-1).sum())
        needed = f"{options.minimum_pixels} needed"
        if depths < options.minimum_pixels:
            return Status.failed(
                Reason.NO_VALID_DEPTH, f"{depths} pixels with valid depth, {needed}"
            )
        if flows < options.minimum_pixels:
            return Status.failed(Reason.NO_FLOW, f"{flows} pixels with valid flow, {needed}")
        return Status.failed(Reason.LOW_INLIERS, f"{count} usable pixels, {needed}")
    if not definite:
        return Status.failed(
            Reason.DEGENERATE_GEOMETRY, "the pixels leave a direction of the motion undetermined"
        )
    if lost:
        return Status.failed(
            Reason.LOW_INLIERS, f"{100 * share:.1f} % of the pixels follow one motion"
        )
    if not converged:
        return Status.degraded(
            Reason.SOLVER_DIVERGED, f"not converged after {options.iterations} steps"
        )
    if share < 0.2:
        return Status.degraded(
            Reason.LOW_INLIERS, f"only {100 * share:.0f} % of the pixels follow the motion"
        )
    return Status()
