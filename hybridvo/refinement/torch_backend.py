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
    BatchOptions,
    checked_batch,
    given_noise,
    initial_poses,
    status_of,
)
from hybridvo.refinement.covariance import NOTHING, UPPER, sandwich_covariance
from hybridvo.refinement.noise import estimate_noise
from hybridvo.refinement.torch_factors import (
    KERNELS,
    Linearization,
    RobustNoise,
    linearize,
    residuals,
    score_sum,
)
from hybridvo.refinement.torch_pixels import Pixels, from_tiles, gather_pixels, tile_grid
from hybridvo.torch_geometry import left_update, pp
from hybridvo.types import PairBatch

MIN_DAMPING = 1e-6
"""Share of the diagonal of the normal equations that is added to it."""
GNC_RATIO = 0.7
"""Factor from one scale of the graduated kernel to the next."""
INITIAL_NOISE = (0.7, 0.01)
"""px and of log depth, where the noise estimate begins."""
DEPTH_NOISE_CAP = 0.08
INLIER_DISTANCE2 = 9.0
ROUNDED_STEP = 0.05
"""Steps below, in standard deviations of the noise, that no longer shrink are rounding."""
FLOW_ROUNDING = 2e-5
"""px; single precision at a coordinate of 300."""


def refine_batch(
    batch: PairBatch,
    T_init: Any = None,
    weights: Any = None,
    *,
    noise: Any = None,
    kernel: str = "geman-mcclure",
    gradient: str = "implicit",
    options: BatchOptions | RefineOptions | None = None,
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
        options: of the batch, or those of the refinement of one pair.

    Returns:
        Poses with covariance and a status per sample. Bad data give a failed status for that very
        sample, never an exception and never a pose that is not finite. The gradient of a failed
        sample is zero.

    Raises:
        InputError: shapes, types or options that cannot be used.
    """
    if isinstance(options, RefineOptions):
        options = BatchOptions.of(options, kernel)
    options = options or BatchOptions()
    if not isinstance(batch, PairBatch) or not isinstance(options, BatchOptions):
        raise InputError(
            f"refine_batch: expected a PairBatch and BatchOptions or RefineOptions, got "
            f"{type(batch).__name__} and {options!r}."
        )
    if kernel not in KERNELS:
        raise InputError(f"refine_batch: unknown kernel {kernel!r}; known: {', '.join(KERNELS)}.")
    if gradient not in ("implicit", "none"):
        raise InputError(f"refine_batch: expected gradient implicit or none, got {gradient!r}.")
    batch, weights = checked_batch(batch, weights, options.use_depth_curr)
    starts = initial_poses(T_init, batch.flow, alone=weights is not None)
    given = given_noise(noise, batch.flow, options.use_depth_curr)
    tensors = (*vars(batch).values(), weights, given)
    wanted = gradient == "implicit" and torch.is_grad_enabled()
    wanted = wanted and any(x is not None and x.requires_grad for x in tensors)
    cutoff = KERNELS[kernel].cutoff if options.cutoff is None else float(options.cutoff)
    height, width = batch.depth_prev.shape[1:]
    tile = int(np.clip(round(np.sqrt(height * width / options.tiles)), 8, 64))
    with torch.autocast(batch.flow.device.type, enabled=False):
        with torch.no_grad():
            pixels = gather_pixels(batch, weights, options.use_depth_curr, tile)
            solver = _Solver(pixels, (height, width), tile, kernel, cutoff, options)
            result = solver.solve(batch, starts, given, tight=wanted)
        if not wanted:
            return result
        pixels = gather_pixels(batch, weights, options.use_depth_curr, tile)
        how = RobustNoise(result.noise if given is None else given, kernel, cutoff)
        T = left_update(_zero_step(pixels, result, how), result.SE3)
    return replace(result, SE3=T)


def _zero_step(pixels: Pixels, result: BatchedPose, how: RobustNoise) -> torch.Tensor:
    """(B, 6) Newton step of value zero and with the gradient A^-1 dg."""
    T = result.SE3.detach()
    A = newton_matrix(pixels.map(torch.Tensor.detach), T, how)
    step, solved = solve_small(A, score_sum(pixels, T, how))
    step = torch.where((solved & ~result.failed)[:, None], step, torch.zeros_like(step))
    return step - step.detach()


def newton_matrix(pixels: Pixels, T: pp.LieTensor, how: RobustNoise) -> torch.Tensor:
    """A = -dg / d xi at pypose SE3 poses, (B, 6, 6), not symmetric; A xi = g is the Newton step."""
    how = how._replace(noise=how.noise.detach())
    pixels = replace(pixels, K=pixels.K.detach())
    with torch.enable_grad():
        xi = torch.zeros(len(T), 6, dtype=T.dtype, device=T.device, requires_grad=True)
        g = score_sum(pixels, T, how, xi)
        rows = [torch.autograd.grad(g[:, k].sum(), xi, retain_graph=True)[0] for k in range(6)]
    return -torch.stack(rows, dim=1)


def solve_small(
    A: torch.Tensor, b: torch.Tensor, damping: torch.Tensor | float = 0.0
) -> tuple[torch.Tensor, torch.Tensor]:
    """Solve ((A + damping diag A) x = b) for (B, 6, 6) systems in float64, each for itself.

    Returns:
        (B, 6) float64 solutions and (B,) bool; where False (singular, or not finite) they are zero.
    """
    A, b = A.double(), b.double()
    unit = torch.eye(A.shape[1], dtype=A.dtype, device=A.device)
    scale = A.diagonal(dim1=1, dim2=2).abs().sqrt()
    good = torch.isfinite(A).flatten(1).all(dim=1) & torch.isfinite(b).all(dim=1)
    good = good & (scale > 1e-15).all(dim=1)
    scale = torch.where(good[:, None], scale, torch.ones_like(scale))
    b = torch.where(good[:, None], b, torch.zeros_like(b))
    damping = torch.as_tensor(damping, dtype=A.dtype, device=A.device).reshape(-1, 1, 1)
    A = A / (scale[:, :, None] * scale[:, None, :]) + damping * unit
    x, info = torch.linalg.solve_ex(torch.where(good[:, None, None], A, unit), b / scale)
    x = x / scale
    good = good & (info == 0) & (x.abs() < 1e6).all(dim=1)
    return torch.where(good[:, None], x, torch.zeros_like(x)), good


class _Solver:
    """The stages of the estimate on one batch of pixels, without gradient."""

    def __init__(
        self,
        pixels: Pixels,
        shape: tuple[int, int],
        tile: int,
        kernel: str,
        cutoff: float,
        options: BatchOptions,
    ) -> None:
        self.pixels, self.kernel, self.cutoff, self.options = pixels, kernel, cutoff, options
        self.tile = tile
        self.tiles, self.run = tile_grid(shape, tile)
        self.few = pixels.subset(options.subset_pixels)
        self.planar = replace(self.few, log_depth_curr=None, has_depth_curr=None)

    def solve(
        self, batch: PairBatch, starts: pp.LieTensor, given: torch.Tensor | None, tight: bool
    ) -> BatchedPose:
        """From the starts to the pose of every sample, with covariance and status."""
        end = self.few.weight.new_full((len(starts),), self.options.smallest_px)
        if given is not None:
            end = torch.maximum(end, given[:, 0].detach())
        T = self._graduate(starts, end)
        own, rival = self._shares(T, end)
        T, noise = self._fit_subset(T, given)
        how = RobustNoise(noise, self.kernel, self.cutoff)
        curvature, meat = self._curvature(T, how)
        T, last, converged, iterations = self._fit_all(T, how, curvature, tight)
        height, width = batch.depth_prev.shape[1:]
        near = (last.weights > 0) & (last.distance2 <= INLIER_DISTANCE2)
        weight = self.pixels.weight
        total = weight.sum(dim=1).clamp(min=1e-30)
        ratio = torch.nan_to_num((weight * near).sum(dim=1) / total)
        covariance, definite = self._covariance(T, last, noise, curvature, meat)
        finite = torch.isfinite(T.tensor()).all(dim=1)
        usable = (weight > 0).sum(dim=1)
        lost = ratio < self.options.min_inlier_ratio
        failed = (usable < self.options.min_pixels) | ~definite | ~finite | lost
        probability = own**2 / (own**2 + rival**2).clamp(min=1e-12)
        probability = torch.where(failed, torch.zeros_like(own), probability)
        status = [
            status_of(
                batch,
                k,
                self.options,
                usable=int(usable[k]),
                definite=bool(definite[k] & finite[k]),
                converged=bool(converged[k]),
                inlier_ratio=float(ratio[k]),
                rival_ratio=float(rival[k]),
                probability=float(probability[k]),
            )
            for k in range(len(T))
        ]
        identity = pp.identity_SE3(len(T), dtype=T.dtype, device=T.device)
        nothing = torch.as_tensor(NOTHING, dtype=weight.dtype, device=T.device)
        return BatchedPose(
            SE3=pp.SE3(torch.where(failed[:, None], identity.tensor(), T.tensor())),
            covariance=torch.where(failed[:, None, None], nothing, covariance.to(weight.dtype)),
            converged=converged & ~failed,
            failed=failed,
            status=status,
            probability=probability,
            iterations=iterations,
            cost=torch.nan_to_num(last.cost / total),
            weights=torch.nan_to_num(from_tiles(last.weights, self.tile, height, width)),
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
        scale = torch.maximum(scale.clamp(1.0, self.options.largest_px), end)
        going = torch.ones_like(scale, dtype=torch.bool)
        while bool(going.any()):
            H, g = linearize(pixels, T, self._isotropic(scale)).total()
            step, _ = solve_small(H, g, MIN_DAMPING)
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
        """Noise and pose on the subset, in turn."""
        few = self.few
        if given is not None:
            noise = given.detach()
            return self._descend(T, RobustNoise(noise, self.kernel, self.cutoff), 6), noise
        noise = few.weight.new_tensor(INITIAL_NOISE).repeat(len(T), 1)
        for steps in (2, 3, 3):
            noise = self._depth_curr_noise(T, self._noise(T, noise))
            T = self._descend(T, RobustNoise(noise, self.kernel, self.cutoff), steps)
        return T, self._depth_curr_noise(T, self._noise(T, noise))

    def _descend(self, T: pp.LieTensor, how: RobustNoise, steps: int) -> pp.LieTensor:
        """Gauss-Newton steps on the subset."""
        for _ in range(steps):
            H, g = linearize(self.few, T, how).total()
            T = left_update(solve_small(H, g, MIN_DAMPING)[0], T)
        return T

    def _noise(self, T: pp.LieTensor, noise: torch.Tensor) -> torch.Tensor:
        """(B, 2) flow noise in px and noise of log depth, by the numba estimator."""
        few, poses = self.planar, T.matrix().cpu().numpy()
        rays = few.points[:, :2] / few.points[:, 2:]
        rows = torch.cat([rays, few.points[:, 2:], few.target], dim=1)
        rest = [1 / few.flow_variance, few.depth_variance, few.weight]
        buffers = torch.cat([rows, torch.stack(rest, dim=1)], dim=1).float().cpu().numpy()
        K = few.K[:, [0, 1, 0, 1], [0, 1, 2, 2]].float().cpu().numpy()
        out = []
        for k, (sf, sd) in enumerate(noise[:, :2].double().tolist()):
            pose, count = np.ascontiguousarray(poses[k, :3]), buffers.shape[2]
            if not np.isfinite(pose).all():
                out.append((sf, sd))
                continue
            found = estimate_noise(
                buffers[k], count, pose, K[k], sf, sd, 1e3, DEPTH_NOISE_CAP, 6, count
            )
            out.append(found[:2] if np.isfinite(found[:2]).all() else (sf, sd))
        return noise.new_tensor(out)

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

        ``tight``: down to the precision of the numbers, which a gradient needs, from the third step
        on with the full derivative of the equations in place of the curvature of the subset.
        """
        pixels, options = self.pixels, self.options
        weight = pixels.weight.double().sum(dim=1)[:, None, None]
        enough = 8 * torch.finfo(weight.dtype).eps if tight else options.tolerance
        best = torch.full((len(T),), torch.inf, dtype=torch.float64, device=T.device)
        done, converged = best < 0, best < 0
        iterations = done.long()
        matrix = None
        for k in range(options.iterations):
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
            plain, solved = solve_small(H, g, MIN_DAMPING)
            step = torch.where(good[:, None], step, plain)
            step = torch.where(done[:, None], torch.zeros_like(step), step)
            moved = (_energy(step, H) / now.weight_sum.double().clamp(min=1e-12)).sqrt()
            T, iterations = left_update(step, T), iterations + (~done).long()
            rounded = (
                (moved > 0.5 * best) & (moved < ROUNDED_STEP) & ((good & (k > 3)) | (not tight))
            )
            converged = converged | (~done & solved & ((moved < enough) | rounded))
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
        weight = self.pixels.weight
        depth = weighted_median(self.few.points[:, 2], self.few.weight, 1.0)
        arrays = [
            x.double().cpu().numpy()
            for x in (last.H, last.g, curvature, meat, depth, noise, weight.sum(dim=1),
                      self.pixels.K[:, 0, 0], T.translation())
        ]  # fmt: skip
        found = [
            _one_covariance(self.tiles, *(x[k] for x in arrays)) for k in range(len(T))
        ]  # fmt: skip
        covariance = torch.as_tensor(np.stack([c for c, _ in found]), device=weight.device)
        return covariance, torch.tensor([ok for _, ok in found], device=weight.device)


def _one_covariance(
    shape: tuple[int, int],
    information: np.ndarray,
    scores: np.ndarray,
    curvature: np.ndarray,
    meat: np.ndarray,
    depth: float,
    noise: np.ndarray,
    weight: float,
    focal: float,
    translation: np.ndarray,
) -> tuple[np.ndarray, bool]:
    """Covariance of one sample from the sums of its tiles, and whether it is definite."""
    if not all(np.isfinite(x).all() for x in (information, scores, curvature, meat, translation)):
        return NOTHING, False
    tiles = np.concatenate([information[:, UPPER[0], UPPER[1]], scores], axis=1)
    sf, sd = noise[:2]
    parallax = focal * np.linalg.norm(translation) / depth
    covariance, _, definite = sandwich_covariance(
        tiles.reshape(*shape, 27),
        curvature * weight,
        meat * weight,
        1 / depth,
        weight * FLOW_ROUNDING**2 / (sf**2 + (parallax * sd) ** 2),
    )
    # whether depth errs about its log, its value or its inverse is not known: the translation's
    # length is uncertain by half the variance of log depth
    covariance[:3, :3] += (0.5 * sd**2) ** 2 * np.outer(translation, translation)
    return covariance, definite


def _energy(step: torch.Tensor, H: torch.Tensor) -> torch.Tensor:
    """(B,) step^T H step."""
    return torch.einsum("bi,bij,bj->b", step, H, step).clamp(min=0)


def weighted_median(x: torch.Tensor, weight: torch.Tensor, default: float) -> torch.Tensor:
    """(B,) median of (B, N) values under weights; ``default`` where nothing has any."""
    ordered, index = x.sort(dim=1)
    reached = weight.gather(1, index).cumsum(dim=1)
    middle = (reached < 0.5 * reached[:, -1:]).sum(dim=1, keepdim=True).clamp(max=x.shape[1] - 1)
    value = ordered.gather(1, middle)[:, 0]
    return torch.where(reached[:, -1] > 0, value, torch.full_like(value, default))
