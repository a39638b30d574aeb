"""A camera that follows a script, and a tracker that only counts."""

from __future__ import annotations

import threading
from collections.abc import Callable
from typing import Any

import numpy as np

import hybridvo as hvo
from hybridvo.io.cameras.base import EndOfFrames, Reading
from hybridvo.io.live import LiveStream, Patience
from hybridvo.tracking.camera_drift import Mean
from hybridvo.tracking.keyframes import Keyframe
from hybridvo.tracking.tracker_state import TrackerState

CAMERA = hvo.Camera(fx=50, fy=50, cx=7.5, cy=5.5, height=12, width=16)
LONG_S = 60.0
"""No test waits so long, unless something is wrong."""
QUICK = Patience(
    max_age_s=LONG_S,
    silence_s=LONG_S,
    first_retry_s=0.001,
    max_retry_s=0.004,
    absence_s=LONG_S,
    closing_s=LONG_S,
)


def frame(stamp: float, depth: float | None = 2.0, camera=CAMERA) -> hvo.Frame:
    """A frame of a grey wall."""
    rgb = np.full((*camera.shape, 3), 90, np.uint8)
    wall = None if depth is None else np.full(camera.shape, depth, np.float32)
    return hvo.Frame(rgb, wall, camera, stamp)


def reading(stamp: float, **more: Any) -> Reading:
    """A frame as a camera hands it out."""
    depth = more.pop("depth", 2.0)
    camera = more.pop("camera", CAMERA)
    return Reading(frame(stamp, depth, camera), **more)


class ScriptedCamera:
    """Hands out readings, raises exceptions and calls functions, in the order of a script.

    It waits until a frame was taken before it goes on, unless it is ``hasty``. After the script
    the recording is over.
    """

    name = "scripted"

    def __init__(self, *script: Any, hasty: bool = False) -> None:
        self.script = list(script)
        self.hasty = hasty
        self.stream: LiveStream | None = None
        self.calls: list[str] = []

    def open(self) -> None:
        self.calls.append("open")
        if self.script and isinstance(self.script[0], OpenFails):
            raise self.script.pop(0).error

    def read(self, timeout_s: float) -> Reading | None:
        if not self.hasty:
            wait_until(lambda: self.stream._reader._newest is None)
        if not self.script:
            raise EndOfFrames
        item = self.script.pop(0)
        if isinstance(item, Exception):
            raise item
        if callable(item):
            return item()
        return item

    def close(self) -> None:
        self.calls.append("close")


class OpenFails:
    """A line of a script: the camera cannot be opened."""

    def __init__(self, error: Exception) -> None:
        self.error = error


class Tracker:
    """Counts frames in place of an Odometry."""

    method = "counting"

    def __init__(self, *_: Any, **__: Any) -> None:
        self.state = TrackerState()
        self.frames: list[hvo.Frame] = []
        self.samples: list[hvo.ImuSamples | None] = []
        self.set_poses: list[np.ndarray] = []
        self.on_track: Callable[[int], None] = lambda count: None
        self.readout: Mean | None = None
        self.readout_ms = 0.0

    def warm_up(self) -> None:
        """Nothing is compiled."""

    def reset(self) -> None:
        self.state = TrackerState()

    def set_pose(self, T: np.ndarray) -> None:
        self.set_poses.append(T)

    def track(
        self, frame: hvo.Frame, imu: hvo.ImuSamples | None = None
    ) -> hvo.Step:
        self.frames.append(frame)
        self.samples.append(imu)
        count = len(self.frames)
        self.on_track(count)
        T = np.eye(4)
        T[0, 3] = count
        self.state = TrackerState(
            Keyframe(frame, T, count - 1, count - 1, np.eye(6)),
            T_world_last=T,
            count=count,
        )
        status = hvo.Status()
        if frame.depth is None:
            status = hvo.Status.failed(hvo.Reason.NO_VALID_DEPTH, "no depth")
        motion = hvo.RelativePose(status=status)
        before = None if count == 1 else count - 2
        return hvo.Step(count - 1, frame.timestamp, T, motion, before)


def wait_until(is_so: Callable[[], bool]) -> None:
    """Wait for another thread."""
    pause = threading.Event()
    for _ in range(int(LONG_S / 0.001)):
        if is_so():
            return
        pause.wait(0.001)
    raise AssertionError("waited for nothing")


class Clock:
    """Time that passes when somebody sleeps."""

    def __init__(self) -> None:
        self.now = 100.0
        self.slept: list[float] = []

    def __call__(self) -> float:
        return self.now

    def sleep(self, seconds: float) -> None:
        self.slept.append(seconds)
        self.now += seconds
