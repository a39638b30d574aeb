"""Every strong motion in the image, one after the other.

Candidates are poses handed in, robust dense fits of overlapping windows and minimal three-pixel
samples. The pixels that follow the winner of a round are set aside before the next one.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from hybridvo.calibration import INLIER_REMOVAL_CUTOFF, NOISE_PIXELS
from hybridvo.numba_tools import njit
from hybridvo.options import Options
from hybridvo.refinement import kernels, robust_fit
from hybridvo.refinement.kernels import FASTMATH, MAX_VALUE, MU, MV, XN, YN, W, Z
from hybridvo.refinement.pixels import PixelGrid

WINDOW_ROWS = 3
WINDOW_COLUMNS = 4
# for the first motion (others: a third); steps of each
MINIMAL_SAMPLES = 384
MINIMAL_STEPS = 3
REFINED = 4  # candidates of a round that are refined
# first scale of the kernel: at most, and about a pose handed in
WIDE_PX = 64.0
NEAR_PX = 1.5
# largest entry between poses of one motion; translations in typical depths
SAME_RAD = 2e-4
INLIER_REMOVAL_GAIN = np.float32(
    2.5
)  # times the robust weight is set aside: or it would be found again

SHARE, FLOW_NOISE, DEPTH_NOISE, SOURCE, ITERATIONS = range(5)
FACTS = 5  # columns of the table of facts of the hypotheses
SOURCE_WINDOW = 100
SOURCE_MINIMAL = 101
SOURCE_REFIT = 102
RUNNER_UP = 103
"""What led to a motion; smaller numbers are those of the starts."""
REFERENCE_WIDTH = 1024  # px; images of different size are compared at this width
# mean distance, px at that width, above which two motions are not the same
OTHER_PX = 3.0


class Motion(NamedTuple):
    """A motion found."""

    pose: np.ndarray  # (3, 4) T_curr_prev
    facts: np.ndarray  # (FACTS,)


def find_motions(
    grid: PixelGrid, starts: np.ndarray, options: Options, seed: int
) -> tuple[np.ndarray, np.ndarray]:
    """Poses (N, 3, 4) of all strong motions, the strongest first, and their facts (N, FACTS).

    Windows and minimal samples, drawn by ``seed``, compete in every round, and in the first one
    the starts (S, 3, 4).
    """
    limits = options.search
    search = _Search(grid, options, seed)
    begun = search.from_starts(starts)
    motions = list[Motion]()
    while (
        len(motions) < limits.max_hypotheses
        and search.left > limits.min_inlier_ratio
    ):
        count = MINIMAL_SAMPLES // 3 if motions else MINIMAL_SAMPLES
        found = search.round(([] if motions else begun) + search.from_pixels(count))
        if not found or (
            motions and found[0].facts[SHARE] < limits.min_inlier_ratio
        ):
            break
        motions.append(found[0])
        if motions[0].facts[SHARE] >= limits.unambiguous_ratio:
            search.seen.clear()
            break
        search.set_aside(found[0])
    for motion in sorted(search.seen, key=lambda motion: -motion.facts[SHARE]):
        strong = motion.facts[SHARE] >= limits.min_inlier_ratio
        more = 0 < len(motions) < limits.max_hypotheses
        if more and strong and is_new(grid, motion.pose, motions):
            motion.facts[SOURCE] = RUNNER_UP
            motions.append(motion)
    poses = [m.pose for m in motions]
    table = [m.facts for m in motions]
    return np.reshape(poses, (-1, 3, 4)), np.reshape(table, (-1, FACTS))


class _Search:
    """The pixels of a pair, on a grid of its own, the share ``left``, and all motions ``seen``."""

    def __init__(self, grid: PixelGrid, options: Options, seed: int) -> None:
        self.grid = grid
        self.K = grid.K
        self.cutoff = options.refine.cutoff
        self.samples, self.h, self.w, _ = grid.sampled(options.search.grid_pixels)
        self.n = self.h * self.w
        self.similar = robust_fit.translation_scale(self.samples, self.n)
        self.rng = np.random.default_rng(seed)
        self.seen = list[Motion]()
        self.left = 1.0

    def round(self, candidates: Sequence[tuple[np.ndarray, int]]) -> list[Motion]:
        """Motions of the pixels that are left, the strongest first, from poses by their source."""
        poses = np.concatenate([some for some, _ in candidates])
        sources = [source for some, source in candidates for _ in some]
        scores = self._scores(poses)
        entries = (poses * [1, 1, 1, self.similar]).reshape(-1, 12)
        refined: list[tuple[float, np.ndarray, int, int]] = []
        while len(refined) < REFINED and scores.max(initial=0) > 0:
            k = int(np.argmax(scores))
            # what stands close by is the same motion
            scores[np.abs(entries - entries[k]).max(axis=1) < SAME_RAD] = 0
            pose = poses[k].copy()
            steps = robust_fit.anneal(
                self.samples, self.n, self.K, 1.5, 0.7, 0.4, 3, pose
            )
            refined.append((self._scores(pose[None])[0], pose, sources[k], steps))
        found: list[Motion] = []
        for score, pose, source, steps in sorted(
            refined, key=lambda each: -each[0]
        ):
            others = [*found, *self.seen] if found else []
            if score > 0 and is_new(self.grid, pose, others):
                found.append(self._finished(pose, source, steps))
        self.seen.extend(found)
        return found

    def from_starts(self, starts: np.ndarray) -> list[tuple[np.ndarray, int]]:
        """Poses handed in (S, 3, 4), fitted to all pixels, and their sources."""
        found = []
        for s, start in enumerate(starts):
            far = 1.5 * robust_fit.residual_scale(
                self.samples, self.n, start, self.K
            )
            # what the caller hands in also from nearby: where most of the image moves a wide kernel
            # would leave even the right motion
            for scale in (min(WIDE_PX, max(1.0, far)), NEAR_PX)[: 1 + (s > 0)]:
                pose = start.copy()
                robust_fit.anneal(
                    self.samples, self.n, self.K, scale, 0.7, 0.4, 2, pose
                )
                found.append((pose[None], s))
        return found

    def from_pixels(self, count: int) -> list[tuple[np.ndarray, int]]:
        """Poses of windows and of ``count`` minimal samples, and their sources."""
        pixels = self.samples, self.h, self.w, self.K
        minimal = fit_minimal_samples(*pixels, count, self.rng)
        return [(fit_windows(*pixels), SOURCE_WINDOW), (minimal, SOURCE_MINIMAL)]

    def _scores(self, poses: np.ndarray) -> np.ndarray:
        return score_poses(self.samples, self.n, poses, self.K)

    def _finished(self, pose: np.ndarray, source: int, steps: int) -> Motion:
        """The motion fitted with its noise."""
        pixels = self.samples, self.n, self.K
        steps += robust_fit.anneal(*pixels, 0.7, 0.5, 0.4, 3, pose)
        final = pose.copy()
        (sf, sd), share, more = robust_fit.reestimate(
            *pixels, self.cutoff, NOISE_PIXELS, final
        )
        scores = self._scores(np.stack([final, pose]))
        if scores[0] > 0.95 * scores[1]:
            pose = final
        return Motion(
            pose, np.array([share * self.left, sf, sd, source, steps + more], float)
        )

    def set_aside(self, motion: Motion) -> None:
        """Scale the weights of the pixels that follow a motion down to what it leaves."""
        pose, facts = motion
        sf = max(facts[FLOW_NOISE], 0.05)
        sd = facts[DEPTH_NOISE]
        noise = kernels.residual_noise(sf, sd, INLIER_REMOVAL_CUTOFF * self.cutoff)
        follows = kernels.robust_weights(self.samples, self.n, pose, self.K, noise)
        weight = self.samples[W, : self.n]
        before = weight.sum()
        weight *= np.maximum(0, 1 - INLIER_REMOVAL_GAIN * follows)
        self.left *= float(weight.sum() / before)


def is_new(grid: PixelGrid, pose: np.ndarray, motions: Sequence[Motion]) -> bool:
    """Whether a pose is none of the motions."""
    poses = [pose, *(motion.pose for motion in motions)]
    return bool((distances(grid, poses, 0)[1:] > OTHER_PX).all())


def distances(grid: PixelGrid, poses: Sequence[np.ndarray], of: int) -> np.ndarray:
    """(N,) mean distance between where poses bring some pixels and one does, px of 1024."""
    gaps = mean_gaps(grid.samples, grid.count, np.stack(poses), of, grid.K)
    return gaps * (REFERENCE_WIDTH / grid.size[1])


@njit(fastmath=FASTMATH, error_model="numpy", cache=True, nogil=True)
def mean_gaps(samples, n, poses, of, K):
    """(N,) mean distance, px, over every seventh pixel: 1000 at most, and where one is behind."""
    other = kernels.pose_entries(poses[of])
    gaps = np.empty(len(poses))
    most = 1e3
    for m in range(len(poses)):
        entries = kernels.pose_entries(poses[m])
        total = 0.0
        count = 0
        for k in range(0, n, 7):
            if samples[W, k] > 0:
                x = samples[XN, k]
                y = samples[YN, k]
                z = samples[Z, k]
                a, b, _, front = kernels.transform_and_project(x, y, z, entries)
                c, d, _, also = kernels.transform_and_project(x, y, z, other)
                gap = np.sqrt((K[0] * (a - c)) ** 2 + (K[1] * (b - d)) ** 2)
                # behind both cameras they do not differ
                total += (
                    min(gap, most) if front and also else most * (front != also)
                )
                count += 1
        gaps[m] = total / count if count else most
    return gaps


@njit(error_model="numpy", cache=True, nogil=True)
def fit_windows(samples, h, w, K):
    """(M, 3, 4) robust dense fits, from the identity, of overlapping windows."""
    rows = min(h, max(3, (2 * h) // (WINDOW_ROWS + 1)))
    columns = min(w, max(3, (2 * w) // (WINDOW_COLUMNS + 1)))
    few = np.empty((kernels.BUFFER_ROWS, rows * columns), np.float32)
    poses = np.empty((WINDOW_ROWS * WINDOW_COLUMNS, 3, 4))
    m = 0
    for i in range(WINDOW_ROWS):
        for j in range(WINDOW_COLUMNS):
            r = i * (h - rows) // (WINDOW_ROWS - 1)
            c = j * (w - columns) // (WINDOW_COLUMNS - 1)
            n = 0
            weight = 0.0
            for k in range(rows * columns):
                at = (r + k // columns) * w + c + k % columns
                if samples[W, at] > 0.05:
                    for q in range(kernels.BUFFER_ROWS):
                        few[q, n] = samples[q, at]
                    weight += samples[W, at]
                    n += 1
            if n < 20 or weight < 12.0:
                continue
            pose = np.eye(3, 4)
            scale = min(
                WIDE_PX, max(1.0, robust_fit.residual_scale(few, n, pose, K))
            )
            robust_fit.anneal(few, n, K, scale, 0.7, 0.4, 2, pose)
            if np.all(np.abs(pose) < MAX_VALUE):
                poses[m] = pose
                m += 1
    return poses[:m]


@njit(error_model="numpy", cache=True, nogil=True)
def fit_minimal_samples(samples, h, w, K, count, rng):
    """(M, 3, 4) motions of ``count`` samples of three pixels, those that determine one."""
    poses = np.empty((count, 3, 4))
    pick = np.zeros(3, np.int64)
    m = 0
    usable = np.flatnonzero(samples[W, : h * w] > 0)
    for s in range(count if len(usable) >= 3 else 0):
        drawn = draw_three(samples, usable, h, w, s % 3 != 0, rng, pick)
        if drawn and fit_minimal(samples, pick, poses[m], K):
            m += 1
    return poses[:m]


@njit(error_model="numpy", cache=True, nogil=True)
def draw_three(samples, usable, h, w, local, rng, pick):
    """Draw three distinct usable pixels, near by if ``local``; False where none is found."""
    m = 0
    for _ in range(60):
        k = usable[int(rng.random() * len(usable))]
        if m > 0 and local:
            row = pick[0] // w + int((rng.random() - 0.5) * 0.5 * h)
            column = pick[0] % w + int((rng.random() - 0.5) * 0.4 * w)
            if row < 0 or row >= h or column < 0 or column >= w:
                continue
            k = row * w + column
        if samples[W, k] < rng.random() or k in pick[:m]:
            continue
        pick[m] = k
        m += 1
        if m == 3:
            return True
    return False


@njit(error_model="numpy", cache=True, nogil=True)
def fit_minimal(samples, pick, pose, K):
    """Three pixels, six equations: Newton steps from the identity, in place; False if it fails."""
    rows = np.empty((6, 7))
    sums = np.empty(27)
    delta = np.empty(6)
    pose[:] = np.eye(3, 4)
    for _ in range(MINIMAL_STEPS):
        entries = kernels.pose_entries(pose)
        for m in range(3):
            k = pick[m]
            a, b, i, front = kernels.transform_and_project(
                samples[XN, k], samples[YN, k], samples[Z, k], entries
            )
            if not front:
                return False
            u = (samples[MU, k] - K[2]) / K[0] - a
            v = (samples[MV, k] - K[3]) / K[1] - b
            rows[2 * m] = (i, 0.0, -a * i, -a * b, 1.0 + a * a, -b, u)
            rows[2 * m + 1] = (0.0, i, -b * i, -(1.0 + b * b), a * b, a, v)
        sums[:] = 0.0
        for row in rows:
            q = 0
            for i in range(6):
                for j in range(i, 6):
                    sums[q] += row[i] * row[j]
                    q += 1
                sums[21 + i] += row[i] * row[6]
        if not robust_fit.solve6(sums, 0.0, delta):
            return False
        robust_fit.left_update(delta, pose, pose)
    return np.all(np.abs(pose) < MAX_VALUE)


@njit(fastmath=FASTMATH, error_model="numpy", cache=True, nogil=True)
def score_poses(samples, n, poses, K):
    """(M,) scores of poses (M, 3, 4): sums of 1 / (1 + (r / 0.15)^2) and 1 / (1 + (r / 0.9)^2)^2:
    an exact motion wins over a vague one, and noisy flow stays in play.
    """
    scores = np.empty(len(poses))
    fx = K[0]
    fy = K[1]
    cx = K[2]
    cy = K[3]
    b_x = samples[XN]
    b_y = samples[YN]
    b_z = samples[Z]
    b_u = samples[MU]
    b_v = samples[MV]
    b_w = samples[W]
    one = np.float32(1.0)
    half = np.float32(0.5)
    for m in range(len(poses)):
        entries = kernels.pose_entries(poses[m].astype(np.float32))
        score = np.float32(0.0)
        for k in range(n):
            a, b, _, front = kernels.transform_and_project(
                b_x[k], b_y[k], b_z[k], entries
            )
            ru = b_u[k] - (fx * a + cx)
            rv = b_v[k] - (fy * b + cy)
            r2 = ru * ru + rv * rv
            near = one / (one + np.float32(44.4) * r2)
            mid = one / (one + np.float32(1.2) * r2)
            w = b_w[k] if front else np.float32(0.0)
            score += w * (half * near + half * mid * mid)
        scores[m] = score if score > 0 else 0.0  # also where a pose is not finite
    return scores
