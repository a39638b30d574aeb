"""One motion on gathered pixels, by Gauss-Newton under a graduated robust kernel, and the noise of
the pixels that follow it (numba). Poses are (3, 4) float64 arrays [R | t].
"""

from __future__ import annotations

import math

import numpy as np

from hybridvo.geometry import se3_exp
from hybridvo.numba_tools import njit
from hybridvo.refinement import kernels
from hybridvo.refinement.kernels import (
    BLOCK,
    FASTMATH,
    ONE,
    PD,
    PF,
    SUMS,
    ZERO,
    W,
    Z,
)

# px, log depth: more is a compromise of motions
FLOW_NOISE_CAP = 1.2
DEPTH_NOISE_CAP = 0.08
DAMPING = 1e-6
# looked at: in the search, in the last fit
NOISE_PIXELS = 1000
FINAL_NOISE_PIXELS = 4000
# px: float32 coordinates of an 8k image are good to 5e-4 px
FLOW_NOISE_FLOOR = 2e-3
USUAL_DEPTH_NOISE = 0.01
SETTLED = 1e-3  # change of both variances, relative, below which they are found


@njit(error_model="numpy", cache=True, nogil=True)
def solve6(acc, damping, delta):
    """Solve (H + damping diag H) delta = g; False where H is not positive definite."""
    # the gradient as a last column
    A = np.empty((6, 7))
    scale = np.empty(6)
    q = 0
    for i in range(6):
        if not acc[q] > 1e-30:
            return False
        scale[i] = 1.0 / math.sqrt(acc[q])
        for j in range(i, 6):
            A[i, j] = A[j, i] = acc[q]
            q += 1
        A[i, 6] = acc[21 + i]
    for i in range(6):
        for j in range(7):
            A[i, j] *= scale[i] * (scale[j] if j < 6 else 1.0)
        A[i, i] = 1.0 + damping
    # Gauss-Jordan elimination: the pivots of a definite matrix are positive
    for k in range(6):
        if not A[k, k] > 1e-13:
            return False
        for i in range(6):
            factor = 0.0 if i == k else A[i, k] / A[k, k]
            for j in range(k, 7):
                A[i, j] -= factor * A[k, j]
    for i in range(6):
        delta[i] = scale[i] * A[i, 6] / A[i, i]
        if not abs(delta[i]) < 1e6:
            return False
    return True


exponential = njit(error_model="numpy", cache=True, nogil=True)(se3_exp)


@njit(error_model="numpy", cache=True, nogil=True)
def left_update(delta, pose, out):
    """``out``, or ``pose`` itself, = Exp(delta) pose, delta = (translation, rotation)."""
    E = exponential(delta)
    for j in range(4):
        x = pose[0, j]
        y = pose[1, j]
        z = pose[2, j]
        for i in range(3):
            out[i, j] = (
                E[i, 0] * x
                + E[i, 1] * y
                + E[i, 2] * z
                + (E[i, 3] if j == 3 else 0.0)
            )


@njit(error_model="numpy", cache=True, nogil=True)
def noise_of(flow_sigma, depth_sigma, cutoff):
    """(3,) float32 of (1/sf^2, sd^2, c^2), as the kernels take the noise."""
    inverse = 1.0 / (flow_sigma * flow_sigma)
    return np.array([inverse, depth_sigma * depth_sigma, cutoff * cutoff]).astype(
        np.float32
    )


