"""Random parts that all generators share: numbers, rotations, paths,
smooth fields, silhouettes.

The silhouettes stand in for the photographs of chairs from which the
paper cut its object masks.
"""

from __future__ import annotations

from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial.transform import Rotation

from hybridvo.core.geometry import make_transform

HELD_OUT, TRAINING, STORED = range(3)
"""What a sample is drawn for. No sample of one use is one of
another, whatever the seeds."""


def sample_generator(
    seed: int, index: int, use: int = HELD_OUT
) -> np.random.Generator:
    """Return the random generator of one sample, the same on every machine.

    Args:
        seed: the seed of the data set.
        index: the number of the sample.
        use: one of :data:`HELD_OUT`, :data:`TRAINING`, :data:`STORED`.

    >>> one = sample_generator(seed=0, index=7)
    >>> other = sample_generator(seed=0, index=7)
    >>> bool(one.random() == other.random())
    True
    """
    key = np.array([seed + (use << 32), index], dtype=np.uint64)
    return np.random.Generator(np.random.Philox(key=key))


# --- numbers, rotations and affine maps -------------------------------------------


def log_uniform(rng: np.random.Generator, limits: tuple[float, float]) -> float:
    """Draw a number whose logarithm is uniform between two positive limits."""
    return float(np.exp(rng.uniform(np.log(limits[0]), np.log(limits[1]))))


def random_direction(rng: np.random.Generator) -> np.ndarray:
    """Draw a unit vector (3,), uniform on the sphere."""
    v = rng.standard_normal(3)
    return v / np.linalg.norm(v)


def rotation_by(rng: np.random.Generator, angle_deg: float) -> np.ndarray:
    """Draw a rotation (3, 3) by a given angle about a random axis."""
    axis_angle = np.radians(angle_deg) * random_direction(rng)
    return Rotation.from_rotvec(axis_angle).as_matrix()


def random_rotation(rng: np.random.Generator) -> np.ndarray:
    """Draw a rotation (3, 3), uniform over all rotations."""
    return Rotation.random(random_state=rng).as_matrix()


def rotation_about(
    R: np.ndarray, point: np.ndarray, t: ArrayLike = 0.0
) -> np.ndarray:
    """Return the motion (4, 4) that rotates about a point (3,) and
    then translates by ``t``.
    """
    return make_transform(R, point - R @ point + t)


def affine(
    half: ArrayLike, centre: ArrayLike, R: np.ndarray | None = None
) -> np.ndarray:
    """Return the map (3, 4) that places a unit shape.

    Args:
        half: (3,) half axes of the shape, metres, or one number for all three.
        centre: (3,) its centre, metres.
        R: (3, 3) its axes as columns; None: those of the frame.
    """
    axes = np.eye(3) if R is None else R
    scaled = axes * np.broadcast_to(np.asarray(half, float), 3)
    return np.column_stack([scaled, np.asarray(centre, float)])


def compose(T: np.ndarray, A: np.ndarray) -> np.ndarray:
    """Return T @ A for affine maps T (..., 4, 4) and A (..., 3, 4).

    Either may be one for all.
    """
    out = T[..., :3, :3] @ A
    out[..., 3] += T[..., :3, 3]
    return out


# --- smooth paths and fields ------------------------------------------------------


class CameraPath(NamedTuple):
    """A camera's path, with and without the shaking of a hand; each (N, 4, 4)."""

    T_world_cam: np.ndarray
    T_world_cam_smooth: np.ndarray


