"""Gauss-Newton with a graduated robust kernel, and the noise estimate, on gathered pixels (numba).

Poses inside the kernels are (3, 4) float64 arrays [R | t]. The group operations are written out
here because a tensor round trip per step would cost more than the step; a test holds them equal to
pypose's.
"""

from __future__ import annotations

import math

import numpy as np

from hybridvo.compilation import njit
from hybridvo.refinement.kernels import (
    BLOCK,
    FASTMATH,
    MIN_DEPTH,
    MU,
    MV,
    ONE,
    PD,
    PF,
    SUMS,
    WORK_ROWS,
    XN,
    YN,
    ZERO,
    W,
    Z,
    keep_apart,
    project_block,
    sum_samples,
)

FLOW_NOISE_FLOOR = 2e-3
"""Smallest flow noise assumed, px: float32 coordinates of an 8k image are good to 5e-4 px."""
FLOW_NOISE_CAP = 1.2
DEPTH_NOISE_CAP = 0.08
"""Largest noise (px, log depth) that a motion may claim in the search; beyond it the fit would be a
compromise between motions. The final fit may claim 2.5 times what the search found."""
DAMPING = 1e-6
USUAL_DEPTH_NOISE = 0.01
DOUBTFUL_DEPTH_NOISE = 0.03
"""Noise of log depth up to whose square the standard error of the square goes where the flow cannot
tell it (stereo and learned depth; with 0.01 instead the errors of far scenes came
out at 1.7 times their standard deviation: the slope of the flow in inverse depth is
shortened by the share of the noise in its variance)."""
NOISE_PIXELS = 1000
"""Pixels that the noise estimate of the search looks at: flow noise to 2 %."""


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


@njit(error_model="numpy", cache=True, nogil=True)
def left_update(delta, pose, out):
    """``out`` = Exp(delta) pose, delta = (translation, rotation)."""
    wx, wy, wz = delta[3], delta[4], delta[5]
    theta2 = wx * wx + wy * wy + wz * wz
    if theta2 < 1e-8:
        a = 1.0 - theta2 / 6.0
        b = 0.5 - theta2 / 24.0
        c = 1.0 / 6.0 - theta2 / 120.0
    else:
        theta = math.sqrt(theta2)
        half = math.sin(0.5 * theta)
        a = math.sin(theta) / theta
        b = 2.0 * half * half / theta2
        c = (1.0 - a) / theta2
    S = np.array([[0.0, -wz, wy], [wz, 0.0, -wx], [-wy, wx, 0.0]])
    S2 = np.empty((3, 3))
    for i in range(3):
        for j in range(3):
            S2[i, j] = S[i, 0] * S[0, j] + S[i, 1] * S[1, j] + S[i, 2] * S[2, j]
    E = np.empty((3, 3))
    for i in range(3):
        for j in range(3):
            E[i, j] = a * S[i, j] + b * S2[i, j]
        E[i, i] += 1.0
    for i in range(3):
        shift = delta[i]
        for j in range(3):
            shift += (b * S[i, j] + c * S2[i, j]) * delta[j]
        for j in range(4):
            value = E[i, 0] * pose[0, j] + E[i, 1] * pose[1, j] + E[i, 2] * pose[2, j]
            out[i, j] = value + shift if j == 3 else value


@njit(error_model="numpy", cache=True, nogil=True)
def set_noise(flow_sigma, depth_sigma, cutoff, out):
    """``out`` (3,) float32 = (1/sf^2, sd^2, c^2)."""
    out[0] = 1.0 / (flow_sigma * flow_sigma)
    out[1] = depth_sigma * depth_sigma
    out[2] = cutoff * cutoff


@njit(error_model="numpy", cache=True, nogil=True)
def evaluate(samples, n, pose, K, noise, work, acc):
    """Normal equations at ``pose``; returns the cost, pixels behind the camera at the full cost."""
    R = pose[:, :3].astype(np.float32)
    t = pose[:, 3].astype(np.float32)
    sum_samples(samples, n, R, t, K, noise, work, acc)
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


