"""The depth of the current frame: a third residual per pixel, and whether it agrees with the first.

The residual is rz = log D_curr(x + F) - log Z'. Given the flow residual r it is Gaussian with mean
k^T r, k = h sd^2 Sigma^-1 q, where h = dlogZ'/dlogZ = 1 - tz/Z' and Sigma, q are those of
:mod:`hybridvo.refinement.kernels`. So rz - k^T r, with the Jacobian row Jz - k^T J,
Jz = (0, 0, i, b, -a, 0), adds to the same normal equations; its variance is estimated.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from hybridvo.calibration import DOUBTFUL_SPREAD, NO_SPREAD
from hybridvo.geometry import backproject, njit
from hybridvo.refinement import kernels
from hybridvo.refinement.coarse_fit import robust_weights
from hybridvo.refinement.covariance import symmetric
from hybridvo.refinement.kernels import FASTMATH, MAX_VALUE, MIN_DEPTH, W
from hybridvo.refinement.pixels import PixelGrid
from hybridvo.refinement.solver import Linearization
from hybridvo.results import Reason, Status
from hybridvo.types import FramePair

SURFACE = 0.05
"""Largest relative difference between the four neighbours that are interpolated."""
MIN_COMPARED, COMPARED = 100, 4000
"""Fewest points whose depths are compared, and about how many are looked at."""


@njit(fastmath=FASTMATH, error_model="numpy", cache=True, nogil=True)
def look_up(samples, n, depth):
    """Log of the current depth at the flow target of ``n`` pixels; NaN outside, at edges, holes."""
    (H, width), out = depth.shape, np.full(n, np.nan, np.float32)
    for k in range(n):
        u, v = samples[kernels.MU, k], samples[kernels.MV, k]
        if not (samples[W, k] > 0 and u >= 0 and v >= 0 and u < width - 1 and v < H - 1):
            continue
        i, j = int(u), int(v)
        a, b, c, d = depth[j, i], depth[j, i + 1], depth[j + 1, i], depth[j + 1, i + 1]
        low, high = min(min(a, b), min(c, d)), max(max(a, b), max(c, d))
        if low > 1e-6 and high < 1e9 and high < low * (1.0 + SURFACE):
            top, bottom = a + (u - i) * (b - a), c + (u - i) * (d - c)
            out[k] = math.log(top + (v - j) * (bottom - top))
    return out


@njit(fastmath=FASTMATH, error_model="numpy", cache=True, nogil=True)
def conditional(samples, k, log_depth, entries, K, noise, row):
    """(conditional residual, raw one, known and in front) of pixel ``k``; ``row``: Jacobian."""
    x, y, z = samples[kernels.XN, k], samples[kernels.YN, k], samples[kernels.Z, k]
    a, b, i, front = kernels.see(x, y, z, entries)
    fx, fy = K[0], K[1]
    ru = samples[kernels.MU, k] - (fx * a + K[2])
    rv = samples[kernels.MV, k] - (fy * b + K[3])
    g = noise[1] * samples[kernels.PD, k] * noise[0] * samples[kernels.PF, k]
    raw = log_depth[k] + math.log(i)
    a, b, i, qu, qv, kappa = kernels.at_likely_depth(a, b, i, ru, rv, g, entries, K)
    h = 1.0 - entries[11] * i
    ku, kv = h * kappa * qu, h * kappa * qv
    row[0] = -ku * fx * i
    row[1] = -kv * fy * i
    row[2] = i + (ku * fx * a + kv * fy * b) * i
    row[3] = b + ku * fx * a * b + kv * fy * (1.0 + b * b)
    row[4] = -a - ku * fx * (1.0 + a * a) - kv * fy * a * b
    row[5] = ku * fx * b - kv * fy * a
    return raw - ku * ru - kv * rv, raw, front and abs(log_depth[k]) < 1e6


@njit(error_model="numpy", cache=True, nogil=True)
def depth_scale(samples, log_depth, robust, pose, K, noise):
    """Robust standard deviations of (conditional residual, raw residual); 0 if too few pixels."""
    row, found, entries, m = np.empty(6), np.empty((2, len(robust))), kernels.pose_entries(pose), 0
    for k in range(len(robust)):
        e, raw, good = conditional(samples, k, log_depth, entries, K, noise, row)
        if good and robust[k] > 0.3:
            found[0, m], found[1, m] = abs(e), abs(raw)
            m += 1
    if m < 50:
        return 0.0, 0.0
    return 1.4826 * np.median(found[0, :m]), 1.4826 * np.median(found[1, :m])


@njit(error_model="numpy", cache=True, nogil=True)
def sum_depth(samples, log_depth, robust, pose, K, noise, sz, tiles, sums, meat):
    """Add the third residual's normal equations to ``sums`` (tiles, 27); returns the cost.

    ``sz``: its standard deviation; ``tiles`` (n,) of each pixel; ``meat`` (21,): sum of w^2 s s^T.
    """
    c2, v = np.float64(noise[2]), sz * sz
    row, entries, cost = np.empty(6), kernels.pose_entries(pose), 0.0
    for k in range(len(log_depth)):
        e, _, good = conditional(samples, k, log_depth, entries, K, noise, row)
        if not good:
            continue
        d2 = e * e / v
        s = c2 / (c2 + d2)
        trust = samples[W, k] * robust[k]
        w = trust * s * s / v
        cost += 0.5 * trust * s * d2
        q = 0
        for p in range(6):
            for r in range(p, 6):
                sums[tiles[k], q] += w * row[p] * row[r]
                meat[q] += (w * e) * (w * e) * row[p] * row[r]
                q += 1
            sums[tiles[k], 21 + p] += w * e * row[p]
    return cost


class DepthFactor:
    """The current frame's depth (H, W), given the flow, at every ``stride``-th pixel of a pair;
    ``sigma``: standard deviation of the conditional residual.
    """

    def __init__(
        self, grid: PixelGrid, curr: np.ndarray, stride: int, sigma: float, noise: np.ndarray,
        tile: int,
    ) -> None:  # fmt: skip
        self._samples, height, width = grid.strided(stride)
        self._log_depth = look_up(self._samples, height * width, curr)
        self._K, self._sigma, self._noise = grid.K, sigma, noise
        row, column = (np.arange(n) * stride // tile for n in (height, width))
        self._shape = tuple(-(-n // tile) for n in grid.size)
        self._tiles = (row[:, None] * self._shape[1] + column).ravel()

    def linearize(self, T: np.ndarray) -> Linearization:
        """The sums over each tile and the meat stay as attributes."""
        where = T[:3], self._K, self._noise
        robust = robust_weights(self._samples, len(self._log_depth), *where)
        tiles, self.meat = np.zeros((*self._shape, kernels.COST)), np.zeros(21)
        cost = sum_depth(
            self._samples, self._log_depth, robust, *where, self._sigma, self._tiles,
            tiles.reshape(-1, kernels.COST), self.meat,
        )  # fmt: skip
        self.tiles, sums = tiles, tiles.sum(axis=(0, 1))
        return Linearization(symmetric(sums[:21]), sums[21:], cost)


class DepthAgreement(NamedTuple):
    """Median ratio of the current depth to the previous points', moved; spread of its log."""

    ratio: float
    spread: float

    @property
    def status(self) -> Status:
        """What is wrong between the two depths: failed where they have nothing in common."""
        if self.spread > DOUBTFUL_SPREAD:
            percent = 100 * np.expm1(self.spread)
            text = f"along the motion the depths of the two frames differ by {percent:.0f} %"
            wrong = Status.failed if self.spread > NO_SPREAD else Status.degraded
            return wrong(Reason.NO_VALID_DEPTH, text)
        if abs(np.log(self.ratio)) > DOUBTFUL_SPREAD:
            return Status.degraded(
                Reason.NO_VALID_DEPTH,
                f"the current frame's depth is {self.ratio:.3g} times the previous one's, so the "
                f"length of the translation is as uncertain",
            )
        return Status()


