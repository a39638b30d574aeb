"""The motion to a frame: between which frames it is sought, and what is known of it beforehand.

What is tried on each of these pairs stands in :mod:`hybridvo.pipeline`.
"""

from __future__ import annotations

import contextlib
import functools
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from hybridvo import pipeline
from hybridvo.core.geometry import chain, invert
from hybridvo.core.options import Options
from hybridvo.core.results import MotionPrior, RelativePose, Term
from hybridvo.core.types import Frame, FramePair
from hybridvo.core.unchecked import changed
from hybridvo.evidence.pair import PairEvidence
from hybridvo.evidence.remembered import Remembered
from hybridvo.flow.providers import FlowAhead, FlowField, FlowProvider, with_flow
from hybridvo.solver.rotation_factor import with_rotation
from hybridvo.tracking.gyroscope import Gyroscope
from hybridvo.tracking.keyframes import Keyframe, expected_motion, trimmed
from hybridvo.tracking.memory import remembered_at
from hybridvo.tracking.relocalization import are_apart, similar_places
from hybridvo.tracking.repeated import Repeat
from hybridvo.tracking.tracker_state import TrackerState

KEYFRAME_METHODS = ("hybrid", "hybrid-flow", "classical")
"""Methods whose motions may span several frames: those that search from an expected motion."""


@dataclass(frozen=True, eq=False)
class Setup:
    """How a tracker finds motions: what stays the same from frame to frame.

    Attributes:
        method: one of :data:`hybridvo.pipeline.METHODS`.
        context: options, networks and flow.
    """

    method: str
    context: pipeline.Context

    @property
    def options(self) -> Options:
        """The option tree."""
        return self.context.options

    @property
    def computes_flow(self) -> bool:
        """Whether flow is computed from the images, as it can be between any two frames."""
        return getattr(self.context.flow, "source", "") == "dis"

    @property
    def spans_frames(self) -> bool:
        """Whether motions may be estimated over several frames."""
        return (
            self.computes_flow
            and self.method in KEYFRAME_METHODS
            and self.options.track.keyframes == "auto"
        )

    @property
    def remembers(self) -> bool:
        """Whether what was static is remembered."""
        is_wanted = self.options.track.memory == "auto"
        return is_wanted and self.method == "hybrid" and self.spans_frames

    def has_own_scale(self, frame: Frame) -> bool:
        """Whether a frame's depth has a scale of its own, unlike that of the trajectory."""
        mode = self.options.depth.scale_per_frame
        if mode == "auto":
            return frame.depth_source == "network"
        return mode == "on"


class Arrival(NamedTuple):
    """A frame whose motion is wanted, and what is known of it."""

    frame: Frame
    # from the reference to the frame, where the caller knows it
    flow: FlowField | np.ndarray | None = None
    # what the caller knows of the motion from the reference
    given: MotionPrior | None = None
    deadline: float | None = None  # on the clock of time.perf_counter
    gyroscope: Gyroscope | None = None  # with the samples up to the frame
    # (4, 4) motion from the reference as the most reduced images show it
    near: np.ndarray | None = None
    repeat: Repeat = Repeat()  # which parts of it are those of the frame before
    following: Frame | None = None  # the frame after it, where that is known

    @property
    def without_depth(self) -> Arrival:
        """The same by the image of the frame alone."""
        frame = changed(self.frame, depth=None, depth_variance=None)
        return self._replace(frame=frame)


class Estimate(NamedTuple):
    """A motion to the current frame, and what it was estimated from.

    Attributes:
        start: the motion is from there.
        motion: from ``start`` to the frame.
        keyframes: those that are near enough to be kept, oldest first.
        is_relocalized: whether the path was lost since ``start``.
    """

    start: Keyframe
    motion: RelativePose
    keyframes: tuple[Keyframe, ...]
    is_relocalized: bool = False

    @property
    def T_world_cam(self) -> np.ndarray:
        """(4, 4) pose of the current frame."""
        return chain(self.start.T_world_cam, self.motion.T_curr_prev)

    def agrees_with(self, others: Iterable[Estimate]) -> bool:
        """Whether all others put the current frame in the same place."""
        here = self.T_world_cam
        return not any(
            are_apart(self.start.frame, here, other.T_world_cam) for other in others
        )


