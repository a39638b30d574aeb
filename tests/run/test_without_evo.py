"""Without the extra ``evaluation`` a run is complete but for the errors of its path."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import numpy as np
import pytest

import hybridvo
from tests.absent import run_without

REMEDY = "pip install 'hybridvo[evaluation]'"


@pytest.fixture(scope="module")
def bare(dataset: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of a run with ground truth where evo is not installed."""
    out = tmp_path_factory.mktemp("bare") / "out"
    options = ("--method", "classical", "--stop", "3")
    done = run_without("evo", "run", dataset, "--out", out, *options)
    assert done.returncode == 0, done.stderr
    (out / "said.txt").write_text(done.stdout)
    return out


@pytest.mark.slow
def test_a_run_leaves_out_the_errors_of_its_path_and_says_why(bare: Path) -> None:
    metrics = json.loads((bare / "metrics.json").read_text())
    assert metrics["ate_rmse"] is None
    assert REMEDY in metrics["reasons"]["ate_rmse"]
    # errors of single motions need no evo
    assert metrics["rot_err_deg_median"] < 0.1
    assert REMEDY in (bare / "said.txt").read_text()
    assert (bare / "trajectory.png").stat().st_size > 1000


@pytest.mark.slow
def test_evaluating_a_file_is_refused_with_the_remedy(bare: Path) -> None:
    path = bare / "trajectory.tum"
    done = run_without("evo", "evaluate", path, path)
    assert done.returncode == 2
    assert REMEDY in done.stderr


@pytest.mark.slow
def test_a_comparison_has_its_table_without_the_errors_of_paths(
    dataset: Path, tmp_path: Path
) -> None:
    out = tmp_path / "out"
    options = ("--methods", "classical", "--stop", "3")
    done = run_without("evo", "compare", dataset, "--out", out, *options)
    assert done.returncode == 0, done.stderr
    assert done.stderr.count(REMEDY) == 1
    assert "classical" in done.stdout
    shutil.rmtree(out)


def test_the_public_call_returns_none_with_a_reason(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(
        "hybridvo_lab.evaluation.metrics.find_spec", lambda name: None
    )
    path = hybridvo.Trajectory(np.arange(3), np.tile(np.eye(4), (3, 1, 1)))
    report = hybridvo.evaluate(path, path)
    assert report["ate_rmse"] is None
    assert REMEDY in report["reasons"]["kitti_drift"]
