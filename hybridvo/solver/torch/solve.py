"""The motions and the noise of a batch of pairs, from their starts.

The order is that of the numba refinement: a robust kernel whose scale falls, noise and motion in
turn, then Newton steps on all pixels.
"""

from __future__ import annotations

from functools import partial
from typing import NamedTuple

import numpy as np
import torch

from hybridvo.core.options import RefineOptions
from hybridvo.core.torch_geometry import left_update, pp, to_matrix
from hybridvo.core.types import PairBatch
from hybridvo.solver import kernels
from hybridvo.solver.calibration import (
    LARGEST_SEED_DISTANCE2,
    LARGEST_SOLUTION_DISTANCE2,
    RIVAL_SCALES,
    RIVAL_WEIGHT,
    SEED_FRACTION,
    SEED_SCALE_PX,
    SEED_STDS,
)
from hybridvo.solver.noise_estimation import START_NOISE, Noise, pair_noise
from hybridvo.solver.pixels import grid_stride
from hybridvo.solver.refine_flow import FULL_STEPS
from hybridvo.solver.robust_fit import (
    LARGEST_SCALE_PX,
    SCALE_PER_RESIDUAL,
    SMALLEST_SCALE_PX,
)
from hybridvo.solver.torch import factors
from hybridvo.solver.torch.by_pairs import PairFit, fit_pairs, rested_at
from hybridvo.solver.torch.factors import (
    KERNELS,
    MAX_STEP_RATIO,
    NormalEquations,
    Pixels,
    ResidualModel,
    exact_depth_model,
)
from hybridvo.solver.torch.newton import Rest, Rested, newton, small_inverse

# Factor from one scale to the next in the fit of a batch, which makes one step at each scale.
BATCH_SCALE_RATIO = 0.7
# Most Newton steps on all pixels of a batch.
BATCH_STEPS = 20
# Gauss-Newton steps after each estimate of the noise of a batch.
BATCH_NOISE_STEPS = (2, 3, 3, 0)
# Length of the last step of a batch, standard deviations.
BATCH_STEP_TOLERANCE_STD = 4.0
# The same near a solution that the gradient needs exactly: there the full derivative may be much
# flatter than H, and is right. See MAX_STEP_RATIO.
MAX_EXACT_STEP_RATIO = 100.0
# Steps of a batch between two exact derivatives.
EXACT_PERIOD = 3

# Pixels of each sample on which starts are refined.
SUBSET_PIXELS = 2048
# numerical guards: a covariance of a seed may be singular
SMALLEST_STD_M = 1e-6
SMALLEST_STD_RAD = 1e-6
# below it a pixel counts for nothing
SMALLEST_WEIGHT = 1e-12


class Starts(NamedTuple):
    """Where the motions of a batch may begin."""

    T: pp.LieTensor  # (B, S, 7)
    # (S,) whether something is known of the motion, other than the identity
    is_seed: list[bool]
    # (B, 6, 6) of the seeds' left perturbation; None: their residuals show how good they are
    covariance: torch.Tensor | None


class SearchRegion(NamedTuple):
    """Where the motions of a batch are sought: around their seeds, as their covariances state."""

    seed: pp.LieTensor  # (B, 7)
    # (B, 6, 6) inverse covariance of the left perturbation; 0: the motion may be anywhere
    information: torch.Tensor

    def distance2(self, T: pp.LieTensor) -> torch.Tensor:
        """Return the squared Mahalanobis distance (B,) of poses (B, 7), per direction."""
        return self._distance2(self._away(T))

    def pulled_back(self, T: pp.LieTensor) -> pp.LieTensor:
        """Return poses (B, 7), those outside of the region at its border."""
        away = self._away(T)
        ratio = LARGEST_SEED_DISTANCE2 / self._distance2(away).clamp(min=1e-12)
        is_outside = (ratio < 1)[:, None]
        border = left_update(ratio.sqrt()[:, None] * away, self.seed)
        return pp.SE3(torch.where(is_outside, border.tensor(), T.tensor()))

    def covariance_to(self, T: pp.LieTensor) -> torch.Tensor:
        """Return the covariance (B, 6, 6) of seeds beside which poses (B, 7) may be right."""
        away = self._away(T)
        covariance, _ = small_inverse(self.information)
        even = 0.5 * (covariance + covariance.mT)
        return even + away[:, :, None] * away[:, None, :]

    def _away(self, T: pp.LieTensor) -> torch.Tensor:
        return (T @ self.seed.Inv()).Log().tensor()

    def _distance2(self, away: torch.Tensor) -> torch.Tensor:
        return torch.einsum("bi,bij,bj->b", away, self.information, away) / 6


