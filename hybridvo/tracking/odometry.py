"""The tracker: one frame in, one step out, constant memory."""

from __future__ import annotations

import contextlib
import functools
import logging
import time
from collections.abc import Callable, Iterator, Sequence
from copy import deepcopy
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np

from hybridvo import pipeline
from hybridvo.core.belief import Belief
from hybridvo.core.checks import as_number, as_rigid, as_seed, check_kind
from hybridvo.core.errors import InputError
from hybridvo.core.geometry import (
    adjoint,
    chain,
    ego_flow,
    invert,
    se3_exp,
    se3_log,
)
from hybridvo.core.imu import ImuSamples
from hybridvo.core.options import Options
from hybridvo.core.results import MotionPrior, Reason, RelativePose, Step
from hybridvo.core.stages import stage
from hybridvo.core.types import Camera, Frame, FramePair
from hybridvo.evidence.depth_lag import depth_at_image_time
from hybridvo.evidence.pair import FlowEvidence, PairEvidence
from hybridvo.evidence.shutter import images_at_one_time
from hybridvo.flow.providers import (
    FlowAhead,
    FlowField,
    FlowProvider,
    dis_flow,
    with_flow,
)
from hybridvo.network.models import Models, default_models
from hybridvo.solver.direct import direct_near, unexplained_by
from hybridvo.tracking.accelerometer import Accelerometer
from hybridvo.tracking.calibration import (
    MAX_UNEXPLAINED,
    MIN_DEPTH_SHARE,
    SAME_MOTION,
)
from hybridvo.tracking.camera_drift import CameraDrift
from hybridvo.tracking.depth_scale import (
    ScaleFilter,
    divided,
    measured_scale,
)
from hybridvo.tracking.estimates import Estimate
from hybridvo.tracking.gyroscope import Gyroscope
from hybridvo.tracking.keyframes import (
    Keyframe,
    between_frames,
    expected_motion,
    trimmed,
)
from hybridvo.tracking.memory import Memory, carried_to, faded
from hybridvo.tracking.object_motions import Earlier, View
from hybridvo.tracking.objects import Objects
from hybridvo.tracking.objects import after_step as objects_after
from hybridvo.tracking.relocalization import similar_places, with_place
from hybridvo.tracking.repeated import (
    Repeat,
    bridge,
    is_as_good_as_new,
    repeat_of,
)
from hybridvo.tracking.tracker_state import TrackerState, in_world
from hybridvo.tracking.worlds import (
    Ahead,
    Weighed,
    learned,
    opened_by_images,
    weighed,
    with_jump,
)

_logger = logging.getLogger(__name__)
KEYFRAME_METHODS = ("hybrid", "hybrid-flow", "classical")
"""Methods whose motions may span several frames: those that search from an expected motion."""
# covariance of no motion, which a pose graph can still invert
FIRST_FRAME_COVARIANCE = 1e-12 * np.eye(6)


class _Query(NamedTuple):
    """A frame whose motion is wanted, and what is known of it."""

    frame: Frame
    # from the reference to the frame, where the caller knows it
    flow: FlowField | np.ndarray | None
    # what the caller knows of the motion from the reference
    given: MotionPrior | None
    deadline: float | None  # on the clock of time.perf_counter

    @property
    def has_flow(self) -> bool:
        """Whether the caller knows the flow."""
        return self.flow is not None

    @property
    def without_depth(self) -> _Query:
        """The same by the image of the frame alone."""
        frame = replace(self.frame, depth=None, depth_variance=None)
        return self._replace(frame=frame)


