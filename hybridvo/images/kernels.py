"""Numba kernels of images and depth maps: residuals and Jacobians of their pixels.

- Photometric residual r = B(pi(X')) - gain A - offset, A and B grey values of the previous and the
  current image, B read by cubic convolution: bilinear reading blurs by an amount that depends on
  the place between the pixels (measured: twice the error on clean images);
- gradient of B at pi(X') from that of A at x, carried over by the warp of a patch of constant depth
  (inverse compositional, Baker and Matthews, IJCV 2004): its noise is independent of that of A;
- rest as in :mod:`hybridvo.refinement.kernels`; the variance is s^2 + sd^2 v_d (G^T q)^2, s the
  noise of the residual in grey levels.
"""

from __future__ import annotations

import numpy as np

from hybridvo.geometry import njit
from hybridvo.refinement import kernels
from hybridvo.refinement.kernels import FASTMATH, MAX_VALUE, MIN_DEPTH, ONE, ZERO

XN, YN, Z, GREY, GX, GY, PD, W = range(8)
"""Rows of a pixel buffer: ray x, y, depth, grey value, its gradient, relative variance, weight."""
BUFFER_ROWS = 8
GQ = 8  # row of the Jacobian, behind motion, gain and offset, that holds G^T q, for the variance
MARGIN = 3  # pixels this close to the border are not read: reading needs neighbours
MIN_AREA = np.float32(1e-3)  # a patch whose area shrinks below this share is seen edge-on
HALF = np.float32(0.5)
REACH = 3  # px to the neighbours that span a plane: steps of a sensor are wider than one
EDGE = 0.1  # relative difference of depth to such a neighbour that makes an edge


@njit(fastmath=FASTMATH, error_model="numpy", cache=True, nogil=True)
def strength_row(v, grey, depth, weights, least, out):
    """Squared gradient of the usable pixels of row ``v``, 0 for the others."""
    kernels.keep_apart()  # type: ignore[call-arg]
    before, here, after = grey[v - 1], grey[v], grey[v + 1]
    zrow, wrow = depth[v], weights[v]
    for u in range(MARGIN, here.shape[0] - MARGIN):
        gx = here[u + 1] - here[u - 1]
        gy = after[u] - before[u]
        strength = gx * gx + gy * gy
        z = zrow[u]
        usable = (wrow[u] >= least) & (z > MIN_DEPTH) & (z < MAX_VALUE) & (strength < MAX_VALUE)
        out[u] = strength if usable else ZERO


