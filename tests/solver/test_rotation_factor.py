"""The rotation of a gyroscope as a factor of a motion."""

from __future__ import annotations

import numpy as np

from hybridvo.core.geometry import invert, make_transform, se3_exp, se3_log
from hybridvo.core.results import MotionPrior, RelativePose
from hybridvo.solver.rotation_factor import with_rotation

MOTION = RelativePose(
    se3_exp(np.array([0.02, 0.01, -0.03, 0.01, 0.02, -0.01])),
    # a turn that looks like a step aside
    covariance=1e-6
    * np.array(
        [
            [4.0, 0, 0, 0, -3, 0],
            [0, 4, 0, 3, 0, 0],
            [0, 0, 1, 0, 0, 0],
            [0, 3, 0, 9, 0, 0],
            [-3, 0, 0, 0, 9, 0],
            [0, 0, 0, 0, 0, 9],
        ]
    ),
    terms=("flow", "images"),
)


def measured(away: np.ndarray, std: float) -> MotionPrior:
    """What a gyroscope says that differs from the motion by a rotation vector."""
    T = se3_exp(np.concatenate([np.zeros(3), away])) @ MOTION.T_curr_prev
    T = make_transform(T[:3, :3], np.zeros(3))
    return MotionPrior(T, np.diag([1.0] * 3 + [std**2] * 3))


def test_it_counts_once_by_its_information() -> None:
    std = 1e-3
    found = with_rotation(MOTION, measured(np.array([0, 2e-3, 0]), std))
    of_sensor = np.diag([0.0] * 3 + [1 / std**2] * 3)
    information = np.linalg.inv(MOTION.covariance) + of_sensor
    np.testing.assert_allclose(np.linalg.inv(found.covariance), information)
    step = se3_log(found.T_curr_prev @ invert(MOTION.T_curr_prev))
    # nine tenths of the way, and the step aside that belongs to it
    np.testing.assert_allclose(step[3:], [0, 1.8e-3, 0], atol=1e-6)
    np.testing.assert_allclose(step[:3], [-0.6e-3, 0, 0], atol=1e-5)
    assert found.terms == ("flow", "images", "gyroscope")


def test_a_sure_motion_hardly_changes() -> None:
    found = with_rotation(MOTION, measured(np.array([0.02, 0, 0]), 0.1))
    step = se3_log(found.T_curr_prev @ invert(MOTION.T_curr_prev))
    assert np.linalg.norm(step) < 5e-5


def test_a_sensor_that_contradicts_counts_less() -> None:
    near = with_rotation(MOTION, measured(np.array([0.003, 0, 0]), 1e-3))
    far = with_rotation(MOTION, measured(np.array([0.2, 0, 0]), 1e-3))
    step = se3_log(far.T_curr_prev @ invert(MOTION.T_curr_prev))
    assert np.linalg.norm(step[3:]) < 0.01
    assert np.trace(far.covariance) > 2 * np.trace(near.covariance)
