"""What measuring does to flow and depth: noise, gross errors, bias, holes and blurred edges."""

from __future__ import annotations

import cv2
import numpy as np

from hybridvo.synthetic.draws import log_uniform, smooth_field


def noisy_flow(
    rng: np.random.Generator,
    flow: np.ndarray,
    noise_px: float,
    share: float,
    reach_px: float,
) -> tuple[np.ndarray, np.ndarray]:
    """Add white noise and a share of gross errors to a flow; returns it and where these are."""
    white = rng.standard_normal(flow.shape, dtype=np.float32)
    flow = flow.astype(np.float32) + np.float32(noise_px) * white
    bad = rng.random(flow.shape[:2], dtype=np.float32) < share
    flow[bad] += rng.uniform(-reach_px, reach_px, (int(bad.sum()), 2)).astype(
        np.float32
    )
    return flow, bad


def sample_at(
    depth: np.ndarray, offset: np.ndarray, border: int = cv2.BORDER_CONSTANT
) -> np.ndarray:
    """Look a depth map (H, W) up at x + offset (H, W, 2), nearest pixel; 0 outside by default."""
    height, width = depth.shape
    u = offset[..., 0] + np.arange(width, dtype=np.float32)
    v = offset[..., 1] + np.arange(height, dtype=np.float32)[:, None]
    return cv2.remap(
        depth, u, v, cv2.INTER_NEAREST, borderMode=border, borderValue=0.0
    )


def depth_jump(depth: np.ndarray) -> np.ndarray:
    """Return the largest difference of depth between a pixel and its neighbours, (H, W)."""
    return cv2.morphologyEx(depth, cv2.MORPH_GRADIENT, np.ones((3, 3), np.uint8))


def degrade_depth(
    rng: np.random.Generator, depths: list[np.ndarray]
) -> list[np.ndarray]:
    """Return depth maps (H, W), metres, as one sensor would have measured them; 0 is invalid."""
    # relative noise: proportional to depth (per metre; Kinect: 0.0015 to 0.003), or constant
    quadratic = rng.random() < 0.5
    strength = log_uniform(rng, (0.0003, 0.006) if quadratic else (0.001, 0.03))
    bias = log_uniform(rng, (0.001, 0.04))
    bleed_px = log_uniform(rng, (0.3, 2.5)) if rng.random() < 0.6 else 0.0
    hole_share = 0.3 * rng.random() ** 2 if rng.random() < 0.5 else 0.0
    edges = rng.random() < 0.3
    limit = np.inf
    if rng.random() < 0.25:
        valid = depths[0][depths[0] > 0]
        if valid.size:
            limit = float(np.quantile(valid[::7], rng.uniform(0.5, 0.98)))
    size = depths[0].shape
    # most of a sensor's bias stays from one frame to the next; its change is what misleads
    common = smooth_field(rng, size, 4)
    out = []
    for depth in depths:
        wander = smooth_field(rng, size, 24, 2) * np.float32(bleed_px / 2)
        noisy = (
            sample_at(depth, wander, cv2.BORDER_REPLICATE)
            if bleed_px
            else depth.copy()
        )
        error = bias * (0.9 * common + 0.3 * smooth_field(rng, size, 4))
        white = rng.standard_normal(depth.shape, dtype=np.float32) * np.float32(
            strength
        )
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
