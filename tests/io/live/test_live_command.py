"""``hybridvo live``: what it writes, sends and shows, and how it ends."""

from __future__ import annotations

import json
import re
import signal
import socket
import threading
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import hybridvo as hvo
from hybridvo.core.options import load_options
from hybridvo.core.trajectory import read_trajectory
from hybridvo.io.cameras.base import Reading
from hybridvo.io.cameras.predicted import PredictedCamera
from hybridvo.io.live import Patience
from hybridvo.run.cli import main
from hybridvo.run.commands import live as command
from hybridvo.run.commands.arguments import build_parser
from hybridvo.run.commands.text import text_of
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


def test_results_are_kept(tracker: Tracker, tmp_path: Path) -> None:
    command.live(ScriptedCamera(*frames(2)), tmp_path, quiet=True)
    with pytest.raises(hvo.InputError, match="holds results"):
        command.live(ScriptedCamera(*frames(2)), tmp_path, quiet=True)
    summary, _ = command.live(
        ScriptedCamera(*frames(3)), tmp_path, quiet=True, overwrite=True
    )
    assert summary["tracked"] == 3
    assert len((tmp_path / "trajectory.tum").read_text().splitlines()) == 3


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
    "udp", ["9000", "host", "127.0.0.1:x", ":9", "127.0.0.1:99999"]
)
def test_a_wrong_address_is_refused(udp: str, tmp_path: Path) -> None:
    with pytest.raises(hvo.InputError, match="HOST:PORT"):
        command.live(ScriptedCamera(), tmp_path, udp=udp, quiet=True)


@pytest.mark.parametrize(("name", "value"), [("seconds", 0), ("max_frames", 0)])
def test_a_limit_that_is_none_is_refused(
    name: str, value: int, tmp_path: Path
) -> None:
    with pytest.raises(hvo.InputError, match=name.replace("_", "-")):
        command.live(ScriptedCamera(), tmp_path, quiet=True, **{name: value})


def test_passes_are_refused(tmp_path: Path) -> None:
    options = load_options(named={"run.passes": 2})
    with pytest.raises(hvo.InputError, match=r"run.passes: expected 1 .* got 2"):
        command.live(ScriptedCamera(), tmp_path, options, quiet=True)


def test_a_rerun_recording_is_written(tracker: Tracker, tmp_path: Path) -> None:
    pytest.importorskip("rerun")
    rrd = tmp_path / "live.rrd"
    summary, _ = command.live(
        ScriptedCamera(*frames(3)), tmp_path / "out", rrd=rrd, quiet=True
    )
    assert summary["recording"] == str(rrd)
    assert rrd.stat().st_size > 1000


def test_a_camera_without_frames_is_an_error(
    tracker: Tracker, tmp_path: Path, monkeypatch
) -> None:
    camera = ScriptedCamera(OpenFails(RuntimeError("no device connected")))
    with pytest.raises(hvo.InputError, match="no device connected"):
        command.live(camera, tmp_path, quiet=True)
    assert (tmp_path / "trajectory.tum").read_text() == ""


def test_what_a_recording_states_is_shown(
    tracker: Tracker, tmp_path: Path, capsys
) -> None:
    camera = ScriptedCamera(*frames(2), hasty=True)
    camera.warnings = ["topics were guessed"]
    predicted = PredictedCamera(camera, [])
    summary, _ = command.live(predicted, tmp_path / "a")
    assert summary["warnings"] == ["topics were guessed"]
    assert "topics were guessed" in capsys.readouterr().err
    # it is not the reason why nothing came
    silent = ScriptedCamera()
    silent.warnings = ["topics were guessed"]
    with pytest.raises(hvo.InputError, match="scripted: no frames"):
        command.live(silent, tmp_path / "b", quiet=True)


def test_frames_that_are_all_too_old_are_the_reason(
    tracker: Tracker, tmp_path: Path
) -> None:
    camera = ScriptedCamera(reading(10.0, age_s=99.0), reading(10.1, age_s=99.0))
    with pytest.raises(hvo.InputError, match="scripted: 2 frames, all too old"):
        command.live(camera, tmp_path, quiet=True)


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


def test_a_screen_that_is_none_has_no_line_that_changes(
    tracker: Tracker, tmp_path: Path, capsys
) -> None:
    gone = Reading(None, note="files are gone since frame 3", is_gone=True)
    camera = ScriptedCamera(*frames(3), gone, gone)
    summary, exit_code = command.live(camera, tmp_path)
    assert capsys.readouterr().err == "scripted: files are gone since frame 3\n"
    assert exit_code == 3
    text = text_of("live", summary)
    assert "unusable           2 frames" in text
    assert "end of the recording, whose files are gone" in text


def test_the_line_is_ended_before_an_error(
    tracker: Tracker, tmp_path: Path, capsys, monkeypatch
) -> None:
    monkeypatch.setenv("TTY_COMPATIBLE", "1")
    monkeypatch.setenv("TERM", "xterm")
    camera = ScriptedCamera(OpenFails(hvo.InputError("scripted: no device")))
    with pytest.raises(hvo.InputError):
        command.live(camera, tmp_path)
    shown = re.sub(r"\x1b\[[?0-9;]*[a-zA-Z]", "", capsys.readouterr().err)
    assert shown.rstrip("\n").endswith("waiting for frames")
    assert shown.endswith("\n")


