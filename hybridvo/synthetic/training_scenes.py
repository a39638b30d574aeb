"""Rendered two-frame worlds for the selector's training; many kinds, not the benchmark's.

Streets, halls, hills, walls and tables with static things at all depths, some of them close enough
to fill the picture; vehicles, walkers, chains, hinged panels, swarms, breathing and twisting
bodies, alone or together, free or followed by the camera. The scenes of
:mod:`hybridvo.synthetic.scenes` are kept aside for measuring: no builder of theirs is used here.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial.transform import Rotation

from hybridvo.geometry import make_transform
from hybridvo.synthetic.raycast import BOX, CYLINDER, ELLIPSOID
from hybridvo.synthetic.render import Scene
from hybridvo.synthetic.world import Solid, World, moving_share
from hybridvo.types import Camera

SHAPES = (BOX, ELLIPSOID, CYLINDER)


@dataclass(frozen=True, eq=False)
class _Part:
    """A unit shape: (3, 4) maps into the frame of its body at both times."""

    shape: int
    before: np.ndarray
    after: np.ndarray


def _log_uniform(rng: np.random.Generator, low: float, high: float) -> float:
    return float(np.exp(rng.uniform(np.log(low), np.log(high))))


def _map(half: ArrayLike, centre: ArrayLike, R: np.ndarray | None = None) -> np.ndarray:
    axes = (np.eye(3) if R is None else R) * np.broadcast_to(np.asarray(half, float), 3)
    return np.column_stack([axes, np.asarray(centre, float)])


def _turn(rng: np.random.Generator, angle_deg: float) -> np.ndarray:
    axis = rng.standard_normal(3)
    return Rotation.from_rotvec(np.radians(angle_deg) * axis / np.linalg.norm(axis)).as_matrix()


def _any_turn(rng: np.random.Generator) -> np.ndarray:
    return Rotation.random(random_state=rng).as_matrix()


def _apply(T: np.ndarray, A: np.ndarray) -> np.ndarray:
    """A (3, 4) map after a (4, 4) affine one."""
    out = T[:3, :3] @ A
    out[:, 3] += T[:3, 3]
    return out


def _about(R: np.ndarray, point: np.ndarray) -> np.ndarray:
    """(4, 4) linear map about a point."""
    return make_transform(R, point - R @ point)


class _Painter:
    """Looks of solids: palettes and texture scales of one world."""

    def __init__(self, rng: np.random.Generator, scale: float) -> None:
        self.rng = rng
        self.base = rng.uniform(0.2, 1.0, 3)
        self.variety = rng.uniform(0.1, 0.6)
        self.contrast = rng.uniform(0.15, 0.45)
        self.wavelength = scale * _log_uniform(rng, 0.25, 1.6)

    def solid(self, shape: int, A: np.ndarray, object_id: int = 0, stretch: float = 1.0) -> Solid:
        rng = self.rng
        first = np.clip(self.base + rng.normal(0, self.variety, 3), 0.1, 1.0)
        second = np.clip(first + rng.normal(0, self.contrast, 3), 0.05, 1.0)
        colours = (tuple(first.tolist()), tuple(second.tolist()))
        wavelength = stretch * self.wavelength * _log_uniform(rng, 0.6, 1.7)
        return Solid(shape, A, object_id, wavelength=wavelength, colours=colours)


# --- what stands still -------------------------------------------------------------------------


def _street(rng: np.random.Generator, paint: _Painter, view: np.ndarray, s: float) -> list[Solid]:
    """Ground and rows of houses, open to the sky."""
    floor = rng.uniform(1.2, 2.2) * s
    out = [paint.solid(BOX, _map((80 * s, 0.5 * s, 80 * s), (0, floor + 0.5 * s, 60 * s)))]
    for side in (-1.0, 1.0):
        z = rng.uniform(1, 6) * s
        while z < 45 * s:
            depth = rng.uniform(2, 6) * s
            height = rng.uniform(1.5, 7) * s
            x = side * rng.uniform(5, 10) * s
            A = _map((rng.uniform(1.5, 3.5) * s, height, depth / 2), (x, floor - height, z))
            out.append(paint.solid(BOX, A))
            z += depth + rng.uniform(0, 3) * s
    for _ in range(int(rng.integers(0, 7))):
        radius, z = rng.uniform(0.04, 0.12) * s, rng.uniform(3, 25) * s
        height = rng.uniform(1.5, 3.5) * s
        place = (rng.uniform(-1, 1) * view[0] * z, floor - height, z)
        out.append(paint.solid(CYLINDER, _map((radius, height, radius), place)))
    return out


def _hall(rng: np.random.Generator, paint: _Painter, view: np.ndarray, s: float) -> list[Solid]:
    """A closed room with columns, benches and boards on its walls."""
    low = np.array([-rng.uniform(3, 9), -rng.uniform(2, 5), -4.0]) * s
    high = np.array([rng.uniform(3, 9), rng.uniform(1.0, 2.2), rng.uniform(7, 26)]) * s
    out = [paint.solid(BOX, _map((high - low) / 2, (high + low) / 2), stretch=1.5)]
    pitch = rng.uniform(2.0, 4.5) * s
    radius = rng.uniform(0.1, 0.35) * s
    if rng.random() < 0.6:
        for x in np.arange(low[0] + pitch, high[0] - 0.3 * pitch, pitch):
            for z in np.arange(3.2 * s, high[2] - 0.5 * pitch, 1.3 * pitch):
                size = (radius, (high[1] - low[1]) / 2, radius)
                shape = BOX if radius > 0.22 * s else CYLINDER
                out.append(paint.solid(shape, _map(size, (x, (high[1] + low[1]) / 2, z))))
    for _ in range(int(rng.integers(2, 12))):
        z = rng.uniform(2.5 * s, high[2] - 0.5 * s)
        half = rng.uniform(0.15, 0.7, 3) * s
        x = np.clip(rng.uniform(-1.1, 1.1) * view[0] * z, low[0] + half[0], high[0] - half[0])
        R = Rotation.from_euler("y", rng.uniform(0, 90), degrees=True).as_matrix()
        out.append(paint.solid(BOX, _map(half, (x, high[1] - half[1], z), R)))
    return out[:60]


def _hills(rng: np.random.Generator, paint: _Painter, view: np.ndarray, s: float) -> list[Solid]:
    """Mounds under the sky, with trees."""
    floor = rng.uniform(0.8, 2.5) * s
    out = [paint.solid(BOX, _map((90 * s, 0.5 * s, 90 * s), (0, floor + 0.5 * s, 70 * s)))]
    for _ in range(int(rng.integers(4, 11))):
        z = rng.uniform(6, 50) * s
        half = np.array([rng.uniform(2, 9), rng.uniform(0.5, 5), rng.uniform(2, 6)]) * s
        out.append(
            paint.solid(ELLIPSOID, _map(half, (rng.uniform(-1.3, 1.3) * view[0] * z, floor, z)))
        )
    for _ in range(int(rng.integers(0, 10))):
        z = rng.uniform(3, 25) * s
        x, height = rng.uniform(-1.1, 1.1) * view[0] * z, rng.uniform(0.7, 2) * s
        trunk = _map((0.12 * s, height, 0.12 * s), (x, floor - height, z))
        crown = _map(rng.uniform(0.5, 1.4, 3) * s, (x, floor - 2 * height, z), _any_turn(rng))
        out += [paint.solid(CYLINDER, trunk), paint.solid(ELLIPSOID, crown)]
    return out


def _wall(rng: np.random.Generator, paint: _Painter, view: np.ndarray, s: float) -> list[Solid]:
    """One slanted wall with relief, all there is to see."""
    z = rng.uniform(3, 12) * s
    angles = (rng.normal(0, 15), rng.normal(0, 25), rng.uniform(-180, 180))
    R = Rotation.from_euler("xyz", angles, degrees=True).as_matrix()
    out = [paint.solid(BOX, _map((25 * s, 25 * s, 0.3 * s), (0, 0, z + 0.3 * s), R))]
    for _ in range(int(rng.integers(2, 16))):
        place = R @ np.array([*(rng.uniform(-1.2, 1.2, 2) * view * z), rng.uniform(-0.3, 0.1) * s])
        half = rng.uniform(0.1, 0.8, 3) * s
        out.append(
            paint.solid(int(rng.choice(SHAPES)), _map(half, place + (0, 0, z), _any_turn(rng)))
        )
    return out


def _table(rng: np.random.Generator, paint: _Painter, view: np.ndarray, s: float) -> list[Solid]:
    """Looking down at a table with things on it, a wall behind."""
    tilt = Rotation.from_euler("x", rng.uniform(15, 50), degrees=True).as_matrix()
    z = rng.uniform(2, 5) * s
    top = np.array([0.0, 0.35 * z, z])
    out = [
        paint.solid(BOX, _map((12 * s, 0.1 * s, 3 * s), top + tilt @ (0, 0.1 * s, 0), tilt)),
        paint.solid(BOX, _map((20 * s, 12 * s, 0.3 * s), (0, 0, z + rng.uniform(3, 7) * s))),
    ]
    for _ in range(int(rng.integers(4, 18))):
        half = rng.uniform(0.08, 0.4, 3) * s
        at = np.array([rng.uniform(-1.2, 1.2) * view[0] * z, -half[1], rng.uniform(-1.3, 2.5) * s])
        turn = tilt @ Rotation.from_euler("y", rng.uniform(0, 180), degrees=True).as_matrix()
        out.append(paint.solid(int(rng.choice(SHAPES)), _map(half, top + tilt @ at, turn)))
    return out


SURROUNDINGS: tuple[Callable[..., list[Solid]], ...] = (_street, _hall, _hills, _wall, _table)


def _occluders(
    rng: np.random.Generator, paint: _Painter, view: np.ndarray, s: float
) -> list[Solid]:
    """Static things close to the camera, from a pole to one that fills half of the picture."""
    out = []
    for _ in range(int(rng.choice([0, 1, 2, 4], p=[0.35, 0.35, 0.2, 0.1]))):
        z = rng.uniform(1.3, 4.0) * s
        size = _log_uniform(rng, 0.04, 0.9) * view[0] * z
        half = size * rng.uniform(0.4, 1.3, 3) * (1, 1, 0.4)
        if rng.random() < 0.25:
            half[1] *= 6
        place = (*(rng.uniform(-1.1, 1.1, 2) * view * z), z + half[2])
        A = _map(half, place, _any_turn(rng) if rng.random() < 0.5 else None)
        out.append(paint.solid(int(rng.choice(SHAPES)), A))
    return out


# --- what moves: bodies of about unit radius, at both times ------------------------------------


def _rigid(parts: list[tuple[int, np.ndarray]]) -> list[_Part]:
    return [_Part(shape, A, A) for shape, A in parts]


def _vehicle(rng: np.random.Generator) -> list[_Part]:
    length, height, width = 1.0, rng.uniform(0.2, 0.5), rng.uniform(0.35, 0.6)
    parts = [(BOX, _map((length, height, width), (0, 0, 0)))]
    cabin = (rng.uniform(0.3, 0.7), rng.uniform(0.15, 0.35), 0.9 * width)
    parts.append((BOX, _map(cabin, (rng.uniform(-0.4, 0.4), -height - cabin[1], 0))))
    R = Rotation.from_euler("x", 90, degrees=True).as_matrix()
    wheel = rng.uniform(0.15, 0.3)
    for x in (-0.65, 0.65):
        for z in (-width, width):
            parts.append((CYLINDER, _map((wheel, 0.08, wheel), (x, height, z), R)))
    return _rigid(parts)


def _walker(rng: np.random.Generator) -> list[_Part]:
    """Trunk, head and four limbs of two parts that swing about their joints."""
    trunk = np.array([rng.uniform(0.18, 0.3), rng.uniform(0.35, 0.5), rng.uniform(0.12, 0.25)])
    parts = _rigid(
        [(ELLIPSOID, _map(trunk, (0, 0, 0))), (ELLIPSOID, _map(0.16, (0, -trunk[1] - 0.12, 0)))]
    )
    swing = _log_uniform(rng, 1.0, 18.0)
    for side in (-1.0, 1.0):
        for hip in (-1.0, 1.0):
            joint = np.array([side * (trunk[0] + 0.03), 0.8 * hip * trunk[1], 0.0])
            pose = Rotation.from_euler("xz", rng.normal(0, (35, 20)), degrees=True).as_matrix()
            upper, lower = (
                _about(pose, joint),
                _about(_turn(rng, rng.normal(0, 40)), joint + (0, 0.4, 0)),
            )
            move = _about(_turn(rng, swing * rng.normal()), joint)
            bend = _about(_turn(rng, swing * rng.normal()), joint + (0, 0.4, 0))
            thick = rng.uniform(0.06, 0.12)
            A = _map((thick, 0.24, thick), joint + (0, 0.2, 0))
            B = _map((0.8 * thick, 0.24, 0.8 * thick), joint + (0, 0.6, 0))
            parts.append(_Part(ELLIPSOID, _apply(upper, A), _apply(move @ upper, A)))
            parts.append(
                _Part(
                    ELLIPSOID,
                    _apply(upper @ lower, B),
                    _apply(move @ upper @ bend @ lower, B),
                )
            )
    return parts


def _chain(rng: np.random.Generator) -> list[_Part]:
    """Links one after the other, each turning against the one before."""
    count = int(rng.integers(4, 12))
    thick, length = rng.uniform(0.1, 0.3), 2.0 / count
    shape = int(rng.choice(SHAPES))
    bend = _log_uniform(rng, 0.5, 8.0)
    before, after = np.eye(4), np.eye(4)
    parts = []
    for k in range(count):
        local = make_transform(_turn(rng, rng.normal(0, 25)), np.array([0.85 * 2 * length, 0, 0]))
        if k == 0:
            local = make_transform(np.eye(3), np.array([-1.0, 0, 0]))
        before = before @ local
        after = after @ local @ make_transform(_turn(rng, bend * rng.normal()), np.zeros(3))
        A = _map((1.1 * length, thick, thick), (length, 0, 0))
        parts.append(_Part(shape, _apply(before, A), _apply(after, A)))
    return parts


def _panels(rng: np.random.Generator) -> list[_Part]:
    """Boards that fold about their hinges: doors, screens, pages."""
    count = int(rng.integers(1, 5))
    half = np.array([1.0 / count, rng.uniform(0.5, 1.2), 0.03])
    before, after, parts = np.eye(4), np.eye(4), []
    swing = _log_uniform(rng, 0.5, 10.0)
    edge = np.array([-1.0, 0, 0])
    for _ in range(count):
        fold = rng.normal(0, 35)
        turns = [
            Rotation.from_euler("y", angle, degrees=True).as_matrix()
            for angle in (fold, fold + swing * rng.normal())
        ]
        before = before @ make_transform(turns[0], edge)
        after = after @ make_transform(turns[1], edge)
        A = _map(half, (half[0], 0, 0))
        parts.append(_Part(BOX, _apply(before, A), _apply(after, A)))
        for _ in range(int(rng.integers(0, 3))):
            knob = _map(
                rng.uniform(0.03, 0.15, 3),
                (*(rng.uniform(0, 1.6, 2) * half[:2] - (0, half[1])), -0.08),
            )
            parts.append(_Part(ELLIPSOID, _apply(before, knob), _apply(after, knob)))
        edge = np.array([2 * half[0], 0, 0])
    return parts


def _breathing(rng: np.random.Generator) -> list[_Part]:
    """A ball of solids that swells, shears or twists, more the farther from its middle."""
    count = int(rng.integers(8, 45))
    stretch = _log_uniform(rng, 0.003, 0.06) * rng.normal(size=(3, 3))
    twist, axis = _log_uniform(rng, 0.5, 8.0), int(rng.integers(3))
    squash = rng.uniform(0.35, 1.0, 3)
    parts = []
    for k in range(count):
        direction = rng.standard_normal(3)
        radius = 0.0 if k == 0 else rng.uniform(0.3, 0.85)
        centre = squash * direction / np.linalg.norm(direction) * radius
        half = (0.6 if k == 0 else rng.uniform(0.12, 0.35)) * squash * rng.uniform(0.7, 1.2, 3)
        A = _map(half, centre, _any_turn(rng) if k else None)
        angle = np.zeros(3)
        angle[axis] = np.radians(twist * centre[axis])
        change = Rotation.from_rotvec(angle).as_matrix() @ (np.eye(3) + stretch * (0.5 + centre))
        after = change @ A
        parts.append(_Part(ELLIPSOID, A, after))
    return parts


def _heap(rng: np.random.Generator) -> list[_Part]:
    """A rigid heap of arbitrary solids, with gaps to look through or without."""
    count, size = int(rng.integers(1, 16)), rng.uniform(0.25, 0.7)
    parts = []
    for _ in range(count):
        half = size * rng.uniform(0.3, 1.2, 3)
        centre = rng.uniform(-0.8, 0.8, 3) * (1 if count > 1 else 0)
        parts.append((int(rng.choice(SHAPES)), _map(half, centre, _any_turn(rng))))
    return _rigid(parts)


def _swarm(rng: np.random.Generator) -> list[_Part]:
    """Many small bodies that share a motion only in part."""
    own_m, own_deg = _log_uniform(rng, 0.003, 0.1), _log_uniform(rng, 0.3, 12.0)
    parts = []
    for _ in range(int(rng.integers(6, 40))):
        centre = rng.uniform(-1, 1, 3) * (1, 1, 0.6)
        A = _map(_log_uniform(rng, 0.05, 0.3) * rng.uniform(0.6, 1.3, 3), centre, _any_turn(rng))
        T = _about(_turn(rng, own_deg * rng.normal()), centre)
        T[:3, 3] += own_m * rng.standard_normal(3)
        parts.append(_Part(int(rng.choice(SHAPES)), A, _apply(T, A)))
    return parts


BODIES: tuple[Callable[[np.random.Generator], list[_Part]], ...] = (
    _vehicle, _walker, _chain, _panels, _breathing, _heap, _swarm,
)  # fmt: skip


def _movers(
    rng: np.random.Generator,
    paint: _Painter,
    view: np.ndarray,
    s: float,
    T_world_cam: np.ndarray,
    grow: float,
) -> list[Solid]:
    """Bodies, each with a motion of its own or a common one; ``grow`` scales their sizes."""
    many = rng.random() < 0.25
    count = int(rng.integers(4, 11)) if many else int(rng.integers(1, 4))
    follow, together, alike = rng.random(3) < (0.45, 0.3, 0.5)
    kinds = rng.integers(len(BODIES), size=count)
    common: np.ndarray | None = None
    solids = []
    for number in range(count):
        z = rng.uniform(1.8, 7.0) * s
        least = 0.08 if many or number else 0.3
        radius = grow * _log_uniform(rng, least, 0.7) * np.sqrt(view[0] * view[1]) * z
        centre = np.array([*(rng.uniform(-0.95, 0.95, 2) * view * z), z])
        # flat enough for a large body not to reach the camera
        depth = min(rng.uniform(0.4, 1.0), 0.7 * z / radius)
        place = make_transform(np.diag([radius, radius, depth * radius]) @ _any_turn(rng), centre)
        t = _log_uniform(rng, 0.003, 0.07) * z * rng.standard_normal(3) * (1, 0.7, 0.7)
        turn = _log_uniform(rng, 0.15, 6.0)
        if follow:
            # the camera goes along: what is left of the motion in the picture is small
            left = _log_uniform(rng, 0.03, 1.0)
            own = T_world_cam @ _about(_turn(rng, left * turn), centre)
            own[:3, 3] += T_world_cam[:3, :3] @ (left * t)
        else:
            own = _about(_turn(rng, turn), centre)
            own[:3, 3] += t
        if together and common is not None:
            own = common
        common = own
        for part in BODIES[int(kinds[0 if alike else number])](rng):
            before, after = _apply(place, part.before), _apply(own @ place, part.after)
            gap = min(A[2, 3] - float(np.linalg.norm(A[2, :3])) for A in (before, after))
            if gap > 0.4 * s:
                solids.append(paint.solid(part.shape, np.stack([before, after]), number + 1))
    return solids


def training_scene(seed: int, height: int, width: int) -> Scene:
    """Scene of two frames.

    Args:
        seed: not negative; the same seed gives the same pictures.
        height: pixels.
        width: pixels.
    """
    rng = np.random.default_rng([0x6A75, seed])
    spread = np.tan(np.radians(rng.uniform(34, 100) / 2))
    focal = width / 2 / spread
    centre = rng.normal(0, 0.03, 2) * width
    aspect = _log_uniform(rng, 0.8, 1.25) if rng.random() < 0.3 else 1.0
    camera = Camera(
        focal,
        aspect * focal,
        (width - 1) / 2 + centre[0],
        (height - 1) / 2 + centre[1],
        height,
        width,
    )
    view = np.array([spread, spread * height / width / aspect])
    s = _log_uniform(rng, 0.2, 3.0)
    size = min(_log_uniform(rng, 0.1, 8.0), 6.0)
    rotation = (
        np.zeros(3) if rng.random() < 0.05 else np.radians(size) * rng.standard_normal(3) * 0.6
    )
    t = (
        _log_uniform(rng, 0.005, 0.25)
        * s
        * rng.standard_normal(3)
        * rng.choice([0.0, 1.0], p=[0.05, 0.95])
    )
    if rng.random() < 0.3:
        t = t * (0.3, 0.2, 1.0)
    T_world_cam = np.stack(
        [np.eye(4), make_transform(Rotation.from_rotvec(rotation).as_matrix(), t)]
    )
    paint = _Painter(rng, s)
    still = SURROUNDINGS[int(rng.integers(len(SURROUNDINGS)))](rng, paint, view, s)
    still += _occluders(rng, paint, view, s)
    light = rng.standard_normal(3) * (1, 0.5, 1) - (0, 0.8, 0)
    seeds = rng.integers(2**31, size=2)
    noise = float(rng.choice([0.0, rng.uniform(0, 4)]))
    wanted = float(
        rng.choice([0.0, rng.uniform(0, 0.3), rng.uniform(0.3, 0.87)], p=[0.06, 0.3, 0.64])
    )

    def build(grow: float) -> World:
        movers = []
        if grow:
            own = np.random.default_rng(seeds[0])
            paint.rng = own
            movers = _movers(own, paint, view, s, T_world_cam[1], grow)
        solids = tuple(still + movers)
        return World((camera, camera), T_world_cam, solids, int(seeds[1]), tuple(light.tolist()))

    if wanted == 0:
        return Scene(build(0.0), noise)
    grow = 1.0
    for _ in range(8):
        world = build(grow)
        share = moving_share(world, 0, 64)[0]
        if abs(share - wanted) < 0.07:
            break
        grow = float(np.clip(grow * np.sqrt((wanted + 0.03) / (share + 0.03)), 0.15, 6.0))
    return Scene(world, noise)
