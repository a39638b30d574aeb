"""The tracker: one frame in, one step out, constant memory."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np

from hybridvo.errors import InputError
from hybridvo.estimation import warm_up
from hybridvo.flow import FlowField, FlowProvider, dis_flow, with_flow
from hybridvo.geometry import invert, se3_exp, se3_log
from hybridvo.images.photometric import refine_photometric
from hybridvo.network.models import Models, default_models
from hybridvo.options import Options
from hybridvo.pipeline import (
    DEFAULT_METHOD,
    IDENTITY_STD,
    SEARCHING,
    Context,
    check_method,
    networks_of,
    refines_images,
    run_method,
)
from hybridvo.refinement.refine import widened
from hybridvo.results import MotionPrior, Reason, RelativePose, State, Status, Step
from hybridvo.tracking.pose_graph import Edge
from hybridvo.tracking.state import TrackerState
from hybridvo.tracking.window import STANDSTILL, KeyFrame, Window, locate
from hybridvo.trajectory import chain
from hybridvo.types import Frame, FramePair, as_number, as_rigid, as_seed

DEFAULT_WINDOW = 3
"""Key frames kept where the images refine the motion."""
START_INFLATION = 1000.0
"""On the covariance of the motion that a registration starts from: the images decide."""
REGISTRATION_STEPS = 10
"""Most steps under each blur: a start that was wrong by pixels needs more than a pair's."""
MAX_FRAMES = 10**6
"""Frames ahead that may be asked for: matrix powers beyond are noise."""


