"""Numba kernels of what PWVO reads of a motion hypothesis: in one pass what torch does in 150.

:mod:`hybridvo.network.hypothesis_readings` computes the same in torch, for training and for
other devices; a test holds both equal. The maps are so small that torch spends most of its
time between its operations.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from hybridvo.compiled.numba_tools import njit

MIN_FLOW_NOISE = 0.01
"""Smallest standard deviation of the flow, px."""
SUPPORT_CUTOFF_SQUARED = 9.0
"""Square of the robust kernel's cutoff, in variances of the residual."""
MIN_DEPTH_STD = 0.003
"""Standard deviation of log depth that even exact depths have between neighbouring pixels."""
PATCH = 5
"""Side of the patches that are correlated, in pixels of the grid."""
HALF_TEXTURE_VARIANCE = 9.0
"""Variance of a patch that counts half as texture, grey levels squared. Sensor noise alone has
about 2."""
MIN_PATCH_COVER = 0.3
"""Smallest fraction of a patch that is visible in both images, for it to count as texture."""
ALL_KNOWN = 0.99
"""Weight of the neighbours with depth, of those between which depth is read."""
FAR_RESIDUAL = 1e3
"""Residual of a pixel behind the camera, and the largest one, in standard deviations."""
MIN_Z = 1e-6
"""Smallest depth in front of a camera, m."""

# single precision, as torch computes
_SUPPORT = np.float32(SUPPORT_CUTOFF_SQUARED)
_FAR = np.float32(FAR_RESIDUAL)
_MIN_Z = np.float32(MIN_Z)
_TEXTURE = np.float32(HALF_TEXTURE_VARIANCE)
_ZERO = np.float32(0.0)
_HALF = np.float32(0.5)
_ONE = np.float32(1.0)
# maps whose means over patches are taken: visible, the two images, their products
_TERMS = 6


class PairMaps(NamedTuple):
    """The maps of one pair as arrays, see :class:`hybridvo.network.grid_maps.GridMaps`."""

    ray: np.ndarray
    depth: np.ndarray
    target: np.ndarray
    flow_variance: np.ndarray
    depth_variance: np.ndarray
    usable: np.ndarray
    log_depth_at_target: np.ndarray
    K: np.ndarray
    stride: int
    has_depth: np.ndarray
    image_prev: np.ndarray
    image_curr: np.ndarray
    log_depth_curr: np.ndarray


class HypothesisReadings(NamedTuple):
    """Maps (N, h, w) of N hypotheses; flags are 1 or 0."""

    u: Any  # px, where the hypothesis leads
    v: Any
    log_z: Any  # log metres, there
    in_front: Any  # bool: of the camera
    known: Any  # bool: flow and depth are known, and it is in front
    eu: Any  # what it leaves of the flow, standard deviations
    ev: Any
    length: Any  # the same, px
    support: Any  # robust weight of the flow
    # log of the current depth over that of the hypothesis; 0 if unknown
    depth_residual: Any
    has_depth: Any  # flag: that is known
    texture: Any  # of the previous image, from 0 to 1
    agreement: Any  # texture times the correlation of the two images
    depth_ratio: Any  # log of the depths where it leads; 0 if unknown
    is_compared: Any  # flag: that is known


@njit(error_model="numpy", cache=True, nogil=True)
def read_flow_of_hypothesis(maps, pose, noise, n, out):
    """Fill what a hypothesis leaves of the flow, and where it leads.

    Args:
        maps: a :class:`PairMaps`.
        pose: (3, 4) float32 ``T_curr_prev``.
        noise: standard deviations of the flow, px, and of log depth.
        n: number of the hypothesis.
        out: a :class:`HypothesisReadings` of float32 arrays, of which row ``n`` is filled.
    """
    fx, fy, cx, cy = maps.K
    flow_variance = noise[0] * noise[0]
    depth_variance = noise[1] * noise[1]
    rows, columns = maps.depth.shape
    for r in range(rows):
        for k in range(columns):
            x = maps.ray[0, r, k]
            y = maps.ray[1, r, k]
            z = maps.depth[r, k]
            a = z * (pose[0, 0] * x + pose[0, 1] * y + pose[0, 2]) + pose[0, 3]
            b = z * (pose[1, 0] * x + pose[1, 1] * y + pose[1, 2]) + pose[1, 3]
            c = z * (pose[2, 0] * x + pose[2, 1] * y + pose[2, 2]) + pose[2, 3]
            in_front = c > _MIN_Z
            i = _ONE / (c if in_front else _ONE)
            a *= i
            b *= i
            u = fx * a + cx
            v = fy * b + cy
            ru = maps.target[0, r, k] - u
            rv = maps.target[1, r, k] - v
            qu = fx * i * (a * pose[2, 3] - pose[0, 3])
            qv = fy * i * (b * pose[2, 3] - pose[1, 3])
            vd = depth_variance * maps.depth_variance[r, k]
            information = _ONE / (flow_variance * maps.flow_variance[r, k])
            g = vd * information
            root = np.sqrt(_ONE + g * (qu * qu + qv * qv))
            shrink = g / (root * (_ONE + root)) * (qu * ru + qv * rv)
            scale = np.sqrt(information)
            usable = maps.usable[r, k]
            known = usable and in_front
            eu = _limited((ru - shrink * qu) * scale if known else _FAR)
            ev = _limited((rv - shrink * qv) * scale if known else _FAR)
            robust = _SUPPORT / (_SUPPORT + eu * eu + ev * ev)
            log_depth = maps.log_depth_at_target[r, k]
            has_depth = known and np.isfinite(log_depth)
            distance = np.log(max(c, _MIN_Z))
            out.u[n, r, k] = u
            out.v[n, r, k] = v
            out.log_z[n, r, k] = distance
            out.in_front[n, r, k] = in_front
            out.known[n, r, k] = known
            out.eu[n, r, k] = eu
            out.ev[n, r, k] = ev
            out.length[n, r, k] = np.sqrt(ru * ru + rv * rv)
            out.support[n, r, k] = robust * robust if usable else _ZERO
            out.depth_residual[n, r, k] = (
                log_depth - distance if has_depth else _ZERO
            )
            out.has_depth[n, r, k] = _ONE if has_depth else _ZERO


