"""Scene families: a furnished room, a camera path and movers that keep a wanted share of the view.

Every family is drawn from one seed; movers are sized, and draws rejected, until the share of
moving pixels is inside the family's band in every frame.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from hybridvo.errors import InputError
from hybridvo.synthetic.draws import affine, any_turn, camera_path, carried, poses, sway
from hybridvo.synthetic.raycast import BOX, CYLINDER, ELLIPSOID
from hybridvo.synthetic.render import Scene, Solid
from hybridvo.types import Camera

BANDS = {
    "static": (0.0, 0.0),
    "light": (0.15, 0.45),
    "pair": (0.02, 0.7),
    **dict.fromkeys(("heavy_rigid", "heavy_deforming", "heavy_two", "heavy_ten"), (0.48, 0.73)),
}
"""Share of the pixels on movers in every frame of each family."""
ATTEMPTS = 200
"""Draws of a family before a share is given up."""
LAG = 6
"""Most frames by which the path of a mover runs before or after the camera's, which it follows."""

Parts = list[tuple[int, np.ndarray]]
"""Unit shapes with their (3, 4) or (N, 3, 4) maps into the object frame, metres."""
Mover = Callable[[int, float], list[Solid]]
"""Number and size of a moving object -> its solids."""


def draw_look(rng: np.random.Generator) -> dict[str, Any]:
    """Texture of one solid."""
    base = rng.uniform(0.35, 1.0, 3)
    other = np.clip(base + rng.normal(0, 0.3, 3), 0.25, 1.0)
    return {"wavelength": rng.uniform(1.0, 2.2), "colours": (base, other)}


def cluster(rng: np.random.Generator, half: np.ndarray, count: int) -> Parts:
    """A rigid body of one large part and smaller ones that stick out of it."""
    shape = int(rng.choice([BOX, ELLIPSOID]))
    parts = [(shape, affine(half * (1.15 if shape == ELLIPSOID else 1.0), np.zeros(3)))]
    for _ in range(count - 1):
        # mostly on the side that faces the camera: relief, so that no mover is one plane
        at = rng.uniform((-0.95, -0.95, -1.3), (0.95, 0.95, -0.4)) * half
        R = any_turn(rng)
        part = rng.uniform(0.25, 0.55, 3) * half.mean()
        parts.append((int(rng.choice([BOX, ELLIPSOID, CYLINDER])), affine(part, at, R)))
    return parts


def cloud(rng: np.random.Generator, frames: int, half: np.ndarray, rate: float) -> Parts:
    """A sheet of ellipsoids, carried and sheared by two travelling waves; exact at every point."""
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


def _furnish(rng: np.random.Generator, spread: float, rise: float) -> list[Solid]:
    """Room with boxes, spheres and poles at all depths; some stand close to the camera."""
    floor, ceiling = rng.uniform(1.5, 2.6), -rng.uniform(3.5, 7.0)
    left, right = -rng.uniform(7, 12), rng.uniform(7, 12)
    back, far = -6.0, rng.uniform(20, 27)
    low, high = np.array([left, ceiling, back]), np.array([right, floor, far])
    look = draw_look(rng) | {"wavelength": 2.4}
    solids = [Solid(BOX, affine((high - low) / 2, (high + low) / 2), **look)]

    def put(shape: int, half: np.ndarray, centre: np.ndarray, R: np.ndarray) -> None:
        solids.append(Solid(shape, affine(half, centre, R), **draw_look(rng)))

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
        put(shape, half, np.array([x, y, depth]), R.as_matrix())

    for depth in rng.uniform(4, far - 1.5, 8):
        upright(depth, rng.uniform(-1.3, 1.3) * spread, thin=False)
    for depth in rng.uniform(3.6, far - 2, 4):
        upright(depth, rng.uniform(-1.2, 1.2) * spread, thin=True)
    for depth in rng.uniform(4, far - 3, 6):
        at = rng.uniform(-1.2, 1.2) * spread, rng.uniform(-1.2, 0.8) * rise, 1.0
        centre = np.array(at) * depth
        half = rng.uniform(0.2, 0.6) * (0.5 + depth / 9) * rng.uniform(0.7, 1.3, 3)
        R = any_turn(rng)
        put(int(rng.choice([ELLIPSOID, ELLIPSOID, BOX])), half, centre, R)
    for side in rng.permutation([-1.0, 1.0, 0.0]):
        depth = rng.uniform(2.8, 3.6)
        angle = side * rng.uniform(0.75, 1.1) * spread + rng.normal(0, 0.05)
        slope = rng.choice([-1, 1]) * rise * rng.uniform(0.8, 1.3)
        if side == 0.0:
            upright(depth, rng.uniform(-0.8, 0.8) * spread, thin=True)
        else:
            shape, half = ELLIPSOID if side < 0 else BOX, rng.uniform(0.12, 0.3, 3)
            put(shape, half, np.array([angle, slope, 1.0]) * depth, any_turn(rng))
    return solids


