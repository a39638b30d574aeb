"""The depth maps of a pair as a factor of its motion: points to planes.

A static point of the previous depth map, moved by T, lies on the plane through the current depth
map at the pixel where it is seen: ``r = n . (T X - P)``, P that pixel's point and n the normal of
its surface. Depth knows the direction along the axis that flow and images hardly see; no feature of
the image is needed.

The noise of a sensor grows with its distance: about with the square for structured light and
stereo, hardly for lidar, not at all where depth is rendered. One law for all,
``sigma = a + b z + c z^2`` with no negative term, is fitted to the residuals of the pair itself.
"""

from __future__ import annotations

import numpy as np
from scipy.optimize import nnls

from hybridvo.options import RefineOptions
from hybridvo.refinement.covariance import dispersion, tile_sums
from hybridvo.refinement.full_fit import tile_size
from hybridvo.refinement.solver import Linearization, positive_inverse
from hybridvo.types import FramePair

PIXELS = 5000
"""Used at most, on a regular grid."""
REACH = 3
"""Pixels from one of the four neighbours that span a plane to the other's middle: the steps of a
structured-light sensor are wider than one."""
EDGE = 0.1
"""Relative difference of depth between such neighbours from which on there is an edge between."""
CUTOFF = 3.0
"""c of the Geman-McClure kernel, in standard deviations."""
FLOOR = 1e-4
"""Least standard deviation, in shares of the depth."""
MEAN_LENGTH = np.sqrt(2 / np.pi)
"""Mean absolute value of a standard normal number."""
MIN_PIXELS = 300


