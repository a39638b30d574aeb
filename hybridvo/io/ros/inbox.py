"""What waits to be tracked: images, until their camera and the place of the base are known."""

from __future__ import annotations

import threading
import time
from collections import deque
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from hybridvo.core.imu import ImuSamples
from hybridvo.io.data.bags.messages import rigid, transform_between
from hybridvo.io.ros.conversions import Mount, base_mount, optical_mount
from hybridvo.io.ros.frames import stamp_ns
from hybridvo.io.ros.gyroscope import Rates, has_rates
from hybridvo.io.ros.parameters import NodeOptions

# s that a frame waits for samples up to its stamp: a gyroscope of 100 Hz hands one
# out every .01 s, and DDS delivers it in less
IMU_PATIENCE_S = 0.05


class Arrived(NamedTuple):
    """The messages of a frame, how its camera is mounted, and what a gyroscope measured before."""

    rgb: Any
    depth: Any
    info: Any
    mount: Mount
    imu: ImuSamples | None = None


class Inbox:
    """Holds frames until they are tracked; where there is no room, the oldest one goes.

    Messages may be added in any thread. Frames are held back until a ``CameraInfo`` has come,
    and, where the pose of a base is wanted, the transform between it and the camera. Where there
    is a gyroscope, a frame also waits for its samples, but not for long.

    Args:
        options: How many may wait, and which frame is the base.
        say: Gets a sentence about what is waited for.
        patience_s: How long a frame waits for samples of the gyroscope.

    Attributes:
        dropped: frames that had to go.
    """

    def __init__(
        self,
        options: NodeOptions,
        say: Callable[[str], None],
        patience_s: float = IMU_PATIENCE_S,
    ) -> None:
        self.dropped = 0
        self._patience_s = patience_s
        self._rates = Rates()
        # since when the first frame waits for the gyroscope, by the clock of time.monotonic
        self._waits_since: float | None = None
        # the stamp of a frame that waited in vain: before samples reach it none waits again
        self._given_up_ns: int | None = None
        self._options = options
        self._say = say
        self._waiting: deque[tuple[Any, Any]] = deque()
        self._info: Any = None
        self._edges: dict[tuple[str, str], np.ndarray] = {}
        self._changed = threading.Condition()
        self._is_closed = False
        self._said: set[str] = set()

    def add_images(self, rgb: Any, depth: Any) -> None:
        """Add two messages of one moment."""
        with self._changed:
            if len(self._waiting) == self._options.queue_size:
                self._waiting.popleft()
                self.dropped += 1
            self._waiting.append((rgb, depth))
            self._changed.notify()

    def add_info(self, info: Any) -> None:
        """Take over a ``CameraInfo``."""
        with self._changed:
            self._info = info
            self._changed.notify()

    def add_imu(self, message: Any) -> None:
        """Take over a sample of the gyroscope."""
        with self._changed:
            if not has_rates(message):
                topic = self._options.topic_imu
                self._say_once(f"{topic} states that it has no rates: not used")
                return
            first = stamp_ns(self._waiting[0][0]) if self._waiting else None
            self._rates.add(message, first)
            self._changed.notify()

    def add_transforms(self, message: Any) -> None:
        """Take over the transforms of a message of ``/tf_static``."""
        with self._changed:
            for each in message.transforms:
                parent = _name(each.header.frame_id)
                child = _name(each.child_frame_id)
                moved = each.transform
                T = rigid(moved.translation, moved.rotation)
                if T is not None:
                    self._edges[parent, child] = T
            self._changed.notify()

    def close(self, finish: bool = False) -> None:
        """Let :meth:`take` end.

        Args:
            finish: Whether the frames that wait are still handed out.
        """
        with self._changed:
            self._is_closed = True
            if not finish:
                self._waiting.clear()
            self._changed.notify()

    def take(self) -> Arrived | None:
        """Wait for the next frame; None after :meth:`close`, when there are no more."""
        with self._changed:
            while True:
                arrived = self._next()
                if arrived is not None or self._is_closed:
                    return arrived
                self._changed.wait(self._remaining_s())

    def _next(self) -> Arrived | None:
        if not self._waiting:
            return None
        if self._info is None:
            self._say_once(f"waiting for a CameraInfo on {self._options.info}")
            return None
        rgb, depth = self._waiting[0]
        optical = _name(rgb.header.frame_id)
        mount = self._mount(optical)
        if mount is None:
            base = self._options.base_frame
            self._say_once(
                f"waiting for a transform between '{base}' and '{optical}' in /tf_static"
            )
            return None
        if not self._imu_is_here(rgb):
            return None
        self._say_of_parents(mount.child)
        self._waiting.popleft()
        return Arrived(rgb, depth, self._info, mount, self._imu(rgb))

    # -- the gyroscope ---------------------------------------------------------------------

    def _imu_is_here(self, rgb: Any) -> bool:
        """Whether the samples of a frame have come, or are not waited for any longer."""
        if not self._options.topic_imu or self._is_closed:
            return True
        has_come = self._rates.reach(stamp_ns(rgb))
        has_given_up = not self._rates.reach(self._given_up_ns)
        if has_come or has_given_up:
            self._waits_since = None
            return True
        now = time.monotonic()
        if self._waits_since is None:
            self._waits_since = now
        if now - self._waits_since < self._patience_s:
            return False
        self._waits_since = None
        self._given_up_ns = stamp_ns(rgb)
        return True

    def _remaining_s(self) -> float | None:
        """How much longer the first frame waits for the gyroscope; None where it does not."""
        if self._waits_since is None:
            return None
        return max(self._waits_since + self._patience_s - time.monotonic(), 0.0)

    def _imu(self, rgb: Any) -> ImuSamples | None:
        """What the gyroscope measured before a frame, and after those that were handed out."""
        if not self._options.topic_imu:
            return None
        topic = self._options.topic_imu
        R_cam_imu = self._R_cam_imu(rgb)
        samples = self._rates.taken(stamp_ns(rgb), R_cam_imu)
        if self._rates.latest_ns is not None and R_cam_imu is None:
            self._say_once(
                f"{topic} is not used: no /tf_static between '{self._rates.frame_id}' and "
                f"'{_name(rgb.header.frame_id)}'"
            )
        elif samples is None:
            self._say_once(
                f"no sample on {topic} between two frames: tracking goes on without"
            )
        return samples

    def _R_cam_imu(self, rgb: Any) -> np.ndarray | None:
        """(3, 3) from the axes of the gyroscope to those of the camera; None where unknown."""
        optical = _name(rgb.header.frame_id)
        T = transform_between(self._edges, optical, self._rates.frame_id)
        return None if T is None else T[:3, :3]

    # -- frames of reference ---------------------------------------------------------------

    def _mount(self, optical: str) -> Mount | None:
        base = self._options.base_frame.lstrip("/")
        if base in ("", optical):
            return optical_mount(optical)
        T_base_cam = transform_between(self._edges, base, optical)
        return None if T_base_cam is None else base_mount(base, T_base_cam)

    def _say_of_parents(self, frame: str) -> None:
        """State where a frame would get a second parent, of which tf takes only one."""
        parents = [parent for parent, child in self._edges if child == frame]
        if self._options.publish_tf and parents:
            self._say_once(
                f"publish_tf: '{frame}' has the parent '{parents[0]}' in /tf_static already: "
                "give the root of its tree as base_frame"
            )

    def _say_once(self, text: str) -> None:
        if text not in self._said:
            self._say(text)
        self._said.add(text)


def _name(frame_id: Any) -> str:
    """The name of a frame; ROS 1 may begin it with a slash."""
    return str(frame_id).lstrip("/")
