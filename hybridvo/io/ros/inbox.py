"""What waits to be tracked: images, until their camera and the place of the base are known."""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from hybridvo.io.data.bags.messages import rigid, transform_between
from hybridvo.io.ros.conversions import Mount, base_mount, optical_mount
from hybridvo.io.ros.parameters import NodeOptions


class Arrived(NamedTuple):
    """The messages of a frame, and how its camera is mounted."""

    rgb: Any
    depth: Any
    info: Any
    mount: Mount


class Inbox:
    """Holds frames until they are tracked; where there is no room, the oldest one goes.

    Messages may be added in any thread. Frames are held back until a ``CameraInfo`` has come,
    and, where the pose of a base is wanted, the transform between it and the camera.

    Args:
        options: How many may wait, and which frame is the base.
        say: Gets a sentence about what is waited for.

    Attributes:
        dropped: frames that had to go.
    """

    def __init__(self, options: NodeOptions, say: Callable[[str], None]) -> None:
        self.dropped = 0
        self._options = options
        self._say = say
        self._waiting: deque[tuple[Any, Any]] = deque()
        self._info: Any = None
        self._edges: dict[tuple[str, str], np.ndarray] = {}
        self._changed = threading.Condition()
        self._is_closed = False
        self._last_said = ""

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

    def add_transforms(self, message: Any) -> None:
        """Take over the transforms of a message of ``/tf_static``."""
        with self._changed:
            for each in message.transforms:
                parent = str(each.header.frame_id).lstrip("/")
                child = str(each.child_frame_id).lstrip("/")
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
                self._changed.wait()

    def _next(self) -> Arrived | None:
        if not self._waiting:
            return None
        if self._info is None:
            self._say_once(f"waiting for a CameraInfo on {self._options.info}")
            return None
        rgb, depth = self._waiting[0]
        optical = str(rgb.header.frame_id).lstrip("/")
        mount = self._mount(optical)
        if mount is None:
            base = self._options.base_frame
            self._say_once(
                f"waiting for a transform between '{base}' and '{optical}' in /tf_static"
            )
            return None
        self._say_of_parents(mount.child)
        self._waiting.popleft()
        return Arrived(rgb, depth, self._info, mount)

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
        if text != self._last_said:
            self._say(text)
        self._last_said = text
