"""Constant velocity as a prior of the next motion: how sure it is."""

from __future__ import annotations

import numpy as np

from hybridvo.core.geometry import invert, se3_exp, se3_log
from hybridvo.tracking.motion_model import MotionModel

MOTION = se3_exp(np.array([0.03, -0.02, 0.08, 0.004, -0.006, 0.003]))


def test_the_model_knows_how_well_constant_velocity_held() -> None:
    rng = np.random.default_rng(2)
    sigma = np.array([0.02, 0.01, 0.03, 0.004, 0.006, 0.002])
    for ahead in (1, 3):
        motion, model, squared = MOTION, MotionModel(), []
        for k in range(400):
            prediction = model.predict(ahead)
            motions = [motion]
            for _ in range(ahead):
                motions.append(
                    se3_exp(sigma * rng.standard_normal(6)) @ motions[-1]
                )
            if prediction is not None and k > 20:
                true = np.eye(4)
                for T in motions[1:]:
                    true = T @ true
                error = se3_log(true @ invert(prediction.T_curr_prev))
                squared.append(
                    error @ np.linalg.solve(prediction.covariance, error)
                )
            motion = motions[1]
            model = model.observed(motion)
        # twice the mean square of the last ten changes: a mean of 3 to 6 for six numbers
        assert 1.5 < np.mean(squared) < 7.0


def test_the_model_says_little_before_it_has_seen_changes() -> None:
    model = MotionModel()
    assert model.predict() is None
    prediction = model.observed(MOTION).predict()
    assert prediction is not None and prediction.covariance[0, 0] == 1.0
