"""How much later than its image a depth map is measured, by a camera that turns to and fro."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

import hybridvo as hvo
from hybridvo.core.geometry import se3_exp
from hybridvo.core.results import Step
from hybridvo.run.commands.diagnosis.depth_lag import depth_lag
from hybridvo.tracking.camera_drift import Bend
from hybridvo.tracking.depth_lag import _turn_of, find_lag, mean_lag
from tests.late_depth import late_frames, untold


@pytest.mark.slow
@pytest.mark.parametrize("lag_ms", [12.0, 0.0, -15.0])
def test_a_camera_that_turns_shows_how_late_its_depth_is(lag_ms: float) -> None:
    lag = find_lag(untold(late_frames(0, lag_ms, 30)))
    assert lag is not None
    assert lag.ms == pytest.approx(lag_ms, abs=2.0)


def test_a_frame_that_comes_twice_shows_nothing() -> None:
    frame = late_frames(0, 12.0, 1)[0]
    stamped = [replace(frame, timestamp=k / 30) for k in range(30)]
    assert find_lag(stamped) is None


@pytest.mark.parametrize("again", [(), ("rgb",), ("depth",), ("rgb", "depth")])
def test_only_a_step_between_fresh_frames_tells_how_the_camera_turned(
    again: tuple[str, ...],
) -> None:
    prev, curr = late_frames(0, 12.0, 2)
    curr = replace(curr, **{name: getattr(prev, name) for name in again})
    motion = hvo.RelativePose(se3_exp(np.array([0, 0, 0, 0.01, 0, 0])), np.eye(6))
    step = Step(1, curr.timestamp, np.eye(4), motion, prev_index=0)
    turn = _turn_of(replace(prev, index=0), replace(curr, index=1), step)
    assert (turn is None) == bool(again)
    if turn is not None:
        np.testing.assert_allclose(turn.rate, (0.3, 0, 0), rtol=1e-6)


def test_outliers_hardly_move_the_mean() -> None:
    agreeing = [Bend(10.0 + 0.1 * k, 1.0) for k in range(-15, 16)]
    lag = mean_lag([*agreeing, Bend(500.0, 1.0), Bend(-900.0, 1.0)])
    assert lag is not None
    assert lag.ms == pytest.approx(10.0, abs=0.1)
    assert mean_lag(agreeing[:5]) is None


def test_equal_answers_have_a_mean() -> None:
    lag = mean_lag([Bend(7.0, 2.0)] * 40)
    assert lag is not None
    assert lag.ms == pytest.approx(7.0)
    assert lag.std_ms == pytest.approx(0.0, abs=1e-9)


@pytest.mark.slow
def test_doctor_names_the_lag() -> None:
    class Recording:
        """Frames that a doctor can read one by one."""

        def __init__(self, frames: list[hvo.Frame]) -> None:
            self._frames = frames

        def __len__(self) -> int:
            return len(self._frames)

        def frame(self, index: int) -> hvo.Frame:
            return self._frames[index]

        def camera(self, index: int) -> hvo.Camera:
            return self._frames[index].camera

    told = late_frames(0, 12.0, 30)
    assert "--depth-lag-ms 12" in depth_lag(Recording(untold(told)), 40).message
    assert depth_lag(Recording(told), 40).differs is False
    assert depth_lag(Recording(told[:3]), 40).differs is None
