"""One motion on gathered pixels: Gauss-Newton under a graduated robust kernel (numba).

Poses inside the kernels are (3, 4) float64 arrays [R | t].
"""

from __future__ import annotations

import math

import numpy as np

from hybridvo.geometry import njit, se3_exp
from hybridvo.refinement.kernels import (
    BLOCK,
    MU,
    MV,
    PD,
    PF,
    SUMS,
    XN,
    YN,
    W,
    Z,
    new_work,
    project_block,
    sum_samples,
)
from hybridvo.refinement.noise import estimate_noise

FLOW_NOISE_CAP = 1.2
DEPTH_NOISE_CAP = 0.08
"""Largest noise (px, log depth) that a motion may claim in the search; beyond it the fit would be a
compromise between motions. The final fit may claim 2.5 times what the search found."""
DAMPING = 1e-6
NOISE_PIXELS = 1000
"""Pixels that the noise estimate of the search looks at: flow noise to 2 %."""
FINAL_NOISE_PIXELS = 4000
"""The same of the last fit of a motion."""


@njit(error_model="numpy", cache=True, nogil=True)
def solve6(acc, damping, delta):
    """Solve (H + damping diag H) delta = g by Cholesky; False where H is not positive definite."""
    L = np.zeros((6, 6))
    q = 0
    for i in range(6):
        for j in range(i, 6):
            L[j, i] = acc[q]
            q += 1
    scale = np.empty(6)
    for i in range(6):
        if not L[i, i] > 1e-30:
            return False
        scale[i] = 1.0 / math.sqrt(L[i, i])
    for i in range(6):
        for j in range(i + 1):
            L[i, j] *= scale[i] * scale[j]
        L[i, i] = 1.0 + damping
    for i in range(6):
        for j in range(i + 1):
            s = L[i, j]
            for k in range(j):
                s -= L[i, k] * L[j, k]
            if i == j:
                if not s > 1e-13:
                    return False
                L[i, i] = math.sqrt(s)
            else:
                L[i, j] = s / L[j, j]
    for i in range(6):
        s = acc[21 + i] * scale[i]
        for k in range(i):
            s -= L[i, k] * delta[k]
        delta[i] = s / L[i, i]
    for i in range(5, -1, -1):
        s = delta[i]
        for k in range(i + 1, 6):
            s -= L[k, i] * delta[k]
        delta[i] = s / L[i, i]
    for i in range(6):
        delta[i] *= scale[i]
        if not abs(delta[i]) < 1e6:
            return False
    return True


exponential = njit(error_model="numpy", cache=True, nogil=True)(se3_exp)


@njit(error_model="numpy", cache=True, nogil=True)
def left_update(delta, pose, out):
    """``out`` = Exp(delta) pose, delta = (translation, rotation)."""
    E = exponential(delta)
    for i in range(3):
        for j in range(4):
            out[i, j] = E[i, 0] * pose[0, j] + E[i, 1] * pose[1, j] + E[i, 2] * pose[2, j]
        out[i, 3] += E[i, 3]


@njit(error_model="numpy", cache=True, nogil=True)
def set_noise(flow_sigma, depth_sigma, cutoff, out):
    """``out`` (3,) float32 = (1/sf^2, sd^2, c^2)."""
    out[0] = 1.0 / (flow_sigma * flow_sigma)
    out[1] = depth_sigma * depth_sigma
    out[2] = cutoff * cutoff


@njit(error_model="numpy", cache=True, nogil=True)
def evaluate(samples, n, pose, K, noise, work, acc):
    """Normal equations at ``pose``; returns the cost, pixels behind the camera at the full cost."""
    sum_samples(samples, n, pose, K, noise, work, acc)
    return acc[27]


@njit(error_model="numpy", cache=True, nogil=True)
def gauss_newton(samples, n, total, K, noise, steps, tolerance_px, pose, work):
    """Damped Gauss-Newton in place; a step is taken only where the robust cost does not rise.

    ``total`` is the sum of the external weights. Stops when the step moves the image by less
    than ``tolerance_px``. Returns (iterations, cost, converged).
    """
    acc = np.zeros(SUMS)
    other = np.zeros(SUMS)
    delta = np.zeros(6)
    candidate = np.empty((3, 4))
    full = 0.5 * np.float64(noise[2])
    cost = evaluate(samples, n, pose, K, noise, work, acc)
    cost += full * max(0.0, total - acc[29])
    damping = DAMPING
    done = 0
    for _ in range(steps):
        if not solve6(acc, damping, delta):
            damping = max(damping * 100.0, 1e-3)
            if damping > 1e3:
                return done, cost, False
            continue
        left_update(delta, pose, candidate)
        new_cost = evaluate(samples, n, candidate, K, noise, work, other)
        new_cost += full * max(0.0, total - other[29])
        done += 1
        if new_cost <= cost * (1.0 + 1e-9) + 1e-12:
            # predicted mean squared motion of the image, px^2: delta^T H delta / weight
            moved = 0.0
            for i in range(6):
                moved += delta[i] * acc[21 + i]
            moved = moved / max(acc[28], 1e-12) / np.float64(noise[0])
            pose[:, :] = candidate
            acc[:] = other
            cost = new_cost
            damping = max(damping * 0.1, DAMPING)
            if moved < tolerance_px * tolerance_px:
                return done, cost, True
        else:
            damping = max(damping * 10.0, 1e-3)
            if damping > 1e3:
                return done, cost, True  # no descent left at the precision of the sums
    return done, cost, False


