"""A frame in, the tracker's next state and the frame's step out.

Read this file after :mod:`hybridvo.pipeline`: the two hold all that decides. :func:`find` seeks the
motion to a frame from a keyframe some steps back and from the frame before; what is tried on each
of these pairs stands in the pipeline. :func:`keep` says what follows from the motion: the pose,
keyframes, what was static. What is done where a motion fails stands in
:mod:`hybridvo.tracking.fallbacks`, frames that are not what they seem in
:mod:`hybridvo.tracking.following`.
"""

from __future__ import annotations

import contextlib
import functools
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from hybridvo import pipeline
from hybridvo.core.belief import Belief
from hybridvo.core.geometry import chain, invert, se3_exp, se3_log
from hybridvo.core.results import Edge, MotionPrior, Reason, RelativePose, Term
from hybridvo.core.types import Frame, FramePair
from hybridvo.evidence.pair import PairEvidence
from hybridvo.flow.providers import FlowAhead, FlowField, FlowProvider, with_flow
from hybridvo.solver.rotation_factor import with_rotation
from hybridvo.tracking.estimates import Estimate
from hybridvo.tracking.fallbacks import carried_by_depth, from_place, held
from hybridvo.tracking.gyroscope import Gyroscope
from hybridvo.tracking.keyframes import (
    Keyframe,
    between_frames,
    expected_motion,
    has_enough_depth,
    trimmed,
)
from hybridvo.tracking.memory import Memory, carried_to, memory_after
from hybridvo.tracking.motion_model import MotionModel
from hybridvo.tracking.relocalization import with_place
from hybridvo.tracking.setup import Setup
from hybridvo.tracking.tracker_state import Outcome, TrackerState, advanced, step_of

if TYPE_CHECKING:
    from hybridvo.tracking.objects import Objects

# covariance of no motion, which a pose graph can still invert
FIRST_FRAME_COVARIANCE = 1e-12 * np.eye(6)


class Query(NamedTuple):
    """A frame whose motion is wanted, and what is known of it."""

    frame: Frame
    # from the reference to the frame, where the caller knows it
    flow: FlowField | np.ndarray | None
    # what the caller knows of the motion from the reference
    given: MotionPrior | None
    deadline: float | None  # on the clock of time.perf_counter
    gyroscope: Gyroscope | None = None  # with the samples up to the frame
    # (4, 4) motion from the reference as the most reduced images show it
    near: np.ndarray | None = None

    @property
    def without_depth(self) -> Query:
        """The same by the image of the frame alone."""
        frame = replace(self.frame, depth=None, depth_variance=None)
        return self._replace(frame=frame)


# -- the core --------------------------------------------------------------------------


def find(setup: Setup, state: TrackerState, query: Query) -> Estimate:
    """Find the motion to a frame.

    Args:
        setup: of the tracker.
        state: of the tracker, after the frame before.
        query: the frame.

    Returns:
        The first sure motion from a keyframe or from the frame before, each source of motions
        tried from both; where none is sure and the path is lost, that from an earlier place; else
        the surest.
    """
    pairs = Pairs(setup, state, query)
    with pairs.flow_ahead() as flow:
        context = replace(setup.context, flow=flow)
        evidence = [pairs.evidence(start, context) for start in pairs.starts]
        number, motion = pipeline.first_sure(
            evidence, setup.method, context, query.deadline
        )
    start = pairs.starts[number]
    motion = pairs.with_turn(motion, start.frame)
    found = Estimate(start, motion, pairs.reference, pairs.keyframes, query.given)
    # a place costs as much as the frame did
    is_over = pipeline.is_late(query.deadline)
    if query.flow is None and pairs.is_lost(motion) and not is_over:
        return from_place(setup, state, query, found) or found
    return found


def keep(
    setup: Setup,
    state: TrackerState,
    frame: Frame,
    estimate: Estimate,
    has_flow: bool,
) -> Outcome:
    """Say what follows from a motion that was sought.

    Args:
        setup: of the tracker.
        state: of the tracker before the frame.
        frame: the current one.
        estimate: the motion to it.
        has_flow: whether the next flow starts from this frame.

    Returns:
        The next state, and the step of the frame.
    """
    found = estimate.motion
    if found.is_by_depth_alone:
        return carried_by_depth(state, frame, estimate)
    leads = has_flow or becomes_reference(setup, frame, found, state.gap)
    if not found.usable:
        return held(setup, state, frame, estimate, leads)
    origin = origin_of(state, estimate)
    motion = found
    measured = None
    if origin is not estimate.start:
        motion = between_frames(found, estimate.start, origin)
        start = estimate.start.frame.index
        measured = Edge(start, found.T_curr_prev, found.covariance)
    objects = moving_objects(setup, state, frame, estimate) if leads else None
    after = with_keyframe(
        setup, known_path(state, estimate), frame, estimate, leads
    )
    after = replace(
        after,
        motion_model=velocity_after(state, estimate, origin, motion),
        failed=0,
        things=state.things if objects is None else objects.things,
        used_flow=Term.FLOW in motion.terms,
        memory=learned(setup, state, frame, estimate),
    )
    T_world_cam = estimate.T_world_cam
    after = advanced(after, frame, T_world_cam, leads, motion.ok)
    step = step_of(frame, T_world_cam, motion, origin.frame.index, objects)
    return Outcome(after, replace(step, measured=measured))


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


