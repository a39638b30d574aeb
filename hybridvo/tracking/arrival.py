"""What a tracker knows and states after a frame: its next state, and the frame's step."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from hybridvo.core.geometry import chain, invert, se3_exp, se3_log
from hybridvo.core.results import Edge, MotionPrior, Reason, RelativePose, Step
from hybridvo.core.types import Frame
from hybridvo.flow.providers import has_texture
from hybridvo.tracking.estimates import Estimate
from hybridvo.tracking.keyframes import (
    Keyframe,
    between_frames,
    has_enough_depth,
    is_near,
)
from hybridvo.tracking.memory import Memory, faded, memory_after
from hybridvo.tracking.motion_model import MotionModel
from hybridvo.tracking.relocalization import with_place
from hybridvo.tracking.setup import Setup
from hybridvo.tracking.tracker_state import TrackerState

if TYPE_CHECKING:
    from hybridvo.tracking.objects import Objects

# covariance of no motion, which a pose graph can still invert
FIRST_FRAME_COVARIANCE = 1e-12 * np.eye(6)


class Outcome(NamedTuple):
    """What follows from a frame."""

    state: TrackerState
    step: Step


def of_first_frame(setup: Setup, state: TrackerState, frame: Frame) -> Outcome:
    """The outcome of the first frame: no motion."""
    T = state.T_world_last
    motion = RelativePose(
        covariance=FIRST_FRAME_COVARIANCE.copy(), method=setup.method
    )
    keyframes: tuple[Keyframe, ...] = ()
    if setup.spans_frames and frame.rgb is not None and has_enough_depth(frame):
        exact = np.zeros((6, 6))
        keyframes = (Keyframe(frame, T, state.count, state.count, exact),)
    after = TrackerState(
        frame,
        T,
        T,
        count=state.count + 1,
        keyframes=keyframes,
        places=keyframes,
    )
    return Outcome(after, step_of(frame, T, motion, None))


def bridged(state: TrackerState, frame: Frame, motion: RelativePose) -> Outcome:
    """The outcome of a motion from the reference that no later motion starts from."""
    assert state.frame is not None
    T_world_cam = chain(state.T_world_cam, motion.T_curr_prev)
    after = advanced(state, frame, T_world_cam, leads=False, is_sure=False)
    return Outcome(after, step_of(frame, T_world_cam, motion, state.frame.index))


def advanced(
    state: TrackerState,
    frame: Frame,
    T_world_cam: np.ndarray,
    leads: bool,
    is_sure: bool,
) -> TrackerState:
    """Return a state that counts a frame, and makes it the reference if it leads."""
    state = replace(
        state, T_world_last=T_world_cam, count=state.count + 1, by_depth=False
    )
    if not leads:
        return replace(state, gap=state.gap + 1)
    return replace(
        state, frame=frame, T_world_cam=T_world_cam, gap=0, is_sure=is_sure
    )


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


def step_of(
    frame: Frame,
    T_world_cam: np.ndarray,
    motion: RelativePose,
    prev_index: int | None,
    objects: Objects | None = None,
) -> Step:
    """The step of a frame, with a copy of its pose (4, 4)."""
    seen = () if objects is None else objects.seen
    return Step(
        frame.index,
        frame.timestamp,
        T_world_cam.copy(),
        motion,
        prev_index,
        objects=seen,
    )


def after_estimate(
    setup: Setup,
    state: TrackerState,
    frame: Frame,
    estimate: Estimate,
    has_flow: bool,
) -> Outcome:
    """The outcome of a frame whose motion was sought.

    Args:
        setup: of the tracker.
        state: of the tracker before the frame.
        frame: the current one.
        estimate: the motion to it.
        has_flow: whether the next flow starts from this frame.
    """
    if estimate.motion.is_by_depth_alone:
        return carried_by_depth(state, frame, estimate)
    leads = has_flow or becomes_reference(setup, frame, estimate.motion, state.gap)
    arrival = Arrival(setup, state, frame, estimate, leads)
    return arrival.followed() if estimate.motion.usable else arrival.lost()


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


def _known_before(state: TrackerState, count: int) -> TrackerState:
    """The state with only those keyframes and places that are earlier than a frame's number."""
    return replace(
        state,
        keyframes=tuple(k for k in state.keyframes if k.count < count),
        places=tuple(p for p in state.places if p.count < count),
    )


def becomes_reference(
    setup: Setup, frame: Frame, found: RelativePose, gap: int
) -> bool:
    """Whether the next motion starts from this frame: it has depth, and it was matched."""
    if not has_enough_depth(frame):
        return False
    if frame.rgb is None and found.status.reason is Reason.NO_FLOW:
        return False
    # the frame before is what cannot be used
    is_unusable = found.status.reason in (
        Reason.NO_VALID_DEPTH,
        Reason.DEPTH_UNIT,
    )
    matched = found.usable or is_unusable
    # after two failures the camera may be far away; flow from files cannot span a frame
    return matched or gap > 0 or not setup.computes_flow


