"""Paths at video rate: rendered scenes slowed down to steps
of one to two centimetres.

A part of ``tools/benchmark.py``. Where objects move slowly too, each step differs
little between them and the static scene; the figures say whether a path still
holds, and whether its covariance says how well.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from typing import Any, NamedTuple

import cv2
import numpy as np
from measuring import OUTSIDE, digits, proportion, timed
from measuring import measured as measured_items
from scipy.interpolate import CubicSpline
from scipy.spatial.transform import Rotation, RotationSpline

from hybridvo.geometry import adjoint, invert, se3_log
from hybridvo.synthetic.render import Scene
from hybridvo.synthetic.scenes import make_scene
from hybridvo.synthetic.sensors import depth_jump

KINDS = ("static", "light", "heavy_two")
"""Families of scenes."""
SIZE = (240, 320)
"""Rows and columns of the images."""
SLOWDOWN = 5
"""Frames for each frame of the scene: its steps of 6 to 13 cm become 1 to 3 cm."""
FRAME_RATE = 30.0
"""Frames a second."""
IMAGE_NOISE = 2.0
"""Standard deviation of the image noise, grey levels."""
NOISE_BLUR_PX = 1.5
"""Standard deviation of the blur that correlates the depth noise."""
EDGE_JUMP = 0.1
"""Relative difference of depth between neighbours at which
the sensor loses an edge."""
OFF_M = 0.005
"""Translation error from which an ``ok`` step is off, metres."""


class DepthNoise(NamedTuple):
    """What a depth sensor adds to the true depth."""

    quadratic: float  # the noise has the standard deviation quadratic * z^2, 1/m
    loses_edges: bool


NOISES = {
    "exact": DepthNoise(0.0, loses_edges=False),
    "structured light": DepthNoise(0.0015, loses_edges=True),
    "a third of it": DepthNoise(0.0005, loses_edges=True),
}
"""The depth sensors by name."""


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
    }


def track_scene(frame_count: int, kind_and_seed: tuple[str, int]) -> dict[str, Any]:
    """Track a scene with the noise of every sensor."""
    kind, seed = kind_and_seed
    scene = slow_scene(kind, seed, frame_count)
    frames = [scene.render(i) for i in range(scene.frames)]
    return {noise: track(scene, frames, noise, seed) for noise in NOISES}


# --- scenes -----------------------------------------------------------------------


def slow_scene(kind: str, seed: int, frames: int) -> Scene:
    """A rendered scene whose camera and objects move SLOWDOWN times as
    slowly, for some frames.
    """
    height, width = SIZE
    keys = -(-frames // SLOWDOWN) + 1
    scene = make_scene(kind, seed, height=height, width=width, frames=keys)
    return slowed_down(scene, SLOWDOWN, frames)


def slowed_down(scene: Scene, factor: int, frames: int) -> Scene:
    """The scene with its frames ``factor`` frames apart, and splines in between."""
    key_times = factor * np.arange(scene.frames)
    times = np.arange(frames)
    rotations = Rotation.from_matrix(scene.T_world_cam[:, :3, :3])
    T_world_cam = np.tile(np.eye(4), (frames, 1, 1))
    T_world_cam[:, :3, :3] = RotationSpline(key_times, rotations)(times).as_matrix()
    T_world_cam[:, :3, 3] = CubicSpline(key_times, scene.T_world_cam[:, :3, 3])(
        times
    )
    solids = []
    for solid in scene.solids:
        is_moving = solid.A_world_body.ndim == 3
        if is_moving:
            spline = CubicSpline(key_times, solid.A_world_body)
            solid = replace(solid, A_world_body=spline(times))
        solids.append(solid)
    return replace(scene, T_world_cam=T_world_cam, solids=tuple(solids))


def measured(frame: Any, noise: DepthNoise, rng: np.random.Generator) -> Measured:
    """Image and depth of a rendered frame as a sensor delivers them."""
    image = frame.rgb + rng.normal(0, IMAGE_NOISE, frame.rgb.shape)
    rgb = np.clip(np.rint(image), 0, 255).astype(np.uint8)
    depth = frame.depth.astype(np.float64)
    if noise.quadratic:
        white = rng.standard_normal(depth.shape)
        field = cv2.GaussianBlur(white, (0, 0), NOISE_BLUR_PX)
        depth = depth + noise.quadratic * depth**2 * field / field.std()
    if noise.loses_edges:
        depth[depth_jump(frame.depth) > EDGE_JUMP * depth] = 0
    return Measured(rgb, depth.astype(np.float32))


# --- tracking and figures ---------------------------------------------------------


def track(
    scene: Scene, frames: Sequence[Any], noise: str, seed: int
) -> dict[str, Any]:
    """Track the frames of a scene with a sensor's noise, and measure the path."""
    from hybridvo import Frame, Odometry

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
        deviation by the chained covariances; ``steps``, ``failed``;
        ``ok_and_off``: ``ok`` steps whose translation errs by more than OFF_M;
        ``nees``: of each step that did not fail.
    """
    # of each pose, as a left perturbation in its camera; the first pose is given
    covariances = {steps[0].index: np.zeros((6, 6))}
    failed = 0
    ok_and_off = 0
    nees = []
    moved = [step for step in steps if step.prev_index is not None]
    for step in moved:
        T_prev_curr = invert(step.T_curr_prev)
        T_true = invert(T_world_cam[step.index]) @ T_world_cam[step.prev_index]
        error = se3_log(T_true @ T_prev_curr)
        if step.usable:
            nees.append(float(error @ np.linalg.solve(step.covariance, error)))
        else:
            failed += 1
        if step.ok and np.linalg.norm(error[:3]) > OFF_M:
            ok_and_off += 1
        A = adjoint(step.T_curr_prev)
        before = A @ covariances[step.prev_index] @ A.T
        covariances[step.index] = before + step.covariance
    last = steps[-1]
    variance = np.trace(covariances[last.index][:3, :3])
    away = last.T_world_cam[:3, 3] - T_world_cam[last.index][:3, 3]
    return {
        "end_cm": 100 * float(np.linalg.norm(away)),
        "sigma_cm": 100 * float(np.sqrt(variance)),
        "steps": len(moved),
        "failed": failed,
        "ok_and_off": ok_and_off,
        "nees": nees,
    }


def summarise_runs(runs: list[dict[str, Any]]) -> dict[str, Any]:
    """Medians over the paths of a row, and its steps together."""
    nees = np.concatenate([run["nees"] for run in runs])
    times_ms = np.concatenate([run["ms"] for run in runs])
    ends = [run["end_cm"] for run in runs]
    beyond = int((nees > OUTSIDE).sum())
    return {
        "end_cm": digits(np.median(ends)),
        "worst_end_cm": digits(max(ends)),
        "sigma_cm": digits(np.median([run["sigma_cm"] for run in runs])),
        "steps": sum(run["steps"] for run in runs),
        "failed": sum(run["failed"] for run in runs),
        "ok_and_off": sum(run["ok_and_off"] for run in runs),
        "nees_median": digits(np.median(nees)) if len(nees) else None,
        "beyond_3_sigma": proportion(beyond, len(nees)),
        "ms": digits(np.median(times_ms)),
    }
