"""Loops: motions from places that were left long ago and are seen again.

A place is tried because it looks like the frame, and believed because of the images alone: where
the path leads is not asked, since a loop is to correct the path.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from hybridvo import pipeline
from hybridvo.core.results import Edge, RelativePose
from hybridvo.core.types import Frame, FramePair
from hybridvo.judge.findings import covering
from hybridvo.tracking.relocalization import are_apart, similar_places
from hybridvo.tracking.search import Setup
from hybridvo.tracking.tracker_state import TrackerState


def loops_to_reference(
    setup: Setup, state: TrackerState, apart: int
) -> Iterator[Edge]:
    """Yield the sure motions to the reference from places that look like it.

    Two frames at which a scene only looks alike may have one sure motion, but hardly ever the
    same one there and back.

    Args:
        setup: of the tracker.
        state: of the tracker, whose reference is the frame that came last.
        apart: so many frames before it a place was kept at least.
    """
    reference = state.known_reference
    curr = reference.frame
    latest = reference.count - apart
    places = [place for place in state.places if place.count <= latest]
    for place in similar_places(places, curr):
        there = motion_between(setup, place.frame, curr)
        if not there.ok:
            continue
        back = motion_between(setup, curr, place.frame)
        T_apart = there.T_curr_prev @ back.T_curr_prev
        if back.usable and not are_apart(curr, T_apart, np.eye(4)):
            covariance = there.covariance + covering(T_apart)
            yield Edge(place.frame.index, there.T_curr_prev, covariance)


def motion_between(setup: Setup, prev: Frame, curr: Frame) -> RelativePose:
    """The motion between two frames, of which nothing is expected."""
    evidence = setup.context.evidence(FramePair(prev, curr, None))
    return pipeline.run_method(evidence, setup.method, setup.context)
