"""Complete systems that install by pip, on the same frames as hybridvo: ORB-SLAM3 and RTAB-Map.

    python tools/benchmark.py slam_peers --data ../shared/data --out docs/results/slam_peers.json

Short clips in which a piece of another recording moves, static recordings, and a camera beside a
T265 on the same handle. ORB-SLAM3 comes from ``pyorbslam3``, RTAB-Map's odometry from ``depthai``;
each runs in a process of its own, without a device and without a network. Systems that are not
installed are listed with the remedy. Times are those of the processor, all threads.
"""

from __future__ import annotations

import argparse
import contextlib
import importlib.metadata
import importlib.util
import json
import os
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterable, Sequence
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from measuring import (
    add_workers,
    digits,
    measured,
    methods_here,
    parser_of,
    provenance,
    store,
)

from bench import t265
from bench.orb_vocabulary import write_vocabulary
from bench.peers import Tracked, path_error, tracker_of
from hybridvo import Frame, open_sequence
from hybridvo.core.geometry import invert, rotation_angle
from hybridvo.core.trajectory import COLUMNS, read_poses

METHODS = {
    "hybridvo": "hybrid",
    "small_gicp": "small-gicp",
    "OpenCV RGB-D": "opencv-rgbd",
    "no motion": "identity",
}
"""What runs in this process: the name of its row and of its method."""
SYSTEMS = {"RTAB-Map": "depthai", "ORB-SLAM3": "pyorbslam3"}
"""What runs in a process of its own: the name of its row and its package."""
ORDER = (
    *("hybridvo", "RTAB-Map", "ORB-SLAM3"),
    *("small_gicp", "OpenCV RGB-D", "no motion"),
)
CLIPS = "semi_real_clips"
NOTHING_MOVES = "_static"
"""End of the names of clips in which nothing moves."""
STATIC = (
    "real_static/rooms_110",
    "tum/rgbd_dataset_freiburg1_rpy_100",
    "tartanair_v2/P000",
)
SHIM = Path(__file__).with_name("slam_calibration.cpp")
"""RTAB-Map's node asks a device for its calibration: this answers in its place."""
RIGHT = {"cm": 3.0, "deg": 1.0, "share": 0.05}
FAR_OFF = {"cm": 10.0, "deg": 3.0, "share": 0.15}
"""A path is right up to both lengths or up to both shares of its way and its turns; mixed too."""
PATIENCE_S = 600
"""Time after which a system is stopped."""


class Recording(NamedTuple):
    """A folder of frames, and how the camera truly moved."""

    part: str  # clips, static or t265
    folder: Path
    T_world_cam: np.ndarray  # (N, 4, 4)

    def frames(self) -> list[Frame]:
        """All frames, read."""
        sequence = open_sequence(self.folder)
        return [sequence.frame(k) for k in range(len(sequence))]


class Built(NamedTuple):
    """What the systems need that their packages lack."""

    vocabulary: Path  # of ORB-SLAM3
    shim: Path  # of RTAB-Map


def build_parser() -> argparse.ArgumentParser:
    parser = parser_of(__file__, __doc__)
    add = parser.add_argument
    add("--methods", type=lambda text: text.split(","), default=list(ORDER))
    add("--data", type=Path, default=Path("../shared/data"), metavar="DIR")
    add(
        "--vocabulary",
        type=Path,
        default=Path("runs/orb_vocabulary.txt"),
        metavar="FILE",
        help="of ORB-SLAM3; trained on the recordings if it is not there",
    )
    add("--out", type=Path, metavar="FILE")
    add_workers(parser)
    return parser


def main(argv: list[str] | None = None) -> int:
    args = build_parser().parse_args(argv)
    result = provenance("benchmark.py slam_peers", argv)
    absent = missing(args.methods)
    for name, why in absent.items():
        print(f"{name} is left out: {why}.", file=sys.stderr)
    ready = [name for name in args.methods if name not in absent]
    recordings = {each.folder.name: each for each in recordings_of(args.data)}
    with tempfile.TemporaryDirectory() as folder:
        built = build(Path(folder), ready, args)
        work = partial(rows_of, ready, built)
        found = measured(args, "recordings", work, recordings)
    result["versions"] |= versions_of(ready)
    result |= {"missing": absent, "clips": clip_part(found, ready)}
    for part in ("static", "t265"):
        result[part] = [row for row in found.values() if row["part"] == part]
        for row in result[part]:
            print(row, flush=True)
    print(result["clips"], flush=True)
    store(args.out, result)
    return 0


