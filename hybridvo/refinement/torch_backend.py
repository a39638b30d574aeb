"""The refinement of a batch of pairs in torch: CPU or GPU, float32 or float64, differentiable.

The gradient is that of the implicit function theorem: the estimate solves
g(T, inputs, noise) = 0, so d xi = A^-1 dg with A = -dg / d xi. It is attached by one Newton step
of value zero. What is held:

* With ``noise`` given it is the gradient of the solution itself, also with respect to the noise.
* With estimated noise it is that of the solution with the noise held at its estimate.
* ``T_init``, covariance, probability and status carry none, and there is no second derivative.

Samples never see each other.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from typing import Any, NamedTuple, ParamSpec, TypeVar

import numpy as np
import torch

from hybridvo.calibration import DIS_NOISE, MIN_PROBABILITY, MIN_TILES, PWVO_RIGHT
from hybridvo.checks import brief, check_kind
from hybridvo.errors import InputError
from hybridvo.geometry import agreement
from hybridvo.options import RefineOptions
from hybridvo.refinement import kernels
from hybridvo.refinement import torch_factors as factors
from hybridvo.refinement.covariance import UPPER, motion_covariance
from hybridvo.refinement.depth import DepthAgreement, compare_depths
from hybridvo.refinement.pixels import grid_stride, too_few
from hybridvo.refinement.refine import degeneracy, pair_noise, status_of
from hybridvo.refinement.solver import tile_size
from hybridvo.refinement.torch_factors import (
    CUTOFF,
    KERNELS,
    Pixels,
    ResidualModel,
    flow_noise,
)
from hybridvo.results import (
    UNINFORMATIVE_COVARIANCE,
    Reason,
    RelativePose,
    Status,
    probability_right,
)
from hybridvo.torch_geometry import left_update, pp, se3
from hybridvo.types import Camera, Frame, FramePair, PairBatch

P = ParamSpec("P")
R = TypeVar("R")
# pixels on which starts are refined; most steps on all pixels
SUBSET_PIXELS = 2048
STEPS = 20
# scale of the kernel: first, last; factor
LARGEST_PX = 64.0
SMALLEST_PX = 0.4
GNC_RATIO = 0.7
# std: of the last step; shorter ones are rounding
STEP_TOLERANCE_SIGMA = 4.0
ROUNDED_STEP = 0.05
INLIER_DISTANCE2 = 9.0  # squared distance of an inlier, standard deviations
# 95 % efficient under normal noise
CUTOFFS = {"cauchy": 2.385, "huber": 1.345, "l2": 1.0}
# a rival's part in the evidence counts from this share to one less it
LARGEST_ODDS = 1e-3
NO_SEARCH = Status.degraded(
    Reason.AMBIGUOUS_MOTION,
    "a batch without weights does not search for other motions, so that this one may be an "
    "object's; give weights, as of hybridvo.select(hybridvo.PWVO.from_pretrained()(batch)), or "
    "call hybridvo.estimate for each pair",
)
NOT_CONVERGED = Status.degraded(
    Reason.SOLVER_DIVERGED, f"not converged after {STEPS} steps"
)


@dataclass(frozen=True, eq=False)
class BatchedPose:
    """Camera motions of a batch of B pairs, as in :class:`hybridvo.results.RelativePose`.

    Attributes:
        SE3: pypose SE3 (B, 7) of T_curr_prev, metres; the identity where failed. It carries the
            gradient.
        covariance: (B, 6, 6) of the left perturbation (translation, rotation) in the current
            camera; m^2, m rad, rad^2. Positive definite, in float64: single precision cannot hold
            that of a motion whose rotation is known a million times as well.
        converged: (B,) bool.
        failed: (B,) bool.
        status: of every sample.
        probability: (B,) that this is the camera's motion; 0 where failed. Calibrated where the
            start is that of ``select``; with other weights, how little of them follows another
            motion, which is as right as the weights; NaN where there are none, or all are alike.
        iterations: (B,) Newton steps on all pixels.
        cost: (B,) robust cost per unit of weight, dimensionless.
        weights: (B, H, W) robust weights without the external ones, 0 where unusable.
        noise: (B, 2) standard deviations of flow, px, and of log depth.
        inlier_ratio: (B,) share of the external weight within three standard deviations.
        evidence: (B, 3) of which the calibrated probability is a function; None without it.
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
    evidence: torch.Tensor | None = None

    @property
    def T_curr_prev(self) -> torch.Tensor:
        """(B, 4, 4) points of the previous camera into the current one, metres."""
        return self.SE3.matrix().to(self.weights.dtype)

    def one(self, index: int) -> RelativePose:
        """The motion of one sample as every estimator gives it, in numpy."""
        evidence = (
            () if self.evidence is None else tuple(self.evidence[index].tolist())
        )
        return RelativePose(
            T_curr_prev=self.SE3[index].detach().matrix().double().cpu().numpy(),
            covariance=self.covariance[index].cpu().numpy(),
            status=self.status[index],
            inlier_ratio=min(1.0, float(self.inlier_ratio[index])),
            iterations=int(self.iterations[index]),
            cost=float(self.cost[index]),
            residual_scale_px=float(self.noise[index, 0]),
            depth_noise=float(self.noise[index, 1]),
            weights=self.weights[index].detach().float().cpu().numpy(),
            probability=float(self.probability[index]),
            evidence=evidence if self.status[index].usable else (),
            method="classical",
            terms=("flow",),
        )


