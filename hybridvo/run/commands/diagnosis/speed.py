"""How fast this machine tracks, and what the time of a frame goes to."""

from __future__ import annotations

import os
import time
from collections.abc import Iterable, Iterator
from typing import Any

import numpy as np

from hybridvo.core import laboratory
from hybridvo.core.errors import InputError
from hybridvo.core.stages import (
    LATE_PERCENTILE,
    stage,
    stage_summary,
    stage_times,
)
from hybridvo.core.types import Frame
from hybridvo.io.data.sequence import Sequence
from hybridvo.odometry import Odometry

# frames that are tracked, of the demo a third: some seconds
SPEED_FRAMES = 60

DEMO = "scene of the demo"
"""What is tracked where no sequence is named."""


def speed(sequence: Sequence | None = None) -> dict[str, Any]:
    """Track the first frames of a sequence, one after the other, and measure each stage.

    Args:
        sequence: The sequence; None: the rendered scene of ``hybridvo demo``.

    Returns:
        A report, JSON-ready: ``frames_per_second``, ``frame_ms`` and ``stages``, over all
        motions, and the load of the machine in which they were measured.

    Raises:
        InputError: There are fewer than two frames.
    """
    if sequence is not None and len(sequence) < 2:
        raise InputError(
            f"{sequence.name}: --speed needs two frames, got {len(sequence)}."
        )
    tracker = Odometry()
    tracker.warm_up()
    frames = _rendered() if sequence is None else _read(sequence)
    return {
        "sequence": DEMO if sequence is None else sequence.name,
        "method": tracker.method,
        "cores": os.cpu_count(),
        "load": _load(),
        **measure(tracker, frames),
    }


def measure(tracker: Any, frames: Iterable[Frame]) -> dict[str, Any]:
    """Track frames, and state how long each stage took; the first frame has no motion.

    Args:
        tracker: An :class:`~hybridvo.odometry.Odometry`, warmed up.
        frames: Two or more; taking the next one counts as reading.
    """
    rows = []
    frame_ms = []
    size = (0, 0)
    rest = iter(frames)
    while True:
        with stage_times() as times:
            with stage("reading"):
                frame = next(rest, None)
            if frame is None:
                break
            started = time.perf_counter()
            tracker.track(frame)
            passed = 1e3 * (time.perf_counter() - started)
        size = (frame.camera.width, frame.camera.height)
        frame_ms.append(passed)
        rows.append(times.rounded())
    motions = np.array(frame_ms[1:])
    return {
        "size": list(size),
        "motions": len(motions),
        "frames_per_second": round(1e3 / float(np.mean(motions)), 2),
        "frame_ms": {
            "median_ms": round(float(np.median(motions)), 3),
            "p95_ms": round(float(np.percentile(motions, LATE_PERCENTILE)), 3),
            "mean_ms": round(float(np.mean(motions)), 3),
        },
        "stages": stage_summary(rows[1:]),
    }


def _read(sequence: Sequence) -> Iterator[Frame]:
    """The first frames of a sequence."""
    for index in range(min(len(sequence), SPEED_FRAMES)):
        yield sequence.frame(index)


def _rendered() -> list[Frame]:
    """The frames of the demo; drawing them is no reading."""
    draw = laboratory.wanted(
        laboratory.FUNCTIONS, "demo_frames", "'--speed' without DIR"
    )
    frames: list[Frame] = draw(SPEED_FRAMES // 3)
    return frames


def _load() -> float | None:
    """Processes that wanted a core in the last minute; None where the system does not say."""
    return round(os.getloadavg()[0], 2) if hasattr(os, "getloadavg") else None
