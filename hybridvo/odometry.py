"""The tracker: one frame in, one step out, constant memory."""

from __future__ import annotations

import functools
import time
from collections.abc import Callable
from copy import deepcopy
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from hybridvo.errors import InputError
from hybridvo.flow import FlowField, FlowProvider, dis_flow, with_flow
from hybridvo.geometry import chain, ego_flow, invert, pose_matrix, se3_exp, se3_log
from hybridvo.network.models import Models, default_models
from hybridvo.options import Options
from hybridvo.pipeline import (
    DEFAULT_METHOD,
    IDENTITY_STD,
    NETWORKS,
    Context,
    check_method,
    run_method,
)
from hybridvo.results import MotionPrior, Reason, RelativePose, Step
from hybridvo.types import Camera, Frame, FramePair, as_number, as_rigid, as_seed, check_kind

STANDSTILL = 1e-12 * np.eye(6)  # covariance of no motion, which a pose graph can still invert
KEEP = 0.9  # of the weight of a change, with every further one
MIN_CHANGES = 3  # changes between motions to be seen before their spread means anything
INFLATION = 2.0  # of the mean square of the last changes, which tell little of a larger one
FLOOR = 1e-3  # smallest standard deviation, m and rad: no camera repeats its motion exactly


@dataclass(frozen=True, eq=False)
class MotionModel:
    """Constant velocity: the last motion between neighbours, and how motions change."""

    T_last: np.ndarray | None = None
    spread: np.ndarray = field(default_factory=lambda: np.zeros((6, 6)))  # decaying sum of squares
    changes: int = 0

    def observed(self, T_curr_prev: np.ndarray, neighbours: bool = True) -> MotionModel:
        """The model after one more motion, which follows the last one directly (``neighbours``)."""
        # a step hands its motion out as well: its array may change
        T_curr_prev = np.array(T_curr_prev)
        if self.T_last is None or not neighbours:
            return replace(self, T_last=T_curr_prev)
        change = se3_log(T_curr_prev @ invert(self.T_last))
        spread = KEEP * self.spread + np.outer(change, change)
        return MotionModel(T_curr_prev, spread, self.changes + 1)

    def predict(self, frames: int = 1) -> MotionPrior | None:
        """The motion to the frame ``frames`` ahead; None before the first motion."""
        if self.T_last is None:
            return None
        n = int(frames)
        grown = n * (n + 1) * (2 * n + 1) / 6  # the velocity wanders on by as much as it did
        T = pose_matrix(np.linalg.matrix_power(self.T_last, n)[:3])
        if self.changes < MIN_CHANGES:
            return MotionPrior(T, grown * np.diag(IDENTITY_STD**2))
        # ten changes are few for 21 numbers: half of it is even in all directions
        mean = self.spread * (1 - KEEP) / (1 - KEEP**self.changes)
        even = np.repeat([np.trace(mean[:3, :3]) / 3, np.trace(mean[3:, 3:]) / 3], 3)
        one = INFLATION * 0.5 * (mean + np.diag(even))
        return MotionPrior(T, grown * (one + FLOOR**2 * np.eye(6)))


@dataclass(frozen=True, eq=False)
class TrackerState:
    """State of a tracker after a frame: all that another one needs to go on."""

    frame: Frame | None = None  # that the next one is held against
    T_world_cam: np.ndarray = field(default_factory=lambda: np.eye(4))  # its pose
    T_world_last: np.ndarray = field(default_factory=lambda: np.eye(4))  # the last one handed out
    motion_model: MotionModel = field(default_factory=MotionModel)
    gap: int = 0  # frames passed over since ``frame``
    failed: int = 0  # motions since the last that was found
    count: int = 0  # frames seen


