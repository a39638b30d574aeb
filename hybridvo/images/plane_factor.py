"""The two depth maps of a pair as a factor of its motion: points to planes."""

from __future__ import annotations

from typing import NamedTuple

import cv2
import numpy as np
from scipy.optimize import nnls

from hybridvo.geometry import njit
from hybridvo.options import RefineOptions
from hybridvo.refinement.covariance import dispersion, tile_size, tile_sums
from hybridvo.refinement.kernels import MAX_VALUE, MIN_DEPTH
from hybridvo.refinement.pixels import as_contiguous
from hybridvo.refinement.solver import Linearization, positive_inverse
from hybridvo.types import FramePair

POINTS = 5000
"""On a regular grid, at most."""
REACH = 3
"""Pixels from one of the four neighbours that span a plane to the other's middle: the steps of a
structured-light sensor are wider than one."""
EDGE = 0.1
"""Relative difference of depth between such neighbours from which on there is an edge between."""
FLOOR = 1e-4
"""Least standard deviation, in shares of the depth."""
CUTOFF = 3.0
"""c of the Geman-McClure kernel, in standard deviations."""
MEAN_LENGTH = np.sqrt(2 / np.pi)
"""Mean absolute value of a standard normal number."""
INFLATION = 4.0
"""Factor on the covariance of images and depth maps beyond the tiles: a sensor is bent over the
image, errors are alike far beyond them."""
MIN_POINTS = 300


class Residuals(NamedTuple):
    """Points of the previous depth map at a motion.

    ``r`` (N,) m, signed distance to the plane, 0 where not seen; ``J`` (N, 6) its derivative; ``z``
    (N,) m, depth of the plane, 1 where not seen; ``seen`` (N,) bool, the current depth map has a
    surface there; ``at`` (N, 2) px, where the point falls in the current image.
    """

    r: np.ndarray
    J: np.ndarray
    z: np.ndarray
    seen: np.ndarray
    at: np.ndarray


