from __future__ import annotations

import contextlib
import json
import logging
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from hybridvo.core.errors import InputError, LockedError
from hybridvo.core.files import locked_folder
from hybridvo.core.trajectory import read_trajectory
from hybridvo.run.commands.run_folder import CHECKPOINT, STATE, STEPS, RunFolder

COMMAND = ["hybridvo", "run", "my walk", "--fps", "5"]
IDENTITY = {
    "command": COMMAND,
    "sequence": "mine",
    "input_hash": "abc",
    "options": {"seed": 0},
}


@contextlib.contextmanager
def start(path: Path, mode: str = "new", **identity: object) -> Iterator[RunFolder]:
    with locked_folder(path):
        folder = RunFolder(path, IDENTITY | identity, mode)  # type: ignore[arg-type]
        try:
            yield folder
        finally:
            folder.close()


def state(path: Path) -> dict:
    return json.loads((path / STATE).read_text())


def test_results_are_replaced_only_when_asked_and_nothing_else(tmp_path):
    with start(tmp_path) as folder:
        folder.save("done")
    with pytest.raises(InputError, match=r"--resume.*--out.*--overwrite"):
        with start(tmp_path):
            pass
    (tmp_path / "trajectory.tum").write_text("old")
    (tmp_path / "mine.txt").write_text("keep")
    with start(tmp_path, "overwrite"):
        assert not (tmp_path / "trajectory.tum").exists()
        assert (tmp_path / "mine.txt").read_text() == "keep"


def test_overwrite_removes_a_link_and_not_what_it_points_to(tmp_path):
    with start(tmp_path / "out") as folder:
        folder.save("done")
    sentinel = tmp_path / "sentinel"
    sentinel.write_text("untouched")
    (tmp_path / "out" / "trajectory.tum").symlink_to(sentinel)
    with start(tmp_path / "out", "overwrite"):
        pass
    assert sentinel.read_text() == "untouched"
    assert not (tmp_path / "out" / "trajectory.tum").is_symlink()


def test_resume_goes_on_from_the_checkpoint(tmp_path):
    with start(tmp_path) as folder:
        for index in range(2):
            folder.add(
                {"index": index, "x": 0.1 * index, "T_world_cam": [1, 2]},
                {"n": index},
            )
        assert state(tmp_path)["state"] == "running"
    with start(tmp_path, "resume") as folder:
        assert [row["index"] for row in folder.rows] == [0, 1]
        assert folder.rows[1]["T_world_cam"] == [1, 2] and folder.tracker == {
            "n": 1
        }
        folder.add({"index": 2, "x": None}, {"n": 2})
        folder.add({"index": 3, "x": float("nan")}, {"n": 2})
        folder.save("done", summary={"n": 4, "files": []})
    lines = (tmp_path / STEPS).read_text().splitlines()
    assert lines == ["index,x", "0,0.0", "1,0.1", "2,", "3,"]
    assert (
        state(tmp_path)["frames_done"] == 4 and state(tmp_path)["summary"]["n"] == 4
    )
    assert sorted(path.name for path in tmp_path.iterdir()) == [STATE, STEPS]


def test_resume_without_a_checkpoint_or_of_nothing_starts_anew(tmp_path):
    for _ in range(2):
        with start(tmp_path, "resume") as folder:
            assert folder.rows == [] and folder.summary is None
    (tmp_path / CHECKPOINT).unlink()
    with start(tmp_path, "resume") as folder:
        assert folder.rows == [] and folder.summary is None
        folder.save("done", summary={"frames": 2, "files": []})
    with start(tmp_path, "resume") as folder:
        assert folder.summary["frames"] == 2


def test_a_checkpoint_that_was_cut_anywhere_gives_its_whole_lines(tmp_path):
    """So does a writer that is killed: it has written everything up to some byte."""
    with start(tmp_path / "out") as folder:
        for index in range(3):
            folder.add({"index": index}, {"n": [index]})
    content = (tmp_path / "out" / CHECKPOINT).read_bytes()
    assert content.count(b"\n") == 3
    second_line = content.index(b"\n") + 1
    for length in range(second_line, len(content)):
        (tmp_path / "out" / CHECKPOINT).write_bytes(content[:length])
        whole = content[:length].count(b"\n")
        with start(tmp_path / "out", "resume") as folder:
            assert [row["index"] for row in folder.rows] == list(range(whole))
            assert folder.tracker == {"n": [whole - 1]}
            for index in range(whole, 3):
                folder.add({"index": index}, {"n": [index]})
        assert (tmp_path / "out" / CHECKPOINT).read_bytes() == content
        assert (tmp_path / "out" / STEPS).read_text() == "index\n0\n1\n2\n"


