"""Whether a path survives: dropped frames and fast turns, and a camera that does not wait.

    python tools/benchmark.py lost --out docs/results/lost.json

``disturbed``: every third frame of a recording is dropped, and a run of frames every now and
then, as in a fast turn. The error of the path is compared with that of the undisturbed one on
the same frames. ``real time``: frames come at their own rate whether the last one is done or not,
by a clock that counts the measured time of each step; the newest one is tracked.
"""

from __future__ import annotations

import argparse
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from measuring import digits, parser_of, provenance, ready_tracker, store, timed
from scipy.spatial.transform import Rotation

from hybridvo import evaluate, open_sequence
from hybridvo.core.options import TrackOptions
from hybridvo.core.trajectory import Trajectory

RECORDINGS = (
    "tum/rgbd_dataset_freiburg1_rpy_100",
    "real_static/rooms_110",
    "tripod/corridor",
)
"""A turning Kinect, a walk through rooms, and people before a camera that stands."""
DROPPED_EVERY = 3
TURN_EVERY = 20
"""Frames from one fast turn to the next."""
TURN_DEG = 16.0
TURN_M = 0.3
"""A fast turn takes away frames as long as the camera has not turned or moved farther."""
BUDGETS_MS = (0.0, 33.0)
"""Values of ``track.budget_ms``; 0: no limit."""
FRAME_RATE = 30.0


class Tracked(NamedTuple):
    """Steps of a tracker over some frames of a recording."""

    indices: list[int]
    steps: list[Any]
    ms: list[float]


def build_parser() -> argparse.ArgumentParser:
    parser = parser_of(__file__, __doc__)
    add = parser.add_argument
    add("--methods", default="hybrid,classical")
    add("--recordings", default=";".join(RECORDINGS))
    add("--data", type=Path, default=Path("../shared/data"), metavar="DIR")
    add("--out", type=Path, metavar="FILE")
    return parser


def main(argv: list[str] | None = None) -> int:
    args = build_parser().parse_args(argv)
    rows = []
    for name in args.recordings.split(";"):
        sequence = open_sequence(args.data / name)
        for method in args.methods.split(","):
            row = {"recording": name, "method": method}
            row["disturbed"] = disturbed(sequence, method)
            row["real_time"] = [
                real_time(sequence, method, budget) for budget in BUDGETS_MS
            ]
            rows.append(row)
            print(row, flush=True)
    result = provenance("benchmark.py lost", argv) | {"rows": rows}
    store(args.out, result)
    return 0


def kept_frames(poses: np.ndarray) -> list[int]:
    """Indices of the frames that a disturbed recording still has, given its poses (N, 4, 4)."""
    kept = []
    index = 0
    while index < len(poses):
        if index % DROPPED_EVERY != DROPPED_EVERY - 1:
            kept.append(index)
        index += 1
        if index % TURN_EVERY == 0:
            index = after_turn(poses, index)
    return kept


def after_turn(poses: np.ndarray, start: int) -> int:
    """The frame at which a fast turn ends: the last one within its limits.

    It is the first one where the camera never moves that far.
    """
    for index in range(start, len(poses)):
        change = np.linalg.inv(poses[start]) @ poses[index]
        turned = Rotation.from_matrix(change[:3, :3]).magnitude()
        if np.rad2deg(turned) > TURN_DEG or np.linalg.norm(change[:3, 3]) > TURN_M:
            return max(start, index - 1)
    return start


def disturbed(sequence: Any, method: str) -> dict[str, Any]:
    """The errors of the disturbed path and of the undisturbed one."""
    poses = sequence.poses
    if poses is None:
        poses = np.tile(np.eye(4), (len(sequence), 1, 1))
    kept = kept_frames(poses)
    whole = track(sequence, method, list(range(len(sequence))))
    some = track(sequence, method, kept)
    undisturbed = Tracked(kept, [whole.steps[k] for k in kept], [])
    before = path_error(sequence, undisturbed)
    after = path_error(sequence, some)
    return {
        "frames": len(sequence),
        "kept": len(kept),
        "ate_cm": digits(after),
        "ate_undisturbed_cm": digits(before),
        "ratio": digits(after / before),
        **counts(some),
    }


def track(
    sequence: Any, method: str, indices: list[int], budget_ms: float = 0.0
) -> Tracked:
    """Track some frames of a recording, one after the other."""
    odometry = ready_tracker(TrackOptions(budget_ms=budget_ms), method)
    path = Tracked(indices, [], [])
    for index in indices:
        frame = sequence.frame(index)
        step, ms = timed(partial(odometry.track, frame))
        path.steps.append(step)
        path.ms.append(ms)
    return path


def real_time(sequence: Any, method: str, budget_ms: float) -> dict[str, Any]:
    """Track the newest frame whenever the one before is done."""
    odometry = ready_tracker(TrackOptions(budget_ms=budget_ms), method)
    path = Tracked([], [], [])
    now = 0.0
    index = 0
    while index < len(sequence):
        frame = sequence.frame(index)
        step, ms = timed(partial(odometry.track, frame))
        path.indices.append(index)
        path.steps.append(step)
        path.ms.append(ms)
        now = max(now, index / FRAME_RATE) + 1e-3 * ms
        newest = int(now * FRAME_RATE)
        index = max(index + 1, newest)
    return {
        "budget_ms": budget_ms,
        "tracked": digits(len(path.steps) / len(sequence)),
        "ate_cm": digits(path_error(sequence, path)),
        "ms_median": digits(np.median(path.ms)),
        "ms_95": digits(np.percentile(path.ms, 95)),
        **counts(path),
    }


def path_error(sequence: Any, path: Tracked) -> float:
    """Absolute trajectory error after alignment, cm; of a standing camera: largest distance.

    Of fewer than three frames it is not a number.
    """
    estimated = np.stack([step.T_world_cam for step in path.steps])
    if sequence.poses is None:
        return 100 * float(np.abs(estimated[:, :3, 3]).max())
    true = np.stack([sequence.poses[k] for k in path.indices])
    stamps = np.arange(len(path.indices), dtype=np.float64)
    report = evaluate(Trajectory(stamps, estimated), Trajectory(stamps, true))
    error = report["ate_rmse"]
    return np.nan if error is None else 100 * error


def counts(path: Tracked) -> dict[str, int]:
    """How many steps failed, and how many are not sure."""
    failed = sum(not step.motion.usable for step in path.steps)
    degraded = sum(not step.motion.ok for step in path.steps) - failed
    return {"failed": failed, "degraded": degraded}
