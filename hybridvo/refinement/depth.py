"""The depth of the current frame: how it bounds the noise of the first, and whether both agree."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from hybridvo.calibration import DOUBTFUL_SPREAD, NO_SPREAD
from hybridvo.depth_units import nearer_than_sky
from hybridvo.geometry import backproject, project
from hybridvo.numba_tools import as_contiguous, njit
from hybridvo.refinement import kernels
from hybridvo.refinement.kernels import FASTMATH, MAX_VALUE, MIN_DEPTH, W
from hybridvo.results import Reason, Status
from hybridvo.types import Frame, FramePair

# largest relative difference between the four neighbours that are interpolated
SURFACE = 0.05
# points: least, about; least for the noise
MIN_COMPARED = 100
COMPARED = 2000
MIN_TOLD = 50


@njit(fastmath=FASTMATH, error_model="numpy", cache=True, nogil=True)
def look_up(samples, n, depth):
    """Log of the current depth at the flow target of ``n`` pixels; NaN outside, at edges, holes."""
    (H, width), out = depth.shape, np.full(n, np.nan, np.float32)
    for k in range(n):
        u = samples[kernels.MU, k]
        v = samples[kernels.MV, k]
        if not (
            samples[W, k] > 0 and u >= 0 and v >= 0 and u < width - 1 and v < H - 1
        ):
            continue
        i = int(u)
        j = int(v)
        a = depth[j, i]
        b = depth[j, i + 1]
        c = depth[j + 1, i]
        d = depth[j + 1, i + 1]
        low = min(min(a, b), min(c, d))
        high = max(max(a, b), max(c, d))
        if low > 1e-6 and high < 1e9 and high < low * (1.0 + SURFACE):
            top = a + (u - i) * (b - a)
            bottom = c + (u - i) * (d - c)
            out[k] = math.log(top + (v - j) * (bottom - top))
    return out


def depth_noise(
    samples: np.ndarray, curr: np.ndarray, robust: np.ndarray, pose: np.ndarray
) -> float:
    """Robust standard deviation of both depths' log ratio where a motion is followed, or 0."""
    log_depth = look_up(samples, len(robust), as_contiguous(curr))
    good = (robust > 0.3) & np.isfinite(log_depth)
    if np.count_nonzero(good) < MIN_TOLD:
        return 0.0
    x, y, z = samples[:3, good]
    moved = z * (pose[2, 0] * x + pose[2, 1] * y + pose[2, 2]) + pose[2, 3]
    return float(1.4826 * np.median(np.abs(log_depth[good] - np.log(moved))))


class DepthAgreement(NamedTuple):
    """Median ratio of the current depth to the previous points', moved; spread of its log."""

    ratio: float
    spread: float

    @property
    def status(self) -> Status:
        """What is wrong between the two depths: failed where they have nothing in common."""
        if self.spread > DOUBTFUL_SPREAD:
            percent = 100 * np.expm1(self.spread)
            text = f"along the motion the depths of the two frames differ by {percent:.0f} %"
            wrong = Status.failed if self.spread > NO_SPREAD else Status.degraded
            return wrong(Reason.NO_VALID_DEPTH, text)
        if abs(np.log(self.ratio)) > DOUBTFUL_SPREAD:
            return Status.degraded(
                Reason.NO_VALID_DEPTH,
                f"the current frame's depth is {self.ratio:.3g} times the previous one's, so the "
                f"length of the translation is as uncertain",
            )
        return Status()

    def length_doubt(self, t: np.ndarray) -> np.ndarray:
        """Covariance (3, 3), m^2, of a translation ``t`` whose length depths that differ tell."""
        if self.status.ok:
            return np.zeros((3, 3))
        return (np.log(self.ratio) ** 2 + self.spread**2) * np.outer(t, t)


def compare_depths(
    pair: FramePair, T_curr_prev: np.ndarray, weights: np.ndarray | None
) -> DepthAgreement | None:
    """Compare both depths where the robust weights (H, W) exceed one half, along a motion (4, 4).

    Returns:
        None where fewer than :data:`MIN_COMPARED` points are known in both frames.
    """
    prev = pair.prev
    curr = pair.curr
    if prev.depth is None or curr.depth is None or weights is None:
        return None
    step = max(1, math.isqrt(prev.depth.size // COMPARED))
    first = step // 2
    rows, columns = np.nonzero(weights[first::step, first::step] > 0.5)
    index = np.stack([first + step * rows, first + step * columns], axis=1)
    points = backproject(prev.depth, prev.camera, index)
    moved = points @ T_curr_prev[:3, :3].T + T_curr_prev[:3, 3]
    moved = moved[moved[:, 2] > MIN_DEPTH]
    places = np.rint(project(moved, curr.camera))
    height, width = curr.depth.shape
    inside = ((places >= 0) & (places < [width, height])).all(axis=1)
    column, row = places[inside].astype(np.intp).T
    seen = curr.depth[row, column].astype(np.float64)
    known = (seen > MIN_DEPTH) & (seen < MAX_VALUE)
    if np.count_nonzero(known) < MIN_COMPARED:
        return None
    log_ratio = np.log(seen[known] / moved[inside][known, 2])
    middle = float(np.median(log_ratio))
    spread = float(np.median(np.abs(log_ratio - middle)))
    return DepthAgreement(float(np.exp(middle)), spread)


def without_sky(pair: FramePair) -> FramePair:
    """Return the pair without the depth that renderers state for the sky, as no sensor does."""

    def cut(frame: Frame) -> Frame:
        depth = None if frame.depth is None else nearer_than_sky(frame.depth)
        return frame if depth is frame.depth else replace(frame, depth=depth)

    return replace(pair, prev=cut(pair.prev), curr=cut(pair.curr))
