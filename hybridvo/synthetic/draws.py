"""What every generator of scenes draws: numbers, rotations, smooth paths and fields, silhouettes.

The silhouettes stand in for the photographs of chairs from which the paper cut its object masks.
"""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial.transform import Rotation

from hybridvo.geometry import make_transform

HELD_OUT, TRAINING, STORED = range(3)
"""What a sample is drawn for. No sample of one use is one of another, whatever the seeds."""


def sample_generator(
    seed: int, index: int, use: int = HELD_OUT
) -> np.random.Generator:
    """Return the generator of a sample, the same on every machine and in every process."""
    key = np.array([seed + (use << 32), index], dtype=np.uint64)
    return np.random.Generator(np.random.Philox(key=key))


def log_uniform(rng: np.random.Generator, limits: tuple[float, float]) -> float:
    """Draw a number whose logarithm is uniform between two positive limits."""
    return float(np.exp(rng.uniform(np.log(limits[0]), np.log(limits[1]))))


def direction(rng: np.random.Generator) -> np.ndarray:
    """Draw a unit vector (3,), uniform on the sphere."""
    v = rng.standard_normal(3)
    return v / np.linalg.norm(v)


def turn(rng: np.random.Generator, angle_deg: float) -> np.ndarray:
    """Draw a rotation (3, 3) by a given angle about any axis."""
    return Rotation.from_rotvec(np.radians(angle_deg) * direction(rng)).as_matrix()


def any_turn(rng: np.random.Generator) -> np.ndarray:
    """Draw a rotation (3, 3), uniform over all rotations."""
    return Rotation.random(random_state=rng).as_matrix()


def about(R: np.ndarray, point: np.ndarray, t: ArrayLike = 0.0) -> np.ndarray:
    """Return the motion (4, 4) that turns about a point and then translates."""
    return make_transform(R, point - R @ point + t)


def affine(
    half: ArrayLike, centre: ArrayLike, R: np.ndarray | None = None
) -> np.ndarray:
    """Return the map (3, 4) that gives a unit shape half axes along the columns of R."""
    axes = (np.eye(3) if R is None else R) * np.broadcast_to(
        np.asarray(half, float), 3
    )
    return np.column_stack([axes, np.asarray(centre, float)])


def carried(T: np.ndarray, A: np.ndarray) -> np.ndarray:
    """Return T @ A for affine maps T (..., 4, 4) and A (..., 3, 4); either may be one for all."""
    out = T[..., :3, :3] @ A
    out[..., 3] += T[..., :3, 3]
    return out


def camera_path(
    rng: np.random.Generator, frames: int, step: float, turn_deg: float
) -> tuple[np.ndarray, np.ndarray]:
    """Draw a camera path T_world_cam (N, 4, 4), with and without the shaking of a hand.

    The camera moves by about ``step`` metres and ``turn_deg`` degrees a frame.
    """
    t = np.arange(frames)

    def wave(rate: float, low: float, high: float) -> tuple[np.ndarray, np.ndarray]:
        period = rng.uniform(low, high)
        phase = 2 * np.pi * (t / period + rng.uniform())
        sign = rng.choice([-1.0, 1.0])
        amplitude = rate * period / (2 * np.pi)
        return amplitude * np.cos(phase), sign * amplitude * np.sin(phase)

    x, z = wave(step * rng.uniform(0.8, 1.2), 50, 80)
    y = wave(0.35 * step, 30, 60)[0]
    yaw, pitch = wave(turn_deg, 45, 75)
    roll = wave(0.25 * turn_deg, 30, 60)[0]
    position = np.stack([x, y, rng.uniform(0.6, 1.0) * z], axis=1)
    angles = np.stack([0.5 * pitch, yaw, roll], axis=1)
    shake = np.stack([wave(0.1 * step, 7, 13)[0] for _ in range(3)], axis=1)
    shake_deg = np.stack(
        [wave(0.15 * turn_deg, 7, 13)[0] for _ in range(3)], axis=1
    )
    return poses(angles + shake_deg, position + shake), poses(angles, position)


def poses(angles_deg: np.ndarray, position: np.ndarray) -> np.ndarray:
    """Return poses (N, 4, 4) from Euler angles X-Y-Z (N, 3), degrees, and positions (N, 3)."""
    T = np.tile(np.eye(4), (len(position), 1, 1))
    T[:, :3, :3] = Rotation.from_euler("XYZ", angles_deg, degrees=True).as_matrix()
    T[:, :3, 3] = position
    return T


def sway(rng: np.random.Generator, frames: int, rate: float) -> np.ndarray:
    """Draw a smooth oscillation (N, 3) that changes by about ``rate`` a frame and never rests."""
    axes = rng.normal(size=(2, 3))
    axes /= np.linalg.norm(axes, axis=1, keepdims=True)
    period = rng.uniform(22, 40)
    phase = 2 * np.pi * (np.arange(frames) / period + rng.uniform())
    circle = np.outer(np.cos(phase), axes[0]) + np.outer(np.sin(phase), axes[1])
    return rate * period / (2 * np.pi) * circle


