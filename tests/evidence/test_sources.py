"""In which order the sources of motions are asked about the starts of a tracker."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import pytest

from hybridvo import pipeline
from hybridvo.core.geometry import se3_exp
from hybridvo.core.results import Reason, RelativePose, StageFailed, Status
from hybridvo.core.types import FramePair
from hybridvo.evidence.pair import PairEvidence
from hybridvo.odometry import Odometry
from hybridvo.pipeline import Context, by_first_source, first_sure
from hybridvo_lab.synthetic.scenes import make_scene

STEP = se3_exp(np.array([0.005, 0, 0, 0, 0, 0]))
DOUBTFUL = Status.degraded(Reason.AMBIGUOUS_MOTION, "by hand")
SOURCES = ("images", "flow", "matches")


class Asked:
    """A method of three sources, which notes what it is asked; one answer is sure."""

    def __init__(self) -> None:
        self.calls: list[tuple[int, str]] = []
        self.sure: tuple[int, str] | None = None
        self.nothing: tuple[str, ...] = ()

    def __call__(
        self, evidence: PairEvidence, ctx: Context
    ) -> Iterator[RelativePose | None]:
        for source in SOURCES:
            call = (evidence.pair.prev.index, source)
            self.calls.append(call)
            if source in self.nothing:
                yield None
                continue
            is_sure = self.sure is None or call == self.sure
            status = Status() if is_sure else DOUBTFUL
            motion = RelativePose(STEP, status=status, probability=0.5)
            yield motion


@pytest.fixture
def asked(monkeypatch: pytest.MonkeyPatch) -> Asked:
    method = Asked()
    # images and flow
    asked = pipeline.Method(method, cheap_rounds=2)
    monkeypatch.setitem(pipeline.METHODS, "classical", asked)
    return method


def after_three_frames() -> tuple[Odometry, object]:
    scene = make_scene("static", 0, height=48, width=64, frames=4)
    frames = [scene.render(number) for number in range(4)]
    odometry = Odometry(network=None)
    for frame in frames[:3]:
        odometry.track(frame)
    return odometry, frames[3]


def test_each_source_is_asked_about_all_starts_before_the_next(asked: Asked):
    odometry, frame = after_three_frames()
    asked.calls.clear()
    asked.sure = (0, "matches")
    assert odometry.track(frame).motion.ok
    assert asked.calls == [
        (0, "images"),
        (2, "images"),
        (0, "flow"),
        (2, "flow"),
        (0, "matches"),
    ]


def test_a_source_without_an_answer_does_not_hand_the_turn_to_the_next(
    asked: Asked,
):
    odometry, frame = after_three_frames()
    asked.calls.clear()
    asked.nothing = ("images",)
    asked.sure = (2, "flow")
    assert odometry.track(frame).motion.ok
    assert asked.calls[:3] == [(0, "images"), (2, "images"), (0, "flow")]


def test_the_first_sure_motion_ends_the_search(asked: Asked):
    odometry, frame = after_three_frames()
    asked.calls.clear()
    asked.sure = (2, "images")
    step = odometry.track(frame)
    assert step.motion.ok
    assert asked.calls == [(0, "images"), (2, "images")]


def test_what_a_later_source_says_replaces_what_an_earlier_one_said(
    monkeypatch: pytest.MonkeyPatch,
):
    """The answer after the last source rests on all of them, however sure one alone was."""
    surer = RelativePose(STEP, status=DOUBTFUL, probability=0.8)
    last = RelativePose(np.eye(4), status=DOUBTFUL, probability=0.3)

    def method(evidence: PairEvidence, ctx: Context) -> Iterator[RelativePose]:
        yield surer
        yield last

    monkeypatch.setitem(pipeline.METHODS, "identity", pipeline.Method(method))
    _, motion = first_sure([evidence_of_a_pair()], "identity", Context())
    assert motion.probability == 0.3


def test_a_stage_that_fails_becomes_a_status(monkeypatch: pytest.MonkeyPatch):
    def method(evidence: PairEvidence, ctx: Context) -> Iterator[RelativePose]:
        raise StageFailed(Reason.NO_FLOW, "by hand")
        yield

    monkeypatch.setitem(pipeline.METHODS, "identity", pipeline.Method(method))
    _, motion = first_sure([evidence_of_a_pair()], "identity", Context())
    assert not motion.usable
    assert motion.status.reason is Reason.NO_FLOW
    assert motion.method == "identity"


@pytest.mark.parametrize("nothing", [(), ("images",)])
def test_the_first_source_alone_signs_its_motion(asked: Asked, nothing):
    """As a motion by all sources does: a step from an earlier place names its method."""
    asked.nothing = nothing
    motion = by_first_source(evidence_of_a_pair(), "classical", Context())
    assert [source for _, source in asked.calls] == ["images"]
    assert motion.usable == (not nothing)
    assert motion.method == "classical"
    assert motion.ms > 0


def evidence_of_a_pair() -> PairEvidence:
    scene = make_scene("static", 0, height=48, width=64, frames=2)
    pair = FramePair(scene.render(0), scene.render(1), None)
    return Context().evidence(pair)
