"""A hand-held depth camera against a T265 that is fixed to it: motions over windows of frames.

    python tools/benchmark.py t265 --out docs/results/t265.json

The transform between the two cameras is fitted to the windows of 30 frames of each method first,
so that its own rotation and lever arm cost nothing. The T265 is polled, so single steps are not
judged; its own error is unknown. Recordings are those of ``devices`` in the data folder: rows of
``t265.tum`` belong to their frames one by one.
"""

from __future__ import annotations

import argparse
import time
from collections import Counter
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from matplotlib.figure import Figure
from measuring import ROOT, digits, parser_of, provenance, store
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from hybridvo import Frame, Odometry, open_sequence
from hybridvo.core.geometry import invert, make_transform
from hybridvo.core.trajectory import COLUMNS, read_poses
from hybridvo.tracking.camera_drift import Mean
from hybridvo.tracking.passes import find_times

RECORDINGS = ("devices/d435_quiet", "devices/d435_fast")
METHODS = ("hybrid", "classical", "opencv-rgbd", "small-gicp")
SPANS = (10, 30, 90)
"""Frames of a window."""
FITTED_SPAN = 30
"""Frames of the windows to which the transform between the cameras is fitted."""
TOLD = "hybrid"
"""The method that is also told how long the shutter takes and how late depth is, and that may find
out in passes."""
PASSES = 3
FIT_SCALES = (0.3, 0.5, 0.1)
"""Degrees, centimetres and metres of the lever arm that weigh alike in that fit."""
FIGURE = ROOT / "docs" / "figures" / "t265.png"
COLOURS = {"T265": "#222222", "hybrid": "#0072B2"}


def build_parser() -> argparse.ArgumentParser:
    parser = parser_of(__file__, __doc__)
    add = parser.add_argument
    add("--methods", default=",".join(METHODS))
    add("--recordings", default=";".join(RECORDINGS))
    add("--data", type=Path, default=Path("../shared/data"), metavar="DIR")
    # by the T265; by hybridvo doctor
    add("--readout-ms", type=float, default=32.0, metavar="MS")
    add("--depth-lag-ms", type=float, default=16.0, metavar="MS")
    add("--out", type=Path, metavar="FILE")
    add("--draw", action="store_true", help="write docs/figures/t265.png as well")
    return parser


def main(argv: list[str] | None = None) -> int:
    args = build_parser().parse_args(argv)
    rows = []
    paths = {}
    for name in args.recordings.split(";"):
        sequence = open_sequence(args.data / name)
        _, theirs = read_poses(args.data / name / "t265.tum", COLUMNS["tum"])
        frames = [sequence.frame(index) for index in range(len(sequence))]
        for method in args.methods.split(","):
            for times, passes in conditions(method, args):
                shown = [with_times(frame, times) for frame in frames]
                row, path = compared(shown, theirs[: len(frames)], method, passes)
                about = {"recording": name.split("/")[-1], "method": method}
                rows.append(about | times | row)
                paths.setdefault(about["recording"], (path, theirs))
                print(rows[-1], flush=True)
    result = provenance("benchmark.py t265", argv)
    result |= {"spans": list(SPANS), "rows": rows}
    store(args.out, result)
    if args.draw:
        draw(paths, FIGURE)
    return 0


class Condition(NamedTuple):
    """What a method knows of the camera."""

    times: dict[str, float]  # that it is told
    passes: int = 1  # how often it may look at the recording


def conditions(method: str, args: argparse.Namespace) -> list[Condition]:
    """Of every method nothing is told; one of them also gets the times of the camera, or passes."""
    unknown = {"readout_ms": 0.0, "depth_lag_ms": 0.0}
    if method != TOLD:
        return [Condition(unknown)]
    rolls = unknown | {"readout_ms": args.readout_ms}
    lags = rolls | {"depth_lag_ms": args.depth_lag_ms}
    return [
        Condition(unknown),
        Condition(rolls),
        Condition(lags),
        Condition(unknown, PASSES),
        Condition(unknown | {"depth_lag_ms": args.depth_lag_ms}, PASSES),
    ]


def with_times(frame: Frame, times: dict[str, float]) -> Frame:
    """A frame whose camera states its times."""
    return replace(frame, camera=replace(frame.camera, **times))


