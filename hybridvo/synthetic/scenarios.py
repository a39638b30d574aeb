"""Synthetic pairs of the benchmark: exact geometry, known noise, moving objects, no images.

A pair depends on its scenario and seed alone. Seeds 0 to 999 are for development, those from 1000
on for published figures.
"""

from __future__ import annotations

import zlib
from dataclasses import dataclass, replace
from typing import Any

import cv2
import numpy as np

from hybridvo.geometry import make_transform
from hybridvo.synthetic.draws import (
    about,
    direction,
    log_uniform,
    smooth_field,
    turn,
)
from hybridvo.synthetic.layered import rays, rigid_flow, splat
from hybridvo.synthetic.sensors import noisy_flow
from hybridvo.types import Camera, Frame, FramePair


@dataclass(frozen=True)
class Scenario:
    """The conditions of one scenario."""

    moving: float = 0.3  # share of the pixels on objects that move by themselves
    objects: int = 5
    # standard deviation of each component, independent per pixel
    flow_noise_px: float = 0.5
    depth_noise: float = 0.02  # standard deviation of log depth
    depth_smooth: float = 0.5  # share of its variance that is correlated in space
    # share of the pixels whose flow has a gross error of up to 60 px
    outliers: float = 0.05
    rotation_deg: float = 3.0  # largest angle
    translation_m: float = 0.3  # largest length
    min_translation_m: float = 0.0
    scene: str = "structured"  # 1-30 m; plane: one oblique plane; far: 60-200 m
    # 1/m, c of a further error of the standard deviation c z^2
    depth_quadratic: float = 0.0
    # from the left eye of a depth sensor to its right eye or projector: what only one of them sees
    # has no depth; 0: everything has depth
    baseline_m: float = 0.0
    # step to which the sensor rounds disparities, at a width of 1024 px; 0: exact
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
"""The eight scenarios over which methods are compared."""

DEGENERATE_SCENARIOS: dict[str, Scenario] = {
    "zero_motion": Scenario(moving=0.0, rotation_deg=0.0, translation_m=0.0),
    "pure_rotation": Scenario(moving=0.0, translation_m=0.0),
    "tiny_1cm": Scenario(moving=0.0, translation_m=0.01, min_translation_m=0.01),
    "plane": Scenario(moving=0.0, scene="plane"),
    "far": Scenario(moving=0.0, scene="far"),
}
"""Scenarios in which some direction of the motion is only weakly determined."""

SCENARIOS: dict[str, Scenario] = {
    **MAIN_SCENARIOS,
    **DEGENERATE_SCENARIOS,
    # depth as Kinect's projector and stereo cameras measure it
    "structured_light": Scenario(
        depth_noise=0.0, depth_quadratic=0.0015, baseline_m=0.075
    ),
    "stereo": Scenario(depth_noise=0.0, disparity_step_px=0.125, baseline_m=0.12),
    "shadows": Scenario(baseline_m=0.25),
    "one60": Scenario(moving=0.6, objects=1),
}
"""Every scenario by name."""


def make_pair(
    scenario: str | Scenario, seed: int, height: int = 436, width: int = 1024
) -> tuple[FramePair, dict[str, Any]]:
    """Draw a pair of one of :data:`SCENARIOS`, or of other conditions, and its truth.

    The current depth is NaN where the previous frame saw nothing. The truth holds ``T_curr_prev``;
    ``depth_true`` and ``flow_true`` (with the objects) on the previous grid; ``moving`` and
    ``outlier``, (H, W) bool; and ``object``, (H, W) uint8, which is 0 for the static scene.
    """
    name = scenario if isinstance(scenario, str) else "custom"
    scenario = SCENARIOS[scenario] if isinstance(scenario, str) else scenario
    rng = np.random.default_rng([zlib.crc32(name.encode()), int(seed)])
    focal = 1120.0 * width / 1024
    camera = Camera(focal, focal, (width - 1) / 2, (height - 1) / 2, height, width)
    angle_deg = rng.uniform(0, scenario.rotation_deg)
    length = rng.uniform(scenario.min_translation_m, scenario.translation_m)
    T = make_transform(turn(rng, angle_deg), length * direction(rng))
    rho = _surfaces(rng, scenario, (height, width))
    ray = rays(camera.K, rho.shape)
    owner, motions = _add_objects(rng, scenario, rho, ray, T)
    flow, ratio = rigid_flow(camera.K, rho, T, ray)
    for number, motion in enumerate(motions, start=1):
        mine = owner == number
        flow[mine], ratio[mine] = rigid_flow(
            camera.K, rho[mine], motion, ray[:, mine]
        )
    seen = splat(flow, rho / ratio)
    depths = [
        (1.0 / np.where(r > 0, r, np.nan)).astype(np.float32) for r in (rho, seen)
    ]
    measured, outlier = noisy_flow(
        rng, flow, scenario.flow_noise_px, scenario.outliers, 60.0
    )
    sensed = [_sensed(rng, scenario, depth, focal) for depth in depths]
    prev, curr = (
        Frame(None, depth, camera, 0.1 * i, i) for i, depth in enumerate(sensed)
    )
    pair = FramePair(
        prev, curr, measured, flow_source="synthetic", depth_source="synthetic"
    )
    return pair, {
        "T_curr_prev": T,
        "depth_true": depths[0],
        "moving": owner > 0,
        "object": owner,
        "outlier": outlier,
        "flow_true": flow.astype(np.float32),
    }


