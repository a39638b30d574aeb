"""The refinement of a batch of pairs in torch: CPU or GPU, float32 or float64, differentiable.

Every start is refined on a subset of the pixels under a kernel whose scale shrinks; that of least
cost is fitted to the noise found there, and then to all pixels. Samples never see each other.

The gradient is that of the implicit function theorem: the estimate solves g(T, inputs) = 0 with
g = sum of w J^T Sigma^-1 r, so d xi = A^-1 dg with A = -dg / d xi, the full derivative. It is
attached by one Newton step of value zero; noise and covariance carry none.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import torch

from hybridvo.errors import InputError
from hybridvo.options import RefineOptions
from hybridvo.refinement import kernels
from hybridvo.refinement.batch import (
    BatchedPose,
    Pixels,
    checked_batch,
    from_tiles,
    gather_pixels,
    initial_poses,
)
from hybridvo.refinement.coarse_fit import DAMPING
from hybridvo.refinement.covariance import NOTHING, UPPER, motion_covariance
from hybridvo.refinement.pixels import grid_stride, too_few
from hybridvo.refinement.refine import LAST_STEP, pair_noise, status_of
from hybridvo.refinement.solver import tile_size
from hybridvo.refinement.torch_factors import (
    CUTOFF,
    KERNELS,
    Linearization,
    RobustNoise,
    attached,
    flow_noise,
    linearize,
    newton_matrix,
    scores,
    solve_small,
    stepped,
    typical_residual,
    weigh,
)
from hybridvo.results import Reason, Status
from hybridvo.torch_geometry import left_update, pp
from hybridvo.types import PairBatch

SUBSET_PIXELS, STEPS = 2048, 20
"""Pixels on which starts are refined; most Newton steps on all pixels."""
LARGEST_PX, SMALLEST_PX, GNC_RATIO = 64.0, 0.4, 0.7
"""Largest and last scale of the graduated kernel, px, and factor from one to the next."""
ROUNDED_STEP, INLIER_DISTANCE2 = 0.05, 9.0
"""Standard deviations below which steps that no longer shrink are rounding; squared, of inliers."""
CUTOFFS = {"cauchy": 2.385, "huber": 1.345, "l2": 1.0}
"""Standard deviations, 95 % efficient under normal noise (P. J. Huber, Robust Statistics)."""
DEPTH_NOISE_FLOOR = 2e-3
"""Least noise of the current frame's log depth."""
MIN_PROBABILITY = 0.8
"""Below which a motion is degraded; 0.8 is a rival with half of the motion's own weight."""


