"""Motions from a keyframe that contradict the path since.

A slow object that is taken for the scene leads the path away by a little in every step, and each
of these steps may be sure. From a keyframe the object has moved by pixels, and the motion from
there is right again. It then leads to a place that the camera cannot have reached from the frame
before: that frame was elsewhere.
"""

from __future__ import annotations

import numpy as np

from hybridvo.core.geometry import invert, se3_log
from hybridvo.core.results import MotionPrior, RelativePose
from hybridvo.tracking.calibration import SAME_MOTION
from hybridvo.tracking.keyframes import Keyframe, between_frames


def contradicts_path(
    motion: RelativePose,
    start: Keyframe,
    reference: Keyframe,
    expected: MotionPrior | None,
) -> bool:
    """Whether a motion and the path since its start cannot both be right.

    Args:
        motion: from ``start`` to the current frame.
        start: a keyframe.
        reference: the frame before.
        expected: what is known of the motion from the reference; None: nothing.

    Returns:
        False where the motion starts from the reference itself, or nothing is expected.
    """
    if expected is None or start.count >= reference.count:
        return False
    step = between_frames(motion.replace(weights=None), start, reference)
    apart = se3_log(step.T_curr_prev @ invert(expected.T_curr_prev))
    covariance = step.covariance + expected.covariance
    return bool(apart @ np.linalg.solve(covariance, apart) > SAME_MOTION)
