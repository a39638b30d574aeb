"""What an export is made of: images with their poses, and points on what stands still."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from hybridvo.core.geometry import backproject, transform_points, valid_depth
from hybridvo.core.types import Camera, Frame

MAX_POINTS = 100_000
"""Points of an export: what a splat starts from."""


class PosedImage(NamedTuple):
    """An image of a run with its pose."""

    name: str  # of the file, below the folder of the images
    camera: Camera
    T_world_cam: np.ndarray  # (4, 4) with OpenCV's axes: x right, y down, z forward

    @property
    def centre(self) -> tuple[float, float]:
        """The principal point where the first pixel's corner is (0, 0): COLMAP and nerfstudio."""
        return self.camera.cx + 0.5, self.camera.cy + 0.5


class ColouredPoints(NamedTuple):
    """Points with colours."""

    xyz: np.ndarray  # (N, 3) metres, in the world frame
    rgb: np.ndarray  # (N, 3) uint8

    @classmethod
    def joined(cls, parts: list[ColouredPoints]) -> ColouredPoints:
        """Return the points of all parts."""
        none = ColouredPoints(np.zeros((0, 3)), np.zeros((0, 3), np.uint8))
        xyz, rgb = zip(none, *parts, strict=True)
        return cls(np.concatenate(xyz), np.concatenate(rgb))


def points_of(
    frame: Frame, mask: np.ndarray, T_world_cam: np.ndarray, count: int
) -> ColouredPoints:
    """Return points of a frame on a regular grid, without what its mask ignores.

    Args:
        frame: The frame, with image and depth.
        mask: (H, W) of :func:`hybridvo.io.masks.mask_of`.
        T_world_cam: (4, 4) its pose.
        count: About how many points.
    """
    depth = frame.depth
    rgb = frame.rgb
    if depth is None or rgb is None:
        return ColouredPoints.joined([])
    rows, columns = np.nonzero(valid_depth(depth) & mask)
    step = max(1, len(rows) // max(count, 1))
    index = np.column_stack([rows[::step], columns[::step]])
    points = backproject(depth, frame.camera, index)
    colours = rgb[index[:, 0], index[:, 1]].reshape(len(index), -1)
    xyz = transform_points(T_world_cam, points)
    return ColouredPoints(xyz, np.broadcast_to(colours, (len(index), 3)))