class PlaneFactor:
    """The two depth maps of a pair, at the pixels whose weight is at least ``least``.

    ``inflation`` is a factor on the covariance beyond the tiles: a sensor is bent over the image.
    """

    def __init__(
        self, pair: FramePair, weights: np.ndarray, least: float, inflation: float = 1.0
    ) -> None:
        prev = pair.prev.camera
        step = max(1, round(np.sqrt(prev.height * prev.width / PIXELS)))
        v, u = np.mgrid[step // 2 : prev.height : step, step // 2 : prev.width : step]
        z = np.asarray(pair.prev.depth)[v, u].astype(np.float64)
        weight = np.asarray(weights)[v, u]
        used = (z > 0) & np.isfinite(z) & (weight >= least)
        u, v, z = u[used], v[used], z[used]
        self._points = np.stack([(u - prev.cx) / prev.fx * z, (v - prev.cy) / prev.fy * z, z], 1)
        self._weight = weight[used].astype(np.float64)
        tile = tile_size(prev.shape, RefineOptions().tiles)
        self._tile = (v // tile) * -(-prev.width // tile) + u // tile
        self._camera = pair.curr.camera
        self._depth = np.asarray(pair.curr.depth)
        self._inflation, self._at = inflation, np.empty(0)
        self._law, self._scale = np.array([0.0, 0.0, 1.0]), 1.0

    @classmethod
    def of(
        cls, pair: FramePair, weights: np.ndarray, least: float, inflation: float = 1.0
    ) -> PlaneFactor | None:
        """None where a depth map is missing or has too few pixels."""
        if pair.prev.depth is None or pair.curr.depth is None:
            return None
        factor = cls(pair, weights, least, inflation)
        return factor if len(factor._points) >= MIN_PIXELS else None

    def estimate(self, T: np.ndarray) -> bool:
        """Fit the noise and the scale of the information; whether enough points are seen."""
        r, _, z, seen = self._residuals(T)
        if seen.sum() < MIN_PIXELS:
            self._scale = 0.0
            return False
        z, lengths = z[seen], np.abs(r[seen])
        columns = np.stack([np.ones_like(z), z, z * z], 1)
        usual = 1.4826 * np.median(lengths / z**2) * z**2
        for _ in range(2):  # the first law says which residuals are outliers of the second
            near = lengths < CUTOFF * np.maximum(usual, FLOOR * z)
            share = 1 / z[near, None]
            self._law = nnls(columns[near] * share, lengths[near] * share[:, 0])[0] / MEAN_LENGTH
            usual = self.noise(z)
        self._estimate_scale(T)
        return self._scale > 0

    def noise(self, z: np.ndarray) -> np.ndarray:
        """Standard deviation (N,) of the residual at depths (N,), metres: the fitted law."""
        return self._law @ np.stack([np.ones_like(z), z, z * z])

    def linearize(self, T: np.ndarray) -> Linearization:
        """See :class:`hybridvo.refinement.solver.Factor`."""
        J, r, w, cost = self._weighted(T)
        weighted = J * w[:, None]
        return Linearization(
            self._scale * (weighted.T @ J), -self._scale * (weighted.T @ r), self._scale * cost
        )

    def _weighted(self, T: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray, float]:
        """(J (N, 6), r (N,), robust information (N,), cost); points unseen cost the most."""
        r, J, z, seen = self._residuals(T)
        sigma = np.maximum(self.noise(z), FLOOR * z)
        d2, c2 = (r / sigma) ** 2, CUTOFF**2
        robust = np.where(seen, c2 / (c2 + d2), 0.0)
        cost = 0.5 * self._weight @ np.where(seen, robust * d2, c2)
        return J, r, self._weight * robust**2 / sigma**2, float(cost)

    def _residuals(self, T: np.ndarray) -> tuple[np.ndarray, ...]:
        """What :meth:`_measure` finds at a motion; the last one's is kept."""
        if T is not self._at:
            self._found, self._at = self._measure(T), T
        return self._found

    def _measure(self, T: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """(r (N,), J (N, 6), depth (N,), seen (N,) bool) at a motion; finite where not seen."""
        K, depth = self._camera, self._depth
        moved = self._points @ T[:3, :3].T + T[:3, 3]
        front = np.maximum(moved[:, 2], 1e-6)
        u = np.rint(np.clip(K.fx * moved[:, 0] / front + K.cx, -1e6, 1e6)).astype(np.intp)
        v = np.rint(np.clip(K.fy * moved[:, 1] / front + K.cy, -1e6, 1e6)).astype(np.intp)
        seen = (moved[:, 2] > 1e-6) & (u >= REACH) & (u < K.width - REACH)
        seen &= (v >= REACH) & (v < K.height - REACH)
        u, v = np.where(seen, u, REACH), np.where(seen, v, REACH)
        z = depth[v, u].astype(np.float64)
        seen &= np.isfinite(z) & (z > 0)
        z = np.where(seen, z, 1.0)

        def point(du: int, dv: int) -> tuple[np.ndarray, np.ndarray]:
            other = depth[v + dv, u + du].astype(np.float64)
            near = np.abs(other - z) < EDGE * z  # False where not finite
            other = np.where(near, other, z)
            x, y = (u + du - K.cx) / K.fx, (v + dv - K.cy) / K.fy
            return np.stack([x * other, y * other, other], 1), near

        ends = [point(*shift) for shift in ((REACH, 0), (-REACH, 0), (0, REACH), (0, -REACH))]
        for _, near in ends:
            seen &= near
        (right, _), (left, _), (below, _), (above, _) = ends
        normal = np.cross(below - above, right - left)
        normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-12)
        here = point(0, 0)[0]
        r = np.where(seen, ((moved - here) * normal).sum(1), 0.0)
        return r, np.concatenate([normal, np.cross(moved, normal)], 1), z, seen

    def _estimate_scale(self, T: np.ndarray) -> None:
        """Share of the information that is left under errors alike within a tile."""
        J, r, w, _ = self._weighted(T)
        scores = J * (w * r)[:, None]
        model = positive_inverse((J * w[:, None]).T @ J)
        sums = tile_sums(scores.T, self._tile, self._tile.max() + 1)
        factor = None if model is None else dispersion(sums, scores.T @ scores, model)
        self._scale = 0.0 if factor is None else 1.0 / (factor * self._inflation)
