"""Numba kernels of the refinement: one pass over the pixels gives the 6x6 normal equations.

For each pixel, with X' = T X, a = X'/Z', b = Y'/Z', i = 1/Z' (conventions of
:mod:`hybridvo.core.types`). :mod:`hybridvo.solver.torch.factors` computes the same; a test
holds both equal:

- residual r = (x + F) - pi(X');
- Jacobian of pi(X') with respect to the left perturbation (translation, rotation):
  diag(fx, fy) B, B = [[i, 0, -a i, -a b, 1 + a^2, -b], [0, i, -b i, -(1 + b^2), a b, a]];
- q = d pi(X') / d log Z = (fx i (a tz - tx), fy i (b tz - ty));
- covariance sf^2 v_f I + sd^2 v_d q q^T (flow noise and propagated depth noise);
- robust weight of Geman-McClure, (c^2 / (c^2 + d^2))^2, of the squared Mahalanobis distance d^2;
- B and q are taken at log Z + e, e = sd^2 v_d q^T Sigma^-1 r, the posterior mean of the true log
  depth. At the measured depth their errors correlate with the residual's, and the estimated
  translation is biased by a fraction of about sd^2 (errors in variables): many standard
  deviations on a full grid.
"""

from __future__ import annotations

from enum import IntEnum
from typing import NamedTuple

import numpy as np
from numba.extending import register_jitable

from hybridvo.compiled.numba_tools import njit, noinline

# Largest correction of a log depth: the linearization in log depth holds no farther.
MAX_DEPTH_SHIFT = 0.3
# Squared distance, in standard deviations, that a pixel behind the camera is charged: under the
# kernel of Geman-McClure, in single precision, as much as any outlier can cost.
BEHIND_DISTANCE2 = 1e8

# nnan and ninf are missing: the kernels test for invalid values
FASTMATH = {"reassoc", "contract", "arcp", "nsz"}

# Rows of a pixel buffer, float32. Plain integers: numba compiles them into the kernels.
XN = 0  # x of the ray (x, y, 1) through the pixel, previous camera
YN = 1  # y of it
Z = 2  # depth, metres, previous frame
MU = 3  # column that the flow leads to in the current image, px
MV = 4  # row that it leads to, px
PF = 5  # inverse of the flow variance, relative to the typical one
PD = 6  # variance of log depth, relative to the typical one
W = 7  # external weight; 0 where the pixel cannot be used
BUFFER_ROWS = 8


class WorkRow(IntEnum):
    """Rows of the work space between the two stages of a pass."""

    A = 0  # a
    B = 1  # b
    INVERSE_Z = 2  # i
    M00 = 3  # weighted information (2, 2) in units of B
    M01 = 4
    M11 = 5
    N0 = 6  # weighted Sigma^-1 r in units of B: a score is B^T (n0, n1)
    N1 = 7
    ROBUST = 8  # robust weight without the external one


WORK_ROWS = len(WorkRow)

# Pixels that both stages work on at once: their work space stays in the L1 cache.
BLOCK = 512
# Rows a little longer than a block do not fall into the same sets of the cache.
PADDING = 16

# Places in an accumulator, float64.
# upper triangle of the Hessian, row by row; then 6 of the gradient
HESSIAN_SUMS = 21
COST = 27
ROBUST_SUM = 28  # sum of robust times external weights
EXTERNAL_SUM = 29  # sum of the external weights of all usable pixels
INLIER_SUM = 30  # of those within the robust kernel's cutoff
SUMS = 31

# Smallest and largest value that counts as valid: metres, px, variances, weights.
MIN_DEPTH = np.float32(1e-6)
MAX_VALUE = np.float32(1e9)
# px^2 for each unit of log depth, below which depth moves no pixel.
NO_PARALLAX2 = 1e-20
# Limits of a pixel's inverse flow variance and of its depth variance, relative to the typical ones.
MAX_RELATIVE_INFORMATION = np.float32(1e6)
MAX_RELATIVE_VARIANCE = np.float32(1e9)
# Largest correction of a log depth: the linearization in log depth holds no farther.
MAX_SHIFT = np.float32(MAX_DEPTH_SHIFT)
# Squared distance that a pixel behind the camera is charged.
BEHIND = np.float32(BEHIND_DISTANCE2)
ONE = np.float32(1.0)
ZERO = np.float32(0.0)
# The first pixel. Numba compiles a kernel anew for an argument that is written as a number.
FIRST = np.int64(0)