def compare_depths(
    pair: FramePair, T_curr_prev: np.ndarray, weights: np.ndarray | None
) -> DepthAgreement | None:
    """Compare both depths of a pair where the robust weights (H, W) of a motion exceed one half.

    At the nearest pixel, whatever its neighbours are: in noise none agree. None where too few tell.
    """
    prev, curr, flow = pair.prev, pair.curr, pair.flow
    if flow is None or prev.depth is None or curr.depth is None or weights is None:
        return None
    (height, width), step = prev.depth.shape, max(1, math.isqrt(prev.depth.size // COMPARED))
    first = step // 2
    v, u = (first + step * k for k in np.nonzero(weights[first::step, first::step] > 0.5))
    points = backproject(prev.depth, prev.camera, np.stack([v, u], axis=1))
    moved = points @ T_curr_prev[2, :3] + T_curr_prev[2, 3]
    column, row = np.rint(u + flow[v, u, 0]), np.rint(v + flow[v, u, 1])
    inside = (row >= 0) & (column >= 0) & (row < height) & (column < width) & (moved > MIN_DEPTH)
    at = row[inside].astype(np.intp), column[inside].astype(np.intp)
    seen = curr.depth[at].astype(np.float64)
    known = (seen > MIN_DEPTH) & (seen < MAX_VALUE)
    if curr.mask is not None:
        known &= curr.mask[at]
    if np.count_nonzero(known) < MIN_COMPARED:
        return None
    log_ratio = np.log(seen[known] / moved[inside][known])
    middle = float(np.median(log_ratio))
    return DepthAgreement(float(np.exp(middle)), float(np.median(np.abs(log_ratio - middle))))