def missing(names: Iterable[str]) -> dict[str, str]:
    """Which of some methods cannot run here: the reason and the remedy."""
    here = methods_here(METHODS.values())
    absent = {}
    for name in names:
        package = SYSTEMS.get(name, "")
        if METHODS.get(name) in here.missing:
            absent[name] = here.missing[METHODS[name]]
        elif package and importlib.util.find_spec(package) is None:
            absent[name] = f"{package} is not installed; pip install {package}"
        elif package == "depthai" and shutil.which("g++") is None:
            absent[name] = (
                "its calibration is compiled by g++, which is not installed"
            )
    return absent


def versions_of(names: Sequence[str]) -> dict[str, str]:
    """Versions of the packages of some methods."""
    packages = [package for name, package in SYSTEMS.items() if name in names]
    if "small_gicp" in names:
        packages.append("small_gicp")
    return {package: importlib.metadata.version(package) for package in packages}


def recordings_of(data: Path) -> Iterable[Recording]:
    """The recordings below the data folder."""
    moving = sorted(file.parent for file in (data / CLIPS).glob("*/camera.yaml"))
    moving = [each for each in moving if not each.name.endswith(NOTHING_MOVES)]
    static = [data / name for name in STATIC if (data / name).is_dir()]
    for part, folders in (("clips", moving), ("static", static)):
        for folder in folders:
            poses = open_sequence(folder).poses
            assert poses is not None
            yield Recording(part, folder, np.asarray(poses))
    for name in t265.RECORDINGS:
        if (data / name).is_dir():
            _, poses = read_poses(data / name / "t265.tum", COLUMNS["tum"])
            count = len(open_sequence(data / name))
            yield Recording("t265", data / name, poses[:count])


# --- tracking ---------------------------------------------------------------------


def build(folder: Path, names: Sequence[str], args: argparse.Namespace) -> Built:
    """Train the vocabulary, if it is not there, and compile the calibration."""
    built = Built(args.vocabulary.absolute(), folder / "calibration.so")
    if "ORB-SLAM3" in names and not built.vocabulary.exists():
        write_vocabulary(args.data, built.vocabulary)
    if "RTAB-Map" in names:
        compiler = ["g++", "-shared", "-fPIC", "-O2", "-std=c++17", str(SHIM)]
        subprocess.run([*compiler, "-o", str(built.shim)], check=True)
    return built


def rows_of(names: Sequence[str], built: Built, of: Recording) -> dict[str, Any]:
    """Figures of some methods on a recording; None where a system broke down."""
    row: dict[str, Any] = {
        "part": of.part,
        "recording": of.folder.name,
        "frames": len(of.T_world_cam),
        "methods": {},
    }
    for name in names:
        if name in SYSTEMS:
            tracked = by_system(SYSTEMS[name], of.folder, built)
        else:
            tracked = by_method(METHODS[name], of.frames())
        score = None if tracked is None else scored(tracked, of.T_world_cam)
        if score and tracked and of.part == "t265":
            # the poses are those of the other camera: only motions can be compared
            score = {key: score[key] for key in ("states", "ms")}
            score["windows"] = windows(tracked.T_world_cam, of.T_world_cam)
        row["methods"][name] = score
    return row


def by_method(method: str, frames: Iterable[Frame]) -> Tracked:
    """The path by a method of ours, or by one that hybridvo_lab wraps."""
    tracker = tracker_of(method)
    poses, states, times = [], [], []
    for frame in frames:
        begin = time.process_time()
        step = tracker.track(frame)
        times.append(1e3 * (time.process_time() - begin))
        poses.append(step.T_world_cam)
        states.append(step.status.state.value)
    return Tracked(np.stack(poses), states[1:], times[1:])