def make_model_pair(seed: int) -> tuple[FramePair, dict[str, Any]]:
    """Draw a static pair of 160x320 with the noise that the refinement assumes, and its truth."""
    pair, truth = make_pair(
        Scenario(moving=0.0, outliers=0.0, depth_smooth=0.0), seed, 160, 320
    )
    return replace(pair, curr=replace(pair.curr, depth=None)), truth


def _surfaces(
    rng: np.random.Generator, scenario: Scenario, size: tuple[int, int]
) -> np.ndarray:
    """Inverse depth (H, W), 1/m: patches of slanted planes with smooth bumps at 1 to 30 m."""
    u, v = _unit_grid(size)
    if scenario.scene == "plane":
        slope = rng.uniform(-0.5, 0.5, 2)
        return (1 + slope[0] * u + slope[1] * v) / rng.uniform(3, 12)
    count = 12
    centre = rng.uniform(-0.5, 0.5, (count, 2))
    slope = rng.uniform(-0.8, 0.8, (count, 2))
    near = np.exp(-rng.uniform(np.log(1.5), np.log(28.0), count))
    owner = np.argmin(
        [(u[:, ::4] - a) ** 2 + (v[::4] - b) ** 2 for a, b in centre], axis=0
    )
    owner = cv2.resize(
        owner.astype(np.uint8), size[::-1], interpolation=cv2.INTER_NEAREST
    )
    (a, b), (du, dv) = centre[owner].T, slope[owner].T
    plane = near[owner] * (1 + du.T * (u - a.T) + dv.T * (v - b.T))
    plane /= np.exp(0.08 * smooth_field(rng, size, max(size[0] // 48, 2)))
    if scenario.scene == "far":
        return np.clip(plane / 7, 1 / 200, 1 / 60)
    return np.clip(plane, 1 / 30, 1.0)


def _unit_grid(size: tuple[int, int]) -> tuple[np.ndarray, np.ndarray]:
    """(1, W) and (H, 1) coordinates from -0.5 to 0.5."""
    return np.linspace(-0.5, 0.5, size[1])[None], np.linspace(-0.5, 0.5, size[0])[
        :, None
    ]


def _add_objects(
    rng: np.random.Generator,
    scenario: Scenario,
    rho: np.ndarray,
    ray: np.ndarray,
    T: np.ndarray,
) -> tuple[np.ndarray, list[np.ndarray]]:
    """Lay objects over the scene ``rho``; returns the object of each pixel, and their motions."""
    height, width = size = rho.shape
    owner = np.zeros(size, np.uint8)
    motions = list[np.ndarray]()
    if scenario.moving <= 0:
        return owner, motions
    (u, v), aspect = _unit_grid(size), width / height
    # no object may be as large as the static scene, or the pair has no right answer; the scenario
    # ``one60`` is about that
    largest = np.inf if scenario.objects == 1 else 0.8 * (1 - scenario.moving)
    for _ in range(50):
        distance = []
        for _ in range(scenario.objects):
            x = rng.uniform(-0.42, 0.42) * aspect
            y = rng.uniform(-0.35, 0.35)
            stretch = np.exp(rng.uniform(-0.4, 0.4))
            distance.append(
                ((u * aspect - x) * stretch) ** 2 + ((v - y) / stretch) ** 2
            )
        nearest = np.min(distance, axis=0)
        inside = nearest < np.quantile(nearest, scenario.moving)
        owner = np.where(inside, np.argmin(distance, axis=0) + 1, 0).astype(
            np.uint8
        )
        if np.bincount(owner[inside]).max() <= largest * inside.size:
            break
    for number in range(1, scenario.objects + 1):
        mine = owner == number
        slope = rng.uniform(-0.5, 0.5, 2)
        surface = (1 + slope[0] * u + slope[1] * v) / log_uniform(rng, (2.0, 12.0))
        rho[mine] = surface[mine]
        centre = np.array([*ray[:, mine].mean(axis=1), 1.0]) / rho[mine].mean()
        heading = rng.uniform(0, 2 * np.pi)
        towards = np.array(
            [np.cos(heading), np.sin(heading), rng.uniform(-0.5, 0.5)]
        )
        t = rng.uniform(8, 70) / 1120 * centre[2] * towards
        motions.append(T @ about(turn(rng, rng.uniform(0, 5)), centre, t))
    return owner, motions


def _sensed(
    rng: np.random.Generator, scenario: Scenario, depth: np.ndarray, focal: float
) -> np.ndarray:
    """(H, W) float32 depth as it is measured, NaN where it is not."""
    height, width = depth.shape
    error = np.sqrt(1 - scenario.depth_smooth) * rng.standard_normal(
        depth.shape, dtype=np.float32
    )
    smooth = 1.27 * smooth_field(rng, depth.shape, height // 24)  # of unit variance
    error += np.sqrt(scenario.depth_smooth) * smooth
    out = depth * np.exp(scenario.depth_noise * error)
    error = scenario.depth_quadratic * rng.standard_normal(depth.shape) * depth
    out *= np.clip(1 + error, 0.1, None)
    if scenario.baseline_m:
        disparity = focal * scenario.baseline_m / depth
        seen_at = np.where(
            np.isnan(disparity), np.inf, np.arange(width) - disparity
        )
        # what is farther to the right and yet seen at the same place there stands in front
        cover = np.minimum.accumulate(seen_at[:, ::-1], axis=1)[:, ::-1]
        out[(seen_at > cover) | (seen_at < 0)] = np.nan
        if scenario.disparity_step_px:
            step = scenario.disparity_step_px * width / 1024
            steps = np.maximum(
                np.rint(focal * scenario.baseline_m / out / step), 1.0
            )
            out = focal * scenario.baseline_m / (steps * step)
    return np.ascontiguousarray(out, np.float32)
