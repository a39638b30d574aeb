"""What the time of a frame goes to: stages count for themselves, in the thread that is watched."""

from __future__ import annotations

import pytest

import hybridvo as hvo
from hybridvo.core import stages
from hybridvo.core.stages import STAGES, stage, stage_times
from hybridvo.run.commands.diagnosis.speed import measure
from hybridvo_lab.synthetic.scenes import make_scene


class Clock:
    """In place of ``time.perf_counter``: it stands still unless it is moved."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.now = 0.0
        monkeypatch.setattr(stages.time, "perf_counter", lambda: self.now)

    def work(self, ms: float) -> None:
        self.now += 1e-3 * ms


def test_a_stage_inside_another_one_counts_for_it_alone(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    clock = Clock(monkeypatch)
    with stage_times() as times, stage("look"):
        clock.work(5)
        with stage("search"):
            clock.work(7)
        clock.work(11)
        with stage("search"):
            clock.work(13)
    assert times.rounded() == {"look": 16.0, "search": 20.0}


def test_a_stage_ends_where_its_function_fails(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    clock = Clock(monkeypatch)

    @stage("flow")
    def fails() -> None:
        clock.work(3)
        raise ValueError

    with stage_times() as times:
        for _ in range(2):
            with pytest.raises(ValueError):
                fails()
        with stage("judge"):
            clock.work(4)
    assert times.rounded() == {"flow": 6.0, "judge": 4.0}


@pytest.mark.parametrize(
    ("method", "expected"),
    [
        ("hybrid", {"images alone", "judge", "memory", "other"}),
        ("hybrid-flow", {"flow", "search", "look", "solve", "judge", "other"}),
    ],
)
def test_the_stages_are_those_that_a_method_has(
    method: str, expected: set[str]
) -> None:
    scene = make_scene("static", 0, height=96, width=128, frames=3)
    tracker = hvo.Odometry(method=method)
    report = measure(tracker, (scene.render(k) for k in range(3)))
    assert report["motions"] == 2
    assert expected <= set(report["stages"]) <= set(STAGES)
    assert report["stages"]["reading"]["mean_ms"] > 0
    # the first motion of a tracker is by flow in any case
    assert (
        report["stages"]["flow"]["frames"]
        == {"hybrid": 1, "hybrid-flow": 2}[method]
    )
    # reading comes before the frame
    inside = [
        stage for name, stage in report["stages"].items() if name != "reading"
    ]
    total = sum(stage["frames"] * stage["mean_ms"] for stage in inside)
    assert total <= report["motions"] * report["frame_ms"]["mean_ms"] + 0.1
