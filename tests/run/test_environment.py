"""Fresh processes in poor surroundings: no network, no home, no optional libraries."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from tests.absent import run_without
from tests.walks import command

ROOT = Path(__file__).resolve().parents[2]
MAIN = "import sys; from hybridvo.run.cli import main; sys.exit(main(sys.argv[1:]))"
WATCHED = """
import sys
def watch(event, given):
    if event.startswith("socket.") and event not in ("socket.gethostname", "socket.__new__"):
        raise SystemExit(f"network: {event} {given[1:]}")
sys.addaudithook(watch)
from hybridvo.run.cli import main
sys.exit(main(sys.argv[1:]))
"""


def child(code: str, *arguments: object, **environment: str | None):
    env = os.environ | {"OMP_NUM_THREADS": "1", "PYTHONPATH": os.fspath(ROOT)}
    for name, value in environment.items():
        if value is None:
            env.pop(name, None)
        else:
            env[name] = value
    return subprocess.run(
        [sys.executable, "-c", code, *map(str, arguments)],
        capture_output=True,
        text=True,
        check=False,
        env=env,
    )


@pytest.mark.long
def test_the_demo_needs_no_network(tmp_path: Path) -> None:
    done = child(WATCHED, "demo", "--out", tmp_path / "out", "--frames", 3, "-q")
    assert done.returncode == 0, done.stderr
    assert (tmp_path / "out" / "report.html").is_file()


@pytest.mark.long
@pytest.mark.parametrize("home", ["nowhere", None])
def test_home_does_not_matter(walk: Path, tmp_path: Path, home: str | None) -> None:
    dropped = dict.fromkeys(
        ("MPLCONFIGDIR", "XDG_CONFIG_HOME", "XDG_CACHE_HOME", "NUMBA_CACHE_DIR")
    )
    arguments = command(
        walk, tmp_path / "out", "--method", "identity", "--flow", "file", "-q"
    )
    done = child(
        MAIN, *arguments, **dropped, HOME=str(tmp_path / home) if home else None
    )
    assert (done.returncode, done.stderr) == (0, "")
    assert (tmp_path / "out" / "trajectory.png").stat().st_size > 1000


@pytest.mark.long
def test_the_core_needs_no_optional_library(walk: Path, tmp_path: Path) -> None:
    optional = "rerun,poselib,open3d,torchvision,gtsam,evo"
    for out, hidden in (("with", "nothing"), ("without", optional)):
        arguments = command(
            walk, tmp_path / out, "--method", "classical", "--flow", "file", "-q"
        )
        done = run_without(hidden, *arguments)
        assert (done.returncode, done.stderr) == (0, "")
    poses = [
        np.loadtxt(tmp_path / out / "trajectory.tum") for out in ("with", "without")
    ]
    np.testing.assert_allclose(poses[0], poses[1], rtol=0, atol=1e-6)


@pytest.mark.long
@pytest.mark.parametrize(
    ("hidden", "options", "remedy"),
    [
        ("rerun", ["--rrd"], "pip install 'hybridvo[viz]'"),
        ("poselib", ["--method", "poselib"], "pip install 'hybridvo[baselines]'"),
        ("open3d", ["--method", "open3d-rgbd"], "pip install open3d"),
    ],
)
def test_an_absent_library_is_one_line_with_its_command(
    walk: Path, tmp_path: Path, hidden: str, options: list[str], remedy: str
) -> None:
    done = run_without(hidden, *command(walk, tmp_path / "out", "-q", *options))
    assert done.returncode == 2 and done.stdout == ""
    assert done.stderr.count("\n") == 1 and remedy in done.stderr
    assert not (tmp_path / "out").exists()


@pytest.mark.long
def test_a_batch_is_refined_where_warnings_are_errors() -> None:
    code = """
import sys, warnings
warnings.simplefilter("error")
import torch, hybridvo as hvo
K = torch.tensor([[[80.0, 0, 47.5], [0, 80, 35.5], [0, 0, 1]]])
depth = 3 + torch.linspace(0, 2, 72 * 96).reshape(1, 72, 96).sin()
found = hvo.refine(hvo.PairBatch(torch.zeros(1, 72, 96, 2), depth, K, K))
print((found.T_curr_prev - torch.eye(4)).abs().max().item())
"""
    done = child(code)
    assert done.returncode == 0 and done.stderr == "", done.stderr
    assert float(done.stdout) < 1e-6
