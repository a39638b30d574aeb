"""Odometry that a user of a depth camera would pick, side by side, on whole recordings.

    python tools/benchmark.py peers --out docs/results/peers.json --overwrite

Tracked: static recordings, people before a camera that stands (its true motion is none), and
rendered scenes at video rate with the noise of structured light. Every method tracks frame
after frame as ``hvo.Odometry`` does; KISS-ICP also as its own odometry with a map. RGB-D
odometry and the registrations get no flow. Methods whose packages are missing are listed with
the remedy.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable, Iterable, Iterator, Sequence
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from measuring import (
    digits,
    methods_here,
    parser_of,
    provenance,
    timed,
    write_result,
)

from bench import video_rate as video
from hybridvo import (
    Frame,
    Odometry,
    open_sequence,
)
from hybridvo.core.errors import DegenerateError
from hybridvo.core.geometry import invert, rotation_angle
from hybridvo.flow.providers import FlowField
from hybridvo_lab.baselines import ALIGNERS, WITHOUT_FLOW
from hybridvo_lab.baselines.clouds import (
    CLOUD_RANGE_RATIO,
    kiss_odometry,
    median_depth,
    points_of,
)
from hybridvo_lab.evaluation.metrics import Match, ate

METHODS = (
    *("hybrid", "hybrid-flow", "classical", "pnp-ransac-tuned", "poselib"),
    *("opencv-rgbd", "open3d-rgbd", "small-gicp", "kiss-icp", "sift-pnp"),
)
KISS_MAP = "kiss-icp, map"
"""KISS-ICP as it is meant: against a map of all frames, with its own motion model."""
STATIC = (
    "tum/rgbd_dataset_freiburg1_rpy_100",
    "tum/rgbd_dataset_freiburg1_xyz_first10",
    "real_static/rooms_110",
    "tartanair_v2/P000",
)
"""Recordings below the data folder in which nothing moves but the camera."""
TRIPOD = ("corridor", "lab_close", "lab_far", "books", "boxes", "fruit")
"""Recordings below its folder ``tripod``."""
VIDEO_NOISE = "structured light"
PARTS = ("static", "tripod", "video")
STILL_M = 1e-6


class Recording(NamedTuple):
    """Frames with their true poses."""

    part: str
    name: str
    frames: Callable[[], Iterable[Frame]]
    T_world_cam: np.ndarray  # (N, 4, 4)


class Tracked(NamedTuple):
    """The path of a method, and what it reported of its steps."""

    T_world_cam: np.ndarray  # (N, 4, 4)
    states: list[str]  # of the N - 1 steps
    ms: list[float]  # of the N - 1 steps


def build_parser() -> argparse.ArgumentParser:
    parser = parser_of(__file__, __doc__)
    add = parser.add_argument
    add("--parts", default=",".join(PARTS), help="default: %(default)s")
    add("--methods", default=",".join(METHODS), help="default: %(default)s")
    add("--video-frames", type=int, default=60, help="of a rendered scene")
    add("--seed", type=int, default=9400, help="of the rendered scenes")
    add("--data", type=Path, default=Path("../shared/data"), metavar="DIR")
    add("--out", type=Path, default=Path("runs/peers.json"), metavar="FILE")
    add("--overwrite", action="store_true", help="replace --out")
    return parser


def main(argv: list[str] | None = None) -> int:
    args = build_parser().parse_args(argv)

    def made() -> dict[str, Any]:
        return provenance("benchmark.py peers", argv) | measure(args)

    return write_result("benchmark.py peers", args.out, args.overwrite, made)


def measure(args: argparse.Namespace) -> dict[str, Any]:
    """Figures of every method on every recording."""
    parts = args.parts.split(",")
    names = methods_here(args.methods.split(","))
    tracked = []
    absent = []
    for recording in recordings(args, parts, absent):
        methods = trackers(names.ready)
        row = track_all(recording, methods)
        tracked.append(row)
        print(recording.part, recording.name, file=sys.stderr, flush=True)
    return {
        "methods": [*trackers(names.ready)],
        "missing": names.missing,
        "absent": absent,
        "video_noise": VIDEO_NOISE,
        "tracked": tracked,
    }


# --- recordings -------------------------------------------------------------------


def recordings(
    args: argparse.Namespace, parts: Sequence[str], absent: list[str]
) -> Iterator[Recording]:
    """The recordings of some parts; ``absent`` gets those that are not there."""
    folders = []
    if "static" in parts:
        folders += [("static", name) for name in STATIC]
    if "tripod" in parts:
        folders += [("tripod", f"tripod/{name}") for name in TRIPOD]
    for part, name in folders:
        if (args.data / name).is_dir():
            yield from_disk(part, args.data / name)
        else:
            absent.append(name)
    if "video" in parts:
        for kind in video.KINDS:
            yield rendered(kind, args.seed, args.video_frames)


def from_disk(part: str, folder: Path) -> Recording:
    """A recording with its true poses; a camera on a tripod stands still."""
    sequence = open_sequence(folder)
    indices = range(len(sequence))
    T = np.tile(np.eye(4), (len(indices), 1, 1))
    if part != "tripod":
        assert sequence.poses is not None
        known = [i for i in indices if np.isfinite(sequence.poses[i]).all()]
        indices = range(known[0], known[-1] + 1)
        T = sequence.poses[list(indices)]
    return Recording(
        part, sequence.name, lambda: (sequence.frame(i) for i in indices), T
    )


def rendered(kind: str, seed: int, count: int) -> Recording:
    """A rendered scene at video rate with the noise of a depth camera."""
    scene = video.slow_scene(kind, seed, count, video.SIZE)
    rng = np.random.default_rng(seed)
    frames = []
    for i in range(scene.frames):
        given = video.measured(scene.render(i), video.NOISES[VIDEO_NOISE], rng)
        stamp = i / video.FRAME_RATE
        frames.append(Frame(*given, scene.camera, timestamp=stamp, index=i))
    return Recording("video rate", kind, lambda: frames, scene.T_world_cam)


# --- tracking ---------------------------------------------------------------------


def trackers(methods: Iterable[str]) -> dict[str, Callable[[], Any]]:
    """What makes a tracker, by the name of its row."""
    names = list(methods)
    made: dict[str, Callable[[], Any]] = {
        name: partial(tracker_of, name) for name in names
    }
    if "kiss-icp" in names:
        made[KISS_MAP] = KissMap
    return made


def tracker_of(method: str) -> Odometry:
    """A tracker; methods that need no flow compute none."""
    flow = no_flow if method in (*ALIGNERS, *WITHOUT_FLOW) else None
    tracker = Odometry(method=method, flow=flow)
    tracker.warm_up()
    return tracker


def no_flow(prev: Frame, curr: Frame) -> FlowField:
    """A provider without flow."""
    return FlowField(None, source="none")


class KissMap:
    """KISS-ICP over a whole recording; its lengths follow the first frame's depth."""

    def __init__(self) -> None:
        self.range_m = 0.0
        self.odometry: Any = None

    def track(self, frame: Frame) -> KissStep:
        """Register a frame with the map."""
        if self.odometry is None:
            self.range_m = CLOUD_RANGE_RATIO * median_depth(frame)
            self.odometry = kiss_odometry(self.range_m)
        points = points_of(frame, self.range_m)
        if len(points):
            self.odometry.register_frame(points, np.zeros(0))
        return KissStep(self.odometry.last_pose.copy(), bool(len(points)))


