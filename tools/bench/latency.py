"""The benchmark's live camera: the age of a pose where frames come at 30 Hz.

Frames of a recording lie in memory and come at their time, as from a camera, through the loop of
``hybridvo live``: one thread takes them and keeps the newest, another one tracks. What comes
while a frame is tracked is dropped. The age of a pose is the time from the arrival of its frame
to its step.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from measuring import digits, proportion, ready_tracker

from bench.lost import BUDGETS_MS, FRAME_RATE, Tracked, path_error
from bench.wide_steps import RIGHT_M
from hybridvo import Frame, open_sequence
from hybridvo.core.options import TrackOptions
from hybridvo.io.cameras.folder import FolderCamera
from hybridvo.io.data.sequence import Sequence
from hybridvo.io.live import stream

METHOD = "hybrid"
RECORDINGS = (
    "tripod/corridor",
    "tripod/lab_close",
    "tum/rgbd_dataset_freiburg1_rpy_100",
)
"""Below the data folder."""
LOST_CM = 100 * RIGHT_M
"""Error from which a path is lost: that up to which a wide step is right."""
SCORED = 3
"""Steps from which the error of a path is determined."""


class LiveRun(NamedTuple):
    """One run of the loop over a recording."""

    ages_s: list[float]  # of the poses
    failed: int  # motions
    error_cm: float | None  # of the path; None where too few frames were tracked
    ends_usable: bool  # whether the last motion was usable

    @property
    def is_lost(self) -> bool:
        """Whether the path is off by more than a wide step may be, or ends in a failure."""
        if self.error_cm is None or not self.ends_usable:
            return True
        return self.error_cm > LOST_CM


class InMemory(Sequence):
    """Frames of a recording in memory, at 30 Hz: a camera reads no files."""

    def __init__(self, original: Sequence) -> None:
        self.__dict__.update(vars(original))
        self._frames = list(original)
        self.timestamps = np.arange(len(self._frames)) / FRAME_RATE

    def frame(self, index: int) -> Frame:
        """A frame with its new stamp."""
        stamp = float(self.timestamps[index])
        return replace(self._frames[index], timestamp=stamp, index=index)


def latency(data: Path, repeats: int) -> dict[str, Any]:
    """A row for each recording that is there and each ``track.budget_ms``."""
    rows = []
    for name in RECORDINGS:
        if not (data / name).is_dir():
            continue
        sequence = InMemory(open_sequence(data / name))
        for budget_ms in BUDGETS_MS:
            runs = [live_run(sequence, budget_ms) for _ in range(repeats)]
            named = {"recording": name, "budget_ms": budget_ms}
            rows.append(named | figures(runs, len(sequence)))
    return {
        "method": METHOD,
        "frame_rate": FRAME_RATE,
        "lost_cm": digits(LOST_CM),
        "rows": rows,
    }


def live_run(sequence: Sequence, budget_ms: float) -> LiveRun:
    """Track a recording as it comes."""
    odometry = ready_tracker(TrackOptions(budget_ms=budget_ms), METHOD)
    notes: list[str] = []
    steps = stream(FolderCamera(sequence), odometry, say=notes.append)
    lives = list(steps)
    path = Tracked([], [], [])
    for live in lives:
        path.indices.append(live.step.index)
        path.steps.append(live.step)
    error_cm = None
    if len(lives) >= SCORED:
        error = path_error(sequence, path)
        error_cm = error if np.isfinite(error) else None
    return LiveRun(
        [live.age_s for live in lives],
        steps.counts.failed,
        error_cm,
        bool(lives) and lives[-1].step.usable,
    )


def figures(runs: list[LiveRun], frames: int) -> dict[str, Any]:
    """Figures over the runs on a recording of so many frames; the error is the largest."""
    ages_ms = 1e3 * np.concatenate([one.ages_s for one in runs])
    errors = [one.error_cm for one in runs if one.error_cm is not None]
    return {
        "tracked": proportion(len(ages_ms), frames * len(runs)),
        "age_ms": {
            "median": digits(np.median(ages_ms)),
            "p95": digits(np.percentile(ages_ms, 95)),
        },
        "failed": sum(one.failed for one in runs),
        "error_cm": digits(max(errors)) if errors else None,
        "lost": proportion(sum(one.is_lost for one in runs), len(runs)),
    }
