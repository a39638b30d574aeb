"""Motions from a keyframe that correct the path since.

A slow object that is taken for the scene leads the path away by a little in every step, and each
of these steps may be sure. From a keyframe the object has moved by pixels, and the motion from
there is right again. By it the camera has moved as it is not expected to, and as the images of the
frame before do not show: that frame was elsewhere.
"""

from __future__ import annotations

import numpy as np

from hybridvo.core.geometry import squared_distance
from hybridvo.core.options import RefineOptions
from hybridvo.core.results import MotionPrior, RelativePose
from hybridvo.core.types import Frame, FramePair
from hybridvo.hypotheses.direct import direct_near
from hybridvo.tracking.calibration import SAME_MOTION
from hybridvo.tracking.keyframes import Keyframe, between_frames


def corrects_path(
    motion: RelativePose,
    start: Keyframe,
    reference: Keyframe,
    frame: Frame,
    expected: MotionPrior | None,
    options: RefineOptions,
) -> bool:
    """Whether a motion and the path since its start cannot both be right.

    Args:
        motion: from ``start`` to the current frame.
        start: a keyframe.
        reference: the frame before.
        frame: the current one.
        expected: what is known of the motion from the reference; None: nothing.
        options: of the refinement.

    Returns:
        False where the motion starts from the reference itself, or nothing is expected.
    """
    if expected is None or start.count >= reference.count:
        return False
    step = between_frames(motion.replace(weights=None), start, reference)
    T_expected = expected.T_curr_prev
    if _agree(step, T_expected, expected.covariance):
        return False
    # the camera may have moved so all the same
    pair = FramePair(reference.frame, frame, None)
    shown = direct_near(pair, step.T_curr_prev, options)
    if shown is None:
        return True
    return not _agree(step, shown.T_curr_prev, shown.covariance)


def _agree(
    step: RelativePose, T_curr_prev: np.ndarray, covariance: np.ndarray
) -> bool:
    """Whether a step agrees with another estimate of it, whose covariance (6, 6) is given."""
    both = step.covariance + covariance
    return squared_distance(step.T_curr_prev, T_curr_prev, both) <= SAME_MOTION
