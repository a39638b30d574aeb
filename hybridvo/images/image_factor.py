"""The images of a pair as a factor of its motion.

The residual of a weighted static pixel is ``I_curr(pi(T X)) - gain I_prev - offset``; its
definition is in :mod:`hybridvo.images.photometric_kernels`. Gain and offset follow the motion,
so that the cost is one of the motion alone; the noise is estimated from the residuals, and the
information is scaled by what errors that neighbours share leave of it.

Light that changes over the image (vignette, lamps, the camera's tone curve) cannot be followed by
one gain and one offset a pair, and what they leave pulls at the motion. Where smooth fields of gain
and offset, bilinear between the nodes of a coarse grid, explain much of the residual, they are put
into the grey values of the previous image. Gradients have no preferred sign within a cell, so that
the fields leave the motion alone.
"""

from __future__ import annotations

from functools import cache, cached_property
from weakref import WeakKeyDictionary

import cv2
import numpy as np

from hybridvo.calibration import EVEN_PARTS, UNEVEN_LIGHT
from hybridvo.images import photometric_kernels as kernels
from hybridvo.images.plane_factor import CUTOFF, INFLATION
from hybridvo.options import RefineOptions
from hybridvo.refinement.covariance import dispersion, tile_size, tile_sums
from hybridvo.refinement.kernels import MAX_VALUE
from hybridvo.refinement.pixels import as_contiguous, typical
from hybridvo.refinement.solver import Linearization, positive_inverse
from hybridvo.results import RelativePose
from hybridvo.types import Frame, FramePair

MID_GREY = 128.0
"""Taken off every grey value, so that gain and offset are nearly independent."""
GREY = np.array([[0.299, 0.587, 0.114, -MID_GREY]])
_IMAGES: WeakKeyDictionary[Frame, dict[float, np.ndarray]] = WeakKeyDictionary()
"""Blurred images by blur, as long as the frame is kept."""
PER_CELL = 4
MIN_WEIGHT = 0.25
"""Robust weight in the refinement on the flow below which a pixel is not used."""
NOISE_FLOOR = 0.1
"""Grey levels: rounding to 8 bits leaves 0.08 after the finest blur."""
GAINS = (0.2, 5.0)
"""Limits of the gain between two images."""
PARTS = ((2, 2), (4, 1))
"""Rows and columns of parts of the image that are held against each other: a lens errs by
quadrant, a rolling shutter by row."""
ROWS, COLUMNS = 5, 7
"""Nodes of the fields."""
SMOOTH = 0.01
"""Weight of the differences between neighbouring nodes, in shares of a node's typical weight."""


def blurred(frame: Frame, px: float) -> np.ndarray:
    """(H, W) float32 grey values less :data:`MID_GREY` under a Gaussian blur."""
    images = _IMAGES.setdefault(frame, {})
    if 0.0 not in images:
        # not rounded: 8 bits of grey would add as much noise as the camera's own rounding
        images[0.0] = cv2.transform(np.ascontiguousarray(frame.rgb).astype(np.float32), GREY)
    if px not in images:
        images[px] = cv2.GaussianBlur(images[0.0], (0, 0), px)
    return images[px]


