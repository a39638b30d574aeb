"""The images of a pair as a factor of its motion.

The residual of a weighted static pixel is ``I_curr(pi(T X)) - gain I_prev - offset``; its
definition is in :mod:`hybridvo.refinement.photometric_kernels`. Gain and offset follow the motion,
so that the cost is one of the motion alone; the noise is estimated from the residuals, and the
information is scaled by what errors that neighbours share leave of it.

Light that changes over the image (vignette, lamps, the camera's tone curve) cannot be followed by
one gain and one offset a pair, and what they leave pulls at the motion. Where smooth fields of gain
and offset, bilinear between the nodes of a coarse grid, explain much of the residual, they are put
into the grey values of the previous image. Gradients have no preferred sign within a cell, so that
the fields leave the motion alone.
"""

from __future__ import annotations

from functools import cache

import numpy as np

from hybridvo.calibration import EVEN_PARTS, UNEVEN_LIGHT
from hybridvo.options import RefineOptions
from hybridvo.refinement import photometric_kernels as kernels
from hybridvo.refinement.covariance import dispersion
from hybridvo.refinement.full_fit import tile_size
from hybridvo.refinement.pixels import as_contiguous, typical
from hybridvo.refinement.solver import Linearization, positive_inverse
from hybridvo.results import RelativePose
from hybridvo.types import FramePair

CUTOFF = 3.0
"""c of the Geman-McClure kernel, in standard deviations."""
NOISE_FLOOR = 0.1
"""Grey levels: rounding to 8 bits leaves 0.08 after the finest blur."""
PARTS = ((2, 2), (4, 1))
"""Rows and columns of parts of the image that are held against each other: a lens errs by
quadrant, a rolling shutter by row."""
ROWS, COLUMNS = 5, 7
"""Nodes of the fields."""
SMOOTH = 0.01
"""Weight of the differences between neighbouring nodes, in shares of a node's typical weight."""


