"""The hybrid's sequences: records, goals, the page, and the tool that makes them."""

from __future__ import annotations

import json
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest

from hybridvo.comparison.hybrid_page import START, STOP, fill
from hybridvo.comparison.hybrid_sequences import (
    ORACLE,
    RecordedJudge,
    SequenceOptions,
    methods_here,
    run_cells,
    run_sequence,
)
from hybridvo.comparison.hybrid_summary import summarise
from hybridvo.errors import FormatError, InputError
from hybridvo.pipeline import estimate, shipped_judge
from hybridvo.synthetic.scenarios import make_pair
from tests.scripts import load_script

ROOT = Path(__file__).resolve().parents[2]
SMALL = {"frames": 4, "height": 64, "width": 128, "noisy_stride": 2}


def tool() -> ModuleType:
    return load_script("tools/evaluate_hybrid.py")


@pytest.fixture(scope="module")
def measured():
    options = SequenceOptions(methods=("hybrid-flow", "refine", ORACLE), **SMALL)
    found = run_sequence("heavy_two", 3, options)
    return found.records, found.paths


def test_a_recorded_judge_changes_nothing():
    pair, _ = make_pair("one60", 3, 109, 256)
    judge = RecordedJudge(shipped_judge())
    found = estimate(pair, method="hybrid-flow", judge=judge)
    plain = estimate(pair, method="hybrid-flow")
    np.testing.assert_array_equal(found.T_curr_prev, plain.T_curr_prev)
    assert str(found.status) == str(plain.status)
    stated = judge.take()
    assert stated is not None
    assert 0 <= stated <= 1
    assert judge.take() is None


def test_one_record_per_flow_method_and_pair(measured):
    records, paths = measured
    keys = [(r["flow"], r["method"], r["index"]) for r in records]
    wanted = {
        (f, m, i)
        for f in ("true", "dis")
        for m in ("hybrid-flow", "refine", ORACLE)
        for i in range(3)
    }
    wanted |= {("true+noise", m, i) for m in ("hybrid-flow", "refine") for i in (0, 2)}
    assert len(keys) == len(set(keys))
    assert set(keys) == wanted
    assert {(p["flow"], p["method"]) for p in paths} == {k[:2] for k in keys if "+" not in k[0]}
    for r in records:
        assert r["failure"] == (r["epe_px"] > 1.0 or r["status"] == "failed")
        assert r["moving_share"] > 0.4
        assert (r["probability"] is None) or r["method"] == "hybrid-flow"


def test_true_flow_in_the_true_mask_is_exact(measured):
    records, paths = measured
    mine = [r for r in records if (r["flow"], r["method"]) == ("true", ORACLE)]
    # float32 flow and depth of a 128 px picture
    assert max(r["epe_px"] for r in mine) < 1e-2
    (path,) = (p for p in paths if (p["flow"], p["method"]) == ("true", ORACLE))
    assert path["ate_m"] < 1e-3 * path["path_m"]


def test_cells_are_measured_as_named():
    records = run_cells(2, 5, ("moving30",), (109, 256))
    assert [(r["kind"], r["seed"], r["method"]) for r in records] == [
        ("moving30", s, m) for s in (5, 6) for m in ("hybrid-flow", "refine")
    ]
    assert all(r["nees"] is not None for r in records)


def test_options_that_cannot_be_meant():
    for wrong in ({"frames": 2}, {"kinds": ()}, {"kinds": ("no_such",)}, {"noisy_stride": -1}):
        with pytest.raises(InputError, match="expected"):
            SequenceOptions(**wrong)


def answer(flow, method, epe, status="ok", nees=6.0, probability=None):
    return {
        "kind": "heavy_two", "seed": 1, "index": 0, "flow": flow, "method": method,
        "status": status, "reason": "", "epe_px": epe, "failure": epe > 1, "nees": nees,
        "probability": probability, "noise_px": 0.1, "share": 0.5,
        "right": epe <= 0.5, "ms": 1.0, "moving_share": 0.6,
    }  # fmt: skip


def path(flow, method, ate):
    return {"kind": "heavy_two", "seed": 1, "flow": flow, "method": method, "ate_m": ate,
            "path_m": 10.0, "ate_share": ate / 10, "reason": ""}  # fmt: skip


@pytest.fixture
def summary():
    records = [
        answer("dis", "hybrid-flow", 0.1, probability=0.9),
        answer("dis", "hybrid-flow", 0.2, "degraded", 20.0, probability=0.6),
        answer("dis", "hybrid-flow", 3.0, "degraded", 1e4, probability=0.2),
        answer("dis", "hybrid-flow", 5.0, "ok", 1e5, probability=0.8),
        *[answer("dis", ORACLE, e) for e in (0.1, 0.1, 0.1, 2.0)],
        *[answer("true", "hybrid-flow", e, probability=1.0) for e in (0.0, 0.0, 0.0, 1.5)],
    ]
    paths = [path("dis", "hybrid-flow", 0.2), path("dis", "pnp-ransac-tuned", 4.0)]
    return summarise(records, [*paths, path("dis", "poselib", 0.5)])