def with_lead(T: torch.Tensor, lead: torch.Tensor) -> torch.Tensor:
    """The start T (B, 4, 4), marked with the lead (B,) of its network.

    ``refine_batch`` finds the mark on this very tensor; a changed copy has none.
    """
    T.lead = lead  # type: ignore[attr-defined]
    return T


def lead_of(T: Any) -> torch.Tensor | None:
    """The lead that a start is marked with, if it is."""
    return getattr(T, "lead", None)


def uncompiled(function: Callable[P, R]) -> Callable[P, R]:
    """The function, which ``torch.compile`` calls as it is: its loops depend on the data."""

    @functools.wraps(function)
    def call(*args: P.args, **named: P.kwargs) -> R:
        # not before: disable() loads the compiler, two seconds
        if torch.compiler.is_compiling():
            return torch.compiler.disable(function)(*args, **named)
        return function(*args, **named)

    return call


@uncompiled
def refine_batch(
    batch: PairBatch,
    T_init: Any = None,
    weights: Any = None,
    *,
    lead: Any = None,
    noise: Any = None,
    kernel: str = "geman-mcclure",
    options: RefineOptions | None = None,
    min_probability: float = MIN_PROBABILITY,
) -> BatchedPose:
    """Camera motion of every pair of a batch by robust dense reprojection.

    In the type of flow and depth, at least float32. Gradients reach flow, depth, intrinsics,
    variances, weights and ``noise``, not ``T_init``: see the module for what is held. Bad data give
    a failed status and a zero gradient for that very sample.

    A batch is not searched for other motions. Which one is found follows from the weights; without
    any, or where all of a sample are alike, its status is at best degraded and its probability NaN.

    Args:
        batch: see :class:`~hybridvo.types.PairBatch`.
        T_init: (B, 4, 4) or (B, S, 4, 4) T_curr_prev to start from, metres; in place of one that
            is not finite the identity. Without weights the identity is one more start.
        weights: (B, H, W) factors on the information, squared at first; positive, finite or unused.
        lead: (B,) by how much the network that ``T_init`` and the weights come from is surer of
            them than of another motion, for the calibrated probability; None: what ``select``
            marked ``T_init`` with.
        noise: standard deviations of flow, px, and of log depth, as (2,) or (B, 2); None:
            estimated, and held for the gradient.
        kernel: ``geman-mcclure``, with the cutoff of the options, ``cauchy``, ``huber`` or ``l2``.
        options: see :class:`~hybridvo.options.RefineOptions`.
        min_probability: the probability below which a motion is degraded.

    Raises:
        InputError: for values of another shape, type or device.
    """
    options = RefineOptions() if options is None else options
    check_kind("refine_batch.batch", batch, PairBatch)
    check_kind("refine_batch.options", options, RefineOptions)
    if not isinstance(kernel, str) or kernel not in KERNELS:
        names = ", ".join(KERNELS)
        raise InputError(
            f"refine_batch: unknown kernel {brief(kernel)}; known: {names}."
        )
    lead = lead_of(T_init) if lead is None else lead
    batch, weights = factors.checked_batch(batch, weights)
    starts = _initial_poses(T_init, batch.flow, alone=weights is not None)
    lead = _given_lead(lead, batch.flow, weights is not None and T_init is not None)
    given = _given_noise(noise, batch.flow)
    how = ResidualModel(torch.empty(0), CUTOFFS.get(kernel, options.cutoff), kernel)
    tensors = (*vars(batch).values(), weights, given)
    wanted = torch.is_grad_enabled() and any(
        x is not None and x.requires_grad for x in tensors
    )
    with torch.autocast(batch.flow.device.type, enabled=False):
        pixels = factors.gather_pixels(batch, weights)
        with torch.no_grad():
            fixed = pixels.map(torch.Tensor.detach)
            fit = _solve(batch, fixed, starts, given, how, options, tight=wanted)
            known = _Known(
                starts[:, 0], lead, _tell(weights, batch.flow), min_probability
            )
            result = _judged(batch, fixed, fit, known, options)
        if not wanted:
            return result
        T = result.SE3.detach()
        how = how._replace(noise=result.noise if given is None else given)
        A = factors.newton_matrix(pixels, T, how)
        g = factors.total_score(pixels, T.matrix(), how)
        return replace(
            result,
            SE3=factors.attach_implicit_gradient(T, A, g, ~result.failed[:, None]),
        )


