"""Refinement on flow and depth: from a start to a metric motion with covariance and status.

Minimises the ego-flow reprojection error (paper, equations 6 and 8), weighed by the noise of flow
and depth, both estimated from the pair, under a Geman-McClure kernel.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from hybridvo.calibration import MIN_TILES, WEAK_RATIO
from hybridvo.geometry import invert, pose_matrix, se3_log
from hybridvo.options import RefineOptions
from hybridvo.refinement import coarse_fit, kernels
from hybridvo.refinement.covariance import motion_covariance, symmetric
from hybridvo.refinement.depth import compare_depths, depth_noise
from hybridvo.refinement.pixels import PixelGrid, coarse_grid
from hybridvo.refinement.solver import Linearization, gauss_newton, tile_size
from hybridvo.results import (
    UNINFORMATIVE_COVARIANCE,
    Hypothesis,
    Reason,
    RelativePose,
    Status,
)
from hybridvo.types import FramePair

# share of the pixels that follow a motion; with less it failed
MIN_INLIER_RATIO = 0.02
STEPS = 5  # most Newton steps on all pixels
# length of the last step, standard deviations: what it leaves is a tenth of one
STEP_TOLERANCE_SIGMA = 30.0
# times the noise of one: sqrt(2), less what interpolation averages away
DEPTHS_PER_PAIR = 1.32


@dataclass(frozen=True, eq=False)
class Selection:
    """The motion (4, 4) to be refined, and what is known of it."""

    T_curr_prev: np.ndarray
    # flow px, log depth: standard deviations found so far
    noise: tuple[float, float] | None = None
    # (h, w) weights on the coarse grid that it was fitted with
    mask: np.ndarray | None = None
    coverage: float = 1.0  # share of the usable pixels' weight that the mask leaves
    # by how much its score exceeds that of any other motion
    evidence: tuple[float, ...] = ()
    probability: float = 1.0  # that the motion is right, calibrated in the evidence
    # all candidates, the one selected first
    hypotheses: tuple[Hypothesis, ...] = ()
    iterations: int = 0  # Gauss-Newton steps spent on it


def refine_pair(
    pair: FramePair,
    start: Selection,
    grid: PixelGrid | None = None,
    weights: np.ndarray | None = None,
    options: RefineOptions | None = None,
    min_probability: float = 0.0,
) -> RelativePose:
    """The motion of a pair near its only start; degraded below ``min_probability``.

    ``grid``: the pair's; None: it is made, with ``weights`` (H, W) on the information.
    """
    options = options or RefineOptions()
    made = grid or coarse_grid(pair, weights, options)
    if isinstance(made, RelativePose):
        return made
    pose = np.array(start.T_curr_prev[:3], np.float64)
    noise = start.noise
    iterations = start.iterations
    if noise is None:
        pose, sf, sd, _, iterations = coarse_fit.fit_coarse(
            made.samples, made.count, made.K, pose, options.cutoff
        )
        noise = sf, sd
    curr = None if options.current_depth == "off" else pair.curr.depth
    motion, tiles, eigenvalues = _fit_full_grid(made, curr, pose, noise, options)
    depths = (
        None
        if curr is None
        else compare_depths(pair, motion.T_curr_prev, motion.weights)
    )
    share = motion.inlier_ratio
    motion = motion.replace(
        inlier_ratio=min(1.0, share * start.coverage),
        iterations=iterations + motion.iterations,
        hypotheses=start.hypotheses,
        probability=start.probability,
        evidence=start.evidence,
    )
    weak = degeneracy(eigenvalues, tiles, made.size, options)
    status = status_of(
        tiles > 0, share, Status() if depths is None else depths.status,
        start.probability, min_probability, weak,
    )  # fmt: skip
    if not status.usable:
        nothing = {
            "T_curr_prev": np.eye(4),
            "covariance": UNINFORMATIVE_COVARIANCE.copy(),
            "probability": 0.0,
        }
        return motion.replace(status=status, **nothing)
    # what few tiles, and two depths that differ, leave unknown
    covariance = motion.covariance * max(1.0, MIN_TILES / tiles)
    if depths is not None:
        covariance[:3, :3] += depths.length_doubt(motion.T_curr_prev[:3, 3])
    return motion.replace(status=status, covariance=covariance)


def degeneracy(
    eigenvalues: np.ndarray,
    tiles: int,
    size: tuple[int, int],
    options: RefineOptions,
) -> str:
    """What makes a definite motion doubtful, or "": the pixels' geometry, or how few tiles."""
    if eigenvalues[0] < WEAK_RATIO * eigenvalues[-1]:
        return "a direction of the motion is barely determined"
    if (
        tiles
        < MIN_TILES
        <= 0.5 * np.prod(size) / tile_size(size, options.tiles) ** 2
    ):
        return "the pixels cover too little of the image to tell how far their errors agree"
    return ""


def status_of(
    definite: bool,
    share: float,
    doubt: Status,
    probability: float,
    min_probability: float,
    weak: str = "",
) -> Status:
    """Status of a motion that ``share`` of the pixels follow; the first reason that holds."""
    degenerate = Reason.DEGENERATE_GEOMETRY
    if not definite:
        return Status.failed(
            degenerate, "the pixels leave a direction of the motion undetermined"
        )
    if share < MIN_INLIER_RATIO:
        return Status.failed(
            Reason.LOW_INLIERS, f"{100 * share:.1f} % of pixels follow one motion"
        )
    if not doubt.ok:
        return doubt
    if probability < min_probability:
        return ambiguous(probability)
    if weak:
        return Status.degraded(degenerate, weak)
    return Status()