class PixelMaps(NamedTuple):
    """Maps of a pair, float32 and contiguous: (h, w), or one row that holds for all rows."""

    depth: np.ndarray  # (h, w) metres, previous frame
    flow: np.ndarray  # (h, w, 2) px, previous to current
    flow_variance: np.ndarray  # px^2, or of any unit: only ratios count
    depth_variance: np.ndarray  # of log depth, or of any unit
    weights: np.ndarray  # factors on the information


class GridCamera(NamedTuple):
    """The previous camera, float32, and where in its image the pixels of the maps are."""

    inverse_fx: np.float32  # 1 / px
    inverse_fy: np.float32
    cx: np.float32  # px
    cy: np.float32
    first: np.float32  # px, row and column of the first pixel
    stride: np.float32  # px between neighbours


class TypicalVariance(NamedTuple):
    """The variances that a pixel's own are relative to, float32."""

    flow: np.float32
    depth: np.float32


class PixelSource(NamedTuple):
    """What a pixel buffer is filled from."""

    maps: PixelMaps
    camera: GridCamera
    typical: TypicalVariance


class ResidualNoise(NamedTuple):
    """Noise and robust kernel as the kernels take them, float32."""

    flow_information: np.float32  # 1 / sf^2, 1 / px^2
    depth_variance: np.float32  # sd^2, of log depth
    squared_cutoff: np.float32  # c^2, squared standard deviations


class ScoreProducts(NamedTuple):
    """Sums of outer products of the pixels' scores, (21,) upper triangles, per external weight."""

    # of the robust weights: the Hessian less it is the full derivative
    curvature: np.ndarray
    meat: np.ndarray  # covariance of the gradient if errors are independent


class TileSums(NamedTuple):
    """What a pass over all pixels fills."""

    # (rows, columns, 27) upper triangle of the Hessian, gradient of each tile
    tiles: np.ndarray
    totals: np.ndarray  # (rows, SUMS) cost and sums of weights of each row of tiles
    robust: np.ndarray  # (H, W) float32 robust weights, without the external ones


@register_jitable
def residual_noise(flow_std, depth_std, cutoff):
    """Return the :class:`ResidualNoise` of standard deviations (px, log depth) and of c.

    Kernels call it, and Python code as plain Python: numba would hand its float32 on as float64.
    """
    return ResidualNoise(
        np.float32(1.0 / (flow_std * flow_std)),
        np.float32(depth_std * depth_std),
        np.float32(cutoff * cutoff),
    )


@njit(fastmath=FASTMATH, error_model="numpy", cache=True, nogil=True)
def gather_row(v, u, n, source, buf, o):
    """Fill ``buf`` from column ``o`` on with ``n`` pixels of row ``v`` from column ``u`` on.

    A pixel that cannot be used gets the weight 0 and harmless values.
    """
    noinline()  # type: ignore[call-arg]
    maps = source.maps
    camera = source.camera
    typical = source.typical
    ifx = camera.inverse_fx
    cx = camera.cx
    stride = camera.stride
    y = camera.first + stride * np.float32(v)
    x = camera.first + stride * np.float32(u)
    yn = (y - camera.cy) * camera.inverse_fy

    # One row holds both components of the flow: LLVM does not vectorise loads at an array's stride.
    z_row = maps.depth[v, u:]
    f_row = maps.flow[v].reshape(-1)[2 * u :]
    vf_row = maps.flow_variance[min(v, len(maps.flow_variance) - 1), u:]
    vd_row = maps.depth_variance[min(v, len(maps.depth_variance) - 1), u:]
    w_row = maps.weights[min(v, len(maps.weights) - 1), u:]

    b_x = buf[XN][o:]
    b_y = buf[YN][o:]
    b_z = buf[Z][o:]
    b_u = buf[MU][o:]
    b_v = buf[MV][o:]
    b_f = buf[PF][o:]
    b_d = buf[PD][o:]
    b_w = buf[W][o:]
    for k in range(n):
        column = x + stride * np.float32(np.int32(k))
        z = z_row[k]
        mu = f_row[2 * k] + column
        mv = f_row[2 * k + 1] + y
        vf = vf_row[k]
        vd = vd_row[k]
        w = w_row[k]

        valid = (
            (z > MIN_DEPTH)
            & (z < MAX_VALUE)
            & (abs(mu) < MAX_VALUE)
            & (abs(mv) < MAX_VALUE)
        )
        valid_vf = (vf > ZERO) & (vf < MAX_VALUE)
        valid_vd = (vd >= ZERO) & (vd < MAX_VALUE)
        usable = valid & valid_vf & valid_vd & (w > ZERO) & (w < MAX_VALUE)

        b_x[k] = (column - cx) * ifx
        b_y[k] = yn
        b_z[k] = z if valid else ONE
        b_u[k] = mu if valid else ZERO
        b_v[k] = mv if valid else ZERO
        information = typical.flow / (vf if valid_vf else ONE)
        b_f[k] = min(information, MAX_RELATIVE_INFORMATION)
        variance = (vd if valid_vd else ONE) / typical.depth
        b_d[k] = min(variance, MAX_RELATIVE_VARIANCE)
        b_w[k] = w if usable else ZERO


