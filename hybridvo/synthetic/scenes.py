"""Scene families: a furnished room, a camera path and movers that keep a wanted share of the view.

Every family is drawn from one seed; movers are sized, and draws rejected, until the share of
moving pixels is inside the family's band in every frame. :mod:`hybridvo.synthetic.render` renders
the result.
"""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from hybridvo.errors import InputError
from hybridvo.synthetic.bodies import (
    Mover,
    Parts,
    affine,
    camera_path,
    cloud,
    cluster,
    draw_look,
    mover_path,
)
from hybridvo.synthetic.raycast import BOX, CYLINDER, ELLIPSOID
from hybridvo.synthetic.world import Solid, World, dynamic_share, moving_share
from hybridvo.types import Camera

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
MOST_FRAMES = 100_000
"""Of a scene: an hour at 30 frames a second. Its cameras are drawn at once, in memory."""
_ATTEMPTS = 200


def _direction(angle: float, slope: float, depth: float) -> np.ndarray:
    """Point at a depth along the direction with these horizontal and vertical tangents."""
    return np.array([angle * depth, slope * depth, depth])


def _furnish(rng: np.random.Generator, spread: float, rise: float) -> list[Solid]:
    """Room with boxes, spheres and poles at all depths; some stand close to the camera.

    Args:
        rng: source of all choices.
        spread: tangent of half the horizontal field of view.
        rise: tangent of half the vertical field of view.
    """
    floor, ceiling = rng.uniform(1.5, 2.6), -rng.uniform(3.5, 7.0)
    left, right = -rng.uniform(7, 12), rng.uniform(7, 12)
    back, far = -6.0, rng.uniform(20, 27)
    low, high = np.array([left, ceiling, back]), np.array([right, floor, far])
    look = draw_look(rng) | {"wavelength": 2.4}
    solids = [Solid(BOX, affine((high - low) / 2, (high + low) / 2), **look)]

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
        solids.append(
            Solid(shape, affine(half, np.array([x, y, depth]), R.as_matrix()), **draw_look(rng))
        )

    for depth in rng.uniform(4, far - 1.5, 8):
        upright(depth, rng.uniform(-1.3, 1.3) * spread, thin=False)
    for depth in rng.uniform(3.6, far - 2, 4):
        upright(depth, rng.uniform(-1.2, 1.2) * spread, thin=True)
    for depth in rng.uniform(4, far - 3, 6):
        centre = _direction(rng.uniform(-1.2, 1.2) * spread, rng.uniform(-1.2, 0.8) * rise, depth)
        half = rng.uniform(0.2, 0.6) * (0.5 + depth / 9) * rng.uniform(0.7, 1.3, 3)
        R = Rotation.random(random_state=rng).as_matrix()
        shape = int(rng.choice([ELLIPSOID, ELLIPSOID, BOX]))
        solids.append(Solid(shape, affine(half, centre, R), **draw_look(rng)))
    for side in rng.permutation([-1.0, 1.0, 0.0]):
        depth = rng.uniform(2.8, 3.6)
        angle = side * rng.uniform(0.75, 1.1) * spread + rng.normal(0, 0.05)
        centre = _direction(angle, rng.choice([-1, 1]) * rise * rng.uniform(0.8, 1.3), depth)
        if side == 0.0:
            upright(depth, rng.uniform(-0.8, 0.8) * spread, thin=True)
        else:
            half = rng.uniform(0.12, 0.3, 3)
            R = Rotation.random(random_state=rng).as_matrix()
            solids.append(Solid(ELLIPSOID if side < 0 else BOX, affine(half, centre, R),
                                **draw_look(rng)))  # fmt: skip
    return solids


def _draw_movers(
    rng: np.random.Generator, kind: str, guide: np.ndarray, frames: int, view: np.ndarray
) -> list[Mover]:
    """Movers of one family.

    Args:
        rng: source of all choices.
        kind: of the family.
        frames: N.
        guide: (N + 2 LAG, 4, 4) camera path without shake, padded on both sides.
        view: tangents of half the horizontal and vertical field of view.
    """
    spread, rise = view

    def follow(lag: int) -> np.ndarray:
        return guide[_LAG + lag : _LAG + lag + frames]

    def make(
        parts: Parts, centre: np.ndarray, speed: float, spin_deg: float, guide_path: np.ndarray
    ) -> Mover:
        path = mover_path(rng, guide_path, centre, speed, spin_deg)
        return Mover(parts, path, [draw_look(rng) for _ in parts])

    def blob(
        angle: float,
        slope: float,
        depth: float,
        share: float,
        count: int,
        speed: float,
        spin_deg: float,
        guide_path: np.ndarray,
    ) -> Mover:
        """Body whose outline covers about ``share`` of the view."""
        area = share * spread * rise * depth**2
        aspect = rng.uniform(0.7, 1.8)
        half = np.array([np.sqrt(area * aspect), np.sqrt(area / aspect), 0.0])
        half[2] = rng.uniform(0.5, 0.9) * half[:2].min()
        centre = _direction(angle * spread, slope * rise, depth)
        return make(cluster(rng, half, count), centre, speed, spin_deg, guide_path)

    def lag() -> int:
        return int(rng.integers(-_LAG, _LAG + 1))

    if kind in ("heavy_rigid", "heavy_deforming"):
        depth = rng.uniform(4.5, 9.0)
        side = rng.choice([-1.0, 1.0]) * rng.uniform(0.15, 0.4)
        half = np.array([0.55 * spread, 1.1 * rise, 0.2 * spread]) * depth
        centre = _direction(side * spread, rng.uniform(-0.2, 0.2) * rise, depth)
        speed, spin_deg = rng.uniform(0.03, 0.09), rng.uniform(0.4, 1.6)
        if kind == "heavy_rigid":
            parts = cluster(rng, half, int(rng.integers(6, 11)))
        else:
            parts = cloud(rng, frames, half * (1.2, 1.0, 0.6), rng.uniform(0.03, 0.06))
            spin_deg *= 0.5
        return [make(parts, centre, speed, spin_deg, follow(lag()))]
    if kind == "heavy_two":
        depths = rng.permutation([rng.uniform(3.8, 5.5), rng.uniform(6.0, 9.0)])
        return [
            blob(side * rng.uniform(0.4, 0.65), rng.uniform(-0.3, 0.3), depth, 0.33,
                 int(rng.integers(3, 6)), rng.uniform(0.06, 0.1), rng.uniform(0.4, 1.8),
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
            in every frame, and at least 46 % whose flow differs from the camera's by over 1/512 of
            the width.
        seed: not negative; the same seed gives the same world.
        height: pixels.
        width: pixels.
        frames: at least 2, at most :data:`MOST_FRAMES`.
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
    if frames > MOST_FRAMES:
        raise InputError(f"frames: expected at most {MOST_FRAMES}, got {frames}.")
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
    step, turn_deg = rng.uniform(0.06, 0.13), rng.uniform(0.5, 1.4)
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
    if kind.startswith("heavy"):
        for index in range(frames - 1):
            # one pixel of a picture 512 wide: small pictures are judged alike
            if dynamic_share(world, index, 64, width / 512) < 0.47:
                return None
    return world
