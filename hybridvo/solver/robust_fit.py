"""One motion fitted to gathered pixels, by Gauss-Newton under a graduated robust kernel (numba).

Poses are (3, 4) float64 arrays [R | t], T_curr_prev.
"""

from __future__ import annotations

import numpy as np

from hybridvo.compiled.numba_tools import njit
from hybridvo.solver import kernels
from hybridvo.solver.calibration import DEPTH_NOISE_CAP, FLOW_NOISE_CAP_PX
from hybridvo.solver.kernels import (
    COST,
    HESSIAN_SUMS,
    ROBUST_SUM,
    SUMS,
    W,
    Z,
)
from hybridvo.solver.newton_kernels import (
    DAMPING,
    exponential,
    lowered,
    raised,
    solve_definite,
)
from hybridvo.solver.noise_estimation import (
    FINAL_NOISE_PIXELS,
    START_NOISE,
    Noise,
    estimate_noise,
)

# First scale of the robust kernel, in medians of the residuals' lengths.
SCALE_PER_RESIDUAL = 1.5
# Largest first scale of the robust kernel, px.
LARGEST_SCALE_PX = 64.0
# Last scale of the robust kernel before the noise is estimated, px.
SMALLEST_SCALE_PX = 0.4
# Factor from one scale to the next in the coarse fit of a pair.
COARSE_SCALE_RATIO = 0.5
# Gauss-Newton steps at each scale of the coarse fit.
COARSE_STEPS = 3
# How often noise and motion are estimated in turn.
REESTIMATE_ROUNDS = 2
# Rounds of expectation-maximisation each time.
REESTIMATE_NOISE_ROUNDS = 5
# Gauss-Newton steps each time, and once more when the noise of the answer is known.
REESTIMATE_STEPS = 4
# Length of the last step at a scale of the robust kernel, as a fraction of that scale.
SCALE_TOLERANCE = 0.1
# Length of the last step with known noise, in standard deviations of the flow.
NOISE_TOLERANCE = 1e-3

# Pixels from which the length of a typical residual is taken.
SCALE_PIXELS = 1000
# px; a shorter step is rounding.
TOLERANCE_FLOOR_PX = 1e-5
# Column of the translation in a pose.
TRANSLATION = 3


@njit(error_model="numpy", cache=True, nogil=True)
def solve6(acc, damping, delta):
    """Solve (H + damping diag H) delta = g; return False if H is not definite.

    Args:
        acc: (27,) or longer: upper triangle of H row by row, then g.
        damping: fraction of the diagonal that is added to it.
        delta: (6,) the solution, set only where True is returned.
    """
    A = np.empty((6, 6))
    q = 0
    for i in range(6):
        for j in range(i, 6):
            A[i, j] = acc[q]
            A[j, i] = acc[q]
            q += 1
    step = solve_definite(A, acc[HESSIAN_SUMS:COST], damping)
    if np.isnan(step[0]):
        return False
    for i in range(6):
        delta[i] = step[i]
    return True


@njit(error_model="numpy", cache=True, nogil=True)
def left_update(delta, pose, out):
    """Set ``out``, which may be ``pose`` itself, to Exp(delta) pose."""
    E = exponential(delta)
    for j in range(4):
        x = pose[0, j]
        y = pose[1, j]
        z = pose[2, j]
        for i in range(3):
            moved = E[i, 0] * x + E[i, 1] * y + E[i, 2] * z
            out[i, j] = moved + E[i, 3] if j == TRANSLATION else moved


@njit(error_model="numpy", cache=True, nogil=True)
def copy_pose(pose, out):
    """Set ``out`` to a pose (3, 4), entry by entry: numba compiles that quickly."""
    for i in range(3):
        for j in range(4):
            out[i, j] = pose[i, j]


@njit(error_model="numpy", cache=True, nogil=True)
def gauss_newton(samples, n, K, noise, steps, tolerance_px, pose):
    """Refine a pose in place by damped Gauss-Newton steps; return how many were tried.

    This loop is compiled, for the search starts it hundreds of times for a pair. Its damping is
    that of :func:`hybridvo.solver.newton.newton`; it has no use for the curvature of the robust
    weights, and ends by the motion of the image.

    Args:
        samples: pixel buffer.
        n: number of pixels.
        K: (fx, fy, cx, cy) of the current camera.
        noise: :class:`hybridvo.solver.kernels.ResidualNoise`.
        steps: most steps.
        tolerance_px: a step that moves the image by less is the last one.
        pose: (3, 4), changed.
    """
    acc = np.zeros(SUMS)
    candidate_acc = np.zeros(SUMS)
    delta = np.zeros(6)
    candidate = np.empty((3, 4))
    cost = kernels.sum_samples(samples, n, pose, K, noise, acc)
    damping = DAMPING
    done = 0
    for _ in range(steps):
        if not solve6(acc, damping, delta):
            damping = raised(damping)
            continue
        left_update(delta, pose, candidate)
        candidate_cost = kernels.sum_samples(
            samples, n, candidate, K, noise, candidate_acc
        )
        done += 1
        if candidate_cost > cost * (1.0 + 1e-9) + 1e-12:
            damping = raised(damping)
            continue
        # mean squared motion of the image that the step predicts, px^2: delta^T H delta / weight
        predicted = np.sum(delta * acc[HESSIAN_SUMS:COST])
        moved2 = (
            predicted
            / max(acc[ROBUST_SUM], 1e-12)
            / np.float64(noise.flow_information)
        )
        copy_pose(candidate, pose)
        acc, candidate_acc = candidate_acc, acc
        cost = candidate_cost
        damping = lowered(damping)
        if moved2 < tolerance_px * tolerance_px:
            return done
    return done