@dataclass(frozen=True, eq=False)
class _Movers:
    """Draws the movers of a scene along ``guide``, the camera path without shake, padded by LAG."""

    rng: np.random.Generator
    guide: np.ndarray
    frames: int
    view: np.ndarray

    def follow(self, slower: int = 1) -> np.ndarray:
        """(N, 4, 4) the camera's path, some frames before or after it."""
        lag = int(self.rng.integers(-LAG, LAG + 1)) // slower
        return self.guide[LAG + lag : LAG + lag + self.frames]

    def mover(
        self, parts: Parts, centre: np.ndarray, speed: float, spin_deg: float, path: np.ndarray
    ) -> Mover:
        """A body that sways about a place in the frame of a path."""
        angles = sway(self.rng, self.frames, spin_deg)
        place = path @ poses(angles, centre + sway(self.rng, self.frames, speed))
        looks = [draw_look(self.rng) for _ in parts]

        def solids(number: int, size: float) -> list[Solid]:
            return [
                Solid(shape, carried(place, size * local), number, **look)
                for (shape, local), look in zip(parts, looks, strict=True)
            ]

        return solids

    def blob(
        self,
        at: tuple[float, float, float],
        share: float,
        count: int,
        speed: float,
        spin_deg: float,
        path: np.ndarray,
    ) -> Mover:
        """Rigid body over a ``share`` of the view; ``at``: shares of the half view, and metres."""
        (spread, rise), depth = self.view, at[2]
        area = share * spread * rise * depth**2
        aspect = self.rng.uniform(0.7, 1.8)
        half = np.array([np.sqrt(area * aspect), np.sqrt(area / aspect), 0.0])
        half[2] = self.rng.uniform(0.5, 0.9) * half[:2].min()
        centre = np.array([at[0] * spread, at[1] * rise, 1.0]) * depth
        return self.mover(cluster(self.rng, half, count), centre, speed, spin_deg, path)

    def single(self, deforming: bool) -> list[Mover]:
        """One body on more than half of the image, rigid or not."""
        rng, (spread, rise) = self.rng, self.view
        depth = rng.uniform(4.5, 9.0)
        side = rng.choice([-1.0, 1.0]) * rng.uniform(0.15, 0.4)
        half = np.array([0.55 * spread, 1.1 * rise, 0.2 * spread]) * depth
        centre = np.array([side * spread, rng.uniform(-0.2, 0.2) * rise, 1.0]) * depth
        speed, spin_deg = rng.uniform(0.03, 0.09), rng.uniform(0.4, 1.6)
        if deforming:
            parts = cloud(rng, self.frames, half * (1.2, 1.0, 0.6), rng.uniform(0.03, 0.06))
            spin_deg *= 0.5
        else:
            parts = cluster(rng, half, int(rng.integers(6, 11)))
        return [self.mover(parts, centre, speed, spin_deg, self.follow())]

    def draw(self, kind: str) -> list[Mover]:
        """Movers of one family."""
        uniform, integers = self.rng.uniform, self.rng.integers
        blob, follow = self.blob, self.follow
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
        if kind == "light":
            still = np.broadcast_to(self.guide[LAG + self.frames // 2], (self.frames, 4, 4))
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
        return [
            blob((uniform(-0.8, 0.8), uniform(-0.8, 0.8), uniform(3.5, 12)), uniform(0.03, 0.3),
                 int(integers(1, 4)), uniform(0.005, 0.1), uniform(0.1, 2.5), follow())
            for _ in range(int(integers(1, 5)))
        ]  # fmt: skip


def make_scene(
    kind: str,
    seed: int,
    *,
    height: int = 218,
    width: int = 512,
    frames: int | None = None,
    zoom: float = 0.0,
    noise: float = 0.0,
) -> Scene:
    """Scene of a family, drawn from a seed.

    Kinds: ``static``; ``light`` (several movers, about 30 % of the pixels); ``pair`` (small, any);
    ``heavy_rigid``, ``heavy_deforming``, ``heavy_two``, ``heavy_ten``: 46 to 75 % of the pixels on
    movers in every frame, and at least 46 % whose flow differs from the camera's by over 1/512 of
    the width. ``frames``: default 20, for ``pair`` 2; ``zoom``: relative amplitude of a slow change
    of focal length; ``noise``: standard deviation of the sensor noise in grey levels.

    Raises:
        InputError: an unknown kind, or a value out of range.

    Example:
        >>> scene = make_scene("static", 0, height=16, width=32, frames=2)
        >>> scene.render(0).rgb.shape
        (16, 32, 3)
    """
    if frames is None:
        frames = 2 if kind == "pair" else 20
    if kind not in BANDS:
        raise InputError(f"scene kind: expected one of {', '.join(BANDS)}, got {kind!r}.")
    for name, value, low, high in (
        ("seed", seed, 0, np.inf), ("frames", frames, 2, np.inf), ("height", height, 8, np.inf),
        ("width", width, 8, np.inf), ("zoom", zoom, 0, 0.3), ("noise", noise, 0, 255),
    ):  # fmt: skip
        if not low <= value <= high or (high == np.inf and value % 1):
            raise InputError(f"{name}: expected {low} to {high}, got {value!r}.")
    for attempt in range(ATTEMPTS):
        rng = np.random.default_rng([list(BANDS).index(kind), seed, attempt])
        scene = _draw_scene(rng, kind, (height, width), frames, zoom, noise)
        if scene is not None:
            return scene
    raise InputError(
        f"scene {kind!r}, seed {seed}: no draw of {ATTEMPTS} kept its share of moving pixels over "
        f"{frames} frames; ask for another seed."
    )


def _draw_scene(
    rng: np.random.Generator,
    kind: str,
    size: tuple[int, int],
    frames: int,
    zoom: float,
    noise: float,
) -> Scene | None:
    """One draw of a family, or None where it leaves its band or a surface comes too close."""
    height, width = size
    focal = rng.uniform(1.0, 1.2) * width
    period, phase = rng.uniform(40, 80), rng.uniform(0, 2 * np.pi)
    cameras = tuple(
        Camera(f, f, (width - 1) / 2, (height - 1) / 2, height, width)
        for f in focal * (1 + zoom * np.sin(2 * np.pi * np.arange(frames) / period + phase))
    )
    view = np.array([width / 2, height / 2]) / focal
    path, guide = camera_path(rng, frames + 2 * LAG, rng.uniform(0.06, 0.13), rng.uniform(0.5, 1.4))
    furniture = tuple(_furnish(rng, *view))
    seed = int(rng.integers(2**31))
    scene = Scene(cameras, path[LAG : LAG + frames], furniture, seed, noise=noise)
    movers = [] if kind == "static" else _Movers(rng, guide, frames, view).draw(kind)
    if movers:
        share = {"light": 0.30, "pair": rng.uniform(0.05, 0.5)}.get(kind, 0.60)
        scene, found = _sized(scene, movers, share)
        if abs(found - share) > 0.04:
            return None
    return scene if _keeps_band(scene, kind) else None


def _sized(scene: Scene, movers: list[Mover], share: float) -> tuple[Scene, float]:
    """The scene with movers of the size at which they cover a share, and which they cover."""
    last = scene.frames - 1
    samples = np.unique(np.linspace(0, last, min(last + 1, 9)).round().astype(int))
    small, large = 0.4, 2.0
    for _ in range(9):
        size = np.sqrt(small * large)
        solids = [solid for n, mover in enumerate(movers, 1) for solid in mover(n, size)]
        sized = replace(scene, solids=(*scene.solids, *solids))
        found = np.median([sized.moving_share(int(i), 64)[0] for i in samples])
        small, large = (size, large) if found < share else (small, size)
    return sized, float(found)


def _keeps_band(scene: Scene, kind: str) -> bool:
    """Whether every frame has the family's share of movers, and no surface is nearer than 1.2 m."""
    low, high = BANDS[kind]
    for index in range(scene.frames):
        share, nearest = scene.moving_share(index)
        if nearest < 1.2 or not low <= share <= high:
            return False
    # one pixel of an image 512 wide: small images are judged alike
    threshold = scene.cameras[0].width / 512
    return not kind.startswith("heavy") or all(
        scene.dynamic_share(index, 64, threshold) >= 0.47 for index in range(scene.frames - 1)
    )