@dataclass(frozen=True, eq=False)
class Arrival:
    """A frame and the motion to it.

    Attributes:
        setup: of the tracker.
        state: of the tracker before the frame.
        frame: the current one.
        estimate: the motion to it.
        leads: whether the next motion starts from it.
    """

    setup: Setup
    state: TrackerState
    frame: Frame
    estimate: Estimate
    leads: bool

    def lost(self) -> Outcome:
        """The outcome of a motion that failed."""
        state = self.state
        estimate = self.estimate
        T_world_cam, motion = fallback(
            self.setup, state, estimate.motion, estimate.given
        )
        is_cut = self.leads and estimate.given is None
        state = replace(
            state,
            failed=state.failed + 1,
            part=state.count if is_cut else state.part,
            keyframes=estimate.keyframes,
            memory=None if state.memory is None else faded(state.memory),
        )
        after = advanced(state, self.frame, T_world_cam, self.leads, is_sure=False)
        origin = estimate.reference.frame.index
        return Outcome(after, step_of(self.frame, T_world_cam, motion, origin))

    def followed(self) -> Outcome:
        """The outcome of a motion that was found."""
        estimate = self.estimate
        motion = self._motion()
        T_world_cam = estimate.T_world_cam
        objects = self._objects()
        state = self._with_path()
        new = self._new_keyframe()
        if new is not None:
            state = replace(
                state,
                keyframes=(*state.keyframes, new),
                places=with_place(state.places, new),
            )
        state = replace(
            state,
            motion_model=self._motion_model(motion),
            failed=0,
            things=state.things if objects is None else objects.things,
            used_flow="flow" in motion.terms,
            memory=self._memory(),
        )
        after = advanced(state, self.frame, T_world_cam, self.leads, motion.ok)
        origin = self._origin.frame.index
        step = step_of(self.frame, T_world_cam, motion, origin, objects)
        return Outcome(after, replace(step, measured=self._measured()))

    # -- the motion from the frame before ------------------------------------------------

    @cached_property
    def _origin(self) -> Keyframe:
        """The frame that the step starts from: the one before, if its pose is believed."""
        estimate = self.estimate
        is_earlier = estimate.start.count < estimate.reference.count
        is_sure = self.state.is_sure and not estimate.is_relocalized
        if is_earlier and is_sure:
            return estimate.reference
        return estimate.start

    def _motion(self) -> RelativePose:
        """The motion from the origin of the step."""
        estimate = self.estimate
        origin = self._origin
        if origin is estimate.start:
            return estimate.motion
        return between_frames(estimate.motion, estimate.start, origin)

    def _measured(self) -> Edge | None:
        """The motion from the keyframe, where the step does not start there."""
        start = self.estimate.start
        if self._origin is start:
            return None
        motion = self.estimate.motion
        return Edge(start.frame.index, motion.T_curr_prev, motion.covariance)

    def _motion_model(self, motion: RelativePose) -> MotionModel:
        """What is expected of the next motion, after one from the origin."""
        state = self.state
        if self.estimate.is_relocalized:
            # the velocity is unknown
            return replace(state.motion_model, T_last=None)
        spanned = state.count - self._origin.count
        one_frame = motion.T_curr_prev
        if spanned > 1:
            one_frame = se3_exp(se3_log(one_frame) / spanned)
        follows = spanned == 1 and not state.failed
        return state.motion_model.observed(one_frame, follows)

    # -- the path so far -----------------------------------------------------------------

    def _with_path(self) -> TrackerState:
        """The state with the keyframes and places whose poses are known relative to the frame."""
        estimate = self.estimate
        state = replace(self.state, keyframes=estimate.keyframes)
        start = estimate.start.count
        if start >= state.part:
            return state
        # poses since the path was lost are relative to an unknown one
        return replace(_known_before(state, state.part), part=0)

    def _new_keyframe(self) -> Keyframe | None:
        """The frame as a keyframe, if its motion is sure and a later one may start there."""
        motion = self.estimate.motion
        can_start = self.frame.rgb is not None and has_enough_depth(self.frame)
        is_wanted = self.leads and motion.ok and self.setup.spans_frames
        if not (is_wanted and can_start):
            return None
        return Keyframe(
            self.frame,
            self.estimate.T_world_cam,
            self.state.count,
            self.estimate.start.count,
            motion.covariance,
        )

    # -- what was seen -------------------------------------------------------------------

    def _memory(self) -> Memory | None:
        """What is remembered."""
        estimate = self.estimate
        if not self.setup.remembers or estimate.is_relocalized:
            return None
        if not estimate.home.frame.is_rgbd:
            return self.state.memory
        return memory_after(self.state.memory, self.frame, estimate)

    def _objects(self) -> Objects | None:
        """What moves by itself, from the frame before on; None where that is not sought."""
        estimate = self.estimate
        reference = estimate.reference
        is_wanted = self.setup.options.track.objects == "auto" and self.leads
        if not is_wanted or estimate.is_relocalized:
            return None
        if not (self.frame.is_rgbd and reference.frame.is_rgbd):
            return None
        from hybridvo.tracking import objects
        from hybridvo.tracking.object_motions import Earlier, View

        T_cam_world = invert(estimate.T_world_cam)
        starts = (*estimate.keyframes, estimate.start)
        oldest = min(starts, key=lambda keyframe: keyframe.count)
        far = None
        if oldest.count < reference.count and oldest.frame.depth is not None:
            far = Earlier(oldest.frame, T_cam_world @ oldest.T_world_cam)
        before = Earlier(reference.frame, T_cam_world @ reference.T_world_cam)
        view = View(self.frame, before, far, estimate.motion.depth_noise)
        passed = self.state.count - reference.count
        context = self.setup.context
        return objects.after_step(
            self.state.things, view, passed, context.options, context.seed
        )
