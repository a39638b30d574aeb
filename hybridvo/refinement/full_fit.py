"""The last stage of the refinement: one motion, fitted on every pixel, with its covariance."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from hybridvo.calibration import MIN_TILES
from hybridvo.geometry import pose_matrix
from hybridvo.options import RefineOptions
from hybridvo.refinement import coarse_fit, depth, kernels
from hybridvo.refinement.covariance import sandwich_covariance, score_sums, symmetric
from hybridvo.refinement.depth import DepthAgreement, DepthFactor
from hybridvo.refinement.noise import estimate_noise
from hybridvo.refinement.pixels import CoarseGrid, PixelGrid, as_contiguous
from hybridvo.refinement.solver import Factor, Linearization, gauss_newton
from hybridvo.results import RelativePose
from hybridvo.types import FramePair

STEPS, LAST_STEP = 5, 0.5
"""Most steps, and length in standard deviations of the last one. The coarse fit is about
sqrt(6 x 60) of the full fit's standard deviations away (60 times fewer pixels), and a step is wrong
by some 2 % of its length, the statistical error of the curvature: the second step is the last."""
WELL_CONDITIONED = 0.005
"""Ratio of the extreme eigenvalues of the flow's information above which it needs no help."""
CURRENT_DEPTH_GAIN = 0.5
"""The current depth is used where it adds this share of the flow's information somewhere."""
DEPTHS_PER_PAIR = 1.32
"""The two depths of a pair differ by this many times the noise of one: sqrt(2), less what the
interpolation of the second one averages away (4/9 remains of independent noise)."""
FLOW_ROUNDING = 2e-5
"""Pixels: single precision at a coordinate of 300."""


class FlowFactor:
    """Flow and depth of every pixel of a grid, see :mod:`hybridvo.refinement.kernels`.

    ``per_weight`` (42,) is that of :func:`hybridvo.refinement.covariance.score_sums`.
    """

    def __init__(
        self, image: PixelGrid, noise: np.ndarray, tile: int, per_weight: np.ndarray
    ) -> None:
        self.image, self.noise, self.tile, self._per_weight = image, noise, tile, per_weight

    def linearize(self, T: np.ndarray) -> Linearization:
        """See :class:`hybridvo.refinement.solver.Factor`; the sums stay as attributes."""
        self.tiles, self.rest, self.weights = self.image.full_pass(T[:3], self.noise, self.tile)
        """(rows, columns, 27) sums of each tile; cost and sums of the weights; robust weights."""
        self.meat = self._per_weight[21:] * self.rest[2]
        sums = self.tiles.sum(axis=(0, 1))
        curvature = symmetric(self._per_weight[:21] * self.rest[2])
        return Linearization(symmetric(sums[:21]), sums[21:], float(self.rest[0]), curvature)


@dataclass(frozen=True, eq=False)
class FullFit:
    """A motion that looks ok, and what speaks against it.

    Args:
        motion: with its covariance.
        definite: whether every direction is determined.
        tiles: of the image, in which pixels were used.
        depths: how the current depth agrees with the first, moved; None where it cannot be told.
    """

    motion: RelativePose
    definite: bool
    tiles: int
    depths: DepthAgreement | None


class PairNoise(NamedTuple):
    """Noise of the pixels that follow a motion.

    Args:
        flow: px. depth: of log depth.
        share: of the weight that follows.
        depth_error: standard error of the depth noise squared.
        current_depth: standard deviation of the log of the current depth, given the flow; 0 where
            it cannot be told.
    """

    flow: float
    depth: float
    share: float
    depth_error: float
    current_depth: float


def tile_size(shape: tuple[int, int], tiles: int) -> int:
    """Side, px, of the tiles that cut an image into about ``tiles``; 8 to 64."""
    return int(np.clip(round(np.sqrt(shape[0] * shape[1] / tiles)), 8, 64))


