"""Noise of flow and depth, from the residuals of the pixels that follow a motion (numba)."""

from __future__ import annotations

import math

import numpy as np

from hybridvo.geometry import njit
from hybridvo.refinement.kernels import (
    FASTMATH,
    MIN_DEPTH,
    MU,
    MV,
    ONE,
    PD,
    PF,
    XN,
    YN,
    ZERO,
    W,
    Z,
    keep_apart,
    pose_entries,
)

FLOW_NOISE_FLOOR = 2e-3
"""Smallest flow noise assumed, px: float32 coordinates of an 8k image are good to 5e-4 px."""
USUAL_DEPTH_NOISE = 0.01
DOUBTFUL_DEPTH_NOISE = 0.03
"""Noise of log depth up to whose square the standard error of the square goes where the flow cannot
tell it (stereo and learned depth; with 0.01 instead the errors of far scenes came out at 1.7 times
their standard deviation)."""

SETTLED = 1e-3
"""Change of both variances, relative, below which they are found."""


@njit(fastmath=FASTMATH, error_model="numpy", cache=True, nogil=True)
def gather_noise(samples, n, step, pose, K, radius, terms):
    """What the noise estimate needs of every ``step``-th pixel, as rows of ``terms`` (6, N).

    Squared residual along q and across it, variance of the flow and of the depth (through q) in
    units of sf^2 and sd^2, external weight (0 farther away than ``radius``), density of outliers.
    Returns (number of pixels, their external weight, that of the pixels within the radius).
    """
    keep_apart()  # type: ignore[call-arg]
    fx, fy, cx, cy = K[0], K[1], K[2], K[3]
    r00, r01, r02, tx, r10, r11, r12, ty, r20, r21, r22, tz = pose_entries(pose)
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
    radius = np.float32(max(4.0, 8.0 * sf))
    m, total, inside = gather_noise(samples, n, step, pose, K, radius, terms)
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
        before, vd_before = vf, vd
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
        if abs(vf - before) < SETTLED * before and abs(vd - vd_before) < SETTLED * vd_before:
            break
    if vd < 2.0 * spread:
        # too little parallax to tell: no more than a usual sensor has
        vd = min(vd, USUAL_DEPTH_NOISE * USUAL_DEPTH_NOISE)
        spread = max(min(spread, DOUBTFUL_DEPTH_NOISE * DOUBTFUL_DEPTH_NOISE), vd)
    return math.sqrt(vf), math.sqrt(vd), share * inside / total, spread
