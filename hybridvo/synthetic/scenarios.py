"""Synthetic pairs of the solver benchmark: exact geometry, known noise, moving objects, no images.

A pair depends on (cell, seed) alone. Seeds 0-999 are for development, 1000 and up for published
figures.
"""

from __future__ import annotations

import zlib
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np

from hybridvo.errors import InputError
from hybridvo.geometry import backproject, ego_flow, make_transform, pixel_grid, project, se3_exp
from hybridvo.synthetic.draws import about, direction, turn
from hybridvo.types import Camera, Frame, FramePair


@dataclass(frozen=True)
class Scenario:
    """One row of conditions.

    Args:
        moving: share of the pixels on ``objects`` that move by themselves.
        flow_noise_px: standard deviation of each flow component, independent per pixel.
        depth_noise: standard deviation of log depth; half of its variance is correlated in space.
        outliers: share of the pixels whose flow has a gross error of up to 60 px.
        rotation_deg, translation_m: largest angle and length.
        scene: ``structured`` (1-30 m), ``plane`` (one oblique plane) or ``far`` (60-200 m).
        depth_quadratic: c of a further error of depth with the standard deviation c z^2, 1/m.
        baseline_m: of a depth sensor of two eyes, or of an eye and a projector, the second one on
            the right: what only one of them sees has no depth. 0: all has. At a width of 1024:
        disparity_step_px: of the disparities that it states; 0: exact.
    """

    moving: float = 0.3
    objects: int = 5
    flow_noise_px: float = 0.5
    depth_noise: float = 0.02
    outliers: float = 0.05
    rotation_deg: float = 3.0
    translation_m: float = 0.3
    min_translation_m: float = 0.0
    scene: str = "structured"
    depth_quadratic: float = 0.0
    baseline_m: float = 0.0
    disparity_step_px: float = 0.0


MAIN_SCENARIOS: dict[str, Scenario] = {
    "moving00": Scenario(moving=0.0),
    "moving30": Scenario(moving=0.3),
    "moving50": Scenario(moving=0.5),
    "moving70": Scenario(moving=0.7),
    "exact_depth": Scenario(depth_noise=0.0),
    "noisy": Scenario(flow_noise_px=1.0, depth_noise=0.05),
    "low_noise": Scenario(flow_noise_px=0.1, depth_noise=0.005),
    "outliers20": Scenario(outliers=0.2),
}
"""The eight main and noise cells over which methods are compared."""

DEGENERATE_SCENARIOS: dict[str, Scenario] = {
    "zero_motion": Scenario(moving=0.0, rotation_deg=0.0, translation_m=0.0),
    "pure_rotation": Scenario(moving=0.0, translation_m=0.0),
    "tiny_1cm": Scenario(moving=0.0, translation_m=0.01, min_translation_m=0.01),
    "plane": Scenario(moving=0.0, scene="plane"),
    "far": Scenario(moving=0.0, scene="far"),
}
"""Motions and scenes in which some direction of the motion is weak."""

SENSOR_SCENARIOS: dict[str, Scenario] = {
    "structured_light": Scenario(depth_noise=0.0, depth_quadratic=0.0015, baseline_m=0.075),
    "stereo": Scenario(depth_noise=0.0, disparity_step_px=0.125, baseline_m=0.12),
    "shadows": Scenario(baseline_m=0.25),
}
"""Depth as Kinect's projector and stereo cameras measure it; wide borders and strips without."""

SCENARIOS: dict[str, Scenario] = {
    **MAIN_SCENARIOS,
    **DEGENERATE_SCENARIOS,
    **SENSOR_SCENARIOS,
    "one60": Scenario(moving=0.6, objects=1),
}
"""Every cell by name."""


