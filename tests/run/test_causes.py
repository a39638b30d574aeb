"""The likely cause of a motion that is not sure, from what its frames show."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest

from hybridvo.core.geometry import se3_exp
from hybridvo.core.results import Reason, RelativePose, Status, Step
from hybridvo.core.types import Frame
from hybridvo.run.commands.diagnosis.causes import CAUSES, depth_delay, likely_cause
from tests import worlds

SIZE = (240, 320)


def frames() -> tuple[Frame, Frame]:
    rng = np.random.default_rng(3)
    camera = worlds.camera(SIZE)
    made = []
    for index in range(2):
        # blocks of ten pixels, with sharp edges
        blocks = rng.integers(0, 256, (24, 32, 3), dtype=np.uint8)
        rgb = np.kron(blocks, np.ones((10, 10, 1), np.uint8))
        depth = rng.uniform(1, 4, SIZE).astype(np.float32)
        made.append(Frame(rgb, depth, camera, 0.1 * index, index))
    return made[0], made[1]


PREV, CURR = frames()
TURN = se3_exp(np.array([0, 0, 0, 0, 0.03, 0]))  # 0.03 rad in 0.1 s
UNSURE = Status.degraded(Reason.AMBIGUOUS_MOTION, "another one")


def step(status: Status = UNSURE) -> Step:
    return Step(1, 0.1, np.eye(4), RelativePose(TURN, status=status), 0)


def changed(**parts: object) -> Frame:
    return replace(CURR, **parts)


BLURRED = cv2.GaussianBlur(CURR.rgb, (0, 0), 3)
HOLED = np.where(np.arange(SIZE[1]) < 4, CURR.depth, 0).astype(np.float32)


@pytest.mark.parametrize(
    ("curr", "cause"),
    [
        (CURR, ""),
        (changed(rgb=PREV.rgb.copy()), "repeated_frame"),
        (changed(depth=PREV.depth.copy()), "repeated_frame"),
        (changed(depth=HOLED), "little_depth"),
        (changed(rgb=np.full_like(CURR.rgb, 90)), "little_texture"),
        (changed(rgb=BLURRED), "blur"),
        (changed(rgb=None), ""),
        (changed(depth=None), ""),
    ],
)
def test_what_is_unusual_is_named(curr: Frame, cause: str) -> None:
    assert likely_cause(step(), PREV, curr) == cause
    assert cause in ("", *CAUSES)


def test_nothing_is_said_of_motions_that_are_sure() -> None:
    assert likely_cause(step(Status()), PREV, changed(rgb=BLURRED)) == ""
    assert likely_cause(step(), None, changed(rgb=BLURRED)) == ""


def test_the_unit_is_the_cause_where_it_is_wrong() -> None:
    wrong = Status.degraded(Reason.DEPTH_UNIT, "the median depth is 2000")
    assert likely_cause(step(wrong), PREV, changed(rgb=BLURRED)) == "depth_unit"


def test_clocks_count_where_the_camera_turns() -> None:
    # 0.3 rad/s, 320 px: 19 ms are 1.8 px, 25 ms are 2.4 px
    assert likely_cause(step(), PREV, CURR, 0.019) == ""
    assert likely_cause(step(), PREV, CURR, -0.025) == "clocks"
    still = replace(step(), motion=RelativePose(status=UNSURE))
    assert likely_cause(still, PREV, CURR, 0.025) == ""


def test_the_delay_of_depth_is_that_of_its_stamps() -> None:
    class Stamped:
        timestamps = np.array([1.0, 2.0])
        depth_timestamps = np.array([1.0, 2.015])

    assert depth_delay(Stamped(), 1) == pytest.approx(0.015)
    assert depth_delay(object(), 1) == 0.0


def test_an_image_that_is_missing_is_neither_dark_nor_blurred() -> None:
    no_flow = step(Status.degraded(Reason.NO_FLOW, "an image is missing"))
    without = changed(rgb=None)
    assert likely_cause(no_flow, PREV, without) == "no_image"
    assert likely_cause(no_flow, without, CURR) == "no_image"
    assert "missing" in CAUSES["no_image"]
