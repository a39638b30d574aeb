"""Scenes at video rate: the benchmark scenes slowed down to steps of one to
two centimetres, as a depth camera measures them.

Where objects move slowly too, each step differs little between them and the
static scene.
"""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
from scipy.interpolate import CubicSpline
from scipy.spatial.transform import Rotation, RotationSpline

from hybridvo_lab.synthetic.render import Scene
from hybridvo_lab.synthetic.scenes import make_scene
from hybridvo_lab.synthetic.sensors import depth_jump

SLOWDOWN = 5
"""Frames for each frame of the scene: its steps of 6 to 13 cm become 1 to 3 cm."""
GREY_NOISE = 2.0
"""Standard deviation of the image noise, grey levels."""
DEPTH_NOISE = 0.0015
"""Of structured light: standard deviation in metres over the square of the depth."""
NOISE_BLUR_PX = 1.5
"""Standard deviation of the blur that correlates the depth noise."""
EDGE_JUMP = 0.1
"""Relative difference of depth between neighbours at which
the sensor loses an edge."""


def slow_scene(kind: str, seed: int, frames: int, size: tuple[int, int]) -> Scene:
    """Make a scene whose camera and objects move SLOWDOWN times as slowly.

    Args:
        kind: family of the scene, such as ``"light"``.
        seed: seed of the scene.
        frames: number of slow frames.
        size: height and width of the images.
    """
    height, width = size
    keys = -(-frames // SLOWDOWN) + 1
    scene = make_scene(kind, seed, height=height, width=width, frames=keys)
    return slowed_down(scene, SLOWDOWN, frames)


def slowed_down(scene: Scene, factor: int, frames: int) -> Scene:
    """Put the frames of a scene ``factor`` frames apart, with splines in between."""
    key_times = factor * np.arange(scene.frames)
    times = np.arange(frames)
    rotations = Rotation.from_matrix(scene.T_world_cam[:, :3, :3])
    positions = CubicSpline(key_times, scene.T_world_cam[:, :3, 3])

    T_world_cam = np.tile(np.eye(4), (frames, 1, 1))
    T_world_cam[:, :3, :3] = RotationSpline(key_times, rotations)(times).as_matrix()
    T_world_cam[:, :3, 3] = positions(times)

    solids = []
    for solid in scene.solids:
        is_moving = solid.A_world_body.ndim == 3
        if is_moving:
            spline = CubicSpline(key_times, solid.A_world_body)
            solid = replace(solid, A_world_body=spline(times))
        solids.append(solid)
    return replace(scene, T_world_cam=T_world_cam, solids=tuple(solids))


def noisy_image(
    rgb: np.ndarray, rng: np.random.Generator, std: float = GREY_NOISE
) -> np.ndarray:
    """Add white noise to an image (H, W, 3) uint8; ``std`` in grey levels."""
    noisy = rgb + rng.normal(0.0, std, rgb.shape)
    return np.clip(np.rint(noisy), 0, 255).astype(np.uint8)


def structured_light(
    depth: np.ndarray,
    rng: np.random.Generator,
    strength: float = DEPTH_NOISE,
    *,
    edges_by_measured: bool = False,
) -> np.ndarray:
    """Measure a depth map as structured light does: smooth noise, no depth at edges.

    Args:
        depth: (H, W) exact depth, metres.
        rng: source of the noise.
        strength: standard deviation of the noise over the square of the depth, 1/m.
        edges_by_measured: whether the jump at an edge is relative to the measured
            depth, and not to the exact one.

    Returns:
        (H, W) float32 metres, 0 where an edge is lost.
    """
    exact = depth.astype(np.float64)
    white = rng.standard_normal(depth.shape)
    field = cv2.GaussianBlur(white, (0, 0), NOISE_BLUR_PX)
    measured = exact + strength * exact**2 * field / field.std()

    reference = measured if edges_by_measured else exact
    measured[depth_jump(depth) > EDGE_JUMP * reference] = 0.0
    return measured.astype(np.float32)
