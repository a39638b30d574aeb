"""The refinement of a batch of pairs in torch: CPU or GPU, float32 or float64, differentiable.

Every start is refined on a subset of the pixels under a kernel whose scale shrinks (graduated
non-convexity); the start of least cost is fitted to the noise found there, and then to all pixels.
Poses are pypose SE3 in float64. Samples never see each other.

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
from hybridvo.refinement.covariance import NOTHING, UPPER, motion_covariance, tile_size
from hybridvo.refinement.pixels import grid_stride, too_few
from hybridvo.refinement.refine import LAST_STEP, pair_noise, status_of
from hybridvo.refinement.torch_factors import (
    CUTOFF,
    KERNELS,
    Linearization,
    RobustNoise,
    attached,
    flow_noise,
    linearize,
    newton_matrix,
    residuals,
    scores,
    sensitivity,
    solve_small,
    stepped,
    typical_residual,
    weigh,
)
from hybridvo.results import Reason, Status
from hybridvo.torch_geometry import left_update, pp, weighted_median
from hybridvo.types import PairBatch

SUBSET_PIXELS = 2048
"""Pixels on which starts are refined."""
LARGEST_PX, SMALLEST_PX, GNC_RATIO = 64.0, 0.4, 0.7
"""Largest and last scale of the graduated kernel, px, and factor from one to the next."""
STEPS = 20
"""Most Newton steps on all pixels."""
ROUNDED_STEP = 0.05
"""Steps below, in standard deviations of the noise, that no longer shrink are rounding."""
INLIER_DISTANCE2 = 9.0
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

    Works in the floating type of the flow and depth (half types are raised to float32), outside
    autocast. Gradients reach flow, depth, intrinsics, variances, weights and noise where one of
    them requires it; not ``T_init``, on which the estimate does not depend.

    Args:
        batch: see :class:`~hybridvo.types.PairBatch`.
        T_init: (B, 4, 4) or (B, S, 4, 4) T_curr_prev to start from, in place of one that is not
            finite the identity. Without weights the identity is one more start.
        weights: (B, H, W) factors on the information; what is not positive and finite switches a
            pixel off.
        noise: flow noise in px and noise of log depth, as (2,) or (B, 2), and with the current
            frame's depth that of its log; None: estimated.
        kernel: ``geman-mcclure``, with the cutoff of the options, ``cauchy``, ``huber`` or ``l2``.
        options: the current frame's depth is a third residual where ``current_depth`` is ``on``.

    Returns:
        Poses with covariance and a status per sample. Bad data give a failed status and a zero
        gradient for that very sample, never an exception and never a pose that is not finite.

    Raises:
        InputError: shapes, types or options that cannot be used.
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
    tensors = (*vars(batch).values(), weights, given)
    wanted = torch.is_grad_enabled() and any(x is not None and x.requires_grad for x in tensors)
    height, width = batch.depth_prev.shape[1:]
    tile = tile_size((height, width), options.tiles)
    with torch.autocast(batch.flow.device.type, enabled=False):
        with torch.no_grad():
            pixels = gather_pixels(batch, weights, tile, with_depth)
            solver = _Solver(batch, pixels, tile, kernel, options)
            result = solver.solve(starts, given, tight=wanted)
        if not wanted:
            return result
        pixels = gather_pixels(batch, weights, tile, with_depth)
        how = solver.how(result.noise if given is None else given)
        # a Newton step of value zero, and with the gradient A^-1 dg
        T = result.SE3.detach()
        A = newton_matrix(pixels.map(torch.Tensor.detach), T, how)
        g = scores(pixels, residuals(pixels, T), how)[0].sum(dim=2)
        return replace(result, SE3=attached(T, A, g, ~result.failed))


def _given_noise(noise: Any, like: torch.Tensor, with_depth: bool) -> torch.Tensor | None:
    """(B, 2) noise as handed in; (B, 3) with the current depth, whose noise is sd unless stated."""
    if noise is None:
        return None
    value = torch.as_tensor(noise, device=like.device).to(like.dtype)
    known, sizes = value.detach(), (2, 3) if with_depth else (2,)
    fits = value.shape in [shape for n in sizes for shape in ((n,), (len(like), n))]
    if not fits or not bool(
        (torch.isfinite(known) & (known >= 0)).all() & (known[..., ::2] > 0).all()
    ):
        raise InputError(
            f"refine_batch: expected noise (sf, sd{', sz' * with_depth}), one or {len(like)} rows, "
            f"finite, sf positive, sd not negative, got {noise!r}."
        )
    value = value.expand(len(like), value.shape[-1])
    if with_depth and value.shape[1] == 2:
        value = torch.cat([value, value[:, 1:].clamp(min=DEPTH_NOISE_FLOOR)], dim=1)
    return value


class _Solver:
    """The stages of the estimate on one batch of pixels, without gradient."""

    def __init__(
        self, batch: PairBatch, pixels: Pixels, tile: int, kernel: str, options: RefineOptions
    ) -> None:
        self.batch, self.pixels, self.tile = batch, pixels, tile
        self.kernel, self.options = kernel, options
        self.few = pixels.subset(SUBSET_PIXELS)
        self.flow_only = replace(self.few, log_depth_curr=None, has_depth_curr=None)

    def how(self, noise: torch.Tensor) -> RobustNoise:
        """The kernel at a noise."""
        return RobustNoise(noise, CUTOFFS.get(self.kernel, self.options.cutoff), self.kernel)

    def solve(self, starts: pp.LieTensor, given: torch.Tensor | None, tight: bool) -> BatchedPose:
        """From the starts (B, S, 7) to the pose of every sample, with covariance and status."""
        end = self.few.weight.new_full((len(starts),), SMALLEST_PX)
        if given is not None:
            end = torch.maximum(end, given[:, 0].detach())
        T = self._graduate(starts, end)
        own, rival = self._shares(T, end)
        T, noise = self._fit_subset(T, given)
        curvature, meat = self._curvature(T, self.how(noise))
        T, last, converged, iterations = self._fit_all(T, self.how(noise), curvature, tight)
        near = (last.at.robust > 0) & (last.at.distance2 <= INLIER_DISTANCE2)
        weight = self.pixels.weight
        total = weight.sum(dim=1).clamp(min=1e-30)
        ratio = torch.nan_to_num((weight * near).sum(dim=1) / total)
        covariance, definite = self._covariance(T, last, noise, curvature, meat)
        probability = own**2 / (own**2 + rival**2).clamp(min=1e-12)
        status = [
            self._status(k, bool(definite[k]), bool(converged[k]), float(ratio[k]), float(p))
            for k, p in enumerate(probability)
        ]
        failed = torch.tensor([not s.usable for s in status], device=T.device)
        identity = pp.identity_SE3(len(T), dtype=T.dtype, device=T.device)
        nothing = torch.as_tensor(NOTHING, dtype=weight.dtype, device=T.device)
        return BatchedPose(
            SE3=pp.SE3(torch.where(failed[:, None], identity.tensor(), T.tensor())),
            covariance=torch.where(failed[:, None, None], nothing, covariance.to(weight.dtype)),
            converged=converged & ~failed,
            failed=failed,
            status=status,
            probability=torch.where(failed, torch.zeros_like(own), probability),
            iterations=iterations,
            cost=torch.nan_to_num(last.cost / total),
            weights=torch.nan_to_num(
                from_tiles(last.at.robust, self.tile, *self.batch.depth_prev.shape[1:])
            ),
            noise=torch.where(torch.isfinite(noise), noise, torch.ones_like(noise)),
            inlier_ratio=ratio,
        )

    def _graduate(self, starts: pp.LieTensor, end: torch.Tensor) -> pp.LieTensor:
        """The start of least cost at the scale ``end`` px, refined: (B, 7)."""
        batch, count = starts.shape[:2]
        pixels = self.flow_only.map(lambda x: x.repeat_interleave(count, dim=0))
        ends = end.repeat_interleave(count)
        T = self._shrink_scale(pixels, pp.SE3(starts.tensor().flatten(0, 1)), ends)
        if count == 1:
            return T
        cost = linearize(pixels, residuals(pixels, T), flow_noise(ends)).cost.reshape(batch, count)
        best = torch.nan_to_num(cost, nan=torch.inf).argmin(dim=1)
        index = torch.arange(batch, device=best.device)
        return pp.SE3(T.tensor().reshape(batch, count, 7)[index, best])

    def _shrink_scale(self, pixels: Pixels, T: pp.LieTensor, end: torch.Tensor) -> pp.LieTensor:
        """One Gauss-Newton step for each scale of the kernel, down to ``end``."""
        at = residuals(pixels, T)
        scale = torch.maximum((CUTOFF * typical_residual(pixels, at)).clamp(1.0, LARGEST_PX), end)
        going = torch.ones_like(scale, dtype=torch.bool)
        while bool(going.any()):
            T = stepped(pixels, T, residuals(pixels, T), flow_noise(scale), going)
            going = going & (scale > end)
            scale = torch.maximum(scale * GNC_RATIO, end)
        return T

    def _shares(self, T: pp.LieTensor, end: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """(B,) shares of the weight that follow this motion, and another near by but not this."""
        pixels = self.flow_only
        own = weigh(pixels, residuals(pixels, T), flow_noise(3 * end)).robust
        rest = replace(pixels, weight=pixels.weight * (own < 0.25))
        identity = pp.identity_SE3(len(T), dtype=T.dtype, device=T.device)
        other = self._shrink_scale(rest, identity, end)
        theirs = weigh(rest, residuals(rest, other), flow_noise(3 * end)).robust
        total = pixels.weight.double().sum(dim=1).clamp(min=1e-30)
        found = ((pixels.weight, own), (rest.weight, theirs))
        shares = [(w * (follow > 0.25)).double().sum(dim=1) / total for w, follow in found]
        return torch.nan_to_num(shares[0]), torch.nan_to_num(shares[1])

    def _fit_subset(
        self, T: pp.LieTensor, given: torch.Tensor | None
    ) -> tuple[pp.LieTensor, torch.Tensor]:
        """Noise and pose, in turn; the noise by the function of the numba refinement."""
        noise = self.few.weight.new_tensor([0.5, 0.01]).repeat(len(T), 1)
        samples = None if given is not None else self._samples()
        for steps in (2, 3, 3, 0):
            noise = given.detach() if given is not None else self._noise(samples, T, noise)
            for _ in range(steps):
                T = stepped(self.few, T, residuals(self.few, T), self.how(noise))
        return T, noise

    def _samples(self) -> np.ndarray:
        """(B, 8, n) the coarse grid of the numba refinement, as a buffer of its kernels."""
        p, (height, width) = self.pixels, self.batch.depth_prev.shape[1:]
        z = p.points[:, 2:]
        more = torch.stack([1 / p.flow_variance, p.depth_variance, p.weight], dim=1)
        rows = torch.cat([p.points[:, :2] / z, z, p.target, more], dim=1)
        step = grid_stride((height, width), self.options.coarse_pixels)
        images = from_tiles(rows.flatten(0, 1), self.tile, height, width)
        sparse = images[:, step // 2 :: step, step // 2 :: step].unflatten(0, (-1, 8)).flatten(2)
        return sparse.float().cpu().numpy()

    def _noise(self, samples: Any, T: pp.LieTensor, noise: torch.Tensor) -> torch.Tensor:
        """(B, 2) noise at a pose; as before where there is none to be had."""
        depth = None if self.options.current_depth == "off" else self.batch.depth_curr
        K = self.pixels.K[:, [0, 1, 0, 1], [0, 1, 2, 2]].float().cpu().numpy()
        poses, count, out = T.matrix().cpu().numpy(), samples.shape[2], noise.tolist()
        for k, (sf, sd, *_) in enumerate(noise.tolist()):
            if np.isfinite(poses[k]).all() and (samples[k, kernels.W] > 0).any():
                curr = None if depth is None else depth[k].float().cpu().numpy()
                where = samples[k], count, K[k], poses[k, :3]
                found = pair_noise(*where, (sf, sd), self.options.cutoff, curr)[:2]
                out[k] = found if np.isfinite(found).all() else out[k][:2]
        return self._with_depth_noise(T, noise.new_tensor([row[:2] for row in out]))

    def _with_depth_noise(self, T: pp.LieTensor, noise: torch.Tensor) -> torch.Tensor:
        """The noise of log D_curr beside (B, 2): the spread of r_z that sd does not explain."""
        few = self.few
        if few.has_depth_curr is None:
            return noise
        at = residuals(few, T)
        near = at.r[:, :2].square().sum(dim=1) <= (8 * noise[:, :1]).clamp(min=4.0).square()
        used = few.weight * few.has_depth_curr * at.front * near
        spread = 1.4826 * weighted_median(at.r[:, 2].abs(), used, 0.02)
        h = weighted_median(sensitivity(few, at)[:, 2].abs(), used, 1.0).clamp(min=1e-3)
        # at most half of the variance: the flow of a slow camera says next to nothing of sd
        sd = torch.minimum(noise[:, 1], 0.5**0.5 * spread / h)
        sz = (spread.square() - (sd * h).square()).clamp(min=DEPTH_NOISE_FLOOR**2).sqrt()
        return torch.stack([noise[:, 0], sd, sz], dim=1)

    def _curvature(self, T: pp.LieTensor, how: RobustNoise) -> tuple[torch.Tensor, torch.Tensor]:
        """(B, 6, 6) curvature of the robust weights and scores' outer products, from the subset."""
        each, at = scores(self.few, residuals(self.few, T), how)
        s, w = each.double(), (self.few.weight * at.robust).double()
        slope = how.kernel(at.distance2).slope
        factor = torch.where(w > 1e-12, slope / w.clamp(min=1e-12), torch.zeros_like(w))
        total = self.few.weight.double().sum(dim=1).clamp(min=1e-12)[:, None, None]
        return (s * factor[:, None]) @ s.transpose(1, 2) / total, s @ s.transpose(1, 2) / total

    def _fit_all(
        self, T: pp.LieTensor, how: RobustNoise, curvature: torch.Tensor, tight: bool
    ) -> tuple[pp.LieTensor, Linearization, torch.Tensor, torch.Tensor]:
        """Newton steps on all pixels: (pose, last equations, converged, steps)."""
        pixels = self.pixels
        weight = pixels.weight.double().sum(dim=1)[:, None, None]
        rounding = 8 * torch.finfo(pixels.weight.dtype).eps
        best = torch.full((len(T),), torch.inf, dtype=torch.float64, device=T.device)
        done, converged = best < 0, best < 0
        iterations = done.long()
        for k in range(STEPS):
            now = linearize(pixels, residuals(pixels, T), how, self.tile**2)
            H, g = now.total()
            if tight and k % 3 == 2:  # the full derivative, also of residual and Jacobian
                few = linearize(self.few, residuals(self.few, T), how).total()[0]
                few = few - newton_matrix(self.few, T, how).double()
                curvature = (
                    few / self.few.weight.double().sum(dim=1).clamp(min=1e-12)[:, None, None]
                )
            step, good = solve_small(H - curvature * weight, g)
            ahead = (step * g).sum(dim=1)
            # under a kernel that turns over the equations may be far from definite: Gauss-Newton
            # (near the solution the full derivative may be much flatter than H, and is right)
            longest = 100 if tight and k > 1 else 4
            good = good & (ahead > 0) & (_energy(step, H) <= longest * ahead)
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

    def _covariance(
        self,
        T: pp.LieTensor,
        last: Linearization,
        noise: torch.Tensor,
        curvature: torch.Tensor,
        meat: torch.Tensor,
    ) -> tuple[torch.Tensor, torch.Tensor]:
        """Sandwich covariance (B, 6, 6) by the numpy function, and whether it is definite (B,)."""
        weight = self.pixels.weight.double().sum(dim=1)
        depth = weighted_median(self.few.points[:, 2], self.few.weight, 1.0)
        tiles = torch.cat([last.H[..., UPPER[0], UPPER[1]], last.g], dim=2).double()
        arrays = [
            x.double().cpu().numpy()
            for x in (tiles, curvature * weight[:, None, None], meat * weight[:, None, None],
                      1 / depth, weight, self.pixels.K[:, 0, 0], T.translation(), noise[:, :2])
        ]  # fmt: skip
        found = []
        rows = -(-self.batch.depth_prev.shape[1] // self.tile)
        for sums, *more in zip(*arrays, strict=True):
            if not all(np.isfinite(x).all() for x in (sums, *more)):
                found.append((NOTHING, False))
                continue
            covariance, _, tiles_used = motion_covariance(sums.reshape(rows, -1, 27), *more)
            found.append((covariance, tiles_used > 0))
        covariances = torch.as_tensor(np.stack([c for c, _ in found]), device=T.device)
        return covariances, torch.tensor([ok for _, ok in found], device=T.device)

    def _status(
        self, k: int, definite: bool, converged: bool, share: float, probability: float
    ) -> Status:
        """Status of a sample."""
        batch, usable = self.batch, int((self.pixels.weight[k] > 0).sum())
        if usable < self.options.min_pixels:
            for name, K in (("K_prev", batch.K_prev[k]), ("K_curr", batch.K_curr[k])):
                if not bool(torch.isfinite(K).all() & (K.diagonal() > 0).all()):
                    return Status.failed(Reason.NAN_INPUT, f"{name} is no camera matrix")
            depth, flow = (x[k].detach().cpu().numpy() for x in (batch.depth_prev, batch.flow))
            return Status.failed(*too_few(depth, flow, usable, self.options.min_pixels))
        doubt = Status.degraded(Reason.SOLVER_DIVERGED, f"not converged after {STEPS} steps")
        if converged:
            doubt = Status()
        return status_of(definite, share, doubt, probability, MIN_PROBABILITY)


def _energy(step: torch.Tensor, H: torch.Tensor) -> torch.Tensor:
    """(B,) step^T H step."""
    return torch.einsum("bi,bij,bj->b", step, H, step).clamp(min=0)
