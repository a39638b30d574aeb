"""Whether a flow that was handed in is the flow of its pictures.

A flow with the wrong sign, direction, unit, order of channels or of another pair is a flawless flow
of another motion: nothing but the pictures can tell. They are asked for the coarsest fact only,
whether the flow carries one onto the other better than standing still does.
"""

from __future__ import annotations

import cv2
import numpy as np

from hybridvo.flow import crashes_dis
from hybridvo.types import FramePair

__all__ = ["contradiction"]

SIDE = 100
"""Shorter side in pixels at which the pictures are compared."""
TEXTURE_LEVELS = 2.0
"""Gradient in grey levels per pixel of that size where a shift can be seen."""
LEAST_PIXELS = 200
NO_BETTER = 0.8
"""Median difference after the flow, over that of standing still, from which the flow is doubted."""
MUST_MOVE = 2.0
"""How much better than standing still a coarse flow of the pictures' own must do, plus one level:
else they stand still, are not of one place, or change by light.

Measured on 27 pairs, rendered and real: given over still is 0.04 to 0.2 for the right flow, up to
0.25 with noise of 3 px or 30 % of wrong pixels; 1.3 to 1.8 for a negated or backward flow, 1.0 for
none, 0.85 to 1.2 for twice the flow. Half the flow (0.5 to 0.7) passes.
"""


def contradiction(pair: FramePair) -> str | None:
    """Why the flow of a pair cannot be that of its pictures, or None.

    Says nothing where a picture or the flow is missing, where the flow was computed from them
    (source ``dis``), and where the pictures tell too little.
    """
    rgb_prev, rgb_curr, flow = pair.prev.rgb, pair.curr.rgb, pair.flow
    if rgb_prev is None or rgb_curr is None or flow is None or pair.flow_source == "dis":
        return None
    height, width = flow.shape[:2]
    factor = max(1, min(height, width) // SIDE)
    size = (width // factor, height // factor)
    first, second = (
        cv2.blur(
            cv2.resize(cv2.cvtColor(x, cv2.COLOR_RGB2GRAY), size, interpolation=cv2.INTER_AREA),
            (3, 3),
        )
        for x in (rgb_prev, rgb_curr)
    )
    if crashes_dis(first):
        return None
    try:
        dis = cv2.DISOpticalFlow.create(cv2.DISOPTICAL_FLOW_PRESET_FAST)
        own = np.asarray(dis.calc(first, second, None))  # type: ignore[call-overload]
    except cv2.error:  # smaller than DIS's patches
        return None
    middle = (
        slice(factor // 2, factor * size[1], factor),
        slice(factor // 2, factor * size[0], factor),
    )
    small = flow[middle] / np.float32(factor)
    seen = np.isfinite(small[..., 0]) & np.isfinite(small[..., 1])
    if pair.flow_valid is not None:
        seen &= pair.flow_valid[middle]
    small = np.where(seen[..., None], small, np.float32(0))
    # single pixels are noisy or wrong, which a fit does not mind
    small = np.dstack([cv2.blur(cv2.medianBlur(x, 5), (5, 5)) for x in cv2.split(small)])
    du, dv = cv2.Sobel(first, cv2.CV_32F, 1, 0) / 8, cv2.Sobel(first, cv2.CV_32F, 0, 1) / 8
    seen &= cv2.magnitude(du, dv) > TEXTURE_LEVELS
    u = np.arange(size[0], dtype=np.float32)
    v = np.arange(size[1], dtype=np.float32)[:, None]

    def difference(shift: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        x, y = shift[..., 0] + u, shift[..., 1] + v
        inside = (x >= 0) & (x <= size[0] - 1) & (y >= 0) & (y <= size[1] - 1)
        there = cv2.remap(second.astype(np.float32), x, y, cv2.INTER_LINEAR)
        return np.abs(there - first), inside

    (given, lands), (best, lands_own) = difference(small), difference(own)
    still, _ = difference(np.zeros_like(own))
    seen &= lands & lands_own
    if np.count_nonzero(seen) < LEAST_PIXELS:
        return None
    left, least, most = (float(np.median(x[seen])) for x in (given, best, still))
    if left < NO_BETTER * most or most < MUST_MOVE * least + 1:
        return None
    return (
        f"the flow ({pair.flow_source}) carries the previous picture onto the current one hardly "
        f"better than standing still ({left:.1f} and {most:.1f} grey levels, {least:.1f} by a "
        f"flow of the pictures). Expected pixels, (u, v), from the previous frame to the current "
        f"one: check its sign, its direction, its unit and whose pair it is."
    )
