"""Rendered two-frame scenes for the selector's training, none of the families that are measured on.

Streets, halls, hills, walls and tables, in which vehicles, walkers, chains, panels, swarms and
breathing bodies move, alone or together, free or followed by the camera.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable
from dataclasses import replace

import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial.transform import Rotation

from hybridvo.geometry import make_transform
from hybridvo.synthetic.draws import about, affine, any_turn, carried, direction, log_uniform, turn
from hybridvo.synthetic.raycast import BOX, CYLINDER, ELLIPSOID
from hybridvo.synthetic.render import Scene, Solid
from hybridvo.types import Camera

SHAPES = (BOX, ELLIPSOID, CYLINDER)

Parts = list[tuple[int, np.ndarray]]
"""Unit shapes and their maps into the frame of a body: (3, 4), or (2, 3, 4) at both times."""


def _rotation(axes: str, angles_deg: ArrayLike) -> np.ndarray:
    return Rotation.from_euler(axes, angles_deg, degrees=True).as_matrix()


class _Builder:
    """Solids of one scene of size ``s`` (1: a street in metres), its palette and texture scale.

    Places and sizes are given in units of ``s``; ``view``: tangents of half the horizontal and
    vertical field of view.
    """

    def __init__(self, rng: np.random.Generator, view: np.ndarray, s: float) -> None:
        self.rng, self.view, self.s = rng, view, s
        self.base = rng.uniform(0.2, 1.0, 3)
        self.variety = rng.uniform(0.1, 0.6)
        self.contrast = rng.uniform(0.15, 0.45)
        self.wavelength = s * log_uniform(rng, (0.25, 1.6))
        self.solids: list[Solid] = []

    def add(
        self, shape: int, half: ArrayLike, centre: ArrayLike, R: np.ndarray | None = None
    ) -> None:
        """Add a static solid."""
        self.paint(shape, self.s * affine(half, centre, R))

    def paint(self, shape: int, A: np.ndarray, object_id: int = 0, stretch: float = 1.0) -> None:
        """Add a solid under given maps (metres), in colours of its own."""
        rng = self.rng
        first = np.clip(self.base + rng.normal(0, self.variety, 3), 0.1, 1.0)
        second = np.clip(first + rng.normal(0, self.contrast, 3), 0.05, 1.0)
        wavelength = stretch * self.wavelength * log_uniform(rng, (0.6, 1.7))
        self.solids.append(Solid(shape, A, object_id, wavelength, (first, second)))

    def any_shape(self) -> int:
        """One of the three shapes."""
        return int(self.rng.choice(SHAPES))


# --- what stands still ----------------------------------------------------------------------------


def _street(b: _Builder) -> None:
    """Ground and rows of houses, open to the sky."""
    rng = b.rng
    floor = rng.uniform(1.2, 2.2)
    b.add(BOX, (80, 0.5, 80), (0, floor + 0.5, 60))
    for side in (-1.0, 1.0):
        z = rng.uniform(1, 6)
        while z < 45:
            depth, height = rng.uniform(2, 6), rng.uniform(1.5, 7)
            x = side * rng.uniform(5, 10)
            b.add(BOX, (rng.uniform(1.5, 3.5), height, depth / 2), (x, floor - height, z))
            z += depth + rng.uniform(0, 3)
    for _ in range(int(rng.integers(0, 7))):
        radius, z, height = rng.uniform(0.04, 0.12), rng.uniform(3, 25), rng.uniform(1.5, 3.5)
        place = (rng.uniform(-1, 1) * b.view[0] * z, floor - height, z)
        b.add(CYLINDER, (radius, height, radius), place)


def _hall(b: _Builder) -> None:
    """A closed room with columns, benches and boards on its walls."""
    rng = b.rng
    low = np.array([-rng.uniform(3, 9), -rng.uniform(2, 5), -4.0])
    high = np.array([rng.uniform(3, 9), rng.uniform(1.0, 2.2), rng.uniform(7, 26)])
    b.paint(BOX, b.s * affine((high - low) / 2, (high + low) / 2), stretch=1.5)
    pitch, radius = rng.uniform(2.0, 4.5), rng.uniform(0.1, 0.35)
    if rng.random() < 0.6:
        shape = BOX if radius > 0.22 else CYLINDER
        for x in np.arange(low[0] + pitch, high[0] - 0.3 * pitch, pitch):
            for z in np.arange(3.2, high[2] - 0.5 * pitch, 1.3 * pitch):
                column = (radius, (high[1] - low[1]) / 2, radius)
                b.add(shape, column, (x, (high[1] + low[1]) / 2, z))
    for _ in range(int(rng.integers(2, 12))):
        z, half = rng.uniform(2.5, high[2] - 0.5), rng.uniform(0.15, 0.7, 3)
        x = np.clip(rng.uniform(-1.1, 1.1) * b.view[0] * z, low[0] + half[0], high[0] - half[0])
        b.add(BOX, half, (x, high[1] - half[1], z), _rotation("y", rng.uniform(0, 90)))
    del b.solids[60:]


def _hills(b: _Builder) -> None:
    """Mounds under the sky, with trees."""
    rng = b.rng
    floor = rng.uniform(0.8, 2.5)
    b.add(BOX, (90, 0.5, 90), (0, floor + 0.5, 70))
    for _ in range(int(rng.integers(4, 11))):
        z = rng.uniform(6, 50)
        half = rng.uniform((2, 0.5, 2), (9, 5, 6))
        b.add(ELLIPSOID, half, (rng.uniform(-1.3, 1.3) * b.view[0] * z, floor, z))
    for _ in range(int(rng.integers(0, 10))):
        z = rng.uniform(3, 25)
        x, height = rng.uniform(-1.1, 1.1) * b.view[0] * z, rng.uniform(0.7, 2)
        crown = affine(rng.uniform(0.5, 1.4, 3), (x, floor - 2 * height, z), any_turn(rng))
        b.add(CYLINDER, (0.12, height, 0.12), (x, floor - height, z))
        b.paint(ELLIPSOID, b.s * crown)


def _wall(b: _Builder) -> None:
    """One slanted wall with relief, all there is to see."""
    rng = b.rng
    z = rng.uniform(3, 12)
    R = _rotation("xyz", (rng.normal(0, 15), rng.normal(0, 25), rng.uniform(-180, 180)))
    b.add(BOX, (25, 25, 0.3), (0, 0, z + 0.3), R)
    for _ in range(int(rng.integers(2, 16))):
        at = np.array([*(rng.uniform(-1.2, 1.2, 2) * b.view * z), rng.uniform(-0.3, 0.1)])
        half = rng.uniform(0.1, 0.8, 3)
        b.add(b.any_shape(), half, R @ at + (0, 0, z), any_turn(rng))


def _table(b: _Builder) -> None:
    """Looking down at a table with things on it, a wall behind."""
    rng = b.rng
    tilt = _rotation("x", rng.uniform(15, 50))
    z = rng.uniform(2, 5)
    top = np.array([0.0, 0.35 * z, z])
    b.add(BOX, (12, 0.1, 3), top + tilt @ (0, 0.1, 0), tilt)
    b.add(BOX, (20, 12, 0.3), (0, 0, z + rng.uniform(3, 7)))
    for _ in range(int(rng.integers(4, 18))):
        half = rng.uniform(0.08, 0.4, 3)
        x = rng.uniform(-1.2, 1.2) * b.view[0] * z
        at = np.array([x, -half[1], rng.uniform(-1.3, 2.5)])
        R = tilt @ _rotation("y", rng.uniform(0, 180))
        b.add(b.any_shape(), half, top + tilt @ at, R)


SURROUNDINGS: tuple[Callable[[_Builder], None], ...] = (_street, _hall, _hills, _wall, _table)


def _occluders(b: _Builder) -> None:
    """Static things close to the camera, from a pole to one that fills half of the image."""
    rng = b.rng
    for _ in range(int(rng.choice([0, 1, 2, 4], p=[0.35, 0.35, 0.2, 0.1]))):
        z = rng.uniform(1.3, 4.0)
        size = log_uniform(rng, (0.04, 0.9)) * b.view[0] * z
        half = size * rng.uniform(0.4, 1.3, 3) * (1, 1, 0.4)
        if rng.random() < 0.25:
            half[1] *= 6
        place = (*(rng.uniform(-1.1, 1.1, 2) * b.view * z), z + half[2])
        R = any_turn(rng) if rng.random() < 0.5 else None
        b.add(b.any_shape(), half, place, R)


# --- what moves: bodies of about unit radius ------------------------------------------------------


def _vehicle(rng: np.random.Generator) -> Parts:
    """Body, cabin and four wheels."""
    height, width = rng.uniform(0.2, 0.5), rng.uniform(0.35, 0.6)
    parts = [(BOX, affine((1.0, height, width), (0, 0, 0)))]
    cabin = (rng.uniform(0.3, 0.7), rng.uniform(0.15, 0.35), 0.9 * width)
    parts.append((BOX, affine(cabin, (rng.uniform(-0.4, 0.4), -height - cabin[1], 0))))
    R, wheel = _rotation("x", 90), rng.uniform(0.15, 0.3)
    places = [(x, height, z) for x in (-0.65, 0.65) for z in (-width, width)]
    return parts + [(CYLINDER, affine((wheel, 0.08, wheel), at, R)) for at in places]


def _walker(rng: np.random.Generator) -> Parts:
    """Trunk, head and four limbs of two parts that swing about their joints."""
    trunk = np.array([rng.uniform(0.18, 0.3), rng.uniform(0.35, 0.5), rng.uniform(0.12, 0.25)])
    parts = [(ELLIPSOID, affine(trunk, (0, 0, 0)))]
    parts.append((ELLIPSOID, affine(0.16, (0, -trunk[1] - 0.12, 0))))
    swing = log_uniform(rng, (1.0, 18.0))
    for side, hip in itertools.product((-1.0, 1.0), repeat=2):
        joint = np.array([side * (trunk[0] + 0.03), 0.8 * hip * trunk[1], 0.0])
        knee = joint + (0, 0.4, 0)
        upper = about(_rotation("xz", rng.normal(0, (35, 20))), joint)
        lower = about(turn(rng, rng.normal(0, 40)), knee)
        move = about(turn(rng, swing * rng.normal()), joint)
        bend = about(turn(rng, swing * rng.normal()), knee)
        thick = rng.uniform(0.06, 0.12)
        thigh = np.stack([upper, move @ upper])
        shin = thigh @ np.stack([lower, bend @ lower])
        for limb, width, down in ((thigh, thick, 0.2), (shin, 0.8 * thick, 0.6)):
            A = affine((width, 0.24, width), joint + (0, down, 0))
            parts.append((ELLIPSOID, carried(limb, A)))
    return parts


def _chain(rng: np.random.Generator) -> Parts:
    """Links one after the other, each turning against the one before."""
    count = int(rng.integers(4, 12))
    thick, length = rng.uniform(0.1, 0.3), 2.0 / count
    shape = int(rng.choice(SHAPES))
    bend = log_uniform(rng, (0.5, 8.0))
    link = affine((1.1 * length, thick, thick), (length, 0, 0))
    place = np.stack([np.eye(4)] * 2)
    parts = []
    for k in range(count):
        R, at = turn(rng, rng.normal(0, 25)), 1.7 * length
        local = make_transform(R, np.array([at, 0, 0]))
        if k == 0:
            local = make_transform(np.eye(3), np.array([-1.0, 0, 0]))
        change = make_transform(turn(rng, bend * rng.normal()), np.zeros(3))
        place = place @ np.stack([local, local @ change])
        parts.append((shape, carried(place, link)))
    return parts


def _panels(rng: np.random.Generator) -> Parts:
    """Boards that fold about their hinges: doors, screens, pages."""
    count = int(rng.integers(1, 5))
    half = np.array([1.0 / count, rng.uniform(0.5, 1.2), 0.03])
    swing = log_uniform(rng, (0.5, 10.0))
    place, edge, parts = np.stack([np.eye(4)] * 2), np.array([-1.0, 0, 0]), []
    for _ in range(count):
        fold = rng.normal(0, 35)
        angles = (fold, fold + swing * rng.normal())
        place = place @ np.stack([make_transform(_rotation("y", a), edge) for a in angles])
        parts.append((BOX, carried(place, affine(half, (half[0], 0, 0)))))
        for _ in range(int(rng.integers(0, 3))):
            knob = rng.uniform(0.03, 0.15, 3)
            at = (*(rng.uniform(0, 1.6, 2) * half[:2] - (0, half[1])), -0.08)
            parts.append((ELLIPSOID, carried(place, affine(knob, at))))
        edge = np.array([2 * half[0], 0, 0])
    return parts


def _breathing(rng: np.random.Generator) -> Parts:
    """A ball of solids that swells, shears or twists, more the farther from its middle."""
    count = int(rng.integers(8, 45))
    stretch = log_uniform(rng, (0.003, 0.06)) * rng.normal(size=(3, 3))
    twist, axis = log_uniform(rng, (0.5, 8.0)), int(rng.integers(3))
    squash = rng.uniform(0.35, 1.0, 3)
    parts = []
    for k in range(count):
        towards = direction(rng)
        radius = 0.0 if k == 0 else rng.uniform(0.3, 0.85)
        centre = squash * towards * radius
        half = (0.6 if k == 0 else rng.uniform(0.12, 0.35)) * squash * rng.uniform(0.7, 1.2, 3)
        A = affine(half, centre, any_turn(rng) if k else None)
        change = _rotation("xyz"[axis], twist * centre[axis]) @ (
            np.eye(3) + stretch * (0.5 + centre)
        )
        parts.append((ELLIPSOID, np.stack([A, change @ A])))
    return parts


def _heap(rng: np.random.Generator) -> Parts:
    """A rigid heap of arbitrary solids, with gaps to look through or without."""
    count, size = int(rng.integers(1, 16)), rng.uniform(0.25, 0.7)
    parts = []
    for _ in range(count):
        half = size * rng.uniform(0.3, 1.2, 3)
        centre = rng.uniform(-0.8, 0.8, 3) * (1 if count > 1 else 0)
        parts.append((int(rng.choice(SHAPES)), affine(half, centre, any_turn(rng))))
    return parts


def _swarm(rng: np.random.Generator) -> Parts:
    """Many small bodies that share a motion only in part."""
    own_m, own_deg = log_uniform(rng, (0.003, 0.1)), log_uniform(rng, (0.3, 12.0))
    parts = []
    for _ in range(int(rng.integers(6, 40))):
        centre = rng.uniform(-1, 1, 3) * (1, 1, 0.6)
        half = log_uniform(rng, (0.05, 0.3)) * rng.uniform(0.6, 1.3, 3)
        A = affine(half, centre, any_turn(rng))
        T = about(turn(rng, own_deg * rng.normal()), centre, own_m * rng.standard_normal(3))
        parts.append((int(rng.choice(SHAPES)), np.stack([A, carried(T, A)])))
    return parts


BODIES: tuple[Callable[[np.random.Generator], Parts], ...] = (
    _vehicle, _walker, _chain, _panels, _breathing, _heap, _swarm,
)  # fmt: skip


def _movers(b: _Builder, T_world_cam: np.ndarray, grow: float) -> None:
    """Add bodies, each with a motion of its own or a common one; ``grow`` scales their sizes."""
    rng = b.rng
    many = rng.random() < 0.25
    count = int(rng.integers(4, 11)) if many else int(rng.integers(1, 4))
    follow, together, alike = rng.random(3) < (0.45, 0.3, 0.5)
    kinds = rng.integers(len(BODIES), size=count)
    own: np.ndarray | None = None
    for number in range(count):
        z = rng.uniform(1.8, 7.0) * b.s
        least = 0.08 if many or number else 0.3
        radius = grow * log_uniform(rng, (least, 0.7)) * np.sqrt(b.view[0] * b.view[1]) * z
        centre = np.array([*(rng.uniform(-0.95, 0.95, 2) * b.view * z), z])
        # flat enough for a large body not to reach the camera
        depth = min(rng.uniform(0.4, 1.0), 0.7 * z / radius)
        place = make_transform(np.diag([radius, radius, depth * radius]) @ any_turn(rng), centre)
        t = log_uniform(rng, (0.003, 0.07)) * z * rng.standard_normal(3) * (1, 0.7, 0.7)
        angle_deg = log_uniform(rng, (0.15, 6.0))
        # where the camera goes along, what is left of the motion in the image is small
        left = log_uniform(rng, (0.03, 1.0)) if follow else 1.0
        alone = about(turn(rng, left * angle_deg), centre, left * t)
        if own is None or not together:
            own = T_world_cam @ alone if follow else alone
        both = np.stack([place, own @ place])
        for shape, A in BODIES[int(kinds[0 if alike else number])](rng):
            maps = carried(both, A)
            if min(M[2, 3] - float(np.linalg.norm(M[2, :3])) for M in maps) > 0.4 * b.s:
                b.paint(shape, maps, number + 1)


def training_scene(seed: int, height: int, width: int) -> Scene:
    """Scene of two frames; the same seed gives the same images."""
    rng = np.random.default_rng([0x6A75, seed])
    spread = np.tan(np.radians(rng.uniform(34, 100) / 2))
    focal = width / 2 / spread
    shift = rng.normal(0, 0.03, 2) * width
    aspect = log_uniform(rng, (0.8, 1.25)) if rng.random() < 0.3 else 1.0
    centre = (width - 1) / 2 + shift[0], (height - 1) / 2 + shift[1]
    camera = Camera(focal, aspect * focal, *centre, height, width)
    s = log_uniform(rng, (0.2, 3.0))
    angle_deg = min(log_uniform(rng, (0.1, 8.0)), 6.0)
    rotation = np.zeros(3)
    if rng.random() >= 0.05:
        rotation = np.radians(angle_deg) * rng.standard_normal(3) * 0.6
    t = log_uniform(rng, (0.005, 0.25)) * s * rng.standard_normal(3)
    t = t * rng.choice([0.0, 1.0], p=[0.05, 0.95])
    if rng.random() < 0.3:
        t = t * (0.3, 0.2, 1.0)
    T = make_transform(Rotation.from_rotvec(rotation).as_matrix(), t)
    b = _Builder(rng, np.array([spread, spread * height / width / aspect]), s)
    SURROUNDINGS[int(rng.integers(len(SURROUNDINGS)))](b)
    _occluders(b)
    light = rng.standard_normal(3) * (1, 0.5, 1) - (0, 0.8, 0)
    seeds = rng.integers(2**31, size=2)
    noise = float(rng.choice([0.0, rng.uniform(0, 4)]))
    shares = [0.0, rng.uniform(0, 0.3), rng.uniform(0.3, 0.87)]
    wanted = float(rng.choice(shares, p=[0.06, 0.3, 0.64]))
    still, path = tuple(b.solids), np.stack([np.eye(4), T])
    scene = Scene((camera, camera), path, still, int(seeds[1]), tuple(light.tolist()), noise)
    grow = 1.0
    for _ in range(8 if wanted else 0):
        b.rng, b.solids = np.random.default_rng(seeds[0]), list(still)
        _movers(b, T, grow)
        scene = replace(scene, solids=tuple(b.solids))
        share = scene.moving_share(0, 64)[0]
        if abs(share - wanted) < 0.07:
            break
        grow = float(np.clip(grow * np.sqrt((wanted + 0.03) / (share + 0.03)), 0.15, 6.0))
    return scene
