"""In which unit time stamps and depth probably are, where a file does not say."""

from __future__ import annotations

import numpy as np

EPOCH_S = (1e9, 4.2e9)
"""Seconds since 1970 from 2001 to 2103: where the stamps of today's clocks lie."""
MAX_SECONDS = 1e14
"""Stamps above this (three million years) cannot be seconds and are taken as nanoseconds."""

PLAUSIBLE_DEPTH_M = (0.1, 200.0)
"""Metres; a depth map whose median lies outside is not in metres."""
EVERYDAY_DEPTH_M = (0.3, 8.0)
"""Metres; where the median of an indoor depth map usually lies."""
UNITS_PER_METRE = {1000: "millimetres", 5000: "TUM's unit", 100: "centimetres", 256: "KITTI's unit"}
"""Depth units in use, the most frequent first."""


def stamp_unit(stamps: np.ndarray) -> tuple[float, str]:
    """How many of the unit of some stamps make a second, and its name.

    Milliseconds and microseconds are told by two things together: every stamp (N,) that is finite
    is one of today's clocks (2001 to 2103), and neighbours are typically less than a second apart,
    which for a clock that counts nanoseconds since the machine was started would be more than 1000
    images a second. Else stamps above 1e14 are nanoseconds.
    """
    known = np.abs(stamps[np.isfinite(stamps)])
    with np.errstate(over="ignore"):  # between numbers that are no times anyway
        step = np.median(np.abs(np.diff(known))) if len(known) > 1 else np.inf
    for factor, name in ((1e3, "milliseconds"), (1e6, "microseconds")):
        first, last = factor * EPOCH_S[0], factor * EPOCH_S[1]
        if step < factor and first <= known.min() and known.max() <= last:
            return factor, name
    return (1e9, "nanoseconds") if (known > MAX_SECONDS).any() else (1.0, "seconds")


def typical_depth(depth: np.ndarray) -> float | None:
    """Median of the valid depths without the sky, in the map's unit; None where there are none."""
    values = depth[np.isfinite(depth) & (depth > 0)].astype(np.float64)
    near = values[values <= 1000.0]  # renderers mark the sky with larger values
    values = near if near.size > 0.1 * values.size else values
    return float(np.median(values)) if values.size else None


def depth_advice(median: float, usual: float | None = None) -> str:
    """What probably turns depths of this median into metres; empty where they can be metres.

    A guess: no image knows its scale. The first unit is taken that brings the median to everyday
    depths, the data set's own (``usual``, units per metre) before the others.

    Example:
        >>> depth_advice(974.0)
        'divide by 1000 (millimetres)'
    """
    low, high = PLAUSIBLE_DEPTH_M
    if low <= median <= high:
        return ""
    too_large = median > high
    units = [1 / unit if too_large else float(unit) for unit in UNITS_PER_METRE]
    inside = [f for f in units if EVERYDAY_DEPTH_M[0] <= median * f <= EVERYDAY_DEPTH_M[1]]
    if usual and too_large and low <= median / usual <= high:
        inside = [1 / usual]
    centre = np.sqrt(np.prod(EVERYDAY_DEPTH_M))
    nearest = min(units, key=lambda factor: abs(np.log(median * factor / centre)))
    factor = inside[0] if inside else nearest
    if factor > 1:
        return f"multiply by {factor:g}"
    unit = UNITS_PER_METRE.get(round(1 / factor))
    return f"divide by {1 / factor:g}" + (f" ({unit})" if unit else "")
