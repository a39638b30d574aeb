"""The frames of a tracker, each brought to the time of its middle row, once for all its pairs."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from hybridvo.core.geometry import invert
from hybridvo.core.types import FramePair
from hybridvo.evidence.one_time import (
    is_of_one_time,
    pair_at_image_times,
    rough_motion,
)
from hybridvo.tracking.repeated import Repeat
from hybridvo.tracking.setup import Setup
from hybridvo.tracking.tracker import Query, find
from hybridvo.tracking.tracker_state import TrackerState


class InTime(NamedTuple):
    """A tracker and a frame, of which all is of one time."""

    state: TrackerState
    query: Query


def frames_at_one_time(
    setup: Setup, state: TrackerState, query: Query, repeat: Repeat
) -> InTime:
    """Bring a frame, and after a first motion the reference, to one time.

    Flow that is not computed from the images leads between the rows as they were exposed: such
    frames stay, and each of their pairs is brought to one time.

    Args:
        setup: of the tracker.
        state: of the tracker before the frame.
        query: the frame, and what is known of it.
        repeat: which parts of it are those of the frame before.

    Returns:
        The state and the query with the frames in the place of those that were taken.
    """
    frame = query.frame
    reference = state.frame
    if reference is None or query.flow is not None or not setup.computes_flow:
        return InTime(state, query)
    taken = FramePair(reference, frame, None)
    if is_of_one_time(taken):
        return InTime(state, query)
    T_near = _rough_motion(setup, state, query, repeat, taken)
    in_time = pair_at_image_times(taken, T_near)
    return InTime(
        state.starting_with(in_time.prev),
        query._replace(frame=in_time.curr, near=T_near),
    )


def _rough_motion(
    setup: Setup,
    state: TrackerState,
    query: Query,
    repeat: Repeat,
    taken: FramePair,
) -> np.ndarray:
    """(4, 4) motion from the reference to a frame as they were taken, to a few per cent.

    A repeated image corrects nothing of what is expected.
    """

    def found_in(as_they_are: FramePair) -> np.ndarray | None:
        of_prev = state.starting_with(as_they_are.prev)
        of_curr = query._replace(frame=as_they_are.curr)
        found = find(setup, of_prev, of_curr)
        if not found.motion.usable:
            return None
        return invert(found.T_world_cam) @ state.T_world_cam

    expected = query.given or state.expected()
    if expected is not None and repeat.colour:
        return expected.T_curr_prev
    return rough_motion(taken, expected, setup.options.refine, found_in)
