"""Synthetic pairs of the benchmark: exact geometry, known noise,
moving objects, no images.

A pair depends on its scenario and seed alone. Seeds 0 to 999 are for development,
those from 1000 on for published figures.
"""

from __future__ import annotations

import zlib
from dataclasses import dataclass, replace
from typing import NamedTuple, TypedDict

import cv2
import numpy as np

from hybridvo.core.geometry import make_transform
from hybridvo.core.types import Camera, Frame, FramePair
from hybridvo_lab.synthetic.draws import (
    log_uniform,
    random_direction,
    rotation_about,
    rotation_by,
    smooth_field,
)
from hybridvo_lab.synthetic.paper_samples import rays, rigid_flow, splat
from hybridvo_lab.synthetic.sensors import noisy_flow

REFERENCE_WIDTH = 1024
"""Width to which the scenarios' numbers in px refer."""
REFERENCE_FOCAL_PX = 1120.0
"""Focal length at this width."""
OUTLIER_PX = 60.0
"""Largest gross error of a flow component."""
PLANES = 12
"""Slanted planes of a structured scene."""
OBJECT_DRAWS = 50
"""Draws after which objects may be larger than the limit."""
FRAME_INTERVAL_S = 0.1
"""Time between the two frames."""


@dataclass(frozen=True)
class Scenario:
    """The conditions of one scenario."""

    moving: float = 0.3  # fraction of the pixels on objects that move by themselves
    objects: int = 5
    # standard deviation of each component, independent per pixel
    flow_noise_px: float = 0.5
    depth_noise: float = 0.02  # standard deviation of log depth
    # fraction of its variance that is correlated in space
    depth_smooth: float = 0.5
    outliers: float = 0.05  # fraction of the pixels whose flow has a gross error
    rotation_deg: float = 3.0  # largest angle
    translation_m: float = 0.3  # largest length
    min_translation_m: float = 0.0
    scene: str = "structured"  # 1-30 m; plane: one oblique plane; far: 60-200 m
    # 1/m, the factor c of a further depth error of the standard deviation c z^2
    depth_quadratic: float = 0.0
    # from the left eye of a depth sensor to its right eye or projector: what only
    # one of them sees has no depth; 0: everything has depth
    baseline_m: float = 0.0
    # step to which the sensor rounds disparities, at the reference width; 0: exact
    disparity_step_px: float = 0.0


class PairTruth(TypedDict):
    """The ground truth of a pair, on the grid of the previous frame."""

    T_curr_prev: np.ndarray
    """(4, 4) camera motion."""
    depth_true: np.ndarray
    """(H, W) float32, metres."""
    flow_true: np.ndarray
    """(H, W, 2) float32 px, that of the objects included."""
    moving: np.ndarray
    """(H, W) bool, pixels of moving objects."""
    object: np.ndarray
    """(H, W) uint8, number of the object, 0 for the static scene."""
    outlier: np.ndarray
    """(H, W) bool, pixels with a gross error of the flow."""


class _Objects(NamedTuple):
    """The moving objects of a pair."""

    owner: np.ndarray  # (H, W) uint8, 0 for the static scene
    motions: list[np.ndarray]  # (4, 4) of object 1 and on, camera motion included


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
) -> tuple[FramePair, PairTruth]:
    """Draw a pair with known noise, and its ground truth.

    Args:
        scenario: a name of :data:`SCENARIOS`, or other conditions.
        seed: with the name it determines the pair.
        height: rows of the images.
        width: columns of the images.

    Returns:
        The pair, whose current depth is NaN where the previous frame
        saw nothing; and the ground truth.

    >>> pair, truth = make_pair("moving30", 0, 54, 128)
    >>> pair.flow.shape, round(float(truth["moving"].mean()), 2)
    ((54, 128, 2), 0.3)
    """
    name = scenario if isinstance(scenario, str) else "custom"
    conditions = SCENARIOS[scenario] if isinstance(scenario, str) else scenario
    rng = np.random.default_rng([zlib.crc32(name.encode()), int(seed)])
    focal = REFERENCE_FOCAL_PX * width / REFERENCE_WIDTH
    camera = Camera(
        focal, focal, (width - 1) / 2, (height - 1) / 2, height=height, width=width
    )
    T = _draw_motion(rng, conditions)

    # geometry
    rho = _draw_surfaces(rng, conditions, (height, width))
    ray = rays(camera.K, rho.shape)
    objects = _add_objects(rng, conditions, rho, ray, T)
    flow, depth_ratio = rigid_flow(camera.K, rho, T, ray)
    for number, motion in enumerate(objects.motions, start=1):
        mine = objects.owner == number
        own = rigid_flow(camera.K, rho[mine], motion, ray[:, mine])
        flow[mine] = own.flow
        depth_ratio[mine] = own.depth_ratio
    depth_prev = _to_depth(rho)
    depth_curr = _to_depth(splat(flow, rho / depth_ratio))

    # measurement
    noisy = noisy_flow(
        rng, flow, conditions.flow_noise_px, conditions.outliers, OUTLIER_PX
    )
    measured_prev = _measure_depth(rng, conditions, depth_prev, focal)
    measured_curr = _measure_depth(rng, conditions, depth_curr, focal)
    pair = FramePair(
        Frame(None, measured_prev, camera, 0.0, 0),
        Frame(None, measured_curr, camera, FRAME_INTERVAL_S, 1),
        noisy.flow,
        flow_source="synthetic",
        depth_source="synthetic",
    )
    truth: PairTruth = {
        "T_curr_prev": T,
        "depth_true": depth_prev,
        "flow_true": flow.astype(np.float32),
        "moving": objects.owner > 0,
        "object": objects.owner,
        "outlier": noisy.outlier,
    }
    return pair, truth


