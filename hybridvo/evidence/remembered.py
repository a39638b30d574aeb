"""What earlier frames have shown of a view: which of its points are static."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from hybridvo.core.belief import Belief
from hybridvo.core.geometry import transform_points
from hybridvo.core.stages import stage
from hybridvo.core.types import Frame
from hybridvo.evidence.calibration import HANDED_OVER, SEEN_THROUGH_LOG_ODDS
from hybridvo.solver.calibration import HIDDEN_SIGMAS
from hybridvo.solver.points import points_of
from hybridvo.solver.visibility import visibility


class Remembered(NamedTuple):
    """A belief about the view of an earlier frame.

    Attributes:
        belief: which of its points are static.
        frame: the earlier one; with another one in its place the belief stays.
        T_there_here: (4, 4) motion to it from the frame whose view is asked for; None: it is that.
    """

    belief: Belief
    frame: Frame
    T_there_here: np.ndarray | None = None


@stage("memory")
def carried_belief(known: Remembered, frame: Frame) -> Belief:
    """Return what is believed of the view of a frame.

    A surface that both frames see keeps most of its log odds. What was hidden or out of view is
    unknown. What stands where the earlier frame saw farther has come there: it moves.

    Args:
        known: of an earlier frame.
        frame: whose view is asked for.
    """
    if known.T_there_here is None:
        return known.belief
    points = points_of(frame)
    moved = transform_points(known.T_there_here, points.xyz)
    there = visibility(moved, known.frame, 0.0)
    stands_before = there.distance < -HIDDEN_SIGMAS
    agrees = there.is_measured & ~there.is_hidden & ~stands_before
    handed = HANDED_OVER * _at_pixels(known, there.uv)
    log_odds = np.where(agrees, handed, 0.0)
    log_odds[stands_before] = SEEN_THROUGH_LOG_ODDS
    return Belief(points.on_grid(log_odds), known.belief.certainty)


def _at_pixels(known: Remembered, uv: np.ndarray) -> np.ndarray:
    """(N,) log odds of a belief at pixels (N, 2); outside, those of the border."""
    log_odds = known.belief.log_odds
    rows, columns = log_odds.shape
    height, width = known.frame.camera.shape
    column = np.clip(uv[:, 0] * columns / width, 0, columns - 1).astype(int)
    row = np.clip(uv[:, 1] * rows / height, 0, rows - 1).astype(int)
    return log_odds[row, column].astype(np.float32)
