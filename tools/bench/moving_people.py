"""A camera that stands while people walk by: where each
method believes that it goes.

    python tools/benchmark.py moving_people --out docs/results/moving_people.json
    python tools/benchmark.py moving_people --draw docs/results/moving_people.json

The recordings are of a tripod: the true path is one point. Then a virtual camera turns
in them by exact angles (a homography), and its true path is the same point. The second
command draws docs/figures/moving_people.png from the figures, without any image.
"""

from __future__ import annotations

import argparse
import importlib.util
import itertools
import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from matplotlib.figure import Figure
from measuring import digits, parser_of, provenance, write_result
from scipy.spatial.transform import Rotation

from hybridvo import Camera, Frame, FramePair, Odometry, chain_covariance
from hybridvo.core.geometry import invert, rotation_angle
from hybridvo.flow.providers import dis_flow, with_flow
from hybridvo_lab.baselines import estimate
from hybridvo_lab.synthetic.turned_windows import (
    TripodRecording,
    load_tripod,
    turning_camera,
)

RECORDINGS = ("lab_close", "books", "fruit")
"""Recordings below the data folder that are in no training."""
SHOWN = "lab_close"
"""The recording whose paths are drawn."""
LIMITS_PX = (0.25, 0.5, 1.0, 2.0, 3.0)
"""Residuals of an inlier of PnP-RANSAC, of which the best is kept by the true path."""
WINDOW = (300, 400)
"""Rows and columns of the camera that turns."""
SWING_DEG = (9.0, 4.0)
"""How far it turns to each side, and up and down."""
PERIODS = (30.0, 17.0)
"""Frames of one turn to and fro, and of one up and down."""
OFF_CM = 1.0
OFF_DEG = 0.15
"""Errors of a step from which an ``ok`` one counts as wrong: the floor of
the recordings shakes by 0.03 degrees."""
COLOURS = {
    "hybridvo": "#0072B2",
    "OpenCV RGB-D odometry": "#D55E00",
    "OpenCV PnP-RANSAC, best limit": "#CC79A7",
    "small_gicp": "#009E73",
}
"""Methods of the figure, in the colours of Okabe and Ito."""

Motions = list[np.ndarray]
"""T_prev_curr (4, 4) of each pair of neighbours."""


class Path6(NamedTuple):
    """What one method answers about a recording."""

    poses: np.ndarray  # (N, 4, 4) T_first_cam
    limits: str = ""  # which setting was the best by the true path
    steps: Sequence[Any] = ()  # of hybridvo


def build_parser() -> argparse.ArgumentParser:
    parser = parser_of(__file__, __doc__)
    add = parser.add_argument
    add("--data", type=Path, default=Path("../shared/data"), metavar="DIR")
    add("--out", type=Path, default=Path("docs/results/moving_people.json"))
    add("--overwrite", action="store_true")
    add("--draw", type=Path, metavar="JSON", help="only draw the figure of it")
    figure = Path("docs/figures/moving_people.png")
    add("--figure", type=Path, default=figure, metavar="FILE")
    return parser


def main(argv: list[str] | None = None) -> int:
    args = build_parser().parse_args(argv)
    if args.draw is not None:
        content = json.loads(args.draw.read_text(encoding="utf-8"))
        draw(content, args.figure)
        print(args.figure)
        return 0
    tripod = args.data / "tripod"
    return write_result(
        "benchmark.py moving_people",
        args.out,
        args.overwrite,
        lambda: provenance("benchmark.py moving_people", argv) | measure(tripod),
    )


# --- measuring --------------------------------------------------------------------


def measure(tripod: Path) -> dict[str, Any]:
    """Every method on every recording, as it is and turned."""
    rows = []
    paths: dict[str, dict[str, Any]] = {}
    for recording in load_tripod(tripod, RECORDINGS):
        for kind in ("stands", "turns"):
            frames, R_true = views(recording, kind)
            answers = answer(frames, R_true)
            about = describe(recording, kind, R_true)
            for method, path in answers.items():
                row = about | {"method": method} | figures(path, R_true)
                rows.append(row)
                print(row, flush=True)
            if recording.name == SHOWN:
                paths[kind] = drawn(kind, answers, R_true)
    return {
        "limits_px": LIMITS_PX,
        "off_cm": OFF_CM,
        "off_deg": OFF_DEG,
        "shown": SHOWN,
        "window": WINDOW,
        "rows": rows,
        "paths": paths,
    }


