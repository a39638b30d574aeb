"""The search for every strong motion in the image, one after the other.

The candidates of a round are poses that the caller hands in, robust fits of overlapping
windows, and motions of three pixels. The pixels that follow the winner of a round are
removed before the next round.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from operator import attrgetter
from typing import NamedTuple

import numpy as np

from hybridvo.compiled.numba_tools import njit
from hybridvo.core.options import Options, SearchOptions
from hybridvo.hypotheses.calibration import (
    DISTINCT_MOTION_PX,
    INLIER_REMOVAL_CUTOFF,
    INLIER_REMOVAL_GAIN,
    REESTIMATED_MIN_SCORE,
)
from hybridvo.hypotheses.cues import MIN_INLIER_NOISE_PX
from hybridvo.hypotheses.proposals import (
    CANDIDATE_ANNEALING,
    CANDIDATE_MIN_START_PX,
    Annealing,
    fit_minimal_samples,
    fit_windows,
    score_poses,
)
from hybridvo.hypotheses.types import Candidate, MotionSource
from hybridvo.solver import kernels, robust_fit
from hybridvo.solver.kernels import FASTMATH, XN, YN, W, Z
from hybridvo.solver.pixels import PixelGrid

# Pixels from which the noise of a motion is estimated during the search, about.
NOISE_PIXELS = 1000
# First scale about a pose that is handed in, as a multiple of its median residual.
START_SCALE_FACTOR = 1.5
# First scale of a second fit about a pose that is handed in, px: where most of the image moves, a
# wide kernel would leave even the right motion.
NEAR_START_PX = 1.5
# Of the candidates of a round that have the largest scores.
BEST_CANDIDATES_ANNEALING = Annealing(start_px=1.5, end_px=0.7, ratio=0.4, steps=3)
# Of a motion that won its round, before its noise is estimated.
FOUND_MOTION_ANNEALING = Annealing(start_px=0.7, end_px=0.5, ratio=0.4, steps=3)
# Largest difference between the entries of two poses that are one candidate: rad, and translation
# over the typical depth.
DUPLICATE_CANDIDATE = 2e-4
# Largest difference of the ego flows of two motions at a pixel, px; also that of a pixel which
# only one of them leaves in front of the camera.
MAX_PIXEL_DISTANCE_PX = 1e3

# minimal samples of the first round, and of each later one: without any 47 instead of 38 of 196
# steps of the kitchen, box and lens clips are wrong
FIRST_MINIMAL_SAMPLES = 384
LATER_MINIMAL_SAMPLES = 128
# candidates of a round that are fitted to all pixels
BEST_CANDIDATES = 4
# px; images of different size are compared at this width
REFERENCE_WIDTH = 1024
# motions are compared on every so many pixels
COMPARED_STRIDE = 7


POSE_OF = attrgetter("pose")
Proposals = Mapping[MotionSource, np.ndarray]
"""Poses (N, 3, 4) of each kind, which compete in a round."""


class _ScoredCandidate(NamedTuple):
    """A candidate fitted to all pixels, and the Gauss-Newton steps spent on it."""

    score: float
    pose: np.ndarray
    source: MotionSource
    iterations: int


def find_motions(
    grid: PixelGrid, starts: np.ndarray, options: Options, seed: int
) -> tuple[Candidate, ...]:
    """Find all strong motions of a pair.

    Windows and minimal samples compete in every round, the starts only in the first one.
    The search ends where too few pixels are left for another motion, or where the winner of a
    round has too few inliers. However many pixels follow the first winner, it may be a compromise
    between the camera's motion and an object's: what it leaves tells both apart.

    Args:
        grid: the pixels of the pair.
        starts: (S, 3, 4) ``T_curr_prev`` that the caller hands in.
        options: the option tree, of which ``search`` and ``refine.cutoff`` matter.
        seed: of the minimal samples.

    Returns:
        The winners of the rounds, then the distinct motions that won no round; nothing
        where the pixels determine no motion.
    """
    limits = options.search
    search = _Search(grid, options, seed)
    fitted = search.fit_starts(starts)
    motions: list[Candidate] = []
    while (
        len(motions) < limits.max_hypotheses
        and search.remaining_ratio > limits.min_inlier_ratio
    ):
        if not motions:
            from_pixels = search.fit_pixels(FIRST_MINIMAL_SAMPLES)
            ranked = search.run_round({MotionSource.START: fitted, **from_pixels})
        else:
            ranked = search.run_round(search.fit_pixels(LATER_MINIMAL_SAMPLES))
        if not ranked:
            break
        winner = ranked[0]
        if motions and winner.inlier_ratio < limits.min_inlier_ratio:
            break
        motions.append(winner)
        search.remove_inliers(winner)
    return _with_runners_up(grid, motions, search.ranked, limits)


def _with_runners_up(
    grid: PixelGrid,
    winners: Sequence[Candidate],
    ranked: Sequence[Candidate],
    limits: SearchOptions,
) -> tuple[Candidate, ...]:
    """Append the strong motions that differ from all before, the strongest first."""
    motions = list(winners)
    if not motions:
        return ()
    by_strength = sorted(ranked, key=lambda x: x.inlier_ratio, reverse=True)
    for motion in by_strength:
        is_strong = motion.inlier_ratio >= limits.min_inlier_ratio
        has_room = len(motions) < limits.max_hypotheses
        if has_room and is_strong and is_new(grid, motion.pose, motions):
            motions.append(motion._replace(source=MotionSource.RUNNER_UP))
    return tuple(motions)


class _Search:
    """The pixels of a pair on a sparse grid, and what earlier rounds made of them.

    Attributes:
        ranked: every distinct motion of every round.
        remaining_ratio: fraction of the weight that is left after inliers were removed.
    """

    def __init__(self, grid: PixelGrid, options: Options, seed: int) -> None:
        self.grid = grid
        self.K = grid.K
        self.cutoff = options.refine.cutoff
        self.samples, shape = grid.sampled(options.search.grid_pixels)
        self.h, self.w, _ = shape
        self.n = self.h * self.w
        self.inverse_depth = robust_fit.translation_scale(self.samples, self.n)
        self.rng = np.random.default_rng(seed)
        self.ranked: list[Candidate] = []
        self.remaining_ratio = 1.0

    def fit_starts(self, starts: np.ndarray) -> np.ndarray:
        """Fit the poses that the caller hands in, (S, 3, 4), to all pixels.

        The first one is the identity. The others are fitted twice, with a wide kernel and
        with a narrow one.

        Returns:
            (N, 3, 4) poses.
        """
        poses = []
        for number, start in enumerate(starts):
            residual_px = robust_fit.residual_scale(
                self.samples, self.n, start, self.K
            )
            wide_px = max(CANDIDATE_MIN_START_PX, START_SCALE_FACTOR * residual_px)
            start_scales = [min(CANDIDATE_ANNEALING.start_px, wide_px)]
            if number > 0:
                start_scales.append(NEAR_START_PX)
            for start_px in start_scales:
                pose = start.copy()
                self._anneal(CANDIDATE_ANNEALING._replace(start_px=start_px), pose)
                poses.append(pose)
        return np.stack(poses)

    def fit_pixels(self, minimal_samples: int) -> Proposals:
        """Fit windows, and so many minimal samples, to the pixels that are left."""
        minimal = fit_minimal_samples(
            self.samples, self.h, self.w, self.K, minimal_samples, self.rng
        )
        windows = fit_windows(self.samples, self.h, self.w, self.K)
        return {MotionSource.WINDOW: windows, MotionSource.MINIMAL: minimal}

    def run_round(self, proposals: Proposals) -> list[Candidate]:
        """Fit the best proposals to the pixels that are left.

        Returns:
            The distinct ones, the largest score first. Those behind the winner also
            differ from the motions of earlier rounds.
        """
        best = self._fit_best(proposals)
        best.sort(key=lambda x: x.score, reverse=True)
        ranked: list[Candidate] = []
        for candidate in best:
            others = [*ranked, *self.ranked] if ranked else []
            if candidate.score > 0 and is_new(self.grid, candidate.pose, others):
                ranked.append(self._finish(candidate))
        self.ranked.extend(ranked)
        return ranked

    def _fit_best(self, proposals: Proposals) -> list[_ScoredCandidate]:
        """Fit the distinct proposals with the largest scores to the pixels left."""
        poses = np.concatenate(list(proposals.values()))
        sources = [source for source, some in proposals.items() for _ in some]
        scores = self._scores(poses)
        # radians, and translations in units of the typical depth
        units = np.array([1.0, 1.0, 1.0, self.inverse_depth])
        entries = (poses * units).reshape(-1, 12)
        best: list[_ScoredCandidate] = []
        while len(best) < BEST_CANDIDATES and scores.max(initial=0) > 0:
            k = int(np.argmax(scores))
            difference = np.abs(entries - entries[k]).max(axis=1)
            scores[difference < DUPLICATE_CANDIDATE] = 0
            pose = poses[k].copy()
            iterations = self._anneal(BEST_CANDIDATES_ANNEALING, pose)
            score = float(self._scores(pose[None])[0])
            best.append(_ScoredCandidate(score, pose, sources[k], iterations))
        return best

    def _finish(self, candidate: _ScoredCandidate) -> Candidate:
        """Fit a motion once more, then estimate its noise, and fit it with that noise."""
        annealed = candidate.pose.copy()
        iterations = self._anneal(FOUND_MOTION_ANNEALING, annealed)
        reestimated = annealed.copy()
        (flow_noise_px, depth_noise), inlier_ratio, more = robust_fit.reestimate(
            self.samples,
            self.n,
            self.K,
            self.cutoff,
            NOISE_PIXELS,
            reestimated,
        )
        after, before = self._scores(np.stack([reestimated, annealed]))
        is_as_good = after > REESTIMATED_MIN_SCORE * before
        return Candidate(
            reestimated if is_as_good else annealed,
            inlier_ratio=float(inlier_ratio * self.remaining_ratio),
            flow_noise_px=float(flow_noise_px),
            depth_noise=float(depth_noise),
            source=candidate.source,
            iterations=int(candidate.iterations + iterations + more),
        )

    def remove_inliers(self, motion: Candidate) -> None:
        """Reduce the weights of the pixels that follow a motion."""
        noise = kernels.residual_noise(
            max(motion.flow_noise_px, MIN_INLIER_NOISE_PX),
            motion.depth_noise,
            INLIER_REMOVAL_CUTOFF * self.cutoff,
        )
        robust = kernels.robust_weights(
            self.samples, self.n, motion.pose, self.K, noise
        )
        weight = self.samples[W, : self.n]
        before = weight.sum()
        weight *= np.maximum(0, 1 - INLIER_REMOVAL_GAIN * robust)
        self.remaining_ratio *= float(weight.sum() / before)

    def _scores(self, poses: np.ndarray) -> np.ndarray:
        return score_poses(self.samples, self.n, poses, self.K)

    def _anneal(self, schedule: Annealing, pose: np.ndarray) -> int:
        """Fit a pose to all pixels under a shrinking kernel, in place; return the steps."""
        return robust_fit.anneal(self.samples, self.n, self.K, *schedule, pose)


def is_new(grid: PixelGrid, pose: np.ndarray, motions: Sequence[Candidate]) -> bool:
    """Whether a pose (3, 4) differs from each of the motions."""
    poses = [pose, *map(POSE_OF, motions)]
    others = distances(grid, poses, 0)[1:]
    return bool((others > DISTINCT_MOTION_PX).all())


def distances(
    grid: PixelGrid, poses: Sequence[np.ndarray], reference: int
) -> np.ndarray:
    """Mean difference of the ego flows of motions from that of one of them.

    Args:
        grid: pixels with depth.
        poses: N motions (3, 4).
        reference: index of the motion that all are compared with.

    Returns:
        (N,) px at a width of 1024.
    """
    distances_px = mean_distances(
        grid.samples, grid.count, np.stack(poses), reference, grid.K
    )
    return distances_px * (REFERENCE_WIDTH / grid.size[1])


@njit(fastmath=FASTMATH, error_model="numpy", cache=True, nogil=True)
def mean_distances(samples, n, poses, reference, K):
    """Mean distances (N,), px, of :func:`distances`, over every seventh pixel.

    The distance of a pixel is limited, and takes that limit where only one of the two
    motions leaves it in front of the camera. It is 0 where both bring it behind.
    """
    reference_entries = kernels.pose_entries(poses[reference])
    means = np.empty(len(poses))
    for m in range(len(poses)):
        entries = kernels.pose_entries(poses[m])
        total = 0.0
        count = 0
        for k in range(0, n, COMPARED_STRIDE):
            if not samples[W, k] > 0:
                continue
            x = samples[XN, k]
            y = samples[YN, k]
            z = samples[Z, k]
            a, b, _, front = kernels.transform_and_project(x, y, z, entries)
            c, d, _, reference_front = kernels.transform_and_project(
                x, y, z, reference_entries
            )
            count += 1
            if front and reference_front:
                du = K[0] * (a - c)
                dv = K[1] * (b - d)
                total += min(np.sqrt(du**2 + dv**2), MAX_PIXEL_DISTANCE_PX)
            elif front != reference_front:
                total += MAX_PIXEL_DISTANCE_PX
        means[m] = total / count if count else MAX_PIXEL_DISTANCE_PX
    return means
