"""What is believed of a frame's pixels: which of them are static, and how surely."""

from __future__ import annotations

from dataclasses import dataclass, field

import cv2
import numpy as np
from scipy.special import expit

from hybridvo.core.calibration import (
    BELIEF_MIDDLE,
    BELIEF_SLOPE,
    KNOWN_LOG_ODDS,
    MIN_CERTAINTY,
    MIN_MOVING,
    MIN_STATIC,
    TEXTURE_MIDDLE,
)


@dataclass(frozen=True, eq=False)
class Belief:
    """Which parts of a view are static, as frames before have shown.

    Attributes:
        log_odds: (h, w) float16 log odds of each point of a regular grid to be static
            (:func:`hybridvo.solver.points.grid_index`); 0 where nothing is known.
        certainty: log odds that the whole belief is right.
    """

    log_odds: np.ndarray = field(
        default_factory=lambda: np.zeros((0, 0), np.float16)
    )
    certainty: float = 0.0

    @property
    def static_fraction(self) -> float:
        """Fraction of the points that are believed static."""
        return _fraction(self.log_odds > KNOWN_LOG_ODDS)

    @property
    def moving_fraction(self) -> float:
        """Fraction of the points that are believed to move."""
        return _fraction(self.log_odds < -KNOWN_LOG_ODDS)

    @property
    def is_ready(self) -> bool:
        """Whether enough is known, surely enough, to do without flow."""
        knows_enough = self.static_fraction >= MIN_STATIC
        return knows_enough and self.certainty >= MIN_CERTAINTY

    @property
    def something_moves(self) -> bool:
        """Whether so much moves that it matters which pixels are used."""
        return self.moving_fraction >= MIN_MOVING

    @property
    def weights(self) -> np.ndarray:
        """(h, w) float32 weights of a fit to what is believed static, from 0 to 1.

        Even ones where hardly anything moves.
        """
        if not self.something_moves:
            return np.ones(self.log_odds.shape, np.float32)
        ramp = BELIEF_SLOPE * (self.log_odds.astype(np.float32) - BELIEF_MIDDLE)
        return np.asarray(expit(ramp), np.float32)

    @property
    def static_weights(self) -> np.ndarray:
        """(h, w) float32 factors on the texture of each point, from 0 to 1."""
        ramp = self.log_odds.astype(np.float32) - TEXTURE_MIDDLE
        return np.asarray(expit(ramp), np.float32)


def resized(grid: np.ndarray, shape: tuple[int, int]) -> np.ndarray:
    """Return values (h, w) of a regular grid over an image for each of (H, W) pixels."""
    height, width = shape
    values = np.asarray(grid, np.float32)
    return cv2.resize(values, (width, height), interpolation=cv2.INTER_NEAREST)


def _fraction(is_so: np.ndarray) -> float:
    return float(np.mean(is_so)) if is_so.size else 0.0