def ambiguous(probability: float) -> Status:
    """Status of a motion that may be another's than the camera's."""
    what = "another of the motions found could be the camera's (probability of this one"
    return Status.degraded(
        Reason.AMBIGUOUS_MOTION, f"{what} {100 * probability:.0f} %)"
    )


def inflate_ambiguous_covariance(motion: RelativePose) -> RelativePose:
    """An ambiguous motion, its covariance widened to cover the others: the mixture's second moment.

    If it is wrong, the camera's is as far away as the farthest of the others or standing still.
    """
    others = [h.T_curr_prev for h in motion.hypotheses[1:]] + [np.eye(4)]
    steps = np.array([se3_log(motion.T_curr_prev @ invert(T)) for T in others])
    sizes = [
        np.max(np.sum(steps[:, part] ** 2, axis=1))
        for part in (slice(0, 3), slice(3, 6))
    ]
    doubt = (1 - motion.probability) * np.diag(np.repeat(sizes, 3))
    return motion.replace(covariance=motion.covariance + doubt)


class FlowFactor:
    """Flow and depth of every pixel of a pair; ``per_weight`` (42,): of ``kernels.score_sums``."""

    def __init__(
        self, grid: PixelGrid, noise: np.ndarray, tile: int, per_weight: np.ndarray
    ) -> None:
        self._grid = grid
        self._noise = noise
        self._tile = tile
        self._per_weight = per_weight
        self.weights = np.empty(grid.size, np.float32)

    def linearize(self, T: np.ndarray) -> Linearization:
        """The sums of each tile, of cost and weights, and the robust weights stay as attributes."""
        at = T[:3], self._noise, self._tile, self.weights
        self.tiles, self.rest = self._grid.full_pass(*at)
        both = self._per_weight * self.rest[2]
        self.curvature = symmetric(both[:21])
        self.meat = symmetric(both[21:])
        sums = self.tiles.sum(axis=(0, 1))
        return Linearization(
            symmetric(sums[:21]), sums[21:], float(self.rest[0]), self.curvature
        )


def pair_noise(
    samples: np.ndarray,
    n: int,
    K: np.ndarray,
    pose: np.ndarray,
    start: tuple[float, float],
    cutoff: float,
    curr: np.ndarray | None,
) -> tuple[float, float, float]:
    """Noise (sf, sd) of the pixels that follow a motion, and their share of the weight; the current
    depth (H, W) bounds the noise of the first, and tells it where the flow cannot.
    """
    sf, sd = start
    sf, sd, share, told = coarse_fit.estimate_noise(
        samples, n, pose, K, sf, sd, 2.5 * sf, max(2.5 * sd, 0.02), 30,
        coarse_fit.FINAL_NOISE_PIXELS,
    )  # fmt: skip
    if curr is None:
        return sf, sd, share
    few = np.ascontiguousarray(samples[:, : n : max(1, n // 1000)])
    noise = coarse_fit.noise_of(sf, sd, cutoff)
    robust = coarse_fit.robust_weights(few, few.shape[1], pose, K, noise)
    both = depth_noise(few, curr, robust, pose)
    if both <= 0:
        return sf, sd, share
    if not told:  # errors that both depths share do not show here
        sd = min(both / DEPTHS_PER_PAIR, coarse_fit.DEPTH_NOISE_CAP)
    return sf, min(sd, both), share


def _fit_full_grid(
    grid: PixelGrid,
    curr: np.ndarray | None,
    pose: np.ndarray,
    start: tuple[float, float],
    options: RefineOptions,
) -> tuple[RelativePose, int, np.ndarray]:
    """The motion, no status; tiles with pixels, 0 if a direction is open; eigenvalues, rising."""
    samples = grid.samples
    n = grid.count
    K = grid.K
    sf, sd, share = pair_noise(samples, n, K, pose, start, options.cutoff, curr)
    noise = coarse_fit.noise_of(sf, sd, options.cutoff)
    inverse_depth = coarse_fit.translation_scale(samples, n)
    total = float(grid.weight.sum(dtype=np.float64))
    iterations = coarse_fit.gauss_newton(
        samples, n, total, K, noise, 4, 1e-3 * sf, pose
    )
    per_weight = kernels.score_sums(samples, n, pose, K, noise)
    flow = FlowFactor(grid, noise, tile_size(grid.size, options.tiles), per_weight)
    T, more = gauss_newton(
        flow.linearize, pose_matrix(pose), STEPS, STEP_TOLERANCE_SIGMA
    )
    T, (cost, followers, usable) = pose_matrix(T[:3]), flow.rest
    covariance, eigenvalues, occupied = motion_covariance(
        flow.tiles,
        flow.curvature,
        flow.meat,
        inverse_depth,
        usable,
        K[0],
        T[:3, 3],
        (sf, sd),
    )
    motion = RelativePose(
        T_curr_prev=T,
        covariance=covariance,
        method="classical",
        terms=("flow",),
        inlier_ratio=float(share) if followers >= 6 else 0.0,
        iterations=int(iterations + more),
        cost=float(cost / max(usable, 1e-12)),
        residual_scale_px=float(sf),
        depth_noise=float(sd),
        weights=flow.weights,
    )
    return motion, occupied if np.isfinite(T).all() else 0, eigenvalues
