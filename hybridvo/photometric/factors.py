"""The images of a pair, and its two depth maps, as factors of its motion.

Images: the residual of a weighted static pixel is ``I_curr(pi(T X)) - gain I_prev - offset``. Depth
maps: ``r = n . (T X - P)``, P and n point and normal of the current one where T X is
seen. Both estimate their noise from the residuals, and count errors that neighbours share.
"""

from __future__ import annotations

from weakref import WeakKeyDictionary

import cv2
import numpy as np
from scipy.optimize import nnls

from hybridvo.calibration import EVEN_PARTS
from hybridvo.geometry import backproject
from hybridvo.numba_tools import as_contiguous
from hybridvo.photometric import kernels
from hybridvo.refinement.kernels import MAX_VALUE
from hybridvo.refinement.pixels import typical
from hybridvo.refinement.solver import positive_inverse, tile_size
from hybridvo.results import RelativePose
from hybridvo.types import Frame, FramePair

# mid grey makes gain and offset independent
GREY = np.array([[0.299, 0.587, 0.114, -128.0]])
BLUR = 1.0  # standard deviation, px
# grey levels: rounding to 8 bits leaves 0.08 after the finest blur
NOISE_FLOOR = 0.1
# compared: a lens errs by quadrant, a rolling shutter by row
PARTS = ((2, 2), (4, 1))
# of a depth map, on a regular grid: at most, and at least
POINTS = 5000
MIN_POINTS = 300
CUTOFF = float(np.sqrt(kernels.CUTOFF2))
# factor on the covariance of both: errors are alike far beyond the tiles
INFLATION = 4.0


_IMAGES: WeakKeyDictionary[Frame, np.ndarray] = WeakKeyDictionary()
"""Blurred images, as long as the frame is kept."""


def blurred(frame: Frame) -> np.ndarray:
    """(H, W) float32 grey values less mid grey, under a Gaussian blur."""
    if frame not in _IMAGES:
        # not rounded: 8 bits of grey would add as much noise as the camera's own rounding
        grey = cv2.transform(
            np.ascontiguousarray(frame.rgb).astype(np.float32), GREY
        )
        _IMAGES[frame] = cv2.GaussianBlur(grey, (0, 0), BLUR)
    return _IMAGES[frame]


