"""Constant velocity, with a covariance from how well that has held so far."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from hybridvo.geometry import invert, pose_matrix, se3_log
from hybridvo.results import MotionPrior

MEMORY = 10
"""Motions after which a change counts 1 / e of a new one."""
MIN_CHANGES = 3
"""Changes between motions to be seen before their spread means anything."""
INFLATION = 2.0
"""Factor on the mean square of the last changes, which tell little of the next, larger one."""
FLOOR_M, FLOOR_RAD = 1e-3, 1e-3
"""Smallest standard deviations of a prediction: no camera repeats its motion exactly."""
UNKNOWN_M, UNKNOWN_RAD = 1.0, 0.3
"""Standard deviations where too little is known."""


@dataclass(frozen=True, eq=False)
class MotionModel:
    """The last motion and the spread of the changes from motion to motion; constant size.

    Args:
        T_last: (4, 4) last motion found between neighbours, or None.
        spread: (6, 6) decaying sum of squared changes.
        weight: decaying number of changes.
        changes: how many were seen.
    """

    T_last: np.ndarray | None = None
    spread: np.ndarray | None = None
    weight: float = 0.0
    changes: int = 0

    def observed(self, T_curr_prev: np.ndarray, neighbours: bool = True) -> MotionModel:
        """The model after one more motion.

        ``neighbours``: whether it follows the last one directly, both over one frame.
        """
        # a step hands its motion out as well: its array may change
        T_curr_prev = np.array(T_curr_prev)
        if self.T_last is None or not neighbours:
            return MotionModel(T_curr_prev, self.spread, self.weight, self.changes)
        change = se3_log(T_curr_prev @ invert(self.T_last))
        keep = 1.0 - 1.0 / MEMORY
        before = np.zeros((6, 6)) if self.spread is None else self.spread
        return MotionModel(
            T_curr_prev,
            keep * before + np.outer(change, change),
            keep * self.weight + 1.0,
            self.changes + 1,
        )

    def predict(self, frames: int = 1) -> MotionPrior | None:
        """The motion to the frame ``frames`` ahead; None before the first motion.

        The velocity is taken to wander by as much as it did: over n frames the variance is that of
        one change times n (n + 1) (2 n + 1) / 6.
        """
        if self.T_last is None:
            return None
        n = int(frames)
        grown = n * (n + 1) * (2 * n + 1) / 6
        T = pose_matrix(np.linalg.matrix_power(self.T_last, n)[:3])
        if self.spread is None or self.changes < MIN_CHANGES:
            one = np.diag([UNKNOWN_M**2] * 3 + [UNKNOWN_RAD**2] * 3)
        else:
            # ten changes are few for 21 numbers: half of it is even in all directions
            mean = self.spread / self.weight
            even = np.repeat([np.trace(mean[:3, :3]) / 3, np.trace(mean[3:, 3:]) / 3], 3)
            one = INFLATION * 0.5 * (mean + np.diag(even))
            one += np.diag([FLOOR_M**2] * 3 + [FLOOR_RAD**2] * 3)
        return MotionPrior(T, grown * one)