class Odometry:
    """Chains the motions of consecutive frames, held together by a window of key frames.

    A step's pose is the best one at its time; no pose is revised later, and the motions of the
    steps chain to their poses. Memory is that of the last frame and of the key frames.
    Two trackers share no state and may run in two threads; one tracker belongs to one thread.

    Args:
        network: ``default`` for the pretrained weights, None for the classical refinement alone,
            the name or file of other selector weights, or :class:`hybridvo.network.models.Models`.
        flow: provider ``(prev, curr) -> FlowField or (H, W, 2) array``; default: OpenCV DIS. After
            :meth:`skip` the two frames are no neighbours.
        method: one of :data:`hybridvo.pipeline.METHODS`; by default ``hybrid``, or ``refine``
            without a network.
        options: the option tree; all groups but ``run`` are read, and of that ``run.device``.
        seed: of everything drawn at random.

    Raises:
        InputError: an argument that cannot be used, or a window with a method that has none.

    Example:
        >>> import numpy as np
        >>> from hybridvo.types import Camera
        >>> vo = Odometry(method="identity")
        >>> camera = Camera(30, 30, 15.5, 11.5, 24, 32)
        >>> step = vo.track(Frame(None, np.ones((24, 32)), camera, timestamp=0.1))
        >>> step.ok, step.index
        (True, 0)
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
        options = Options() if options is None else options
        if not isinstance(options, Options):
            got = type(options).__name__
            raise InputError(f"Odometry.options: expected Options, got {got}.")
        if flow is not None and not callable(flow):
            raise InputError(f"Odometry.flow: expected a callable (prev, curr), got {flow!r}.")
        if method is None:
            method = "refine" if network is None else DEFAULT_METHOD
        self._models = _models(network, method, options)
        check_method(method)
        if method not in SEARCHING and (options.track.window or 1) > 1:
            raise InputError(
                f"Odometry: method {method!r} has no window of key frames; set track.window to "
                f"1, or use one of the methods {', '.join(SEARCHING)}."
            )
        self.method, self.options = method, options
        self.seed = as_seed(seed, "Odometry.seed")
        self._by_images = refines_images(method, options)
        self.window = options.track.window or (DEFAULT_WINDOW if self._by_images else 1)
        # beside a window the prior of a registration is no flow of which errors are known
        self._registration = replace(
            options.photometric, prior_inflation=1.0, iterations=REGISTRATION_STEPS
        )
        self._flow = flow or dis_flow(options.flow.dis_preset)
        self.reset()

    @classmethod
    def from_pretrained(cls, name: str = "default", **options: Any) -> Odometry:
        """Tracker with the weights of a selector: ``default``, another name, or a file."""
        return cls(name, **options)

    @property
    def state(self) -> TrackerState:
        """State after the last frame: hand it to :meth:`resume` to go on later."""
        return self._state

    def reset(self) -> None:
        """Forget everything: the next frame is the first one, at the identity."""
        self._state = TrackerState()
        self._flow_fits = False

    def set_pose(self, T_world_cam: np.ndarray) -> None:
        """Say where the camera is now (or where it starts), as after a loop closure."""
        T = as_rigid(T_world_cam, "Odometry.set_pose")
        state = self._state
        # the frame that the next pair starts from keeps its place relative to the last pose
        T_state = T @ invert(state.T_world_last) @ state.T_world_cam if state.gap else T
        window = state.window
        if window is not None:
            window = window.moved(T_state @ invert(state.T_world_cam))
        self._state = replace(state, T_world_cam=T_state, T_world_last=T, window=window)

    def resume(self, state: TrackerState) -> None:
        """Go on where another tracker stopped."""
        if not isinstance(state, TrackerState):
            got = type(state).__name__
            raise InputError(f"Odometry.resume: expected a TrackerState, got {got}.")
        self._state = state

    def warm_up(self) -> float:
        """Compile and load everything before the first frame; seconds spent."""
        return warm_up(self.method, self._models)

    @property
    def edges(self) -> tuple[Edge, ...]:
        """Motions between key frames and the last frame, for a graph of one's own; may be empty."""
        window = self._state.window
        return () if window is None else window.found

    def predict(self, frames: int = 1) -> MotionPrior | None:
        """The motion to the frame so many ahead, at constant velocity; None before the first."""
        if as_number(frames) % 1 or not 1 <= frames <= MAX_FRAMES:
            raise InputError(
                f"Odometry.predict: expected a number of frames from 1 to {MAX_FRAMES}, "
                f"got {frames!r}."
            )
        return self._state.motion_model.predict(frames)

    def track(self, frame: Frame, flow: FlowField | np.ndarray | None = None) -> Step:
        """Pose of the next frame; the first one has the identity as motion, status ok.

        Args:
            frame: the next frame. Its arrays are copied: a driver may reuse its buffers.
            flow: (H, W, 2) px from ``state.frame``, the last one tracked, to this one, or a
                FlowField, where it is known already; by default the tracker's provider is asked.

        Raises:
            InputError: ``frame`` is no Frame, has another size than the one before, or the flow
                does not fit it. The tracker is then as it was.
        """
        if not isinstance(frame, Frame):
            raise InputError(f"Odometry.track: expected a Frame, got {type(frame).__name__}.")
        state, frame = self._state, _own(frame)
        if frame.index is None:
            frame = replace(frame, index=state.count)
        if state.frame is None:
            return self._start(frame, state)
        prev = state.frame
        pair = self._pair(prev, frame, flow)
        ahead = None
        if self.options.track.motion_prior:
            ahead = state.motion_model.predict(state.gap + 1)
        found = self._estimate(pair, ahead)
        T_world_cam, motion = chain(state.T_world_cam, found.T_curr_prev), found
        if not found.usable:
            T_world_cam, motion = self._instead(state, found)
        if frame.rgb is None and pair.flow is None:
            # nothing can be matched from here: the next pair spans this frame
            self._pass(T_world_cam)
            return _step(frame, T_world_cam, motion)
        window = state.window
        if window is None:
            window = self._first_key(frame, T_world_cam)
        else:
            window, T, motion, used = locate(
                window, motion, prev, frame, self._register, self.window, self.options.track
            )
            T_world_cam = T if used else T_world_cam
        if found.status.reason is Reason.AMBIGUOUS_MOTION:
            # a registration that started from this motion confirms it whichever it is
            motion = widened(motion)
        model = state.motion_model
        if found.usable:
            # the pair's own motion: that of the step holds corrections of the pose before as well
            T = found.T_curr_prev
            if state.gap:
                T = se3_exp(se3_log(T) / (state.gap + 1))
            model = model.observed(T, neighbours=not state.gap and not state.failed)
        failed = 0 if motion.usable else state.failed + 1
        self._state = TrackerState(
            frame, T_world_cam, T_world_cam, model, 0, failed, state.count + 1, window
        )
        return _step(frame, T_world_cam, motion)

    def _pass(self, T_world_last: np.ndarray) -> None:
        """After a frame that nothing can be matched from."""
        state = self._state
        self._state = replace(
            state, T_world_last=T_world_last, gap=state.gap + 1, count=state.count + 1
        )

    def _estimate(self, pair: FramePair, prior: MotionPrior | None) -> RelativePose:
        # the images are asked whether a flow can be theirs until one is
        check_flow = not self._flow_fits
        context = Context(
            self.options, prior, self.seed, None, self._models, check_flow, self._flow
        )
        found = run_method(pair, self.method, context)
        self._flow_fits |= found.usable
        return found

    def _register(
        self, key: KeyFrame, curr: Frame, prior: MotionPrior | None, weights: np.ndarray
    ) -> RelativePose:
        """Motion from a key frame, from a start or without; one in doubt counts as failed."""
        if prior is not None and self._by_images:
            start = RelativePose(
                T_curr_prev=prior.T_curr_prev,
                covariance=START_INFLATION * prior.covariance,
                weights=weights,
                depth_noise=key.depth_noise,
                method=self.method,
            )
            pair = FramePair(key.frame, curr, None)
            found = refine_photometric(pair, start, self._registration)
            assert found.photometric is not None
            if found.photometric.taken:
                return found
            status = Status.failed(Reason.SOLVER_DIVERGED, found.photometric.message)
            return found.replace(status=status)
        found = self._estimate(self._pair(key.frame, curr), prior)
        if found.status.state is State.DEGRADED:
            return found.replace(status=Status.failed(found.status.reason, found.status.message))
        return found

    def skip(self, index: int, timestamp: float, message: str = "") -> Step:
        """A frame that could not be read: a failed step; the next pair, and its flow, span it."""
        if as_number(index) % 1 or not np.isfinite(as_number(timestamp)):
            raise InputError(
                f"Odometry.skip: expected an index and finite seconds, got {index!r}, "
                f"{timestamp!r}."
            )
        state = self._state
        failed = RelativePose.failed(
            Reason.MISSING_FRAME, message or "the frame cannot be read", self.method
        )
        if state.frame is None:
            self._state = replace(state, count=state.count + 1)
            return Step(int(index), timestamp, state.T_world_last.copy(), failed)
        T_world_cam, motion = self._instead(state, failed)
        self._pass(T_world_cam)
        return Step(int(index), timestamp, T_world_cam.copy(), motion)

    def _start(self, frame: Frame, state: TrackerState) -> Step:
        T = state.T_world_last
        # no motion precedes the first frame
        first = RelativePose(covariance=STANDSTILL.copy(), method=self.method)
        window = self._first_key(frame, T)
        self._state = TrackerState(frame, T, T, count=state.count + 1, window=window)
        return _step(frame, T, first)

    def _first_key(self, frame: Frame, T_world_cam: np.ndarray) -> Window | None:
        """A window that begins with a frame, where one is kept and the frame has depth."""
        if self.window == 1 or frame.depth is None:
            return None
        return Window((KeyFrame(frame, T_world_cam),))

    def _pair(self, prev: Frame, curr: Frame, flow: Any = None) -> FramePair:
        if curr.camera.shape != prev.camera.shape:
            raise InputError(
                f"Odometry.track: expected a frame of {prev.camera.shape} (height, width) as "
                f"before, got {curr.camera.shape}. Resize it with "
                f"hybridvo.data.sequence.resize_frame, or reset() the tracker."
            )
        pair = FramePair(prev, curr, None)
        if flow is not None:
            return with_flow(pair, lambda *_: flow, "given")
        # the method asks for it where it needs one
        return pair if curr.rgb is not None else with_flow(pair, self._flow)

    def _instead(
        self, state: TrackerState, failed: RelativePose
    ) -> tuple[np.ndarray, RelativePose]:
        """(pose, motion) by policy, where a motion was not found."""
        covariance = np.diag(np.maximum(IDENTITY_STD**2, np.diag(failed.covariance)))
        T_world_cam, T_curr_prev = state.T_world_last, np.eye(4)
        ahead = state.motion_model.predict(state.gap + 1)
        if self.options.track.on_failure == "hold" or ahead is None:
            if state.gap:
                T_curr_prev = invert(T_world_cam) @ state.T_world_cam
        else:
            # the velocity wanders on with every motion that fails
            T_curr_prev, covariance = ahead.T_curr_prev, (state.failed + 1) * ahead.covariance
            T_world_cam = chain(state.T_world_cam, T_curr_prev)
        return T_world_cam, failed.replace(T_curr_prev=T_curr_prev, covariance=covariance)


def _step(frame: Frame, T_world_cam: np.ndarray, motion: RelativePose) -> Step:
    return Step(frame.index, frame.timestamp, T_world_cam.copy(), motion)


def _own(frame: Frame) -> Frame:
    """Copy whose arrays nobody else can change."""
    images: dict[str, Any] = {
        name: x.copy() for name, x in vars(frame).items() if isinstance(x, np.ndarray)
    }
    return replace(frame, **images)


def _models(network: Any, method: str, options: Options) -> Models:
    """The networks asked for: a name or file of selector weights, or all of them."""
    if network is not None and not isinstance(network, str | Models):
        got = type(network).__name__
        raise InputError(
            f"Odometry.network: expected 'default', the name or file of weights, Models or None, "
            f"got {got}."
        )
    if network is None and networks_of(method):
        raise InputError(
            f"Odometry: method {method!r} needs a network; leave network='default', or use "
            f"method='refine'."
        )
    if isinstance(network, Models):
        return network
    if network in ("default", None):
        return default_models(options.run.device if networks_of(method) else "cpu")
    from hybridvo.network.weights import weights_file

    return Models(options.run.device, {"selector": weights_file(network)})