def test_the_screen_has_one_line(
    tracker: Tracker, tmp_path: Path, capsys, monkeypatch
) -> None:
    monkeypatch.setenv("TTY_COMPATIBLE", "1")
    monkeypatch.setenv("TERM", "xterm")
    monkeypatch.setenv("COLUMNS", "200")
    bad = RuntimeError("unplugged \x1b[2J")
    camera = ScriptedCamera(*frames(3), bad, reading(10.3))
    summary, _ = command.live(camera, tmp_path)
    shown = re.sub(r"\x1b\[[?0-9;]*[a-zA-Z]", "", capsys.readouterr().err)
    assert "scripted: unplugged \\x1b[2J; next attempt in 0.001 s\n" in shown
    last = re.split(r"[\r\n]+", shown.strip())[-1]
    assert last.startswith("x +4.000 y +0.000 z +0.000 m  ok  ")
    assert "frames/s  0 dropped  age " in last and "p95" in last
    text = text_of("live", summary)
    assert "age of a pose      p50 " in text
    assert "scripted, 4 frames, 0 dropped" in text


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


def test_the_arguments_are_those_of_the_page() -> None:
    words = (
        "live --camera realsense:0001 --preset d435 --out o --udp h:1 --rrd a.rrd"
    )
    more = "--seconds 2.5 --max-frames 7 --set run.max_failed=0.5 --weights pwvo=x"
    args = build_parser().parse_args([*words.split(), *more.split()])
    assert (args.camera, args.preset) == ("realsense:0001", "d435")
    assert (args.seconds, args.max_frames) == (2.5, 7)
    assert (args.size, args.rate) == (None, "camera")
    args = build_parser().parse_args(["live", "--readout-ms", "18"])
    assert args.readout_ms == 18
    args = build_parser().parse_args(
        ["live", "--size", "320x240", "--rate", "auto"]
    )
    assert (args.size, args.rate) == ((320, 240), "auto")


@pytest.mark.parametrize("size", ["320", "320x", "0x240", "-3x4", "axb"])
def test_a_size_that_is_none_is_refused(size: str, capsys) -> None:
    assert main(["live", f"--size={size}"]) == 2
    assert "argument --size" in capsys.readouterr().err


def test_the_end_says_what_was_dropped_and_what_helps(
    tracker: Tracker, tmp_path: Path
) -> None:
    numbered = [reading(10 + 0.1 * i, number=4 * i) for i in range(5)]
    summary, _ = command.live(
        ScriptedCamera(*numbered), tmp_path, quiet=True, size=(8, 6)
    )
    assert summary["dropped"] == summary["missed"] == 12
    assert summary["help"].startswith(
        "most of the dropped frames never came: USB 3"
    )
    assert summary["size"] == [8, 6]
    text = text_of("live", summary)
    assert "dropped            12: never came from the camera" in text
    assert "what helps         most of the dropped" in text
    assert "counting, images of 8x6" in text


def test_motions_that_are_not_ok_are_explained_at_the_end(
    tracker: Tracker, tmp_path: Path
) -> None:
    dark = [reading(10.1, depth=None), reading(10.2, depth=None)]
    summary, _ = command.live(
        ScriptedCamera(reading(10.0), *dark), tmp_path, quiet=True
    )
    assert summary["outcomes"][0] == {
        "state": "failed",
        "reason": "no_valid_depth",
        "steps": 2,
    }
    text = text_of("live", summary)
    assert "2 no_valid_depth: the depth map is empty or nearly so" in text


def test_rate_auto_says_what_it_chose(tracker: Tracker, tmp_path: Path) -> None:
    summary, _ = command.live(
        ScriptedCamera(*frames(9)), tmp_path / "out", quiet=True, rate="auto"
    )
    # of images that are small already, by a tracker that costs nothing
    assert summary["chosen"].startswith("rate auto: images of 16x12, budget 100 ms")
    assert (summary["tried"], summary["tracked"]) == (5, 4)
    assert summary["warnings"] == []
    # five are measured: then there is a choice, and nothing left to track
    for count in (3, 5):
        camera = ScriptedCamera(*frames(count))
        out = tmp_path / str(count)
        with pytest.raises(hvo.InputError, match=f"{count} frames, too few for"):
            command.live(camera, out, quiet=True, rate="auto")


def test_the_command_line_says_what_is_missing(capsys) -> None:
    assert main(["live"]) == 2
    assert "expected --camera or --preset" in capsys.readouterr().err
    assert main(["live", "--camera", "nowhere"]) == 2
    assert "folder or file of a recording" in capsys.readouterr().err


def test_patience_is_what_the_calibration_says() -> None:
    from hybridvo.io import calibration

    assert Patience().absence_s == calibration.MAX_ABSENCE_S
