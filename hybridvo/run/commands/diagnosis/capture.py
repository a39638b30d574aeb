"""Frames of a live camera, kept as a recording in memory."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from hybridvo.core.errors import InputError
from hybridvo.core.types import Frame
from hybridvo.io.cameras.base import (
    EndOfFrames,
    LiveCamera,
    Reading,
    warnings_of,
)
from hybridvo.io.live import LIVE_WAIT_S, MAX_SILENCE_S

MAX_CAPTURED = 300
"""Frames that are kept at most; 300 of 640x480 take 0.7 GB."""


@dataclass
class Captured:
    """Frames of a camera, as a sequence without ground truth.

    Attributes:
        name: of the camera.
        frames: as they came.
        lost: frames that never came, by gaps in the camera's own count.
        refused: why frames could not be used, a sentence each.
        asked_fps: frames a second that was requested of the camera; None where unknown.
        warnings: what the camera noticed when it was made.
    """

    name: str
    frames: list[Frame] = field(default_factory=list)
    lost: int = 0
    refused: list[str] = field(default_factory=list)
    asked_fps: float | None = None
    warnings: list[str] = field(default_factory=list)
    poses: None = None
    has_flow: bool = False
    kind: str = "camera"

    @property
    def timestamps(self) -> np.ndarray:
        """(N,) seconds."""
        return np.array([frame.timestamp for frame in self.frames])

    def __len__(self) -> int:
        return len(self.frames)

    def frame(self, index: int) -> Frame:
        """Return a frame."""
        return self.frames[index]


def capture(
    camera: LiveCamera,
    seconds: float,
    asked_fps: float | None = None,
    clock: Callable[[], float] = time.monotonic,
) -> Captured:
    """Keep the frames of a camera for a while.

    Args:
        camera: the camera, which is opened and closed again.
        seconds: how long, from the first frame on.
        asked_fps: frames a second that was requested.
        clock: seconds, from any start.

    Returns:
        The frames, :data:`MAX_CAPTURED` at most.

    Raises:
        InputError: the camera cannot be opened, or gives no frames.

    Example:
        >>> from hybridvo.io.cameras.realsense import RealSenseCamera
        >>> capture(RealSenseCamera(), seconds=5)  # doctest: +SKIP
    """
    captured = Captured(
        camera.name, asked_fps=asked_fps, warnings=warnings_of(camera)
    )
    try:
        camera.open()
        _fill(captured, camera, seconds, clock)
    except EndOfFrames:
        pass
    except InputError:
        raise
    # whatever an SDK raises is a lost camera
    except Exception as error:
        reason = " ".join(str(error).split()) or type(error).__name__
        captured.refused.append(f"the camera was lost: {reason}")
    finally:
        camera.close()
    if not captured.frames:
        reason = "; ".join(captured.refused) or "no frames"
        raise InputError(f"{camera.name}: {reason}.")
    return captured


def _fill(
    captured: Captured,
    camera: LiveCamera,
    seconds: float,
    clock: Callable[[], float],
) -> None:
    """Read frames until there are enough, or none come any more."""
    last = clock()
    first: float | None = None
    number: int | None = None
    while len(captured) < MAX_CAPTURED:
        now = clock()
        if first is not None and now - first >= seconds:
            return
        reading = camera.read(LIVE_WAIT_S)
        if reading is None:
            if clock() - last > MAX_SILENCE_S:
                captured.refused.append(f"no frames for {MAX_SILENCE_S:g} s")
                return
            continue
        last = clock()
        if first is None:
            first = last
        captured.lost += _missed(number, reading.number)
        number = reading.number
        _keep(captured, reading)


def _missed(before: int | None, now: int | None) -> int:
    """Return how many frames a camera's own count leaves out."""
    if before is None or now is None:
        return 0
    return max(now - before - 1, 0)


def _keep(captured: Captured, reading: Reading) -> None:
    """Keep a frame, if it can be used and is a new one."""
    frame = reading.frame
    if frame is None:
        captured.refused.append(reading.note)
        return
    is_old = False
    if captured.frames:
        is_old = frame.timestamp <= captured.frames[-1].timestamp
    if is_old:
        captured.refused.append("a frame with the stamp of an earlier one")
        return
    changes: dict[str, Any] = {"index": len(captured)}
    captured.frames.append(replace(frame, **changes))