def _initial_poses(T_init: Any, like: torch.Tensor, alone: bool) -> pp.LieTensor:
    """(B, S, 7) pypose SE3; ``alone``: without the identity beside what is handed in."""
    batch = len(like)
    unit = torch.eye(4, dtype=torch.float64, device=like.device)
    identity = unit.expand(batch, 1, 4, 4)
    if T_init is None:
        return se3(identity)
    if isinstance(T_init, pp.LieTensor):
        T_init = T_init.matrix()
    T = factors.as_tensor(T_init, "T_init", like.device).detach().double()
    if T.ndim == 3 or (T.ndim == 2 and batch == 1):
        T = T.reshape(-1, 1, *T.shape[-2:])
    if (
        T.ndim != 4
        or T.shape[0] != batch
        or T.shape[2:] != (4, 4)
        or T.shape[1] == 0
    ):
        shapes = f"({batch}, 4, 4) or ({batch}, S, 4, 4)"
        raise InputError(
            f"refine_batch: expected T_init of shape {shapes}, got {tuple(T.shape)}."
        )
    good = (T.abs() < 1e9).flatten(2).all(dim=2)
    T = torch.where(good[:, :, None, None], T, unit)
    return se3(T if alone else torch.cat([identity, T], dim=1))


def _given_lead(
    lead: Any, like: torch.Tensor, is_whole: bool
) -> torch.Tensor | None:
    """(B,) lead as handed in; ``is_whole``: with the start and the weights that it belongs to."""
    if lead is None or not is_whole:
        return None
    value = factors.as_tensor(lead, "lead", like.device).detach().double()
    if value.shape != like.shape[:1]:
        shape = f"({len(like)},)"
        raise InputError(
            f"refine_batch: expected lead of shape {shape}, got {tuple(value.shape)}."
        )
    return torch.nan_to_num(value, 0.0, 0.0, 0.0)


