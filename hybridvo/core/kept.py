"""What is computed of a frame once, and kept as long as the frame."""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Generic, TypeVar
from weakref import WeakKeyDictionary

from hybridvo.core.types import Frame

Kept = TypeVar("Kept")


class kept_with_frame(Generic[Kept]):
    """Compute something of a frame once, and keep it as long as the frame.

    Args:
        compute: what is kept, from a frame that is not changed.

    >>> from hybridvo.core.types import Camera
    >>> @kept_with_frame
    ... def rows(frame):
    ...     print("computed")
    ...     return frame.camera.height
    >>> frame = Frame(None, None, Camera(10, 10, 3.5, 2.5, 6, 8))
    >>> rows(frame), rows(frame)
    computed
    (6, 6)
    """

    def __init__(self, compute: Callable[[Frame], Kept]) -> None:
        self._compute = compute
        self._kept: WeakKeyDictionary[Frame, Kept] = WeakKeyDictionary()
        functools.update_wrapper(self, compute)

    def __call__(self, frame: Frame) -> Kept:
        """Return what belongs to a frame."""
        if frame not in self._kept:
            self._kept[frame] = self._compute(frame)
        return self._kept[frame]

    def keep(self, frame: Frame, value: Kept) -> None:
        """Keep what was computed elsewhere."""
        self._kept[frame] = value
