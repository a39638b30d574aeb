"""Where a motion is ambiguous, both motions are handed out, each with its own odds."""

from __future__ import annotations

import numpy as np
import pytest

import hybridvo as hvo
from hybridvo.core.geometry import invert, se3_exp, se3_log
from hybridvo.core.results import Reason, RelativePose, Rival, Status
from hybridvo.hypotheses.select import ChoiceEvidence
from hybridvo.judge.verdict import _as_probable_as_stated
from hybridvo.tracking.keyframes import Keyframe, between_frames
from hybridvo_lab.synthetic.noise_scenarios import make_pair

STEP = se3_exp(np.array([0.05, 0, 0, 0, 0.02, 0]))
OTHER = se3_exp(np.array([0, 0.1, 0, 0, 0, 0.05]))
EVIDENCE = ChoiceEvidence(-0.2, -0.2, -1.0, -0.7)


def ambiguous(probability: float = 0.6) -> RelativePose:
    """A motion that may be another one."""
    return RelativePose(
        STEP,
        1e-6 * np.eye(6),
        Status.degraded(Reason.AMBIGUOUS_MOTION, "two motions"),
        rivals=(Rival(OTHER, 4e-6 * np.eye(6), EVIDENCE),),
        probability=probability,
    )


def test_both_motions_keep_their_own_covariance() -> None:
    motion = _as_probable_as_stated(ambiguous())
    itself, other = motion.rivals
    np.testing.assert_array_equal(itself.covariance, 1e-6 * np.eye(6))
    np.testing.assert_array_equal(other.covariance, 4e-6 * np.eye(6))
    np.testing.assert_array_equal(other.T_curr_prev, OTHER)
    # the motion's own covariance covers both
    apart = se3_log(OTHER @ invert(STEP))
    assert apart @ np.linalg.solve(motion.covariance, apart) < 6


@pytest.mark.parametrize("probability", [0.06, 0.5, 0.89])
def test_their_probabilities_are_those_of_two_that_exclude_each_other(
    probability: float,
) -> None:
    itself, other = _as_probable_as_stated(ambiguous(probability)).rivals
    assert itself.probability == probability
    assert 0 < other.probability <= 1 - probability


def test_a_motion_that_is_not_ambiguous_has_no_rivals() -> None:
    sure = ambiguous().replace(status=Status(), probability=0.95)
    assert _as_probable_as_stated(sure).rivals == ()
    lonely = ambiguous().replace(rivals=())
    assert _as_probable_as_stated(lonely).rivals == ()


def test_rivals_of_a_keyframe_start_from_the_frame_before_as_well() -> None:
    camera = hvo.Camera(100.0, 100.0, 31.5, 23.5, height=48, width=64)
    depth = np.full(camera.shape, 2.0, np.float32)
    frame = hvo.Frame(np.zeros((48, 64, 3), np.uint8), depth, camera)
    T_prev_key = se3_exp(np.array([0.1, 0, 0, 0, 0.1, 0]))
    key = Keyframe(frame, np.eye(4), 0, 0, np.zeros((6, 6)))
    previous = Keyframe(frame, invert(T_prev_key), 1, 0, 1e-6 * np.eye(6))
    motion = ambiguous()
    found = between_frames(motion, key, previous)
    alone = between_frames(
        motion.replace(T_curr_prev=OTHER, covariance=4e-6 * np.eye(6)),
        key,
        previous,
    )
    (rival,) = found.rivals
    np.testing.assert_allclose(rival.T_curr_prev @ T_prev_key, OTHER, atol=1e-12)
    np.testing.assert_array_equal(rival.covariance, alone.covariance)


def test_the_truth_is_one_of_two_motions_that_are_as_likely() -> None:
    """Seven tenths of the view move: nothing in the pair says which part is the scene."""
    pair, truth = make_pair("moving70", 0, 218, 512)
    motion = hvo.estimate(pair, method="hybrid-flow")
    assert motion.status.reason is Reason.AMBIGUOUS_MOTION
    assert len(motion.rivals) == 2
    lengths = [
        np.linalg.norm(se3_log(each.T_curr_prev @ invert(truth["T_curr_prev"])))
        for each in motion.rivals
    ]
    assert min(lengths) < 0.01
    assert max(lengths) > 5 * min(lengths)
