"""The tracker: one frame in, one step out, constant memory."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, fields, replace
from typing import Any

import numpy as np

from hybridvo.errors import InputError
from hybridvo.flow import FlowField, FlowProvider, dis_flow, with_flow
from hybridvo.geometry import chain, invert, pose_matrix, se3_exp, se3_log
from hybridvo.network.models import Models, default_models
from hybridvo.options import Options
from hybridvo.pipeline import (
    DEFAULT_METHOD,
    IDENTITY_STD,
    Context,
    check_method,
    networks_of,
    run_method,
    warm_up,
)
from hybridvo.results import MotionPrior, Reason, RelativePose, Step
from hybridvo.types import Camera, Frame, FramePair, as_number, as_rigid, as_seed, check_kind

STANDSTILL = 1e-12 * np.eye(6)
"""Covariance of no motion at all; a pose graph can still invert it."""
MEMORY = 10  # motions after which a change counts 1 / e of a new one
MIN_CHANGES = 3  # changes between motions to be seen before their spread means anything
INFLATION = 2.0
"""Factor on the mean square of the last changes, which tell little of the next, larger one."""
FLOOR_M, FLOOR_RAD = 1e-3, 1e-3
"""Smallest standard deviations of a prediction: no camera repeats its motion exactly."""
UNKNOWN_M, UNKNOWN_RAD = 1.0, 0.3  # standard deviations where too little is known


@dataclass(frozen=True, eq=False)
class MotionModel:
    """Constant velocity: the last motion between neighbours, and how motions change.

    ``spread`` (6, 6) is a decaying sum of squared changes, ``weight`` their decaying number.
    """

    T_last: np.ndarray | None = None
    spread: np.ndarray = field(default_factory=lambda: np.zeros((6, 6)))
    weight: float = 0.0
    changes: int = 0

    def observed(self, T_curr_prev: np.ndarray, neighbours: bool = True) -> MotionModel:
        """The model after one more motion, which follows the last one directly (``neighbours``)."""
        # a step hands its motion out as well: its array may change
        T_curr_prev = np.array(T_curr_prev)
        if self.T_last is None or not neighbours:
            return replace(self, T_last=T_curr_prev)
        change = se3_log(T_curr_prev @ invert(self.T_last))
        keep = 1.0 - 1.0 / MEMORY
        spread = keep * self.spread + np.outer(change, change)
        return MotionModel(T_curr_prev, spread, keep * self.weight + 1.0, self.changes + 1)

    def predict(self, frames: int = 1) -> MotionPrior | None:
        """The motion to the frame ``frames`` ahead; None before the first motion.

        The velocity is taken to wander by as much as it did: over n frames the variance is that of
        one change times n (n + 1) (2 n + 1) / 6.
        """
        if self.T_last is None:
            return None
        n = int(frames)
        grown = n * (n + 1) * (2 * n + 1) / 6
        T = pose_matrix(np.linalg.matrix_power(self.T_last, n)[:3])
        if self.changes < MIN_CHANGES:
            return MotionPrior(T, grown * np.diag([UNKNOWN_M**2] * 3 + [UNKNOWN_RAD**2] * 3))
        # ten changes are few for 21 numbers: half of it is even in all directions
        mean = self.spread / self.weight
        even = np.repeat([np.trace(mean[:3, :3]) / 3, np.trace(mean[3:, 3:]) / 3], 3)
        one = INFLATION * 0.5 * (mean + np.diag(even))
        return MotionPrior(T, grown * (one + np.diag([FLOOR_M**2] * 3 + [FLOOR_RAD**2] * 3)))


@dataclass(frozen=True, eq=False)
class TrackerState:
    """State of a tracker after a frame: all that another one needs to go on.

    Args:
        frame: the frame that the next one is held against; None before the first one.
        T_world_cam: (4, 4) its pose.
        T_world_last: (4, 4) pose last handed out: another one after frames that were passed over.
        gap: frames passed over since ``frame``. failed: motions since the last found.
        count: frames seen.
    """

    frame: Frame | None = None
    T_world_cam: np.ndarray = field(default_factory=lambda: np.eye(4))
    T_world_last: np.ndarray = field(default_factory=lambda: np.eye(4))
    motion_model: MotionModel = field(default_factory=MotionModel)
    gap: int = 0
    failed: int = 0
    count: int = 0

    def to_arrays(self) -> dict[str, np.ndarray]:
        """The state as named arrays, for ``numpy.savez``: no pickles."""
        parts = {"": vars(self), "frame.": vars(self.frame) if self.frame is not None else {}}
        parts["model."] = vars(self.motion_model)
        if self.frame is not None:
            parts["camera."] = vars(self.frame.camera)
        return {
            prefix + name: np.asarray(value)
            for prefix, values in parts.items()
            for name, value in values.items()
            if isinstance(value, np.ndarray | int | float)
        }

    @classmethod
    def from_arrays(cls, arrays: Mapping[str, np.ndarray]) -> TrackerState:
        """The state that :meth:`to_arrays` wrote; InputError where an array is missing."""

        def part(kind: Any, prefix: str, **more: Any) -> Any:
            known = {
                f.name: arrays[prefix + f.name] for f in fields(kind) if prefix + f.name in arrays
            }
            return kind(**{k: v if v.ndim else v.item() for k, v in known.items()}, **more)

        try:
            if "count" not in arrays:
                raise KeyError("count")
            frame = None
            if "frame.timestamp" in arrays:
                camera = part(Camera, "camera.")
                empty = {k: None for k in ("rgb", "depth") if f"frame.{k}" not in arrays}
                frame = part(Frame, "frame.", camera=camera, **empty)
            return part(cls, "", frame=frame, motion_model=part(MotionModel, "model."))
        except (KeyError, TypeError, ValueError) as error:
            raise InputError(
                f"TrackerState.from_arrays: expected the arrays of to_arrays(), got {error!r}. "
                f"Start the run anew."
            ) from None


class Odometry:
    """Chains the motions of consecutive frames; no pose is revised later.

    A frame that the next one cannot be held against (without depth, or of no motion) is passed
    over: the next motion spans it. Memory is that of one frame. Two trackers share no state and may
    run in two threads; one tracker belongs to one thread.

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
        InputError: an argument that cannot be used.

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
        check_kind("Odometry.options", options, Options)
        if flow is not None and not callable(flow):
            raise InputError(f"Odometry.flow: expected a callable (prev, curr), got {flow!r}.")
        if method is None:
            method = "refine" if network is None else DEFAULT_METHOD
        self._models = _models(network, method, options)
        check_method(method)
        self.method, self.options = method, options
        self.seed = as_seed(seed, "Odometry.seed")
        self._flow = flow or dis_flow(options.flow.dis_preset)
        self.reset()

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
        self._state = replace(state, T_world_cam=T_state, T_world_last=T)

    def resume(self, state: TrackerState) -> None:
        """Go on where another tracker stopped."""
        check_kind("Odometry.resume", state, TrackerState)
        self._state = state

    def warm_up(self) -> float:
        """Compile and load everything before the first frame; seconds spent."""
        return warm_up(self.method, self._models)

    def predict(self) -> MotionPrior | None:
        """The motion to the next frame, at constant velocity; None before the first motion."""
        return self._state.motion_model.predict()

    def track(self, frame: Frame, flow: FlowField | np.ndarray | None = None) -> Step:
        """Pose of the next frame; the first one has the identity as motion, status ok.

        Args:
            frame: the next frame. Its arrays are copied: a driver may reuse its buffers.
            flow: (H, W, 2) px from ``state.frame`` to this one, or a FlowField, where it is known
                already; by default the tracker's provider is asked. A frame that comes with its
                flow is never passed over: the next one's leads from it.

        Raises:
            InputError: ``frame`` is no Frame, has another size than the one before, or the flow
                does not fit it. The tracker is then as it was.
        """
        check_kind("Odometry.track", frame, Frame)
        state, frame = self._state, _own(frame)
        if frame.index is None:
            frame = replace(frame, index=state.count)
        if state.frame is None:
            return self._start(frame, state)
        pair = self._pair(state.frame, frame, flow)
        # the images are asked whether a flow can be theirs until one is
        wanted, check = self.options.track.motion_prior, not self._flow_fits
        prior = state.motion_model.predict(state.gap + 1) if wanted else None
        context = Context(self.options, prior, self.seed, None, self._models, check, self._flow)
        found = run_method(pair, self.method, context)
        self._flow_fits |= found.usable
        if found.usable:
            T, motion, failed = chain(state.T_world_cam, found.T_curr_prev), found, 0
            last = found.T_curr_prev
            if state.gap:  # over frames that were passed over: the share of one
                last = se3_exp(se3_log(last) / (state.gap + 1))
            model = state.motion_model.observed(last, not state.gap and not state.failed)
        else:
            (T, motion), failed = self._instead(state, found), state.failed + 1
            model = state.motion_model
        after: dict[str, Any] = {"T_world_last": T, "motion_model": model, "failed": failed}
        if flow is not None or self._leads(frame, pair, found, state.gap):
            after |= {"frame": frame, "T_world_cam": T, "gap": 0}
        else:
            after["gap"] = state.gap + 1
        self._state = replace(state, count=state.count + 1, **after)
        return Step(frame.index, frame.timestamp, T.copy(), motion)

    def _leads(self, frame: Frame, pair: FramePair, found: RelativePose, gap: int) -> bool:
        """Whether the next frame is held against this one: it has depth, and it was matched.

        After two motions that failed it is all the same: the camera may have moved on. Only flow
        that is computed from the images can span a frame that could not be matched.
        """
        if frame.depth is None or (frame.rgb is None and pair.flow is None):
            return False
        without_depth = found.status.reason is Reason.NO_VALID_DEPTH
        return (
            found.usable or gap > 0 or without_depth or getattr(self._flow, "source", "") != "dis"
        )

    def skip(self, index: int, timestamp: float, message: str = "") -> Step:
        """A frame that could not be read: a failed step; the next pair, and its flow, span it."""
        if as_number(index) % 1 or not np.isfinite(as_number(timestamp)):
            raise InputError(
                f"Odometry.skip: expected an index and finite seconds, got {index!r}, "
                f"{timestamp!r}."
            )
        state, message = self._state, message or "the frame cannot be read"
        motion = RelativePose.failed(Reason.MISSING_FRAME, message, self.method)
        T, gap = state.T_world_last, state.gap
        if state.frame is not None:
            (T, motion), gap = self._instead(state, motion), gap + 1
        self._state = replace(state, T_world_last=T, gap=gap, count=state.count + 1)
        return Step(int(index), timestamp, T.copy(), motion)

    def _start(self, frame: Frame, state: TrackerState) -> Step:
        T = state.T_world_last
        # no motion precedes the first frame
        first = RelativePose(covariance=STANDSTILL.copy(), method=self.method)
        self._state = TrackerState(frame, T, T, count=state.count + 1)
        return Step(frame.index, frame.timestamp, T.copy(), first)

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


def _own(frame: Frame) -> Frame:
    """Copy whose arrays nobody else can change."""
    images: dict[str, Any] = {
        name: x.copy() for name, x in vars(frame).items() if isinstance(x, np.ndarray)
    }
    return replace(frame, **images)


def _models(network: Any, method: str, options: Options) -> Models:
    """The networks asked for: a name or file of selector weights, or all of them."""
    if isinstance(network, Models):
        return network
    if network is None and networks_of(method):
        raise InputError(
            f"Odometry: method {method!r} needs a network; leave network='default', or use "
            f"method='refine'."
        )
    if network in ("default", None):
        return default_models(options.run.device if networks_of(method) else "cpu")
    check_kind("Odometry.network", network, str)
    from hybridvo.network.weights import weights_file

    return Models(options.run.device, {"selector": weights_file(network)})