def smooth_field(
    rng: np.random.Generator, size: tuple[int, ...], cells: int, channels: int = 1
) -> np.ndarray:
    """Draw a smooth Gaussian field (H, W[, C]) of about unit spread, ``cells`` knots a height."""
    height, width = size
    rows = max(cells, 2)
    columns = max(round(cells * width / max(height, 1)), 2)
    coarse = rng.standard_normal((rows, columns, channels), dtype=np.float32)
    field = cv2.resize(coarse, (width, height), interpolation=cv2.INTER_CUBIC)
    return (
        field.reshape(height, width, channels)
        if channels > 1
        else field.reshape(size)
    )


KINDS = ("superellipse", "polygon", "star", "bar")


def outline(rng: np.random.Generator, kind: str) -> np.ndarray:
    """Draw a closed outline (N, 2) around the origin that touches the unit circle."""
    if kind == "bar":
        half = rng.uniform(0.03, 0.18)
        points = np.array([[-1.0, -half], [1.0, -half], [1.0, half], [-1.0, half]])
    elif kind == "superellipse":
        exponent = 2.0 / log_uniform(rng, (0.7, 6.0))
        points = _unit(np.linspace(0.0, 2 * np.pi, 48, endpoint=False))
        points = np.copysign(np.abs(points) ** exponent, points)
        points[:, 1] *= rng.uniform(0.3, 1.0)
    elif kind == "polygon":
        corners = int(rng.integers(3, 10))
        angle = (
            2
            * np.pi
            * (np.arange(corners) + rng.uniform(-0.35, 0.35, corners))
            / corners
        )
        points = rng.uniform(0.45, 1.0, corners)[:, None] * _unit(angle)
    else:
        angle = np.linspace(0.0, 2 * np.pi, 64, endpoint=False)
        radius = np.ones_like(angle)
        for k in range(2, 8):
            amplitude = rng.uniform(0.0, 0.7) / k
            radius += amplitude * np.cos(k * angle + rng.uniform(0.0, 2 * np.pi))
        points = np.maximum(radius, 0.15)[:, None] * _unit(angle)
    points /= np.sqrt((points**2).sum(axis=1).max())
    c, s = _unit(rng.uniform(0.0, 2 * np.pi))
    return points @ np.array([[c, s], [-s, c]])


def _unit(angle: ArrayLike) -> np.ndarray:
    return np.stack([np.cos(angle), np.sin(angle)], axis=-1)


def random_silhouette(
    rng: np.random.Generator,
) -> tuple[list[np.ndarray], list[np.ndarray]]:
    """Draw one to four outlines, and smaller ones to cut from their union."""
    first = KINDS[int(rng.choice(4, p=[0.35, 0.3, 0.3, 0.05]))]
    parts = [outline(rng, first)]
    holes = []
    for _ in range(int(rng.integers(0, 4))):
        kind = KINDS[int(rng.integers(4))]
        size = rng.uniform(0.7, 1.3) if kind == "bar" else rng.uniform(0.3, 0.8)
        parts.append(size * outline(rng, kind) + rng.uniform(-0.6, 0.6, 2))
    if rng.random() < 0.4:
        for _ in range(int(rng.integers(1, 3))):
            kind = KINDS[int(rng.integers(3))]
            holes.append(
                rng.uniform(0.12, 0.4) * outline(rng, kind)
                + rng.uniform(-0.6, 0.6, 2)
            )
    return parts, holes


def cut_out(rng: np.random.Generator, size: int) -> np.ndarray:
    """Draw the mask (h, w) of a silhouette that spans ``size`` px, cropped to its bounding box."""
    while True:
        parts, holes = random_silhouette(rng)
        added = np.concatenate(parts)
        low = added.min(axis=0)
        high = added.max(axis=0)
        radius = size / float((high - low).max())
        centre = (size - 1 - radius * (low + high)) / 2
        mask = np.zeros((size, size), np.uint8)
        for points, value in [(x, 1) for x in parts] + [(x, 0) for x in holes]:
            # OpenCV takes positions in sixteenths of a pixel (a shift of 4 bits)
            sixteenths = np.round((points * radius + centre) * 16).astype(np.int32)
            cv2.fillPoly(mask, [sixteenths], value, cv2.LINE_8, shift=4)
        left, top, width, height = cv2.boundingRect(mask)
        # a hole can swallow a small shape, but every object must have some pixels
        if width * height and cv2.countNonZero(mask) > 0.02 * mask.size:
            return mask[top : top + height, left : left + width].astype(bool)
