"""In which order a tracker tries its starts, by flow and by sparse matches."""

from __future__ import annotations

import numpy as np
import pytest

from hybridvo import pipeline
from hybridvo.geometry import se3_exp
from hybridvo.odometry import Odometry
from hybridvo.pipeline import Effort
from hybridvo.results import Reason, RelativePose, Status
from hybridvo.synthetic.scenes import make_scene

STEP = se3_exp(np.array([0.005, 0, 0, 0, 0, 0]))
DOUBTFUL = RelativePose(
    T_curr_prev=STEP, status=Status.degraded(Reason.AMBIGUOUS_MOTION, "by hand")
)


@pytest.fixture
def tried(monkeypatch: pytest.MonkeyPatch):
    """The starts and efforts of the last frame; its motion is ok where they are the wanted."""
    calls: list[tuple[int, Effort]] = []
    wanted: list[tuple[int, Effort]] = []

    def run_method(pair, method, ctx):
        call = (pair.prev.index, ctx.effort)
        calls.append(call)
        is_ok = not wanted or call in wanted
        return RelativePose(T_curr_prev=STEP) if is_ok else DOUBTFUL

    monkeypatch.setattr(pipeline, "run_method", run_method)
    return calls, wanted


def after_three_frames(method: str) -> tuple[Odometry, object]:
    scene = make_scene("static", 0, height=48, width=64, frames=4)
    frames = [scene.render(number) for number in range(4)]
    odometry = Odometry(method=method)
    for frame in frames[:3]:
        odometry.track(frame)
    return odometry, frames[3]


def test_matches_are_sought_only_after_every_start_was_tried_by_flow(tried):
    calls, wanted = tried
    odometry, frame = after_three_frames("hybrid")
    calls.clear()
    wanted.append((0, Effort.ONLY_WIDE))
    assert odometry.track(frame).motion.ok
    assert calls == [
        (0, Effort.ONLY_NEAR),
        (2, Effort.ONLY_NEAR),
        (0, Effort.ONLY_WIDE),
    ]


def test_the_first_sure_motion_ends_the_search(tried):
    calls, wanted = tried
    odometry, frame = after_three_frames("hybrid")
    calls.clear()
    wanted.append((2, Effort.ONLY_NEAR))
    assert odometry.track(frame).motion.ok
    assert calls == [(0, Effort.ONLY_NEAR), (2, Effort.ONLY_NEAR)]


def test_a_method_without_matches_tries_each_start_once(tried):
    calls, wanted = tried
    odometry, frame = after_three_frames("classical")
    calls.clear()
    wanted.append((-1, Effort.ALL))
    odometry.track(frame)
    assert calls == [(0, Effort.ALL), (2, Effort.ALL)]