def _tell(weights: torch.Tensor | None, like: torch.Tensor) -> torch.Tensor:
    """(B,) whether weights prefer some pixels to others."""
    if weights is None:
        return torch.zeros(len(like), dtype=torch.bool, device=like.device)
    first = weights[:, :1, :1]
    return (weights != first).flatten(1).any(dim=1)


def _given_noise(noise: Any, like: torch.Tensor) -> torch.Tensor | None:
    """(B, 2) noise as handed in."""
    if noise is None:
        return None
    value = factors.as_tensor(noise, "noise", like.device).to(like.dtype)
    known = value.detach()
    fits = value.shape in ((2,), (len(like), 2))
    if (
        not fits
        or not ((known >= 0) & (known < torch.inf)).all()
        or (known[..., 0] == 0).any()
    ):
        expected = (
            f"noise (2,) or ({len(like)}, 2), flow's positive, depth's not negative"
        )
        got = f"{known.flatten()[:8].tolist()} of shape {tuple(known.shape)}"
        raise InputError(f"refine_batch: expected {expected}, finite, got {got}.")
    return value.expand(len(like), 2)


class _Fit(NamedTuple):
    """What the steps found, before it is judged."""

    T: pp.LieTensor  # (B, 7)
    noise: torch.Tensor  # (B, 2) px, log depth
    own: torch.Tensor  # (B,) share of the weight that follows this motion
    rival: torch.Tensor  # (B,) share that follows another near by, but not this one
    converged: torch.Tensor  # (B,)
    iterations: torch.Tensor  # (B,)
    # covariance, eigenvalues, tiles of each
    spread: list[tuple[np.ndarray, np.ndarray, int]]
    robust: torch.Tensor  # (B, N)
    distance2: torch.Tensor  # (B, N)
    cost: torch.Tensor  # (B, N)


class _Known(NamedTuple):
    """What is known of the motions beside the pixels."""

    start: pp.LieTensor  # (B, 7) the first of those handed in
    lead: torch.Tensor | None  # (B,) of the network that it comes from
    told: torch.Tensor  # (B,) whether weights say which pixels to trust
    min_probability: float


def _solve(
    batch: PairBatch,
    pixels: Pixels,
    starts: pp.LieTensor,
    given: torch.Tensor | None,
    how: ResidualModel,
    options: RefineOptions,
    tight: bool,
) -> _Fit:
    """From the starts (B, S, 7) to every sample's pose; ``tight``: as exact as a gradient needs."""
    weight = pixels.weight
    few = pixels.subset(SUBSET_PIXELS)
    end = weight.new_full((len(starts),), SMALLEST_PX)
    if given is not None:
        end = torch.maximum(end, given[:, 0].detach())
    # the surest pixels decide which motion, more of them how exactly
    sure = few._replace(
        weight=few.weight.square() / few.weight.amax(1, True).clamp(min=1e-30)
    )
    T = _graduate(sure, starts, end)
    # where all weigh alike, it is done
    if not torch.equal(sure.weight, few.weight):
        T = _shrink_scale(few, T, end)
    own, rival = _shares(sure, T, end)
    how = how._replace(noise=weight.new_tensor([0.5, 0.01]).repeat(len(T), 1))
    for steps in (2, 3, 3, 0):
        noise = (
            _noise(batch, pixels, T, how, options)
            if given is None
            else given.detach()
        )
        how = how._replace(noise=noise)
        for _ in range(steps):
            T = factors.stepped(few, T, how)
    spread = _curvature(few, pixels, T, how)
    T, converged, iterations = _fit_all(pixels, few, T, how, spread[0], tight)
    found, seen = _covariances(batch, pixels, few, T, how, spread, options)
    return _Fit(T, how.noise, own, rival, converged, iterations, found, *seen)


