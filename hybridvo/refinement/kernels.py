"""Numba kernels of the refinement: one pass over the pixels gives the 6x6 normal equations.

Per pixel, with X' = T X, a = X'/Z', b = Y'/Z', i = 1/Z' (conventions of :mod:`hybridvo.types`), as
in :mod:`hybridvo.refinement.torch_factors`; a test holds both equal:

- residual r = (x + F) - pi(X');
- Jacobian of pi(X') with respect to the left perturbation (translation, rotation):
  diag(fx, fy) B, B = [[i, 0, -a i, -a b, 1 + a^2, -b], [0, i, -b i, -(1 + b^2), a b, a]];
- q = d pi(X') / d log Z = (fx i (a tz - tx), fy i (b tz - ty));
- covariance sf^2 v_f I + sd^2 v_d q q^T (flow noise and propagated depth noise);
- robust weight of Geman-McClure, (c^2 / (c^2 + d^2))^2, of the squared Mahalanobis distance d^2;
- B and q are taken at log Z + e, e = sd^2 v_d q^T Sigma^-1 r, the posterior mean of the true log
  depth. At the measured depth its error correlates with the residual's, and the translation comes
  out wrong by a share of about sd^2 (errors in variables): many standard deviations on a full grid.
"""

from __future__ import annotations

import numpy as np

from hybridvo.numba_tools import njit, noinline

# not nnan/ninf: invalid values are tested for
FASTMATH = {"reassoc", "contract", "arcp", "nsz"}

XN, YN, Z, MU, MV, PF, PD, W = range(8)
"""Rows of a pixel buffer: ray x, ray y, depth, flow target u, v, inverse relative flow variance,
relative depth variance, external weight (0 where the pixel cannot be used)."""
BUFFER_ROWS = 8
WORK_ROWS = 9
BLOCK = 512

SUMS = 30
COST = 27
"""Length of an accumulator (21 upper-triangle sums of the Hessian, 6 of the gradient, cost, sum of
robust weights, sum of external weights), and the place of the cost."""

MIN_DEPTH = np.float32(1e-6)
MAX_VALUE = np.float32(1e9)
# of variances, relative
MAX_RELATIVE_INFORMATION = np.float32(1e6)
MAX_RELATIVE_VARIANCE = np.float32(1e9)
# largest correction of log depth that an outlier may cause
MAX_SHIFT = np.float32(0.3)
ONE = np.float32(1.0)
ZERO = np.float32(0.0)


@njit(fastmath=FASTMATH, error_model="numpy", cache=True, nogil=True)
def gather_row(v, u, n, data, camera, scale, buf, o):
    """Fill ``buf`` from column ``o`` on with ``n`` pixels of row ``v`` from column ``u`` on; where
    one cannot be used its weight is 0.

    ``data`` = (depth, flow, flow_variance, depth_variance, weights), (h, w) or one row for all;
    ``camera`` = (1/fx, 1/fy, cx, cy, first, stride): of the previous frame, and where in the image
    its pixels are; ``scale``: typical variances.
    """
    noinline()  # type: ignore[call-arg]
    depth, flow, flow_variance, depth_variance, weights = data
    ifx = camera[0]
    cx = camera[2]
    first = camera[4]
    stride = camera[5]
    y = first + stride * np.float32(v)
    x = first + stride * np.float32(u)
    yn = (y - camera[3]) * camera[1]
    # both components in one row: loads that are strided by an array's layout are not vectorised
    z_row = depth[v, u:]
    f_row = flow[v].reshape(-1)[2 * u :]
    vf_row = flow_variance[min(v, len(flow_variance) - 1), u:]
    vd_row = depth_variance[min(v, len(depth_variance) - 1), u:]
    w_row = weights[min(v, len(weights) - 1), u:]
    b_x = buf[XN][o:]
    b_y = buf[YN][o:]
    b_z = buf[Z][o:]
    b_u = buf[MU][o:]
    b_v = buf[MV][o:]
    b_f = buf[PF][o:]
    b_d = buf[PD][o:]
    b_w = buf[W][o:]
    for k in range(n):
        at = x + stride * np.float32(np.int32(k))
        z = z_row[k]
        mu = f_row[2 * k] + at
        mv = f_row[2 * k + 1] + y
        vf = vf_row[k]
        vd = vd_row[k]
        w = w_row[k]
        seen = (
            (z > MIN_DEPTH)
            & (z < MAX_VALUE)
            & (abs(mu) < MAX_VALUE)
            & (abs(mv) < MAX_VALUE)
        )
        known_f = (vf > ZERO) & (vf < MAX_VALUE)
        known_d = (vd >= ZERO) & (vd < MAX_VALUE)
        good = seen & known_f & known_d & (w > ZERO) & (w < MAX_VALUE)
        b_x[k] = (at - cx) * ifx
        b_y[k] = yn
        b_z[k] = z if seen else ONE
        b_u[k] = mu if seen else ZERO
        b_v[k] = mv if seen else ZERO
        b_f[k] = min(scale[0] / (vf if known_f else ONE), MAX_RELATIVE_INFORMATION)
        b_d[k] = min((vd if known_d else ONE) / scale[1], MAX_RELATIVE_VARIANCE)
        b_w[k] = w if good else ZERO


