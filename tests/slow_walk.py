"""A rendered scene slowed down to video rate, with the noise of a depth sensor."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
from scipy.interpolate import CubicSpline
from scipy.spatial.transform import Rotation, RotationSpline

import hybridvo as hvo
from hybridvo.synthetic.scenes import make_scene

EVERY = 5  # frames for each of the scene's own steps
HEIGHT, WIDTH = 120, 160


def frames(
    kind: str, seed: int, count: int, stride: int = 1
) -> tuple[list[hvo.Frame], np.ndarray]:
    """Frames and their poses T_world_cam; every ``stride``-th of the slow ones."""
    length = count * stride
    keys = np.arange(length // EVERY + 2) * EVERY
    scene = make_scene(kind, seed, height=HEIGHT, width=WIDTH, frames=len(keys))
    times = np.arange(0, length, stride)
    poses = np.tile(np.eye(4), (len(times), 1, 1))
    turned = Rotation.from_matrix(scene.T_world_cam[:, :3, :3])
    poses[:, :3, :3] = RotationSpline(keys, turned)(times).as_matrix()
    poses[:, :3, 3] = CubicSpline(keys, scene.T_world_cam[:, :3, 3])(times)
    solids = []
    for solid in scene.solids:
        if np.ndim(solid.A_world_body) > 2:
            moved = CubicSpline(keys, solid.A_world_body)(times)
            solid = replace(solid, A_world_body=moved)
        solids.append(solid)
    slow = replace(scene, T_world_cam=poses, solids=tuple(solids))
    rng = np.random.default_rng(seed)
    return [sensed(slow, k, rng) for k in range(len(times))], poses


def sensed(scene, index: int, rng: np.random.Generator) -> hvo.Frame:
    """A frame with two grey levels of noise, and depth as of structured light."""
    seen = scene.render(index)
    grey = rng.normal(0, 2, seen.rgb.shape)
    rgb = np.clip(np.rint(seen.rgb + grey), 0, 255).astype(np.uint8)
    depth = seen.depth.astype(np.float64)
    field = cv2.GaussianBlur(rng.standard_normal(depth.shape), (0, 0), 1.5)
    depth = depth + 0.0015 * depth**2 * field / field.std()
    square = np.ones((3, 3), np.uint8)
    edges = cv2.morphologyEx(seen.depth, cv2.MORPH_GRADIENT, square)
    depth[edges > 0.1 * depth] = 0
    return hvo.Frame(
        rgb, depth.astype(np.float32), scene.camera, timestamp=index / 30
    )
