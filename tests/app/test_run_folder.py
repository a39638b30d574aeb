from __future__ import annotations

import contextlib
import json
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from hybridvo.commands.run import STATE, STEPS, RunFolder
from hybridvo.errors import InputError, LockedError, OutputError
from hybridvo.files import held
from hybridvo.trajectory import read_trajectory

IDENTITY = {"input_hash": "abc", "options": {"seed": 0}}


@contextlib.contextmanager
def start(path: Path, mode: str = "new", **identity: object) -> Iterator[RunFolder]:
    with held(path):
        yield RunFolder(path, IDENTITY | identity, mode)  # type: ignore[arg-type]


def state(path: Path) -> dict:
    return json.loads((path / STATE).read_text())


def test_results_are_replaced_only_when_asked_and_nothing_else(tmp_path):
    with start(tmp_path) as folder:
        folder.save("done")
    with pytest.raises(InputError, match=r"--overwrite.*--resume"):
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
        folder.rows.extend([{"index": 0}, {"index": 1}])
        folder.save_rows({"T": np.eye(4)})
        folder.rows.append({"index": 2})  # after it: computed again
        assert state(tmp_path)["state"] == "running"
    with start(tmp_path, "resume") as folder:
        assert [row["index"] for row in folder.rows] == [0, 1]
        np.testing.assert_array_equal(folder.tracker["T"], np.eye(4))
        folder.rows.append({"index": 2})
        folder.save_rows()
        folder.save("done", summary={"n": 3})
    lines = (tmp_path / STEPS).read_text().splitlines()
    assert [line.split(",")[0] for line in lines] == ["index", "0", "1", "2"]
    assert state(tmp_path)["frames_done"] == 3 and state(tmp_path)["summary"] == {"n": 3}
    assert sorted(path.name for path in tmp_path.iterdir()) == [STATE, STEPS]


def test_resume_without_a_checkpoint_or_of_nothing_starts_anew(tmp_path):
    for _ in range(2):
        with start(tmp_path, "resume") as folder:
            assert folder.rows == [] and folder.summary is None
    with start(tmp_path, "resume") as folder:
        folder.save("done", summary={"frames": 2})
    with start(tmp_path, "resume") as folder:
        assert folder.summary == {"frames": 2}


def test_resume_of_another_run_or_a_damaged_state_is_refused(tmp_path):
    with start(tmp_path):
        pass
    with pytest.raises(InputError, match=r"options\.seed differs .0 then, 1 now"):
        with start(tmp_path, "resume", options={"seed": 1}):
            pass
    for damaged in ("{", "{}"):
        (tmp_path / STATE).write_text(damaged)
        with pytest.raises(InputError, match=r"run\.json.*--overwrite"):
            with start(tmp_path, "resume"):
                pass


def test_a_second_run_in_the_same_folder_is_refused(tmp_path):
    with start(tmp_path) as folder:
        with pytest.raises(LockedError, match="another run"):
            with start(tmp_path, "overwrite"):
                pass
        folder.save("done")  # the first is unharmed
    with start(tmp_path, "overwrite"):
        pass


def test_a_file_in_place_of_the_folder(tmp_path):
    (tmp_path / "out").write_text("")
    with pytest.raises(OutputError, match="out: cannot be created"):
        with start(tmp_path / "out"):
            pass


@pytest.mark.slow
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGKILL])
def test_a_run_that_was_stopped_is_resumed_to_the_same_end(dataset, tmp_path, number):
    command = [sys.executable, "-m", "hybridvo.cli", "run", str(dataset), "--flow", "dis"]
    command += ["--method", "refine", "-q", "--out"]
    subprocess.run([*command, str(tmp_path / "whole")], check=True, capture_output=True)
    cut = tmp_path / "cut"
    child = subprocess.Popen([*command, str(cut)], stdout=subprocess.DEVNULL)
    while child.poll() is None and not (cut / STATE).exists():
        time.sleep(0.01)
    child.send_signal(number)
    child.wait()
    assert child.returncode in (0, 130, -number)
    done = subprocess.run([*command, str(cut), "--resume"], capture_output=True, check=False)
    assert done.returncode == 0, done.stderr
    ends = [read_trajectory(tmp_path / n / "trajectory.tum").T_world_cam for n in ("whole", "cut")]
    np.testing.assert_allclose(ends[0], ends[1], atol=1e-6)
