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
    DIRECT_RIGHT,
    LEAST_SHARE,
)


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


def direct_probability(evidence: Sequence[float]) -> float:
    """Return the probability that a motion found without flow is the camera's.

    Args:
        evidence: its standard deviation, px, and the log of the fraction of the texture in regions
            that it leaves unexplained.
    """
    return probability_right(evidence, DIRECT_RIGHT)
