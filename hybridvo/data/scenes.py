"""Scene families: a furnished room, a camera path and movers that keep a wanted share of the view.

Every family is drawn from one seed; movers are sized, and draws rejected, until the share of moving
pixels is inside the family's band in every frame. :mod:`hybridvo.data.synthetic` renders the result.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from hybridvo.data.raycasting import BOX, CYLINDER, ELLIPSOID
from hybridvo.data.world import Solid, World, moving_share
from hybridvo.errors import InputError
from hybridvo.geometry import make_transform
from hybridvo.types import Camera

__all__ = ["SCENE_KINDS", "camera_path", "compose_world"]

_BANDS = {
    "static": (0.0, 0.0),
    "light": (0.15, 0.45),
    "pair": (0.02, 0.7),
    "heavy_rigid": (0.48, 0.73),
    "heavy_deforming": (0.48, 0.73),
    "heavy_two": (0.48, 0.73),
    "heavy_ten": (0.48, 0.73),
}
SCENE_KINDS = tuple(_BANDS)
"""Families that :func:`compose_world` knows."""

_LAG = 6
_MIN_DEPTH = 1.2
_ATTEMPTS = 200


def camera_path(
    rng: np.random.Generator, frames: int, *, step: float = 0.09, turn_deg: float = 0.7
) -> tuple[np.ndarray, np.ndarray]:
    """Smooth, bounded camera path that never rests, with a faster hand shake on top.

    Position runs on an ellipse and orientation on another (yaw against pitch), so that neither
    speed passes through zero, however many frames are asked for.

    Args:
        step: metres per frame, about. turn_deg: degrees per frame, about.

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


def _affine(half_size: np.ndarray, centre: np.ndarray, R: np.ndarray | None = None) -> np.ndarray:
    """(3, 4) map of a unit shape to half axes ``half_size`` along the columns of R."""
    axes = (np.eye(3) if R is None else R) * np.asarray(half_size, dtype=float)
    return np.concatenate([axes, np.asarray(centre, dtype=float)[:, None]], axis=1)


def _look(rng: np.random.Generator) -> dict:
    """Texture of one solid."""
    base = rng.uniform(0.35, 1.0, 3)
    other = np.clip(base + rng.normal(0, 0.3, 3), 0.25, 1.0)
    return {
        "wavelength": float(rng.uniform(1.0, 2.2)),
        "colours": (tuple(base.tolist()), tuple(other.tolist())),
    }


def _direction(angle: float, slope: float, depth: float) -> np.ndarray:
    """Point at a depth along a viewing direction (tangents of the horizontal and vertical angle)."""
    return np.array([angle * depth, slope * depth, depth])


