"""Every strong motion in the image, one after the other (numba).

Starts come from three sources: poses that the caller hands in (identity, the last motion, a
network's seed), robust dense fits of overlapping windows, and minimal three-pixel samples. They are
scored at two residual scales at once, the best few are refined, and the pixels that follow the
winner are set aside before the next round. Everything is deterministic for a seed.
"""

from __future__ import annotations

import math

import numpy as np

from hybridvo.compilation import njit
from hybridvo.refinement.coarse_fit import (
    DEPTH_NOISE_CAP,
    FLOW_NOISE_CAP,
    NOISE_PIXELS,
    anneal,
    left_update,
    reestimate,
    residual,
    residual_scale,
    robust_weights,
    set_noise,
)
from hybridvo.refinement.kernels import (
    BUFFER_ROWS,
    FASTMATH,
    MAX_VALUE,
    MU,
    MV,
    PD,
    PF,
    XN,
    YN,
    W,
    Z,
    new_work,
)

WINDOW_ROWS, WINDOW_COLUMNS = 3, 4
MINIMAL_SAMPLES = 384
MINIMAL_STEPS = 3
REFINED = 4
NEAR_START = 1.5
"""First scale, px, of the robust kernel about a pose that was handed in."""
COHERENT = 0.35
"""Coherence of the residuals above which a motion that holds the image is not beyond doubt; depth
noise that is half correlated in space stays below 0.25."""

SETTLED = 0.5
"""Share of the image above which a motion without coherent residuals is taken as it is: no other
can hold as much, and further ones are looked for in what it leaves."""

ASIDE = 0.8
"""Factor on the kernel's cutoff within which pixels are set aside with a motion. Wider, a motion
takes with it much of another that looks like it in places (measured under DIS flow: at 2 the world
is found in 80 % of the heavy pairs, from 0.5 to 1 in 84 %)."""

FIRMLY = np.float32(2.5)
"""Factor on the robust weight that is set aside: nothing is left within 1.5 standard deviations, or
the same motion would be found again."""

SHARE, FLOW_NOISE, DEPTH_NOISE, SOURCE, ITERATIONS = range(5)
FACTS = 5
"""Columns of the table of facts of the hypotheses."""
SOURCE_WINDOW, SOURCE_MINIMAL = 100, 101


@njit(error_model="numpy", cache=True, nogil=True)
def next_random(state):
    """xorshift64*: a float in [0, 1)."""
    x = state[0]
    x ^= x >> np.uint64(12)
    x ^= x << np.uint64(25)
    x ^= x >> np.uint64(27)
    state[0] = x
    return np.float64((x * np.uint64(2685821657736338717)) >> np.uint64(11)) / 9007199254740992.0


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
def solve_square(A, x):
    """Solve the 6x6 system A y = x in place by elimination with pivoting; False if singular."""
    for i in range(6):
        best = i
        for r in range(i + 1, 6):
            if abs(A[r, i]) > abs(A[best, i]):
                best = r
        if not abs(A[best, i]) > 1e-9:
            return False
        if best != i:
            for c in range(i, 6):
                A[i, c], A[best, c] = A[best, c], A[i, c]
            x[i], x[best] = x[best], x[i]
        for r in range(i + 1, 6):
            factor = A[r, i] / A[i, i]
            for c in range(i + 1, 6):
                A[r, c] -= factor * A[i, c]
            x[r] -= factor * x[i]
    for i in range(5, -1, -1):
        for c in range(i + 1, 6):
            x[i] -= A[i, c] * x[c]
        x[i] /= A[i, i]
        if not abs(x[i]) < 1e4:
            return False
    return True


