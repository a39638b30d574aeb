"""The tracker that users make: the camera's path, and what else moves where that is asked."""

from __future__ import annotations

from copy import deepcopy
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from hybridvo.core.checks import check_kind
from hybridvo.core.geometry import invert
from hybridvo.core.imu import ImuSamples
from hybridvo.core.results import MotionPrior, Reason, Step
from hybridvo.core.types import Frame
from hybridvo.core.unchecked import changed
from hybridvo.evidence.one_time import states_times
from hybridvo.flow.providers import FlowField
from hybridvo.objects.followed import Things, after_step
from hybridvo.objects.motions import GridView
from hybridvo.tracking.camera_drift import Mean
from hybridvo.tracking.readout import ReadoutFinder, Taken, surely_ms
from hybridvo.tracking.tracker import Tracker
from hybridvo.tracking.tracker_state import TrackerState

PAIRS_OF_READOUT = 45
"""Pairs that show a readout while a tracker runs: those before it was known show too little."""


class _Given(NamedTuple):
    """A frame whose step was given, and what it takes to find that once more."""

    before: TrackerState
    things: Things
    frame: Frame
    prior: MotionPrior | None
    imu: ImuSamples | None
    is_stated: bool  # the times of its pixels, by its camera


class Odometry(Tracker):
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
        >>> vo = hvo.Odometry(network=None)
        >>> steps = [vo.track(frame) for frame in hvo.example_frames()]
        >>> [(step.prev_index, str(step.status)) for step in steps]
        [(None, 'ok'), (0, 'ok'), (1, 'ok')]
    """

    def reset(self) -> None:
        """Forget everything: the next frame is the first one, at the identity."""
        super().reset()
        self.things = Things()
        self._given_once: _Given | None = None
        self._readout = ReadoutFinder(PAIRS_OF_READOUT)

    def resume(self, state: TrackerState, things: Things | None = None) -> None:
        """Go on where another tracker stopped.

        Args:
            state: the ``state`` of that tracker.
            things: its ``things``: what else moves; None: nothing is known.

        Raises:
            InputError: for a value of another type.
        """
        check_kind("Odometry.resume: things", things, Things, type(None))
        super().resume(state)
        self._given_once = None
        self.things = things or Things()

    def set_pose(self, T_world_cam: np.ndarray) -> None:
        """Set the pose of the camera, at the start or after a loop closure.

        Args:
            T_world_cam: (4, 4) camera to world, metres.

        Raises:
            InputError: for a matrix that is not rigid.
        """
        T_last_world = invert(self.state.T_world_last)
        super().set_pose(T_world_cam)
        once = self._given_once
        if once is not None:
            T_new_old = self.state.T_world_last @ T_last_world
            before = once.before.moved(T_new_old @ once.before.T_world_last)
            self._given_once = once._replace(before=before)

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
        if not self.options.track.lag or flow is not None or following is not None:
            self._given_once = None
            return super().track(frame, flow, prior, imu, following)
        is_stated = states_times(frame.camera)
        frame = deepcopy(self._with_readout(frame))
        corrected = self._corrected(frame)
        before = self.state
        things = self.things
        step = super().track(frame, None, prior, imu)
        frame = changed(frame, index=step.index)
        if states_times(frame.camera) and before.reference is not None:
            self._given_once = _Given(before, things, frame, prior, imu, is_stated)
        elif not is_stated:
            self._take_note(0.0, frame, step)
        return replace(step, corrected=corrected)

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
        self._given_once = None
        return super().skip(index, timestamp, message, reason, prior)

    @property
    def readout(self) -> Mean | None:
        """What ``track.lag`` has found of the readout, ms; None: too little."""
        return self._readout.mean()

    @property
    def readout_ms(self) -> float:
        """How long the rows of an image surely take, ms, as ``track.lag`` finds it; else 0."""
        return surely_ms(self.readout)

    def _with_readout(self, frame: Frame) -> Frame:
        """A frame whose camera states the readout that was found, unless it states its own."""
        if states_times(frame.camera) or not self.readout_ms:
            return frame
        camera = replace(frame.camera, readout_ms=self.readout_ms)
        return changed(frame, camera=camera)

    def _corrected(self, following: Frame) -> Step | None:
        """Track the frame before once more, now that it is known what follows."""
        once = self._given_once
        if once is None:
            return None
        self._given_once = None
        self.state = once.before
        self.things = once.things
        step = super().track(once.frame, None, once.prior, once.imu, following)
        if not once.is_stated:
            self._take_note(once.frame.camera.readout_ms, once.frame, step)
        return step

    def _take_note(self, readout_ms: float, frame: Frame, step: Step) -> None:
        """Learn what a frame shows of the readout, with its last step."""
        last = self.state.frame
        if last is not None and last.index == step.index:
            # as it was tracked
            frame = last
        self._readout.add(Taken(frame, step, is_old=False, readout_ms=readout_ms))

    def _finished(
        self, before: TrackerState, after: TrackerState, step: Step
    ) -> Step:
        """A step with what else moves from the frame before on, where that is sought."""
        things = self.things
        view = None
        if self.options.track.objects == "auto":
            view = GridView.after(before, after, step)
        if view is not None:
            passed = before.count - before.known_reference.count
            things, seen = after_step(things, view, passed, self.options, self.seed)
            step = replace(step, objects=seen)
        if step.scale_change != 1:
            things = things.rescaled(step.scale_change)
        self.things = things
        return step
