"""The images of a pair, and its two depth maps, as factors of its motion.

Images: the residual of a weighted static pixel is ``I_curr(pi(T X)) - gain I_prev - offset``; where
the light changes over the image, smooth fields of both are put into the grey values of the previous
one. Depth maps: ``r = n . (T X - P)``, P and n point and normal of the current one where T X is
seen. Both estimate their noise from the residuals, and count errors that neighbours share.
"""

from __future__ import annotations

from functools import cached_property
from typing import NamedTuple

import cv2
import numpy as np
from scipy.optimize import nnls

from hybridvo.calibration import EVEN_PARTS, UNEVEN_LIGHT
from hybridvo.geometry import as_contiguous, backproject
from hybridvo.images import kernels
from hybridvo.refinement.kernels import MAX_VALUE
from hybridvo.refinement.pixels import typical
from hybridvo.refinement.solver import Linearization, positive_inverse, tile_size
from hybridvo.results import RelativePose
from hybridvo.types import FramePair

NOISE_FLOOR = 0.1  # grey levels: rounding to 8 bits leaves 0.08 after the finest blur
GAINS = (0.2, 5.0)  # limits of the gain between two images
PARTS = ((2, 2), (4, 1))  # compared: a lens errs by quadrant, a rolling shutter by row
ROWS, COLUMNS = 5, 7  # nodes of the fields
BETWEEN = [np.diff(np.eye(n), axis=0) for n in (ROWS, COLUMNS)]
DIFFERENCES = np.kron(np.eye(ROWS), BETWEEN[1].T @ BETWEEN[1])
DIFFERENCES += np.kron(BETWEEN[0].T @ BETWEEN[0], np.eye(COLUMNS))
SMOOTH = 0.01  # weight of their differences, in shares of a typical node's
POINTS, MIN_POINTS = 5000, 300  # of a depth map, on a regular grid: at most, and at least
DEPTH_FLOOR = 1e-4  # least standard deviation of a point's distance, in shares of the depth
CUTOFF = 3.0  # c of the Geman-McClure kernels, in standard deviations
INFLATION = 4.0  # factor on the covariance of both: errors are alike far beyond the tiles