@njit(error_model="numpy", cache=True, nogil=True)
def gather_all(source):
    """Return the buffer (BUFFER_ROWS, h w or more) of all pixels of a :class:`PixelSource`."""
    h, w = source.maps.depth.shape
    # an odd number of cache lines keeps the rows out of each other's cache sets
    lines = (h * w + 15) // 16 | 1
    buf = np.empty((BUFFER_ROWS, lines * 16), np.float32)
    for v in range(h):
        gather_row(v, FIRST, w, source, buf, v * w)
    return buf


@njit(error_model="numpy", cache=True, nogil=True)
def pose_entries(p):
    """Return the twelve numbers of a (3, 4) pose, row by row."""
    return (
        p[0, 0], p[0, 1], p[0, 2], p[0, 3], p[1, 0], p[1, 1],
        p[1, 2], p[1, 3], p[2, 0], p[2, 1], p[2, 2], p[2, 3],
    )  # fmt: skip


@njit(fastmath=FASTMATH, error_model="numpy", cache=True, nogil=True)
def transform_and_project(x, y, z, entries):
    """Move a point from the previous into the current camera, and project it.

    Args:
        x: of the ray (x, y, 1) through the point, previous camera.
        y: of the same ray.
        z: depth of the point, metres, previous camera.
        entries: the twelve numbers of T_curr_prev.

    Returns:
        a = X'/Z', b = Y'/Z', i = 1/Z' (1 / metres), and whether the point is in front of the
        current camera; behind it i is 1.
    """
    r00, r01, r02, tx, r10, r11, r12, ty, r20, r21, r22, tz = entries
    moved_z = z * (r20 * x + r21 * y + r22) + tz
    front = moved_z > MIN_DEPTH
    i = ONE / (moved_z if front else ONE)
    a = (z * (r00 * x + r01 * y + r02) + tx) * i
    b = (z * (r10 * x + r11 * y + r12) + ty) * i
    return a, b, i, front


@njit(fastmath=FASTMATH, error_model="numpy", cache=True, nogil=True)
def depth_jacobian(a, b, i, entries, K):
    """Return q = d pi(X') / d log Z, px, from what :func:`transform_and_project` gives."""
    tx = entries[3]
    ty = entries[7]
    tz = entries[11]
    return K[0] * i * (a * tz - tx), K[1] * i * (b * tz - ty)


@njit(fastmath=FASTMATH, error_model="numpy", cache=True, nogil=True)
def at_posterior_depth(a, b, i, ru, rv, g, entries, K):
    """Move a projected point to the depth that its residual makes most likely.

    See the module's docstring. ``g`` is the variance of log depth over that of the flow.

    Returns:
        a, b, i, qu, qv there, and kappa with Sigma^-1 proportional to I - kappa q q^T.
    """
    qu, qv = depth_jacobian(a, b, i, entries, K)
    shift = g * (qu * ru + qv * rv) / (ONE + g * (qu * qu + qv * qv))
    shift = min(max(shift, -MAX_SHIFT), MAX_SHIFT)
    a += qu * shift / K[0]
    b += qv * shift / K[1]
    i *= ONE - (ONE - entries[11] * i) * shift
    qu, qv = depth_jacobian(a, b, i, entries, K)
    return a, b, i, qu, qv, g / (ONE + g * (qu * qu + qv * qv))


