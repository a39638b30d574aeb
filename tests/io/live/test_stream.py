"""The stream of a camera: the newest frame counts, and whatever breaks is said and survived."""

from __future__ import annotations

import threading
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

import hybridvo as hvo
from hybridvo.io.cameras.base import Reading
from hybridvo.io.live import (
    MAX_OLD_FRAMES,
    MAX_STANDING_STAMPS,
    LiveStep,
    LiveStream,
    Patience,
    stream,
)
from hybridvo.tracking.camera_drift import Mean
from tests.io.live.scripted import (
    LONG_S,
    QUICK,
    OpenFails,
    ScriptedCamera,
    Tracker,
    reading,
)


def run(
    camera: ScriptedCamera,
    tracker: Tracker | None = None,
    patience: Patience = QUICK,
    **more: Any,
) -> tuple[LiveStream, list[LiveStep], list[str]]:
    """Follow a script to its end; returns the stream, its steps and what it said."""
    said: list[str] = []
    steps = stream(
        camera, tracker or Tracker(), say=said.append, patience=patience, **more
    )
    camera.stream = steps
    found = list(steps)
    assert not steps._reader.is_alive()
    return steps, found, said


def test_every_frame_of_a_calm_camera_is_tracked() -> None:
    stamps = [5.0, 5.1, 5.2]
    camera = ScriptedCamera(*(reading(stamp) for stamp in stamps))
    steps, found, said = run(camera)
    assert [live.step.timestamp for live in found] == stamps
    assert [live.frame.timestamp for live in found] == stamps
    assert camera.calls == ["open", "close"]
    assert said == []
    assert steps.ended == "end of the recording"
    assert (steps.counts.tracked, steps.counts.dropped) == (3, 0)


def test_the_newest_frame_counts_and_none_queues() -> None:
    tracked = threading.Event()
    given = threading.Event()
    tracker = Tracker()

    def busy(count: int) -> None:
        """The tracker is at work until three more frames have come."""
        if count == 1:
            tracked.set()
            assert given.wait(LONG_S)

    def wait() -> None:
        assert tracked.wait(LONG_S)

    tracker.on_track = busy
    later = [reading(0.1 * i) for i in (1, 2, 3)]
    camera = ScriptedCamera(reading(0.0), wait, *later, given.set, hasty=True)
    steps, found, _ = run(camera, tracker)
    assert [live.step.timestamp for live in found] == pytest.approx([0.0, 0.3])
    assert steps.counts.replaced == 2
    assert found[-1].dropped == 2


def test_gaps_in_the_cameras_count_are_dropped_frames() -> None:
    numbers = [7, 8, 11, 12]
    script = [reading(0.1 * n, number=n) for n in numbers]
    # a camera that starts anew counts anew
    again = [reading(2.0, number=1), reading(2.1, number=3)]
    camera = ScriptedCamera(*script, RuntimeError("unplugged"), *again)
    steps, found, _ = run(camera)
    assert len(found) == 6
    assert steps.counts.missed == 2 + 1


def test_a_lost_camera_is_opened_again() -> None:
    script = [
        reading(0.0),
        RuntimeError("unplugged"),
        OpenFails(OSError("no such\ndevice")),
        OpenFails(OSError("no such device")),
        reading(0.4),
    ]
    camera = ScriptedCamera(*script)
    steps, found, said = run(camera)
    assert len(found) == 2
    assert camera.calls == ["open", "close"] * 4
    assert steps.counts.lost == 1
    assert said == [
        "scripted: unplugged; next attempt in 0.001 s",
        "scripted: no such device; next attempt in 0.002 s",
        "scripted: no such device; next attempt in 0.004 s",
        "scripted: frames again",
    ]


def test_a_camera_that_falls_silent_is_opened_again() -> None:
    camera = ScriptedCamera(reading(0.0), None, reading(0.1))
    _, found, said = run(camera, patience=replace(QUICK, silence_s=-1.0))
    assert len(found) == 2
    assert camera.calls == ["open", "close"] * 2
    assert "no frames for -1 s" in said[0]


