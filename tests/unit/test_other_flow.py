"""``pwvo-refine`` goes on with other flow of the images where its first answer is not sure."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np
import pytest

from hybridvo import pipeline
from hybridvo.geometry import se3_exp
from hybridvo.pipeline import Attempt, Context, surest_in_torch
from hybridvo.results import Reason, RelativePose, StageFailed, Status
from hybridvo.types import FramePair
from tests import worlds

OK = Status()
UNSURE = Status.degraded(Reason.AMBIGUOUS_MOTION, "which one")
GUIDE = se3_exp(np.array([0.1, 0.0, 0.0, 0.0, 0.0, 0.0]))
PAIR = worlds.world((24, 32))[0]
OTHERS = [replace(PAIR, flow=PAIR.flow + k) for k in (1, 2)]


class Scripted:
    """Answers with one status for each pair with flow; None: the stage fails."""

    def __init__(self, *answers: Status | None) -> None:
        pairs = (PAIR, *OTHERS)
        self.answers = {id(p): a for p, a in zip(pairs, answers, strict=False)}
        self.starts: list[list[np.ndarray]] = []

    def __call__(
        self, pair: FramePair, ctx: Context, starts: tuple[np.ndarray, ...] = ()
    ) -> RelativePose:
        number = len(self.starts)
        self.starts.append(list(starts))
        status = self.answers[id(pair)]
        if status is None:
            raise StageFailed(Reason.NO_FLOW, f"failure {number}")
        T = se3_exp(np.full(6, 0.01 * (number + 1)))
        return RelativePose(T, status=status, probability=0.5)


def answer(
    monkeypatch: pytest.MonkeyPatch, *answers: Status | None
) -> tuple[pipeline.OnFlow, Scripted]:
    scripted = Scripted(*answers)
    monkeypatch.setattr(pipeline, "refined_in_torch", scripted)
    others = (Attempt(other, GUIDE) for other in OTHERS)
    return surest_in_torch(PAIR, others, Context()), scripted


def test_other_flow_is_not_computed_for_a_sure_answer(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    def never() -> Iterator[Attempt]:
        raise AssertionError("drawn")
        yield

    monkeypatch.setattr(pipeline, "refined_in_torch", Scripted(OK))
    assert surest_in_torch(PAIR, never(), Context()).pair is PAIR


def test_a_sure_answer_on_other_flow_takes_the_place_of_one_that_is_not(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    found, scripted = answer(monkeypatch, UNSURE, OK)
    assert found.pair is OTHERS[0] and found.found.ok
    # where the flow was found from, and what the first look found
    first, second = scripted.starts[1]
    np.testing.assert_array_equal(first, GUIDE)
    np.testing.assert_array_equal(second, se3_exp(np.full(6, 0.01)))


def test_where_none_is_sure_the_first_stands(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    found, scripted = answer(monkeypatch, UNSURE, UNSURE, UNSURE)
    assert found.pair is PAIR
    assert len(scripted.starts) == 3


def test_an_unsure_answer_is_better_than_none(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    found, scripted = answer(monkeypatch, None, UNSURE, UNSURE)
    assert found.pair is OTHERS[0]
    assert len(scripted.starts[1]) == 1


def test_the_failure_is_that_of_the_first_flow(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    with pytest.raises(StageFailed, match="failure 0"):
        answer(monkeypatch, None, None, None)
