"""Paths at video rate: rendered scenes slowed down to steps
of one to two centimetres, and people before a camera that stands.

A part of ``tools/benchmark.py methods``. Where objects move slowly too, each step differs
little between them and the static scene; the figures state whether a path still
holds, and whether its covariance states how well.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from measuring import OUTSIDE, digits, proportion, timed
from measuring import measured as measured_items
from scipy.stats import chi2

from hybridvo import Frame, Odometry, open_sequence
from hybridvo.core.geometry import invert, se3_log
from hybridvo.tracking.calibration import KEYFRAME_CORRELATION
from hybridvo.tracking.chains import PathCovariance
from hybridvo_lab.synthetic.render import Scene
from hybridvo_lab.synthetic.slow_scenes import (
    noisy_image,
    slow_scene,
    structured_light,
)

KINDS = ("static", "light", "heavy_two")
"""Families of scenes."""
SIZE = (240, 320)
"""Rows and columns of the images."""
FRAME_RATE = 30.0
"""Frames a second."""
OFF_M = 0.005
"""Translation error from which an ``ok`` step is off, metres."""
POSITION_OUTSIDE = float(chi2.ppf(0.9973, 3))
"""Squared distance of a position, three degrees of freedom, from which it is beyond
3 sigma."""
TRIPODS = ("books", "boxes", "corridor", "fruit", "lab_close", "lab_far")
"""Recordings of a camera that stands. The floor shakes when people walk by."""

NOISES = {
    "exact": 0.0,
    "structured light": 0.0015,
    "a third of it": 0.0005,
}
"""Name of a depth sensor -> standard deviation of its noise in metres over the square
of the depth. Those with noise lose edges as well."""


class Measured(NamedTuple):
    """What a sensor delivers of a frame."""

    rgb: np.ndarray  # (H, W, 3) uint8
    depth: np.ndarray  # (H, W) float32 metres, 0 where invalid


def video_rate(args: argparse.Namespace) -> dict[str, Any]:
    """Figures of the default method on every kind of scene and depth noise."""
    seeds = range(args.seed0, args.seed0 + args.sequences)
    scenes = {f"{kind} {seed}": (kind, seed) for kind in KINDS for seed in seeds}
    work = partial(track_scene, args.video_frames)
    tracked = measured_items(args, "video_rate", work, scenes)
    runs = {
        (kind, noise): [tracked[f"{kind} {seed}"][noise] for seed in seeds]
        for kind in KINDS
        for noise in NOISES
    }
    return {
        "method": "hybrid",
        "seeds": [seeds[0], seeds[-1]],
        "frames": args.video_frames,
        "frame_rate": FRAME_RATE,
        "size": list(SIZE),
        "off_mm": 1000 * OFF_M,
        "rows": [
            {"kind": kind, "noise": noise} | summarise_runs(some)
            for (kind, noise), some in runs.items()
        ],
        "standing": standing(args.data / "tripod"),
    }


def standing(folder: Path) -> list[dict[str, Any]]:
    """Figures of a camera on a tripod: the true path stays where it began."""
    rows = []
    for name in TRIPODS:
        if not (folder / name).is_dir():
            continue
        sequence = open_sequence(folder / name)
        odometry = Odometry()
        timings = [timed(partial(odometry.track, frame)) for frame in sequence]
        steps = [step for step, _ in timings]
        T_true = np.tile(np.eye(4), (len(steps), 1, 1))
        run = path_figures(steps, T_true) | {"ms": [ms for _, ms in timings]}
        rows.append({"recording": name} | summarise_runs([run]))
    return rows


def track_scene(frame_count: int, kind_and_seed: tuple[str, int]) -> dict[str, Any]:
    """Track a scene with the noise of every sensor."""
    kind, seed = kind_and_seed
    scene = slow_scene(kind, seed, frame_count, SIZE)
    frames = [scene.render(i) for i in range(scene.frames)]
    return {noise: track(scene, frames, noise, seed) for noise in NOISES}


# --- sensor -----------------------------------------------------------------------


def measured(frame: Any, noise: float, rng: np.random.Generator) -> Measured:
    """Image and depth of a rendered frame as a sensor delivers them."""
    rgb = noisy_image(frame.rgb, rng)
    if not noise:
        return Measured(rgb, frame.depth)
    depth = structured_light(frame.depth, rng, noise, edges_by_measured=True)
    return Measured(rgb, depth)


# --- tracking and figures ---------------------------------------------------------


def track(
    scene: Scene, frames: Sequence[Any], noise: str, seed: int
) -> dict[str, Any]:
    """Track the frames of a scene with a sensor's noise, and measure the path."""
    rng = np.random.default_rng([seed, list(NOISES).index(noise)])
    odometry = Odometry()
    odometry.set_pose(scene.T_world_cam[0])
    steps = []
    times_ms = []
    for i, frame in enumerate(frames):
        rgb, depth = measured(frame, NOISES[noise], rng)
        time_s = i / FRAME_RATE
        given = Frame(rgb, depth, scene.camera, timestamp=time_s, index=i)
        step, ms = timed(lambda given=given: odometry.track(given))
        steps.append(step)
        times_ms.append(ms)
    return path_figures(steps, scene.T_world_cam) | {"ms": times_ms}


