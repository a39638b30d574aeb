"""Whether a motion is the camera's: the probability by what speaks for it, of each source.

Of a motion that was chosen among all that were found, the margin of its score alone throws most of
the evidence away. An object that is taken for the scene covers more of the view than the scene that
is left, and is hardly contradicted by what else moves.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from hybridvo.core.results import Hypothesis, probability_right
from hybridvo.judge.calibration import (
    CHOICE_RIGHT,
    CUES_RIGHT,
    DIRECT_EXACT,
    DIRECT_OF_SCENE,
)

# What is added to the standard deviation of the ego flow and to its length, fractions of the
# image's width, to a shift of regions, standard errors, and to a fraction of the texture, before
# a logarithm is taken.
LEAST_STD = 1e-5
LEAST_FLOW = 0.0125
LEAST_REGION_SHIFT = 0.3
LEAST_UNEXPLAINED = 0.01
# Fraction of the view that is added to a share before its logarithm is evidence.
LEAST_SHARE = 0.01


class ChoiceEvidence(NamedTuple):
    """What speaks for a motion among others.

    Attributes:
        margin: by how much its score exceeds that of any other motion of any flow.
        first_margin: the same in the first flow alone, of the motion that was best there.
        log_share: log of the fraction of the view that follows it.
        log_rival_share: the same of the best other motion; that of nothing where there is none.
    """

    margin: float
    first_margin: float
    log_share: float
    log_rival_share: float


def choice_evidence(
    margin: float,
    first_margin: float,
    chosen: Hypothesis,
    rival: Hypothesis | None,
) -> ChoiceEvidence:
    """Collect the evidence on a choice.

    Args:
        margin: see :class:`ChoiceEvidence`.
        first_margin: see :class:`ChoiceEvidence`.
        chosen: the motion with the best score.
        rival: the best motion that differs from it; None where there is none.
    """
    rival_share = 0.0 if rival is None else float(np.mean(rival.inliers))
    return ChoiceEvidence(
        margin=margin,
        first_margin=first_margin,
        log_share=float(np.log(np.mean(chosen.inliers) + LEAST_SHARE)),
        log_rival_share=float(np.log(rival_share + LEAST_SHARE)),
    )


def choice_probability(evidence: Sequence[float]) -> float:
    """Return the probability that the motion chosen is the camera's.

    Args:
        evidence: a :class:`ChoiceEvidence`.

    >>> alone = ChoiceEvidence(6.0, 6.0, -0.1, -4.6)
    >>> round(choice_probability(alone), 2)
    0.98
    >>> as_good = ChoiceEvidence(0.0, 0.0, -0.7, -0.7)
    >>> round(choice_probability(as_good), 2)
    0.59
    """
    probability = probability_right(evidence, CHOICE_RIGHT)
    return float(np.nan_to_num(probability))


def cue_probability(evidence: Sequence[float]) -> float:
    """Return the probability that the motion which hand-made cues choose is the camera's.

    Args:
        evidence: see :func:`hybridvo.hypotheses.select.cue_evidence`.
    """
    return probability_right(evidence, CUES_RIGHT)


class DirectEvidence(NamedTuple):
    """What speaks for a motion that was found without flow.

    Attributes:
        log_std: log of the standard deviation of the ego flow, fraction of the image's width.
        log_flow: log of the mean length of the ego flow, fraction of the image's width.
        log_region_shift: log of the shift of the image's regions beside the motion, in standard
            errors.
        log_unexplained: log of the fraction of the texture in regions that it leaves unexplained.
    """

    log_std: float
    log_flow: float
    log_region_shift: float
    log_unexplained: float


def direct_evidence(
    std: float, flow: float, region_shift: float, unexplained: float
) -> DirectEvidence:
    """Collect the evidence on a motion that was found without flow.

    Args:
        std: standard deviation of the ego flow, fraction of the image's width.
        flow: mean length of the ego flow, fraction of the image's width.
        region_shift: shift of the image's regions beside the motion, in standard errors.
        unexplained: fraction of the texture in regions that it leaves unexplained.
    """
    return DirectEvidence(
        log_std=float(np.log(std + LEAST_STD)),
        log_flow=float(np.log(flow + LEAST_FLOW)),
        log_region_shift=float(np.log(region_shift + LEAST_REGION_SHIFT)),
        log_unexplained=float(np.log(unexplained + LEAST_UNEXPLAINED)),
    )


def direct_probability(evidence: DirectEvidence) -> float:
    """Return the probability that a motion found without flow is the camera's.

    It must be the motion of one thing and not one between those of several; and the thing must be
    the scene.

    >>> turning_camera = direct_evidence(0.0002, 0.05, 1.0, 0.1)
    >>> round(direct_probability(turning_camera), 2)
    0.97
    >>> between_two = direct_evidence(0.0005, 0.004, 2.7, 0.03)
    >>> round(direct_probability(between_two), 2)
    0.03
    """
    is_of_scene = probability_right([evidence.log_unexplained], DIRECT_OF_SCENE)
    return exact_probability(evidence) * is_of_scene


def exact_probability(evidence: DirectEvidence) -> float:
    """Return the probability that a motion found without flow is that of one thing, and exact.

    Of what is believed static no more is asked: the belief says that it is the scene.
    """
    return probability_right(evidence, DIRECT_EXACT)