@njit(fastmath=FASTMATH, error_model="numpy", cache=True, nogil=True)
def gather_noise(samples, n, step, R, t, K, radius, terms):
    """What the noise estimate needs of every ``step``-th pixel, as rows of ``terms`` (6, N).

    Squared residual along q and across it, variance of the flow and of the depth (through q) in
    units of sf^2 and sd^2, external weight (0 farther away than ``radius``), density of outliers.
    Returns (number of pixels, their external weight, that of the pixels within the radius).
    """
    keep_apart()  # type: ignore[call-arg]
    fx, fy, cx, cy = K[0], K[1], K[2], K[3]
    r00, r01, r02 = R[0, 0], R[0, 1], R[0, 2]
    r10, r11, r12 = R[1, 0], R[1, 1], R[1, 2]
    r20, r21, r22 = R[2, 0], R[2, 1], R[2, 2]
    tx, ty, tz = t[0], t[1], t[2]
    b_x, b_y, b_z, b_u = samples[XN], samples[YN], samples[Z], samples[MU]
    b_v, b_f, b_d, b_w = samples[MV], samples[PF], samples[PD], samples[W]
    along, across, alpha = terms[0], terms[1], terms[2]
    beta, weight, outlier = terms[3], terms[4], terms[5]
    m = (n + step - 1) // step
    disc = np.float32(1.0 / math.pi) / (radius * radius)
    total = inside = ZERO
    for j in range(m):
        k = j * step
        z = b_z[k]
        Zc = z * (r20 * b_x[k] + r21 * b_y[k] + r22) + tz
        front = Zc > MIN_DEPTH
        i = ONE / (Zc if front else ONE)
        a = (z * (r00 * b_x[k] + r01 * b_y[k] + r02) + tx) * i
        b = (z * (r10 * b_x[k] + r11 * b_y[k] + r12) + ty) * i
        ru = b_u[k] - (fx * a + cx)
        rv = b_v[k] - (fy * b + cy)
        qu = fx * i * (a * tz - tx)
        qv = fy * i * (b * tz - ty)
        q2 = qu * qu + qv * qv
        pure = q2 < np.float32(1e-20)  # no parallax: any axis will do
        qu = ONE if pure else qu
        inverse = ONE / (ONE if pure else q2)
        dot = ru * qu + rv * qv
        cross = rv * qu - ru * qv
        spread = ONE / b_f[k]
        wide = max(spread, ONE)
        w = b_w[k]
        total += w
        near = front & (ru * ru + rv * rv <= radius * radius * wide) & (q2 < np.float32(1e12))
        w = w if near else ZERO
        inside += w
        along[j] = dot * dot * inverse if near else ZERO
        across[j] = cross * cross * inverse if near else ZERO
        alpha[j] = spread
        beta[j] = min(b_d[k] * q2, np.float32(1e8)) if near else ZERO
        weight[j] = w
        outlier[j] = disc / wide
    return m, total, inside


@njit(fastmath=FASTMATH, error_model="numpy", cache=True, nogil=True)
def sum_noise(terms, m, vf, vd, share, sums):
    """One round of expectation-maximisation: set ``sums`` to the weight of the followers, the three
    entries of the information of (sf^2, sd^2) and the two of its right-hand side.
    """
    keep_apart()  # type: ignore[call-arg]
    along, across, alpha = terms[0], terms[1], terms[2]
    beta, weight, outlier = terms[3], terms[4], terms[5]
    density = share * np.float32(0.5 / math.pi)
    rest = ONE - share
    hits = a11 = a12 = a22 = b1 = b2 = ZERO
    for k in range(m):
        al = alpha[k]
        be = beta[k]
        x1 = along[k]
        x2 = across[k]
        i2 = ONE / (vf * al)
        i1 = ONE / (vf * al + vd * be)
        d2 = x1 * i1 + x2 * i2
        # exp(-d2 / 2) = exp(-y)^16 by a series that is good to 1e-3 at the limit: no call to a
        # library function, so that the loop is vectorised
        y = min(d2, np.float32(60.0)) * np.float32(1 / 32)
        e = y * np.float32(1 / 5040) + np.float32(1 / 720)
        e = e * y + np.float32(1 / 120)
        e = e * y + np.float32(1 / 24)
        e = e * y + np.float32(1 / 6)
        e = e * y + np.float32(0.5)
        e = (e * y + ONE) * y + ONE
        e = e * e
        e = e * e
        e = e * e
        e = e * e
        p = density * np.sqrt(i1 * i2)
        p = weight[k] * p / (p + rest * outlier[k] * e)
        p = p if d2 < np.float32(60.0) else ZERO
        j1 = p * i1 * i1
        j2 = p * i2 * i2
        hits += p
        a11 += al * al * (j1 + j2)
        a12 += al * be * j1
        a22 += be * be * j1
        b1 += al * (x1 * j1 + x2 * j2)
        b2 += be * x1 * j1
    sums[0], sums[1], sums[2] = hits, a11, a12
    sums[3], sums[4], sums[5] = a22, b1, b2


