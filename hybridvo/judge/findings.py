"""What a witness states of a motion: how much less certain it is, and why it is not ok.

A witness changes nothing. :func:`hybridvo.judge.verdict.judge` puts all findings together.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from hybridvo.core.geometry import invert, se3_log
from hybridvo.core.results import Motion, Reason, RelativePose, Status


class Finding(NamedTuple):
    """What a witness states of a motion.

    Attributes:
        covariance: (6, 6) that is added to the motion's; to widen that by a factor k,
            ``(k - 1) * motion.covariance``.
        probability: the motion is right with at most this.
        status: of the motion, in the place of what was stated so far; None: it stays.
    """

    covariance: np.ndarray
    probability: float = 1.0
    status: Status | None = None


def covering(T_apart: np.ndarray) -> np.ndarray:
    """Return the covariance (6, 6) with which a motion covers one that is so far (4, 4) away."""
    step = se3_log(T_apart)
    return np.outer(step, step)


def towards(motion: Motion, T_curr_prev: np.ndarray) -> np.ndarray:
    """Return the covariance (6, 6) with which a motion covers another one (4, 4)."""
    return covering(T_curr_prev @ invert(motion.T_curr_prev))


def improbable(motion: RelativePose) -> Finding:
    """Find that a motion is not the camera's with its own probability."""
    percent = 100 * motion.probability
    text = f"the motion found has a probability of {percent:.0f} %"
    return Finding(
        np.zeros((6, 6)), 0.0, Status.failed(Reason.AMBIGUOUS_MOTION, text)
    )


def others_possible(motion: RelativePose) -> Finding:
    """Find that one of the other motions, or standing still, may be the camera's instead.

    It adds the second moment of a mixture: where this motion is wrong, the camera's is taken to
    be as far away as the farthest of the others.
    """
    others = [h.T_curr_prev for h in motion.hypotheses[1:]]
    others += [rival.T_curr_prev for rival in motion.rivals] + [np.eye(4)]
    steps = np.array([se3_log(motion.T_curr_prev @ invert(T)) for T in others])
    translation2 = np.max(np.sum(steps[:, :3] ** 2, axis=1))
    rotation2 = np.max(np.sum(steps[:, 3:] ** 2, axis=1))
    variances = np.repeat([translation2, rotation2], 3)
    return Finding((1 - motion.probability) * np.diag(variances))
