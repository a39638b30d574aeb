"""Flow that is computed beside other work."""

from __future__ import annotations

import threading

import numpy as np
import pytest

from hybridvo.core.results import Term
from hybridvo.core.types import Frame
from hybridvo.flow.providers import FlowAhead, FlowField
from hybridvo.pipeline import Context
from hybridvo.tracking.keyframes import Keyframe
from hybridvo.tracking.search import Arrival, Pairs, Setup
from hybridvo.tracking.tracker_state import TrackerState
from tests import worlds


class Provider:
    """Counts its calls, and in which thread they come."""

    def __init__(self, source: str = "dis") -> None:
        self.source = source
        self.threads: list[threading.Thread] = []

    def __call__(self, prev: Frame, curr: Frame) -> FlowField:
        self.threads.append(threading.current_thread())
        flow = np.full((*prev.camera.shape, 2), len(self.threads), np.float32)
        return FlowField(flow, source=self.source)


def frame() -> Frame:
    shape = (4, 5)
    return Frame(None, np.ones(shape, np.float32), worlds.camera(shape))


def test_the_flow_of_the_pair_is_computed_once_on_another_thread():
    provider = Provider()
    prev = frame()
    curr = frame()
    with FlowAhead(provider, prev, curr) as ahead:
        assert ahead.source == "dis"
        assert ahead(prev, curr).flow[0, 0, 0] == 1
        assert ahead(prev, curr).flow[0, 0, 0] == 1
        # any other pair is computed at once
        assert ahead(curr, prev).flow[0, 0, 0] == 2
    first, second = provider.threads
    assert first is not threading.current_thread()
    assert second is threading.current_thread()


def test_an_error_of_the_provider_comes_where_its_flow_is_wanted():
    def broken(prev: Frame, curr: Frame) -> FlowField:
        raise RuntimeError("out of order")

    prev = frame()
    curr = frame()
    with FlowAhead(broken, prev, curr) as ahead, pytest.raises(RuntimeError):
        ahead(prev, curr)


@pytest.mark.parametrize(
    ("source", "expects_flow", "calls"),
    [("dis", True, 1), ("dis", False, 0), ("my network", True, 0)],
)
def test_only_our_flow_is_computed_ahead_and_only_where_it_is_expected(
    source: str, expects_flow: bool, calls: int
):
    provider = Provider(source)
    setup = Setup("hybrid", Context(flow=provider))
    before = Keyframe(frame(), np.eye(4), 0, 0, np.zeros((6, 6)))
    found_by = (Term.FLOW,) if expects_flow else ()
    state = TrackerState(before, count=1, found_by=found_by)
    with Pairs(setup, state, Arrival(frame())).flow_ahead():
        pass
    assert len(provider.threads) == calls
