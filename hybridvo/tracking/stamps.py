"""Whether the stamps of frames rise, as those of a clock do."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Clock:
    """The stamp of the last frame, and whether it came after the one before.

    Attributes:
        stamp: of the last frame, seconds; None before the first one.
        rises: whether the last two frames came one after the other. Frames without
            stamps all have the same one: they are taken to be evenly spaced.

    Example:
        >>> clock = Clock().after(1.0).after(1.1)
        >>> clock.breaks_at(1.2), clock.breaks_at(0.9)
        (False, True)
    """

    stamp: float | None = None
    rises: bool = False

    def after(self, stamp: float) -> Clock:
        """Return the clock after a frame of this stamp, seconds."""
        return Clock(stamp, self.stamp is not None and stamp > self.stamp)

    def breaks_at(self, stamp: float) -> bool:
        """Whether a stamp, seconds, stands still or runs backwards where stamps rose."""
        return self.rises and self.stamp is not None and stamp <= self.stamp