class Tiles:
    """The tiles of an image (H, W) that pixels (N, 2), rows and columns, lie in."""

    def __init__(self, shape: tuple[int, int], index: np.ndarray) -> None:
        size = tile_size(shape)
        self.shape = -(-shape[0] // size), -(-shape[1] // size)
        self._number = index[:, 0] // size * self.shape[1] + index[:, 1] // size

    def sums(self, scores: np.ndarray) -> np.ndarray:
        """(rows, columns, M) sums of (M, N) scores over each."""
        sums = [np.bincount(self._number, x, np.prod(self.shape)) for x in scores]
        return np.stack(sums, axis=-1).reshape(*self.shape, -1)


def spread(lengths: np.ndarray) -> float:
    """Standard deviation of normal numbers of these lengths, from the upper median."""
    half = len(lengths) // 2
    return 1.4826 * float(np.partition(lengths, half)[half])


def independent_share(sums: np.ndarray, meat: np.ndarray, model: np.ndarray) -> float:
    """Share of the information (``meat``) that errors alike in a tile, and beyond, leave; or 0."""
    independent, sums = positive_inverse(meat), sums.reshape(-1, 6)
    if independent is None:
        return 0.0
    clusters = max(1.0, np.trace(independent @ sums.T @ sums) / 6)
    return float(1 / (INFLATION * max(1.0, clusters * np.trace(model @ meat) / 6)))


class ImageFactor:
    """The images of a pair under one blur after another, at pixels (N, 2) of a weighted pose."""

    def __init__(self, pair: FramePair, pose: RelativePose, index: np.ndarray) -> None:
        prev, curr, n = pair.prev.camera, pair.curr.camera, len(index)
        rows, columns = index.T
        buffer = np.ones((kernels.BUFFER_ROWS, n), np.float32)
        buffer[kernels.XN] = (columns - prev.cx) / prev.fx
        buffer[kernels.YN] = (rows - prev.cy) / prev.fy
        buffer[kernels.Z] = np.asarray(pair.prev.depth)[rows, columns]
        buffer[kernels.W] = np.minimum(np.asarray(pose.weights)[rows, columns], 1.0)
        if pair.prev.depth_variance is not None:
            variance = pair.prev.depth_variance[rows, columns]
            good = (variance >= 0) & (variance < MAX_VALUE)
            buffer[kernels.PD, good] = variance[good] / typical(pair.prev.depth_variance)
            buffer[kernels.W, ~good] = 0.0
        self._buffer, self._index = buffer, index
        self._depth_noise = float(pose.depth_noise)
        self._scales = np.array([1 / prev.fx, 1 / prev.fy], np.float32)
        self._K = np.array([curr.fx, curr.fy, curr.cx, curr.cy], np.float32)
        self._J = np.empty((kernels.GQ + 1, n), np.float32)
        # residuals, NaN where not seen; weights, 0 there; their products
        self._r, self._w, self._wr = np.empty((3, n), np.float32)
        self._light = np.array([1.0, 0.0], np.float32)  # gain and offset
        self._places = index * [(ROWS - 1) / prev.height, (COLUMNS - 1) / prev.width]
        self._tiles = Tiles(prev.shape, index)
        self._scale = 1.0 / INFLATION
        self._noise = NOISE_FLOOR  # standard deviation of the residual, grey levels
        # by how much the parts of the image lowered it; whether gain and offset vary over the image
        self.agreement, self.uneven_light = 1.0, False

    @cached_property
    def _shares(self) -> np.ndarray:
        """Of the fields' nodes in each pixel: asked for only where the light may be uneven."""
        return node_shares(self._places)

    @property
    def gain(self) -> float:
        """Of the current image over the previous one."""
        return float(self._light[0])

    @property
    def seen(self) -> float:
        """Share of the weight that falls inside the current image."""
        weight = self._buffer[kernels.W]
        return float(weight[self._w > 0].sum() / max(weight.sum(), 1e-12))

    def use(
        self, prev: np.ndarray, curr: np.ndarray, T: np.ndarray, uneven_light: bool = True
    ) -> None:
        """Take two images (H, W) and estimate noise and light at a motion."""
        width, at = prev.shape[1], self._index @ [prev.shape[1], 1]
        right, left, below, above = (prev.take(at + step) for step in (1, -1, width, -width))
        self._buffer[kernels.GX] = 0.5 * (right - left)
        self._buffer[kernels.GY] = 0.5 * (below - above)
        self._curr, self._at = curr, np.empty(0)
        # without the fields of light that may be put into the buffer's
        self._even = self._buffer[kernels.GREY] = prev.take(at)
        self._project(T)
        for _ in range(2):
            self._settle()
        self._uneven_here = uneven_light and self._even_light(UNEVEN_LIGHT)
        self.uneven_light |= self._uneven_here
        self._settle()

    def estimate(self, T: np.ndarray) -> None:
        """Estimate light, noise and the scale of the information at a motion."""
        self._project(T)
        if self._uneven_here:
            self._even_light(0.0)
        self._settle()
        H, light = self._marginal()
        model, self._scale = positive_inverse(H), 0.0
        if model is None:
            return
        free, J = np.hstack([np.eye(6), -light]).astype(np.float32), self._J[: kernels.GQ]
        pull = J * self._wr
        # as at the optimum of the images alone, to first order: the flow pulls away from it
        step = model.astype(np.float32) @ (free @ (J @ self._wr))
        sums = self._tiles.sums(pull - J * (self._w * (step @ free @ J))) @ free.T
        share = independent_share(sums, free @ (pull @ pull.T) @ free.T, model)
        if share > 0:
            parts = share * parts_dispersion(sums, model)
            # what the parts disagree about is seen; as much again is common to them and is not
            self.agreement = min(1.0, (EVEN_PARTS / max(parts, EVEN_PARTS)) ** 2)
            self._scale = share * self.agreement

    def linearize(self, T: np.ndarray) -> Linearization:
        """See :class:`hybridvo.refinement.solver.Factor`."""
        self._project(T)
        cost = self._weigh()
        H, light = self._marginal()
        g = self._g[:6] - light @ self._g[6:]
        return Linearization(self._scale * H, self._scale * g, self._scale * cost)

    def correlation(self) -> float:
        """Of the two images over the pixels seen; within small cells where the light is uneven: the
        fields can bring the means of any two images together, but not what is within a cell.
        """
        used = self._w > 0
        grey, weight = self._buffer[kernels.GREY][used], self._buffer[kernels.W][used]
        seen = self._r[used] + self._light[0] * grey + self._light[1]
        cell = np.zeros(len(grey), int)
        if self.uneven_light:
            v, u = (2 * self._places[used]).astype(int).T  # cells half as wide as the fields'
            grey, cell = self._even[used], 2 * (COLUMNS - 1) * v + u
        return correlation(grey, seen, weight, cell)

    def _project(self, T: np.ndarray) -> None:
        if T is not self._at:
            where = T[:3], self._K, self._scales, self._light
            kernels.project_pixels(self._buffer, self._curr, *where, self._J, self._r)
            self._at = T

    def _weigh(self) -> float:
        """Weights, H, g of the last projection; the light that fits best, and the cost under it."""
        # the depth's noise belongs to the typical depth variance, the unit of the buffer's
        noise = np.array([self._noise, self._depth_noise, CUTOFF], np.float32)
        known = self._buffer[kernels.W], self._buffer[kernels.PD], self._J[kernels.GQ], self._r
        cost = kernels.weigh_pixels(*known, noise, self._w, self._wr)
        J = self._J[: kernels.GQ]
        self._H = ((J * self._w) @ J.T).astype(np.float64)
        self._g = -(J @ self._wr).astype(np.float64)
        g, (b, c) = self._g[6:], self._H[7, 6:]
        gain = float(self._light[0] + (self._light_inverse() @ g)[0])
        more = np.float32(min(max(gain, GAINS[0]), GAINS[1])) - self._light[0]
        shift = np.float32((g[1] - b * more) / c if c > 0 else 0.0)
        change = more * self._buffer[kernels.GREY] + shift
        self._r -= change
        self._wr -= self._w * change
        self._light += more, shift
        return cost - 0.5 * float(g @ (more, shift))

    def _light_inverse(self) -> np.ndarray:
        """Covariance (2, 2) of gain and offset; 0 of a gain that cannot be told from the offset."""
        (a, b), (_, c) = self._H[6:, 6:]
        determinant = a * c - b * b
        if determinant > 1e-9 * a * c > 0:
            return np.array([[c, -b], [-b, a]]) / determinant
        return np.diag([0.0, 1 / c if c > 0 else 0.0])

    def _settle(self) -> None:
        """Noise of the last projection, and the light under it."""
        lengths = np.abs(self._r[~np.isnan(self._r)])
        if len(lengths):
            self._noise = max(spread(lengths), NOISE_FLOOR)
        self._weigh()

    def _even_light(self, least: float) -> bool:
        """Put fields of gain and offset into the grey values where they explain enough."""
        buffer, (gain, _), r, w, few = self._buffer, self._light, self._r, self._w, np.s_[::4]
        grey = buffer[kernels.GREY]
        if least > 0:
            some = node_shares(self._places[few]), grey[few], r[few], w[few]
            if light_fields(*some, least) is None:
                return False
        shares = self._shares
        fields = light_fields(shares, grey, r, w)
        if fields is None:
            return False
        more, shift = (shares @ fields.T).T
        self._r -= more * grey + shift
        buffer[[kernels.GREY, kernels.GX, kernels.GY]] *= 1 + more / gain
        buffer[kernels.GREY] += shift / gain
        return True

    def _marginal(self) -> tuple[np.ndarray, np.ndarray]:
        """(H (6, 6) with gain and offset free, what they explain of each column (6, 2))."""
        light = self._H[:6, 6:] @ self._light_inverse()
        return self._H[:6, :6] - light @ self._H[6:, :6], light


def parts_dispersion(scores: np.ndarray, model: np.ndarray) -> float:
    """Dispersion of the scores (rows, columns, 6) of tiles, summed over each of :data:`PARTS`."""
    found = []
    for shape in PARTS:
        sums, sizes = np.zeros((*shape, 6)), zip(scores.shape[:2], shape, strict=True)
        np.add.at(sums, np.ix_(*(np.arange(n) * k // n for n, k in sizes)), scores)
        count = shape[0] * shape[1]
        found.append(np.einsum("rcp,pq,rcq->", sums, model, sums) / 6 * count / (count - 1))
    return float(np.mean(found))


def node_shares(places: np.ndarray) -> np.ndarray:
    """(N, nodes) bilinear shares of the nodes in places (N, 2): rows and columns among them."""
    v, u = (
        np.maximum(0, 1 - np.abs(place[:, None] - np.arange(n, dtype=np.float32)))
        for place, n in zip(places.T.astype(np.float32), (ROWS, COLUMNS), strict=True)
    )
    return (v[:, :, None] * u[:, None]).reshape(len(places), -1)


def light_fields(
    shares: np.ndarray, grey: np.ndarray, r: np.ndarray, w: np.ndarray, least: float = 0.0
) -> np.ndarray | None:
    """Smooth changes of gain and offset (2, nodes) that explain the residuals best, or None."""
    r, nodes = np.where(w > 0, r, np.float32(0)), ROWS * COLUMNS
    A = np.concatenate([shares * grey[:, None], shares], axis=1)
    weighted = (A * w[:, None]).T
    H, g = (weighted @ A).astype(np.float64), weighted @ r
    scale = np.repeat([np.trace(H[:nodes, :nodes]), np.trace(H[nodes:, nodes:])], nodes) / nodes
    H += SMOOTH * scale * np.kron(np.eye(2), DIFFERENCES)
    # and a weak pull to no change, for nodes that no pixel is near to
    field, power = np.linalg.solve(H + np.diag(1e-4 * scale + 1e-12), g), w @ (r * r)
    if not (np.isfinite(field).all() and field @ g >= least * power and power > 0):
        return None
    return field.astype(np.float32).reshape(2, nodes)


def correlation(a: np.ndarray, b: np.ndarray, weight: np.ndarray, cell: np.ndarray) -> float:
    """Weighted correlation of grey values (N,) about the means of their cells; 0 if constant."""
    total = np.maximum(np.bincount(cell, weight), 1e-12)
    a, b = (x - (np.bincount(cell, weight * x) / total)[cell] for x in (a, b))
    power = float(weight @ (a * a)) * float(weight @ (b * b))
    return float(weight @ (a * b)) / np.sqrt(power) if power > 0 else 0.0


class Residuals(NamedTuple):
    """Points of the previous depth map at a motion, metres."""

    r: np.ndarray  # (N,) signed distance to the plane, 0 where not seen
    J: np.ndarray  # (6, N) its derivative
    z: np.ndarray  # (N,) depth of the plane, 1 where not seen
    seen: np.ndarray  # (N,) bool, the current depth map has a surface there
    at: np.ndarray  # (N, 2) px, where the point falls in the current image


class PlaneFactor:
    """A static point of the previous depth map, moved by T, lies on the current one's surface.

    The noise is ``sigma = a + b z + c z^2``, fitted to the residuals of the pair. Used are pixels
    of at least the weight ``least`` on a regular grid of at most ``points``.
    """

    def __init__(
        self, pair: FramePair, weights: np.ndarray, least: float, points: int = POINTS
    ) -> None:
        (height, width), curr = pair.prev.camera.shape, pair.curr.camera
        self._shape, step = (height, width), max(1, round(np.sqrt(height * width / points)))
        rows, columns = np.mgrid[step // 2 : height : step, step // 2 : width : step]
        z, weight = np.asarray(pair.prev.depth)[rows, columns], np.asarray(weights)[rows, columns]
        used = (z > 0) & np.isfinite(z) & (weight >= least)
        self.cells, self._grid = np.nonzero(used), used.shape  # rows and columns on the grid
        self.index = np.stack([rows[used], columns[used]], 1)  # (N, 2) the same in px
        self.points = backproject(np.asarray(pair.prev.depth), pair.prev.camera, self.index)
        self._weight, self._tiles = weight[used].astype(np.float64), Tiles(self._shape, self.index)
        self._K = np.array([curr.fx, curr.fy, curr.cx, curr.cy])
        self._depth = as_contiguous(np.asarray(pair.curr.depth))
        self._at = np.empty(0)
        self._law, self._scale = np.array([0.0, 0.0, 1.0]), 1.0

    def on_grid(self, values: np.ndarray) -> np.ndarray:
        """Values (N,) of the points on their regular grid, float32; 0 where there is no point."""
        out = np.zeros(self._grid, np.float32)
        out[self.cells] = values
        return out

    def image_of(self, values: np.ndarray) -> np.ndarray:
        """(H, W) float32: each pixel has the value of the nearest place of the grid."""
        size = self._shape[::-1]
        return cv2.resize(self.on_grid(values), size, interpolation=cv2.INTER_NEAREST)

    def estimate(self, T: np.ndarray) -> bool:
        """Fit the noise law and the scale of the information; whether enough points are seen."""
        found = self.residuals(T)
        if found.seen.sum() < MIN_POINTS:
            self._scale = 0.0
            return False
        z, lengths = found.z[found.seen], np.abs(found.r[found.seen])
        columns = np.stack([np.ones_like(z), z, z * z], 1)
        usual = spread(lengths / z**2) * z**2
        mean_length = np.sqrt(2 / np.pi)  # of a standard normal number
        for _ in range(2):  # the first law says which residuals are outliers of the second
            near = lengths < CUTOFF * np.maximum(usual, DEPTH_FLOOR * z)
            share = 1 / z[near, None]
            self._law = nnls(columns[near] * share, lengths[near] * share[:, 0])[0] / mean_length
            usual = self.noise(z)
        _, w = self.weigh(T)
        scores = found.J * (w * found.r)
        model = positive_inverse((found.J * w) @ found.J.T)
        sums, meat = self._tiles.sums(scores), scores @ scores.T
        self._scale = 0.0 if model is None else independent_share(sums, meat, model)
        return self._scale > 0

    def noise(self, z: np.ndarray) -> np.ndarray:
        """Standard deviation (N,) of the residual at depths (N,), metres: the fitted law."""
        a, b, c = self._law
        return np.maximum(a + (b + c * z) * z, DEPTH_FLOOR * z)

    def weigh(self, T: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """(N,) robust factors in [0, 1], 0 where not seen, and information of the residuals."""
        found = self.residuals(T)
        sigma = self.noise(found.z)
        robust = CUTOFF**2 * found.seen / (CUTOFF**2 + (found.r / sigma) ** 2)
        return robust, self._weight * (robust / sigma) ** 2

    def linearize(self, T: np.ndarray) -> Linearization:
        """See :class:`hybridvo.refinement.solver.Factor`; points unseen cost the most."""
        found, scale = self.residuals(T), self._scale
        robust, information = self.weigh(T)
        cost = 0.5 * CUTOFF**2 * float(self._weight @ (1 - robust))
        weighted = found.J * (scale * information)
        return Linearization(weighted @ found.J.T, -(weighted @ found.r), scale * cost)

    def residuals(self, T: np.ndarray) -> Residuals:
        """At a motion; the last one's are kept."""
        if T is not self._at:
            found = kernels.measure(self.points, T, self._depth, self._K)
            self._found, self._at = Residuals(*found), T
        return self._found