def refine_batch(
    batch: PairBatch,
    T_init: Any = None,
    weights: Any = None,
    *,
    noise: Any = None,
    kernel: str = "geman-mcclure",
    options: RefineOptions | None = None,
) -> BatchedPose:
    """Camera motion of every pair of a batch by robust dense reprojection.

    Works in the floating type of the flow and depth (half types are raised to float32). Gradients
    reach all but ``T_init``, on which the estimate does not depend. Bad data give a failed status
    and a zero gradient for that very sample; shapes or types that cannot be used an InputError.

    Args:
        batch: see :class:`~hybridvo.types.PairBatch`.
        T_init: (B, 4, 4) or (B, S, 4, 4) T_curr_prev to start from, in place of one that is not
            finite the identity. Without weights the identity is one more start.
        weights: (B, H, W) factors on the information; not positive or not finite: not used.
        noise: flow noise in px and noise of log depth, as (2,) or (B, 2), and with the current
            frame's depth that of its log; None: estimated.
        kernel: ``geman-mcclure``, with the cutoff of the options, ``cauchy``, ``huber`` or ``l2``.
        options: the current frame's depth is a third residual where ``current_depth`` is ``on``.
    """
    options = options or RefineOptions()
    if kernel not in KERNELS:
        raise InputError(f"refine_batch: unknown kernel {kernel!r}; known: {', '.join(KERNELS)}.")
    batch, weights = checked_batch(batch, weights)
    with_depth = options.current_depth == "on"
    if with_depth and batch.depth_curr is None:
        raise InputError("refine_batch: current_depth 'on' needs PairBatch.depth_curr.")
    starts = initial_poses(T_init, batch.flow, alone=weights is not None)
    given = _given_noise(noise, batch.flow, with_depth)
    how = RobustNoise(torch.empty(0), CUTOFFS.get(kernel, options.cutoff), kernel)
    tensors = (*vars(batch).values(), weights, given)
    wanted = torch.is_grad_enabled() and any(x is not None and x.requires_grad for x in tensors)
    height, width = batch.depth_prev.shape[1:]
    tile = tile_size((height, width), options.tiles)
    with torch.autocast(batch.flow.device.type, enabled=False):
        with torch.no_grad():
            pixels = gather_pixels(batch, weights, tile, with_depth)
            result = _solve(batch, pixels, starts, given, how, options, tight=wanted)
        if not wanted:
            return result
        pixels = gather_pixels(batch, weights, tile, with_depth)
        how = how._replace(noise=result.noise if given is None else given)
        T = result.SE3.detach()
        A = newton_matrix(pixels, T, how)
        g = scores(pixels, T, how)[0].sum(dim=2)
        return replace(result, SE3=attached(T, A, g, ~result.failed[:, None]))


def _given_noise(noise: Any, like: torch.Tensor, with_depth: bool) -> torch.Tensor | None:
    """(B, 2) noise as handed in; (B, 3) with the current depth, whose noise is sd unless stated."""
    if noise is None:
        return None
    value = torch.as_tensor(noise, device=like.device).to(like.dtype)
    known, sizes = value.detach(), (2, 3) if with_depth else (2,)
    fits = value.shape in [shape for n in sizes for shape in ((n,), (len(like), n))]
    if not fits or not ((known >= 0) & (known < torch.inf)).all() or (known[..., ::2] == 0).any():
        wanted = f"sf positive, sd not negative{', sz positive' * with_depth}"
        expected = f"noise ({wanted}), one or {len(like)} rows"
        raise InputError(f"refine_batch: expected {expected}, finite, got {noise!r}.")
    value = value.expand(len(like), value.shape[-1])
    if with_depth and value.shape[1] == 2:
        value = torch.cat([value, value[:, 1:].clamp(min=DEPTH_NOISE_FLOOR)], dim=1)
    return value


