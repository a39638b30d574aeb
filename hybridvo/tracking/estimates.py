"""The motion to a frame, and what it was estimated from."""

from __future__ import annotations

from collections.abc import Iterable
from typing import NamedTuple

import numpy as np

from hybridvo.core.geometry import chain
from hybridvo.core.results import MotionPrior, RelativePose
from hybridvo.tracking.keyframes import Keyframe
from hybridvo.tracking.relocalization import are_apart


class Estimate(NamedTuple):
    """A motion to the current frame, and what it was estimated from.

    Attributes:
        start: the motion is from there.
        motion: from ``start`` to the frame.
        reference: the frame before.
        keyframes: those that are near enough to be kept, oldest first.
        given: what the caller knows of the motion from the reference.
        is_relocalized: whether the path was lost since ``start``.
    """

    start: Keyframe
    motion: RelativePose
    reference: Keyframe
    keyframes: tuple[Keyframe, ...]
    given: MotionPrior | None
    is_relocalized: bool = False

    @property
    def T_world_cam(self) -> np.ndarray:
        """(4, 4) pose of the current frame."""
        return chain(self.start.T_world_cam, self.motion.T_curr_prev)

    @property
    def home(self) -> Keyframe:
        """The oldest keyframe in use, on whose pixels a memory stands."""
        return min(
            (*self.keyframes, self.reference), key=lambda keyframe: keyframe.count
        )

    def agrees_with(self, others: Iterable[Estimate]) -> bool:
        """Whether all others put the current frame in the same place."""
        here = self.T_world_cam
        return not any(
            are_apart(self.start.frame, here, other.T_world_cam) for other in others
        )
