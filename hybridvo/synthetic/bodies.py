"""Bodies that move, each made of unit shapes under affine maps into the body's frame, metres.

A map is (3, 4), or (N, 3, 4) for a part that moves within the body from frame to frame.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial.transform import Rotation

from hybridvo.geometry import make_transform
from hybridvo.synthetic.draws import (
    about,
    affine,
    any_turn,
    carried,
    direction,
    log_uniform,
    turn,
)
from hybridvo.synthetic.raycast import BOX, CYLINDER, ELLIPSOID
from hybridvo.synthetic.render import Solid

SHAPES = (BOX, ELLIPSOID, CYLINDER)
Parts = list[tuple[int, np.ndarray]]
"""The unit shapes of a body, with their maps."""
Mover = Callable[[int, float], list[Solid]]
"""A moving object: given its number and its size, it returns its solids."""


def draw_look(rng: np.random.Generator) -> dict[str, Any]:
    """Draw the texture of one solid, as the arguments of :class:`Solid`."""
    base = rng.uniform(0.35, 1.0, 3)
    other = np.clip(base + rng.normal(0, 0.3, 3), 0.25, 1.0)
    return {"wavelength": rng.uniform(1.0, 2.2), "colours": (base, other)}


def mover(
    rng: np.random.Generator,
    parts: Parts,
    place: np.ndarray,
    nearest: float = -np.inf,
) -> Mover:
    """Return a body that moves along its poses ``place`` (N, 4, 4) in the world.

    Parts that come closer to the camera's plane z = 0 than ``nearest``, metres, are left out.
    """
    looks = [draw_look(rng) for _ in parts]

    def solids(number: int, size: float) -> list[Solid]:
        maps = [carried(place, size * local) for _, local in parts]
        return [
            Solid(shape, A, number, **look)
            for (shape, _), A, look in zip(parts, maps, looks, strict=True)
            if (A[:, 2, 3] - np.linalg.norm(A[:, 2, :3], axis=1)).min() > nearest
        ]

    return solids


def cluster(rng: np.random.Generator, half: np.ndarray, count: int) -> Parts:
    """Draw a rigid body of one large part and smaller ones that stick out of it."""
    shape = int(rng.choice([BOX, ELLIPSOID]))
    parts = [
        (shape, affine(half * (1.15 if shape == ELLIPSOID else 1.0), np.zeros(3)))
    ]
    for _ in range(count - 1):
        # mostly on the side that faces the camera: relief, so that no mover is one plane
        at = rng.uniform((-0.95, -0.95, -1.3), (0.95, 0.95, -0.4)) * half
        R = any_turn(rng)
        part = rng.uniform(0.25, 0.55, 3) * half.mean()
        parts.append(
            (int(rng.choice([BOX, ELLIPSOID, CYLINDER])), affine(part, at, R))
        )
    return parts


def cloud(
    rng: np.random.Generator, frames: int, half: np.ndarray, rate: float
) -> Parts:
    """Draw a sheet of ellipsoids that two waves carry and shear by ``rate`` metres a frame each."""
    columns = 11
    rows = 7
    x = np.linspace(-1, 1, columns) * half[0]
    y = np.linspace(-1, 1, rows) * half[1]
    spacing = np.array([x[1] - x[0], y[1] - y[0]])
    centres = np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)
    centres = centres + rng.uniform(-0.15, 0.15, centres.shape) * spacing
    bulge = half[2] * (centres[:, 0] ** 2 / half[0] ** 2 - 0.5)
    centres = np.column_stack(
        [centres, bulge + rng.normal(0, 0.1 * spacing.mean(), len(centres))]
    )
    t = np.arange(frames)
    waves = []
    for _ in range(2):
        period = rng.uniform(18, 34)
        length = rng.uniform(1.6, 2.4) * half[0]
        heading = rng.uniform(0, 2 * np.pi)
        k = 2 * np.pi / length * np.array([np.cos(heading), np.sin(heading), 0.0])
        sway = rng.normal(size=3) * (0.6, 0.6, 1.0)
        amplitude = min(
            float(rate * period / (2 * np.pi)), float(0.25 / np.linalg.norm(k))
        )
        waves.append(
            (amplitude * sway / np.linalg.norm(sway), k, 2 * np.pi * t / period)
        )
    parts = []
    for centre in centres:
        moved = np.tile(centre, (frames, 1))
        gradient = np.tile(np.eye(3), (frames, 1, 1))
        for sway, k, phase in waves:
            angle = centre @ k - phase
            moved = moved + np.outer(np.sin(angle), sway)
            gradient = gradient + np.cos(angle)[:, None, None] * np.outer(sway, k)
        radius = rng.uniform(0.62, 0.78, 3) * (
            spacing[0],
            spacing[1],
            spacing.mean(),
        )
        parts.append(
            (
                ELLIPSOID,
                np.concatenate([gradient * radius, moved[..., None]], axis=2),
            )
        )
    return parts


# --- bodies of about unit radius, over two frames -------------------------------------------------


def vehicle(rng: np.random.Generator) -> Parts:
    """Draw a vehicle: a box, a cabin and four wheels."""
    height = rng.uniform(0.2, 0.5)
    width = rng.uniform(0.35, 0.6)
    cabin = np.array([rng.uniform(0.3, 0.7), rng.uniform(0.15, 0.35), 0.9 * width])
    wheel = rng.uniform(0.15, 0.3)
    R = Rotation.from_euler("x", 90, degrees=True).as_matrix()
    parts = [(BOX, affine((1.0, height, width), np.zeros(3)))]
    parts.append(
        (BOX, affine(cabin, (rng.uniform(-0.4, 0.4), -height - cabin[1], 0)))
    )
    for x, z in itertools.product((-0.65, 0.65), (-width, width)):
        parts.append((CYLINDER, affine((wheel, 0.08, wheel), (x, height, z), R)))
    return parts


def linked(
    rng: np.random.Generator,
    shape: int,
    half: ArrayLike,
    count: int,
    start: np.ndarray,
) -> Parts:
    """Draw links along y, each hinged at the end of the one before and turning against it."""
    half = np.asarray(half)
    bend_deg = log_uniform(rng, (0.5, 15.0))
    parts = []
    place = np.stack([start] * 2)
    step = make_transform(np.eye(3), np.array([0, 1.8 * half[1], 0]))
    for _ in range(count):
        rest = turn(rng, rng.normal(0, 30))
        axis = direction(rng)
        bent = Rotation.from_rotvec(
            np.radians(bend_deg * rng.normal()) * axis
        ).as_matrix()
        place = place @ np.stack(
            [about(R, np.zeros(3)) for R in (rest, rest @ bent)]
        )
        parts.append((shape, carried(place, affine(half, (0, half[1], 0)))))
        place = place @ step
    return parts


def walker(rng: np.random.Generator) -> Parts:
    """Draw a trunk, a head and four limbs of two parts that swing about their joints."""
    trunk = rng.uniform((0.18, 0.35, 0.12), (0.3, 0.5, 0.25))
    parts = [(ELLIPSOID, affine(trunk, np.zeros(3)))]
    parts.append((ELLIPSOID, affine(0.16, (0, -trunk[1] - 0.12, 0))))
    for side, hip in itertools.product((-1.0, 1.0), repeat=2):
        joint = np.array([side * (trunk[0] + 0.03), 0.8 * hip * trunk[1], 0.0])
        thick = rng.uniform(0.06, 0.12)
        limb = make_transform(np.eye(3), joint)
        parts += linked(rng, ELLIPSOID, (thick, 0.24, thick), 2, limb)
    return parts


def chain(rng: np.random.Generator) -> Parts:
    """Draw a chain of links, or of boards that fold about their hinges, as doors and pages do."""
    count = int(rng.integers(2, 12))
    half = (rng.uniform(0.1, 0.4), 1.1 / count, rng.uniform(0.1, 0.4))
    shape = int(rng.choice(SHAPES))
    if rng.random() < 0.5:
        shape = BOX
        half = (rng.uniform(0.5, 1.2), 1.1 / count, 0.03)
    return linked(
        rng, shape, half, count, make_transform(np.eye(3), np.array([0, -1.0, 0]))
    )


def bunch(rng: np.random.Generator) -> Parts:
    """Draw solids in a ball: a rigid heap, a swarm whose members move, or a body that breathes."""
    kind = rng.choice(["heap", "swarm", "breathing"])
    parts = []
    size = log_uniform(rng, (0.1, 0.6))
    own_m = log_uniform(rng, (0.003, 0.1))
    own_deg = log_uniform(rng, (0.3, 12.0))
    stretch = log_uniform(rng, (0.003, 0.06)) * rng.normal(size=(3, 3))
    for _ in range(int(rng.integers(1, 16) / size**0.5)):
        centre = 0.85 * rng.uniform() ** (1 / 3) * direction(rng)
        A = affine(size * rng.uniform(0.5, 1.5, 3), centre, any_turn(rng))
        change = np.eye(4)
        if kind == "swarm":
            change = about(
                turn(rng, own_deg * rng.normal()), centre, own_m * direction(rng)
            )
        elif kind == "breathing":
            twist = Rotation.from_euler(
                "z", own_deg * centre[2], degrees=True
            ).as_matrix()
            change[:3, :3] = twist @ (np.eye(3) + stretch * (0.5 + centre))
        parts.append((int(rng.choice(SHAPES)), np.stack([A, carried(change, A)])))
    return parts


BODIES = (vehicle, walker, chain, bunch)
"""The kinds of bodies in training pairs."""
