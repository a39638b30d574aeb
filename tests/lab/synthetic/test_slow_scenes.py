"""Scenes at video rate pass through the poses of the benchmark scenes."""

from __future__ import annotations

import numpy as np

from hybridvo_lab.synthetic.scenes import make_scene
from hybridvo_lab.synthetic.slow_scenes import (
    slow_scene,
    slowed_down,
    structured_light,
)


def test_a_slowed_scene_passes_through_the_poses_of_the_scene():
    scene = make_scene("light", 0, height=48, width=64, frames=4)
    slow = slowed_down(scene, 5, 16)
    assert slow.frames == 16
    np.testing.assert_allclose(slow.T_world_cam[::5], scene.T_world_cam, atol=1e-12)
    for solid, slowed in zip(scene.solids, slow.solids, strict=True):
        if solid.A_world_body.ndim == 2:
            assert slowed is solid
        else:
            keys = slowed.A_world_body[::5]
            np.testing.assert_allclose(keys, solid.A_world_body, atol=1e-9)


def test_steps_are_of_one_to_three_centimetres():
    scene = slow_scene("static", 1, 20, (240, 320))
    steps = np.linalg.norm(np.diff(scene.T_world_cam[:, :3, 3], axis=0), axis=1)
    assert scene.frames == 20
    assert 0.005 < np.median(steps) < 0.03


def test_an_edge_is_lost_by_the_exact_or_by_the_measured_depth():
    # a jump of 0.1 m beside 1 m: the noise of the measured depth decides
    depth = np.full((60, 80), 1.0, np.float32)
    depth[:, 40:] = 1.1
    exact = structured_light(depth, np.random.default_rng(0), 0.01)
    by_measured = structured_light(
        depth, np.random.default_rng(0), 0.01, edges_by_measured=True
    )
    near_edge = depth[:, 39]
    assert (np.float32(1.1) - near_edge > 0.1 * near_edge).all()
    assert (exact[:, 39] == 0).all() and (exact[:, 40] > 0).all()
    lost = by_measured[:, 39] == 0
    assert 0.2 < lost.mean() < 0.8
