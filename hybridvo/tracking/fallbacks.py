"""What a tracker does where no motion was found, or depth alone found it."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from hybridvo import pipeline
from hybridvo.core.geometry import chain, invert
from hybridvo.core.results import MotionPrior, RelativePose
from hybridvo.core.types import Frame, FramePair
from hybridvo.flow.providers import has_texture
from hybridvo.tracking.estimates import Estimate
from hybridvo.tracking.keyframes import has_enough_depth, is_near
from hybridvo.tracking.memory import faded
from hybridvo.tracking.relocalization import similar_places
from hybridvo.tracking.setup import Setup
from hybridvo.tracking.tracker_state import Outcome, TrackerState, advanced, step_of

if TYPE_CHECKING:
    from hybridvo.tracking.tracker import Query


# -- an earlier place --------------------------------------------------------------------


def from_place(
    setup: Setup, state: TrackerState, query: Query, best: Estimate
) -> Estimate | None:
    """The motion from a place that resembles the frame, if it is sure and no other fits.

    Where the frame has a motion already, though not a sure one, a place must show at first
    sight that it fits: looking longer cost as much as all else and never changed an answer.
    """
    tried = {best.start.count, best.reference.count}
    places = [place for place in state.places if place.count not in tried]
    fitting = []
    for place in similar_places(places, query.frame):
        # nothing is expected of the motion from there
        pair = FramePair(place.frame, query.frame, None)
        evidence = setup.context.evidence(pair)
        if best.motion.usable:
            motion = pipeline.by_first_source(evidence, setup.method, setup.context)
        else:
            motion = pipeline.run_method(
                evidence, setup.method, setup.context, query.deadline
            )
        if motion.ok:
            fitting.append(
                best._replace(
                    start=place, motion=motion, keyframes=(), is_relocalized=True
                )
            )
    if not fitting:
        return None
    surest = max(fitting, key=lambda estimate: estimate.motion.rank)
    return surest if surest.agrees_with(fitting) else None


# -- depth alone ---------------------------------------------------------------------------


def carried_by_depth(
    state: TrackerState, frame: Frame, estimate: Estimate
) -> Outcome:
    """The outcome of a frame whose image shows nothing, by depth.

    Later motions start from the frame before it as long as that is near, so that the errors
    of such steps do not add up and images are followed again as soon as there are some.
    """
    T_world_cam = estimate.T_world_cam
    last = invert(T_world_cam) @ state.T_world_last
    reference = estimate.reference
    is_far = not is_near(reference, T_world_cam, state.count)
    leads = has_enough_depth(frame) and (is_far or has_texture(frame))
    after = replace(
        state,
        motion_model=replace(state.motion_model, T_last=last),
        failed=0,
        keyframes=estimate.keyframes,
    )
    after = advanced(after, frame, T_world_cam, leads, is_sure=False)
    index = estimate.start.frame.index
    step = step_of(frame, T_world_cam, estimate.motion, index)
    return Outcome(replace(after, by_depth=True), step)


def bridged(state: TrackerState, frame: Frame, motion: RelativePose) -> Outcome:
    """The outcome of a motion from the reference that no later motion starts from."""
    assert state.frame is not None
    T_world_cam = chain(state.T_world_cam, motion.T_curr_prev)
    after = advanced(state, frame, T_world_cam, leads=False, is_sure=False)
    return Outcome(after, step_of(frame, T_world_cam, motion, state.frame.index))


# -- nothing -------------------------------------------------------------------------------


def held(
    setup: Setup,
    state: TrackerState,
    frame: Frame,
    estimate: Estimate,
    leads: bool,
) -> Outcome:
    """The outcome of a motion that failed."""
    T_world_cam, motion = fallback(setup, state, estimate.motion, estimate.given)
    is_cut = leads and estimate.given is None
    after = replace(
        state,
        failed=state.failed + 1,
        part=state.count if is_cut else state.part,
        keyframes=estimate.keyframes,
        memory=None if state.memory is None else faded(state.memory),
    )
    after = advanced(after, frame, T_world_cam, leads, is_sure=False)
    origin = estimate.reference.frame.index
    return Outcome(after, step_of(frame, T_world_cam, motion, origin))


def fallback(
    setup: Setup,
    state: TrackerState,
    failed: RelativePose,
    given: MotionPrior | None,
) -> tuple[np.ndarray, RelativePose]:
    """The pose and motion where none was found: as given, or by ``track.on_failure``."""
    if given is not None:
        T_world_cam = chain(state.T_world_cam, given.T_curr_prev)
        return T_world_cam, failed.replace(
            T_curr_prev=given.T_curr_prev, covariance=given.covariance
        )
    T_world_cam = state.T_world_last
    T_curr_prev = np.eye(4)
    covariance = failed.covariance
    ahead = state.motion_model.predict(state.gap + 1, state.failed)
    if setup.options.track.on_failure == "hold" or ahead is None:
        if state.gap:
            T_curr_prev = invert(T_world_cam) @ state.T_world_cam
    else:
        T_curr_prev = ahead.T_curr_prev
        covariance = ahead.covariance
        T_world_cam = chain(state.T_world_cam, T_curr_prev)
    return T_world_cam, failed.replace(
        T_curr_prev=T_curr_prev, covariance=covariance
    )
