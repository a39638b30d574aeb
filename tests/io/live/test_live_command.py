"""``hybridvo live``: what it writes, sends and shows, and how it ends."""

from __future__ import annotations

import dataclasses
import json
import signal
import socket
import threading
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import hybridvo as hvo
from hybridvo.core.options import TrackOptions
from hybridvo.core.trajectory import read_trajectory
from hybridvo.io.cameras.base import Reading
from hybridvo.io.live import LiveStep
from hybridvo.run.cli import main
from hybridvo.run.commands import live as command
from tests.io.live.scripted import (
    QUICK,
    OpenFails,
    ScriptedCamera,
    Tracker,
    reading,
)


@pytest.fixture
def tracker(monkeypatch: pytest.MonkeyPatch) -> Tracker:
    """The tracker of every run, and a stream that is known to the camera."""
    made = Tracker()
    monkeypatch.setattr(command, "Odometry", lambda *_, **__: made)
    real = command.stream

    def known(camera: Any, *args: Any, **more: Any) -> Any:
        steps = real(camera, *args, patience=QUICK, **more)
        camera.stream = steps
        return steps

    monkeypatch.setattr(command, "stream", known)
    return made


def frames(count: int) -> list[Any]:
    return [reading(10 + 0.1 * i) for i in range(count)]


def test_it_writes_what_it_found(tracker: Tracker, tmp_path: Path) -> None:
    out = tmp_path / "out"
    camera = ScriptedCamera(*frames(4), RuntimeError("unplugged"), reading(10.4))
    summary, exit_code = command.live(
        camera, out, command=["hybridvo", "live"], quiet=True
    )
    assert exit_code == 0
    assert summary["tracked"] == 5
    assert summary["age_ms_p50"] <= summary["age_ms_p95"]
    assert summary["warnings"][0].startswith("scripted: unplugged")
    assert summary["ended"] == "end of the recording"

    path = read_trajectory(out / "trajectory.tum")
    np.testing.assert_allclose(path.timestamps, 10 + 0.1 * np.arange(5), atol=1e-6)
    np.testing.assert_allclose(path.positions[:, 0], [1, 2, 3, 4, 5])

    lines = (out / "steps.jsonl").read_text().splitlines()
    steps = [json.loads(line) for line in lines]
    assert [step["prev_index"] for step in steps] == [None, 0, 1, 2, 3]
    assert steps[1]["position"] == [2.0, 0.0, 0.0]
    assert steps[1]["orientation_xyzw"] == [0.0, 0.0, 0.0, 1.0]
    assert np.reshape(steps[1]["covariance"], (6, 6)).tolist() == np.eye(6).tolist()
    assert steps[1]["age_ms"] >= 0

    state = json.loads((out / "run.json").read_text())
    assert state["state"] == "done"
    assert state["summary"] == summary
    assert state["command"] == ["hybridvo", "live"]
    assert state["options"]["run"]["method"] == "hybrid"


def test_the_path_on_disk_is_the_corrected_one(tmp_path: Path) -> None:
    def step(number: int, x: float, corrected: hvo.Step | None = None) -> hvo.Step:
        T = np.eye(4)
        T[0, 3] = x
        motion = hvo.RelativePose()
        return hvo.Step(number, 10.0 + number, T, motion, None, corrected=corrected)

    steps = [step(0, 0.0), step(1, 1.5), step(2, 2.5, step(1, 1.0)), step(3, 3.0)]
    frame = frames(1)[0].frame
    options = hvo.Options(track=TrackOptions(lag=1))
    header = {"options": dataclasses.asdict(options)}
    with command._Files(tmp_path, header, overwrite=False) as files:
        for each in steps:
            files.add(LiveStep(each, frame, 0.0, 30.0, 0, None), None)
    path = read_trajectory(tmp_path / "trajectory.tum")
    np.testing.assert_allclose(path.positions[:, 0], [0.0, 1.0, 2.5, 3.0])


