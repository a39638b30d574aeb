"""The refinement of a batch of pairs in torch: CPU or GPU, float32 or float64, differentiable.

Every start is refined on a subset of the pixels under a kernel whose scale shrinks (graduated
non-convexity); the start of least cost is fitted to the noise found there, and then to all pixels.
Poses are pypose SE3 in float64, pixels keep their type. Samples never see each other: damping,
convergence and failure are per sample.

The gradient is that of the implicit function theorem: the estimate solves g(T, inputs) = 0 with
g = sum of w J^T Sigma^-1 r, so d xi = A^-1 dg with A = -dg / d xi, the full derivative (residual,
Jacobian, robust weights and covariance). It is attached by one Newton step whose value is zero;
noise and covariance come from the numpy functions and carry no gradient.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import torch

from hybridvo.errors import InputError
from hybridvo.options import RefineOptions
from hybridvo.refinement.batch import (
    DEPTH_CURR_FLOOR,
    BatchedPose,
    Pixels,
    checked_batch,
    from_tiles,
    gather_pixels,
    given_noise,
    initial_poses,
    tile_grid,
)
from hybridvo.refinement.coarse_fit import DAMPING
from hybridvo.refinement.covariance import NOTHING, UPPER, sandwich_covariance
from hybridvo.refinement.full_fit import FLOW_ROUNDING, SOLVER, pair_noise, tile_size
from hybridvo.refinement.pixels import CoarseGrid, coarse_grid, too_few
from hybridvo.refinement.refine import LOW_INLIER_RATIO, MIN_INLIER_RATIO
from hybridvo.refinement.torch_factors import (
    KERNELS,
    Linearization,
    RobustNoise,
    linearize,
    newton_matrix,
    residuals,
    score_sum,
    solve_small,
)
from hybridvo.results import Reason, RelativePose, Status
from hybridvo.torch_geometry import left_update, pp, weighted_median
from hybridvo.types import Camera, Frame, FramePair, PairBatch

SUBSET_PIXELS = 2048
"""Pixels on which starts are refined."""
LARGEST_PX, SMALLEST_PX, GNC_RATIO = 64.0, 0.4, 0.7
"""Largest and last scale of the graduated kernel, px, and factor from one to the next."""
STEPS = 20
"""Most Newton steps on all pixels."""
ROUNDED_STEP = 0.05
"""Steps below, in standard deviations of the noise, that no longer shrink are rounding."""
INLIER_DISTANCE2 = 9.0
MIN_PROBABILITY = 0.8
"""Below which a motion is degraded; 0.8 is a rival with half of the motion's own weight."""


