"""Building blocks of the scene families: smooth paths, textures, and bodies made of solids."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from hybridvo.geometry import make_transform
from hybridvo.synthetic.raycast import BOX, CYLINDER, ELLIPSOID
from hybridvo.synthetic.world import Solid

Parts = list[tuple[int, np.ndarray]]
"""Unit shapes with their (3, 4) or (N, 3, 4) maps into the object frame, metres."""


def camera_path(
    rng: np.random.Generator, frames: int, *, step: float = 0.09, turn_deg: float = 0.7
) -> tuple[np.ndarray, np.ndarray]:
    """Smooth, bounded camera path that never rests, with a faster hand shake on top.

    Position runs on an ellipse and orientation on another (yaw against pitch), so that neither
    speed passes through zero, however many frames are asked for.

    Args:
        rng: source of all choices.
        frames: N.
        step: metres per frame, about.
        turn_deg: degrees per frame, about.

    Returns:
        (N, 4, 4) T_world_cam, and the same path without the shake.
    """
    t = np.arange(frames)

    def wave(rate: float, low: float, high: float) -> tuple[np.ndarray, np.ndarray]:
        """Two sinusoids in quadrature that change by ``rate`` per frame at their fastest."""
        period = rng.uniform(low, high)
        phase = 2 * np.pi * (t / period + rng.uniform())
        sign = rng.choice([-1.0, 1.0])
        return rate * period / (2 * np.pi) * np.cos(phase), (
            sign * rate * period / (2 * np.pi) * np.sin(phase)
        )

    x, z = wave(step * rng.uniform(0.8, 1.2), 50, 80)
    y = wave(0.35 * step, 30, 60)[0]
    yaw, pitch = wave(turn_deg, 45, 75)
    yaw, pitch = yaw, 0.5 * pitch
    roll = wave(0.25 * turn_deg, 30, 60)[0]
    position = np.stack([x, y, rng.uniform(0.6, 1.0) * z], axis=1)
    angles = np.stack([pitch, yaw, roll], axis=1)
    shake = np.stack([wave(0.1 * step, 7, 13)[0] for _ in range(3)], axis=1)
    shake_deg = np.stack([wave(0.15 * turn_deg, 7, 13)[0] for _ in range(3)], axis=1)
    return _poses(angles + shake_deg, position + shake), _poses(angles, position)


def _poses(angles_deg: np.ndarray, position: np.ndarray) -> np.ndarray:
    """(N, 4, 4) from (N, 3) Euler angles about x, y, z and (N, 3) positions."""
    R = Rotation.from_euler("XYZ", angles_deg, degrees=True).as_matrix()
    return np.stack([make_transform(r, p) for r, p in zip(R, position, strict=True)])


def affine(half_size: np.ndarray, centre: np.ndarray, R: np.ndarray | None = None) -> np.ndarray:
    """(3, 4) map of a unit shape to half axes ``half_size`` along the columns of R."""
    axes = (np.eye(3) if R is None else R) * np.asarray(half_size, dtype=float)
    return np.concatenate([axes, np.asarray(centre, dtype=float)[:, None]], axis=1)


def draw_look(rng: np.random.Generator) -> dict[str, Any]:
    """Texture of one solid."""
    base = rng.uniform(0.35, 1.0, 3)
    other = np.clip(base + rng.normal(0, 0.3, 3), 0.25, 1.0)
    return {
        "wavelength": float(rng.uniform(1.0, 2.2)),
        "colours": (tuple(base.tolist()), tuple(other.tolist())),
    }


@dataclass(frozen=True, eq=False)
class Mover:
    """One moving object, before its size is fixed.

    Args:
        parts: unit shapes with their (3, 4) or (N, 3, 4) maps in the object frame.
        T_world_object: (N, 4, 4).
    """

    parts: Parts
    T_world_object: np.ndarray
    looks: list[dict[str, Any]]

    def solids(self, object_id: int, size: float) -> list[Solid]:
        """Solids of the mover, scaled about its own origin."""
        T = self.T_world_object
        out = []
        for (shape, local), look in zip(self.parts, self.looks, strict=True):
            A = T[:, :3, :3] @ (size * local)
            A[:, :, 3] += T[:, :3, 3]
            out.append(Solid(shape, A, object_id, **look))
        return out


def _sway(rng: np.random.Generator, frames: int, rate: float) -> np.ndarray:
    """(N, 3) smooth oscillation that changes by about ``rate`` per frame and never rests."""
    t = np.arange(frames)
    direction = rng.normal(size=(2, 3))
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    period = rng.uniform(22, 40)
    phase = 2 * np.pi * (t / period + rng.uniform())
    amplitude = rate * period / (2 * np.pi)
    return amplitude * (
        np.outer(np.cos(phase), direction[0]) + np.outer(np.sin(phase), direction[1])
    )


def mover_path(
    rng: np.random.Generator, guide: np.ndarray, centre: np.ndarray, speed: float, spin_deg: float
) -> np.ndarray:
    """(N, 4, 4) object poses: a guide path, a place in its frame, and the object's own motion."""
    frames = len(guide)
    place = _poses(_sway(rng, frames, spin_deg), centre + _sway(rng, frames, speed))
    return guide @ place