class KissStep(NamedTuple):
    """A step of KISS-ICP, which states no covariance and no status."""

    T_world_cam: np.ndarray  # (4, 4)
    ok: bool

    @property
    def usable(self) -> bool:
        """Whether there were points."""
        return self.ok


def track_all(
    recording: Recording, methods: dict[str, Callable[[], Any]]
) -> dict[str, Any]:
    """Figures of every method on a recording."""
    T = recording.T_world_cam
    lengths = np.linalg.norm(np.diff(T[:, :3, 3], axis=0), axis=1)
    return {
        "part": recording.part,
        "recording": recording.name,
        "frames": len(T),
        "path_m": digits(lengths.sum()),
        "methods": {
            name: figures(track(recording.frames(), make()), T)
            for name, make in methods.items()
        },
    }


def track(frames: Iterable[Frame], tracker: Any) -> Tracked:
    """The path of a tracker; the time of its first frame does not count."""
    poses = []
    states = []
    times = []
    for frame in frames:
        step, ms = timed(partial(tracker.track, frame))
        poses.append(step.T_world_cam)
        state = "ok" if step.ok else "degraded"
        states.append(state if step.usable else "failed")
        times.append(ms)
    return Tracked(np.stack(poses), states[1:], times[1:])


def figures(tracked: Tracked, truth: np.ndarray) -> dict[str, Any]:
    """Errors of a path beside its true poses (N, 4, 4).

    Returns:
        ``path_cm``: the absolute error (root mean square) after a rigid alignment, or, where
        the camera stands, the distance from the first pose; ``worst_cm`` of a step;
        ``step_cm`` and ``step_deg``: medians; ``failed``, ``degraded``; ``ms``.
    """
    est = tracked.T_world_cam
    estimated = invert(est[:-1]) @ est[1:]
    true = invert(truth[:-1]) @ truth[1:]
    error = invert(true) @ estimated
    lengths = np.linalg.norm(error[:, :3, 3], axis=1)
    angles = np.degrees(rotation_angle(error[:, :3, :3]))
    return {
        "path_cm": digits(100 * path_error(est, truth)),
        "step_cm": digits(100 * np.median(lengths)),
        "worst_cm": digits(100 * lengths.max()),
        "step_deg": digits(np.median(angles)),
        "failed": tracked.states.count("failed"),
        "degraded": tracked.states.count("degraded"),
        "ms": digits(np.median(tracked.ms)),
    }


def path_error(est: np.ndarray, truth: np.ndarray) -> float:
    """Absolute error of a path, metres, from the first pose where no alignment is determined."""
    matched = Match(est, truth, np.arange(len(truth), dtype=float), "index", "")
    extent = np.linalg.norm(truth[:, :3, 3] - truth[0, :3, 3], axis=1).max()
    if extent > STILL_M:
        try:
            return ate(matched, "se3").rmse
        except DegenerateError:
            pass
    return ate(matched, "origin").rmse
