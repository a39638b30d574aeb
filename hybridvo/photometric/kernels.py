"""Numba kernels of images and depth maps: residuals, Jacobians, and the loop that follows them.

- Photometric residual r = B(pi(X')) - gain A - offset, A and B grey values of the previous and the
  current image, B read by cubic convolution: bilinear reading blurs by an amount that depends on
  the place between the pixels (measured: twice the error on clean images);
- gradient of B at pi(X') from that of A at x, carried over by the warp of a patch of constant depth
  (inverse compositional, Baker and Matthews, IJCV 2004): its noise is independent of that of A;
- rest as in :mod:`hybridvo.refinement.kernels`; the variance is s^2 + sd^2 v_d (G^T q)^2, s the
  noise of the residual in grey levels;
- depth maps: r = n . (T X - P), P and n point and normal of the current one where T X is seen.
"""

from __future__ import annotations

import numpy as np

from hybridvo.numba_tools import njit
from hybridvo.refinement import kernels
from hybridvo.refinement.kernels import (
    BLOCK,
    FASTMATH,
    MAX_VALUE,
    MIN_DEPTH,
    ONE,
    ZERO,
)
from hybridvo.refinement.robust_fit import exponential

XN, YN, Z, GREY, GX, GY, PD, W = range(8)
"""Rows of a pixel buffer: ray x, y, depth, grey value, its gradient, relative variance, weight."""
BUFFER_ROWS = 8
R = 0
MOTION = 1
GAIN = 7
OFFSET = 8
ALONG = 9
U = 10
V = 11
"""Rows that a motion gives each pixel: residual, its derivatives in the motion, the gain and the
offset, and in the log depth; place, px, a negative one where not seen."""
TERMS = 9
IMAGE_ROWS = 12
SURFACE = 7
ROBUST = 8
PLACE = 9
PLANE_TERMS = 7
PLANE_ROWS = 11
"""Rows of a point of a depth map behind the first seven: depth of the surface, 0 where there is
none, robust factor in [0, 1], and place, px."""
MARGIN = 3  # pixels this close to the border are not read: reading needs neighbours
# a patch whose area shrinks below this share is seen edge-on
MIN_AREA = np.float32(1e-3)
HALF = np.float32(0.5)
# px to the neighbours that span a plane: steps of a sensor are wider than one
REACH = 3
# relative difference of depth to such a neighbour that makes an edge
EDGE = np.float32(0.1)
# least standard deviation of a distance, in shares of the depth
DEPTH_FLOOR = np.float32(1e-4)
# square of c of the Geman-McClure kernels, c in standard deviations
CUTOFF2 = np.float32(9.0)
# of the kernels, in shares of the weights: 0.73 if residuals are normal, or less
CURVATURE = 0.6
TOLERANCE = 0.1  # standard deviations: a shorter step is the last
# between two images
MIN_GAIN = 0.2
MAX_GAIN = 5.0
# degrees of freedom of Student's kernel: the covariance is an estimate
PRIOR_FREEDOM = 6.0


@njit(fastmath=FASTMATH, error_model="numpy", cache=True, nogil=True)
def compare_row(v, grey, depth, weights, least, best, row):
    """Where squared gradients of usable pixels of row ``v`` are larger, put them into ``best``."""
    kernels.noinline()  # type: ignore[call-arg]
    left = grey[v][MARGIN - 1 :]
    right = grey[v][MARGIN + 1 :]
    above = grey[v - 1][MARGIN:]
    below = grey[v + 1][MARGIN:]
    zrow = depth[v][MARGIN:]
    wrow = weights[v][MARGIN:]
    best = best[MARGIN:]
    row = row[MARGIN:]
    for u in range(len(zrow) - MARGIN):
        gx = right[u] - left[u]
        gy = below[u] - above[u]
        z = zrow[u]
        usable = (wrow[u] >= least) & (z > MIN_DEPTH) & (z < MAX_VALUE)
        strength = gx * gx + gy * gy if usable else ZERO
        row[u] = v if strength > best[u] else row[u]
        best[u] = max(strength, best[u])