def test_every_changed_byte_of_a_checkpoint_is_found(tmp_path):
    with start(tmp_path) as folder:
        for index in range(3):
            folder.add({"index": index}, {})
    content = (tmp_path / CHECKPOINT).read_bytes()
    for place in range(len(content)):
        changed = bytearray(content)
        changed[place] ^= 1
        (tmp_path / CHECKPOINT).write_bytes(changed)
        is_last_line_end = place == len(content) - 1
        if is_last_line_end:  # like a line that was cut off
            with start(tmp_path, "resume") as folder:
                assert len(folder.rows) == 2
            continue
        with pytest.raises(
            InputError, match=r"checkpoint\.jsonl:[123]: damaged.*--overwrite"
        ):
            with start(tmp_path, "resume"):
                pass


def other_lines(lines: list[bytes]) -> dict[str, list[bytes]]:
    """Checkpoints whose lines are whole, but not the ones that this run has written."""
    return {
        "first gone": lines[1:],
        "middle gone": [lines[0], lines[2]],
        "twice": [lines[0], *lines],
        "swapped": [lines[1], lines[0], lines[2]],
        "deep": [b"[" * 100_000],
        "none": [b"", *lines],
        "null": [b"null"],
        "number": [b"5"],
        "list": [b"[]"],
        "binary": [bytes(range(256)).replace(b"\n", b"")],
    }


def test_lines_of_a_checkpoint_in_another_order_are_refused(tmp_path):
    with start(tmp_path) as folder:
        for index in range(3):
            folder.add({"index": index}, {})
    lines = (tmp_path / CHECKPOINT).read_bytes().splitlines()
    for name, other in other_lines(lines).items():
        (tmp_path / CHECKPOINT).write_bytes(
            b"".join(line + b"\n" for line in other)
        )
        with pytest.raises(
            InputError, match=r"checkpoint\.jsonl:\d: damaged.*--overwrite"
        ):
            with start(tmp_path, "resume"):
                pytest.fail(name)


def test_the_checkpoint_of_another_run_is_refused(tmp_path):
    for name, seed in (("a", 0), ("b", 1)):
        with start(tmp_path / name, options={"seed": seed}) as folder:
            folder.add({"index": 0}, {})
    (tmp_path / "b" / CHECKPOINT).replace(tmp_path / "a" / CHECKPOINT)
    with pytest.raises(InputError, match=r"of another run.*--overwrite"):
        with start(tmp_path / "a", "resume", options={"seed": 0}):
            pass


def test_the_checkpoint_grows_by_the_same_for_every_frame(tmp_path):
    """What is written for a frame must not depend on how many came before."""
    sizes = []
    with start(tmp_path) as folder:
        for index in range(100, 200):
            folder.add({"index": index}, {"n": index})
            sizes.append((tmp_path / CHECKPOINT).stat().st_size)
            inode = (tmp_path / CHECKPOINT).stat().st_ino
    assert len(set(np.diff(sizes))) == 1
    # and nothing is written again
    assert (tmp_path / CHECKPOINT).stat().st_ino == inode


DAMAGED_STATES = ("", "{", "{}", "[]", "5", "[" * 100_000, '{"state": "done"}')


def test_resume_of_another_run_or_a_damaged_state_is_refused(tmp_path):
    with start(tmp_path):
        pass
    as_started = "as it was started: hybridvo run 'my walk' --fps 5"
    refusal = rf"options\.seed differs .0 then, 1 now.*{as_started}"
    with pytest.raises(InputError, match=refusal):
        with start(tmp_path, "resume", options={"seed": 1}):
            pass
    with pytest.raises(InputError, match="not those of the run, which read mine"):
        with start(tmp_path, "resume", input_hash="def"):
            pass
    whole = (tmp_path / STATE).read_text()
    changed = (
        whole[:-20],
        whole.replace("abc", "abd"),
        whole.replace("running", "done"),
    )
    for damaged in (*DAMAGED_STATES, *changed):
        assert damaged != whole
        (tmp_path / STATE).write_text(damaged)
        with pytest.raises(InputError, match=r"run\.json.*--overwrite"):
            with start(tmp_path, "resume"):
                pass
    (tmp_path / STATE).write_bytes(b"\xff\x00")
    with pytest.raises(InputError, match=r"run\.json.*--overwrite"):
        with start(tmp_path, "resume"):
            pass


