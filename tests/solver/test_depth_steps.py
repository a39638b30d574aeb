"""Depth of another scale on the way (F22)."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from hybridvo.core.geometry import ego_flow, se3_exp
from hybridvo.core.types import Camera, Frame, FramePair
from hybridvo.solver.depths import compare_depths

K = Camera(90, 95, 63.5, 47.5, height=96, width=128)
T = se3_exp(np.array([0.02, -0.03, 0.4, 0.01, -0.02, 0.03]))


def plane(camera: Camera, T_cam_world: np.ndarray) -> np.ndarray:
    """Depth of the plane z = 4 + 0.3 x of the world, exact at every pixel."""
    normal, distance = T_cam_world[:3, :3] @ np.array([-0.3, 0.0, 1.0]), 4.0
    v, u = np.mgrid[: camera.height, : camera.width].astype(float)
    rays = np.stack(
        [(u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy, np.ones_like(u)],
        -1,
    )
    return (distance + normal @ T_cam_world[:3, 3]) / (rays @ normal)


@pytest.fixture
def pair() -> tuple[Frame, Frame, np.ndarray]:
    prev, curr = plane(K, np.eye(4)), plane(K, T)
    return (
        Frame(None, prev, K),
        Frame(None, curr, K, index=1),
        ego_flow(prev, T, K, K),
    )


EVERYWHERE = np.ones(K.shape)


def test_exact_depth_has_the_ratio_one(pair) -> None:
    # half a pixel to the nearest of a slope of 0.2 % a pixel; the median of both signs
    found = compare_depths(FramePair(*pair), T, EVERYWHERE)
    assert found.ratio == pytest.approx(1.0, abs=5e-4)
    # T moves the points away by 0.4 m, and they are 4 m away
    found = compare_depths(FramePair(*pair), np.eye(4), EVERYWHERE)
    assert found.ratio == pytest.approx(1.1, abs=0.03)


@pytest.mark.parametrize("scale", [5.0, 1.3, 0.2, 1e-3])
def test_another_scale_is_its_ratio_in_spite_of_holes(pair, scale: float) -> None:
    prev, curr, flow = pair
    depth = scale * curr.depth
    depth[::3] = np.nan
    mask, followers = np.ones(K.shape, bool), EVERYWHERE.copy()
    mask[:, :30] = False
    depth[:, :30] = 77.0
    followers[:20] = 0.0
    flow[:20] = np.nan
    found = compare_depths(
        FramePair(prev, replace(curr, depth=depth, mask=mask), flow), T, followers
    )
    assert found.ratio == pytest.approx(scale, rel=2e-3) and not found.status.ok
