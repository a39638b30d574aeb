from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

from hybridvo.commands.progress import Progress, interruptible
from hybridvo.commands.run_folder import STATE, STEPS, RunFolder
from hybridvo.errors import InputError, LockedError, OutputError
from hybridvo.trajectory import read_trajectory

IDENTITY = {"input_hash": "abc", "options": {"seed": 0}}


def start(path: Path, mode: str = "new", **identity: object) -> RunFolder:
    return RunFolder(path, IDENTITY | identity, {"command": ["test"]}, mode)  # type: ignore[arg-type]


def state(path: Path) -> dict:
    return json.loads((path / STATE).read_text())


def test_steps_are_on_disk_as_they_are_appended(tmp_path):
    out = tmp_path / "out"
    with start(out) as folder:
        for i in range(3):
            folder.append({"index": i})
            assert len((out / STEPS).read_text().splitlines()) == i + 2  # and the header
        assert state(out)["state"] == "running"
        folder.write_state("done", summary={"n": 3})
    assert state(out)["frames_done"] == 3 and state(out)["summary"] == {"n": 3}
    assert sorted(path.name for path in out.iterdir()) == [STATE, STEPS]


def test_results_are_replaced_only_when_asked_and_only_those_of_a_run(tmp_path):
    with start(tmp_path) as folder:
        folder.write_state("done")
    with pytest.raises(InputError, match=r"--overwrite.*--resume"):
        start(tmp_path)
    (tmp_path / "trajectory.tum").write_text("old")
    (tmp_path / "mine.txt").write_text("keep")
    with start(tmp_path, "overwrite"):
        assert not (tmp_path / "trajectory.tum").exists()
        assert (tmp_path / "mine.txt").read_text() == "keep"
    other = tmp_path / "other"
    other.mkdir()
    (other / "trajectory.tum").write_text("a user's own")
    with pytest.raises(InputError, match=r"trajectory\.tum"):
        start(other, "overwrite")
    assert (other / "trajectory.tum").read_text() == "a user's own"


def test_overwrite_removes_a_link_and_not_what_it_points_to(tmp_path):
    with start(tmp_path / "out") as folder:
        folder.write_state("done")
    sentinel = tmp_path / "sentinel"
    sentinel.write_text("untouched")
    (tmp_path / "out" / "trajectory.tum").symlink_to(sentinel)
    with start(tmp_path / "out", "overwrite"):
        pass
    assert sentinel.read_text() == "untouched"
    assert not (tmp_path / "out" / "trajectory.tum").is_symlink()


def test_resume_goes_on_from_the_checkpoint(tmp_path):
    with start(tmp_path) as folder:
        folder.append({"index": 0})
        folder.append({"index": 1})
        folder.save_checkpoint({"T": np.eye(4)})
        folder.append({"index": 2})  # after it: computed again
    with (tmp_path / STEPS).open("a") as file:
        file.write("3,0.1,o")  # torn by the end of the process
    with start(tmp_path, "resume") as folder:
        assert [row["index"] for row in folder.rows] == [0, 1]
        np.testing.assert_array_equal(folder.tracker["T"], np.eye(4))
        folder.append({"index": 2})
    lines = (tmp_path / STEPS).read_text().splitlines()
    assert [line.split(",")[0] for line in lines] == ["index", "0", "1", "2"]


def test_resume_without_a_checkpoint_or_of_nothing_starts_anew(tmp_path):
    with start(tmp_path, "resume") as folder:
        folder.append({"index": 0})
    with start(tmp_path, "resume") as folder:
        assert folder.rows == [] and not folder.finished
        folder.write_state("done")
    with start(tmp_path, "resume") as folder:
        assert folder.finished


def test_resume_of_another_run_or_a_damaged_state_is_refused(tmp_path):
    with start(tmp_path) as folder:
        folder.append({"index": 0})
    with pytest.raises(InputError, match=r"options\.seed differs .0 then, 1 now"):
        start(tmp_path, "resume", options={"seed": 1})
    (tmp_path / STATE).write_text("{")
    with pytest.raises(InputError, match=r"run\.json.*--overwrite"):
        start(tmp_path, "resume")


def test_a_second_run_in_the_same_folder_is_refused(tmp_path):
    with start(tmp_path) as folder:
        with pytest.raises(LockedError, match="another run"):
            start(tmp_path, "overwrite")
        folder.append({"index": 0})  # the first is unharmed
    with start(tmp_path, "overwrite"):
        pass


def test_a_file_in_place_of_the_folder(tmp_path):
    (tmp_path / "out").write_text("")
    with pytest.raises(OutputError, match="out: cannot be created"):
        start(tmp_path / "out")


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="needs /dev/full")
def test_a_full_disk_is_an_output_error(tmp_path):
    with start(tmp_path) as folder:
        (tmp_path / STEPS).symlink_to("/dev/full")
        with pytest.raises(OutputError, match="No space left"):
            folder.append({"index": 0})


def test_the_first_signal_sets_the_event_and_the_second_aborts():
    before = signal.getsignal(signal.SIGTERM)
    with interruptible() as interrupted:
        assert not interrupted.is_set()
        os.kill(os.getpid(), signal.SIGTERM)
        assert interrupted.wait(5)
        with pytest.raises(KeyboardInterrupt):
            os.kill(os.getpid(), signal.SIGTERM)
            time.sleep(1)
    assert signal.getsignal(signal.SIGTERM) is before


def test_progress_on_a_terminal_is_a_bar():
    import io

    from rich.console import Console

    text = io.StringIO()
    console = Console(file=text, force_terminal=True, width=120)
    with Progress(4, "static [x]", console=console) as progress:
        progress.say("a line")
        progress.update(4, 1)
    assert "static [x]" in text.getvalue() and "4/4" in text.getvalue()
    assert "1 failed" in text.getvalue() and "a line" in text.getvalue()


@pytest.mark.slow
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGKILL])
def test_a_run_that_was_stopped_is_resumed_to_the_same_end(dataset, tmp_path, number):
    command = [sys.executable, "-m", "hybridvo.cli", "run", str(dataset), "--flow", "dis"]
    command += ["--method", "refine", "-q", "--out"]
    subprocess.run([*command, str(tmp_path / "whole")], check=True, capture_output=True)
    cut = tmp_path / "cut"
    child = subprocess.Popen([*command, str(cut)], stdout=subprocess.DEVNULL)
    while child.poll() is None and not (cut / STEPS).exists():
        time.sleep(0.01)
    child.send_signal(number)
    child.wait()
    assert child.returncode in (0, 130, -number)
    done = subprocess.run([*command, str(cut), "--resume"], capture_output=True, check=False)
    assert done.returncode == 0, done.stderr
    ends = [read_trajectory(tmp_path / n / "trajectory.tum").T_world_cam for n in ("whole", "cut")]
    np.testing.assert_allclose(ends[0], ends[1], atol=1e-6)
