"""Frames whose rows, or whose depth, are measured before or after the middle of their image."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

import hybridvo as hvo
from hybridvo.core.geometry import invert, se3_log
from hybridvo.evidence.one_time import at_image_time
from tests.late_depth import (
    PERIOD_S,
    late_frames,
    motion_until,
    rolling_frames,
    untold,
)


def wrong(depth: np.ndarray, true: np.ndarray) -> float:
    """Fraction of the pixels whose depth differs by more than 3 %."""
    return float(np.mean(np.abs(depth / true - 1) > 0.03))


def velocity_within(duration_s: float) -> np.ndarray:
    """(6,) mean velocity about the first frame."""
    motion = invert(motion_until(duration_s / 2)) @ motion_until(-duration_s / 2)
    return se3_log(motion) / duration_s


@pytest.mark.parametrize("lag_ms", [12.0, -12.0])
def test_depth_is_brought_to_the_time_of_the_image(lag_ms: float) -> None:
    late = late_frames(1, lag_ms, 1)[0]
    true = late_frames(1, 0.0, 1)[0].depth
    moved = at_image_time(late, velocity_within(0.2 * PERIOD_S))
    assert moved.camera.depth_lag_ms == 0

    assert wrong(late.depth, true) > 0.1
    assert wrong(moved.depth, true) < 0.3 * wrong(late.depth, true)


def test_a_frame_of_one_time_stays_as_it_is() -> None:
    frame = untold(late_frames(1, 0.0, 1))[0]
    assert at_image_time(frame, np.array([3.0, 0, 0, 0, 3.0, 0])) is frame


@pytest.mark.parametrize("lag_ms", [0.0, 12.0])
def test_rows_are_brought_to_the_time_of_the_middle_one(lag_ms: float) -> None:
    rolled = rolling_frames(1, 20.0, lag_ms, 1)[0]
    true = late_frames(1, 0.0, 1)[0]
    moved = at_image_time(rolled, velocity_within(0.2 * PERIOD_S))
    assert moved.camera.readout_ms == 0
    assert moved.camera.depth_lag_ms == 0

    def error(frame: hvo.Frame) -> float:
        return float(np.mean(np.abs(frame.rgb.astype(float) - true.rgb)))

    assert error(moved) < 0.4 * error(rolled)
    # what was outside the view has no depth
    seen = moved.depth > 0
    assert np.mean(seen) > 0.95
    before = wrong(rolled.depth[seen], true.depth[seen])
    assert wrong(moved.depth[seen], true.depth[seen]) < 0.5 * before


def ignorant(frames: list[hvo.Frame]) -> list[hvo.Frame]:
    """The same frames, whose camera states no times."""
    camera = replace(frames[0].camera, readout_ms=0.0, depth_lag_ms=0.0)
    return [replace(frame, camera=camera) for frame in frames]


@pytest.mark.slow
@pytest.mark.parametrize(("readout_ms", "share"), [(0.0, 0.6), (20.0, 0.8)])
def test_a_pair_uses_readout_and_lag(readout_ms: float, share: float) -> None:
    """Of a camera that turns by 1 rad/s and pitches by 0.7 rad/s; lag alone 0.4, both 0.6."""
    true = invert(motion_until(PERIOD_S)) @ motion_until(0)

    def error(frames: list[hvo.Frame]) -> float:
        return float(np.linalg.norm(hvo.estimate(*frames).T_curr_prev - true))

    known = []
    ignored = []
    for seed in (1, 2, 3, 4):
        frames = rolling_frames(seed, readout_ms, 30.0, 2)
        known.append(error(frames))
        ignored.append(error(ignorant(frames)))
    assert np.mean(known) < share * np.mean(ignored)


def test_a_tracker_keeps_depth_of_the_time_of_the_image() -> None:
    frames = late_frames(2, 20.0, 5)
    true = late_frames(2, 0.0, 5)[-1].depth
    tracker = hvo.Odometry()
    for frame in frames:
        tracker.track(frame)
    assert tracker.state.sensors.last is not None
    assert np.array_equal(tracker.state.sensors.last.depth, frames[-1].depth)
    assert tracker.state.frame is not None
    kept = tracker.state.frame.depth
    assert wrong(kept, true) < 0.5 * wrong(frames[-1].depth, true)


def test_the_first_motion_brings_the_first_depth_in_time() -> None:
    frames = late_frames(2, 20.0, 2)
    true = late_frames(2, 0.0, 2)
    tracker = hvo.Odometry()
    for frame in frames:
        tracker.track(frame)
    kept = {index: each.depth for index, each in tracker.state.starts.items()}
    for index in (0, 1):
        late = wrong(frames[index].depth, true[index].depth)
        assert wrong(kept[index], true[index].depth) < 0.5 * late


def test_a_lag_that_is_no_time_is_refused() -> None:
    with pytest.raises(hvo.InputError, match="depth_lag_ms"):
        hvo.Camera(
            100, 100, 79.5, 59.5, height=120, width=160, depth_lag_ms=float("nan")
        )
