"""Whether a live camera is kept up with: recordings played at 30 Hz through the loop of ``live``.

    python tools/benchmark.py live --data ../shared/data --out docs/results/live.json

Frames lie in memory and come at their time, to and fro until there are enough of them, with and
without ``--rate auto``. A path is lost where it is off by more than a wide step may be, or where
its last motion failed. The load of the machine is kept beside each row: figures hold for it alone.
"""

from __future__ import annotations

import argparse
import os
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from measuring import digits, parser_of, proportion, provenance, store

from bench.lost import FRAME_RATE, Tracked, path_error
from bench.wide_steps import RIGHT_M
from hybridvo import Frame, Options, open_sequence
from hybridvo.io.cameras.folder import FolderCamera
from hybridvo.io.data.sequence import Sequence
from hybridvo.io.live import LiveStream, stream
from hybridvo.io.live_rate import AutoRate, default_tracker

RECORDINGS = (
    "tum/rgbd_dataset_freiburg1_rpy_100",
    "tripod/corridor",
    "tripod/lab_close",
)
"""Below the data folder: a turning Kinect, and people before a camera that stands."""
MODES = ("no limit", "budget", "auto")
"""``track.budget_ms=0``; the default of live, which is the camera's period; ``--rate auto``."""
LOST_CM = 100 * RIGHT_M
"""Error from which a path is lost: that up to which a wide step is right."""
SCORED = 3
"""Steps from which the error of a path is determined."""


class ToAndFro(Sequence):
    """Frames of a recording in memory, forward and backward in turn, at 30 Hz."""

    def __init__(self, original: Sequence, count: int) -> None:
        self.__dict__.update(vars(original))
        frames = list(original)
        there_and_back = [*range(len(frames)), *range(len(frames) - 2, 0, -1)]
        self._order = [
            there_and_back[k % len(there_and_back)] for k in range(count)
        ]
        self._frames = frames
        self.timestamps = np.arange(count) / FRAME_RATE
        if original.poses is not None:
            self.poses = original.poses[self._order]

    def frame(self, index: int) -> Frame:
        """A frame with its new stamp."""
        stamp = float(self.timestamps[index])
        return replace(
            self._frames[self._order[index]], timestamp=stamp, index=index
        )


def build_parser() -> argparse.ArgumentParser:
    parser = parser_of(__file__, __doc__)
    add = parser.add_argument
    add("--recordings", default=";".join(RECORDINGS))
    add("--modes", default=";".join(MODES))
    add("--frames", type=int, default=400, metavar="N", help="default 400")
    add("--data", type=Path, default=Path("../shared/data"), metavar="DIR")
    add("--out", type=Path, metavar="FILE")
    return parser


def main(argv: list[str] | None = None) -> int:
    args = build_parser().parse_args(argv)
    rows = []
    for name in args.recordings.split(";"):
        sequence = ToAndFro(open_sequence(args.data / name), args.frames)
        for mode in args.modes.split(";"):
            row = {"recording": name, "mode": mode, **live_run(sequence, mode)}
            rows.append(row)
            print(row, flush=True)
    result = provenance("benchmark.py live", argv) | {
        "method": Options().run.method,
        "frames": args.frames,
        "frame_rate": FRAME_RATE,
        "lost_cm": digits(LOST_CM),
        "rows": rows,
    }
    store(args.out, result)
    return 0


def live_run(sequence: Sequence, mode: str) -> dict[str, Any]:
    """Track a recording as it comes."""
    notes: list[str] = []
    camera = FolderCamera(sequence)
    if mode == "auto":
        steps = stream(camera, rate=AutoRate(), say=notes.append)
    else:
        options = Options()
        if mode == "no limit":
            options = replace(options, track=replace(options.track, budget_ms=0.0))
        steps = stream(camera, default_tracker(options), say=notes.append)
    load_before = os.getloadavg()[0]
    path = Tracked([], [], [])
    worked = time.process_time()
    for live in steps:
        path.indices.append(live.step.index)
        path.steps.append(live.step)
    worked = time.process_time() - worked
    return figures(steps, path, sequence) | {
        # what a machine that does nothing else would need at least, of one core
        "processor_ms": digits(1e3 * worked / max(len(path.steps), 1)),
        "notes": notes,
        "load": [digits(load_before), digits(os.getloadavg()[0])],
    }


def figures(steps: LiveStream, path: Tracked, sequence: Sequence) -> dict[str, Any]:
    """Figures of a run that has ended; frames that were only tried do not count."""
    summary = steps.summary()
    error_cm = np.nan
    if len(path.steps) >= SCORED:
        error_cm = path_error(sequence, path)
    ends_usable = bool(path.steps) and path.steps[-1].usable
    is_lost = not ends_usable or not error_cm <= LOST_CM
    offered = summary["tracked"] + summary["dropped"]
    return {
        "size": summary["size"],
        "tried": summary["tried"],
        "tracked": proportion(summary["tracked"], offered),
        "frames_per_second": known(summary["frames_per_second"]),
        "age_ms": {
            "median": known(steps.age_ms(50)),
            "p95": known(steps.age_ms(95)),
        },
        "degraded": summary["degraded"],
        "failed": summary["failed"],
        "error_cm": digits(error_cm) if np.isfinite(error_cm) else None,
        "lost": is_lost,
        "help": summary["help"],
        "stages": summary["stages"],
    }


def known(value: float | None) -> float | None:
    """A figure to its digits; None where nothing was tracked."""
    return None if value is None else digits(value)
