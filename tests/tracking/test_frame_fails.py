"""A frame in which something breaks leaves the tracker as it was."""

from __future__ import annotations

import pytest

import hybridvo as hvo
from hybridvo.evidence import one_time
from hybridvo.tracking import step
from tests.late_depth import rolling_frames


@pytest.mark.parametrize(
    ("room", "broken", "number"),
    [
        (one_time, "follow_roughly", 2),
        (step, "keep", 2),
        # its stamp jumps back, so that no velocity is known
        (step, "keep", 0),
    ],
)
def test_a_tracker_is_as_it_was(
    monkeypatch, room, broken: str, number: int
) -> None:
    frames = rolling_frames(1, 20.0, 12.0, 3)
    tracker = hvo.Odometry()
    for frame in frames[:2]:
        tracker.track(frame)
    before = tracker.state

    def breaks(*_: object) -> None:
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(room, broken, breaks)
        with pytest.raises(KeyboardInterrupt):
            tracker.track(frames[number])
    assert tracker.state is before
    assert tracker.track(frames[2]).ok
