"""The arrays of a pair as the kernels take them: on a coarse grid, or all pixels in two threads."""

from __future__ import annotations

from copy import copy
from functools import reduce
from typing import NamedTuple

import cv2
import numpy as np

from hybridvo.compiled.numba_tools import as_contiguous, in_two_threads
from hybridvo.core.options import RefineOptions
from hybridvo.core.results import Reason, StageFailed
from hybridvo.core.types import FramePair
from hybridvo.solver import kernels
from hybridvo.solver.kernels import (
    GridCamera,
    PixelMaps,
    PixelSource,
    ResidualNoise,
    TileSums,
    TypicalVariance,
)

# Quantile of the variances of an image that is their unit, the typical variance.
TYPICAL_QUANTILE = 0.2
# Fraction of a grid's pixels that must be usable; with fewer the grid is made finer.
MIN_USABLE_RATIO = 0.05

# The typical variance is a quantile of every n-th pixel's, in both directions.
TYPICAL_STRIDE = 7


class GridShape(NamedTuple):
    """A grid of pixels in an image."""

    rows: int
    columns: int
    stride: int  # px between neighbours


class PixelGrid:
    """The arrays of a pair as the kernels take them, and a coarse grid of its pixels.

    Attributes:
        size: (H, W) of the image.
        K: (4,) float32 fx, fy, cx, cy of the current camera, px.
        scale: typical variances, which the pixels' own are relative to.
        samples: pixel buffer (BUFFER_ROWS, n or more) of the grid.
        shape: of the grid.
    """

    def __init__(
        self,
        pair: FramePair,
        weights: np.ndarray | None,
        pixels: int = RefineOptions.coarse_pixels,
    ) -> None:
        """Prepare a pair that has flow and depth.

        Args:
            pair: the pair.
            weights: (H, W) factors on the information of each pixel, or None.
            pixels: number of pixels of the grid, about.
        """
        prev = pair.prev.camera
        curr = pair.curr.camera
        self.size = prev.shape
        self.scale = TypicalVariance(
            np.float32(typical(pair.flow_variance)),
            np.float32(typical(pair.prev.depth_variance)),
        )
        self._maps = _pixel_maps(pair, weights)
        self._camera = GridCamera(
            np.float32(1 / prev.fx),
            np.float32(1 / prev.fy),
            np.float32(prev.cx),
            np.float32(prev.cy),
            first=np.float32(0),
            stride=np.float32(1),
        )
        self.K = np.array([curr.fx, curr.fy, curr.cx, curr.cy], np.float32)
        self.samples, self.shape = self.sampled(pixels)

    def sampled(self, pixels: int) -> tuple[np.ndarray, GridShape]:
        """Return a grid of about ``pixels`` pixels, made finer where few of them are usable.

        Returns:
            A pixel buffer (BUFFER_ROWS, n or more), and the grid that it was filled from.
        """
        stride = grid_stride(self.size, pixels)
        while True:
            samples, shape = self._sample(stride)
            count = shape.rows * shape.columns
            usable = np.count_nonzero(samples[kernels.W, :count] > 0)
            if usable >= MIN_USABLE_RATIO * pixels or stride == 1:
                return samples, shape
            stride //= 2

    def _sample(self, stride: int) -> tuple[np.ndarray, GridShape]:
        """Return every ``stride``-th pixel in both directions."""
        first = stride // 2
        every = slice(first, None, stride)
        maps = PixelMaps._make(
            # a map of one row holds for all rows
            as_contiguous(x[min(first, len(x) - 1) :: stride, every])
            for x in self._maps
        )
        camera = self._camera._replace(
            first=np.float32(first), stride=np.float32(stride)
        )
        buffer = kernels.gather_all(PixelSource(maps, camera, self.scale))
        rows, columns = maps.depth.shape[:2]
        return buffer, GridShape(rows, columns, stride)

    def full_pass(
        self, pose: np.ndarray, noise: ResidualNoise, tile: int
    ) -> TileSums:
        """Sum the normal equations of all pixels.

        Args:
            pose: (3, 4) T_curr_prev.
            noise: noise and robust kernel.
            tile: side of a tile, px.
        """
        height, width = self.size
        rows = -(-height // tile)
        columns = -(-width // tile)
        out = TileSums(
            tiles=np.zeros((rows, columns, kernels.COST)),
            totals=np.zeros((rows, kernels.SUMS)),
            robust=np.empty(self.size, np.float32),
        )
        source = PixelSource(self._maps, self._camera, self.scale)

        def work(first: int, last: int) -> None:
            kernels.sum_tiles(source, pose, self.K, noise, first, last, tile, out)

        in_two_threads(work, rows)
        return out

    @property
    def count(self) -> int:
        """Number of pixels of the grid."""
        return self.shape.rows * self.shape.columns

    @property
    def weight(self) -> np.ndarray:
        """External weight (n,) of each pixel of the grid; 0 where it cannot be used."""
        return self.samples[kernels.W, : self.count]

    @property
    def places(self) -> tuple[slice, slice]:
        """Index of the grid's pixels in an image (H, W)."""
        stride = self.shape.stride
        return (slice(stride // 2, None, stride),) * 2

    def within(self, mask: np.ndarray) -> PixelGrid:
        """Return the same grid with weights times a mask (h, w), interpolated to all pixels."""
        height, width = self.size
        rows, columns, stride = self.shape
        mask = np.ascontiguousarray(mask, np.float32)
        fine = cv2.resize(
            mask, (columns * stride, rows * stride), interpolation=cv2.INTER_LINEAR
        )
        missing_rows = max(0, height - rows * stride)
        missing_columns = max(0, width - columns * stride)
        fine = np.pad(fine, ((0, missing_rows), (0, missing_columns)), mode="edge")
        weights = self._maps.weights * fine[:height, :width]

        grid = copy(self)
        grid._maps = self._maps._replace(weights=as_contiguous(weights))
        grid.samples = self.samples.copy()
        grid.weight[:] *= mask.reshape(-1)
        return grid


def _pixel_maps(pair: FramePair, weights: np.ndarray | None) -> PixelMaps:
    """Return the maps of a pair; what it does not state is one row of ones."""
    assert pair.flow is not None and pair.prev.depth is not None
    ones = np.ones((1, pair.prev.camera.width), np.float32)
    flow_variance = ones if pair.flow_variance is None else pair.flow_variance
    depth_variance = pair.prev.depth_variance
    if depth_variance is None:
        depth_variance = ones
    factors = [
        np.asarray(x, np.float32)
        for x in (weights, pair.flow_valid)
        if x is not None
    ]
    return PixelMaps(
        as_contiguous(pair.prev.depth),
        as_contiguous(pair.flow),
        as_contiguous(flow_variance),
        as_contiguous(depth_variance),
        as_contiguous(reduce(np.multiply, factors or [ones])),
    )


def grid_stride(shape: tuple[int, int], pixels: int) -> int:
    """Return the distance, px, between pixels of a grid of about ``pixels`` in an image (H, W)."""
    return max(1, round(np.sqrt(shape[0] * shape[1] / pixels)))


def coarse_grid(
    pair: FramePair, weights: np.ndarray | None, options: RefineOptions
) -> PixelGrid:
    """Return the pixels of a pair.

    Args:
        pair: the pair.
        weights: (H, W) factors on the information of each pixel, or None.
        options: size of the grid, and the smallest number of usable pixels.

    Raises:
        StageFailed: The pair has no flow, no depth, or too few usable pixels.
    """
    if pair.flow is None:
        raise StageFailed(Reason.NO_FLOW, "no optical flow for this pair")
    if pair.prev.depth is None:
        raise StageFailed(Reason.NO_VALID_DEPTH, "no depth for this frame")
    grid = PixelGrid(pair, weights, options.coarse_pixels)
    usable = int(np.count_nonzero(grid.weight > 0))
    if usable < options.min_pixels:
        reason, message = too_few(
            pair.prev.depth, pair.flow, usable, options.min_pixels
        )
        raise StageFailed(reason, message)
    return grid


def too_few(
    depth: np.ndarray, flow: np.ndarray, count: int, minimum: int
) -> tuple[Reason, str]:
    """Return why only ``count`` pixels of a pair are usable, fewer than the ``minimum``.

    Args:
        depth: (H, W) metres.
        flow: (H, W, 2) px.
        count: usable pixels.
        minimum: number needed.
    """
    with np.errstate(invalid="ignore"):
        valid_depth = (depth > kernels.MIN_DEPTH) & (depth < kernels.MAX_VALUE)
        valid_flow = (np.abs(flow) < kernels.MAX_VALUE).all(axis=2)
    depths = int(np.count_nonzero(valid_depth))
    flows = int(np.count_nonzero(valid_flow))
    if depths < minimum:
        text = f"{depths} pixels with valid depth, {minimum} needed"
        return Reason.NO_VALID_DEPTH, text
    if flows < minimum:
        return Reason.NO_FLOW, f"{flows} pixels with valid flow, {minimum} needed"
    return Reason.LOW_INLIERS, f"{count} usable pixels, {minimum} needed"


def typical(variance: np.ndarray | None) -> float:
    """Return the variance of good pixels, a low quantile of the valid values; 1 if there are none.

    Args:
        variance: (H, W), or None.
    """
    if variance is None:
        return 1.0
    sparse = variance[::TYPICAL_STRIDE, ::TYPICAL_STRIDE]
    valid = sparse[(sparse > 0) & (sparse < kernels.MAX_VALUE)]
    return float(np.quantile(valid, TYPICAL_QUANTILE)) if valid.size else 1.0