def find(setup: Setup, state: TrackerState, arrival: Arrival) -> Estimate:
    """Find the motion to a frame.

    Args:
        setup: of the tracker.
        state: of the tracker, after the frame before.
        arrival: the frame.

    Returns:
        The first sure motion from a keyframe or from the frame before, each source of motions
        tried from both; where none is sure and the path is lost, that from an earlier place; else
        the surest.
    """
    pairs = Pairs(setup, state, arrival)
    with pairs.flow_ahead() as flow:
        context = replace(setup.context, flow=flow)
        evidence = [pairs.evidence(start, context) for start in pairs.starts]
        number, motion = pipeline.first_sure(
            evidence, setup.method, context, arrival.deadline
        )
    start = pairs.starts[number]
    motion = pairs.with_turn(motion, start.frame)
    found = Estimate(start, motion, pairs.keyframes)
    # a place costs as much as the frame did
    is_over = pipeline.is_late(arrival.deadline)
    if arrival.flow is None and pairs.is_lost(motion) and not is_over:
        return (
            from_place(setup, state, arrival, found)
            or from_failed(setup, state, arrival)
            or found
        )
    return found


@dataclass(frozen=True, eq=False)
class Pairs:
    """The pairs of a frame and an earlier one, and what is known of each.

    Attributes:
        setup: of the tracker.
        state: of the tracker, after the frame before.
        arrival: the frame.
    """

    setup: Setup
    state: TrackerState
    arrival: Arrival

    @functools.cached_property
    def starts(self) -> list[Keyframe]:
        """From where a motion is sought: the oldest keyframe in use, then the reference."""
        reference = self.state.known_reference
        if self.keyframes and self.keyframes[0].count < reference.count:
            return [self.keyframes[0], reference]
        return [reference]

    @functools.cached_property
    def keyframes(self) -> tuple[Keyframe, ...]:
        """The keyframes that are near enough to the frame to be kept, oldest first."""
        if self.arrival.flow is not None or not self.setup.spans_frames:
            return ()
        keyframes = self.state.keyframes
        if self.arrival.frame.rgb is None:
            return keyframes
        reference = self.state.known_reference
        T_ahead = reference.T_world_cam
        expected = self._expected_from(reference)
        if expected is not None:
            T_ahead = chain(T_ahead, expected.T_curr_prev)
        # nothing was seen of the scene since it is hidden
        seen = self.state.count - self.state.hidden
        return trimmed(keyframes, T_ahead, seen)

    def _T_ref_start(self, start: Keyframe) -> np.ndarray:
        """(4, 4) motion from a start to the reference."""
        reference = self.state.known_reference
        return invert(reference.T_world_cam) @ start.T_world_cam

    def _expected_from(self, start: Keyframe) -> MotionPrior | None:
        """What is known of the motion from a start: as given, or by constant velocity."""
        expected = self._expected
        if expected is None:
            return None
        return expected_motion(expected, self._T_ref_start(start))

    @functools.cached_property
    def _expected(self) -> MotionPrior | None:
        """What is known of the motion from the reference."""
        state = self.state
        ahead = state.motion_model.predict(state.gap + 1)
        if state.gap and state.is_by_depth:
            # from where the frame before was found
            ahead = state.expected()
        return self.arrival.given or ahead

    def evidence(self, start: Keyframe, context: pipeline.Context) -> PairEvidence:
        """What can be measured of the pair of a start and the frame."""
        frame = self.arrival.frame
        pair = FramePair(start.frame, frame, None)
        if self.arrival.flow is not None:
            pair = with_flow(pair, lambda *_: self.arrival.flow, "given")
        # with images, a method computes flow only if it needs it
        elif frame.rgb is None:
            pair = with_flow(pair, context.flow)
        expected = None
        if self.setup.options.track.motion_prior:
            expected = self._expected_from(start)
        near = self.arrival.near
        if near is not None:
            near = near @ self._T_ref_start(start)
        if self._asks_for_a_look:
            context = context.looking
        return context.evidence(
            pair, expected, remembered=self._remembered(start), near=near
        )

    @property
    def _asks_for_a_look(self) -> bool:
        """Whether nothing is known of the scene."""
        memory = self.state.memory
        is_known = memory is not None and memory.belief.is_ready
        is_free = self.setup.options.direct.mode == "auto"
        return is_free and self.setup.remembers and not is_known

    def _remembered(self, start: Keyframe) -> Remembered | None:
        """What is remembered, for the view of a start; None: nothing."""
        memory = self.state.memory
        if memory is None or not start.frame.is_rgbd or not self.setup.remembers:
            return None
        return remembered_at(memory, start)

    @contextlib.contextmanager
    def flow_ahead(self) -> Iterator[FlowProvider | None]:
        """Yield the provider of flow, which works on the first pair already if that is needed.

        Returns:
            A context in which the provider may be called for any pair.
        """
        flow = self.setup.context.flow
        # a callable of the user's may not be called from another thread
        is_expected = Term.FLOW in self.state.found_by and self.setup.computes_flow
        is_needed = self.arrival.flow is None and self.setup.method == "hybrid"
        if flow is None or not (is_expected and is_needed):
            yield flow
            return
        with FlowAhead(flow, self.starts[0].frame, self.arrival.frame) as ahead:
            yield ahead

    def with_turn(self, motion: RelativePose, start: Frame) -> RelativePose:
        """A motion with the rotation that a gyroscope measured since a frame, if there is one.

        What rests on depth alone has it already, as what was expected.
        """
        gyroscope = self.arrival.gyroscope
        is_ours = pipeline.method_of(self.setup.method).is_verified
        is_found = motion.usable and not motion.is_by_depth_alone
        if gyroscope is None or not (is_ours and is_found):
            return motion
        end = self.arrival.frame.timestamp
        measured = gyroscope.measured(start.timestamp, end)
        return motion if measured is None else with_rotation(motion, measured)

    def is_lost(self, motion: RelativePose) -> bool:
        """Whether neither this motion nor that of the frame before is sure."""
        if motion.ok or not self.setup.spans_frames:
            return False
        state = self.state
        is_sure = state.known_reference.is_sure
        was_unsure = not is_sure or state.motion_model.failed > 0
        return not motion.usable or was_unsure


