"""One covariance, one probability and one status of a motion, from all findings on it.

The only place where the covariance of a motion is widened after the solver: what a tracker finds
on an answer is a finding as well.
"""

from __future__ import annotations

from hybridvo.core.depth_units import depth_unit_warning
from hybridvo.core.results import Reason, RelativePose, Status
from hybridvo.core.stages import stage
from hybridvo.judge.calibration import NO_MOTION_PROBABILITY
from hybridvo.judge.consistency import against_images_and_depth
from hybridvo.judge.false_depth import false_depth
from hybridvo.judge.findings import Finding, Question, improbable, others_possible


@stage("judge")
def judge(question: Question, is_compared: bool = True) -> RelativePose:
    """Return a motion with the covariance, probability and status that all findings leave it.

    Args:
        question: the motion, and what it can be held against.
        is_compared: whether it is held against images and depth maps: answers of other libraries
            are shown as they are.
    """
    motion = _as_probable_as_stated(question.motion)
    if is_compared and motion.usable:
        against = against_images_and_depth(question._replace(motion=motion))
        motion = with_finding(motion, against)
    if is_compared and motion.ok and question.pair.prev.depth is not None:
        false = false_depth(question._replace(motion=motion))
        motion = with_finding(motion, false)
    warning = depth_unit_warning(question.pair.prev.depth)
    if not warning:
        return motion
    return motion.replace(status=_in_another_unit(motion.status, warning))


def _as_probable_as_stated(motion: RelativePose) -> RelativePose:
    """A motion that its own probability makes failed, or less certain."""
    if not motion.usable:
        return motion
    reason = motion.status.reason
    # what else is wrong with a motion is stated, and explains the probability
    is_doubted_for_that = reason in (Reason.NONE, Reason.AMBIGUOUS_MOTION)
    if motion.probability < NO_MOTION_PROBABILITY and is_doubted_for_that:
        return with_finding(motion, improbable(motion))
    if reason is Reason.AMBIGUOUS_MOTION:
        return with_finding(motion, others_possible(motion))
    return motion


def with_finding(motion: RelativePose, finding: Finding | None) -> RelativePose:
    """Return a motion with what was found on it; None: nothing was."""
    if finding is None:
        return motion
    status = finding.status or motion.status
    if motion.usable and not status.usable:
        return RelativePose.failed(status.reason, status.message)
    return motion.replace(
        covariance=motion.covariance + finding.covariance,
        probability=min(motion.probability, finding.probability),
        status=status,
    )


def _in_another_unit(status: Status, warning: str) -> Status:
    """The status of a motion whose depth cannot be in metres: much else may follow from that."""
    if status.ok:
        return Status.degraded(Reason.DEPTH_UNIT, warning)
    # found before the values of depth mattered
    is_independent = status.reason in (Reason.NO_FLOW, Reason.MISSING_FRAME)
    reason = status.reason if is_independent else Reason.DEPTH_UNIT
    return Status(status.state, reason, f"{warning}; besides, {status.message}")