class BatchFit(NamedTuple):
    """Motions of a batch, before they are judged."""

    T: pp.LieTensor  # (B, 7)
    # (B, 7) the solution of the equations; T is the seed where that lies outside of its region
    solution: pp.LieTensor
    is_seed: torch.Tensor  # (B,) whether T is the seed for that reason
    region: SearchRegion
    noise: torch.Tensor  # (B, 2) px, log depth
    followers: torch.Tensor  # (B,) fraction of the weight that follows the motion
    # (B,) fraction that follows another motion instead, fitted from the identity
    rivals: torch.Tensor
    converged: torch.Tensor  # (B,)
    iterations: torch.Tensor  # (B,) Newton steps
    subset: Pixels  # some pixels of each sample
    curvature: torch.Tensor  # (B, 6, 6) of the robust weights
    # (B, 6, 6) covariance of the gradient if errors are independent
    meat: torch.Tensor
    max_steps: int  # most Newton steps
    # of the samples alone, where these were fitted one after the other
    by_pair: list[PairFit | None] | None = None


def solve(
    batch: PairBatch,
    weights: torch.Tensor | None,
    pixels: Pixels,
    starts: Starts,
    noise: torch.Tensor | None,
    model: ResidualModel,
    options: RefineOptions,
    exact: bool,
) -> BatchFit:
    """Find the motion of every sample.

    Args:
        batch: checked.
        weights: (B, H, W) factors on the information, or None.
        pixels: of the batch, without gradient.
        starts: of every sample.
        noise: (B, 2) handed in; None: it is estimated.
        model: the robust kernel; its noise is not used.
        options: of the refinement.
        exact: solve as exactly as a gradient needs.
    """
    weight = pixels.weight
    subset = pixels.subset(SUBSET_PIXELS)
    last_scale = weight.new_full((len(weight),), SMALLEST_SCALE_PX)
    if noise is not None:
        last_scale = torch.maximum(last_scale, noise[:, 0].detach())

    # the surest pixels decide which motion it is, more of them decide how exactly
    largest = subset.weight.amax(1, True).clamp(min=1e-30)
    surest = subset._replace(weight=subset.weight.square() / largest)
    T, largest_scale, region = _best_start(surest, starts, last_scale)
    prefers = _prefers_some(subset)
    if bool(prefers.any()):
        by_more = _anneal(subset, T, largest_scale, last_scale, region)
        T = pp.SE3(torch.where(prefers[:, None], by_more.tensor(), T.tensor()))
    followers, rivals = _followers_and_rivals(surest, T, last_scale)

    by_pair = None
    if noise is None and is_answered_by_pairs(model, weight):
        by_pair = fit_pairs(batch, weights, T, options)
        rested, current = rested_at(by_pair, T)
        T = rested.state
        model = model._replace(noise=current)
    else:
        first_noise = weight.new_tensor(list(START_NOISE)).repeat(len(T), 1)
        model = model._replace(noise=first_noise)
        for steps in BATCH_NOISE_STEPS:
            if noise is None:
                current = _estimate_noise(batch, pixels, T, model, options)
            else:
                current = noise.detach()
            model = model._replace(noise=current)
            T = factors.gauss_newton(subset, T, partial(_same, model), steps)

    curvature, meat = _score_products(subset, pixels, T, model)
    if by_pair is None or exact:
        rested = _newton(pixels, subset, T, model, curvature, exact)
    solution = rested.state
    is_seed = region.distance2(solution) > LARGEST_SOLUTION_DISTANCE2
    T = pp.SE3(
        torch.where(is_seed[:, None], region.seed.tensor(), solution.tensor())
    )
    return BatchFit(
        T=T,
        solution=solution,
        is_seed=is_seed,
        region=region,
        noise=model.noise,
        followers=followers,
        rivals=rivals,
        converged=rested.converged,
        iterations=rested.iterations,
        subset=subset,
        curvature=curvature,
        meat=meat,
        max_steps=BATCH_STEPS if by_pair is None or exact else FULL_STEPS,
        by_pair=by_pair,
    )


