"""Rows of the fault matrix that no other file has: F24, F29, F40, F41 at the command line, and what
F8 to F12 promise of exact data."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from hybridvo.cli import main
from hybridvo.data.synthetic import make_scene, write_sintel
from hybridvo.geometry import invert, se3_log
from hybridvo.pipeline import estimate
from hybridvo.types import Reason, State

ROOT = Path(__file__).resolve().parents[2]
FRAMES = 3
CHI2_6_3SIGMA = 20.062


@pytest.fixture(scope="module")
def dataset(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Root of a data set in Sintel's layout with one sequence of three frames."""
    root = tmp_path_factory.mktemp("sintel")
    write_sintel(make_scene("static", 3, height=96, width=160, frames=FRAMES), root, "static")
    return root


def walk(root: Path) -> Path:
    return root / "training" / "clean" / "static"


def run(sequence: Path, out: Path, *options: object) -> int:
    # the method that needs no kernel: what is looked at here happens before or after it
    arguments = ["run", "--sequence", sequence, "--out", out, "-q", "--method=identity", *options]
    return main([str(part) for part in arguments])


class Sentinel:
    """Its pickle, where anybody loads it, leaves a file behind."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def __reduce__(self):
        return os.mkdir, (os.fspath(self.path),)


def test_f24_a_pickle_in_place_of_any_input_runs_nothing(
    dataset, tmp_path, capsys, record_property
):
    import pickle

    ran = tmp_path / "ran"
    content = pickle.dumps(Sentinel(ran))
    pickle.loads(content)  # the trap works
    ran.rmdir()
    places = sorted(path for path in dataset.rglob("*") if path.is_file())
    record_property("tries", len(places) + 3)
    tested = set()
    for number, place in enumerate(places):
        root = tmp_path / f"copy{number}"
        shutil.copytree(dataset, root)
        (root / place.relative_to(dataset)).write_bytes(content)
        code = run(walk(root), tmp_path / f"out{number}", "--flow", "auto", "--max-failed", "1")
        # a damaged flow is replaced by DIS, a damaged frame is spanned, a camera is needed
        assert code in (0, 2)
        assert "Traceback" not in capsys.readouterr().err
        tested.add(place.suffix)
        shutil.rmtree(root)
    assert {".png", ".flo", ".dpt", ".cam"} <= tested
    trap = tmp_path / "trap"
    trap.write_bytes(content)
    for arguments in (
        ["run", "--sequence", walk(dataset), "--out", tmp_path / "o", "--config", trap],
        ["evaluate", trap, trap],
        ["run", "--sequence", trap, "--out", tmp_path / "o"],
    ):
        assert main([str(part) for part in arguments]) == 2
        error = capsys.readouterr().err
        assert error.count("\n") == 1
        assert "Traceback" not in error
    assert not ran.exists()


@pytest.mark.parametrize("home", ["nowhere", "a_file", "read_only", None])
def test_f29_home_does_not_matter(dataset, tmp_path, home):
    place = tmp_path / "home"
    if home == "a_file":
        place.write_text("")
    if home == "read_only":
        place.mkdir(mode=0o555)
    dropped = ("HOME", "MPLCONFIGDIR", "XDG_CONFIG_HOME", "XDG_CACHE_HOME", "NUMBA_CACHE_DIR")
    environment = {k: v for k, v in os.environ.items() if k not in dropped}
    environment |= {"TMPDIR": str(tmp_path), "OMP_NUM_THREADS": "1"}
    if home is not None:
        environment["HOME"] = str(place)
    command = [sys.executable, "-m", "hybridvo.cli", "run", "--sequence", walk(dataset)]
    command += ["--out", tmp_path / "out", "--method", "identity", "--flow", "dis", "-q"]
    done = subprocess.run(
        [str(part) for part in command], env=environment, capture_output=True, text=True
    )
    assert (done.returncode, done.stderr) == (0, "")
    assert (tmp_path / "out" / "trajectory.png").stat().st_size > 1000
    if home == "read_only":
        assert not any(place.iterdir()) or os.getuid() == 0  # root writes where it likes


@pytest.mark.parametrize("kind", ["a_file_above", "a_file", "no_name"])
def test_f29_output_is_refused_before_anything_is_computed(
    dataset, tmp_path, capsys, monkeypatch, kind
):
    def computed(*_: object, **__: object) -> None:
        raise AssertionError("an estimate was made")

    monkeypatch.setattr("hybridvo.odometry.estimate", computed)
    (tmp_path / "file").write_text("kept")
    out = {
        "a_file_above": tmp_path / "file" / "out",
        "a_file": tmp_path / "file",
        "no_name": Path("/dev/null/out"),
    }[kind]
    assert run(walk(dataset), out) == 5
    error = capsys.readouterr().err
    assert error.count("\n") == 1
    assert str(out) in error
    assert (tmp_path / "file").read_text() == "kept"


class OutOfMemoryError(RuntimeError):
    """Of the name that torch gives its own."""


@pytest.mark.parametrize(
    "error",
    [
        MemoryError(),
        MemoryError("Unable to allocate 16.0 GiB for an array with shape (65536, 65536)"),
        OutOfMemoryError("CUDA out of memory. Tried to allocate 2.00 GiB\nand more lines"),
    ],
    ids=["python", "numpy", "cuda"],
)
def test_f40_out_of_memory_is_one_line_with_a_remedy(dataset, tmp_path, capsys, monkeypatch, error):
    def exhausted(*_: object, **__: object) -> None:
        raise error

    monkeypatch.setattr("hybridvo.odometry.estimate", exhausted)
    out = tmp_path / "out"
    assert run(walk(dataset), out) == 2
    said = capsys.readouterr().err
    assert said.count("\n") == 1
    assert "memory" in said
    assert ("--device cpu" if "CUDA" in str(error) else "smaller") in said
    assert not (out / "run.lock").exists()


def _out_of_memory() -> list[Exception]:
    """As Python, numpy, torch on a CPU and OpenCV say it; the last two from the libraries."""
    import cv2
    import torch

    found: list[Exception] = [MemoryError("Unable to allocate 4.00 EiB for an array")]
    try:
        torch.empty(2**61, dtype=torch.uint8)
    except RuntimeError as error:
        found.append(error)
    lack = cv2.error("OpenCV(5.0.0) alloc.cpp:73: error: (-4:Insufficient memory) Failed")
    lack.code = -4
    return [*found, lack]


@pytest.mark.parametrize(
    "place",
    [
        "hybridvo.run.open_sequence",
        "hybridvo.data.sintel.read_dpt",
        "hybridvo.odometry.check_field",
        "hybridvo.odometry._own",
        "hybridvo.run.write_tum",
        "hybridvo.run_results.write_csv",
        "hybridvo.run_results.np.savez",
        "hybridvo.run.score",
        "hybridvo.evaluation.plots.plot_trajectories",
    ],
)
def test_f40_memory_may_end_anywhere(dataset, tmp_path, capsys, monkeypatch, place):
    """One line, no lock, nothing half written; with memory again the results of any other run."""
    whole = tmp_path / "whole"
    assert run(walk(dataset), whole, "--flow", "dis") == 0
    expected = {p.name: p.read_bytes() for p in whole.iterdir() if p.suffix in (".tum", ".npz")}
    assert len(expected) == 2
    errors = _out_of_memory()
    assert len(errors) == 3
    for number, error in enumerate(errors):
        out = tmp_path / f"out{number}"

        def exhausted(*_: object, error: Exception = error, **__: object) -> None:
            raise error

        with monkeypatch.context() as patch:
            patch.setattr(place, exhausted)
            assert run(walk(dataset), out, "--flow", "dis") == 2
        said = capsys.readouterr().err
        assert said.count("\n") == 1 and "memory" in said and "smaller" in said
        left = {p.name: p.read_bytes() for p in out.iterdir()} if out.exists() else {}
        assert "run.lock" not in left and not any(name.endswith(".tmp") for name in left)
        assert all(left[name] == expected[name] for name in left.keys() & expected.keys())
        assert run(walk(dataset), out, "--flow", "dis", "--resume") == 0
        assert all((out / name).read_bytes() == expected[name] for name in expected)


def test_f40_torch_has_an_error_of_that_name():
    import torch

    assert torch.cuda.OutOfMemoryError.__name__ == OutOfMemoryError.__name__


@pytest.mark.parametrize(
    "name",
    ["with space", "Größe-日本", "🎥", "-q", "a" * 200, "/".join(["deep" * 10] * 20), "new\nline"],
    ids=["space", "letters", "emoji", "like_an_option", "long", "deep", "newline"],
)
def test_f41_long_and_odd_output_names(dataset, tmp_path, capsys, name):
    out = tmp_path / name
    assert run(walk(dataset), out, "--flow", "dis") == 0
    assert len((out / "trajectory.tum").read_text().splitlines()) >= FRAMES
    assert (out / "trajectory.png").is_file()


def test_f41_names_that_no_file_system_takes(dataset, tmp_path, capsys):
    for name in ("a" * 300, "/".join(["b" * 200] * 30)):
        assert run(walk(dataset), tmp_path / name) == 5
        error = capsys.readouterr().err
        assert error.startswith("hybridvo: ")
        assert "Traceback" not in error


@pytest.mark.parametrize("method", ["refine", "hybrid"])
@pytest.mark.parametrize(
    "kind",
    [
        *("zero_motion", "pure_rotation", "tiny_1cm", "plane", "far"),
        *("line", "patch", "every_pixel_its_own", "five_motions"),
    ],
)
def test_f8_to_f12_exact_data_are_never_wrong_and_confident(
    monkeypatch, kind, method, record_property
):
    """Without noise the only error is rounding, and where nothing holds together none is ok."""
    monkeypatch.syspath_prepend(str(ROOT / "tools"))
    import measure_degenerate

    seeds = range(2)
    record_property("tries", len(seeds))
    for seed in seeds:
        pair, T_true = measure_degenerate.make(kind, seed, noise=False)
        found = estimate(pair, method=method, seed=seed)
        error = se3_log(found.T_curr_prev @ invert(T_true))
        inside = error @ np.linalg.solve(found.covariance, error) < CHI2_6_3SIGMA
        assert inside or found.status.state is not State.OK
        assert np.isfinite(found.T_curr_prev).all()


def test_f12_a_small_patch_in_noise_is_no_plain_ok(monkeypatch):
    # errors that all of its pixels share decide: the covariance alone cannot know
    monkeypatch.syspath_prepend(str(ROOT / "tools"))
    import measure_degenerate

    for seed in range(4):
        pair, _ = measure_degenerate.make("patch", seed, noise=True)
        assert estimate(pair, method="refine").status.reason is Reason.DEGENERATE_GEOMETRY
