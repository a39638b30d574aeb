"""Training pairs of real people and things: windows of recordings from a tripod.

The camera stood still. A virtual one looks at a part of the image and turns between the
two frames by a rotation that is known exactly: a homography of the images.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

from hybridvo.core.geometry import make_transform, project
from hybridvo.core.types import Camera, Frame, FramePair
from hybridvo.flow.providers import FlowProvider, with_flow
from hybridvo.io.data.open import open_sequence
from hybridvo_lab.synthetic.draws import log_uniform, random_direction
from hybridvo_lab.synthetic.paper_samples import KnownPair, camera_flow

TRAINING = ("corridor", "boxes", "lab_far")
"""Recordings that may be trained on; the others are for calibration and tests."""
BACKGROUND_FRAMES = 41
"""Frames of which the medians are the empty scene."""
DEPTH_CHANGE = 0.06
"""Change of depth against the empty scene from which something stands there, relative."""
GREY_CHANGE = 30.0
"""The same where a depth is unknown, grey levels."""
MOVING_PX = 0.5
"""Difference from the ego flow from which a foreground pixel counts as moving, px."""
MAX_STRIDE = 3
"""Largest number of frames between the two of a pair."""
SWING_PX = 20.0
"""Distance of a window from the border of the recording, px: room for the turn."""
TURN_DEG = (0.1, 4.0)
"""Angle by which the virtual camera turns, degrees."""


@dataclass(frozen=True, eq=False)
class TripodRecording:
    """The frames of a recording, and where each differs from the empty scene."""

    name: str
    frames: tuple[Frame, ...]
    foreground: tuple[np.ndarray, ...]  # (H, W) uint8, 1 where something stands


class WindowView(NamedTuple):
    """What a virtual camera sees."""

    frame: Frame
    foreground: np.ndarray  # (h, w) bool


def load_tripod(
    folder: str | Path, names: Sequence[str] = TRAINING
) -> tuple[TripodRecording, ...]:
    """Read the recordings of a folder that are there."""
    present = [name for name in names if (Path(folder) / name).is_dir()]
    return tuple(_load(Path(folder) / name) for name in present)


def _load(path: Path) -> TripodRecording:
    """Read a recording and find its foreground."""
    sequence = open_sequence(path)
    frames = [sequence.frame(k) for k in range(len(sequence))]
    count = min(len(frames), BACKGROUND_FRAMES)
    chosen = np.linspace(0, len(frames) - 1, count).astype(int)
    depths = np.stack([_depth(frames[k]) for k in chosen])
    # columns without any depth stay NaN
    known = np.isfinite(depths).any(axis=0)
    background = np.full(depths.shape[1:], np.nan, np.float32)
    background[known] = np.nanmedian(depths[:, known], axis=0)
    grey = np.median(np.stack([_grey(frames[k]) for k in chosen]), axis=0)
    foreground = [_foreground(frame, background, grey) for frame in frames]
    return TripodRecording(path.name, tuple(frames), tuple(foreground))


def _depth(frame: Frame) -> np.ndarray:
    """(H, W) float32 metres, NaN where it is unknown."""
    assert frame.depth is not None
    return np.where(frame.depth > 0, frame.depth, np.nan).astype(np.float32)


def _grey(frame: Frame) -> np.ndarray:
    """(H, W) float32 grey levels."""
    assert frame.rgb is not None
    return cv2.cvtColor(frame.rgb, cv2.COLOR_RGB2GRAY).astype(np.float32)


def _foreground(
    frame: Frame, background: np.ndarray, background_grey: np.ndarray
) -> np.ndarray:
    """(H, W) uint8, 1 where a frame differs from the empty scene."""
    depth = _depth(frame)
    is_compared = np.isfinite(depth) & np.isfinite(background)
    change = np.abs(np.nan_to_num(depth - background))
    nearer = is_compared & (change > DEPTH_CHANGE * np.nan_to_num(background))
    other = ~is_compared & (np.abs(_grey(frame) - background_grey) > GREY_CHANGE)
    mask = (nearer | other).astype(np.uint8)
    square = np.ones((5, 5), np.uint8)
    return cv2.dilate(cv2.morphologyEx(mask, cv2.MORPH_OPEN, square), square)


def draw_turned_window(
    rng: np.random.Generator,
    recordings: Sequence[TripodRecording],
    flow: FlowProvider,
) -> KnownPair:
    """Draw two frames, a window that something fills, and a rotation.

    Pixels that differ from the empty scene and follow the camera all the same, such as
    people who stand still, have no true depth: they count neither way.
    """
    weight = np.sqrt([len(recording.frames) for recording in recordings])
    chosen = int(rng.choice(len(recordings), p=weight / weight.sum()))
    recording = recordings[chosen]
    stride = int(rng.integers(1, MAX_STRIDE + 1))
    first = int(rng.integers(len(recording.frames) - stride))
    indices = [first, first + stride]
    if rng.random() < 0.5:
        indices.reverse()
    camera = recording.frames[0].camera
    window = _window_camera(rng, camera)
    middle = _draw_middle(rng, recording, indices, window)

    R_prev = looking_at(middle, camera)
    turn = np.radians(log_uniform(rng, TURN_DEG)) * random_direction(rng)
    if rng.random() < 0.1:
        turn = np.zeros(3)
    R_curr = R_prev @ Rotation.from_rotvec(turn).as_matrix()
    prev, curr = (
        view_of_turned(recording.frames[k], recording.foreground[k], R, window)
        for k, R in zip(indices, (R_prev, R_curr), strict=True)
    )
    T = make_transform(R_curr.T @ R_prev, np.zeros(3))
    pair = with_flow(FramePair(prev.frame, curr.frame, None), flow)

    assert prev.frame.depth is not None
    depth = prev.frame.depth
    moving = np.zeros(depth.shape, bool)
    if pair.flow is not None:
        ego_flow = camera_flow(window.K, np.where(depth > 0, depth, 1.0), T).flow
        away = np.linalg.norm(np.nan_to_num(pair.flow - ego_flow), axis=2)
        moving = prev.foreground & (away > MOVING_PX)
    is_known = moving | ~prev.foreground
    return KnownPair(pair, T, np.where(is_known, depth, 0), moving, recording.name)


def turning_camera(
    recording: TripodRecording, R_world_cam: np.ndarray, window: Camera
) -> list[Frame]:
    """See a recording by a virtual camera that turns while the true one stands.

    Args:
        recording: The recording.
        R_world_cam: (N, 3, 3) rotations of the virtual camera, one for each frame, from its axes
            to those of the true one.
        window: The virtual camera, of the same centre.

    Returns:
        The N frames, with the time stamps of the recording.
    """
    frames = []
    for index, R in enumerate(R_world_cam):
        seen = recording.frames[index]
        frame = view_of_turned(seen, recording.foreground[index], R, window).frame
        stamp = recording.frames[index].timestamp
        frames.append(replace(frame, timestamp=stamp, index=index))
    return frames


def _draw_middle(
    rng: np.random.Generator,
    recording: TripodRecording,
    indices: Sequence[int],
    window: Camera,
) -> np.ndarray:
    """The pixel (2,) at which the virtual camera looks: mostly one of the foreground."""
    camera = recording.frames[0].camera
    zoom = window.fx / camera.fx
    margin = 0.5 * np.array([window.width, window.height]) / zoom + SWING_PX
    size = np.array([camera.width, camera.height])
    margin = np.minimum(margin, 0.45 * size)
    at = rng.uniform(margin, size - margin)
    union = recording.foreground[indices[0]] | recording.foreground[indices[1]]
    rows, columns = np.nonzero(union[::8, ::8])
    if len(rows) and rng.random() < 0.8:
        pick = int(rng.integers(len(rows)))
        at = 8.0 * np.array([columns[pick], rows[pick]])
    return np.clip(at, margin, size - margin)


def _window_camera(rng: np.random.Generator, camera: Camera) -> Camera:
    """A camera that sees a part of another's view, with pixels of the same size or larger."""
    height, width = ((240, 320), (240, 320), (192, 256), (288, 384), (180, 320))[
        int(rng.integers(5))
    ]
    zoom = rng.uniform(0.7, 1.05)
    fx = zoom * camera.fx
    fy = zoom * camera.fy
    return Camera(
        fx, fy, (width - 1) / 2, (height - 1) / 2, height=height, width=width
    )


