"""A camera that turns to and fro, whose depth or whose rows are measured at other times."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from hybridvo.core.geometry import invert, se3_exp, se3_log
from hybridvo.core.types import Frame
from hybridvo_lab.synthetic.render import Scene
from hybridvo_lab.synthetic.scenes import make_scene

PERIOD_S = 1 / 30
"""Time between two frames."""
TURNS = ((0.1, 7.0), (0.2, 5.0))
"""Amplitude, rad, and angular frequency, rad/s, of pitch and yaw."""
SPEED_M_S = 0.1


def scene_of(seed: int) -> Scene:
    """A static scene in small images."""
    return make_scene("static", seed, height=120, width=160, frames=2)


def motion_until(time_s: float) -> np.ndarray:
    """(4, 4) pose of the camera at a time in that of the start."""
    pitch, yaw = (size * np.sin(rate * time_s) for size, rate in TURNS)
    return se3_exp(np.array([SPEED_M_S * time_s, 0, 0, pitch, yaw, 0]))


def seen_at(scene: Scene, times: np.ndarray) -> Scene:
    """The scene from where the camera is at some times."""
    poses = [scene.T_world_cam[0] @ motion_until(time) for time in times]
    return replace(scene, T_world_cam=np.stack(poses))


def rolling_frames(
    seed: int, readout_ms: float, lag_ms: float, count: int
) -> list[Frame]:
    """Frames of such a camera whose rows are exposed one after the other.

    Stamps are those of the middle row. Depth has the times of the rows, unless it lags.
    """
    made = []
    for frame in late_frames(seed, lag_ms, count):
        slices = 24
        rows = frame.camera.height // slices
        late_s = readout_ms / 1000 * ((np.arange(slices) + 0.5) / slices - 0.5)
        seen = seen_at(scene_of(seed), frame.timestamp + late_s)
        rgb = frame.rgb.copy()
        depth = frame.depth.copy()
        for number in range(slices):
            part = slice(number * rows, (number + 1) * rows)
            shown = seen.render(number)
            rgb[part] = shown.rgb[part]
            if lag_ms == 0:
                depth[part] = shown.depth[part]
        camera = replace(frame.camera, readout_ms=readout_ms)
        made.append(replace(frame, rgb=rgb, depth=depth, camera=camera))
    return made


def late_frames(seed: int, lag_ms: float, count: int) -> list[Frame]:
    """Frames of such a camera, which states its lag."""
    scene = scene_of(seed)
    times = PERIOD_S * np.arange(count)
    images = seen_at(scene, times)
    depths = seen_at(scene, times + lag_ms / 1000)
    camera = replace(scene.camera, depth_lag_ms=lag_ms)
    return [
        replace(
            images.render(index),
            depth=depths.render(index).depth,
            camera=camera,
            timestamp=float(times[index]),
            index=index,
        )
        for index in range(count)
    ]


def untold(frames: list[Frame]) -> list[Frame]:
    """The same frames, whose camera states no times of its pixels."""
    camera = replace(frames[0].camera, readout_ms=0.0, depth_lag_ms=0.0)
    return [replace(frame, camera=camera) for frame in frames]


def median_error_px(poses: Sequence[np.ndarray]) -> float:
    """Median error of the rotation from frame to frame, as a shift of the middle of the view."""
    errors = []
    for k in range(1, len(poses)):
        there = [motion_until(PERIOD_S * at) for at in (k - 1, k)]
        true = invert(there[1]) @ there[0]
        found = invert(poses[k]) @ poses[k - 1]
        errors.append(np.linalg.norm(se3_log(found @ invert(true))[3:]))
    return float(120 * np.median(errors))
