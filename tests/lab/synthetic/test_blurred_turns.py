"""Real views blurred by a turn: their motion is known, and their blur is that of the turn."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from hybridvo.core.geometry import ego_flow
from hybridvo.core.types import Camera, Frame
from hybridvo.flow.providers import dis_flow
from hybridvo_lab.synthetic.blurred_turns import Recorded, draw_blurred_turn

SIZE = (240, 320)
CAMERA = Camera(300.0, 300.0, 159.5, 119.5, height=SIZE[0], width=SIZE[1])
NOTHING = np.zeros(SIZE, np.uint8)


@pytest.fixture(scope="module")
def recorded() -> Recorded:
    """A camera that stands before a wall with texture."""
    rng = np.random.default_rng(0)
    coarse = rng.integers(0, 256, (60, 80, 3)).astype(np.uint8)
    rgb = cv2.resize(coarse, SIZE[::-1], interpolation=cv2.INTER_CUBIC)
    frame = Frame(rgb, np.full(SIZE, 2.0, np.float32), CAMERA)
    return Recorded(frame, frame, np.eye(4), (NOTHING, NOTHING))


@pytest.mark.parametrize("seed", range(4))
def test_the_flow_of_the_images_is_that_of_the_motion(recorded, seed) -> None:
    drawn = draw_blurred_turn(np.random.default_rng(seed), recorded, dis_flow())
    pair = drawn.pair
    camera = pair.prev.camera
    true = ego_flow(pair.prev.depth, drawn.T_curr_prev, camera, camera)
    known = (drawn.depth > 0) & pair.flow_valid
    away = np.linalg.norm(pair.flow - true, axis=2)[known]
    assert known.mean() > 0.3 and np.median(away) < 0.5
    assert not drawn.moving.any()


def test_what_stands_before_the_scene_counts_as_moving(recorded) -> None:
    mask = NOTHING.copy()
    mask[80:160, 120:200] = 1
    some = recorded._replace(foreground=(mask, mask))
    drawn = draw_blurred_turn(np.random.default_rng(1), some, dis_flow())
    assert 0.05 < drawn.moving.mean() < 0.6
    assert (drawn.depth[drawn.moving] == 0).all()
