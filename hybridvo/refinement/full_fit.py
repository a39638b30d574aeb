"""The last stage of the refinement: one motion, fitted on every pixel, with its covariance."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from hybridvo.options import RefineOptions
from hybridvo.refinement import depth as current_depth
from hybridvo.refinement import kernels, solver
from hybridvo.refinement.covariance import ORDER, UPPER, sandwich_covariance, symmetric
from hybridvo.refinement.depth_agreement import DepthAgreement, depth_agreement
from hybridvo.refinement.pixels import CoarseGrid, PixelGrid, as_contiguous
from hybridvo.types import FramePair

LONG_STEP = 1e3
"""Squared length, in standard deviations, of a step that may not be the last. The coarse fit is
about sqrt(6 x 60) of the full fit's standard deviations away (60 times fewer pixels), and the step
is wrong by some 2 % of its length, the statistical error of the curvature."""
MAX_STEPS = 5
"""Newton steps on the full grid."""
NOISE_PIXELS = 4000
"""Pixels that the final noise estimate looks at."""
MIN_SAMPLES = 1500
"""With fewer usable pixels on the coarse grid (a line across the image leaves 50) noise and
curvature are averaged over the usable pixels of a finer one."""
WELL_CONDITIONED = 0.005
"""Ratio of the extreme eigenvalues of the flow's information above which it needs no help."""
CURRENT_DEPTH_GAIN = 0.5
"""The current depth is used where it adds this share of the flow's information somewhere."""
MIN_TILES = 24
"""Tiles of the whole image in which usable pixels lie, below which a covariance cannot be
trusted: depth errs alike over some 50 px, so that a line across the image holds ten to twenty
independent readings for six unknowns (3 of 59 development lines were beyond 3 sigma, one by 7)."""
DEPTHS_PER_PAIR = 1.32
"""The two depths of a pair differ by this many times the noise of one: sqrt(2), less what the
interpolation of the second one averages away (4/9 remains of independent noise)."""
MIN_DEPTH_VARIANCE = 1e-10
FLOW_ROUNDING = 2e-5
"""Pixels: single precision at a coordinate of 300."""


@dataclass(frozen=True, eq=False)
class FullFit:
    """Outcome of :func:`fit_full_grid`.

    Args:
        pose: (3, 4) T_curr_prev. covariance: (6, 6). eigenvalues: (6,) of the information, m scaled
            by the typical depth. definite: whether every direction is determined.
        weights: (H, W) robust weights. weight: their sum. share: of the pixels that follow.
        cost: per usable pixel. flow_noise: px. depth_noise: of log depth, both at a pixel of the
            typical variance handed in. uses_current_depth: whether the third residual took part.
        depths: how the current depth agrees with the first, moved; None where it cannot be told.
    """

    pose: np.ndarray
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
    depths: DepthAgreement | None = None


