"""How probable a motion is to be the camera's, by what its source says for it.

The only place in which a probability is made of evidence: each kind of evidence has its own
function of it, fitted by ``tools/calibrate.py``. What speaks against a motion lowers it later, see
:mod:`hybridvo.judge.verdict`.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from scipy.special import expit

from hybridvo.core.results import Motion
from hybridvo.hypotheses.select import ChoiceEvidence, CueEvidence
from hybridvo.judge.calibration import (
    CERTAINTY_BONUS,
    CHOICE_RIGHT,
    CUES_RIGHT,
    DIRECT_EXACT,
    DIRECT_OF_SCENE,
    DIRECT_PROBABILITY,
    WITHOUT_IMAGES_RIGHT,
)
from hybridvo.solver.align import Aligned
from hybridvo.solver.aligned_points import DirectEvidence, RememberedEvidence
from hybridvo.solver.depth_alone import DepthEvidence


def probability_of(evidence: tuple[float, ...]) -> float:
    """Return the probability of a motion to be the camera's; 1 where nothing was asked.

    Args:
        evidence: what its source says for it; its type says what that is.

    Raises:
        TypeError: for a kind of evidence of which no probability is known.
    """
    if not evidence:
        return 1.0
    kind = type(evidence)
    if kind not in PROBABILITIES:
        known = ", ".join(each.__name__ for each in PROBABILITIES)
        raise TypeError(
            f"evidence: expected one of {known}, got {kind.__name__}; add a row to PROBABILITIES "
            "in hybridvo/judge/probability.py."
        )
    return float(np.nan_to_num(PROBABILITIES[kind](evidence)))


def logistic(evidence: Sequence[float], weights: Sequence[float]) -> float:
    """Return the logistic function of some evidence.

    Args:
        evidence: (n,) numbers.
        weights: (n + 1,) a weight for each number, then a constant.

    >>> logistic([2.0], [0.5, -1.0])
    0.5
    """
    log_odds = np.dot(weights, (*evidence, 1.0))
    return float(expit(log_odds))


def choice_probability(evidence: ChoiceEvidence) -> float:
    """Return the probability that the motion which PWVO chose is the camera's.

    >>> alone = ChoiceEvidence(6.0, 6.0, -0.1, -4.6)
    >>> round(choice_probability(alone), 2)
    0.99
    >>> as_good = ChoiceEvidence(0.0, 0.0, -0.7, -0.7)
    >>> round(choice_probability(as_good), 2)
    0.42
    """
    return logistic(evidence, CHOICE_RIGHT)


def cue_probability(evidence: CueEvidence) -> float:
    """Return the probability that the motion which hand-made cues choose is the camera's."""
    return logistic(evidence, CUES_RIGHT)


def direct_probability(evidence: DirectEvidence) -> float:
    """Return the probability that a motion found without flow is the camera's.

    It must be the motion of one thing and not one between those of several; and the thing must be
    the scene.

    >>> from hybridvo.solver.aligned_points import direct_evidence
    >>> turning_camera = direct_evidence(0.0002, 0.05, 1.0, 0.1)
    >>> round(direct_probability(turning_camera), 2)
    0.98
    >>> between_two = direct_evidence(0.0005, 0.004, 2.7, 0.03)
    >>> round(direct_probability(between_two), 2)
    0.02
    """
    is_of_scene = logistic([evidence.log_unexplained], DIRECT_OF_SCENE)
    return logistic(evidence, DIRECT_EXACT) * is_of_scene


def remembered_probability(evidence: RememberedEvidence) -> float:
    """Return the probability that the motion of what is believed static is the camera's.

    Of what is believed static no more is asked than that it moves as one thing: the belief says
    that it is the scene.
    """
    *seen, certainty = evidence
    return logistic(seen, DIRECT_EXACT) * float(expit(certainty + CERTAINTY_BONUS))


def depth_probability(evidence: DepthEvidence) -> float:
    """Return the probability of a motion that no image confirms."""
    return WITHOUT_IMAGES_RIGHT * evidence.in_view * evidence.inlier_ratio


PROBABILITIES: dict[type, Callable[[Any], float]] = {
    ChoiceEvidence: choice_probability,
    CueEvidence: cue_probability,
    DirectEvidence: direct_probability,
    RememberedEvidence: remembered_probability,
    DepthEvidence: depth_probability,
}
"""The probability of each kind of evidence, to which another package may add its own."""


def surest_evidence(aligned: Aligned) -> Motion:
    """Return an alignment with the evidence that says most for it.

    What is believed static is asked where all of the view does not show enough.
    """
    motion = aligned.motion
    p = probability_of(motion.evidence)
    if p >= DIRECT_PROBABILITY:
        return motion
    remembered = aligned.by_belief()
    if remembered is None or probability_of(remembered.evidence) <= p:
        return motion
    return remembered
