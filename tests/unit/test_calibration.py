"""Normalised errors, reliability and the cost of flags, against numbers worked by hand."""

from __future__ import annotations

import numpy as np
import pytest
from hybridvo.hypotheses.confidence import RECALIBRATION, probability_right

from hybridvo.errors import InputError
from hybridvo.evaluation.calibration import (
    CHI2_6_3SIGMA,
    flag_cost,
    nees_summary,
    normalised_error,
    proportion,
    recalibrate,
    recalibrated,
    reliability,
)
from hybridvo.evaluation.plots_calibration import plot_calibration
from hybridvo.geometry import se3_exp


def test_three_sigma_is_scipys():
    from scipy.stats import chi2, norm

    assert chi2.ppf(norm.cdf(3) - norm.cdf(-3), 6) == pytest.approx(CHI2_6_3SIGMA, abs=2e-3)


def test_normalised_errors_of_a_right_covariance_are_chi_square():
    rng = np.random.default_rng(0)
    A = rng.normal(size=(6, 6)) * 1e-2
    covariance = A @ A.T + 1e-6 * np.eye(6)
    L = np.linalg.cholesky(covariance)
    T_true = se3_exp(np.array([0.3, -0.1, 0.8, 0.1, 0.2, -0.05]))
    values = [
        normalised_error(se3_exp(L @ rng.normal(size=6)) @ T_true, covariance, T_true)
        for _ in range(2000)
    ]
    found = nees_summary(values)
    # mean of 2000 chi-squares: standard deviation sqrt(12 / 2000) = 0.077; four of them
    assert found["mean"] == pytest.approx(6.0, abs=0.31)
    assert found["median"] == pytest.approx(5.348, abs=0.4)
    assert found["contained"]["low"] < 0.9973 < found["contained"]["high"]
    assert found["unknown"] == 0


def test_an_error_of_one_sigma_in_each_parameter_is_six():
    sigma = np.array([0.01, 0.02, 0.03, 0.001, 0.002, 0.003])
    T = se3_exp(sigma) @ se3_exp(np.array([1.0, 0, 0, 0, 0.5, 0]))
    T_true = se3_exp(np.array([1.0, 0, 0, 0, 0.5, 0]))
    assert normalised_error(T, np.diag(sigma**2), T_true) == pytest.approx(6.0, rel=1e-9)


def test_a_singular_covariance_has_no_normalised_error():
    assert normalised_error(np.eye(4), np.zeros((6, 6)), np.eye(4)) is None
    found = nees_summary([None, 1.0])
    assert found["unknown"] == 1
    # what states nothing contains nothing
    assert found["contained"]["count"] == 1
    assert found["contained"]["of"] == 2
    assert nees_summary([])["mean"] is None


def test_reliability_by_hand():
    found = reliability([0.1, 0.1, 0.9, 0.9], [False, True, True, True], bins=2)
    low, high = found["bins"]
    assert (low["answers"], low["stated"], low["observed"]["share"]) == (2, 0.1, 0.5)
    assert (high["answers"], high["stated"], high["observed"]["share"]) == (2, 0.9, 1.0)
    # (0.01 + 0.81 + 0.01 + 0.01) / 4, and half of 0.4 plus half of 0.1
    assert found["brier"] == pytest.approx(0.21)
    assert found["ece"] == pytest.approx(0.25)
    assert found["brier_base_rate"] == pytest.approx(0.75 * 0.25)


def test_an_honest_probability_has_no_calibration_error():
    rng = np.random.default_rng(1)
    p = rng.uniform(size=20000)
    found = reliability(p, rng.uniform(size=p.size) < p)
    # a bin of 2000 is off by 0.007 in the mean, the mean of ten by 0.0017 from that; four of them
    assert found["ece"] < 0.014
    assert found["brier"] == pytest.approx(1 / 6, abs=0.005)


def test_nothing_asked_is_nothing_known():
    found = reliability([], [])
    assert found["ece"] is None
    assert found["answers"] == 0
    assert all(b["observed"]["share"] is None for b in found["bins"])


@pytest.mark.parametrize(("p", "y"), [([0.5, 1.2], [True, True]), ([0.5], [True, False])])
def test_what_is_no_probability_is_refused(p, y):
    with pytest.raises(InputError, match="expected"):
        reliability(p, y)