def views(
    recording: TripodRecording, kind: str
) -> tuple[Sequence[Frame], np.ndarray]:
    """The frames of a camera that stands or turns, and its true
    rotations (N, 3, 3) from the first.
    """
    count = len(recording.frames)
    if kind == "stands":
        return recording.frames, np.tile(np.eye(3), (count, 1, 1))
    k = np.arange(count)
    yaw = SWING_DEG[0] * np.sin(2 * np.pi * k / PERIODS[0])
    pitch = SWING_DEG[1] * np.sin(2 * np.pi * k / PERIODS[1])
    angles = np.stack([yaw, pitch], axis=-1)
    R = Rotation.from_euler("YX", angles, degrees=True).as_matrix()
    whole = recording.frames[0].camera
    height, width = WINDOW
    middle = ((width - 1) / 2, (height - 1) / 2)
    window = Camera(whole.fx, whole.fy, *middle, height=height, width=width)
    return turning_camera(recording, R, window), R[0].T @ R


def describe(
    recording: TripodRecording, kind: str, R_true: np.ndarray
) -> dict[str, Any]:
    """What a row states of its recording."""
    shares = [float(mask.mean()) for mask in recording.foreground]
    turns = np.swapaxes(R_true[:-1], 1, 2) @ R_true[1:]
    angles = [np.degrees(rotation_angle(R)) for R in turns]
    return {
        "recording": recording.name,
        "kind": kind,
        "frames": len(recording.frames),
        "foreground_max": digits(max(shares)),
        "turn_deg": digits(np.median(angles)),
    }


def answer(frames: Sequence[Frame], R_true: np.ndarray) -> dict[str, Path6]:
    """The path of every method."""
    flow = dis_flow()
    pairs = [
        with_flow(FramePair(prev, curr, None), flow)
        for prev, curr in itertools.pairwise(frames)
    ]
    answers = {"hybridvo": track(frames)}
    rgbd = [motion_of("opencv-rgbd", pair) for pair in pairs]
    answers["OpenCV RGB-D odometry"] = Path6(chained(rgbd))
    by_limit = {
        f"{limit:g} px": chained(
            [motion_of("pnp-ransac-tuned", pair, limit) for pair in pairs]
        )
        for limit in LIMITS_PX
    }
    answers["OpenCV PnP-RANSAC, best limit"] = best(by_limit)
    if importlib.util.find_spec("small_gicp"):
        by_start = {
            "identity as start": [motion_of("small-gicp", pair) for pair in pairs],
            "constant velocity as start": predicted(pairs),
        }
        answers["small_gicp"] = best(
            {name: chained(motions) for name, motions in by_start.items()}
        )
    return answers


def track(frames: Sequence[Frame]) -> Path6:
    """The path of the tracker with its defaults."""
    odometry = Odometry()
    steps = [odometry.track(frame) for frame in frames]
    poses = np.stack([step.T_world_cam for step in steps])
    return Path6(poses, steps=steps)


def motion_of(
    method: str, pair: FramePair, inlier_px: float | None = None
) -> np.ndarray:
    """T_prev_curr (4, 4) of a method of another library; no motion where it failed."""
    motion = estimate(method, pair, inlier_px=inlier_px)
    return invert(motion.T_curr_prev)


def predicted(pairs: Sequence[FramePair]) -> Motions:
    """T_prev_curr by small_gicp, each from the motion before."""
    T = np.eye(4)
    motions = []
    for pair in pairs:
        T = estimate("small-gicp", pair, start=T).T_curr_prev
        motions.append(invert(T))
    return motions


def chained(motions: Motions) -> np.ndarray:
    """T_first_cam (N, 4, 4) of the motions between neighbours."""
    poses = [np.eye(4)]
    for T_prev_curr in motions:
        poses.append(poses[-1] @ T_prev_curr)
    return np.stack(poses)


def best(candidates: dict[str, np.ndarray]) -> Path6:
    """The path that stays nearest to the true point: chosen by the true path."""

    def rmse(name: str) -> float:
        away = candidates[name][:, :3, 3]
        return float(np.mean(away**2))

    name = min(candidates, key=rmse)
    return Path6(candidates[name], name)


# --- figures ----------------------------------------------------------------------


def figures(path: Path6, R_true: np.ndarray) -> dict[str, Any]:
    """Errors of a path whose true position never changes, and what it states."""
    away = 100 * np.linalg.norm(path.poses[:, :3, 3], axis=1)
    turned = angles_deg(path.poses[:, :3, :3], R_true)
    row: dict[str, Any] = {
        "rmse_cm": digits(np.sqrt(np.mean(away**2))),
        "worst_cm": digits(away.max()),
        "rmse_deg": digits(np.sqrt(np.mean(turned**2))),
        "chosen": path.limits,
    }
    if path.steps:
        row |= stated(path, R_true)
    return row


