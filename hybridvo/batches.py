"""A batch of pairs in, their camera motions out: fitted in torch, and judged as those of a pair.

Read it beside :mod:`hybridvo.pipeline`. A batch is not searched for motions: where it starts, and
which pixels count, follows from a :class:`~hybridvo.solver.torch.tools.PoseSeed`.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
import torch
from scipy.special import logit

from hybridvo.core.calibration import MIN_PROBABILITY
from hybridvo.core.geometry import agreement
from hybridvo.core.options import RefineOptions
from hybridvo.core.results import UNINFORMATIVE_COVARIANCE, Status
from hybridvo.core.torch_geometry import pp, to_matrix
from hybridvo.core.types import PairBatch
from hybridvo.flow.calibration import DIS_NOISE
from hybridvo.hypotheses.select import ChoiceEvidence
from hybridvo.judge.calibration import AGREEMENT_RIGHT
from hybridvo.judge.probability import choice_probability
from hybridvo.judge.verdict import as_probable
from hybridvo.solver.pixels import too_few
from hybridvo.solver.status import FitSummary, degeneracy, status_of
from hybridvo.solver.torch.backend import BatchSolution, solve_batch
from hybridvo.solver.torch.batched_pose import BatchedPose
from hybridvo.solver.torch.factors import Pixels
from hybridvo.solver.torch.tools import uncompiled


class Probabilities(NamedTuple):
    """How probable the motions are."""

    values: list[float]  # NaN where nothing states it
    # (B, 2) of which they are a function, where calibrated
    evidence: torch.Tensor | None


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
    with torch.autocast(_device_type(batch), enabled=False):
        solution = solve_batch(batch, T_init, weights, noise, kernel, options)
        with torch.no_grad():
            result = judged_batch(solution, min_probability, options)
        return solution.with_gradient(result)


def judged_batch(
    solution: BatchSolution, min_probability: float, options: RefineOptions
) -> BatchedPose:
    """Return the motions of a batch with probability, status and covariance.

    Args:
        solution: the fit.
        min_probability: the probability below which a motion is degraded.
        options: of the refinement.
    """
    batch = solution.batch
    fit = solution.fit
    stated = solution.stated
    pixels = solution.pixels.map(torch.Tensor.detach)
    T = fit.T
    followers = stated.weights.sum(dim=(1, 2))
    estimates = stated.motions
    probabilities = _probabilities(solution)
    status = []
    for k, estimate in enumerate(estimates):
        failure = _too_few_pixels(batch, pixels, k, options.min_pixels)
        summary = FitSummary(
            is_determined=estimate.tiles > 0,
            inlier_ratio=float(stated.inlier_ratio[k]),
            followers=float(followers[k]),
            converged=bool(fit.converged[k]),
            max_steps=fit.max_steps,
            is_seed=bool(fit.is_seed[k]),
        )
        degenerate = degeneracy(estimate, _size(batch), options)
        of_fit = status_of(summary, stated.depths[k], degenerate)
        probable = as_probable(of_fit, probabilities.values[k], min_probability)
        status.append(failure or probable)
    covariance = [
        estimate.covariance if one.usable else UNINFORMATIVE_COVARIANCE
        for estimate, one in zip(estimates, status, strict=True)
    ]
    failed = torch.tensor([not one.usable for one in status], device=T.device)
    identity = pp.identity_SE3(len(T), dtype=T.dtype, device=T.device)
    probability = fit.followers.new_tensor(probabilities.values)
    noise = fit.noise
    return BatchedPose(
        SE3=pp.SE3(torch.where(failed[:, None], identity.tensor(), T.tensor())),
        covariance=torch.as_tensor(np.stack(covariance), device=T.device),
        converged=fit.converged & ~failed,
        failed=failed,
        status=status,
        probability=torch.where(failed, torch.zeros_like(probability), probability),
        iterations=fit.iterations,
        cost=stated.cost,
        weights=stated.weights,
        noise=torch.where(torch.isfinite(noise), noise, torch.ones_like(noise)),
        inlier_ratio=stated.inlier_ratio,
        evidence=probabilities.evidence,
    )


def _size(batch: PairBatch) -> tuple[int, int]:
    """Return (H, W) of the images."""
    height, width = batch.depth_prev.shape[1:]
    return height, width


def _too_few_pixels(
    batch: PairBatch, pixels: Pixels, k: int, min_pixels: int
) -> Status | None:
    """Return the failure of a sample with too few usable pixels, or None."""
    usable = int((pixels.weight[k] > 0).sum())
    if usable >= min_pixels:
        return None
    depth = batch.depth_prev[k].detach().cpu().numpy()
    flow = batch.flow[k].detach().cpu().numpy()
    return Status.failed(*too_few(depth, flow, usable, min_pixels))


def _probabilities(solution: BatchSolution) -> Probabilities:
    """Return how probable it is that each motion is the camera's.

    With the evidence of a choice it is calibrated. Without, it is the squared fraction of the
    weight that follows this motion, over the sum of its square and a rival's.
    """
    fit = solution.fit
    own2 = fit.followers**2
    alone = own2 / (own2 + fit.rivals**2).clamp(min=1e-12)
    if solution.evidence is None:
        uncalibrated = torch.where(solution.has_preference, alone, torch.nan)
        return Probabilities(uncalibrated.tolist(), None)
    starts = to_matrix(solution.starts).double().cpu().numpy()
    # of a seed that was kept, whether the solution agrees with it
    motions = to_matrix(fit.solution).double().cpu().numpy()
    lead = [_lead(chosen) for chosen in solution.evidence.tolist()]
    noise_px = fit.noise[:, 0].tolist()
    evidence = fit.followers.new_zeros(len(motions), 2)
    for k, estimate in enumerate(solution.stated.motions):
        if estimate.tiles == 0:
            continue
        # no network's motion is as exact as flow with less noise than DIS would allow
        ratio = max(1.0, DIS_NOISE[0] / max(noise_px[k], 1e-9))
        agreed = agreement(starts[k], motions[k], ratio**2 * estimate.covariance)
        evidence[k] = evidence.new_tensor((lead[k], math.log(agreed)))
    weights = evidence.new_tensor([1.0, AGREEMENT_RIGHT])
    return Probabilities(torch.sigmoid(evidence @ weights).tolist(), evidence)


def _lead(chosen: list[float]) -> float:
    """Log odds of a choice; 0 where nothing speaks for or against it."""
    if any(math.isnan(number) for number in chosen):
        return 0.0
    # in single precision, as what else a network states
    return float(np.float32(logit(choice_probability(ChoiceEvidence(*chosen)))))


def _device_type(batch: Any) -> str:
    """The kind of device of a batch; of anything else the CPU's, until it is refused."""
    return batch.flow.device.type if isinstance(batch, PairBatch) else "cpu"