def choose_pixels(
    grey: np.ndarray, depth: np.ndarray, weights: np.ndarray, count: int
) -> np.ndarray:
    """(N, 2) int32 rows and columns of the pixels to use: strong gradients, evenly spread."""
    height, width = grey.shape
    cell = max(2, round(np.sqrt(height * width * PER_CELL / count)))
    cells = (height // cell + 1) * (width // cell + 1)
    index = np.empty((cells * PER_CELL, 2), np.int32)
    n = kernels.select_pixels(
        grey, as_contiguous(depth), as_contiguous(weights, np.float32),
        np.float32(MIN_WEIGHT), cell, PER_CELL, index,
    )  # fmt: skip
    return index[:n]


class ImageFactor:
    """The images of a pair under one blur after another, at the pixels (N, 2) ``index``.

    ``pose`` holds the weights of the pixels.
    """

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
        self._r, self._w = np.empty(n, np.float32), np.empty(n, np.float32)
        self._light = np.array([1.0, 0.0], np.float32)
        self._places = index * [(ROWS - 1) / prev.height, (COLUMNS - 1) / prev.width]
        tile = tile_size(prev.shape, RefineOptions().tiles)
        self._tiles = -(-prev.height // tile), -(-prev.width // tile)
        self._tile = rows // tile * self._tiles[1] + columns // tile
        self._scale = 1.0 / INFLATION
        self._noise = NOISE_FLOOR  # standard deviation of the residual, grey levels
        self.agreement = 1.0
        """Factor in (0, 1] on the information by which the parts of the image lowered it."""
        self.uneven_light = False
        """Whether gain and offset had to vary over the image."""

    @cached_property
    def _shares(self) -> np.ndarray:
        """Of the fields' nodes in each pixel: asked for only where the light may be uneven."""
        return node_shares(self._places)

    @property
    def gain(self) -> float:
        """Of the current image over the previous one."""
        return float(self._light[0])

    @property
    def offset(self) -> float:
        """The same, grey levels about mid grey."""
        return float(self._light[1])

    @property
    def seen(self) -> float:
        """Share of the weight that falls inside the current image."""
        weight = self._buffer[kernels.W]
        return float(weight[self._w > 0].sum() / max(weight.sum(), 1e-12))

    def use(
        self, prev: np.ndarray, curr: np.ndarray, T: np.ndarray, uneven_light: bool = True
    ) -> None:
        """Take two images (H, W) and estimate noise and light at a motion."""
        rows, columns = self._index.T
        self._buffer[kernels.GX] = 0.5 * (prev[rows, columns + 1] - prev[rows, columns - 1])
        self._buffer[kernels.GY] = 0.5 * (prev[rows + 1, columns] - prev[rows - 1, columns])
        self._curr, self._at = curr, np.empty(0)
        # without the fields of light that may be put into the buffer's
        self._even = self._buffer[kernels.GREY] = prev[rows, columns]
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
        self._estimate_scale()

    def linearize(self, T: np.ndarray) -> Linearization:
        """See :class:`hybridvo.refinement.solver.Factor`."""
        self._project(T)
        cost = self._weigh()
        H, light = self._marginal()
        g = self._g[:6] - light @ self._g[6:]
        return Linearization(self._scale * H, self._scale * g, self._scale * cost)

    def correlation(self) -> float:
        """Of the two images over the pixels seen; within small cells where the light is uneven.

        The fields can bring the means of any two images together, but not what is within a cell.
        """
        used = self._w > 0
        grey, weight = self._buffer[kernels.GREY][used], self._buffer[kernels.W][used]
        seen = self._r[used] + self.gain * grey + self.offset
        if not self.uneven_light:
            return correlation(grey, seen, weight)
        v, u = (2 * self._places[used]).astype(np.intp).T  # cells half as wide as the fields'
        return correlation(self._even[used], seen, weight, 2 * (COLUMNS - 1) * v + u)

    def _project(self, T: np.ndarray) -> None:
        if T is self._at:
            return
        kernels.project_pixels(
            self._buffer, self._curr, T[:3], self._K, self._scales, self._light, self._J, self._r
        )
        self._at = T

    def _weigh(self) -> float:
        """Weights, H (8, 8) and g (8,) of the last projection; then the light that fits best.

        Returns the cost under that light, to second order. Points unseen cost the most.
        """
        buffer, J, r, c2 = self._buffer, self._J[: kernels.GQ], self._r, CUTOFF**2
        # depth_noise belongs to the typical depth variance, the unit of the buffer's
        depth = buffer[kernels.PD] * (self._depth_noise * self._J[kernels.GQ]) ** 2
        information = 1 / (self._noise**2 + depth)
        d2 = r * r * information
        seen = d2 < MAX_VALUE  # false for NaN
        robust = c2 / (c2 + np.where(seen, d2, 0))
        self._w = np.where(seen, buffer[kernels.W] * robust * robust * information, 0)
        cost = 0.5 * float(buffer[kernels.W].astype(np.float64) @ np.where(seen, robust * d2, c2))
        weighted = J * self._w
        self._H = (weighted @ J.T).astype(np.float64)
        self._g = -(weighted @ np.where(seen, r, 0)).astype(np.float64)
        g, (b, c) = self._g[6:], self._H[7, 6:]
        gain = float(self._light[0] + (self._light_inverse() @ g)[0])
        more = np.float32(min(max(gain, GAINS[0]), GAINS[1])) - self._light[0]
        shift = np.float32((g[1] - b * more) / c if c > 0 else 0.0)
        self._r -= more * buffer[kernels.GREY] + shift
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
            self._noise = max(1.4826 * float(np.median(lengths)), NOISE_FLOOR)
        self._weigh()

    def _even_light(self, least: float) -> bool:
        """Put fields of gain and offset into the grey values where they explain enough."""
        buffer, (gain, _), r, w, shares = self._buffer, self._light, self._r, self._w, self._shares
        grey, few = buffer[kernels.GREY], np.s_[::4]
        if least > 0 and light_fields(shares[few], grey[few], r[few], w[few], least) is None:
            return False
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

    def _estimate_scale(self) -> None:
        """Share of the information that is left under errors alike in a region, at most 1."""
        H, light = self._marginal()
        model, self._scale = positive_inverse(H), 0.0
        if model is None:
            return
        rows = self._J[:6].astype(np.float64) - light @ self._J[6:8]
        r = np.where(self._w > 0, self._r, 0.0)
        pull = rows * (self._w * r)
        # as at the optimum of the images alone, to first order: the flow pulls away from it
        r = r - (model @ pull.sum(axis=1)) @ rows
        scores = tile_sums(rows * (self._w * r), self._tile, self._tiles[0] * self._tiles[1])
        factor = dispersion(scores, pull @ pull.T, model)
        if factor is None:
            return
        scale = 1.0 / (factor * INFLATION)
        parts = scale * parts_dispersion(scores.reshape(*self._tiles, 6), model)
        # what the parts disagree about is seen; as much again is common to them and is not
        self.agreement = min(1.0, (EVEN_PARTS / max(parts, EVEN_PARTS)) ** 2)
        self._scale = scale * self.agreement


def parts_dispersion(scores: np.ndarray, model: np.ndarray) -> float:
    """Dispersion of the scores (rows, columns, 6) of tiles, summed over each of :data:`PARTS`."""
    found = []
    for shape in PARTS:
        rows, columns = (
            np.arange(n) * k // n for n, k in zip(scores.shape[:2], shape, strict=True)
        )
        sums = np.zeros((*shape, 6))
        np.add.at(sums, np.ix_(rows, columns), scores)
        parts = sums.reshape(-1, 6)
        k = len(parts)
        found.append(np.einsum("bp,pq,bq->", parts, model, parts) / 6 * k / (k - 1))
    return float(np.mean(found))


def node_shares(places: np.ndarray) -> np.ndarray:
    """(N, nodes) bilinear shares of the nodes in places (N, 2): rows and columns among them."""
    corner = places.astype(np.intp)
    v, u = (places - corner).T
    nodes = (corner @ (COLUMNS, 1))[:, None] + (0, 1, COLUMNS, COLUMNS + 1)
    out = np.zeros((len(places), ROWS * COLUMNS), np.float32)
    out[np.arange(len(places))[:, None], nodes] = np.stack(
        [(1 - v) * (1 - u), (1 - v) * u, v * (1 - u), v * u], axis=1
    )
    return out


def light_fields(
    shares: np.ndarray, grey: np.ndarray, r: np.ndarray, w: np.ndarray, least: float = 0.0
) -> np.ndarray | None:
    """Smooth changes of gain and offset (2, nodes) that explain the residuals best, or None."""
    r, nodes = np.where(w > 0, r, np.float32(0)), ROWS * COLUMNS
    A = np.concatenate([shares * grey[:, None], shares], axis=1)
    weighted = (A * w[:, None]).T
    H, g = (weighted @ A).astype(np.float64), weighted @ r
    scale = np.repeat([np.trace(H[:nodes, :nodes]), np.trace(H[nodes:, nodes:])], nodes) / nodes
    H += SMOOTH * scale * np.kron(np.eye(2), _differences())
    # and a weak pull to no change, for nodes that no pixel is near to
    field, power = np.linalg.solve(H + np.diag(1e-4 * scale + 1e-12), g), w @ (r * r)
    if not (np.isfinite(field).all() and field @ g >= least * power and power > 0):
        return None
    return field.astype(np.float32).reshape(2, nodes)


def correlation(
    a: np.ndarray, b: np.ndarray, weight: np.ndarray, cell: np.ndarray | None = None
) -> float:
    """Weighted correlation of two sets of grey values (N,); 0 where one of them is constant.

    ``cell`` (N,): groups about whose own means the values are taken.
    """
    cell = np.zeros(len(a), np.intp) if cell is None else cell
    total = np.maximum(np.bincount(cell, weight), 1e-12)
    a, b = (x - (np.bincount(cell, weight * x) / total)[cell] for x in (a, b))
    power = float(weight @ (a * a)) * float(weight @ (b * b))
    return float(weight @ (a * b)) / np.sqrt(power) if power > 0 else 0.0


@cache
def _differences() -> np.ndarray:
    """Quadratic form of the differences between neighbouring nodes."""
    rows, columns = (np.diff(np.eye(n), axis=0) for n in (ROWS, COLUMNS))
    return np.kron(np.eye(ROWS), columns.T @ columns) + np.kron(rows.T @ rows, np.eye(COLUMNS))
