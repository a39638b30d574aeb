"""Scores of a table of pairs, by hand."""

from __future__ import annotations

from typing import Any
from unittest import mock

import numpy as np
import pandas as pd
import pytest

from hybridvo.core.geometry import ego_flow, se3_exp
from hybridvo.core.trajectory import Trajectory
from hybridvo.core.types import Camera
from hybridvo_lab.calibration import TRUTH_NOISE
from hybridvo_lab.evaluation.metrics import evaluate, rpe_over_a_second
from hybridvo_lab.evaluation.scores import (
    pair_table,
    sequence_row,
    total_row,
    wrong_limit,
    wrong_motions,
)


def row(
    index: int, error: float | None, method: str = "a", /, **more: Any
) -> dict[str, Any]:
    base = {
        "sequence": "walk",
        "index": index,
        "method": method,
        "flow_source": "dis",
    }
    return {**base, "status": "ok", "message": "", "epe_l2_px": error, **more}


def table(*rows: dict[str, Any]) -> pd.DataFrame:
    return pair_table(rows)


def test_a_failed_estimate_is_wrong_and_an_unknown_error_is_left_out() -> None:
    pairs = table(
        row(0, 0.5),
        row(1, 1.5),
        # small error of a motion that was never found
        row(2, 0.1, status="failed(no_flow)"),
        row(3, None, status="failed(no_valid_depth)"),
        row(4, None),
        row(5, 1.0),  # one pixel is not wrong yet
    )
    rate = wrong_motions(pairs)
    assert (rate["wrong"], rate["wrong_share"]) == (3, 0.6)


def test_the_interval_of_a_rate_by_hand() -> None:
    # E. B. Wilson's score interval at 0 of 10 and 1 of 10, 95 %
    for wrong, low, high in ((0, 0.0, 0.2775), (1, 0.0179, 0.4042)):
        rate = wrong_motions(
            table(*(row(i, 9.0 if i < wrong else 0.1) for i in range(10)))
        )
        assert rate["wrong_share_low"] == pytest.approx(low, abs=1e-4)
        assert rate["wrong_share_high"] == pytest.approx(high, abs=1e-4)
    assert wrong_motions(table(row(0, None)))["wrong_share"] is None


def test_the_limit_follows_the_noise_of_the_truth() -> None:
    """As a rotation and a translation of that size move the pixel in the middle of the image."""
    camera = Camera(500.0, 500.0, 319.5, 239.5, height=480, width=640)
    depth = np.full((480, 640), 2.0)
    degrees, metres = TRUTH_NOISE["tum"]
    for x, angle in ((metres, 0.0), (0.0, np.radians(degrees))):
        T = se3_exp(np.array([x, 0, 0, 0, angle, 0]))
        moved = np.linalg.norm(ego_flow(depth, T, camera, camera)[240, 320])
        only = {"tum": (0.0, x) if x else (degrees, 0.0)}
        with mock.patch.dict(TRUTH_NOISE, only):
            assert wrong_limit("tum", camera, depth) == pytest.approx(
                moved, rel=0.01
            )
    both = np.hypot(500 * np.radians(degrees), 500 * metres / 2)
    assert wrong_limit("tum", camera, depth) == pytest.approx(both)
    # rendered: the truth is exact
    assert wrong_limit("sintel", camera, depth) == 1.0
    small = Camera(50.0, 50.0, 31.5, 23.5, height=48, width=64)
    assert wrong_limit("tum", small, np.full((48, 64), np.nan)) == 1.0
    limits = {"wrong_limit_px": 4.0}
    pairs = table(row(0, 3.0, **limits), row(1, 5.0, **limits), row(2, 3.0))
    found = wrong_motions(pairs)
    assert (found["wrong"], found["wrong_limit_px"]) == (2, 4.0)


def test_a_line_of_results_by_hand() -> None:
    errors = {"rot_err_deg": 1.0, "trans_err": 0.1, "r_err_deg": 0.5, "t_err": 0.05}
    pairs = table(
        row(0, 2.0, **errors, epe=0.3, ms=10.0, flow_ms=5.0, dynamic_fraction=0.5),
        row(1, 4.0, **errors | {"rot_err_deg": 3.0}, epe=0.5, ms=20.0, flow_ms=5.0),
        row(2, None, status="failed(no_flow)", ms=30.0, flow_ms=5.0),
    )
    poses = np.stack(
        [se3_exp(np.array([0.1 * k, 0.02 * k**2, 0, 0, 0, 0])) for k in range(4)]
    )
    gt = Trajectory(np.arange(4) / 2, poses)
    named = {
        "sequence": "walk",
        "method": "a",
        "flow_source": "dis",
        "depth_source": "true",
    }
    moved = gt.transformed(se3_exp(np.full(6, 0.3)))
    path = evaluate(moved, gt) | rpe_over_a_second(moved, gt)
    line = sequence_row(pairs, path, named)
    expected = {
        **{"pairs": 3, "pairs_scored": 2, "failed": 1, "epe_l2_px": 3.0},
        **{"wrong": 3, "wrong_share": 1.0, "wrong_limit_px": 1.0},
        **{
            "epe": 0.4,
            "rot_err_deg_mean": 2.0,
            "trans_err_median": 0.1,
            "ms_per_pair_median": 20,
        },
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
