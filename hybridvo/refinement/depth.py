"""The depth of the current frame: a third residual per pixel, and whether it agrees with the first.

The residual is rz = log D_curr(x + F) - log Z'. Given the flow residual r it is Gaussian with mean
k^T r, k = h sd^2 Sigma^-1 q, where h = dlogZ'/dlogZ = 1 - tz/Z' and Sigma, q are those of
:mod:`hybridvo.refinement.kernels`: both residuals share the error of the previous depth. So the
full 3x3 covariance enters as one more scalar residual, rz - k^T r, with the Jacobian row
Jz - k^T J, Jz = (0, 0, i, b, -a, 0), that adds to the same normal equations. Its variance is
estimated.

Depth that is noise, or of another scale in the current frame, does not show in the flow's residual.
It shows where the motion takes each point to a pixel whose depth is known as well.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from hybridvo.calibration import DOUBTFUL_SPREAD, NO_SPREAD
from hybridvo.geometry import njit
from hybridvo.refinement.covariance import symmetric
from hybridvo.refinement.kernels import (
    BLOCK,
    COST,
    FASTMATH,
    MAX_SHIFT,
    MU,
    MV,
    PD,
    PF,
    SUMS,
    XN,
    YN,
    W,
    Z,
    new_work,
    project_block,
)
from hybridvo.refinement.pixels import PixelGrid
from hybridvo.refinement.solver import Linearization
from hybridvo.types import Frame

SURFACE = 0.05
"""Largest relative difference between the four neighbours that are interpolated."""
MAX_RATIO = 1.25
"""Of depths that may have one scale: learned depth jitters by 10 %, and where most of the image
moves towards the camera the median is theirs."""


@njit(fastmath=FASTMATH, error_model="numpy", cache=True, nogil=True)
def look_up(samples, n, step, depth, u0, v0, out):
    """Log of the current depth at the flow target of every ``step``-th pixel; NaN outside, at edges
    and at holes.
    """
    H, width = depth.shape
    for k in range(0, n, step):
        out[k] = np.nan
        if not samples[W, k] > 0:
            continue
        u = samples[MU, k] + u0
        v = samples[MV, k] + v0
        if not (u >= 0 and v >= 0 and u < width - 1 and v < H - 1):
            continue
        i = int(u)
        j = int(v)
        a, b, c, d = depth[j, i], depth[j, i + 1], depth[j + 1, i], depth[j + 1, i + 1]
        low = min(min(a, b), min(c, d))
        high = max(max(a, b), max(c, d))
        if low > 1e-6 and high < 1e9 and high < low * (1.0 + SURFACE):
            fu = u - i
            fv = v - j
            top = a + fu * (b - a)
            bottom = c + fu * (d - c)
            out[k] = math.log(top + fv * (bottom - top))


@njit(fastmath=FASTMATH, error_model="numpy", cache=True, nogil=True)
def conditional(samples, k, log_depth, pose, K, noise, row):
    """(conditional residual, raw residual, in front) of pixel ``k``; its Jacobian in ``row``."""
    x, y, z = samples[XN, k], samples[YN, k], samples[Z, k]
    X = z * (pose[0, 0] * x + pose[0, 1] * y + pose[0, 2]) + pose[0, 3]
    Y = z * (pose[1, 0] * x + pose[1, 1] * y + pose[1, 2]) + pose[1, 3]
    Zc = z * (pose[2, 0] * x + pose[2, 1] * y + pose[2, 2]) + pose[2, 3]
    if not Zc > 1e-6:
        return 0.0, 0.0, False
    tx, ty, tz = pose[0, 3], pose[1, 3], pose[2, 3]
    i = 1.0 / Zc
    a = X * i
    b = Y * i
    ru = samples[MU, k] - (K[0] * a + K[2])
    rv = samples[MV, k] - (K[1] * b + K[3])
    qu = K[0] * i * (a * tz - tx)
    qv = K[1] * i * (b * tz - ty)
    g = noise[1] * samples[PD, k] * noise[0] * samples[PF, k]
    raw = log_depth[k] - math.log(Zc)
    # Jacobian and q at the depth that the flow makes most likely, as in the kernels
    shift = g * (qu * ru + qv * rv) / (1.0 + g * (qu * qu + qv * qv))
    shift = min(max(shift, -MAX_SHIFT), MAX_SHIFT)
    a += qu * shift / K[0]
    b += qv * shift / K[1]
    i *= 1.0 - (1.0 - tz * i) * shift
    qu = K[0] * i * (a * tz - tx)
    qv = K[1] * i * (b * tz - ty)
    shrink = 1.0 / (1.0 + g * (qu * qu + qv * qv))
    h = 1.0 - tz * i
    ku = h * g * shrink * qu
    kv = h * g * shrink * qv
    fx, fy = K[0], K[1]
    row[0] = -ku * fx * i
    row[1] = -kv * fy * i
    row[2] = i + (ku * fx * a + kv * fy * b) * i
    row[3] = b + ku * fx * a * b + kv * fy * (1.0 + b * b)
    row[4] = -a - ku * fx * (1.0 + a * a) - kv * fy * a * b
    row[5] = ku * fx * b - kv * fy * a
    return raw - ku * ru - kv * rv, raw, True


@njit(error_model="numpy", cache=True, nogil=True)
def sparse_step(n):
    """Distance of the about 1000 pixels that :func:`depth_scale` looks at."""
    return max(1, n // 1000)


@njit(error_model="numpy", cache=True, nogil=True)
def depth_scale(samples, n, log_depth, robust, pose, K, noise):
    """Robust standard deviations of (conditional residual, raw residual); 0 if too few pixels."""
    row = np.empty(6)
    step = sparse_step(n)
    size = n // step + 1
    one = np.empty(size)
    two = np.empty(size)
    m = 0
    for k in range(0, n, step):
        if not (robust[k] > 0.3 and abs(log_depth[k]) < 1e6):
            continue
        e, raw, front = conditional(samples, k, log_depth, pose, K, noise, row)
        if not front:
            continue
        one[m] = abs(e)
        two[m] = abs(raw)
        m += 1
    if m < 50:
        return 0.0, 0.0
    return 1.4826 * np.median(one[:m]), 1.4826 * np.median(two[:m])


@njit(error_model="numpy", cache=True, nogil=True)
def sum_depth(
    samples, n, log_depth, pose, K, noise, sz, step, tile, columns, width, work, sums, meat
):
    """Add the third residual's normal equations to the tiles' ``sums`` (tiles, 27).

    ``sz``: standard deviation of the conditional residual. The tile follows from the place of pixel
    k on the grid of ``width`` pixels, ``step`` apart, with ``columns`` tiles in a row; ``meat``
    (21,) gets the sum of w^2 s s^T. Returns the cost.
    """
    c2 = np.float64(noise[2])
    dummy = np.zeros(SUMS)
    row = np.empty(6)
    cost = 0.0
    for o in range(0, n, BLOCK):
        m = min(BLOCK, n - o)
        project_block(samples, o, m, pose, K, noise, work, work[8], dummy)
        for j in range(m):
            k = o + j
            if not abs(log_depth[k]) < 1e6:
                continue
            e, _, front = conditional(samples, k, log_depth, pose, K, noise, row)
            if not front:
                continue
            v = sz * sz
            d2 = e * e / v
            s = c2 / (c2 + d2)
            trust = samples[W, k] * work[8, j]
            w = trust * s * s / v
            cost += 0.5 * trust * s * d2
            at = (k // width * step // tile) * columns + k % width * step // tile
            q = 0
            for p in range(6):
                for r in range(p, 6):
                    sums[at, q] += w * row[p] * row[r]
                    meat[q] += (w * e) * (w * e) * row[p] * row[r]
                    q += 1
                sums[at, 21 + p] += w * e * row[p]
    return cost


class DepthFactor:
    """The current frame's depth (H, W), given the flow, at every ``stride``-th pixel of a pair.

    ``sigma`` is the standard deviation of the conditional residual, ``noise`` (3,) that of flow and
    depth as in the kernels.
    """

    def __init__(
        self,
        image: PixelGrid,
        curr: np.ndarray,
        stride: int,
        sigma: float,
        noise: np.ndarray,
        tile: int,
    ) -> None:
        self._samples, height, self._width = image.strided(stride)
        self._log_depth = np.empty(height * self._width, np.float32)
        look_up(self._samples, height * self._width, 1, curr, *image.origin, self._log_depth)
        self._image, self._stride, self._sigma = image, stride, sigma
        self._noise, self._tile = noise, tile

    def linearize(self, T: np.ndarray) -> Linearization:
        """The sums over each tile and the meat stay as attributes."""
        rows, columns = (-(-n // self._tile) for n in self._image.shape)
        tiles, self.meat = np.zeros((rows * columns, COST)), np.zeros(21)
        cost = sum_depth(
            self._samples, len(self._log_depth), self._log_depth, T[:3], self._image.K,
            self._noise, self._sigma, self._stride, self._tile, columns, self._width,
            new_work(), tiles, self.meat,
        )  # fmt: skip
        self.tiles = tiles.reshape(rows, columns, COST)
        sums = tiles.sum(axis=0)
        return Linearization(symmetric(sums[:21]), sums[21:], cost)


@dataclass(frozen=True)
class DepthAgreement:
    """Median ratio of the second depth to that of the first frame's points, moved, and the median
    distance of its log from that of the median.
    """

    ratio: float
    spread: float

    @property
    def is_none(self) -> bool:
        """Whether the two depths have nothing to do with each other."""
        return self.spread > NO_SPREAD

    @property
    def doubt(self) -> str:
        """What is wrong between the two depths, in words; empty where nothing is."""
        if self.spread > DOUBTFUL_SPREAD:
            percent = 100 * np.expm1(self.spread)
            return f"along the motion the depths of the two frames differ by {percent:.0f} %"
        if abs(np.log(self.ratio)) > DOUBTFUL_SPREAD:
            return (
                f"the current frame's depth is {self.ratio:.3g} times the previous one's, so the "
                f"length of the translation is as uncertain"
            )
        return ""


def depth_agreement(
    curr: Frame, u: np.ndarray, v: np.ndarray, moved: np.ndarray, least: int = 100
) -> DepthAgreement | None:
    """Compare the depth of a frame with that of points of another one, moved into it.

    It asks the nearest pixel, whatever its neighbours are: in noise none agree. Points (N,) are
    seen at ``u``, ``v`` px with the depth ``moved``, metres; None where fewer than ``least`` tell.
    """
    assert curr.depth is not None  # asked by the caller
    height, width = curr.depth.shape
    with np.errstate(invalid="ignore"):
        inside = (u > -0.5) & (v > -0.5) & (u < width - 0.5) & (v < height - 0.5)
        inside &= (moved > 1e-6) & (moved < 1e9)
    at = np.rint(v[inside]).astype(np.intp), np.rint(u[inside]).astype(np.intp)
    seen = curr.depth[at].astype(np.float64)
    known = (seen > 1e-6) & (seen < 1e9)
    if curr.mask is not None:
        known &= curr.mask[at]
    if np.count_nonzero(known) < least:
        return None
    log_ratio = np.log(seen[known] / moved[inside][known])
    middle = float(np.median(log_ratio))
    return DepthAgreement(float(np.exp(middle)), float(np.median(np.abs(log_ratio - middle))))


def depth_ratio(
    prev: Frame, curr: Frame, flow: np.ndarray | None, T_curr_prev: np.ndarray
) -> float | None:
    """Median depth of the current frame over what the previous one and the motion predict.

    The scale of a whole sequence cannot be seen: all depths and all translations times s project to
    the same pixels. A scale that changes on the way can. None where too few pixels can be compared.
    """
    if flow is None or prev.depth is None or curr.depth is None:
        return None
    step = max(1, math.isqrt(prev.depth.size // 1500))
    rows, columns = (np.arange(step // 2, n, step) for n in prev.depth.shape)
    v, u = (x.ravel() for x in np.meshgrid(rows, columns, indexing="ij"))
    usable = prev.depth[v, u] > 0
    if prev.mask is not None:
        usable &= prev.mask[v, u]
    v, u = v[usable], u[usable]
    K, (a, b, c), t = prev.camera, T_curr_prev[2, :3], T_curr_prev[2, 3]
    moved = prev.depth[v, u] * (a * (u - K.cx) / K.fx + b * (v - K.cy) / K.fy + c) + t
    found = depth_agreement(curr, u + flow[v, u, 0], v + flow[v, u, 1], moved, least=50)
    return None if found is None else found.ratio


def is_step(ratio: float | None) -> bool:
    """Whether depths of one scale would not give this ratio."""
    return ratio is not None and abs(math.log(max(ratio, 1e-30))) > math.log(MAX_RATIO)
