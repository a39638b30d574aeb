"""A recording played at its own rate, as if its camera were connected."""

from __future__ import annotations

import time
from collections.abc import Callable
from pathlib import Path

import numpy as np

from hybridvo.core.errors import InputError
from hybridvo.core.imu import ImuSamples
from hybridvo.io.cameras.base import EndOfFrames, Reading
from hybridvo.io.data.open import open_sequence
from hybridvo.io.data.sequence import Sequence


class FolderCamera:
    """A folder or bag whose frames come when they came, by its time stamps.

    A frame that is due while an earlier one is still being read takes its place, as in a camera.

    Args:
        recording: what :func:`hybridvo.open_sequence` opens or has opened.
        clock: seconds, from any start.
        sleep: waits for some seconds.
        imu: whether the samples of the recording's IMU are handed on, if it has some.

    Attributes:
        fps: frames a second, by the median interval of the stamps; None of a single frame.
        warnings: what the reader noticed, as the topics that it guessed.

    Raises:
        InputError: it cannot be opened.

    Example:
        >>> camera = FolderCamera("drive.bag")  # doctest: +SKIP
    """

    def __init__(
        self,
        recording: str | Path | Sequence,
        clock: Callable[[], float] = time.monotonic,
        sleep: Callable[[float], None] = time.sleep,
        imu: bool = True,
    ) -> None:
        if not isinstance(recording, Sequence):
            recording = open_sequence(recording)
        self.name = recording.name
        self.warnings = recording.warnings
        self._sequence = recording
        self._due = recording.timestamps - recording.timestamps[0]
        usual_s = (
            float(np.median(np.diff(self._due))) if len(self._due) > 1 else 0.0
        )
        self.fps = 1 / usual_s if usual_s > 0 else None
        self._clock = clock
        self._sleep = sleep
        self._started: float | None = None
        self._next = 0
        self._uses_imu = imu
        self._last_stamp: float | None = None  # of the frame handed out before

    def open(self) -> None:
        """Go on where it was; time runs from the first frame that is read."""

    def read(self, timeout_s: float) -> Reading | None:
        """Wait until a frame is due, and read the newest one that is."""
        if self._next >= len(self._due):
            raise EndOfFrames
        if self._started is None:
            self._started = self._clock()
        wait = self._due[self._next] - (self._clock() - self._started)
        if wait > 0:
            self._sleep(min(wait, timeout_s))
            if wait > timeout_s:
                return None
        passed = self._clock() - self._started
        newest = int(np.searchsorted(self._due, passed, side="right")) - 1
        # sleeping may end a moment too early
        index = max(newest, self._next)
        self._next = index + 1
        try:
            frame = self._sequence.frame(index)
        except FileNotFoundError:
            note = f"files are gone since frame {index}"
            return Reading(None, number=index, note=note, is_gone=True)
        except (InputError, OSError) as error:
            return Reading(None, number=index, note=self._note(index, error))
        # a recording that is one file lists none
        listed = dict(enumerate(self._sequence.rgb_files)).get(index)
        if listed is not None and frame.rgb is None:
            note = f"the image of frame {index} is gone: {listed}"
            return Reading(None, number=index, note=note, is_gone=True)
        age = self._clock() - self._started - self._due[index]
        imu = self._samples(frame.timestamp)
        return Reading(frame, max(float(age), 0.0), index, imu=imu)

    def _samples(self, stamp: float) -> ImuSamples | None:
        """What the recording's IMU measured up to a frame since the one before."""
        last = self._last_stamp
        self._last_stamp = stamp
        if last is None or not self._uses_imu:
            return None
        return self._sequence.imu(last, stamp)

    def close(self) -> None:
        """Nothing is held open."""

    def _note(self, index: int, error: Exception) -> str:
        """What is wrong with a frame, without the name of the recording, which comes before."""
        text = str(error).removeprefix(f"{self.name}: ")
        number = f"frame {index}"
        return text if text.startswith(number) else f"{number}: {text}"
