"""The classical method needs no torch: not the command, not its picture, not its scores."""

from __future__ import annotations

import json
import subprocess
import sys

import pytest

from tests.absent import ROOT, run_without

HIDDEN = "torch,kornia,pypose"


@pytest.mark.slow
def test_a_sequence_is_tracked_scored_and_drawn_without_torch(dataset, tmp_path):
    out = tmp_path / "out"
    options = ["--method", "classical", "--stop", "3", "--json"]
    done = run_without(HIDDEN, "run", dataset, "--out", out, *options)
    assert done.returncode == 0, done.stderr
    summary = json.loads(done.stdout)
    assert summary["motions"] == 2
    assert summary["failed"] == 0
    assert summary["metrics"]["ate_rmse_origin"] < 0.01
    assert (out / "trajectory.png").stat().st_size > 1000


@pytest.mark.slow
def test_a_method_with_a_network_says_what_is_missing(dataset, tmp_path):
    arguments = ("run", str(dataset), "--out", str(tmp_path / "out"), "--stop", "3")
    done = run_without(HIDDEN, *arguments, "--method", "hybrid")
    assert done.returncode == 2
    assert "torch" in done.stderr
    assert "bug" not in done.stderr


@pytest.mark.slow
def test_torch_is_imported_only_when_a_network_is_wanted():
    """A tracker whose images and depth maps explain everything never asks for one."""
    code = """
import sys
import hybridvo
tracker = hybridvo.Odometry()
print("torch" in sys.modules)
tracker._models.network("pwvo")
print("torch" in sys.modules)
"""
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, cwd=ROOT
    )
    assert done.stdout.split() == ["False", "True"], done.stderr
