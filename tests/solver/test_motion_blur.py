"""Images of a long exposure: the camera moves on meanwhile, by up to the whole flow of a pair."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

import hybridvo as hvo
from hybridvo.core.geometry import ego_flow, invert, mean_flow, se3_exp, se3_log
from hybridvo_lab.synthetic.render import Scene
from hybridvo_lab.synthetic.scenes import make_scene
from hybridvo_lab.synthetic.slow_scenes import noisy_image
from tests.worlds import CHI2_3SIGMA

SIZE = (240, 320)
VIEWS = 8
"""Views whose mean is a blurred image: a point draws no gaps of more than 4 px."""


def exposed(
    scene: Scene, twist: np.ndarray, start: float, length: float
) -> hvo.Frame:
    """A frame whose exposure takes a part of the time of a motion, and depth of its middle.

    Args:
        scene: static; its first pose is that of the time 0.
        twist: (6,) motion in the time 1.
        start: the middle of the exposure.
        length: of the exposure; 0: the image is sharp.
    """
    times = start + length * ((np.arange(VIEWS) + 0.5) / VIEWS - 0.5)
    first = scene.T_world_cam[0]
    poses = [first @ invert(se3_exp(time * twist)) for time in (*times, start)]
    moved = replace(scene, T_world_cam=np.stack(poses))
    images = [moved.render(view).rgb.astype(np.float64) for view in range(VIEWS)]
    mean = np.rint(np.mean(images, axis=0)).astype(np.uint8)
    # of the same noise in every frame, whatever its blur
    rng = np.random.default_rng(int(10 * start))
    depth = moved.depth(VIEWS) * (1 + 0.002 * rng.standard_normal(SIZE))
    return hvo.Frame(
        noisy_image(mean, rng),
        depth.astype(np.float32),
        scene.camera,
        timestamp=start,
    )


@pytest.mark.slow
@pytest.mark.parametrize(
    ("flow_px", "lengths"), [(10, (1, 1)), (30, (1, 1)), (10, (0, 1))]
)
def test_a_blurred_pair_is_right_and_its_sigma_covers_it(flow_px, lengths):
    scene = make_scene("static", 703, height=SIZE[0], width=SIZE[1], frames=2)
    first = scene.render(0)
    T_scene = invert(scene.T_world_cam[1]) @ scene.T_world_cam[0]
    twist = se3_log(T_scene)
    # the mean flow grows nearly as the motion does
    for _ in range(3):
        twist *= flow_px / (SIZE[1] * mean_flow(first, se3_exp(twist)))
    frames = [
        exposed(scene, twist, time, length)
        for time, length in zip((0.0, 1.0), lengths, strict=True)
    ]
    T_true = se3_exp(twist)
    found = hvo.estimate(*frames)
    assert found.ok
    camera = scene.camera
    flow = ego_flow(first.depth, found.T_curr_prev, camera, camera)
    true = ego_flow(first.depth, T_true, camera, camera)
    # of 45 pairs the worst was off by 0.16 px
    assert np.nanmedian(np.linalg.norm(flow - true, axis=-1)) < 0.3
    error = se3_log(found.T_curr_prev @ invert(T_true))
    nees = error @ np.linalg.solve(found.covariance, error)
    # of 45 pairs 3 are beyond 3 sigma, so sigma is allowed to be too small by a half
    assert nees < 1.5**2 * CHI2_3SIGMA
