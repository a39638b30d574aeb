"""Scores of a table of pairs, by hand."""

from __future__ import annotations

from typing import Any

import numpy as np
import pandas as pd
import pytest

from hybridvo.evaluation.metrics import evaluate
from hybridvo.evaluation.scores import failure_rate, pair_table, sequence_row, total_row
from hybridvo.geometry import se3_exp
from hybridvo.trajectory import Trajectory


def row(index: int, error: float | None, method: str = "a", /, **more: Any) -> dict[str, Any]:
    base = {"sequence": "walk", "index": index, "method": method, "flow_source": "dis"}
    return {**base, "status": "ok", "message": "", "epe_l2_px": error, **more}


def table(*rows: dict[str, Any]) -> pd.DataFrame:
    return pair_table(rows)


def test_a_failed_estimate_is_a_failure_and_an_unknown_error_is_left_out() -> None:
    pairs = table(
        row(0, 0.5),
        row(1, 1.5),
        row(2, 0.1, status="failed(no_flow)"),  # small error of a motion that was never found
        row(3, None, status="failed(no_valid_depth)"),
        row(4, None),
        row(5, 1.0),  # one pixel is no failure yet
    )
    rate = failure_rate(pairs)
    assert (rate["failures"], rate["failure_rate"]) == (3, 0.6)


def test_the_interval_of_a_rate_by_hand() -> None:
    # E. B. Wilson's score interval at 0 of 10 and 1 of 10, 95 %
    for failures, low, high in ((0, 0.0, 0.2775), (1, 0.0179, 0.4042)):
        rate = failure_rate(table(*(row(i, 9.0 if i < failures else 0.1) for i in range(10))))
        assert rate["failure_rate_low"] == pytest.approx(low, abs=1e-4)
        assert rate["failure_rate_high"] == pytest.approx(high, abs=1e-4)
    assert failure_rate(table(row(0, None)))["failure_rate"] is None


def test_a_line_of_results_by_hand() -> None:
    errors = {"rot_err_deg": 1.0, "trans_err": 0.1, "r_err_deg": 0.5, "t_err": 0.05}
    pairs = table(
        row(0, 2.0, **errors, epe=0.3, ms=10.0, flow_ms=5.0, dynamic_fraction=0.5),
        row(1, 4.0, **errors | {"rot_err_deg": 3.0}, epe=0.5, ms=20.0, flow_ms=5.0),
        row(2, None, status="failed(no_flow)", ms=30.0, flow_ms=5.0),
    )
    poses = np.stack([se3_exp(np.array([0.1 * k, 0.02 * k**2, 0, 0, 0, 0])) for k in range(4)])
    gt = Trajectory(np.arange(4) / 10, poses)
    named = {"sequence": "walk", "method": "a", "flow_source": "dis", "depth_source": "true"}
    moved = gt.transformed(se3_exp(np.full(6, 0.3)))
    line = sequence_row(pairs, evaluate(moved, gt), named)
    expected = {
        **{"pairs": 3, "pairs_scored": 2, "failed": 1, "failures": 3, "epe_l2_px": 3.0},
        **{"epe": 0.4, "rot_err_deg_mean": 2.0, "trans_err_median": 0.1, "ms_per_pair_median": 20},
        **{"flow_ms_median": 5.0, "dynamic_fraction": 0.5, "alignment": "se3"},
    }
    assert {key: line[key] for key in expected} == pytest.approx(expected)
    assert line["ate_rmse"] == pytest.approx(0, abs=1e-12)
    assert None not in line.values()
    other = sequence_row(pairs, None, named | {"sequence": "b"})
    assert other["ate_rmse"] is None
    total = total_row(pd.concat([pairs, pairs]), [line, other])
    assert total["pairs"] == 6 and total["ate_rmse"] == line["ate_rmse"]
    assert "1 of 2 sequences" in total["reasons"]["ate_rmse"]
