"""A recording tracked in passes: the readout that they find, and what it is worth."""

from __future__ import annotations

import itertools
from dataclasses import replace

import numpy as np
import pytest

import hybridvo as hvo
from hybridvo import InputError, RelativePose, Step
from hybridvo.core.geometry import invert, se3_exp, se3_log
from hybridvo.core.results import Reason
from hybridvo.tracking.camera_drift import Mean
from hybridvo.tracking.passes import (
    PixelTimes,
    TimesFinder,
    find_times,
    track_in_passes,
)
from tests.doors import refuses
from tests.late_depth import PERIOD_S, median_error_px, rolling_frames, untold

READOUT_MS = 20.0
COUNT = 45


@pytest.fixture(scope="module")
def rolled() -> list[hvo.Frame]:
    """Frames of a camera that turns to and fro, whose rows are exposed one after the other."""
    return rolling_frames(1, READOUT_MS, 0.0, COUNT)


def error_px(steps: list[Step]) -> float:
    """The median error of the path of some steps."""
    return median_error_px([step.T_world_cam for step in steps])


@pytest.mark.slow
def test_the_passes_find_the_readout_and_use_it(rolled) -> None:
    once = track_in_passes(untold(rolled), passes=1)
    thrice = track_in_passes(untold(rolled), passes=3)
    assert once.times.readout is None
    assert thrice.times.readout_ms == pytest.approx(READOUT_MS, abs=2.0)
    assert error_px(thrice.steps) < 0.6 * error_px(once.steps)


@pytest.mark.slow
def test_a_stated_readout_is_believed(rolled) -> None:
    once = track_in_passes(rolled, passes=1)
    twice = track_in_passes(rolled, passes=2)
    assert twice.times.readout is None
    assert len(twice.times.velocities) == COUNT
    assert error_px(twice.steps) < error_px(once.steps)


@pytest.mark.slow
def test_a_shutter_that_does_not_roll_needs_no_second_pass() -> None:
    frames = untold(rolling_frames(1, 0.0, 0.0, COUNT))
    times = find_times(frames, passes=2)
    assert times.readout is not None and abs(times.readout.error) < 2.0
    assert times.readout_ms == 0.0 and not times.velocities
    assert times.frame(frames[0]).rgb is frames[0].rgb


test_refuses = refuses(
    [
        (
            f"{passes!r} passes",
            lambda passes=passes: track_in_passes([], passes),  # type: ignore[misc]
            InputError,
            (
                "track_in_passes.passes",
                "expected a whole number from 1 on",
                repr(passes),
            ),
        )
        for passes in (0, 1.5, 2.0, "two", "2")
    ]
    + [
        (
            name,
            call,
            InputError,
            ("track_in_passes", "expected", *words),
        )
        for name, call, words in (
            (
                "a frame",
                lambda: track_in_passes(blank(0)),  # type: ignore[arg-type]
                ("a list of frames", "got Frame"),
            ),
            (
                "one index twice",
                lambda: track_in_passes([blank(4), blank(4)]),
                ("frame 1", "an index of its own", "got 4"),
            ),
            (
                "one tracker for all passes",
                lambda: track_in_passes(
                    [blank(0)], 2, itertools.repeat(hvo.Odometry()).__next__
                ),
                ("make_tracker()", "has tracked 1 frames"),
            ),
        )
    ]
)


# -- what is learned of the velocity -----------------------------------------------------


def blank(
    index: int, readout_ms: float = 0.0, stamp: float | None = None
) -> hvo.Frame:
    """A frame that shows nothing."""
    camera = hvo.Camera(
        40.0, 40.0, 31.5, 23.5, height=48, width=64, readout_ms=readout_ms
    )
    depth = np.full(camera.shape, 2.0, np.float32)
    time = PERIOD_S * index if stamp is None else stamp
    return hvo.Frame(None, depth, camera, timestamp=time, index=index)


