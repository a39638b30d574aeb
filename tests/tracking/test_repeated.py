"""Frames that a camera hands out again, and clocks that do not go on."""

from __future__ import annotations

import logging
from dataclasses import replace

import numpy as np
import pytest

import hybridvo as hvo
from hybridvo.core.geometry import invert, se3_log
from hybridvo.tracking.repeated import Repeat, repeat_of
from tests import slow_walk

CAMERA = hvo.Camera(100.0, 100.0, 31.5, 23.5, height=48, width=64)
AT = 5


@pytest.fixture(scope="module")
def walk() -> tuple[list[hvo.Frame], np.ndarray]:
    """Frames of a camera that moves by some pixels each, and their poses."""
    return slow_walk.frames("static", seed=6, count=9, stride=4)


def tracked(frames: list[hvo.Frame], poses: np.ndarray) -> list[hvo.Step]:
    """The steps of a new tracker."""
    vo = hvo.Odometry()
    vo.set_pose(poses[0])
    return [vo.track(frame) for frame in frames]


def noisy_frame(seed: int) -> hvo.Frame:
    """An image and a depth map of noise."""
    rng = np.random.default_rng(seed)
    rgb = rng.integers(0, 255, (48, 64, 3), np.uint8)
    return hvo.Frame(rgb, rng.uniform(1, 3, (48, 64)).astype(np.float32), CAMERA)


def test_what_repeats_is_found_byte_for_byte() -> None:
    one = noisy_frame(1)
    other = noisy_frame(2)
    assert repeat_of(None, one) == Repeat()
    assert repeat_of(one, other) == Repeat()
    assert repeat_of(one, replace(other, rgb=one.rgb)) == Repeat(colour=True)
    assert repeat_of(one, replace(other, depth=one.depth)) == Repeat(depth=True)
    assert repeat_of(one, replace(one)).entire
    nearly = one.rgb.copy()
    nearly[-1, -1, 2] ^= 1
    assert repeat_of(one, replace(one, rgb=nearly)) == Repeat(depth=True)


def test_a_map_of_one_value_repeats_without_a_meaning() -> None:
    black = np.zeros((48, 64, 3), np.uint8)
    depth = np.full((48, 64), 2.0, np.float32)
    depth[:5] = np.nan
    frame = hvo.Frame(black, depth, CAMERA)
    assert repeat_of(frame, replace(frame)) == Repeat()


@pytest.mark.parametrize("parts", [("rgb",), ("depth",), ("rgb", "depth")])
def test_a_repeated_part_is_bridged_by_what_is_fresh(walk, parts) -> None:
    frames, poses = walk
    old = {part: getattr(frames[AT - 1], part) for part in parts}
    given = [*frames]
    given[AT] = replace(frames[AT], **old)
    steps = tracked(given, poses)
    step = steps[AT]
    assert str(step.status) == "degraded(repeated_frame)"
    assert "byte for byte" in step.status.message
    away = se3_log(invert(step.T_world_cam) @ poses[AT])
    distance = away @ np.linalg.solve(step.covariance, away)
    # of six degrees of freedom: 99.9 %
    assert distance < 22.5
    if len(parts) == 1:
        assert np.linalg.norm(away[:3]) < 0.02
    else:
        # nothing is new: the pose is that of the image
        np.testing.assert_allclose(
            step.T_world_cam, steps[AT - 1].T_world_cam, atol=1e-9
        )
    # the next motion starts before it, and nothing is lost
    assert steps[AT + 1].prev_index < AT
    for k in range(AT + 1, len(frames)):
        assert steps[k].ok
        error = steps[k].T_world_cam[:3, 3] - poses[k][:3, 3]
        assert np.linalg.norm(error) < 0.01


def test_a_rendered_camera_that_stands_repeats_rightly(walk) -> None:
    frame = walk[0][0]
    steps = tracked([frame] * 4, walk[1])
    assert all(step.ok for step in steps)
    np.testing.assert_allclose(steps[-1].T_world_cam, walk[1][0], atol=1e-5)


def test_noise_in_the_image_alone_is_no_repeated_depth(walk) -> None:
    """A rendered camera that stands, with noise in its images."""
    rng = np.random.default_rng(0)
    frame = walk[0][0]
    frames = [
        replace(
            frame,
            rgb=np.clip(
                frame.rgb + rng.normal(0, 2, frame.rgb.shape), 0, 255
            ).astype(np.uint8),
        )
        for _ in range(4)
    ]
    assert all(step.ok for step in tracked(frames, walk[1]))


# -- clocks ------------------------------------------------------------------------------


def stamped(frames: list[hvo.Frame], stamps: list[float]) -> list[hvo.Frame]:
    """Frames with other stamps."""
    return [
        replace(frame, timestamp=stamp)
        for frame, stamp in zip(frames, stamps, strict=False)
    ]


@pytest.mark.parametrize("third", [0.0, 0.1])
def test_a_stamp_that_does_not_rise_is_said_once(walk, caplog, third) -> None:
    """It runs backwards, or stands still: no velocity is known over it."""
    frames = stamped(walk[0], [0.0, 0.1, third, 0.2, third, 0.3, 0.4])
    vo = hvo.Odometry()
    expectations = []
    with caplog.at_level(logging.WARNING, "hybridvo"):
        for frame in frames:
            vo.track(frame)
            expectations.append(vo.predict() is not None)
    assert expectations == [False, True, False, True, False, True, True]
    said = [text for text in caplog.messages if "stamp" in text]
    assert len(said) == 1
    assert f"{third:.6f} s does not come after 0.100000 s" in said[0]


def test_frames_without_stamps_are_evenly_spaced(walk, caplog) -> None:
    vo = hvo.Odometry()
    for frame in stamped(walk[0], [0.0] * 4):
        vo.track(frame)
    assert vo.predict() is not None
    assert not [text for text in caplog.messages if "stamp" in text]