def looking_at(pixel: np.ndarray, camera: Camera) -> np.ndarray:
    """Return the rotation (3, 3) that turns the optical axis to a pixel (2,)."""
    x = (pixel[0] - camera.cx) / camera.fx
    y = (pixel[1] - camera.cy) / camera.fy
    yaw = np.arctan2(x, 1.0)
    pitch = -np.arctan2(y, np.hypot(x, 1.0))
    return Rotation.from_euler("YX", [yaw, pitch]).as_matrix()


def view_of_turned(
    frame: Frame, foreground: np.ndarray, R: np.ndarray, window: Camera
) -> WindowView:
    """Return what a camera of the same centre sees.

    Args:
        frame: with image and depth.
        foreground: (H, W) uint8, 1 where something stands.
        R: (3, 3) from the axes of that camera to those of the frame's.
        window: that camera.
    """
    assert frame.rgb is not None and frame.depth is not None
    v, u = np.indices(window.shape, dtype=np.float64)
    ray = np.stack(
        [(u - window.cx) / window.fx, (v - window.cy) / window.fy, np.ones_like(u)],
        axis=2,
    )
    turned = ray @ R.T
    source = frame.camera
    places = project(turned, source).astype(np.float32)
    columns = np.ascontiguousarray(places[..., 0])
    rows = np.ascontiguousarray(places[..., 1])
    rgb = cv2.remap(frame.rgb, columns, rows, cv2.INTER_CUBIC)
    # z along the recording's axis over the ray's own z there
    depth = cv2.remap(frame.depth, columns, rows, cv2.INTER_NEAREST)
    depth = (depth / turned[..., 2]).astype(np.float32)
    seen_foreground = cv2.remap(foreground, columns, rows, cv2.INTER_NEAREST)
    return WindowView(Frame(rgb, np.maximum(depth, 0), window), seen_foreground > 0)
