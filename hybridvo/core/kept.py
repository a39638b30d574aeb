"""What is computed of a frame or a pair once, and kept as long as it."""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Generic, TypeVar
from weakref import WeakKeyDictionary

from hybridvo.core.types import Frame

Owner = TypeVar("Owner")
Kept = TypeVar("Kept")


class kept_with(Generic[Owner, Kept]):
    """Compute something of an object once, and keep it as long as the object.

    Args:
        compute: what is kept, from an object that is not changed.

    >>> from hybridvo.core.types import Camera
    >>> @kept_with
    ... def rows(frame):
    ...     print("computed")
    ...     return frame.camera.height
    >>> frame = Frame(None, None, Camera(10, 10, 3.5, 2.5, height=6, width=8))
    >>> rows(frame), rows(frame)
    computed
    (6, 6)
    """

    def __init__(self, compute: Callable[[Owner], Kept]) -> None:
        self._compute = compute
        self._kept: WeakKeyDictionary[Owner, Kept] = WeakKeyDictionary()
        functools.update_wrapper(self, compute)

    def __call__(self, owner: Owner) -> Kept:
        """Return what belongs to an object."""
        if owner not in self._kept:
            self._kept[owner] = self._compute(owner)
        return self._kept[owner]

    def keep(self, owner: Owner, value: Kept) -> None:
        """Keep what was computed elsewhere."""
        self._kept[owner] = value


class kept_with_frame(kept_with[Frame, Kept]):
    """The same of a frame."""
