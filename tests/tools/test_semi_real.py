"""What the semi-real benchmark says of a probability, and what the calibration makes of one."""

from __future__ import annotations

import numpy as np
import pytest

from tests.scripts import load_script

benchmark = load_script("tools/bench/semi_real.py")
calibrate = load_script("tools/calibrate.py")


def test_calibration_of_a_probability() -> None:
    # stated .85 of ten answers, six of them right; stated .15 of ten, none right
    stated = np.repeat([0.85, 0.15], 10)
    true = np.arange(20) < 6
    assert benchmark.calibration_error(stated, true) == pytest.approx(
        (0.25 + 0.15) / 2
    )


def test_the_fit_finds_the_weights_that_made_the_answers() -> None:
    rng = np.random.default_rng(0)
    evidence = rng.standard_normal((4000, 2))
    weights = np.array([1.5, -0.5, 1.0])
    right = rng.random(4000) < 1 / (
        1 + np.exp(-evidence @ weights[:2] - weights[2])
    )
    found = calibrate.fit(evidence, right)
    # the penalty draws the slopes a little towards zero
    np.testing.assert_allclose(found, weights, atol=0.2)
    stated = 1 / (1 + np.exp(-evidence @ found[:2] - found[2]))
    assert benchmark.calibration_error(stated, right) < 0.05
