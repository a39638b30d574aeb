"""Whether sigma, probability and status can be believed, in numbers and in the report."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from scipy.stats import chi2

from hybridvo.core.geometry import se3_exp
from hybridvo.core.results import stated_sigmas
from hybridvo_lab.evaluation.belief import (
    belief_rows,
    normalised_error,
    reliability,
)
from hybridvo_lab.evaluation.scores import pair_table


def pair(status: str = "ok", error: float = 0.1, **more: Any) -> dict[str, Any]:
    known = {"method": "hybrid", "flow_source": "dis", "wrong_limit_px": 1.0}
    return {"status": status, "epe_l2_px": error, **known, **more}


def test_the_normalised_error_of_a_true_covariance_is_six_in_the_mean(rng) -> None:
    root = 0.01 * rng.standard_normal((6, 6))
    covariance = root @ root.T
    T = se3_exp(np.array([0.3, -0.2, 0.1, 0.02, -0.1, 0.05]))
    found = [
        normalised_error(se3_exp(root @ rng.standard_normal(6)) @ T, T, covariance)
        for _ in range(2000)
    ]
    assert np.mean(found) == pytest.approx(6, rel=0.1)
    assert np.median(found) == pytest.approx(chi2.median(6), rel=0.1)


def test_a_covariance_that_is_none_gives_no_number() -> None:
    assert normalised_error(np.eye(4), np.eye(4), np.zeros((6, 6))) is None


def test_sigmas_are_lengths_in_their_units() -> None:
    found = stated_sigmas(np.diag([9e-4, 16e-4, 0, np.radians(2) ** 2, 0, 0]))
    assert found["sigma_trans"] == pytest.approx(0.05)
    assert found["sigma_rot_deg"] == pytest.approx(2)


def test_what_is_wrong_and_called_ok_is_counted() -> None:
    pairs = pair_table(
        [
            pair(nees=5.0),
            pair(nees=6.0),
            pair(nees=100.0),
            pair(error=3.0, nees=1e4),
            pair("degraded(contradicted)", error=3.0),
            pair("failed(no_flow)", error=0.2),
        ]
    )
    (row,) = belief_rows(pairs)
    assert (row["pairs"], row["ok"], row["wrong_ok"]) == (6, 4, 1)
    assert row["wrong_ok_share"] == pytest.approx(1 / 4)
    assert row["wrong_told"] == pytest.approx(2 / 3)
    # of the right ones alone
    assert row["nees_median"] == 6.0
    assert row["beyond_share"] == pytest.approx(1 / 3)


def test_probabilities_are_held_against_how_often_they_are_right() -> None:
    pairs = pair_table(
        [pair(probability=0.97, error=e) for e in (0.1, 0.2, 0.1, 5.0)]
        + [pair(probability=0.5, error=e) for e in (0.1, 5.0)]
    )
    rows = reliability(pairs)
    assert rows["probability"].tolist() == pytest.approx([0.5, 0.97])
    assert rows["right"].tolist() == [0.5, 0.75]
    assert rows["motions"].tolist() == [2, 4]
