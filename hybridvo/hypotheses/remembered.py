"""What earlier frames have shown as evidence among the motions of a pair.

The majority of the view may move, and follow a motion that looks like a camera's. So a motion is
judged by fractions: how much of what was static follows it, and how much of what moved. Sums over
pixels would be a majority vote of the past.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from hybridvo.core.belief import Belief, resized
from hybridvo.core.calibration import KNOWN_LOG_ODDS, MIN_STATIC
from hybridvo.hypotheses.calibration import (
    FRACTION_EVIDENCE,
    FRACTION_FLOOR,
    MEMORY_DEAD_ZONE,
    MEMORY_SURE,
)
from hybridvo.hypotheses.types import HypothesisSet

# guards divisions
TINY = 1e-9


def on_pixels(found: HypothesisSet, values: np.ndarray) -> np.ndarray:
    """Return values (h, w) of a belief on the pixels of a search, (rows, columns)."""
    rows, columns = found.grid.shape[:2]
    return resized(values, (rows, columns))


def memory_scores(
    found: HypothesisSet, inliers: Sequence[np.ndarray], belief: Belief
) -> np.ndarray:
    """Return what is added to the scores (N,) of motions by what is remembered, nats.

    Args:
        found: the pixels.
        inliers: (rows, columns) of each motion.
        belief: what earlier frames have shown of these pixels.

    Returns:
        At most 0; 0 of the motion that fits the memory best, and of all where too little is
        known.
    """
    count = len(inliers)
    if belief.static_fraction < MIN_STATIC or count == 0:
        return np.zeros(count)
    log_odds = on_pixels(found, belief.log_odds)
    static = _followed_fractions(found, inliers, log_odds > KNOWN_LOG_ODDS)
    evidence = np.log(static + FRACTION_FLOOR)
    if belief.something_moves:
        moving = _followed_fractions(found, inliers, log_odds < -KNOWN_LOG_ODDS)
        evidence = FRACTION_EVIDENCE * (evidence - np.log(moving + FRACTION_FLOOR))
    behind = np.minimum(evidence - evidence.max() + MEMORY_DEAD_ZONE, 0)
    return np.log(MEMORY_SURE * np.exp(behind) + 1 - MEMORY_SURE)


def _followed_fractions(
    found: HypothesisSet, inliers: Sequence[np.ndarray], is_counted: np.ndarray
) -> np.ndarray:
    """Fractions (N,) of the pixels that count which follow each motion."""
    weight = is_counted.reshape(-1) * found.grid.weight
    total = max(float(weight.sum()), TINY)
    return np.array([float(weight @ each.reshape(-1)) / total for each in inliers])
