"""Depth maps that are measured before or after their images."""

from __future__ import annotations

import numpy as np
import pytest

import hybridvo as hvo
from hybridvo.core.geometry import invert, se3_exp
from hybridvo.evidence.depth_lag import depth_at_image_time
from tests.late_depth import PERIOD_S, late_frames, motion_until, untold


def wrong(depth: np.ndarray, true: np.ndarray) -> float:
    """Fraction of the pixels whose depth differs by more than 3 %."""
    return float(np.mean(np.abs(depth / true - 1) > 0.03))


@pytest.mark.parametrize("lag_ms", [12.0, -12.0])
def test_depth_is_brought_to_the_time_of_the_image(lag_ms: float) -> None:
    late = late_frames(1, lag_ms, 1)[0]
    true = late_frames(1, 0.0, 1)[0].depth
    duration_s = 0.2 * PERIOD_S
    T_curr_prev = invert(motion_until(duration_s / 2)) @ motion_until(
        -duration_s / 2
    )
    moved = depth_at_image_time(late, T_curr_prev, duration_s)
    assert moved.camera.depth_lag_ms == 0

    assert wrong(late.depth, true) > 0.1
    assert wrong(moved.depth, true) < 0.3 * wrong(late.depth, true)


def test_depth_stays_where_no_lag_or_no_time_is_known() -> None:
    frames = late_frames(1, 12.0, 1)
    motion = se3_exp(np.array([0, 0, 0, 0, 0.02, 0]))
    assert depth_at_image_time(frames[0], motion, 0.0) is frames[0]
    in_time = untold(frames)[0]
    assert depth_at_image_time(in_time, motion, PERIOD_S) is in_time


def test_a_tracker_keeps_depth_of_the_time_of_the_image() -> None:
    frames = late_frames(2, 20.0, 5)
    true = late_frames(2, 0.0, 5)[-1].depth
    tracker = hvo.Odometry()
    for frame in frames:
        tracker.track(frame)
    assert tracker.state.last is not None
    assert np.array_equal(tracker.state.last.depth, frames[-1].depth)
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
        hvo.Camera(100, 100, 79.5, 59.5, 120, 160, depth_lag_ms=float("nan"))
