from __future__ import annotations

import json
import logging
import sys
import time
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from hybridvo.cli import main
from hybridvo.errors import InputError
from hybridvo.recording import CHUNK_ROWS, MAX_PICTURES, Recording, check_recording
from hybridvo.synthetic.render import make_scene, write_sintel
from hybridvo.trajectory import read_trajectory
from hybridvo.types import Camera, Frame, RelativePose, Step

pytest.importorskip("rerun", reason="Rerun is not installed (extra viz)")


@pytest.fixture(scope="module")
def sequence(tmp_path_factory: pytest.TempPathFactory) -> str:
    root = tmp_path_factory.mktemp("sintel")
    write_sintel(make_scene("static", 1, height=64, width=128, frames=5), root, "tiny")
    return str(root / "training" / "clean" / "tiny")


def step_of(index: int) -> tuple[Frame, Step]:
    camera = Camera(30, 30, 15.5, 11.5, 24, 32)
    rgb = np.full((24, 32, 3), index % 256, np.uint8)
    frame = Frame(rgb, np.ones((24, 32)), camera, timestamp=0.1 * index, index=index)
    return frame, Step(index, 0.1 * index, np.eye(4), RelativePose(weights=np.ones((6, 8))))


class Tape:
    """What a recording logs, instead of Rerun's stream."""

    def __init__(self, fail_at: int | None = None) -> None:
        self.logged: list[tuple[str, object]] = []
        self.fail_at = fail_at
        self.closed = 0

    def set_time(self, *arguments: object, **named: object) -> None:
        pass

    def log(self, path: str, *what: object, **named: object) -> None:
        if self.fail_at is not None and len(self.logged) >= self.fail_at:
            raise OSError("no space left on device")
        self.logged.append((path, what[0]))

    def flush(self, **named: object) -> None:
        self.closed += 1

    def disconnect(self) -> None:
        self.closed += 1

    def count(self, path: str) -> int:
        return sum(name == path for name, _ in self.logged)


def test_a_run_leaves_a_recording(sequence: str, tmp_path: Path, capsys) -> None:
    out = tmp_path / "out"
    plain = tmp_path / "plain"
    assert main(["run", "--sequence", sequence, "--out", str(out), "--rrd", "-q"]) == 0
    assert main(["run", "--sequence", sequence, "--out", str(plain), "-q"]) == 0
    content = (out / "recording.rrd").read_bytes()
    assert content[:3] == b"RRF" and 5_000 < len(content) < 400_000
    for name in (b"world/camera/image", b"weights", b"flow", b"world/path", b"world/truth"):
        assert name in content
    # recording changes nothing that is estimated
    assert (out / "trajectory.tum").read_bytes() == (plain / "trajectory.tum").read_bytes()
    assert not (plain / "recording.rrd").exists()
    named = tmp_path / "named.rrd"
    options = ["--sequence", sequence, "--out", str(out), "--overwrite", "--rrd", str(named), "-q"]
    capsys.readouterr()
    assert main(["run", *options]) == 0
    assert str(named) in capsys.readouterr().out
    assert named.stat().st_size > 5_000
    assert not (out / "recording.rrd").exists()  # of the run that was replaced


def test_what_is_recorded_can_be_read_back(sequence: str, tmp_path: Path) -> None:
    rerun_chunk = pytest.importorskip("rerun.chunk", reason="an older Rerun reads nothing back")

    out = tmp_path / "out"
    assert main(["run", "--sequence", sequence, "--out", str(out), "--rrd", "-q"]) == 0
    found: dict[str, list[dict]] = {}
    for chunk in rerun_chunk.RrdReader(out / "recording.rrd").stream():
        rows = chunk.to_record_batch().to_pylist()
        found.setdefault(chunk.entity_path.lstrip("/"), []).extend(rows)
    (strip,) = [row["LineStrips3D:strips"][0] for row in found["world/path"]]
    positions = read_trajectory(out / "trajectory.tum", "tum").positions
    np.testing.assert_allclose(strip, positions, atol=1e-6)  # float32 of some metres
    with np.load(out / "steps.npz") as steps:
        std = np.sqrt(np.diagonal(steps["covariance"], axis1=1, axis2=2))
    rows = sorted(found["covariance/translation_std_mm"], key=lambda row: row["frame"])
    recorded = [row["Scalars:scalars"] for row in rows]
    np.testing.assert_allclose(recorded, 1e3 * std[:, :3], rtol=1e-9)
    assert len(found["flow"]) == 4 and len(found["weights"]) == 4
    (blob,) = found["flow"][0]["EncodedImage:blob"]
    assert cv2.imdecode(np.array(blob, np.uint8), cv2.IMREAD_COLOR).shape == (64, 128, 3)