class ImageFactor:
    """The images of a pair under one blur after another, see
    :class:`hybridvo.refinement.solver.Factor`.

    Args:
        pair: with two images.
        pose: weighted motion of the pair, on the full grid.
        index: (N, 2) int32 rows and columns of the pixels to use.
        inflation: factor on the covariance beyond the tiles.
    """

    def __init__(
        self, pair: FramePair, pose: RelativePose, index: np.ndarray, inflation: float
    ) -> None:
        prev, curr, n = pair.prev.camera, pair.curr.camera, len(index)
        self._depth = as_contiguous(np.asarray(pair.prev.depth))
        self._weights = as_contiguous(np.asarray(pose.weights), np.float32)
        variance = pair.prev.depth_variance
        self._unit = np.float32(1.0 if variance is None else typical(variance))
        self._variance = as_contiguous(
            np.ones((1, 1), np.float32) if variance is None else variance
        )
        self._shape, self._index = prev.shape, index
        self._depth_noise, self._inflation = pose.depth_noise, inflation
        self._camera = np.array([1 / prev.fx, 1 / prev.fy, prev.cx, prev.cy], np.float32)
        self._K = np.array([curr.fx, curr.fy, curr.cx, curr.cy], np.float32)
        self._buffer = np.empty((kernels.BUFFER_ROWS, n), np.float32)
        self._J = np.empty((kernels.GQ + 1, n), np.float32)
        self._r, self._w = np.empty(n, np.float32), np.empty(n, np.float32)
        self._H, self._g = np.empty((kernels.COLUMNS,) * 2), np.empty(kernels.COLUMNS)
        self._light = np.array([1.0, 0.0], np.float32)
        self._places = field_places(index, prev.shape)
        self._scale = 1.0 / inflation
        self._uneven_here = False
        self.noise = 0.0
        """Standard deviation of the residual, grey levels."""
        self.agreement = 1.0
        """Factor in (0, 1] on the information by which the parts of the image lowered it."""
        self.uneven_light = False
        """Whether gain and offset had to vary over the image."""

    @property
    def gain(self) -> float:
        """Of the current image over the previous one."""
        return float(self._light[0])

    @property
    def offset(self) -> float:
        """The same, grey levels about mid grey."""
        return float(self._light[1])

    @property
    def pixels(self) -> int:
        """How many are seen."""
        return int(np.count_nonzero(self._w))

    @property
    def seen(self) -> float:
        """Share of the weight that falls inside the current image."""
        weight = self._buffer[kernels.W]
        return float(weight[self._w > 0].sum() / max(weight.sum(), 1e-12))

    def use(self, prev: np.ndarray, curr: np.ndarray, T: np.ndarray) -> None:
        """Take two images (H, W) and estimate noise and light at a motion."""
        kernels.gather_pixels(
            self._index, len(self._index), prev, self._depth, self._weights, self._variance,
            self._unit, self._camera, self._buffer,
        )  # fmt: skip
        self._prev, self._curr, self._at = prev, curr, np.empty(0)
        self._project(T)
        for _ in range(2):
            self._settle()
        self._uneven_here = self._even_light(UNEVEN_LIGHT)
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
        rows, columns = self._index[used].T
        v, u = (2 * self._places[used]).astype(np.intp).T  # cells half as wide as the fields'
        return correlation(self._prev[rows, columns], seen, weight, 2 * (COLUMNS - 1) * v + u)

    def _project(self, T: np.ndarray) -> None:
        if T is self._at:
            return
        R, t = T[:3, :3].astype(np.float32), T[:3, 3].astype(np.float32)
        kernels.project_pixels(
            self._buffer, len(self._index), self._curr, R, t, self._K, self._camera[:2],
            self._light, self._J, self._r,
        )  # fmt: skip
        self._at = T

    def _weigh(self) -> float:
        """Weights, light, H and g of the last projection; returns the cost."""
        # depth_noise belongs to the typical depth variance, the unit of the buffer's
        noise = 1 / max(self.noise, NOISE_FLOOR) ** 2, self._depth_noise**2, CUTOFF**2
        return kernels.normal_equations(
            self._buffer, len(self._index), np.array(noise, np.float32), self._light, self._J,
            self._r, self._w, self._H, self._g,
        )  # fmt: skip

    def _settle(self) -> None:
        """Noise of the last projection, and the light under it."""
        step = max(1, len(self._index) // 2000)  # enough for 3 %
        lengths, weight = np.abs(self._r[::step]), self._buffer[kernels.W, ::step]
        seen = lengths >= 0  # not NaN
        if seen.any():
            order = np.argsort(lengths[seen])
            reached = np.cumsum(weight[seen][order])
            middle = np.searchsorted(reached, 0.5 * reached[-1])
            self.noise = 1.4826 * float(lengths[seen][order[min(middle, len(order) - 1)]])
        self.noise = max(self.noise, NOISE_FLOOR)
        self._weigh()

    def _even_light(self, least: float) -> bool:
        """Put fields of gain and offset into the grey values where they explain enough."""
        grey = self._buffer[kernels.GREY]
        arrays = self._places, grey, self._r, self._w
        if least > 0:
            a, b, c, d = (np.ascontiguousarray(x[::4]) for x in arrays)
            if light_fields(a, b, c, d, least) is None:
                return False
        fields = light_fields(*arrays)
        if fields is None:
            return False
        kernels.apply_fields(self._places, fields, self._light[0], self._buffer, self._r)
        return True

    def _marginal(self) -> tuple[np.ndarray, np.ndarray]:
        """(H (6, 6) with gain and offset free, what they explain of each column (6, 2))."""
        H, (a, b, c) = self._H, (self._H[6, 6], self._H[6, 7], self._H[7, 7])
        determinant = a * c - b * b
        if determinant > 1e-9 * a * c > 0:
            inverse = np.array([[c, -b], [-b, a]]) / determinant
        else:
            inverse = np.diag([0.0, 1 / c if c > 0 else 0.0])
        light = H[:6, 6:] @ inverse
        return H[:6, :6] - light @ H[6:, :6], light

    def _estimate_scale(self) -> None:
        """Share of the information that is left under errors alike in a region.

        Trace ratio of the sandwich covariance over tiles to that of the model, at least 1; beyond
        the tiles by ``inflation``, and by ``agreement`` where that is not enough.
        """
        height, width = self._shape
        tile = tile_size((height, width), RefineOptions().tiles)
        columns, rows = -(-width // tile), -(-height // tile)
        scores, curvature = np.zeros((rows * columns, 6)), np.zeros((rows * columns, 6, 6))
        meat = np.zeros((6, 6))
        H, light = self._marginal()
        kernels.tile_scores(
            self._index, len(self._index), self._J, self._r, self._w, tile, columns, light, scores,
            curvature, meat,
        )  # fmt: skip
        model = positive_inverse(H)
        if model is None:
            self._scale = 0.0
            return
        # as at the optimum of the images alone, to first order: the flow pulls away from it
        scores -= curvature @ (model @ scores.sum(axis=0))
        factor = dispersion(scores, meat, model)
        if factor is None:
            self._scale = 0.0
            return
        scale = 1.0 / (factor * self._inflation)
        parts = scale * parts_dispersion(scores.reshape(rows, columns, 6), model)
        # what the parts disagree about is seen; as much again is common to them and is not
        self.agreement = min(1.0, (EVEN_PARTS / max(parts, EVEN_PARTS)) ** 2)
        self._scale = scale * self.agreement


def parts_dispersion(scores: np.ndarray, model: np.ndarray) -> float:
    """Dispersion of the scores (rows, columns, 6) of tiles, summed over each of :data:`PARTS`.

    1 where the parts are independent and the ``model`` covariance (6, 6) is right.
    """
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


def light_fields(
    place: np.ndarray, grey: np.ndarray, r: np.ndarray, w: np.ndarray, least: float = 0.0
) -> np.ndarray | None:
    """Smooth changes of gain and offset that explain the residuals best.

    Args:
        place: (N, 2) v and u in cells of the fields, see :func:`field_places`.
        grey: (N,) grey values.
        r: (N,) residuals.
        w: (N,) their weights, 0 where not seen.
        least: share of the squared residuals that the fields must explain.

    Returns:
        (ROWS, COLUMNS, 2) float32 changes of gain and offset at the nodes; None where they explain
        less.
    """
    nodes = ROWS * COLUMNS
    H, g = np.zeros((2 * nodes,) * 2), np.zeros(2 * nodes)
    power = kernels.field_equations(place, grey, r, w, COLUMNS, H, g)
    scale = np.tile([np.trace(H[::2, ::2]), np.trace(H[1::2, 1::2])], nodes) / nodes
    H[::2, ::2] += SMOOTH * scale[0] * _differences()
    H[1::2, 1::2] += SMOOTH * scale[1] * _differences()
    # and a weak pull to no change, for nodes that no pixel is near to
    field = np.linalg.solve(H + np.diag(1e-4 * scale + 1e-12), g)
    if not (np.isfinite(field).all() and field @ g >= least * power and power > 0):
        return None
    return field.astype(np.float32).reshape(ROWS, COLUMNS, 2)


def field_places(index: np.ndarray, shape: tuple[int, int]) -> np.ndarray:
    """(N, 2) place of pixels (v, u) of an image (H, W), in cells of the fields."""
    return index * np.array([(ROWS - 1) / shape[0], (COLUMNS - 1) / shape[1]], np.float32)


def correlation(
    a: np.ndarray, b: np.ndarray, weight: np.ndarray, cell: np.ndarray | None = None
) -> float:
    """Weighted correlation of two sets of grey values (N,); 0 where one of them is constant.

    Args:
        a: (N,) one set.
        b: (N,) the other.
        weight: (N,) not negative.
        cell: (N,) groups about whose own means the values are taken; None: one.
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