def _solve(
    batch: PairBatch,
    pixels: Pixels,
    starts: pp.LieTensor,
    given: torch.Tensor | None,
    how: RobustNoise,
    options: RefineOptions,
    tight: bool,
) -> BatchedPose:
    """From the starts (B, S, 7) to the pose of every sample; ``how``: the kernel, without noise;
    ``tight``: to the precision that a gradient needs.
    """
    (height, width), weight = batch.depth_prev.shape[1:], pixels.weight
    size = height, width
    tile, few = tile_size(size, options.tiles), pixels.subset(SUBSET_PIXELS)
    flow_only = few._replace(log_depth_curr=None, has_depth_curr=None)
    end = weight.new_full((len(starts),), SMALLEST_PX)
    if given is not None:
        end = torch.maximum(end, given[:, 0].detach())
    T = _graduate(flow_only, starts, end)
    own, rival = _shares(flow_only, T, end)
    samples = None if given is not None else _samples(pixels, size, tile, options)
    how = how._replace(noise=weight.new_tensor([0.5, 0.01]).repeat(len(T), 1))
    for steps in (2, 3, 3, 0):
        noise = _noise(batch, samples, T, how, options) if given is None else given.detach()
        how = how._replace(noise=noise)
        for _ in range(steps):
            T = stepped(few, T, how)
    total = weight.double().sum(dim=1)
    curvature, meat = (x * total[:, None, None] for x in _curvature(few, T, how))
    T, last, converged, iterations = _fit_all(pixels, few, T, how, curvature, tile, tight)
    found = _covariances(pixels, few, T, last, how.noise, (curvature, meat), size, tile)
    near = (last.robust > 0) & (last.distance2 <= INLIER_DISTANCE2)
    ratio = torch.nan_to_num((weight * near).sum(dim=1) / weight.sum(dim=1).clamp(min=1e-30))
    probability = own**2 / (own**2 + rival**2).clamp(min=1e-12)
    covariances, status = [], []
    for k, (covariance, definite) in enumerate(found):
        doubt = Status.degraded(Reason.SOLVER_DIVERGED, f"not converged after {STEPS} steps")
        sure = float(probability[k]), MIN_PROBABILITY
        judged = _bad_input(batch, pixels, k, options.min_pixels) or status_of(
            definite, float(ratio[k]), Status() if converged[k] else doubt, *sure
        )
        covariances.append(covariance if judged.usable else NOTHING)
        status.append(judged)
    failed = torch.tensor([not s.usable for s in status], device=T.device)
    identity = pp.identity_SE3(len(T), dtype=T.dtype, device=T.device)
    return BatchedPose(
        SE3=pp.SE3(torch.where(failed[:, None], identity.tensor(), T.tensor())),
        covariance=torch.as_tensor(np.stack(covariances), dtype=weight.dtype, device=T.device),
        converged=converged & ~failed,
        failed=failed,
        status=status,
        probability=torch.where(failed, torch.zeros_like(own), probability),
        iterations=iterations,
        cost=torch.nan_to_num(last.cost / weight.sum(dim=1).clamp(min=1e-30)),
        weights=torch.nan_to_num(from_tiles(last.robust, tile, *size)),
        noise=torch.where(torch.isfinite(how.noise), how.noise, torch.ones_like(how.noise)),
        inlier_ratio=ratio,
    )


