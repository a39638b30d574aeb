"""A wall of bays along which a camera moves; two of them look alike.

Where the path is lost before one of these, nothing shows which it is.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from hybridvo.core.types import Camera
from hybridvo.lab.synthetic.bodies import draw_texture
from hybridvo.lab.synthetic.draws import affine, random_rotation
from hybridvo.lab.synthetic.raycast import BOX, CYLINDER, ELLIPSOID
from hybridvo.lab.synthetic.render import Scene, Solid

BAY_WIDTH = 6.0
"""Distance from the middle of one bay to that of the next, metres."""
BAYS = (0, 1, 1, 2)
"""What the bays show, from left to right: two are alike."""
ALIKE = (1, 2)
"""Places of these two in the row."""
WALL_DISTANCE = 5.0
"""Of the wall behind a bay from the camera, metres."""
HALF_HEIGHT = 2.0
THICKNESS = 0.1
"""Of walls, metres."""
THINGS = 9
"""Solids that stand in a bay."""


def row_of_bays(seed: int, positions: np.ndarray, size: tuple[int, int]) -> Scene:
    """Make the bays and a camera that looks at them.

    Args:
        seed: of what stands in them.
        positions: (N,) places of the camera along the row in bays, 0 before the middle of
            the first one.
        size: height and width of the images.

    Returns:
        The scene; the camera looks at the wall from N places.

    >>> scene = row_of_bays(0, np.array(ALIKE, float), (60, 80))
    >>> first = scene.render(0)
    >>> second = scene.render(1)
    >>> bool((first.rgb == second.rgb).all()), bool(np.allclose(first.depth, second.depth))
    (True, True)
    """
    height, width = size
    focal = float(width)
    camera = Camera(focal, focal, (width - 1) / 2, (height - 1) / 2, height, width)
    T_world_cam = np.tile(np.eye(4), (len(positions), 1, 1))
    T_world_cam[:, 0, 3] = BAY_WIDTH * np.asarray(positions)
    solids = [
        _moved(solid, BAY_WIDTH * place)
        for place, kind in enumerate(BAYS)
        for solid in _bay(np.random.default_rng([seed, kind]), 100 * kind)
    ]
    return Scene(camera, T_world_cam, tuple(solids), seed=seed)


def _bay(rng: np.random.Generator, pattern: int) -> list[Solid]:
    """A bay at the origin: wall, floor and ceiling, and what stands in it."""
    depth = WALL_DISTANCE / 2
    half_width = BAY_WIDTH / 2
    slabs = [
        ((half_width, HALF_HEIGHT, THICKNESS), (0.0, 0.0, WALL_DISTANCE)),
        ((half_width, THICKNESS, depth), (0.0, HALF_HEIGHT, depth)),
        ((half_width, THICKNESS, depth), (0.0, -HALF_HEIGHT, depth)),
    ]
    solids = [
        Solid(BOX, affine(half, centre), pattern=pattern + k, **draw_texture(rng))
        for k, (half, centre) in enumerate(slabs)
    ]
    for k in range(len(slabs), len(slabs) + THINGS):
        shape = (BOX, ELLIPSOID, CYLINDER)[k % 3]
        half = rng.uniform(0.15, 0.5, 3)
        # none reaches into the next bay
        low = np.array([0.7 - half_width, -1.5, 2.5])
        high = np.array([half_width - 0.7, 1.5, 4.6])
        A = affine(half, rng.uniform(low, high), random_rotation(rng))
        solids.append(Solid(shape, A, pattern=pattern + k, **draw_texture(rng)))
    return solids


def _moved(solid: Solid, x: float) -> Solid:
    """A solid, moved along the row by some metres."""
    A = solid.A_world_body.copy()
    A[0, 3] += x
    return replace(solid, A_world_body=A)
