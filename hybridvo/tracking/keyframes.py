"""A key frame, and what of it another frame sees."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from hybridvo.geometry import project
from hybridvo.results import RelativePose
from hybridvo.types import Frame

GRID_COLUMNS = 128
"""Cells in a row of the coarse grid on which static pixels and overlap are known."""
HIDDEN = 0.03
"""Relative difference of depth from which a pixel is taken for hidden or moved."""


@dataclass(frozen=True, eq=False)
class KeyFrame:
    """A frame that others are registered to.

    Args:
        frame: the frame.
        T_world_cam: (4, 4) where the graph has it now.
        static: (h, w) bool on the coarse grid, pixels of the world; None until the motion of the
            next frame has told.
        depth_noise: standard deviation of log depth, from the same motion.
    """

    frame: Frame
    T_world_cam: np.ndarray
    static: np.ndarray | None = None
    depth_noise: float = 0.0


def static_cells(frame: Frame, motion: RelativePose) -> np.ndarray:
    """(h, w) bool on the coarse grid of a frame: where the pixels follow the motion from it."""
    height, width = frame.camera.shape
    cell = _cell(width)
    if motion.weights is None:
        return np.ones((-(-height // cell), -(-width // cell)), np.bool_)
    return np.asarray(_cells(motion.weights, cell) > 0.5)


def _cell(width: int) -> int:
    return max(4, -(-width // GRID_COLUMNS))


def _cells(image: np.ndarray, cell: int) -> np.ndarray:
    """(h, w) mean of each cell; cells at the border repeat the last row and column."""
    height, width = image.shape
    padded = np.pad(image, ((0, -height % cell), (0, -width % cell)), mode="edge")
    return padded.reshape(padded.shape[0] // cell, cell, -1, cell).mean(axis=(1, 3))


class View:
    """What of a key frame a frame sees under a motion."""

    def __init__(self, key: KeyFrame, T: np.ndarray, curr: Frame) -> None:
        height, width = key.frame.camera.shape
        self.cell = cell = _cell(width)
        rows = np.minimum(np.arange(-(-height // cell)) * cell + cell // 2, height - 1)
        columns = np.minimum(np.arange(-(-width // cell)) * cell + cell // 2, width - 1)
        z = np.asarray(key.frame.depth)[np.ix_(rows, columns)].astype(np.float64)
        valid = np.isfinite(z) & (z > 0)
        if key.static is not None:
            valid &= key.static
        camera = key.frame.camera
        u, v = np.meshgrid(columns.astype(np.float64), rows.astype(np.float64))
        ray = np.stack(
            [(u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy, np.ones_like(u)], -1
        )
        moved = ray * np.where(valid, z, 1.0)[..., None] @ T[:3, :3].T + T[:3, 3]
        depth = moved[..., 2]
        x, y = np.moveaxis(project(moved, curr.camera), -1, 0)
        with np.errstate(invalid="ignore"):
            seen = (x > -0.5) & (x < width - 0.5) & (y > -0.5) & (y < height - 0.5) & valid
        i = np.clip(np.where(seen, np.rint(y), 0).astype(np.intp), 0, height - 1)
        j = np.clip(np.where(seen, np.rint(x), 0).astype(np.intp), 0, width - 1)
        if curr.mask is not None:
            seen &= curr.mask[i, j]
        if curr.depth is not None:
            there = curr.depth[i, j]
            known = np.isfinite(there) & (there > 0) & seen
            ratio = np.where(known, there, 1.0) / np.where(known, depth, 1.0)
            seen &= np.abs(ratio - 1.0) < HIDDEN
        self.seen = seen
        count = max(int(np.count_nonzero(valid)), 1)
        self.overlap = float(np.count_nonzero(seen)) / count
        shift = np.hypot(x - u, y - v)[seen]
        self.motion = float(np.median(shift)) / width if shift.size else 1.0

    def weights(self, shape: tuple[int, int]) -> np.ndarray:
        """(H, W) float32, 1 where a pixel is static and seen."""
        fine = self.seen.astype(np.float32).repeat(self.cell, 0).repeat(self.cell, 1)
        return np.ascontiguousarray(fine[: shape[0], : shape[1]])


def spread_px(key: KeyFrame, covariance: np.ndarray) -> float:
    """How far a (6, 6) covariance of a motion lets the image of a key frame move, px.

    Root mean square over both axes, at the median depth.
    """
    camera, z = key.frame.camera, np.asarray(key.frame.depth)[::8, ::8]
    z = z[np.isfinite(z) & (z > 0)]
    depth = float(np.median(z)) if z.size else 1.0
    variance = np.trace(covariance[:3, :3]) / depth**2 + np.trace(covariance[3:, 3:])
    return float(0.5 * (camera.fx + camera.fy) * np.sqrt(max(variance, 0.0)))
