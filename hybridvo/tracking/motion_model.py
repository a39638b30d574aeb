"""What is known of the next motion from those before: constant velocity."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np

from hybridvo.core.geometry import invert, pose_matrix, se3_log
from hybridvo.core.results import MotionPrior, identity_covariance
from hybridvo.core.unchecked import made
from hybridvo.tracking.calibration import CHANGE_DECAY, CHANGE_INFLATION

# Changes of the motion; with fewer their standard deviation is not known yet.
MIN_CHANGES = 3
# Smallest standard deviation of a change, m and rad: no camera repeats its motion exactly.
MIN_CHANGE_STD = 1e-3


@dataclass(frozen=True, eq=False)
class MotionModel:
    """A motion model of constant velocity, with the mean square of its changes so far."""

    # (4, 4) last motion between neighbouring frames
    T_last: np.ndarray | None = None
    # decaying sum of squares
    spread: np.ndarray = field(default_factory=lambda: np.zeros((6, 6)))
    changes: int = 0  # so far
    failed: int = 0  # motions that failed since the last one that was found

    def observed(
        self, T_curr_prev: np.ndarray, neighbours: bool = True
    ) -> MotionModel:
        """Return the model after one more motion; ``neighbours``: it follows the last directly."""
        # copied, for the user gets the same array in a step and may change it
        T_curr_prev = np.array(T_curr_prev)
        if self.T_last is None or not neighbours:
            return replace(self, T_last=T_curr_prev, failed=0)
        change = se3_log(T_curr_prev @ invert(self.T_last))
        spread = CHANGE_DECAY * self.spread + np.outer(change, change)
        return MotionModel(T_curr_prev, spread, self.changes + 1)

    def predict(self, frames: int = 1, failures: int = 0) -> MotionPrior | None:
        """Predict the motion to a later frame; None before the first motion.

        Args:
            frames: how many frames ahead it is.
            failures: motions that failed before it: the velocity may change with every one.
        """
        if self.T_last is None:
            return None
        n = int(frames)
        # each change of the velocity lasts: it counts once for every motion that follows
        grown = (failures + 1) * sum(k**2 for k in range(1, n + 1))
        T = pose_matrix(np.linalg.matrix_power(self.T_last, n)[:3])
        if self.changes < MIN_CHANGES:
            covariance = grown * identity_covariance()
            return made(MotionPrior, T_curr_prev=T, covariance=covariance)
        # ten changes are few for the 21 numbers of a covariance: half of it is made isotropic
        mean = self.spread * (1 - CHANGE_DECAY) / (1 - CHANGE_DECAY**self.changes)
        even = np.repeat(
            [np.trace(mean[:3, :3]) / 3, np.trace(mean[3:, 3:]) / 3], 3
        )
        one = CHANGE_INFLATION * 0.5 * (mean + np.diag(even))
        covariance = grown * (one + MIN_CHANGE_STD**2 * np.eye(6))
        return made(MotionPrior, T_curr_prev=T, covariance=covariance)