@njit(error_model="numpy", cache=True, nogil=True)
def select_pixels(grey, depth, weights, least, cell):
    """(N, 2) rows and columns of the strongest gradient in each cell of ``cell`` px (not whole),
    where the weight is at least ``least`` and the depth valid.
    """
    (H, width), n = grey.shape, 0
    best = np.zeros(width, np.float32)
    row = np.zeros(width, np.int32)
    index = np.empty((int(H / cell + 1) * int(width / cell + 1), 2), np.int32)
    for v in range(MARGIN, H - MARGIN):
        compare_row(np.int32(v), grey, depth, weights, least, best, row)
        if int((v + 1) / cell) == int(v / cell):
            continue
        for k in range(int(width / cell) + 1):
            u = int(k * cell)
            for other in range(u + 1, min(int((k + 1) * cell), width)):
                if best[other] > best[u]:
                    u = other
            if u < width and best[u] > ZERO:
                index[n, 0], index[n, 1] = row[u], u
                n += 1
        best[:] = ZERO
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
    iu = int(u)
    iv = int(v)
    x0, x1, x2, x3 = cubic(u - np.float32(iu))
    y0, y1, y2, y3 = cubic(v - np.float32(iv))
    a = image[iv - 1]
    b = image[iv]
    c = image[iv + 1]
    d = image[iv + 2]
    j = iu - 1
    return (
        y0 * (x0 * a[j] + x1 * a[j + 1] + x2 * a[j + 2] + x3 * a[j + 3])
        + y1 * (x0 * b[j] + x1 * b[j + 1] + x2 * b[j + 2] + x3 * b[j + 3])
        + y2 * (x0 * c[j] + x1 * c[j + 1] + x2 * c[j + 2] + x3 * c[j + 3])
        + y3 * (x0 * d[j] + x1 * d[j + 1] + x2 * d[j + 2] + x3 * d[j + 3])
    )


@njit(fastmath=FASTMATH, error_model="numpy", cache=True, nogil=True)
def project_pixels(buf, T, gain, size, camera, J):
    """Places and Jacobians of gathered pixels in an image of a ``size``."""
    kernels.noinline()  # type: ignore[call-arg]
    fx = camera[0]
    fy = camera[1]
    cx = camera[2]
    cy = camera[3]
    K = camera
    sx = fx * camera[4]
    sy = fx * camera[5]
    tx_ = fy * camera[4]
    ty_ = fy * camera[5]
    entries = kernels.pose_entries(T.astype(np.float32))
    r00, r01, _, _, r10, r11, _, _, r20, r21, _, _ = entries
    low = np.float32(MARGIN - 1)
    high_u = np.float32(size[1] - MARGIN)
    high_v = np.float32(size[0] - MARGIN)
    x_ = buf[XN]
    y_ = buf[YN]
    z_ = buf[Z]
    gx_ = buf[GX]
    gy_ = buf[GY]
    j0 = J[1]
    j1 = J[2]
    j2 = J[3]
    j3 = J[4]
    j4 = J[5]
    j5 = J[6]
    along = J[ALONG]
    u_ = J[U]
    v_ = J[V]
    for k in range(len(x_)):
        z = z_[k]
        a, b, i, front = kernels.transform_and_project(x_[k], y_[k], z, entries)
        u = fx * a + cx
        v = fy * b + cy
        # d pi / d x for constant depth; the gradient of A is its transpose times that of B
        s = z * i
        w00 = s * sx * (r00 - a * r20)
        w01 = s * sy * (r01 - a * r21)
        w10 = s * tx_ * (r10 - b * r20)
        w11 = s * ty_ * (r11 - b * r21)
        determinant = w00 * w11 - w01 * w10
        seen = front & (u > low) & (u < high_u) & (v > low) & (v < high_v)
        seen &= determinant > MIN_AREA
        f = gain / (determinant if seen else ONE)
        gx = f * (w11 * gx_[k] - w10 * gy_[k])
        gy = f * (w00 * gy_[k] - w01 * gx_[k])
        qu, qv = kernels.depth_jacobian(a, b, i, entries, K)
        along[k] = gx * qu + gy * qv
        gx *= fx
        gy *= fy
        j0[k] = gx * i
        j1[k] = gy * i
        j2[k] = -(gx * a + gy * b) * i
        j3[k] = -(gx * a * b + gy * (ONE + b * b))
        j4[k] = gx * (ONE + a * a) + gy * a * b
        j5[k] = gy * a - gx * b
        u_[k] = u if seen else -ONE
        v_[k] = v


@njit(error_model="numpy", cache=True, nogil=True)
def image_rows(buf, image, camera, T, light, J):
    """Rows ``J`` of pixels at a motion, under a gain and an offset.

    ``camera`` = (fx, fy, cx, cy) of the current frame, (1/fx, 1/fy) of the previous one.
    """
    gain = np.float32(light[0])
    offset = np.float32(light[1])
    project_pixels(buf, T, gain, image.shape, camera, J)
    for k in range(J.shape[1]):
        J[R, k], grey = ZERO, buf[GREY, k]
        J[GAIN, k], J[OFFSET, k] = -grey, -ONE
        if J[U, k] > ZERO:
            J[R, k] = read_cubic(image, J[U, k], J[V, k]) - gain * grey - offset


