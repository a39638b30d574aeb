"""What measuring does to flow and depth: errors with the structure of a real estimator and sensor.

Flow like OpenCV's DIS: motion bleeds over silhouettes, fails block by block, lags behind large
motions. Depth: noise that grows with distance, a smooth bias, edges in the wrong place and holes.
"""

from __future__ import annotations

import cv2
import numpy as np

from hybridvo.options import Share, option_group
from hybridvo.synthetic.draws import Range, log_uniform, smooth_field


@option_group
class SensorOptions:
    """How strongly inputs are damaged; a range is drawn log-uniformly once per sample.

    Units and reasons stand in ``configs/data_diverse.yaml`` under ``degradation``.
    """

    exact_flow_probability: Share = 0.35
    exact_depth_probability: Share = 0.4
    flow_white_px: Range = (0.005, 0.15)
    flow_smooth_px: Range = (0.01, 0.4)
    flow_lag: Share = 0.08
    bleed_px: Range = (0.5, 5.0)
    block_share: Range = (0.002, 0.08)
    block_px: Range = (0.3, 8.0)
    textureless_probability: Share = 0.3
    hidden_px: Range = (0.2, 4.0)
    depth_relative: Range = (0.001, 0.03)
    depth_quadratic: Range = (0.0003, 0.006)
    depth_bias: Range = (0.001, 0.04)
    depth_bleed_px: Range = (0.3, 2.5)
    hole_share: Share = 0.3
    edge_hole_probability: Share = 0.3
    range_limit_probability: Share = 0.25


def noisy_flow(
    rng: np.random.Generator, flow: np.ndarray, noise_px: float, share: float, reach_px: float
) -> tuple[np.ndarray, np.ndarray]:
    """(H, W, 2) float32 flow with white noise and a share of gross errors, and where these are."""
    white = rng.standard_normal(flow.shape, dtype=np.float32)
    flow = flow.astype(np.float32) + np.float32(noise_px) * white
    bad = rng.random(flow.shape[:2], dtype=np.float32) < share
    flow[bad] += rng.uniform(-reach_px, reach_px, (int(bad.sum()), 2)).astype(np.float32)
    return flow, bad


def _look_up(
    image: np.ndarray, offset: np.ndarray, border: int = cv2.BORDER_REPLICATE
) -> np.ndarray:
    """Image at x + offset, nearest pixel."""
    height, width = image.shape[:2]
    u = offset[..., 0] + np.arange(width, dtype=np.float32)
    v = offset[..., 1] + np.arange(height, dtype=np.float32)[:, None]
    return cv2.remap(image, u, v, cv2.INTER_NEAREST, borderMode=border, borderValue=0.0)


def degrade_flow(
    rng: np.random.Generator, flow: np.ndarray, hidden: np.ndarray, options: SensorOptions
) -> np.ndarray:
    """(H, W, 2) float32 px, flow as DIS would have measured the true one.

    ``hidden`` (H, W) bool: points that are covered in the next frame or leave it.
    """
    o, size = options, flow.shape[:2]
    bleed = log_uniform(rng, o.bleed_px)
    wander = smooth_field(rng, size, 16, 2) * np.float32(bleed / 2)
    out = _look_up(flow, wander)
    side = 2 * int(rng.integers(0, 1 + max(1, round(bleed)))) + 1
    if side > 1:
        median = rng.random() < 0.5
        out = cv2.medianBlur(out, min(side, 5)) if median else cv2.blur(out, (side,) * 2)
    lag = np.float32(1.0) - np.float32(o.flow_lag * rng.random() ** 2) * np.abs(
        smooth_field(rng, size, 6)
    )
    out *= lag[..., None]
    if rng.random() < o.textureless_probability:
        field = smooth_field(rng, size, int(rng.integers(3, 8)))
        area = field > np.float32(rng.uniform(0.5, 1.6))
        spread = 2 * int(rng.integers(4, 17)) + 1
        guess = cv2.blur(out, (spread, spread)) * np.float32(rng.uniform(0.3, 1.0))
        np.copyto(out, guess, where=area[..., None])
    block = int(rng.integers(3, 9))
    rows, columns = (-(-side // block) for side in size)
    bad = rng.random((rows, columns), dtype=np.float32) < log_uniform(rng, o.block_share)
    if bad.any():
        offsets = np.zeros((rows, columns, 2), np.float32)
        offsets[bad] = log_uniform(rng, o.block_px) * rng.standard_normal((int(bad.sum()), 2))
        out += np.repeat(np.repeat(offsets, block, 0), block, 1)[: size[0], : size[1]]
    if hidden.any():
        around = cv2.blur(out, (9, 9))
        error = smooth_field(rng, size, 24, 2) * np.float32(log_uniform(rng, o.hidden_px))
        np.copyto(out, around + error, where=hidden[..., None])
    smooth = smooth_field(rng, size, int(rng.integers(4, 17)), 2)
    out += smooth * np.float32(log_uniform(rng, o.flow_smooth_px))
    white = rng.standard_normal(flow.shape, dtype=np.float32)
    out += white * np.float32(log_uniform(rng, o.flow_white_px))
    return out


def sample_at(depth: np.ndarray, offset: np.ndarray) -> np.ndarray:
    """(H, W) depth looked up at x + offset, nearest pixel; 0 outside."""
    return _look_up(depth, offset, cv2.BORDER_CONSTANT)


def depth_jump(depth: np.ndarray) -> np.ndarray:
    """(H, W) largest difference of depth among a pixel and its neighbours."""
    kernel = np.ones((3, 3), np.uint8)
    return cv2.dilate(depth, kernel) - cv2.erode(depth, kernel)


def degrade_depth(
    rng: np.random.Generator, depths: list[np.ndarray], options: SensorOptions
) -> list[np.ndarray]:
    """Depths (H, W) float32 in metres as one sensor would have measured them; 0 is invalid."""
    o = options
    quadratic = rng.random() < 0.5
    strength = log_uniform(rng, o.depth_quadratic if quadratic else o.depth_relative)
    bias = log_uniform(rng, o.depth_bias)
    bleed = log_uniform(rng, o.depth_bleed_px) if rng.random() < 0.6 else 0.0
    hole_share = o.hole_share * rng.random() ** 2 if rng.random() < 0.5 else 0.0
    edges = rng.random() < o.edge_hole_probability
    limit = np.inf
    if rng.random() < o.range_limit_probability:
        valid = depths[0][depths[0] > 0]
        if valid.size:
            limit = float(np.quantile(valid[::7], rng.uniform(0.5, 0.98)))
    size = depths[0].shape
    # Most of a sensor's bias stays from one frame to the next; its change is what misleads.
    common = smooth_field(rng, size, 4)
    out = []
    for depth in depths:
        wander = smooth_field(rng, size, 24, 2) * np.float32(bleed / 2)
        noisy = _look_up(depth, wander) if bleed else depth.copy()
        error = bias * (0.9 * common + 0.3 * smooth_field(rng, size, 4))
        white = rng.standard_normal(depth.shape, dtype=np.float32) * np.float32(strength)
        error += np.clip(white * noisy, -0.5, 0.5) if quadratic else white
        noisy *= np.clip(1.0 + error, 0.3, 3.0)
        lost = noisy > limit
        if hole_share:
            field = smooth_field(rng, size, int(rng.integers(4, 20)))
            lost |= field > np.quantile(field[::3, ::3], 1.0 - hole_share)
        if edges:
            lost |= depth_jump(depth) > 0.15 * depth
        noisy[lost] = 0.0
        out.append(noisy)
    return out