def refine_batch(
    batch: PairBatch,
    T_init: Any = None,
    weights: Any = None,
    *,
    noise: Any = None,
    kernel: str = "geman-mcclure",
    gradient: str = "implicit",
    options: RefineOptions | None = None,
) -> BatchedPose:
    """Camera motion of every pair of a batch by robust dense reprojection.

    Works in the floating type of the flow and depth (half types are raised to float32), outside
    autocast.

    Args:
        batch: see :class:`~hybridvo.types.PairBatch`.
        T_init: (B, 4, 4) or (B, S, 4, 4) T_curr_prev to start from, in place of one that is not
            finite the identity. Without weights the identity is one more start; with weights only
            what is handed in is.
        weights: (B, H, W) factors on the information; what is not positive and finite switches a
            pixel off.
        noise: (sf, sd) flow noise in px and noise of log depth, or (sf, sd, sz) with that of the
            current frame's depth; numbers, or a (B, 2) or (B, 3) tensor. None: estimated.
        kernel: ``geman-mcclure``, ``cauchy``, ``huber`` or ``l2``.
        gradient: ``implicit`` attaches the gradient to flow, depth, intrinsics, variances, weights
            and noise where one of them requires it, ``none`` does not. T_init has none: the
            estimate does not depend on it.
        options: of the refinement; ``cutoff`` is that of the kernel ``geman-mcclure``, and the
            current frame's depth is a third residual where ``current_depth`` is ``on``.

    Returns:
        Poses with covariance and a status per sample. Bad data give a failed status for that very
        sample, never an exception and never a pose that is not finite. The gradient of a failed
        sample is zero.

    Raises:
        InputError: shapes, types or options that cannot be used.
    """
    options = options or RefineOptions()
    if not isinstance(batch, PairBatch) or not isinstance(options, RefineOptions):
        raise InputError(
            f"refine_batch: expected a PairBatch and RefineOptions, got {type(batch).__name__} and "
            f"{options!r}."
        )
    if kernel not in KERNELS:
        raise InputError(f"refine_batch: unknown kernel {kernel!r}; known: {', '.join(KERNELS)}.")
    if gradient not in ("implicit", "none"):
        raise InputError(f"refine_batch: expected gradient implicit or none, got {gradient!r}.")
    with_depth = options.current_depth == "on"
    batch, weights = checked_batch(batch, weights, with_depth)
    starts = initial_poses(T_init, batch.flow, alone=weights is not None)
    given = given_noise(noise, batch.flow, with_depth)
    tensors = (*vars(batch).values(), weights, given)
    wanted = gradient == "implicit" and torch.is_grad_enabled()
    wanted = wanted and any(x is not None and x.requires_grad for x in tensors)
    height, width = batch.depth_prev.shape[1:]
    tile = tile_size((height, width), options.tiles)
    with torch.autocast(batch.flow.device.type, enabled=False):
        with torch.no_grad():
            pixels = gather_pixels(batch, weights, with_depth, tile)
            solver = _Solver(batch, weights, pixels, tile, kernel, options)
            result = solver.solve(starts, given, tight=wanted)
        if not wanted:
            return result
        pixels = gather_pixels(batch, weights, with_depth, tile)
        how = solver.how(result.noise if given is None else given)
        # a Newton step of value zero, and with the gradient A^-1 dg
        T = result.SE3.detach()
        A = newton_matrix(pixels.map(torch.Tensor.detach), T, how)
        step, solved = solve_small(A, score_sum(pixels, T, how))
        step = torch.where((solved & ~result.failed)[:, None], step, torch.zeros_like(step))
        return replace(result, SE3=left_update(step - step.detach(), T))