def test_files_of_another_run_are_not_left_beside(
    tracker: Tracker, tmp_path: Path
) -> None:
    old = ("run.json", "trajectory.kitti", "steps.csv", "metrics.json", "notes.txt")
    for name in old:
        (tmp_path / name).write_text("old")
    (tmp_path / "run.json").unlink()
    with pytest.raises(hvo.InputError, match="holds results"):
        command.live(ScriptedCamera(*frames(2)), tmp_path, quiet=True)
    command.live(ScriptedCamera(*frames(2)), tmp_path, quiet=True, overwrite=True)
    names = {path.name for path in tmp_path.iterdir()}
    assert names == {"run.json", "trajectory.tum", "steps.jsonl", "notes.txt"}


def test_interrupt_ends_it_with_results(tracker: Tracker, tmp_path: Path) -> None:
    def interrupt() -> None:
        signal.raise_signal(signal.SIGINT)

    class Endless(ScriptedCamera):
        """It would never end by itself."""

        def read(self, timeout_s: float) -> Any:
            if self.script:
                return super().read(timeout_s)
            threading.Event().wait(0.001)
            return None

    camera = Endless(*frames(3), interrupt)
    summary, exit_code = command.live(camera, tmp_path, quiet=True)
    assert exit_code == 0
    assert summary["ended"] == "SIGINT"
    assert summary["tracked"] >= 1
    lines = (tmp_path / "trajectory.tum").read_text().splitlines()
    assert len(lines) == summary["tracked"]
    assert json.loads((tmp_path / "run.json").read_text())["state"] == "done"
    assert camera.calls == ["open", "close"]


def test_steps_go_out_by_udp(tracker: Tracker, tmp_path: Path) -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as ear:
        ear.bind(("127.0.0.1", 0))
        ear.settimeout(60)
        port = ear.getsockname()[1]
        camera = ScriptedCamera(*frames(3))
        command.live(camera, tmp_path, udp=f"127.0.0.1:{port}", quiet=True)
        heard = [ear.recv(65536) for _ in range(3)]
    # one datagram of an Ethernet frame, which is not cut in pieces
    assert max(map(len, heard)) < 1400
    lines = (tmp_path / "steps.jsonl").read_text().splitlines()
    assert [data.decode() for data in heard] == [f"{line}\n" for line in lines]


def test_a_datagram_is_short_whatever_the_numbers(tracker: Tracker) -> None:
    rng = np.random.default_rng(3)
    T = np.eye(4)
    T[:3, 3] = rng.normal(0, 1e4, 3)
    covariance = rng.normal(0, 1e-7, (6, 6))
    motion = hvo.RelativePose(T, covariance, probability=float("nan"))
    step = hvo.Step(10**7, 1.7e9 + 1 / 3, T, motion, 10**7 - 1)
    found = command.LiveStep(step, reading(0.0).frame, 0.0123456789, 29.97, 10**6)
    line = command.json_line(found)
    assert json.loads(line)["probability"] is None
    assert len(line) < 1400


@pytest.mark.parametrize(
    ("words", "named"),
    [
        ("--udp=127.0.0.1:x", "HOST:PORT"),
        ("--udp=127.0.0.1:99999", "HOST:PORT"),
        ("--seconds=0", "seconds"),
        ("--max-frames=0", "max-frames"),
        ("--size=0x240", "argument --size"),
        ("--size=axb", "argument --size"),
        ("--set=run.passes=2", "run.passes"),
    ],
)
def test_what_cannot_be_is_refused(
    words: str, named: str, image_walk: Path, tmp_path: Path, capsys
) -> None:
    given = ["live", "--camera", str(image_walk), "--out", str(tmp_path / "out")]
    assert main([*given, words]) == 2
    assert named in capsys.readouterr().err


