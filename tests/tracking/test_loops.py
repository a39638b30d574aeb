"""Loops: places that are seen again while the tracker knows where it is."""

from __future__ import annotations

import json
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

import hybridvo as hvo
from hybridvo.core.geometry import invert, se3_exp, se3_log
from hybridvo.run.commands.stored_state import restored, saved
from hybridvo.tracking import loops
from hybridvo_lab.synthetic.slow_scenes import slow_scene

SIZE = (120, 160)
THERE = (0, 2, 4, 6, 8, 10)
WALK = (*THERE, 9, 7, 5, 3, 1)
"""Frames of a scene, there and back, none of them twice."""


@pytest.fixture(scope="module")
def scene():
    return slow_scene("static", 3, 12, SIZE)


@pytest.fixture(scope="module")
def frames(scene):
    return [
        replace(scene.render(i), index=k, timestamp=k / 30)
        for k, i in enumerate(WALK)
    ]


@pytest.fixture(scope="module")
def tracked(frames):
    """A tracker at the end of the walk, and its last step."""
    vo = hvo.Odometry()
    steps = [vo.track(frame) for frame in frames]
    assert all(step.ok for step in steps)
    return vo, steps[-1]


def test_the_first_place_is_seen_again(scene, tracked) -> None:
    vo, step = tracked
    (edge,) = vo.loops(step, apart=8)
    T_world_cam = scene.T_world_cam
    true = invert(T_world_cam[WALK[step.index]]) @ T_world_cam[WALK[edge.start]]
    error = se3_log(edge.T_curr_start @ invert(true))
    assert edge.start == 0
    assert np.linalg.norm(error[:3]) < 0.002
    assert error @ np.linalg.solve(edge.covariance, error) < 30


def test_a_place_that_was_left_a_short_while_ago_is_no_loop(tracked) -> None:
    vo, step = tracked
    assert vo.loops(step, apart=step.index + 1) == ()
    assert vo.loops(step) == ()


def test_no_later_step_depends_on_it(frames, tracked) -> None:
    asked = hvo.Odometry()
    for frame in frames:
        step = asked.track(frame)
        asked.loops(step, apart=1)
    np.testing.assert_array_equal(step.T_world_cam, tracked[1].T_world_cam)
    np.testing.assert_array_equal(step.covariance, tracked[1].covariance)


def test_what_the_images_show_in_one_direction_alone_is_no_loop(
    tracked, monkeypatch
) -> None:
    """The motion back must lead to where the frame was, and the covariance covers both."""
    vo, step = tracked
    measured = loops.motion_between
    (edge,) = vo.loops(step, apart=8)

    def apart_by(metres: float) -> tuple[hvo.Edge, ...]:
        """The loops, where the second motion leads elsewhere."""
        aside = se3_exp(np.array([metres, 0, 0, 0, 0, 0]))

        def between(setup, prev, curr):
            motion = measured(setup, prev, curr)
            if prev.index > curr.index:
                motion = motion.replace(T_curr_prev=motion.T_curr_prev @ aside)
            return motion

        monkeypatch.setattr(loops, "motion_between", between)
        return vo.loops(step, apart=8)

    assert apart_by(5.0) == ()
    (wider,) = apart_by(0.01)
    grown = wider.covariance - edge.covariance
    assert np.sqrt(np.trace(grown[:3, :3])) == pytest.approx(0.01, rel=0.2)

    def fails(setup, prev, curr):
        if prev.index > curr.index:
            return hvo.RelativePose.failed(hvo.Reason.NO_FLOW, "nothing is seen")
        return measured(setup, prev, curr)

    monkeypatch.setattr(loops, "motion_between", fails)
    assert vo.loops(step, apart=8) == ()


def test_another_scene_closes_no_loop(frames) -> None:
    """Where the images show no motion there is none, and no exception."""
    vo = hvo.Odometry(network=None)
    for frame in frames[:3]:
        vo.track(frame)
    others = slow_scene("static", 6, 3, SIZE)
    for k in range(3):
        other = replace(others.render(k), index=3 + k, timestamp=1 + k / 30)
        assert vo.loops(vo.track(other), apart=2) == ()


def test_a_frame_that_fails_closes_no_loop(frames) -> None:
    vo = hvo.Odometry(network=None)
    vo.track(frames[0])
    vo.track(frames[1])
    dark = replace(
        frames[2], rgb=0 * frames[2].rgb, depth=np.zeros_like(frames[2].depth)
    )
    step = vo.track(dark)
    assert not step.usable
    assert vo.loops(step, apart=1) == ()
    assert vo.loops(vo.skip(3, 0.1), apart=1) == ()


def test_only_the_last_step_is_asked_for_loops(frames) -> None:
    vo = hvo.Odometry(network=None)
    first = hvo.Step(0, 0.0, np.eye(4), hvo.RelativePose(), None)
    with pytest.raises(hvo.InputError, match="after no frame"):
        vo.loops(first)
    first = vo.track(frames[0])
    vo.track(frames[1])
    with pytest.raises(hvo.InputError, match="got that of frame 0 after frame 1"):
        vo.loops(first)
    with pytest.raises(hvo.InputError, match="expected Step, got int"):
        vo.loops(1)
    with pytest.raises(hvo.InputError, match="from 0 on, got -1"):
        vo.loops(vo.track(frames[2]), apart=-1)


def test_as_many_places_are_kept_as_the_options_say() -> None:
    """A camera that turns by a third of its view passes two places; one may make room."""
    room = slow_scene("static", 3, 8, SIZE)
    turns = [se3_exp(np.array([0, 0, 0, 0, 0.05 * k, 0])) for k in range(8)]
    room = replace(room, T_world_cam=room.T_world_cam[0] @ np.stack(turns))
    kept = []
    for options in (hvo.Options(), hvo.Options(track={"places": 1})):
        vo = hvo.Odometry(options=options)
        for k in range(room.frames):
            frame = replace(room.render(k), index=k, timestamp=k / 30)
            assert vo.track(frame).ok
        kept.append([place.count for place in vo.state.places])
    first, later = kept[0]
    assert first == 0 and kept[1] == [later]
    with pytest.raises(hvo.InputError, match="places"):
        hvo.Options(track={"places": 201})


def test_a_run_goes_on_with_as_many_places_as_the_options_allow(tracked) -> None:
    vo, _ = tracked
    places = vo.state.places[:1] * hvo.Options(track={"places": 200}).track.places
    text = json.dumps(saved(replace(vo.state, places=places)))
    frames = SimpleNamespace(frame=lambda index: places[0].frame)
    again = restored(json.loads(text), frames)
    assert len(again.places) == 200
