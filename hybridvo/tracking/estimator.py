"""The motion to a frame: from which earlier frames it is sought, and which answer is believed.

The pairs are those of the frame and a keyframe some steps back, the frame and the one before, and,
where the path is lost, the frame and earlier places. What is tried on a pair stands in
:mod:`hybridvo.pipeline`.
"""

from __future__ import annotations

import contextlib
import functools
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from hybridvo import pipeline
from hybridvo.core.belief import Belief
from hybridvo.core.geometry import chain, invert
from hybridvo.core.results import MotionPrior, RelativePose
from hybridvo.core.types import Frame, FramePair
from hybridvo.evidence.pair import PairEvidence
from hybridvo.flow.providers import (
    FlowAhead,
    FlowField,
    FlowProvider,
    with_flow,
)
from hybridvo.solver.rotation_factor import with_rotation
from hybridvo.tracking.estimates import Estimate
from hybridvo.tracking.gyroscope import Gyroscope
from hybridvo.tracking.keyframes import Keyframe, expected_motion, trimmed
from hybridvo.tracking.memory import carried_to
from hybridvo.tracking.relocalization import similar_places
from hybridvo.tracking.setup import Setup
from hybridvo.tracking.tracker_state import TrackerState


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


@dataclass(frozen=True, eq=False)
class Estimator:
    """Finds the motion to a frame.

    Attributes:
        setup: how.
        state: of the tracker, after the frame before.
        query: the frame.
    """

    setup: Setup
    state: TrackerState
    query: Query

    def estimate(self) -> Estimate:
        """The motion to the frame from a keyframe, from the reference, or from a place.

        The images alone are tried from every start, then flow, then sparse matches. A place is
        tried where the path is lost.
        """
        reference = self._reference
        keyframes = self._near_keyframes()
        starts = [reference]
        if keyframes and keyframes[0].count < reference.count:
            starts.insert(0, keyframes[0])
        best = self._first_sure(starts, keyframes)
        # a place costs as much as the frame did
        is_over = pipeline.is_late(self.query.deadline)
        if self.query.flow is None and self._is_lost(best.motion) and not is_over:
            return self._from_place(best) or best
        return best

    @functools.cached_property
    def _reference(self) -> Keyframe:
        """The frame before; the covariance of its own motion is kept only if it is a keyframe."""
        state = self.state
        assert state.frame is not None
        count = state.count - state.gap - 1
        if state.keyframes and state.keyframes[-1].count == count:
            return state.keyframes[-1]
        unknown = np.zeros((6, 6))
        return Keyframe(state.frame, state.T_world_cam, count, count, unknown)

    def _near_keyframes(self) -> tuple[Keyframe, ...]:
        """The keyframes that are near enough to the frame to be kept, oldest first."""
        if self.query.flow is not None or not self.setup.spans_frames:
            return ()
        keyframes = self.state.keyframes
        if self.query.frame.rgb is None:
            return keyframes
        T_ahead = self._reference.T_world_cam
        expected = self._expected_from(self._reference)
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

    # -- the first sure motion ---------------------------------------------------------

    def _first_sure(
        self, starts: Sequence[Keyframe], keyframes: tuple[Keyframe, ...]
    ) -> Estimate:
        """The first sure motion from some starts, each source tried from all of them."""
        with self.flow_ahead(starts[0].frame) as flow:
            context = replace(self.setup.context, flow=flow)
            pairs = [self._evidence(start, context) for start in starts]
            answer = pipeline.first_sure(
                pairs, self.setup.method, context, self.query.deadline
            )
        start = starts[answer.number]
        return Estimate(
            start,
            self._with_turn(answer.motion, start.frame),
            self._reference,
            keyframes,
            self.query.given,
        )

    def _with_turn(self, motion: RelativePose, start: Frame) -> RelativePose:
        """A motion with the rotation that a gyroscope measured since a frame, if there is one.

        What rests on depth alone has it already, as what was expected.
        """
        gyroscope = self.query.gyroscope
        is_ours = self.setup.method in pipeline.VERIFIED
        is_found = motion.usable and not motion.is_by_depth_alone
        if gyroscope is None or not (is_ours and is_found):
            return motion
        measured = gyroscope.measured(start.timestamp, self.query.frame.timestamp)
        return motion if measured is None else with_rotation(motion, measured)

    @contextlib.contextmanager
    def flow_ahead(self, prev: Frame) -> Iterator[FlowProvider | None]:
        """Yield the provider of flow, which works on a pair already where that will be needed.

        Args:
            prev: the frame from which the motion will probably be estimated.

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
        with FlowAhead(flow, prev, self.query.frame) as ahead:
            yield ahead

    def _evidence(self, start: Keyframe, context: pipeline.Context) -> PairEvidence:
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

    # -- earlier places ----------------------------------------------------------------

    def _is_lost(self, motion: RelativePose) -> bool:
        """Whether neither this motion nor that of the frame before is sure."""
        if motion.ok or not self.setup.spans_frames:
            return False
        was_unsure = not self.state.is_sure or self.state.failed > 0
        return not motion.usable or was_unsure

    def _from_place(self, best: Estimate) -> Estimate | None:
        """The motion from a place that resembles the frame, if it is sure and no other fits.

        Where the frame has a motion already, though not a sure one, a place must show at first
        sight that it fits: looking longer cost as much as all else and never changed an answer.
        """
        fitting = self._from_places(best, by_first_source=best.motion.usable)
        if not fitting:
            return None
        surest = max(fitting, key=lambda estimate: estimate.motion.rank)
        return surest if surest.agrees_with(fitting) else None

    def _from_places(
        self, estimate: Estimate, by_first_source: bool = False
    ) -> list[Estimate]:
        """The sure motions from places that resemble the frame; those tried already left out."""
        tried = {estimate.start.count, estimate.reference.count}
        places = [p for p in self.state.places if p.count not in tried]
        fitting = []
        for place in similar_places(places, self.query.frame):
            motion = self._from_frame(place.frame, by_first_source)
            if motion.ok:
                found = estimate._replace(
                    start=place,
                    motion=motion,
                    keyframes=(),
                    is_relocalized=True,
                )
                fitting.append(found)
        return fitting

    def _from_frame(self, earlier: Frame, by_first_source: bool) -> RelativePose:
        """The motion from an earlier frame, of which nothing is expected."""
        context = self.setup.context
        pair = FramePair(earlier, self.query.frame, None)
        evidence = context.evidence(pair)
        method = self.setup.method
        if by_first_source:
            return pipeline.by_first_source(evidence, method, context)
        return pipeline.run_method(evidence, method, context, self.query.deadline)