def _furnish(rng: np.random.Generator, spread: float, rise: float) -> list[Solid]:
    """Room with boxes, spheres and poles at all depths; some stand close to the camera.

    Args:
        spread, rise: tangents of half the horizontal and vertical field of view.
    """
    floor, ceiling = rng.uniform(1.5, 2.6), -rng.uniform(3.5, 7.0)
    left, right = -rng.uniform(7, 12), rng.uniform(7, 12)
    back, far = -6.0, rng.uniform(20, 27)
    low, high = np.array([left, ceiling, back]), np.array([right, floor, far])
    look = _look(rng) | {"wavelength": 2.4}
    solids = [Solid(BOX, _affine((high - low) / 2, (high + low) / 2), **look)]

    def upright(depth: float, angle: float, thin: bool) -> None:
        x = angle * depth
        if not left + 1 < x < right - 1:
            return
        R = Rotation.from_euler("YX", [rng.uniform(0, 90), rng.normal(0, 3)], degrees=True)
        if thin:
            radius = rng.uniform(0.03, 0.05) * max(1.0, depth / 4)
            half, y = np.array([radius, (floor - ceiling) / 2, radius]), (floor + ceiling) / 2
            shape = CYLINDER
        else:
            half = rng.uniform(0.2, 0.55, 3) * (0.5 + depth / 9)
            half[1] *= rng.uniform(0.8, 2.0)
            y, shape = floor - half[1], int(rng.choice([BOX, BOX, CYLINDER]))
        solids.append(Solid(shape, _affine(half, (x, y, depth), R.as_matrix()), **_look(rng)))

    for depth in rng.uniform(4, far - 1.5, 8):
        upright(depth, rng.uniform(-1.3, 1.3) * spread, thin=False)
    for depth in rng.uniform(3.6, far - 2, 4):
        upright(depth, rng.uniform(-1.2, 1.2) * spread, thin=True)
    for depth in rng.uniform(4, far - 3, 6):
        centre = _direction(rng.uniform(-1.2, 1.2) * spread, rng.uniform(-1.2, 0.8) * rise, depth)
        half = rng.uniform(0.2, 0.6) * (0.5 + depth / 9) * rng.uniform(0.7, 1.3, 3)
        R = Rotation.random(random_state=rng).as_matrix()
        shape = int(rng.choice([ELLIPSOID, ELLIPSOID, BOX]))
        solids.append(Solid(shape, _affine(half, centre, R), **_look(rng)))
    for side in rng.permutation([-1.0, 1.0, 0.0]):
        depth = rng.uniform(2.8, 3.6)
        angle = side * rng.uniform(0.75, 1.1) * spread + rng.normal(0, 0.05)
        centre = _direction(angle, rng.choice([-1, 1]) * rise * rng.uniform(0.8, 1.3), depth)
        if side == 0.0:
            upright(depth, rng.uniform(-0.8, 0.8) * spread, thin=True)
        else:
            half = rng.uniform(0.12, 0.3, 3)
            R = Rotation.random(random_state=rng).as_matrix()
            solids.append(Solid(ELLIPSOID if side < 0 else BOX, _affine(half, centre, R),
                                **_look(rng)))  # fmt: skip
    return solids


@dataclass(frozen=True, eq=False)
class _Mover:
    """One moving object, before its size is fixed.

    Args:
        parts: unit shapes with their (3, 4) or (N, 3, 4) maps in the object frame.
        T_world_object: (N, 4, 4).
    """

    parts: list[tuple[int, np.ndarray]]
    T_world_object: np.ndarray
    looks: list[dict]

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


def _mover_path(
    rng: np.random.Generator, guide: np.ndarray, centre: np.ndarray, speed: float, spin_deg: float
) -> np.ndarray:
    """(N, 4, 4) object poses: a guide path, a place in its frame, and the object's own motion."""
    frames = len(guide)
    place = _poses(_sway(rng, frames, spin_deg), centre + _sway(rng, frames, speed))
    return guide @ place


def _cluster(
    rng: np.random.Generator, half: np.ndarray, count: int
) -> list[tuple[int, np.ndarray]]:
    """A rigid body of one large part and smaller ones that stick out of it."""
    shape = int(rng.choice([BOX, ELLIPSOID]))
    parts = [(shape, _affine(half * (1.15 if shape == ELLIPSOID else 1.0), np.zeros(3)))]
    for _ in range(count - 1):
        at = rng.uniform(-1, 1, 3) * half
        R = Rotation.random(random_state=rng).as_matrix()
        part = rng.uniform(0.25, 0.55, 3) * half.mean()
        parts.append((int(rng.choice([BOX, ELLIPSOID, CYLINDER])), _affine(part, at, R)))
    return parts


def _cloud(
    rng: np.random.Generator, frames: int, half: np.ndarray, rate: float
) -> list[tuple[int, np.ndarray]]:
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
        amplitude = min(rate * period / (2 * np.pi), 0.25 / np.linalg.norm(k))
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


