"""Depth that is one plane before a scene that is none, and real walls."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest

import hybridvo as hvo
from hybridvo.core.geometry import invert, se3_exp
from hybridvo.core.results import Reason
from hybridvo.judge.false_depth import exact_surface
from hybridvo_lab.synthetic.scenes import make_scene

CAMERA = hvo.Camera(250.0, 250.0, 159.5, 119.5, height=240, width=320)


def constant(depth: np.ndarray) -> np.ndarray:
    """Three metres everywhere."""
    return np.full_like(depth, 3.0)


def tilted(depth: np.ndarray) -> np.ndarray:
    """A plane that leans back."""
    v = np.arange(depth.shape[0], dtype=np.float32)[:, None] / depth.shape[0]
    return np.broadcast_to(1 / (0.2 + 0.25 * v), depth.shape).astype(np.float32)


def ramp(depth: np.ndarray) -> np.ndarray:
    """Linear in depth, from 2 to 4 metres."""
    v = np.arange(depth.shape[0], dtype=np.float32)[:, None] / depth.shape[0]
    return np.broadcast_to(2 + 2 * v, depth.shape).astype(np.float32)


def mostly_constant(depth: np.ndarray) -> np.ndarray:
    """Three metres but for every tenth pixel."""
    v, u = np.indices(depth.shape)
    return np.where((u + 7 * v) % 11 == 0, depth, 3.0).astype(np.float32)


@pytest.mark.slow
@pytest.mark.parametrize("wrong", [constant, tilted, ramp, mostly_constant])
@pytest.mark.parametrize("seed", [1, 2])
def test_false_depth_is_never_ok(wrong, seed: int) -> None:
    scene = make_scene("static", seed, height=240, width=320, frames=2)
    pair = [scene.render(i) for i in range(2)]
    assert hvo.estimate(*pair).ok
    false = [replace(frame, depth=wrong(frame.depth)) for frame in pair]
    found = hvo.estimate(*false)
    assert not found.ok
    if found.status.reason is Reason.FALSE_DEPTH:
        sigmas = np.sqrt(np.diag(found.covariance)[:3])
        assert np.all(sigmas >= np.abs(found.T_curr_prev[:3, 3]))
        assert found.probability < 0.5


def wall(T_world_cam: np.ndarray, inverse: np.ndarray) -> hvo.Frame:
    """A rendered frame before a textured plane: inverse @ point = 1 in the world."""
    rng = np.random.default_rng(3)
    texture = cv2.GaussianBlur(rng.uniform(0, 255, (512, 512)), (0, 0), 2)
    texture = cv2.normalize(texture, None, 0, 255, cv2.NORM_MINMAX).astype(np.uint8)
    v, u = np.indices(CAMERA.shape)
    x = (u - CAMERA.cx) / CAMERA.fx
    y = (v - CAMERA.cy) / CAMERA.fy
    rays = np.stack([x, y, np.ones_like(x)], axis=-1)
    turned = rays @ T_world_cam[:3, :3].T
    depth = (1 - inverse @ T_world_cam[:3, 3]) / (turned @ inverse)
    points = depth[..., None] * turned + T_world_cam[:3, 3]
    at = (100 * points[..., :2] + 256).astype(np.float32)
    grey = cv2.remap(
        texture,
        at[..., 0],
        at[..., 1],
        cv2.INTER_LINEAR,
        borderMode=cv2.BORDER_WRAP,
    )
    rgb = np.repeat(grey[..., None], 3, axis=2)
    return hvo.Frame(rgb, depth.astype(np.float32), CAMERA)


@pytest.mark.parametrize("inverse", [[0, 0, 0.4], [0.05, 0.15, 0.4]])
@pytest.mark.parametrize(
    "step",
    [
        [0.06, 0.0, 0.0, 0.0, 0.0, 0.0],
        [0.02, -0.03, 0.08, 0.01, -0.02, 0.02],
        [0.0, 0.0, 0.0, 0.02, 0.03, 0.0],
    ],
)
def test_a_rendered_wall_is_no_false_depth(inverse: list, step: list) -> None:
    before = wall(np.eye(4), np.array(inverse))
    now = wall(invert(se3_exp(np.array(step))), np.array(inverse))
    assert exact_surface(before.depth) is not None
    found = hvo.estimate(before, now)
    assert found.status.reason is not Reason.FALSE_DEPTH


def test_a_sensors_wall_is_not_even_asked() -> None:
    before = wall(np.eye(4), np.array([0.0, 0.0, 0.4]))
    noise = np.random.default_rng(0).normal(0, 0.005, before.depth.shape)
    assert exact_surface(before.depth * (1 + noise)) is None
    assert exact_surface(np.zeros((240, 320), np.float32)) is None