def test_a_camera_that_stays_away_ends_the_stream() -> None:
    class Absent(ScriptedCamera):
        def read(self, timeout_s: float) -> None:
            threading.Event().wait(0.001)

    steps, found, _ = run(Absent(), patience=replace(QUICK, absence_s=0.05))
    assert found == []
    assert steps.ended == "no frames for 0.05 s"


def test_a_driver_that_hangs_is_left_alone() -> None:
    release = threading.Event()
    camera = ScriptedCamera(reading(0.0), lambda: release.wait(LONG_S) and None)
    patience = replace(QUICK, absence_s=0.05, closing_s=0.01)
    said: list[str] = []
    steps = stream(camera, Tracker(), say=said.append, patience=patience)
    camera.stream = steps
    assert len(list(steps)) == 1
    assert said[-1] == "scripted: does not stop; left to itself"
    release.set()
    steps._reader.join(LONG_S)
    assert camera.calls == ["open", "close"]


def test_an_input_error_later_is_a_lost_camera() -> None:
    script = [reading(0.0), hvo.InputError("odd frame"), reading(0.1)]
    _, found, said = run(ScriptedCamera(*script))
    assert len(found) == 2
    assert said[0].startswith("scripted: odd frame; next attempt")


def test_frames_without_depth_are_said_once_and_survived() -> None:
    dark = [reading(0.1 * i, depth=None) for i in range(2)]
    more = [reading(0.3), reading(0.4, depth=None), reading(0.5, depth=0.0)]
    steps, found, said = run(ScriptedCamera(*dark, *more, reading(0.6)))
    # nothing can start from the first two
    assert [live.step.timestamp for live in found] == [0.3, 0.4, 0.5, 0.6]
    assert [live.step.usable for live in found] == [True, False, True, True]
    assert steps.counts.without_depth == 4
    assert steps.counts.failed == 1
    assert (
        said
        == [
            "scripted: frames without depth",
            "scripted: depth is back after 2 frames",
        ]
        * 2
    )


def test_the_run_ends_where_no_files_come_back() -> None:
    """After the documented time, although the recording goes on."""
    passed = [0.0]
    camera = ScriptedCamera(reading(0.0))

    def gone() -> Reading:
        passed[0] += 1
        camera.script.append(gone)
        return Reading(None, note="files are gone since frame 1", is_gone=True)

    camera.script.append(gone)
    said: list[str] = []
    camera.stream = steps = LiveStream(
        camera,
        Tracker(),
        seconds=None,
        max_frames=None,
        stop=lambda: False,
        say=said.append,
        patience=replace(QUICK, absence_s=60.0, max_age_s=np.inf),
        clock=lambda: passed[0],
    )
    assert len(list(steps)) == 1
    assert steps.ended == "no frames for 60 s"
    assert said == ["scripted: files are gone since frame 1"]


@pytest.mark.parametrize("jump", [-400.0, 400.0])
def test_a_clock_that_jumps_is_said_and_stamps_go_on(jump: float) -> None:
    stamps = [500.0, 500.03, 500.06 + jump, 500.09 + jump, 500.12 + jump]
    camera = ScriptedCamera(*(reading(stamp) for stamp in stamps))
    steps, found, said = run(camera)
    seen = np.array([live.step.timestamp for live in found])
    assert steps.counts.clock_jumps == 1
    text = said[0].partition("its clock jumped by ")[2].split()[0]
    assert float(text) == pytest.approx(jump, abs=0.5)
    assert len(seen) == 5
    assert (np.diff(seen) > 0).all()
    # after the jump the intervals are the camera's again
    assert np.diff(seen)[2:] == pytest.approx([0.03, 0.03])
    # and the jump itself takes as long as it took by our clock
    assert np.diff(seen)[1] < 1


def test_a_frame_that_comes_twice_is_dropped() -> None:
    script = [reading(0.0), reading(0.0), reading(0.1), reading(0.05)]
    steps, found, _ = run(ScriptedCamera(*script))
    assert [live.step.timestamp for live in found] == [0.0, 0.1]
    assert steps.counts.repeated == 2


def test_a_clock_that_stands_still_does_not_slow_a_camera_down() -> None:
    stands = [reading(7.0) for _ in range(30)]
    steps, found, said = run(ScriptedCamera(reading(6.97), *stands))
    assert steps.counts.repeated < MAX_STANDING_STAMPS
    assert steps.counts.tracked > 25
    assert steps.counts.clock_jumps == 0
    assert (np.diff([live.step.timestamp for live in found]) > 0).all()
    assert len(said) == 1
    assert "do not rise; from now on a frame's stamp is when it came" in said[0]


