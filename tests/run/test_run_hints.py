"""What a finished run shows of its recording, and whether the command that it names helps."""

from __future__ import annotations

import json
import shlex
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from hybridvo.core.depth_units import depth_by_units
from hybridvo.io.data.open import open_sequence
from hybridvo.run.cli import main
from hybridvo.run.commands import run_hints
from hybridvo.run.commands.diagnosis.answer import Diagnosis
from hybridvo.run.commands.diagnosis.rate import gaps
from hybridvo.run.commands.run_hints import Hint, hint_of_run, next_command
from hybridvo_lab.synthetic.scenes import make_scene

FRAMES = 9
SCALE = 1000


def write_room(path: Path, **changes: Any) -> Path:
    """A rendered static room as arrays, with true poses and depth in millimetres."""
    scene = make_scene("static", 3, height=96, width=160, frames=FRAMES)
    seen = [scene.render(index) for index in range(FRAMES)]
    camera = scene.camera
    K = np.array([[camera.fx, 0, camera.cx], [0, camera.fy, camera.cy], [0, 0, 1]])
    depth = np.stack([np.nan_to_num(each.depth, posinf=0) for each in seen])
    arrays = {
        "rgb": np.stack([each.rgb for each in seen]),
        "depth": (SCALE * depth).clip(0, 65535).astype(np.uint16),
        "depth_scale": np.array(SCALE),
        "K": K,
        "timestamps": np.arange(FRAMES) / 30,
        "poses": scene.T_world_cam,
    }
    np.savez(path, **(arrays | changes))
    return path


def summary_of(capsys: pytest.CaptureFixture[str], *words: str) -> dict[str, Any]:
    assert main([*words, "--json", "-q"]) == 0
    summary: dict[str, Any] = json.loads(capsys.readouterr().out)
    return summary


@pytest.mark.parametrize(
    ("changes", "option", "words"),
    [
        ({}, None, ""),
        ({"depth_scale": np.array(SCALE / 5)}, "--depth-scale", "5 times as long"),
        ({"timestamps": np.arange(FRAMES) * 1000 / 30}, "--fps", "milliseconds"),
    ],
)
def test_a_run_names_the_likely_cause_and_its_command_removes_it(
    changes: dict[str, Any],
    option: str | None,
    words: str,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    path = write_room(tmp_path / "room.npz", **changes)
    given = ["run", str(path), "--out", str(tmp_path / "my out"), "--flow", "dis"]
    summary = summary_of(capsys, *given)
    if option is None:
        assert "likely" not in summary
        return
    likely = summary["likely"]
    assert words in likely["cause"] and option in likely["command"]
    before = sorted((tmp_path / "my out").iterdir())
    program, *again = shlex.split(likely["command"])
    assert program == "hybridvo"
    after = summary_of(capsys, *[w for w in again if w not in ("--json", "-q")])
    assert "likely" not in after
    assert after["metrics"]["ate_rmse"] < 0.02
    assert sorted((tmp_path / "my out").iterdir()) == before


def test_it_is_shown_to_people(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    stamps = np.arange(FRAMES) * 1000 / 15
    path = write_room(tmp_path / "room.npz", timestamps=stamps)
    given = [
        "run",
        str(path),
        "--out",
        str(tmp_path / "out"),
        "--method",
        "identity",
    ]
    assert main([*given, "--flow", "dis"]) == 0
    said = capsys.readouterr().out
    assert "likely cause" in said and "--fps 15" in said


def test_only_motions_that_are_sure_and_long_show_a_scale(tmp_path: Path) -> None:
    sequence = open_sequence(write_room(tmp_path / "room.npz"))
    assert sequence.poses is not None
    rows = []
    for index in range(1, FRAMES):
        T = np.linalg.inv(sequence.poses[index]) @ sequence.poses[index - 1]
        T[:3, 3] *= 3
        row = {"index": index, "prev_index": index - 1, "status": "ok"}
        rows.append(row | {"T_curr_prev": T.tolist()})
    hint = hint_of_run(sequence, rows)
    assert hint is not None
    assert hint.option == ("--depth-scale", "3000")
    unsure = [row | {"status": "degraded"} for row in rows]
    assert hint_of_run(sequence, unsure) is None
    assert hint_of_run(sequence, rows[:3]) is None


def test_a_rolling_shutter_is_named_where_it_was_not_taken_out(
    tmp_path: Path,
) -> None:
    sequence = open_sequence(write_room(tmp_path / "room.npz"))
    hint = hint_of_run(sequence, [], readout_ms=31.4)
    assert hint is not None and hint.option == ("--passes", "3")
    assert hint_of_run(sequence, [], readout_ms=31.4, passes=3) is None


def test_the_next_command_keeps_what_was_asked_for() -> None:
    hint = Hint("", ("--depth-scale", "5000"))
    words = ["hybridvo", "run", "x", "--depth-scale=1", "--resume", "--stop", "3"]
    said = next_command(words, None, hint, Path("runs/x"))  # type: ignore[arg-type]
    assert said == ("hybridvo run x --stop 3 --depth-scale 5000 --out runs/x-again")


def test_doctor_does_not_take_milliseconds_for_seconds() -> None:
    answer = gaps(np.arange(20) * 66.667)
    assert answer.differs and answer.option == ("--fps", "15")
    assert gaps(np.arange(20) / 15).differs is False


def test_the_unit_of_depth_can_be_seen(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    stored = np.full((24, 32), 1500, np.uint16)
    assert "1.5 m by 1000, 0.3 m by 5000" in depth_by_units(stored)
    assert depth_by_units(np.zeros((24, 32), np.uint16)) == ""
    path = tmp_path / "room.npz"
    write_room(path)
    with np.load(path) as arrays:
        kept = {name: arrays[name] for name in arrays if name != "depth_scale"}
    np.savez(path, **kept)
    assert main(["run", str(path), "-q"]) == 2
    said = capsys.readouterr().err
    assert "m by 1000" in said and "m by 5000" in said and "m by 256" in said


@pytest.mark.parametrize("has_stamps", [True, False])
def test_a_late_clock_of_depth_is_named(
    has_stamps: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As doctor finds it; depth without stamps of its own has no clock."""
    late = Diagnosis(True, "depth comes late", ("--depth-offset-ms", "132"))
    monkeypatch.setattr(run_hints, "one_clock", lambda sequence, pairs: late)
    sequence = open_sequence(write_room(tmp_path / "room.npz"))
    if has_stamps:
        sequence.depth_timestamps = sequence.timestamps
    hint = hint_of_run(sequence, [])
    assert (hint is not None) == has_stamps
    if hint is not None:
        assert hint.option == ("--depth-offset-ms", "132")
