"""The tracker: one frame in, one step out, constant memory."""

from __future__ import annotations

import functools
import itertools
import time
from collections.abc import Callable, Iterable
from copy import deepcopy
from dataclasses import dataclass, field, replace
from typing import Any, NamedTuple

import numpy as np

from hybridvo import pipeline
from hybridvo.calibration import (
    CHANGE_DECAY,
    CHANGE_INFLATION,
    MIN_CHANGE_STD,
    MIN_CHANGES,
    MIN_DEPTH_SHARE,
)
from hybridvo.checks import as_number, as_rigid, as_seed, check_kind
from hybridvo.depth_scale import (
    ScaleFilter,
    divided,
    lengthened,
    measured_scale,
    rescaled_about,
)
from hybridvo.errors import InputError
from hybridvo.flow import FlowField, FlowProvider, dis_flow, with_flow
from hybridvo.geometry import chain, ego_flow, invert, pose_matrix, se3_exp, se3_log
from hybridvo.keyframes import Keyframe, between_frames, expected_motion, trimmed
from hybridvo.network.models import Models, default_models
from hybridvo.options import Options
from hybridvo.photometric.consistency import contradiction_by_depth
from hybridvo.pipeline import Effort
from hybridvo.relocalization import are_apart, similar_places, with_place
from hybridvo.results import MotionPrior, Reason, RelativePose, Step
from hybridvo.types import Camera, Frame, FramePair

KEYFRAME_METHODS = ("hybrid", "hybrid-flow", "classical")
"""Methods whose motions may span several frames: those that search from an expected motion."""
# covariance of no motion, which a pose graph can still invert
FIRST_FRAME_COVARIANCE = 1e-12 * np.eye(6)


@dataclass(frozen=True, eq=False)
class MotionModel:
    """A motion model of constant velocity, with the mean square of its changes so far."""

    # (4, 4) last motion between neighbouring frames
    T_last: np.ndarray | None = None
    # decaying sum of squares
    spread: np.ndarray = field(default_factory=lambda: np.zeros((6, 6)))
    changes: int = 0  # so far

    def observed(
        self, T_curr_prev: np.ndarray, neighbours: bool = True
    ) -> MotionModel:
        """Return the model after one more motion; ``neighbours``: it follows the last directly."""
        # copied, for the user gets the same array in a step and may change it
        T_curr_prev = np.array(T_curr_prev)
        if self.T_last is None or not neighbours:
            return replace(self, T_last=T_curr_prev)
        change = se3_log(T_curr_prev @ invert(self.T_last))
        spread = CHANGE_DECAY * self.spread + np.outer(change, change)
        return MotionModel(T_curr_prev, spread, self.changes + 1)

    def predict(self, frames: int = 1) -> MotionPrior | None:
        """Predict the motion to the frame ``frames`` ahead; None before the first motion."""
        if self.T_last is None:
            return None
        n = int(frames)
        # each change of the velocity lasts: it counts once for every motion that follows
        grown = sum(k**2 for k in range(1, n + 1))
        T = pose_matrix(np.linalg.matrix_power(self.T_last, n)[:3])
        if self.changes < MIN_CHANGES:
            return MotionPrior(T, grown * pipeline.identity_covariance())
        # ten changes are few for the 21 numbers of a covariance: half of it is made isotropic
        mean = self.spread * (1 - CHANGE_DECAY) / (1 - CHANGE_DECAY**self.changes)
        even = np.repeat(
            [np.trace(mean[:3, :3]) / 3, np.trace(mean[3:, 3:]) / 3], 3
        )
        one = CHANGE_INFLATION * 0.5 * (mean + np.diag(even))
        return MotionPrior(T, grown * (one + MIN_CHANGE_STD**2 * np.eye(6)))