def compared(
    frames: list[Frame], theirs: np.ndarray, method: str, passes: int
) -> tuple[dict[str, Any], np.ndarray]:
    """Track some frames and compare the motions over windows.

    Args:
        frames: of a recording.
        theirs: (N, 4, 4) poses of the other camera.
        method: of ours.
        passes: how often it looks at the recording; the figures are those of the last time.

    Returns:
        The figures, and the path of the camera in the other one's world, (N, 4, 4).
    """
    make_tracker = partial(Odometry, method=method)
    pixel_times = find_times(frames, passes - 1, make_tracker)
    tracker = make_tracker()
    tracker.warm_up()
    poses = []
    states: Counter[str] = Counter()
    reasons: Counter[str] = Counter()
    times = []
    for frame in frames:
        begin = time.process_time()
        step = tracker.track(pixel_times.frame(frame))
        times.append(1e3 * (time.process_time() - begin))
        poses.append(step.T_world_cam)
        states[step.status.state.value] += 1
        if not step.ok:
            reasons[step.status.reason.value] += 1
    ours = np.stack(poses)
    X = hand_eye(windows(ours, FITTED_SPAN), windows(theirs, FITTED_SPAN))
    row = {
        "frames": len(frames),
        "passes": passes,
        "readout_found": found(pixel_times.readout),
        "states": dict(states),
        "reasons": dict(reasons),
        "processor_ms": {
            "median": digits(np.median(times)),
            "p95": digits(np.percentile(times, 95)),
        },
        "windows": {
            str(span): figures(windows(ours, span), windows(theirs, span), X)
            for span in SPANS
            if span < len(frames)
        },
    }
    return row, invert(X) @ invert(ours[0]) @ ours @ X


def found(readout: Mean | None) -> dict[str, float] | None:
    """The readout that passes have found, ms, and its standard deviation."""
    if readout is None:
        return None
    return {"ms": digits(readout.error), "std_ms": digits(readout.std)}


def windows(poses: np.ndarray, span: int) -> np.ndarray:
    """Motions (M, 4, 4) over a number of frames, a third of it apart."""
    starts = range(0, len(poses) - span, max(1, span // 3))
    return np.stack([invert(poses[i]) @ poses[i + span] for i in starts])


def residuals(
    ours: np.ndarray, theirs: np.ndarray, X: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Rotation, degrees, and translation, cm, that is left of ours X = X theirs."""
    left = invert(X @ theirs @ invert(X)) @ ours
    turned = Rotation.from_matrix(left[:, :3, :3]).magnitude()
    return np.degrees(turned), 100 * np.linalg.norm(left[:, :3, 3], axis=1)


def hand_eye(ours: np.ndarray, theirs: np.ndarray) -> np.ndarray:
    """(4, 4) X with ours X = X theirs, by a robust fit to motions."""
    a = Rotation.from_matrix(ours[:, :3, :3]).as_rotvec()
    b = Rotation.from_matrix(theirs[:, :3, :3]).as_rotvec()
    start = np.r_[Rotation.align_vectors(a, b)[0].as_rotvec(), 0, 0, 0]
    degrees, centimetres, metres = FIT_SCALES

    def cost(x: np.ndarray) -> np.ndarray:
        angle, length = residuals(ours, theirs, transform_of(x))
        return np.r_[angle / degrees, length / centimetres, x[3:] / metres]

    return transform_of(least_squares(cost, start, loss="soft_l1").x)


def transform_of(x: np.ndarray) -> np.ndarray:
    """The transform (4, 4) of a rotation vector and a translation (6,)."""
    return make_transform(Rotation.from_rotvec(x[:3]).as_matrix(), x[3:])


def figures(ours: np.ndarray, theirs: np.ndarray, X: np.ndarray) -> dict[str, Any]:
    """Median and 90th percentile of what is left over windows of one length."""
    angle, length = residuals(ours, theirs, X)
    return {
        "windows": len(ours),
        "rotation_deg": spread(angle),
        "translation_cm": spread(length),
    }


def spread(values: np.ndarray) -> dict[str, float]:
    return {
        "median": digits(np.median(values)),
        "p90": digits(np.percentile(values, 90)),
    }


def draw(paths: dict[str, tuple[np.ndarray, np.ndarray]], path: Path) -> None:
    """Draw the three coordinates of both paths over the frames: no image is shown."""
    figure = Figure(figsize=(8, 3), layout="constrained")
    for axes, (name, (ours, theirs)) in zip(
        figure.subplots(1, len(paths), squeeze=False)[0], paths.items(), strict=True
    ):
        from_start = invert(theirs[0]) @ theirs[: len(ours)]
        for label, poses in (("T265", from_start), ("hybrid", ours)):
            shift = 100 * poses[:, :3, 3]
            axes.plot(shift, color=COLOURS[label], linewidth=1.2)
            axes.plot([], [], color=COLOURS[label], label=label)
        axes.set(title=name, xlabel="frame", ylabel="x, y, z, cm")
    axes.legend()
    figure.savefig(path, dpi=120)
