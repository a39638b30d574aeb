"""Whether a depth map can be in metres, and what makes metres of it."""

from __future__ import annotations

import numpy as np

# a depth map whose median lies outside is not in metres
PLAUSIBLE_DEPTH_M = (0.1, 200.0)
SKY = 1000.0  # metres; no sensor reaches as far: renderers state it for the sky
# where the median of an indoor depth map usually lies
EVERYDAY_DEPTH_M = (0.3, 8.0)
UNITS_PER_METRE = {
    1000: "millimetres",
    5000: "TUM's unit",
    100: "centimetres",
    256: "KITTI's unit",
}
"""Units of depth that are in use, the most frequent first."""


def typical_depth(depth: np.ndarray) -> float | None:
    """Return the median of valid depth without the sky, in the map's unit; None without any."""
    depth = nearer_than_sky(depth)
    values = depth[np.isfinite(depth) & (depth > 0)].astype(np.float64)
    return float(np.median(values)) if values.size else None


def nearer_than_sky(depth: np.ndarray) -> np.ndarray:
    """A depth map without what lies beyond the sky's; itself where hardly anything is nearer."""
    far = depth > SKY
    if not far.any() or np.count_nonzero(
        (depth > 0) & ~far
    ) <= 0.1 * np.count_nonzero(far):
        return depth
    return np.where(far, np.float32(np.nan), depth)


def depth_unit_warning(depth: np.ndarray | None) -> str:
    """Return why a depth map cannot be in metres, and the probable remedy; empty where it can."""
    median = None if depth is None else typical_depth(depth[::8, ::8])
    advice = "" if median is None else depth_unit_fix(median)
    return (
        advice
        and f"the median depth is {median:.4g}; Frame.depth expects metres: {advice}"
    )


def depth_unit_fix(median: float, usual: float | None = None) -> str:
    """Return what turns depth of this median into metres; empty where it is in metres.

    ``usual`` is the number of units in a metre that its data set has.
    """
    low, high = PLAUSIBLE_DEPTH_M
    if low <= median <= high:
        return ""
    if median < low:
        return "multiply by 1000"
    near, far = EVERYDAY_DEPTH_M
    units = [unit for unit in UNITS_PER_METRE if near <= median / unit <= far] or [
        1000
    ]
    unit = round(usual) if usual and low <= median / usual <= high else units[0]
    return f"divide by {unit}" + (
        f" ({UNITS_PER_METRE[unit]})" if unit in UNITS_PER_METRE else ""
    )