def _draw_movers(
    rng: np.random.Generator, kind: str, guide: np.ndarray, frames: int, view: np.ndarray
) -> list[_Mover]:
    """Movers of one family.

    Args:
        guide: (N + 2 LAG, 4, 4) camera path without shake, padded on both sides.
        view: tangents of half the horizontal and vertical field of view.
    """
    spread, rise = view

    def follow(lag: int) -> np.ndarray:
        return guide[_LAG + lag : _LAG + lag + frames]

    def make(parts, centre, speed, spin_deg, guide_path) -> _Mover:
        path = _mover_path(rng, guide_path, centre, speed, spin_deg)
        return _Mover(parts, path, [_look(rng) for _ in parts])

    def blob(angle, slope, depth, share, count, speed, spin_deg, guide_path) -> _Mover:
        """Body whose outline covers about ``share`` of the view."""
        area = share * spread * rise * depth**2
        aspect = rng.uniform(0.7, 1.8)
        half = np.array([np.sqrt(area * aspect), np.sqrt(area / aspect), 0.0])
        half[2] = rng.uniform(0.5, 0.9) * half[:2].min()
        centre = _direction(angle * spread, slope * rise, depth)
        return make(_cluster(rng, half, count), centre, speed, spin_deg, guide_path)

    def lag() -> int:
        return int(rng.integers(-_LAG, _LAG + 1))

    if kind in ("heavy_rigid", "heavy_deforming"):
        depth = rng.uniform(4.5, 9.0)
        side = rng.choice([-1.0, 1.0]) * rng.uniform(0.15, 0.4)
        half = np.array([0.55 * spread, 1.1 * rise, 0.2 * spread]) * depth
        centre = _direction(side * spread, rng.uniform(-0.2, 0.2) * rise, depth)
        speed, spin_deg = rng.uniform(0.03, 0.09), rng.uniform(0.4, 1.6)
        if kind == "heavy_rigid":
            parts = _cluster(rng, half, int(rng.integers(4, 8)))
        else:
            parts = _cloud(rng, frames, half * (1.2, 1.0, 0.6), rng.uniform(0.03, 0.06))
            spin_deg *= 0.5
        return [make(parts, centre, speed, spin_deg, follow(lag()))]
    if kind == "heavy_two":
        depths = rng.permutation([rng.uniform(3.8, 5.5), rng.uniform(6.0, 9.0)])
        return [
            blob(side * rng.uniform(0.4, 0.65), rng.uniform(-0.3, 0.3), depth, 0.33,
                 int(rng.integers(3, 6)), rng.uniform(0.03, 0.09), rng.uniform(0.4, 1.8),
                 follow(lag()))
            for side, depth in zip((-1.0, 1.0), depths, strict=True)
        ]  # fmt: skip
    if kind == "heavy_ten":
        return [
            blob(0.4 * column + rng.normal(0, 0.06), row + rng.normal(0, 0.08),
                 rng.uniform(3.8, 9.0), 0.07, int(rng.integers(1, 4)), rng.uniform(0.02, 0.09),
                 rng.uniform(0.3, 2.5), follow(lag() // 2))
            for column in range(-2, 3) for row in (-0.5, 0.5)
        ]  # fmt: skip
    anchor = np.broadcast_to(guide[_LAG + frames // 2], (frames, 4, 4))
    if kind == "light":
        first = rng.choice([-1.0, 1.0]) * rng.uniform(0.35, 0.6)
        return [
            blob(first, rng.uniform(-0.2, 0.3), rng.uniform(4.5, 7), 0.19, 4,
                 rng.uniform(0.04, 0.09), rng.uniform(0.5, 1.5), follow(lag())),
            blob(-0.7 * np.sign(first), rng.uniform(-0.4, 0.4), rng.uniform(4, 6), 0.06, 3,
                 rng.uniform(0.04, 0.08), rng.uniform(1.0, 2.5), follow(lag())),
            blob(-0.15 * np.sign(first), rng.uniform(-0.5, 0.5), rng.uniform(6, 10), 0.04, 2,
                 rng.uniform(0.05, 0.1), rng.uniform(0.5, 2.0), anchor),
            blob(rng.uniform(-0.8, 0.8), rng.uniform(-0.5, 0.5), rng.uniform(6, 12), 0.03, 1,
                 0.006, 0.1, anchor),
        ]  # fmt: skip
    return [
        blob(rng.uniform(-0.8, 0.8), rng.uniform(-0.8, 0.8), rng.uniform(3.5, 12),
             rng.uniform(0.03, 0.3), int(rng.integers(1, 4)), rng.uniform(0.005, 0.1),
             rng.uniform(0.1, 2.5), follow(lag()))
        for _ in range(int(rng.integers(1, 5)))
    ]  # fmt: skip


def compose_world(
    kind: str,
    seed: int,
    *,
    height: int = 218,
    width: int = 512,
    frames: int = 20,
    moving: float | None = None,
    zoom: float = 0.0,
) -> World:
    """World of one family.

    Args:
        kind: one of ``SCENE_KINDS``. ``heavy_*`` families have 46 to 75 % of the pixels on movers
            in every frame.
        seed: not negative; the same seed gives the same world.
        height, width: pixels. frames: at least 2.
        moving: median share of the pixels on movers; None for the family's own (light 0.3,
            heavy 0.6, pair random).
        zoom: amplitude of a slow change of focal length, relative.

    Raises:
        InputError: an unknown kind, a value out of range, or a share that the family cannot keep.
    """
    if kind not in _BANDS:
        raise InputError(f"scene kind: expected one of {', '.join(_BANDS)}, got {kind!r}.")
    for name, value, least in (("seed", seed, 0), ("frames", frames, 2), ("height", height, 8),
                               ("width", width, 8)):  # fmt: skip
        if isinstance(value, bool) or int(value) != value or value < least:
            raise InputError(f"{name}: expected an integer of at least {least}, got {value!r}.")
    if not 0.0 <= zoom <= 0.3:
        raise InputError(f"zoom: expected 0 to 0.3, got {zoom}.")
    low, high = _BANDS[kind]
    if moving is not None and (kind == "static" or not low < moving < high):
        raise InputError(
            f"moving: a {kind!r} scene can have {low} to {high} of its pixels moving, got {moving}."
        )
    for attempt in range(_ATTEMPTS):
        rng = np.random.default_rng([SCENE_KINDS.index(kind), seed, attempt])
        world = _draw(rng, kind, height, width, frames, moving, zoom)
        if world is not None:
            return world
    raise InputError(
        f"scene {kind!r}, seed {seed}: no draw of {_ATTEMPTS} kept {moving} of the pixels moving "
        f"over {frames} frames; ask for another share or seed."
    )


def _draw(
    rng: np.random.Generator,
    kind: str,
    height: int,
    width: int,
    frames: int,
    moving: float | None,
    zoom: float,
) -> World | None:
    """One draw, or None where a frame leaves the family's band or a surface comes too close."""
    low, high = _BANDS[kind]
    focal = rng.uniform(1.0, 1.2) * width
    period, phase = rng.uniform(40, 80), rng.uniform(0, 2 * np.pi)
    cameras = tuple(
        Camera(f, f, (width - 1) / 2, (height - 1) / 2, height, width)
        for f in focal * (1 + zoom * np.sin(2 * np.pi * np.arange(frames) / period + phase))
    )
    view = np.array([width / 2, height / 2]) / focal
    step, turn_deg = rng.uniform(0.05, 0.12), rng.uniform(0.4, 1.0)
    path, guide = camera_path(rng, frames + 2 * _LAG, step=step, turn_deg=turn_deg)
    path = path[_LAG : _LAG + frames]
    furniture = tuple(_furnish(rng, *view))
    seed = int(rng.integers(2**31))
    movers = [] if kind == "static" else _draw_movers(rng, kind, guide, frames, view)
    target = moving
    if target is None:
        target = {"light": 0.30, "pair": rng.uniform(0.05, 0.5)}.get(kind, 0.60)
    if moving is not None:
        low, high = max(low, moving - 0.15), min(high, moving + 0.15)

    def build(size: float) -> World:
        solids = list(furniture)
        for number, mover in enumerate(movers, start=1):
            solids += mover.solids(number, size)
        return World(cameras, path, tuple(solids), seed)

    world = build(1.0)
    if movers:
        samples = np.unique(np.linspace(0, frames - 1, min(frames, 9)).round().astype(int))
        small, large = 0.4, 2.0
        for _ in range(9):
            size = np.sqrt(small * large)
            world = build(size)
            share = np.median([moving_share(world, int(i), 64)[0] for i in samples])
            small, large = (size, large) if share < target else (small, size)
        if abs(share - target) > 0.04:
            return None
    for index in range(frames):
        share, nearest = moving_share(world, index)
        if nearest < _MIN_DEPTH or not low <= share <= high:
            return None
    return world
