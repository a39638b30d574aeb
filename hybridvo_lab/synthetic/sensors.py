"""What measuring does to flow and depth: noise, gross errors, bias,
holes and blurred edges.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import cv2
import numpy as np

from hybridvo_lab.synthetic.draws import log_uniform, smooth_field

MIN_DEPTH_FACTOR = 0.3
MAX_DEPTH_FACTOR = 3.0
"""Limits of the factor by which noise and bias change a depth."""
EDGE_JUMP = 0.15
"""Relative difference of depth between neighbours from which a
sensor may lose an edge."""


class NoisyFlow(NamedTuple):
    """A flow with noise, and where its errors are gross."""

    flow: np.ndarray  # (H, W, 2) float32 px
    outlier: np.ndarray  # (H, W) bool


def noisy_flow(
    rng: np.random.Generator,
    flow: np.ndarray,
    noise_px: float,
    outlier_fraction: float,
    outlier_px: float,
) -> NoisyFlow:
    """Add white noise and gross errors to a flow.

    Args:
        rng: the source of randomness.
        flow: (H, W, 2) true flow, px.
        noise_px: standard deviation of each component.
        outlier_fraction: fraction of the pixels with a gross error.
        outlier_px: largest gross error of a component.
    """
    white = rng.standard_normal(flow.shape, dtype=np.float32)
    noisy = flow.astype(np.float32) + np.float32(noise_px) * white
    outlier = rng.random(flow.shape[:2], dtype=np.float32) < outlier_fraction
    errors = rng.uniform(-outlier_px, outlier_px, (int(outlier.sum()), 2))
    noisy[outlier] += errors.astype(np.float32)
    return NoisyFlow(noisy, outlier)


def sample_at(
    depth: np.ndarray, offset: np.ndarray, border: int = cv2.BORDER_CONSTANT
) -> np.ndarray:
    """Sample a depth map (H, W) at x + offset (H, W, 2), nearest pixel.

    0 outside by default.
    """
    height, width = depth.shape
    u = offset[..., 0] + np.arange(width, dtype=np.float32)
    v = offset[..., 1] + np.arange(height, dtype=np.float32)[:, None]
    return cv2.remap(
        depth, u, v, cv2.INTER_NEAREST, borderMode=border, borderValue=0.0
    )


def depth_jump(depth: np.ndarray) -> np.ndarray:
    """Return the largest difference of depth between a pixel
    and its neighbours, (H, W).
    """
    return cv2.morphologyEx(depth, cv2.MORPH_GRADIENT, np.ones((3, 3), np.uint8))


@dataclass(frozen=True)
class _DepthSensor:
    """The properties of one random depth sensor."""

    # the noise grows with the square of depth (Kinect: 0.0015 to 0.003 per metre),
    # or with depth
    is_quadratic: bool
    noise: float  # per metre where it is quadratic, else relative
    bias: float  # relative, smooth over the image
    bleed_px: float  # displacement of edges
    hole_fraction: float
    loses_edges: bool
    max_depth: float  # metres


def _draw_sensor(rng: np.random.Generator, depth: np.ndarray) -> _DepthSensor:
    """Draw a sensor whose range suits a depth map (H, W)."""
    is_quadratic = rng.random() < 0.5
    noise = log_uniform(rng, (0.0003, 0.006) if is_quadratic else (0.001, 0.03))
    bias = log_uniform(rng, (0.001, 0.04))
    bleed_px = log_uniform(rng, (0.3, 2.5)) if rng.random() < 0.6 else 0.0
    hole_fraction = 0.3 * rng.random() ** 2 if rng.random() < 0.5 else 0.0
    loses_edges = rng.random() < 0.3
    max_depth = np.inf
    if rng.random() < 0.25:
        valid = depth[depth > 0]
        if valid.size:
            quantile = rng.uniform(0.5, 0.98)
            max_depth = float(np.quantile(valid[::7], quantile))
    return _DepthSensor(
        is_quadratic, noise, bias, bleed_px, hole_fraction, loses_edges, max_depth
    )


def degrade_depth(
    rng: np.random.Generator, depths: list[np.ndarray]
) -> list[np.ndarray]:
    """Return depth maps (H, W), metres, as one sensor would have measured them.

    0 is invalid.
    """
    sensor = _draw_sensor(rng, depths[0])
    # most of a sensor's bias stays from one frame to the next; its change misleads
    # a method
    common_bias = smooth_field(rng, depths[0].shape, 4)
    return [_measure(rng, sensor, depth, common_bias) for depth in depths]


def _measure(
    rng: np.random.Generator,
    sensor: _DepthSensor,
    depth: np.ndarray,
    common_bias: np.ndarray,
) -> np.ndarray:
    """Return the depth map (H, W), metres, that a sensor measures of a true one."""
    size = depth.shape
    wander = smooth_field(rng, size, 24, 2) * np.float32(sensor.bleed_px / 2)
    if sensor.bleed_px:
        measured = sample_at(depth, wander, cv2.BORDER_REPLICATE)
    else:
        measured = depth.copy()

    own_bias = smooth_field(rng, size, 4)
    error = sensor.bias * (0.9 * common_bias + 0.3 * own_bias)
    white = rng.standard_normal(size, dtype=np.float32) * np.float32(sensor.noise)
    if sensor.is_quadratic:
        error += np.clip(white * measured, -0.5, 0.5)
    else:
        error += white
    measured *= np.clip(1.0 + error, MIN_DEPTH_FACTOR, MAX_DEPTH_FACTOR)

    lost = measured > sensor.max_depth
    if sensor.hole_fraction:
        field = smooth_field(rng, size, int(rng.integers(4, 20)))
        lost |= field > np.quantile(field[::3, ::3], 1.0 - sensor.hole_fraction)
    if sensor.loses_edges:
        lost |= depth_jump(depth) > EDGE_JUMP * depth
    measured[lost] = 0.0
    return measured