def make_model_pair(seed: int) -> tuple[FramePair, PairTruth]:
    """Draw a static pair of 160x320 with the noise that the
    refinement assumes, and its ground truth.
    """
    conditions = Scenario(moving=0.0, outliers=0.0, depth_smooth=0.0)
    pair, truth = make_pair(conditions, seed, 160, 320)
    return replace(pair, curr=replace(pair.curr, depth=None)), truth


def _draw_motion(rng: np.random.Generator, scenario: Scenario) -> np.ndarray:
    """T_curr_prev (4, 4)."""
    angle_deg = rng.uniform(0, scenario.rotation_deg)
    length = rng.uniform(scenario.min_translation_m, scenario.translation_m)
    R = rotation_by(rng, angle_deg)
    return make_transform(R, length * random_direction(rng))


def _to_depth(rho: np.ndarray) -> np.ndarray:
    """Depth (H, W) float32 of inverse depth; NaN where that is 0."""
    return (1.0 / np.where(rho > 0, rho, np.nan)).astype(np.float32)


def _draw_surfaces(
    rng: np.random.Generator, scenario: Scenario, size: tuple[int, int]
) -> np.ndarray:
    """Inverse depth (H, W), 1/m: patches of slanted planes with
    smooth bumps at 1 to 30 m.
    """
    u, v = _unit_grid(size)
    if scenario.scene == "plane":
        slope = rng.uniform(-0.5, 0.5, 2)
        return (1 + slope[0] * u + slope[1] * v) / rng.uniform(3, 12)
    centre = rng.uniform(-0.5, 0.5, (PLANES, 2))
    slope = rng.uniform(-0.8, 0.8, (PLANES, 2))
    nearness = np.exp(-rng.uniform(np.log(1.5), np.log(28.0), PLANES))

    # every pixel belongs to the plane whose centre is nearest
    distance = [(u[:, ::4] - a) ** 2 + (v[::4] - b) ** 2 for a, b in centre]
    plane = np.argmin(distance, axis=0).astype(np.uint8)
    plane = cv2.resize(plane, size[::-1], interpolation=cv2.INTER_NEAREST)
    off_u = u - centre[plane, 0]
    off_v = v - centre[plane, 1]
    tilt = 1 + slope[plane, 0] * off_u + slope[plane, 1] * off_v
    rho = nearness[plane] * tilt
    rho /= np.exp(0.08 * smooth_field(rng, size, max(size[0] // 48, 2)))
    if scenario.scene == "far":
        return np.clip(rho / 7, 1 / 200, 1 / 60)
    return np.clip(rho, 1 / 30, 1.0)


def _unit_grid(size: tuple[int, int]) -> tuple[np.ndarray, np.ndarray]:
    """(1, W) and (H, 1) coordinates from -0.5 to 0.5."""
    height, width = size
    u = np.linspace(-0.5, 0.5, width)[None]
    v = np.linspace(-0.5, 0.5, height)[:, None]
    return u, v


def _add_objects(
    rng: np.random.Generator,
    scenario: Scenario,
    rho: np.ndarray,
    ray: np.ndarray,
    T: np.ndarray,
) -> _Objects:
    """Add moving objects to the inverse depth ``rho`` (H, W), in place.

    ``ray`` (2, H, W) are the pixels' directions, ``T`` (4, 4) is the camera motion.
    """
    motions: list[np.ndarray] = []
    if scenario.moving <= 0:
        return _Objects(np.zeros(rho.shape, np.uint8), motions)
    owner = _place_objects(rng, scenario, rho.shape)
    u, v = _unit_grid(rho.shape)
    for number in range(1, scenario.objects + 1):
        mine = owner == number
        slope = rng.uniform(-0.5, 0.5, 2)
        tilt = 1 + slope[0] * u + slope[1] * v
        surface = tilt / log_uniform(rng, (2.0, 12.0))
        rho[mine] = surface[mine]

        centre = np.array([*ray[:, mine].mean(axis=1), 1.0]) / rho[mine].mean()
        heading = rng.uniform(0, 2 * np.pi)
        ahead = rng.uniform(-0.5, 0.5)
        along = np.array([np.cos(heading), np.sin(heading), ahead])
        step_px = rng.uniform(8, 70)
        t = step_px / REFERENCE_FOCAL_PX * centre[2] * along
        R = rotation_by(rng, rng.uniform(0, 5))
        motions.append(T @ rotation_about(R, centre, t))
    return _Objects(owner, motions)


def _place_objects(
    rng: np.random.Generator, scenario: Scenario, size: tuple[int, int]
) -> np.ndarray:
    """Number of the object at each pixel, (H, W) uint8; 0: the static scene."""
    height, width = size
    u, v = _unit_grid(size)
    aspect = width / height
    # no object may be as large as the static scene, or the pair has no right
    # answer; the scenario ``one60`` is about that
    largest = np.inf if scenario.objects == 1 else 0.8 * (1 - scenario.moving)
    for _ in range(OBJECT_DRAWS):
        distance = []
        for _ in range(scenario.objects):
            x = rng.uniform(-0.42, 0.42) * aspect
            y = rng.uniform(-0.35, 0.35)
            stretch = np.exp(rng.uniform(-0.4, 0.4))
            across = ((u * aspect - x) * stretch) ** 2
            distance.append(across + ((v - y) / stretch) ** 2)
        nearest = np.min(distance, axis=0)
        inside = nearest < np.quantile(nearest, scenario.moving)
        number = np.argmin(distance, axis=0) + 1
        owner = np.where(inside, number, 0).astype(np.uint8)
        if np.bincount(owner[inside]).max() <= largest * inside.size:
            break
    return owner


def _measure_depth(
    rng: np.random.Generator, scenario: Scenario, depth: np.ndarray, focal: float
) -> np.ndarray:
    """(H, W) float32 depth as it is measured, NaN where it is not."""
    white = rng.standard_normal(depth.shape, dtype=np.float32)
    # the factor makes the variance of this field one
    smooth = 1.27 * smooth_field(rng, depth.shape, depth.shape[0] // 24)
    error = np.sqrt(1 - scenario.depth_smooth) * white
    error += np.sqrt(scenario.depth_smooth) * smooth
    measured = depth * np.exp(scenario.depth_noise * error)

    error = scenario.depth_quadratic * rng.standard_normal(depth.shape) * depth
    measured *= np.clip(1 + error, 0.1, None)
    if scenario.baseline_m:
        _look_with_two_eyes(scenario, depth, measured, focal)
    return np.ascontiguousarray(measured, np.float32)


def _look_with_two_eyes(
    scenario: Scenario, depth: np.ndarray, measured: np.ndarray, focal: float
) -> None:
    """Remove what only one eye sees from ``measured`` (H,
    W), and round it, in place.

    ``depth`` (H, W) is the true depth, metres, ``focal`` the focal length, px.
    """
    width = depth.shape[1]
    disparity = focal * scenario.baseline_m / depth
    column = np.arange(width) - disparity
    column_other = np.where(np.isnan(disparity), np.inf, column)
    # a pixel to the right that the other eye sees no farther right stands in front
    cover = np.minimum.accumulate(column_other[:, ::-1], axis=1)[:, ::-1]
    is_hidden = column_other > cover
    measured[is_hidden | (column_other < 0)] = np.nan
    if scenario.disparity_step_px:
        step = scenario.disparity_step_px * width / REFERENCE_WIDTH
        steps = np.rint(focal * scenario.baseline_m / measured / step)
        steps = np.maximum(steps, 1.0)
        measured[:] = focal * scenario.baseline_m / (steps * step)