@njit(error_model="numpy", cache=True, nogil=True)
def gauss_newton(samples, n, total, K, noise, steps, tolerance_px, pose):
    """Damped Gauss-Newton in place, while the cost falls and the image moves; returns the steps.

    ``total``: sum of the external weights; ``tolerance_px``: move of the image of the last step.
    """
    acc = np.zeros(SUMS)
    other = np.zeros(SUMS)
    delta = np.zeros(6)
    candidate = np.empty((3, 4))
    full = 0.5 * np.float64(noise[2])
    cost = kernels.sum_samples(samples, n, pose, K, noise, acc)
    cost += full * max(0.0, total - acc[29])  # pixels behind the camera
    damping = DAMPING
    done = 0
    for _ in range(steps):
        if not solve6(acc, damping, delta):
            damping = max(damping * 100.0, 1e-3)
            if damping > 1e3:
                return done
            continue
        left_update(delta, pose, candidate)
        new_cost = kernels.sum_samples(samples, n, candidate, K, noise, other)
        new_cost += full * max(0.0, total - other[29])
        done += 1
        if new_cost <= cost * (1.0 + 1e-9) + 1e-12:
            # predicted mean squared motion of the image, px^2: delta^T H delta / weight
            moved = (
                np.sum(delta * acc[21:27])
                / max(acc[28], 1e-12)
                / np.float64(noise[0])
            )
            pose[:, :] = candidate
            acc[:] = other
            cost = new_cost
            damping = max(damping * 0.1, DAMPING)
            if moved < tolerance_px * tolerance_px:
                return done
        else:
            damping = max(damping * 10.0, 1e-3)
            if damping > 1e3:
                return done  # no descent left at the precision of the sums
    return done


@njit(error_model="numpy", cache=True, nogil=True)
def residuals(samples, n, pose, K):
    """(ru, rv, qu, qv) of ``n`` pixels, (4, n); NaN where a pixel cannot be used."""
    out = np.full((4, n), np.nan)
    entries = kernels.pose_entries(pose)
    for k in range(n):
        ru, rv, qu, qv, front = kernels.residual(samples, k, entries, K)
        if front and samples[W, k] > 0:
            out[0, k], out[1, k], out[2, k], out[3, k] = ru, rv, qu, qv
    return out


