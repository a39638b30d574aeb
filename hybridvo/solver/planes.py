"""The two depth maps of a pair as a factor of its motion: points to planes.

A static point of the previous depth map, moved by T, lies on the surface of the
current one. The noise of its distance is ``sigma = a + b z + c z^2`` at depth z,
fitted to the residuals of the pair; errors that neighbours share lower the
information.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import scipy

from hybridvo.compiled.numba_tools import as_contiguous
from hybridvo.core.geometry import valid_depth
from hybridvo.core.options import RefineOptions
from hybridvo.core.types import FramePair
from hybridvo.solver.align import PlaneInputs
from hybridvo.solver.calibration import (
    MIN_EQUAL_DEPTHS,
    MIN_PLANE_POINTS,
    QUANTUM_PERCENTILE,
    SHARED_DEPTH_ERROR,
)
from hybridvo.solver.correlated_errors import (
    estimate_information,
    robust_std,
    view_of,
)
from hybridvo.solver.newton import positive_inverse
from hybridvo.solver.plane_kernels import (
    NOISE_FLOOR,
    linearize_planes,
    weigh_points,
)
from hybridvo.solver.points import points_of
from hybridvo.solver.products import weighted_products
from hybridvo.solver.rows import PLANE_ROWS, PLANE_TERMS, PlaneRow

# points on a regular grid, at most
POINTS = 5000
# every fourth residual is used to fit the noise polynomial, which has three numbers
NOISE_STEP = 4
# times that the polynomial is fitted: the first identifies which residuals are outliers
# of the second
NOISE_ROUNDS = 2
# of single precision, relative: what differs by less is equal
ROUNDING = 1e-5
# mean of the absolute value of a standard normal number
MEAN_ABSOLUTE_NORMAL = np.sqrt(2 / np.pi)


# where nothing is known of the noise: it grows with the square of the depth
UNKNOWN_NOISE = np.array([0, 0, 1], np.float32)


@dataclass(frozen=True, eq=False)
class PlanesAt:
    """Distances of the points of a factor to the current surface, at one motion.

    Attributes:
        rows: (11, N) residuals and derivatives, see :class:`PlaneRow`.
        weights: (N,) robust weights, in units of information.
        noise_polynomial: (3,) of the standard deviation of a distance at a depth.
        information: (6, 6) of the motion; zero where too few points are visible.
        information_scale: factor that makes the normal equations state about as much; 0 where
            the depth maps do not determine the motion.
    """

    rows: np.ndarray
    weights: np.ndarray
    noise_polynomial: np.ndarray
    information: np.ndarray
    information_scale: float

    @property
    def determine_motion(self) -> bool:
        """Whether enough points are visible on the current surface."""
        return self.information_scale > 0

    @property
    def surface_depth(self) -> np.ndarray:
        """(N,) depth of the surface that a point is visible on, metres; 0 where it is not."""
        return self.rows[PlaneRow.SURFACE_DEPTH]

    def noise(self, z: np.ndarray) -> np.ndarray:
        """Return the fitted standard deviation (N,) at depths (N,), metres."""
        a, b, c = self.noise_polynomial
        return np.maximum(a + (b + c * z) * z, NOISE_FLOOR * z)


class PlaneFactor:
    """Distances of moved points of the previous depth map to the current one.

    Attributes:
        cells: (rows, columns) of the points on their regular grid.
        index: (N, 2) rows and columns of their pixels.
        points: (N, 3) metres, in the previous camera.
    """

    def __init__(
        self,
        pair: FramePair,
        weights: np.ndarray,
        min_weight: float,
        options: RefineOptions,
        max_points: int = POINTS,
    ) -> None:
        """Choose the points of a pair.

        Args:
            pair: two frames; the previous one has depth.
            weights: (H, W) static weights, from 0 to 1.
            min_weight: smallest weight of a pixel that is used.
            options: cutoff of the robust kernel, and number of tiles.
            max_points: about how many points there are at most.
        """
        grid = points_of(pair.prev, max_points)
        weight = np.asarray(weights)[grid.pixels[:, 0], grid.pixels[:, 1]]
        used = weight >= min_weight
        self.cells = tuple(each[used] for each in grid.cells)
        self._grid_shape = grid.shape
        self.index = grid.pixels[used]
        self.points = grid.xyz[used]
        self._points = self.points.astype(np.float32)
        self._static_weight = weight[used].astype(np.float32)
        self._depth = _current_depth(pair)
        self._quantum = depth_quantum(np.asarray(pair.prev.depth), self.index)
        camera = pair.curr.camera
        self._camera = np.array(
            [camera.fx, camera.fy, camera.cx, camera.cy], np.float32
        )
        self._view = view_of(pair.prev.camera.shape, self.index, options.tiles)
        self._cutoff = options.cutoff
        self._squared_cutoff = np.float32(options.cutoff**2)

    def inputs(self, at: PlanesAt) -> PlaneInputs:
        """What :func:`hybridvo.solver.align.align` needs, with the noise at a motion."""
        return PlaneInputs(
            self._points,
            self._depth,
            self._camera,
            self._static_weight,
            at.noise_polynomial,
            self._squared_cutoff,
            np.empty_like(at.rows),
            np.empty_like(at.weights),
            at.information_scale,
        )

    def on_grid(self, values: np.ndarray) -> np.ndarray:
        """Return values (N,) of the points on their grid, float32; 0 elsewhere."""
        grid = np.zeros(self._grid_shape, np.float32)
        grid[self.cells] = values
        return grid

    def at(self, T_curr_prev: np.ndarray) -> PlanesAt:
        """Return distances, noise and information at a motion (4, 4)."""
        count = len(self.points)
        rows = np.zeros((PLANE_ROWS, count), np.float32)
        linearize_planes(self._points, self._depth, self._camera, T_curr_prev, rows)
        seen = rows[PlaneRow.SURFACE_DEPTH] > 0
        unknown = np.zeros((6, 6))
        if np.count_nonzero(seen) < MIN_PLANE_POINTS:
            nothing = np.zeros(count, np.float32)
            return PlanesAt(rows, nothing, UNKNOWN_NOISE, unknown, 0.0)
        z = rows[PlaneRow.SURFACE_DEPTH, seen][::NOISE_STEP]
        residual = rows[PlaneRow.RESIDUAL, seen][::NOISE_STEP]
        polynomial = fit_noise(z, np.abs(residual), self._cutoff)
        # of two maps that err by up to half a quantum each
        polynomial[2] = max(polynomial[2], self._quantum / np.sqrt(6))
        weights = np.empty(count, np.float32)
        weigh_points(
            self._static_weight, polynomial, self._squared_cutoff, rows, weights
        )
        seen_at = PlanesAt(rows, weights, polynomial, unknown, 0.0)
        terms = rows[:PLANE_TERMS]
        noise = seen_at.noise(rows[PlaneRow.SURFACE_DEPTH])
        found = estimate_information(
            terms,
            weights,
            np.float32(SHARED_DEPTH_ERROR) * noise[None],
            weighted_products(terms, weights),
            self._view,
            0.0,
        )
        return replace(
            seen_at, information=found.matrix, information_scale=found.scale
        )

    def structure_information(self, at: PlanesAt) -> np.ndarray:
        """Return the information (6, 6) by structure that neighbouring points have in common.

        Noise tilts the normal of each point on its own, so that a flat wall seems to show a
        motion along it. Products of the normals of two neighbours are free of that.
        """
        number = np.full(self._grid_shape, -1)
        number[self.cells] = np.arange(len(self.points))
        pairs = np.stack([number[:, :-1].ravel(), number[:, 1:].ravel()])
        pairs = pairs[:, (pairs >= 0).all(axis=0)]
        is_seen = at.surface_depth > 0
        here, beside = pairs[:, is_seen[pairs].all(axis=0)]
        weights = np.sqrt(at.weights[here] * at.weights[beside])
        J = at.rows[PlaneRow.MOTION : PLANE_TERMS].astype(np.float64)
        weighted = J[:, here] * weights
        own = weighted @ J[:, here].T
        if positive_inverse(own) is None:
            return np.zeros((6, 6))
        common = weighted @ J[:, beside].T
        common = (common + common.T) / 2
        # the directions in which both are diagonal, and the fractions that are common
        fractions, directions = scipy.linalg.eigh(common, own)
        factors = np.sqrt(np.clip(fractions, 0, 1))
        M = np.linalg.inv(directions).T @ (factors * directions).T
        return np.asarray(M @ at.information @ M.T)


def fit_noise(z: np.ndarray, lengths: np.ndarray, cutoff: float) -> np.ndarray:
    """Fit the noise a + b z + c z^2, without negative terms, to residuals.

    Args:
        z: (N,) depths, metres.
        lengths: (N,) absolute values of the residuals at these depths, metres.
        cutoff: standard deviations beyond which a residual is an outlier.

    Returns:
        (3,) float32 a, b, c.
    """
    powers = np.stack([np.ones_like(z), z, z * z], 1)
    sigma = robust_std(lengths / powers[:, 2]) * powers[:, 2]
    for _ in range(NOISE_ROUNDS):
        is_inlier = lengths < cutoff * np.maximum(sigma, NOISE_FLOOR * z)
        # relative errors are fitted
        relative = 1 / z[is_inlier]
        terms, _ = scipy.optimize.nnls(
            powers[is_inlier] * relative[:, None], lengths[is_inlier] * relative
        )
        polynomial = (terms / MEAN_ABSOLUTE_NORMAL).astype(np.float32)
        sigma = powers @ polynomial
    return polynomial


def depth_quantum(depth: np.ndarray, index: np.ndarray) -> float:
    """Return the step in which a sensor rounds depth, divided by depth squared.

    A sensor that rounds gives many neighbours the same depth. Two maps of a camera that
    stands still are rounded alike, and then seem to agree exactly.

    Args:
        depth: (H, W) metres.
        index: (N, 2) rows and columns of some pixels with depth.

    Returns:
        The step over the square of the depth, 1 / m; 0 where depth is not rounded.
    """
    rows, columns = index.T
    z = depth[rows, columns]
    beside = depth[rows, np.minimum(columns + 1, depth.shape[1] - 1)]
    # the far half may be sky
    used = valid_depth(beside) & (z <= np.median(z)) if len(z) else z > 0
    difference = np.abs(beside - z)[used]
    z = z[used]
    is_equal = difference < ROUNDING * z
    if not len(z) or np.mean(is_equal) < MIN_EQUAL_DEPTHS or is_equal.all():
        return 0.0
    steps = difference[~is_equal] / z[~is_equal] ** 2
    return float(np.percentile(steps, QUANTUM_PERCENTILE))


def _current_depth(pair: FramePair) -> np.ndarray:
    """(H, W) float32 depth of the current frame; (1, 1) of 0 where it has none."""
    if pair.curr.depth is None:
        return as_contiguous(np.zeros((1, 1)), np.float32)
    return as_contiguous(np.asarray(pair.curr.depth), np.float32)