class Tiles:
    """The tiles of an image (H, W) that pixels (N, 2), rows and columns, lie in."""

    def __init__(self, shape: tuple[int, int], index: np.ndarray) -> None:
        size = tile_size(shape)
        self.shape = -(-shape[0] // size), -(-shape[1] // size)
        self._number = index[:, 0] // size * self.shape[1] + index[:, 1] // size

    def sums(self, scores: np.ndarray) -> np.ndarray:
        """(rows, columns, M) sums of (M, N) scores over each."""
        count = self.shape[0] * self.shape[1]
        sums = [np.bincount(self._number, row, count) for row in scores]
        return np.stack(sums, axis=1).reshape(*self.shape, -1)


def spread(lengths: np.ndarray) -> float:
    """Standard deviation of normal numbers of these lengths, from the upper median."""
    half = len(lengths) // 2
    return 1.4826 * float(np.partition(lengths, half)[half])


def products(J: np.ndarray, w: np.ndarray) -> np.ndarray:
    """(M, M) sums of the weighted products of the rows of J (M, N)."""
    sums = np.zeros((len(J), len(J)))
    kernels.add_products(J, w, 1.0, sums)
    return sums


def independent_share(
    sums: np.ndarray, meat: np.ndarray, model: np.ndarray
) -> float:
    """Share of the information (``meat``) that errors alike in a tile, and beyond, leave; or 0."""
    independent = positive_inverse(meat)
    sums = sums.reshape(-1, 6)
    if independent is None:
        return 0.0
    clusters = max(1.0, np.trace(independent @ sums.T @ sums) / 6)
    return float(1 / (INFLATION * max(1.0, clusters * np.trace(model @ meat) / 6)))


class ImageFactor:
    """The images of a pair at pixels (N, 2) of a weighted pose, from its motion on."""

    def __init__(
        self, pair: FramePair, pose: RelativePose, index: np.ndarray
    ) -> None:
        prev = pair.prev.camera
        curr = pair.curr.camera
        n = len(index)
        rows, columns = index.T
        buffer = np.ones((kernels.BUFFER_ROWS, n), np.float32)
        buffer[kernels.XN] = (columns - prev.cx) / prev.fx
        buffer[kernels.YN] = (rows - prev.cy) / prev.fy
        buffer[kernels.Z] = np.asarray(pair.prev.depth)[rows, columns]
        buffer[kernels.W] = np.minimum(np.asarray(pose.weights)[rows, columns], 1.0)
        if pair.prev.depth_variance is not None:
            variance = pair.prev.depth_variance[rows, columns]
            good = (variance >= 0) & (variance < MAX_VALUE)
            buffer[kernels.PD, good] = variance[good] / typical(
                pair.prev.depth_variance
            )
            buffer[kernels.W, ~good] = 0.0
        grey = blurred(pair.prev)
        buffer[kernels.GX] = 0.5 * (
            grey[rows, columns + 1] - grey[rows, columns - 1]
        )
        buffer[kernels.GY] = 0.5 * (
            grey[rows + 1, columns] - grey[rows - 1, columns]
        )
        buffer[kernels.GREY] = grey[rows, columns]
        self._buffer = buffer
        self._curr = blurred(pair.curr)
        self._camera = np.array(
            [curr.fx, curr.fy, curr.cx, curr.cy, 1 / prev.fx, 1 / prev.fy],
            np.float32,
        )
        self._J = np.empty((kernels.IMAGE_ROWS, n), np.float32)
        self._w = np.empty(n, np.float32)
        # gain, of the current image over the previous, offset
        self.light = np.array([1.0, 0.0])
        self._tiles = Tiles(prev.shape, index)
        self._scale = 1.0 / INFLATION
        # standard deviations: of the residual, grey levels; of the typical log depth
        self._noise = np.array([NOISE_FLOOR, pose.depth_noise], np.float32)
        self.agreement = 1.0  # by how much the parts of the image lowered it
        self._see(pose.T_curr_prev)
        # the noise under the light just found follows
        self._estimate_gain_and_noise()
        self.estimate(pose.T_curr_prev)

    @property
    def known(self) -> tuple:
        """What :func:`kernels.align` takes of the images."""
        noise = self._noise, self._J, self._w, self._scale
        return self._buffer, self._curr, self._camera, *noise

    @property
    def noise(self) -> float:
        """Standard deviation of the residual where it was last estimated, grey levels."""
        return float(self._noise[0])

    @property
    def seen(self) -> float:
        """Share of the weight that falls inside the current image."""
        weight = self._buffer[kernels.W]
        return float(weight[self._w > 0].sum() / max(weight.sum(), 1e-12))

    def estimate(self, T: np.ndarray) -> None:
        """Estimate light, noise and the scale of the information at a motion."""
        self._see(T)
        self._scale_information(self._estimate_gain_and_noise())

    def follow(
        self,
        planes: PlaneFactor,
        prior: tuple[np.ndarray, np.ndarray],
        T: np.ndarray,
        steps: int,
    ) -> np.ndarray:
        """The motion after at most so many steps from one; ``prior``: its inverse, information."""
        T, self.light = kernels.align(
            self.known, planes.known, prior, T, self.light, steps
        )
        return T

    def _scale_information(self, sums: np.ndarray) -> None:
        """By how much errors that pixels share lower the information of these products."""
        covariance = positive_inverse(sums[1:, 1:])
        self._scale = 0.0
        H = None if covariance is None else positive_inverse(covariance[:6, :6])
        self.information = np.zeros((6, 6))
        if covariance is None or H is None:
            return
        J = self._J[kernels.MOTION : kernels.TERMS]
        # as at the optimum of the images alone, to first order: the flow pulls away from it
        step = (covariance @ sums[1:, kernels.R]).astype(np.float32)
        pull = self._w * (self._J[kernels.R] - step @ J)
        scores = covariance[:6].astype(np.float32) @ (J * pull)
        sums = self._tiles.sums(scores)
        share = independent_share(sums, scores @ scores.T, H)
        if share > 0:
            parts = share * parts_dispersion(sums, H)
            # what the parts disagree about is seen; as much again is common to them and is not
            self.agreement = min(1.0, (EVEN_PARTS / max(parts, EVEN_PARTS)) ** 2)
            self._scale = share * self.agreement
            self.information = self._scale * H

    def correlation(self) -> float:
        """Weighted correlation of the two images over the pixels seen; 0 if one is constant."""
        used = self._w > 0
        a = self._buffer[kernels.GREY][used]
        weight = self._buffer[kernels.W][used]
        b = self._J[kernels.R][used] + self.light[0] * a + self.light[1]
        a, b = (x - weight @ x / max(weight.sum(), 1e-12) for x in (a, b))
        power = float(weight @ (a * a)) * float(weight @ (b * b))
        return float(weight @ (a * b)) / np.sqrt(power) if power > 0 else 0.0

    def _see(self, T: np.ndarray) -> None:
        kernels.image_rows(
            self._buffer, self._curr, self._camera, T, self.light, self._J
        )

    def _estimate_gain_and_noise(self) -> np.ndarray:
        """Noise where the pixels were last seen, and the light under it; the products."""
        J = self._J
        light = np.s_[kernels.GAIN : kernels.TERMS]
        lengths = np.abs(J[kernels.R][J[kernels.U] > 0])
        if len(lengths):
            self._noise[0] = max(spread(lengths), NOISE_FLOOR)
        kernels.weigh_pixels(self._buffer, self._noise, J, self._w)
        sums = products(J[: kernels.TERMS], self._w)
        before = self.light
        # a light that nothing tells stays
        ridge = np.diag(1e-9 * np.diag(sums)[light] + 1e-12)
        self.light = before - np.linalg.solve(
            sums[light, light] + ridge, sums[light, kernels.R]
        )
        self.light[0] = np.clip(self.light[0], kernels.MIN_GAIN, kernels.MAX_GAIN)
        more = self.light - before
        J[kernels.R] += more.astype(np.float32) @ J[light]
        sums[:, kernels.R] += sums[:, light] @ more
        sums[kernels.R] += more @ sums[light]
        return sums


def parts_dispersion(scores: np.ndarray, model: np.ndarray) -> float:
    """Dispersion of the scores (rows, columns, 6) of tiles, summed over each of :data:`PARTS`."""
    found = []
    for shape in PARTS:
        sums = np.zeros((*shape, 6))
        sizes = zip(scores.shape[:2], shape, strict=True)
        np.add.at(sums, np.ix_(*(np.arange(n) * k // n for n, k in sizes)), scores)
        count = shape[0] * shape[1]
        found.append(
            np.einsum("rcp,pq,rcq->", sums, model, sums) / 6 * count / (count - 1)
        )
    return float(np.mean(found))


class PlaneFactor:
    """A static point of the previous depth map, moved by T, lies on the current one's surface.

    The noise is ``sigma = a + b z + c z^2``, fitted to the residuals of the pair. Used are pixels
    of at least the weight ``least`` on a regular grid of at most ``points``.
    """

    def __init__(
        self,
        pair: FramePair,
        weights: np.ndarray,
        least: float,
        points: int = POINTS,
    ) -> None:
        (height, width), curr = pair.prev.camera.shape, pair.curr.camera
        self._shape = (height, width)
        step = max(1, round(np.sqrt(height * width / points)))
        rows, columns = np.mgrid[
            step // 2 : height : step, step // 2 : width : step
        ]
        z = np.asarray(pair.prev.depth)[rows, columns]
        weight = np.asarray(weights)[rows, columns]
        used = (z > 0) & np.isfinite(z) & (weight >= least)
        # rows and columns on the grid
        self.cells = np.nonzero(used)
        self._grid = used.shape
        # (N, 2) the same in px
        self.index = np.stack([rows[used], columns[used]], 1)
        self.points = backproject(
            np.asarray(pair.prev.depth), pair.prev.camera, self.index
        )
        depth = (
            np.zeros((1, 1))
            if pair.curr.depth is None
            else np.asarray(pair.curr.depth)
        )
        camera = np.array([curr.fx, curr.fy, curr.cx, curr.cy], np.float32)
        self._where = (
            self.points.astype(np.float32),
            as_contiguous(depth, np.float32),
            camera,
        )
        self._weight = weight[used].astype(np.float32)
        self._tiles = Tiles(self._shape, self.index)
        self.rows = np.empty((kernels.PLANE_ROWS, len(self.points)), np.float32)
        self._w = np.empty(len(self.points), np.float32)
        self._law = np.array([0, 0, 1], np.float32)
        self._scale = 0.0

    @property
    def known(self) -> tuple:
        """What :func:`kernels.align` takes of the depth maps."""
        return (
            *self._where,
            self._weight,
            self._law,
            self.rows,
            self._w,
            self._scale,
        )

    @property
    def point_weights(self) -> np.ndarray:
        """(N,) robust weights of the points where they were last estimated, on information."""
        return self._w

    def on_grid(self, values: np.ndarray) -> np.ndarray:
        """Values (N,) of the points on their regular grid, float32; 0 where there is no point."""
        out = np.zeros(self._grid, np.float32)
        out[self.cells] = values
        return out

    def estimate(self, T: np.ndarray) -> bool:
        """Fit the noise law and the scale of the information; whether enough points are seen."""
        kernels.plane_rows(*self._where, T, self.rows)
        seen = self.rows[kernels.SURFACE] > 0
        self._scale = 0.0
        self.information = np.zeros((6, 6))
        if np.count_nonzero(seen) < MIN_POINTS:
            return False
        # of every fourth: the law has three numbers
        z, r = self.rows[[kernels.SURFACE, kernels.R]][:, seen][:, ::4]
        lengths = np.abs(r)
        columns = np.stack([np.ones_like(z), z, z * z], 1)
        usual = spread(lengths / columns[:, 2]) * columns[:, 2]
        mean_length = np.sqrt(2 / np.pi)  # of a standard normal number
        # the first law says which residuals are outliers of the second
        for _ in range(2):
            near = lengths < CUTOFF * np.maximum(usual, kernels.DEPTH_FLOOR * z)
            share = 1 / z[near]
            self._law = (
                nnls(columns[near] * share[:, None], lengths[near] * share)[0]
                / mean_length
            )
            self._law = self._law.astype(np.float32)
            usual = columns @ self._law
        kernels.weigh_points(self._weight, self._law, self.rows, self._w)
        J = self.rows[kernels.MOTION : kernels.PLANE_TERMS]
        scores = J * (self._w * self.rows[kernels.R])
        H = products(self.rows[: kernels.PLANE_TERMS], self._w)[1:, 1:]
        model = positive_inverse(H)
        meat = scores @ scores.T
        if model is not None:
            self._scale = independent_share(self._tiles.sums(scores), meat, model)
            self.information = self._scale * H
        return self._scale > 0

    def noise(self, z: np.ndarray) -> np.ndarray:
        """Standard deviation (N,) of the residual at depths (N,), metres: the fitted law."""
        a, b, c = self._law
        return np.maximum(a + (b + c * z) * z, kernels.DEPTH_FLOOR * z)
