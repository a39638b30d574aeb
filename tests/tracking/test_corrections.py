"""A motion from a keyframe that contradicts the path since."""

from __future__ import annotations

import numpy as np
import pytest

import hybridvo as hvo
from hybridvo.core.geometry import invert, se3_exp
from hybridvo.core.results import MotionPrior, RelativePose
from hybridvo.tracking.corrections import contradicts_path
from hybridvo.tracking.keyframes import Keyframe
from tests import slow_walk

STD = 1e-3
COVARIANCE = STD**2 * np.eye(6)
STEP = se3_exp(np.array([0.01, 0, 0, 0, 0, 0]))


def keyframe(count: int, poses: np.ndarray) -> Keyframe:
    """The frame of a path in steps of a centimetre, of which all were measured from the first."""
    shape = (48, 64)
    camera = hvo.Camera(60, 60, 31.5, 23.5, *shape)
    blank = hvo.Frame(None, np.ones(shape), camera)
    return Keyframe(blank, poses[count], count, 0, COVARIANCE)


@pytest.fixture
def poses() -> np.ndarray:
    """(5, 4, 4) T_world_cam of a path at constant velocity."""
    return np.array([invert(np.linalg.matrix_power(STEP, k)) for k in range(5)])


@pytest.mark.parametrize(("apart", "contradicts"), [(0.0, False), (0.02, True)])
def test_the_step_that_a_motion_implies_is_held_against_the_expected_one(
    poses: np.ndarray, apart: float, contradicts: bool
) -> None:
    aside = se3_exp(np.array([apart, 0, 0, 0, 0, 0]))
    motion = RelativePose(aside @ invert(poses[4]), covariance=COVARIANCE)
    expected = MotionPrior(STEP, COVARIANCE)
    start = keyframe(0, poses)
    reference = keyframe(3, poses)
    assert contradicts_path(motion, start, reference, expected) == contradicts
    # with nothing expected, or from the frame before, there is nothing to contradict
    assert not contradicts_path(motion, start, reference, None)
    assert not contradicts_path(motion, start, start, expected)


def test_what_is_expected_loosely_is_not_contradicted(poses: np.ndarray) -> None:
    motion = RelativePose(
        se3_exp(np.array([0.02, 0, 0, 0, 0, 0])) @ invert(poses[4]),
        covariance=COVARIANCE,
    )
    loose = MotionPrior(STEP, 0.02**2 * np.eye(6))
    start = keyframe(0, poses)
    reference = keyframe(3, poses)
    assert not contradicts_path(motion, start, reference, loose)


@pytest.mark.slow
def test_a_corrected_path_goes_on_from_the_keyframe_that_corrects_it() -> None:
    """Slow things lead it away by a centimetre in each of the first steps."""
    frames, poses = slow_walk.frames("light", seed=7, count=16)
    vo = hvo.Odometry()
    vo.set_pose(poses[0])
    steps = [vo.track(frame) for frame in frames]
    correction = next(s for s in steps[2:] if s.prev_index < s.index - 1)
    for step in steps[correction.index :]:
        true = invert(poses[step.index]) @ poses[step.prev_index]
        np.testing.assert_allclose(step.T_curr_prev, true, atol=0.01)
        held = {keyframe.count for keyframe in vo.state.keyframes}
        # what was taken on the wrong path is no longer a start
        assert not held & set(range(correction.prev_index + 1, correction.index))
