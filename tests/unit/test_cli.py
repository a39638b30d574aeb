from __future__ import annotations

import json
import os
import signal
import socket
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

from hybridvo import __version__
from hybridvo.cli import main
from hybridvo.console import Progress, interruptible
from hybridvo.run_folder import LOCK
from hybridvo.synthetic.render import make_scene, write_sintel

HYBRIDVO = [sys.executable, "-m", "hybridvo.cli"]


@pytest.fixture(scope="module")
def sequence(tmp_path_factory: pytest.TempPathFactory) -> str:
    root = tmp_path_factory.mktemp("sintel")
    write_sintel(make_scene("static", 1, height=48, width=96, frames=3), root, "tiny")
    return str(root / "training" / "clean" / "tiny")


def write_tum(path: Path, poses: int = 5, noise: float = 0.0) -> str:
    rng = np.random.default_rng(0)
    x = np.cumsum(rng.normal(size=(poses, 3)), axis=0) + noise * rng.normal(size=(poses, 3))
    lines = [f"{i}.0 {a:.17g} {b:.17g} {c:.17g} 0 0 0 1" for i, (a, b, c) in enumerate(x)]
    path.write_text("\n".join(lines) + "\n")
    return str(path)


def test_version_and_help(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["--version"]) == 0
    assert capsys.readouterr().out == f"hybridvo {__version__}\n"
    assert main(["run", "--help"]) == 0
    text = capsys.readouterr().out
    for option in (
        "--sequence --dataset --out --method --flow --start --stop --stride --device --config "
        "--set --resume --overwrite --rrd --json --max-failed --strict -v -q"
    ).split():
        assert option in text


def test_help_is_fast() -> None:
    """Nothing heavy is imported before parsing: best of three, 0.3 s on a quiet machine."""
    times = []
    for _ in range(3):
        started = time.perf_counter()
        subprocess.run([*HYBRIDVO, "--help"], check=True, stdout=subprocess.DEVNULL)
        times.append(time.perf_counter() - started)
        if times[-1] < 0.3:
            return
    code = "import sys, hybridvo.cli; sys.exit(any(m in sys.modules for m in ('numpy', 'torch')))"
    subprocess.run([sys.executable, "-c", code], check=True)
    assert min(times) < 1.5  # a loaded machine


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ([], "required"),
        (["walk"], "invalid choice: 'walk'"),
        (["run"], "--sequence"),
        (["run", "--sequence", "x", "--resume", "--overwrite"], "not allowed with"),
        (["run", "--sequence", "x", "-q", "-v"], "not allowed with"),
        (["run", "--sequence", "x", "--start", "a"], "invalid int value"),
        (["evaluate", "a"], "GT"),
    ],
)
def test_wrong_usage_is_exit_code_2(
    arguments: list[str], message: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(arguments) == 2
    assert message in capsys.readouterr().err


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--method", "pixelwise"], "needs network weights, which this version does not ship yet"),
        (["--method", "vonet"], "--method refine"),
        (["--method", "refin"], "did you mean 'refine'"),
        (["--flow", "raft"], "flow: expected auto, file, dis, got 'raft'"),
        (["--flow", "file", "--stride", "2"], "pass --flow dis"),
        (["--start", "7"], "no frames from 7 on: there are 3"),
        (["--start", "-1"], "start >= 0"),
        (["--stride", "0"], "stride >= 1"),
        (["--max-failed", "2"], "a share in [0, 1]"),
        (["--device", "tpu"], "device: expected auto, cpu, cuda"),
        (["--dataset", "sintell"], "did you mean 'sintel'"),
        (["--config", "none.yaml"], "none.yaml: no such file"),
        (["--set", "refinement.cutof=1"], "did you mean 'cutoff'"),
        (["--rrd", "recording.txt"], "a name that ends in .rrd"),
    ],
)
def test_bad_options_are_one_line(
    sequence: str,
    tmp_path: Path,
    options: list[str],
    message: str,
    capsys: pytest.CaptureFixture[str],
) -> None:
    out = tmp_path / "out"
    assert main(["run", "--sequence", sequence, "--out", str(out), *options]) == 2
    captured = capsys.readouterr()
    assert captured.out == ""
    assert message in captured.err and captured.err.startswith("hybridvo: ")
    assert captured.err.count("\n") == 1 and "Traceback" not in captured.err
    assert not out.exists()