def make_pair(
    cell: str | Scenario, seed: int, height: int = 436, width: int = 1024
) -> tuple[FramePair, dict[str, Any]]:
    """A pair of a row of :data:`SCENARIOS`, or of conditions of one's own, and its truth.

    The focal length scales with the width: 1120 px at 1024.

    Returns:
        The pair (the current depth is NaN where the previous frame saw nothing) and the truth:
        ``T_curr_prev`` (4, 4), ``depth_true`` (H, W) float32 metres on the previous grid,
        ``moving`` (H, W) bool, ``object`` (H, W) uint8 label (0 is the world), ``outlier`` (H, W)
        bool, ``flow_true`` (H, W, 2) float32 of the surface, objects included.

    Raises:
        InputError: unknown cell, negative seed, or an image below 16 pixels.
    """
    name = cell if isinstance(cell, str) else "custom"
    if isinstance(cell, str):
        if cell not in SCENARIOS:
            raise InputError(f"make_pair: unknown cell {cell!r}; known: {', '.join(SCENARIOS)}.")
        cell = SCENARIOS[cell]
    if seed < 0 or min(height, width) < 16:
        raise InputError(
            f"make_pair: expected seed >= 0 and at least 16x16 pixels, got seed {seed} and "
            f"{height}x{width}."
        )
    rng = np.random.default_rng([zlib.crc32(name.encode()), int(seed)])
    focal = 1120.0 * width / 1024
    camera = Camera(focal, focal, (width - 1) / 2, (height - 1) / 2, height, width)
    angle_deg = rng.uniform(0, cell.rotation_deg)
    length = rng.uniform(cell.min_translation_m, cell.translation_m)
    T = make_transform(turn(rng, angle_deg), length * direction(rng))
    depth = _scene(rng, cell, height, width)
    label = _objects(rng, cell, depth)
    moved = _moved(rng, T, backproject(depth, camera), label)
    target = project(moved, camera)
    flow_true = (target - pixel_grid(height, width)).astype(np.float32)
    flow, outlier = _measured(rng, cell, flow_true)
    depth_curr = _splat(target, moved[..., 2])
    depths = [_sensed(rng, cell, d, focal) for d in (depth, depth_curr)]
    truth = {
        "T_curr_prev": T,
        "depth_true": depth,
        "moving": label > 0,
        "object": label,
        "outlier": outlier,
        "flow_true": flow_true,
    }
    return _pair(depths, camera, flow), truth


def _pair(depths: Sequence[np.ndarray | None], camera: Camera, flow: np.ndarray) -> FramePair:
    """A pair of frames without images, a tenth of a second apart."""
    prev, curr = (Frame(None, d, camera, 0.1 * i, i) for i, d in enumerate(depths))
    return FramePair(prev, curr, flow, flow_source="synthetic", depth_source="synthetic")


def make_model_pair(seed: int) -> tuple[FramePair, dict[str, Any]]:
    """A static pair of 160x320 whose noise is exactly what the refinement assumes, and its truth.

    Smooth depth of 3-13 m with one step; noise of half a pixel and of 2 % of depth, independent per
    pixel; no outliers, no second depth. Under it the normalised error of a right covariance is
    chi-square with six degrees of freedom. The truth is that of :func:`make_pair` in float64.
    """
    rng = np.random.default_rng([zlib.crc32(b"model"), int(seed)])
    camera = Camera(350, 340, 159, 82, 160, 320)
    u, v = np.arange(320), np.arange(160)[:, None]
    depth = 6 + 3 * np.sin(u / 40 + rng.uniform(0, 6)) * np.cos(v / 30 + rng.uniform(0, 6))
    depth = depth + 4.0 * (u > rng.uniform(80, 240))
    limit = np.array([0.3] * 3 + [0.03] * 3)
    T = se3_exp(rng.uniform(-limit, limit))
    flow_true = ego_flow(depth, T, camera, camera)
    flow = flow_true + 0.5 * rng.standard_normal(flow_true.shape)
    measured = depth * np.exp(0.02 * rng.standard_normal(depth.shape))
    pair = _pair([measured.astype(np.float32), None], camera, flow.astype(np.float32))
    return pair, {"T_curr_prev": T, "depth_true": depth, "flow_true": flow_true}


