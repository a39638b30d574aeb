"""The tracker of a camera: one frame in, one step out, constant memory."""

from __future__ import annotations

import functools
import logging
import time
from collections.abc import Callable
from copy import deepcopy
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np

from hybridvo import pipeline
from hybridvo.core.checks import as_number, as_rigid, as_seed, check_kind
from hybridvo.core.errors import InputError
from hybridvo.core.geometry import ego_flow, invert, se3_exp
from hybridvo.core.imu import ImuSamples
from hybridvo.core.options import Options
from hybridvo.core.results import (
    Edge,
    MotionPrior,
    Reason,
    RelativePose,
    Step,
    StepMotion,
)
from hybridvo.core.stages import stage
from hybridvo.core.types import Camera, Frame, FramePair
from hybridvo.core.unchecked import changed
from hybridvo.evidence.one_time import states_times
from hybridvo.evidence.pair import FlowEvidence
from hybridvo.flow.providers import (
    FlowField,
    FlowProvider,
    dis_flow,
)
from hybridvo.network.models import Models, default_models
from hybridvo.tracking.accelerometer import Accelerometer
from hybridvo.tracking.camera_drift import Mean
from hybridvo.tracking.gyroscope import Gyroscope
from hybridvo.tracking.loops import loops_to_reference
from hybridvo.tracking.readout import ReadoutFinder, Taken, surely_ms
from hybridvo.tracking.repeated import repeat_of
from hybridvo.tracking.search import Arrival, Setup
from hybridvo.tracking.step import fallback, follow
from hybridvo.tracking.tracker_state import Sensors, TrackerState

_logger = logging.getLogger(__name__)


class _Asked(NamedTuple):
    """A frame, and what is known of the motion to it."""

    frame: Frame
    prior: MotionPrior | None
    imu: ImuSamples | None


class _Given(NamedTuple):
    """A frame whose step was given, and what it takes to find that once more."""

    known: tuple[Any, ...]  # before it
    asked: _Asked
    is_stated: bool  # the times of its pixels, by its camera