@njit(error_model="numpy", cache=True, nogil=True)
def _limited(residual):
    """A residual in standard deviations, at most :data:`FAR_RESIDUAL`."""
    return min(max(residual, -_FAR), _FAR)


@njit(error_model="numpy", cache=True, nogil=True)
def compare_images_of_hypothesis(maps, n, out):
    """Fill how well the two images and the two depth maps agree along a hypothesis.

    Args:
        maps: a :class:`PairMaps`.
        n: number of the hypothesis, for which :func:`read_flow_of_hypothesis` was called.
        out: a :class:`HypothesisReadings` of float32 arrays, of which row ``n`` is filled.
    """
    rows, columns = maps.depth.shape
    rows_curr, columns_curr = maps.image_curr.shape
    first = np.float32(maps.stride // 2)
    inverse = _ONE / np.float32(maps.stride)
    terms = np.zeros((_TERMS, rows, columns), np.float32)
    for r in range(rows):
        for k in range(columns):
            out.depth_ratio[n, r, k] = _ZERO
            out.is_compared[n, r, k] = _ZERO
            # place in the current grid
            x = (out.u[n, r, k] - first) * inverse
            y = (out.v[n, r, k] - first) * inverse
            is_inside = -_HALF < x < columns_curr - _HALF
            is_inside &= -_HALF < y < rows_curr - _HALF
            if not (is_inside and out.in_front[n, r, k] and maps.has_depth[r, k]):
                continue
            q, log_depth, known = _read_current(maps, x, y)
            p = maps.image_prev[r, k]
            terms[0, r, k] = _ONE
            terms[1, r, k] = p
            terms[2, r, k] = q
            terms[3, r, k] = p * p
            terms[4, r, k] = q * q
            terms[5, r, k] = p * q
            if known > np.float32(ALL_KNOWN):
                out.depth_ratio[n, r, k] = log_depth - out.log_z[n, r, k]
                out.is_compared[n, r, k] = _ONE
    means = patch_means(terms)
    for r in range(rows):
        for k in range(columns):
            cover = means[0, r, k]
            count = max(cover, np.float32(1e-6))
            mean_p = means[1, r, k] / count
            mean_q = means[2, r, k] / count
            var_p = max(means[3, r, k] / count - mean_p * mean_p, _ZERO)
            var_q = max(means[4, r, k] / count - mean_q * mean_q, _ZERO)
            covariance = means[5, r, k] / count - mean_p * mean_q
            is_covered = terms[0, r, k] > _ZERO and cover > np.float32(
                MIN_PATCH_COVER
            )
            texture = var_p / (var_p + _TEXTURE) if is_covered else _ZERO
            noise = np.sqrt(var_p * var_q) + _HALF * _TEXTURE
            out.texture[n, r, k] = texture
            out.agreement[n, r, k] = texture * covariance / noise


@njit(error_model="numpy", cache=True, nogil=True)
def _read_current(maps, x, y):
    """Grey level, log depth and weight of the known depth between pixels of the current grid."""
    rows, columns = maps.image_curr.shape
    x = min(max(x, _ZERO), np.float32(columns - 1))
    y = min(max(y, _ZERO), np.float32(rows - 1))
    left = int(x)
    top = int(y)
    grey = _ZERO
    log_depth = _ZERO
    known = _ZERO
    for below in range(2):
        row = min(top + below, rows - 1)
        down = y - top if below else _ONE - (y - top)
        for beside in range(2):
            column = min(left + beside, columns - 1)
            weight = np.float32(down * (x - left if beside else _ONE - (x - left)))
            grey += weight * maps.image_curr[row, column]
            depth = maps.log_depth_curr[row, column]
            if np.isfinite(depth):
                log_depth += weight * depth
                known += weight
    return grey, log_depth, known


@njit(error_model="numpy", cache=True, nogil=True)
def patch_means(maps):
    """Return averages of maps (M, h, w) over the patch around each pixel, zeros outside."""
    count, rows, columns = maps.shape
    side = PATCH // 2
    along = np.zeros_like(maps)
    for m in range(count):
        for r in range(rows):
            for shift in range(-side, side + 1):
                begin = max(0, -shift)
                end = min(columns, columns - shift)
                for k in range(begin, end):
                    along[m, r, k] += maps[m, r, k + shift]
    means = np.zeros_like(maps)
    scale = np.float32(1 / PATCH**2)
    for m in range(count):
        for r in range(rows):
            for shift in range(max(-side, -r), min(side, rows - 1 - r) + 1):
                for k in range(columns):
                    means[m, r, k] += scale * along[m, r + shift, k]
    return means
