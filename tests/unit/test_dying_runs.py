"""Runs that die, and what they leave: nothing finished is lost."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from hybridvo.cli import main
from hybridvo.errors import LockedError, OutputError
from hybridvo.run import run_name
from hybridvo.run_folder import LOCK, PARTIAL, STATE, RunFolder
from tests.walks import write_walk

pytestmark = pytest.mark.skipif(not hasattr(os, "fork"), reason="forks")


IDENTITY = {"input_hash": "abc"}


def start(path: Path, mode: str = "new") -> RunFolder:
    return RunFolder(path, IDENTITY, {"command": ["test"]}, mode)  # type: ignore[arg-type]


def test_a_killed_process_that_nobody_waited_for_holds_no_lock(tmp_path: Path) -> None:
    """A container without an init keeps the dead as zombies, pid and start time and all."""
    code = (
        "import os, signal, sys\n"
        "from hybridvo.run_folder import RunFolder\n"
        "RunFolder(sys.argv[1], {'input_hash': 'abc'}, {}).append({'index': 0})\n"
        "os.kill(os.getpid(), signal.SIGKILL)\n"
    )
    child = subprocess.Popen([sys.executable, "-c", code, str(tmp_path)])
    os.waitid(os.P_PID, child.pid, os.WEXITED | os.WNOWAIT)
    try:
        assert (tmp_path / LOCK).exists()
        with start(tmp_path, "resume") as folder:
            assert folder.frames_done == 1
    finally:
        child.wait()


def test_what_a_killed_run_left_half_written_goes_away(tmp_path: Path) -> None:
    with start(tmp_path) as folder:
        folder.append({"index": 0})
    holder = {"pid": os.getpid(), "host": "elsewhere.invalid", "started": None}
    (tmp_path / f".{LOCK}.0123abcd").write_text(json.dumps(holder))
    (tmp_path / ".trajectory.tum.77-0123abcd.tmp").write_text("1 2 3")
    (tmp_path / ".notes.tum.77-0123abcd.tmp").write_text("not ours")
    with start(tmp_path, "resume") as folder:
        assert folder.frames_done == 1
        folder.finish()
    assert sorted(p.name for p in tmp_path.iterdir()) == [
        ".notes.tum.77-0123abcd.tmp",
        f".{LOCK}.0123abcd",  # of another machine: may be a living run
        STATE,
    ]


def test_rows_left_by_a_kill_after_the_end_go_away(tmp_path: Path) -> None:
    with start(tmp_path) as folder:
        folder.append({"index": 0})
        rows = (tmp_path / PARTIAL).read_bytes()
        folder.finish()
    (tmp_path / PARTIAL).write_bytes(rows)
    with start(tmp_path, "resume") as folder:
        assert folder.finished
    assert sorted(p.name for p in tmp_path.iterdir()) == [STATE]


def test_resume_never_cuts_a_file_behind_a_link(tmp_path: Path) -> None:
    sentinel = tmp_path / "sentinel"
    sentinel.write_text("no row at all")
    out = tmp_path / "out"
    with start(out) as folder:
        folder.append({"index": 0})
    (out / PARTIAL).unlink()
    (out / PARTIAL).symlink_to(sentinel)
    with pytest.raises(OutputError):
        start(out, "resume")
    assert sentinel.read_text() == "no row at all"
    assert not (out / LOCK).exists()


def test_a_lock_on_a_full_disk_is_none(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    import hybridvo.run_folder as module

    def full(path: Path, content: bytes) -> None:
        path.write_bytes(b"")
        path.unlink()
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(module, "_write_new", full)
    with pytest.raises(OutputError, match="No space left"):
        start(tmp_path)
    monkeypatch.undo()
    with start(tmp_path):
        pass


def test_a_lock_without_hard_links(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def unsupported(*_: object, **__: object) -> None:
        raise PermissionError(1, "Operation not permitted")

    monkeypatch.setattr(os, "link", unsupported)
    with start(tmp_path):
        assert json.loads((tmp_path / LOCK).read_text())["pid"] == os.getpid()
        with pytest.raises(LockedError, match="held by another run"):
            start(tmp_path, "resume")
    assert list(tmp_path.glob(f"*{LOCK}*")) == []


@pytest.fixture(scope="module")
def walk(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_walk(tmp_path_factory.mktemp("walk") / "walk", 6)


def run(walk: Path, out: Path, *options: str) -> int:
    arguments = ["run", "--sequence", str(walk), "--out", str(out), "--method", "identity"]
    return main([*arguments, "--flow", "file", "-q", *options])


def stopped(
    walk: Path, out: Path, rows: int, monkeypatch: pytest.MonkeyPatch, *options: str
) -> None:
    """A run whose process died after some frames."""

    class Died(BaseException):
        pass

    append = RunFolder.append

    def die(self: RunFolder, row: dict) -> None:
        if self.frames_done == rows:
            raise Died
        append(self, row)

    with monkeypatch.context() as patch:
        patch.setattr(RunFolder, "append", die)
        with pytest.raises(Died):
            run(walk, out, *options)


def test_a_hybrid_run_with_its_window_resumes_to_the_same_poses(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Key frames, the history of the motion and the window live beyond one pair."""
    walk = write_walk(tmp_path / "walk", 9, height=64, width=96, pictures=True)
    options = ("--method", "hybrid", "--flow", "dis")
    assert run(walk, tmp_path / "whole", *options) == 0
    out = tmp_path / "out"
    stopped(walk, out, 3, monkeypatch, *options)
    stopped(walk, out, 6, monkeypatch, *options, "--resume")
    assert run(walk, out, *options, "--resume") == 0
    with np.load(tmp_path / "whole" / "steps.npz") as whole, np.load(out / "steps.npz") as resumed:
        for name in ("T_curr_prev", "covariance"):
            np.testing.assert_allclose(resumed[name], whole[name], rtol=0, atol=1e-6)