@dataclass(frozen=True, eq=False)
class TrackerState:
    """The state of a tracker after a frame, with which another tracker can go on."""

    frame: Frame | None = None  # the reference, from which the next motion starts
    # pose of the reference
    T_world_cam: np.ndarray = field(default_factory=lambda: np.eye(4))
    # pose of the last step
    T_world_last: np.ndarray = field(default_factory=lambda: np.eye(4))
    motion_model: MotionModel = field(default_factory=MotionModel)
    gap: int = 0  # frames passed over since the reference
    failed: int = 0  # motions that failed since the last one that was found
    count: int = 0  # frames so far
    is_sure: bool = True  # whether the motion of the reference was ok
    used_flow: bool = False  # whether the last motion needed flow
    # number of the first frame that leads here: no motion is known from earlier ones
    part: int = 0
    keyframes: tuple[Keyframe, ...] = ()  # oldest first
    places: tuple[Keyframe, ...] = ()  # from which a lost path is found again
    # how well the scale of all depths is known, where each frame has its own
    scale: ScaleFilter = field(default_factory=ScaleFilter)

    @property
    def starts(self) -> dict[int, Frame]:
        """The frames from which the next motion may start, by their index."""
        held = [each.frame for each in (*self.places, *self.keyframes)]
        if self.frame is not None:
            held.append(self.frame)
        return {frame.index: frame for frame in held}

    def rescaled(self, factor: float) -> TrackerState:
        """Return the state after all lengths grew by a factor; the last pose stays."""
        here = self.T_world_last
        frame = None if self.frame is None else divided(self.frame, 1 / factor)
        model = self.motion_model
        if model.T_last is not None:
            T_last = lengthened(model.T_last, factor)
            model = replace(model, T_last=T_last)

        def rescaled(keyframe: Keyframe) -> Keyframe:
            return replace(
                keyframe,
                frame=divided(keyframe.frame, 1 / factor),
                T_world_cam=rescaled_about(keyframe.T_world_cam, here, factor),
            )

        return replace(
            self,
            frame=frame,
            T_world_cam=rescaled_about(self.T_world_cam, here, factor),
            motion_model=model,
            keyframes=tuple(map(rescaled, self.keyframes)),
            places=tuple(map(rescaled, self.places)),
        )