def angles_deg(R: np.ndarray, R_true: np.ndarray) -> np.ndarray:
    """(N,) degrees between rotations."""
    errors = np.swapaxes(R_true, 1, 2) @ R
    return np.array([np.degrees(rotation_angle(each)) for each in errors])


def stated(path: Path6, R_true: np.ndarray) -> dict[str, Any]:
    """Statuses of the steps, and standard deviations beside the errors."""
    states = [str(step.status.state.value) for step in path.steps[1:]]
    errors_cm = []
    sigmas_cm = []
    wrong = 0
    for step in path.steps[1:]:
        if not step.usable or step.prev_index is None:
            continue
        T = step.T_prev_curr
        R = R_true[step.prev_index].T @ R_true[step.index]
        error_cm = 100 * float(np.linalg.norm(T[:3, 3]))
        error_deg = np.degrees(rotation_angle(R.T @ T[:3, :3]))
        errors_cm.append(error_cm)
        variance = np.trace(step.covariance[:3, :3])
        sigmas_cm.append(100 * float(np.sqrt(variance)))
        wrong += step.ok and (error_cm > OFF_CM or error_deg > OFF_DEG)
    end_covariance = chain_covariance(path.steps)
    end_cm = 100 * np.linalg.norm(path.poses[-1][:3, 3])
    return {
        "states": {
            name: states.count(name) for name in ("ok", "degraded", "failed")
        },
        "ok_and_wrong": int(wrong),
        "step_cm": digits(np.median(errors_cm)),
        "step_sigma_cm": digits(np.median(sigmas_cm)),
        "end_cm": digits(end_cm),
        "end_sigma_cm": digits(100 * np.sqrt(np.trace(end_covariance[:3, :3]))),
    }


def drawn(
    kind: str, answers: dict[str, Path6], R_true: np.ndarray
) -> dict[str, Any]:
    """What the figure shows: positions from above in cm, or headings in degrees."""
    if kind == "turns":
        headings = {name: heading(path.poses) for name, path in answers.items()}
        return {"true": heading(R_true)} | headings
    content = {}
    for name, path in answers.items():
        xyz_cm = 100 * path.poses[:, :3, 3]
        content[name] = {
            "right_cm": rounded(xyz_cm[:, 0]),
            "ahead_cm": rounded(xyz_cm[:, 2]),
            "away_cm": rounded(np.linalg.norm(xyz_cm, axis=1)),
        }
    return content


def heading(R: np.ndarray) -> list[float]:
    """Angles (N,) to the right of where a camera looks, degrees."""
    return rounded(np.degrees(np.arctan2(R[:, 0, 2], R[:, 2, 2])))


def rounded(values: np.ndarray) -> list[float]:
    return [digits(value) for value in values]


# --- drawing ----------------------------------------------------------------------


def draw(content: dict[str, Any], out: Path) -> None:
    """Three panels: paths from above, distances from the start, headings."""
    figure = Figure(figsize=(12.8, 3.9), dpi=100, layout="constrained")
    panels = figure.subplots(1, 3, width_ratios=(1, 1.15, 1.15))
    stands = content["paths"]["stands"]
    turns = content["paths"]["turns"]
    for name, colour in COLOURS.items():
        if name not in stands:
            continue
        is_ours = name == "hybridvo"
        look = {
            "color": colour,
            "lw": 2.6 if is_ours else 1.5,
            "zorder": 3 if is_ours else 2,
        }
        path = stands[name]
        panels[0].plot(path["right_cm"], path["ahead_cm"], label=name, **look)
        away_cm = path["away_cm"][1:]
        panels[1].semilogy(range(1, 1 + len(away_cm)), away_cm, **look)
        error = np.subtract(turns[name], turns["true"])
        panels[2].plot(error, **look)
    panels[0].plot(0, 0, "k+", ms=14, mew=2, zorder=4, label="true: it stands here")
    label(panels[0], "Where is the camera? From above", "cm", "cm")
    panels[0].set_aspect("equal", adjustable="datalim")
    label(panels[1], "Distance from where it stands", "frame", "cm (log scale)")
    label(panels[2], "The same, turned: error of the heading", "frame", "degrees")
    figure.legend(loc="outside lower center", ncols=5, frameon=False, fontsize=10)
    out.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(out, metadata={"Software": None})


def label(panel: Any, title: str, across: str, up: str) -> None:
    panel.set_title(title, fontsize=11, loc="left")
    panel.set_xlabel(across)
    panel.set_ylabel(up)
    panel.grid(True, color="#e4e4e4", linewidth=0.8)
