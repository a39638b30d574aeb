"""The depth of the current frame: how it bounds the previous one's noise, and if both agree."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from hybridvo.compiled.numba_tools import as_contiguous, njit
from hybridvo.core.geometry import backproject, project, transform_points
from hybridvo.core.results import Reason, Status
from hybridvo.core.types import FramePair
from hybridvo.solver import kernels
from hybridvo.solver.calibration import (
    DOUBTFUL_SPREAD,
    FOLLOWING_WEIGHT,
    MIN_COMPARED_DEPTHS,
    MIN_DEPTH_NOISE_POINTS,
    NO_SPREAD,
    SURFACE,
)
from hybridvo.solver.kernels import FASTMATH, MAX_VALUE, MIN_DEPTH, W

# Points that are compared, about.
COMPARED = 2000
# Robust weight above which a pixel's depth is compared.
COMPARED_WEIGHT = 0.5
# Metres: what lies outside of them is no measurement.
SMALLEST_DEPTH = 1e-6
LARGEST_DEPTH = 1e9
# Standard deviation of normal numbers over their median absolute deviation.
MAD_TO_STD = 1.4826


@njit(fastmath=FASTMATH, error_model="numpy", cache=True, nogil=True)
def look_up(samples, n, depth):
    """Return the log (n,) of the current depth where the flow of gathered pixels leads.

    It is interpolated between four neighbours; NaN outside the image, in holes, and at edges.
    """
    height, width = depth.shape
    out = np.full(n, np.nan, np.float32)
    for k in range(n):
        u = samples[kernels.MU, k]
        v = samples[kernels.MV, k]
        is_inside = u >= 0 and v >= 0 and u < width - 1 and v < height - 1
        if not (samples[W, k] > 0 and is_inside):
            continue
        i = int(u)
        j = int(v)
        a = depth[j, i]
        b = depth[j, i + 1]
        c = depth[j + 1, i]
        d = depth[j + 1, i + 1]
        low = min(min(a, b), min(c, d))
        high = max(max(a, b), max(c, d))
        is_known = low > SMALLEST_DEPTH and high < LARGEST_DEPTH
        if is_known and high < low * (1.0 + SURFACE):
            top = a + (u - i) * (b - a)
            bottom = c + (u - i) * (d - c)
            out[k] = math.log(top + (v - j) * (bottom - top))
    return out


def depth_noise(
    samples: np.ndarray,
    depth_curr: np.ndarray,
    robust: np.ndarray,
    pose: np.ndarray,
) -> float:
    """Return the robust standard deviation of the log ratio of both depths along a motion.

    Args:
        samples: pixel buffer (BUFFER_ROWS, n).
        depth_curr: (H, W) current depth, metres.
        robust: (n,) robust weights; pixels that follow the motion are compared.
        pose: (3, 4) T_curr_prev.

    Returns:
        The standard deviation; 0 where too few pixels can be compared.
    """
    log_depth = look_up(samples, len(robust), as_contiguous(depth_curr))
    compared = (robust > FOLLOWING_WEIGHT) & np.isfinite(log_depth)
    if np.count_nonzero(compared) < MIN_DEPTH_NOISE_POINTS:
        return 0.0
    x, y, z = samples[:3, compared]
    moved_z = z * (pose[2, 0] * x + pose[2, 1] * y + pose[2, 2]) + pose[2, 3]
    log_ratio = log_depth[compared] - np.log(moved_z)
    return float(MAD_TO_STD * np.median(np.abs(log_ratio)))


class DepthAgreement(NamedTuple):
    """How the current depth compares with the previous points, moved.

    Attributes:
        ratio: median of current over moved depth.
        log_deviation: median absolute deviation of the log of the ratio.
    """

    ratio: float
    log_deviation: float

    @property
    def status(self) -> Status:
        """Ok, degraded where the depths differ, failed where they have nothing in common."""
        if self.log_deviation > DOUBTFUL_SPREAD:
            percent = 100 * np.expm1(self.log_deviation)
            text = f"along the motion the depths of the two frames differ by {percent:.0f} %"
            if self.log_deviation > NO_SPREAD:
                return Status.failed(Reason.NO_VALID_DEPTH, text)
            return Status.degraded(Reason.NO_VALID_DEPTH, text)
        if abs(np.log(self.ratio)) > DOUBTFUL_SPREAD:
            return Status.degraded(
                Reason.NO_VALID_DEPTH,
                f"the current frame's depth is {self.ratio:.3g} times the previous one's, so the "
                f"length of the translation is as uncertain",
            )
        return Status()

    @property
    def length_variance(self) -> float:
        """Relative variance of the length of a translation by depths that differ."""
        if self.status.ok:
            return 0.0
        return float(np.log(self.ratio) ** 2 + self.log_deviation**2)


def compare_depths(
    pair: FramePair, T_curr_prev: np.ndarray, weights: np.ndarray | None
) -> DepthAgreement | None:
    """Compare the depths of both frames along a motion.

    Args:
        pair: frames with their depth.
        T_curr_prev: (4, 4) motion, metres.
        weights: (H, W) robust weights; pixels above one half are compared.

    Returns:
        None where fewer than :data:`MIN_COMPARED_DEPTHS` points have a depth in both frames.
    """
    prev = pair.prev
    curr = pair.curr
    if prev.depth is None or curr.depth is None or weights is None:
        return None

    stride = max(1, math.isqrt(prev.depth.size // COMPARED))
    first = stride // 2
    rows, columns = np.nonzero(
        weights[first::stride, first::stride] > COMPARED_WEIGHT
    )
    index = np.stack([first + stride * rows, first + stride * columns], axis=1)
    points = backproject(prev.depth, prev.camera, index)
    moved = transform_points(T_curr_prev, points)
    moved = moved[moved[:, 2] > MIN_DEPTH]

    places = np.rint(project(moved, curr.camera))
    height, width = curr.depth.shape
    inside = ((places >= 0) & (places < [width, height])).all(axis=1)
    column, row = places[inside].astype(np.intp).T
    measured = curr.depth[row, column].astype(np.float64)
    valid = (measured > MIN_DEPTH) & (measured < MAX_VALUE)
    if np.count_nonzero(valid) < MIN_COMPARED_DEPTHS:
        return None

    log_ratio = np.log(measured[valid] / moved[inside][valid, 2])
    middle = float(np.median(log_ratio))
    deviation = float(np.median(np.abs(log_ratio - middle)))
    return DepthAgreement(float(np.exp(middle)), deviation)