@njit(error_model="numpy", cache=True, nogil=True)
def estimate_noise(samples, n, pose, K, sf, sd, sf_cap, sd_cap, rounds, limit):
    """Flow noise (px) and depth noise (of log Z) of the pixels that follow ``pose``.

    Expectation-maximisation of a mixture of N(0, sf^2 v_f I + sd^2 v_d q q^T) and a uniform density
    over a disc; the two variances by Fisher scoring of the components along and across q. Only the
    shape of the residuals is used, never a given noise level. ``limit`` bounds the number of pixels
    looked at, ``sf_cap`` and ``sd_cap`` the noise. Returns (sf, sd, share of the weight that
    follows the pose, standard error of sd^2).
    """
    step = max(1, n // limit)
    terms = np.empty((6, ((n // step + 16) // 16 | 1) * 16), np.float32)
    R = pose[:, :3].astype(np.float32)
    t = pose[:, 3].astype(np.float32)
    radius = np.float32(max(4.0, 8.0 * sf))
    m, total, inside = gather_noise(samples, n, step, R, t, K, radius, terms)
    if m < 8 or not inside > 0:
        return sf, sd, 0.0, sd * sd
    vf = sf * sf
    vd = sd * sd
    share = 0.7
    spread = 0.0
    sums = np.empty(6)
    for _ in range(rounds):
        sum_noise(terms, m, np.float32(vf), np.float32(vd), np.float32(share), sums)
        a11, a12, a22, b1, b2 = sums[1], sums[2], sums[3], sums[4], sums[5]
        share = min(0.999, max(0.01, sums[0] / inside))
        if not (0 < a11 < np.inf and a22 < np.inf and abs(b1) < np.inf and abs(b2) < np.inf):
            break
        determinant = a11 * a22 - a12 * a12
        if determinant > 1e-9 * a11 * a22 and determinant > 0:
            vf = (b1 * a22 - b2 * a12) / determinant
            vd = (b2 * a11 - b1 * a12) / determinant
            if vd < 0:
                vd = 0.0
                vf = b1 / a11
        else:
            vf = max(0.0, b1 - a12 * vd) / a11
        floor = FLOW_NOISE_FLOOR * FLOW_NOISE_FLOOR
        # standard error of vd: Fisher's information of a variance is half of these sums
        spread = math.sqrt(2.0 / max(a22 - a12 * a12 / a11, 1e-30))
        vf = min(max(vf, floor), sf_cap * sf_cap)
        vd = min(vd, sd_cap * sd_cap)
        vd = max(vd, 1e-10)  # stays estimable in the next round
    if vd < 2.0 * spread:
        # too little parallax to tell: no more than a usual sensor has
        vd = min(vd, USUAL_DEPTH_NOISE * USUAL_DEPTH_NOISE)
        spread = max(min(spread, DOUBTFUL_DEPTH_NOISE * DOUBTFUL_DEPTH_NOISE), vd)
    return math.sqrt(vf), math.sqrt(vd), share * inside / total, spread


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
    R = pose[:, :3].astype(np.float32)
    t = pose[:, 3].astype(np.float32)
    acc = np.zeros(SUMS)
    for o in range(0, n, BLOCK):
        m = min(BLOCK, n - o)
        project_block(samples, o, m, R, t, K, noise, work, out[o:], acc)


@njit(error_model="numpy", cache=True, nogil=True)
def new_work():
    """Scratch memory of one solver."""
    # rows a little longer than a block do not fall into the same sets of the cache
    return np.empty((WORK_ROWS, BLOCK + 16), np.float32)