class _Solver:
    """The stages of the estimate on one batch of pixels, without gradient."""

    def __init__(
        self,
        batch: PairBatch,
        weights: torch.Tensor | None,
        pixels: Pixels,
        tile: int,
        kernel: str,
        options: RefineOptions,
    ) -> None:
        self.batch, self.external, self.pixels = batch, weights, pixels
        self.tile, self.kernel, self.options = tile, kernel, options
        self.cutoff = options.cutoff if kernel == "geman-mcclure" else KERNELS[kernel].cutoff
        height, width = batch.depth_prev.shape[1:]
        self.tiles, self.run = tile_grid((height, width), tile)
        self.few = pixels.subset(SUBSET_PIXELS)
        self.planar = replace(self.few, log_depth_curr=None, has_depth_curr=None)

    def how(self, noise: torch.Tensor) -> RobustNoise:
        """The kernel at a noise."""
        return RobustNoise(noise, self.kernel, self.cutoff)

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
        near = (last.weights > 0) & (last.distance2 <= INLIER_DISTANCE2)
        weight = self.pixels.weight
        total = weight.sum(dim=1).clamp(min=1e-30)
        ratio = torch.nan_to_num((weight * near).sum(dim=1) / total)
        covariance, definite = self._covariance(T, last, noise, curvature, meat)
        probability = own**2 / (own**2 + rival**2).clamp(min=1e-12)
        status = [
            self._status(k, bool(definite[k]), bool(converged[k]), float(ratio[k]),
                         float(rival[k]), float(probability[k]))
            for k in range(len(T))
        ]  # fmt: skip
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
                from_tiles(last.weights, self.tile, *self.batch.depth_prev.shape[1:])
            ),
            noise=torch.where(torch.isfinite(noise), noise, torch.ones_like(noise)),
            inlier_ratio=ratio,
        )

    def _graduate(self, starts: pp.LieTensor, end: torch.Tensor) -> pp.LieTensor:
        """The start of least cost at the scale ``end`` px, refined: (B, 7)."""
        batch, count = starts.shape[:2]
        pixels = self.planar.repeat(count)
        ends = end.repeat_interleave(count)
        T = self._shrink_scale(pixels, pp.SE3(starts.tensor().flatten(0, 1)), ends)
        if count == 1:
            return T
        cost = linearize(pixels, T, self._isotropic(ends)).cost.reshape(batch, count)
        best = torch.nan_to_num(cost, nan=torch.inf).argmin(dim=1)
        index = torch.arange(batch, device=best.device)
        return pp.SE3(T.tensor().reshape(batch, count, 7)[index, best])

    def _isotropic(self, scale: torch.Tensor) -> RobustNoise:
        return RobustNoise(torch.stack([scale, torch.zeros_like(scale)], dim=1), self.kernel, 1.0)

    def _shrink_scale(self, pixels: Pixels, T: pp.LieTensor, end: torch.Tensor) -> pp.LieTensor:
        """One Gauss-Newton step for each scale of the kernel from the residuals' down to ``end``.

        A sample whose scale has come to the end stands still, whatever the others do.
        """
        at = residuals(pixels, T)
        length = (at.r[0].square() + at.r[1].square()).sqrt()
        scale = 1.5 * weighted_median(length, pixels.weight * at.front, 1.0)
        scale = torch.maximum(scale.clamp(1.0, LARGEST_PX), end)
        going = torch.ones_like(scale, dtype=torch.bool)
        while bool(going.any()):
            H, g = linearize(pixels, T, self._isotropic(scale)).total()
            step, _ = solve_small(H, g, DAMPING)
            T = left_update(torch.where(going[:, None], step, torch.zeros_like(step)), T)
            going = going & (scale > end)
            scale = torch.maximum(scale * GNC_RATIO, end)
        return T

    def _shares(self, T: pp.LieTensor, end: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """(B,) shares of the external weight that follow this motion, and another but not this.

        Both within the same few pixels: a compromise between two motions explains neither, however
        much noise is granted to it afterwards.
        """
        pixels = self.planar
        own = linearize(pixels, T, self._isotropic(3 * end)).weights
        rest = replace(pixels, weight=pixels.weight * (own < 0.25))
        identity = pp.identity_SE3(len(T), dtype=T.dtype, device=T.device)
        other = self._shrink_scale(rest, identity, end)
        theirs = linearize(rest, other, self._isotropic(3 * end)).weights
        total = pixels.weight.double().sum(dim=1).clamp(min=1e-30)
        found = ((pixels.weight, own), (rest.weight, theirs))
        shares = [(w * (follow > 0.25)).double().sum(dim=1) / total for w, follow in found]
        return torch.nan_to_num(shares[0]), torch.nan_to_num(shares[1])

    def _fit_subset(
        self, T: pp.LieTensor, given: torch.Tensor | None
    ) -> tuple[pp.LieTensor, torch.Tensor]:
        """Noise and pose, in turn; the noise is that of the coarse grid of the numba refinement."""
        noise = self.few.weight.new_tensor([0.5, 0.01]).repeat(len(T), 1)
        grids = self._grids() if given is None else []
        for steps in (2, 3, 3):
            noise = self._noise(grids, T, noise) if given is None else given.detach()
            for _ in range(steps):
                H, g = linearize(self.few, T, self.how(noise)).total()
                T = left_update(solve_small(H, g, DAMPING)[0], T)
        return T, self._noise(grids, T, noise) if given is None else noise

    def _grids(self) -> list[tuple[FramePair, CoarseGrid] | None]:
        """Each sample as a pair in numpy with its coarse grid; None where too little is usable."""
        values: dict[str, Any] = {
            name: None if x is None else x.cpu().numpy()
            for name, x in (*vars(self.batch).items(), ("weights", self.external))
        }
        for name, x in values.items():
            if x is not None and x.dtype != np.bool_:
                values[name] = x.astype(np.float32)
        out: list[tuple[FramePair, CoarseGrid] | None] = []
        for k in range(len(self.batch.flow)):
            one: dict[str, Any] = {n: None if x is None else x[k] for n, x in values.items()}
            shape = one["depth_prev"].shape
            try:
                prev, curr = (Camera.from_matrix(one[K], *shape) for K in ("K_prev", "K_curr"))
            except InputError:
                out.append(None)
                continue
            pair = FramePair(
                Frame(None, one["depth_prev"], prev, depth_variance=one["depth_variance"]),
                Frame(None, one["depth_curr"], curr),
                one["flow"], one["flow_variance"], one["valid"],
            )  # fmt: skip
            grid = coarse_grid(pair, one["weights"], self.options)
            out.append(None if isinstance(grid, RelativePose) else (pair, grid))
        return out

    def _noise(
        self,
        grids: list[tuple[FramePair, CoarseGrid] | None],
        T: pp.LieTensor,
        noise: torch.Tensor,
    ) -> torch.Tensor:
        """(B, 2) or (B, 3) noise at a pose, by the numba estimator."""
        out = []
        for known, pose, start in zip(grids, T.matrix().cpu().numpy(), noise.tolist(), strict=True):
            found = start[:2]
            if known is not None and np.isfinite(pose).all():
                found = list(pair_noise(*known, pose[:3], (start[0], start[1]), self.options)[:2])
            out.append(found if np.isfinite(found).all() else start[:2])
        return self._depth_curr_noise(T, noise.new_tensor(out))

    def _depth_curr_noise(self, T: pp.LieTensor, noise: torch.Tensor) -> torch.Tensor:
        """(B, 3): the noise of log D_curr from the spread of r_z that sd h does not explain.

        sd may explain half of the variance at most: the two depths come from one sensor, and the
        flow of a slow camera says next to nothing of sd.
        """
        few = self.few
        if few.has_depth_curr is None:
            return noise
        at = residuals(few, T)
        reach = (8 * noise[:, :1]).clamp(min=4.0).square()
        near = at.r[0].square() + at.r[1].square() <= reach
        used = few.weight * few.has_depth_curr * at.front * near
        spread = 1.4826 * weighted_median(at.r[2].abs(), used, 0.02)
        h = weighted_median(at.u[2].abs(), used, 1.0).clamp(min=1e-3)
        sd = torch.minimum(noise[:, 1], 0.5**0.5 * spread / h)
        sz = (spread.square() - (sd * h).square()).clamp(min=DEPTH_CURR_FLOOR**2).sqrt()
        return torch.stack([noise[:, 0], sd, sz], dim=1)

    def _curvature(self, T: pp.LieTensor, how: RobustNoise) -> tuple[torch.Tensor, torch.Tensor]:
        """(B, 6, 6) curvature of the robust weights and scores' outer products, per unit of weight.

        From the subset: both are averages over many pixels and enter the result at second order.
        """
        at = linearize(self.few, T, how, scores=True)
        assert at.scores is not None
        s, w = at.scores.double(), (self.few.weight * at.weights).double()
        ratio = KERNELS[self.kernel].curvature(at.distance2, self.cutoff**2)
        factor = torch.where(w > 1e-12, ratio / w.clamp(min=1e-12), torch.zeros_like(w))
        total = self.few.weight.double().sum(dim=1).clamp(min=1e-12)[:, None, None]
        return (s * factor[:, None]) @ s.transpose(1, 2) / total, s @ s.transpose(1, 2) / total

    def _fit_all(
        self, T: pp.LieTensor, how: RobustNoise, curvature: torch.Tensor, tight: bool
    ) -> tuple[pp.LieTensor, Linearization, torch.Tensor, torch.Tensor]:
        """Newton steps on all pixels: (pose, last equations, converged, steps).

        Ends as the numba refinement does; ``tight``: at the precision of the numbers, which a
        gradient needs, from the third step on with the full derivative of the equations in place of
        the curvature of the subset.
        """
        pixels = self.pixels
        weight = pixels.weight.double().sum(dim=1)[:, None, None]
        rounding = 8 * torch.finfo(pixels.weight.dtype).eps
        best = torch.full((len(T),), torch.inf, dtype=torch.float64, device=T.device)
        done, converged = best < 0, best < 0
        iterations, matrix = done.long(), None
        for k in range(STEPS):
            now = linearize(pixels, T, how, self.run)
            H, g = now.total()
            if tight and k % 3 == 2:  # anew, for samples that were far when it was made
                matrix = newton_matrix(pixels, T, how).double()
            newton = H - curvature * weight if matrix is None else matrix
            step, good = solve_small(newton, g)
            ahead = (step * g).sum(dim=1)
            # under a kernel that turns over the equations may be far from definite: Gauss-Newton
            # (near the solution the full derivative may be much flatter than H, and is right)
            longest = 4 if matrix is None else 100
            good = good & (ahead > 0) & (_energy(step, H) <= longest * ahead)
            plain, solved = solve_small(H, g, DAMPING)
            step = torch.where(good[:, None], step, plain)
            step = torch.where(done[:, None], torch.zeros_like(step), step)
            length2 = _energy(step, H)
            moved = (length2 / now.weight_sum.double().clamp(min=1e-12)).sqrt()
            T, iterations = left_update(step, T), iterations + (~done).long()
            last = moved < rounding if tight else length2 < SOLVER.tolerance**2
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
        parallax = self.pixels.K[:, 0, 0] * T.translation().norm(dim=1) / depth
        variance = noise[:, 0].square() + (parallax * noise[:, 1]).square()
        arrays = [
            x.double().cpu().numpy()
            for x in (tiles, curvature * weight[:, None, None], meat * weight[:, None, None],
                      1 / depth, weight * FLOW_ROUNDING**2 / variance, T.matrix()[:, :3], noise)
        ]  # fmt: skip
        found = []
        for k in range(len(T)):
            *sums, pose, (_, sd, *_) = (x[k] for x in arrays)
            if not all(np.isfinite(x).all() for x in (*sums, pose)):
                found.append((NOTHING, False))
                continue
            covariance, _, definite = sandwich_covariance(
                sums[0].reshape(*self.tiles, 27), *sums[1:]
            )
            # as in the numba refinement: log depth or depth
            covariance[:3, :3] += (0.5 * sd**2) ** 2 * np.outer(pose[:, 3], pose[:, 3])
            found.append((covariance, definite))
        covariances = torch.as_tensor(np.stack([c for c, _ in found]), device=T.device)
        return covariances, torch.tensor([ok for _, ok in found], device=T.device)

    def _status(
        self,
        k: int,
        definite: bool,
        converged: bool,
        inlier_ratio: float,
        rival_ratio: float,
        probability: float,
    ) -> Status:
        """Status of a sample."""
        batch, usable = self.batch, int((self.pixels.weight[k] > 0).sum())
        if usable < self.options.min_pixels:
            for name, K in (("K_prev", batch.K_prev[k]), ("K_curr", batch.K_curr[k])):
                if not bool(torch.isfinite(K).all()) or not bool((K.diagonal() > 0).all()):
                    return Status.failed(Reason.NAN_INPUT, f"{name} is no camera matrix")
            depth, flow = (x[k].detach().cpu().numpy() for x in (batch.depth_prev, batch.flow))
            return Status.failed(*too_few(depth, flow, usable, self.options.min_pixels))
        if not definite:
            what = "the pixels leave a direction of the motion undetermined"
            return Status.failed(Reason.DEGENERATE_GEOMETRY, what)
        share = f"{100 * inlier_ratio:.1f} % of the pixels follow"
        if inlier_ratio < MIN_INLIER_RATIO:
            return Status.failed(Reason.LOW_INLIERS, f"{share} one motion")
        if not converged:
            return Status.degraded(Reason.SOLVER_DIVERGED, f"not converged after {STEPS} steps")
        if probability < MIN_PROBABILITY:
            what = f"{share} this motion, {100 * rival_ratio:.1f} % another one"
            return Status.degraded(Reason.AMBIGUOUS_MOTION, what)
        if inlier_ratio < LOW_INLIER_RATIO:
            return Status.degraded(Reason.LOW_INLIERS, f"only {share} the motion")
        return Status()


def _energy(step: torch.Tensor, H: torch.Tensor) -> torch.Tensor:
    """(B,) step^T H step."""
    return torch.einsum("bi,bij,bj->b", step, H, step).clamp(min=0)