class Odometry:
    """Chains the motions of consecutive frames; no pose is revised, and a frame is kept at most.

    A frame that the next one cannot be held against (without depth, or of no motion) is passed
    over: the next motion spans it. ``network`` is ``default`` (pretrained), None for the classical
    refinement alone, the name or file of other selector weights, or Models; ``flow`` a provider
    ``(prev, curr) -> FlowField or (H, W, 2) array``, by default OpenCV's DIS; ``method`` by default
    ``hybrid``, or ``refine`` without a network.
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
            raise InputError(f"Odometry.flow: expected a callable (prev, curr), got {flow!r}.")
        self.method = method or ("refine" if network is None else DEFAULT_METHOD)
        self.seed = as_seed(seed, "Odometry.seed")
        check_method(self.method)
        device = self.options.run.device if self.method in NETWORKS else "cpu"
        if network is None and self.method in NETWORKS:
            raise InputError(f"Odometry: method {method!r} needs a network; use method='refine'.")
        if network in (None, "default"):
            network = default_models(device)
        elif not isinstance(network, Models):
            check_kind("Odometry.network", network, str)
            network = default_models(device, str(network))
            network.path("selector")  # refuses a name that nobody knows
        self._models, self._flow = network, flow or dis_flow(self.options.flow.dis_preset)
        self.reset()

    def reset(self) -> None:
        """Forget everything: the next frame is the first one, at the identity."""
        self.state = TrackerState()  # hand it to another one's resume() to go on later
        self._flow_fits = False

    def set_pose(self, T_world_cam: np.ndarray) -> None:
        """Say where the camera is now (or where it starts), as after a loop closure."""
        T = as_rigid(T_world_cam, "Odometry.set_pose")
        state = self.state
        # the frame that the next pair starts from keeps its place relative to the last pose
        T_state = T @ invert(state.T_world_last) @ state.T_world_cam if state.gap else T
        self.state = replace(state, T_world_cam=T_state, T_world_last=T)

    def resume(self, state: TrackerState) -> None:
        """Go on where another tracker stopped."""
        check_kind("Odometry.resume", state, TrackerState)
        self.state = state

    def warm_up(self) -> float:
        """Compile and load everything before the first frame; seconds spent."""
        return warm_up(self.method, self._models)

    def predict(self) -> MotionPrior | None:
        """The motion to the next frame, at constant velocity; None before the first motion."""
        return self.state.motion_model.predict()

    def track(self, frame: Frame, flow: FlowField | np.ndarray | None = None) -> Step:
        """Pose of the next frame; the first one has the identity as motion, status ok.

        The arrays of ``frame`` are copied. ``flow``, (H, W, 2) px from ``state.frame`` to this one,
        or a FlowField, is given where it is known. After an InputError the tracker is as it was.
        """
        check_kind("Odometry.track", frame, Frame)
        state, frame = self.state, deepcopy(frame)
        if frame.index is None:
            frame = replace(frame, index=state.count)
        if state.frame is None:
            T = state.T_world_last
            self.state = TrackerState(frame, T, T, count=state.count + 1)
            first = RelativePose(covariance=STANDSTILL.copy(), method=self.method)
            return Step(frame.index, frame.timestamp, T.copy(), first)
        pair = FramePair(state.frame, frame, None)
        if flow is not None:
            pair = with_flow(pair, lambda *_: flow, "given")
        elif frame.rgb is None:  # with images the method asks for it where it needs one
            pair = with_flow(pair, self._flow)
        # the images are asked whether a flow can be theirs until one is
        wanted, check = self.options.track.motion_prior, not self._flow_fits
        prior = state.motion_model.predict(state.gap + 1) if wanted else None
        context = Context(self.options, prior, self.seed, None, self._models, check, self._flow)
        motion = run_method(pair, self.method, context)
        leads = flow is not None or self._leads(frame, pair, motion, state.gap)
        if motion.usable:
            self._flow_fits = True
            T, last = chain(state.T_world_cam, motion.T_curr_prev), motion.T_curr_prev
            if state.gap:  # over frames that were passed over: the share of one
                last = se3_exp(se3_log(last) / (state.gap + 1))
            model = state.motion_model.observed(last, not state.gap and not state.failed)
            state = replace(state, motion_model=model, failed=0)
        else:
            T, motion = self._instead(state, motion)
            state = replace(state, failed=state.failed + 1)
        new = {"frame": frame, "T_world_cam": T, "gap": 0} if leads else {"gap": state.gap + 1}
        self.state = replace(state, **new, T_world_last=T, count=state.count + 1)
        return Step(frame.index, frame.timestamp, T.copy(), motion)

    def _leads(self, frame: Frame, pair: FramePair, found: RelativePose, gap: int) -> bool:
        """Whether the next frame is held against this one: it has depth, and it was matched."""
        if frame.depth is None or (frame.rgb is None and pair.flow is None):
            return False
        matched = found.usable or found.status.reason is Reason.NO_VALID_DEPTH
        # after two failures the camera may have moved on; flow from files cannot span a frame
        return matched or gap > 0 or getattr(self._flow, "source", "") != "dis"

    def skip(self, index: int, timestamp: float, message: str = "") -> Step:
        """A frame that could not be read: a failed step; the next pair, and its flow, span it."""
        if as_number(index) % 1 or not np.isfinite(as_number(timestamp)):
            got = f"{index!r}, {timestamp!r}"
            raise InputError(f"Odometry.skip: expected an index and finite seconds, got {got}.")
        state, why = self.state, message or "the frame cannot be read"
        motion = RelativePose.failed(Reason.MISSING_FRAME, why, self.method)
        T, gap = state.T_world_last, state.gap
        if state.frame is not None:
            (T, motion), gap = self._instead(state, motion), gap + 1
        self.state = replace(state, T_world_last=T, gap=gap, count=state.count + 1)
        return Step(int(index), timestamp, T.copy(), motion)

    def _instead(self, state: TrackerState, failed: RelativePose) -> tuple[Any, RelativePose]:
        """(pose, motion) by policy, where a motion was not found."""
        T_world_cam, T_curr_prev, covariance = state.T_world_last, np.eye(4), failed.covariance
        ahead = state.motion_model.predict(state.gap + 1)
        if self.options.track.on_failure == "hold" or ahead is None:
            if state.gap:
                T_curr_prev = invert(T_world_cam) @ state.T_world_cam
        else:
            # the velocity wanders on with every motion that fails
            T_curr_prev, covariance = ahead.T_curr_prev, (state.failed + 1) * ahead.covariance
            T_world_cam = chain(state.T_world_cam, T_curr_prev)
        return T_world_cam, failed.replace(T_curr_prev=T_curr_prev, covariance=covariance)


@functools.cache
def warm_up(method: str = DEFAULT_METHOD, models: Models | None = None) -> float:
    """Compile and load everything; seconds spent: a minute once, a second after that."""
    started = time.perf_counter()
    context = Context(models=models or default_models(), check_flow=False)
    for height, width in ((48, 64), (320, 400)):  # the second takes the parallel kernels
        camera = Camera(width, width, (width - 1) / 2, (height - 1) / 2, height, width)
        u, v = np.arange(width), np.arange(height)[:, None]
        wave = np.sin(u / 7.0) + np.cos(v / 5.0)
        depth, rgb = 4.0 + wave, (100 + 40 * wave)[..., None].repeat(3, 2).astype(np.uint8)
        motion = se3_exp(np.array([0.02, -0.01, 0.05, 0.002, 0.004, -0.003]))
        flow = ego_flow(depth, motion, camera, camera)
        # a mask, a variance and a second motion: every branch is compiled
        flow[: height // 3, : width // 3] += 3.0
        frame = Frame(rgb, depth, camera)
        pair, valid = FramePair(frame, frame, flow), depth > 0
        run_method(replace(pair, flow_variance=0.01 * depth, flow_valid=valid), method, context)
        run_method(pair, method, context)
        if method.startswith("hybrid"):  # what few pairs ask for
            context.predict(pair)
            context.direct(replace(pair, flow_source="dis"))
    return time.perf_counter() - started