class Odometry:
    """A tracker that chains the motions of consecutive frames, in constant memory.

    A frame from which no motion can start (it has hardly any depth, or its own motion failed) is
    passed over: the next motion spans it. Where flow is computed from the images, motions are
    estimated from a keyframe some steps back and given between neighbouring frames. Where the
    path is lost, the motion is also sought from one of ten earlier places. No pose is revised.

    Args:
        network: ``default`` (pretrained), None for the classical refinement alone, the name or
            file of other PWVO weights, or Models.
        flow: a callable ``(prev, curr)`` that returns a FlowField or (H, W, 2) px; None: OpenCV's
            DIS.
        method: None: ``hybrid``, or ``classical`` without a network.
        options: the option tree.
        seed: of the search.

    Raises:
        InputError: for values of another type, and for an unknown method or network.

    Example:
        >>> import hybridvo as hvo
        >>> from hybridvo.lab.synthetic.scenes import make_scene
        >>> scene = make_scene("static", 0, height=96, width=128, frames=3)
        >>> vo = hvo.Odometry(network=None)
        >>> steps = [vo.track(scene.render(i)) for i in range(3)]
        >>> [(step.prev_index, str(step.status)) for step in steps]
        [(None, 'ok'), (0, 'ok'), (1, 'ok')]
    """

    def __init__(
        self,
        network: Models | str | None = "default",
        *,
        flow: FlowProvider | Callable[[Frame, Frame], Any] | None = None,
        method: str | None = None,
        options: Options | None = None,
        seed: int = 0,
    ) -> None:
        self.options = Options() if options is None else options
        check_kind("Odometry.options", self.options, Options)
        if flow is not None and not callable(flow):
            raise InputError(
                f"Odometry.flow: expected a callable (prev, curr), got {flow!r}."
            )
        default = "classical" if network is None else pipeline.DEFAULT_METHOD
        self.method = pipeline.check_method(method or default)
        self.seed = as_seed(seed, "Odometry.seed")
        needs_network = self.method in pipeline.NETWORKS
        device = self.options.run.device if needs_network else "cpu"
        if network is None and needs_network:
            raise InputError(
                f"Odometry: method {method!r} needs a network; use method='classical'."
            )
        if network in (None, "default"):
            network = default_models(device)
        elif not isinstance(network, Models):
            check_kind("Odometry.network", network, str)
            network = Models(device, {"pwvo": network})
            network.path("pwvo")  # refuses a name that nobody knows
        self._models = network
        self._flow = flow or dis_flow(self.options.flow.dis_preset)
        self._context = pipeline.Context(
            self.options, self._models, self._flow, self.seed
        )
        self.reset()

    def reset(self) -> None:
        """Forget everything: the next frame is the first one, at the identity."""
        self.state = TrackerState()
        self._warned_of_clock = False
        self._warned_of_focal = False

    def set_pose(self, T_world_cam: np.ndarray) -> None:
        """Set the pose of the camera, at the start or after a loop closure.

        Args:
            T_world_cam: (4, 4) camera to world, metres.

        Raises:
            InputError: for a matrix that is not rigid.
        """
        T = as_rigid(T_world_cam, "Odometry.set_pose")
        state = self.state
        # reference and keyframes keep their places relative to the last pose
        T_new_old = T @ invert(state.T_world_last)
        T_reference = T_new_old @ state.T_world_cam if state.gap else T
        self.state = replace(
            state,
            T_world_cam=T_reference,
            T_world_last=T,
            keyframes=tuple(each.moved(T_new_old) for each in state.keyframes),
            places=tuple(each.moved(T_new_old) for each in state.places),
            memory=None if state.memory is None else state.memory.moved(T_new_old),
            rivals=tuple(each.moved(T_new_old) for each in state.rivals),
            accelerometer=_moved(state.accelerometer, T_new_old),
        )

    def resume(self, state: TrackerState) -> None:
        """Go on where another tracker stopped.

        Args:
            state: the ``state`` of that tracker.

        Raises:
            InputError: for a value of another type.
        """
        check_kind("Odometry.resume", state, TrackerState)
        self.state = state

    def warm_up(self) -> None:
        """Compile and load everything before the first frame.

        It takes two or three seconds in every process. Where no kernels came with the wheel it
        takes about a minute once. Without it the first motion waits so long.
        """
        warm_up(self.method, self._models)

    def predict(self) -> MotionPrior | None:
        """Predict the motion to the next frame at constant velocity.

        Returns:
            The motion with its covariance; None before the first motion.
        """
        return self.state.motion_model.predict()

    @stage("other")
    def track(
        self,
        frame: Frame,
        flow: FlowField | np.ndarray | None = None,
        prior: MotionPrior | None = None,
        imu: ImuSamples | None = None,
    ) -> Step:
        """Track the next frame; the motion of the first one is the identity, with status ok.

        Args:
            frame: its arrays are copied.
            flow: where it is known: a FlowField or (H, W, 2) px, from ``state.frame`` to this one.
            prior: what is known of the motion from ``state.frame``, for instance by a gyroscope
                (:func:`hybridvo.gyro_prior`) or wheels; by default constant velocity. It also
                bridges a motion that fails.
            imu: samples since the frame before. Without a prior their rotation, with the velocity
                before, is what is expected; the bias of the sensor is learned from sure steps. If
                they have accelerations, the step has ``gravity``.

        Returns:
            The step, whose ``prev_index`` is the frame from which its motion starts.

        Raises:
            InputError: for what is no frame or prior; the tracker is as it was.
        """
        check_kind("Odometry.track", frame, Frame)
        if prior is not None:
            check_kind("Odometry.track: prior", prior, MotionPrior)
        check_kind("Odometry.track: imu", imu, ImuSamples, type(None))
        state = self.state
        gyroscope = state.gyroscope
        if imu is not None:
            gyroscope = (gyroscope or Gyroscope()).after(imu)
        frame = self._rolled(deepcopy(frame))
        if frame.index is None:
            frame = replace(frame, index=state.count)
        repeat = repeat_of(state.last, frame)
        clock = state.clock.after(frame.timestamp)
        breaks = state.clock.breaks_at(frame.timestamp) and not repeat.entire
        if breaks:
            self._warn_of_clock(frame.timestamp)
            self._forget_velocity()
        if gyroscope is not None and prior is None and not breaks:
            prior = self._turned(gyroscope, frame)
        query = _Query(frame, flow, prior, self._deadline())
        step = self._track(self._in_time(query), repeat)
        if breaks:
            # of a motion over an unknown time
            self._forget_velocity()
        accelerometer = self._felt(gyroscope, state, step)
        gyroscope = self._learned(gyroscope, state, step)
        self.state = replace(
            self.state,
            last=frame,
            clock=clock,
            gyroscope=gyroscope,
            accelerometer=accelerometer,
        )
        return replace(step, gravity=self.state.gravity)

    def _rolled(self, frame: Frame) -> Frame:
        """A frame with the readout that the motions so far show, where it states none."""
        camera = frame.camera
        readout_ms = self.state.camera.readout.readout_ms
        is_wanted = self.options.track.readout == "auto" and self._computes_flow()
        if not is_wanted or camera.readout_ms > 0 or readout_ms == 0:
            return frame
        return replace(frame, camera=replace(camera, readout_ms=readout_ms))

    def _in_time(self, query: _Query) -> _Query:
        """The query of a frame whose depth map is brought to the time of its image.

        How the camera moves meanwhile is what is expected of the motion.
        """
        frame = query.frame
        reference = self.state.frame
        if frame.camera.depth_lag_ms == 0 or reference is None:
            return query
        expected = query.given or self.state.expected()
        if expected is None:
            return query
        duration_s = frame.timestamp - reference.timestamp
        frame = depth_at_image_time(frame, expected.T_curr_prev, duration_s)
        return query._replace(frame=frame)

    def _turned(self, gyroscope: Gyroscope, frame: Frame) -> MotionPrior | None:
        """What a gyroscope and the velocity before let expect of the motion to a frame."""
        reference = self.state.frame
        if reference is None:
            return None
        expected = self.state.expected()
        return gyroscope.prior(reference.timestamp, frame.timestamp, expected)

    def _learned(
        self, gyroscope: Gyroscope | None, before: TrackerState, step: Step
    ) -> Gyroscope | None:
        """The gyroscope after a step, with the samples that the next one may need."""
        if gyroscope is None:
            return None
        starts = before.starts
        start = None if step.prev_index is None else starts.get(step.prev_index)
        if start is not None:
            gyroscope = gyroscope.corrected(step, start.timestamp, step.timestamp)
        reference = self.state.frame
        return (
            gyroscope if reference is None else gyroscope.since(reference.timestamp)
        )

    def _felt(
        self, gyroscope: Gyroscope | None, before: TrackerState, step: Step
    ) -> Accelerometer | None:
        """The accelerometer after a step, whose samples the gyroscope holds; None without one."""
        known = before.accelerometer
        leads = self.state.gap == 0
        if known is not None and self.state.part != before.part:
            # a piece of path that nothing ties to the one before
            known = known.elsewhere()
        elif known is not None and leads:
            # the next motion starts here, with the error of this one
            known = known.drifted(step)
        if gyroscope is None or gyroscope.samples.accelerations is None:
            return known
        known = known or Accelerometer()
        return known.after(gyroscope.samples, gyroscope.bias, step, leads)

    def _warn_of_clock(self, stamp: float) -> None:
        """Log once that the stamps do not rise."""
        if self._warned_of_clock:
            return
        self._warned_of_clock = True
        _logger.warning(
            "Odometry.track: the stamp %.6f s does not come after %.6f s, that of the "
            "frame before: no velocity is known there; check the clock of the camera",
            stamp,
            self.state.clock.stamp,
        )

    def _forget_velocity(self) -> None:
        """Expect nothing of the next motion."""
        model = replace(self.state.motion_model, T_last=None)
        self.state = replace(self.state, motion_model=model)

    def _track(self, query: _Query, repeat: Repeat) -> Step:
        """The step of a frame, of which ``repeat`` is that of the frame before."""
        if self.state.frame is None:
            return self._first_step(query.frame)
        bridged = self._bridge(query, repeat)
        if bridged is not None:
            return bridged
        if self._scales(query.frame):
            return self._track_scaled(query)
        estimate = self._estimate(query)
        return self._step(query.frame, estimate, query.has_flow)

    def _bridge(self, query: _Query, repeat: Repeat) -> Step | None:
        """The step of a frame of which a part is an old one, by the part that is fresh.

        None where nothing is repeated, or the camera may as well have stood still. No later
        motion starts from such a frame: image and depth do not belong together.
        """
        if repeat.depth and not repeat.colour:
            return self._step_by_images(query, repeat)
        if not repeat.colour:
            return None
        frame = query.frame
        depth_is_fresh = not (repeat.depth or self._scales(frame))
        motion = bridge(self.state, frame, query.given, repeat, depth_is_fresh)
        return None if motion is None else self._bridged_step(frame, motion)

    def _step_by_images(self, query: _Query, repeat: Repeat) -> Step | None:
        """The step of a frame whose depth is an old one, by its image.

        None where that depth is what the frame must show, as where the camera stands.
        """
        frame = query.frame
        without_depth = query.without_depth
        estimate = self._estimate(without_depth)
        if not estimate.motion.usable:
            given = query.given
            motion = bridge(self.state, frame, given, repeat, depth_is_fresh=False)
            return None if motion is None else self._bridged_step(frame, motion)
        step = invert(estimate.T_world_cam) @ self.state.T_world_last
        if is_as_good_as_new(frame, step):
            return None
        estimate = estimate._replace(motion=repeat.marked(estimate.motion))
        # flow from elsewhere leads from each frame to the next one
        started = frame if query.has_flow else without_depth.frame
        return self._step(started, estimate, query.has_flow)

    def _bridged_step(self, frame: Frame, motion: RelativePose) -> Step:
        """The step of a motion from the reference that no later motion starts from."""
        state = self.state
        assert state.frame is not None
        T_world_cam = chain(state.T_world_cam, motion.T_curr_prev)
        self._advance(frame, T_world_cam, leads=False, is_sure=False)
        return Step(
            frame.index,
            frame.timestamp,
            T_world_cam.copy(),
            motion.replace(method=self.method),
            state.frame.index,
        )

    def _step(self, frame: Frame, estimate: Estimate, has_flow: bool) -> Step:
        """The step of an estimate; ``has_flow``: the next flow starts from this frame."""
        leads = has_flow or self._becomes_reference(
            frame, estimate.motion, self.state.gap
        )
        if estimate.motion.usable:
            return self._follow(frame, estimate, leads)
        return self._lose(frame, estimate, leads)

    def _scales(self, frame: Frame) -> bool:
        """Whether a frame's depth is brought to the scale of the trajectory."""
        mode = self.options.depth.scale_per_frame
        if mode == "auto":
            return frame.depth_source == "network"
        return mode == "on"

    def _track_scaled(self, query: _Query) -> Step:
        """Track a frame whose depth has a scale of its own.

        The first motion comes from the earlier frame's depth alone, in whose scale it is. With the
        scale that the static pixels then show, both depth maps take part in the second one.
        """
        frame = query.frame
        estimate = self._estimate(query.without_depth)
        scale = measured_scale(estimate.start.frame, frame, estimate.motion)
        if scale is not None:
            frame = divided(frame, scale)
            again = self._estimate(query._replace(frame=frame))
            more = measured_scale(again.start.frame, frame, again.motion)
            # unless two depth maps of one scale make it less sure
            if more is not None and again.motion.ok >= estimate.motion.ok:
                estimate = again
                scale *= more
                frame = divided(frame, more)
        before = self.state.scale
        step = self._step(frame, estimate, query.has_flow)
        if scale is None:
            # the next motion may start from this frame, in its own scale
            self.state = replace(self.state, scale=ScaleFilter())
            return step
        change = scale**before.gain
        state = self.state.rescaled(change)
        self.state = replace(state, scale=before.observed())
        return replace(step, depth_scale=scale, scale_change=change)

    def _first_step(self, frame: Frame) -> Step:
        """The step of the first frame: no motion."""
        state = self.state
        T = state.T_world_last
        motion = RelativePose(
            covariance=FIRST_FRAME_COVARIANCE.copy(), method=self.method
        )
        keyframes: tuple[Keyframe, ...] = ()
        if self._spans_frames() and frame.rgb is not None and has_depth(frame):
            exact = np.zeros((6, 6))
            keyframes = (Keyframe(frame, T, state.count, state.count, exact),)
        self.state = TrackerState(
            frame,
            T,
            T,
            count=state.count + 1,
            keyframes=keyframes,
            places=keyframes,
        )
        return Step(frame.index, frame.timestamp, T.copy(), motion, None)

    def _estimate(self, query: _Query) -> Estimate:
        """The motion to a frame from a keyframe, from the reference, or from a place.

        The images alone are tried from every start, then flow, then sparse matches. A place is
        tried where the path is lost.
        """
        reference = self._reference()
        keyframes = self._near_keyframes(query, reference)
        starts = [reference]
        if keyframes and keyframes[0].count < reference.count:
            starts.insert(0, keyframes[0])
        best = self._first_sure(query, starts, keyframes)
        # of a path that was lost since: only where no other place fits as well
        if best.start.count < self.state.part <= reference.count:
            best = best._replace(is_relocalized=True)
            if not self._is_the_only_one(query, best):
                best = self._first_sure(query, [reference], keyframes)
        # a place costs as much as the frame did
        is_over = pipeline.is_late(query.deadline)
        if query.flow is None and self._is_lost(best.motion) and not is_over:
            return self._from_place(query, best) or best
        return best

    def _near_keyframes(
        self, query: _Query, reference: Keyframe
    ) -> tuple[Keyframe, ...]:
        """The keyframes that are near enough to the frame to be kept, oldest first."""
        if query.flow is not None or not self._spans_frames():
            return ()
        keyframes = self.state.keyframes
        if query.frame.rgb is None:
            return keyframes
        T_ahead = reference.T_world_cam
        expected = self._expected(query, reference)
        if expected is not None:
            T_ahead = chain(T_ahead, expected.T_curr_prev)
        return trimmed(keyframes, T_ahead, self.state.count)

    def _expected(self, query: _Query, start: Keyframe) -> MotionPrior | None:
        """What is known of the motion from a start: as given, or by constant velocity."""
        state = self.state
        expected = query.given or state.motion_model.predict(state.gap + 1)
        if expected is None:
            return None
        T_ref_start = invert(state.T_world_cam) @ start.T_world_cam
        return expected_motion(expected, T_ref_start)

    def _first_sure(
        self,
        query: _Query,
        starts: Sequence[Keyframe],
        keyframes: tuple[Keyframe, ...],
    ) -> Estimate:
        """The first sure motion from some starts, each source tried from all of them."""
        with self.flow_ahead(starts[0].frame, query.frame, query.flow) as flow:
            context = replace(self._context, flow=flow)
            pairs = [self._evidence(query, start, context) for start in starts]

            def tied(answer: pipeline.Answer) -> pipeline.Answer | None:
                return self._tied(query.frame, starts, pairs[0], answer)

            answer = pipeline.first_sure(
                pairs, self.method, context, query.deadline, tied
            )
        return Estimate(
            starts[answer.number],
            answer.motion,
            self._reference(),
            keyframes,
            query.given,
        )

    def _tied(
        self,
        frame: Frame,
        starts: Sequence[Keyframe],
        of_keyframe: PairEvidence,
        answer: pipeline.Answer,
    ) -> pipeline.Answer | None:
        """The same motion from a keyframe, where the images gave it from a later start.

        So the errors of neighbouring frames do not add up, and an object that moves by less than
        the noise of one step does not lead the path away. From the keyframe the images must
        lead to the same place and leave little of their texture unexplained. None where they do
        not.
        """
        motion = answer.motion
        keyframe = starts[0]
        start = starts[answer.number]
        if answer.number == 0 or "flow" in motion.terms:
            return answer
        T_start_key = invert(start.T_world_cam) @ keyframe.T_world_cam
        T_near = motion.T_curr_prev @ T_start_key
        pair = FramePair(keyframe.frame, frame, None)
        pair = images_at_one_time(pair, T_near)
        belief = of_keyframe.ready_belief
        tied = direct_near(pair, T_near, self.options.refine, belief)
        if tied is None or unexplained_by(tied) > MAX_UNEXPLAINED:
            return None
        A = adjoint(motion.T_curr_prev)
        of_start = A @ start.covariance @ A.T
        covariance = motion.covariance + of_start + tied.covariance
        apart = se3_log(tied.T_curr_prev @ invert(T_near))
        if apart @ np.linalg.solve(covariance, apart) > SAME_MOTION:
            return None
        return pipeline.Answer(0, tied.replace(probability=motion.probability))

    def _evidence(
        self, query: _Query, start: Keyframe, context: pipeline.Context
    ) -> PairEvidence:
        """What can be measured of the pair of a start and the frame."""
        pair = FramePair(start.frame, query.frame, None)
        if query.flow is not None:
            pair = with_flow(pair, lambda *_: query.flow, "given")
        # with images, a method computes flow only if it needs it
        elif query.frame.rgb is None:
            pair = with_flow(pair, context.flow)
        expected = None
        if self.options.track.motion_prior:
            expected = self._expected(query, start)
        return context.evidence(pair, expected, remember=self._remember(start))

    @contextlib.contextmanager
    def flow_ahead(
        self, prev: Frame, curr: Frame, given: Any = None
    ) -> Iterator[FlowProvider]:
        """Yield the provider of flow, which works on a pair already where that will be needed.

        Args:
            prev: the frame from which the motion will probably be estimated.
            curr: the frame to come.
            given: the flow of the two where the caller knows it: then none is computed.

        Returns:
            A context in which the provider may be called for any pair.
        """
        # a callable of the user's may not be called from another thread
        is_expected = self.state.used_flow and self._computes_flow()
        is_needed = given is None and self.method == "hybrid"
        if not (is_expected and is_needed):
            yield self._flow
            return
        with FlowAhead(self._flow, prev, curr) as ahead:
            yield ahead

    def _deadline(self) -> float | None:
        """When the time of a frame is over, on the clock of ``time.perf_counter``."""
        budget_ms = self.options.track.budget_ms
        return time.perf_counter() + budget_ms / 1000 if budget_ms else None

    def _is_lost(self, motion: RelativePose) -> bool:
        """Whether neither this motion nor that of the frame before is sure."""
        if motion.ok or not self._spans_frames():
            return False
        was_unsure = not self.state.is_sure or self.state.failed > 0
        return not motion.usable or was_unsure

    def _from_place(self, query: _Query, best: Estimate) -> Estimate | None:
        """The motion from a place that resembles a frame, if it is sure and no other fits."""
        fitting = self._from_places(query, best)
        if not fitting:
            return None
        surest = max(fitting, key=lambda estimate: estimate.motion.rank)
        return surest if surest.agrees_with(fitting) else None

    def _is_the_only_one(self, query: _Query, estimate: Estimate) -> bool:
        """Whether a motion is sure, and no place fits from which the pose is another one."""
        if not estimate.motion.ok:
            return False
        return estimate.agrees_with(self._from_places(query, estimate))

    def _from_places(self, query: _Query, estimate: Estimate) -> list[Estimate]:
        """The sure motions from places that resemble a frame; those tried already left out."""
        tried = {estimate.start.count, estimate.reference.count}
        places = [p for p in self.state.places if p.count not in tried]
        fitting = []
        for place in similar_places(places, query.frame):
            pair = FramePair(place.frame, query.frame, None)
            motion = pipeline.run_method(
                self._context.evidence(pair),
                self.method,
                self._context,
                query.deadline,
            )
            if motion.ok:
                found = estimate._replace(
                    start=place, motion=motion, keyframes=(), is_relocalized=True
                )
                fitting.append(found)
        return fitting

    def _follow(self, frame: Frame, estimate: Estimate, leads: bool) -> Step:
        """The step of a motion that was found."""
        given = estimate
        outcome = self._weighed(frame, estimate, leads)
        estimate = outcome.estimate
        rivals = outcome.rivals
        if outcome.changed is not None:
            self.state = in_world(self.state, outcome.changed)
        state = self.state
        start = estimate.start
        motion = estimate.motion
        T_world_cam = estimate.T_world_cam
        keyframes = estimate.keyframes
        places = state.places
        part = state.part
        if estimate.is_relocalized and start.count < part:
            # poses since the path was lost are relative to an unknown one
            keyframes = tuple(k for k in keyframes if k.count < part)
            places = tuple(p for p in places if p.count < part)
            part = 0
        can_start = frame.rgb is not None and has_depth(frame)
        if leads and motion.ok and self._spans_frames() and can_start:
            new = Keyframe(
                frame, T_world_cam, state.count, start.count, motion.covariance
            )
            keyframes = (*keyframes, new)
            places = with_place(places, new)
            rivals = tuple(each.with_keyframe(new) for each in rivals)

        # between neighbours, unless the pose of the frame before is uncertain
        origin = start
        is_sure = state.is_sure and not estimate.is_relocalized
        if start.count < estimate.reference.count and is_sure:
            origin = estimate.reference
            motion = between_frames(motion, start, origin)

        spanned = state.count - origin.count
        one_frame = motion.T_curr_prev
        if spanned > 1:
            one_frame = se3_exp(se3_log(one_frame) / spanned)
        follows = spanned == 1 and not state.failed
        model = state.motion_model.observed(one_frame, follows)
        if estimate.is_relocalized:
            # the velocity is unknown
            model = replace(state.motion_model, T_last=None)
        objects = self._objects_after(frame, estimate, leads)
        self.state = replace(
            state,
            motion_model=model,
            failed=0,
            things=objects.things,
            part=part,
            keyframes=keyframes,
            places=places,
            used_flow="flow" in motion.terms,
            camera=self._camera_after(frame, estimate, origin, motion),
            memory=self._memory_after(frame, estimate, bool(rivals)),
            rivals=rivals,
        )
        self._advance(frame, T_world_cam, leads, motion.ok)
        if outcome.changed is not None:
            was = given.start if origin is start else given.reference
            motion = with_jump(motion, invert(origin.T_world_cam) @ was.T_world_cam)
        return Step(
            frame.index,
            frame.timestamp,
            T_world_cam.copy(),
            motion,
            origin.frame.index,
            objects=objects.seen,
        )

    def _objects_after(
        self, frame: Frame, estimate: Estimate, leads: bool
    ) -> Objects:
        """What moves by itself after a motion that was found, from the frame before on."""
        things = self.state.things
        reference = estimate.reference
        is_wanted = self.options.track.objects == "auto" and leads
        frames = (frame, reference.frame)
        lacks = any(each.rgb is None or each.depth is None for each in frames)
        if not is_wanted or lacks or estimate.is_relocalized:
            return Objects(things, ())
        T_cam_world = invert(estimate.T_world_cam)
        starts = (*estimate.keyframes, estimate.start)
        oldest = min(starts, key=lambda keyframe: keyframe.count)
        far = None
        if oldest.count < reference.count and oldest.frame.depth is not None:
            far = Earlier(oldest.frame, T_cam_world @ oldest.T_world_cam)
        before = Earlier(reference.frame, T_cam_world @ reference.T_world_cam)
        view = View(frame, before, far, estimate.motion.depth_noise)
        passed = self.state.count - reference.count
        return objects_after(things, view, passed, self.options, self.seed)

    def _weighed(self, frame: Frame, estimate: Estimate, leads: bool) -> Weighed:
        """The world to be followed after a frame, and those beside it while that is open."""
        state = self.state
        starts = (estimate.start.frame, estimate.home.frame)
        lacks = any(each.rgb is None or each.depth is None for each in starts)
        if not self._remembers() or estimate.is_relocalized or lacks:
            return Weighed(estimate)
        memory = state.memory
        # at the first of the frames that do without flow
        is_believed = "memory" in estimate.motion.terms and state.used_flow
        if is_believed and memory is not None:
            ahead = self._ahead(estimate.start, leads)
            return opened_by_images(memory, frame, state.count, estimate, ahead)
        return weighed(state.rivals, memory, frame, state.count, estimate, leads)

    def _ahead(self, start: Keyframe, leads: bool) -> Ahead:
        """What is known beforehand of a frame after a start."""
        state = self.state
        T_curr_start = None
        expected = state.motion_model.predict(state.gap + 1)
        if expected is not None:
            T_ref_start = invert(state.T_world_cam) @ start.T_world_cam
            T_curr_start = expected.T_curr_prev @ T_ref_start
        return Ahead(T_curr_start, self.options.refine, leads)

    def _memory_after(
        self, frame: Frame, estimate: Estimate, is_open: bool
    ) -> Memory | None:
        """What is remembered after a motion that was found."""
        if not self._remembers() or estimate.is_relocalized:
            return None
        home = estimate.home.frame
        if home.depth is None or home.rgb is None:
            return self.state.memory
        return learned(self.state.memory, frame, estimate, is_open)

    def _camera_after(
        self,
        frame: Frame,
        estimate: Estimate,
        origin: Keyframe,
        step: RelativePose,
    ) -> CameraDrift:
        """What is known of the camera after a motion, and the step from a frame that it made.

        It is logged once where the focal length is off.
        """
        before = self.state.camera
        known = before.with_span(estimate.start.frame, frame, estimate.motion)
        known = known.with_step(origin.frame, frame, step)
        if known.focal.is_off and not self._warned_of_focal:
            self._warned_of_focal = True
            _logger.warning("Odometry: %s", known.focal.message)
        return known

    def _lose(self, frame: Frame, estimate: Estimate, leads: bool) -> Step:
        """The step of a motion that failed."""
        state = self.state
        T_world_cam, motion = self._fallback_motion(
            state, estimate.motion, estimate.given
        )
        self.state = replace(
            state,
            failed=state.failed + 1,
            part=state.count if leads and estimate.given is None else state.part,
            keyframes=estimate.keyframes,
            memory=None if state.memory is None else faded(state.memory),
            rivals=(),
        )
        self._advance(frame, T_world_cam, leads, is_sure=False)
        origin = estimate.reference
        return Step(
            frame.index,
            frame.timestamp,
            T_world_cam.copy(),
            motion,
            origin.frame.index,
        )

    def _advance(
        self, frame: Frame, T_world_cam: np.ndarray, leads: bool, is_sure: bool
    ) -> None:
        """Count a frame, and make it the reference if it leads."""
        state = replace(
            self.state, T_world_last=T_world_cam, count=self.state.count + 1
        )
        if leads:
            self.state = replace(
                state, frame=frame, T_world_cam=T_world_cam, gap=0, is_sure=is_sure
            )
        else:
            self.state = replace(state, gap=state.gap + 1)

    def _computes_flow(self) -> bool:
        """Whether flow is computed from the images, as it can be between any two frames."""
        return getattr(self._flow, "source", "") == "dis"

    def _spans_frames(self) -> bool:
        """Whether motions may be estimated over several frames."""
        return (
            self._computes_flow()
            and self.method in KEYFRAME_METHODS
            and self.options.track.keyframes == "auto"
        )

    def _remember(self, start: Keyframe) -> Callable[[], Belief] | None:
        """Returns what is believed of the view of a start, when it is called; None: nothing."""
        memory = self.state.memory
        has_pixels = start.frame.depth is not None and start.frame.rgb is not None
        if memory is None or not has_pixels or not self._remembers():
            return None
        if self.state.rivals:
            # while a question is open it takes flow to settle it
            memory = memory.with_certainty(0.0)
        return lambda: carried_to(memory, start).belief

    def _remembers(self) -> bool:
        """Whether what was static is remembered."""
        is_wanted = self.options.track.memory == "auto"
        return is_wanted and self.method == "hybrid" and self._spans_frames()

    def _reference(self) -> Keyframe:
        """The frame before as the start of a motion; what its own covariance was is not kept."""
        state = self.state
        assert state.frame is not None
        count = state.count - state.gap - 1
        if state.keyframes and state.keyframes[-1].count == count:
            return state.keyframes[-1]
        unknown = np.zeros((6, 6))
        return Keyframe(state.frame, state.T_world_cam, count, count, unknown)

    def _becomes_reference(
        self, frame: Frame, found: RelativePose, gap: int
    ) -> bool:
        """Whether the next motion starts from this frame: it has depth, and it was matched."""
        if not has_depth(frame):
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
        return matched or gap > 0 or not self._computes_flow()

    def skip(
        self,
        index: int,
        timestamp: float,
        message: str = "",
        reason: Reason = Reason.MISSING_FRAME,
        prior: MotionPrior | None = None,
    ) -> Step:
        """Pass over a frame that could not be read; the next motion spans it.

        Args:
            index: number of the frame.
            timestamp: seconds.
            message: why it could not be read.
            reason: the same as a reason.
            prior: what is known of the motion from ``state.frame``, which bridges this one.

        Returns:
            The step, whose motion failed.

        Raises:
            InputError: for an index or a timestamp that is no number, and for what is no prior.
        """
        check_kind("Odometry.skip: prior", prior, MotionPrior, type(None))
        if as_number(index) % 1 or not np.isfinite(as_number(timestamp)):
            got = f"{index!r}, {timestamp!r}"
            raise InputError(
                f"Odometry.skip: expected an index and finite seconds, got {got}."
            )
        state = self.state
        why = message or "the frame cannot be read"
        motion = RelativePose.failed(reason, why, self.method)
        T = state.T_world_last
        gap = state.gap
        if state.frame is not None:
            T, motion = self._fallback_motion(state, motion, prior)
            gap += 1
        self.state = replace(
            state,
            T_world_last=T,
            gap=gap,
            count=state.count + 1,
            clock=state.clock.after(timestamp),
        )
        prev_index = None if state.frame is None else state.frame.index
        return Step(int(index), timestamp, T.copy(), motion, prev_index)

    def _fallback_motion(
        self,
        state: TrackerState,
        failed: RelativePose,
        given: MotionPrior | None = None,
    ) -> tuple[Any, RelativePose]:
        """The pose and motion where none was found: as given, or by ``track.on_failure``."""
        if given is not None:
            T_world_cam = chain(state.T_world_cam, given.T_curr_prev)
            return T_world_cam, failed.replace(
                T_curr_prev=given.T_curr_prev, covariance=given.covariance
            )
        T_world_cam = state.T_world_last
        T_curr_prev = np.eye(4)
        covariance = failed.covariance
        ahead = state.motion_model.predict(state.gap + 1)
        if self.options.track.on_failure == "hold" or ahead is None:
            if state.gap:
                T_curr_prev = invert(T_world_cam) @ state.T_world_cam
        else:
            # the velocity may change with every motion that fails
            T_curr_prev = ahead.T_curr_prev
            covariance = (state.failed + 1) * ahead.covariance
            T_world_cam = chain(state.T_world_cam, T_curr_prev)
        return T_world_cam, failed.replace(
            T_curr_prev=T_curr_prev, covariance=covariance
        )


