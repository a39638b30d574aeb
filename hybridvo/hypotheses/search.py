"""Every strong motion in the image, one after the other (numba).

Starts come from three sources: poses that the caller hands in (identity, the last motion, a
network's seed), robust dense fits of overlapping windows, and minimal three-pixel samples. They are
scored at two residual scales at once, the best few are refined, and the pixels that follow the
winner are set aside before the next round. The winner may be a compromise that takes the pixels of
a weaker motion with it, so the others of a round are kept, behind all winners. Everything is
deterministic for a seed.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from hybridvo.calibration import ASIDE, SETTLED_COHERENCE
from hybridvo.geometry import njit
from hybridvo.options import Options
from hybridvo.refinement.coarse_fit import (
    DEPTH_NOISE_CAP,
    FLOW_NOISE_CAP,
    NOISE_PIXELS,
    anneal,
    left_update,
    reestimate,
    residual_coherence,
    residual_scale,
    robust_weights,
    set_noise,
    solve6,
    translation_scale,
)
from hybridvo.refinement.kernels import (
    BUFFER_ROWS,
    FASTMATH,
    MAX_VALUE,
    MU,
    MV,
    XN,
    YN,
    W,
    Z,
    new_work,
)
from hybridvo.refinement.pixels import CoarseGrid

WINDOW_ROWS, WINDOW_COLUMNS = 3, 4
MINIMAL_SAMPLES = 384
"""Samples of three pixels for the first motion; a third of them for every further one."""
MINIMAL_STEPS = 3
REFINED = 4
"""Candidates of a round that are refined."""
WIDE_PX, NEAR_PX = 64.0, 1.5
"""First scale of the robust kernel: at most, and about a pose that was handed in."""
SAME_RAD = 2e-4
"""Entries of two poses up to which they are one motion; translations in typical depths."""
SETTLED = 0.5
"""Share of the image above which a motion without coherent residuals is taken as it is: no other
can hold as much, and further ones are looked for in what it leaves."""
FIRMLY = np.float32(2.5)
"""Factor on the robust weight that is set aside: nothing is left within 1.5 standard deviations, or
the same motion would be found again."""

SHARE, FLOW_NOISE, DEPTH_NOISE, SOURCE, ITERATIONS = range(5)
FACTS = 5
"""Columns of the table of facts of the hypotheses."""
SOURCE_WINDOW, SOURCE_MINIMAL, RUNNER_UP = 100, 101, 103
REFERENCE_WIDTH = 1024
"""px; images of different size are compared at this width."""
OTHER_PX = 3.0
"""Mean distance, px at that width, above which two motions are not the same."""


def find_motions(
    grid: CoarseGrid, starts: np.ndarray, options: Options, decisive: float, seed: int
) -> tuple[np.ndarray, np.ndarray, float]:
    """All strong motions, in the order of their strength.

    The first is sought from the handed-in starts; where these find none that is settled, and for
    every further one, windows and minimal samples compete as well.

    Args:
        grid: pixels on which motions are refined.
        starts: (S, 3, 4) poses T_curr_prev, the first one seen from afar only.
        options: ``search`` and ``refine`` are read.
        decisive: share of the usable pixels above which the first motion stands alone.
        seed: of the minimal samples.

    Returns:
        Poses (N, 3, 4), their facts (N, FACTS), and 1 / typical depth, by which translations are
        compared with rotations.
    """
    limits, cutoff, K = options.search, options.refine.cutoff, grid.pixels.K
    h, w, _ = grid.shape
    n, coarse, work = h * w, grid.samples.copy(), new_work()
    small, sh, sw, _ = grid.pixels.samples(limits.grid_pixels)
    depth_scale = translation_scale(grid.samples, n)
    rng = np.random.default_rng(seed)

    def search_round(starts: np.ndarray, samples: int) -> list[tuple[np.ndarray, np.ndarray]]:
        """Motions of the pixels that are left, the strongest first: (pose, facts)."""
        best = candidates(small, sh, sw, K, starts, samples, rng, depth_scale, work)
        scores, steps = refine_candidates(small, sh * sw, coarse, n, K, best, work)
        found: list[tuple[np.ndarray, np.ndarray]] = []
        for k in np.argsort(-scores, kind="stable"):
            pose, facts = best[0][k], np.zeros(FACTS)
            if scores[k] > 0 and _is_new(grid, pose, [*found, *seen] if found else []):
                facts[SOURCE] = best[2][k]
                facts[ITERATIONS] = steps[k]
                finish(coarse, n, K, cutoff, pose, facts, work)
                facts[SHARE] *= left / total
                found.append((pose, facts))
        seen.extend(found)
        return found

    motions: list[tuple[np.ndarray, np.ndarray]] = []
    seen: list[tuple[np.ndarray, np.ndarray]] = []
    total = left = float(coarse[W, :n].sum(dtype=np.float64))
    while len(motions) < limits.max_hypotheses and left > limits.min_inlier_ratio * total:
        if motions:
            found = search_round(starts[:0], MINIMAL_SAMPLES // 3)
        else:
            found = search_round(starts, 0)
            if not found or not _is_settled(coarse, h, w, K, *found[0]):
                found = search_round(starts, MINIMAL_SAMPLES)
        if not found:
            break
        pose, facts = found[0]
        if motions and facts[SHARE] < limits.min_inlier_ratio:
            break
        motions.append((pose, facts))
        if len(motions) == 1 and facts[SHARE] >= decisive:
            return pose[None], facts[None], depth_scale
        for samples, count in ((coarse, n), (small, sh * sw)):
            set_aside(samples, count, pose, K, facts[FLOW_NOISE], facts[DEPTH_NOISE], cutoff, work)
        left = float(coarse[W, :n].sum(dtype=np.float64))
    for pose, facts in sorted(seen, key=lambda motion: -motion[1][SHARE]):
        more = len(motions) < limits.max_hypotheses and facts[SHARE] >= limits.min_inlier_ratio
        if more and motions and _is_new(grid, pose, motions):
            facts[SOURCE] = RUNNER_UP
            motions.append((pose, facts))
    poses, table = ([motion[i] for motion in motions] for i in range(2))
    return np.reshape(poses, (-1, 3, 4)), np.reshape(table, (-1, FACTS)), depth_scale


def _is_new(
    grid: CoarseGrid, pose: np.ndarray, motions: Sequence[tuple[np.ndarray, np.ndarray]]
) -> bool:
    """Whether a pose is none of the motions."""
    poses = np.stack([pose, *(other for other, _ in motions)])
    return bool((distances(grid, poses, 0)[1:] > OTHER_PX).all())


def distances(grid: CoarseGrid, poses: np.ndarray, of: int) -> np.ndarray:
    """(N,) mean distance between where poses (N, 3, 4) bring the pixels and where one of them does,
    px at a width of 1024.
    """
    samples = grid.samples[:, : grid.count : 7]
    samples = samples[:, samples[W] > 0].astype(np.float64)
    z = samples[Z]
    points = np.stack([samples[XN] * z, samples[YN] * z, z])
    moved = poses[:, :, :3] @ points + poses[:, :, 3:]
    seen = moved[:, :2] / np.maximum(moved[:, 2:], 1e-3)
    gap = np.linalg.norm((seen - seen[of]) * grid.pixels.K[:2, None], axis=1)
    return np.minimum(gap, 1e3).mean(axis=1) * REFERENCE_WIDTH / grid.size[1]


def _is_settled(
    samples: np.ndarray, h: int, w: int, K: np.ndarray, pose: np.ndarray, facts: np.ndarray
) -> bool:
    """Whether no other motion can hold as much of the image, and this one is no compromise."""
    if facts[SHARE] < SETTLED:
        return False
    noise = facts[FLOW_NOISE], facts[DEPTH_NOISE]
    return bool(residual_coherence(samples, h, w, pose, K, *noise) < SETTLED_COHERENCE)


@njit(error_model="numpy", cache=True, nogil=True)
def candidates(small, h, w, K, starts, samples, rng, similar, work):
    """The best distinct candidates: (poses, scores, sources), best first.

    With ``samples`` minimal samples, and windows, they compete with the ``starts`` (S, 3, 4).
    """
    n = h * w
    best = (np.zeros((REFINED, 3, 4)), np.zeros(REFINED), np.zeros(REFINED))
    pose = np.empty((3, 4))
    for s in range(starts.shape[0]):
        # from afar; and, for what the caller hands in, from nearby: where most of the image moves
        # a wide kernel would leave even the right motion
        for near in range(2 if s > 0 else 1):
            pose[:, :] = starts[s]
            scale = NEAR_PX
            if near == 0:
                scale = min(WIDE_PX, max(1.0, 1.5 * residual_scale(small, n, pose, K)))
            anneal(small, n, K, scale, 0.7, 0.4, 2, pose, work)
            keep_best(pose, score_pose(small, n, pose, K), s, best, similar)
    if samples == 0:
        return best
    few = np.zeros((BUFFER_ROWS, n + 1), np.float32)
    rows = min(h, max(3, (2 * h) // (WINDOW_ROWS + 1)))
    columns = min(w, max(3, (2 * w) // (WINDOW_COLUMNS + 1)))
    for i in range(WINDOW_ROWS):
        for j in range(WINDOW_COLUMNS):
            r = i * (h - rows) // (WINDOW_ROWS - 1)
            c = j * (w - columns) // (WINDOW_COLUMNS - 1)
            if fit_window(small, w, r, r + rows, c, c + columns, K, few, pose, work):
                keep_best(pose, score_pose(small, n, pose, K), SOURCE_WINDOW, best, similar)
    pick = np.zeros(3, np.int64)
    for s in range(samples):
        drawn = draw_three(small, h, w, s % 3 != 0, rng, pick)
        if drawn and fit_minimal(small, pick, pose, K):
            keep_best(pose, score_pose(small, n, pose, K), SOURCE_MINIMAL, best, similar)
    return best


@njit(error_model="numpy", cache=True, nogil=True)
def refine_candidates(small, ns, coarse, n, K, best, work):
    """Refine the candidates of a round, in place, on ``small``: their scores on ``coarse``, steps.

    The scores are 0 where there is no candidate.
    """
    poses, scores, _ = best
    on_coarse, steps = np.zeros(REFINED), np.zeros(REFINED)
    for s in range(REFINED):
        if scores[s] > 0:
            steps[s] = anneal(small, ns, K, 1.5, 0.7, 0.4, 3, poses[s], work)
            on_coarse[s] = score_pose(coarse, n, poses[s], K)
    return on_coarse, steps


@njit(error_model="numpy", cache=True, nogil=True)
def finish(coarse, n, K, cutoff, pose, facts, work):
    """Refine a pose on ``coarse``, in place, and fill in its facts."""
    facts[ITERATIONS] += anneal(coarse, n, K, 0.7, 0.5, 0.4, 3, pose, work)
    candidate = pose.copy()
    sf, sd, share, more = reestimate(
        coarse, n, K, 0.5, 0.01, FLOW_NOISE_CAP, DEPTH_NOISE_CAP, cutoff, 2, 4, NOISE_PIXELS,
        candidate, work,
    )  # fmt: skip
    if score_pose(coarse, n, candidate, K) > 0.95 * score_pose(coarse, n, pose, K):
        pose[:, :] = candidate
    facts[SHARE] = share
    facts[FLOW_NOISE] = sf
    facts[DEPTH_NOISE] = sd
    facts[ITERATIONS] += more


@njit(error_model="numpy", cache=True, nogil=True)
def set_identity(pose):
    """``pose`` (3, 4) = [I | 0]."""
    pose[:, :] = 0.0
    for i in range(3):
        pose[i, i] = 1.0


@njit(error_model="numpy", cache=True, nogil=True)
def is_bounded(pose):
    """Whether every entry is finite and of a size that later sums survive."""
    for i in range(3):
        for j in range(4):
            if not abs(pose[i, j]) < MAX_VALUE:
                return False
    return True


@njit(error_model="numpy", cache=True, nogil=True)
def fit_minimal(samples, pick, pose, K):
    """Three pixels, six equations: Newton steps from the identity, in place; False if it fails."""
    rows = np.empty((6, 7))
    sums = np.empty(27)
    delta = np.empty(6)
    other = np.empty((3, 4))
    set_identity(pose)
    for _ in range(MINIMAL_STEPS):
        for m in range(3):
            k = pick[m]
            x, y, z = samples[XN, k], samples[YN, k], samples[Z, k]
            X = z * (pose[0, 0] * x + pose[0, 1] * y + pose[0, 2]) + pose[0, 3]
            Y = z * (pose[1, 0] * x + pose[1, 1] * y + pose[1, 2]) + pose[1, 3]
            Zc = z * (pose[2, 0] * x + pose[2, 1] * y + pose[2, 2]) + pose[2, 3]
            if not Zc > 1e-6:
                return False
            i = 1.0 / Zc
            a = X * i
            b = Y * i
            u = (samples[MU, k] - K[2]) / K[0] - a
            v = (samples[MV, k] - K[3]) / K[1] - b
            rows[2 * m] = (i, 0.0, -a * i, -a * b, 1.0 + a * a, -b, u)
            rows[2 * m + 1] = (0.0, i, -b * i, -(1.0 + b * b), a * b, a, v)
        q = 0
        for i in range(6):
            for j in range(i, 7):
                total = 0.0
                for r in range(6):
                    total += rows[r, i] * rows[r, j]
                if j == 6:
                    sums[21 + i] = total
                else:
                    sums[q] = total
                    q += 1
        if not solve6(sums, 0.0, delta):
            return False
        other[:, :] = pose
        left_update(delta, other, pose)
    return is_bounded(pose)


@njit(error_model="numpy", cache=True, nogil=True)
def fit_window(samples, w, r0, r1, c0, c1, K, few, pose, work):
    """Robust dense fit of the usable pixels of a window, from the identity, in place."""
    m = 0
    total = 0.0
    for r in range(r0, r1):
        for k in range(r * w + c0, r * w + c1):
            if samples[W, k] > 0.05:
                for q in range(BUFFER_ROWS):
                    few[q, m] = samples[q, k]
                total += samples[W, k]
                m += 1
    if m < 20 or total < 12.0:
        return False
    set_identity(pose)
    scale = min(WIDE_PX, max(1.0, residual_scale(few, m, pose, K)))
    anneal(few, m, K, scale, 0.7, 0.4, 2, pose, work)
    return is_bounded(pose)


@njit(error_model="numpy", cache=True, nogil=True)
def draw_three(samples, h, w, local, rng, pick):
    """Draw three distinct usable pixels, near by if ``local``; False where none is found."""
    m = 0
    for _ in range(60):
        k = int(rng.random() * h * w)
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
def keep_best(pose, score, source, best, similar):
    """Insert into the list of the best distinct candidates, best first."""
    poses, scores, sources = best
    # a candidate that scores alike and stands close by is the same motion
    place = len(scores)
    for k in range(len(scores)):
        if scores[k] <= 0:
            break
        gap = 0.0
        for i in range(3):
            for j in range(4):
                unit = similar if j == 3 else 1.0
                gap = max(gap, unit * abs(poses[k, i, j] - pose[i, j]))
        if gap < SAME_RAD:
            place = k
            break
    if place == len(scores):
        place -= 1
    if score <= scores[place]:
        return
    # whatever stood at ``place`` goes; what is worse than the new one moves down
    while place > 0 and score > scores[place - 1]:
        scores[place] = scores[place - 1]
        sources[place] = sources[place - 1]
        poses[place] = poses[place - 1]
        place -= 1
    scores[place] = score
    sources[place] = source
    poses[place] = pose


@njit(fastmath=FASTMATH, error_model="numpy", cache=True, nogil=True)
def agreement(samples, n, R, t, K):
    """Two-scale score of a pose: mean of 1 / (1 + (r / 0.15)^2) and 1 / (1 + (r / 0.9)^2)^2.

    The fine scale lets an exact motion win over a vague one, the coarse one keeps noisy flow in
    play; a wider scale yet makes compromises between two motions win (measured).
    """
    r00, r01, r02 = R[0, 0], R[0, 1], R[0, 2]
    r10, r11, r12 = R[1, 0], R[1, 1], R[1, 2]
    r20, r21, r22 = R[2, 0], R[2, 1], R[2, 2]
    tx, ty, tz = t[0], t[1], t[2]
    fx, fy, cx, cy = K[0], K[1], K[2], K[3]
    b_x, b_y, b_z, b_u = samples[XN], samples[YN], samples[Z], samples[MU]
    b_v, b_w = samples[MV], samples[W]
    one = np.float32(1.0)
    score = np.float32(0.0)
    for k in range(n):
        z = b_z[k]
        Zc = z * (r20 * b_x[k] + r21 * b_y[k] + r22) + tz
        front = Zc > np.float32(1e-6)
        i = one / (Zc if front else one)
        ru = b_u[k] - (fx * (z * (r00 * b_x[k] + r01 * b_y[k] + r02) + tx) * i + cx)
        rv = b_v[k] - (fy * (z * (r10 * b_x[k] + r11 * b_y[k] + r12) + ty) * i + cy)
        r2 = ru * ru + rv * rv
        near = one / (one + np.float32(44.4) * r2)
        mid = one / (one + np.float32(1.2) * r2)
        w = b_w[k] if front else np.float32(0.0)
        score += w * (np.float32(0.5) * near + np.float32(0.5) * mid * mid)
    return np.float64(score)


@njit(error_model="numpy", cache=True, nogil=True)
def score_pose(samples, n, pose, K):
    """:func:`agreement` of a (3, 4) float64 pose."""
    return agreement(samples, n, pose[:, :3].astype(np.float32), pose[:, 3].astype(np.float32), K)


@njit(error_model="numpy", cache=True, nogil=True)
def set_aside(samples, n, pose, K, sf, sd, cutoff, work):
    """Scale the weights of the pixels that follow ``pose`` down to what it leaves unexplained."""
    noise = np.empty(3, np.float32)
    follows = np.empty(n, np.float32)
    set_noise(max(sf, 0.05), sd, ASIDE * cutoff, noise)
    robust_weights(samples, n, pose, K, noise, work, follows)
    for k in range(n):
        samples[W, k] *= max(np.float32(0.0), np.float32(1.0) - FIRMLY * follows[k])
