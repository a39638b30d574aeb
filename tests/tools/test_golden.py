"""The comparison of golden figures notices each kind of change, and nothing within the spread."""

from __future__ import annotations

import copy
from typing import Any

import numpy as np
import pytest

from tests.scripts import ROOT, load_script

compare = load_script("tools/golden.py").compare
measuring = load_script("tools/measuring.py")

CASE = {
    "pairs": 30,
    "median": 0.06,
    "worst": 0.4,
    "failed": 0,
    "unflagged": 0,
    "overconfident": 0,
    "status": {"ok": 28, "degraded(low_inliers)": 2},
    "nees": 5.0,
    "spread": {"median": 0.002},
}
PRIOR = CASE | {"without": {"median": 0.06, "failed": 0, "unflagged": 0}}


def figures(
    case: dict[str, Any], name: str = "heavy/dis/hybrid", **head: Any
) -> dict[str, Any]:
    return {"processor": "p", "cases": {name: copy.deepcopy(case)}} | head


def words(old: dict[str, Any], new: dict[str, Any]) -> list[str]:
    return [line.split(" ")[0] for line in compare(old, new)]


@pytest.mark.parametrize(
    "change",
    [
        {"median": 0.0655},
        {"worst": 0.61},
        {"failed": 1},
        {"unflagged": 1},
        {"overconfident": 2},
        {"status": {"ok": 24, "degraded(low_inliers)": 6}},
        {"status": {"ok": 24, "degraded(low_inliers)": 2, "failed(no_flow)": 4}},
        {"nees": 1.25},
        {"nees": 9.0},
    ],
    ids=lambda change: "-".join(f"{key}={value}" for key, value in change.items())[
        :40
    ],
)
def test_something_worse_is_named(change):
    assert words(figures(CASE), figures(CASE | change)) == ["WORSE"]


def test_answers_where_there_were_none_have_an_error_that_is_named():
    before = figures(CASE | {"nees": None})
    assert words(before, figures(CASE | {"nees": 90.0})) == ["WORSE"]


@pytest.mark.parametrize(
    "change",
    [{}, {"median": 0.0649}, {"worst": 0.59}, {"overconfident": 1}, {"nees": 7.0}],
)
def test_what_is_within_its_spread_is_not_named(change):
    assert compare(figures(CASE), figures(CASE | change)) == []


def test_a_smaller_error_is_better():
    assert words(figures(CASE), figures(CASE | {"median": 0.03})) == ["better"]


def test_another_processor_widens_the_bound():
    new = figures(CASE | {"median": 0.07}, processor="q")
    assert compare(figures(CASE), new) == []
    assert words(
        figures(CASE), figures(CASE | {"median": 0.09}, processor="q")
    ) == ["WORSE"]


def test_the_covariance_under_the_model_s_noise_is_judged_without_earlier_figures():
    new = figures(CASE | {"nees": 1.3}, "model_noise/made/refine")
    assert words(figures(CASE), new) == ["WORSE"]


def test_a_true_prior_never_makes_an_answer_worse():
    name = "prior_true/heavy/refine"
    assert compare(figures(CASE), figures(PRIOR, name)) == []
    assert words(figures(CASE), figures(PRIOR | {"failed": 1}, name)) == ["WORSE"]
    assert words(figures(CASE), figures(PRIOR | {"median": 0.073}, name)) == [
        "WORSE"
    ]


def test_errors_are_those_worked_by_hand():
    from hybridvo import Camera, Frame, FramePair
    from hybridvo.core.geometry import se3_exp

    camera = Camera(100.0, 100.0, 31.5, 23.5, height=48, width=64)
    frame = Frame(None, np.full((48, 64), 2.0), camera)
    T = np.eye(4)
    T[0, 3] = 0.02  # 100 px * 0.02 m / 2 m = 1 px
    pair = FramePair(frame, frame, None)
    assert measuring.ego_flow_error(
        T, np.eye(4), frame.depth, pair
    ) == pytest.approx(1.0)
    delta = np.array([0.1, -0.2, 0.3, 0.02, 0.01, -0.03])
    assert measuring.motion_error(se3_exp(delta) @ T, T) == pytest.approx(delta)


def test_the_frozen_figures_hold_every_kind_of_case():
    import json

    frozen = json.loads((ROOT / "docs/golden.json").read_text(encoding="utf-8"))
    kinds = {name.split("/")[0].split("_")[0] for name in frozen["cases"]}
    assert {"heavy", "track"} <= kinds
    assert compare(frozen, frozen) == []
