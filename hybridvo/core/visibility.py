"""Where points of one frame lie before or behind what another frame measures."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from hybridvo.core.calibration import (
    DEPTH_NOISE_M,
    DEPTH_NOISE_PER_M,
    DEPTH_NOISE_SIGMAS,
    HIDDEN_SIGMAS,
)
from hybridvo.core.geometry import project
from hybridvo.core.types import Frame

# steps to the neighbours of a pixel along one axis, itself included
STEPS = np.array([-1, 0, 1])
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
    height, width = frame.camera.shape
    uv = np.nan_to_num(project(points, frame.camera), nan=-FAR_OUTSIDE)
    uv = np.clip(uv, -FAR_OUTSIDE, FAR_OUTSIDE).astype(np.float32)
    u, v = np.rint(uv).astype(np.int64).T
    inside = (u >= 0) & (u < width) & (v >= 0) & (v < height)
    if frame.depth is None:
        nothing = np.zeros(len(points))
        return Visibility(uv, inside, nothing.astype(bool), nothing)
    rows = np.clip(v + STEPS[:, None], 0, height - 1)
    columns = np.clip(u + STEPS[:, None], 0, width - 1)
    around = frame.depth[rows[:, None], columns[None]].reshape(-1, len(points))
    valid = (around > 0) & (around < np.inf)
    nearest = np.where(valid, around, np.inf).min(axis=0)
    farthest = np.where(valid, around, 0).max(axis=0)
    is_measured = inside & (farthest > 0)
    z = points[:, 2]
    sigma = depth_std(np.maximum(z, 0), log_noise)
    behind = np.maximum(z - farthest, 0)
    before = np.maximum(np.where(is_measured, nearest, 0) - z, 0)
    with np.errstate(divide="ignore", invalid="ignore"):
        distance = (behind - before) / sigma
    return Visibility(uv, inside, is_measured, np.where(is_measured, distance, 0.0))


def depth_std(z: np.ndarray, log_noise: float) -> np.ndarray:
    """Standard deviation (N,), metres, of a difference of two depths (N,) of one surface."""
    least = DEPTH_NOISE_M * z + DEPTH_NOISE_PER_M * z * z
    return np.maximum(least, DEPTH_NOISE_SIGMAS * log_noise * z)