def fit_full_grid(
    pair: FramePair,
    grid: CoarseGrid,
    pose: np.ndarray,
    noise_start: tuple[float, float],
    options: RefineOptions,
) -> FullFit:
    """Fit one motion on the full grid, from its pose (3, 4) and noise there on the coarse one."""
    image, pose = grid.pixels, pose.copy()
    tile = tile_size(image.shape, options.tiles)
    depth_scale = coarse_fit.translation_scale(grid.samples, grid.count)
    samples, n = grid.samples, grid.count
    asks_depth = options.current_depth != "off" and pair.curr.depth is not None
    found_noise = pair_noise(
        samples, n, image.K, pose, noise_start, options.cutoff,
        pair.curr.depth if asks_depth else None, image.origin,
    )  # fmt: skip
    sf, sd, share, _, sigma = found_noise
    noise = np.empty(3, np.float32)
    coarse_fit.set_noise(sf, sd, options.cutoff, noise)
    total = float(grid.weight.sum(dtype=np.float64))
    iterations, _, _ = coarse_fit.gauss_newton(
        samples, n, total, image.K, noise, 4, 1e-3 * sf, pose, kernels.new_work()
    )
    flow = FlowFactor(image, noise, tile, score_sums(samples, n, pose, image.K, noise))
    term = _depth_factor(pair, grid, pose, sigma, noise, options) if sigma > 0 else None
    factors: list[Factor] = [flow] if term is None else [flow, term]
    found = gauss_newton(factors, pose_matrix(pose), STEPS, LAST_STEP)
    T = pose_matrix(found.T[:3])
    tiles, meat = flow.tiles, flow.meat
    if term is not None:
        tiles, meat = tiles + term.tiles, meat + term.meat
    cost, followers, usable = flow.rest
    # rounding is the same for neighbours, so that an average over n pixels is no better than one
    parallax = image.K[0] * np.linalg.norm(T[:3, 3]) * depth_scale
    rounding = usable * FLOW_ROUNDING**2 / (sf**2 + (parallax * sd) ** 2)
    covariance, eigenvalues, definite = sandwich_covariance(
        tiles, np.asarray(found.at.curvature), symmetric(meat), depth_scale, rounding
    )
    if definite:
        newton = found.at.H - found.at.curvature
        shift = _slope_in_depth_variance(image, samples, n, T, found_noise, options) * usable
        shift = np.linalg.lstsq(newton, shift, rcond=1e-12)[0] * found_noise.depth_error
        covariance += np.outer(shift, shift)
    # whether depth errs about its log, its value or its inverse is not known: the translation's
    # length is uncertain by half the variance of log depth
    covariance[:3, :3] += (0.5 * sd**2) ** 2 * np.outer(T[:3, 3], T[:3, 3])
    weights = np.zeros(grid.size, np.float32)
    v0, v1, u0, u1 = grid.box
    weights[v0:v1, u0:u1] = flow.weights
    motion = RelativePose(
        T_curr_prev=T,
        covariance=covariance,
        method="refine",
        terms=("flow",) if term is None else ("flow", "depth"),
        inlier_ratio=float(share) if followers >= 6 else 0.0,
        iterations=int(iterations + found.iterations),
        cost=float(cost / max(usable, 1e-12)),
        residual_scale_px=float(sf),
        depth_noise=float(sd),
        weights=weights,
        information_eigenvalues=eigenvalues,
    )
    return FullFit(
        motion,
        definite and bool(np.isfinite(T).all()),
        _tiles_used(grid, options.tiles),
        _compare_depths(pair, image, samples, n, T, noise) if asks_depth else None,
    )