class _Estimate(NamedTuple):
    """A motion to the current frame, and what it was estimated from."""

    start: Keyframe
    motion: RelativePose  # from ``start``
    reference: Keyframe  # the frame before
    keyframes: tuple[Keyframe, ...]  # those that are near enough to be kept
    given: (
        MotionPrior | None
    )  # what the user knows of the motion from the reference
    # the path was lost since ``start``
    is_relocalized: bool = False

    @property
    def T_world_cam(self) -> np.ndarray:
        """(4, 4) pose of the current frame."""
        return chain(self.start.T_world_cam, self.motion.T_curr_prev)

    def agrees_with(self, others: Iterable[_Estimate]) -> bool:
        """Whether the current frame has the same place by all others."""
        here = self.T_world_cam
        return not any(
            are_apart(self.start.frame, here, other.T_world_cam) for other in others
        )


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
        >>> from hybridvo.synthetic.scenes import make_scene
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
        self.reset()

    def reset(self) -> None:
        """Forget everything: the next frame is the first one, at the identity."""
        self.state = TrackerState()

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

    def track(
        self,
        frame: Frame,
        flow: FlowField | np.ndarray | None = None,
        prior: MotionPrior | None = None,
    ) -> Step:
        """Track the next frame; the motion of the first one is the identity, with status ok.

        Args:
            frame: its arrays are copied.
            flow: where it is known: a FlowField or (H, W, 2) px, from ``state.frame`` to this one.
            prior: what is known of the motion from ``state.frame``, for instance by a gyroscope
                (:func:`hybridvo.gyro_prior`) or wheels; by default constant velocity. It also
                bridges a motion that fails.

        Returns:
            The step, whose ``prev_index`` is the frame from which its motion starts.

        Raises:
            InputError: for what is no frame or prior; the tracker is as it was.
        """
        check_kind("Odometry.track", frame, Frame)
        if prior is not None:
            check_kind("Odometry.track: prior", prior, MotionPrior)
        state = self.state
        frame = deepcopy(frame)
        if frame.index is None:
            frame = replace(frame, index=state.count)
        if state.frame is None:
            return self._first_step(frame)
        if self._scales(frame):
            return self._track_scaled(frame, flow, prior)
        if is_stale(state.frame, frame):
            text = (
                "the image is that of the frame before, while the depth has moved"
            )
            return self.skip(
                frame.index, frame.timestamp, text, Reason.CONTRADICTED, prior
            )
        estimate = self._estimate(frame, flow, prior, self._deadline())
        return self._step(frame, estimate, flow is not None)

    def _step(self, frame: Frame, estimate: _Estimate, has_flow: bool) -> Step:
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

    def _track_scaled(
        self,
        frame: Frame,
        flow: FlowField | np.ndarray | None,
        prior: MotionPrior | None,
    ) -> Step:
        """Track a frame whose depth has a scale of its own.

        The first motion comes from the earlier frame's depth alone, in whose scale it is. With the
        scale that the static pixels then show, both depth maps take part in the second one.
        """
        without_depth = replace(frame, depth=None, depth_variance=None)
        deadline = self._deadline()
        estimate = self._estimate(without_depth, flow, prior, deadline)
        scale = measured_scale(estimate.start.frame, frame, estimate.motion)
        if scale is not None:
            frame = divided(frame, scale)
            again = self._estimate(frame, flow, prior, deadline)
            more = measured_scale(again.start.frame, frame, again.motion)
            # unless two depth maps of one scale make it less sure
            if more is not None and again.motion.ok >= estimate.motion.ok:
                estimate = again
                scale *= more
                frame = divided(frame, more)
        before = self.state.scale
        step = self._step(frame, estimate, flow is not None)
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

    def _estimate(
        self,
        frame: Frame,
        flow: FlowField | np.ndarray | None,
        given: MotionPrior | None,
        deadline: float | None,
    ) -> _Estimate:
        """The motion to a frame from a keyframe, from the reference, or from a place.

        The reference is tried where a keyframe gives no sure motion, a place where the path is
        lost. The surest one counts.
        """
        state = self.state
        reference = self._reference()
        expected = given or state.motion_model.predict(state.gap + 1)
        starts = [reference]
        keyframes = state.keyframes
        if flow is not None or not self._spans_frames():
            keyframes = ()
        elif frame.rgb is not None:
            T_ahead = state.T_world_cam
            if expected is not None:
                T_ahead = chain(T_ahead, expected.T_curr_prev)
            keyframes = trimmed(keyframes, T_ahead, state.count)
            if keyframes and keyframes[0].count < reference.count:
                starts.insert(0, keyframes[0])
        found = []
        for effort, start in itertools.product(self._efforts(flow), starts):
            prior = None
            if expected is not None:
                T_ref_start = invert(reference.T_world_cam) @ start.T_world_cam
                prior = expected_motion(expected, T_ref_start)
            motion = self._motion(start.frame, frame, flow, prior, deadline, effort)
            estimate = _Estimate(start, motion, reference, keyframes, given)
            # of a path that was lost since: only where no other place fits as well
            if start.count < state.part <= reference.count:
                estimate = estimate._replace(is_relocalized=True)
                if not self._is_the_only_one(frame, estimate, deadline):
                    continue
            found.append(estimate)
            if motion.ok or (motion.usable and pipeline.is_late(deadline)):
                break
        best = max(found, key=lambda estimate: estimate.motion.rank)
        if flow is None and self._is_lost(best.motion):
            place = self._from_place(frame, best, deadline)
            return place or best
        return best

    def _efforts(self, flow: FlowField | np.ndarray | None) -> tuple[Effort, ...]:
        """What is tried from every start before the next of these is."""
        is_ours = flow is None and self._computes_flow()
        if is_ours and self.method in pipeline.WIDE_METHODS:
            return (Effort.ONLY_NEAR, Effort.ONLY_WIDE)
        return (Effort.ALL,)

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

    def _from_place(
        self, frame: Frame, best: _Estimate, deadline: float | None
    ) -> _Estimate | None:
        """The motion from a place that resembles a frame, if it is sure and no other fits."""
        fitting = self._from_places(frame, best, deadline)
        if not fitting:
            return None
        surest = max(fitting, key=lambda estimate: estimate.motion.rank)
        return surest if surest.agrees_with(fitting) else None

    def _is_the_only_one(
        self, frame: Frame, estimate: _Estimate, deadline: float | None
    ) -> bool:
        """Whether a motion is sure, and no place fits from which the pose is another one."""
        if not estimate.motion.ok:
            return False
        return estimate.agrees_with(self._from_places(frame, estimate, deadline))

    def _from_places(
        self, frame: Frame, estimate: _Estimate, deadline: float | None
    ) -> list[_Estimate]:
        """The sure motions from places that resemble a frame; those tried already left out."""
        tried = {estimate.start.count, estimate.reference.count}
        places = [p for p in self.state.places if p.count not in tried]
        fitting = []
        for place in similar_places(places, frame):
            motion = self._motion(place.frame, frame, None, None, deadline)
            if motion.ok:
                fitting.append(
                    estimate._replace(
                        start=place,
                        motion=motion,
                        keyframes=(),
                        is_relocalized=True,
                    )
                )
        return fitting

    def _follow(self, frame: Frame, estimate: _Estimate, leads: bool) -> Step:
        """The step of a motion that was found."""
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
        self.state = replace(
            state,
            motion_model=model,
            failed=0,
            part=part,
            keyframes=keyframes,
            places=places,
            used_flow="flow" in motion.terms,
        )
        self._advance(frame, T_world_cam, leads, motion.ok)
        return Step(
            frame.index,
            frame.timestamp,
            T_world_cam.copy(),
            motion,
            origin.frame.index,
        )

    def _lose(self, frame: Frame, estimate: _Estimate, leads: bool) -> Step:
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

    def _reference(self) -> Keyframe:
        """The frame before as the start of a motion; what its own covariance was is not kept."""
        state = self.state
        assert state.frame is not None
        count = state.count - state.gap - 1
        if state.keyframes and state.keyframes[-1].count == count:
            return state.keyframes[-1]
        unknown = np.zeros((6, 6))
        return Keyframe(state.frame, state.T_world_cam, count, count, unknown)

    def _motion(
        self,
        prev: Frame,
        curr: Frame,
        flow: FlowField | np.ndarray | None,
        prior: MotionPrior | None,
        deadline: float | None,
        effort: Effort = Effort.ALL,
    ) -> RelativePose:
        """The motion between two frames by the tracker's method."""
        pair = FramePair(prev, curr, None)
        if flow is not None:
            pair = with_flow(pair, lambda *_: flow, "given")
        # with images, the method computes flow only if it needs it
        elif curr.rgb is None:
            pair = with_flow(pair, self._flow)
        context = pipeline.Context(
            options=self.options,
            prior=prior if self.options.track.motion_prior else None,
            seed=self.seed,
            models=self._models,
            flow=self._flow,
            deadline=deadline,
            effort=effort,
            expects_flow=self.state.used_flow,
        )
        return pipeline.run_method(pair, self.method, context)

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
        self.state = replace(state, T_world_last=T, gap=gap, count=state.count + 1)
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


def has_depth(frame: Frame) -> bool:
    """Whether a motion can start from a frame: enough of its pixels have depth."""
    if frame.depth is None:
        return False
    valid = (frame.depth > 0) & np.isfinite(frame.depth)
    return bool(np.count_nonzero(valid) >= MIN_DEPTH_SHARE * valid.size)


def is_stale(before: Frame, frame: Frame) -> bool:
    """Whether a camera handed out the image of the frame before once more, with fresh depth."""
    if (
        frame.rgb is None
        or before.rgb is None
        or not np.array_equal(frame.rgb, before.rgb)
    ):
        return False
    everywhere = np.ones(frame.camera.shape, np.float32)
    standing = RelativePose(weights=everywhere)
    return (
        contradiction_by_depth(FramePair(before, frame, None), standing) is not None
    )


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
        pipeline.run_method(full, method, context)
        pipeline.run_method(pair, method, context)
        if method.startswith("hybrid"):  # what only few pairs need
            context.direct(replace(pair, flow_source="dis"))
            context.search(replace(pair, flow=noisy))