class Tracker:
    """What :class:`hybridvo.Odometry` tracks with: the camera alone, not what else moves.

    Its arguments and errors are those of that class.
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
        needs_network = bool(pipeline.method_of(self.method).networks)
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
        provider = flow or dis_flow(self.options.flow.dis_preset)
        self._context = pipeline.Context(self.options, network, provider, self.seed)
        self.reset()

    def __repr__(self) -> str:
        x, y, z = self.state.T_world_last[:3, 3]
        place = f"at [{x:.4f} {y:.4f} {z:.4f}] m"
        frames = f"{self.state.count} frames"
        return f"{type(self).__name__}({self.method}, {frames}, {place})"

    def reset(self) -> None:
        """Forget everything: the next frame is the first one, at the identity."""
        self.state = TrackerState()
        self._warned_of_clock = False
        self._given_once: _Given | None = None
        self._readout = ReadoutFinder()

    def set_pose(self, T_world_cam: np.ndarray) -> None:
        """Set the pose of the camera, at the start or after a loop closure.

        Args:
            T_world_cam: (4, 4) camera to world, metres.

        Raises:
            InputError: for a matrix that is not rigid.
        """
        T = as_rigid(T_world_cam, "Odometry.set_pose")
        once = self._given_once
        if once is not None:
            before, *rest = once.known
            T_now_before = invert(self.state.T_world_last) @ before.T_world_last
            known = (before.moved(T @ T_now_before), *rest)
            self._given_once = once._replace(known=known)
        self.state = self.state.moved(T)

    def resume(self, state: TrackerState) -> None:
        """Go on where another tracker stopped.

        Args:
            state: the ``state`` of that tracker.

        Raises:
            InputError: for a value of another type.
        """
        check_kind("Odometry.resume", state, TrackerState)
        self.state = state
        self._given_once = None

    @property
    def _known(self) -> tuple[Any, ...]:
        """All that a later step depends on: what :meth:`resume` takes."""
        return (self.state,)

    @property
    def readout(self) -> Mean | None:
        """What ``track.lag`` has found of the readout, ms; None: too little."""
        return self._readout.mean()

    @property
    def readout_ms(self) -> float:
        """How long the rows of an image surely take, ms, as ``track.lag`` finds it; else 0."""
        return surely_ms(self.readout)

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
        following: Frame | None = None,
    ) -> Step:
        """Track the next frame; the motion of the first one is the identity, with status ok.

        Args:
            frame: its arrays are copied.
            flow: where it is known: a FlowField or (H, W, 2) px, from ``state.frame`` to this one.
            prior: what is known of the motion from ``state.frame``, for instance by a gyroscope
                (:func:`hybridvo.gyro_prior`) or wheels; by default constant velocity. It also
                bridges a motion that fails.
            imu: samples since the frame before. Without a prior their rotation, with the velocity
                before, is what is expected. It also takes part in the motion that is found, by
                its covariance; the bias of the sensor is learned from sure steps. If they have
                accelerations, the step has ``gravity``.
            following: the frame after it, where that is known. Where the camera states times of
                its pixels (``readout_ms``, ``depth_lag_ms``), it shows the velocity at this one.

        Returns:
            The step, whose ``prev_index`` is the frame from which its motion starts. With
            ``track.lag``, its ``corrected`` is the step of the frame before once more.

        Raises:
            InputError: for what is no frame or prior; the tracker is as it was.
        """
        check_kind("Odometry.track", frame, Frame)
        if prior is not None:
            check_kind("Odometry.track: prior", prior, MotionPrior)
        check_kind("Odometry.track: imu", imu, ImuSamples, type(None))
        check_kind("Odometry.track: following", following, Frame, type(None))
        frame = deepcopy(frame)
        if self.options.track.lag and flow is None and following is None:
            return self._track_and_correct(_Asked(frame, prior, imu))
        self._given_once = None
        return self._track(_Asked(frame, prior, imu), flow, following)

    def _track_and_correct(self, asked: _Asked) -> Step:
        """Track a frame, and the frame before once more, now that it is known what follows."""
        is_stated = states_times(asked.frame.camera)
        if not is_stated and self.readout_ms:
            camera = replace(asked.frame.camera, readout_ms=self.readout_ms)
            asked = asked._replace(frame=changed(asked.frame, camera=camera))
        corrected = None
        once = self._given_once
        if once is not None:
            self.resume(*once.known)
            corrected = self._track(once.asked, None, asked.frame)
            if not once.is_stated:
                self._learn_readout(once.asked.frame, corrected)
        known = self._known
        step = self._track(asked)
        if states_times(asked.frame.camera) and step.prev_index is not None:
            # as it is numbered
            frame = changed(asked.frame, index=step.index)
            asked = asked._replace(frame=frame)
            self._given_once = _Given(known, asked, is_stated)
        elif not is_stated:
            self._learn_readout(asked.frame, step)
        return replace(step, corrected=corrected)

    def _learn_readout(self, frame: Frame, step: Step) -> None:
        """Learn what a frame shows of the readout, with its last step."""
        readout_ms = frame.camera.readout_ms
        last = self.state.frame
        if last is not None and last.index == step.index:
            # as it was tracked
            frame = last
        is_old = step.status.reason is Reason.REPEATED_FRAME
        self._readout.add(Taken(frame, step, is_old, readout_ms))

    def _track(
        self,
        asked: _Asked,
        flow: FlowField | np.ndarray | None = None,
        following: Frame | None = None,
    ) -> Step:
        """Track a frame, whose step stays as it is."""
        frame, prior, imu = asked
        before = self.state
        sensors = before.sensors
        gyroscope = sensors.gyroscope
        if imu is not None:
            gyroscope = (gyroscope or Gyroscope()).after(imu)
        if frame.index is None:
            frame = changed(frame, index=before.count)
        repeat = repeat_of(sensors.last, frame)
        clock = sensors.clock.after(frame.timestamp)
        breaks = sensors.clock.breaks_at(frame.timestamp) and not repeat.entire
        state = before
        if breaks:
            self._warn_of_clock(frame.timestamp)
            state = before.without_velocity()
        if gyroscope is not None and prior is None and not breaks:
            prior = self._expected_by_gyroscope(gyroscope, frame)
        arrival = Arrival(
            frame,
            flow,
            prior,
            self._deadline(),
            gyroscope,
            repeat=repeat,
            following=following,
        )
        state, step = follow(self._setup, state, arrival)
        if breaks:
            # of a motion over an unknown time
            state = state.without_velocity()
        sensors = Sensors(
            frame,
            clock,
            state.sensors.scale,
            _gyroscope_after(gyroscope, before, state, step),
            _accelerometer_after(gyroscope, before, state, step),
        )
        after = replace(state, sensors=sensors)
        step = self._finished(before, after, replace(step, gravity=after.gravity))
        # nothing has changed so far: a frame that fails leaves the tracker as it was
        self.state = after
        return replace(step, motion=StepMotion.of(step.motion))

    def _finished(
        self, before: TrackerState, after: TrackerState, step: Step
    ) -> Step:
        """A step, to which whoever tracks more than the camera adds what that shows."""
        return step

    def _expected_by_gyroscope(
        self, gyroscope: Gyroscope, frame: Frame
    ) -> MotionPrior | None:
        """The motion to a frame that a gyroscope and the velocity before lead one to expect."""
        reference = self.state.frame
        if reference is None:
            return None
        expected = self.state.expected()
        return gyroscope.prior(reference.timestamp, frame.timestamp, expected)

    def _warn_of_clock(self, stamp: float) -> None:
        """Log once that the stamps do not rise."""
        if self._warned_of_clock:
            return
        self._warned_of_clock = True
        _logger.warning(
            "Odometry.track: the stamp %.6f s does not come after %.6f s, that of the "
            "frame before: no velocity is known there; check the clock of the camera",
            stamp,
            self.state.sensors.clock.stamp,
        )

    @property
    def _setup(self) -> Setup:
        """How motions are found, by the options of now."""
        context = replace(self._context, options=self.options)
        return Setup(self.method, context)

    def loops(self, step: Step, apart: int = 30) -> tuple[Edge, ...]:
        """Measure the loops that the last frame closes.

        The frame is compared with the places that are kept: ``track.places`` of them, where flow
        is computed from the images. A loop is a motion from a place that looks like the frame. The
        images show it in both directions, and where the path leads is not asked. So where a scene
        repeats itself, a loop may be wrong: give it a robust kernel. Each place that looks alike,
        at most three, costs one motion or two: a second. No later step depends on this call.

        Args:
            step: of the last frame.
            apart: frames from a place to this one at least.

        Returns:
            Sure motions to ``step.index``, each from the frame of a place, metres; their
            covariances also cover the motion backwards. Empty where no place fits, where the step
            failed, and where no later motion may start from the frame.

        Raises:
            InputError: for a usable step that is not that of the last frame, for a number below 0,
                and for another type.

        Example:
            >>> import hybridvo as hvo
            >>> vo = hvo.Odometry(network=None)
            >>> steps = [vo.track(frame) for frame in hvo.example_frames()]
            >>> [edge.start for edge in vo.loops(steps[-1], apart=2)]
            [0]
        """
        check_kind("Odometry.loops", step, Step)
        if not as_number(apart) >= 0:
            raise InputError(
                f"Odometry.loops: apart: expected frames from 0 on, got {apart!r}."
            )
        if not step.usable:
            return ()
        last = self.state.sensors.last
        if last is None or step.index != last.index:
            known = "no frame" if last is None else f"frame {last.index}"
            raise InputError(
                f"Odometry.loops: expected the step of the last frame, got that of frame "
                f"{step.index} after {known}. Call it after each track."
            )
        frame = self.state.frame
        if frame is None or frame.index != step.index:
            return ()
        return tuple(loops_to_reference(self._setup, self.state, apart))

    def _deadline(self) -> float | None:
        """When the time of a frame is over, on the clock of ``time.perf_counter``."""
        budget_ms = self.options.track.budget_ms
        return time.perf_counter() + budget_ms / 1000 if budget_ms else None

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
        self._given_once = None
        state = self.state
        why = message or "the frame cannot be read"
        motion = RelativePose.failed(reason, why, self.method)
        T = state.T_world_last
        if state.reference is not None:
            T, motion = fallback(self._setup, state, motion, prior)
        sensors = replace(state.sensors, clock=state.sensors.clock.after(timestamp))
        self.state = replace(state.advanced(T), sensors=sensors)
        prev_index = None if state.frame is None else state.frame.index
        return Step(int(index), timestamp, T.copy(), motion, prev_index)


def _gyroscope_after(
    gyroscope: Gyroscope | None,
    before: TrackerState,
    after: TrackerState,
    step: Step,
) -> Gyroscope | None:
    """The gyroscope after a step, with the samples that the next one may need."""
    if gyroscope is None:
        return None
    starts = before.starts
    start = None if step.prev_index is None else starts.get(step.prev_index)
    if start is not None:
        was_false = gyroscope.contradicts_images
        gyroscope = gyroscope.corrected(step, start.timestamp, step.timestamp)
        if gyroscope.contradicts_images and not was_false:
            _logger.warning(
                "Odometry.track: the gyroscope turns otherwise than the images, and is left out "
                "from here on; check its axes (R_cam_imu), signs, unit (rad/s) and clock"
            )
    needed = [frame.timestamp for frame in after.nearest_starts]
    return gyroscope.since(min(needed)) if needed else gyroscope


def _accelerometer_after(
    gyroscope: Gyroscope | None,
    before: TrackerState,
    after: TrackerState,
    step: Step,
) -> Accelerometer | None:
    """The accelerometer after a step, whose samples the gyroscope holds; None without one."""
    known = before.sensors.accelerometer
    leads = after.gap == 0
    if known is not None and after.part != before.part:
        # a piece of path that nothing ties to the one before
        known = known.elsewhere()
    elif known is not None and leads:
        # the next motion starts here, with the error of this one
        known = known.drifted(step)
    if gyroscope is None or gyroscope.samples.accelerations is None:
        return known
    known = known or Accelerometer()
    return known.after(gyroscope.samples, gyroscope.bias, step, leads)


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
            width,
            width,
            (width - 1) / 2,
            (height - 1) / 2,
            height=height,
            width=width,
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
