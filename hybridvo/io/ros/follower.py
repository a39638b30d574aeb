"""Messages in, what is published out: the tracker as both nodes run it."""

from __future__ import annotations

import threading
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from hybridvo.core.errors import InputError
from hybridvo.core.imu import MAX_CLOCK_JUMP_S, ImuSamples, with_earlier
from hybridvo.core.options import Options
from hybridvo.core.results import UNINFORMATIVE_COVARIANCE, Step
from hybridvo.core.types import Frame
from hybridvo.flow.providers import dis_flow
from hybridvo.io.masks import mask_of
from hybridvo.io.ros.conversions import (
    Twist,
    pose_covariance,
    pose_in_odom,
    twist,
)
from hybridvo.io.ros.frames import FrameReader, stamp_ns
from hybridvo.io.ros.inbox import Arrived
from hybridvo.io.ros.parameters import NodeOptions
from hybridvo.network.models import Models
from hybridvo.odometry import Odometry
from hybridvo.pipeline import check_method
from hybridvo.tracking.chains import PathCovariance
from hybridvo.tracking.keyframes import has_enough_depth


class Moving(NamedTuple):
    """Where something moves by itself.

    Attributes:
        header: of the image whose pixels are meant, which is that before.
        mask: (H, W) bool, True where it moves.
    """

    header: Any
    mask: np.ndarray


class Report(NamedTuple):
    """What is published of a frame.

    Attributes:
        header: of its image; its stamp is that of the pose.
        child: the frame whose pose it is.
        T_odom_child: (4, 4) the pose, m.
        covariance: (6, 6) of it, in the axes of odom.
        twist: the velocity, in the axes of the child.
        step: what the tracker returned.
        T_odom_before: (4, 4) the pose of the frame before once more, with ``track.lag``; else None.
        moving: what moves; None where it is not known, or not wanted.
        restarts: how often tracking began anew.
    """

    header: Any
    child: str
    T_odom_child: np.ndarray
    covariance: np.ndarray
    twist: Twist
    step: Step
    T_odom_before: np.ndarray | None
    moving: Moving | None
    restarts: int


