"""Odometry: a stateful tracker for SLAM front ends, one frame in, one step out, constant memory."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any, Literal

import numpy as np

from hybridvo.checks import as_number, as_rigid, as_seed
from hybridvo.errors import InputError
from hybridvo.flow import FlowField, FlowProvider, check_field, dis_flow
from hybridvo.geometry import invert, se3_exp, se3_log
from hybridvo.pipeline import (
    DEFAULT_METHOD,
    JUDGED,
    LearnedJudge,
    check_method,
    check_polish,
    estimate,
    shipped_judge,
    warm_up,
)
from hybridvo.refinement.photometric import PhotometricOptions, polish_photometric
from hybridvo.refinement.photometric_monitor import PhotometricMonitor
from hybridvo.refinement.refine import RefinementOptions
from hybridvo.tracking.anchor import Anchor
from hybridvo.tracking.key_frame import KeyFrame
from hybridvo.tracking.motion_history import Prediction
from hybridvo.tracking.pose_graph import Edge
from hybridvo.tracking.window import Located, Window, WindowOptions, check_window, corrected, locate
from hybridvo.trajectory import chain
from hybridvo.types import Frame, FramePair, Reason, RelativePose, State, Status, Step

__all__ = ["Anchor", "Odometry", "Policy"]

Policy = Literal["hold", "constant_velocity"]
POLICIES = ("hold", "constant_velocity")

FAILED_STD_M = 1.0
FAILED_STD_RAD = 0.3
"""Smallest standard deviations that a failed motion claims where nothing is predicted."""
WINDOWED = (*JUDGED, "refine")
"""Methods whose weights and covariance a window can build on."""
DEFAULT_WINDOW = 3
"""Key frames kept where the pictures sharpen the motion."""
START_INFLATION = 1000.0
"""On the covariance of the motion that a registration starts from: the pictures decide."""
REGISTRATION_STEPS = 10
"""Most steps under each blur: a start that was wrong by pixels needs more than a pair's."""


FARTHEST = 10**6
"""Frames ahead that may be asked for: matrix powers beyond are noise."""
FIRST_COVARIANCE = 1e-12 * np.eye(6)