@pytest.mark.parametrize(
    ("damage", "message"),
    [
        ({"anchor": None}, "row 3 cannot be used"),
        ({"failed_so_far": "many"}, "row 3 cannot be used"),
        ({"index": 4}, "another frame's"),
    ],
)
def test_rows_that_were_tampered_with(
    walk: Path,
    tmp_path: Path,
    damage: dict,
    message: str,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    out = tmp_path / "out"
    stopped(walk, out, 3, monkeypatch)
    *before, last = (out / PARTIAL).read_text().splitlines()
    (out / PARTIAL).write_text("\n".join([*before, json.dumps(json.loads(last) | damage)]) + "\n")
    assert run(walk, out, "--resume") == 2
    error = capsys.readouterr().err
    assert message in error and error.count("\n") == 1
    assert len((out / PARTIAL).read_text().splitlines()) == 3  # nothing is thrown away unasked


def test_resume_with_other_weights_is_refused(
    walk: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    out = tmp_path / "out"
    monkeypatch.setattr("hybridvo.run.weights_hash", lambda method: "of yesterday")
    stopped(walk, out, 3, monkeypatch)
    monkeypatch.setattr("hybridvo.run.weights_hash", lambda method: "of today")
    assert run(walk, out, "--resume") == 2
    assert "cannot be resumed: weights differ" in capsys.readouterr().err


def test_weights_have_a_hash_where_there_are_any() -> None:
    from hybridvo.pipeline import weights_hash

    assert weights_hash("refine") is None and weights_hash("identity") is None
    judged, alone = weights_hash("hybrid"), weights_hash("pwvo")
    assert judged and alone and judged != alone and len(judged) == 64


@pytest.mark.parametrize("name", ["../../x", "/", "..", ".hidden", "a/b\\c", "", "x\n\0y", "é😀 z"])
def test_a_name_is_one_plain_part_of_a_path(name: str, walk: Path) -> None:
    from hybridvo.data.sequence import open_sequence

    sequence = open_sequence(walk)
    sequence.name = name  # type: ignore[misc]
    part = run_name(sequence)
    assert part and Path(part).name == part and part not in (".", "..")
    assert "\0" not in part and "\\" not in part


def test_a_full_stdout_is_an_output_error(tmp_path: Path) -> None:
    """And a closed one none: what is written to it goes nowhere, not into the next open file."""
    truth = tmp_path / "gt"
    truth.write_text("".join(f"{i}.0 {i} 0 0 0 0 0 1\n" for i in range(5)))
    command = [sys.executable, "-m", "hybridvo.cli", "evaluate", str(truth), str(truth)]
    if Path("/dev/full").exists():
        with open("/dev/full", "wb") as full:
            done = subprocess.run(command, stdout=full, stderr=subprocess.PIPE, text=True)
        assert done.returncode == 5
        assert done.stderr == "hybridvo: stdout: cannot be written: No space left on device.\n"
    close = "import os, sys; os.close(1); os.close(2); os.execv(sys.argv[1], sys.argv[1:])"
    done = subprocess.run([sys.executable, "-c", close, *command], capture_output=True)
    assert (done.returncode, done.stdout, done.stderr) == (0, b"", b"")


def test_caches_are_not_kept_where_others_can_write(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Numba's cache holds code: a folder that somebody prepared in /tmp must not become it."""
    from hybridvo.cli import _prepare_caches

    monkeypatch.setattr("tempfile.gettempdir", lambda: str(tmp_path))
    monkeypatch.setattr("os.access", lambda *_: False)
    for name in ("MPLCONFIGDIR", "NUMBA_CACHE_DIR"):
        monkeypatch.setenv(name, "")
        monkeypatch.delenv(name)
    scratch = tmp_path / f"hybridvo-{os.getuid()}"
    scratch.mkdir()
    scratch.chmod(0o777)
    _prepare_caches()
    assert "NUMBA_CACHE_DIR" not in os.environ
    scratch.rmdir()
    _prepare_caches()
    assert os.environ["NUMBA_CACHE_DIR"] == os.environ["MPLCONFIGDIR"] == str(scratch)
    assert scratch.stat().st_mode & 0o777 == 0o700
    for name in ("MPLCONFIGDIR", "NUMBA_CACHE_DIR"):
        del os.environ[name]
    scratch.rmdir()
    scratch.symlink_to(tmp_path)
    _prepare_caches()
    assert "NUMBA_CACHE_DIR" not in os.environ


def test_a_recording_never_follows_a_link(tmp_path: Path) -> None:
    pytest.importorskip("rerun", reason="Rerun is not installed (extra viz)")
    from hybridvo.recording import Recording

    (tmp_path / "a.rrd").symlink_to(tmp_path / "elsewhere.rrd")
    with Recording(tmp_path / "a.rrd", "x", "id", 1) as recording:
        pass
    assert not recording.failed and (tmp_path / "a.rrd").stat().st_size > 0
    assert [path.name for path in tmp_path.iterdir()] == ["a.rrd"]
