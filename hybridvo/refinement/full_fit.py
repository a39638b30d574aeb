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
from hybridvo.refinement.noise import estimate_noise
from hybridvo.refinement.pixels import CoarseGrid, PixelGrid, as_contiguous
from hybridvo.refinement.solver import Linearization, SolverOptions, gauss_newton
from hybridvo.types import FramePair

SOLVER = SolverOptions(iterations=5, tolerance=0.5)
"""The coarse fit is about sqrt(6 x 60) of the full fit's standard deviations away (60 times fewer
pixels), and a step is wrong by some 2 % of its length, the statistical error of the curvature: the
second step is the last."""
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

    Args:
        image: the pixels.
        noise: (3,) float32, see :func:`hybridvo.refinement.coarse_fit.set_noise`.
        tile: side of the tiles, px.
        per_weight: (42,) curvature of the robust weights and meat of independent errors, per unit
            of external weight, see :func:`hybridvo.refinement.covariance.score_sums`.
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


class DepthFactor:
    """The current frame's depth, given the flow, see :mod:`hybridvo.refinement.depth`.

    Args:
        image: the pixels of the pair.
        samples: those that are compared, on a grid ``width`` pixels wide, ``stride`` apart.
        log_depth: (N,) of the current frame, NaN where unknown.
        width: of the grid.
        stride: px.
        sigma: standard deviation of the conditional residual.
        noise: (3,) float32, of flow and depth.
        tile: side of the tiles, px.
    """

    def __init__(
        self,
        image: PixelGrid,
        samples: np.ndarray,
        log_depth: np.ndarray,
        width: int,
        stride: int,
        sigma: float,
        noise: np.ndarray,
        tile: int,
    ) -> None:
        self._image, self._samples, self._log_depth = image, samples, log_depth
        self._width, self._stride, self._sigma = width, stride, sigma
        self._noise, self._tile = noise, tile

    def linearize(self, T: np.ndarray) -> Linearization:
        """See :class:`hybridvo.refinement.solver.Factor`; the sums stay as attributes."""
        rows, columns = (-(-n // self._tile) for n in self._image.shape)
        tiles, self.meat = np.zeros((rows * columns, kernels.COST)), np.zeros(21)
        cost = depth.sum_depth(
            self._samples, len(self._log_depth), self._log_depth, T[:3], self._image.K,
            self._noise, self._sigma, self._stride, self._tile, columns, self._width,
            kernels.new_work(), tiles, self.meat,
        )  # fmt: skip
        self.tiles = tiles.reshape(rows, columns, kernels.COST)
        sums = tiles.sum(axis=0)
        return Linearization(symmetric(sums[:21]), sums[21:], cost)


@dataclass(frozen=True, eq=False)
class FullFit:
    """Outcome of :func:`fit_full_grid`.

    Args:
        T: (4, 4) T_curr_prev. covariance: (6, 6). eigenvalues: (6,) of the information, m scaled
            by the typical depth. definite: whether every direction is determined.
        weights: (H, W) robust weights. weight: their sum. share: of the pixels that follow.
        cost: per usable pixel. flow_noise: px. depth_noise: of log depth, both at a pixel of the
            typical variance handed in. uses_current_depth: whether the third residual took part.
        tiles: of the image, in which pixels were used.
        depths: how the current depth agrees with the first, moved; None where it cannot be told.
    """

    T: np.ndarray
    covariance: np.ndarray
    eigenvalues: np.ndarray
    definite: bool
    weights: np.ndarray
    weight: float
    share: float
    cost: float
    flow_noise: float
    depth_noise: float
    iterations: int
    uses_current_depth: bool
    tiles: int
    depths: depth.DepthAgreement | None


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
    """Fit one motion on the full grid, from its fit on the coarse one.

    Args:
        pair: the input.
        grid: its coarse grid.
        pose: (3, 4) start.
        noise_start: (sf, sd) found with it.
        options: of the refinement.
    """
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
    total = float(samples[kernels.W, :n].sum(dtype=np.float64))
    iterations, _, _ = coarse_fit.gauss_newton(
        samples, n, total, image.K, noise, 4, 1e-3 * sf, pose, kernels.new_work()
    )
    term = None
    if asks_depth and sigma > 0:
        term = _depth_factor(pair, grid, pose, sigma, noise, options)
    per_weight = score_sums(samples, n, pose, image.K, noise)
    flow = FlowFactor(image, noise, tile, per_weight)
    found = gauss_newton([flow] if term is None else [flow, term], pose_matrix(pose), SOLVER)
    T = pose_matrix(found.T[:3])
    tiles, meat = flow.tiles, flow.meat
    if term is not None:
        tiles, meat = tiles + term.tiles, meat + term.meat
    _, followers, usable = flow.rest
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
    return FullFit(
        T=T,
        covariance=covariance,
        eigenvalues=eigenvalues,
        definite=definite,
        weights=flow.weights,
        weight=float(followers),
        share=float(share),
        cost=float(flow.rest[0] / max(usable, 1e-12)),
        flow_noise=float(sf),
        depth_noise=float(sd),
        iterations=int(iterations + found.iterations),
        uses_current_depth=term is not None,
        tiles=_tiles_used(image, samples, n, pair.prev.camera.shape, options.tiles),
        depths=_compare_depths(pair, image, samples, n, T, noise) if asks_depth else None,
    )


def _tiles_used(
    image: PixelGrid, samples: np.ndarray, n: int, shape: tuple[int, int], tiles: int
) -> int:
    """Tiles of an image of ``shape`` that hold one of the usable samples.

    :data:`MIN_TILES` where the image itself has few.
    """
    tile = tile_size(shape, tiles)
    columns = -(-shape[1] // tile)
    if shape[0] * shape[1] < 2 * MIN_TILES * tile**2:
        return MIN_TILES
    ifx, ify, cx, cy = image.camera
    x, y = samples[kernels.XN : kernels.YN + 1, :n][:, samples[kernels.W, :n] > 0]
    # the rays are of pixel centres: half a pixel keeps the rounding off the border of the tile
    u = ((x / ifx + (cx + image.origin[0] + 0.5)) / tile).astype(np.intp)
    v = ((y / ify + (cy + image.origin[1] + 0.5)) / tile).astype(np.intp)
    return int(np.count_nonzero(np.bincount(v * columns + u)))


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
    """Noise of the pixels that follow a motion.

    The current depth bounds the noise of the first, and tells it where the flow cannot.

    Args:
        samples: buffer of pixels; its first ``n`` count.
        n: pixels.
        K: (4,) float32 fx, fy, cx, cy of the current camera.
        pose: (3, 4) T_curr_prev.
        start: (sf, sd) found before.
        cutoff: of the robust kernel.
        curr: (H, W) current depth, or None.
        origin: (u, v) of its pixel at which the samples' coordinates begin.
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
    """(6,) derivative of the estimating equation in the depth's variance, per unit of weight.

    What is not known of that variance moves the answer, through the correction of the depth.
    """
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
    image, coarse, n = grid.pixels, grid.samples, grid.count
    _, columns, stride = grid.shape
    curr, tile = as_contiguous(np.asarray(pair.curr.depth)), tile_size(image.shape, options.tiles)
    sums = np.zeros(kernels.SUMS)
    coarse_fit.evaluate(coarse, n, pose, image.K, noise, kernels.new_work(), sums)
    H_flow = symmetric(sums[:21])
    if options.current_depth == "auto":
        scale = np.repeat([1 / coarse_fit.translation_scale(coarse, n), 1.0], 3)
        eigenvalues = np.linalg.eigvalsh(H_flow * np.outer(scale, scale))
        if eigenvalues[0] > WELL_CONDITIONED * eigenvalues[-1]:
            return None
    log_depth = np.empty(n, np.float32)
    depth.look_up(coarse, n, 1, curr, *image.origin, log_depth)
    term = DepthFactor(image, coarse, log_depth, columns, stride, sigma, noise, tile)
    # on the full fit the flow has every pixel, the depth every second one of both axes
    fine = min(2, stride)
    if options.current_depth == "auto":
        H_depth = term.linearize(pose).H / fine**2
        gain = np.linalg.eigvals(np.linalg.pinv(H_flow) @ H_depth).real.max()
        if not gain > CURRENT_DEPTH_GAIN:
            return None
    if fine < stride:
        samples, h, w = image.strided(fine)
        log_depth = np.empty(h * w, np.float32)
        depth.look_up(samples, h * w, 1, curr, *image.origin, log_depth)
        term = DepthFactor(image, samples, log_depth, w, fine, sigma, noise, tile)
    return term


def _compare_depths(
    pair: FramePair,
    image: PixelGrid,
    samples: np.ndarray,
    n: int,
    T: np.ndarray,
    noise: np.ndarray,
) -> depth.DepthAgreement | None:
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
