"""Whether the depth of one frame has the scale of the frame before.

The scale of a whole sequence cannot be seen from it: all depths and all translations times s
project to the same pixels (s D, s t instead of D, t leaves K (R D x + t) / z as it is) and move in
the same proportion, so every residual of flow and of depth stays what it was. A scale that changes
on the way can: the motion carries the depth of one frame into the next, where it is measured again.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np

from hybridvo.types import Frame

__all__ = ["LARGEST_RATIO", "depth_ratio", "depth_step_warning", "is_step"]

PIXELS = 1500
"""About as many are compared, on a grid."""
LEAST_PIXELS = 50
LARGEST_RATIO = 1.25
"""Of depths that may have one scale: learned depth jitters by 10 %, and where most of the picture
moves towards the camera the median is theirs."""


def depth_ratio(
    prev: Frame, curr: Frame, flow: np.ndarray | None, T_curr_prev: np.ndarray
) -> float | None:
    """Median depth of the current frame over what the previous one and the motion predict.

    Args:
        prev: frame with depth, metres.
        curr: the next one with depth.
        flow: (H, W, 2) px from ``prev`` to ``curr``, or None.
        T_curr_prev: (4, 4) motion between them, metres.

    Returns:
        1 where both have the same scale and the motion is right; None where fewer than
        :data:`LEAST_PIXELS` can be compared.
    """
    if flow is None or prev.depth is None or curr.depth is None:
        return None
    height, width = prev.camera.shape
    step = max(1, math.isqrt(height * width // PIXELS))
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
    if np.count_nonzero(good) < LEAST_PIXELS:
        return None
    return float(np.exp(np.median(np.log(found[good] / predicted[good]))))


def is_step(ratio: float | None) -> bool:
    """Whether depths of one scale would not give this ratio."""
    return ratio is not None and abs(math.log(max(ratio, 1e-30))) > math.log(LARGEST_RATIO)


def depth_step_warning(rows: Iterable[Mapping[str, Any]]) -> str:
    """What a user is told of the frames whose depth has another scale; empty where none has.

    Args:
        rows: with ``index``, ``prev_index`` and ``depth_ratio``.
    """
    steps = [row for row in rows if is_step(row["depth_ratio"])]
    if not steps:
        return ""
    first, more = steps[0], f", and {len(steps) - 1} more" if len(steps) > 1 else ""
    return (
        f"the depth of frame {first['index']} is {first['depth_ratio']:.3g} times what frame "
        f"{first['prev_index']} and the motion between them say{more}: its unit or scale changes "
        f"within the sequence, and the trajectory's with it"
    )
