"""What an attack on the command line, the readers and the output folders found, one test each.

The list of what was tried is in docs/attack.md.
"""

from __future__ import annotations

import io
import json
import os
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import hybridvo.trajectory
from hybridvo.cli import _open_standard_streams, main
from hybridvo.configuration import load_options
from hybridvo.console import Progress, printable
from hybridvo.data.sequence import open_sequence
from hybridvo.diagnosis import diagnose, diagnosis_text
from hybridvo.errors import InputError
from hybridvo.evaluation.plots import plot_trajectories
from hybridvo.evaluation.report import to_json, write_csv, write_json
from hybridvo.recording import check_recording
from hybridvo.run_folder import PARTIAL, STATE, RunFolder
from hybridvo.trajectory import Trajectory
from tests.sequences import image, png, write_folder

ROOT = Path(__file__).resolve().parents[2]


def start(path: Path, mode: Any = "new", **options: Any) -> RunFolder:
    return RunFolder(path, {"input_hash": "abc", "options": options}, {"command": ["test"]}, mode)


# output folders


@pytest.mark.parametrize("name", ["trajectory.png", "metrics.json", "trajectory.tum"])
def test_overwrite_leaves_a_file_that_no_run_has_written(tmp_path: Path, name: str) -> None:
    (tmp_path / name).write_text("mine")
    with pytest.raises(InputError, match=r"no run\.json that says a run wrote it: not replaced"):
        start(tmp_path, "overwrite")
    assert (tmp_path / name).read_text() == "mine"
    assert sorted(path.name for path in tmp_path.iterdir()) == [name]


def test_overwrite_leaves_the_run_json_of_another_program(tmp_path: Path) -> None:
    (tmp_path / STATE).write_text('{"jogging": "5 km"}')
    with pytest.raises(InputError, match="not replaced"):
        start(tmp_path, "overwrite")
    assert "jogging" in (tmp_path / STATE).read_text()


def test_overwrite_replaces_a_run_whose_state_is_damaged(tmp_path: Path) -> None:
    start(tmp_path).close()
    (tmp_path / STATE).write_text('{"identity": {')
    (tmp_path / "metrics.json").write_text("{}")
    with start(tmp_path, "overwrite") as folder:
        assert folder.frames_done == 0
        assert not (tmp_path / "metrics.json").exists()


def test_overwrite_that_is_killed_can_be_tried_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with start(tmp_path) as folder:
        folder.append({"index": 0})
        (tmp_path / "steps.csv").write_text("old")
        folder.finish()
    with monkeypatch.context() as patch:
        patch.setattr(RunFolder, "_remove", _die_at("steps.csv", RunFolder._remove))
        with pytest.raises(KeyboardInterrupt):
            start(tmp_path, "overwrite", seed=1)
    assert json.loads((tmp_path / STATE).read_text())["state"] == "running"
    with start(tmp_path, "overwrite", seed=1) as folder:
        assert folder.frames_done == 0
        assert not (tmp_path / "steps.csv").exists()


def _die_at(name: str, remove: Any) -> Any:
    def dying(self: RunFolder, which: str) -> None:
        if which == name:
            raise KeyboardInterrupt
        remove(self, which)

    return dying


def test_a_folder_named_like_a_result_stops_an_overwrite_before_it_removes_anything(
    tmp_path: Path,
) -> None:
    start(tmp_path).close()
    (tmp_path / "trajectory.tum").mkdir()
    before = (tmp_path / STATE).read_bytes(), (tmp_path / PARTIAL).exists()
    with pytest.raises(InputError, match="is a folder"):
        start(tmp_path, "overwrite")
    assert ((tmp_path / STATE).read_bytes(), (tmp_path / PARTIAL).exists()) == before


@pytest.mark.parametrize(
    "content",
    [
        "[" * 100_000,
        '{"identity": null, "state": "done"}',
        '{"identity": 5, "state": "done"}',
        '{"identity": [1], "state": "done"}',
        "5",
    ],
    ids=["deep", "null", "number", "list", "no mapping"],
)
def test_resume_with_a_state_edited_by_hand_is_refused(tmp_path: Path, content: str) -> None:
    start(tmp_path).close()
    (tmp_path / STATE).write_text(content)
    with pytest.raises(InputError, match="cannot be read, so the run cannot be resumed"):
        start(tmp_path, "resume")


def test_resume_with_deeply_nested_rows_computes_them_again(tmp_path: Path) -> None:
    with start(tmp_path) as folder:
        folder.append({"index": 0})
    with (tmp_path / PARTIAL).open("ab") as file:
        file.write(b"[" * 100_000 + b"\n")
    with start(tmp_path, "resume") as folder:
        assert folder.frames_done == 1


