"""Status and probability of the motions of a batch."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
import torch

from hybridvo.core.geometry import agreement
from hybridvo.core.options import RefineOptions
from hybridvo.core.results import (
    UNINFORMATIVE_COVARIANCE,
    Status,
)
from hybridvo.core.torch_geometry import pp, to_matrix
from hybridvo.core.types import PairBatch
from hybridvo.flow.calibration import DIS_NOISE
from hybridvo.solver.calibration import AGREEMENT_RIGHT
from hybridvo.solver.covariance import MotionCovariance
from hybridvo.solver.pixels import too_few
from hybridvo.solver.status import FitSummary, degeneracy, status_of
from hybridvo.solver.torch.batched_pose import BatchedPose
from hybridvo.solver.torch.covariance import BatchCovariance
from hybridvo.solver.torch.factors import Pixels
from hybridvo.solver.torch.solve import BATCH_STEPS, BatchFit


class StartEvidence(NamedTuple):
    """What is known about the motions beside the pixels."""

    start: pp.LieTensor  # (B, 7) the first of those handed in
    # (B,) how much surer the network is of it than of another motion
    lead: torch.Tensor | None
    # (B,) whether the weights prefer some pixels to others
    has_preference: torch.Tensor
    min_probability: float  # below it a motion is degraded


class Probabilities(NamedTuple):
    """How probable the motions are."""

    values: list[float]  # NaN where nothing states it
    # (B, 3) of which they are a function, where calibrated
    evidence: torch.Tensor | None


def judged_batch(
    batch: PairBatch,
    pixels: Pixels,
    fit: BatchFit,
    stated: BatchCovariance,
    start_evidence: StartEvidence,
    options: RefineOptions,
) -> BatchedPose:
    """Return the motions of a batch with probability, status and covariance.

    Args:
        batch: checked.
        pixels: of the batch, without gradient.
        fit: the motions.
        stated: the covariances of the motions, and what they rest on.
        start_evidence: what is known beside the pixels.
        options: of the refinement.
    """
    T = fit.T
    statistics = stated.statistics
    weight = pixels.weight
    total = weight.sum(dim=1).clamp(min=1e-30)
    near = (statistics.robust > 0) & (statistics.distance2 <= options.cutoff**2)
    inlier_ratio = torch.nan_to_num((weight * near).sum(dim=1) / total)
    robust = statistics.followed(pixels).view_as(batch.depth_prev)
    followers = robust.sum(dim=(1, 2))

    estimates = stated.motions
    probabilities = _probabilities(fit, start_evidence, estimates)
    status = []
    for k, estimate in enumerate(estimates):
        failure = _too_few_pixels(batch, pixels, k, options.min_pixels)
        summary = FitSummary(
            is_determined=estimate.tiles > 0,
            inlier_ratio=float(inlier_ratio[k]),
            followers=float(followers[k]),
            converged=bool(fit.converged[k]),
            max_steps=BATCH_STEPS,
            is_seed=bool(fit.is_seed[k]),
        )
        status.append(
            failure
            or status_of(
                summary,
                stated.depths[k],
                probabilities.values[k],
                start_evidence.min_probability,
                degeneracy(estimate, _size(batch), options),
            )
        )
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
        cost=torch.nan_to_num((weight * statistics.cost).sum(dim=1) / total),
        weights=robust,
        noise=torch.where(torch.isfinite(noise), noise, torch.ones_like(noise)),
        inlier_ratio=inlier_ratio,
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


def _probabilities(
    fit: BatchFit,
    start_evidence: StartEvidence,
    estimates: list[MotionCovariance],
) -> Probabilities:
    """Return how probable it is that each motion is the camera's.

    With the lead of a network it is calibrated. Without, it is the squared fraction of the weight
    that follows this motion, over the sum of its square and a rival's.
    """
    own2 = fit.followers**2
    alone = own2 / (own2 + fit.rivals**2).clamp(min=1e-12)
    if start_evidence.lead is None:
        uncalibrated = torch.where(start_evidence.has_preference, alone, torch.nan)
        return Probabilities(uncalibrated.tolist(), None)
    starts = to_matrix(start_evidence.start).double().cpu().numpy()
    # of a seed that was kept, whether the solution agrees with it
    motions = to_matrix(fit.solution).double().cpu().numpy()
    lead = start_evidence.lead.tolist()
    noise_px = fit.noise[:, 0].tolist()
    evidence = fit.followers.new_zeros(len(motions), 2)
    for k, estimate in enumerate(estimates):
        if estimate.tiles == 0:
            continue
        # no network's motion is as exact as flow with less noise than DIS would allow
        ratio = max(1.0, DIS_NOISE[0] / max(noise_px[k], 1e-9))
        agreed = agreement(starts[k], motions[k], ratio**2 * estimate.covariance)
        evidence[k] = evidence.new_tensor((lead[k], math.log(agreed)))
    weights = evidence.new_tensor([1.0, AGREEMENT_RIGHT])
    return Probabilities(torch.sigmoid(evidence @ weights).tolist(), evidence)