def is_answered_by_pairs(model: ResidualModel, weight: torch.Tensor) -> bool:
    """Return whether each sample gets the fit of a pair: with that kernel, on a CPU."""
    return model.name == KERNELS[0] and weight.device.type == "cpu"


def _prefers_some(pixels: Pixels) -> torch.Tensor:
    """Return (B,) whether some pixels of a sample weigh more than others of it."""
    weight = pixels.weight
    is_less = (weight > 0) & (weight < weight.amax(1, True))
    return is_less.any(dim=1)


def _best_start(
    pixels: Pixels, starts: Starts, last_scale: torch.Tensor
) -> tuple[pp.LieTensor, torch.Tensor, SearchRegion]:
    """Anneal every start, and return the motion of least cost of each sample.

    Returns:
        (B, 7) the motion, (B,) the largest scale, px, at which it may be annealed, and the region
        of its start.
    """
    batch, count = starts.T.shape[:2]
    repeated = Pixels(*(x.repeat_interleave(count, dim=0) for x in pixels))
    first = pp.SE3(starts.T.tensor().flatten(0, 1))
    largest = _largest_scales(repeated, first, starts)
    scales = last_scale.repeat_interleave(count)
    information = _seed_information(starts)
    region = SearchRegion(first, information.flatten(0, 1))
    T = _anneal(repeated, first, largest, scales, region)
    cost = factors.linearize(repeated, T, exact_depth_model(scales)).cost
    cost = torch.nan_to_num(cost.reshape(batch, count), nan=torch.inf)
    index = torch.arange(batch, device=cost.device)
    best = cost.argmin(dim=1)
    motions = T.tensor().reshape(batch, count, 7)
    seed = pp.SE3(starts.T.tensor()[index, best])
    return (
        pp.SE3(motions[index, best]),
        largest.reshape(batch, count)[index, best],
        SearchRegion(seed, information[index, best]),
    )


def _seed_information(starts: Starts) -> torch.Tensor:
    """Return the inverse covariance (B, S, 6, 6) of every start; 0 where there is none."""
    batch, count = starts.T.shape[:2]
    none = starts.T.tensor().new_zeros(batch, count, 6, 6)
    if starts.covariance is None:
        return none
    variance = none.new_tensor([SMALLEST_STD_M**2] * 3 + [SMALLEST_STD_RAD**2] * 3)
    covariance = starts.covariance.to(none) + torch.diag_embed(variance)
    information, exists = small_inverse(covariance)
    is_seed = torch.tensor(starts.is_seed, device=none.device)
    known = exists[:, None] & is_seed
    return torch.where(known[..., None, None], information[:, None], none)