def cluster(rng: np.random.Generator, half: np.ndarray, count: int) -> Parts:
    """A rigid body of one large part and smaller ones that stick out of it."""
    shape = int(rng.choice([BOX, ELLIPSOID]))
    parts = [(shape, affine(half * (1.15 if shape == ELLIPSOID else 1.0), np.zeros(3)))]
    for _ in range(count - 1):
        # mostly on the side that faces the camera: relief, so that no mover is one plane
        at = rng.uniform((-0.95, -0.95, -1.3), (0.95, 0.95, -0.4)) * half
        R = Rotation.random(random_state=rng).as_matrix()
        part = rng.uniform(0.25, 0.55, 3) * half.mean()
        parts.append((int(rng.choice([BOX, ELLIPSOID, CYLINDER])), affine(part, at, R)))
    return parts


def cloud(rng: np.random.Generator, frames: int, half: np.ndarray, rate: float) -> Parts:
    """A deforming sheet of ellipsoids, carried and sheared by two travelling waves.

    Each part moves with the displacement field at its centre and deforms with the field's
    gradient, so that the body bends and breathes as one while every point's motion stays exact.
    """
    columns, rows = 11, 7
    x = np.linspace(-1, 1, columns) * half[0]
    y = np.linspace(-1, 1, rows) * half[1]
    spacing = np.array([x[1] - x[0], y[1] - y[0]])
    centres = np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)
    centres = centres + rng.uniform(-0.15, 0.15, centres.shape) * spacing
    bulge = half[2] * (centres[:, 0] ** 2 / half[0] ** 2 - 0.5)
    centres = np.column_stack([centres, bulge + rng.normal(0, 0.1 * spacing.mean(), len(centres))])
    t = np.arange(frames)
    waves = []
    for _ in range(2):
        period, length = rng.uniform(18, 34), rng.uniform(1.6, 2.4) * half[0]
        heading = rng.uniform(0, 2 * np.pi)
        k = 2 * np.pi / length * np.array([np.cos(heading), np.sin(heading), 0.0])
        sway = rng.normal(size=3) * (0.6, 0.6, 1.0)
        amplitude = min(float(rate * period / (2 * np.pi)), float(0.25 / np.linalg.norm(k)))
        waves.append((amplitude * sway / np.linalg.norm(sway), k, 2 * np.pi * t / period))
    parts = []
    for centre in centres:
        moved, gradient = np.tile(centre, (frames, 1)), np.tile(np.eye(3), (frames, 1, 1))
        for sway, k, phase in waves:
            angle = centre @ k - phase
            moved = moved + np.outer(np.sin(angle), sway)
            gradient = gradient + np.cos(angle)[:, None, None] * np.outer(sway, k)
        radius = rng.uniform(0.62, 0.78, 3) * (spacing[0], spacing[1], spacing.mean())
        parts.append((ELLIPSOID, np.concatenate([gradient * radius, moved[..., None]], axis=2)))
    return parts
