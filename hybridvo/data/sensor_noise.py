"""Depth noise of usual sensors as the variance of log depth, for ``Frame.depth_variance``.

Only the shape over the picture matters: the refinement estimates the scale from each pair.
"""

from __future__ import annotations

import numpy as np

from hybridvo.errors import InputError

KINECT_COEFFICIENT = 1.425e-3
"""sigma_z / z^2 of the first Kinect, 1/m (Khoshelham and Oude Elberink, Sensors 2012)."""


def _positive(name: str, value: float) -> float:
    if not (np.isfinite(value) and value > 0):
        raise InputError(f"{name}: expected a positive number, got {value!r}.")
    return float(value)


def structured_light_variance(
    depth: np.ndarray, coefficient: float = KINECT_COEFFICIENT
) -> np.ndarray:
    """(H, W) float32 variance of log depth where sigma_z = ``coefficient`` z^2 (depth in metres).

    Raises:
        InputError: a coefficient that is not positive.
    """
    return np.square(_positive("coefficient", coefficient) * depth).astype(np.float32)


def stereo_variance(
    depth: np.ndarray, focal_px: float, baseline_m: float, disparity_sigma_px: float = 0.5
) -> np.ndarray:
    """(H, W) float32 variance of log depth of a stereo pair: (sigma_d z / (f b))^2.

    Raises:
        InputError: a focal length, baseline or disparity noise that is not positive.
    """
    reach = _positive("focal_px", focal_px) * _positive("baseline_m", baseline_m)
    sigma = _positive("disparity_sigma_px", disparity_sigma_px)
    return np.square(sigma * depth / reach).astype(np.float32)


def ratio_variance(depth: np.ndarray, ratio: float = 0.01) -> np.ndarray:
    """(H, W) float32 variance of log depth where sigma_z is a constant share of z.

    Raises:
        InputError: a ratio that is not positive.
    """
    return np.full(np.shape(depth), _positive("ratio", ratio) ** 2, np.float32)
