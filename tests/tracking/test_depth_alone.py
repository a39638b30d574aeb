"""Frames whose image shows nothing or little: the depth maps carry the path."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

import hybridvo as hvo
from hybridvo import pipeline
from hybridvo.core.geometry import invert, se3_exp, se3_log
from hybridvo.core.results import MotionPrior
from hybridvo.core.types import FramePair
from hybridvo.solver.depth_alone import follow_depth
from tests import slow_walk

FIRST = 7
AFTER = 12
"""Frames from the first whose image is bad to the first with a good one."""


@pytest.fixture(scope="module")
def walk() -> tuple[list[hvo.Frame], np.ndarray]:
    """Frames of a camera that moves by some pixels each, and their poses."""
    return slow_walk.frames("static", seed=6, count=14, stride=3)


def black(frame: hvo.Frame) -> hvo.Frame:
    """A frame of a dark room, or under a cover."""
    return replace(frame, rgb=np.zeros_like(frame.rgb))


def white(frame: hvo.Frame) -> hvo.Frame:
    """An overexposed frame."""
    return replace(frame, rgb=np.full_like(frame.rgb, 255))


def tracked(frames: list[hvo.Frame], poses: np.ndarray) -> list[hvo.Step]:
    """The steps of a new tracker."""
    vo = hvo.Odometry()
    vo.set_pose(poses[0])
    return [vo.track(frame) for frame in frames]


def error(step: hvo.Step, T_true: np.ndarray) -> np.ndarray:
    """(6,) of a pose, metres and radians."""
    return se3_log(invert(step.T_world_cam) @ T_true)


@pytest.mark.parametrize("spoil", [black, white], ids=lambda f: f.__name__)
def test_depth_carries_the_path_through_images_that_show_nothing(walk, spoil):
    frames, poses = walk
    given = [*frames]
    for k in range(FIRST, AFTER):
        given[k] = spoil(frames[k])
    steps = tracked(given, poses)
    for k in range(FIRST, AFTER):
        assert str(steps[k].status) == "degraded(no_flow)"
        assert "depth maps carry the motion" in steps[k].status.message
        assert steps[k].motion.terms[0] == "depth"
        away = error(steps[k], poses[k])
        # of six degrees of freedom: 99.9 %
        assert away @ np.linalg.solve(steps[k].covariance, away) < 22.5
        length = np.linalg.norm(poses[k][:3, 3] - poses[FIRST - 1][:3, 3])
        assert np.linalg.norm(away[:3]) < max(0.15 * length, 0.01)
        # later motions start from the last image that showed something
        assert steps[k].prev_index < FIRST
    for k in range(AFTER, len(frames)):
        assert steps[k].ok
        assert np.linalg.norm(error(steps[k], poses[k])[:3]) < 0.01


def test_images_carry_the_path_where_depth_is_gone(walk):
    frames, poses = walk
    given = [*frames]
    for k in range(FIRST, AFTER):
        given[k] = replace(frames[k], depth=np.zeros_like(frames[k].depth))
    steps = tracked(given, poses)
    for k in range(FIRST, len(frames)):
        assert steps[k].ok
        assert np.linalg.norm(error(steps[k], poses[k])[:3]) < 0.01
    assert all("depth" not in step.motion.terms for step in steps[FIRST:AFTER])


def test_a_path_in_the_dark_has_no_end(walk):
    """From its first frame on, and farther than one depth map reaches."""
    frames, poses = slow_walk.frames("static", seed=6, count=14, stride=6)
    steps = tracked([black(frame) for frame in frames], poses)
    assert all(step.usable for step in steps)
    starts = {step.prev_index for step in steps[1:]}
    assert len(starts) > 1
    length = np.linalg.norm(poses[-1][:3, 3] - poses[0][:3, 3])
    assert np.linalg.norm(error(steps[-1], poses[-1])[:3]) < 0.2 * length


def test_images_with_texture_are_not_passed_over(walk):
    frames, _ = walk
    context = pipeline.Context()
    for image, is_asked in ((frames[1].rgb, False), (0 * frames[1].rgb, True)):
        pair = FramePair(frames[0], replace(frames[1], rgb=image), None)
        pair = replace(pair, flow_source="dis")
        evidence = replace(context, flow=hvo.dis_flow()).evidence(pair)
        assert (pipeline.by_depth(evidence) is not None) is is_asked


def test_no_depth_and_no_texture_is_a_failure(walk):
    frames, _ = walk
    blind = replace(black(frames[1]), depth=np.zeros_like(frames[1].depth))
    assert not hvo.estimate(frames[0], blind).usable


def test_a_wall_leaves_open_what_it_does_not_show():
    """Of six directions it shows three: the others stay as expected, and as uncertain."""
    camera = hvo.Camera(160, 160, 79.5, 59.5, height=120, width=160)
    rng = np.random.default_rng(0)
    walls = [
        (2.0 + 0.004 * rng.standard_normal((120, 160))).astype(np.float32)
        for _ in range(2)
    ]
    pair = FramePair(*(hvo.Frame(None, wall, camera) for wall in walls), None)
    expected = MotionPrior(
        se3_exp(np.array([0.03, 0.02, 0.01, 0.0, 0.0, 0.01])), 1e-4 * np.eye(6)
    )
    found = follow_depth(pair, expected)
    assert found is not None and found.rests_on(expected)
    variances = np.diag(found.known.covariance) / 1e-4
    # along the wall, and about the optical axis
    assert (variances[[0, 1, 5]] > 0.9).all()
    assert (variances[[2, 3, 4]] < 0.1).all()
    T = found.known.T_curr_prev
    np.testing.assert_allclose(T[:3, 3], [0.03, 0.02, 0.0], atol=2e-3)


def test_the_covariance_covers_the_error():
    """From expectations that err by as much as they state, on eight pairs of two scenes."""
    squared = []
    covariance = np.diag([0.01**2] * 3 + [0.01**2] * 3)
    for seed in (6, 7):
        frames, poses = slow_walk.frames("static", seed=seed, count=5, stride=4)
        rng = np.random.default_rng(seed)
        for k in range(4):
            true = invert(poses[k + 1]) @ poses[k]
            away = rng.multivariate_normal(np.zeros(6), covariance)
            expected = MotionPrior(se3_exp(away) @ true, covariance)
            found = follow_depth(FramePair(*frames[k : k + 2], None), expected)
            assert found is not None
            wrong = se3_log(found.known.T_curr_prev @ invert(true))
            squared.append(wrong @ np.linalg.solve(found.known.covariance, wrong))
            # it is much nearer than what was expected
            assert np.linalg.norm(wrong) < np.linalg.norm(away)
    # 5.3 is the median of six degrees of freedom
    assert 5.3 / 2 < np.median(squared) < 2 * 5.3