def _moved(
    rng: np.random.Generator, T: np.ndarray, points: np.ndarray, label: np.ndarray
) -> np.ndarray:
    """(H, W, 3) points after the camera's motion and those of the objects."""
    moved = points @ T[:3, :3].T + T[:3, 3]
    for k in range(1, int(label.max()) + 1):
        mine = points[label == k]
        if not len(mine):
            continue
        centre = mine.mean(axis=0)
        heading = rng.uniform(0, 2 * np.pi)
        metres = rng.uniform(8, 70) / 1120 * centre[2]
        t = metres * np.array([np.cos(heading), np.sin(heading), rng.uniform(-0.5, 0.5)])
        own = T @ about(turn(rng, rng.uniform(0, 5)), centre, t)
        moved[label == k] = mine @ own[:3, :3].T + own[:3, 3]
    return moved


def _measured(
    rng: np.random.Generator, cell: Scenario, flow: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """(H, W, 2) float32 flow with noise and gross errors, and (H, W) bool where these are."""
    flow = flow.copy()
    if cell.flow_noise_px > 0:
        noise = rng.standard_normal(flow.shape, dtype=np.float32)
        flow += np.float32(cell.flow_noise_px) * noise
    outlier = np.zeros(flow.shape[:2], dtype=bool)
    if cell.outliers > 0:
        outlier = rng.random(flow.shape[:2], dtype=np.float32) < cell.outliers
        flow[outlier] += rng.uniform(-60, 60, (int(outlier.sum()), 2)).astype(np.float32)
    return flow, outlier


def _smooth(rng: np.random.Generator, height: int, width: int, size: int) -> np.ndarray:
    """(H, W) float32 smooth noise of about unit variance with a correlation length of ``size``."""
    rows, columns = height // size + 3, width // size + 3
    coarse = rng.standard_normal((rows, columns), dtype=np.float32)
    scale = cv2.resize(coarse, (columns * size, rows * size), interpolation=cv2.INTER_CUBIC)
    field = scale[size : size + height, size : size + width]
    return field * np.float32(1.27)  # cubic interpolation keeps 0.62 of the variance


def _scene(rng: np.random.Generator, cell: Scenario, height: int, width: int) -> np.ndarray:
    """(H, W) float32 depth: layers of slanted planes with smooth bumps, 1-30 m."""
    x = np.linspace(-0.5, 0.5, width, dtype=np.float32)
    y = np.linspace(-0.5, 0.5, height, dtype=np.float32)[:, None]
    if cell.scene == "plane":
        slope = rng.uniform(-0.5, 0.5, 2)
        return np.float32(rng.uniform(3, 12)) / (
            1 + np.float32(slope[0]) * x + slope[1] * y
        ).astype(np.float32)
    layers = 12
    centre = rng.uniform(-0.5, 0.5, (layers, 2)).astype(np.float32)
    inverse = np.exp(-rng.uniform(np.log(1.5), np.log(28.0), layers)).astype(np.float32)
    slope = rng.uniform(-0.8, 0.8, (layers, 2)).astype(np.float32)
    distance = np.stack([(x[::4] - c[0]) ** 2 + (y[::4] - c[1]) ** 2 for c in centre])
    owner = np.argmin(distance, axis=0).astype(np.uint8)
    owner = cv2.resize(owner, (width, height), interpolation=cv2.INTER_NEAREST)
    across, down = (slope[owner, i] * (p - centre[owner, i]) for i, p in enumerate((x, y)))
    plane = inverse[owner] * (1 + across + down)
    bumps = np.exp(np.float32(0.06) * _smooth(rng, height, width, 48))
    if cell.scene == "far":
        return np.clip(7 * bumps / plane, 60.0, 200.0)
    return np.clip(bumps / plane, 1.0, 30.0)


def _objects(rng: np.random.Generator, cell: Scenario, depth: np.ndarray) -> np.ndarray:
    """(H, W) uint8 object label, 0 = static; writes the objects' surfaces into ``depth``."""
    height, width = depth.shape
    if cell.moving <= 0:
        return np.zeros((height, width), dtype=np.uint8)
    aspect = width / height
    x = np.linspace(-0.5, 0.5, width, dtype=np.float32)[::2] * aspect
    y = np.linspace(-0.5, 0.5, height, dtype=np.float32)[::2, None]
    # one object must not rival the scene, or the pair has no right answer; ``one60`` is about that
    largest = np.inf if cell.objects == 1 else 0.8 * (1 - cell.moving)
    for _ in range(50):
        distance = []
        for _ in range(cell.objects):
            cx, cy = rng.uniform(-0.42, 0.42) * float(x[-1] - x[0]), rng.uniform(-0.35, 0.35)
            stretch = np.exp(rng.uniform(-0.4, 0.4))
            distance.append(((x - cx) * stretch) ** 2 + ((y - cy) / stretch) ** 2)
        stacked = np.stack(distance).astype(np.float32)
        nearest = stacked.min(axis=0)
        inside = nearest < np.quantile(nearest, cell.moving)
        coarse = np.where(inside, stacked.argmin(axis=0) + 1, 0).astype(np.uint8)
        if np.bincount(coarse.ravel())[1:].max(initial=0) <= largest * coarse.size:
            break
    label = np.repeat(np.repeat(coarse, 2, axis=0), 2, axis=1)[:height, :width]
    for k in range(1, cell.objects + 1):
        rows, columns = np.nonzero(label == k)
        z = np.float32(np.exp(rng.uniform(np.log(2.0), np.log(12.0))))
        slope = rng.uniform(-0.5, 0.5, 2).astype(np.float32)
        depth[rows, columns] = z / (
            1 + slope[0] * (columns / width - 0.5) + slope[1] * (rows / height - 0.5)
        )
    return np.ascontiguousarray(label)


def _sensed(
    rng: np.random.Generator, cell: Scenario, depth: np.ndarray, focal: float
) -> np.ndarray:
    """(H, W) float32 depth as it is measured, NaN where it is not."""
    height, width = depth.shape
    out = depth.astype(np.float32)
    if cell.depth_noise:
        noise = rng.standard_normal(depth.shape, dtype=np.float32)
        noise += _smooth(rng, height, width, 24)
        noise *= np.float32(cell.depth_noise * np.sqrt(0.5))
        out = (depth * np.exp(noise)).astype(np.float32)
    if cell.depth_quadratic:
        error = rng.standard_normal(depth.shape) * cell.depth_quadratic * depth
        out *= np.clip(1 + error, 0.1, None).astype(np.float32)
    if cell.baseline_m:
        disparity = focal * cell.baseline_m / depth
        seen_at = np.where(np.isnan(disparity), np.inf, np.arange(width) - disparity)
        # what is farther to the right and yet seen at the same place there stands in front
        cover = np.minimum.accumulate(seen_at[:, ::-1], axis=1)[:, ::-1]
        out[(seen_at > cover) | (seen_at < 0)] = np.nan
        if cell.disparity_step_px:
            step = cell.disparity_step_px * width / 1024
            steps = np.maximum(np.rint(focal * cell.baseline_m / out / step), 1.0)
            out = (focal * cell.baseline_m / (steps * step)).astype(np.float32)
    return np.ascontiguousarray(out)


def _splat(target: np.ndarray, z: np.ndarray) -> np.ndarray:
    """(H, W) float32 depth on the current grid: nearest surface that lands on each pixel."""
    height, width = z.shape
    place = np.rint(target)
    value = z.copy()
    for axis in (0, 1):
        slope = np.gradient(z, axis=1 - axis)
        # a depth edge is no slope
        slope[np.abs(slope) > 0.02 * z] = 0.0
        value += slope * (place - target)[..., axis]
    inside = ((place >= 0) & (place < (width, height))).all(axis=-1) & (z > 0)
    index = (place[inside] @ (1, width)).astype(np.intp)
    depth = np.full(height * width, np.inf, dtype=np.float32)
    np.minimum.at(depth, index, value[inside].astype(np.float32))
    depth[np.isinf(depth)] = np.nan
    return depth.reshape(height, width)
