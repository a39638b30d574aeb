"""A rotation that another sensor measured, as a factor of a motion that was found."""

from __future__ import annotations

import numpy as np

from hybridvo.core.geometry import invert, se3_exp, se3_log
from hybridvo.core.results import MotionPrior, RelativePose, Term
from hybridvo.solver.calibration import PRIOR_FREEDOM


def with_rotation(motion: RelativePose, measured: MotionPrior) -> RelativePose:
    """Add what a gyroscope measured to a motion by flow and images.

    Each counts by its information. Under Student's kernel a sensor that contradicts the
    motion by far more than both err counts less.

    Args:
        motion: what was found without the gyroscope.
        measured: the rotation of the same motion; its translation is not used.

    Returns:
        The motion of both, whose terms name the gyroscope.
    """
    away = se3_log(measured.T_curr_prev @ invert(motion.T_curr_prev))[3:]
    of_sensor = measured.covariance[3:, 3:]
    apart = motion.covariance[3:, 3:] + of_sensor
    squared = float(away @ np.linalg.solve(apart, away))
    factor = (PRIOR_FREEDOM + len(away)) / (PRIOR_FREEDOM + squared)
    # it counts once, however well both agree
    of_sensor = of_sensor / min(factor, 1.0)
    gain = motion.covariance[:, 3:] @ np.linalg.inv(
        motion.covariance[3:, 3:] + of_sensor
    )
    covariance = motion.covariance - gain @ motion.covariance[3:, :]
    return motion.replace(
        T_curr_prev=se3_exp(gain @ away) @ motion.T_curr_prev,
        covariance=(covariance + covariance.T) / 2,
        terms=(*motion.terms, Term.GYROSCOPE),
    )