@njit(error_model="numpy", cache=True, nogil=True)
def gather_all(data, camera, scale):
    """Buffer (BUFFER_ROWS, h w or more) of all pixels of ``data``."""
    h, w = data[0].shape
    # an odd number of cache lines keeps the rows out of each other's cache sets
    buf = np.empty((BUFFER_ROWS, ((h * w + 15) // 16 | 1) * 16), np.float32)
    for v in range(h):
        gather_row(v, 0, w, data, camera, scale, buf, v * w)
    return buf


@njit(error_model="numpy", cache=True, nogil=True)
def pose_entries(p):
    """The twelve numbers of a (3, 4) pose, row by row."""
    return (
        p[0, 0], p[0, 1], p[0, 2], p[0, 3], p[1, 0], p[1, 1],
        p[1, 2], p[1, 3], p[2, 0], p[2, 1], p[2, 2], p[2, 3],
    )  # fmt: skip


@njit(fastmath=FASTMATH, error_model="numpy", cache=True, nogil=True)
def see(x, y, z, entries):
    """(X'/Z', Y'/Z', 1/Z', whether in front) of a point on the ray (x, y, 1), ``z`` metres deep."""
    r00, r01, r02, tx, r10, r11, r12, ty, r20, r21, r22, tz = entries
    Zc = z * (r20 * x + r21 * y + r22) + tz
    front = Zc > MIN_DEPTH
    i = ONE / (Zc if front else ONE)
    a = (z * (r00 * x + r01 * y + r02) + tx) * i
    b = (z * (r10 * x + r11 * y + r12) + ty) * i
    return a, b, i, front


@njit(fastmath=FASTMATH, error_model="numpy", cache=True, nogil=True)
def slope(a, b, i, entries, K):
    """Derivative q of pi(X') in log Z."""
    tx = entries[3]
    ty = entries[7]
    tz = entries[11]
    return K[0] * i * (a * tz - tx), K[1] * i * (b * tz - ty)


@njit(fastmath=FASTMATH, error_model="numpy", cache=True, nogil=True)
def at_posterior_depth(a, b, i, ru, rv, g, entries, K):
    """(a, b, i, qu, qv, kappa) at the depth that the residual makes most likely (see the module's
    docstring); ``g``: variance of log depth over that of the flow, Sigma^-1 ~ I - kappa q q^T.
    """
    qu, qv = slope(a, b, i, entries, K)
    shift = g * (qu * ru + qv * rv) / (ONE + g * (qu * qu + qv * qv))
    shift = min(max(shift, -MAX_SHIFT), MAX_SHIFT)
    a += qu * shift / K[0]
    b += qv * shift / K[1]
    i *= ONE - (ONE - entries[11] * i) * shift
    qu, qv = slope(a, b, i, entries, K)
    return a, b, i, qu, qv, g / (ONE + g * (qu * qu + qv * qv))


@njit(fastmath=FASTMATH, error_model="numpy", cache=True, nogil=True)
def project_block(buf, o, n, pose, K, noise, work, robust, acc):
    """First stage, pixels ``o .. o + n - 1``: residuals, robust weights, weighted information.

    ``pose`` (3, 4) float64; ``K`` = (fx, fy, cx, cy) of the current frame and ``noise`` =
    (1/sf^2, sd^2, c^2), float32; ``work`` rows: a, b, i, m00, m01, m11 (information in units of B),
    n0, n1 (gradient); ``robust`` (N,): weight without the external one, 0 where unusable.
    """
    noinline()  # type: ignore[call-arg]
    fx = K[0]
    fy = K[1]
    cx = K[2]
    cy = K[3]
    entries = pose_entries(pose.astype(np.float32))
    isf2 = noise[0]
    sd2 = noise[1]
    c2 = noise[2]
    b_x = buf[XN][o:]
    b_y = buf[YN][o:]
    b_z = buf[Z][o:]
    b_u = buf[MU][o:]
    b_v = buf[MV][o:]
    b_f = buf[PF][o:]
    b_d = buf[PD][o:]
    b_w = buf[W][o:]
    A = work[0]
    B = work[1]
    IZ = work[2]
    M0 = work[3]
    M1 = work[4]
    M2 = work[5]
    N0 = work[6]
    N1 = work[7]
    cost = wsum = count = ZERO
    for k in range(n):
        a, b, i, front = see(b_x[k], b_y[k], b_z[k], entries)
        wx = b_w[k] if front else ZERO
        ru = b_u[k] - (fx * a + cx)
        rv = b_v[k] - (fy * b + cy)
        ip = isf2 * b_f[k]
        a, b, i, qu, qv, kap = at_posterior_depth(
            a, b, i, ru, rv, sd2 * b_d[k] * ip, entries, K
        )
        dot = kap * (qu * ru + qv * rv)
        n0 = ip * (ru - dot * qu)
        n1 = ip * (rv - dot * qv)
        d2 = ru * n0 + rv * n1
        s = c2 / (c2 + d2)
        s2 = s * s if wx > ZERO else ZERO
        robust[k] = s2
        w = wx * s2
        wf = w * ip
        A[k] = a
        B[k] = b
        IZ[k] = i
        M0[k] = wf * (ONE - kap * qu * qu) * fx * fx
        M1[k] = -wf * kap * qu * qv * fx * fy
        M2[k] = wf * (ONE - kap * qv * qv) * fy * fy
        N0[k] = w * fx * n0
        N1[k] = w * fy * n1
        cost += wx * s * d2
        wsum += w
        count += wx
    acc[27] += np.float32(0.5) * cost
    acc[28] += wsum
    acc[29] += count


@njit(error_model="numpy", cache=True, nogil=True)
def residual(samples, k, entries, K):
    """(ru, rv, qu, qv, in front) of pixel ``k``."""
    a, b, i, front = see(samples[XN, k], samples[YN, k], samples[Z, k], entries)
    qu, qv = slope(a, b, i, entries, K)
    return (
        samples[MU, k] - (K[0] * a + K[2]),
        samples[MV, k] - (K[1] * b + K[3]),
        qu,
        qv,
        front,
    )


@njit(fastmath=FASTMATH, error_model="numpy", cache=True, nogil=True)
def sum_products(o, n, work, acc):
    """Second stage, pixels ``o .. o + n - 1``: their H and g are added to ``acc``."""
    noinline()  # type: ignore[call-arg]
    A = work[0][o:]
    B = work[1][o:]
    IZ = work[2][o:]
    M0 = work[3][o:]
    M1 = work[4][o:]
    M2 = work[5][o:]
    N0 = work[6][o:]
    N1 = work[7][o:]
    h00 = h01 = h02 = h03 = h04 = h05 = h11 = h12 = h13 = h14 = h15 = h22 = h23 = (
        h24
    ) = h25 = ZERO
    h33 = h34 = h35 = h44 = h45 = h55 = g0 = g1 = g2 = g3 = g4 = g5 = ZERO
    for k in range(n):
        a = A[k]
        b = B[k]
        i = IZ[k]
        m0 = M0[k]
        m1 = M1[k]
        m2 = M2[k]
        x = N0[k]
        y = N1[k]
        ab = a * b
        aa = ONE + a * a
        bb = ONE + b * b
        ii = i * i
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
    found = (
        *(
            h00,
            h01,
            h02,
            h03,
            h04,
            h05,
            h11,
            h12,
            h13,
            h14,
            h15,
            h22,
            h23,
            h24,
            h25,
        ),
        *(h33, h34, h35, h44, h45, h55, g0, g1, g2, g3, g4, g5),
    )
    for q in range(COST):
        acc[q] += found[q]


@njit(error_model="numpy", cache=True, nogil=True)
def sum_samples(samples, n, pose, K, noise, acc):
    """Normal equations of gathered pixels, set in ``acc`` (30,) float64; returns their cost."""
    acc[:] = 0.0
    # rows a little longer than a block do not fall into the same sets of the cache
    work = np.empty((WORK_ROWS, BLOCK + 16), np.float32)
    for o in range(0, n, BLOCK):
        m = min(BLOCK, n - o)
        project_block(samples, o, m, pose, K, noise, work, work[8], acc)
        sum_products(0, m, work, acc)
    return acc[COST]


@njit(error_model="numpy", cache=True, nogil=True)
def score_sums(samples, n, pose, K, noise):
    """(42,) curvature of the robust weights, meat of independent errors, per unit of weight."""
    work = np.empty((WORK_ROWS, BLOCK + 16), np.float32)
    used = np.zeros(SUMS)
    curvature = np.zeros(SUMS)
    meat = np.zeros(SUMS)
    for o in range(0, n, BLOCK):
        m = min(BLOCK, n - o)
        project_block(samples, o, m, pose, K, noise, work, work[8], used)
        # a score is B^T w (N0, N1), so that its outer product has the form of the Hessian
        for weighed in range(2):
            for k in range(m):
                x = work[6, k]
                y = work[7, k]
                s2 = work[8, k]
                w = samples[W, o + k]
                # w S, S = (c2 / (c2 + d2))^2, weighs s; wanted 4 w S / (c2 + d2) s s^T of w S s
                f = (
                    ONE
                    if weighed
                    else np.float32(4.0) / (noise[2] * w * np.sqrt(s2))
                )
                # beyond is no single precision
                f = f if s2 * w > np.float32(1e-30) else ZERO
                work[3, k], work[4, k], work[5, k] = f * x * x, f * x * y, f * y * y
            sum_products(0, m, work, meat if weighed else curvature)
    return np.concatenate((curvature[:21], meat[:21])) / max(used[29], 1e-12)


@njit(error_model="numpy", cache=True, nogil=True)
def sum_tiles(data, camera, scale, pose, K, noise, bands, tile, weights, sums, out):
    """Normal equations of each tile into ``sums`` (rows, columns, 27), cost and weights into
    ``out`` (rows, 30), robust weights into ``weights`` (H, W), for some ``bands`` of the full grid.
    """
    H, width = data[0].shape
    # whole tiles that stay in the L1 cache, in rows that do not fall into the same of its sets
    part = max(1, BLOCK // tile) * tile
    buf = np.empty((BUFFER_ROWS, part + 16), np.float32)
    work = np.empty((WORK_ROWS, part + 16), np.float32)
    for v in range(bands[0] * tile, min(H, bands[1] * tile)):
        band = v // tile
        for u0 in range(0, width, part):
            n = min(part, width - u0)
            gather_row(v, u0, n, data, camera, scale, buf, 0)
            project_block(
                buf, 0, n, pose, K, noise, work, weights[v, u0:], out[band]
            )
            for o in range(0, n, tile):
                m = min(tile, n - o)
                sum_products(o, m, work, sums[band, (u0 + o) // tile])