def _largest_scales(
    pixels: Pixels, T: pp.LieTensor, starts: Starts
) -> torch.Tensor:
    """Return the largest scale (B S,) of the robust kernel at which a start may be annealed, px.

    Annealing from a wide kernel forgets where it began, and follows whatever most pixels do.
    A seed is not to be forgotten: the kernel is as wide as the seed may be off. Where no
    covariance states that, a pixel is assumed, and more where hardly any pixel fits the seed.
    """
    if starts.covariance is None:
        best = factors.typical_residual(pixels, T, SEED_FRACTION)
        accuracy = (SCALE_PER_RESIDUAL * best).clamp(min=SEED_SCALE_PX)
    else:
        covariance = starts.covariance.repeat_interleave(len(starts.is_seed), dim=0)
        accuracy = SEED_STDS * factors.displacement(pixels, T, covariance)
    is_seed = torch.tensor(starts.is_seed, device=accuracy.device)
    is_seed = is_seed.repeat(len(T) // len(starts.is_seed))
    accuracy = torch.nan_to_num(accuracy, nan=LARGEST_SCALE_PX)
    accuracy = accuracy.to(pixels.weight).clamp(max=LARGEST_SCALE_PX)
    return torch.where(is_seed, accuracy, LARGEST_SCALE_PX)


def _anneal(
    pixels: Pixels,
    T: pp.LieTensor,
    largest_scale: torch.Tensor,
    last_scale: torch.Tensor,
    region: SearchRegion | None = None,
) -> pp.LieTensor:
    """Make one Gauss-Newton step at each scale of the robust kernel, inside of a region.

    The first scale follows the residuals, up to the largest one (B,); the last one is (B,); px.
    """
    scale = SCALE_PER_RESIDUAL * factors.typical_residual(pixels, T)
    scale = torch.minimum(scale.clamp(min=1.0), largest_scale)
    scale = torch.maximum(scale, last_scale)
    scales = [scale]
    while bool((scales[-1] > last_scale).any()):
        scales.append(torch.maximum(scales[-1] * BATCH_SCALE_RATIO, last_scale))

    def linearized(number: int, T: pp.LieTensor) -> NormalEquations:
        at = factors.linearize(pixels, T, exact_depth_model(scales[number]))
        if number == 0:
            return at
        # a sample that has had its last scale stays where it is
        is_active = scales[number - 1] > last_scale
        return at._replace(g=torch.where(is_active[:, None], at.g, 0.0))

    def moved(
        T: pp.LieTensor, delta: torch.Tensor, _: NormalEquations
    ) -> pp.LieTensor:
        T = left_update(delta, T)
        return T if region is None else region.pulled_back(T)

    return newton(linearized, moved, T, len(scales)).state


def _same(model: ResidualModel, number: int, T: pp.LieTensor) -> ResidualModel:
    return model


def _followers_and_rivals(
    pixels: Pixels, T: pp.LieTensor, last_scale: torch.Tensor
) -> tuple[torch.Tensor, torch.Tensor]:
    """Return which fractions (B,) of the weight follow a motion, and another one instead.

    The other is fitted, from the identity, to the pixels that do not follow the first.
    """
    model = exact_depth_model(RIVAL_SCALES * last_scale)
    total = pixels.total.clamp(min=1e-30)

    def follows(part: Pixels, motion: pp.LieTensor) -> torch.Tensor:
        return factors.weigh(part, to_matrix(motion), model).robust > RIVAL_WEIGHT

    def weight_ratio(part: Pixels, mask: torch.Tensor) -> torch.Tensor:
        return torch.nan_to_num((part.weight * mask).double().sum(dim=1) / total)

    mask = follows(pixels, T)
    rest = pixels._replace(weight=pixels.weight * ~mask)
    identity = pp.identity_SE3(len(T), dtype=T.dtype, device=T.device)
    widest = torch.full_like(last_scale, LARGEST_SCALE_PX)
    other = _anneal(rest, identity, widest, last_scale)
    return weight_ratio(pixels, mask), weight_ratio(rest, follows(rest, other))


def _estimate_noise(
    batch: PairBatch,
    pixels: Pixels,
    T: pp.LieTensor,
    model: ResidualModel,
    options: RefineOptions,
) -> torch.Tensor:
    """Estimate the noise (B, 2) at the motions as the numba refinement does, on its coarse grid.

    A sample for which that fails keeps the noise of the model.
    """
    buffers = coarse_buffers(batch, pixels, options)
    K = batch.K_curr[:, [0, 1, 0, 1], [0, 1, 2, 2]].float().cpu().numpy()
    poses = to_matrix(T)[:, :3].cpu().numpy()
    uses_depth = options.current_depth != "off" and batch.depth_curr is not None
    noise = model.noise.tolist()
    for k, buffer in enumerate(buffers):
        if not (np.isfinite(poses[k]).all() and (buffer[kernels.W] > 0).any()):
            continue
        depth_curr = None
        if uses_depth and batch.depth_curr is not None:
            depth_curr = batch.depth_curr[k].float().cpu().numpy()
        estimate = pair_noise(
            buffer,
            buffer.shape[1],
            K[k],
            poses[k],
            Noise(*noise[k]),
            options.cutoff,
            depth_curr,
        )
        if np.isfinite(estimate.noise).all():
            noise[k] = list(estimate.noise)
    return model.noise.new_tensor(noise)


def coarse_buffers(
    batch: PairBatch, pixels: Pixels, options: RefineOptions
) -> np.ndarray:
    """Return the pixel buffers (B, BUFFER_ROWS, n) of the coarse grid, float32."""
    height, width = batch.depth_prev.shape[1:]
    stride = grid_stride((height, width), options.coarse_pixels)
    every = slice(stride // 2, None, stride)

    def sample(x: torch.Tensor) -> torch.Tensor:
        return x.unflatten(-1, (height, width))[..., every, every].flatten(-2)

    subset = pixels.map(sample)
    z = subset.points[:, 2:]
    # in the order of the rows in hybridvo.solver.kernels
    rows = (
        subset.points[:, :2] / z,
        z,
        subset.target,
        1 / subset.flow_variance[:, None],
        subset.depth_variance[:, None],
        subset.weight[:, None],
    )
    return torch.cat(rows, dim=1).float().cpu().numpy()


def _score_products(
    subset: Pixels, pixels: Pixels, T: pp.LieTensor, model: ResidualModel
) -> tuple[torch.Tensor, torch.Tensor]:
    """Return curvature of the robust weights and meat (B, 6, 6) of all pixels, from a subset."""
    at = factors.weigh(subset, to_matrix(T), model)
    scores = torch.stack(at.scores(), dim=1).double()
    w = (subset.weight * at.robust)[:, None]
    slope = model.kernel(at.distance2).slope[:, None]
    factor = torch.where(
        w > SMALLEST_WEIGHT, slope / w.clamp(min=SMALLEST_WEIGHT), 0.0
    )
    scale = _weight_ratio(pixels, subset)
    curvature = scale * (scores * factor) @ scores.mT
    meat = scale * scores @ scores.mT
    return curvature, meat


def _weight_ratio(pixels: Pixels, subset: Pixels) -> torch.Tensor:
    """Return the weight of all pixels over that of a subset, (B, 1, 1)."""
    return (pixels.total / subset.total.clamp(min=1e-12))[:, None, None]


def _newton(
    pixels: Pixels,
    subset: Pixels,
    T: pp.LieTensor,
    model: ResidualModel,
    curvature: torch.Tensor,
    exact: bool,
) -> Rested[pp.LieTensor]:
    """Make Newton steps on all pixels, each sample until it has come to rest.

    Args:
        pixels: all pixels.
        subset: a subset, for the exact derivative.
        T: (B, 7) starts.
        model: noise and robust kernel.
        curvature: (B, 6, 6) of the robust weights.
        exact: go on to the precision of the numbers, with the exact derivative now and then.
    """
    if not exact:

        def linearized(_: int, T: pp.LieTensor) -> NormalEquations:
            return factors.linearize(pixels, T, model)._replace(curvature=curvature)

        rest = Rest(BATCH_STEP_TOLERANCE_STD**2)
        return newton(linearized, factors.moved, T, BATCH_STEPS, rest)

    last = curvature

    def exactly(number: int, T: pp.LieTensor) -> NormalEquations:
        nonlocal last
        if number % EXACT_PERIOD == EXACT_PERIOD - 1:
            # the derivative of the residual and of its Jacobian as well
            full = factors.newton_matrix(subset, T, model)
            missing = factors.linearize(subset, T, model).H - full
            last = missing * _weight_ratio(pixels, subset)
        ratio = MAX_EXACT_STEP_RATIO if number > 1 else MAX_STEP_RATIO
        at = factors.linearize(pixels, T, model)
        return at._replace(curvature=last, max_step_ratio=ratio)

    rounding = torch.finfo(pixels.weight.dtype).eps ** 0.5
    rest = Rest(0.0, moved=rounding)
    return newton(exactly, factors.moved, T, BATCH_STEPS, rest)