class Odometry:
    """Chains the motions of consecutive frames, held together by a window of key frames.

    A step's pose is the best one at its time; no pose is revised later, and the motions of the
    steps chain to their poses. Memory is that of the last frame and of the key frames.

    Two trackers share no state and may run in two threads; one tracker belongs to one thread.

    Args:
        network: ``default`` for the shipped weights, None for the classical refinement alone, or a
            :class:`hybridvo.pipeline.LearnedJudge` of one's own.
        flow: provider ``(prev, curr) -> FlowField or (H, W, 2) array``; default: OpenCV DIS with a
            forward-backward check. Functions of two images go through
            :func:`hybridvo.flow.as_provider`. After :meth:`skip` the two are no neighbours.
        method: see :data:`hybridvo.pipeline.METHODS`; by default ``hybrid``, or ``refine`` without
            a network.
        history: let the predicted motion take part (:meth:`predict`): as one start among others,
            and as a cue for which motion is the world. It cannot hold the tracker: every start
            competes by how well the pixels follow it.
        policy: pose of a frame whose motion failed: ``hold`` (no motion) or ``constant_velocity``
            (the predicted motion, with its covariance). The status stays failed.
        polish: sharpen the flow's motion by the pictures: ``auto`` (where the method is
            ``hybrid``), ``on`` or ``off``.
        window: most key frames that new frames are registered to, 1 for none, see
            :mod:`hybridvo.tracking.window`. By default 3 where the pictures sharpen the motion, so
            that a registration needs no flow of its own, else 1. A larger number without pictures
            asks the flow for every registration.
        window_options: of the window.
        options: of the refinement.
        photometric: options of the polish.
        seed: of everything drawn at random.
        prepare: compile now rather than at the first pair (see :func:`hybridvo.pipeline.warm_up`).

    Raises:
        InputError: an unknown method or policy, a network that is none or that the method lacks, a
            window that the method cannot use, options of another kind, or no seed.

    Example:
        >>> import numpy as np
        >>> from hybridvo.types import Camera
        >>> vo = Odometry(method="identity")
        >>> camera = Camera(30, 30, 15.5, 11.5, 24, 32)
        >>> step = vo.track(Frame(None, np.ones((24, 32)), camera, timestamp=0.1))
        >>> step.ok, step.T_world_cam[0, 0]
        (True, 1.0)
    """

    def __init__(
        self,
        network: LearnedJudge | str | None = "default",
        *,
        flow: FlowProvider | Callable[[Frame, Frame], Any] | None = None,
        method: str | None = None,
        policy: Policy = "hold",
        polish: str = "auto",
        window: int | None = None,
        options: RefinementOptions | None = None,
        photometric: PhotometricOptions | None = None,
        window_options: WindowOptions | None = None,
        seed: int = 0,
        history: bool = True,
        prepare: bool = True,
    ) -> None:
        if network is not None and network != "default" and not isinstance(network, LearnedJudge):
            raise InputError(
                f"Odometry.network: expected 'default', None or a LearnedJudge, got {network!r}."
            )
        if method is None:
            method = "refine" if network is None else DEFAULT_METHOD
        if network is None and method in JUDGED:
            raise InputError(
                f"Odometry: method {method!r} needs a network; leave network='default', or use "
                f"method='refine'."
            )
        if policy not in POLICIES:
            raise InputError(f"Odometry.policy: expected {' or '.join(POLICIES)}, got {policy!r}.")
        if flow is not None and not callable(flow):
            raise InputError(
                f"Odometry.flow: expected a callable (prev, curr), got {type(flow).__name__}."
            )
        for name, value, kind in (
            ("options", options, RefinementOptions),
            ("photometric", photometric, PhotometricOptions),
            ("window_options", window_options, WindowOptions),
        ):
            if value is not None and not isinstance(value, kind):
                got = type(value).__name__
                raise InputError(f"Odometry.{name}: expected {kind.__name__}, got {got}.")
        check_method(method)
        check_polish(polish)
        check_window(window)
        polished = polish == "on" or (polish == "auto" and method == "hybrid")
        if method not in WINDOWED:
            if window is not None and window > 1:
                raise InputError(
                    f"Odometry.window: method {method!r} has no window of key frames; pass "
                    f"window=1, or one of the methods {', '.join(WINDOWED)}."
                )
            polished = False
        self.window = window or (DEFAULT_WINDOW if polished else 1)
        self.window_options = window_options or WindowOptions()
        self._polished = polished
        self.method = method
        self.polish = polish
        self.photometric = photometric or PhotometricOptions()
        # beside a window the prior of a registration is no flow of which errors are known
        self._registering = replace(
            self.photometric, flow_inflation=1.0, iterations=REGISTRATION_STEPS
        )
        self.images = PhotometricMonitor()
        self.policy = policy
        self.options = options or RefinementOptions()
        self.seed = as_seed(seed, "Odometry.seed")
        self.history = bool(history)
        self._judge = None
        if method in JUDGED:
            self._judge = network if isinstance(network, LearnedJudge) else shipped_judge()
        self._flow = flow or dis_flow()
        self.reset()
        if prepare:
            warm_up(method, polish)

    @classmethod
    def from_pretrained(cls, name: str = "default", **options: Any) -> Odometry:
        """Tracker with shipped network weights.

        Args:
            name: ``default``, or one of :func:`hybridvo.network.weights.pretrained_names`.
            options: of the tracker.

        Raises:
            CheckpointError: no such weights (the message lists those known), or damaged ones.
        """
        return cls("default" if name == "default" else shipped_judge(name), **options)

    @property
    def anchor(self) -> Anchor:
        """State after the last frame: hand it to :meth:`resume` to go on later."""
        return self._anchor

    def reset(self) -> None:
        """Forget everything: the next frame is the first one, at the identity."""
        self._anchor = Anchor(None, np.eye(4), np.eye(4))
        self.images.restore(None)

    def set_pose(self, T_world_cam: np.ndarray) -> None:
        """Say where the camera is now (or where it starts), as after a loop closure.

        Args:
            T_world_cam: (4, 4) camera to world of the last frame, or of the first one to come.

        Raises:
            InputError: no finite rigid transform.
        """
        T = as_rigid(T_world_cam, "Odometry.set_pose")
        anchor = self._anchor
        # the frame that the next pair starts from keeps its place relative to the last pose
        T_anchor = T @ invert(anchor.T_world_last) @ anchor.T_world_cam if anchor.gap else T
        window = anchor.window
        if window is not None:
            window = window.moved(T_anchor @ invert(anchor.T_world_cam))
        self._anchor = replace(anchor, T_world_cam=T_anchor, T_world_last=T, window=window)

    def resume(self, anchor: Anchor) -> None:
        """Go on where another tracker stopped; the steps that follow have the same bytes.

        Raises:
            InputError: no anchor.
        """
        if not isinstance(anchor, Anchor):
            raise InputError(f"Odometry.resume: expected an Anchor, got {type(anchor).__name__}.")
        self._anchor = anchor
        self.images.restore(anchor.images)

    @property
    def edges(self) -> tuple[Edge, ...]:
        """Motions between key frames and the last frame, each with its covariance and status.

        For a pose graph of one's own; empty without a window.
        """
        window = self._anchor.window
        return () if window is None else window.found

    def predict(self, frames: int = 1) -> Prediction | None:
        """The motion from the last frame to the next, before it is seen; None before the first one.

        Args:
            frames: how far ahead.

        Returns:
            Constant velocity, with a covariance from how the last motions changed.

        Raises:
            InputError: no number of frames from 1 to 10^6.
        """
        if as_number(frames) % 1 or not 1 <= frames <= FARTHEST:
            raise InputError(
                f"Odometry.predict: expected a number of frames from 1 to {FARTHEST}, "
                f"got {frames!r}."
            )
        return self._anchor.history.predict(frames)

    def track(self, frame: Frame, flow: FlowField | np.ndarray | None = None) -> Step:
        """Pose of the next frame.

        Args:
            frame: the next frame. Its arrays are copied: a driver may reuse its buffers.
            flow: (H, W, 2) px from the previous frame to this one, or a FlowField, where it is
                known already; by default the tracker's own provider is asked. The previous frame
                is ``anchor.frame``: after :meth:`skip` the last one that was tracked. A flow from
                the skipped one is of another pair, which its numbers do not tell: leave it away.

        Returns:
            The step. The first frame has the identity as motion, status ok.

        Raises:
            InputError: ``frame`` is no Frame, has another size than the one before, or the flow
                does not fit it. The tracker is then as it was.
        """
        if not isinstance(frame, Frame):
            raise InputError(f"Odometry.track: expected a Frame, got {type(frame).__name__}.")
        anchor = self._anchor
        if anchor.frame is None:
            return self._start(frame, anchor)
        prev = anchor.frame
        pair = self._pair(prev, frame, flow)
        ahead = anchor.history.predict(anchor.gap + 1) if self.history else None
        motion = self._estimate(pair, ahead)
        self.images.update(pair, motion)
        if motion.polish is not None:
            anchor = replace(anchor, images=self.images.state())
        found = motion
        if motion.ok:
            T_world_cam = chain(anchor.T_world_cam, motion.T_curr_prev)
        else:
            T_world_cam, motion = self._instead(anchor, motion)
        # without an image nothing can be matched from here: the next pair spans this frame
        if frame.rgb is None and pair.flow is None:
            self._anchor = replace(anchor, T_world_last=T_world_cam, gap=anchor.gap + 1)
            return Step(frame.index, frame.timestamp, T_world_cam.copy(), motion)
        own = _own(frame)
        window, jumped = anchor.window, False
        if window is None:
            window = self._first_key(own, T_world_cam)
        else:
            located = self._locate(window, motion, prev, own)
            window = located.window
            if located.used:
                T_world_cam = located.T_world_cam
                motion = corrected(motion, located, invert(T_world_cam) @ anchor.T_world_cam)
                jumped = motion.covariance is not located.covariance
        history = anchor.history
        if found.ok:
            # a motion that the key frames contradict is no velocity; theirs is, where it is of
            # this pair alone
            T = found.T_curr_prev if anchor.lost or jumped else motion.T_curr_prev
            alone = not anchor.gap and not anchor.lost
            if anchor.gap:
                T = se3_exp(se3_log(T) / (anchor.gap + 1))
            history = history.observed(T, neighbours=alone)
        self._anchor = Anchor(
            own,
            T_world_cam,
            T_world_cam,
            history,
            lost=0 if motion.ok else anchor.lost + 1,
            images=anchor.images,
            window=window,
        )
        return Step(frame.index, frame.timestamp, T_world_cam.copy(), motion)

    def _estimate(self, pair: FramePair, expected: Prediction | None) -> RelativePose:
        options: dict[str, Any] = {
            "method": self.method,
            "options": self.options,
            "judge": self._judge,
            "polish": self.polish,
            "photometric": self.photometric,
            "trust": self.images.trust,
            "seed": self.seed,
        }
        if expected is not None:
            options["T_last"] = expected.T_curr_prev
            options["T_last_covariance"] = expected.covariance if expected.informed else None
        return estimate(pair, **options)

    def _locate(self, window: Window, motion: RelativePose, prev: Frame, curr: Frame) -> Located:
        return locate(
            window,
            motion,
            prev,
            curr,
            self._by_pictures if self._polished else self._by_flow,
            self._search,
            self.window,
            self.window_options,
        )

    def _by_pictures(
        self,
        key: KeyFrame,
        curr: Frame,
        T_start: np.ndarray,
        covariance: np.ndarray,
        weights: np.ndarray,
    ) -> RelativePose:
        """Motion from a key frame by the pictures alone, from a start that is close."""
        start = RelativePose(
            T_curr_prev=T_start,
            covariance=START_INFLATION * covariance,
            weights=weights,
            depth_noise=key.depth_noise,
            method=self.method,
        )
        pair = FramePair(key.frame, curr, None)
        found = polish_photometric(pair, start, self._registering, trust=self.images.trust)
        if found.polish.taken:
            return found
        status = Status.failed(Reason.SOLVER_DIVERGED, found.polish.message)
        return found.replace(status=status)

    def _by_flow(
        self,
        key: KeyFrame,
        curr: Frame,
        T_start: np.ndarray | None,
        covariance: np.ndarray,
        weights: np.ndarray,
    ) -> RelativePose:
        """Motion from a key frame as between neighbours, beside a start."""
        expected = None if T_start is None else Prediction(T_start, covariance, informed=False)
        found = self._estimate(self._pair(key.frame, curr, None), expected)
        if found.status.state is State.DEGRADED:
            # key frames hold the walk together: what is doubtful between neighbours is not used
            return found.replace(status=Status.failed(found.status.reason, found.status.message))
        return found

    def _search(
        self,
        key: KeyFrame,
        curr: Frame,
        T_start: np.ndarray,
        covariance: np.ndarray,
        weights: np.ndarray,
    ) -> RelativePose:
        """The same where nothing is known of the motion."""
        return self._by_flow(key, curr, None, covariance, weights)

    def skip(self, index: int, timestamp: float, message: str = "") -> Step:
        """A frame that could not be read: a failed step; the next pair, and its flow, span it.

        Args:
            index: of the frame.
            timestamp: seconds.
            message: why.

        Raises:
            InputError: a stamp that is not finite, or an index that is no whole number.
        """
        if as_number(index) % 1 or not np.isfinite(as_number(timestamp)):
            raise InputError(
                f"Odometry.skip: expected an index and finite seconds, got {index!r}, "
                f"{timestamp!r}."
            )
        anchor = self._anchor
        failed = RelativePose.failed(
            Reason.MISSING_FRAME, message or "the frame cannot be read", self.method
        )
        if anchor.frame is None:
            return Step(index, timestamp, anchor.T_world_last.copy(), failed)
        T_world_cam, motion = self._instead(anchor, failed)
        self._anchor = replace(anchor, T_world_last=T_world_cam, gap=anchor.gap + 1)
        return Step(index, timestamp, T_world_cam.copy(), motion)

    def _start(self, frame: Frame, anchor: Anchor) -> Step:
        T = anchor.T_world_last
        own = _own(frame)
        self._anchor = Anchor(own, T, T, window=self._first_key(own, T))
        # no motion precedes the first frame; a covariance that a pose graph can still invert
        first = RelativePose(covariance=FIRST_COVARIANCE.copy(), method=self.method)
        return Step(frame.index, frame.timestamp, T.copy(), first)

    def _first_key(self, frame: Frame, T_world_cam: np.ndarray) -> Window | None:
        """A window that begins with a frame, where one is kept and the frame has depth."""
        if self.window == 1 or frame.depth is None:
            return None
        return Window.start(frame, T_world_cam)

    def _pair(self, prev: Frame, curr: Frame, flow: Any) -> FramePair:
        if curr.camera.shape != prev.camera.shape:
            raise InputError(
                f"Odometry.track: expected a frame of {prev.camera.shape} (height, width) as "
                f"before, got {curr.camera.shape}. Resize it with "
                f"hybridvo.data.resize.resize_frame, or reset() the tracker."
            )
        given = self._flow(prev, curr) if flow is None else flow
        field = check_field(given, prev, "given" if flow is not None else "callable")
        return FramePair(
            prev, curr, field.flow, field.variance, field.valid, field.source, field.is_true
        )

    def _instead(self, anchor: Anchor, failed: RelativePose) -> tuple[np.ndarray, RelativePose]:
        """(pose, motion) by policy, where a motion was not found."""
        covariance = np.diag([FAILED_STD_M**2] * 3 + [FAILED_STD_RAD**2] * 3)
        covariance = np.maximum(covariance, np.diag(np.diag(failed.covariance)))
        T_world_cam, T_curr_prev = anchor.T_world_last, np.eye(4)
        ahead = anchor.history.predict(anchor.gap + 1)
        if self.policy == "hold" or ahead is None:
            if anchor.gap:
                T_curr_prev = invert(T_world_cam) @ anchor.T_world_cam
        else:
            # the velocity wanders on with every motion that fails
            T_curr_prev, covariance = ahead.T_curr_prev, (anchor.lost + 1) * ahead.covariance
            T_world_cam = chain(anchor.T_world_cam, T_curr_prev)
        return T_world_cam, failed.replace(T_curr_prev=T_curr_prev, covariance=covariance)


def _own(frame: Frame) -> Frame:
    """Copy whose arrays nobody else can change."""

    def copy(array: np.ndarray | None) -> np.ndarray | None:
        return None if array is None else array.copy()

    return replace(
        frame,
        rgb=copy(frame.rgb),
        depth=copy(frame.depth),
        depth_variance=copy(frame.depth_variance),
        mask=copy(frame.mask),
    )