@njit(fastmath=FASTMATH, error_model="numpy", cache=True, nogil=True)
def weigh_pixels(buf, noise, J, w):
    """Weights ``w``, 0 where unseen, by the ``noise`` (grey levels, log depth); the cost."""
    kernels.noinline()  # type: ignore[call-arg]
    s2 = noise[0] * noise[0]
    sd = noise[1]
    cost = ZERO
    weight = buf[W]
    relative = buf[PD]
    along = J[ALONG]
    r = J[R]
    u = J[U]
    for k in range(len(w)):
        q = sd * along[k]
        information = ONE / (s2 + relative[k] * q * q)
        d2 = r[k] * r[k] * information
        robust = CUTOFF2 / (CUTOFF2 + d2) if u[k] > ZERO else ZERO
        w[k] = weight[k] * robust * robust * information
        cost += weight[k] * (ONE - robust)
    return HALF * CUTOFF2 * cost


@njit(error_model="numpy", cache=True, nogil=True)
def point(depth, u, v, ray):
    """The point of a pixel, metres; ``ray`` = (1/fx, 1/fy, cx, cy)."""
    z = depth[v, u]
    return (
        (np.float32(u) - ray[2]) * ray[0] * z,
        (np.float32(v) - ray[3]) * ray[1] * z,
        z,
    )


@njit(error_model="numpy", cache=True, nogil=True)
def plane_rows(points, depth, camera, T, J):
    """Rows ``J`` of points (N, 3) on a depth map at a motion."""
    r00, r01, r02, tx, r10, r11, r12, ty, r20, r21, r22, tz = kernels.pose_entries(
        T.astype(np.float32)
    )
    fx = camera[0]
    fy = camera[1]
    cx = camera[2]
    cy = camera[3]
    ray = ONE / fx, ONE / fy, cx, cy
    height, width = depth.shape
    low = REACH - HALF
    high_u = width - REACH - HALF
    high_v = height - REACH - HALF
    for k in range(len(points)):
        a = points[k, 0]
        b = points[k, 1]
        c = points[k, 2]
        X = r00 * a + r01 * b + r02 * c + tx
        Y = r10 * a + r11 * b + r12 * c + ty
        Z = r20 * a + r21 * b + r22 * c + tz
        J[:PLACE, k] = ZERO
        i = ONE / Z if Z > MIN_DEPTH else -ONE
        x, y = (fx * X * i + cx, fy * Y * i + cy) if i > 0 else (-ONE, -ONE)
        J[PLACE, k], J[PLACE + 1, k] = x, y
        if not (low < x < high_u and low < y < high_v):
            continue
        u = int(x + HALF)
        v = int(y + HALF)
        px, py, pz = point(depth, u, v, ray)
        rx, ry, rz = point(depth, u + REACH, v, ray)
        lx, ly, lz = point(depth, u - REACH, v, ray)
        bx, by, bz = point(depth, u, v + REACH, ray)
        ux, uy, uz = point(depth, u, v - REACH, ray)
        edge = EDGE * pz
        # False where not finite
        whole = abs(rz - pz) < edge and abs(lz - pz) < edge
        whole = whole and abs(bz - pz) < edge and abs(uz - pz) < edge
        if not (whole and MIN_DEPTH < pz < MAX_VALUE):
            continue
        rx = rx - lx
        ry = ry - ly
        rz = rz - lz
        bx = bx - ux
        by = by - uy
        bz = bz - uz
        nx = by * rz - bz * ry
        ny = bz * rx - bx * rz
        nz = bx * ry - by * rx
        inverse = ONE / max(np.sqrt(nx * nx + ny * ny + nz * nz), np.float32(1e-12))
        nx = nx * inverse
        ny = ny * inverse
        nz = nz * inverse
        J[R, k] = (X - px) * nx + (Y - py) * ny + (Z - pz) * nz
        J[1, k], J[2, k], J[3, k] = nx, ny, nz
        J[4, k], J[5, k], J[6, k] = (
            Y * nz - Z * ny,
            Z * nx - X * nz,
            X * ny - Y * nx,
        )
        J[SURFACE, k] = pz


