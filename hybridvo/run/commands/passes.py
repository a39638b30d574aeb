"""The passes over a sequence before the one whose results are kept."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

from rich.console import Console
from rich.markup import escape
from rich.progress import Progress

from hybridvo.core.errors import InputError, printable
from hybridvo.core.types import Camera, Frame
from hybridvo.io.data.selected import WholeSequence
from hybridvo.io.data.sequence import Sequence
from hybridvo.odometry import Odometry
from hybridvo.run.commands.frame_reading import FramesAhead, samples_before, skipped
from hybridvo.run.commands.stopping import stop_requested
from hybridvo.tracking.passes import PixelTimes, TimesFinder, finders


class InTimeSequence(WholeSequence):
    """Another sequence, of each of whose frames all is of one time.

    Args:
        original: Any sequence.
        times: When the pixels of its frames were measured, and how the camera moved then.

    Example:
        >>> same = InTimeSequence(sequence, PixelTimes())  # doctest: +SKIP
    """

    def __init__(self, original: Sequence, times: PixelTimes) -> None:
        super().__init__(original)
        self._times = times

    def camera(self, index: int) -> Camera:
        """Return the camera of a frame, which states no times where none are left."""
        camera = self._times.camera(super().camera(index))
        if index not in self._times.velocities:
            return camera
        return replace(camera, readout_ms=0.0, depth_lag_ms=0.0)

    def frame(self, index: int) -> Frame:
        """Read a frame; see :meth:`Sequence.frame`."""
        return self._times.frame(super().frame(index))


def times_after_passes(
    sequence: Sequence,
    frames: range,
    make_tracker: Callable[[], Odometry],
    passes: int,
    quiet: bool,
) -> PixelTimes:
    """Track a sequence, and return what that shows of the times of its pixels.

    Args:
        sequence: The sequence.
        frames: Which of its frames.
        make_tracker: Returns a new tracker for each pass.
        passes: How often it is tracked.
        quiet: Whether no progress is shown.

    Raises:
        InputError: A frame cannot be read, and ``run.strict`` is set.
    """
    console = Console(stderr=True, quiet=quiet, markup=False, highlight=False)
    name = printable(sequence.name)
    times = PixelTimes()
    with Progress(console=console) as bar, stop_requested() as stop:
        for number, finder in enumerate(finders(passes)):
            label = escape(f"{name} [pass {number + 1} of {passes + 1}]")
            task = bar.add_task(label, total=len(frames))
            tracker = make_tracker()
            in_time = InTimeSequence(sequence, finder.known)
            ahead = FramesAhead(in_time, frames)
            for index in frames:
                _track(in_time, ahead, index, tracker, finder)
                bar.advance(task)
                stop.raise_if_requested(done=f"{number} of {passes + 1} passes")
            times = finder.found()
    return times


def _track(
    sequence: InTimeSequence,
    ahead: FramesAhead,
    index: int,
    tracker: Odometry,
    finder: TimesFinder,
) -> None:
    """Track a frame of a pass."""
    try:
        frame = ahead.frame(index)
        following = ahead.after(frame)
    except (InputError, OSError) as error:
        skipped(sequence, index, tracker, error)
        return
    samples = samples_before(sequence, frame, tracker)
    step = tracker.track(frame, imu=samples, following=following)
    finder.add(frame, step)
