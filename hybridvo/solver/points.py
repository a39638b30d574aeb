"""The points of a depth map on a regular grid of its pixels, kept with their frame."""

from __future__ import annotations

from typing import NamedTuple

import cv2
import numpy as np

from hybridvo.core.geometry import backproject, valid_depth
from hybridvo.core.kept import kept_with_frame
from hybridvo.core.types import Frame

# points of the grid, about
POINTS = 5000
# guards divisions
TINY = 1e-6


class Points(NamedTuple):
    """The points of a frame on a regular grid, those with depth.

    Attributes:
        shape: (h, w) of the grid.
        cells: rows and columns (N,) on the grid.
        pixels: (N, 2) their rows and columns in the image.
        xyz: (N, 3) metres, in the camera.
    """

    shape: tuple[int, int]
    cells: tuple[np.ndarray, ...]
    pixels: np.ndarray
    xyz: np.ndarray

    def on_grid(self, values: np.ndarray) -> np.ndarray:
        """Return values (N,) on the grid, (h, w) float32; 0 where there is no point."""
        grid = np.zeros(self.shape, np.float32)
        grid[self.cells] = values
        return grid

    def averaged(
        self, values: np.ndarray, side: int, counts: np.ndarray | None = None
    ) -> np.ndarray:
        """(N,) averages over squares of points, of values (N,) that count."""
        if counts is None:
            counts = np.ones(len(self.pixels), bool)
        total = cv2.blur(self.on_grid(np.where(counts, values, 0)), (side, side))
        fraction = cv2.blur(self.on_grid(counts), (side, side))
        return np.asarray((total / np.maximum(fraction, TINY))[self.cells])


def grid_index(shape: tuple[int, int], points: int = POINTS) -> np.ndarray:
    """Return the rows and columns (h, w, 2) of a regular grid of pixels of an image (H, W).

    Args:
        shape: (H, W) of the image.
        points: about how many there are at most; by default those of a belief.

    Returns:
        The grid.

    >>> grid_index((480, 640)).shape
    (60, 80, 2)
    """
    height, width = shape
    step = grid_step(shape, points)
    first = step // 2
    rows, columns = np.mgrid[first:height:step, first:width:step]
    return np.stack([rows, columns], axis=-1)


def grid_step(shape: tuple[int, int], points: int) -> int:
    """Return the distance, px, between the pixels of :func:`grid_index`."""
    return max(1, round(np.sqrt(shape[0] * shape[1] / points)))


def points_of(frame: Frame, count: int = POINTS) -> Points:
    """Return the points of a frame with depth; they are kept with it, and not to be changed.

    Args:
        frame: with depth.
        count: about how many there are at most; by default those of a belief.
    """
    grids = _grids(frame)
    step = grid_step(frame.camera.shape, count)
    if step not in grids:
        grids[step] = _choose(frame, count)
    return grids[step]


@kept_with_frame
def _grids(frame: Frame) -> dict[int, Points]:
    """The points that were chosen so far, by the step of their grid."""
    return {}


def _choose(frame: Frame, count: int) -> Points:
    depth = np.asarray(frame.depth)
    grid = grid_index(frame.camera.shape, count)
    cells = np.nonzero(valid_depth(depth[grid[..., 0], grid[..., 1]]))
    index = grid[cells]
    xyz = backproject(depth, frame.camera, index)
    return Points(grid.shape[:2], cells, index, xyz)