def _tiles_used(grid: CoarseGrid, tiles: int) -> int:
    """Tiles of the whole image that hold a usable pixel; enough where the image has few."""
    tile, (h, w, stride) = tile_size(grid.size, tiles), grid.shape
    if grid.size[0] * grid.size[1] < 2 * MIN_TILES * tile**2:
        return MIN_TILES
    v, u = (
        (np.arange(n) * stride + stride // 2 + grid.box[k]) // tile for n, k in ((h, 0), (w, 2))
    )
    numbers = v[:, None] * grid.size[1] + u
    return len(np.unique(numbers[grid.weight.reshape(h, w) > 0]))


def pair_noise(
    samples: np.ndarray,
    n: int,
    K: np.ndarray,
    pose: np.ndarray,
    start: tuple[float, float],
    cutoff: float,
    curr: np.ndarray | None = None,
    origin: tuple[int, int] = (0, 0),
) -> PairNoise:
    """Noise of the pixels that follow a motion, from the noise (sf, sd) found before.

    The current depth (H, W) bounds the noise of the first, and tells it where the flow cannot;
    ``origin`` is its pixel at which the coordinates of the samples begin.
    """
    sf, sd = start
    sf, sd, share, spread = estimate_noise(
        samples, n, pose, K, sf, sd, 2.5 * sf, max(2.5 * sd, 0.02), 30,
        coarse_fit.FINAL_NOISE_PIXELS,
    )  # fmt: skip
    if curr is None:
        return PairNoise(sf, sd, share, spread, 0.0)
    noise = np.empty(3, np.float32)
    coarse_fit.set_noise(sf, sd, cutoff, noise)
    log_depth, robust = np.empty(n, np.float32), np.empty(n, np.float32)
    # looked up at random places of a whole image: no more than the scale needs
    depth.look_up(samples, n, depth.sparse_step(n), as_contiguous(curr), *origin, log_depth)
    coarse_fit.robust_weights(samples, n, pose, K, noise, kernels.new_work(), robust)
    sigma, raw = depth.depth_scale(samples, n, log_depth, robust, pose, K, noise)
    if raw <= 0:
        return PairNoise(sf, sd, share, spread, 0.0)
    # var(rz) = sz^2 + h^2 sd^2: with two depths of one sensor sd is about raw / sqrt(2)
    if sd**2 < 2 * spread:
        # too little parallax for the flow to tell; errors that both depths share do not show here
        sd = min(raw / DEPTHS_PER_PAIR, coarse_fit.DEPTH_NOISE_CAP)
        spread = max(sd**2, 1e-10)
    return PairNoise(sf, min(sd, raw), share, spread, max(sigma, 1e-4))


def _slope_in_depth_variance(
    image: PixelGrid,
    samples: np.ndarray,
    n: int,
    T: np.ndarray,
    found: PairNoise,
    options: RefineOptions,
) -> np.ndarray:
    """(6,) derivative of the estimating equation in the depth's variance, per unit of weight."""
    sums, noise = np.zeros((2, kernels.SUMS)), np.empty(3, np.float32)
    variances = 0.9 * found.depth**2, 1.1 * found.depth**2 + 1e-8
    for row, variance in zip(sums, variances, strict=True):
        coarse_fit.set_noise(found.flow, np.sqrt(variance), options.cutoff, noise)
        coarse_fit.evaluate(samples, n, T[:3], image.K, noise, kernels.new_work(), row)
    difference = sums[1, 21:27] - sums[0, 21:27]
    return difference / (variances[1] - variances[0]) / max(sums[0, 29], 1e-12)


def _depth_factor(
    pair: FramePair,
    grid: CoarseGrid,
    pose: np.ndarray,
    sigma: float,
    noise: np.ndarray,
    options: RefineOptions,
) -> DepthFactor | None:
    """The current depth as a factor, or None where it is not asked for or adds too little."""
    image, (_, _, stride) = grid.pixels, grid.shape
    curr, tile = as_contiguous(np.asarray(pair.curr.depth)), tile_size(image.shape, options.tiles)
    # on the full fit the flow has every pixel, the depth every second one of both axes
    fine = min(2, stride)
    if options.current_depth == "auto":
        sums = np.zeros(kernels.SUMS)
        work = kernels.new_work()
        coarse_fit.evaluate(grid.samples, grid.count, pose, image.K, noise, work, sums)
        H_flow = symmetric(sums[:21])
        unit = 1 / coarse_fit.translation_scale(grid.samples, grid.count)
        units = np.repeat([unit, 1.0], 3)
        eigenvalues = np.linalg.eigvalsh(H_flow * np.outer(units, units))
        if eigenvalues[0] > WELL_CONDITIONED * eigenvalues[-1]:
            return None
        coarse = DepthFactor(image, curr, stride, sigma, noise, tile)
        gain = np.linalg.eigvals(np.linalg.pinv(H_flow) @ coarse.linearize(pose).H / fine**2)
        if not gain.real.max() > CURRENT_DEPTH_GAIN:
            return None
    return DepthFactor(image, curr, fine, sigma, noise, tile)


def _compare_depths(
    pair: FramePair,
    image: PixelGrid,
    samples: np.ndarray,
    n: int,
    T: np.ndarray,
    noise: np.ndarray,
) -> DepthAgreement | None:
    """Whether the current depth is that of the points which follow the motion."""
    robust = np.empty(n, np.float32)
    coarse_fit.robust_weights(samples, n, T[:3], image.K, noise, kernels.new_work(), robust)
    follow = np.flatnonzero((robust > 0.5) & (samples[kernels.W, :n] > 0))
    follow = follow[:: max(1, len(follow) // coarse_fit.FINAL_NOISE_PIXELS)]
    x, y, z, u, v = (
        samples[row, follow].astype(np.float64)
        for row in (kernels.XN, kernels.YN, kernels.Z, kernels.MU, kernels.MV)
    )
    moved = z * (T[2, 0] * x + T[2, 1] * y + T[2, 2]) + T[2, 3]
    return depth.depth_agreement(pair.curr, u + image.origin[0], v + image.origin[1], moved)