@njit(error_model="numpy", cache=True, nogil=True)
def fit_minimal(samples, pick, K, A, x, other, pose):
    """Three pixels, six equations: Newton steps from the identity, in place; False if it fails."""
    pose[:, :] = 0.0
    for i in range(3):
        pose[i, i] = 1.0
    for _ in range(MINIMAL_STEPS):
        for m in range(3):
            k = pick[m]
            px, py, pz = samples[XN, k], samples[YN, k], samples[Z, k]
            X = pz * (pose[0, 0] * px + pose[0, 1] * py + pose[0, 2]) + pose[0, 3]
            Y = pz * (pose[1, 0] * px + pose[1, 1] * py + pose[1, 2]) + pose[1, 3]
            Zc = pz * (pose[2, 0] * px + pose[2, 1] * py + pose[2, 2]) + pose[2, 3]
            if not Zc > 1e-6:
                return False
            i = 1.0 / Zc
            a = X * i
            b = Y * i
            # rows in units of the image's radians, translation in units of the depth
            u = 2 * m
            v = u + 1
            A[u, 0], A[u, 1], A[u, 2] = i, 0.0, -a * i
            A[u, 3], A[u, 4], A[u, 5] = -a * b, 1.0 + a * a, -b
            A[v, 0], A[v, 1], A[v, 2] = 0.0, i, -b * i
            A[v, 3], A[v, 4], A[v, 5] = -(1.0 + b * b), a * b, a
            x[u] = (samples[MU, k] - K[2]) / K[0] - a
            x[v] = (samples[MV, k] - K[3]) / K[1] - b
        if not solve_square(A, x):
            return False
        other[:, :] = pose
        left_update(x, other, pose)
    return True


@njit(error_model="numpy", cache=True, nogil=True)
def draw_three(samples, n, h, w, local, state, pick):
    """Draw three distinct usable pixels, near each other if ``local``; False where none is left."""
    tries = 0
    m = 0
    while m < 3:
        tries += 1
        if tries > 60:
            return False
        if m == 0 or not local:
            k = int(next_random(state) * n)
        else:
            row = pick[0] // w + int((next_random(state) - 0.5) * 0.5 * h)
            column = pick[0] % w + int((next_random(state) - 0.5) * 0.4 * w)
            if row < 0 or row >= h or column < 0 or column >= w:
                continue
            k = row * w + column
        if k >= n or samples[W, k] < next_random(state):
            continue
        if (m > 0 and k == pick[0]) or (m > 1 and k == pick[1]):
            continue
        pick[m] = k
        m += 1
    return True


@njit(error_model="numpy", cache=True, nogil=True)
def fit_window(samples, h, w, r0, r1, c0, c1, K, buffer, pose, work):
    """Robust dense fit of the usable pixels of a window, from the identity, in place."""
    m = 0
    total = 0.0
    for r in range(r0, r1):
        for c in range(c0, c1):
            k = r * w + c
            if samples[W, k] > 0.05:
                for q in range(BUFFER_ROWS):
                    buffer[q, m] = samples[q, k]
                total += samples[W, k]
                m += 1
    if m < 20 or total < 12.0:
        return False
    pose[:, :] = 0.0
    for i in range(3):
        pose[i, i] = 1.0
    scale = min(64.0, max(1.0, residual_scale(buffer, m, pose, K)))
    anneal(buffer, m, K, scale, 0.7, 0.4, 2, pose, work)
    for i in range(3):
        for j in range(4):
            if not abs(pose[i, j]) < MAX_VALUE:
                return False
    return True


@njit(error_model="numpy", cache=True, nogil=True)
def keep_best(pose, score, source, poses, scores, sources, similar):
    """Insert into the list of the best distinct candidates, best first."""
    count = scores.shape[0]
    # a candidate that scores alike and stands close by is the same motion
    for k in range(count):
        if scores[k] <= 0:
            break
        gap = 0.0
        for i in range(3):
            for j in range(3):
                gap = max(gap, abs(poses[k, i, j] - pose[i, j]))
            gap = max(gap, similar * abs(poses[k, i, 3] - pose[i, 3]))
        if gap < 2e-4:
            if score <= scores[k]:
                return
            for q in range(k, count - 1):
                scores[q] = scores[q + 1]
                sources[q] = sources[q + 1]
                poses[q] = poses[q + 1]
            scores[count - 1] = 0.0
            break
    at = count
    while at > 0 and score > scores[at - 1]:
        at -= 1
    if at == count:
        return
    for q in range(count - 1, at, -1):
        scores[q] = scores[q - 1]
        sources[q] = sources[q - 1]
        poses[q] = poses[q - 1]
    scores[at] = score
    sources[at] = source
    poses[at] = pose