def camera_path(
    rng: np.random.Generator, frames: int, step: float, turn_deg: float
) -> CameraPath:
    """Draw the path of a hand-held camera that swings to and fro.

    Args:
        rng: the source of randomness.
        frames: the number of poses, N.
        step: the typical translation between two frames, metres.
        turn_deg: the typical rotation between two frames, degrees.
    """
    t = np.arange(frames)

    def wave(rate: float, low: float, high: float) -> tuple[np.ndarray, np.ndarray]:
        """Draw a cosine and a sine whose period lies in [low, high] and
        whose slope is ``rate``.
        """
        period = rng.uniform(low, high)
        phase = 2 * np.pi * (t / period + rng.uniform())
        sign = rng.choice([-1.0, 1.0])
        amplitude = rate * period / (2 * np.pi)
        return amplitude * np.cos(phase), sign * amplitude * np.sin(phase)

    x, z = wave(step * rng.uniform(0.8, 1.2), 50, 80)
    y, _ = wave(0.35 * step, 30, 60)
    yaw, pitch = wave(turn_deg, 45, 75)
    roll, _ = wave(0.25 * turn_deg, 30, 60)
    position = np.stack([x, y, rng.uniform(0.6, 1.0) * z], axis=1)
    angles_deg = np.stack([0.5 * pitch, yaw, roll], axis=1)

    shakes = [wave(0.1 * step, 7, 13)[0] for _ in range(3)]
    shakes_deg = [wave(0.15 * turn_deg, 7, 13)[0] for _ in range(3)]
    shaken = poses(
        angles_deg + np.stack(shakes_deg, axis=1),
        position + np.stack(shakes, axis=1),
    )
    return CameraPath(shaken, poses(angles_deg, position))


def poses(angles_deg: np.ndarray, position: np.ndarray) -> np.ndarray:
    """Return poses (N, 4, 4) from Euler angles X-Y-Z (N, 3),
    degrees, and positions (N, 3).
    """
    T = np.tile(np.eye(4), (len(position), 1, 1))
    T[:, :3, :3] = Rotation.from_euler("XYZ", angles_deg, degrees=True).as_matrix()
    T[:, :3, 3] = position
    return T


def sway(rng: np.random.Generator, frames: int, rate: float) -> np.ndarray:
    """Draw a smooth oscillation (N, 3) that changes by about ``rate``
    a frame and never rests.
    """
    axes = rng.normal(size=(2, 3))
    axes /= np.linalg.norm(axes, axis=1, keepdims=True)
    period = rng.uniform(22, 40)
    phase = 2 * np.pi * (np.arange(frames) / period + rng.uniform())
    circle = np.outer(np.cos(phase), axes[0]) + np.outer(np.sin(phase), axes[1])
    return rate * period / (2 * np.pi) * circle


def smooth_field(
    rng: np.random.Generator, size: tuple[int, ...], cells: int, channels: int = 1
) -> np.ndarray:
    """Draw a smooth Gaussian field, float32, whose standard deviation is about one.

    Args:
        rng: the source of randomness.
        size: (height, width) of the field.
        cells: knots over the height; the width has as many in proportion.
        channels: number of independent fields.

    Returns:
        (H, W), or (H, W, channels) where there is more than one.
    """
    height, width = size
    rows = max(cells, 2)
    columns = max(round(cells * width / max(height, 1)), 2)
    coarse = rng.standard_normal((rows, columns, channels), dtype=np.float32)
    field = cv2.resize(coarse, (width, height), interpolation=cv2.INTER_CUBIC)
    if channels > 1:
        return field.reshape(height, width, channels)
    return field.reshape(size)


# --- silhouettes ------------------------------------------------------------------

KINDS = ("superellipse", "polygon", "star", "bar")
"""The kinds of outlines."""
MIN_FILLED = 0.02
"""Smallest filled fraction of a silhouette's square: holes can remove a shape."""


class Silhouette(NamedTuple):
    """Outlines (N, 2) whose union is filled, and others that are cut out of it."""

    parts: list[np.ndarray]
    holes: list[np.ndarray]


def outline(rng: np.random.Generator, kind: str) -> np.ndarray:
    """Draw a closed outline (N, 2) around the origin, inside the unit circle."""
    if kind == "bar":
        half = rng.uniform(0.03, 0.18)
        points = np.array([[-1.0, -half], [1.0, -half], [1.0, half], [-1.0, half]])
    elif kind == "superellipse":
        points = _superellipse(rng)
    elif kind == "polygon":
        points = _polygon(rng)
    else:
        points = _star(rng)
    points /= np.sqrt((points**2).sum(axis=1).max())
    c, s = _unit(rng.uniform(0.0, 2 * np.pi))
    return points @ np.array([[c, s], [-s, c]])