@njit(fastmath=FASTMATH, error_model="numpy", cache=True, nogil=True)
def project_block(buf, o, n, pose, K, noise, work, robust, acc):
    """First stage, pixels ``o .. o + n - 1``: residuals, robust weights, weighted information.

    Args:
        buf: pixel buffer (BUFFER_ROWS, ...).
        o: first pixel.
        n: number of pixels.
        pose: (3, 4) float64 T_curr_prev.
        K: (fx, fy, cx, cy) of the current camera, float32.
        noise: :class:`ResidualNoise`.
        work: (WORK_ROWS, n or more), filled but for its last row.
        robust: (n,) or longer, filled with the weight without the external one; 0 where a pixel
            cannot be used.
        acc: (SUMS,), to which cost and sums of weights are added. A pixel behind the
            camera costs as much as the worst outlier.
    """
    noinline()  # type: ignore[call-arg]
    fx = K[0]
    fy = K[1]
    cx = K[2]
    cy = K[3]
    entries = pose_entries(pose.astype(np.float32))
    isf2 = noise.flow_information
    sd2 = noise.depth_variance
    c2 = noise.squared_cutoff

    b_x = buf[XN][o:]
    b_y = buf[YN][o:]
    b_z = buf[Z][o:]
    b_u = buf[MU][o:]
    b_v = buf[MV][o:]
    b_f = buf[PF][o:]
    b_d = buf[PD][o:]
    b_w = buf[W][o:]
    w_a = work[WorkRow.A]
    w_b = work[WorkRow.B]
    w_i = work[WorkRow.INVERSE_Z]
    w_m00 = work[WorkRow.M00]
    w_m01 = work[WorkRow.M01]
    w_m11 = work[WorkRow.M11]
    w_n0 = work[WorkRow.N0]
    w_n1 = work[WorkRow.N1]

    cost = ZERO
    robust_sum = ZERO
    external_sum = ZERO
    inlier_sum = ZERO
    for k in range(n):
        a, b, i, front = transform_and_project(b_x[k], b_y[k], b_z[k], entries)
        external = b_w[k]
        ru = b_u[k] - (fx * a + cx)
        rv = b_v[k] - (fy * b + cy)
        information = isf2 * b_f[k]
        a, b, i, qu, qv, kappa = at_posterior_depth(
            a, b, i, ru, rv, sd2 * b_d[k] * information, entries, K
        )

        # (n0, n1) = Sigma^-1 r
        dot = kappa * (qu * ru + qv * rv)
        n0 = information * (ru - dot * qu)
        n1 = information * (rv - dot * qv)
        d2 = ru * n0 + rv * n1 if front else BEHIND
        root = c2 / (c2 + d2)
        robust_weight = root * root if front & (external > ZERO) else ZERO
        robust[k] = robust_weight

        w = external * robust_weight
        wi = w * information
        w_a[k] = a
        w_b[k] = b
        w_i[k] = i
        w_m00[k] = wi * (ONE - kappa * qu * qu) * fx * fx
        w_m01[k] = -wi * kappa * qu * qv * fx * fy
        w_m11[k] = wi * (ONE - kappa * qv * qv) * fy * fy
        w_n0[k] = w * fx * n0
        w_n1[k] = w * fy * n1
        cost += external * root * d2
        robust_sum += w
        external_sum += external
        inlier_sum += external if front & (d2 <= c2) else ZERO
    acc[COST] += np.float32(0.5) * cost
    acc[ROBUST_SUM] += robust_sum
    acc[EXTERNAL_SUM] += external_sum
    acc[INLIER_SUM] += inlier_sum