# -- the pairs in which a motion is sought -----------------------------------------------


@dataclass(frozen=True, eq=False)
class Pairs:
    """The pairs of a frame and an earlier one, and what is known of each.

    Attributes:
        setup: of the tracker.
        state: of the tracker, after the frame before.
        query: the frame.
    """

    setup: Setup
    state: TrackerState
    query: Query

    @functools.cached_property
    def starts(self) -> list[Keyframe]:
        """From where a motion is sought: the oldest keyframe in use, then the reference."""
        if self.keyframes and self.keyframes[0].count < self.reference.count:
            return [self.keyframes[0], self.reference]
        return [self.reference]

    @functools.cached_property
    def reference(self) -> Keyframe:
        """The frame before; the covariance of its own motion is kept only if it is a keyframe."""
        state = self.state
        assert state.frame is not None
        count = state.count - state.gap - 1
        if state.keyframes and state.keyframes[-1].count == count:
            return state.keyframes[-1]
        unknown = np.zeros((6, 6))
        return Keyframe(state.frame, state.T_world_cam, count, count, unknown)

    @functools.cached_property
    def keyframes(self) -> tuple[Keyframe, ...]:
        """The keyframes that are near enough to the frame to be kept, oldest first."""
        if self.query.flow is not None or not self.setup.spans_frames:
            return ()
        keyframes = self.state.keyframes
        if self.query.frame.rgb is None:
            return keyframes
        T_ahead = self.reference.T_world_cam
        expected = self._expected_from(self.reference)
        if expected is not None:
            T_ahead = chain(T_ahead, expected.T_curr_prev)
        return trimmed(keyframes, T_ahead, self.state.count)

    def _expected_from(self, start: Keyframe) -> MotionPrior | None:
        """What is known of the motion from a start: as given, or by constant velocity."""
        expected = self._expected
        if expected is None:
            return None
        T_ref_start = invert(self.state.T_world_cam) @ start.T_world_cam
        return expected_motion(expected, T_ref_start)

    @functools.cached_property
    def _expected(self) -> MotionPrior | None:
        """What is known of the motion from the reference."""
        state = self.state
        ahead = state.motion_model.predict(state.gap + 1)
        if state.gap and state.by_depth:
            # from where the frame before was found
            ahead = state.expected()
        return self.query.given or ahead

    def evidence(self, start: Keyframe, context: pipeline.Context) -> PairEvidence:
        """What can be measured of the pair of a start and the frame."""
        frame = self.query.frame
        pair = FramePair(start.frame, frame, None)
        if self.query.flow is not None:
            pair = with_flow(pair, lambda *_: self.query.flow, "given")
        # with images, a method computes flow only if it needs it
        elif frame.rgb is None:
            pair = with_flow(pair, context.flow)
        expected = None
        if self.setup.options.track.motion_prior:
            expected = self._expected_from(start)
        near = None
        if self.query.near is not None:
            T_ref_start = invert(self.state.T_world_cam) @ start.T_world_cam
            near = self.query.near @ T_ref_start
        return context.evidence(
            pair, expected, remember=self._remember(start), near=near
        )

    def _remember(self, start: Keyframe) -> Callable[[], Belief] | None:
        """Returns what is believed of the view of a start, when it is called; None: nothing."""
        memory = self.state.memory
        if memory is None or not start.frame.is_rgbd or not self.setup.remembers:
            return None
        return lambda: carried_to(memory, start).belief

    @contextlib.contextmanager
    def flow_ahead(self) -> Iterator[FlowProvider | None]:
        """Yield the provider of flow, which works on the first pair already if that is needed.

        Returns:
            A context in which the provider may be called for any pair.
        """
        flow = self.setup.context.flow
        # a callable of the user's may not be called from another thread
        is_expected = self.state.used_flow and self.setup.computes_flow
        is_needed = self.query.flow is None and self.setup.method == "hybrid"
        if flow is None or not (is_expected and is_needed):
            yield flow
            return
        with FlowAhead(flow, self.starts[0].frame, self.query.frame) as ahead:
            yield ahead

    def with_turn(self, motion: RelativePose, start: Frame) -> RelativePose:
        """A motion with the rotation that a gyroscope measured since a frame, if there is one.

        What rests on depth alone has it already, as what was expected.
        """
        gyroscope = self.query.gyroscope
        is_ours = pipeline.method_of(self.setup.method).is_verified
        is_found = motion.usable and not motion.is_by_depth_alone
        if gyroscope is None or not (is_ours and is_found):
            return motion
        measured = gyroscope.measured(start.timestamp, self.query.frame.timestamp)
        return motion if measured is None else with_rotation(motion, measured)

    def is_lost(self, motion: RelativePose) -> bool:
        """Whether neither this motion nor that of the frame before is sure."""
        if motion.ok or not self.setup.spans_frames:
            return False
        was_unsure = not self.state.is_sure or self.state.failed > 0
        return not motion.usable or was_unsure


