"""What the search hands to the selection: the motions of a pair, and the pixels behind them."""

from __future__ import annotations

import enum
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from hybridvo.core.types import FramePair
from hybridvo.solver.pixels import PixelGrid


class MotionSource(enum.StrEnum):
    """The kind of candidate that a motion was fitted from."""

    START = "start"
    """A pose that the caller hands in."""
    WINDOW = "window"
    """A dense fit of one window of the image."""
    MINIMAL = "minimal"
    """Three pixels."""
    RUNNER_UP = "runner-up"
    """Any of the above that lost its round, but differs from all winners."""
    REFIT = "refit"
    """A motion of the search, fitted again inside a static mask."""


class Candidate(NamedTuple):
    """One rigid motion that many pixels follow, and how it was found.

    Attributes:
        pose: (3, 4) ``T_curr_prev``, metres.
        inlier_ratio: weight of the inliers over that of all usable pixels, from 0 to 1.
        flow_noise_px: standard deviation of the inliers' flow, px.
        depth_noise: standard deviation of the inliers' log depth.
        source: the kind of candidate that it was fitted from.
        iterations: Gauss-Newton steps spent on it.
        parent: number of the motion of the search that it goes back to, or its own.
        mask: (h, w) weights with which a refit was made; None for motions of the search.
    """

    pose: np.ndarray
    inlier_ratio: float
    flow_noise_px: float
    depth_noise: float
    source: MotionSource
    iterations: int = 0
    parent: int = 0
    mask: np.ndarray | None = None

    @property
    def noise(self) -> tuple[float, float]:
        """Standard deviations of the inliers' flow, px, and of their log depth."""
        return self.flow_noise_px, self.depth_noise


@dataclass(frozen=True, eq=False)
class HypothesisSet:
    """Every strong motion of a pair, the strongest first; there is at least one.

    Attributes:
        pair: the frames with their flow, without the depth of the sky.
        grid: the pixels on which the motions were searched.
        motions: the motions, in the order found.
        cutoff: c of the Geman-McClure kernel, in standard deviations.
        is_complete: whether there is only one motion, and it explains nearly all pixels.
        lacks_sky: whether the previous frame has a sky, which the search left out.
    """

    pair: FramePair
    grid: PixelGrid
    motions: tuple[Candidate, ...]
    cutoff: float
    lacks_sky: bool = False
    is_complete: bool = False

    @property
    def poses(self) -> np.ndarray:
        """The poses of all motions, (M, 3, 4) ``T_curr_prev``."""
        return np.stack([motion.pose for motion in self.motions])