def from_failed(
    setup: Setup, state: TrackerState, arrival: Arrival
) -> Estimate | None:
    """The motion from a frame to which none was found, if it is sure.

    The step to that frame may have been too wide; the one over both frames is wider still.
    """
    if state.failed is None:
        return None
    pair = FramePair(state.failed.frame, arrival.frame, None)
    motion = pipeline.run_method(
        setup.context.evidence(pair), setup.method, setup.context, arrival.deadline
    )
    return Estimate(state.failed, motion, ()) if motion.ok else None


def from_place(
    setup: Setup, state: TrackerState, arrival: Arrival, best: Estimate
) -> Estimate | None:
    """The motion from a place that resembles the frame, if it is sure and no other fits.

    Where the frame has a motion already, though not a sure one, a place must show at first
    sight that it fits: looking longer cost as much as all else and never changed an answer.
    """
    tried = {best.start.count, state.known_reference.count}
    places = [place for place in state.places if place.count not in tried]
    fitting = []
    for place in similar_places(places, arrival.frame):
        # nothing is expected of the motion from there
        pair = FramePair(place.frame, arrival.frame, None)
        evidence = setup.context.evidence(pair)
        if best.motion.usable and not state.hidden:
            motion = pipeline.by_first_source(evidence, setup.method, setup.context)
        else:
            motion = pipeline.run_method(
                evidence, setup.method, setup.context, arrival.deadline
            )
        if motion.ok:
            fitting.append(Estimate(place, motion, (), is_relocalized=True))
    if not fitting:
        return None
    surest = max(fitting, key=lambda estimate: estimate.motion.rank)
    return surest if surest.agrees_with(fitting) else None