def step_to(index: int, x: float, failed: bool = False) -> Step:
    """A step to a camera at x metres."""
    T = np.eye(4)
    T[0, 3] = x
    motion = RelativePose()
    if failed:
        motion = RelativePose.failed(Reason.NO_FLOW, "none")
    return Step(index, PERIOD_S * index, T, motion, index - 1 if index else None)


def times_of(frames: list[hvo.Frame], steps: list[Step]) -> PixelTimes:
    """What a pass over some frames shows."""
    finder = TimesFinder()
    for frame, step in zip(frames, steps, strict=True):
        finder.add(frame, step)
    return finder.found()


def test_velocities_by_hand() -> None:
    frames = [blank(k, readout_ms=20.0) for k in range(4)]
    steps = [step_to(k, x) for k, x in enumerate((0.0, 0.01, 0.03, 0.06))]
    velocities = times_of(frames, steps).velocities
    # between the neighbours; at the ends from the only one
    metres = [-0.01, -0.015, -0.025, -0.03]
    for k, way in enumerate(metres):
        expected = np.array([way / PERIOD_S, 0, 0, 0, 0, 0])
        np.testing.assert_allclose(velocities[k], expected, atol=1e-9)


def test_no_velocity_over_a_failure_or_a_long_time() -> None:
    frames = [blank(k, readout_ms=20.0) for k in range(3)]
    failed = step_to(1, 0.0, failed=True)
    spanning = replace(step_to(2, 0.02), prev_index=0)
    velocities = times_of(frames, [step_to(0, 0.0), failed, spanning]).velocities
    assert 0 not in velocities
    # the motion after a failure spans it
    assert velocities[1][0] == pytest.approx(-0.01 / PERIOD_S)
    # where the camera was at the failure is a guess
    assert 2 not in velocities


def test_what_a_camera_hands_out_again_stays_as_it_is() -> None:
    frames = rolling_frames(1, READOUT_MS, 0.0, 6)
    old = frames[2]
    frames[3] = replace(frames[3], rgb=old.rgb, depth=old.depth)
    steps, times = track_in_passes(frames, passes=2)
    assert times.velocities.keys() == {0, 1, 4, 5}
    assert steps[3].status.reason is Reason.REPEATED_FRAME
    # the motion to frame 4 took two intervals, and does not count
    motion = se3_log(invert(steps[5].T_world_cam) @ steps[4].T_world_cam)
    turn = times.velocities[4][3:]
    np.testing.assert_allclose(turn, motion[3:] / PERIOD_S, atol=0.05)
    late = [blank(0, 20.0), blank(1, 20.0, stamp=5.0)]
    assert not times_of(late, [step_to(0, 0.0), step_to(1, 0.1)]).velocities


def test_frames_of_one_time_learn_nothing() -> None:
    frames = [blank(k) for k in range(4)]
    steps = [step_to(k, 0.01 * k) for k in range(4)]
    assert not times_of(frames, steps).velocities


def test_a_camera_that_states_its_readout_keeps_it() -> None:
    times = PixelTimes(Mean(25.0, 2.0, 40))
    assert times.camera(blank(0).camera).readout_ms == 25.0
    assert times.camera(blank(0, readout_ms=10.0).camera).readout_ms == 10.0
    unsure = PixelTimes(Mean(25.0, 9.0, 40))
    assert not unsure.readout_is_known and unsure.readout_ms == 0.0


def test_a_frame_with_a_velocity_states_no_times_any_more() -> None:
    velocity = se3_log(se3_exp(np.array([0, 0, 0, 0, 1.0, 0])))
    times = PixelTimes(Mean(25.0, 2.0, 40), {3: velocity})
    assert times.frame(blank(3)).camera.readout_ms == 0.0
    assert times.frame(blank(4)).camera.readout_ms == 25.0


def test_frames_without_numbers_get_them() -> None:
    frames = [replace(blank(k), index=None) for k in range(2)]
    tracked = track_in_passes(frames, passes=2)
    assert [step.index for step in tracked.steps] == [0, 1]
