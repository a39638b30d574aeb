"""Runs that die, in the short: tools/stress.py repeats them by the hundred (faults.md, F28-F43)."""

from __future__ import annotations

import contextlib
import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from hybridvo.cli import main
from hybridvo.errors import LockedError, OutputError
from hybridvo.run import run_name
from hybridvo.run_folder import LOCK, PARTIAL, STATE, RunFolder

TOOLS = Path(__file__).parents[2] / "tools"

pytestmark = pytest.mark.skipif(not hasattr(os, "fork"), reason="forks")


@pytest.fixture(autouse=True)
def tools_on_the_path(monkeypatch: pytest.MonkeyPatch) -> None:
    """What ``python tools/stress.py`` does: the script's folder comes first."""
    monkeypatch.syspath_prepend(TOOLS)


@pytest.fixture(scope="module")
def figures(tmp_path_factory: pytest.TempPathFactory) -> dict:
    """All campaigns, each a few times, in one process of their own."""
    out = tmp_path_factory.mktemp("stress") / "stress.json"
    names = "kills,signals,full_disk,two_runs,deleted_input,denied"
    command = [sys.executable, str(TOOLS / "stress.py"), "--campaigns", names]
    counts = ["--counts", "kills=20,signals=3,full_disk=2,two_runs=2,deleted_input=3,denied=1"]
    done = subprocess.run([*command, *counts, "--out", str(out)], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr[-3000:]
    return json.loads(out.read_text())


def test_killed_runs_lose_no_frame_and_end_with_the_same_bytes(figures: dict) -> None:
    kills = figures["kills"]
    assert kills["kills"] == 20 and kills["runs"] >= 4
    assert kills["identical"] == kills["runs"], kills
    assert kills["frames_lost"] == kills["refused"] == kills["failed"] == 0, kills


def test_signals_end_a_run_in_order(figures: dict) -> None:
    signals = figures["signals"]
    assert signals["signals"] == signals["exit_130"] == signals["identical"] == 3, signals
    assert signals["frames_lost"] == signals["locks_left"] == signals["tracebacks"] == 0, signals


def test_a_full_disk_costs_nothing_that_was_finished(figures: dict) -> None:
    full = figures["full_disk"]
    assert full["runs"] == full["identical"] == full["exit_5"] + full["exit_0"] == 2, full
    assert full["half_written"] == full["frames_lost"] == full["tracebacks"] == 0, full


def test_of_three_runs_in_one_folder_one_works(figures: dict) -> None:
    two = figures["two_runs"]
    assert two["rounds"] == two["one_winner"] == two["identical"] == 2, two
    assert two["tracebacks"] == 0, two


def test_input_that_vanishes_is_failed_frames(figures: dict) -> None:
    deleted = figures["deleted_input"]
    assert deleted["runs"] == deleted["lost_frames_said"] == 3, deleted
    assert deleted["rows_missing"] == deleted["not_finite"] == deleted["tracebacks"] == 0, deleted
    assert deleted["resumed"] == 0, "a resume on what is left of the input"


def test_what_may_not_be_written(figures: dict) -> None:
    denied = figures["denied"]
    output = denied["read_only_output"]
    assert output == {"exit_code": 5, "frames_computed": 0, "one_line": True}
    home = denied["read_only_home"]
    assert home == {"exit_code": 0, "identical": True, "files_elsewhere": []}
    assert denied["no_home_at_all"] == {"exit_code": 0, "identical": True}


def test_a_closed_terminal_keeps_what_is_finished(tmp_path: Path) -> None:
    """Not the signal alone: the terminal is gone, and nothing can be written to it any more."""
    pty = pytest.importorskip("pty")
    from stress_parts import REFINE, ROOT, command, rows_kept, state, write_walk

    frames = 4000  # 10 s and more: it cannot be through when the terminal closes
    walk, out = write_walk(tmp_path / "walk", frames, distinct=8), tmp_path / "out"
    pid, terminal = pty.fork()
    if pid == 0:
        signal.signal(signal.SIGHUP, signal.SIG_DFL)  # also under nohup
        os.environ |= {"PYTHONPATH": str(ROOT), "OMP_NUM_THREADS": "1"}
        arguments = command(walk, out, *REFINE[:-1])  # not quiet: with its bar
        os.execv(sys.executable, [sys.executable, "-m", "hybridvo.cli", *arguments])
    os.set_blocking(terminal, False)
    until = time.monotonic() + 120
    while not (out / PARTIAL).exists() or rows_kept(out) < 5:
        assert time.monotonic() < until
        with contextlib.suppress(BlockingIOError, OSError):
            os.read(terminal, 65536)
        time.sleep(0.01)
    os.close(terminal)
    _, status = os.waitpid(pid, 0)
    assert os.waitstatus_to_exitcode(status) == 130
    assert state(out)["state"] == "interrupted"
    assert 5 <= rows_kept(out) == state(out)["frames_done"] < frames
    assert not (out / LOCK).exists()
    assert len((out / "trajectory.tum").read_text().splitlines()) >= rows_kept(out)


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
    sys.path.insert(0, str(TOOLS))
    try:
        from stress_parts import write_walk
    finally:
        sys.path.remove(str(TOOLS))
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


def test_a_hybrid_run_with_its_window_resumes_to_the_same_bytes(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Key frames, history of the motion and trust in the pictures live beyond one pair."""
    from stress_parts import content, write_walk

    walk = write_walk(tmp_path / "walk", 9, height=64, width=96, pictures=True)
    options = ("--method", "hybrid", "--flow", "dis")
    assert run(walk, tmp_path / "whole", *options) == 0
    out = tmp_path / "out"
    stopped(walk, out, 3, monkeypatch, *options)
    stopped(walk, out, 6, monkeypatch, *options, "--resume")
    assert run(walk, out, *options, "--resume") == 0
    assert content(out) == content(tmp_path / "whole")


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