def _moved(
    accelerometer: Accelerometer | None, T_new_old: np.ndarray
) -> Accelerometer | None:
    """What is known of an accelerometer in another world, if anything is."""
    return None if accelerometer is None else accelerometer.moved(T_new_old)


def has_depth(frame: Frame) -> bool:
    """Whether a motion can start from a frame: enough of its pixels have depth."""
    if frame.depth is None:
        return False
    valid = (frame.depth > 0) & np.isfinite(frame.depth)
    return bool(np.count_nonzero(valid) >= MIN_DEPTH_SHARE * valid.size)


@functools.cache
def warm_up(
    method: str = pipeline.DEFAULT_METHOD, models: Models | None = None
) -> None:
    """Compile and load everything that a method needs: a minute once, seconds after that.

    The cache of the kernels reports on the logger ``hybridvo`` when it compiles.
    """
    context = pipeline.Context(models=models or default_models())
    # the second takes the parallel kernels
    for height, width in ((48, 64), (320, 400)):
        camera = Camera(
            width, width, (width - 1) / 2, (height - 1) / 2, height, width
        )
        u = np.arange(width)
        v = np.arange(height)[:, None]
        wave = np.sin(u / 7.0) + np.cos(v / 5.0)
        depth = 4.0 + wave
        rgb = (100 + 40 * wave)[..., None].repeat(3, 2).astype(np.uint8)
        motion = se3_exp(np.array([0.02, -0.01, 0.05, 0.002, 0.004, -0.003]))
        flow = ego_flow(depth, motion, camera, camera)
        # one motion alone, and noise: an unambiguous pair
        noisy = flow + 0.05 * np.random.default_rng(0).normal(size=flow.shape)
        # a mask, a variance and a second motion, so that every branch is compiled
        flow[: height // 3, : width // 3] += 3.0
        frame = Frame(rgb, depth, camera)
        pair = FramePair(frame, frame, flow)
        full = replace(pair, flow_variance=0.01 * depth, flow_valid=depth > 0)
        for each in (full, pair):
            pipeline.run_method(context.evidence(each), method, context)
        if method.startswith("hybrid"):  # what only few pairs need
            pipeline.by_images(context.evidence(replace(pair, flow_source="dis")))
            of_noise = FlowEvidence(
                replace(pair, flow=noisy), context.evidence(pair)
            )
            pipeline.look_at(of_noise, context)