@njit(error_model="numpy", cache=True, nogil=True)
def residual_scale(samples, n, pose, K):
    """Median length of the residual in px over up to about 1000 usable pixels."""
    found = residuals(
        samples[:, : n : max(1, n // 1000)], -(-n // max(1, n // 1000)), pose, K
    )
    lengths = np.sqrt(found[0] ** 2 + found[1] ** 2)
    lengths = lengths[~np.isnan(lengths)]
    return np.median(lengths) if len(lengths) else 1.0


@njit(error_model="numpy", cache=True, nogil=True)
def anneal(samples, n, K, start_px, end_px, ratio, steps, pose):
    """Graduated Geman-McClure with isotropic noise, from ``start_px`` down to ``end_px``."""
    total = np.float64(np.sum(samples[W, :n]))
    scale = max(start_px, end_px)
    iterations = 0
    while True:
        noise = noise_of(scale, 0.0, 1.0)
        iterations += gauss_newton(
            samples, n, total, K, noise, steps, 0.1 * scale, pose
        )
        if scale <= end_px:
            return iterations
        scale = max(end_px, scale * ratio)


@njit(error_model="numpy", cache=True, nogil=True)
def gather_noise(samples, n, step, pose, K, radius):
    """Of pixels with residuals within ``radius`` px: squared residual along and across q, variance
    of flow and depth in units of sf^2 and sd^2, weight, density of outliers, (6, N); their share.
    """
    terms = np.empty((6, -(-n // step)), np.float32)
    entries = kernels.pose_entries(pose)
    m = 0
    inside = 0.0
    total = 0.0
    for k in range(0, n, step):
        ru, rv, qu, qv, front = kernels.residual(samples, k, entries, K)
        q2 = qu * qu + qv * qv
        spread = 1.0 / samples[PF, k]
        weight = samples[W, k]
        area = radius * radius * max(spread, 1.0)
        total += weight
        # False where not a number
        if front and weight > 0 and ru * ru + rv * rv <= area and q2 < 1e12:
            # no parallax: any
            axis, length2 = (1.0, 1.0) if q2 < 1e-20 else (qu, q2)
            dot = ru * axis + rv * qv
            cross = rv * axis - ru * qv
            terms[0, m], terms[1, m] = dot * dot / length2, cross * cross / length2
            terms[2, m], terms[3, m] = spread, min(samples[PD, k] * q2, 1e8)
            terms[4, m], terms[5, m] = weight, 1.0 / (math.pi * area)
            inside += weight
            m += 1
    return terms[:, :m].copy(), inside / max(total, 1e-30)


@njit(fastmath=FASTMATH, error_model="numpy", cache=True, nogil=True)
def sum_noise(terms, vf, vd, share):
    """One round: weight of the followers, information of (sf^2, sd^2), its right-hand side."""
    kernels.noinline()  # type: ignore[call-arg]
    along = terms[0]
    across = terms[1]
    alpha = terms[2]
    beta = terms[3]
    weight = terms[4]
    outlier = terms[5]
    density = share * np.float32(0.5 / math.pi)
    rest = ONE - share
    hits = a11 = a12 = a22 = b1 = b2 = ZERO
    for k in range(len(along)):
        x1 = along[k]
        x2 = across[k]
        al = alpha[k]
        be = beta[k]
        i1 = ONE / (vf * al + vd * be)
        i2 = ONE / (vf * al)
        d2 = x1 * i1 + x2 * i2
        # exp(d2 / 2) = exp(y)^32 by a series: a call of the library's would not be vectorised
        y = min(d2, np.float32(60.0)) * np.float32(1 / 64)
        e = ONE + y * (
            ONE
            + y * (np.float32(1 / 2) + y * (np.float32(1 / 6) + y / np.float32(24)))
        )
        for _ in range(5):
            e *= e
        p = density * np.sqrt(i1 * i2)
        p = weight[k] * p / (p + rest * outlier[k] * e)
        j1 = p * i1 * i1
        j2 = p * i2 * i2
        hits += p
        a11 += al * al * (j1 + j2)
        a12 += al * be * j1
        a22 += be * be * j1
        b1 += al * (x1 * j1 + x2 * j2)
        b2 += be * x1 * j1
    return hits, a11, a12, a22, b1, b2


@njit(error_model="numpy", cache=True, nogil=True)
def estimate_noise(samples, n, pose, K, sf, sd, sf_cap, sd_cap, rounds, limit):
    """Noise (sf px, sd of log Z) of the pixels that follow ``pose``, share of the weight that does,
    and whether the flow tells the depth's noise; from ``limit`` pixels.

    Expectation-maximisation of N(0, sf^2 v_f I + sd^2 v_d q q^T) and a uniform density over a disc.
    """
    terms, inside = gather_noise(
        samples, n, -(-n // limit), pose, K, max(4.0, 8.0 * sf)
    )
    if terms.shape[1] < 8:
        return sf, sd, 0.0, True
    vf = sf * sf
    vd = sd * sd
    share = 0.7
    spread = 0.0
    weight = np.sum(terms[4])
    for _ in range(rounds):
        noise = np.float32(vf), np.float32(vd), np.float32(share)
        hits, a11, a12, a22, b1, b2 = sum_noise(terms, *noise)
        before = vf
        vd_before = vd
        share = min(0.999, max(0.01, hits / weight))
        if not (
            0 < a11 < np.inf
            and a22 < np.inf
            and abs(b1) < np.inf
            and abs(b2) < np.inf
        ):
            break
        determinant = a11 * a22 - a12 * a12
        if determinant > 1e-9 * a11 * a22 and determinant > 0:
            vf = (b1 * a22 - b2 * a12) / determinant
            vd = (b2 * a11 - b1 * a12) / determinant
            if vd < 0:
                vf = b1 / a11
                vd = 0.0
        else:
            vf = max(0.0, b1 - a12 * vd) / a11
        # standard error of vd: Fisher's information of a variance is half of these sums
        spread = math.sqrt(2.0 / max(a22 - a12 * a12 / a11, 1e-30))
        vf = min(max(vf, FLOW_NOISE_FLOOR * FLOW_NOISE_FLOOR), sf_cap * sf_cap)
        # stays estimable in the next round
        vd = max(min(vd, sd_cap * sd_cap), 1e-10)
        if (
            abs(vf - before) < SETTLED * before
            and abs(vd - vd_before) < SETTLED * vd_before
        ):
            break
    told = vd >= 2.0 * spread
    if not told:  # too little parallax: no more than a usual sensor has
        vd = min(vd, USUAL_DEPTH_NOISE * USUAL_DEPTH_NOISE)
    return math.sqrt(vf), math.sqrt(vd), share * inside, told


@njit(error_model="numpy", cache=True, nogil=True)
def reestimate(samples, n, K, cutoff, limit, pose):
    """Noise and Gauss-Newton in turn, in place; returns (sf, sd, share, iterations)."""
    total = np.float64(np.sum(samples[W, :n]))
    caps = (FLOW_NOISE_CAP, DEPTH_NOISE_CAP)
    sf = 0.5
    sd = 0.01
    share = 0.0
    iterations = 0
    for _ in range(2):
        sf, sd, share, _ = estimate_noise(
            samples, n, pose, K, sf, sd, *caps, 5, limit
        )
        noise = noise_of(sf, sd, cutoff)
        iterations += gauss_newton(
            samples, n, total, K, noise, 4, 1e-3 * sf + 1e-5, pose
        )
    return sf, sd, share, iterations


@njit(error_model="numpy", cache=True, nogil=True)
def robust_weights(samples, n, pose, K, noise):
    """Robust weight in [0, 1] of ``n`` pixels, without the external weight; 0 where unusable."""
    out = np.empty(n, np.float32)
    acc = np.zeros(SUMS)
    work = np.empty((kernels.WORK_ROWS, BLOCK + 16), np.float32)
    for o in range(0, n, BLOCK):
        m = min(BLOCK, n - o)
        kernels.project_block(samples, o, m, pose, K, noise, work, out[o:], acc)
    return out


def translation_scale(samples: np.ndarray, n: int) -> float:
    """1 / typical depth, per metre: root mean square over the usable pixels."""
    usable = samples[W, :n] > 0
    inverse = 1.0 / samples[Z, :n][usable].astype(np.float64)
    return max(1e-9, float(np.sqrt(np.mean(inverse**2)))) if len(inverse) else 1.0


def fit_coarse(
    samples: np.ndarray, n: int, K: np.ndarray, pose: np.ndarray, cutoff: float
) -> tuple[np.ndarray, float, float, float, int]:
    """One motion (3, 4), by graduated non-convexity; (pose, sf, sd, inlier ratio, iterations)."""
    pose = np.array(pose, np.float64, order="C")
    scale = min(64.0, max(1.0, 1.5 * residual_scale(samples, n, pose, K)))
    steps = anneal(samples, n, K, scale, 0.4, 0.5, 3, pose)
    sf, sd, share, more = reestimate(
        samples, n, K, cutoff, FINAL_NOISE_PIXELS, pose
    )
    return pose, sf, sd, share, steps + more


@njit(error_model="numpy", cache=True, nogil=True)
def residual_coherence(samples, h, w, pose, K, sf, sd):
    """How alike neighbouring residuals are: 0 for independent noise, 1 for equal ones, as a
    compromise of motions leaves them. Whitened, from the variance of the means of 8 x 8 blocks.
    """
    found = residuals(samples, h * w, pose, K)
    pixels = 0.0
    between = 0.0
    full = 0
    for block in range((h // 8) * (w // 8)):
        first = block // (w // 8) * 8 * w + block % (w // 8) * 8
        count = 0
        su = 0.0
        sv = 0.0
        squares = 0.0
        for j in range(64):
            k = first + j // 8 * w + j % 8
            ru = found[0, k]
            rv = found[1, k]
            qu = found[2, k]
            qv = found[3, k]
            information = samples[PF, k] / (sf * sf)
            g = sd * sd * samples[PD, k] * information
            root = math.sqrt(1.0 + g * (qu * qu + qv * qv))
            along = g / (root * (1.0 + root)) * (qu * ru + qv * rv)
            ru = ru - along * qu
            rv = rv - along * qv
            square = (ru * ru + rv * rv) * information
            if square <= 16.0:  # not where a residual is unknown
                count += 1
                squares += square
                su += ru * math.sqrt(information)
                sv += rv * math.sqrt(information)
        if count >= 16:
            full += 1
            pixels += squares
            # pairs of different pixels: sum of products over the number of pairs
            between += (su * su + sv * sv - squares) / (count - 1.0)
    return between / pixels if full >= 4 and pixels > 0 else 1.0