@njit(error_model="numpy", cache=True, nogil=True)
def residual_scale(samples, n, pose, K):
    """Return the median length of the residuals of about 1000 pixels, px; 1 if none is usable."""
    step = max(1, n // SCALE_PIXELS)
    entries = kernels.pose_entries(pose)
    lengths = np.empty(-(-n // step))
    m = 0
    for k in range(0, n, step):
        ru, rv, _, _, front = kernels.residual(samples, k, entries, K)
        length = np.sqrt(ru * ru + rv * rv)
        if front and samples[W, k] > 0 and not np.isnan(length):
            lengths[m] = length
            m += 1
    return np.median(lengths[:m]) if m > 0 else 1.0


@njit(error_model="numpy", cache=True, nogil=True)
def anneal(samples, n, K, start_px, end_px, ratio, steps, pose):
    """Refine a pose in place while the scale of the robust kernel falls; return the steps tried.

    Graduated non-convexity with the kernel of Geman-McClure around exact depths.

    Args:
        samples: pixel buffer.
        n: number of pixels.
        K: (fx, fy, cx, cy) of the current camera.
        start_px: first scale of the kernel, px.
        end_px: last scale, px.
        ratio: factor from one scale to the next, below 1.
        steps: most Gauss-Newton steps at each scale.
        pose: (3, 4), changed.
    """
    scale = max(start_px, end_px)
    iterations = 0
    while True:
        noise = kernels.residual_noise(scale, 0.0, 1.0)
        tolerance_px = SCALE_TOLERANCE * scale
        iterations += gauss_newton(samples, n, K, noise, steps, tolerance_px, pose)
        if scale <= end_px:
            return iterations
        scale = max(end_px, scale * ratio)


@njit(error_model="numpy", cache=True, nogil=True)
def reestimate(samples, n, K, cutoff, limit, pose):
    """Estimate noise and motion in turn, the pose in place.

    ``cutoff`` is that of the robust kernel, in standard deviations; ``limit`` is about how many
    pixels the noise is estimated from.

    Returns:
        The noise, the fraction of the weight that follows the motion, and the Gauss-Newton steps.
    """
    cap = Noise(FLOW_NOISE_CAP_PX, DEPTH_NOISE_CAP)
    noise = Noise(START_NOISE.flow_px, START_NOISE.log_depth)
    inlier_ratio = 0.0
    iterations = 0
    # not as written numbers, for which numba would compile the kernels anew
    noise_rounds = np.int64(REESTIMATE_NOISE_ROUNDS)
    steps = np.int64(REESTIMATE_STEPS)
    for _ in range(REESTIMATE_ROUNDS):
        estimate = estimate_noise(
            samples, n, pose, K, noise, cap, noise_rounds, limit
        )
        noise = estimate.noise
        inlier_ratio = estimate.inlier_ratio
        weighting = kernels.residual_noise(noise.flow_px, noise.log_depth, cutoff)
        tolerance_px = NOISE_TOLERANCE * noise.flow_px + TOLERANCE_FLOOR_PX
        iterations += gauss_newton(
            samples, n, K, weighting, steps, tolerance_px, pose
        )
    return noise, inlier_ratio, iterations


def translation_scale(samples: np.ndarray, n: int) -> float:
    """Return 1 / typical depth, 1 / m: root mean square of usable pixels, 1 if there are none."""
    usable = samples[W, :n] > 0
    inverse = 1.0 / samples[Z, :n][usable].astype(np.float64)
    if len(inverse) == 0:
        return 1.0
    return max(1e-9, float(np.sqrt(np.mean(inverse**2))))


def fit_coarse(
    samples: np.ndarray, n: int, K: np.ndarray, pose: np.ndarray, cutoff: float
) -> tuple[np.ndarray, Noise, float, int]:
    """Fit one motion and its noise to gathered pixels, from a start.

    Args:
        samples: pixel buffer (BUFFER_ROWS, n or more).
        n: number of pixels.
        K: (4,) float32 fx, fy, cx, cy of the current camera.
        pose: (3, 4) the start; it stays as it is.
        cutoff: c of the robust kernel, standard deviations.

    Returns:
        The motion (3, 4), its noise, the fraction of the weight that follows it, and the
        Gauss-Newton steps.
    """
    pose = np.array(pose, np.float64, order="C")
    scale_px = SCALE_PER_RESIDUAL * residual_scale(samples, n, pose, K)
    scale_px = min(LARGEST_SCALE_PX, max(1.0, scale_px))
    steps = anneal(
        samples,
        n,
        K,
        scale_px,
        SMALLEST_SCALE_PX,
        COARSE_SCALE_RATIO,
        COARSE_STEPS,
        pose,
    )
    noise, inlier_ratio, more = reestimate(
        samples, n, K, cutoff, FINAL_NOISE_PIXELS, pose
    )
    return pose, noise, inlier_ratio, steps + more