@njit(error_model="numpy", cache=True, nogil=True)
def select_pixels(grey, depth, weights, least, cell, per_cell):
    """(N, 2) rows and columns of the ``per_cell`` strongest gradients in each ``cell`` px, where
    the weight is at least ``least`` and the depth valid.
    """
    (H, width), n = grey.shape, 0
    strength = np.zeros((H, width), np.float32)
    for v in range(MARGIN, H - MARGIN):
        strength_row(v, grey, depth, weights, least, strength[v])
    index = np.empty(((H // cell + 1) * (width // cell + 1) * per_cell, 2), np.int32)
    for v0 in range(MARGIN, H - MARGIN, cell):
        for u0 in range(MARGIN, width - MARGIN, cell):
            first, low = n, ZERO
            for v in range(v0, min(v0 + cell, H)):
                for u in range(u0, min(u0 + cell, width)):
                    if not strength[v, u] > low:
                        continue
                    k = min(n, first + per_cell - 1)
                    while k > first and strength[index[k - 1, 0], index[k - 1, 1]] < strength[v, u]:
                        index[k] = index[k - 1]
                        k -= 1
                    index[k] = v, u
                    n = min(n + 1, first + per_cell)
                    if n == first + per_cell:
                        low = strength[index[n - 1, 0], index[n - 1, 1]]
    return index[:n]


@njit(fastmath=FASTMATH, error_model="numpy", cache=True, nogil=True)
def cubic(f):
    """Weights of four neighbours at ``f`` of the way between the inner two."""
    ff = f * f
    fff = ff * f
    return (
        HALF * (-fff + ff + ff - f),
        HALF * (fff + fff + fff - (ff + ff + ff + ff + ff)) + ONE,
        HALF * (-(fff + fff + fff) + (ff + ff + ff + ff) + f),
        HALF * (fff - ff),
    )


@njit(fastmath=FASTMATH, error_model="numpy", cache=True, nogil=True)
def read_cubic(image, u, v):
    """Value of ``image`` at (u, v) by cubic convolution with a = -1/2 (Keys 1981)."""
    iu, iv = int(u), int(v)
    x0, x1, x2, x3 = cubic(u - np.float32(iu))
    y0, y1, y2, y3 = cubic(v - np.float32(iv))
    a, b, c, d = image[iv - 1], image[iv], image[iv + 1], image[iv + 2]
    j = iu - 1
    return (
        y0 * (x0 * a[j] + x1 * a[j + 1] + x2 * a[j + 2] + x3 * a[j + 3])
        + y1 * (x0 * b[j] + x1 * b[j + 1] + x2 * b[j + 2] + x3 * b[j + 3])
        + y2 * (x0 * c[j] + x1 * c[j + 1] + x2 * c[j + 2] + x3 * c[j + 3])
        + y3 * (x0 * d[j] + x1 * d[j + 1] + x2 * d[j + 2] + x3 * d[j + 3])
    )


@njit(error_model="numpy", cache=True, nogil=True)
def project_pixels(buf, image, pose, K, scale, light, J, r):
    """Residuals ``r`` (N,), NaN where not seen, and Jacobians ``J`` (GQ + 1, N) of gathered pixels.

    ``K`` = (fx, fy, cx, cy) of the current frame, ``scale`` = (1/fx, 1/fy) of the previous one.
    """
    H, width = image.shape
    fx, fy, cx, cy = K[0], K[1], K[2], K[3]
    sx, sy = fx * scale[0], fx * scale[1]
    tx_, ty_ = fy * scale[0], fy * scale[1]
    entries = kernels.pose_entries(pose)
    r00, r01, _, _, r10, r11, _, _, r20, r21, _, _ = entries
    gain, offset = light[0], light[1]
    low, high_u, high_v = np.float32(MARGIN - 1), width - MARGIN, H - MARGIN
    for k in range(len(r)):
        z = buf[Z, k]
        a, b, i, front = kernels.see(buf[XN, k], buf[YN, k], z, entries)
        u, v = fx * a + cx, fy * b + cy
        # d pi / d x for constant depth; the gradient of A is its transpose times that of B
        s = z * i
        w00 = s * sx * (r00 - a * r20)
        w01 = s * sy * (r01 - a * r21)
        w10 = s * tx_ * (r10 - b * r20)
        w11 = s * ty_ * (r11 - b * r21)
        determinant = w00 * w11 - w01 * w10
        seen = front & (u > low) & (u < high_u) & (v > low) & (v < high_v)
        if not (seen and determinant > MIN_AREA):
            for p in range(GQ + 1):
                J[p, k] = ZERO
            r[k] = np.nan
            continue
        grey = buf[GREY, k]
        f = gain / determinant
        gx = f * (w11 * buf[GX, k] - w10 * buf[GY, k])
        gy = f * (w00 * buf[GY, k] - w01 * buf[GX, k])
        qu, qv = kernels.slope(a, b, i, entries, K)
        J[GQ, k] = gx * qu + gy * qv
        gx *= fx
        gy *= fy
        J[0, k] = gx * i
        J[1, k] = gy * i
        J[2, k] = -(gx * a + gy * b) * i
        J[3, k] = -(gx * a * b + gy * (ONE + b * b))
        J[4, k] = gx * (ONE + a * a) + gy * a * b
        J[5, k] = gy * a - gx * b
        J[6, k] = -grey
        J[7, k] = -ONE
        r[k] = read_cubic(image, u, v) - gain * grey - offset


@njit(fastmath=FASTMATH, error_model="numpy", cache=True, nogil=True)
def weigh_pixels(weight, relative, along, r, noise, w, wr):
    """Weights ``w`` and their products ``wr`` with the residuals, 0 where unseen; returns the cost.

    ``noise`` = (grey levels, log depth, c of the Geman-McClure kernel); ``along``: G^T q.
    """
    s2, sd, c2, cost = noise[0] * noise[0], noise[1], noise[2] * noise[2], 0.0
    for k in range(len(r)):
        q = sd * along[k]
        information = ONE / (s2 + relative[k] * q * q)
        d2 = r[k] * r[k] * information
        seen = d2 < MAX_VALUE  # False for NaN
        robust = c2 / (c2 + (d2 if seen else ZERO))
        factor = weight[k] * robust * robust * information if seen else ZERO
        w[k] = factor
        wr[k] = factor * (r[k] if seen else ZERO)
        cost += HALF * weight[k] * (robust * d2 if seen else c2)
    return cost


@njit(cache=True, nogil=True)
def point(depth, u, v, K):
    """The point of a pixel, metres."""
    z = np.float64(depth[v, u])
    return (u - K[2]) / K[0] * z, (v - K[3]) / K[1] * z, z


@njit(cache=True, nogil=True)
def measure(points, T, depth, K):
    """:class:`hybridvo.images.factors.Residuals` of moved points (N, 3) on a depth map."""
    (height, width), n = depth.shape, len(points)
    r, J, z = np.zeros(n), np.zeros((6, n)), np.ones(n)
    seen, at = np.zeros(n, np.bool_), np.full((n, 2), -1.0)
    for k in range(n):
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
        J[0, k], J[1, k], J[2, k] = nx, ny, nz
        J[3, k], J[4, k], J[5, k] = Y * nz - Z * ny, Z * nx - X * nz, X * ny - Y * nx
        z[k], seen[k] = pz, True
    return r, J, z, seen, at
