"""What an export is made of: images with their poses, and points on what stands still."""

from __future__ import annotations

from typing import NamedTuple

import cv2
import numpy as np

from hybridvo.geometry import backproject, transform_points, valid_depth
from hybridvo.types import Camera, Frame

MAX_POINTS = 100_000
"""Points of an export: what a splat starts from."""
MIN_SUPPORT = 0.2
"""Mean weight of the pixels around one, below which it moves."""
WINDOW = 1 / 32
"""Side of the square of these pixels, as a fraction of the image's width."""


class View(NamedTuple):
    """An image of a run with its pose."""

    name: str  # of the file, below the folder of the images
    camera: Camera
    T_world_cam: np.ndarray  # (4, 4) with OpenCV's axes: x right, y down, z forward

    @property
    def centre(self) -> tuple[float, float]:
        """The principal point where the first pixel's corner is (0, 0): COLMAP and nerfstudio."""
        return self.camera.cx + 0.5, self.camera.cy + 0.5


class Points(NamedTuple):
    """Points with colours."""

    xyz: np.ndarray  # (N, 3) metres, in the world frame
    rgb: np.ndarray  # (N, 3) uint8

    @classmethod
    def joined(cls, parts: list[Points]) -> Points:
        """Return the points of all parts."""
        none = Points(np.zeros((0, 3)), np.zeros((0, 3), np.uint8))
        xyz, rgb = zip(none, *parts, strict=True)
        return cls(np.concatenate(xyz), np.concatenate(rgb))


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


def _mean(values: np.ndarray, side: int) -> np.ndarray:
    """The mean (H, W) in the square around each pixel."""
    return cv2.boxFilter(values.astype(np.float32), -1, (side, side))


def points_of(
    frame: Frame, mask: np.ndarray, T_world_cam: np.ndarray, count: int
) -> Points:
    """Return points of a frame on a regular grid, without what its mask ignores.

    Args:
        frame: The frame, with image and depth.
        mask: (H, W) of :func:`mask_of`.
        T_world_cam: (4, 4) its pose.
        count: About how many points.
    """
    depth = frame.depth
    rgb = frame.rgb
    if depth is None or rgb is None:
        return Points.joined([])
    rows, columns = np.nonzero(valid_depth(depth) & mask)
    step = max(1, len(rows) // max(count, 1))
    index = np.column_stack([rows[::step], columns[::step]])
    points = backproject(depth, frame.camera, index)
    colours = rgb[index[:, 0], index[:, 1]].reshape(len(index), -1)
    xyz = transform_points(T_world_cam, points)
    return Points(xyz, np.broadcast_to(colours, (len(index), 3)))