@njit(error_model="numpy", cache=True, nogil=True)
def search_round(
    small, sh, sw, coarse, n, K, starts, wide, minimal, cutoff, similar, state, pose, facts,
    work,
):  # fmt: skip
    """One motion among the pixels that are left (their weights in row W of both sample sets).

    ``small`` (sh x sw) serves starts and scores, ``coarse`` (n pixels) the refinement. ``starts``
    (S, 3, 4) are handed in; with ``wide`` windows and ``minimal`` minimal samples compete. Sets
    ``pose`` and ``facts``; returns whether anything was found.
    """
    ns = sh * sw
    poses = np.zeros((REFINED, 3, 4))
    scores = np.zeros(REFINED)
    sources = np.zeros(REFINED)
    candidate = np.empty((3, 4))
    for s in range(starts.shape[0]):
        # from afar; and, for what the caller hands in, from nearby: where most of the image moves
        # a wide kernel would leave even the right motion
        for near in range(2 if s > 0 else 1):
            candidate[:, :] = starts[s]
            scale = NEAR_START
            if near == 0:
                scale = min(64.0, max(1.0, 1.5 * residual_scale(small, ns, candidate, K)))
            anneal(small, ns, K, scale, 0.7, 0.4, 2, candidate, work)
            score = score_pose(small, ns, candidate, K)
            keep_best(candidate, score, s, poses, scores, sources, similar)
    if wide:
        buffer = np.empty((BUFFER_ROWS, ns + 1), np.float32)
        height = min(sh, max(3, (2 * sh) // (WINDOW_ROWS + 1)))
        width = min(sw, max(3, (2 * sw) // (WINDOW_COLUMNS + 1)))
        for i in range(WINDOW_ROWS):
            for j in range(WINDOW_COLUMNS):
                r0 = i * (sh - height) // (WINDOW_ROWS - 1)
                c0 = j * (sw - width) // (WINDOW_COLUMNS - 1)
                if fit_window(
                    small, sh, sw, r0, min(sh, r0 + height), c0, min(sw, c0 + width), K, buffer,
                    candidate, work,
                ):  # fmt: skip
                    score = score_pose(small, ns, candidate, K)
                    keep_best(candidate, score, SOURCE_WINDOW, poses, scores, sources, similar)
        A = np.empty((6, 6))
        x = np.empty(6)
        other = np.empty((3, 4))
        pick = np.zeros(3, np.int64)
        for s in range(minimal):
            if not draw_three(small, ns, sh, sw, s % 3 != 0, state, pick):
                break
            if fit_minimal(small, pick, K, A, x, other, candidate):
                score = score_pose(small, ns, candidate, K)
                keep_best(candidate, score, SOURCE_MINIMAL, poses, scores, sources, similar)
    best = -1.0
    steps = 0
    for s in range(REFINED):
        if scores[s] <= 0:
            break
        candidate[:, :] = poses[s]
        steps += anneal(small, ns, K, 1.5, 0.7, 0.4, 3, candidate, work)
        score = score_pose(coarse, n, candidate, K)
        if score > best:
            best = score
            pose[:, :] = candidate
            facts[SOURCE] = sources[s]
    if best <= 0:
        return False
    steps += anneal(coarse, n, K, 0.7, 0.5, 0.4, 3, pose, work)
    candidate[:, :] = pose
    sf, sd, share, more, _, _ = reestimate(
        coarse,
        n,
        K,
        0.5,
        0.01,
        FLOW_NOISE_CAP,
        DEPTH_NOISE_CAP,
        cutoff,
        2,
        4,
        NOISE_PIXELS,
        candidate,
        work,
    )
    if score_pose(coarse, n, candidate, K) > 0.95 * score_pose(coarse, n, pose, K):
        pose[:, :] = candidate
    facts[SHARE] = share
    facts[FLOW_NOISE] = sf
    facts[DEPTH_NOISE] = sd
    facts[ITERATIONS] = steps + more
    return True


@njit(error_model="numpy", cache=True, nogil=True)
def set_aside(samples, n, pose, K, sf, sd, cutoff, work, scratch):
    """Scale the weights of the pixels that follow ``pose`` down to what it leaves unexplained."""
    noise = np.empty(3, np.float32)
    set_noise(max(sf, 0.05), sd, ASIDE * cutoff, noise)
    robust_weights(samples, n, pose, K, noise, work, scratch)
    for k in range(n):
        samples[W, k] *= max(np.float32(0.0), np.float32(1.0) - FIRMLY * scratch[k])


@njit(error_model="numpy", cache=True, nogil=True)
def residual_coherence(samples, h, w, pose, K, sf, sd):
    """How alike neighbouring residuals are: 0 for independent noise, 1 for equal residuals.

    Of whitened residuals in 8 x 8 blocks, from the variance of the block means. A compromise
    between two motions leaves residuals that agree with their neighbours.
    """
    between = pixels = blocks = 0.0
    for r0 in range(0, h - 7, 8):
        for c0 in range(0, w - 7, 8):
            m = s0 = s1 = squares = 0.0
            for r in range(r0, r0 + 8):
                for c in range(c0, c0 + 8):
                    k = r * w + c
                    if not samples[W, k] > 0:
                        continue
                    ru, rv, qu, qv, front = residual(samples, k, pose, K)
                    if not front:
                        continue
                    ip = samples[PF, k] / (sf * sf)
                    g = sd * sd * samples[PD, k] * ip
                    q2 = qu * qu + qv * qv
                    root = math.sqrt(1.0 + g * q2)
                    beta = g / (root * (1.0 + root))
                    dot = beta * (qu * ru + qv * rv)
                    e0 = (ru - dot * qu) * math.sqrt(ip)
                    e1 = (rv - dot * qv) * math.sqrt(ip)
                    if e0 * e0 + e1 * e1 > 16.0:
                        continue
                    m += 1.0
                    s0 += e0
                    s1 += e1
                    squares += e0 * e0 + e1 * e1
            if m >= 16:
                # pairs of different pixels: sum of products over the number of pairs
                between += (s0 * s0 + s1 * s1 - squares) / (m - 1.0)
                pixels += squares
                blocks += 1.0
    if blocks < 4 or pixels <= 0:
        return 1.0
    return between / pixels


@njit(error_model="numpy", cache=True, nogil=True)
def find_motions(
    small,
    sh,
    sw,
    coarse,
    h,
    w,
    K,
    starts,
    cutoff,
    decisive,
    least,
    most,
    similar,
    seed,
    poses,
    facts,
):  # fmt: skip
    """All strong motions, in the order of their strength; returns their number.

    ``decisive``: share of the usable pixels above which the first motion stands alone. ``least``:
    smallest share of a further motion. ``most``: largest number of motions. ``poses`` (most, 3, 4)
    and ``facts`` (most, FACTS) receive them. The weights in row W of ``small`` and ``coarse`` are
    used up.
    """
    n = h * w
    work = new_work()
    state = np.empty(1, np.uint64)
    state[0] = np.uint64(seed) * np.uint64(2) + np.uint64(88172645463325253)
    all_weight = 0.0
    for k in range(n):
        all_weight += coarse[W, k]
    if all_weight <= 0:
        return 0
    scratch = np.empty(max(n, sh * sw), np.float32)
    none = np.empty((0, 3, 4))
    found = 0
    first_wide = False
    while found < most:
        left = 0.0
        for k in range(n):
            left += coarse[W, k]
        if found > 0 and left < least * all_weight:
            break
        pose = poses[found]
        fact = facts[found]
        ok = search_round(
            small, sh, sw, coarse, n, K, starts if found == 0 else none,
            found > 0 or first_wide,
            MINIMAL_SAMPLES if found == 0 else MINIMAL_SAMPLES // 3,
            cutoff, similar, state, pose, fact, work,
        )  # fmt: skip
        if not ok:
            break
        fact[SHARE] *= left / all_weight
        clear = fact[SHARE] >= decisive and found == 0
        if found == 0 and not first_wide:
            settled = fact[SHARE] >= SETTLED
            if settled:
                coherence = residual_coherence(
                    coarse, h, w, pose, K, fact[FLOW_NOISE], fact[DEPTH_NOISE]
                )
                settled = coherence < COHERENT
            if not settled:
                # the handed-in starts found no motion for sure: every start competes for the first
                first_wide = True
                continue
        if found > 0 and fact[SHARE] < least:
            break
        found += 1
        if found == 1 and clear:
            break
        set_aside(coarse, n, pose, K, fact[FLOW_NOISE], fact[DEPTH_NOISE], cutoff, work, scratch)
        set_aside(
            small, sh * sw, pose, K, fact[FLOW_NOISE], fact[DEPTH_NOISE], cutoff, work, scratch
        )
    return found
