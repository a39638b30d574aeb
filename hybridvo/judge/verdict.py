"""One covariance, one probability and one status of a motion, from all that is found on it.

The only place where the covariance of a motion is widened after the solver: what a tracker finds
on an answer is a finding as well.
"""

from __future__ import annotations

import math
from dataclasses import replace

from hybridvo.core.calibration import MIN_PROBABILITY
from hybridvo.core.depth_units import depth_unit_warning
from hybridvo.core.results import Motion, Reason, RelativePose, Rival, Status
from hybridvo.core.stages import stage
from hybridvo.evidence.pair import PairEvidence
from hybridvo.judge.calibration import DIRECT_INFLATION, NO_MOTION_PROBABILITY
from hybridvo.judge.consistency import against_images_and_depth
from hybridvo.judge.false_depth import false_depth
from hybridvo.judge.findings import Finding, improbable, others_possible
from hybridvo.judge.probability import probability_of
from hybridvo.solver.aligned_points import DirectEvidence, RememberedEvidence

NO_SEARCH = Status.degraded(
    Reason.AMBIGUOUS_MOTION,
    "a batch without weights does not search for other motions, so that this one may be an "
    "object's; give weights, as of hybridvo.select(hybridvo.PWVO.from_pretrained()(batch)), or "
    "call hybridvo.estimate for each pair",
)


@stage("judge")
def judge(
    evidence: PairEvidence, motion: Motion, is_compared: bool = True
) -> RelativePose:
    """Return a motion with the covariance, probability and status that all findings leave it.

    Where it is not ok, the pipeline asks the next source, which may cost flow.

    Args:
        evidence: what can be measured of the pair.
        motion: of the pair.
        is_compared: whether it is held against images and depth maps: answers of other libraries
            are shown as they are.
    """
    stated = believed(motion, evidence.options.select.min_probability)
    stated = _as_probable_as_stated(_explained(stated))
    depth = evidence.pair.prev.depth
    if is_compared and stated.usable:
        stated = with_finding(stated, against_images_and_depth(evidence, stated))
    if is_compared and stated.ok and depth is not None:
        stated = with_finding(stated, false_depth(evidence, stated))
    warning = depth_unit_warning(depth)
    if not warning:
        return stated
    return stated.replace(status=_in_another_unit(stated.status, warning))


def believed(
    motion: Motion, min_probability: float = MIN_PROBABILITY
) -> RelativePose:
    """Return a motion with the probability that its evidence gives it.

    Args:
        motion: as its source states it; one that is judged already stays as it is.
        min_probability: below it the motion is degraded.
    """
    if isinstance(motion, RelativePose):
        return motion
    probability = probability_of(motion.evidence) if motion.usable else 0.0
    status = as_probable(motion.status, probability, min_probability)
    is_direct = isinstance(motion.evidence, (DirectEvidence, RememberedEvidence))
    stated = vars(motion) | {
        "covariance": (DIRECT_INFLATION if is_direct else 1.0) * motion.covariance,
        "probability": probability,
        "status": status,
    }
    return RelativePose(**stated)


def as_probable(
    status: Status, probability: float, min_probability: float
) -> Status:
    """Return the status of a motion that may be an object's.

    Args:
        status: as its source states it.
        probability: that the motion is the camera's; NaN where nothing states it.
        min_probability: below it the motion is degraded.
    """
    # what else is wrong with a motion is stated, and explains the probability
    is_open = status.reason in (Reason.NONE, Reason.DEGENERATE_GEOMETRY)
    if not (status.usable and is_open):
        return status
    if math.isnan(probability):
        return NO_SEARCH
    if probability >= min_probability:
        return status
    what = "another of the motions found could be the camera's (probability of this one"
    return Status.degraded(
        Reason.AMBIGUOUS_MOTION, f"{what} {100 * probability:.0f} %)"
    )


def _explained(motion: RelativePose) -> RelativePose:
    """A motion whose status says why its images were not used, where it says nothing else."""
    report = motion.photometric
    if motion.status.message or report is None or not report.refusal:
        return motion
    text = f"images not used: {report.refusal}"
    return motion.replace(status=replace(motion.status, message=text))


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
        motion = motion.replace(rivals=_with_odds(motion))
        return with_finding(motion, others_possible(motion))
    return motion.replace(rivals=())


def _with_odds(motion: RelativePose) -> tuple[Rival, ...]:
    """A motion and its rival with their probabilities; empty where it has none."""
    if not motion.rivals:
        return ()
    p = motion.probability
    itself = Rival(motion.T_curr_prev, motion.covariance, motion.evidence, p)
    others = [
        replace(each, probability=min(1 - p, probability_of(each.evidence)))
        for each in motion.rivals
    ]
    return (itself, *others)


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
