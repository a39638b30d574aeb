"""What a tracker is handed of a frame on disk, and what becomes of one that cannot be read."""

from __future__ import annotations

from hybridvo.core.errors import InputError
from hybridvo.core.imu import ImuSamples
from hybridvo.core.results import Step
from hybridvo.core.types import Frame
from hybridvo.io.data.sequence import Sequence
from hybridvo.odometry import Odometry


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
