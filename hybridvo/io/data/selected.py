"""Sequences made of another one: some of its frames, or all with other times."""

from __future__ import annotations

from collections.abc import Iterable
from collections.abc import Sequence as Indices
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from hybridvo.core.types import Camera, Frame
from hybridvo.io.data.lists import RATE_IS_ASSUMED
from hybridvo.io.data.resize import resize_camera, resize_frame
from hybridvo.io.data.sequence import Files, Sequence


class SelectedSequence(Sequence):
    """Frames of another sequence, in the same order.

    Flow files are those between frames that were neighbours; scaled frames have none.

    Args:
        original: The other sequence.
        indices: Which of its frames, increasing.
        size: Height and width to which they are scaled, pixels; None: as they are.
        poses: (N, 4, 4) true T_world_cam of these frames, NaN where unknown; None: the
            original's.

    Example:
        >>> halves = SelectedSequence(sequence, range(0, 90, 3))  # doctest: +SKIP
    """

    def __init__(
        self,
        original: Sequence,
        indices: Indices[int],
        size: tuple[int, int] | None = None,
        poses: np.ndarray | None = None,
    ) -> None:
        self._take_over(original)
        self._original = original
        self._indices = [int(index) for index in indices]
        self._scaled_to = size
        if size is not None:
            self.height, self.width = size
        self.timestamps = original.timestamps[self._indices]
        self.rgb_files = self._of(original.rgb_files)
        self.depth_files = self._of(original.depth_files)
        self.mask_files = self._of(original.mask_files)
        self.flow_files = self._flow_files()
        self.warnings = list(original.warnings)
        if poses is not None:
            self.poses = poses
        elif original.poses is not None:
            self.poses = original.poses[self._indices]

    def _of(self, files: Files) -> Files:
        """Return the files of the selected frames."""
        return [files[index] for index in self._indices]

    def _flow_files(self) -> Files:
        """Return the flow files that lead from one selected frame to the next one."""
        count = len(self._indices)
        files: Files = [None] * count
        stored = self._original.flow_files
        if self._scaled_to is not None or not stored:
            return files
        for place, index in enumerate(self._indices[:-1]):
            if self._indices[place + 1] == index + 1:
                files[place] = stored[index]
        return files

    def camera(self, index: int) -> Camera:
        """Return the camera of a frame at its size."""
        camera = self._original.camera(self._indices[index])
        if self._scaled_to is None:
            return camera
        return resize_camera(camera, *self._scaled_to)

    def frame(self, index: int) -> Frame:
        """Read a frame; see :meth:`Sequence.frame`."""
        frame = self._original.frame(self._indices[index])
        frame = replace(frame, index=index)
        if self._scaled_to is None:
            return frame
        return resize_frame(frame, *self._scaled_to)

    def flow(self, index: int) -> tuple[np.ndarray, np.ndarray | None]:
        """Read the flow from a frame to the next one; see :meth:`Sequence.flow`."""
        if self.flow_files[index] is None:
            raise FileNotFoundError(
                f"{self.name}: there is no flow file from frame {index} on."
            )
        return self._original.flow(self._indices[index])

    def opened_with(self) -> dict[str, Any]:
        """Return the settings that decide how the files are read, JSON-ready."""
        settings = self._original.opened_with()
        size = self._scaled_to
        return settings | {
            "frames": self._indices,
            "size": None if size is None else list(size),
        }


class WholeSequence(Sequence):
    """All frames of another sequence, as they are; a class made of this one states what differs.

    Args:
        original: Any sequence.

    Example:
        >>> same = WholeSequence(sequence)  # doctest: +SKIP
    """

    def __init__(self, original: Sequence) -> None:
        self._take_over(original)
        self._original = original

    def camera(self, index: int) -> Camera:
        """Return the camera of a frame."""
        return self._original.camera(index)

    def frame(self, index: int) -> Frame:
        """Read a frame; see :meth:`Sequence.frame`."""
        return self._original.frame(index)

    def flow(self, index: int) -> tuple[np.ndarray, np.ndarray | None]:
        """Read the flow from a frame to the next one; see :meth:`Sequence.flow`."""
        return self._original.flow(index)

    def files(self) -> list[Path]:
        """Return every file that is read."""
        return self._original.files()


class RateSequence(WholeSequence):
    """Another sequence, whose frames come at a rate that the user states.

    Args:
        original: Any sequence; its own time stamps do not count.
        fps: Frames a second.

    Example:
        >>> slow = RateSequence(sequence, 15.0)  # doctest: +SKIP
    """

    def __init__(self, original: Sequence, fps: float) -> None:
        super().__init__(original)
        self.timestamps = np.arange(len(original)) / fps
        # nothing is assumed of the rate any more
        self.warnings = _without_assumed_rate(original.warnings)
        self.assumed = tuple(_without_assumed_rate(original.assumed))

    def frame(self, index: int) -> Frame:
        """Read a frame; see :meth:`Sequence.frame`."""
        frame = super().frame(index)
        return replace(frame, timestamp=float(self.timestamps[index]))

    def opened_with(self) -> dict[str, Any]:
        """Return the settings that decide how the files are read, JSON-ready."""
        settings = self._original.opened_with()
        return settings | {"timestamps": [0.0, *self.timestamps[1:2].tolist()]}


def _without_assumed_rate(sentences: Iterable[str]) -> list[str]:
    """Return those sentences that assume no rate of the frames."""
    return [text for text in sentences if RATE_IS_ASSUMED not in text]


class TimedSequence(WholeSequence):
    """Another sequence, of whose camera the user states at which times it measures.

    Args:
        original: Any sequence.
        times: ``readout_ms``, ``depth_lag_ms`` or both, see :class:`Camera`.

    Example:
        >>> rolling = TimedSequence(sequence, {"readout_ms": 30.0})  # doctest: +SKIP
        >>> rolling.camera(0).readout_ms  # doctest: +SKIP
        30.0
    """

    def __init__(self, original: Sequence, times: dict[str, float]) -> None:
        super().__init__(original)
        self._times = times

    def camera(self, index: int) -> Camera:
        """Return the camera of a frame, with its times."""
        return replace(super().camera(index), **self._times)  # type: ignore[arg-type]

    def frame(self, index: int) -> Frame:
        """Read a frame; see :meth:`Sequence.frame`."""
        frame = super().frame(index)
        return replace(frame, camera=self.camera(index))

    def opened_with(self) -> dict[str, Any]:
        """Return the settings that decide how the files are read, JSON-ready."""
        settings = self._original.opened_with()
        return settings | self._times
