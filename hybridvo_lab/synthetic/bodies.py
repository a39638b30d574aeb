"""Moving objects, each built of unit shapes under affine maps into
the object's frame, metres.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial.transform import Rotation

from hybridvo.core.geometry import make_transform
from hybridvo_lab.synthetic.draws import (
    affine,
    compose,
    log_uniform,
    random_direction,
    random_rotation,
    rotation_about,
    rotation_by,
)
from hybridvo_lab.synthetic.raycast import BOX, CYLINDER, ELLIPSOID
from hybridvo_lab.synthetic.render import Solid

SHAPES = (BOX, ELLIPSOID, CYLINDER)
"""All unit shapes."""
CLOUD_COLUMNS = 11
CLOUD_ROWS = 7
"""Ellipsoids in a row and in a column of a deforming sheet."""
MAX_WAVE_SHEAR = 0.25
"""Largest amplitude of a sheet's wave times its wave number:
steeper sheets would fold."""


class Part(NamedTuple):
    """One unit shape of an object."""

    shape: int
    # (3, 4), or (N, 3, 4) where the part moves within the object from frame to
    # frame
    A_object_unit: np.ndarray


MovingObject = Callable[[int, float], list[Solid]]
"""A moving object: given its number and a factor on its
size, it returns its solids."""


def draw_texture(rng: np.random.Generator) -> dict[str, Any]:
    """Draw the texture of one solid, as keyword arguments of :class:`Solid`."""
    base = rng.uniform(0.35, 1.0, 3)
    other = np.clip(base + rng.normal(0, 0.3, 3), 0.25, 1.0)
    wavelength = rng.uniform(1.0, 2.2)
    return {"wavelength": wavelength, "colours": (base, other)}


def moving_object(
    rng: np.random.Generator,
    parts: list[Part],
    T_world_object: np.ndarray,
    nearest: float = -np.inf,
) -> MovingObject:
    """Make a moving object of its parts and its path.

    Args:
        rng: draws the textures.
        parts: the shapes that the object consists of.
        T_world_object: (N, 4, 4) its pose in each frame.
        nearest: parts that come closer than this to the plane z = 0 of the
            world frame are left out, metres.

    Returns:
        A function of the object's number and of a factor on its size.
    """
    textures = [draw_texture(rng) for _ in parts]

    def solids(number: int, size: float) -> list[Solid]:
        kept = []
        for part, texture in zip(parts, textures, strict=True):
            A = compose(T_world_object, size * part.A_object_unit)
            reach = np.linalg.norm(A[:, 2, :3], axis=1)
            if (A[:, 2, 3] - reach).min() > nearest:
                kept.append(Solid(part.shape, A, number, **texture))
        return kept

    return solids


def cluster(rng: np.random.Generator, half: np.ndarray, count: int) -> list[Part]:
    """Draw a rigid object of one large part and smaller ones that stick out of it.

    Args:
        rng: the source of randomness.
        half: (3,) half axes of the large part, metres.
        count: the number of parts, the large one included.
    """
    shape = int(rng.choice([BOX, ELLIPSOID]))
    # an ellipsoid of the same half axes covers less of the image than a box
    scale = 1.15 if shape == ELLIPSOID else 1.0
    parts = [Part(shape, affine(half * scale, np.zeros(3)))]
    for _ in range(count - 1):
        # mostly on the side that faces the camera, so that no object is a single
        # plane
        low = (-0.95, -0.95, -1.3)
        high = (0.95, 0.95, -0.4)
        centre = rng.uniform(low, high) * half
        R = random_rotation(rng)
        part_half = rng.uniform(0.25, 0.55, 3) * half.mean()
        shape = int(rng.choice([BOX, ELLIPSOID, CYLINDER]))
        parts.append(Part(shape, affine(part_half, centre, R)))
    return parts


class _Wave(NamedTuple):
    """A wave that runs through a sheet."""

    sway: np.ndarray  # (3,) metres, the amplitude with its direction
    wave_vector: np.ndarray  # (3,) rad / m
    phase: np.ndarray  # (N,) rad, by frame


def _draw_wave(
    rng: np.random.Generator, frames: int, half_width: float, rate: float
) -> _Wave:
    """Draw a wave that moves points by at most ``rate`` metres a frame."""
    period = rng.uniform(18, 34)
    length = rng.uniform(1.6, 2.4) * half_width
    heading = rng.uniform(0, 2 * np.pi)
    along = np.array([np.cos(heading), np.sin(heading), 0.0])
    wave_vector = 2 * np.pi / length * along
    sway = rng.normal(size=3) * (0.6, 0.6, 1.0)

    by_rate = float(rate * period / (2 * np.pi))
    by_shear = float(MAX_WAVE_SHEAR / np.linalg.norm(wave_vector))
    amplitude = min(by_rate, by_shear)
    phase = 2 * np.pi * np.arange(frames) / period
    return _Wave(amplitude * sway / np.linalg.norm(sway), wave_vector, phase)


def cloud(
    rng: np.random.Generator, frames: int, half: np.ndarray, rate: float
) -> list[Part]:
    """Draw a deforming object: a sheet of ellipsoids that
    two waves carry and shear.

    Args:
        rng: the source of randomness.
        frames: the number of frames, N.
        half: (3,) half axes of the sheet, metres.
        rate: largest motion that each wave causes, metres a frame.
    """
    x = np.linspace(-1, 1, CLOUD_COLUMNS) * half[0]
    y = np.linspace(-1, 1, CLOUD_ROWS) * half[1]
    spacing = np.array([x[1] - x[0], y[1] - y[0]])
    grid = np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)
    grid = grid + rng.uniform(-0.15, 0.15, grid.shape) * spacing
    bulge = half[2] * (grid[:, 0] ** 2 / half[0] ** 2 - 0.5)
    relief = rng.normal(0, 0.1 * spacing.mean(), len(grid))
    centres = np.column_stack([grid, bulge + relief])
    waves = [_draw_wave(rng, frames, half[0], rate) for _ in range(2)]

    parts = []
    for centre in centres:
        moved = np.tile(centre, (frames, 1))
        gradient = np.tile(np.eye(3), (frames, 1, 1))
        for wave in waves:
            angle = centre @ wave.wave_vector - wave.phase
            shear = np.outer(wave.sway, wave.wave_vector)
            moved = moved + np.outer(np.sin(angle), wave.sway)
            gradient = gradient + np.cos(angle)[:, None, None] * shear
        size = (spacing[0], spacing[1], spacing.mean())
        radius = rng.uniform(0.62, 0.78, 3) * size
        A = np.concatenate([gradient * radius, moved[..., None]], axis=2)
        parts.append(Part(ELLIPSOID, A))
    return parts


# --- objects of about unit radius, over two frames --------------------------------


def vehicle(rng: np.random.Generator) -> list[Part]:
    """Draw a vehicle: a box, a cabin and four wheels."""
    height = rng.uniform(0.2, 0.5)
    width = rng.uniform(0.35, 0.6)
    cabin = np.array([rng.uniform(0.3, 0.7), rng.uniform(0.15, 0.35), 0.9 * width])
    radius = rng.uniform(0.15, 0.3)
    R = Rotation.from_euler("x", 90, degrees=True).as_matrix()

    cabin_centre = (rng.uniform(-0.4, 0.4), -height - cabin[1], 0)
    parts = [
        Part(BOX, affine((1.0, height, width), np.zeros(3))),
        Part(BOX, affine(cabin, cabin_centre)),
    ]
    for x, z in itertools.product((-0.65, 0.65), (-width, width)):
        wheel = affine((radius, 0.08, radius), (x, height, z), R)
        parts.append(Part(CYLINDER, wheel))
    return parts


def hinged_links(
    rng: np.random.Generator,
    shape: int,
    half: ArrayLike,
    count: int,
    T_object_first: np.ndarray,
) -> list[Part]:
    """Draw links along y, each hinged at the end of the one
    before and turning against it.

    Args:
        rng: the source of randomness.
        shape: the unit shape of every link.
        half: (3,) half axes of a link.
        count: the number of links.
        T_object_first: (4, 4) where the first link begins.
    """
    half = np.asarray(half)
    bend_deg = log_uniform(rng, (0.5, 15.0))
    parts = []
    place = np.stack([T_object_first] * 2)
    step = make_transform(np.eye(3), np.array([0, 1.8 * half[1], 0]))
    for _ in range(count):
        R_first = rotation_by(rng, rng.normal(0, 30))
        axis = random_direction(rng)
        bend_rad = np.radians(bend_deg * rng.normal())
        R_bend = Rotation.from_rotvec(bend_rad * axis).as_matrix()
        joint = [
            rotation_about(R, np.zeros(3)) for R in (R_first, R_first @ R_bend)
        ]
        place = place @ np.stack(joint)
        link = affine(half, (0, half[1], 0))
        parts.append(Part(shape, compose(place, link)))
        place = place @ step
    return parts


def walker(rng: np.random.Generator) -> list[Part]:
    """Draw a trunk, a head and four limbs of two parts that
    swing about their joints.
    """
    trunk = rng.uniform((0.18, 0.35, 0.12), (0.3, 0.5, 0.25))
    parts = [
        Part(ELLIPSOID, affine(trunk, np.zeros(3))),
        Part(ELLIPSOID, affine(0.16, (0, -trunk[1] - 0.12, 0))),
    ]
    for side, end in itertools.product((-1.0, 1.0), repeat=2):
        joint = np.array([side * (trunk[0] + 0.03), 0.8 * end * trunk[1], 0.0])
        thick = rng.uniform(0.06, 0.12)
        start = make_transform(np.eye(3), joint)
        parts += hinged_links(rng, ELLIPSOID, (thick, 0.24, thick), 2, start)
    return parts


def chain(rng: np.random.Generator) -> list[Part]:
    """Draw a chain of links, or of boards that fold about their
    hinges, as doors and pages do.
    """
    count = int(rng.integers(2, 12))
    half = (rng.uniform(0.1, 0.4), 1.1 / count, rng.uniform(0.1, 0.4))
    shape = int(rng.choice(SHAPES))
    are_boards = rng.random() < 0.5
    if are_boards:
        shape = BOX
        half = (rng.uniform(0.5, 1.2), 1.1 / count, 0.03)
    start = make_transform(np.eye(3), np.array([0, -1.0, 0]))
    return hinged_links(rng, shape, half, count, start)


def bunch(rng: np.random.Generator) -> list[Part]:
    """Draw solids in a ball: a rigid heap, a swarm whose members move,
    or a body that breathes.
    """
    kind = rng.choice(["heap", "swarm", "breathing"])
    size = log_uniform(rng, (0.1, 0.6))
    own_m = log_uniform(rng, (0.003, 0.1))
    own_deg = log_uniform(rng, (0.3, 12.0))
    stretch = log_uniform(rng, (0.003, 0.06)) * rng.normal(size=(3, 3))
    count = int(rng.integers(1, 16) / size**0.5)
    parts = []
    for _ in range(count):
        centre = 0.85 * rng.uniform() ** (1 / 3) * random_direction(rng)
        A = affine(size * rng.uniform(0.5, 1.5, 3), centre, random_rotation(rng))

        change = np.eye(4)
        if kind == "swarm":
            R = rotation_by(rng, own_deg * rng.normal())
            change = rotation_about(R, centre, own_m * random_direction(rng))
        elif kind == "breathing":
            twist_deg = own_deg * centre[2]
            twist = Rotation.from_euler("z", twist_deg, degrees=True).as_matrix()
            change[:3, :3] = twist @ (np.eye(3) + stretch * (0.5 + centre))

        shape = int(rng.choice(SHAPES))
        parts.append(Part(shape, np.stack([A, compose(change, A)])))
    return parts


def stairs(rng: np.random.Generator) -> list[Part]:
    """Draw a row of steps along x, as those of an escalator or the goods on a belt."""
    count = int(rng.integers(4, 15))
    spacing = 2.0 / count
    rise = rng.choice([0.0, rng.uniform(0.2, 1.0)]) * spacing
    has_belt = rng.random() < 0.5
    are_alike = rng.random() < 0.6
    half = spacing * rng.uniform((0.25, 0.15, 0.4), (0.5, 0.6, 3.0))
    parts = []
    for k in range(count):
        if not are_alike:
            half = spacing * rng.uniform((0.2, 0.1, 0.2), (0.5, 0.6, 1.0))
        middle = k - (count - 1) / 2
        centre = (middle * spacing, -middle * rise - half[1], 0.0)
        parts.append(Part(BOX, affine(half, centre)))
    if has_belt:
        slope_deg = np.degrees(np.arctan2(-rise, spacing))
        R = Rotation.from_euler("z", slope_deg, degrees=True).as_matrix()
        belt = (1.1, 0.02, 1.2 * half[2])
        parts.append(Part(BOX, affine(belt, (0, 0.02, 0), R)))
    return parts


OBJECTS = (vehicle, walker, chain, bunch)
"""The kinds of moving objects in training pairs."""
