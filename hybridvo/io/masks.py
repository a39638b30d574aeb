"""Which pixels of a frame stand still, by the weights of a motion, and which are of an object."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np

from hybridvo.core.geometry import valid_depth
from hybridvo.core.results import MovingObject
from hybridvo.core.types import Frame

MIN_SUPPORT = 0.2
"""Mean weight of the pixels around one, below which it moves."""
WINDOW = 1 / 32
"""Side of the square of these pixels, as a fraction of the image's width."""

OBJECT_COLOURS = (
    (86, 180, 233),
    (204, 121, 167),
    (240, 228, 66),
    (0, 158, 115),
    (213, 94, 0),
    (0, 114, 178),
    (148, 103, 189),
    (140, 86, 75),
)
"""Colours of objects, by their numbers in turn: red, green and blue, 0 to 255."""


def object_colour(number: int) -> tuple[int, int, int]:
    """Return the colour of an object, which it keeps.

    >>> object_colour(1) == object_colour(1 + len(OBJECT_COLOURS))
    True
    """
    return OBJECT_COLOURS[(number - 1) % len(OBJECT_COLOURS)]


def mask_of(frame: Frame, weights: np.ndarray | None) -> np.ndarray:
    """Return which pixels of a frame stand still, as far as is known.

    A pixel moves where the weights around it are small: single ones are small by noise. Where
    there is no depth, nothing is known, and the pixel is kept.

    Args:
        frame: The frame, whose own mask counts as well.
        weights: (H, W) from 0 to 1, of the motion that starts at it; None where there is none.

    Returns:
        (H, W) bool, False where a pixel is to be ignored.
    """
    mask = np.full(frame.camera.shape, True)
    if frame.mask is not None:
        mask &= frame.mask
    depth = frame.depth
    if weights is None or depth is None or weights.shape != depth.shape:
        return mask
    is_known = valid_depth(depth)
    side = 2 * int(WINDOW * depth.shape[1] / 2) + 1
    support = _mean(np.where(is_known, weights, 0), side)
    known = _mean(is_known, side)
    moves = is_known & (support < MIN_SUPPORT * known)
    return mask & ~moves


def numbers_of(things: Sequence[MovingObject]) -> np.ndarray:
    """Return the number of the object at every pixel, 0 where there is none.

    Args:
        things: The objects of a step, at least one.

    Returns:
        (H, W) uint16.

    >>> from hybridvo.core.results import Status
    >>> left = np.array([[True, False]])
    >>> cup = MovingObject(7, left, np.eye(4), np.eye(6), Status(), confidence=0.9)
    >>> numbers_of([cup]).tolist()
    [[7, 0]]
    """
    numbers = np.zeros(things[0].mask.shape, np.uint16)
    for thing in things:
        numbers[thing.mask] = thing.id
    return numbers


def _mean(values: np.ndarray, side: int) -> np.ndarray:
    """The mean (H, W) in the square around each pixel."""
    return cv2.boxFilter(values.astype(np.float32), -1, (side, side))