def test_refused_resume_names_the_option_that_differs(tmp_path: Path) -> None:
    start(tmp_path, method="refine", dis={"preset": "fast"}, seed=0).close()
    with pytest.raises(InputError, match=r"options\.dis\.preset: \"fast\" then, \"medium\" now"):
        start(tmp_path, "resume", method="refine", dis={"preset": "medium"}, seed=1)


@pytest.fixture
def made(tmp_path: Path) -> Iterator[Path]:
    """A tiny sequence of kind 'folder'."""
    yield write_folder(tmp_path).path


def cli(*words: str) -> int:
    return main([*words, "-q"])


@pytest.mark.parametrize("folder", ["rgb", "depth", "flow"])
def test_results_are_not_written_among_the_frames(
    made: Path, folder: str, capsys: pytest.CaptureFixture[str]
) -> None:
    before = sorted(made.rglob("*"))
    words = ("run", "--sequence", str(made), "--method", "identity", "--out")
    assert cli(*words, str(made / folder)) == 2
    assert "would be taken for input" in capsys.readouterr().err
    assert sorted(made.rglob("*")) == before


def test_resume_with_a_row_of_another_time_is_refused(
    made: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "out"
    words = ("run", "--sequence", str(made), "--method", "identity", "--out", str(out))
    assert cli(*words) == 0
    # back to the state of a run that was cut off, its row changed by hand
    state = json.loads((out / STATE).read_text())
    (out / STATE).write_text(json.dumps(state | {"state": "running"}))
    row = {"index": 0, "timestamp": 0.7, "anchor": {"keys": None}, "failed_so_far": 0}
    (out / PARTIAL).write_text(json.dumps(row) + "\n")
    assert cli(*words, "--resume") == 2
    assert "row 1 is another frame's" in capsys.readouterr().err


def test_no_more_motions_fail_than_there_are(
    made: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for path in (made / "rgb").iterdir():
        path.write_bytes(path.read_bytes()[:-20])
    out = tmp_path / "out"
    words = ("run", "--sequence", str(made), "--method", "identity", "--out", str(out))
    assert main(words) == 3
    count = len(list((made / "rgb").iterdir()))
    assert f"{count - 1} of {count - 1} motions failed" in capsys.readouterr().err
    assert json.loads((out / STATE).read_text())["summary"]["failed_share"] == 1.0


def test_a_picture_that_is_handed_out_twice_is_warned_of(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    root = own(tmp_path / "s", (0, 1, 2, 3), (0, 1, 2, 3))
    for a, b in (("0000", "0001"), ("0002", "0003")):
        (root / "rgb" / f"{b}.png").write_bytes((root / "rgb" / f"{a}.png").read_bytes())
    # frames 2 and 3 share their depth as well: a rendered camera that stands
    png(root / "depth" / "0001.png", np.full((24, 32), 2010, np.uint16))
    words = ("run", "--sequence", str(root), "--method", "identity", "--max-failed", "1")
    assert main([*words, "--out", str(tmp_path / "out")]) == 0
    said = capsys.readouterr().err
    assert "frame 1 has the very picture of frame 0, and another depth map: pictures" in said
    assert json.loads((tmp_path / "out" / STATE).read_text())["summary"]["warnings"] != []


def test_a_recording_replaces_no_file_without_overwrite(tmp_path: Path) -> None:
    pytest.importorskip("rerun")
    mine, folder = tmp_path / "mine.rrd", tmp_path / "folder.rrd"
    mine.write_text("mine")
    folder.mkdir()
    with pytest.raises(InputError, match="is there already"):
        check_recording(mine, replace=False)
    with pytest.raises(InputError, match="is a folder"):
        check_recording(folder)
    check_recording(mine)


@pytest.mark.parametrize(("flag", "code"), [((), 2), (("--overwrite",), 0)])
def test_a_run_asks_before_it_replaces_a_recording(
    made: Path, tmp_path: Path, flag: tuple[str, ...], code: int
) -> None:
    pytest.importorskip("rerun")
    mine = tmp_path / "mine.rrd"
    mine.write_text("mine")
    words = ("run", "--sequence", str(made), "--method", "identity", "--rrd", str(mine), *flag)
    assert cli(*words, "--out", str(tmp_path / "out")) == code
    assert (mine.read_bytes() == b"mine") == (code == 2)


# the command line


@pytest.mark.parametrize(
    "words",
    [
        ("run", "--sequence", ""),
        ("run", "--sequence", "a", "--out", ""),
        ("run", "--sequence", "a", "--config", ""),
        ("doctor", "--sequence", ""),
        ("demo", "--out", ""),
    ],
)
def test_an_empty_path_is_not_the_working_folder(
    words: tuple[str, ...], capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(words) == 2
    assert "expected a path, got an empty word" in capsys.readouterr().err


def test_the_first_of_two_sequences_is_not_left_out(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["run", "--sequence", "a", "--sequence", "b"]) == 2
    assert "--sequence: given twice" in capsys.readouterr().err


def test_names_cannot_talk_to_the_terminal(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert printable("a\x1b[31m\x9b2J\rb\tc\n") == "a\\x1b[31m\\x9b2J\\x0db\tc\n"
    assert main(["run", "--sequence", str(tmp_path / "\x1b[2Jx")]) == 2
    assert "\x1b" not in capsys.readouterr().err
    stream = io.StringIO()
    with Progress(1, "x\x1b]0;y\x07", stream=stream) as progress:
        progress.say("note: \x1b[2J")
        progress.update(1, 0)
    assert "\x1b" not in stream.getvalue() and "\\x1b]0;y\\x07: 1/1" in stream.getvalue()


def test_names_are_no_markup_of_the_progress_bar() -> None:
    class Terminal(io.StringIO):
        def isatty(self) -> bool:
            return True

    stream = Terminal()
    with Progress(1, "[red]x[/nope]", stream=stream) as progress:
        progress.update(1, 0)
    assert "[red]x[/nope]" in stream.getvalue()


def test_an_alphabet_without_the_name_does_not_end_a_run(monkeypatch: pytest.MonkeyPatch) -> None:
    bytes_out = io.BytesIO()
    stream = io.TextIOWrapper(bytes_out, encoding="ascii")
    monkeypatch.setattr(sys, "stdout", stream)
    _open_standard_streams()
    print("séq", file=stream, flush=True)
    assert bytes_out.getvalue() == b"s\\xe9q\n"


def test_a_path_that_is_no_utf8_can_be_reported(tmp_path: Path) -> None:
    name = os.fsdecode(b"a\xff\xe9")
    write_json(tmp_path / "x.json", {"path": name, "other": "séq 😀"})
    read = json.loads((tmp_path / "x.json").read_text(encoding="utf-8"))
    assert read == {"path": name, "other": "séq 😀"}
    assert "séq 😀" in to_json("séq 😀")
    write_csv(tmp_path / "x.csv", [{"message": f"{name}: séq"}])
    assert (tmp_path / "x.csv").read_text("utf-8") == "message\na\\udcff\\udce9: séq\n"


@pytest.mark.parametrize("name", ["$\\frac{$x", "序列\x1b", os.fsdecode(b"a\xff\xe9$")])
def test_any_name_can_stand_over_the_picture(tmp_path: Path, name: str) -> None:
    path = Trajectory(np.arange(3.0), np.tile(np.eye(4), (3, 1, 1)))
    plot_trajectories({"identity": path}, tmp_path / "x.png", title=name)
    assert (tmp_path / "x.png").read_bytes()[:4] == b"\x89PNG"


# settings


@pytest.mark.parametrize("seed", [-1, 2**31, 10**30])
def test_a_seed_that_no_generator_takes_is_refused(seed: int) -> None:
    with pytest.raises(InputError, match="seed: expected 0 to 2147483647"):
        load_options(assignments=[f"seed={seed}"])


def own(root: Path, images: tuple[int, ...], depths: tuple[int, ...]) -> Path:
    """A sequence of kind 'folder' with these numbers and no time stamps."""
    (root / "depth").mkdir(parents=True)
    (root / "camera.yaml").write_text(
        "fx: 20\nfy: 20\ncx: 15.5\ncy: 11.5\nwidth: 32\nheight: 24\ndepth_scale: 1000\n"
    )
    for i in images:
        png(root / "rgb" / f"{i:04d}.png", image(i, 24, 32))
    for i in depths:
        png(root / "depth" / f"{i:04d}.png", np.full((24, 32), 2000, np.uint16))
    return root


# evaluate


@pytest.mark.skipif(not Path("/dev/zero").exists(), reason="needs a file that never ends")
def test_evaluate_does_not_read_without_end(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(hybridvo.trajectory, "LARGEST_FILE", 10_000)
    assert main(["evaluate", "/dev/zero", "/dev/zero"]) == 2
    assert "/dev/zero: more than 10000 bytes are no trajectory" in capsys.readouterr().err


# scenes


def test_a_scene_of_a_billion_frames_is_refused_before_it_fills_the_memory(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["demo", "--out", str(tmp_path / "demo"), "--frames", "1000000000"]) == 2
    assert "frames: expected at most 100000" in capsys.readouterr().err


# doctor


def test_doctor_does_not_praise_what_it_could_not_read(tmp_path: Path) -> None:
    root = own(tmp_path, (0, 1, 2), (0, 1, 2))
    for path in (root / "rgb").iterdir():
        if path.name != "0000.png":
            path.write_bytes(b"x")
    report = diagnose(open_sequence(root))
    text = diagnosis_text(report)
    assert len(report["unreadable"]) == 2
    assert "nothing could be compared: see above" in text and "nothing differs" not in text
    half = report | {"findings": [{"name": "a", "state": "agrees", "message": "b"}], "ok": True}
    assert "nothing differs, in what could be read" in diagnosis_text(half)
