"""The arrays of a pair as the kernels take them: on a coarse grid, or all pixels in parallel."""

from __future__ import annotations

from copy import copy
from functools import reduce
from threading import Thread
from typing import Any

import cv2
import numpy as np

from hybridvo.numba_tools import as_contiguous
from hybridvo.options import RefineOptions
from hybridvo.refinement import kernels
from hybridvo.results import Reason, RelativePose
from hybridvo.types import FramePair

# share of the pixels asked for that must be usable, else it is drawn finer
MIN_USABLE = 0.05


class PixelGrid:
    """The arrays of a pair as the kernels take them, and every n-th pixel of both axes.

    ``size`` (H, W) of the image, ``shape`` (h, w, stride) and ``samples`` (rows, n) of the grid.
    """

    def __init__(
        self,
        pair: FramePair,
        weights: np.ndarray | None,
        pixels: int = RefineOptions.coarse_pixels,
    ) -> None:
        prev = pair.prev
        curr = pair.curr
        assert pair.flow is not None and prev.depth is not None
        self.size = prev.camera.shape
        ones = np.ones((1, self.size[1]), np.float32)  # a row for all
        variances = pair.flow_variance, prev.depth_variance
        maps = [
            as_contiguous(ones if image is None else image) for image in variances
        ]
        factors = [x for x in (weights, pair.flow_valid) if x is not None]
        external = reduce(
            np.multiply, [np.asarray(x, np.float32) for x in factors or [ones]]
        )
        data = prev.depth, pair.flow, *maps, external
        self.data: tuple[Any, ...] = tuple(map(as_contiguous, data))
        self.scale = np.array([typical(image) for image in variances], np.float32)
        a = prev.camera
        b = curr.camera
        self.camera = np.array([1 / a.fx, 1 / a.fy, a.cx, a.cy, 0, 1], np.float32)
        self.K = np.array([b.fx, b.fy, b.cx, b.cy], np.float32)
        self.samples, *self.shape = self.sampled(pixels)

    def sampled(self, pixels: int) -> tuple[np.ndarray, int, int, int]:
        """(buffer, h, w, stride) of a grid of about ``pixels`` pixels; finer if few are usable."""
        stride = grid_stride(self.size, pixels)
        while True:
            every = slice(stride // 2, None, stride)
            camera = self.camera.copy()
            camera[4:] = stride // 2, stride
            data = tuple(
                as_contiguous(x[min(stride // 2, len(x) - 1) :: stride, every])
                for x in self.data
            )
            buffer, (h, w) = (
                kernels.gather_all(data, camera, self.scale),
                data[0].shape,
            )
            usable = np.count_nonzero(buffer[kernels.W, : h * w] > 0)
            if usable >= MIN_USABLE * pixels or stride == 1:
                return buffer, h, w, stride
            stride //= 2

    def full_pass(
        self, pose: np.ndarray, noise: np.ndarray, tile: int, weights: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Sums of each tile (rows, columns, 27), cost and sums of weights (3,) at a pose."""
        bands, columns = (-(-n // tile) for n in self.size)
        sums = np.zeros((bands, columns, kernels.COST))
        totals = np.zeros((bands, kernels.SUMS))
        inputs: tuple[Any, ...] = (self.data, self.camera, self.scale)

        def work(first: int, last: int) -> None:
            some = np.array([first, last])
            kernels.sum_tiles(
                *inputs, pose, self.K, noise, some, tile, weights, sums, totals
            )

        # the kernel releases the GIL
        other = Thread(target=work, args=(0, bands // 2))
        other.start()
        work(bands // 2, bands)
        other.join()
        return sums, totals[:, kernels.COST :].sum(axis=0)

    @property
    def count(self) -> int:
        """Pixels of the grid."""
        return self.shape[0] * self.shape[1]

    @property
    def weight(self) -> np.ndarray:
        """(n,) external weight of each pixel; 0 where it cannot be used."""
        return self.samples[kernels.W, : self.count]

    @property
    def places(self) -> tuple[slice, slice]:
        """The grid's pixels of a whole image."""
        stride = self.shape[2]
        return (slice(stride // 2, None, stride),) * 2

    def within(self, mask: np.ndarray) -> PixelGrid:
        """The same grid with weights times a mask (h, w) of it, on every pixel as well."""
        (h, w, stride), (height, width), made = self.shape, self.size, copy(self)
        mask = np.ascontiguousarray(mask, np.float32)
        fine = cv2.resize(
            mask, (w * stride, h * stride), interpolation=cv2.INTER_LINEAR
        )
        missing = (0, max(0, height - h * stride)), (0, max(0, width - w * stride))
        fine = np.pad(fine, missing, mode="edge")[:height, :width]
        made.data = (*self.data[:4], as_contiguous(self.data[4] * fine))
        made.samples = self.samples.copy()
        made.weight[:] *= mask.reshape(-1)
        return made

    def resample(self, image: np.ndarray) -> np.ndarray:
        """(h, w) float32: a map over the whole image, of any resolution, at the grid's pixels."""
        v, u = (
            (np.arange(n)[at] + 0.5) * (m / n) - 0.5
            for n, m, at in zip(self.size, image.shape, self.places, strict=True)
        )
        u, v = np.meshgrid(u.astype(np.float32), v.astype(np.float32))
        source = np.ascontiguousarray(image, np.float32)
        return cv2.remap(
            source, u, v, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE
        )


def grid_stride(shape: tuple[int, int], pixels: int) -> int:
    """Distance, px, of the pixels of a grid of about ``pixels``."""
    return max(1, round(np.sqrt(shape[0] * shape[1] / pixels)))


def coarse_grid(
    pair: FramePair, weights: np.ndarray | None, options: RefineOptions
) -> PixelGrid | RelativePose:
    """The pixels of a pair, or the failure that says what is missing."""
    if pair.flow is None:
        return RelativePose.failed(
            Reason.NO_FLOW, "no optical flow for this pair", "classical"
        )
    if pair.prev.depth is None:
        return RelativePose.failed(
            Reason.NO_VALID_DEPTH, "no depth for this frame", "classical"
        )
    grid = PixelGrid(pair, weights, options.coarse_pixels)
    usable = int(np.count_nonzero(grid.weight > 0))
    if usable < options.min_pixels:
        why = too_few(pair.prev.depth, pair.flow, usable, options.min_pixels)
        return RelativePose.failed(*why, "classical")
    return grid


def too_few(
    depth: np.ndarray, flow: np.ndarray, count: int, minimum: int
) -> tuple[Reason, str]:
    """Reason and words for a pair with ``count`` usable pixels, fewer than the ``minimum``."""
    with np.errstate(invalid="ignore"):
        depths = int(
            np.count_nonzero(
                (depth > kernels.MIN_DEPTH) & (depth < kernels.MAX_VALUE)
            )
        )
        flows = int(
            np.count_nonzero((np.abs(flow) < kernels.MAX_VALUE).all(axis=2))
        )
    if depths < minimum:
        return (
            Reason.NO_VALID_DEPTH,
            f"{depths} pixels with valid depth, {minimum} needed",
        )
    if flows < minimum:
        return Reason.NO_FLOW, f"{flows} pixels with valid flow, {minimum} needed"
    return Reason.LOW_INLIERS, f"{count} usable pixels, {minimum} needed"


def typical(variance: np.ndarray | None) -> float:
    """Variance of the good pixels: the 20 % quantile of the positive finite values; 1 if none."""
    sparse = np.empty(0) if variance is None else variance[::7, ::7]
    good = sparse[(sparse > 0) & (sparse < kernels.MAX_VALUE)]
    return float(np.quantile(good, 0.2)) if good.size else 1.0
