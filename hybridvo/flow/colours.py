"""Flow in colours."""

from __future__ import annotations

import cv2
import numpy as np

LONG_FLOW_BRIGHTNESS = 0.75
"""Brightness of flow that is longer than the longest of the scale."""
HIGH_PERCENTILE = 99
"""Percentile of the values that has the full colour."""
SMALLEST_VALUE = 1e-12
"""Value of the full colour where none is known, or all are zero."""


def flow_colours(flow: np.ndarray, longest: float | None = None) -> np.ndarray:
    """Draw a flow in colours: hue is direction, saturation is length.

    Args:
        flow: (H, W, 2) pixels.
        longest: Length of full colour, pixels; by default the 99th percentile. Longer flow is
            darker, unknown flow is black.

    Returns:
        (H, W, 3) uint8 RGB.
    """
    is_known = np.isfinite(flow).all(axis=2)
    known_flow = np.where(is_known[..., None], flow, 0.0)
    u = known_flow[..., 0]
    v = known_flow[..., 1]
    length = np.hypot(u, v) / (longest or longest_flow(flow))
    brightness = np.where(length > 1, LONG_FLOW_BRIGHTNESS, 1.0)
    degrees = np.degrees(np.arctan2(v, u)) % 360
    saturation = np.minimum(length, 1)
    value = np.where(is_known, brightness, 0.0)
    hsv = np.stack([degrees, saturation, value], axis=-1).astype(np.float32)
    rgb = cv2.cvtColor(hsv, cv2.COLOR_HSV2RGB)
    return (255 * rgb + 0.5).astype(np.uint8)


def longest_flow(flow: np.ndarray) -> float:
    """Return the 99th percentile of the lengths of a flow (H, W, 2), pixels."""
    return high_value(np.hypot(flow[..., 0], flow[..., 1]))


def high_value(values: np.ndarray) -> float:
    """Return the 99th percentile of the known values; almost zero where none is known."""
    return positive_percentile(values[np.isfinite(values)], HIGH_PERCENTILE)


def positive_percentile(values: np.ndarray, percentile: float) -> float:
    """Return a percentile that is positive, whatever the values are."""
    if not values.size:
        return SMALLEST_VALUE
    return max(float(np.percentile(values, percentile)), SMALLEST_VALUE)