@dataclass(frozen=True, eq=False)
class _DepthTerm:
    """Pixels and noise of the third residual."""

    samples: np.ndarray
    log_depth: np.ndarray
    count: int
    width: int
    stride: int
    sigma: float

    def sums(
        self, image: PixelGrid, pose: np.ndarray, noise: np.ndarray, tile: int
    ) -> tuple[np.ndarray, np.ndarray]:
        """(sums of each tile (rows, columns, 27), meat (21,))."""
        rows, columns = -(-image.shape[0] // tile), -(-image.shape[1] // tile)
        sums, meat = np.zeros((rows * columns, kernels.COST)), np.zeros(21)
        current_depth.sum_depth(
            self.samples, self.count, self.log_depth, pose, image.K, noise, self.sigma,
            self.stride, tile, columns, self.width, solver.new_work(), sums, meat,
        )  # fmt: skip
        return sums.reshape(rows, columns, kernels.COST), meat


def translation_scale(samples: np.ndarray, n: int) -> float:
    """1 / typical depth, per metre: root mean square over the usable pixels."""
    usable = samples[kernels.W, :n] > 0
    inverse = 1.0 / samples[kernels.Z, :n][usable].astype(np.float64)
    return max(1e-9, float(np.sqrt(np.mean(inverse**2)))) if len(inverse) else 1.0


def tile_size(shape: tuple[int, int], tiles: int) -> int:
    """Side, px, of the tiles that cut an image into about ``tiles``; 8 to 64."""
    return int(np.clip(round(np.sqrt(shape[0] * shape[1] / tiles)), 8, 64))


def fit_coarse(
    samples: np.ndarray, n: int, K: np.ndarray, pose: np.ndarray, cutoff: float
) -> tuple[np.ndarray, float, float, float, int]:
    """One motion on gathered pixels, by graduated non-convexity from a start.

    Args:
        samples: pixel buffer; its first ``n`` pixels count.
        n: pixels.
        K: (4,) float32 fx, fy, cx, cy of the current camera.
        pose: (3, 4) start; left as it is.
        cutoff: of the robust kernel.

    Returns:
        Pose (3, 4), flow noise px, depth noise, inlier ratio of the weight, iterations.
    """
    work = solver.new_work()
    pose = np.array(pose, np.float64, order="C")
    scale = min(64.0, max(1.0, 1.5 * solver.residual_scale(samples, n, pose, K)))
    steps = solver.anneal(samples, n, K, scale, 0.4, 0.5, 3, pose, work)
    sf, sd, share, more, _, _ = solver.reestimate(
        samples, n, K, 0.5, 0.01, solver.FLOW_NOISE_CAP, solver.DEPTH_NOISE_CAP, cutoff, 2, 4,
        NOISE_PIXELS, pose, work,
    )  # fmt: skip
    return pose, sf, sd, share, steps + more


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
    image, work = grid.pixels, solver.new_work()
    pose = pose.copy()
    tile = tile_size(image.shape, options.tiles)
    depth_scale = translation_scale(grid.samples, grid.count)
    sf, sd = noise_start
    caps = 2.5 * sf, max(2.5 * sd, 0.02)
    samples, n = _enough_samples(grid)
    sf, sd, share, iterations, _, spread = solver.reestimate(
        samples, n, image.K, sf, sd, *caps, options.cutoff, 1, 4, NOISE_PIXELS, pose, work
    )
    noise = np.empty(3, np.float32)
    solver.set_noise(sf, sd, options.cutoff, noise)
    term = None
    if options.current_depth != "off" and pair.curr.depth is not None:
        sd, spread, term = _depth_term(
            pair, grid, pose, (sf, sd, spread), noise, tile, depth_scale, options
        )
        solver.set_noise(sf, sd, options.cutoff, noise)
    per_pixel = _curvature(image, samples, n, pose, noise)
    # with the current depth the weak directions are far from where the flow put them
    long = LONG_STEP if term is None else 1.0
    for step in range(MAX_STEPS):
        tiles, rest, weights = image.full_pass(pose, noise, tile)
        curvature = per_pixel * rest[2]
        if term:
            depth_tiles, depth_meat = term.sums(image, pose, noise, tile)
            tiles += depth_tiles
            curvature[21:] += depth_meat
        total = np.concatenate([tiles.sum(axis=(0, 1)), rest])
        length = _newton_step(total, curvature[:21], pose)
        iterations += step > 0
        if not length > long:
            break
    covariance, eigenvalues, definite = _covariance(
        image, tiles, total, curvature, pose, (sf, sd), depth_scale
    )
    if definite:
        covariance += _depth_uncertainty(
            image, samples, n, pose, (sf, sd, spread), total, curvature, options
        )
    depths = None
    if options.current_depth != "off" and pair.curr.depth is not None:
        robust = np.empty(n, np.float32)
        solver.robust_weights(samples, n, pose, image.K, noise, work, robust)
        depths = depth_agreement(pair.curr, samples[:, :n], robust, pose, image.origin)
    return FullFit(
        pose=pose,
        covariance=covariance,
        eigenvalues=eigenvalues,
        definite=definite,
        weights=weights,
        weight=float(total[28]),
        share=float(share),
        cost=float(total[27] / max(total[29], 1e-12)),
        flow_noise=float(sf),
        depth_noise=float(sd),
        iterations=int(iterations),
        uses_current_depth=term is not None,
        tiles=_tiles_used(image, samples, n, pair.prev.camera.shape, options.tiles),
        depths=depths,
    )


def _covariance(
    image: PixelGrid,
    tiles: np.ndarray,
    total: np.ndarray,
    curvature: np.ndarray,
    pose: np.ndarray,
    noise: tuple[float, float],
    depth_scale: float,
) -> tuple[np.ndarray, np.ndarray, bool]:
    """(covariance, eigenvalues, whether every direction is determined) of the last pass."""
    # rounding is the same for neighbours, so that an average over n pixels is no better than one
    parallax = image.K[0] * np.linalg.norm(pose[:, 3]) * depth_scale
    rounding = total[29] * FLOW_ROUNDING**2 / (noise[0] ** 2 + (parallax * noise[1]) ** 2)
    return sandwich_covariance(
        total,
        curvature[:21],
        curvature[21:],
        _centred_scores(tiles, total),
        tiles[..., :21],
        depth_scale,
        rounding,
    )


def _depth_uncertainty(
    image: PixelGrid,
    samples: np.ndarray,
    n: int,
    pose: np.ndarray,
    noise: tuple[float, float, float],
    total: np.ndarray,
    curvature: np.ndarray,
    options: RefineOptions,
) -> np.ndarray:
    """(6, 6) what not knowing the depth's noise adds; ``noise`` = (sf, sd, error of sd^2)."""
    sf, sd, spread = noise
    # what the uncertainty of sd^2 does to the answer, through the correction of the depth
    slope = _slope_in_depth_variance(image, samples, n, pose, sf, sd, options) * total[29]
    newton = symmetric(total[:21] - curvature[:21])
    shift = np.linalg.lstsq(newton, slope, rcond=1e-12)[0] * spread
    covariance = np.outer(shift, shift)
    # whether depth errs about its log, its value or its inverse is not known: the translation's
    # length is uncertain by half the variance of log depth
    covariance[:3, :3] += (0.5 * sd**2) ** 2 * np.outer(pose[:, 3], pose[:, 3])
    return covariance


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


def _enough_samples(grid: CoarseGrid) -> tuple[np.ndarray, int]:
    """The coarse grid and its size or, where few of its pixels are usable, those of a finer one."""
    coarse, n, stride = grid.samples, grid.count, grid.shape[2]
    usable = np.count_nonzero(grid.weight > 0)
    fine = int(stride * np.sqrt(usable / MIN_SAMPLES))
    if usable >= MIN_SAMPLES or stride == 1 or fine >= stride:
        return coarse, n
    samples, h, w = grid.pixels.strided(max(1, fine))
    samples = np.ascontiguousarray(samples[:, : h * w][:, samples[kernels.W, : h * w] > 0])
    return samples, samples.shape[1]


def _centred_scores(tiles: np.ndarray, total: np.ndarray) -> np.ndarray:
    """(rows, columns, 6) scores of the tiles where all of them together are zero, to first order.

    They were summed before the last step, which is long for a full grid.
    """
    step = np.zeros(6)
    if not solver.solve6(total, solver.DAMPING, step):
        return tiles[..., 21:27]
    return tiles[..., 21:27] - tiles[..., :21][..., ORDER] @ step


def _curvature(
    image: PixelGrid, coarse: np.ndarray, n: int, pose: np.ndarray, noise: np.ndarray
) -> np.ndarray:
    """(42,) curvature of the robust weights and independent meat, per unit of external weight.

    From the coarse grid: both are averages over many pixels and enter the result at second order.
    """
    R, t = pose[:, :3].astype(np.float32), pose[:, 3].astype(np.float32)
    work = solver.new_work()
    rows, factors, used = np.empty((6, n), np.float32), np.empty(n), np.zeros(kernels.SUMS)
    kernels.score_pixels(coarse, n, R, t, image.K, noise, work, rows, factors, used)
    wide = rows.astype(np.float64)  # squares of large external weights overflow in float32
    out = np.concatenate([m[UPPER] for m in ((wide * factors) @ wide.T, wide @ wide.T)])
    return out / max(used[29], 1e-12)


def _slope_in_depth_variance(
    image: PixelGrid,
    coarse: np.ndarray,
    n: int,
    pose: np.ndarray,
    sf: float,
    sd: float,
    options: RefineOptions,
) -> np.ndarray:
    """(6,) derivative of the estimating equation in sd^2, per unit of external weight."""
    sums = np.zeros((2, kernels.SUMS))
    noise = np.empty(3, np.float32)
    work = solver.new_work()
    variances = 0.9 * sd**2, 1.1 * sd**2 + 1e-8
    for row, variance in zip(sums, variances, strict=True):
        solver.set_noise(sf, np.sqrt(variance), options.cutoff, noise)
        solver.evaluate(coarse, n, pose, image.K, noise, work, row)
    difference = sums[1, 21:27] - sums[0, 21:27]
    return difference / (variances[1] - variances[0]) / max(sums[0, 29], 1e-12)


def _newton_step(total: np.ndarray, curvature: np.ndarray, pose: np.ndarray) -> float:
    """Step of the estimating equation, in place; its squared length in standard deviations.

    Gauss-Newton's where the curvature makes it indefinite. Gauss-Newton alone takes back only two
    thirds of an error per step under a redescending kernel, and the coarse fit is several of the
    full fit's standard deviations away.
    """
    step = np.zeros(6)
    newton = total.copy()
    newton[:21] -= curvature
    if not solver.solve6(newton, solver.DAMPING, step) or step @ symmetric(
        total[:21]
    ) @ step > 4.0 * (step @ total[21:27]):
        if not solver.solve6(total, solver.DAMPING, step):
            return 0.0
    solver.left_update(step, pose.copy(), pose)
    return float(step @ total[21:27])


def _depth_term(
    pair: FramePair,
    grid: CoarseGrid,
    pose: np.ndarray,
    found: tuple[float, float, float],
    noise: np.ndarray,
    tile: int,
    inverse_depth: float,
    options: RefineOptions,
) -> tuple[float, float, _DepthTerm | None]:
    """(depth noise, standard error of its square, third residual or None).

    ``found`` = (sf, sd, standard error of sd^2) of the flow. The current depth bounds the noise of
    the first, tells it where the flow cannot, and may add a residual.
    """
    sf, sd, spread = found
    image, coarse, n = grid.pixels, grid.samples, grid.count
    _, columns, stride = grid.shape
    u0, v0 = image.origin
    assert pair.curr.depth is not None  # asked by the caller
    depth = as_contiguous(pair.curr.depth)
    log_depth = np.empty(n, np.float32)
    # looked up at random places of a whole image: first no more than the scale needs
    current_depth.look_up(coarse, n, current_depth.sparse_step(n), depth, u0, v0, log_depth)
    robust = np.empty(n, np.float32)
    work = solver.new_work()
    solver.robust_weights(coarse, n, pose, image.K, noise, work, robust)
    sigma, raw = current_depth.depth_scale(coarse, n, log_depth, robust, pose, image.K, noise)
    if raw <= 0:
        return sd, spread, None
    # var(rz) = sz^2 + h^2 sd^2: with two depths of one sensor sd is about raw / sqrt(2)
    if sd**2 < 2 * spread:
        # too little parallax for the flow to tell; errors that both depths share do not show here
        sd = min(raw / DEPTHS_PER_PAIR, solver.DEPTH_NOISE_CAP)
        spread = max(sd**2, MIN_DEPTH_VARIANCE)
    sd = min(sd, raw)
    solver.set_noise(sf, sd, options.cutoff, noise)
    flow = np.zeros(kernels.SUMS)
    solver.evaluate(coarse, n, pose, image.K, noise, work, flow)
    H_flow = symmetric(flow[:21])
    if options.current_depth == "auto":
        scaling = np.array([1 / inverse_depth] * 3 + [1.0] * 3)
        eigenvalues = np.linalg.eigvalsh(H_flow * np.outer(scaling, scaling))
        if eigenvalues[0] > WELL_CONDITIONED * eigenvalues[-1]:
            return sd, spread, None
    current_depth.look_up(coarse, n, 1, depth, u0, v0, log_depth)
    coarse_term = _DepthTerm(coarse, log_depth, n, columns, stride, max(sigma, 1e-4))
    # on the full fit the flow has every pixel, the depth every second one of both axes
    fine = max(1, min(2, stride))
    H_depth = (
        symmetric(coarse_term.sums(image, pose, noise, tile)[0].sum(axis=(0, 1))[:21]) / fine**2
    )
    if options.current_depth == "auto":
        try:
            gain = np.linalg.eigvals(np.linalg.solve(H_flow, H_depth)).real.max()
        except np.linalg.LinAlgError:
            gain = np.inf
        if not gain > CURRENT_DEPTH_GAIN:
            return sd, spread, None
    if fine == stride:
        return sd, spread, coarse_term
    samples, h, w = image.strided(fine)
    log_depth = np.empty(h * w, np.float32)
    current_depth.look_up(samples, h * w, 1, depth, u0, v0, log_depth)
    return sd, spread, _DepthTerm(samples, log_depth, h * w, w, fine, max(sigma, 1e-4))
