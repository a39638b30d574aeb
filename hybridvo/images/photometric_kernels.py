"""Numba kernels of the photometric term: residuals and Jacobians of its pixels.

Per pixel x of the previous image with grey value A, at a pose T (X' = T X, a = X'/Z', b = Y'/Z',
i = 1/Z'):

- residual r = B(pi(X')) - gain A - offset, B read by cubic convolution (Catmull-Rom): bilinear
  reading blurs by an amount that depends on the place between the pixels, which pulls the motion
  towards places of equal blur (measured: twice the error on clean images);
- image gradient G of B at pi(X') from the gradient of A at x, carried over by the warp of a patch
  of constant depth (inverse compositional, Baker and Matthews, IJCV 2004): the noise of a central
  difference at x is independent of the noise of A at x, so noise alone moves nothing;
- Jacobian of r: G^T diag(fx, fy) B_x with respect to the left perturbation (B_x as in
  :mod:`hybridvo.refinement.kernels`), -A for the gain, -1 for the offset;
- variance s^2 + sd^2 v_d (G^T q)^2, s the noise of the residual in grey levels, q = d pi(X') /
  d log Z;
- robust weight of Geman-McClure, (c^2 / (c^2 + d^2))^2 with d^2 = r^2 / variance.
"""

from __future__ import annotations

import numpy as np

from hybridvo.geometry import njit
from hybridvo.refinement.kernels import (
    FASTMATH,
    MAX_VALUE,
    MIN_DEPTH,
    ONE,
    ZERO,
    keep_apart,
    pose_entries,
)

XN, YN, Z, GREY, GX, GY, PD, W = range(8)
"""Rows of a pixel buffer: ray x, ray y, depth, grey value, its gradient, relative depth variance,
weight."""
BUFFER_ROWS = 8
GQ = 8
"""Row of the Jacobian, behind motion, gain and offset, that holds G^T q, for the variance."""
MARGIN = 3
"""Pixels this close to the border are not read: gradients and cubic reading need neighbours."""
MIN_AREA = np.float32(1e-3)
"""A patch whose area shrinks below this share is seen edge-on."""
HALF = np.float32(0.5)


@njit(fastmath=FASTMATH, error_model="numpy", cache=True, nogil=True)
def strength_row(v, grey, depth, weights, least, out):
    """Squared gradient of the usable pixels of row ``v``, 0 for the others."""
    keep_apart()  # type: ignore[call-arg]
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
def select_pixels(grey, depth, weights, least, cell, per_cell, index):
    """The ``per_cell`` usable pixels of strongest gradient in every cell of ``cell`` px.

    ``index`` (N, 2) int32 gets (v, u); returns how many. Usable: weight of at least ``least``,
    valid depth, off the border.
    """
    H, width = grey.shape
    cells = (width - 2 * MARGIN + cell - 1) // cell
    best = np.empty((cells, per_cell), np.float32)
    place = np.empty((cells, per_cell, 2), np.int32)
    row = np.empty(width, np.float32)
    last = per_cell - 1
    n = 0
    for v0 in range(MARGIN, H - MARGIN, cell):
        best[:] = ZERO
        for v in range(v0, min(v0 + cell, H - MARGIN)):
            strength_row(v, grey, depth, weights, least, row)
            for c in range(cells):
                u0 = MARGIN + c * cell
                for u in range(u0, min(u0 + cell, width - MARGIN)):
                    strength = row[u]
                    if not strength > best[c, last]:
                        continue
                    k = last
                    while k > 0 and best[c, k - 1] < strength:
                        best[c, k] = best[c, k - 1]
                        place[c, k] = place[c, k - 1]
                        k -= 1
                    best[c, k] = strength
                    place[c, k, 0] = v
                    place[c, k, 1] = u
        for c in range(cells):
            for k in range(per_cell):
                if best[c, k] > ZERO and n < index.shape[0]:
                    index[n] = place[c, k]
                    n += 1
    return n


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
    """Residuals and Jacobians of gathered pixels.

    ``pose`` (3, 4) float64; ``K`` = (fx, fy, cx, cy) of the current frame, ``scale`` = (1/fx, 1/fy)
    of the previous one, ``light`` = (gain, offset), all float32. ``J`` (GQ + 1, N); ``r`` (N,), NaN
    where the point is not seen.
    """
    H, width = image.shape
    fx, fy, cx, cy = K[0], K[1], K[2], K[3]
    sx, sy = fx * scale[0], fx * scale[1]
    tx_, ty_ = fy * scale[0], fy * scale[1]
    r00, r01, r02, tx, r10, r11, r12, ty, r20, r21, r22, tz = pose_entries(pose)
    gain, offset = light[0], light[1]
    low = np.float32(MARGIN - 1)
    high_u = np.float32(width - MARGIN)
    high_v = np.float32(H - MARGIN)
    for k in range(len(r)):
        xn = buf[XN, k]
        yn = buf[YN, k]
        z = buf[Z, k]
        X = z * (r00 * xn + r01 * yn + r02) + tx
        Y = z * (r10 * xn + r11 * yn + r12) + ty
        Zc = z * (r20 * xn + r21 * yn + r22) + tz
        i = ONE / (Zc if Zc > MIN_DEPTH else ONE)
        a = X * i
        b = Y * i
        u = fx * a + cx
        v = fy * b + cy
        # d pi / d x for constant depth; the gradient of A is its transpose times that of B
        s = z * i
        w00 = s * sx * (r00 - a * r20)
        w01 = s * sy * (r01 - a * r21)
        w10 = s * tx_ * (r10 - b * r20)
        w11 = s * ty_ * (r11 - b * r21)
        determinant = w00 * w11 - w01 * w10
        seen = (Zc > MIN_DEPTH) & (u > low) & (u < high_u) & (v > low) & (v < high_v)
        if not (seen and determinant > MIN_AREA):
            for p in range(GQ + 1):
                J[p, k] = ZERO
            r[k] = np.nan
            continue
        grey = buf[GREY, k]
        e = read_cubic(image, u, v) - gain * grey - offset
        f = gain / determinant
        gx = f * (w11 * buf[GX, k] - w10 * buf[GY, k])
        gy = f * (w00 * buf[GY, k] - w01 * buf[GX, k])
        qu = fx * i * (a * tz - tx)
        qv = fy * i * (b * tz - ty)
        gq = gx * qu + gy * qv
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
        J[GQ, k] = gq
        r[k] = e