class Follower:
    """Tracks the frames of a node.

    Args:
        tracker: The tracker.
        options: What is published.
        say: Gets a sentence where messages cannot be used, or tracking begins anew.
    """

    def __init__(
        self,
        tracker: Odometry,
        options: NodeOptions,
        say: Callable[[str], None],
    ) -> None:
        self._tracker = tracker
        self._options = options
        self._say = say
        self._reader = FrameReader(options)
        self._path = PathCovariance()
        self._last_said = ""
        self._last_stamp: float | None = None
        self._restarts = 0
        # asked for in another thread
        self._reset = threading.Event()
        # of frames that could not be used
        self._imu: ImuSamples | None = None
        # of the frames from which a motion may start
        self._headers: dict[int, Any] = {}
        self._stamps: dict[int, int] = {}

    def ask_for_reset(self) -> str:
        """Let the next frame be the first one, at the origin of odom; in any thread.

        Returns:
            What a service answers.
        """
        self._reset.set()
        return "tracking begins anew with the next frame, at the origin"

    def follow(self, arrived: Arrived) -> Report | None:
        """Track a frame.

        Args:
            arrived: Its messages.

        Returns:
            What is published of it; None where it cannot be used.
        """
        if self._reset.is_set():
            self._begin_anew()
        self._imu = with_earlier(self._imu, arrived.imu)
        try:
            frame = self._reader.frame(arrived.rgb, arrived.depth, arrived.info)
        except InputError as error:
            self._say_once(str(error))
            return None
        if self._is_repeated(frame):
            return None
        if self._tracker.state.frame is None and not has_enough_depth(frame):
            # a camera that has just been switched on; nothing can start from such a frame
            self._say_once("frames without depth; tracking has not begun")
            return None
        self._start_again_where_needed(frame)
        self._last_stamp = frame.timestamp
        starts = self._tracker.state.starts
        step = self._tracker.track(frame, imu=self._imu)
        self._imu = None
        self._headers[step.index] = arrived.rgb.header
        self._stamps[step.index] = stamp_ns(arrived.rgb)
        covariance = self._path.add(step)
        report = self._report(arrived, step, covariance, starts)
        self._forget()
        return report

    def _report(
        self,
        arrived: Arrived,
        step: Step,
        covariance: np.ndarray,
        starts: dict[int, Frame],
    ) -> Report:
        mount = arrived.mount
        T_odom_child = pose_in_odom(step.T_world_cam, mount)
        # nothing is known of it before the first motion, and where a lost path is found again:
        # that motion starts from a place of long ago
        velocity = Twist(np.zeros(6), UNINFORMATIVE_COVARIANCE)
        T_odom_before = None
        if step.corrected is not None and step.corrected.usable:
            T_odom_before = pose_in_odom(step.corrected.T_world_cam, mount)
        moving = None
        if step.prev_index is not None and self._tracker.predict() is not None:
            # seconds since 1970 would have no more than a fraction of a microsecond
            passed = self._stamps[step.index] - self._stamps[step.prev_index]
            seconds = passed / 1e9
            velocity = twist(step.T_curr_prev, step.covariance, seconds, mount)
        if step.prev_index is not None and self._options.publish_mask:
            moving = self._moving(step, starts[step.prev_index])
        return Report(
            arrived.rgb.header,
            mount.child,
            T_odom_child,
            pose_covariance(covariance, T_odom_child, mount),
            velocity,
            step,
            T_odom_before,
            moving,
            self._restarts,
        )

    def _moving(self, step: Step, start: Frame) -> Moving | None:
        """What moves, on the pixels of the frame from which the motion starts."""
        weights = step.motion.weights
        if weights is None or not step.usable:
            return None
        mask = ~mask_of(start, weights)
        if start.mask is not None:
            mask &= start.mask
        return Moving(self._headers[start.index], mask)

    def _forget(self) -> None:
        """Keep what belongs to frames from which a motion may start."""
        kept = self._tracker.state.starts
        self._path.keep(kept)
        self._headers = {i: h for i, h in self._headers.items() if i in kept}
        self._stamps = {i: s for i, s in self._stamps.items() if i in kept}

    def _is_repeated(self, frame: Frame) -> bool:
        """Whether a frame is one that came before, or comes too late."""
        last = self._last_stamp
        if last is None:
            return False
        return last - MAX_CLOCK_JUMP_S < frame.timestamp <= last

    def _start_again_where_needed(self, frame: Frame) -> None:
        """Begin anew at the last pose, where time jumped back or the camera is another one."""
        state = self._tracker.state
        last = self._last_stamp
        if state.frame is None or last is None:
            return
        reason = ""
        if frame.timestamp < last:
            reason = "time jumped back"
        elif state.frame.camera.shape != frame.camera.shape:
            reason = "images of another size"
        if not reason:
            return
        self._say(f"{reason}; tracking begins anew at the last pose")
        self._forget_all()
        self._tracker.set_pose(state.T_world_last)
        self._path.lose()

    def _begin_anew(self) -> None:
        """Begin at the origin, as after the start of the node."""
        self._reset.clear()
        self._say("reset: tracking begins anew at the origin")
        self._forget_all()
        self._path = PathCovariance()
        self._imu = None
        self._last_stamp = None

    def _forget_all(self) -> None:
        self._restarts += 1
        self._tracker.reset()
        self._headers.clear()
        self._stamps.clear()

    def _say_once(self, text: str) -> None:
        if text != self._last_said:
            self._say(text)
        self._last_said = text


def make_tracker(node: NodeOptions, options: Options) -> Odometry:
    """Make the tracker of a node, compiled and loaded.

    Args:
        node: Which weights.
        options: The options.

    Raises:
        InputError: The method is not known.
        CheckpointError: The weights cannot be read.
    """
    method = check_method(options.run.method)
    weights = {"pwvo": node.weights} if node.weights else None
    models = Models(options.run.device, weights)
    flow = dis_flow(options.flow.dis_preset)
    seed = options.run.seed
    tracker = Odometry(models, flow=flow, method=method, options=options, seed=seed)
    # else the first frames would wait for it
    tracker.warm_up()
    return tracker
