"""Benchmark scenes: a furnished room, a camera path, and moving
objects on a fraction of the view.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from hybridvo.core.errors import InputError
from hybridvo.core.types import Camera
from hybridvo_lab.synthetic.bodies import (
    MovingObject,
    Part,
    cloud,
    cluster,
    draw_texture,
    moving_object,
)
from hybridvo_lab.synthetic.draws import (
    CameraPath,
    affine,
    camera_path,
    poses,
    random_rotation,
    sway,
)
from hybridvo_lab.synthetic.raycast import BOX, CYLINDER, ELLIPSOID
from hybridvo_lab.synthetic.render import Scene, Solid


class Family(NamedTuple):
    """A kind of scenes."""

    number: int  # in the seed
    # fraction of the pixels on moving objects that is aimed at
    target_fraction: float
    min_fraction: float  # limits of this fraction in every frame
    max_fraction: float


HEAVY = ("heavy_rigid", "heavy_deforming", "heavy_two", "heavy_ten")
"""Families in which most of the image moves."""
FAMILIES: dict[str, Family] = {
    "static": Family(0, 0.0, 0.0, 0.0),
    "light": Family(1, 0.3, 0.15, 0.45),
    **{
        kind: Family(number, 0.6, 0.48, 0.73)
        for number, kind in enumerate(HEAVY, 3)
    },
    "escalator": Family(7, 0.5, 0.38, 0.62),
}
"""Every family by its name."""
FRACTION_TOLERANCE = 0.04
"""Difference from the target fraction from which a draw is dropped."""
MIN_DYNAMIC_FRACTION = 0.47
"""Smallest fraction of a heavy scene's pixels whose flow differs from the camera's."""
DYNAMIC_PX = 1.0
"""Difference of flow from which a pixel counts for it, px at a width of 512."""
MIN_SURFACE_DEPTH = 1.2
"""Smallest depth of any surface, metres."""
ATTEMPTS = 200
"""Draws of a family before an error is raised."""
LAG = 6
"""Largest number of frames by which a moving object may go ahead of the
camera or lag behind it."""
STEPS = 6
"""Steps of an escalator on either side of the middle one."""
SIZE_STEPS = 9
"""Steps of the bisection for the size of the moving objects."""
SIZE_FRAMES = 9
"""Largest number of frames in which their fraction is measured."""


# --- the static room --------------------------------------------------------------


class _Room:
    """A room with boxes, spheres and poles at all depths, some of
    them close to the camera.

    ``view``: tangents of half the fields of view, (x, y).
    """

    def __init__(self, rng: np.random.Generator, view: np.ndarray) -> None:
        self.rng = rng
        self.tan_x = view[0]
        self.tan_y = view[1]
        self.floor = rng.uniform(1.5, 2.6)
        self.ceiling = -rng.uniform(3.5, 7.0)
        self.left = -rng.uniform(7, 12)
        self.right = rng.uniform(7, 12)
        self.far = rng.uniform(20, 27)
        self.solids: list[Solid] = []
        self.add_walls()
        self.add_furniture()
        self.add_floating()
        self.add_foreground()

    def put(
        self, shape: int, half: np.ndarray, centre: np.ndarray, R: np.ndarray
    ) -> None:
        """Add one solid with a texture of its own."""
        A = affine(half, centre, R)
        self.solids.append(Solid(shape, A, **draw_texture(self.rng)))

    def add_walls(self) -> None:
        """Add the room itself: one box, viewed from inside."""
        back = -6.0
        low = np.array([self.left, self.ceiling, back])
        high = np.array([self.right, self.floor, self.far])
        texture = draw_texture(self.rng) | {"wavelength": 2.4}
        A = affine((high - low) / 2, (high + low) / 2)
        self.solids.append(Solid(BOX, A, **texture))

    def add_furniture(self) -> None:
        """Add things that stand on the floor, and poles from floor to ceiling."""
        rng = self.rng
        for depth in rng.uniform(4, self.far - 1.5, 8):
            self.add_standing(depth, rng.uniform(-1.3, 1.3) * self.tan_x)
        for depth in rng.uniform(3.6, self.far - 2, 4):
            self.add_pole(depth, rng.uniform(-1.2, 1.2) * self.tan_x)

    def add_standing(self, depth: float, tangent: float) -> None:
        """Add a box or cylinder on the floor, where x / z is ``tangent``."""
        x = tangent * depth
        if not self.is_inside(x):
            return
        R = self.draw_upright()
        half = self.rng.uniform(0.2, 0.55, 3) * (0.5 + depth / 9)
        half[1] *= self.rng.uniform(0.8, 2.0)
        shape = int(self.rng.choice([BOX, BOX, CYLINDER]))
        self.put(shape, half, np.array([x, self.floor - half[1], depth]), R)

    def add_pole(self, depth: float, tangent: float) -> None:
        """Add a pole from floor to ceiling, where x / z is ``tangent``."""
        x = tangent * depth
        if not self.is_inside(x):
            return
        R = self.draw_upright()
        radius = self.rng.uniform(0.03, 0.05) * max(1.0, depth / 4)
        half = np.array([radius, (self.floor - self.ceiling) / 2, radius])
        y = (self.floor + self.ceiling) / 2
        self.put(CYLINDER, half, np.array([x, y, depth]), R)

    def is_inside(self, x: float) -> bool:
        """Whether a thing at x, metres, keeps a distance to the walls."""
        return bool(self.left + 1 < x < self.right - 1)

    def draw_upright(self) -> np.ndarray:
        """Draw a rotation (3, 3) about the vertical axis, and a little tilt."""
        angles = [self.rng.uniform(0, 90), self.rng.normal(0, 3)]
        return Rotation.from_euler("YX", angles, degrees=True).as_matrix()

    def add_floating(self) -> None:
        """Add things in the air."""
        rng = self.rng
        for depth in rng.uniform(4, self.far - 3, 6):
            x = rng.uniform(-1.2, 1.2) * self.tan_x
            y = rng.uniform(-1.2, 0.8) * self.tan_y
            size = rng.uniform(0.2, 0.6) * (0.5 + depth / 9)
            half = size * rng.uniform(0.7, 1.3, 3)
            R = random_rotation(rng)
            shape = int(rng.choice([ELLIPSOID, ELLIPSOID, BOX]))
            self.put(shape, half, np.array((x, y, 1.0)) * depth, R)

    def add_foreground(self) -> None:
        """Add a near thing on each side of the view, and a pole in the middle."""
        rng = self.rng
        for side in rng.permutation([-1.0, 1.0, 0.0]):
            depth = rng.uniform(2.8, 3.6)
            x = side * rng.uniform(0.75, 1.1) * self.tan_x + rng.normal(0, 0.05)
            y = rng.choice([-1, 1]) * self.tan_y * rng.uniform(0.8, 1.3)
            if side == 0.0:
                self.add_pole(depth, rng.uniform(-0.8, 0.8) * self.tan_x)
                continue
            shape = ELLIPSOID if side < 0 else BOX
            half = rng.uniform(0.12, 0.3, 3)
            centre = np.array([x, y, 1.0]) * depth
            self.put(shape, half, centre, random_rotation(rng))


# --- moving objects ---------------------------------------------------------------


class _Place(NamedTuple):
    """Where an object starts: x and y in half views, depth in metres."""

    x: float
    y: float
    depth: float


@dataclass(frozen=True, eq=False)
class _MovingObjects:
    """Draws the moving objects of a scene."""

    rng: np.random.Generator
    # (frames + 2 LAG, 4, 4) path of the camera without shake
    T_world_cam_smooth: np.ndarray
    frames: int
    view: np.ndarray  # tangents of half the fields of view, (x, y)

    def follow_camera(self, slower: int = 1) -> np.ndarray:
        """The camera's path (N, 4, 4), some frames ahead of it or behind."""
        lag = int(self.rng.integers(-LAG, LAG + 1)) // slower
        first = LAG + lag
        return self.T_world_cam_smooth[first : first + self.frames]

    def stay(self) -> np.ndarray:
        """The camera's pose in the middle of the path, N times (N, 4, 4)."""
        middle = self.T_world_cam_smooth[LAG + self.frames // 2]
        return np.broadcast_to(middle, (self.frames, 4, 4))

    def swaying(
        self,
        parts: list[Part],
        centre: np.ndarray,
        speed: float,
        spin_deg: float,
        path: np.ndarray,
    ) -> MovingObject:
        """An object that sways about a point of a frame which
        itself moves along a path.

        Args:
            parts: the shapes of the object.
            centre: (3,) the point, metres in the moving frame.
            speed: typical translation, metres a frame.
            spin_deg: typical rotation, degrees a frame.
            path: (N, 4, 4) the path of the frame.
        """
        angles_deg = sway(self.rng, self.frames, spin_deg)
        position = centre + sway(self.rng, self.frames, speed)
        return moving_object(self.rng, parts, path @ poses(angles_deg, position))

    def blob(
        self,
        place: _Place,
        fraction: float,
        count: int,
        speed: float,
        spin_deg: float,
        path: np.ndarray,
    ) -> MovingObject:
        """A rigid object of ``count`` parts on a fraction of the view.

        See :meth:`swaying`.
        """
        depth = place.depth
        tan_x, tan_y = self.view
        area = fraction * tan_x * tan_y * depth**2
        aspect = self.rng.uniform(0.7, 1.8)
        half = np.array([np.sqrt(area * aspect), np.sqrt(area / aspect), 0.0])
        half[2] = self.rng.uniform(0.5, 0.9) * half[:2].min()
        centre = np.array([place.x * tan_x, place.y * tan_y, 1.0]) * depth
        parts = cluster(self.rng, half, count)
        return self.swaying(parts, centre, speed, spin_deg, path)

    def single(self, is_deforming: bool) -> list[MovingObject]:
        """One object, rigid or deforming, on more than half of the image."""
        rng = self.rng
        tan_x, tan_y = self.view
        depth = rng.uniform(4.5, 9.0)
        x = rng.choice([-1.0, 1.0]) * rng.uniform(0.15, 0.4)
        half = np.array([0.55 * tan_x, 1.1 * tan_y, 0.2 * tan_x]) * depth
        y = rng.uniform(-0.2, 0.2)
        centre = np.array([x * tan_x, y * tan_y, 1.0]) * depth
        speed = rng.uniform(0.03, 0.09)
        spin_deg = rng.uniform(0.4, 1.6)
        if is_deforming:
            rate = rng.uniform(0.03, 0.06)
            parts = cloud(rng, self.frames, half * (1.2, 1.0, 0.6), rate)
            spin_deg *= 0.5
        else:
            parts = cluster(rng, half, int(rng.integers(6, 11)))
        return [self.swaying(parts, centre, speed, spin_deg, self.follow_camera())]

    def two(self) -> list[MovingObject]:
        """Two rigid objects side by side, each on a third of the image."""
        rng = self.rng
        depths = rng.permutation([rng.uniform(3.8, 5.5), rng.uniform(6.0, 9.0)])
        return [
            self.blob(
                _Place(
                    side * rng.uniform(0.4, 0.65), rng.uniform(-0.3, 0.3), depth
                ),
                fraction=0.33,
                count=int(rng.integers(3, 6)),
                speed=rng.uniform(0.06, 0.1),
                spin_deg=rng.uniform(0.4, 1.8),
                path=self.follow_camera(),
            )
            for side, depth in zip((-1.0, 1.0), depths, strict=True)
        ]

    def ten(self) -> list[MovingObject]:
        """Ten small rigid objects in two rows."""
        rng = self.rng
        objects = []
        for column in range(-2, 3):
            for row in (-0.5, 0.5):
                x = 0.4 * column + rng.normal(0, 0.06)
                y = row + rng.normal(0, 0.08)
                drawn = self.blob(
                    _Place(x, y, rng.uniform(3.8, 9.0)),
                    fraction=0.07,
                    count=int(rng.integers(1, 4)),
                    speed=rng.uniform(0.02, 0.09),
                    spin_deg=rng.uniform(0.3, 2.5),
                    path=self.follow_camera(2),
                )
                objects.append(drawn)
        return objects

    def several(self) -> list[MovingObject]:
        """Two objects that follow the camera, and two small ones
        that stay where they are.
        """
        rng = self.rng
        uniform = rng.uniform
        x = rng.choice([-1.0, 1.0]) * uniform(0.35, 0.6)
        side = np.sign(x)
        return [
            self.blob(
                _Place(x, uniform(-0.2, 0.3), uniform(4.5, 7)),
                fraction=0.19,
                count=4,
                speed=uniform(0.04, 0.09),
                spin_deg=uniform(0.5, 1.5),
                path=self.follow_camera(),
            ),
            self.blob(
                _Place(-0.7 * side, uniform(-0.4, 0.4), uniform(4, 6)),
                fraction=0.06,
                count=3,
                speed=uniform(0.04, 0.08),
                spin_deg=uniform(1.0, 2.5),
                path=self.follow_camera(),
            ),
            self.blob(
                _Place(-0.15 * side, uniform(-0.5, 0.5), uniform(6, 10)),
                fraction=0.04,
                count=2,
                speed=uniform(0.05, 0.1),
                spin_deg=uniform(0.5, 2.0),
                path=self.stay(),
            ),
            self.blob(
                _Place(uniform(-0.8, 0.8), uniform(-0.5, 0.5), uniform(6, 12)),
                fraction=0.03,
                count=1,
                speed=0.006,
                spin_deg=0.1,
                path=self.stay(),
            ),
        ]

    def escalator(self) -> list[MovingObject]:
        """A row of steps across the view and beyond, which all move along it."""
        rng = self.rng
        tan_x, tan_y = self.view
        depth = rng.uniform(4.0, 8.0)
        half = np.array([0.12 * tan_x, 0.45 * tan_y, 0.3 * tan_x]) * depth
        rise = rng.uniform(0.0, 0.5) * half[0]
        yaw_deg = rng.uniform(-30, 30)
        parts = []
        for k in range(-STEPS, STEPS + 1):
            size = half * rng.uniform(0.8, 1.0, 3)
            place = np.array(
                [2 * k * half[0], -k * rise, rng.normal(0, 0.1) * depth]
            )
            parts.append(Part(BOX, affine(size, place)))
        centre = np.array([0.0, rng.uniform(-0.2, 0.2) * tan_y, 1.0]) * depth
        along = np.array([2 * half[0], -rise, 0.0])
        R = Rotation.from_euler("y", yaw_deg, degrees=True).as_matrix()
        speed = rng.choice([-1.0, 1.0]) * rng.uniform(0.03, 0.1)
        travelled = speed * (np.arange(self.frames) - self.frames / 2)
        direction = R @ along / np.linalg.norm(along)
        position = centre + travelled[:, None] * direction
        angles_deg = np.tile([0.0, yaw_deg, 0.0], (self.frames, 1))
        path = self.stay() @ poses(angles_deg, position)
        return [moving_object(rng, parts, path)]

    def draw(self, kind: str) -> list[MovingObject]:
        """The moving objects of one family."""
        if kind == "escalator":
            return self.escalator()
        if kind in ("heavy_rigid", "heavy_deforming"):
            return self.single(is_deforming=kind == "heavy_deforming")
        if kind == "heavy_two":
            return self.two()
        if kind == "heavy_ten":
            return self.ten()
        return self.several()


class Populated(NamedTuple):
    """A scene with moving objects."""

    scene: Scene
    # median over the frames of the fraction of pixels on them
    moving_fraction: float


def populate(
    scene: Scene,
    objects: list[MovingObject],
    fraction: float,
    size_limits: tuple[float, float] = (0.4, 2.0),
) -> Populated:
    """Add moving objects of a size at which they cover a fraction of the view.

    The size is found by bisection.

    Args:
        scene: the static scene.
        objects: the moving objects.
        fraction: the fraction of the pixels that they should cover, in the median frame.
        size_limits: smallest and largest factor on the objects' size.
    """
    last = scene.frames - 1
    count = min(last + 1, SIZE_FRAMES)
    samples = np.unique(np.linspace(0, last, count).round().astype(int))
    small, large = size_limits
    for _ in range(SIZE_STEPS):
        size = np.sqrt(small * large)
        solids = [
            solid
            for number, make_solids in enumerate(objects, 1)
            for solid in make_solids(number, size)
        ]
        populated = replace(scene, solids=(*scene.solids, *solids))
        fractions = [
            populated.coverage(int(i), 64).moving_fraction for i in samples
        ]
        reached = np.median(fractions)
        if reached < fraction:
            small = size
        else:
            large = size
    return Populated(populated, float(reached))


# --- scenes -----------------------------------------------------------------------


def make_scene(
    kind: str, seed: int, *, height: int = 218, width: int = 512, frames: int = 20
) -> Scene:
    """Draw a scene of a family from a seed.

    The families are ``static``, ``light`` with several moving objects on about 30 %
    of the pixels, and those of :data:`HEAVY`: moving objects cover 46 to 75 % of
    the pixels of every frame, and the flow of at least 46 % differs from the
    camera's by over 1/512 of the width. On an ``escalator`` many steps on about half of
    the pixels have one motion.

    Args:
        kind: one of :data:`FAMILIES`.
        seed: determines the scene, together with the other arguments.
        height: rows of the images.
        width: columns of the images.
        frames: the number of frames.

    Raises:
        InputError: an argument is out of range, or no draw
            kept the family's limits.

    >>> scene = make_scene("light", 0, height=54, width=128, frames=2)
    >>> scene.render(0).rgb.shape
    (54, 128, 3)
    """
    if kind not in FAMILIES:
        raise InputError(
            f"scene kind: expected one of {', '.join(FAMILIES)}, got {kind!r}."
        )
    if seed < 0 or frames < 2 or min(height, width) < 8:
        raise InputError(
            f"make_scene: expected seed >= 0, 2 frames and 8x8 px or more, got seed {seed}, "
            f"{frames} frames and {height}x{width} px."
        )
    for attempt in range(ATTEMPTS):
        rng = np.random.default_rng([FAMILIES[kind].number, seed, attempt])
        scene = _draw_scene(rng, kind, (height, width), frames)
        if scene is not None:
            return scene
    raise InputError(
        f"scene {kind!r}, seed {seed}: no draw of {ATTEMPTS} kept its fraction of moving pixels in "
        f"{frames} frames. Choose another seed or fewer frames."
    )


def _draw_scene(
    rng: np.random.Generator, kind: str, size: tuple[int, int], frames: int
) -> Scene | None:
    """One draw of a family, or None where it leaves its limits or a
    surface comes too close.
    """
    height, width = size
    focal = rng.uniform(1.0, 1.2) * width
    # not used, but without these draws the scene of every seed would be another one
    rng.random(2)
    camera = Camera(
        focal, focal, (width - 1) / 2, (height - 1) / 2, height=height, width=width
    )
    view = np.array([width / 2, height / 2]) / focal
    path = _draw_path(rng, frames)
    room = tuple(_Room(rng, view).solids)
    T_world_cam = path.T_world_cam[LAG : LAG + frames]
    scene = Scene(camera, T_world_cam, room, int(rng.integers(2**31)))
    family = FAMILIES[kind]
    if kind != "static":
        drawer = _MovingObjects(rng, path.T_world_cam_smooth, frames, view)
        scene, reached = populate(scene, drawer.draw(kind), family.target_fraction)
        if abs(reached - family.target_fraction) > FRACTION_TOLERANCE:
            return None
    return scene if _is_within_limits(scene, kind) else None


def _draw_path(rng: np.random.Generator, frames: int) -> CameraPath:
    """The camera's path with LAG further poses at both ends."""
    step = rng.uniform(0.06, 0.13)
    turn_deg = rng.uniform(0.5, 1.4)
    return camera_path(rng, frames + 2 * LAG, step, turn_deg)


def _is_within_limits(scene: Scene, kind: str) -> bool:
    """Whether every frame keeps the limits of the family
    and of the nearest surface.
    """
    family = FAMILIES[kind]
    for index in range(scene.frames):
        fraction, min_depth = scene.coverage(index)
        if min_depth < MIN_SURFACE_DEPTH:
            return False
        if not family.min_fraction <= fraction <= family.max_fraction:
            return False
    if kind not in HEAVY:
        return True
    # small images are judged by the same fraction of their width
    threshold = DYNAMIC_PX * scene.camera.width / 512
    return all(
        scene.dynamic_fraction(index, 64, threshold) >= MIN_DYNAMIC_FRACTION
        for index in range(scene.frames - 1)
    )