def _superellipse(rng: np.random.Generator) -> np.ndarray:
    exponent = 2.0 / log_uniform(rng, (0.7, 6.0))
    points = _unit(np.linspace(0.0, 2 * np.pi, 48, endpoint=False))
    points = np.copysign(np.abs(points) ** exponent, points)
    points[:, 1] *= rng.uniform(0.3, 1.0)
    return points


def _polygon(rng: np.random.Generator) -> np.ndarray:
    corners = int(rng.integers(3, 10))
    number = np.arange(corners) + rng.uniform(-0.35, 0.35, corners)
    angle = 2 * np.pi * number / corners
    return rng.uniform(0.45, 1.0, corners)[:, None] * _unit(angle)


def _star(rng: np.random.Generator) -> np.ndarray:
    angle = np.linspace(0.0, 2 * np.pi, 64, endpoint=False)
    radius = np.ones_like(angle)
    for k in range(2, 8):
        amplitude = rng.uniform(0.0, 0.7) / k
        radius += amplitude * np.cos(k * angle + rng.uniform(0.0, 2 * np.pi))
    return np.maximum(radius, 0.15)[:, None] * _unit(angle)


def _unit(angle: ArrayLike) -> np.ndarray:
    return np.stack([np.cos(angle), np.sin(angle)], axis=-1)


def random_silhouette(rng: np.random.Generator) -> Silhouette:
    """Draw one to four outlines, and smaller ones to cut from their union."""
    first = KINDS[int(rng.choice(4, p=[0.35, 0.3, 0.3, 0.05]))]
    parts = [outline(rng, first)]
    for _ in range(int(rng.integers(0, 4))):
        kind = KINDS[int(rng.integers(4))]
        size = rng.uniform(0.7, 1.3) if kind == "bar" else rng.uniform(0.3, 0.8)
        part = size * outline(rng, kind)
        parts.append(part + rng.uniform(-0.6, 0.6, 2))

    holes: list[np.ndarray] = []
    if rng.random() >= 0.4:
        return Silhouette(parts, holes)
    for _ in range(int(rng.integers(1, 3))):
        kind = KINDS[int(rng.integers(3))]
        hole = rng.uniform(0.12, 0.4) * outline(rng, kind)
        holes.append(hole + rng.uniform(-0.6, 0.6, 2))
    return Silhouette(parts, holes)


def draw_mask(rng: np.random.Generator, size: int) -> np.ndarray:
    """Draw the mask (h, w) of a silhouette that spans ``size`` px,
    cropped to its bounding box.
    """
    while True:
        silhouette = random_silhouette(rng)
        points = np.concatenate(silhouette.parts)
        low = points.min(axis=0)
        high = points.max(axis=0)
        radius = size / float((high - low).max())
        centre = (size - 1 - radius * (low + high)) / 2

        mask = np.zeros((size, size), np.uint8)
        for part in silhouette.parts:
            _fill(mask, part * radius + centre, 1)
        for hole in silhouette.holes:
            _fill(mask, hole * radius + centre, 0)

        left, top, width, height = cv2.boundingRect(mask)
        if width * height and cv2.countNonZero(mask) > MIN_FILLED * mask.size:
            return mask[top : top + height, left : left + width].astype(bool)


def _fill(mask: np.ndarray, outline_px: np.ndarray, value: int) -> None:
    """Fill an outline (N, 2), px, in place."""
    # OpenCV takes positions in sixteenths of a pixel (a shift of 4 bits)
    sixteenths = np.round(outline_px * 16).astype(np.int32)
    cv2.fillPoly(mask, [sixteenths], value, cv2.LINE_8, shift=4)
