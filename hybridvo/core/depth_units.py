"""Whether a depth map can be in metres, and what makes metres of it."""

from __future__ import annotations

import numpy as np

# m: where the median of a map, without the sky, lies outside, its unit is another
PLAUSIBLE_DEPTH_M = (0.1, 200.0)
# m: where the median of an indoor map usually lies; of several units the one that
# leads there is named
EVERYDAY_DEPTH_M = (0.3, 8.0)
# m: renderers state such depths for the sky, no sensor reaches them
SKY_DEPTH_M = 1000.0
# of nearer pixels to those beyond: with fewer the depths are not in metres
MIN_NEARER_THAN_SKY = 0.1


UNITS_PER_METRE = {
    1000: "millimetres",
    5000: "TUM's unit",
    100: "centimetres",
    256: "KITTI's unit",
}
"""Units of depth that are in use, the most frequent first."""
# every so many rows and columns are enough for a median
STRIDE = 8


def typical_depth(depth: np.ndarray) -> float | None:
    """Return the median of valid depth without the sky.

    Args:
        depth: depths of any shape, in any unit.

    Returns:
        The median, in the same unit; None where no depth is valid.

    >>> typical_depth(np.array([[1.0, 2.0, 3.0], [0.0, np.nan, 1e9]]))
    2.0
    """
    depth = nearer_than_sky(depth)
    values = depth[np.isfinite(depth) & (depth > 0)].astype(np.float64)
    return float(np.median(values)) if values.size else None


def nearer_than_sky(depth: np.ndarray) -> np.ndarray:
    """Return a depth map (any shape) with NaN in place of the sky.

    Where hardly anything is nearer, the map has another unit: it is returned as it
    is.
    """
    is_sky = depth > SKY_DEPTH_M
    if not is_sky.any():
        return depth
    is_near = (depth > 0) & ~is_sky
    min_near = MIN_NEARER_THAN_SKY * np.count_nonzero(is_sky)
    if np.count_nonzero(is_near) <= min_near:
        return depth
    return np.where(is_sky, np.float32(np.nan), depth)


def depth_unit_warning(depth: np.ndarray | None) -> str:
    """Return why a depth map cannot be in metres, and the remedy; else empty."""
    if depth is None:
        return ""
    median = typical_depth(depth[::STRIDE, ::STRIDE])
    if median is None:
        return ""
    fix = depth_unit_fix(median)
    if not fix:
        return ""
    return f"the median depth is {median:.4g}; Frame.depth expects metres: {fix}"


def depth_unit_fix(median: float, usual: float | None = None) -> str:
    """Return what turns depth of this median into metres; empty if it is metres.

    Args:
        median: of a depth map.
        usual: number of units in a metre that its data set has; None: not known.

    >>> depth_unit_fix(2.0), depth_unit_fix(2000.0)
    ('', 'divide by 1000 (millimetres)')
    """
    low, high = PLAUSIBLE_DEPTH_M
    if low <= median <= high:
        return ""
    if median < low:
        return "multiply by 1000"
    unit = _everyday_unit(median)
    if usual and low <= median / usual <= high:
        unit = round(usual)
    if unit not in UNITS_PER_METRE:
        return f"divide by {unit}"
    return f"divide by {unit} ({UNITS_PER_METRE[unit]})"


def depth_by_units(stored: np.ndarray) -> str:
    """Return the median of a depth map in metres, by each unit in use; empty without depth.

    Args:
        stored: depths of any shape, as they are stored.

    Returns:
        A sentence from which people see which unit it is.

    >>> depth_by_units(np.full((9, 9), 900, np.uint16))
    'Its median is 0.9 m by 1000, 0.18 m by 5000, 9 m by 100, 3.52 m by 256'
    """
    median = typical_depth(stored[::STRIDE, ::STRIDE].astype(np.float64))
    if median is None:
        return ""
    shown = [f"{median / unit:.3g} m by {unit}" for unit in UNITS_PER_METRE]
    return f"Its median is {', '.join(shown)}"


def scale_is_unknown(stored: np.ndarray, expected: str) -> str:
    """Return what is wrong with depth of whole numbers without a unit, for a message.

    Args:
        stored: a depth map.
        expected: where the unit could be stated, beside the option.
    """
    by_units = depth_by_units(stored)
    return (
        f"depth is of whole numbers: expected {expected}, or --depth-scale: units per metre, 1000 "
        f"for mm.{' ' if by_units else ''}{by_units}{'.' if by_units else ''}"
    )


def _everyday_unit(median: float) -> int:
    """The most frequent unit in which this median is an everyday depth."""
    near, far = EVERYDAY_DEPTH_M
    for unit in UNITS_PER_METRE:
        if near <= median / unit <= far:
            return unit
    return 1000