def test_a_rerun_recording_is_written(tracker: Tracker, tmp_path: Path) -> None:
    pytest.importorskip("rerun")
    rrd = tmp_path / "live.rrd"
    summary, _ = command.live(
        ScriptedCamera(*frames(3)), tmp_path / "out", rrd=rrd, quiet=True
    )
    assert summary["recording"] == str(rrd)
    assert rrd.stat().st_size > 1000


def test_a_camera_that_cannot_be_used_leaves_no_running_state(
    tracker: Tracker, tmp_path: Path
) -> None:
    camera = ScriptedCamera(OpenFails(hvo.InputError("no such option")))
    with pytest.raises(hvo.InputError, match="no such option"):
        command.live(camera, tmp_path, quiet=True)
    assert json.loads((tmp_path / "run.json").read_text())["state"] == "interrupted"


def test_many_failed_motions_are_an_exit_code(
    tracker: Tracker, tmp_path: Path
) -> None:
    dark = [reading(10.1, depth=None), reading(10.2, depth=None)]
    _, exit_code = command.live(
        ScriptedCamera(reading(10.0), *dark), tmp_path, quiet=True
    )
    assert exit_code == 3


def test_a_recording_whose_files_are_gone_is_an_exit_code(
    tracker: Tracker, tmp_path: Path
) -> None:
    gone = Reading(None, note="files are gone since frame 3", is_gone=True)
    _, exit_code = command.live(ScriptedCamera(*frames(3), gone), tmp_path)
    assert exit_code == 3


def test_what_a_driver_says_cannot_command_the_screen(
    tracker: Tracker, tmp_path: Path, capsys
) -> None:
    bad = RuntimeError("unplugged \x1b[2J")
    command.live(ScriptedCamera(*frames(3), bad, reading(10.3)), tmp_path)
    assert "scripted: unplugged \\x1b[2J;" in capsys.readouterr().err


def test_the_command_line_plays_a_recording(
    image_walk: Path, tmp_path: Path, capsys
) -> None:
    """The real tracker, at the pace of this machine: frames may be dropped, results may not."""
    out = tmp_path / "out"
    words = ["live", "--camera", str(image_walk), "--out", str(out)]
    more = ["--method", "classical", "--max-failed", "1", "--json", "-q"]
    assert main([*words, *more]) == 0
    summary = json.loads(capsys.readouterr().out)
    sequence = hvo.open_sequence(image_walk)
    assert summary["tracked"] + summary["dropped"] == len(sequence)
    assert summary["method"] == "classical"
    path = read_trajectory(out / "trajectory.tum")
    assert len(path) == summary["tracked"] >= 1
    assert set(np.round(path.timestamps, 6)) <= set(
        np.round(sequence.timestamps, 6)
    )
    assert main([*words, "-q"]) == 2
    assert "holds results" in capsys.readouterr().err


def test_rate_auto_says_what_it_chose(tracker: Tracker, tmp_path: Path) -> None:
    summary, _ = command.live(
        ScriptedCamera(*frames(9)), tmp_path / "out", quiet=True, rate="auto"
    )
    # of images that are small already, by a tracker that costs nothing
    assert summary["size"] == [16, 12]
    assert (summary["tried"], summary["tracked"]) == (5, 4)
    assert summary["warnings"] == []
    # five are measured: then there is a choice, and nothing left to track
    for count in (3, 5):
        camera = ScriptedCamera(*frames(count))
        out = tmp_path / str(count)
        with pytest.raises(hvo.InputError, match=f"{count} frames, too few for"):
            command.live(camera, out, quiet=True, rate="auto")


def test_a_camera_without_frames_is_an_error(
    tracker: Tracker, tmp_path: Path, monkeypatch
) -> None:
    camera = ScriptedCamera(OpenFails(RuntimeError("no device connected")))
    with pytest.raises(hvo.InputError, match="no device connected"):
        command.live(camera, tmp_path, quiet=True)
    assert (tmp_path / "trajectory.tum").read_text() == ""
