"""Whether the motion that was chosen among all that were found is the camera's.

The margin of its score alone throws most of the evidence away. An object that is taken for the
scene explains as many pixels as the scene would, or more, but they lie together; the scene lies
all around, and where it is the rival, it touches the border of the view.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from hybridvo.calibration import CHOICE_RIGHT, LEAST_SHARE
from hybridvo.results import Hypothesis, probability_right

# of a sum of weights that may be zero
TINY = 1e-9


class Place(NamedTuple):
    """Where the pixels lie that follow a motion.

    Attributes:
        share: fraction of the view.
        spread: product of the standard deviations of their places, as fractions of width and
            height, times ten: 0.8 where they are everywhere.
        border: mean weight at the border of the view.
    """

    share: float
    spread: float
    border: float


NOWHERE = Place(0.0, 0.0, 0.0)


class ChoiceEvidence(NamedTuple):
    """What speaks for a motion among others.

    Attributes:
        margin: by how much its score exceeds that of any other motion of any flow.
        first_margin: the same in the first flow alone, of the motion that was best there.
        log_share: log of the fraction of the view that follows it.
        log_rival_share: the same of the best other motion; that of nothing where there is none.
        spread: of its pixels, see :class:`Place`.
        rival_spread: of the other motion's.
        border: of its pixels.
        rival_border: of the other motion's.
    """

    margin: float
    first_margin: float
    log_share: float
    log_rival_share: float
    spread: float
    rival_spread: float
    border: float
    rival_border: float


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
    own = place_of(chosen.inliers)
    other = NOWHERE if rival is None else place_of(rival.inliers)
    return ChoiceEvidence(
        margin=margin,
        first_margin=first_margin,
        log_share=float(np.log(own.share + LEAST_SHARE)),
        log_rival_share=float(np.log(other.share + LEAST_SHARE)),
        spread=own.spread,
        rival_spread=other.spread,
        border=own.border,
        rival_border=other.border,
    )


def choice_probability(evidence: Sequence[float]) -> float:
    """Return the probability that the motion chosen is the camera's.

    Args:
        evidence: a :class:`ChoiceEvidence`.
    """
    probability = probability_right(evidence, CHOICE_RIGHT)
    return float(np.nan_to_num(probability))


def place_of(inliers: np.ndarray) -> Place:
    """Return where the pixels of a grid lie that follow a motion.

    Args:
        inliers: (h, w) weights from 0 to 1.

    >>> everywhere = place_of(np.ones((30, 40)))
    >>> [round(value, 2) for value in everywhere]
    [1.0, 0.83, 1.0]
    >>> corner = np.zeros((30, 40))
    >>> corner[:15, :20] = 1.0
    >>> [round(value, 2) for value in place_of(corner)]
    [0.25, 0.21, 0.25]
    """
    weights = np.asarray(inliers, np.float64)
    h, w = weights.shape
    total = weights.sum() + TINY
    rows = weights.sum(axis=1)
    columns = weights.sum(axis=0)
    ring = np.concatenate([weights[0], weights[-1], weights[:, 0], weights[:, -1]])
    spread = 10 * _deviation(rows, total) / h * _deviation(columns, total) / w
    return Place(
        share=float(total / weights.size),
        spread=float(spread),
        border=float(ring.mean()),
    )


def _deviation(weights: np.ndarray, total: float) -> float:
    """Standard deviation of the places (n,) that have these weights."""
    places = np.arange(len(weights))
    mean = (weights * places).sum() / total
    return float(np.sqrt((weights * (places - mean) ** 2).sum() / total))
