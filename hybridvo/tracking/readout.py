"""How long the rows of a camera take to be read, as frames show one after the other.

The velocity during a frame is known once the frame after it is tracked. Each pair of frames between
two others then shows the readout, roughly; the mean of many shows it to a millisecond.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from hybridvo.core.geometry import invert, se3_log
from hybridvo.core.results import Step
from hybridvo.core.types import Frame
from hybridvo.tracking.calibration import MAX_READOUT_STD_MS, MIN_STATIC_SHARE
from hybridvo.tracking.camera_drift import (
    CAMERA_SIGMAS,
    MAX_EVEN_MS,
    MIN_CAMERA_STEPS,
    Bend,
    Mean,
    bends_of,
    robust_mean,
)

# frames whose poses give the velocities of the two in the middle
NEIGHBOURS = 4


class Taken(NamedTuple):
    """A frame as it was tracked, and its step."""

    frame: Frame
    step: Step
    is_old: bool  # it is the frame before, handed out again
    # what of the readout was taken out of it before
    readout_ms: float = 0.0


class ReadoutFinder:
    """What frames, handed in one by one, show of the readout.

    Attributes:
        window: the last frames.
    """

    def __init__(self) -> None:
        self.window: deque[Taken] = deque(maxlen=NEIGHBOURS)
        self._bends: list[Bend] = []

    def add(self, taken: Taken, may_show: bool = True) -> None:
        """Take note of the next frame.

        Args:
            taken: the frame, as it was tracked.
            may_show: whether the readout is asked for.
        """
        self.window.append(taken)
        if may_show and len(self.window) == NEIGHBOURS:
            self._learn(*self.window)

    def mean(self) -> Mean | None:
        """What the frames so far show, ms; None where too few of them do."""
        if len(self._bends) < MIN_CAMERA_STEPS:
            return None
        return robust_mean(self._bends)

    def _learn(self, before: Taken, prev: Taken, curr: Taken, after: Taken) -> None:
        """Learn what the two frames in the middle show of the readout."""
        step = curr.step
        is_neighbour = step.prev_index == prev.frame.index
        is_static = step.ok and step.motion.inlier_ratio > MIN_STATIC_SHARE
        if not (is_neighbour and is_static):
            return
        at_prev = velocity_over([before, prev, curr])
        at_curr = velocity_over([prev, curr, after])
        if at_prev is None or at_curr is None:
            return
        everywhere = np.ones(prev.frame.camera.shape, np.float32)
        motion = step.motion.replace(weights=everywhere)
        bends = bends_of(prev.frame, curr.frame, motion, (at_prev, at_curr))
        if bends is not None and bends.readout is not None:
            left = bends.readout
            self._bends.append(left._replace(error=left.error + curr.readout_ms))


def velocity_over(taken: Sequence[Taken]) -> np.ndarray | None:
    """The mean velocity (6,) from the first of some successive frames to the last.

    It is None over an unknown or long time, and where the motion between the two is not known.
    """
    first = taken[0]
    last = taken[-1]
    between_s = last.frame.timestamp - first.frame.timestamp
    if not 0 < 1000 * between_s <= 2 * MAX_EVEN_MS:
        return None
    if not _are_joined(taken):
        return None
    T_last_first = invert(last.step.T_world_cam) @ first.step.T_world_cam
    return se3_log(T_last_first) / between_s


def _are_joined(taken: Sequence[Taken]) -> bool:
    """Whether motions that were found join the first of some successive frames to the last.

    The pose of a frame whose motion failed is a guess: only a motion that starts there tells of
    it. An old frame was not taken when it is stamped.
    """
    first = taken[0]
    last = taken[-1]
    if first.is_old or last.is_old:
        return False
    later = {each.frame.index: each.step for each in taken[1:]}
    start: int | None = last.frame.index
    while start in later:
        step = later.pop(start)
        if not step.usable:
            return False
        start = step.prev_index
    if start is None:
        return False
    return start == first.frame.index or first.step.usable


def is_known(readout: Mean | None) -> bool:
    """Return whether frames show how long the rows take, or that they take no time."""
    return readout is not None and readout.std < MAX_READOUT_STD_MS


def surely_ms(readout: Mean | None) -> float:
    """Return the readout where frames surely show one; else 0.

    >>> surely_ms(Mean(25.0, 2.0, 40)), surely_ms(Mean(3.0, 2.0, 40)), surely_ms(None)
    (25.0, 0.0, 0.0)
    """
    if readout is None or not is_known(readout):
        return 0.0
    rolls = readout.error > CAMERA_SIGMAS * readout.std
    return readout.error if rolls else 0.0