class PlaneFactor:
    """A static point of the previous depth map, moved by T, lies on the current one's surface.

    ``r = n . (T X - P)``, P the current depth map's point at the pixel where T X is seen and n the
    normal of its surface there. Depth knows the direction along the axis that flow and images
    hardly see, and needs no feature of the image.

    The noise of a sensor grows with its distance: about with the square for structured light and
    stereo, hardly for lidar, not at all where depth is rendered. One law for all,
    ``sigma = a + b z + c z^2`` with no negative term, is fitted to the residuals of the pair.

    Used are the pixels with at least the weight ``least`` on a regular grid of at most ``points``.
    """

    def __init__(
        self, pair: FramePair, weights: np.ndarray, least: float, points: int = POINTS
    ) -> None:
        prev = pair.prev.camera
        step = max(1, round(np.sqrt(prev.height * prev.width / points)))
        v, u = np.mgrid[step // 2 : prev.height : step, step // 2 : prev.width : step]
        z = np.asarray(pair.prev.depth)[v, u].astype(np.float64)
        weight = np.asarray(weights)[v, u]
        used = (z > 0) & np.isfinite(z) & (weight >= least)
        self.cells, self._grid, self._shape = np.nonzero(used), used.shape, prev.shape
        """Rows and columns of the points, on their grid."""
        self.index = np.stack([v[used], u[used]], 1)
        """(N, 2) rows and columns of the points, px."""
        u, v, z = u[used], v[used], z[used]
        self.points = np.stack([(u - prev.cx) / prev.fx * z, (v - prev.cy) / prev.fy * z, z], 1)
        self._weight = weight[used].astype(np.float64)
        tile = tile_size(prev.shape, RefineOptions().tiles)
        self._tile = (v // tile) * -(-prev.width // tile) + u // tile
        camera = pair.curr.camera
        self._K = np.array([camera.fx, camera.fy, camera.cx, camera.cy])
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
        """Fit the noise law, and the share of the information that errors alike in a tile leave.

        Whether enough points are seen.
        """
        found = self.residuals(T)
        if found.seen.sum() < MIN_POINTS:
            self._scale = 0.0
            return False
        z, lengths = found.z[found.seen], np.abs(found.r[found.seen])
        columns = np.stack([np.ones_like(z), z, z * z], 1)
        usual = 1.4826 * np.median(lengths / z**2) * z**2
        for _ in range(2):  # the first law says which residuals are outliers of the second
            near = lengths < CUTOFF * np.maximum(usual, FLOOR * z)
            share = 1 / z[near, None]
            self._law = nnls(columns[near] * share, lengths[near] * share[:, 0])[0] / MEAN_LENGTH
            usual = self.noise(z)
        w = self._information(T)
        scores = found.J * (w * found.r)[:, None]
        model = positive_inverse((found.J * w[:, None]).T @ found.J)
        sums = tile_sums(scores.T, self._tile, self._tile.max() + 1)
        factor = None if model is None else dispersion(sums, scores.T @ scores, model)
        self._scale = 0.0 if factor is None else 1.0 / (factor * INFLATION)
        return self._scale > 0

    def noise(self, z: np.ndarray) -> np.ndarray:
        """Standard deviation (N,) of the residual at depths (N,), metres: the fitted law."""
        a, b, c = self._law
        return np.maximum(a + (b + c * z) * z, FLOOR * z)

    def robust(self, T: np.ndarray) -> np.ndarray:
        """(N,) factors in [0, 1] of the robust kernel, 0 where a point is not seen."""
        found = self.residuals(T)
        d2 = (found.r / self.noise(found.z)) ** 2
        return np.where(found.seen, CUTOFF**2 / (CUTOFF**2 + d2), 0.0)

    def linearize(self, T: np.ndarray) -> Linearization:
        """See :class:`hybridvo.refinement.solver.Factor`; points unseen cost the most."""
        found, scale = self.residuals(T), self._scale
        cost = 0.5 * CUTOFF**2 * float(self._weight @ (1 - self.robust(T)))
        weighted = scale * (found.J * self._information(T)[:, None]).T
        return Linearization(weighted @ found.J, -(weighted @ found.r), scale * cost)

    def residuals(self, T: np.ndarray) -> Residuals:
        """At a motion; the last one's are kept."""
        if T is not self._at:
            n = len(self.points)
            r, J, z, at = np.empty(n), np.empty((n, 6)), np.empty(n), np.empty((n, 2))
            seen = np.empty(n, np.bool_)
            measure(self.points, T, self._depth, self._K, r, J, z, seen, at)
            self._found, self._at = Residuals(r, J, z, seen, at), T
        return self._found

    def _information(self, T: np.ndarray) -> np.ndarray:
        """(N,) 1 / m^2."""
        return self._weight * (self.robust(T) / self.noise(self.residuals(T).z)) ** 2


@njit(cache=True, nogil=True)
def point(depth, u, v, K):
    """The point of a pixel, metres."""
    z = np.float64(depth[v, u])
    return (u - K[2]) / K[0] * z, (v - K[3]) / K[1] * z, z


@njit(cache=True, nogil=True)
def measure(points, T, depth, K, r, J, z, seen, at):
    """Distances of moved points (N, 3) to the surface of a depth map, see :class:`Residuals`."""
    height, width = depth.shape
    for k in range(len(points)):
        seen[k], r[k], z[k] = False, 0.0, 1.0
        J[k], at[k] = 0.0, -1.0
        a, b, c = points[k]
        X = T[0, 0] * a + T[0, 1] * b + T[0, 2] * c + T[0, 3]
        Y = T[1, 0] * a + T[1, 1] * b + T[1, 2] * c + T[1, 3]
        Z = T[2, 0] * a + T[2, 1] * b + T[2, 2] * c + T[2, 3]
        if not Z > MIN_DEPTH:
            continue
        x, y = K[0] * X / Z + K[2], K[1] * Y / Z + K[3]
        at[k, 0], at[k, 1] = x, y
        if not (REACH - 0.5 < x < width - REACH - 0.5 and REACH - 0.5 < y < height - REACH - 0.5):
            continue
        u, v = int(np.rint(x)), int(np.rint(y))
        px, py, pz = point(depth, u, v, K)
        rx, ry, rz = point(depth, u + REACH, v, K)
        lx, ly, lz = point(depth, u - REACH, v, K)
        bx, by, bz = point(depth, u, v + REACH, K)
        tx, ty, tz = point(depth, u, v - REACH, K)
        edge = EDGE * pz
        whole = abs(rz - pz) < edge and abs(lz - pz) < edge  # False where not finite
        whole = whole and abs(bz - pz) < edge and abs(tz - pz) < edge
        if not (whole and MIN_DEPTH < pz < MAX_VALUE):
            continue
        rx, ry, rz, bx, by, bz = rx - lx, ry - ly, rz - lz, bx - tx, by - ty, bz - tz
        nx, ny, nz = by * rz - bz * ry, bz * rx - bx * rz, bx * ry - by * rx
        length = max(np.sqrt(nx * nx + ny * ny + nz * nz), 1e-12)
        nx, ny, nz = nx / length, ny / length, nz / length
        r[k] = (X - px) * nx + (Y - py) * ny + (Z - pz) * nz
        J[k, 0], J[k, 1], J[k, 2] = nx, ny, nz
        J[k, 3], J[k, 4], J[k, 5] = Y * nz - Z * ny, Z * nx - X * nz, X * ny - Y * nx
        z[k], seen[k] = pz, True