def test_goals_by_hand(summary):
    goals = {g["what"]: (g["value"], g["met"]) for g in summary["goals"]}
    assert goals["dis flow: ATE of hybrid-flow over pnp-ransac-tuned"] == (0.05, True)
    assert goals["dis flow: ATE of hybrid-flow over poselib"] == (0.4, False)
    assert goals["true flow: share of failures of hybrid-flow"] == (0.25, False)
    assert goals["dis flow: failures of hybrid-flow over a fit in the true mask"] == (2.0, False)
    assert goals["dis: mean NEES of hybrid-flow, failures aside"] == (13.0, False)
    # of three failures one is flagged and one states an error of 6 that its covariance contains
    silent, met = goals["failures of hybrid-flow that are neither flagged nor inside 3 sigma"]
    assert silent == pytest.approx(1 / 3)
    assert met is False


def test_thresholds_and_reliability_by_hand(summary):
    row = next(t for t in summary["thresholds"]["dis"]["judge"] if t["threshold"] == 0.7)
    assert row["failures_flagged"]["count"] == 1
    assert row["right_degraded"]["count"] == 1
    found = summary["reliability"]["dis"]
    assert found["judge"]["right"] == 0.5
    assert found["judge_right"]["brier"] == pytest.approx((0.01 + 0.16 + 0.04 + 0.64) / 4)
    assert summary["reliability"]["sequences"]["judge"]["answers"] == 8
    # the shift of 2 of the map, at a noise of one pixel and a stated half
    half = [answer("dis", "hybrid-flow", 0.1, probability=0.5) | {"noise_px": 1.0, "share": 0.0}]
    shift = {"logit": 1.0, "log_noise_px": 3.0, "share": 5.0, "constant": 2.0}
    moved = summarise(half, [], shift)["reliability"]["dis"]
    assert moved["stated"]["stated"] == pytest.approx(1 / (1 + np.exp(-2.0)))
    assert moved["judge"]["stated"] == 0.5


def test_the_page_is_filled_between_its_markers(summary):
    result = summary | {
        "command": "python tools/evaluate_hybrid.py",
        "commit": "abc",
        "cpu_s": 60.0,
        "conditions": {
            "kinds": ["heavy_two"], "seeds": [1], "frames": 2, "size": [64, 128],
            "cell_pairs": 0, "failure_px": 1.0, "picture": "results/x.png",
        },
    }  # fmt: skip
    start = START.format(name="x")
    page = f"# before\n{start}\nold\n{STOP}\nafter\n"
    made = fill(page, "x", result)
    assert made.startswith(f"# before\n{start}\n")
    assert made.endswith(f"{STOP}\nafter\n")
    assert "\nold\n" not in made
    assert "| dis flow: ATE of hybrid-flow over pnp-ransac-tuned | <= 0.1 | 0.05 | yes |" in made
    assert "| dis | `hybrid-flow` | 50.0 % (2/4) |" in made
    assert fill(made, "x", result) == made
    with pytest.raises(FormatError, match="markers"):
        fill("no markers", "x", result)
    with pytest.raises(FormatError, match="not as"):
        fill(page, "x", {"conditions": {}})


def test_the_tool(tmp_path, capsys):
    out, page = tmp_path / "h.json", tmp_path / "h.md"
    page.write_text(f"# Hybrid\n{START.format(name='h')}\n{STOP}\n", encoding="utf-8")
    run = ["--seed0", "4", "--kinds", "heavy_ten", "--methods", "hybrid-flow,refine",
           "--frames", "3", "--size", "64x128", "--cell-pairs", "0", "--out", str(out),
           "--answers", str(tmp_path / "a.csv"), "--page", str(page)]  # fmt: skip
    main = tool().main
    assert main(run) == 0
    result = json.loads(out.read_text(encoding="utf-8"))
    assert result["conditions"]["seeds"] == [4]
    assert result["command"].startswith("python tools/evaluate_hybrid.py --seed0 4")
    assert "a.csv" not in result["command"]
    assert len((tmp_path / "a.csv").read_text(encoding="utf-8").splitlines()) == 1 + 2 * 4 + 2
    made = page.read_text(encoding="utf-8")
    assert "### Trajectories" in made
    page.write_text(made.replace("### Trajectories", "### changed"), encoding="utf-8")
    assert main(["--out", str(out), "--page", str(page), "--page-only"]) == 0
    assert page.read_text(encoding="utf-8") == made
    capsys.readouterr()
    assert main(run) == 2
    assert "--overwrite" in capsys.readouterr().err
    assert main(["--out", str(out), "--overwrite", "--size", "big"]) == 2
    assert "HEIGHTxWIDTH" in capsys.readouterr().err
    assert main(["--out", str(out), "--overwrite", "--kinds", "no_such"]) == 2


def test_every_row_has_a_method_that_runs_or_a_reason():
    able, absent = methods_here()
    assert {"hybrid-flow", "hybrid", "refine", ORACLE, "pnp-ransac-tuned"} <= set(able)
    assert all("poselib" in reason for reason in absent.values())


def test_the_shipped_page_says_what_its_json_says():
    path = ROOT / "docs" / "results" / "hybrid_sequences.json"
    page = (ROOT / "docs" / "hybrid.md").read_text(encoding="utf-8")
    assert fill(page, path.stem, json.loads(path.read_text(encoding="utf-8"))) == page
    assert (ROOT / "docs" / "results" / "hybrid_sequences.png").is_file()
