"""Steps that are given once more when the next frame shows how the camera moved."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

import hybridvo as hvo
from hybridvo.core.geometry import se3_exp
from hybridvo.core.options import Options, TrackOptions
from hybridvo.odometry import Odometry
from tests.late_depth import median_error_px, rolling_frames, untold

READOUT_MS = 20.0
COUNT = 60
LAGS = Options(track=TrackOptions(lag=1))


@pytest.fixture(scope="module")
def rolled() -> list[hvo.Frame]:
    """Frames of a camera that turns to and fro, whose rows are exposed one after the other."""
    return rolling_frames(1, READOUT_MS, 0.0, COUNT)


def poses_of(steps: list[hvo.Step]) -> list[np.ndarray]:
    """The path, each pose as it was given last."""
    poses = {}
    for number, step in enumerate(steps):
        poses[number] = step.T_world_cam
        if step.corrected is not None:
            poses[number - 1] = step.corrected.T_world_cam
    return [poses[number] for number in range(len(steps))]


@pytest.mark.slow
def test_corrected_steps_are_better_than_those_at_once(rolled) -> None:
    at_once = [step.T_world_cam for step in map(Odometry().track, rolled)]
    steps = [step for step in map(Odometry(options=LAGS).track, rolled)]
    assert median_error_px(poses_of(steps)) < 0.75 * median_error_px(at_once)
    assert all(step.corrected is not None for step in steps[2:])


@pytest.mark.slow
def test_a_readout_is_found_while_frames_come(rolled) -> None:
    odometry = Odometry(options=LAGS)
    steps = list(map(odometry.track, untold(rolled)))
    assert odometry.readout_ms == pytest.approx(READOUT_MS, abs=3.0)
    assert steps[-1].corrected is not None
    odometry.reset()
    assert odometry.readout_ms == 0


@pytest.mark.slow
def test_the_next_frame_shows_the_velocity_at_one(rolled) -> None:
    ahead = [*rolled[1:], None]
    odometry = Odometry()
    poses = [
        odometry.track(frame, following=following).T_world_cam
        for frame, following in zip(rolled, ahead, strict=True)
    ]
    at_once = [step.T_world_cam for step in map(Odometry().track, rolled)]
    assert median_error_px(poses) < 0.75 * median_error_px(at_once)


def test_a_global_shutter_corrects_nothing() -> None:
    frames = untold(rolling_frames(2, 0.0, 0.0, 6))
    plain = list(map(Odometry(network=None).track, frames))
    lagging = list(map(Odometry(network=None, options=LAGS).track, frames))
    for one, other in zip(plain, lagging, strict=True):
        assert other.corrected is None
        assert np.array_equal(one.T_world_cam, other.T_world_cam)
        assert np.array_equal(one.covariance, other.covariance)


def test_a_frame_may_change_once_it_is_tracked() -> None:
    frames = rolling_frames(3, READOUT_MS, 0.0, 6)
    kept = list(map(Odometry(network=None, options=LAGS).track, frames))
    odometry = Odometry(network=None, options=LAGS)
    for frame, expected in zip(frames, kept, strict=True):
        mine = replace(frame, rgb=frame.rgb.copy(), depth=frame.depth.copy())
        step = odometry.track(mine)
        mine.rgb[:] = 0
        mine.depth[:] = 0
        assert np.array_equal(step.T_world_cam, expected.T_world_cam)


def test_a_pose_that_is_set_holds_for_corrected_steps() -> None:
    frames = rolling_frames(3, READOUT_MS, 0.0, 5)
    plain = Odometry(network=None, options=LAGS)
    moved = Odometry(network=None, options=LAGS)
    for frame in frames[:4]:
        before = plain.track(frame)
        moved.track(frame)
    T_new_old = se3_exp(np.array([1.0, 2.0, 3.0, 0.1, 0.2, 0.3]))
    moved.set_pose(T_new_old @ before.T_world_cam)
    expected = plain.track(frames[4])
    found = moved.track(frames[4])
    for one, other in ((expected, found), (expected.corrected, found.corrected)):
        assert np.allclose(
            T_new_old @ one.T_world_cam, other.T_world_cam, atol=1e-6
        )


def test_what_is_handed_in_later_corrects_nothing() -> None:
    frames = rolling_frames(3, READOUT_MS, 0.0, 5)
    odometry = Odometry(network=None, options=LAGS)
    for frame in frames[:3]:
        odometry.track(frame)
    odometry.skip(3, frames[3].timestamp)
    assert odometry.track(frames[4]).corrected is None


def test_refuses_what_is_no_frame() -> None:
    frame = rolling_frames(3, 0.0, 0.0, 1)[0]
    with pytest.raises(hvo.InputError, match="following"):
        Odometry(network=None).track(frame, following=frame.rgb)