@njit(error_model="numpy", cache=True, nogil=True)
def residual_scale(samples, n, pose, K):
    """Median length of the residual in px over up to about 1000 usable pixels."""
    step = max(1, n // 1000)
    values = np.empty(n // step + 1)
    m = 0
    for k in range(0, n, step):
        if samples[W, k] > 0:
            ru, rv, _, _, front = residual(samples, k, pose, K)
            if front:
                values[m] = math.sqrt(ru * ru + rv * rv)
                m += 1
    if m == 0:
        return 1.0
    return np.median(values[:m])


@njit(error_model="numpy", cache=True, nogil=True)
def residual(samples, k, pose, K):
    """(ru, rv, qu, qv, in front) of pixel ``k`` in double precision."""
    x, y, z = samples[XN, k], samples[YN, k], samples[Z, k]
    X = z * (pose[0, 0] * x + pose[0, 1] * y + pose[0, 2]) + pose[0, 3]
    Y = z * (pose[1, 0] * x + pose[1, 1] * y + pose[1, 2]) + pose[1, 3]
    Zc = z * (pose[2, 0] * x + pose[2, 1] * y + pose[2, 2]) + pose[2, 3]
    if not Zc > 1e-6:
        return 0.0, 0.0, 0.0, 0.0, False
    a = X / Zc
    b = Y / Zc
    ru = samples[MU, k] - (K[0] * a + K[2])
    rv = samples[MV, k] - (K[1] * b + K[3])
    qu = K[0] / Zc * (a * pose[2, 3] - pose[0, 3])
    qv = K[1] / Zc * (b * pose[2, 3] - pose[1, 3])
    return ru, rv, qu, qv, True


@njit(error_model="numpy", cache=True, nogil=True)
def anneal(samples, n, K, start_px, end_px, ratio, steps, pose, work):
    """Graduated Geman-McClure with isotropic noise, from ``start_px`` down to ``end_px``."""
    noise = np.empty(3, np.float32)
    total = np.float64(np.sum(samples[W, :n]))
    scale = max(start_px, end_px)
    iterations = 0
    while True:
        set_noise(scale, 0.0, 1.0, noise)
        done, _, _ = gauss_newton(samples, n, total, K, noise, steps, 0.1 * scale, pose, work)
        iterations += done
        if scale <= end_px:
            return iterations
        scale = max(end_px, scale * ratio)


@njit(error_model="numpy", cache=True, nogil=True)
def reestimate(samples, n, K, sf, sd, sf_cap, sd_cap, cutoff, rounds, steps, limit, pose, work):
    """Alternate noise estimate and Gauss-Newton with the full covariance, in place.

    Returns (sf, sd, share, iterations, converged, standard error of sd^2).
    """
    noise = np.empty(3, np.float32)
    total = np.float64(np.sum(samples[W, :n]))
    iterations = 0
    converged = False
    share = 0.0
    spread = 0.0
    for _ in range(rounds):
        sf, sd, share, spread = estimate_noise(
            samples, n, pose, K, sf, sd, sf_cap, sd_cap, 5, limit
        )
        set_noise(sf, sd, cutoff, noise)
        done, _, converged = gauss_newton(
            samples, n, total, K, noise, steps, 1e-3 * sf + 1e-5, pose, work
        )
        iterations += done
    return sf, sd, share, iterations, converged, spread


@njit(error_model="numpy", cache=True, nogil=True)
def robust_weights(samples, n, pose, K, noise, work, out):
    """Robust weight in [0, 1] of ``n`` pixels, without the external weight; 0 where unusable."""
    acc = np.zeros(SUMS)
    for o in range(0, n, BLOCK):
        m = min(BLOCK, n - o)
        project_block(samples, o, m, pose, K, noise, work, out[o:], acc)


def translation_scale(samples: np.ndarray, n: int) -> float:
    """1 / typical depth, per metre: root mean square over the usable pixels."""
    usable = samples[W, :n] > 0
    inverse = 1.0 / samples[Z, :n][usable].astype(np.float64)
    return max(1e-9, float(np.sqrt(np.mean(inverse**2)))) if len(inverse) else 1.0


def fit_coarse(
    samples: np.ndarray, n: int, K: np.ndarray, pose: np.ndarray, cutoff: float
) -> tuple[np.ndarray, float, float, float, int]:
    """One motion on the first ``n`` pixels, by graduated non-convexity from a (3, 4) start.

    Returns:
        Pose (3, 4), flow noise px, depth noise, inlier ratio of the weight, iterations.
    """
    work = new_work()
    pose = np.array(pose, np.float64, order="C")
    scale = min(64.0, max(1.0, 1.5 * residual_scale(samples, n, pose, K)))
    steps = anneal(samples, n, K, scale, 0.4, 0.5, 3, pose, work)
    sf, sd, share, more, _, _ = reestimate(
        samples, n, K, 0.5, 0.01, FLOW_NOISE_CAP, DEPTH_NOISE_CAP, cutoff, 2, 4,
        FINAL_NOISE_PIXELS, pose, work,
    )  # fmt: skip
    return pose, sf, sd, share, steps + more


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