def path_figures(steps: Sequence[Any], T_world_cam: np.ndarray) -> dict[str, Any]:
    """Errors of a tracked path beside its true poses (N, 4, 4).

    Returns:
        ``end_cm``: error of the last position; ``sigma_cm``: its standard
        deviation by the covariance of the path; ``steps``, ``failed``;
        ``ok_and_off``: ``ok`` steps whose translation errs by more than OFF_M;
        ``nees``: of each step that did not fail; ``scatter``: squared error of the
        translation of each step from a keyframe, in units of its covariance if
        both motions from there erred by themselves; ``positions``: of each
        position, by the covariance of the path.
    """
    path = PathCovariance()
    # the first pose is given
    path.begin(steps[0].index)
    failed = 0
    ok_and_off = 0
    nees = []
    scatter = []
    positions = []
    moved = [step for step in steps if step.prev_index is not None]
    for step in moved:
        T_prev_curr = invert(step.T_curr_prev)
        T_true = invert(T_world_cam[step.index]) @ T_world_cam[step.prev_index]
        error = se3_log(T_true @ T_prev_curr)
        if step.usable:
            nees.append(squared_in(step.covariance, error))
        else:
            failed += 1
        if step.ok and np.linalg.norm(error[:3]) > OFF_M:
            ok_and_off += 1
        if step.ok and step.measured is not None:
            alone = step.covariance[:3, :3] / (1 - KEYFRAME_CORRELATION)
            scatter.append(squared_in(alone, error[:3]))
        T_cam_world = invert(T_world_cam[step.index])
        away = se3_log(T_cam_world @ step.T_world_cam)[:3]
        positions.append(squared_in(path.add(step)[:3, :3], away))
    last = steps[-1]
    variance = np.trace(path.last[:3, :3])
    away = last.T_world_cam[:3, 3] - T_world_cam[last.index][:3, 3]
    return {
        "end_cm": 100 * float(np.linalg.norm(away)),
        "sigma_cm": 100 * float(np.sqrt(variance)),
        "steps": len(moved),
        "failed": failed,
        "ok_and_off": ok_and_off,
        "nees": nees,
        "scatter": scatter,
        "positions": positions,
    }


def squared_in(covariance: np.ndarray, error: np.ndarray) -> float:
    """Square of an error (N,) in units of its covariance (N, N)."""
    return float(error @ np.linalg.solve(covariance, error))


def correlation_of(scatter: np.ndarray) -> float | None:
    """Correlation of two motions from one keyframe with which the steps scatter as stated.

    Args:
        scatter: (N,) squared errors of translations, in units of the covariance of
            motions without it.
    """
    if not len(scatter):
        return None
    return digits(1 - np.median(scatter) / chi2.median(3))


def summarise_runs(runs: list[dict[str, Any]]) -> dict[str, Any]:
    """Medians over the paths of a row, and its steps together."""
    nees = np.concatenate([run["nees"] for run in runs])
    scatter = np.concatenate([run["scatter"] for run in runs])
    times_ms = np.concatenate([run["ms"] for run in runs])
    ends = [run["end_cm"] for run in runs]
    beyond = int((nees > OUTSIDE).sum())
    positions = np.concatenate([run["positions"] for run in runs])
    inside = int((positions <= POSITION_OUTSIDE).sum())
    return {
        "end_cm": digits(np.median(ends)),
        "worst_end_cm": digits(max(ends)),
        "sigma_cm": digits(np.median([run["sigma_cm"] for run in runs])),
        "steps": sum(run["steps"] for run in runs),
        "failed": sum(run["failed"] for run in runs),
        "ok_and_off": sum(run["ok_and_off"] for run in runs),
        "nees_median": digits(np.median(nees)) if len(nees) else None,
        "beyond_3_sigma": proportion(beyond, len(nees)),
        "correlation": correlation_of(scatter),
        "positions_inside": proportion(inside, len(positions)),
        "ms": digits(np.median(times_ms)),
    }