# -- what follows from a motion ------------------------------------------------------------


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


def origin_of(state: TrackerState, estimate: Estimate) -> Keyframe:
    """The frame that the step starts from: the one before, if its pose is believed."""
    is_earlier = estimate.start.count < estimate.reference.count
    is_sure = state.is_sure and not estimate.is_relocalized
    return estimate.reference if is_earlier and is_sure else estimate.start


def velocity_after(
    state: TrackerState, estimate: Estimate, origin: Keyframe, motion: RelativePose
) -> MotionModel:
    """What is expected of the next motion, after one from the origin of the step."""
    if estimate.is_relocalized:
        # the velocity is unknown
        return replace(state.motion_model, T_last=None)
    spanned = state.count - origin.count
    one_frame = motion.T_curr_prev
    if spanned > 1:
        one_frame = se3_exp(se3_log(one_frame) / spanned)
    follows = spanned == 1 and not state.failed
    return state.motion_model.observed(one_frame, follows)


def known_path(state: TrackerState, estimate: Estimate) -> TrackerState:
    """The state with the keyframes and places whose poses are known relative to the frame."""
    after = replace(state, keyframes=estimate.keyframes)
    if estimate.start.count >= state.part:
        return after
    # poses since the path was lost are relative to an unknown one
    return replace(
        after,
        keyframes=tuple(k for k in after.keyframes if k.count < state.part),
        places=tuple(p for p in after.places if p.count < state.part),
        part=0,
    )


def with_keyframe(
    setup: Setup,
    state: TrackerState,
    frame: Frame,
    estimate: Estimate,
    leads: bool,
) -> TrackerState:
    """The state with the frame as a keyframe, if its motion is sure and one may start there."""
    motion = estimate.motion
    is_wanted = leads and motion.ok and setup.spans_frames
    if not is_wanted or frame.rgb is None or not has_enough_depth(frame):
        return state
    new = Keyframe(
        frame,
        estimate.T_world_cam,
        state.count,
        estimate.start.count,
        motion.covariance,
    )
    return replace(
        state,
        keyframes=(*state.keyframes, new),
        places=with_place(state.places, new),
    )


def learned(
    setup: Setup, state: TrackerState, frame: Frame, estimate: Estimate
) -> Memory | None:
    """What is remembered after a frame; None: nothing."""
    if not setup.remembers or estimate.is_relocalized:
        return None
    if not estimate.home.frame.is_rgbd:
        return state.memory
    return memory_after(state.memory, frame, estimate)


def moving_objects(
    setup: Setup, state: TrackerState, frame: Frame, estimate: Estimate
) -> Objects | None:
    """What moves by itself, from the frame before on; None where that is not sought."""
    reference = estimate.reference
    if setup.options.track.objects != "auto" or estimate.is_relocalized:
        return None
    if not (frame.is_rgbd and reference.frame.is_rgbd):
        return None
    from hybridvo.tracking import objects
    from hybridvo.tracking.object_motions import Earlier, GridView

    T_cam_world = invert(estimate.T_world_cam)
    starts = (*estimate.keyframes, estimate.start)
    oldest = min(starts, key=lambda keyframe: keyframe.count)
    far = None
    if oldest.count < reference.count and oldest.frame.depth is not None:
        far = Earlier(oldest.frame, T_cam_world @ oldest.T_world_cam)
    before = Earlier(reference.frame, T_cam_world @ reference.T_world_cam)
    view = GridView(frame, before, far, estimate.motion.depth_noise)
    passed = state.count - reference.count
    context = setup.context
    return objects.after_step(
        state.things, view, passed, context.options, context.seed
    )
