"""Where points of one frame lie before or behind what another frame measures."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from hybridvo.compiled.numba_tools import as_contiguous, njit
from hybridvo.core.geometry import project
from hybridvo.core.types import Frame
from hybridvo.solver.calibration import (
    DEPTH_NOISE_M,
    DEPTH_NOISE_PER_M,
    DEPTH_NOISE_SIGMAS,
    HIDDEN_SIGMAS,
)

# px; where a point is that is behind the camera
FAR_OUTSIDE = 1e6


class Visibility(NamedTuple):
    """What a frame measures where points (N,) fall into its image.

    Attributes:
        uv: (N, 2) float32 px; far outside where a point is behind the camera.
        inside: whether a point falls into the image.
        is_measured: whether depth was measured there.
        distance: by how much a point lies behind (positive) or before what is measured there,
            in standard deviations; 0 within the depths of 3x3 pixels, and where none is.
    """

    uv: np.ndarray
    inside: np.ndarray
    is_measured: np.ndarray
    distance: np.ndarray

    @property
    def is_hidden(self) -> np.ndarray:
        """(N,) whether something nearer is measured."""
        return np.asarray(self.distance > HIDDEN_SIGMAS)


def visibility(points: np.ndarray, frame: Frame, log_noise: float) -> Visibility:
    """Compare points (N, 3) with what a frame measures.

    Args:
        points: metres, in the camera of the frame.
        frame: with depth, or without: then nothing is measured.
        log_noise: standard deviation of log depth.
    """
    uv = np.nan_to_num(project(points, frame.camera), nan=-FAR_OUTSIDE)
    uv = np.clip(uv, -FAR_OUTSIDE, FAR_OUTSIDE).astype(np.float32)
    height, width = frame.camera.shape
    u, v = np.rint(uv).astype(np.int64).T
    inside = (u >= 0) & (u < width) & (v >= 0) & (v < height)
    if frame.depth is None:
        nothing = np.zeros(len(points))
        return Visibility(uv, inside, nothing.astype(bool), nothing)
    nearest, farthest = depths_around(as_contiguous(frame.depth), u, v)
    is_measured = inside & (farthest > 0)
    z = points[:, 2]
    sigma = depth_std(np.maximum(z, 0), log_noise)
    behind = np.maximum(z - farthest, 0)
    before = np.maximum(np.where(is_measured, nearest, 0) - z, 0)
    with np.errstate(divide="ignore", invalid="ignore"):
        distance = (behind - before) / sigma
    return Visibility(uv, inside, is_measured, np.where(is_measured, distance, 0.0))


@njit(error_model="numpy", cache=True, nogil=True)
def depths_around(depth, u, v):
    """Return the least and the largest depth (N,) around pixels, metres.

    Args:
        depth: (H, W) float32 metres.
        u: (N,) columns of the pixels; those outside count as at the border.
        v: (N,) their rows.

    Returns:
        Of the 3x3 pixels around each; infinity and 0 where none has depth.
    """
    height, width = depth.shape
    nearest = np.full(len(u), np.inf)
    farthest = np.zeros(len(u))
    for k in range(len(u)):
        for i in range(v[k] - 1, v[k] + 2):
            row = min(max(i, 0), height - 1)
            for j in range(u[k] - 1, u[k] + 2):
                z = depth[row, min(max(j, 0), width - 1)]
                if z > 0 and z < np.inf:
                    nearest[k] = min(nearest[k], z)
                    farthest[k] = max(farthest[k], z)
    return nearest, farthest


def depth_std(z: np.ndarray, log_noise: float) -> np.ndarray:
    """Standard deviation (N,), metres, of a difference of two depths (N,) of one surface."""
    least = DEPTH_NOISE_M * z + DEPTH_NOISE_PER_M * z * z
    return np.maximum(least, DEPTH_NOISE_SIGMAS * log_noise * z)