def finished(path: Path, *names: str) -> None:
    with start(path) as folder:
        for name in names:
            (path / name).write_text("result")
        files = [str(path / name) for name in (*names, STATE)]
        folder.save("done", summary={"files": files})


def test_a_finished_run_whose_results_are_gone_is_computed_again(tmp_path, caplog):
    names = ("trajectory.tum", "trajectory.png")
    finished(tmp_path, *names)
    (tmp_path / "trajectory.tum").unlink()
    caplog.set_level(logging.WARNING, "hybridvo")
    with start(tmp_path, "resume") as folder:
        assert folder.summary is None and folder.rows == []
    assert "trajectory.tum gone: computed again" in caplog.text


def test_a_finished_run_lists_the_files_that_are_there(tmp_path):
    finished(tmp_path / "a", "trajectory.tum", "trajectory.png")
    (tmp_path / "a" / "trajectory.png").unlink()
    (tmp_path / "a").rename(tmp_path / "b")
    with start(tmp_path / "b", "resume") as folder:
        files = folder.summary["files"]
    assert files == [
        str(tmp_path / "b" / name) for name in ("trajectory.tum", STATE)
    ]
    assert folder.summary["out"] == str(tmp_path / "b")


def test_what_killed_writers_left_is_removed_and_nothing_else(tmp_path):
    (tmp_path / ".steps.csv.123-0a1b2c3d.tmp").write_text("")
    for name in (
        ".mine.tmp",
        "steps.csv.123-0a1b2c3d.tmp",
        ".steps.csv.123-0a1b2c3d",
    ):
        (tmp_path / name).write_text("")
    with locked_folder(tmp_path):
        pass
    assert sorted(path.name for path in tmp_path.iterdir()) == [
        *(".mine.tmp", ".steps.csv.123-0a1b2c3d", "steps.csv.123-0a1b2c3d.tmp"),
    ]


def test_a_second_run_in_the_same_folder_is_refused(tmp_path):
    with start(tmp_path) as folder:
        with pytest.raises(LockedError, match="another run"):
            with start(tmp_path, "overwrite"):
                pass
        folder.save("done")  # the first is unharmed
    with start(tmp_path, "overwrite"):
        pass


@pytest.fixture(scope="module")
def whole_run(
    dataset: Path, tmp_path_factory: pytest.TempPathFactory
) -> tuple[list[str], Path]:
    """The command of a run, without its folder, and what it came to when nothing stopped it."""
    command = [
        sys.executable,
        "-m",
        "hybridvo",
        "run",
        str(dataset),
        "--flow",
        "dis",
    ]
    command += ["--method", "classical", "-q", "--out"]
    out = tmp_path_factory.mktemp("whole")
    subprocess.run(
        [*command, str(out), "--overwrite"], check=True, capture_output=True
    )
    return command, out


@pytest.mark.long
@pytest.mark.parametrize(
    "number", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP, signal.SIGKILL]
)
def test_a_run_that_was_stopped_is_resumed_to_the_same_end(
    whole_run, tmp_path, number
):
    command, whole = whole_run
    child = subprocess.Popen([*command, str(tmp_path)], stdout=subprocess.DEVNULL)
    while child.poll() is None and not (tmp_path / STATE).exists():
        time.sleep(0.01)
    child.send_signal(number)
    child.wait()
    # a signal may come when the frames are done: then it acts as usual, or too late
    assert child.returncode in (0, 128 + number, -number)
    if child.returncode == 128 + number:
        assert state(tmp_path)["state"] == "interrupted"
    done = subprocess.run(
        [*command, str(tmp_path), "--resume"], capture_output=True, check=False
    )
    assert done.returncode == 0, done.stderr
    ends = [
        read_trajectory(path / "trajectory.tum").T_world_cam
        for path in (whole, tmp_path)
    ]
    np.testing.assert_array_equal(ends[0], ends[1])
