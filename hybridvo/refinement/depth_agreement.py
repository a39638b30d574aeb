"""Whether the depths of two frames belong to the same world, and have the same scale.

The flow and the depth of the previous frame give the motion; depth that is noise, or of another
scale in the current frame, does not show there. It shows where the motion takes each point to a
pixel whose depth is known as well.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from hybridvo.refinement import kernels
from hybridvo.types import Frame

PIXELS = 4000
MIN_PIXELS = 100
"""Pixels that are asked, and the fewest that can tell."""
FOLLOWS = 0.5
"""Robust weight from which a pixel follows the motion."""
DOUBTFUL_SPREAD = 0.15
NO_SPREAD = 0.35
"""Spread from which an answer is degraded, and from which it is none. Two depths with independent
noise of s differ by 0.95 s, so these are 16 and 37 % of noise in every pixel; real sensors and
rendered depth with DIS flow measure 0.001 to 0.018, depth that is noise from 0.5 to 10 m 0.49 to
0.6, from 2 to 4 m 0.2."""
DOUBTFUL_RATIO = 1.15
"""Of the scales of the two depths: the translation is as long as the first one says."""
RATIO_PIXELS = 1500
MIN_RATIO_PIXELS = 50
"""Pixels that :func:`depth_ratio` compares, on a grid, and the fewest that can tell."""
MAX_RATIO = 1.25
"""Of depths that may have one scale: learned depth jitters by 10 %, and where most of the image
moves towards the camera the median is theirs."""


@dataclass(frozen=True)
class DepthAgreement:
    """Second depth over the depth of the first frame's points, moved.

    Args:
        ratio: its median; 1 where both frames have one scale.
        spread: median distance of its log from that of the median.
    """

    ratio: float
    spread: float

    @property
    def is_none(self) -> bool:
        """Whether the two depths have nothing to do with each other."""
        return self.spread > NO_SPREAD

    @property
    def doubt(self) -> str:
        """What is wrong between the two depths, in words; empty where nothing is."""
        if self.spread > DOUBTFUL_SPREAD:
            percent = 100 * np.expm1(self.spread)
            return f"along the motion the depths of the two frames differ by {percent:.0f} %"
        if abs(np.log(self.ratio)) > np.log(DOUBTFUL_RATIO):
            return (
                f"the current frame's depth is {self.ratio:.3g} times the previous one's, so the "
                f"length of the translation is as uncertain"
            )
        return ""


def depth_agreement(
    curr: Frame,
    samples: np.ndarray,
    robust: np.ndarray,
    pose: np.ndarray,
    origin: tuple[float, float],
) -> DepthAgreement | None:
    """Compare the depths of two frames along a motion.

    It asks the nearest pixel, whatever its neighbours are: in noise none agree.

    Args:
        curr: the current frame.
        samples: (rows, n) gathered pixels of the previous one, see
            :mod:`hybridvo.refinement.kernels`.
        robust: (n,) robust weights about the motion.
        pose: (3, 4) T_curr_prev.
        origin: (u, v) of the current image's coordinates in ``samples``.

    Returns:
        None where too few pixels of both frames have depth.
    """
    assert curr.depth is not None  # asked by the caller
    follow = np.flatnonzero((robust > FOLLOWS) & (samples[kernels.W] > 0))
    follow = follow[:: max(1, len(follow) // PIXELS)]
    x, y, z, u, v = (
        samples[row, follow].astype(np.float64)
        for row in (kernels.XN, kernels.YN, kernels.Z, kernels.MU, kernels.MV)
    )
    moved = z * (pose[2, 0] * x + pose[2, 1] * y + pose[2, 2]) + pose[2, 3]
    u, v = u + origin[0], v + origin[1]
    height, width = curr.depth.shape
    inside = (u > -0.5) & (v > -0.5) & (u < width - 0.5) & (v < height - 0.5) & (moved > 1e-6)
    rows, columns = np.rint(v[inside]).astype(np.intp), np.rint(u[inside]).astype(np.intp)
    seen = curr.depth[rows, columns].astype(np.float64)
    known = (seen > 1e-6) & (seen < 1e9)
    if curr.mask is not None:
        known &= curr.mask[rows, columns]
    if np.count_nonzero(known) < MIN_PIXELS:
        return None
    log_ratio = np.log(seen[known] / moved[inside][known])
    middle = float(np.median(log_ratio))
    return DepthAgreement(float(np.exp(middle)), float(np.median(np.abs(log_ratio - middle))))


def depth_ratio(
    prev: Frame, curr: Frame, flow: np.ndarray | None, T_curr_prev: np.ndarray
) -> float | None:
    """Median depth of the current frame over what the previous one and the motion predict.

    The scale of a whole sequence cannot be seen: all depths and all translations times s project to
    the same pixels. A scale that changes on the way can.

    Args:
        prev: frame with depth, metres.
        curr: the next one with depth.
        flow: (H, W, 2) px from ``prev`` to ``curr``, or None.
        T_curr_prev: (4, 4) motion between them, metres.

    Returns:
        1 where both have the same scale and the motion is right; None where fewer than
        :data:`MIN_RATIO_PIXELS` can be compared.
    """
    if flow is None or prev.depth is None or curr.depth is None:
        return None
    height, width = prev.camera.shape
    step = max(1, math.isqrt(height * width // RATIO_PIXELS))
    rows = np.arange(step // 2, height, step)[:, None]
    cols = np.arange(step // 2, width, step)[None]
    Z = prev.depth[rows, cols].astype(np.float64)
    u, v = (cols + flow[rows, cols, 0]).astype(float), (rows + flow[rows, cols, 1]).astype(float)
    K, R, t = prev.camera, T_curr_prev[:3, :3], T_curr_prev[:3, 3]
    with np.errstate(all="ignore"):
        x, y = (cols - K.cx) / K.fx, (rows - K.cy) / K.fy
        predicted = Z * (R[2, 0] * x + R[2, 1] * y + R[2, 2]) + t[2]
        usable = (Z > 0) & (predicted > 0) & np.isfinite(predicted)
        inside = (u > -0.5) & (v > -0.5) & (u < curr.camera.width - 0.5)
        usable &= inside & (v < curr.camera.height - 0.5)
    if prev.mask is not None:
        usable &= prev.mask[rows, cols]
    at = np.rint(v[usable]).astype(int), np.rint(u[usable]).astype(int)
    found, predicted = curr.depth[at].astype(np.float64), predicted[usable]
    good = np.isfinite(found) & (found > 0)
    if curr.mask is not None:
        good &= curr.mask[at]
    if np.count_nonzero(good) < MIN_RATIO_PIXELS:
        return None
    return float(np.exp(np.median(np.log(found[good] / predicted[good]))))


def is_step(ratio: float | None) -> bool:
    """Whether depths of one scale would not give this ratio."""
    return ratio is not None and abs(math.log(max(ratio, 1e-30))) > math.log(MAX_RATIO)
