"""A lost path is found again from an earlier place."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

import hybridvo as hvo
from hybridvo import pipeline
from hybridvo.core.geometry import se3_exp
from hybridvo.core.types import FramePair
from hybridvo.flow.providers import dis_flow
from hybridvo.tracking import search
from hybridvo.tracking.keyframes import Keyframe
from hybridvo.tracking.relocalization import similar_places, with_place
from hybridvo_lab.synthetic.slow_scenes import slow_scene

SIZE = (120, 160)


@pytest.fixture(scope="module")
def scene():
    return slow_scene("static", 3, 12, SIZE)


@pytest.fixture(scope="module")
def frames(scene):
    return [
        replace(scene.render(k), index=None, timestamp=k / 30)
        for k in range(scene.frames)
    ]


def covered(frame: hvo.Frame, rng: np.random.Generator) -> hvo.Frame:
    """A frame with a hand on the lens."""
    rgb = rng.integers(0, 40, frame.rgb.shape).astype(np.uint8)
    return replace(frame, rgb=rgb, depth=np.full_like(frame.depth, 0.1))


def keyframe(frame: hvo.Frame, T: np.ndarray, count: int) -> Keyframe:
    return Keyframe(frame, T, count, count, np.zeros((6, 6)))


@pytest.mark.parametrize("seed", [12, 15, 17])
def test_a_step_that_is_too_wide_costs_one_frame(frames, seed: int) -> None:
    """The path goes on from where the camera was taken, and only that step is unknown."""
    elsewhere = slow_scene("static", seed, 6, SIZE)
    vo = hvo.Odometry()
    for k, frame in enumerate(frames[:4]):
        assert vo.track(replace(frame, index=k)).ok
    steps = [
        vo.track(replace(elsewhere.render(k), index=4 + k, timestamp=(4 + k) / 30))
        for k in range(4)
    ]
    assert not steps[0].usable
    assert [step.ok for step in steps[1:]] == [True, True, True]
    assert steps[1].prev_index == 4
    T = elsewhere.T_world_cam
    true = np.linalg.inv(T[3]) @ T[0]
    got = np.linalg.inv(steps[3].T_world_cam) @ steps[0].T_world_cam
    np.testing.assert_allclose(got, true, atol=0.02)


def test_the_path_goes_on_where_it_was_after_the_lens_was_covered(scene, frames):
    rng = np.random.default_rng(0)
    vo = hvo.Odometry()
    for frame in frames[:8]:
        assert vo.track(frame).ok
    for frame in frames[8:10]:
        assert not vo.track(covered(frame, rng)).ok
    # back where it was long ago
    step = vo.track(frames[1])
    assert step.ok
    true = np.linalg.inv(scene.T_world_cam[0]) @ scene.T_world_cam[1]
    np.testing.assert_allclose(step.T_world_cam, true, atol=0.02)
    assert vo.track(frames[2]).ok


def test_places_are_far_apart_and_the_oldest_makes_room(frames):
    frame = frames[0]
    most = 10
    places: tuple[Keyframe, ...] = ()
    for count in range(3 * most):
        # a quarter of the view from one to the next: 160 px are about 60 degrees
        turn = se3_exp(np.array([0, 0, 0, 0, 0.3 * count, 0]))
        places = with_place(places, keyframe(frame, turn, count), most)
        # the same place once more
        places = with_place(places, keyframe(frame, turn, count), most)
    assert [place.count for place in places] == list(range(2 * most, 3 * most))


def test_the_place_that_resembles_a_frame_is_found_although_it_is_shifted(frames):
    rng = np.random.default_rng(1)
    other = rng.integers(0, 255, frames[0].rgb.shape).astype(np.uint8)
    places = [
        keyframe(replace(frames[0], rgb=other), np.eye(4), 0),
        keyframe(frames[0], np.eye(4), 1),
    ]
    shifted = np.roll(frames[0].rgb, 16, axis=1)
    assert similar_places(places, replace(frames[0], rgb=shifted)) == [places[1]]
    assert not similar_places(places[:1], frames[0])
    black = np.zeros_like(other)
    assert not similar_places(places, replace(frames[0], rgb=black))


def test_a_prior_bridges_a_motion_that_fails(frames):
    vo = hvo.Odometry(network=None)
    vo.track(frames[0])
    covariance = np.diag([1e-4] * 3 + [1e-6] * 3)
    T_curr_prev = se3_exp(np.array([0.02, 0.0, 0.01, 0.0, 0.01, 0.0]))
    prior = hvo.MotionPrior(T_curr_prev, covariance)
    black = replace(
        frames[1],
        rgb=np.zeros_like(frames[1].rgb),
        depth=np.zeros_like(frames[1].depth),
    )
    step = vo.track(black, prior=prior)
    assert not step.ok
    np.testing.assert_allclose(step.T_world_cam, np.linalg.inv(T_curr_prev))
    np.testing.assert_allclose(step.motion.covariance, covariance)


def test_a_prior_bridges_an_image_that_comes_twice(frames):
    vo = hvo.Odometry(network=None)
    vo.track(frames[0])
    T_curr_prev = se3_exp(np.array([0.2, 0.0, 0.1, 0.0, 0.01, 0.0]))
    prior = hvo.MotionPrior(T_curr_prev, 1e-4 * np.eye(6))
    step = vo.track(replace(frames[0], depth=None), prior=prior)
    assert step.status.reason is hvo.Reason.REPEATED_FRAME
    np.testing.assert_allclose(step.T_curr_prev, T_curr_prev)
    np.testing.assert_allclose(step.T_world_cam, np.linalg.inv(T_curr_prev))
    with pytest.raises(hvo.InputError, match="prior"):
        vo.skip(2, 0.1, prior=np.eye(4))


def test_places_of_another_scene_are_not_taken_for_this_one(frames):
    """Lost in another room: no place of the first one may be found, however long it is sought."""
    vo = hvo.Odometry(network=None)
    for frame in frames[:3]:
        vo.track(frame)
    others = slow_scene("static", 6, 3, SIZE)
    for k in range(3):
        step = vo.track(replace(others.render(k), index=None, timestamp=1 + k / 30))
        assert step.prev_index != 0 or not step.usable
    # even where its image is the only one to compare with
    motion = hvo.estimate(frames[0], others.render(0))
    assert not motion.ok


def test_a_place_has_depth(frames):
    """Where flow is given, a motion may lead to a frame without depth."""
    vo = hvo.Odometry(network=None)
    flow = dis_flow()
    vo.track(frames[0])
    blind = replace(frames[1], depth=None)
    assert vo.track(blind, flow=flow(frames[0], blind)).ok
    assert [place.count for place in vo.state.places] == [0]
    assert [keyframe.count for keyframe in vo.state.keyframes] == []


def test_no_costly_source_begins_after_the_time_is_over(frames, monkeypatch):
    """Noise has no motion: without a deadline, flow from matches is tried as well."""
    tried = []

    def never(evidence, ctx):
        for source in ("images", "flow", "depth", "matches", "more matches"):
            tried.append(source)
            yield None if source == "images" else nothing

    nothing = hvo.RelativePose.failed(hvo.Reason.AMBIGUOUS_MOTION, "")
    monkeypatch.setitem(
        pipeline.METHODS,
        "hybrid",
        replace(pipeline.METHODS["hybrid"], answers=never),
    )
    ctx = pipeline.Context()
    pair = FramePair(frames[0], frames[1], None)
    pipeline.first_sure([ctx.evidence(pair)], "hybrid", ctx, deadline=0.0)
    assert tried == ["images", "flow"]
    tried.clear()
    pipeline.first_sure([ctx.evidence(pair)], "hybrid", ctx)
    assert len(tried) == 5


def test_an_answer_that_is_late_is_not_improved(frames):
    """With a budget of nearly no time the images are not used after the flow."""
    options = hvo.Options()
    options = replace(options, direct=replace(options.direct, mode="off"))
    hurried = replace(options, track=replace(options.track, budget_ms=1e-6))
    terms = []
    for each in (options, hurried):
        vo = hvo.Odometry(options=each)
        vo.track(frames[0])
        terms.append(vo.track(frames[1]).motion.terms)
    assert terms == [("flow", "images"), ("flow",)]


def test_no_place_is_tried_after_the_time_is_over(frames, monkeypatch):
    sought = []
    monkeypatch.setattr(search, "from_place", lambda *_: sought.append("place"))
    noise = np.random.default_rng(0).integers(0, 255, frames[0].rgb.shape)
    no_depth = np.zeros_like(frames[1].depth)
    lost = replace(frames[1], rgb=noise.astype(np.uint8), depth=no_depth)
    for budget_ms in (1e-6, 0.0):
        vo = hvo.Odometry(options=hvo.Options(track={"budget_ms": budget_ms}))
        vo.track(frames[0])
        assert not vo.track(lost).motion.usable
    assert sought == ["place"]
