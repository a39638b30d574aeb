"""The two depth maps of a pair as a factor of its motion: points to planes.

A static point of the previous depth map, moved by T, lies on the surface of the
current one. The noise of its distance is ``sigma = a + b z + c z^2`` at depth z,
fitted to the residuals of the pair; errors that neighbours share lower the
information.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import scipy

from hybridvo.compiled.numba_tools import as_contiguous
from hybridvo.core.geometry import valid_depth
from hybridvo.core.kept import kept_with, kept_with_frame
from hybridvo.core.options import RefineOptions
from hybridvo.core.types import Frame, FramePair
from hybridvo.solver.calibration import MIN_EQUAL_DEPTHS, QUANTUM_PERCENTILE
from hybridvo.solver.correlated_errors import view_of
from hybridvo.solver.newton import (
    Linearization,
    MotionState,
    positive_inverse,
    robust_linearization,
)
from hybridvo.solver.plane_kernels import (
    PlanesAt,
    Surfaces,
    compare_surfaces,
    sum_planes,
)
from hybridvo.solver.points import POINTS, grid_step, points_of
from hybridvo.solver.products import weighted_products
from hybridvo.solver.rows import PLANE_TERMS, PlaneRow

# Ratio to the largest eigenvalue of the (scaled) information of the depth maps, below which they
# do not determine a direction of the motion.
MIN_DEPTH_EIGENVALUE = 1e-3

# of single precision, relative: what differs by less is equal
ROUNDING = 1e-5
# guards the scale of a direction that no point determines
TINY = 1e-12


class Structure(NamedTuple):
    """What depth maps show of a motion, apart from what the noise of their normals seems to show.

    Along a direction of which a fraction f of the information is common to neighbours, a motion
    pulls at the points by f of what all of the information would; all of the noise is there.
    """

    common: np.ndarray  # (6, 6) f of the information: what a motion pulls by
    information: np.ndarray  # (6, 6) f^2 of it: what is left beside the noise


class PlaneFactor:
    """Two depth maps as a factor of the motion of their pair, before weights are handed to it.

    Args:
        pair: two frames; the previous one has depth.
        max_points: about how many points there are at most.
    """

    def __init__(self, pair: FramePair, max_points: int) -> None:
        self.grid = points_of(pair.prev, max_points)
        self.size = pair.prev.camera.shape
        camera = pair.curr.camera
        self.camera = np.array(
            [camera.fx, camera.fy, camera.cx, camera.cy], np.float32
        )
        self.depth = _current_depth(pair)
        self.quantum = _quantum_of(pair.prev)

    def weighted(
        self, weights: np.ndarray, min_weight: float, options: RefineOptions
    ) -> WeightedPlanes:
        """Return the factor under weights.

        Args:
            weights: (H, W) static weights, from 0 to 1.
            min_weight: smallest weight of a pixel that is used.
            options: cutoff of the robust kernel, and number of tiles.
        """
        return WeightedPlanes(self, weights, min_weight, options)


def planes_of(pair: FramePair, max_points: int = POINTS) -> PlaneFactor:
    """Return the depth maps of a pair as a factor; it is made once, and lent to all.

    Args:
        pair: two frames; the previous one has depth.
        max_points: about how many points there are at most.
    """
    factors = _factors(pair)
    step = grid_step(pair.prev.camera.shape, max_points)
    if step not in factors:
        factors[step] = PlaneFactor(pair, max_points)
    return factors[step]


@kept_with
def _factors(pair: FramePair) -> dict[int, PlaneFactor]:
    """The factors that were made so far, by the step of their grid."""
    return {}


class WeightedPlanes:
    """Distances of moved points of the previous depth map to the current one, under weights.

    Attributes:
        cells: (rows, columns) of the points on their regular grid.
        index: (N, 2) rows and columns of their pixels.
        points: (N, 3) metres, in the previous camera.
    """

    def __init__(
        self,
        factor: PlaneFactor,
        weights: np.ndarray,
        min_weight: float,
        options: RefineOptions,
    ) -> None:
        """Choose the points with enough weight; see :meth:`PlaneFactor.weighted`."""
        grid = factor.grid
        weight = np.asarray(weights)[grid.pixels[:, 0], grid.pixels[:, 1]]
        used = weight >= min_weight
        self.cells = tuple(each[used] for each in grid.cells)
        self._grid_shape = grid.shape
        self.index = grid.pixels[used]
        self.points = grid.xyz[used]
        self._surfaces = Surfaces(
            self.points.astype(np.float32),
            weight[used].astype(np.float32),
            factor.depth,
            factor.camera,
            float(options.cutoff),
            factor.quantum,
            view_of(factor.size, self.index, options.tiles),
        )

    def under(self, at: PlanesAt) -> NoisyPlanes:
        """Return the factor under the noise that was found at a motion."""
        return NoisyPlanes(
            self._surfaces,
            at.noise_polynomial,
            np.empty_like(at.rows),
            np.empty_like(at.weights),
            at.information.scale,
        )

    def on_grid(self, values: np.ndarray) -> np.ndarray:
        """Return values (N,) of the points on their grid, float32; 0 elsewhere."""
        grid = np.zeros(self._grid_shape, np.float32)
        grid[self.cells] = values
        return grid

    def at(self, T_curr_prev: np.ndarray) -> PlanesAt:
        """Return distances, noise and information at a motion (4, 4)."""
        found: PlanesAt = compare_surfaces(self._surfaces, T_curr_prev)
        return found

    def structure(self, at: PlanesAt) -> Structure:
        """Return what neighbouring points show in common, apart from what is noise.

        Noise tilts the normal of each point on its own, so that a flat wall seems to show a
        motion along it. Products of the normals of two neighbours are free of that.
        """
        nothing = Structure(np.zeros((6, 6)), np.zeros((6, 6)))
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
            return nothing
        common = weighted @ J[:, beside].T
        common = (common + common.T) / 2
        # the directions in which both are diagonal, and the fractions that are common
        fractions, directions = scipy.linalg.eigh(common, own)
        fractions = np.clip(fractions, 0, 1)
        back = np.linalg.inv(directions).T

        def scaled(factors: np.ndarray) -> np.ndarray:
            M = back @ (factors * directions).T
            return np.asarray(M @ at.information.matrix @ M.T)

        return Structure(scaled(np.sqrt(fractions)), scaled(fractions))


def determined_step(at: PlanesAt) -> np.ndarray:
    """Gauss-Newton step (6,) of the depth maps alone where they determine it."""
    products = weighted_products(at.rows[:PLANE_TERMS], at.weights)
    H = products[PlaneRow.MOTION :, PlaneRow.MOTION :]
    gradient = products[PlaneRow.MOTION :, PlaneRow.RESIDUAL]
    scale = 1 / np.sqrt(np.diag(H) + TINY)
    eigenvalues, vectors = np.linalg.eigh(H * np.outer(scale, scale))
    determined = eigenvalues > MIN_DEPTH_EIGENVALUE * eigenvalues[-1]
    vectors = vectors[:, determined]
    inverse = (vectors / eigenvalues[determined]) @ vectors.T
    return np.asarray(-scale * (inverse @ (scale * gradient)))


class NoisyPlanes(NamedTuple):
    """The depth maps as a factor, under a known noise."""

    surfaces: Surfaces
    noise_polynomial: np.ndarray  # (3,) float32, see weigh_points
    rows: np.ndarray  # (11, N) float32 to work in, see PlaneRow
    weights: np.ndarray  # (N,) float32 to work in
    information_scale: float  # factor on the information; 0: they are not used

    def linearize(self, state: MotionState) -> Linearization:
        """Return the normal equations of the motion."""
        return robust_linearization(*sum_planes(self, state.T_curr_prev))


@kept_with_frame
def _quantum_of(frame: Frame) -> float:
    """The step in which the sensor of a frame rounds, see :func:`depth_quantum`."""
    return depth_quantum(np.asarray(frame.depth), points_of(frame).pixels)


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
