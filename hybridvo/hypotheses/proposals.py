"""Motions that small sets of pixels propose, and their scores (numba).

A window of the image proposes the motion that a robust fit finds in it. Three pixels
propose the motion that carries each of them to its flow target.

Poses are (3, 4) float64 ``T_curr_prev``; ``samples`` is a pixel buffer with the rows of
:mod:`hybridvo.solver.kernels`; ``K`` is (fx, fy, cx, cy) of the current camera.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from hybridvo.compiled.numba_tools import njit
from hybridvo.hypotheses.calibration import BROAD_SCORE_PER_PX2, SHARP_SCORE_PER_PX2
from hybridvo.solver import kernels, robust_fit
from hybridvo.solver.kernels import FASTMATH, MAX_VALUE, MU, MV, XN, YN, W, Z


class Annealing(NamedTuple):
    """How the scale of a robust kernel shrinks during a fit.

    Attributes:
        start_px: first scale, px; where it follows from the residuals, its largest value.
        end_px: last scale, px.
        ratio: each scale over the one before.
        steps: Gauss-Newton steps at each scale, at most.
    """

    start_px: float
    end_px: float
    ratio: float
    steps: int


# Of the fit of a window, and of a pose that the caller hands in.
CANDIDATE_ANNEALING = Annealing(start_px=64.0, end_px=0.7, ratio=0.4, steps=2)
# Smallest first scale of such a fit, px, even where the residuals are smaller.
CANDIDATE_MIN_START_PX = 1.0
# Weight of a pixel up to which a window leaves it out; 1 is that of an untouched one.
MIN_PIXEL_WEIGHT = 0.05
# Fewest pixels of a window that is fitted.
MIN_WINDOW_PIXELS = 20
# Smallest sum of the weights of such a window.
MIN_WINDOW_WEIGHT = 12.0
# One of so many minimal samples is drawn from all pixels, the others locally.
GLOBAL_SAMPLE_PERIOD = 3
# Region of a local sample about its first pixel, over the height and width of the image.
LOCAL_SAMPLE_HEIGHT = 0.5
LOCAL_SAMPLE_WIDTH = 0.4

# windows are placed in so many rows and columns, and overlap by half
WINDOW_ROWS = 3
WINDOW_COLUMNS = 4
# cells of the grid: smallest side of a window
MIN_WINDOW_SIDE = 3
# Newton steps from the identity, which converge quadratically
MINIMAL_STEPS = 3
# pixels whose flow determines a motion
SAMPLE_SIZE = 3
# draws of a pixel after which a sample is given up
MAX_DRAWS = 60
# entries of the upper triangle of a 6x6 matrix, after which the gradient follows
TRIANGLE = 21
# float32: these enter a vectorised loop
SHARP_SCORE = np.float32(SHARP_SCORE_PER_PX2)
BROAD_SCORE = np.float32(BROAD_SCORE_PER_PX2)
ZERO = np.float32(0.0)
HALF = np.float32(0.5)
ONE = np.float32(1.0)


@njit(error_model="numpy", cache=True, nogil=True)
def fit_windows(samples, h, w, K):
    """Fit a motion to each of the overlapping windows, from the identity.

    Args:
        samples: pixel buffer of a grid, row by row.
        h: rows of the grid.
        w: columns of the grid.
        K: intrinsics of the current camera, px.

    Returns:
        (M, 3, 4) poses of the windows that hold enough pixels.
    """
    rows = min(h, max(MIN_WINDOW_SIDE, (2 * h) // (WINDOW_ROWS + 1)))
    columns = min(w, max(MIN_WINDOW_SIDE, (2 * w) // (WINDOW_COLUMNS + 1)))
    window = np.empty((kernels.BUFFER_ROWS, rows * columns), np.float32)
    poses = np.empty((WINDOW_ROWS * WINDOW_COLUMNS, 3, 4))
    fitted = 0
    for i in range(WINDOW_ROWS):
        for j in range(WINDOW_COLUMNS):
            top = i * (h - rows) // (WINDOW_ROWS - 1)
            left = j * (w - columns) // (WINDOW_COLUMNS - 1)
            first = top * w + left
            n, weight = gather_window(samples, w, first, rows, columns, window)
            if n < MIN_WINDOW_PIXELS or weight < MIN_WINDOW_WEIGHT:
                continue
            pose = np.eye(3, 4)
            fit_window(window, n, K, pose)
            if np.all(np.abs(pose) < MAX_VALUE):
                poses[fitted] = pose
                fitted += 1
    return poses[:fitted]


@njit(error_model="numpy", cache=True, nogil=True)
def gather_window(samples, w, first, rows, columns, window):
    """Copy the pixels of a window that have weight; return their number and weight.

    ``first`` is the index of the window's top left pixel in a grid of ``w`` columns.
    """
    n = 0
    weight = 0.0
    for k in range(rows * columns):
        at = first + (k // columns) * w + k % columns
        if samples[W, at] > MIN_PIXEL_WEIGHT:
            for row in range(kernels.BUFFER_ROWS):
                window[row, n] = samples[row, at]
            weight += samples[W, at]
            n += 1
    return n, weight


@njit(error_model="numpy", cache=True, nogil=True)
def fit_window(window, n, K, pose):
    """Fit a motion to ``n`` pixels of a window under a shrinking kernel, in place."""
    widest = CANDIDATE_ANNEALING.start_px
    residual_px = robust_fit.residual_scale(window, n, pose, K)
    start_px = min(widest, max(CANDIDATE_MIN_START_PX, residual_px))
    end_px = CANDIDATE_ANNEALING.end_px
    ratio = CANDIDATE_ANNEALING.ratio
    steps = CANDIDATE_ANNEALING.steps
    robust_fit.anneal(window, n, K, start_px, end_px, ratio, steps, pose)


@njit(error_model="numpy", cache=True, nogil=True)
def fit_minimal_samples(samples, h, w, K, count, rng):
    """Fit motions to ``count`` random samples of three pixels.

    Two of three samples are drawn from a part of the image, because an object is compact.

    Returns:
        (M, 3, 4) poses of the samples that determine one.
    """
    poses = np.empty((count, 3, 4))
    pick = np.zeros(SAMPLE_SIZE, np.int64)
    usable = np.flatnonzero(samples[W, : h * w] > 0)
    if len(usable) < SAMPLE_SIZE:
        return poses[:0]
    fitted = 0
    for s in range(count):
        is_local = s % GLOBAL_SAMPLE_PERIOD != 0
        drawn = draw_three(samples, usable, h, w, is_local, rng, pick)
        if drawn and fit_minimal(samples, pick, poses[fitted], K):
            fitted += 1
    return poses[:fitted]


@njit(error_model="numpy", cache=True, nogil=True)
def draw_three(samples, usable, h, w, is_local, rng, pick):
    """Draw three distinct pixels with probabilities in proportion to their weights.

    Args:
        samples: pixel buffer of a grid of ``h`` rows and ``w`` columns.
        usable: (N,) indices of the pixels with weight.
        h: rows of the grid.
        w: columns of the grid.
        is_local: draw the second and the third pixel from a region about the first.
        rng: numpy's random generator.
        pick: (3,) int64, the indices drawn, written in place.

    Returns:
        Whether three pixels were drawn.
    """
    drawn = 0
    for _ in range(MAX_DRAWS):
        k = usable[int(rng.random() * len(usable))]
        if drawn > 0 and is_local:
            down = int((rng.random() - 0.5) * LOCAL_SAMPLE_HEIGHT * h)
            right = int((rng.random() - 0.5) * LOCAL_SAMPLE_WIDTH * w)
            row = pick[0] // w + down
            column = pick[0] % w + right
            if row < 0 or row >= h or column < 0 or column >= w:
                continue
            k = row * w + column
        is_rejected = samples[W, k] < rng.random()
        if is_rejected or k in pick[:drawn]:
            continue
        pick[drawn] = k
        drawn += 1
        if drawn == SAMPLE_SIZE:
            return True
    return False


@njit(error_model="numpy", cache=True, nogil=True)
def fit_minimal(samples, pick, pose, K):
    """Find the motion that carries three pixels to their flow targets.

    Their two coordinates are six equations for six unknowns, which Newton steps from the
    identity solve.

    Args:
        samples: pixel buffer.
        pick: (3,) indices of the pixels.
        pose: (3, 4), written in place.
        K: intrinsics of the current camera, px.

    Returns:
        Whether the pixels determine a motion with finite entries.
    """
    equations = np.empty((6, 7))
    sums = np.empty(TRIANGLE + 6)
    delta = np.empty(6)
    pose[:] = np.eye(3, 4)
    for _ in range(MINIMAL_STEPS):
        if not linearize_three(samples, pick, pose, K, equations):
            return False
        sum_normal_equations(equations, sums)
        if not robust_fit.solve6(sums, 0.0, delta):
            return False
        robust_fit.left_update(delta, pose, pose)
    return np.all(np.abs(pose) < MAX_VALUE)


@njit(error_model="numpy", cache=True, nogil=True)
def linearize_three(samples, pick, pose, K, equations):
    """Write the equations (6, 7) of a Newton step: the Jacobian, and the residual last.

    Both are in units of the focal length. The step is a left perturbation (translation,
    rotation). False where a pixel is behind the camera.
    """
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
        equations[2 * m] = (i, 0.0, -a * i, -a * b, 1.0 + a * a, -b, u)
        equations[2 * m + 1] = (0.0, i, -b * i, -(1.0 + b * b), a * b, a, v)
    return True


@njit(error_model="numpy", cache=True, nogil=True)
def sum_normal_equations(equations, sums):
    """Write J^T J as its upper triangle, then J^T r, of equations (N, 7) with r last."""
    sums[:] = 0.0
    for row in equations:
        entry = 0
        for i in range(6):
            for j in range(i, 6):
                sums[entry] += row[i] * row[j]
                entry += 1
            sums[TRIANGLE + i] += row[i] * row[6]


@njit(fastmath=FASTMATH, error_model="numpy", cache=True, nogil=True)
def score_poses(samples, n, poses, K):
    """Score motions by how many pixels agree with them, and how exactly.

    A pixel with a residual of r px adds its weight times half the sum of a sharp kernel,
    1 / (1 + (r / 0.15)^2), and of a broad one, 1 / (1 + (r / 0.9)^2)^2. The sharp one
    prefers an exact motion to a vague one; the broad one keeps motions of noisy flow.

    Args:
        samples: pixel buffer.
        n: pixels in it.
        poses: (M, 3, 4) motions.
        K: intrinsics of the current camera, px.

    Returns:
        (M,) scores, at most the sum of the weights; 0 where a pose is not finite.
    """
    scores = np.empty(len(poses))
    fx = K[0]
    fy = K[1]
    cx = K[2]
    cy = K[3]
    ray_x = samples[XN]
    ray_y = samples[YN]
    depth = samples[Z]
    target_u = samples[MU]
    target_v = samples[MV]
    weights = samples[W]
    for m in range(len(poses)):
        entries = kernels.pose_entries(poses[m].astype(np.float32))
        score = ZERO
        for k in range(n):
            a, b, _, front = kernels.transform_and_project(
                ray_x[k], ray_y[k], depth[k], entries
            )
            ru = target_u[k] - (fx * a + cx)
            rv = target_v[k] - (fy * b + cy)
            r2 = ru * ru + rv * rv
            sharp = ONE / (ONE + SHARP_SCORE * r2)
            broad = ONE / (ONE + BROAD_SCORE * r2)
            weight = weights[k] if front else ZERO
            score += weight * (HALF * sharp + HALF * broad * broad)
        # a comparison with NaN is false
        scores[m] = score if score > 0 else 0.0
    return scores
