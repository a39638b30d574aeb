"""Families of scenes: a furnished room, a camera path, and movers on a wanted share of the view."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import Rotation

from hybridvo.errors import InputError
from hybridvo.synthetic.bodies import Mover, Parts, cloud, cluster, draw_look, mover
from hybridvo.synthetic.draws import affine, any_turn, camera_path, poses, sway
from hybridvo.synthetic.raycast import BOX, CYLINDER, ELLIPSOID
from hybridvo.synthetic.render import Scene, Solid
from hybridvo.types import Camera

HEAVY = ("heavy_rigid", "heavy_deforming", "heavy_two", "heavy_ten")
FAMILIES: dict[str, tuple[int, float, tuple[float, float]]] = {
    "static": (0, 0.0, (0.0, 0.0)),
    "light": (1, 0.3, (0.15, 0.45)),
    **{kind: (number, 0.6, (0.48, 0.73)) for number, kind in enumerate(HEAVY, 3)},
}
"""Of each family: its number in the seed, the share of pixels on movers that is aimed at, and the
limits of that share in every frame."""
ATTEMPTS = 200  # draws of a family before its share is given up
# frames by which a mover may go ahead of the camera or lag behind it, at most
LAG = 6


def _furnish(rng: np.random.Generator, spread: float, rise: float) -> list[Solid]:
    """A room with boxes, spheres and poles at all depths, some of them close to the camera.

    ``spread`` and ``rise`` are the tangents of half the fields of view.
    """
    floor = rng.uniform(1.5, 2.6)
    ceiling = -rng.uniform(3.5, 7.0)
    left = -rng.uniform(7, 12)
    right = rng.uniform(7, 12)
    back = -6.0
    far = rng.uniform(20, 27)
    low = np.array([left, ceiling, back])
    high = np.array([right, floor, far])
    look = draw_look(rng) | {"wavelength": 2.4}
    solids = [Solid(BOX, affine((high - low) / 2, (high + low) / 2), **look)]

    def put(
        shape: int, half: np.ndarray, centre: np.ndarray, R: np.ndarray
    ) -> None:
        solids.append(Solid(shape, affine(half, centre, R), **draw_look(rng)))

    def upright(depth: float, angle: float, thin: bool) -> None:
        x = angle * depth
        if not left + 1 < x < right - 1:
            return
        R = Rotation.from_euler(
            "YX", [rng.uniform(0, 90), rng.normal(0, 3)], degrees=True
        )
        if thin:
            radius = rng.uniform(0.03, 0.05) * max(1.0, depth / 4)
            half = np.array([radius, (floor - ceiling) / 2, radius])
            y = (floor + ceiling) / 2
            shape = CYLINDER
        else:
            half = rng.uniform(0.2, 0.55, 3) * (0.5 + depth / 9)
            half[1] *= rng.uniform(0.8, 2.0)
            y = floor - half[1]
            shape = int(rng.choice([BOX, BOX, CYLINDER]))
        put(shape, half, np.array([x, y, depth]), R.as_matrix())

    for depth in rng.uniform(4, far - 1.5, 8):
        upright(depth, rng.uniform(-1.3, 1.3) * spread, thin=False)
    for depth in rng.uniform(3.6, far - 2, 4):
        upright(depth, rng.uniform(-1.2, 1.2) * spread, thin=True)
    for depth in rng.uniform(4, far - 3, 6):
        at = rng.uniform(-1.2, 1.2) * spread, rng.uniform(-1.2, 0.8) * rise, 1.0
        half = rng.uniform(0.2, 0.6) * (0.5 + depth / 9) * rng.uniform(0.7, 1.3, 3)
        R = any_turn(rng)
        put(
            int(rng.choice([ELLIPSOID, ELLIPSOID, BOX])),
            half,
            np.array(at) * depth,
            R,
        )
    for side in rng.permutation([-1.0, 1.0, 0.0]):
        depth = rng.uniform(2.8, 3.6)
        angle = side * rng.uniform(0.75, 1.1) * spread + rng.normal(0, 0.05)
        slope = rng.choice([-1, 1]) * rise * rng.uniform(0.8, 1.3)
        if side == 0.0:
            upright(depth, rng.uniform(-0.8, 0.8) * spread, thin=True)
        else:
            shape = ELLIPSOID if side < 0 else BOX
            half = rng.uniform(0.12, 0.3, 3)
            put(shape, half, np.array([angle, slope, 1.0]) * depth, any_turn(rng))
    return solids


@dataclass(frozen=True, eq=False)
class _Movers:
    """Draws the movers of a scene."""

    rng: np.random.Generator
    guide: np.ndarray  # (frames + 2 LAG, 4, 4) path of the camera without shake
    frames: int
    view: np.ndarray  # tangents of half the fields of view, (x, y)

    def follow(self, slower: int = 1) -> np.ndarray:
        """The camera's path (N, 4, 4), some frames ahead of it or behind."""
        lag = int(self.rng.integers(-LAG, LAG + 1)) // slower
        return self.guide[LAG + lag : LAG + lag + self.frames]

    def mover(
        self,
        parts: Parts,
        centre: np.ndarray,
        speed: float,
        spin_deg: float,
        path: np.ndarray,
    ) -> Mover:
        """A body that sways about a place, which goes along a path."""
        angles = sway(self.rng, self.frames, spin_deg)
        place = path @ poses(angles, centre + sway(self.rng, self.frames, speed))
        return mover(self.rng, parts, place)

    def blob(
        self,
        at: tuple[float, float, float],
        share: float,
        count: int,
        speed: float,
        spin_deg: float,
        path: np.ndarray,
    ) -> Mover:
        """A rigid body on a share of the view; ``at``: x and y in half views, depth in metres."""
        (spread, rise), depth = self.view, at[2]
        area = share * spread * rise * depth**2
        aspect = self.rng.uniform(0.7, 1.8)
        half = np.array([np.sqrt(area * aspect), np.sqrt(area / aspect), 0.0])
        half[2] = self.rng.uniform(0.5, 0.9) * half[:2].min()
        centre = np.array([at[0] * spread, at[1] * rise, 1.0]) * depth
        return self.mover(
            cluster(self.rng, half, count), centre, speed, spin_deg, path
        )

    def single(self, deforming: bool) -> list[Mover]:
        """One body, rigid or deforming, on more than half of the image."""
        rng, (spread, rise) = self.rng, self.view
        depth = rng.uniform(4.5, 9.0)
        side = rng.choice([-1.0, 1.0]) * rng.uniform(0.15, 0.4)
        half = np.array([0.55 * spread, 1.1 * rise, 0.2 * spread]) * depth
        centre = (
            np.array([side * spread, rng.uniform(-0.2, 0.2) * rise, 1.0]) * depth
        )
        speed = rng.uniform(0.03, 0.09)
        spin_deg = rng.uniform(0.4, 1.6)
        if deforming:
            parts = cloud(
                rng, self.frames, half * (1.2, 1.0, 0.6), rng.uniform(0.03, 0.06)
            )
            spin_deg *= 0.5
        else:
            parts = cluster(rng, half, int(rng.integers(6, 11)))
        return [self.mover(parts, centre, speed, spin_deg, self.follow())]

    def draw(self, kind: str) -> list[Mover]:
        """The movers of one family."""
        uniform = self.rng.uniform
        integers = self.rng.integers
        blob = self.blob
        follow = self.follow
        if kind in ("heavy_rigid", "heavy_deforming"):
            return self.single(deforming=kind == "heavy_deforming")
        if kind == "heavy_two":
            depths = self.rng.permutation([uniform(3.8, 5.5), uniform(6.0, 9.0)])
            return [
                blob((side * uniform(0.4, 0.65), uniform(-0.3, 0.3), depth), 0.33,
                     int(integers(3, 6)), uniform(0.06, 0.1), uniform(0.4, 1.8), follow())
                for side, depth in zip((-1.0, 1.0), depths, strict=True)
            ]  # fmt: skip
        if kind == "heavy_ten":
            normal = self.rng.normal
            return [
                blob((0.4 * column + normal(0, 0.06), row + normal(0, 0.08), uniform(3.8, 9.0)),
                     0.07, int(integers(1, 4)), uniform(0.02, 0.09), uniform(0.3, 2.5), follow(2))
                for column in range(-2, 3) for row in (-0.5, 0.5)
            ]  # fmt: skip
        still = np.broadcast_to(
            self.guide[LAG + self.frames // 2], (self.frames, 4, 4)
        )
        first = self.rng.choice([-1.0, 1.0]) * uniform(0.35, 0.6)
        side = np.sign(first)
        return [
            blob((first, uniform(-0.2, 0.3), uniform(4.5, 7)), 0.19, 4,
                 uniform(0.04, 0.09), uniform(0.5, 1.5), follow()),
            blob((-0.7 * side, uniform(-0.4, 0.4), uniform(4, 6)), 0.06, 3,
                 uniform(0.04, 0.08), uniform(1.0, 2.5), follow()),
            blob((-0.15 * side, uniform(-0.5, 0.5), uniform(6, 10)), 0.04, 2,
                 uniform(0.05, 0.1), uniform(0.5, 2.0), still),
            blob((uniform(-0.8, 0.8), uniform(-0.5, 0.5), uniform(6, 12)), 0.03, 1,
                 0.006, 0.1, still),
        ]  # fmt: skip


def make_scene(
    kind: str, seed: int, *, height: int = 218, width: int = 512, frames: int = 20
) -> Scene:
    """Draw a scene of a family from a seed.

    The families are ``static``, ``light`` with several movers on about 30 % of the pixels, and
    those of :data:`HEAVY`: movers cover 46 to 75 % of the pixels of every frame, and the flow of at
    least 46 % differs from the camera's by over 1/512 of the width.
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
        rng = np.random.default_rng([FAMILIES[kind][0], seed, attempt])
        scene = _draw_scene(rng, kind, (height, width), frames)
        if scene is not None:
            return scene
    raise InputError(
        f"scene {kind!r}, seed {seed}: no draw of {ATTEMPTS} kept its share of moving pixels over "
        f"{frames} frames; ask for another seed."
    )


def _draw_scene(
    rng: np.random.Generator, kind: str, size: tuple[int, int], frames: int
) -> Scene | None:
    """One draw of a family, or None where it leaves its limits or a surface comes too close."""
    height, width = size
    focal = rng.uniform(1.0, 1.2) * width
    # not used, but without these draws the scene of every seed would be another one
    rng.random(2)
    camera = Camera(focal, focal, (width - 1) / 2, (height - 1) / 2, height, width)
    view = np.array([width / 2, height / 2]) / focal
    path, guide = camera_path(
        rng, frames + 2 * LAG, rng.uniform(0.06, 0.13), rng.uniform(0.5, 1.4)
    )
    furniture = tuple(_furnish(rng, *view))
    scene = Scene(
        camera, path[LAG : LAG + frames], furniture, int(rng.integers(2**31))
    )
    if kind != "static":
        share = FAMILIES[kind][1]
        scene, found = sized(
            scene, _Movers(rng, guide, frames, view).draw(kind), share
        )
        if abs(found - share) > 0.04:
            return None
    return scene if _keeps_band(scene, kind) else None


def sized(
    scene: Scene,
    movers: list[Mover],
    share: float,
    limits: tuple[float, float] = (0.4, 2.0),
) -> tuple[Scene, float]:
    """Add movers of a size at which they cover a share of the view; returns the share reached.

    The size is found by bisection between ``limits``; the share is the median over the frames.
    """
    last = scene.frames - 1
    samples = np.unique(np.linspace(0, last, min(last + 1, 9)).round().astype(int))
    small, large = limits
    for _ in range(9):
        size = np.sqrt(small * large)
        solids = [
            solid for n, mover in enumerate(movers, 1) for solid in mover(n, size)
        ]
        made = replace(scene, solids=(*scene.solids, *solids))
        found = np.median([made.moving_share(int(i), 64)[0] for i in samples])
        small, large = (size, large) if found < share else (small, size)
    return made, float(found)


def _keeps_band(scene: Scene, kind: str) -> bool:
    """Whether every frame is within the family's limits, and no surface nearer than 1.2 m."""
    low, high = FAMILIES[kind][2]
    seen = map(scene.moving_share, range(scene.frames))
    if not all(nearest >= 1.2 and low <= share <= high for share, nearest in seen):
        return False
    # one pixel of an image 512 wide: small images are judged alike
    threshold = scene.camera.width / 512
    return kind not in HEAVY or all(
        scene.dynamic_share(index, 64, threshold) >= 0.47
        for index in range(scene.frames - 1)
    )
