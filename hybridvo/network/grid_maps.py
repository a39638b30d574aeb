"""The pixels of a pair as images on the grid of the search: what PWVO looks at."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np

from hybridvo.compiled.numba_tools import as_contiguous
from hybridvo.core.types import Frame, FramePair
from hybridvo.flow.frame_images import grey_bytes
from hybridvo.hypotheses.types import HypothesisSet
from hybridvo.solver import kernels
from hybridvo.solver.depths import look_up
from hybridvo.solver.pixels import PixelGrid

# numerical guard: relative information whose inverse is still finite
MIN_INFORMATION = np.float32(1e-6)


@dataclass(frozen=True, eq=False)
class GridMaps:
    """Properties of each pixel of a grid (h, w); arrays, or tensors of a batch.

    Attributes:
        ray: (2, h, w) first two components of K^-1 x, previous camera.
        depth: (h, w) metres, previous frame.
        target: (2, h, w) px, x + flow in the current image.
        flow_variance: (h, w) relative to the typical one.
        depth_variance: (h, w) relative to the typical one.
        usable: (h, w) bool, flow and depth are known.
        log_depth_at_target: (h, w) log metres of the current frame at the target; NaN where it is
            unknown, and at edges of depth.
        K: (4,) fx, fy, cx, cy of the current camera, px.
        width: px, of the image.
        stride: px between neighbours of the grid.
        has_depth: (h, w) bool, the previous depth is known, with or without flow.
        image_prev: (h, w) grey levels of the previous frame; 0 unless both frames have an image.
        image_curr: (h, w) grey levels of the current frame, on its own grid.
        log_depth_curr: (h, w) log metres of the current frame, on its own grid.
    """

    ray: Any
    depth: Any
    target: Any
    flow_variance: Any
    depth_variance: Any
    usable: Any
    log_depth_at_target: Any
    K: Any
    width: Any
    stride: Any
    has_depth: Any
    image_prev: Any
    image_curr: Any
    log_depth_curr: Any


def grid_maps(found: HypothesisSet) -> GridMaps:
    """Collect the maps of a pair on the grid of its search."""
    grid = found.grid
    pair = found.pair
    h, w, stride = grid.shape
    image_prev, image_curr = _images(pair, grid)
    rows = grid.samples[:, : grid.count].reshape(-1, h, w)
    information = np.maximum(rows[kernels.PF], MIN_INFORMATION)
    return GridMaps(
        ray=rows[[kernels.XN, kernels.YN]],
        depth=rows[kernels.Z],
        target=rows[[kernels.MU, kernels.MV]],
        flow_variance=1.0 / information,
        depth_variance=rows[kernels.PD],
        usable=rows[kernels.W] > 0,
        log_depth_at_target=_log_depth_at_target(pair, grid),
        K=grid.K,
        width=pair.prev.camera.width,
        stride=stride,
        has_depth=np.isfinite(_log_depth(pair.prev, grid)),
        image_prev=image_prev,
        image_curr=image_curr,
        log_depth_curr=_log_depth(pair.curr, grid),
    )


def _log_depth_at_target(pair: FramePair, grid: PixelGrid) -> np.ndarray:
    """(h, w) float32 log of the current depth at the flow targets; NaN where unknown."""
    if pair.curr.depth is None:
        return np.full(grid.shape[:2], np.nan, np.float32)
    depth = as_contiguous(pair.curr.depth)
    log_depth = look_up(grid.samples, grid.count, depth)
    return log_depth.reshape(grid.shape[:2])


def _images(pair: FramePair, grid: PixelGrid) -> tuple[np.ndarray, np.ndarray]:
    """Grey levels (h, w) of both frames; 0 unless both have an image."""
    if not pair.has_images:
        nothing = np.zeros(grid.shape[:2], np.float32)
        return nothing, nothing
    return _grey(pair.prev, grid), _grey(pair.curr, grid)


def _grey(frame: Frame, grid: PixelGrid) -> np.ndarray:
    """(h, w) float32 grey levels, each the mean of the cell around the grid's pixel."""
    stride = grid.shape[2]
    mean = cv2.blur(grey_bytes(frame), (stride, stride))
    return mean[grid.places].astype(np.float32)


def _log_depth(frame: Frame, grid: PixelGrid) -> np.ndarray:
    """(h, w) float32 log metres at the grid's pixels; NaN where unknown."""
    if frame.depth is None:
        return np.full(grid.shape[:2], np.nan, np.float32)
    depth = frame.depth[grid.places]
    is_known = (depth > kernels.MIN_DEPTH) & (depth < kernels.MAX_VALUE)
    return np.log(np.where(is_known, depth, np.float32(np.nan)))