def test_cuda_on_a_machine_without_it(
    sequence: str, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    import torch

    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    assert main(["run", "--sequence", sequence, "--device", "cuda"]) == 2
    assert "use --device cpu" in capsys.readouterr().err


def test_a_folder_without_frames(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    empty = tmp_path / "empty"
    empty.mkdir()
    assert main(["run", "--sequence", str(empty)]) == 2
    assert "no frames" in capsys.readouterr().err
    assert main(["run", "--sequence", str(tmp_path / "absent")]) == 2


def test_verbose_shows_where_an_error_came_from(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["run", "--sequence", str(tmp_path / "absent"), "-v"]) == 2
    assert "Traceback" in capsys.readouterr().err


def test_a_bug_is_exit_code_1(
    sequence: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    def broken(*_: object, **__: object) -> None:
        raise RuntimeError("unforeseen")

    monkeypatch.setattr("hybridvo.odometry.estimate", broken)
    out = tmp_path / "out"
    assert main(["run", "--sequence", sequence, "--out", str(out), "-q"]) == 1
    error = capsys.readouterr().err
    assert "unforeseen" in error and "bug in hybridvo" in error
    assert not (out / LOCK).exists()


def test_output_that_cannot_be_written_is_exit_code_5(
    sequence: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "file").write_text("")
    assert main(["run", "--sequence", sequence, "--out", str(tmp_path / "file" / "out")]) == 5
    assert "cannot be created" in capsys.readouterr().err


def test_a_locked_folder_is_exit_code_4(
    sequence: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    holder = {"pid": os.getpid(), "host": socket.gethostname(), "started": None}
    (tmp_path / LOCK).write_text(json.dumps(holder))
    assert main(["run", "--sequence", sequence, "--out", str(tmp_path)]) == 4
    assert "held by another run" in capsys.readouterr().err


def test_ctrl_c_outside_the_loop_is_exit_code_130(
    sequence: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def interrupted(*_: object, **__: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr("hybridvo.run.open_sequence", interrupted)
    assert main(["run", "--sequence", sequence]) == 130
    assert capsys.readouterr().err == "hybridvo: interrupted.\n"


def test_data_on_stdout_and_progress_on_stderr(
    sequence: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    arguments = ["run", "--sequence", sequence, "--out", str(tmp_path), "--method", "identity"]
    assert main([*arguments, "--json"]) == 0
    captured = capsys.readouterr()
    summary = json.loads(captured.out)
    assert summary["frames"] == 3 and summary["state"] == "done"
    assert {Path(name).name for name in summary["files"]} >= {"metrics.json", "run.json"}
    assert "3/3 frames" in captured.err and "pairs/s" in captured.err
    assert main([*arguments, "--overwrite", "-q"]) == 0
    captured = capsys.readouterr()
    assert captured.err == "" and "identity" in captured.out


def test_default_folder_is_runs_and_the_name(
    sequence: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    assert main(["run", "--sequence", sequence, "--method", "identity", "-q"]) == 0
    (folder,) = (tmp_path / "runs").iterdir()
    assert "tiny" in folder.name and (folder / "trajectory.tum").is_file()


def test_evaluate(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    est, truth = write_tum(tmp_path / "est", noise=0.1), write_tum(tmp_path / "gt")
    assert main(["evaluate", truth, truth, "--json"]) == 0
    report = json.loads(capsys.readouterr().out)
    assert report["ate_rmse"] == pytest.approx(0, abs=1e-9) and report["matched"] == 5
    assert main(["evaluate", est, truth, "--alignment", "origin"]) == 0
    text = capsys.readouterr().out
    assert "5 of 5 poses" in text and "(origin)" in text
    (tmp_path / "bad").write_text("0 1 2 3 4 5 6\n0 1\n")
    assert main(["evaluate", str(tmp_path / "bad"), truth]) == 2
    assert "bad:2: expected 7 numbers" in capsys.readouterr().err


def test_evaluate_gives_the_official_figures(
    shared_data: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """TartanAir's evaluator on its own example: figures of the data folder's README."""
    folder = shared_data / "trajectories"
    files = [str(folder / "pose_est.txt"), str(folder / "pose_gt.txt")]
    assert main(["evaluate", *files, "--json"]) == 0
    report = json.loads(capsys.readouterr().out)
    assert report["matched"] == report["total"]
    drift, short = report["kitti_drift"], report["kitti_drift_short"]
    for value, official in (
        (report["ate_rmse"], 1.2045074393),
        (report["ate_rmse_norms"], 0.8344983412),
        (report["scale_norms"], 1.0782526734),
        (drift["translation"], 0.0271438892),
        (drift["rotation_deg_per_m"], 0.0229947185),
        (short["translation"], 0.0749175164),
        (short["rotation_deg_per_m"], 0.0798719448),
    ):
        assert value == pytest.approx(official, rel=1e-6)


def test_doctor(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["doctor", "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["usable"] is True
    assert main(["doctor"]) == 0
    assert capsys.readouterr().out.endswith("ready\n")


def test_a_reader_that_goes_away_is_no_error(tmp_path: Path) -> None:
    truth = write_tum(tmp_path / "gt")
    child = subprocess.Popen(
        [*HYBRIDVO, "evaluate", truth, truth, "--json"],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
    )
    assert child.stdout is not None and child.stderr is not None
    child.stdout.close()
    assert child.stderr.read() == b"" and child.wait() == 0
    child.stderr.close()


def test_progress_on_a_terminal_is_a_bar() -> None:
    import io

    class Terminal(io.StringIO):
        def isatty(self) -> bool:
            return True

    stream = Terminal()
    with Progress(4, "walk", stream=stream) as progress:
        progress.say("a line")
        progress.update(4, 1)
    assert "walk" in stream.getvalue() and "4/4" in stream.getvalue()
    assert "pairs/s, 1 failed" in stream.getvalue() and "a line" in stream.getvalue()


@pytest.mark.skipif(not hasattr(signal, "SIGHUP"), reason="no SIGHUP on this system")
def test_a_closed_terminal_asks_to_stop_unless_it_is_ignored() -> None:
    before = signal.signal(signal.SIGHUP, signal.SIG_DFL)
    try:
        with interruptible() as interruption:
            for _ in range(2):  # the shell's and the kernel's
                os.kill(os.getpid(), signal.SIGHUP)
                time.sleep(0)
                assert interruption.signal == signal.SIGHUP
        assert signal.getsignal(signal.SIGHUP) is signal.SIG_DFL
        signal.signal(signal.SIGHUP, signal.SIG_IGN)  # nohup
        with interruptible() as interruption:
            os.kill(os.getpid(), signal.SIGHUP)
            time.sleep(0)
            assert not interruption
        assert signal.getsignal(signal.SIGHUP) is signal.SIG_IGN
    finally:
        signal.signal(signal.SIGHUP, before)


def test_second_signal_aborts_and_handlers_return() -> None:
    before = signal.getsignal(signal.SIGTERM)
    with interruptible() as interruption:
        assert not interruption
        os.kill(os.getpid(), signal.SIGTERM)
        assert interruption
        with pytest.raises(KeyboardInterrupt):
            os.kill(os.getpid(), signal.SIGTERM)
            time.sleep(1)
    assert signal.getsignal(signal.SIGTERM) is before
