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

    Milliseconds and microseconds are told by two things together: every stamp is one of today's
    clocks (2001 to 2103), and neighbours are typically less than a second apart, which in the finer
    units of a clock that counts from another moment (nanoseconds since the machine was started)
    would be more than 1000 images a second. Else stamps above 1e14 are nanoseconds.

    Args:
        stamps: (N,) numbers in the order of the frames; those that are not finite say nothing.
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


def depth_factor(median: float, usual: float | None = None) -> float | None:
    """Factor that probably turns depths of this median into metres; None where they can be metres.

    A guess: no image knows its scale. The first unit is taken that brings the median to everyday
    depths, the data set's own before the others.

    Args:
        median: of the valid depths, as :func:`typical_depth` gives it.
        usual: units per metre of the data set, where it has any.

    Example:
        >>> depth_factor(974.0)  # millimetres read as metres
        0.001
    """
    low, high = PLAUSIBLE_DEPTH_M
    if low <= median <= high:
        return None
    too_large = median > high
    if usual and too_large and low <= median / usual <= high:
        return 1 / usual
    factors = [1 / unit if too_large else float(unit) for unit in UNITS_PER_METRE]
    low, high = EVERYDAY_DEPTH_M
    centre = np.sqrt(low * high)
    inside = (factor for factor in factors if low <= median * factor <= high)
    return next(inside, min(factors, key=lambda factor: abs(np.log(median * factor / centre))))


def depth_advice(median: float, usual: float | None = None) -> str:
    """What to do about depths of this median, such as ``divide by 1000 (millimetres)``.

    Empty where they can be metres.
    """
    factor = depth_factor(median, usual)
    if factor is None:
        return ""
    if factor > 1:
        return f"multiply by {factor:g}"
    unit = UNITS_PER_METRE.get(round(1 / factor))
    return f"divide by {1 / factor:g}" + (f" ({unit})" if unit else "")
