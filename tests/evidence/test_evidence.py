"""What is known of a pair reaches the answer: prior, images, rivals, and how sure a choice was.

Each test fails where one line that hands something on is taken away.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np
import pytest

import hybridvo
from hybridvo import pipeline
from hybridvo.core.geometry import ego_flow, invert, se3_exp, se3_log
from hybridvo.core.options import TrackOptions
from hybridvo.core.results import MotionPrior, Reason, RelativePose
from hybridvo.core.types import Camera, Frame, FramePair
from hybridvo.evidence.pair import PairEvidence
from hybridvo_lab.synthetic.noise_scenarios import Scenario, make_pair
from hybridvo_lab.synthetic.render import SyntheticSequence
from hybridvo_lab.synthetic.scenes import make_scene
from tests import worlds

SIZE = {"height": 96, "width": 224}


# The tracker's prior


class Recorder:
    """A method that keeps the priors that it is given, and answers with one motion a frame."""

    motion = se3_exp(np.array([0.03, -0.02, 0.08, 0.004, -0.006, 0.003]))

    def __init__(self) -> None:
        self.priors: list[MotionPrior | None] = []

    def __call__(
        self, evidence: PairEvidence, ctx: pipeline.Context
    ) -> Iterator[RelativePose]:
        self.priors.append(evidence.expected)
        pair = evidence.pair
        frames = pair.curr.index - pair.prev.index
        yield RelativePose(np.linalg.matrix_power(self.motion, frames))


def priors_of(
    monkeypatch: pytest.MonkeyPatch, motion_prior: bool
) -> list[MotionPrior | None]:
    """The priors of frame 1, of frame 2, and of frame 4, before which one was lost."""
    recorder = Recorder()
    monkeypatch.setitem(pipeline.METHODS, "identity", pipeline.Method(recorder))
    options = hybridvo.Options(track=TrackOptions(motion_prior=motion_prior))
    vo = hybridvo.Odometry(method="identity", options=options)
    camera = Camera(60, 60, 31.5, 23.5, height=48, width=64)
    frame = Frame(
        np.zeros((48, 64, 3), np.uint8), np.ones((48, 64), np.float32), camera
    )
    for index in (0, 1, 2):
        vo.track(replace(frame, index=index, timestamp=0.1 * index))
    vo.skip(3, 0.3)
    vo.track(replace(frame, index=4, timestamp=0.4))
    return recorder.priors


def test_the_tracker_hands_the_expected_motion_to_the_method(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    first, second, spanning = priors_of(monkeypatch, motion_prior=True)
    assert first is None
    assert second is not None and spanning is not None
    np.testing.assert_allclose(second.T_curr_prev, Recorder.motion, atol=1e-12)
    twice = Recorder.motion @ Recorder.motion
    np.testing.assert_allclose(spanning.T_curr_prev, twice, atol=1e-12)


def test_the_option_keeps_the_expected_motion_back(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    assert priors_of(monkeypatch, motion_prior=False) == [None, None, None]


def test_a_prior_that_is_handed_in_decides_between_two_motions() -> None:
    pair, T_camera = worlds.world(
        noise=(0.1, 0.002), texture=False, second_depth=False
    )
    T_other = se3_exp(np.array([0.1, 0.03, 0.0, 0.0, 0.0, 0.03])) @ T_camera
    # of each motion every second stripe
    cameras = (pair.prev.camera, pair.curr.camera)
    flow = np.array(pair.flow)
    stripes = np.arange(flow.shape[1]) // 16 % 2 == 1
    noise = flow - ego_flow(pair.prev.depth, T_camera, *cameras)
    of_other = ego_flow(pair.prev.depth, T_other, *cameras) + noise
    flow[:, stripes] = of_other[:, stripes]

    def tracked(T_expected: np.ndarray) -> np.ndarray:
        vo = hybridvo.Odometry(method="classical")
        vo.track(pair.prev)
        prior = MotionPrior(T_expected, np.diag([1e-4] * 3 + [1e-6] * 3))
        return vo.track(pair.curr, flow, prior).T_curr_prev

    for expected in (T_camera, T_other):
        worlds.assert_pose_close(tracked(expected), expected, rad=2e-3, m=0.01)


# Rivals and probability


def with_one_object(fraction: float, seed: int) -> tuple[FramePair, dict]:
    """A pair of which one object holds a share of the pixels."""
    scenario = Scenario(
        moving=fraction, objects=1, flow_noise_px=0.3, depth_noise=0.01
    )
    return make_pair(scenario, seed, **SIZE)


def test_the_covariance_of_an_ambiguous_motion_reaches_its_rivals() -> None:
    pair, _ = with_one_object(0.6, 3)
    found = hybridvo.estimate(pair, method="classical")
    assert found.status.reason is Reason.AMBIGUOUS_MOTION
    rival = found.hypotheses[1].T_curr_prev
    away = se3_log(found.T_curr_prev @ invert(rival))
    # if it is wrong, which has the probability 1 - p, it is off by that much: second moments
    doubt = 1 - found.probability
    variance = np.diag(found.covariance)
    assert (variance[:3] > doubt * np.sum(away[:3] ** 2)).all()
    assert (variance[3:] > doubt * np.sum(away[3:] ** 2)).all()
    # of the fit alone the variances are thousands of times smaller
    assert away @ np.linalg.solve(found.covariance, away) < 2 / doubt


@pytest.mark.parametrize("method", ["classical", "hybrid-flow", "pwvo-refine"])
def test_the_probability_tells_a_clear_choice_from_a_doubtful_one(
    method: str,
) -> None:
    clear, _ = with_one_object(0.3, 5)
    sure = hybridvo.estimate(clear, method=method)
    assert sure.ok and sure.probability > 0.9
    # one object holds 90 %
    unclear, _ = with_one_object(0.9, 5)
    unsure = hybridvo.estimate(unclear, method=method)
    assert unsure.status.reason is Reason.AMBIGUOUS_MOTION
    assert unsure.probability < sure.probability - 0.08


# Flow and images


@pytest.fixture(scope="module")
def rendered() -> FramePair:
    """Two neighbours of a rendered static scene, with DIS flow that is said to come from a file."""
    sequence = SyntheticSequence(
        make_scene("static", 3, height=144, width=320, frames=6)
    )
    prev = sequence.frame(0)
    curr = sequence.frame(1)
    field = hybridvo.dis_flow()(prev, curr)
    return FramePair(prev, curr, field.flow, field.variance, field.valid, "file")


@pytest.mark.parametrize("factor", [-1.0, 2.0, 3.0])
def test_hybrid_holds_a_given_flow_against_the_images(
    rendered: FramePair, factor: float
) -> None:
    """Flow and depth alone would be sure of a motion of the wrong sign or length."""
    assert hybridvo.estimate(rendered).ok
    wrong = replace(rendered, flow=np.float32(factor) * rendered.flow)
    prev = replace(wrong.prev, rgb=None)
    curr = replace(wrong.curr, rgb=None, depth=None)
    assert hybridvo.estimate(replace(wrong, prev=prev, curr=curr)).ok
    assert not hybridvo.estimate(wrong).ok
