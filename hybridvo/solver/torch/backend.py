"""The refinement of a batch of pairs in torch: CPU or GPU, float32 or float64, differentiable.

The gradient is that of the implicit function theorem: the estimate solves
g(T, inputs, noise) = 0, so d xi = A^-1 dg with A = -dg / d xi. It is attached by one Newton step
of value zero. What is held constant:

* With ``noise`` given nothing: it is the gradient of the solution, also with respect to the noise.
* With estimated noise it is that of the solution with the noise held at its estimate.
* ``T_init``, covariance, probability and status carry no gradient, and there is no second
  derivative.

Samples do not influence each other.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import torch

from hybridvo.core.calibration import MIN_PROBABILITY
from hybridvo.core.checks import brief, check_kind
from hybridvo.core.errors import InputError
from hybridvo.core.options import RefineOptions
from hybridvo.core.torch_geometry import pp, se3, to_matrix
from hybridvo.core.types import PairBatch
from hybridvo.solver.torch import factors
from hybridvo.solver.torch.batched_pose import BatchedPose as BatchedPose
from hybridvo.solver.torch.covariance import batch_covariances
from hybridvo.solver.torch.factors import KERNELS, Pixels, ResidualModel
from hybridvo.solver.torch.solve import Starts, solve
from hybridvo.solver.torch.status import StartEvidence, judged_batch
from hybridvo.solver.torch.tools import (
    PoseSeed,
    as_tensor,
    checked_batch,
    uncompiled,
)

# c of the other kernels, standard deviations: 95 % efficient under normal noise (Holland and
# Welsch, 1977). The one of ``l2`` has no effect.
KERNEL_CUTOFFS = {"cauchy": 2.385, "huber": 1.345, "l2": 1.0}

# Largest entry of a start: a larger one counts as not finite.
MAX_ENTRY = 1e9
POSE = (4, 4)
STARTS_DIMENSIONS = 4  # (B, S, 4, 4)


@uncompiled
def refine_batch(
    batch: PairBatch,
    T_init: Any = None,
    weights: Any = None,
    *,
    noise: Any = None,
    kernel: str = "geman-mcclure",
    options: RefineOptions | None = None,
    min_probability: float = MIN_PROBABILITY,
) -> BatchedPose:
    """Estimate the camera motion of every pair of a batch by robust dense reprojection.

    It computes in the type of flow and depth, at least float32. Gradients reach flow, depth,
    intrinsics, variances, weights and ``noise``, not ``T_init``: see the module for what is held
    constant. A sample with bad data fails alone, and its gradient is zero.

    A batch is not searched for other motions. Which one is found follows from the weights; without
    any, or where all of a sample are alike, its status is at best degraded and its probability NaN.

    Args:
        batch: see :class:`~hybridvo.core.types.PairBatch`.
        T_init: a :class:`PoseSeed`; or (B, 4, 4) or (B, S, 4, 4) T_curr_prev to start from, metres;
            one that is not finite is replaced by the identity. Without weights the identity is one
            more start. Where the seed states no covariance the motion is sought within about a
            pixel, or more where hardly any pixel fits it. The identity that stands in for a missing
            start has none: from there the motion is sought far away.
        weights: (B, H, W) factors on the information, unless the seed has some; pixels whose factor
            is not positive and finite are not used. They count squared until the motion is chosen.
        noise: standard deviations of flow, px, and of log depth, as (2,) or (B, 2); None:
            estimated, and held constant for the gradient.
        kernel: ``geman-mcclure``, with the cutoff of the options, ``cauchy``, ``huber`` or ``l2``.
        options: see :class:`~hybridvo.core.options.RefineOptions`.
        min_probability: the probability below which a motion is degraded.

    Returns:
        The motions, with the status of every sample.

    Raises:
        InputError: A value has another shape, type or device.
    """
    options = RefineOptions() if options is None else options
    check_kind("refine_batch.batch", batch, PairBatch)
    check_kind("refine_batch.options", options, RefineOptions)
    model = kernel_model(kernel, options)
    seed = _seed_of(T_init, weights)
    batch, weights = checked_batch(batch, seed.weights)
    with_identity = seed.T_curr_prev is None or weights is None
    T_starts = _initial_poses(seed.T_curr_prev, batch.flow, with_identity)
    is_seed = [True] * T_starts.shape[1]
    is_seed[0] = not with_identity
    covariance = _given_covariance(seed.covariance, batch.flow)
    starts = Starts(T_starts, is_seed, covariance)
    # it belongs to a start and its weights
    lead = None if with_identity else seed.lead
    noise = given_noise(noise, batch.flow)
    start_evidence = StartEvidence(
        T_starts[:, 0],
        _given_lead(lead, batch.flow),
        _has_preference(weights, batch.flow),
        min_probability,
    )
    with torch.autocast(batch.flow.device.type, enabled=False):
        pixels = factors.gather_pixels(batch, weights)
        needs_gradient = _needs_gradient(batch, weights, noise)
        fixed = pixels.map(torch.Tensor.detach)
        with torch.no_grad():
            fit = solve(batch, fixed, starts, noise, model, options, needs_gradient)
            model = model._replace(noise=fit.noise)
            stated = batch_covariances(batch, fixed, fit, model, options)
            result = judged_batch(
                batch, fixed, fit, stated, start_evidence, options
            )
        if not needs_gradient:
            return result
        model = model._replace(noise=result.noise if noise is None else noise)
        return _with_gradient(result, pixels, model, fit.is_seed)


def kernel_model(kernel: Any, options: RefineOptions) -> ResidualModel:
    """Return the robust kernel of a name, still without noise."""
    if not isinstance(kernel, str) or kernel not in KERNELS:
        names = ", ".join(KERNELS)
        raise InputError(
            f"refine_batch: unknown kernel {brief(kernel)}; known: {names}."
        )
    cutoff = KERNEL_CUTOFFS.get(kernel, options.cutoff)
    return ResidualModel(torch.empty(0), cutoff, kernel)


def _seed_of(T_init: Any, weights: Any) -> PoseSeed:
    """The start as it was handed in, with its weights."""
    if not isinstance(T_init, PoseSeed):
        return PoseSeed(T_init, weights)
    if weights is not None and T_init.weights is not None:
        raise InputError(
            "refine_batch: expected weights once, got some beside those of the seed; leave one "
            "out, as with seed._replace(weights=None)."
        )
    return T_init if weights is None else T_init._replace(weights=weights)


def _needs_gradient(
    batch: PairBatch, weights: torch.Tensor | None, noise: torch.Tensor | None
) -> bool:
    """Return whether a gradient of the motions will be needed."""
    tensors = (*vars(batch).values(), weights, noise)
    return torch.is_grad_enabled() and any(
        x is not None and x.requires_grad for x in tensors
    )


def _with_gradient(
    result: BatchedPose,
    pixels: Pixels,
    model: ResidualModel,
    is_seed: torch.Tensor,
) -> BatchedPose:
    """Return the motions with the gradient of the solution; a failed one and a seed have none."""
    T = result.SE3.detach()
    A = factors.newton_matrix(pixels, T, model)
    g = factors.total_score(pixels, to_matrix(T), model)
    wanted = ~(result.failed | is_seed)[:, None]
    return replace(result, SE3=factors.attach_implicit_gradient(T, A, g, wanted))


def _initial_poses(
    T_init: Any, like: torch.Tensor, with_identity: bool
) -> pp.LieTensor:
    """Return the starts as pypose SE3 (B, S, 7), the identity first where it is wanted.

    Args:
        T_init: (B, 4, 4), (B, S, 4, 4), a pypose LieTensor, or None.
        like: (B, ...) tensor of the batch.
        with_identity: whether the identity is one of the starts.
    """
    batch = len(like)
    unit = torch.eye(4, dtype=torch.float64, device=like.device)
    identity = unit.expand(batch, 1, 4, 4)
    if T_init is None:
        return se3(identity)
    if isinstance(T_init, pp.LieTensor):
        T_init = T_init.matrix()
    T = as_tensor(T_init, "T_init", like.device).detach().double()
    one_each = (batch, *POSE)
    if T.shape == one_each or (T.shape == POSE and batch == 1):
        T = T.reshape(batch, 1, *POSE)
    fits = T.ndim == STARTS_DIMENSIONS and T.shape[2:] == POSE
    if not fits or len(T) != batch or T.shape[1] == 0:
        shapes = f"({batch}, 4, 4) or ({batch}, S, 4, 4)"
        raise InputError(
            f"refine_batch: expected T_init of shape {shapes}, got {tuple(T.shape)}."
        )
    finite = (T.abs() < MAX_ENTRY).flatten(2).all(dim=2)
    T = torch.where(finite[:, :, None, None], T, unit)
    return se3(torch.cat([identity, T], dim=1) if with_identity else T)


def _given_covariance(value: Any, like: torch.Tensor) -> torch.Tensor | None:
    """Return the covariance (B, 6, 6) of a start as handed in, or None."""
    if value is None:
        return None
    covariance = (
        as_tensor(value, "PoseSeed.covariance", like.device).detach().double()
    )
    expected = (len(like), 6, 6)
    is_valid = tuple(covariance.shape) == expected
    if is_valid:
        variances = covariance.diagonal(dim1=1, dim2=2)
        is_valid = bool((variances >= 0).all() and torch.isfinite(covariance).all())
    if not is_valid:
        raise InputError(
            f"refine_batch: expected PoseSeed.covariance of shape {expected}, finite, with "
            f"variances that are not negative, got {tuple(covariance.shape)}."
        )
    return covariance


def _given_lead(lead: Any, like: torch.Tensor) -> torch.Tensor | None:
    """Return the lead (B,) as handed in, or None."""
    if lead is None:
        return None
    value = as_tensor(lead, "PoseSeed.lead", like.device).detach().double()
    if value.shape != like.shape[:1]:
        shape = f"({len(like)},)"
        raise InputError(
            f"refine_batch: expected PoseSeed.lead of shape {shape}, got {tuple(value.shape)}."
        )
    return torch.nan_to_num(value, 0.0, 0.0, 0.0)


def _has_preference(
    weights: torch.Tensor | None, like: torch.Tensor
) -> torch.Tensor:
    """Return (B,) whether weights (B, H, W) prefer some pixels to others."""
    if weights is None:
        return torch.zeros(len(like), dtype=torch.bool, device=like.device)
    first = weights[:, :1, :1]
    return (weights != first).flatten(1).any(dim=1)


def given_noise(noise: Any, like: torch.Tensor) -> torch.Tensor | None:
    """Return the noise (B, 2) as handed in, or None."""
    if noise is None:
        return None
    value = as_tensor(noise, "noise", like.device).to(like.dtype)
    detached = value.detach()
    fits = value.shape in ((2,), (len(like), 2))
    if not fits or not _is_noise(detached):
        expected = (
            f"noise (2,) or ({len(like)}, 2), flow's positive, depth's not negative"
        )
        got = f"{detached.flatten()[:8].tolist()} of shape {tuple(detached.shape)}"
        raise InputError(f"refine_batch: expected {expected}, finite, got {got}.")
    return value.expand(len(like), 2)


def _is_noise(value: torch.Tensor) -> bool:
    """Return whether values (..., 2) are finite, the first positive, the second not negative."""
    in_range = (value >= 0) & (value < torch.inf)
    return bool(in_range.all()) and not bool((value[..., 0] == 0).any())