@njit(fastmath=FASTMATH, error_model="numpy", cache=True, nogil=True)
def weigh_points(weight, law, J, w):
    """The same of points of a depth map, by the ``law`` (3,): the noise is a + b z + c z^2."""
    kernels.noinline()  # type: ignore[call-arg]
    r = J[R]
    surface = J[SURFACE]
    kernel = J[ROBUST]
    cost = ZERO
    for k in range(len(w)):
        z = surface[k]
        seen = z > ZERO
        sigma = max(law[0] + (law[1] + law[2] * z) * z, DEPTH_FLOOR * z)
        inverse = ONE / (sigma if seen else ONE)
        d = r[k] * inverse
        robust = CUTOFF2 / (CUTOFF2 + d * d) if seen else ZERO
        kernel[k] = robust
        w[k] = weight[k] * robust * robust * inverse * inverse
        cost += weight[k] * (ONE - robust)
    return HALF * CUTOFF2 * cost


@njit(fastmath=FASTMATH, error_model="numpy", cache=True, nogil=True)
def add_products(J, w, scale, sums):
    """``sums`` (M, M) or larger += scale J diag(w) J^T, of rows J (M, N)."""
    for o in range(0, len(w), BLOCK):
        last = min(len(w), o + BLOCK)
        for p in range(len(J)):
            for q in range(p + 1):
                total = ZERO
                x = J[p]
                y = J[q]
                for k in range(o, last):
                    total += w[k] * x[k] * y[k]
                sums[p, q] += scale * total
                if q < p:
                    sums[q, p] += scale * total


@njit(error_model="numpy", cache=True, nogil=True)
def offset(T, inverse):
    """(6,) from a known motion, of which the inverse is given, to ``T``; second order in angles."""
    E = T @ inverse
    phi = 0.5 * np.array([E[2, 1] - E[1, 2], E[0, 2] - E[2, 0], E[1, 0] - E[0, 1]])
    t = E[:3, 3].copy()
    return np.concatenate((t - 0.5 * np.cross(phi, t), phi))


@njit(error_model="numpy", cache=True, nogil=True)
def add_prior(inverse, information, T, sums):
    """Add a known motion, up to outliers (Student's kernel); (cost, squared distance in sigmas)."""
    xi = offset(T, inverse)
    d2 = xi @ information @ xi
    H = (PRIOR_FREEDOM + 6) / (PRIOR_FREEDOM + d2) * information
    sums[1:7, 1:7] += H
    sums[1:7, R] += H @ xi
    return 0.5 * (PRIOR_FREEDOM + 6) * np.log1p(d2 / PRIOR_FREEDOM), d2


@njit(error_model="numpy", cache=True, nogil=True)
def align(images, planes, prior, T, light, steps):
    """Motion (4, 4), gain and offset of least cost, by Newton steps from a start.

    A step after which the cost is higher is taken back and made shorter.
    """
    buf, image, camera, noise, J, w, scale = images
    points, depth, lens, weight, law, J_plane, w_plane, scale_plane = planes
    kept = T
    kept_light = light
    kept_sums = np.zeros((TERMS, TERMS))
    least = np.inf
    damping = 0.0
    for _ in range(steps):
        sums = np.zeros((TERMS, TERMS))
        image_rows(buf, image, camera, T, light, J)
        cost = scale * weigh_pixels(buf, noise, J, w)
        add_products(J[:TERMS], w, scale, sums)
        if scale_plane > 0:
            plane_rows(points, depth, lens, T, J_plane)
            cost += scale_plane * weigh_points(weight, law, J_plane, w_plane)
            add_products(J_plane[:PLANE_TERMS], w_plane, scale_plane, sums)
        sums[1:, 1:] *= CURVATURE
        cost += add_prior(prior[0], prior[1], T, sums)[0]
        falls = cost <= least
        if falls:
            kept = T
            kept_light = light
            kept_sums = sums
            least = cost
            damping = 0.1 * damping
        else:
            damping = max(10 * damping, 0.01)
        H = kept_sums[1:, 1:].copy()
        g = -kept_sums[1:, R].copy()
        for p in range(TERMS - 1):  # a light that nothing tells stays
            H[p, p] += (damping + 1e-9) * H[p, p] + 1e-12
        delta = np.linalg.solve(H, g)
        T = exponential(delta[:6]) @ kept
        light = kept_light + delta[6:]
        light[0] = min(max(light[0], MIN_GAIN), MAX_GAIN)
        if falls and delta @ g < TOLERANCE * TOLERANCE:
            break
    return T, light
