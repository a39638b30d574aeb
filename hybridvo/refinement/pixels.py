"""The arrays of a pair as the kernels take them, and the passes over the full grid."""

from __future__ import annotations

import itertools
import threading
from collections.abc import Callable
from typing import Any

import numpy as np

from hybridvo.refinement import kernels
from hybridvo.types import Camera, FramePair

PARALLEL_PIXELS = 100_000
"""Below this many pixels one thread is as fast, and steadier under load."""


class Picture:
    """The arrays of a pair as the kernels take them; may be cropped to the usable ones."""

    def __init__(self, pair: FramePair, weights: np.ndarray | None) -> None:
        prev, curr = pair.prev, pair.curr
        assert pair.flow is not None and prev.depth is not None
        flags = 0
        dummy = as_given(np.ones((1, 1), np.float32))
        depth = as_given(prev.depth)
        flow = as_given(pair.flow)
        flow_variance = depth_variance = external = dummy
        scale = np.ones(2, np.float32)
        if pair.flow_variance is not None:
            flow_variance = as_given(pair.flow_variance)
            flags |= kernels.HAS_FLOW_VARIANCE
            scale[0] = typical(flow_variance)
        if prev.depth_variance is not None:
            depth_variance = as_given(prev.depth_variance)
            flags |= kernels.HAS_DEPTH_VARIANCE
            scale[1] = typical(depth_variance)
        if weights is not None:
            external = as_given(weights, np.float32)
            flags |= kernels.HAS_WEIGHTS
        valid = as_given(np.ones((1, 1), np.bool_))
        masks = [m for m in (prev.mask, pair.flow_valid) if m is not None]
        if masks:
            valid = as_given(masks[0] if len(masks) == 1 else masks[0] & masks[1])
            flags |= kernels.HAS_VALID
        self.data: tuple[Any, ...] = (depth, flow, flow_variance, depth_variance, external, valid)
        self.flags, self.scale = flags, scale
        self.set_cameras(prev.camera, curr.camera, 0, 0)

    def set_cameras(self, prev: Camera, curr: Camera, u0: int, v0: int) -> None:
        """Intrinsics for a crop whose top-left pixel is (u0, v0)."""
        self.origin = (u0, v0)
        self.camera = np.array([1 / prev.fx, 1 / prev.fy, prev.cx - u0, prev.cy - v0], np.float32)
        self.K = np.array([curr.fx, curr.fy, curr.cx - u0, curr.cy - v0], np.float32)

    def crop(self, prev: Camera, curr: Camera, box: tuple[int, int, int, int]) -> None:
        """Restrict to rows v0..v1-1 and columns u0..u1-1."""
        v0, v1, u0, u1 = box
        self.data = tuple(
            as_given(a[v0:v1, u0:u1]) if a.shape[:2] != (1, 1) else a for a in self.data
        )
        self.set_cameras(prev, curr, u0, v0)

    @property
    def shape(self) -> tuple[int, int]:
        """(height, width)."""
        return self.data[0].shape

    def samples(self, pixels: int) -> tuple[np.ndarray, int, int, int]:
        """(buffer, h, w, stride) of a regular grid of about ``pixels`` pixels."""
        height, width = self.shape
        stride = max(1, round(np.sqrt(height * width / pixels)))
        return *self.strided(stride), stride

    def strided(self, stride: int) -> tuple[np.ndarray, int, int]:
        """(buffer, h, w) of every ``stride``-th pixel of both axes."""
        height, width = self.shape
        h = (height - stride // 2 + stride - 1) // stride
        w = (width - stride // 2 + stride - 1) // stride
        # an odd number of cache lines keeps the rows out of each other's cache sets
        buffer = np.empty((kernels.BUFFER_ROWS, ((h * w + 15) // 16 | 1) * 16), np.float32)
        kernels.gather_grid(stride, self.data, self.camera, self.flags, self.scale, buffer)
        return buffer, h, w

    def usable_box(self) -> tuple[int, tuple[int, int, int, int]]:
        """(number of usable pixels, their bounding box) of the full grid."""
        depth, flow, flow_variance, depth_variance, weights, valid = self.data
        with np.errstate(invalid="ignore"):
            usable = (depth > kernels.MIN_DEPTH) & (depth < kernels.MAX_VALUE)
            usable &= (np.abs(flow) < kernels.MAX_VALUE).all(axis=2)
            if self.flags & kernels.HAS_FLOW_VARIANCE:
                usable &= (flow_variance > 0) & (flow_variance < kernels.MAX_VALUE)
            if self.flags & kernels.HAS_DEPTH_VARIANCE:
                usable &= (depth_variance >= 0) & (depth_variance < kernels.MAX_VALUE)
            if self.flags & kernels.HAS_WEIGHTS:
                usable &= (weights > 0) & (weights < kernels.MAX_VALUE)
        if self.flags & kernels.HAS_VALID:
            usable &= valid
        count = int(np.count_nonzero(usable))
        if count == 0:
            return 0, (0, 0, 0, 0)
        rows = np.flatnonzero(usable.any(axis=1))
        columns = np.flatnonzero(usable.any(axis=0))
        return count, (rows[0], rows[-1] + 1, columns[0], columns[-1] + 1)

    def full_pass(
        self, pose: np.ndarray, noise: np.ndarray, tile: int
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Normal equations over every pixel at a (3, 4) pose.

        Returns:
            Sums of each tile (rows, columns, 27), cost and the two sums of weights (3,), robust
            weights (H, W).
        """
        R, t = pose[:, :3].astype(np.float32), pose[:, 3].astype(np.float32)
        height, width = self.shape
        bands = -(-height // tile)
        sums = np.zeros((bands, -(-width // tile), kernels.COST))
        totals = np.zeros((bands, kernels.SUMS))
        weights = np.empty((height, width), np.float32)

        arguments: tuple[Any, ...] = (self.data, self.camera, self.flags, self.scale)

        def work(band: int) -> None:
            kernels.sum_tiles(
                *arguments, R, t, self.K, noise, band, tile, weights, sums, totals[band]
            )

        self._run(work, bands)
        return sums, totals[:, kernels.COST :].sum(axis=0), weights

    def _run(self, work: Callable[[int], None], count: int) -> None:
        """Do ``work(0) .. work(count - 1)`` on two threads where the picture is large.

        Plain threads over kernels that release the GIL: each band has its own sum, so the result
        does not depend on who did what, several trackers may run at once, and on a busy machine
        the calling thread does what the other one does not get to. (numba's own parallel loops
        wait for every thread, and one of its backends aborts when two threads enter it.)
        """
        height, width = self.shape
        todo = itertools.count()

        def take() -> None:
            while (band := next(todo)) < count:
                work(band)

        if height * width < PARALLEL_PIXELS:
            take()
            return
        helper = threading.Thread(target=take)
        helper.start()
        take()
        helper.join()


def as_given(array: np.ndarray, dtype: Any = None) -> np.ndarray:
    """Contiguous view that cannot be written to, whatever the array allows.

    Numba compiles a kernel anew for an array that is read-only (a frame out of a buffer, of a file
    that was mapped) or not aligned: seconds, in the middle of a walk. So all look the same to it.
    """
    view = np.require(array, dtype, ["C", "A"]).view()
    view.flags.writeable = False
    return view


def typical(variance: np.ndarray) -> float:
    """Variance of the good pixels: the 20 % quantile of the positive finite values; 1 if none.

    The noise that a motion may claim is bounded in units of it, and the good pixels tell the
    motions apart.
    """
    sparse = variance[::7, ::7]
    good = sparse[(sparse > 0) & (sparse < kernels.MAX_VALUE)]
    return float(np.quantile(good, 0.2)) if good.size else 1.0
