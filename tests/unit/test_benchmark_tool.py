from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from hybridvo.geometry import ego_flow, se3_exp
from hybridvo.synthetic.scenarios import make_pair
from hybridvo.types import Hypothesis, Reason, RelativePose
from tests.scripts import load_script

TOOLS = Path(__file__).parents[2] / "tools"


@pytest.fixture(autouse=True)
def tools_on_the_path(monkeypatch):
    """What ``python tools/benchmark.py`` does: the script's folder comes first."""
    monkeypatch.syspath_prepend(TOOLS)


@pytest.fixture
def tool(tools_on_the_path):
    return load_script("tools/benchmark.py")


def test_writes_json_and_tables_and_never_overwrites(tool, tmp_path, capsys):
    command = ["--cells", "moving30", "--pairs", "2", "--out", str(tmp_path)]
    command += ["--methods", "identity,usac-magsac"]
    assert tool.main(command) == 0
    result = json.loads((tmp_path / "benchmark.json").read_text())
    assert [r["seed"] for r in result["pairs"]] == [0, 0, 1, 1]
    row = result["summary"]["moving30"]["usac-magsac"]
    epes = [r["epe_px"] for r in result["pairs"] if r["method"] == "usac-magsac"]
    assert row["epe_px"]["median"] == pytest.approx(np.median(epes))
    assert result["summary"]["moving30"]["identity"]["failures"] == 2
    assert "usac-magsac" in (tmp_path / "benchmark.md").read_text()
    assert (tmp_path / "benchmark.png").read_bytes()[:4] == b"\x89PNG"
    assert result["heavy"] is result["kernel"] is result["batch"] is None
    assert tool.main(command) == 2
    assert "--overwrite" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("option", "value"),
    [
        ("--cells", "moving31"),
        ("--methods", "magic"),
        ("--pairs", "0"),
        ("--seed0", "-1"),
        ("--heavy", "-1"),
        ("--nees", "-5"),
    ],
)
def test_bad_usage_is_exit_code_2(tool, tmp_path, capsys, option, value):
    assert tool.main([option, value, "--out", str(tmp_path)]) == 2
    assert len(capsys.readouterr().err.splitlines()) == 1


def test_score_of_a_known_error():
    from benchmark_scores import score

    pair, truth = make_pair("moving30", 0, height=109, width=256)
    T = truth["T_curr_prev"]
    delta = np.array([0.01, 0.0, 0.0, 0.0, 0.002, 0.0])
    world = Hypothesis(T, np.ones((1, 1), np.float32), 1, 0.7, 1.0)
    estimate = RelativePose(
        T_curr_prev=se3_exp(delta) @ T,
        covariance=np.diag([0.01**2] * 3 + [0.001**2] * 3),
        hypotheses=(world,),
    )
    row = score(estimate, pair, truth)
    assert row["nees"] == pytest.approx(1 + 4, rel=1e-6)
    assert row["contained"] and row["hypothesis_hit"]
    flows = [
        ego_flow(truth["depth_true"], M, pair.prev.camera, pair.curr.camera)[::2, ::2]
        for M in (estimate.T_curr_prev, T)
    ]
    expected = np.linalg.norm(flows[0] - flows[1], axis=-1).mean()
    assert row["epe_px"] == pytest.approx(expected, rel=1e-9)


def test_no_answer_is_a_failure_even_where_identity_is_right(tool):
    from benchmark_scores import score

    pair, truth = make_pair("zero_motion", 0, height=109, width=256)
    answer = RelativePose.failed(Reason.LOW_INLIERS, "nothing")
    record = {"cell": "zero_motion", "method": "m", "ms": 1.0, **score(answer, pair, truth)}
    assert record["epe_px"] < 1e-9
    row = tool.summarise([record], ["zero_motion"], ["m"])["zero_motion"]["m"]
    assert row["failures"] == 1 and row["not_estimated"] == 1


def test_ratios_by_hand(tool):
    def row(epe, ms):
        return {"epe_px": {"median": epe}, "ms": {"median": ms}}

    summary = {
        "moving30": {"refine": row(0.02, 2.0), "other": row(0.04, 8.0)},
        "noisy": {"refine": row(0.08, 2.0), "other": row(0.64, 9.0)},
        "one60": {"refine": row(50.0, 2.0), "other": row(1.0, 9.0)},
    }
    table = tool.ratios(summary, list(summary), ["refine", "other"])
    # sqrt(0.02 * 0.08) = 0.04 over sqrt(0.04 * 0.64) = 0.16; one60 is none of the eight cells
    assert table["refine_over"]["other"] == {
        "error": pytest.approx(0.25),
        "time": pytest.approx(0.25),
    }


def test_3_sigma_quantile(tool):
    from benchmark_scores import CHI2_6_3SIGMA
    from scipy.stats import chi2

    assert pytest.approx(chi2(6).ppf(0.9973), abs=1e-3) == CHI2_6_3SIGMA
