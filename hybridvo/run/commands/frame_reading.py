"""What a tracker is handed of a frame on disk, and what becomes of one that cannot be read."""

from __future__ import annotations

from hybridvo.core.errors import InputError
from hybridvo.core.imu import ImuSamples
from hybridvo.core.results import Step
from hybridvo.core.types import Frame
from hybridvo.evidence.one_time import states_times
from hybridvo.io.data.sequence import Sequence
from hybridvo.odometry import Odometry


class FramesAhead:
    """The frames of a run, each with the one after it where that tells of this one.

    Args:
        sequence: The sequence.
        frames: The numbers of the frames, in order.
    """

    def __init__(self, sequence: Sequence, frames: range) -> None:
        self._sequence = sequence
        self._frames = frames
        self._read: dict[int, Frame] = {}

    def frame(self, index: int) -> Frame:
        """Read a frame; see :meth:`Sequence.frame`."""
        read = self._read.pop(index, None)
        return self._sequence.frame(index) if read is None else read

    def after(self, frame: Frame) -> Frame | None:
        """Return the frame after one whose pixels were measured at several times.

        It is None where the velocity of the camera makes no difference, and where there is none
        that can be read.
        """
        index = frame.index
        assert index is not None
        next_index = index + self._frames.step
        if not states_times(frame.camera) or next_index not in self._frames:
            return None
        try:
            self._read = {next_index: self._sequence.frame(next_index)}
        except (InputError, OSError):
            return None
        return self._read[next_index]


def samples_before(
    sequence: Sequence, frame: Frame, tracker: Odometry
) -> ImuSamples | None:
    """Return what an IMU of the recording measured since the frame that the tracker saw last."""
    last = tracker.state.sensors.last
    if last is None:
        return None
    return sequence.imu(last.timestamp, frame.timestamp)


def skipped(
    sequence: Sequence, index: int, tracker: Odometry, error: Exception
) -> Step:
    """Return the step of a frame that cannot be read.

    Args:
        sequence: The sequence.
        index: Of the frame.
        tracker: Passes over it.
        error: Why it cannot be read.

    Raises:
        InputError: ``run.strict`` is set.
    """
    if tracker.options.run.strict:
        raise InputError(f"frame {index}: {error}") from error
    return tracker.skip(index, float(sequence.timestamps[index]), str(error))
