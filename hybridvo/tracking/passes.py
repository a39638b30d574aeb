"""A recording tracked in passes, each with what the one before shows of the camera and its path.

A rolling shutter exposes the rows of an image one after the other, and depth may be measured before
or after its image. To bring a frame to one time takes the velocity of the camera while it is taken.
A tracker that runs along must guess it from the frames before, and a hand does not turn evenly. Of
a recording the frames after it are known as well: the path of a first pass gives every frame its
velocity. With the velocities, images also show much better how long the rows take.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field, replace
from typing import NamedTuple

import numpy as np

from hybridvo.core.checks import as_number
from hybridvo.core.errors import InputError
from hybridvo.core.geometry import invert, se3_log
from hybridvo.core.results import Step
from hybridvo.core.types import Camera, Frame
from hybridvo.evidence.one_time import at_image_time
from hybridvo.tracking.calibration import (
    CAMERA_SIGMAS,
    MAX_EVEN_MS,
    MAX_READOUT_STD_MS,
    MIN_CAMERA_STEPS,
    MIN_STATIC_SHARE,
)
from hybridvo.tracking.camera_drift import Bend, Mean, bends_of, robust_mean
from hybridvo.tracking.odometry import Odometry

# frames whose poses give the velocities of the two in the middle
NEIGHBOURS = 4


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
        return self.readout is not None and self.readout.std < MAX_READOUT_STD_MS

    @property
    def readout_ms(self) -> float:
        """The readout where the images surely show one; else 0."""
        if self.readout is None or not self.readout_is_known:
            return 0.0
        rolls = self.readout.error > CAMERA_SIGMAS * self.readout.std
        return self.readout.error if rolls else 0.0

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
    times: (
        PixelTimes  # by which the frames of the last pass were brought to one time
    )


def track_in_passes(
    frames: Sequence[Frame],
    passes: int = 3,
    make_tracker: Callable[[], Odometry] = Odometry,
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
        InputError: for a number of passes that is none.

    Example:
        >>> from hybridvo.lab.synthetic.scenes import make_scene
        >>> scene = make_scene("static", 0, height=96, width=128, frames=3)
        >>> frames = [scene.render(i) for i in range(3)]
        >>> tracked = track_in_passes(frames, passes=2)
        >>> len(tracked.steps), tracked.times.readout_ms
        (3, 0.0)
    """
    if as_number(passes) % 1 or passes < 1:
        raise InputError(
            f"track_in_passes.passes: expected a whole number from 1 on, got {passes!r}."
        )
    times = find_times(frames, passes - 1, make_tracker)
    tracker = make_tracker()
    steps = [tracker.track(times.frame(frame)) for frame in numbered(frames)]
    return Tracked(steps, times)


def find_times(
    frames: Sequence[Frame],
    passes: int = 2,
    make_tracker: Callable[[], Odometry] = Odometry,
) -> PixelTimes:
    """Return when the pixels of a recording were measured, by tracking it some times.

    Args:
        frames: as of :func:`track_in_passes`.
        passes: how often they are tracked at most; once more would change nothing where all of
            each frame is of one time.
        make_tracker: returns a new tracker for each pass.
    """
    times = PixelTimes()
    for _ in range(passes):
        tracker = make_tracker()
        finder = TimesFinder(times)
        for frame in numbered(frames):
            in_time = times.frame(frame)
            finder.add(in_time, tracker.track(in_time))
        times = finder.found()
        if not times.velocities:
            break
    return times


def numbered(frames: Iterable[Frame]) -> Iterable[Frame]:
    """Frames with an index: their own, or their number."""
    for number, frame in enumerate(frames):
        yield frame if frame.index is not None else replace(frame, index=number)


class _Taken(NamedTuple):
    """A frame as it was tracked, and its step."""

    frame: Frame
    step: Step

    @property
    def leads_from_before(self) -> bool:
        """Whether the step tells how the camera moved since the frame before."""
        return self.step.usable and self.step.prev_index is not None


class TimesFinder:
    """What a pass shows of the times of a recording's pixels; frames are handed in one by one.

    Args:
        known: by what the frames of this pass were brought to one time; None in the first one.
    """

    def __init__(self, known: PixelTimes | None = None) -> None:
        self._known = known or PixelTimes()
        self._velocities: dict[int, np.ndarray] = {}
        self._bends: list[Bend] = []
        self._window: deque[_Taken] = deque(maxlen=NEIGHBOURS)
        # whether frames state a readout, and whether they state any time
        self._readout_is_stated = self._known.readout_is_stated
        self._states_times = bool(self._known.velocities)

    def add(self, frame: Frame, step: Step) -> None:
        """Take note of the next frame, as it was tracked, and of what the tracker said."""
        if not self._known.velocities:
            # as it was taken
            camera = frame.camera
            self._readout_is_stated |= camera.readout_ms != 0
            self._states_times |= camera.readout_ms != 0 or camera.depth_lag_ms != 0
        self._window.append(_Taken(frame, step))
        self._learn_velocities()
        if len(self._window) == NEIGHBOURS:
            self._learn_readout(*self._window)

    def found(self) -> PixelTimes:
        """Return what the frames so far show."""
        readout = self._known.readout
        if len(self._bends) >= MIN_CAMERA_STEPS:
            left = robust_mean(self._bends)
            readout = left._replace(error=self._known.readout_ms + left.error)
        times = PixelTimes(readout, dict(self._velocities), self._readout_is_stated)
        if self._states_times or times.readout_ms:
            return times
        return PixelTimes(readout)

    def _learn_velocities(self) -> None:
        """Learn the velocity at the last frame, and anew at the one before it.

        The one before has a neighbour on either side now.
        """
        *earlier, last = self._window
        if not earlier:
            return
        prev = earlier[-1]
        before = earlier[max(len(earlier) - 2, 0)]
        for at, first in ((last, prev), (prev, before)):
            velocity = _velocity(first, last)
            if velocity is not None:
                self._velocities[at.frame.index] = velocity

    def _learn_readout(
        self, before: _Taken, prev: _Taken, curr: _Taken, after: _Taken
    ) -> None:
        """Learn what the two frames in the middle show of the readout."""
        step = curr.step
        is_neighbour = step.prev_index == prev.frame.index
        is_static = step.ok and step.motion.inlier_ratio > MIN_STATIC_SHARE
        if self._readout_is_stated or not (is_neighbour and is_static):
            return
        if not (prev.leads_from_before and after.leads_from_before):
            return
        at_prev = _velocity(before, curr)
        at_curr = _velocity(prev, after)
        if at_prev is None or at_curr is None:
            return
        everywhere = np.ones(prev.frame.camera.shape, np.float32)
        motion = step.motion.replace(weights=everywhere)
        bends = bends_of(prev.frame, curr.frame, motion, (at_prev, at_curr))
        if bends is not None and bends.readout is not None:
            self._bends.append(bends.readout)


def _velocity(first: _Taken, last: _Taken) -> np.ndarray | None:
    """The mean velocity (6,) from a frame to a later one; None over an unknown or long time."""
    between_s = last.frame.timestamp - first.frame.timestamp
    if not 0 < 1000 * between_s <= 2 * MAX_EVEN_MS:
        return None
    if not last.leads_from_before:
        return None
    T_last_first = invert(last.step.T_world_cam) @ first.step.T_world_cam
    return se3_log(T_last_first) / between_s