@njit(error_model="numpy", cache=True, nogil=True)
def residual(samples, k, entries, K):
    """Return ru, rv, qu, qv of pixel ``k``, px, and whether it is in front of the camera."""
    a, b, i, front = transform_and_project(
        samples[XN, k], samples[YN, k], samples[Z, k], entries
    )
    qu, qv = depth_jacobian(a, b, i, entries, K)
    return (
        samples[MU, k] - (K[0] * a + K[2]),
        samples[MV, k] - (K[1] * b + K[3]),
        qu,
        qv,
        front,
    )


@njit(fastmath=FASTMATH, error_model="numpy", cache=True, nogil=True)
def sum_products(o, n, work, acc):
    """Second stage: add B^T M B and B^T n of work columns ``o .. o + n - 1`` to ``acc``.

    Written out entry by entry: a loop over the entries is not vectorised over the pixels.
    """
    noinline()  # type: ignore[call-arg]
    w_a = work[WorkRow.A][o:]
    w_b = work[WorkRow.B][o:]
    w_i = work[WorkRow.INVERSE_Z][o:]
    w_m00 = work[WorkRow.M00][o:]
    w_m01 = work[WorkRow.M01][o:]
    w_m11 = work[WorkRow.M11][o:]
    w_n0 = work[WorkRow.N0][o:]
    w_n1 = work[WorkRow.N1][o:]
    h00 = h01 = h02 = h03 = h04 = h05 = ZERO
    h11 = h12 = h13 = h14 = h15 = ZERO
    h22 = h23 = h24 = h25 = ZERO
    h33 = h34 = h35 = ZERO
    h44 = h45 = ZERO
    h55 = ZERO
    g0 = g1 = g2 = g3 = g4 = g5 = ZERO
    for k in range(n):
        a = w_a[k]
        b = w_b[k]
        i = w_i[k]
        m0 = w_m00[k]
        m1 = w_m01[k]
        m2 = w_m11[k]
        x = w_n0[k]
        y = w_n1[k]
        ab = a * b
        aa = ONE + a * a
        bb = ONE + b * b
        ii = i * i

        # columns 2 to 5 of M B, without the factor i of column 2
        c02 = -(m0 * a + m1 * b)
        c12 = -(m1 * a + m2 * b)
        c03 = -(m0 * ab + m1 * bb)
        c13 = -(m1 * ab + m2 * bb)
        c04 = m0 * aa + m1 * ab
        c14 = m1 * aa + m2 * ab
        c05 = m1 * a - m0 * b
        c15 = m2 * a - m1 * b

        h00 += m0 * ii
        h01 += m1 * ii
        h02 += c02 * ii
        h03 += c03 * i
        h04 += c04 * i
        h05 += c05 * i
        h11 += m2 * ii
        h12 += c12 * ii
        h13 += c13 * i
        h14 += c14 * i
        h15 += c15 * i
        h22 -= (a * c02 + b * c12) * ii
        h23 -= (a * c03 + b * c13) * i
        h24 -= (a * c04 + b * c14) * i
        h25 -= (a * c05 + b * c15) * i
        h33 -= ab * c03 + bb * c13
        h34 -= ab * c04 + bb * c14
        h35 -= ab * c05 + bb * c15
        h44 += aa * c04 + ab * c14
        h45 += aa * c05 + ab * c15
        h55 += a * c15 - b * c05
        g0 += x * i
        g1 += y * i
        g2 -= (a * x + b * y) * i
        g3 -= ab * x + bb * y
        g4 += aa * x + ab * y
        g5 += a * y - b * x
    sums = (
        h00, h01, h02, h03, h04, h05, h11, h12, h13, h14, h15, h22, h23, h24, h25,
        h33, h34, h35, h44, h45, h55, g0, g1, g2, g3, g4, g5,
    )  # fmt: skip
    for q in range(COST):
        acc[q] += sums[q]


@njit(error_model="numpy", cache=True, nogil=True)
def sum_samples(samples, n, pose, K, noise, acc):
    """Set ``acc`` (SUMS,) to the normal equations of gathered pixels; return their cost."""
    acc[:] = 0.0
    work = np.empty((WORK_ROWS, BLOCK + PADDING), np.float32)
    for o in range(0, n, BLOCK):
        m = min(BLOCK, n - o)
        project_block(
            samples, o, m, pose, K, noise, work, work[WorkRow.ROBUST], acc
        )
        sum_products(FIRST, m, work, acc)
    return acc[COST]


