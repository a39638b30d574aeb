"""Scenes and pairs of the golden figures that need no data, made on the spot."""

from __future__ import annotations

import functools
from typing import Any, NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

SIZE = (180, 240)
"""Height and width of what is rendered: larger images take more time and say the same."""
MADE_SIZE = (218, 512)
"""Of pairs without images."""
PAIRS_AT = (0, 4)
"""Frames of a scene from which pairs are taken."""
SCENES = {
    "heavy_rigid": (900, 901, 902),
    "heavy_deforming": (900, 901, 902),
    "heavy_two": (900, 901, 902),
    "heavy_ten": (900, 901, 902),
    "light": (900, 901, 902),
    "static": (900, 901),
}
"""Kind of a scene -> seeds, of those for development."""
WALK_FRAMES = 30

PRIOR_STD = {"true": (0.01, 0.003), "before": (0.03, 0.01), "wrong": (0.01, 0.003)}
"""Kind of a prior -> its standard deviations, m and rad."""
WRONG_PRIOR_M = np.array([0.3, -0.1, 0.2])
WRONG_PRIOR_RAD = np.array([0.05, 0.08, -0.03])
"""By how much the wrong prior is off: thirty of its standard deviations."""


class Known(NamedTuple):
    """Two frames and what is true of them."""

    pair: Any
    """The frames with their true flow, which covers moving objects as well."""
    T_curr_prev: np.ndarray
    depth: np.ndarray
    T_before: np.ndarray | None = None
    """Motion of the pair before, where there is one."""


@functools.cache
def scene_pairs(kind: str) -> tuple[Known, ...]:
    """Return pairs of rendered scenes of a kind."""
    found = []
    for seed in SCENES[kind]:
        scene = made_scene(kind, seed, max(PAIRS_AT) + 2, SIZE)
        found += [scene_pair(scene, index) for index in PAIRS_AT]
    return tuple(found)


def made_scene(kind: str, seed: int, frames: int, size: tuple[int, int]) -> Any:
    """Return a rendered scene."""
    from hybridvo_lab.synthetic.scenes import make_scene

    height, width = size
    return make_scene(kind, seed, height=height, width=width, frames=frames)


def scene_pair(scene: Any, index: int) -> Known:
    """Return a frame of a scene and the next, with their true flow."""
    from hybridvo import FramePair

    prev = scene.render(index)
    curr = scene.render(index + 1)
    flow = scene.flow(index)[0]
    pair = FramePair(prev, curr, flow, flow_source="file", depth_source="true")
    before = motion(scene.T_world_cam, index - 1, index) if index else None
    T = motion(scene.T_world_cam, index, index + 1)
    return Known(pair, T, prev.depth, before)


def motion(T_world_cam: np.ndarray, prev: int, curr: int) -> np.ndarray:
    """Return the true T_curr_prev between two frames of a path."""
    return np.asarray(np.linalg.inv(T_world_cam[curr]) @ T_world_cam[prev])


class Walk(NamedTuple):
    """A rendered walk at video rate."""

    frames: tuple[Any, ...]
    """As a sensor gives them: noisy images, depth of structured light."""
    exact: tuple[Any, ...]
    """As they were rendered."""
    T_world_cam: np.ndarray


@functools.cache
def walk(kind: str, seed: int, size: tuple[int, int] = SIZE) -> Walk:
    """Return a scene slowed down, so that its objects move by less than the noise a step."""
    from hybridvo import Frame
    from hybridvo_lab.synthetic.slow_scenes import (
        noisy_image,
        slow_scene,
        structured_light,
    )

    scene = slow_scene(kind, seed, WALK_FRAMES, size)
    rng = np.random.default_rng(seed)
    exact = tuple(scene.render(index) for index in range(WALK_FRAMES))
    sensed = []
    for index, frame in enumerate(exact):
        rgb = noisy_image(frame.rgb, rng)
        depth = structured_light(frame.depth, rng)
        sensed.append(Frame(rgb, depth, scene.camera, index / 30.0, index))
    return Walk(tuple(sensed), exact, scene.T_world_cam)


@functools.cache
def made_pair(scenario: str, seed: int) -> Known:
    """Return a pair without images: known noise, moving objects, gross errors of the flow."""
    from hybridvo_lab.synthetic.noise_scenarios import make_pair

    pair, truth = make_pair(scenario, seed, *MADE_SIZE)
    return Known(pair, truth["T_curr_prev"], truth["depth_true"])


@functools.cache
def still_pair(
    seed: int,
    flow_noise_px: float,
    depth_noise: float = 0.0,
    size: tuple[int, int] = MADE_SIZE,
) -> Known:
    """Return a made pair in which nothing but the camera moves, without gross errors."""
    from hybridvo_lab.synthetic.noise_scenarios import Scenario, make_pair

    conditions = Scenario(
        moving=0.0,
        outliers=0.0,
        flow_noise_px=flow_noise_px,
        depth_noise=depth_noise,
        depth_smooth=0.0,
    )
    pair, truth = make_pair(conditions, seed, *size)
    return Known(pair, truth["T_curr_prev"], truth["depth_true"])


@functools.cache
def model_pair(seed: int) -> Known:
    """Return a static pair whose noise is what the refinement assumes."""
    from hybridvo_lab.synthetic.noise_scenarios import make_model_pair

    pair, truth = make_model_pair(seed)
    depth = truth["depth_true"].astype(np.float32)
    return Known(pair, truth["T_curr_prev"], depth)


def prior_of(known: Known, kind: str) -> Any:
    """Return a prior: the truth, the motion before, or one that is far off."""
    from hybridvo import MotionPrior

    std_m, std_rad = PRIOR_STD[kind]
    covariance = np.diag([std_m**2] * 3 + [std_rad**2] * 3)
    T = known.T_before if kind == "before" else known.T_curr_prev.copy()
    assert T is not None
    if kind == "wrong":
        T[:3, 3] += WRONG_PRIOR_M
        T[:3, :3] = Rotation.from_rotvec(WRONG_PRIOR_RAD).as_matrix() @ T[:3, :3]
    return MotionPrior(T, covariance)