def _judged(
    batch: PairBatch,
    pixels: Pixels,
    fit: _Fit,
    known: _Known,
    options: RefineOptions,
) -> BatchedPose:
    """Status, probability and covariance of what was found."""
    T = fit.T
    weight = pixels.weight
    total = weight.sum(dim=1).clamp(min=1e-30)
    near = (fit.robust > 0) & (fit.distance2 <= INLIER_DISTANCE2)
    ratio = torch.nan_to_num((weight * near).sum(dim=1) / total)
    robust = (torch.nan_to_num(fit.robust) * (weight > 0)).view_as(batch.depth_prev)
    motions = T.matrix().double().cpu().numpy()
    depths = list(_depth_agreements(batch, motions, robust, options))
    spread = [
        _handed_out(*of) for of in zip(fit.spread, depths, motions, strict=True)
    ]
    probability, evidence = _probabilities(fit, known, motions, spread)
    covariances = []
    status = []
    height, width = batch.depth_prev.shape[1:]
    for k, (covariance, eigenvalues, tiles) in enumerate(spread):
        agreed = depths[k]
        doubts = (
            Status() if agreed is None else agreed.status,
            Status() if fit.converged[k] else NOT_CONVERGED,
            NO_SEARCH if math.isnan(probability[k]) else Status(),
        )
        doubt = next((doubt for doubt in doubts if not doubt.ok), Status())
        weak = degeneracy(eigenvalues, tiles, (height, width), options)
        judged = _bad_input(batch, pixels, k, options.min_pixels) or status_of(
            tiles > 0,
            float(ratio[k]),
            doubt,
            probability[k],
            known.min_probability,
            weak,
        )
        covariances.append(
            covariance if judged.usable else UNINFORMATIVE_COVARIANCE
        )
        status.append(judged)
    failed = torch.tensor([not s.usable for s in status], device=T.device)
    identity = pp.identity_SE3(len(T), dtype=T.dtype, device=T.device)
    stated = fit.own.new_tensor(probability)
    return BatchedPose(
        SE3=pp.SE3(torch.where(failed[:, None], identity.tensor(), T.tensor())),
        covariance=torch.as_tensor(np.stack(covariances), device=T.device),
        converged=fit.converged & ~failed,
        failed=failed,
        status=status,
        probability=torch.where(failed, torch.zeros_like(stated), stated),
        iterations=fit.iterations,
        cost=torch.nan_to_num((weight * fit.cost).sum(dim=1) / total),
        weights=robust,
        noise=torch.where(
            torch.isfinite(fit.noise), fit.noise, torch.ones_like(fit.noise)
        ),
        inlier_ratio=ratio,
        evidence=evidence,
    )


