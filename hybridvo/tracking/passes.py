"""A recording tracked in passes, each with what the one before shows of the camera and its path.

A rolling shutter exposes the rows of an image one after the other, and depth may be measured before
or after its image. To bring a frame to one time takes the velocity of the camera while it is taken.
A tracker that runs along must guess it from the frames before, and a hand does not turn evenly. Of
a recording the frames after it are known as well: the path of a first pass gives every frame its
velocity. With the velocities, images also show much better how long the rows take.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from numbers import Integral
from typing import NamedTuple

import numpy as np

from hybridvo.core.checks import check_kind
from hybridvo.core.errors import InputError
from hybridvo.core.results import Step
from hybridvo.core.types import Camera, Frame
from hybridvo.evidence.one_time import at_image_time
from hybridvo.tracking.camera_drift import Mean
from hybridvo.tracking.readout import (
    ReadoutFinder,
    Taken,
    is_known,
    surely_ms,
    velocity_over,
)
from hybridvo.tracking.repeated import repeat_of
from hybridvo.tracking.tracker import Tracker


@dataclass(frozen=True, eq=False)
class PixelTimes:
    """When the pixels of a recording were measured, and how the camera moved meanwhile.

    Attributes:
        readout: time from the first row of an image to the last, ms, that the images show; None
            where too few of them do, and where the cameras state one.
        velocities: (6,) of the camera at each frame, by its index: log of ``T_curr_prev`` a
            second, metres and radians. Empty where all of each frame is of one time.
        readout_is_stated: whether the cameras state a readout, which is believed.

    >>> PixelTimes(Mean(25.0, 2.0, 40)).readout_ms, PixelTimes(Mean(3.0, 2.0, 40)).readout_ms
    (25.0, 0.0)
    """

    readout: Mean | None = None
    velocities: dict[int, np.ndarray] = field(default_factory=dict)
    readout_is_stated: bool = False

    @property
    def readout_is_known(self) -> bool:
        """Whether the images show how long the rows take, or that they take no time."""
        return is_known(self.readout)

    @property
    def readout_ms(self) -> float:
        """The readout where the images surely show one; else 0."""
        return surely_ms(self.readout)

    def camera(self, camera: Camera) -> Camera:
        """Return a camera that states the readout, unless it states one already."""
        if camera.readout_ms or not self.readout_ms:
            return camera
        return replace(camera, readout_ms=self.readout_ms)

    def frame(self, frame: Frame) -> Frame:
        """Return a frame of which all is of one time, or, without a velocity, with its readout."""
        frame = replace(frame, camera=self.camera(frame.camera))
        velocity = self.velocities.get(frame.index)
        return frame if velocity is None else at_image_time(frame, velocity)


class Tracked(NamedTuple):
    """A recording after its last pass."""

    steps: list[Step]
    # by which the frames of the last pass were brought to one time
    times: PixelTimes


def track_in_passes(
    frames: Sequence[Frame],
    passes: int = 3,
    make_tracker: Callable[[], Tracker] = Tracker,
) -> Tracked:
    """Track a recording several times, each time with what the pass before has shown.

    Where the rolling shutter of the camera is stated (``Camera.readout_ms``), the second pass
    knows how the camera moved while each row was exposed. Where it is not, the passes find it, if
    quick turns of the camera show it; three are then better than two.

    Args:
        frames: N of a camera, with images, depth and rising stamps; the same in each pass.
        passes: how often they are tracked.
        make_tracker: returns a new tracker for each pass.

    Returns:
        The steps of the last pass, and the times that it knew.

    Raises:
        InputError: for a number of passes that is none, for frames that can be read only once, for
            two of one index, and for a tracker that is not new.

    Example:
        >>> import hybridvo as hvo
        >>> tracked = track_in_passes(hvo.example_frames(), passes=2)
        >>> len(tracked.steps), tracked.times.readout_ms
        (3, 0.0)
    """
    if not isinstance(passes, Integral) or passes < 1:
        raise InputError(
            f"track_in_passes.passes: expected a whole number from 1 on, got {passes!r}."
        )
    _check_can_be_read_again(frames)
    times = find_times(frames, int(passes) - 1, make_tracker)
    tracker = _new_tracker(make_tracker)
    steps = [tracker.track(times.frame(frame)) for frame in numbered(frames)]
    return Tracked(steps, times)


def find_times(
    frames: Sequence[Frame],
    passes: int = 2,
    make_tracker: Callable[[], Tracker] = Tracker,
) -> PixelTimes:
    """Return when the pixels of a recording were measured, by tracking it some times.

    Args:
        frames: as of :func:`track_in_passes`.
        passes: how often they are tracked at most; once more would change nothing where all of
            each frame is of one time.
        make_tracker: returns a new tracker for each pass.
    """
    times = PixelTimes()
    for finder in finders(passes):
        tracker = _new_tracker(make_tracker)
        for frame in numbered(frames):
            in_time = finder.known.frame(frame)
            finder.add(in_time, tracker.track(in_time))
        times = finder.found()
    return times


def finders(passes: int) -> Iterator[TimesFinder]:
    """Yield what each pass is to fill, which knows what the one before has found.

    The passes end where another one would show the same.
    """
    known = PixelTimes()
    for _ in range(passes):
        finder = TimesFinder(known)
        yield finder
        known = finder.found()
        if not known.velocities:
            return


def numbered(frames: Iterable[Frame]) -> Iterator[Frame]:
    """Frames with an index: their own, or their number; no two have the same."""
    number_of: dict[int, int] = {}
    for number, frame in enumerate(frames):
        check_kind(f"track_in_passes.frames, frame {number}", frame, Frame)
        if frame.index is None:
            frame = replace(frame, index=number)
        before = number_of.setdefault(frame.index, number)
        if before != number:
            raise InputError(
                f"track_in_passes.frames, frame {number}: expected an index of its own, got "
                f"{frame.index}, that of frame {before}; without any index they are counted."
            )
        yield frame


def _check_can_be_read_again(frames: object) -> None:
    """Raise an InputError for what is no list of frames, and for a generator."""
    where = "track_in_passes.frames: expected a list of frames"
    got = type(frames).__name__
    try:
        is_read_once = iter(frames) is frames  # type: ignore[call-overload]
    except TypeError:
        raise InputError(f"{where}, got {got}.") from None
    if is_read_once:
        raise InputError(
            f"{where}, which each pass reads anew; got {got}: pass list(frames)."
        )


def _new_tracker(make_tracker: Callable[[], Tracker]) -> Tracker:
    """A tracker for a pass; an InputError unless it is one that has tracked nothing."""
    where = "track_in_passes.make_tracker"
    if not callable(make_tracker):
        got = type(make_tracker).__name__
        raise InputError(
            f"{where}: expected a function that returns a new tracker, got {got}."
        )
    tracker = make_tracker()
    check_kind(f"{where}()", tracker, Tracker)
    if tracker.state.count:
        raise InputError(
            f"{where}(): expected a new tracker, got one that has tracked "
            f"{tracker.state.count} frames."
        )
    return tracker


class TimesFinder:
    """What a pass shows of the times of a recording's pixels; frames are handed in one by one.

    Args:
        known: by what the frames of this pass are brought to one time; None in the first one.
    """

    def __init__(self, known: PixelTimes | None = None) -> None:
        self.known = known or PixelTimes()
        self._velocities: dict[int, np.ndarray] = {}
        self._readout = ReadoutFinder()
        self._last: Frame | None = None
        # a tracker knows what a camera handed out again by its bytes, which must stay as they are
        self._as_taken: set[int] = set()
        # whether frames state a readout, and whether they state any time
        self._readout_is_stated = self.known.readout_is_stated
        self._states_times = bool(self.known.velocities)

    def add(self, frame: Frame, step: Step) -> None:
        """Take note of the next frame, as it was tracked, and of what the tracker said."""
        if not self.known.velocities:
            # as it was taken
            camera = frame.camera
            self._readout_is_stated |= camera.readout_ms != 0
            self._states_times |= camera.readout_ms != 0 or camera.depth_lag_ms != 0
        repeat = repeat_of(self._last, frame)
        if self._last is not None and any(repeat):
            self._as_taken |= {self._last.index, frame.index}
        self._last = frame
        taken = Taken(frame, step, repeat.entire)
        self._readout.add(taken, may_show=not self._readout_is_stated)
        self._learn_velocities()

    def found(self) -> PixelTimes:
        """Return what the frames so far show."""
        readout = self.known.readout
        left = self._readout.mean()
        if left is not None:
            readout = left._replace(error=self.known.readout_ms + left.error)
        velocities = {
            index: velocity
            for index, velocity in self._velocities.items()
            if index not in self._as_taken
        }
        times = PixelTimes(readout, velocities, self._readout_is_stated)
        if self._states_times or times.readout_ms:
            return times
        return PixelTimes(readout)

    def _learn_velocities(self) -> None:
        """Learn the velocity at the last frame, and anew at the one before it.

        The one before has a neighbour on either side now. Where either is of no use, the other
        one tells.
        """
        taken = list(self._readout.window)
        if len(taken) == 1:
            return
        prev, last = taken[-2:]
        pair = taken[-2:]
        for at, around in ((last, pair), (prev, pair), (prev, taken[-3:])):
            velocity = velocity_over(around)
            if velocity is not None:
                self._velocities[at.frame.index] = velocity