def test_old_frames_are_dropped_until_it_is_the_camera_that_is_slow() -> None:
    patience = replace(QUICK, max_age_s=LONG_S / 2)
    fresh = [reading(0.0)]
    old = [reading(0.05 * i, age_s=LONG_S) for i in range(1, 3 + MAX_OLD_FRAMES)]
    steps, found, said = run(ScriptedCamera(*fresh, *old), patience=patience)
    assert steps.counts.old == MAX_OLD_FRAMES
    assert len(found) == 1 + 2
    assert found[-1].age_s >= LONG_S
    assert len(said) == 1 and "every frame is old" in said[0]


def test_the_age_counts_from_the_exposure() -> None:
    steps, found, _ = run(ScriptedCamera(reading(0.0, age_s=20.0)))
    assert 20.0 <= found[0].age_s < 20.0 + LONG_S
    assert steps.age_ms(50) == pytest.approx(1000 * found[0].age_s)
    # a clock that is ahead of ours makes no pose younger than its arrival
    _, found, _ = run(ScriptedCamera(reading(0.0, age_s=-20.0)))
    assert found[0].age_s >= 0


def test_images_of_another_size_start_anew_at_the_last_pose() -> None:
    other = hvo.Camera(fx=50, fy=50, cx=3.5, cy=3.5, height=8, width=8)
    tracker = Tracker()
    script = [reading(0.0), reading(0.1), reading(0.2, camera=other)]
    _, found, said = run(ScriptedCamera(*script), tracker)
    assert len(found) == 3
    assert len(said) == 1 and "another size" in said[0]
    assert tracker.set_poses[0][0, 3] == 2.0


def test_it_ends_after_so_many_frames_and_closes_the_camera() -> None:
    camera = ScriptedCamera(*(reading(0.1 * i) for i in range(9)))
    steps, found, _ = run(camera, max_frames=2)
    assert len(found) == 2
    assert steps.ended == "2 frames"
    assert camera.calls[-1] == "close"


def test_it_ends_after_some_seconds() -> None:
    class Endless(ScriptedCamera):
        stamp = 0.0

        def read(self, timeout_s: float) -> Reading:
            self.stamp += 0.1
            threading.Event().wait(0.001)
            return reading(self.stamp)

    steps, found, _ = run(Endless(), seconds=0.02)
    assert found
    assert steps.ended == "0.02 s"


def test_it_ends_when_asked_and_when_left() -> None:
    asked = threading.Event()
    camera = ScriptedCamera(reading(0.0), asked.set, *[None] * 3)
    steps, found, _ = run(camera, stop=asked.is_set)
    assert len(found) <= 1
    assert steps.ended == "stopped"
    camera = ScriptedCamera(*(reading(0.1 * i) for i in range(9)))
    steps = stream(camera, Tracker(), patience=QUICK)
    camera.stream = steps
    for _ in steps:
        break
    steps.close()
    assert camera.calls == ["open", "close"]


def test_frames_that_cannot_be_used_are_said_once() -> None:
    bad = [Reading(None, note=f"frame {i}: cut off") for i in range(3)]
    steps, found, said = run(ScriptedCamera(reading(0.0), *bad, reading(0.1)))
    assert len(found) == 2
    assert steps.counts.unusable == 3
    assert said == [
        "scripted: frame 0: cut off",
        "scripted: frames again after 3 that could not be used",
    ]
    assert not steps.is_gone


@pytest.mark.parametrize("surely_ms", [0.0, 25.0])
def test_a_readout_that_was_found_is_in_the_summary(surely_ms: float) -> None:
    tracker = Tracker()
    tracker.readout = Mean(25.0, 1.5, 40)
    tracker.readout_ms = surely_ms
    steps, _, _ = run(ScriptedCamera(reading(1.0), reading(1.1)), tracker)
    summary = steps.summary()
    stated = (summary.get("readout_ms"), summary.get("readout_std_ms"))
    assert stated == ((25.0, 1.5) if surely_ms else (None, None))