def _covariances(
    batch: PairBatch,
    pixels: Pixels,
    few: Pixels,
    T: pp.LieTensor,
    how: ResidualModel,
    spread: tuple[torch.Tensor, torch.Tensor],
    options: RefineOptions,
) -> tuple[list[tuple[np.ndarray, np.ndarray, int]], tuple[torch.Tensor, ...]]:
    """Covariance, eigenvalues, tiles of each; of a pixel robust weight, squared distance, cost."""
    height, width = batch.depth_prev.shape[1:]
    tile = tile_size((height, width), options.tiles)
    sums = []
    seen = []
    for part in pixels.parts(tile * width):
        at = factors.weigh(part, T.matrix(), how)
        roots, scores = (
            factors.to_tiles(x.unflatten(-1, (-1, width)), tile)
            for x in (at.whitened_jacobian(), torch.stack(at.scores(), dim=1))
        )
        roots = roots.permute(1, 3, 2, 0, 4).flatten(3)  # (B, tiles, 6, 2 n)
        H = roots @ roots.mT
        g = scores.sum(dim=3).mT
        sums.append(torch.cat([H, g[..., None]], dim=3))
        seen.append((at.robust, at.distance2, at.cost))
    # 1 / typical depth, as of the coarse grid: half of the weight may lie on a sky at 30 km
    usable = few.weight > 0
    z = few.points[:, 2]
    inverse = (
        ((usable / z**2).sum(dim=1) / usable.sum(dim=1).clamp(min=1))
        .sqrt()
        .clamp(min=1e-9)
    )
    # (B, rows, columns, 6, 7)
    Hg = torch.cat(sums, dim=1).unflatten(1, (-1, -(-width // tile)))
    image = torch.cat([Hg[..., UPPER[0], UPPER[1]], Hg[..., 6]], dim=3)
    values = (
        image,
        *spread,
        inverse,
        pixels.total,
        pixels.K[:, 0, 0],
        T.translation(),
        how.noise,
    )
    found = []
    for sample in zip(*(x.double().cpu().numpy() for x in values), strict=True):
        covariance = UNINFORMATIVE_COVARIANCE
        eigenvalues = np.zeros(6)
        occupied = 0
        if all(np.isfinite(x).all() for x in sample):
            covariance, eigenvalues, occupied = motion_covariance(*sample)
        found.append(
            (
                covariance * max(1.0, MIN_TILES / max(occupied, 1)),
                eigenvalues,
                occupied,
            )
        )
    return found, tuple(torch.cat(x, dim=1) for x in zip(*seen, strict=True))


def _depth_agreements(
    batch: PairBatch,
    motions: np.ndarray,
    robust: torch.Tensor,
    options: RefineOptions,
) -> Iterator[DepthAgreement | None]:
    """How the two depths of each sample agree under its motion; None where that is not known."""
    if batch.depth_curr is None or options.current_depth == "off":
        yield from [None] * len(motions)
        return
    maps = (batch.depth_prev, batch.depth_curr, batch.flow, robust)
    cameras = (batch.K_prev, batch.K_curr)
    tensors = [x.detach().double().cpu().numpy() for x in (*maps, *cameras)]
    for T, prev, curr, flow, weights, *intrinsics in zip(
        motions, *tensors, strict=True
    ):
        a, b = (
            Camera(*K[[0, 1, 0, 1], [0, 1, 2, 2]], *prev.shape) for K in intrinsics
        )
        pair = FramePair(Frame(None, prev, a), Frame(None, curr, b), flow)
        yield compare_depths(pair, T, weights)


def _handed_out(
    found: tuple[np.ndarray, np.ndarray, int],
    depths: DepthAgreement | None,
    motion: np.ndarray,
) -> tuple[np.ndarray, np.ndarray, int]:
    """The same with what two depths that differ leave open; no tiles where not definite."""
    covariance, eigenvalues, tiles = found
    if depths is not None:
        covariance = covariance.copy()
        covariance[:3, :3] += depths.length_doubt(motion[:3, 3])
    is_definite = np.linalg.eigvalsh(covariance)[0] > 0
    return (
        covariance,
        eigenvalues,
        tiles if is_definite and np.isfinite(motion).all() else 0,
    )


def _probabilities(
    fit: _Fit,
    known: _Known,
    motions: np.ndarray,
    spread: list[tuple[np.ndarray, np.ndarray, int]],
) -> tuple[list[float], torch.Tensor | None]:
    """Probability of each sample's motion, NaN where nothing tells it; evidence where calibrated.

    Without a lead it is the share of the weight that does not go with another motion, squared.
    """
    alone = fit.own**2 / (fit.own**2 + fit.rival**2).clamp(min=1e-12)
    if known.lead is None:
        return torch.where(known.told, alone, torch.nan).tolist(), None
    starts = known.start.matrix().double().cpu().numpy()
    odds = torch.logit(alone, LARGEST_ODDS).tolist()
    lead = known.lead.tolist()
    noise = fit.noise[:, 0].tolist()
    evidence = fit.own.new_zeros(len(motions), 3)
    for k, (covariance, _, tiles) in enumerate(spread):
        if tiles == 0:
            continue
        # flow may be less noisy than any network's motion is exact: as if its noise were the usual
        more = max(1.0, DIS_NOISE[0] / max(noise[k], 1e-9)) ** 2
        agreed = agreement(starts[k], motions[k], more * covariance)
        evidence[k] = evidence.new_tensor((lead[k], math.log(agreed), odds[k]))
    right = [probability_right(one, PWVO_RIGHT) for one in evidence.tolist()]
    return right, evidence


def _bad_input(
    batch: PairBatch, pixels: Pixels, k: int, min_pixels: int
) -> Status | None:
    """The failure of a sample with too few usable pixels."""
    usable = int((pixels.weight[k] > 0).sum())
    if usable >= min_pixels:
        return None
    depth, flow = (
        x[k].detach().cpu().numpy() for x in (batch.depth_prev, batch.flow)
    )
    return Status.failed(*too_few(depth, flow, usable, min_pixels))


def _graduate(
    pixels: Pixels, starts: pp.LieTensor, end: torch.Tensor
) -> pp.LieTensor:
    """The start (B, S, 7) of least cost at the scale ``end`` px, refined: (B, 7)."""
    batch, count = starts.shape[:2]
    pixels = Pixels(*(x.repeat_interleave(count, dim=0) for x in pixels))
    ends = end.repeat_interleave(count)
    T = _shrink_scale(pixels, pp.SE3(starts.tensor().flatten(0, 1)), ends)
    cost = factors.linearize(pixels, T, flow_noise(ends)).cost.reshape(batch, count)
    best = torch.nan_to_num(cost, nan=torch.inf).argmin(dim=1)
    index = torch.arange(batch, device=best.device)
    return pp.SE3(T.tensor().reshape(batch, count, 7)[index, best])


def _shrink_scale(
    pixels: Pixels, T: pp.LieTensor, end: torch.Tensor
) -> pp.LieTensor:
    """One Gauss-Newton step for each scale of the kernel, down to ``end``."""
    scale = CUTOFF * factors.typical_residual(pixels, T)
    scale = torch.maximum(scale.clamp(1.0, LARGEST_PX), end)
    going = torch.ones_like(scale, dtype=torch.bool)
    while bool(going.any()):
        T = factors.stepped(pixels, T, flow_noise(scale), going[:, None])
        going = going & (scale > end)
        scale = torch.maximum(scale * GNC_RATIO, end)
    return T


def _shares(
    pixels: Pixels, T: pp.LieTensor, end: torch.Tensor
) -> tuple[torch.Tensor, torch.Tensor]:
    """(B,) shares of the weight that follow this motion, and another near by but not this."""

    def followed(
        part: Pixels, T: pp.LieTensor
    ) -> tuple[torch.Tensor, torch.Tensor]:
        follow = factors.weigh(part, T.matrix(), flow_noise(3 * end)).robust > 0.25
        share = (part.weight * follow).double().sum(dim=1) / total
        return follow, torch.nan_to_num(share)

    total = pixels.total.clamp(min=1e-30)
    follow, own = followed(pixels, T)
    rest = pixels._replace(weight=pixels.weight * ~follow)
    identity = pp.identity_SE3(len(T), dtype=T.dtype, device=T.device)
    return own, followed(rest, _shrink_scale(rest, identity, end))[1]


def _noise(
    batch: PairBatch,
    pixels: Pixels,
    T: pp.LieTensor,
    how: ResidualModel,
    options: RefineOptions,
) -> torch.Tensor:
    """(B, 2) noise at a pose, from the coarse grid of the numba refinement; else as before."""
    height, width = batch.depth_prev.shape[1:]
    step = grid_stride((height, width), options.coarse_pixels)
    every = slice(step // 2, None, step)
    few = pixels.map(
        lambda x: x.unflatten(-1, (height, width))[..., every, every].flatten(-2)
    )
    z = few.points[:, 2:]
    more = torch.stack(
        [1 / few.flow_variance, few.depth_variance, few.weight], dim=1
    )
    rows = torch.cat([few.points[:, :2] / z, z, few.target, more], dim=1)
    samples = rows.float().cpu().numpy()
    K = batch.K_curr[:, [0, 1, 0, 1], [0, 1, 2, 2]].float().cpu().numpy()
    poses = T.matrix()[:, :3].cpu().numpy()
    out = how.noise.tolist()
    for k, buffer in enumerate(samples):
        if np.isfinite(poses[k]).all() and (buffer[kernels.W] > 0).any():
            curr = None
            if options.current_depth != "off" and batch.depth_curr is not None:
                curr = batch.depth_curr[k].float().cpu().numpy()
            where = buffer, buffer.shape[1], K[k], poses[k]
            found = pair_noise(*where, out[k], options.cutoff, curr)[:2]
            if np.isfinite(found).all():
                out[k] = found
    return how.noise.new_tensor(out)


def _curvature(
    few: Pixels, pixels: Pixels, T: pp.LieTensor, how: ResidualModel
) -> tuple[torch.Tensor, torch.Tensor]:
    """(B, 6, 6) curvature of the robust weights, and the scores' outer products, of all pixels."""
    at = factors.weigh(few, T.matrix(), how)
    s = torch.stack(at.scores(), dim=1).double()
    w = (few.weight * at.robust)[:, None]
    factor = torch.where(
        w > 1e-12, how.kernel(at.distance2)[2][:, None] / w.clamp(min=1e-12), 0.0
    )
    scale = (pixels.total / few.total.clamp(min=1e-12))[:, None, None]
    return scale * (s * factor) @ s.transpose(1, 2), scale * s @ s.transpose(1, 2)


def _fit_all(
    pixels: Pixels,
    few: Pixels,
    T: pp.LieTensor,
    how: ResidualModel,
    curvature: torch.Tensor,
    tight: bool,
) -> tuple[pp.LieTensor, torch.Tensor, torch.Tensor]:
    """Newton steps on all pixels: (pose, converged, steps)."""
    rounding = torch.finfo(pixels.weight.dtype).eps ** 0.5
    scale = (pixels.total / few.total.clamp(min=1e-12))[:, None, None]
    best = torch.full((len(T),), torch.inf, dtype=torch.float64, device=T.device)
    done = best < 0
    converged = best < 0
    iterations = done.long()
    for k in range(STEPS):
        H, g, _, weight = factors.linearize(pixels, T, how)
        # the full derivative, also of residual and Jacobian
        if tight and k % 3 == 2:
            exact = factors.newton_matrix(few, T, how)
            curvature = (factors.linearize(few, T, how).H - exact) * scale
        step, good = factors.solve_small(H - curvature, g)
        ahead = (step * g).sum(dim=1)
        # under a kernel that turns over the equations may be far from definite: Gauss-Newton
        # (near the solution the full derivative may be much flatter than H, and is right)
        good = (
            good
            & (ahead > 0)
            & (_energy(step, H) <= (100 if tight and k > 1 else 4) * ahead)
        )
        plain, solved = factors.solve_small(H, g, factors.DAMPING)
        step = torch.where(good[:, None], step, plain)
        step = torch.where(done[:, None], torch.zeros_like(step), step)
        length2 = _energy(step, H)
        moved = (length2 / weight.clamp(min=1e-12)).sqrt()
        T = left_update(step, T)
        iterations = iterations + (~done).long()
        last = moved < rounding if tight else length2 < STEP_TOLERANCE_SIGMA**2
        last |= (
            (moved > 0.5 * best)
            & (moved < ROUNDED_STEP)
            & ((good & (k > 3)) | (not tight))
        )
        converged = converged | (~done & solved & last)
        best = torch.where(done, best, torch.minimum(best, moved))
        done = converged | ~solved
        if bool(done.all()):
            break
    return T, converged, iterations


def _energy(step: torch.Tensor, H: torch.Tensor) -> torch.Tensor:
    """(B,) step^T H step."""
    return torch.einsum("bi,bij,bj->b", step, H, step).clamp(min=0)