@njit(error_model="numpy", cache=True, nogil=True)
def robust_weights(samples, n, pose, K, noise):
    """Return the robust weights (n,) in [0, 1] of pixels, without the external ones.

    A pixel that cannot be used has the weight 0.
    """
    out = np.empty(n, np.float32)
    acc = np.zeros(SUMS)
    work = np.empty((WORK_ROWS, BLOCK + PADDING), np.float32)
    for o in range(0, n, BLOCK):
        m = min(BLOCK, n - o)
        project_block(samples, o, m, pose, K, noise, work, out[o:], acc)
    return out


@njit(error_model="numpy", cache=True, nogil=True)
def square_scores(work, factor, m):
    """Replace the information of ``m`` work columns by outer products of (n0, n1), times factors.

    A score is B^T (n0, n1), so its outer product is then summed like the Hessian.
    """
    for k in range(m):
        x = work[WorkRow.N0, k]
        y = work[WorkRow.N1, k]
        work[WorkRow.M00, k] = factor[k] * x * x
        work[WorkRow.M01, k] = factor[k] * x * y
        work[WorkRow.M11, k] = factor[k] * y * y


@njit(error_model="numpy", cache=True, nogil=True)
def score_products(samples, n, pose, K, noise):
    """Return the :class:`ScoreProducts` of gathered pixels.

    With external weight w, robust weight S = (c^2 / (c^2 + d^2))^2 and score
    s = w S J^T Sigma^-1 r, the meat is the sum of s s^T. The derivative of S adds
    4 w S / (c^2 + d^2) times the outer product of J^T Sigma^-1 r to the derivative of the
    gradient; as a multiple of s s^T the factor is 4 / (c^2 w sqrt(S)).
    """
    work = np.empty((WORK_ROWS, BLOCK + PADDING), np.float32)
    unit = np.empty(BLOCK, np.float32)
    bend = np.empty(BLOCK, np.float32)
    used = np.zeros(SUMS)
    curvature = np.zeros(SUMS)
    meat = np.zeros(SUMS)
    for o in range(0, n, BLOCK):
        m = min(BLOCK, n - o)
        robust = work[WorkRow.ROBUST]
        project_block(samples, o, m, pose, K, noise, work, robust, used)
        for k in range(m):
            w = samples[W, o + k]
            S = robust[k]
            factor = np.float32(4.0) / (noise.squared_cutoff * w * np.sqrt(S))
            counts = S * w > np.float32(1e-30)  # below, single precision ends
            unit[k] = ONE if counts else ZERO
            bend[k] = factor if counts else ZERO
        square_scores(work, unit, m)
        sum_products(FIRST, m, work, meat)
        square_scores(work, bend, m)
        sum_products(FIRST, m, work, curvature)
    total = max(used[EXTERNAL_SUM], 1e-12)
    return ScoreProducts(
        curvature[:HESSIAN_SUMS] / total, meat[:HESSIAN_SUMS] / total
    )


@njit(error_model="numpy", cache=True, nogil=True)
def sum_tiles(source, pose, K, noise, first_row, last_row, tile, out):
    """Fill the rows ``first_row .. last_row - 1`` of tiles of a :class:`TileSums`.

    ``source`` holds all pixels of the pair; ``tile`` is the side of a tile, px.
    """
    H, width = source.maps.depth.shape
    # whole tiles, so many that they stay in the L1 cache
    part = max(1, BLOCK // tile) * tile
    buf = np.empty((BUFFER_ROWS, part + PADDING), np.float32)
    work = np.empty((WORK_ROWS, part + PADDING), np.float32)
    for v in range(first_row * tile, min(H, last_row * tile)):
        row = v // tile
        for u in range(0, width, part):
            n = min(part, width - u)
            gather_row(v, u, n, source, buf, FIRST)
            robust = out.robust[v, u:]
            totals = out.totals[row]
            project_block(buf, FIRST, n, pose, K, noise, work, robust, totals)
            for o in range(0, n, tile):
                m = min(tile, n - o)
                sum_products(o, m, work, out.tiles[row, (u + o) // tile])
