"""Noise of flow and depth, estimated from the pixels that follow a motion (numba).

Poses are (3, 4) float64 arrays [R | t], T_curr_prev.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from hybridvo.compiled.numba_tools import njit
from hybridvo.solver import kernels
from hybridvo.solver.calibration import (
    DEPTH_NOISE_CAP,
    DEPTHS_PER_PAIR,
    MIN_DEPTH_NOISE_CAP,
    NOISE_CAP_FACTOR,
    OBSERVABLE_DEPTH_NOISE_STD,
    OUTLIER_RADIUS_PX,
    OUTLIER_RADIUS_STD,
    USUAL_DEPTH_NOISE,
)
from hybridvo.solver.depths import depth_noise
from hybridvo.solver.kernels import FASTMATH, NO_PARALLAX2, ONE, PD, PF, ZERO, W

# Pixels from which the noise of the answer is estimated, about.
FINAL_NOISE_PIXELS = 4000
# Most rounds of expectation-maximisation of the answer's noise.
FINAL_NOISE_ROUNDS = 30
# Smallest noise of the flow, px: float32 coordinates of an image 8000 pixels wide are good to
# 5e-4 px.
FLOW_NOISE_FLOOR_PX = 2e-3
# Relative change of both variances below which the rounds of their estimate end.
NOISE_CHANGE = 1e-3
# Smallest number of pixels from which a noise is estimated.
MIN_NOISE_PIXELS = 8
# Fraction of the pixels that follow the motion, before the first round of the noise's estimate,
# and its limits.
FIRST_INLIER_RATIO = 0.7
SMALLEST_INLIER_RATIO = 0.01
LARGEST_INLIER_RATIO = 0.999
# Noise of the flow from which its estimate starts, px.
START_FLOW_NOISE_PX = 0.5
# Noise of log depth from which its estimate starts.
START_DEPTH_NOISE = 0.01

# Pixels that are compared with the current depth.
COMPARED_PIXELS = 1000
# Smallest variance of log depth: one of 0 would stay 0 in the next round.
DEPTH_VARIANCE_FLOOR = 1e-10
# px^2 for each unit of log depth; beyond it a sum of float32 loses all else.
LARGEST_PARALLAX2 = 1e12


class Noise(NamedTuple):
    """Standard deviations at a pixel of typical variance."""

    flow_px: float  # of each component of the flow, px
    log_depth: float  # of log depth


class NoiseEstimate(NamedTuple):
    """The noise of the pixels that follow a motion, and how many do."""

    noise: Noise
    inlier_ratio: float  # fraction of the external weight
    is_depth_observable: bool  # whether the parallax shows the noise of depth


class NoiseTerms(NamedTuple):
    """What the estimate needs of each pixel, (N,) float32."""

    along: np.ndarray  # squared residual along q, px^2
    across: np.ndarray  # squared residual across q, px^2
    flow_variance: np.ndarray  # relative
    depth_variance: np.ndarray  # relative, times |q|^2: px^2 for sd = 1
    weight: np.ndarray  # external
    outlier_density: np.ndarray  # 1 / px^2


class NoiseSums(NamedTuple):
    """Normal equations of the two variances, float32: [[a11, a12], [a12, a22]] x = [b1, b2]."""

    inliers: float  # weight of the pixels that follow the motion
    a11: float
    a12: float
    a22: float
    b1: float
    b2: float


# Where estimates start.
START_NOISE = Noise(START_FLOW_NOISE_PX, START_DEPTH_NOISE)


@njit(error_model="numpy", cache=True, nogil=True)
def gather_noise(samples, n, step, pose, K, radius):
    """Return the :class:`NoiseTerms` of every ``step``-th pixel, and the fraction of their weight.

    Pixels with residuals beyond ``radius`` px are left out; the fraction is that of the others.
    """
    size = -(-n // step)
    along = np.empty(size, np.float32)
    across = np.empty(size, np.float32)
    flow_variance = np.empty(size, np.float32)
    depth_variance = np.empty(size, np.float32)
    weights = np.empty(size, np.float32)
    outlier_density = np.empty(size, np.float32)
    entries = kernels.pose_entries(pose)
    m = 0
    inside = 0.0
    total = 0.0
    for k in range(0, n, step):
        ru, rv, qu, qv, front = kernels.residual(samples, k, entries, K)
        q2 = qu * qu + qv * qv
        variance = 1.0 / samples[PF, k]
        weight = samples[W, k]
        area = radius * radius * max(variance, 1.0)
        total += weight
        is_near = ru * ru + rv * rv <= area  # False where not a number
        if not (front and weight > 0 and is_near and q2 < LARGEST_PARALLAX2):
            continue
        if q2 < NO_PARALLAX2:
            # no parallax: any axis will do
            axis = 1.0
            length2 = 1.0
        else:
            axis = qu
            length2 = q2
        dot = ru * axis + rv * qv
        cross = rv * axis - ru * qv
        along[m] = dot * dot / length2
        across[m] = cross * cross / length2
        flow_variance[m] = variance
        depth_variance[m] = min(samples[PD, k] * q2, 1e8)
        weights[m] = weight
        outlier_density[m] = 1.0 / (math.pi * area)
        inside += weight
        m += 1
    terms = NoiseTerms(
        along[:m],
        across[:m],
        flow_variance[:m],
        depth_variance[:m],
        weights[:m],
        outlier_density[:m],
    )
    return terms, inside / max(total, 1e-30)


@njit(fastmath=FASTMATH, error_model="numpy", cache=True, nogil=True)
def sum_noise(terms, vf, vd, inlier_ratio):
    """Return the :class:`NoiseSums` at the variances ``vf`` and ``vd``, float32."""
    kernels.noinline()  # type: ignore[call-arg]
    along = terms.along
    across = terms.across
    flow_variance = terms.flow_variance
    depth_variance = terms.depth_variance
    weight = terms.weight
    outlier = terms.outlier_density
    density = inlier_ratio * np.float32(0.5 / math.pi)
    outlier_ratio = ONE - inlier_ratio
    inliers = ZERO
    a11 = a12 = a22 = ZERO
    b1 = b2 = ZERO
    for k in range(len(along)):
        x1 = along[k]
        x2 = across[k]
        al = flow_variance[k]
        be = depth_variance[k]
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
        # the probability to follow the motion
        p = density * np.sqrt(i1 * i2)
        p = weight[k] * p / (p + outlier_ratio * outlier[k] * e)
        j1 = p * i1 * i1
        j2 = p * i2 * i2
        inliers += p
        a11 += al * al * (j1 + j2)
        a12 += al * be * j1
        a22 += be * be * j1
        b1 += al * (x1 * j1 + x2 * j2)
        b2 += be * x1 * j1
    return NoiseSums(inliers, a11, a12, a22, b1, b2)


@njit(error_model="numpy", cache=True, nogil=True)
def solve_variances(sums, vd):
    """Return the variances (sf^2, sd^2) that solve the sums; ``vd`` stays if they leave it open."""
    determinant = sums.a11 * sums.a22 - sums.a12 * sums.a12
    if not (determinant > 1e-9 * sums.a11 * sums.a22 and determinant > 0):
        return max(0.0, sums.b1 - sums.a12 * vd) / sums.a11, vd
    new_vf = (sums.b1 * sums.a22 - sums.b2 * sums.a12) / determinant
    new_vd = (sums.b2 * sums.a11 - sums.b1 * sums.a12) / determinant
    if new_vd < 0:
        return sums.b1 / sums.a11, 0.0
    return new_vf, new_vd


@njit(error_model="numpy", cache=True, nogil=True)
def estimate_noise(samples, n, pose, K, start, cap, rounds, limit):
    """Estimate the noise of the pixels that follow a motion.

    Expectation-maximisation of a mixture: N(0, sf^2 v_f I + sd^2 v_d q q^T) for the pixels that
    follow the motion, a uniform density over a disc for the others.

    Args:
        samples: pixel buffer.
        n: number of pixels.
        pose: (3, 4) motion.
        K: (fx, fy, cx, cy) of the current camera.
        start: :class:`Noise` to start from.
        cap: largest :class:`Noise`; more is a compromise of several motions.
        rounds: most rounds.
        limit: about how many of the pixels are used.

    Returns:
        A :class:`NoiseEstimate`; the start, with an inlier ratio of 0, if too few pixels are near.
    """
    step = -(-n // limit)
    radius = max(OUTLIER_RADIUS_PX, OUTLIER_RADIUS_STD * start.flow_px)
    terms, inside = gather_noise(samples, n, step, pose, K, radius)
    if len(terms.along) < MIN_NOISE_PIXELS:
        return NoiseEstimate(start, 0.0, True)
    vf = start.flow_px * start.flow_px
    vd = start.log_depth * start.log_depth
    inlier_ratio = FIRST_INLIER_RATIO
    vd_std = 0.0
    weight = np.sum(terms.weight)
    for _ in range(rounds):
        sums = sum_noise(
            terms, np.float32(vf), np.float32(vd), np.float32(inlier_ratio)
        )
        inlier_ratio = min(
            LARGEST_INLIER_RATIO, max(SMALLEST_INLIER_RATIO, sums.inliers / weight)
        )
        solvable = 0 < sums.a11 < np.inf and sums.a22 < np.inf
        if not (solvable and abs(sums.b1) < np.inf and abs(sums.b2) < np.inf):
            break
        last_vf = vf
        last_vd = vd
        vf, vd = solve_variances(sums, vd)
        # Fisher's information of a variance is half of these sums
        information = sums.a22 - sums.a12 * sums.a12 / sums.a11
        vd_std = math.sqrt(2.0 / max(information, 1e-30))
        vf = min(max(vf, FLOW_NOISE_FLOOR_PX**2), cap.flow_px**2)
        vd = max(min(vd, cap.log_depth**2), DEPTH_VARIANCE_FLOOR)
        flow_converged = abs(vf - last_vf) < NOISE_CHANGE * last_vf
        depth_converged = abs(vd - last_vd) < NOISE_CHANGE * last_vd
        if flow_converged and depth_converged:
            break
    is_depth_observable = vd >= OBSERVABLE_DEPTH_NOISE_STD * vd_std
    if not is_depth_observable:
        vd = min(vd, USUAL_DEPTH_NOISE * USUAL_DEPTH_NOISE)
    noise = Noise(math.sqrt(vf), math.sqrt(vd))
    return NoiseEstimate(noise, inlier_ratio * inside, is_depth_observable)


def pair_noise(
    samples: np.ndarray,
    n: int,
    K: np.ndarray,
    pose: np.ndarray,
    start: Noise,
    cutoff: float,
    depth_curr: np.ndarray | None,
) -> NoiseEstimate:
    """Estimate the noise of a pair at its motion; the current depth bounds that of the previous.

    Args:
        samples: pixel buffer (BUFFER_ROWS, n or more).
        n: number of pixels.
        K: (4,) float32 fx, fy, cx, cy of the current camera.
        pose: (3, 4) T_curr_prev.
        start: noise to start from.
        cutoff: c of the robust kernel, standard deviations.
        depth_curr: (H, W) current depth, metres; None: not used.

    Returns:
        The estimate. Where the flow does not show the noise of depth, the two depths do.
    """
    cap = Noise(
        NOISE_CAP_FACTOR * start.flow_px,
        max(NOISE_CAP_FACTOR * start.log_depth, MIN_DEPTH_NOISE_CAP),
    )
    estimate = estimate_noise(
        samples, n, pose, K, start, cap, FINAL_NOISE_ROUNDS, FINAL_NOISE_PIXELS
    )
    if depth_curr is None:
        return estimate
    flow_px, log_depth = estimate.noise
    step = max(1, n // COMPARED_PIXELS)
    compared = np.ascontiguousarray(samples[:, :n:step])
    noise = kernels.residual_noise(flow_px, log_depth, cutoff)
    robust = kernels.robust_weights(compared, compared.shape[1], pose, K, noise)
    of_both = depth_noise(compared, depth_curr, robust, pose)
    if of_both <= 0:
        return estimate
    if not estimate.is_depth_observable:
        # errors that both depths share do not show here
        log_depth = min(of_both / DEPTHS_PER_PAIR, DEPTH_NOISE_CAP)
    return estimate._replace(noise=Noise(flow_px, min(log_depth, of_both)))