@pytest.mark.parametrize(("start", "clock"), [(0.0, "duration"), (1.3e9, "timestamp")])
def test_stamps_of_sensors_are_dates(tmp_path: Path, start: float, clock: str) -> None:
    rerun_chunk = pytest.importorskip("rerun.chunk", reason="an older Rerun reads nothing back")

    frame, step = step_of(3)
    with Recording(tmp_path / "a.rrd", "x", "id", 1) as recording:
        recording.add(frame, replace(step, timestamp=start + 0.25), None)
    assert not recording.failed
    types = {
        str(chunk.to_record_batch().schema.field("time").type)
        for chunk in rerun_chunk.RrdReader(recording.path).stream()
        if "time" in chunk.timeline_names
    }
    assert types == {f"{clock}[ns]"}


def test_chunks_end_by_frames_and_not_by_time(tmp_path: Path) -> None:
    """Rerun keeps some kB of each until the end: five a second of every kind filled the memory."""
    rerun_chunk = pytest.importorskip("rerun.chunk", reason="an older Rerun reads nothing back")

    frames = CHUNK_ROWS + 50
    with Recording(tmp_path / "slow.rrd", "x", "id", frames) as recording:
        for index in range(frames):
            recording.add(*step_of(index), None)
            time.sleep(0.004)  # a second in all
    chunks = [
        chunk
        for chunk in rerun_chunk.RrdReader(recording.path).stream()
        if chunk.entity_path.lstrip("/") == "status/inlier_ratio"
    ]
    assert sum(len(chunk.to_record_batch()) for chunk in chunks) == frames
    assert len(chunks) == 2


def test_long_runs_take_few_pictures(tmp_path: Path) -> None:
    frames = 3 * MAX_PICTURES - 5
    recording = Recording(tmp_path / "long.rrd", "x", "id", frames)
    stream = recording._stream
    tape = recording._stream = Tape()
    for index in range(frames):
        recording.add(*step_of(index), np.zeros((24, 32, 2)))
    recording.close()
    stream.disconnect()
    assert tape.count("world/camera") == frames
    assert tape.count("covariance/translation_std_mm") == frames
    for path in ("world/camera/image", "flow", "weights"):
        assert 0 < tape.count(path) <= 2 * MAX_PICTURES  # a picture comes with its camera
    assert tape.count("flow") == MAX_PICTURES - 1
    assert tape.count("world/path") == 1
    assert tape.closed == 2


def test_a_failure_is_said_once_and_ends_only_the_recording(tmp_path: Path, caplog) -> None:
    recording = Recording(tmp_path / "full.rrd", "x", "id", 10)
    stream = recording._stream
    recording._stream = Tape(fail_at=20)
    with caplog.at_level(logging.WARNING, logger="hybridvo"):
        for index in range(10):
            recording.add(*step_of(index), None)
        recording.close()
    stream.disconnect()
    assert recording.failed
    (message,) = [record.getMessage() for record in caplog.records]
    assert "no space left on device" in message and "full.rrd" in message


def test_a_run_survives_a_recording_that_cannot_be_written(
    sequence: str, tmp_path: Path, capsys
) -> None:
    out = tmp_path / "out"
    (tmp_path / "file").write_text("")
    bad = str(tmp_path / "file" / "x.rrd")
    assert main(["run", "--sequence", sequence, "--out", str(out), "--rrd", bad]) == 0
    assert "the recording" in capsys.readouterr().err
    assert json.loads((out / "run.json").read_text())["state"] == "done"


def test_parts_of_a_resumed_run_stand_beside_each_other(tmp_path: Path) -> None:
    path = tmp_path / "a.rrd"
    for first, expected in ((0, "a.rrd"), (7, "a_from_000007.rrd"), (0, "a.rrd")):
        with Recording(path, "x", "id", 10, first=first) as recording:
            recording.add(*step_of(first), None)
        assert recording.path.name == expected and not recording.failed
        assert recording.path.stat().st_size > 500


def test_what_cannot_become_a_recording(tmp_path: Path, monkeypatch) -> None:
    check_recording(tmp_path / "a.rrd")
    with pytest.raises(InputError, match=r"ends in \.rrd"):
        check_recording(tmp_path / "a.txt")
    monkeypatch.setitem(sys.modules, "rerun", None)
    with pytest.raises(InputError, match=r"hybridvo\[viz\]"):
        check_recording(tmp_path / "a.rrd")
