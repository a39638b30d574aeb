"""The fit of a batch of pairs in torch: CPU or GPU, float32 or float64, differentiable.

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
from typing import Any, NamedTuple

import torch

from hybridvo.core.checks import brief, check_kind
from hybridvo.core.errors import InputError
from hybridvo.core.options import RefineOptions
from hybridvo.core.torch_geometry import pp, se3, to_matrix
from hybridvo.core.types import PairBatch
from hybridvo.solver.torch import factors
from hybridvo.solver.torch.batched_pose import BatchedPose
from hybridvo.solver.torch.by_pairs import BatchStated
from hybridvo.solver.torch.covariance import batch_covariances
from hybridvo.solver.torch.factors import KERNELS, Pixels, ResidualModel
from hybridvo.solver.torch.solve import BatchFit, Starts, solve
from hybridvo.solver.torch.tools import PoseSeed, as_tensor, checked_batch

# c of the other kernels, standard deviations: 95 % efficient under normal noise (Holland and
# Welsch, 1977). The one of ``l2`` has no effect.
KERNEL_CUTOFFS = {"cauchy": 2.385, "huber": 1.345, "l2": 1.0}

# Largest entry of a start: a larger one counts as not finite.
MAX_ENTRY = 1e9
POSE = (4, 4)
STARTS_DIMENSIONS = 4  # (B, S, 4, 4)
EVIDENCE = 4
"""Numbers that speak for a motion that PWVO chose."""


class BatchSolution(NamedTuple):
    """The motions of a batch, and all that they are judged by.

    Attributes:
        batch: checked.
        pixels: of the batch, with gradient.
        fit: the motions.
        stated: their covariances, and what else the fits state.
        model: the robust kernel, with the noise that was estimated.
        noise: (B, 2) that was handed in, with its gradient; None: none was.
        starts: (B, 7) the first of the motions handed in.
        evidence: (B, 4) what speaks for these, or None.
        has_preference: (B,) whether the weights prefer some pixels to others.
        needs_gradient: whether a gradient of the motions is needed.
    """

    batch: PairBatch
    pixels: Pixels
    fit: BatchFit
    stated: BatchStated
    model: ResidualModel
    noise: torch.Tensor | None
    starts: pp.LieTensor
    evidence: torch.Tensor | None
    has_preference: torch.Tensor
    needs_gradient: bool

    def with_gradient(self, result: BatchedPose) -> BatchedPose:
        """Judged motions with the gradient of the solution; a failed one and a seed have none."""
        if not self.needs_gradient:
            return result
        noise = result.noise if self.noise is None else self.noise
        model = self.model._replace(noise=noise)
        T = result.SE3.detach()
        A = factors.newton_matrix(self.pixels, T, model)
        g = factors.total_score(self.pixels, to_matrix(T), model)
        wanted = ~(result.failed | self.fit.is_seed)[:, None]
        return replace(
            result, SE3=factors.attach_implicit_gradient(T, A, g, wanted)
        )


def solve_batch(
    batch: PairBatch,
    T_init: Any,
    weights: Any,
    noise: Any,
    kernel: str,
    options: RefineOptions,
) -> BatchSolution:
    """Fit the motion of every pair of a batch; see :func:`hybridvo.batches.refine_batch`."""
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
    evidence = None if with_identity else seed.evidence
    evidence = _given_evidence(evidence, batch.flow)
    noise = given_noise(noise, batch.flow)
    has_preference = _has_preference(weights, batch.flow)
    pixels = factors.gather_pixels(batch, weights)
    needs_gradient = _needs_gradient(batch, weights, noise)
    fixed = pixels.map(torch.Tensor.detach)
    with torch.no_grad():
        fit = solve(
            batch, weights, fixed, starts, noise, model, options, needs_gradient
        )
        model = model._replace(noise=fit.noise)
        stated = batch_covariances(batch, fixed, fit, model, options)
    return BatchSolution(
        batch,
        pixels,
        fit,
        stated,
        model,
        noise,
        T_starts[:, 0],
        evidence,
        has_preference,
        needs_gradient,
    )


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


def _given_evidence(evidence: Any, like: torch.Tensor) -> torch.Tensor | None:
    """Return the evidence (B, 4) as handed in, or None."""
    if evidence is None:
        return None
    value = as_tensor(evidence, "PoseSeed.evidence", like.device).detach().double()
    expected = (len(like), EVIDENCE)
    if tuple(value.shape) != expected:
        raise InputError(
            f"refine_batch: expected PoseSeed.evidence of shape {expected}, "
            f"got {tuple(value.shape)}."
        )
    return value


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