def by_system(package: str, folder: Path, built: Built) -> Tracked | None:
    """The path by a system in a process of its own; None where it broke down."""
    environment = dict(os.environ)
    if package == "depthai":
        spec = importlib.util.find_spec(package)
        assert spec is not None and spec.origin is not None
        packages = Path(spec.origin).parent
        libraries = packages.glob("depthai.libs/libdepthaicore*.so")
        preloaded = [str(built.shim), *map(str, libraries)]
        environment["LD_PRELOAD"] = ":".join(preloaded)
    with tempfile.TemporaryDirectory() as out:
        words = [package, str(folder.absolute()), str(built.vocabulary), out]
        command = [sys.executable, "-m", "bench.slam_systems", *words]
        environment["CALIBRATION_JSON"] = f"{out}/calibration.json"
        with contextlib.suppress(subprocess.TimeoutExpired):
            subprocess.run(
                command,
                cwd=Path(__file__).parents[1],
                env=environment,
                capture_output=True,
                timeout=PATIENCE_S,
                check=False,
            )
        path = Path(out) / "tracked.json"
        if not path.exists():
            return None
        content = json.loads(path.read_text(encoding="utf-8"))
    return Tracked(np.array(content["poses"]), content["states"], content["ms"])


# --- figures ----------------------------------------------------------------------


def scored(tracked: Tracked, truth: np.ndarray) -> dict[str, Any]:
    """Figures of a path beside its true poses (N, 4, 4).

    Returns:
        ``end_cm``, ``end_deg``: error of the motion from the first frame to the last;
        ``right``, ``far_off``; ``doubted``: whether a step was reported as bad; ``ate_cm``, as
        ``path_cm`` of tools/bench/peers.py; ``states``; ``ms`` of each step.
    """
    est = tracked.T_world_cam
    steps = invert(truth[:-1]) @ truth[1:]
    way_cm = 100 * np.linalg.norm(steps[:, :3, 3], axis=1).sum()
    turn_deg = np.degrees(rotation_angle(steps[:, :3, :3])).sum()
    error = invert(invert(truth[0]) @ truth[-1]) @ invert(est[0]) @ est[-1]
    end_cm = 100 * float(np.linalg.norm(error[:3, 3]))
    end_deg = float(np.degrees(rotation_angle(error[:3, :3])))

    def within(limit: dict[str, float]) -> bool:
        near = end_cm <= max(limit["cm"], limit["share"] * way_cm)
        turned = end_deg <= max(limit["deg"], limit["share"] * turn_deg)
        return bool(near and turned)

    states = {s: tracked.states.count(s) for s in ("ok", "degraded", "failed")}
    return {
        "path_m": digits(way_cm / 100),
        "end_cm": digits(end_cm),
        "end_deg": digits(end_deg),
        "right": within(RIGHT),
        "far_off": not within(FAR_OFF),
        "doubted": states["ok"] < len(tracked.states),
        "ate_cm": digits(100 * path_error(est, truth)),
        "states": states,
        "ms": [digits(ms) for ms in tracked.ms],
    }


def windows(est: np.ndarray, theirs: np.ndarray) -> dict[str, Any]:
    """What is left of the motions over windows beside those of a T265."""
    fitted = [t265.windows(poses, t265.FITTED_SPAN) for poses in (est, theirs)]
    X = t265.hand_eye(*fitted)
    left = {}
    for span in t265.SPANS:
        if span < len(est):
            both = [t265.windows(poses, span) for poses in (est, theirs)]
            left[str(span)] = t265.figures(*both, X)
    return left


def clip_part(found: dict[str, Any], names: Sequence[str]) -> dict[str, Any]:
    """Figures over the clips; the times of all other recordings become their percentiles."""
    clips = [row for row in found.values() if row["part"] == "clips"]
    by_method = {}
    for name in names:
        scores = [row["methods"][name] for row in clips if row["methods"][name]]
        by_method[name] = summary(scores) if scores else {"clips": 0}
    for row in found.values():
        for score in filter(None, row["methods"].values()):
            score["processor_ms"] = processor(score.pop("ms"))
    return {
        "count": len(clips),
        "right": RIGHT,
        "far": FAR_OFF,
        "methods": by_method,
    }


def summary(scores: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """How the paths of a method ended."""
    wrong = [each for each in scores if not each["right"]]
    return {
        "clips": len(scores),
        "right": len(scores) - len(wrong),
        "wrong_all_ok": sum(not each["doubted"] for each in wrong),
        "far_off": sum(each["far_off"] for each in scores),
        "end_cm": digits(np.median([each["end_cm"] for each in scores])),
        "end_deg": digits(np.median([each["end_deg"] for each in scores])),
        "processor_ms": processor([ms for each in scores for ms in each["ms"]]),
    }


def processor(ms: Sequence[float]) -> dict[str, float]:
    """Median and 95th percentile."""
    median, p95 = map(digits, np.percentile(ms, [50, 95]))
    return {"median": median, "p95": p95}
