"""Scenes of the training: steps of an escalator, rendered pairs and their ground truth."""

from __future__ import annotations

import cv2
import numpy as np

from hybridvo.core.geometry import make_transform
from hybridvo.core.types import Camera
from hybridvo_lab.synthetic import training_scenes
from hybridvo_lab.synthetic.bodies import moving_object, stairs
from hybridvo_lab.synthetic.paper_samples import camera_flow
from hybridvo_lab.synthetic.render import Scene
from hybridvo_lab.synthetic.training_scenes import render_pair, training_scene


def generator(seed: int) -> np.random.Generator:
    return np.random.default_rng([7, seed])


def test_stairs_move_as_one() -> None:
    rng = generator(1)
    place = make_transform(np.eye(3), np.array([0.0, 0.0, 2.5]))
    step = make_transform(np.eye(3), np.array([0.1, 0.0, 0.0]))
    draw = moving_object(rng, stairs(rng), np.stack([place, step @ place]))
    solids = tuple(draw(1, 1.0))
    camera = Camera(120.0, 120.0, 79.5, 59.5, height=120, width=160)
    scene = Scene(camera, np.stack([np.eye(4)] * 2), solids)
    pair = render_pair(scene)
    seen = np.isfinite(pair.flow).all(axis=2) & pair.moving
    assert seen.mean() > 0.02
    # 0.1 m to the right
    expected = 120.0 * 0.1 / pair.depth[0][seen]
    np.testing.assert_allclose(
        pair.flow[seen][:, 0], expected, rtol=1e-3, atol=1e-3
    )
    np.testing.assert_allclose(pair.flow[seen][:, 1], 0, atol=1e-3)


def test_a_rendered_pair_obeys_its_motion_where_nothing_moves() -> None:
    for seed in range(4):
        scene = training_scene(generator(seed), 60, 80, conveyor_fraction=0.5)
        pair = render_pair(scene)
        K = scene.camera.K
        own = camera_flow(K, pair.depth[0], pair.T_curr_prev).flow
        error = np.linalg.norm(pair.flow - own, axis=2)
        limit = training_scenes.MOVING_PX * 80 / 1024
        known = np.isfinite(error) & np.isfinite(pair.depth[0])
        static = known & ~pair.moving
        assert error[static].max() < limit + 1e-3
        if pair.moving.any():
            assert error[known & pair.moving].min() > limit - 1e-3
        assert [frame.depth for frame in pair.images] == [None, None]
        assert pair.images[0].rgb.shape == (60, 80, 3)
        blind = render_pair(scene, images=False)
        assert blind.images[0].rgb is None
        np.testing.assert_array_equal(blind.flow, pair.flow)


def test_rendered_images_show_the_flow() -> None:
    scene = training_scene(generator(3), 120, 160)
    pair = render_pair(scene)
    rows, columns = np.indices((120, 160), np.float32)
    where = (
        (columns + pair.flow[..., 0]).astype(np.float32),
        (rows + pair.flow[..., 1]).astype(np.float32),
    )
    there = cv2.remap(pair.images[1].rgb, *where, cv2.INTER_LINEAR).astype(float)
    inside = np.isfinite(pair.flow).all(axis=2) & (there.sum(axis=2) > 0)
    before = pair.images[0].rgb[inside].mean(axis=1)
    after = there[inside].mean(axis=1)
    assert np.corrcoef(before, after)[0, 1] > 0.6
