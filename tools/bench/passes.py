"""Recordings tracked in one, two and three passes, and with a lag: what it is worth.

    python tools/benchmark.py passes --out docs/results/passes.json

They mend what a rolling shutter does; no readout is stated. The recordings of a D435 have no
ground truth but a T265 beside it: their motions over windows are compared by
``tools/benchmark.py t265``.
"""

from __future__ import annotations

import argparse
import time
from pathlib import Path
from typing import Any

import numpy as np
from measuring import digits, parser_of, provenance, store

from hybridvo import Frame, Odometry, Options, Step, open_sequence
from hybridvo.core.options import TrackOptions
from hybridvo.core.trajectory import Trajectory
from hybridvo.tracking.camera_drift import Mean
from hybridvo.tracking.passes import track_in_passes
from hybridvo_lab.evaluation.metrics import evaluate

RECORDINGS = (
    "tum/rgbd_dataset_freiburg1_rpy_100",
    "tum/rgbd_dataset_freiburg1_xyz_first10",
    "real_static/rooms_110",
    "devices/d435_quiet",
    "devices/d435_fast",
)
"""Recordings below the data folder. The camera moves, and nothing else does."""
HAS_OTHER_TRUTH = "devices/"
"""Recordings whose ground truth is that of another camera."""
PASSES = (1, 2, 3)


def build_parser() -> argparse.ArgumentParser:
    parser = parser_of(__file__, __doc__)
    add = parser.add_argument
    add("--data", type=Path, default=Path("../shared/data"), metavar="DIR")
    add("--out", type=Path, metavar="FILE")
    return parser


def main(argv: list[str] | None = None) -> int:
    args = build_parser().parse_args(argv)
    rows = []
    for name in RECORDINGS:
        folder = args.data / name
        if not folder.is_dir():
            print(f"{name}: not there")
            continue
        sequence = open_sequence(folder)
        frames = [sequence.frame(index) for index in range(len(sequence))]
        truth = None
        if sequence.poses is not None and not name.startswith(HAS_OTHER_TRUTH):
            truth = Trajectory(sequence.timestamps, sequence.poses)
        for passes in PASSES:
            rows.append({"recording": name} | tracked(frames, passes, truth))
            print(rows[-1], flush=True)
        rows.append({"recording": name} | lagging(frames, truth))
        print(rows[-1], flush=True)
    result = provenance("benchmark.py passes", argv) | {"rows": rows}
    store(args.out, result)
    return 0


def tracked(
    frames: list[Frame], passes: int, truth: Trajectory | None
) -> dict[str, Any]:
    """Track frames in some passes, and count what comes of it."""
    begin = time.process_time()
    steps, times = track_in_passes(frames, passes)
    seconds = time.process_time() - begin
    counted = figures(steps, times.readout, truth)
    return {"passes": passes} | counted | {"processor_s": digits(seconds)}


def lagging(frames: list[Frame], truth: Trajectory | None) -> dict[str, Any]:
    """Track frames as they come, each step given once more when the next frame is there."""
    odometry = Odometry(options=Options(track=TrackOptions(lag=1)))
    begin = time.process_time()
    given = [odometry.track(frame) for frame in frames]
    seconds = time.process_time() - begin
    last = [step.corrected for step in given[1:]] + [None]
    steps = [new or old for old, new in zip(given, last, strict=True)]
    counted = figures(steps, odometry.readout, truth)
    return {"lag": 1, "passes": 1} | counted | {"processor_s": digits(seconds)}


def figures(
    steps: list[Step], readout: Mean | None, truth: Trajectory | None
) -> dict[str, Any]:
    """What comes of a path."""
    moved = steps[1:]
    return {
        "frames": len(steps),
        "ok": sum(step.ok for step in moved),
        "degraded": sum(step.usable and not step.ok for step in moved),
        "failed": sum(not step.usable for step in moved),
        "with_flow": sum("flow" in step.motion.terms for step in moved),
        "ate_cm": None if truth is None else ate_cm(steps, truth),
        "readout_ms": None if readout is None else digits(readout.error),
        "readout_std_ms": None if readout is None else digits(readout.std),
    }


def ate_cm(steps: list[Step], truth: Trajectory) -> float:
    """Root mean square error of the rigidly aligned positions, cm."""
    stamps = np.array([step.timestamp for step in steps])
    poses = np.stack([step.T_world_cam for step in steps])
    errors = evaluate(Trajectory(stamps, poses), truth)
    return digits(100 * errors["ate_rmse"])