def test_temperature_and_evidence_are_found_again():
    rng = np.random.default_rng(2)
    z, e = rng.normal(scale=3, size=40000), rng.normal(size=40000)
    truth = 1 / (1 + np.exp(-(0.5 * z - 0.8 * e + 0.3)))
    right = rng.uniform(size=z.size) < truth
    stated = 1 / (1 + np.exp(-z))
    found = recalibrate(stated, right, {"e": e})
    coefficients = found["coefficients"]
    assert list(coefficients) == ["logit", "e", "constant"]
    # standard errors from the Fisher information of 40000 answers: 0.006, 0.015, 0.013; four each
    assert coefficients["logit"] == pytest.approx(0.5, abs=0.024)
    assert coefficients["e"] == pytest.approx(-0.8, abs=0.06)
    assert coefficients["constant"] == pytest.approx(0.3, abs=0.05)
    assert found["loss_after"] < found["loss_before"]
    # stated logits are cut at 1e-4, where one in a thousand of these lies
    assert np.abs(recalibrated(stated, {"e": e}, coefficients) - truth).mean() < 0.01


def test_the_status_states_the_recalibrated_probability():
    noise, share = np.array([0.001, 0.4, 1.3]), np.array([0.9, 0.3, 0.5])
    trust = np.array([0.99999, 0.5, 0.7])
    evidence = {"log_noise_px": np.log(np.maximum(noise, 0.02)), "share": np.minimum(share, 0.45)}
    np.testing.assert_allclose(
        [probability_right(*row) for row in zip(trust, noise, share, strict=True)],
        recalibrated(trust, evidence, RECALIBRATION),
        rtol=1e-12,
    )
    # surer of itself: surer; the same word where more noise was to be expected: surer
    assert probability_right(0.9, 0.5, 0.4) > probability_right(0.8, 0.5, 0.4)
    # where most pixels agree, more of them are no reason for doubt
    assert probability_right(0.8, 0.5, 0.9) == probability_right(0.8, 0.5, 0.5)
    assert probability_right(0.8, 1.0, 0.4) > probability_right(0.8, 0.1, 0.4)


def test_few_or_separable_answers_keep_a_finite_map():
    found = recalibrate([0.2, 0.3, 0.8, 0.9], [False, False, True, True])["coefficients"]
    assert 1 < found["logit"] < 20
    nothing = recalibrate([], [])
    assert nothing["coefficients"] == {"logit": 1.0, "constant": 0.0}
    assert nothing["loss_after"] is None


def test_cost_of_flags_by_hand():
    def answer(failure, status, nees):
        return {"failure": failure, "status": status, "nees": nees}

    records = [
        answer(True, "degraded", 1e6),  # flagged
        answer(True, "ok", 10.0),  # inside its own 3 sigma
        answer(True, "ok", 1e6),  # silent
        answer(True, "failed", None),  # flagged, no covariance
        *[answer(False, "ok", 6.0)] * 5,
        answer(False, "degraded", 6.0),
    ]
    found = flag_cost(records)
    counts = {name: (row["count"], row["of"]) for name, row in found.items()}
    assert counts == {
        "failures": (4, 10),
        "flagged": (2, 4),
        "inside": (1, 4),
        "caught": (3, 4),
        "silent": (1, 4),
        "degraded": (1, 6),
    }
    assert flag_cost([])["caught"]["share"] is None


def test_a_proportion_has_the_breakdowns_interval():
    found = proportion(0, 10)
    assert found["share"] == 0
    assert found["high"] == pytest.approx(0.2775, abs=1e-4)


def test_picture(tmp_path):
    import cv2

    rng = np.random.default_rng(3)
    p = rng.uniform(size=200)
    groups = {"a": reliability(p, rng.uniform(size=200) < p), "b": reliability([0.2], [True])}
    plot_calibration(groups, tmp_path / "r.png", title="doubt")
    image = cv2.imread(str(tmp_path / "r.png"))
    assert image.shape[0] > 400
    assert image.std() > 5  # something is drawn
    with pytest.raises(InputError, match=r"\.png"):
        plot_calibration(groups, tmp_path / "r.svg")
    with pytest.raises(InputError, match="at least one"):
        plot_calibration({}, tmp_path / "r.png")
