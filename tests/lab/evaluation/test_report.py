"""The page of a comparison: what stands first, what is left out, that it needs no other file."""

from __future__ import annotations

import re
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest

from hybridvo.core.geometry import se3_exp
from hybridvo.core.trajectory import Trajectory
from hybridvo_lab.evaluation.metrics import evaluate
from hybridvo_lab.evaluation.protocols import pairs_summary, protocols
from hybridvo_lab.evaluation.report import write_report
from hybridvo_lab.evaluation.scores import (
    pair_table,
    sequence_row,
    total_row,
)

ERRORS = {"hybrid": 0.01, "classical": 0.1, "pnp-ransac": 3.0}
FLOWS = ("file (true)", "dis")
NAME = "<b>walk</b>"


@pytest.fixture
def results(tmp_path: Path) -> tuple[Path, dict[str, Any], pd.DataFrame]:
    """Results of three methods on two sequences of different flow, whose names are hostile."""
    poses = np.stack(
        [se3_exp(np.array([0.1 * k, 0.02 * k**2, 0, 0, 0, 0])) for k in range(7)]
    )
    gt = Trajectory(np.arange(7) / 10, poses)
    (tmp_path / "trajectories").mkdir()
    gt.save(tmp_path / "trajectories" / "gt.tum")
    errors = {
        "rot_err_deg": 0.1,
        "trans_err": 0.01,
        "r_err_deg": 0.1,
        "t_err": 0.01,
    }
    fixed = {"status": "ok", "message": "", "ms": 10.0, "flow_ms": 5.0, "epe": 0.1}
    pairs = [
        fixed
        | errors
        | {"sequence": NAME + flow, "index": i, "prev": i, "next": i + 1}
        | {"method": method, "flow_source": flow, "dynamic_fraction": 0.1 * i}
        | {"epe_l2_px": epe * (1 + i) * (1e-3 if "true" in flow else 1)}
        for flow in FLOWS
        for method, epe in ERRORS.items()
        for i in range(6)
    ]
    # hybrid, dis, pair 0: the one real failure of the best
    pairs[6 * 3]["epe_l2_px"] = 7.5
    table = pair_table(pairs)
    rows, totals = [], []
    for (method, flow), group in table.groupby(
        ["method", "flow_source"], sort=False
    ):
        named = dict(
            sequence=NAME + flow,
            method=method,
            flow_source=flow,
            depth_source="true",
        )
        rows.append(sequence_row(group, evaluate(gt, gt), named))
        rows[-1]["trajectory"] = "trajectories/gt.tum"
        totals.append(total_row(group, rows[-1:]))
    known = {
        "ground_truth": "trajectories/gt.tum",
        "warnings": ["<script>"],
        "left_out": [],
    }
    scored = {"name": NAME, "pairs_scored": 6}
    result: dict[str, Any] = {
        **{"command": ["compare", "<i>my walk</i>"], "versions": {"numpy": "2.4"}},
        **{
            "machine": {"cpus": 2},
            "weights": {"hybrid": "0123456789abcdef", "classical": None},
        },
        "options": {"refine": {"cutoff": 2.5, "tiles": 110}},
        "missing": {"open3d-rgbd": "pip install <i>open3d"},
        **{"rows": rows, "totals": totals},
        "sequences": [{"name": NAME + flow} | known for flow in FLOWS],
        "protocol": pairs_summary(protocols()["paper"], [scored]),
    }
    return tmp_path, result, table


def own_part(page: str) -> str:
    """The page without plotly."""
    return re.sub(r"<script>.*?</script>", "", page, flags=re.DOTALL)


def test_the_page_opens_with_the_winner_and_estimated_flow(results) -> None:
    folder = results[0]
    write_report(*results)
    page, text = (
        (folder / "report.html").read_text(),
        (folder / "report.md").read_text(),
    )
    body = own_part(page)
    # refine has no failure with dis flow, hybrid has one; true flow is called an oracle and last
    lines = [text.index(f"| {method} | {flow} |") for flow in ("dis", "file (true)")
             for method in ("classical", "hybrid", "pnp-ransac")]  # fmt: skip
    assert lines[:3] == sorted(lines[:3]) and lines[2] < min(lines[3:])
    assert "Oracle" in body and "oracle" in text
    assert "open3d-rgbd" in body and "992" in body and "0.626" in body


def test_the_page_needs_no_other_file_and_runs_no_name(results) -> None:
    folder = results[0]
    write_report(*results)
    page = (folder / "report.html").read_text()
    assert len(page) < 8e6
    body = own_part(page)
    assert not re.search(r'(src|href)="(?!#|data:)', body)
    # of the command and of a reason
    assert "<i>" not in body and body.count("&lt;i&gt;") >= 2
    assert (
        "<b>walk" not in body
        and "&lt;b&gt;walk" in body
        and "<script></" not in body
    )


@pytest.mark.parametrize(
    ("absent", "left_out"),
    [("plotly", ["report.html"]), ("jinja2", ["report.md", "report.html"])],
)
def test_a_report_without_its_libraries_says_what_is_left_out(
    absent: str,
    left_out: list[str],
    results: tuple[Path, dict[str, Any], pd.DataFrame],
    monkeypatch: pytest.MonkeyPatch,
    caplog: pytest.LogCaptureFixture,
) -> None:
    folder, result, pairs = results
    monkeypatch.setitem(sys.modules, absent, None)
    assert write_report(folder, result, pairs) == left_out
    assert (folder / "report.tex").is_file()
    for name in ("report.md", "report.html"):
        assert (folder / name).exists() == (name not in left_out)
    messages = [record.getMessage() for record in caplog.records]
    remedy = "pip install 'hybridvo[report]'"
    assert messages == [
        f"{name} is not written: {absent} is not installed: {remedy}"
        for name in left_out
    ]