def _covariances(
    pixels: Pixels,
    few: Pixels,
    T: pp.LieTensor,
    last: Linearization,
    noise: torch.Tensor,
    spread: tuple[torch.Tensor, torch.Tensor],
    size: tuple[int, int],
    tile: int,
) -> list[tuple[np.ndarray, bool]]:
    """Covariance of each sample by the numpy function; whether it is definite."""
    # 1 / typical depth, as of the coarse grid: half of the weight may lie on a sky at 30 km
    usable, z = few.weight > 0, few.points[:, 2]
    inverse = ((usable / z**2).sum(dim=1) / usable.sum(dim=1).clamp(min=1)).sqrt().clamp(min=1e-9)
    tiles = torch.cat([last.H[..., UPPER[0], UPPER[1]], last.g], dim=2)
    tiles = tiles.unflatten(1, (-(-size[0] // tile), -1))
    weight, focal, t = pixels.weight.double().sum(dim=1), pixels.K[:, 0, 0], T.translation()
    values = (tiles, *spread, inverse, weight, focal, t, noise[:, :2])
    found = []
    for sums in zip(*(x.double().cpu().numpy() for x in values), strict=True):
        covariance, occupied = NOTHING, 0
        if all(np.isfinite(x).all() for x in sums):
            covariance, _, occupied = motion_covariance(*sums)
        found.append((covariance, occupied > 0))
    return found


def _bad_input(batch: PairBatch, pixels: Pixels, k: int, min_pixels: int) -> Status | None:
    """The failure of a sample with too few usable pixels."""
    usable = int((pixels.weight[k] > 0).sum())
    if usable >= min_pixels:
        return None
    for name, K in (("K_prev", batch.K_prev[k]), ("K_curr", batch.K_curr[k])):
        if not bool(torch.isfinite(K).all() & (K.diagonal() > 0).all()):
            return Status.failed(Reason.NAN_INPUT, f"{name} is no camera matrix")
    depth, flow = (x[k].detach().cpu().numpy() for x in (batch.depth_prev, batch.flow))
    return Status.failed(*too_few(depth, flow, usable, min_pixels))


def _graduate(pixels: Pixels, starts: pp.LieTensor, end: torch.Tensor) -> pp.LieTensor:
    """The start (B, S, 7) of least cost at the scale ``end`` px, refined: (B, 7)."""
    batch, count = starts.shape[:2]
    pixels = pixels.map(lambda x: x.repeat_interleave(count, dim=0))
    ends = end.repeat_interleave(count)
    T = _shrink_scale(pixels, pp.SE3(starts.tensor().flatten(0, 1)), ends)
    cost = linearize(pixels, T, flow_noise(ends)).cost.reshape(batch, count)
    best = torch.nan_to_num(cost, nan=torch.inf).argmin(dim=1)
    index = torch.arange(batch, device=best.device)
    return pp.SE3(T.tensor().reshape(batch, count, 7)[index, best])


def _shrink_scale(pixels: Pixels, T: pp.LieTensor, end: torch.Tensor) -> pp.LieTensor:
    """One Gauss-Newton step for each scale of the kernel, down to ``end``."""
    scale = torch.maximum((CUTOFF * typical_residual(pixels, T)).clamp(1.0, LARGEST_PX), end)
    going = torch.ones_like(scale, dtype=torch.bool)
    while bool(going.any()):
        T = stepped(pixels, T, flow_noise(scale), going[:, None])
        going = going & (scale > end)
        scale = torch.maximum(scale * GNC_RATIO, end)
    return T


def _shares(
    pixels: Pixels, T: pp.LieTensor, end: torch.Tensor
) -> tuple[torch.Tensor, torch.Tensor]:
    """(B,) shares of the weight that follow this motion, and another near by but not this."""

    def followed(part: Pixels, T: pp.LieTensor) -> tuple[torch.Tensor, torch.Tensor]:
        follow = weigh(part, T, flow_noise(3 * end)).robust > 0.25
        share = (part.weight * follow).double().sum(dim=1) / total
        return follow, torch.nan_to_num(share)

    total = pixels.weight.double().sum(dim=1).clamp(min=1e-30)
    follow, own = followed(pixels, T)
    rest = pixels._replace(weight=pixels.weight * ~follow)
    identity = pp.identity_SE3(len(T), dtype=T.dtype, device=T.device)
    return own, followed(rest, _shrink_scale(rest, identity, end))[1]


def _samples(
    pixels: Pixels, size: tuple[int, int], tile: int, options: RefineOptions
) -> np.ndarray:
    """(B, 8, n) the coarse grid of the numba refinement, as a buffer of its kernels."""
    z = pixels.points[:, 2:]
    more = torch.stack([1 / pixels.flow_variance, pixels.depth_variance, pixels.weight], dim=1)
    rows = torch.cat([pixels.points[:, :2] / z, z, pixels.target, more], dim=1)
    step = grid_stride(size, options.coarse_pixels)
    images = from_tiles(rows.flatten(0, 1), tile, *size)
    sparse = images[:, step // 2 :: step, step // 2 :: step].unflatten(0, (-1, 8)).flatten(2)
    return sparse.float().cpu().numpy()


def _noise(
    batch: PairBatch, samples: Any, T: pp.LieTensor, how: RobustNoise, options: RefineOptions
) -> torch.Tensor:
    """(B, 2) noise at a pose, or (B, 3) with the current depth's; as before where there is none."""
    K = batch.K_curr[:, [0, 1, 0, 1], [0, 1, 2, 2]].float().cpu().numpy()
    poses, count, out = T.matrix()[:, :3].cpu().numpy(), samples.shape[2], []
    for k, (sf, sd, *_) in enumerate(how.noise.tolist()):
        row = [sf, sd, DEPTH_NOISE_FLOOR]
        if np.isfinite(poses[k]).all() and (samples[k, kernels.W] > 0).any():
            curr = None
            if options.current_depth != "off" and batch.depth_curr is not None:
                curr = batch.depth_curr[k].float().cpu().numpy()
            where = samples[k], count, K[k], poses[k]
            sf, sd, _, both, _ = pair_noise(*where, (sf, sd), options.cutoff, curr)
            if np.isfinite([sf, sd]).all():
                # at most half of the variance: the flow of a slow camera says next to nothing of sd
                if options.current_depth == "on" and both > 0:
                    sd = min(sd, 0.5**0.5 * both)
                row = [sf, sd, max(both**2 - sd**2, DEPTH_NOISE_FLOOR**2) ** 0.5]
        out.append(row)
    return how.noise.new_tensor(out)[:, : 3 if options.current_depth == "on" else 2]


def _curvature(
    pixels: Pixels, T: pp.LieTensor, how: RobustNoise
) -> tuple[torch.Tensor, torch.Tensor]:
    """(B, 6, 6) curvature of the robust weights and scores' outer products per unit of weight."""
    each, at = scores(pixels, T, how)
    s, w = each.double(), (pixels.weight * at.robust).double()
    slope = how.kernel(at.distance2)[2]
    factor = torch.where(w > 1e-12, slope / w.clamp(min=1e-12), torch.zeros_like(w))
    total = pixels.weight.double().sum(dim=1).clamp(min=1e-12)[:, None, None]
    return (s * factor[:, None]) @ s.transpose(1, 2) / total, s @ s.transpose(1, 2) / total


def _fit_all(
    pixels: Pixels,
    few: Pixels,
    T: pp.LieTensor,
    how: RobustNoise,
    curvature: torch.Tensor,
    tile: int,
    tight: bool,
) -> tuple[pp.LieTensor, Linearization, torch.Tensor, torch.Tensor]:
    """Newton steps on all pixels: (pose, last equations, converged, steps)."""
    rounding = torch.finfo(pixels.weight.dtype).eps ** 0.5
    total, part = (p.weight.double().sum(dim=1)[:, None, None] for p in (pixels, few))
    best = torch.full((len(T),), torch.inf, dtype=torch.float64, device=T.device)
    done, converged = best < 0, best < 0
    iterations = done.long()
    for k in range(STEPS):
        now = linearize(pixels, T, how, tile**2)
        H, g = now.total()
        if tight and k % 3 == 2:  # the full derivative, also of residual and Jacobian
            slope = linearize(few, T, how).total()[0] - newton_matrix(few, T, how)
            curvature = slope * total / part.clamp(min=1e-12)
        step, good = solve_small(H - curvature, g)
        ahead = (step * g).sum(dim=1)
        # under a kernel that turns over the equations may be far from definite: Gauss-Newton
        # (near the solution the full derivative may be much flatter than H, and is right)
        good = good & (ahead > 0) & (_energy(step, H) <= (100 if tight and k > 1 else 4) * ahead)
        plain, solved = solve_small(H, g, DAMPING)
        step = torch.where(good[:, None], step, plain)
        step = torch.where(done[:, None], torch.zeros_like(step), step)
        length2 = _energy(step, H)
        moved = (length2 / now.weight_sum.double().clamp(min=1e-12)).sqrt()
        T, iterations = left_update(step, T), iterations + (~done).long()
        last = moved < rounding if tight else length2 < LAST_STEP**2
        last |= (moved > 0.5 * best) & (moved < ROUNDED_STEP) & ((good & (k > 3)) | (not tight))
        converged = converged | (~done & solved & last)
        best = torch.where(done, best, torch.minimum(best, moved))
        done = converged | ~solved
        if bool(done.all()):
            break
    return T, now, converged, iterations


def _energy(step: torch.Tensor, H: torch.Tensor) -> torch.Tensor:
    """(B,) step^T H step."""
    return torch.einsum("bi,bij,bj->b", step, H, step).clamp(min=0)
