from __future__ import annotations

import json
import os
import socket
import subprocess
import sys
from pathlib import Path

import pytest

from hybridvo.errors import InputError, LockedError, OutputError
from hybridvo.run_folder import LOCK, PARTIAL, STATE, RunFolder

IDENTITY = {"input_hash": "abc", "options": {"seed": 0}}


def start(path: Path, mode: str = "new", **identity: object) -> RunFolder:
    return RunFolder(path, IDENTITY | identity, {"command": ["test"]}, mode)  # type: ignore[arg-type]


def state(path: Path) -> dict:
    return json.loads((path / STATE).read_text())


def dead_pid() -> int:
    child = subprocess.Popen([sys.executable, "-c", ""])
    child.wait()
    return child.pid


def test_rows_are_on_disk_as_they_are_appended(tmp_path: Path) -> None:
    with start(tmp_path / "out") as folder:
        for i in range(3):
            folder.append({"index": i, "value": 0.1 + i})
            lines = (tmp_path / "out" / PARTIAL).read_text().splitlines()
            assert json.loads(lines[-1]) == {"index": i, "value": 0.1 + i}
        assert [row["index"] for row in folder.rows()] == [0, 1, 2]
        assert state(tmp_path / "out")["state"] == "running"
        folder.finish(summary={"n": 3})
    assert state(tmp_path / "out")["state"] == "done"
    assert state(tmp_path / "out")["frames_done"] == 3
    assert sorted(p.name for p in (tmp_path / "out").iterdir()) == [STATE]


def test_results_are_not_overwritten_unasked(tmp_path: Path) -> None:
    with start(tmp_path) as folder:
        folder.finish()
    with pytest.raises(InputError, match=r"holds results .*run\.json.*--overwrite.*--resume"):
        start(tmp_path)
    (tmp_path / "trajectory.tum").write_text("old")
    (tmp_path / "mine.txt").write_text("keep")
    with start(tmp_path, "overwrite"):
        assert not (tmp_path / "trajectory.tum").exists()
        assert (tmp_path / "mine.txt").read_text() == "keep"


def test_overwrite_removes_a_link_and_not_what_it_points_to(tmp_path: Path) -> None:
    sentinel = tmp_path / "sentinel"
    sentinel.write_text("untouched")
    out = tmp_path / "out"
    out.mkdir()
    for name in ("trajectory.tum", PARTIAL, STATE):
        (out / name).symlink_to(sentinel)
    with start(out, "overwrite") as folder:
        folder.append({"index": 0})
    assert sentinel.read_text() == "untouched"


@pytest.mark.parametrize("torn", ['{"index": 2, "val', '{"index": 2}', "\x00\x00\x00\n", "[1]\n"])
def test_resume_drops_a_torn_line(tmp_path: Path, torn: str) -> None:
    with start(tmp_path) as folder:
        folder.append({"index": 0})
        folder.append({"index": 1})
    with (tmp_path / PARTIAL).open("a") as file:
        file.write(torn)
    with start(tmp_path, "resume") as folder:
        assert folder.frames_done == 2
        assert folder.last == {"index": 1}
        folder.append({"index": 2})
        assert [row["index"] for row in folder.rows()] == [0, 1, 2]


def test_resume_of_nothing_starts_anew(tmp_path: Path) -> None:
    with start(tmp_path, "resume") as folder:
        assert folder.frames_done == 0 and not folder.finished


def test_resume_of_a_finished_run_says_so(tmp_path: Path) -> None:
    with start(tmp_path) as folder:
        folder.finish()
    with start(tmp_path, "resume") as folder:
        assert folder.finished


def test_resume_of_another_run_is_refused(tmp_path: Path) -> None:
    with start(tmp_path) as folder:
        folder.append({"index": 0})
    before = (tmp_path / PARTIAL).read_bytes()
    with pytest.raises(InputError, match=r"options differ .*options\.seed: 0 then, 1 now"):
        start(tmp_path, "resume", options={"seed": 1})
    assert (tmp_path / PARTIAL).read_bytes() == before
    assert not (tmp_path / LOCK).exists()


def test_resume_with_a_damaged_state_is_refused(tmp_path: Path) -> None:
    (tmp_path / STATE).write_text("{")
    with pytest.raises(InputError, match=r"run\.json: cannot be read.*--overwrite"):
        start(tmp_path, "resume")


def test_second_run_in_the_same_folder_is_refused(tmp_path: Path) -> None:
    with start(tmp_path) as folder:
        with pytest.raises(LockedError, match=f"held by another run .process {os.getpid()}"):
            start(tmp_path, "overwrite")
        folder.append({"index": 0})  # the first is unharmed
        assert (tmp_path / LOCK).exists()
    assert not (tmp_path / LOCK).exists()


def test_lock_of_a_dead_process_is_cleared(tmp_path: Path) -> None:
    holder = {"pid": dead_pid(), "host": socket.gethostname(), "started": "1"}
    (tmp_path / LOCK).write_text(json.dumps(holder))
    with start(tmp_path):
        assert json.loads((tmp_path / LOCK).read_text())["pid"] == os.getpid()
    assert list(tmp_path.glob(f".{LOCK}*")) == []


@pytest.mark.skipif(not Path("/proc/self/stat").exists(), reason="needs /proc to tell start times")
def test_lock_whose_pid_was_given_to_another_process_is_cleared(tmp_path: Path) -> None:
    holder = {"pid": os.getpid(), "host": socket.gethostname(), "started": "1"}
    (tmp_path / LOCK).write_text(json.dumps(holder))
    with start(tmp_path):
        pass


def test_lock_of_another_machine_is_respected(tmp_path: Path) -> None:
    holder = {"pid": 1, "host": "elsewhere.invalid", "started": None}
    (tmp_path / LOCK).write_text(json.dumps(holder))
    with pytest.raises(LockedError, match=r"process 1 on elsewhere\.invalid.*remove"):
        start(tmp_path)


@pytest.mark.parametrize("content", ["", "not json", "{}", '{"pid": "x", "host": 1}'])
def test_lock_that_cannot_be_read_is_respected(tmp_path: Path, content: str) -> None:
    (tmp_path / LOCK).write_text(content)
    with pytest.raises(LockedError, match="remove the file"):
        start(tmp_path)
    assert (tmp_path / LOCK).read_text() == content


def test_a_file_in_place_of_the_folder(tmp_path: Path) -> None:
    (tmp_path / "out").write_text("")
    with pytest.raises(OutputError, match="out: cannot be created"):
        start(tmp_path / "out")


def test_a_folder_in_place_of_a_result(tmp_path: Path) -> None:
    (tmp_path / "trajectory.tum").mkdir()
    with pytest.raises(InputError, match=r"trajectory\.tum: is a folder"):
        start(tmp_path, "overwrite")
    assert not (tmp_path / LOCK).exists()


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="needs /dev/full")
def test_full_disk_is_an_output_error(tmp_path: Path) -> None:
    with start(tmp_path) as folder:
        folder._partial.close()  # type: ignore[union-attr]
        folder._partial = open("/dev/full", "ab", buffering=0)  # type: ignore[assignment]
        with pytest.raises(OutputError, match="No space left"):
            folder.append({"index": 0})
