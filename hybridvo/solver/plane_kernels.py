"""Numba kernels of the depth maps: distances of points to the surface.

The residual is r = n . (T X - P). X is a point of the previous depth map, P and n
are point and normal of the current one at the pixel where T X is visible.
"""

from __future__ import annotations

import numpy as np

from hybridvo.compiled.numba_tools import njit
from hybridvo.solver import kernels
from hybridvo.solver.calibration import (
    PLANE_EDGE,
    PLANE_NOISE_FLOOR,
    PLANE_REACH_PX,
)
from hybridvo.solver.image_kernels import HALF
from hybridvo.solver.kernels import FASTMATH, MAX_VALUE, MIN_DEPTH, ONE, ZERO
from hybridvo.solver.rows import PlaneRow

REACH = PLANE_REACH_PX
EDGE = np.float32(PLANE_EDGE)
NOISE_FLOOR = np.float32(PLANE_NOISE_FLOOR)
# the cross product of two steps on the surface, m^2: below, it has no direction
MIN_NORMAL = np.float32(1e-12)


@njit(error_model="numpy", cache=True, nogil=True)
def surface_point(depth, u, v, ray):
    """Return the point of a pixel, metres; ``ray`` is (1/fx, 1/fy, cx, cy)."""
    z = depth[v, u]
    return (
        (np.float32(u) - ray[2]) * ray[0] * z,
        (np.float32(v) - ray[3]) * ray[1] * z,
        z,
    )


@njit(error_model="numpy", cache=True, nogil=True)
def linearize_planes(points, depth, camera, T, rows):
    """Fill the residuals and derivatives of points at a motion.

    Args:
        points: (N, 3) float32 metres, in the previous camera.
        depth: (H, W) float32 metres, the current depth map.
        camera: (4,) float32 (fx, fy, cx, cy) of the current frame.
        T: (4, 4) T_curr_prev.
        rows: (11, N) float32, see :class:`PlaneRow`; filled, but for the robust
            factor.
    """
    entries = kernels.pose_entries(T.astype(np.float32))
    r00, r01, r02, tx, r10, r11, r12, ty, r20, r21, r22, tz = entries
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
        rows[: PlaneRow.U, k] = ZERO
        i = ONE / Z if Z > MIN_DEPTH else -ONE
        # False where Z is infinite as well
        in_front = i > 0
        x = fx * X * i + cx if in_front else -ONE
        y = fy * Y * i + cy if in_front else -ONE
        rows[PlaneRow.U, k] = x
        rows[PlaneRow.V, k] = y
        if not (low < x < high_u and low < y < high_v):
            continue
        # the current point, and its neighbours to the right, left, below and above
        u = int(x + HALF)
        v = int(y + HALF)
        px, py, pz = surface_point(depth, u, v, ray)
        rx, ry, rz = surface_point(depth, u + REACH, v, ray)
        lx, ly, lz = surface_point(depth, u - REACH, v, ray)
        bx, by, bz = surface_point(depth, u, v + REACH, ray)
        ax, ay, az = surface_point(depth, u, v - REACH, ray)
        edge = EDGE * pz
        # both are False where a depth is not finite
        is_smooth = abs(rz - pz) < edge and abs(lz - pz) < edge
        is_smooth = is_smooth and abs(bz - pz) < edge and abs(az - pz) < edge
        if not (is_smooth and MIN_DEPTH < pz < MAX_VALUE):
            continue
        # the normal: (below - above) x (right - left), which points away from the
        # camera
        rx = rx - lx
        ry = ry - ly
        rz = rz - lz
        bx = bx - ax
        by = by - ay
        bz = bz - az
        nx = by * rz - bz * ry
        ny = bz * rx - bx * rz
        nz = bx * ry - by * rx
        inverse = ONE / max(np.sqrt(nx * nx + ny * ny + nz * nz), MIN_NORMAL)
        nx = nx * inverse
        ny = ny * inverse
        nz = nz * inverse
        distance = (X - px) * nx + (Y - py) * ny + (Z - pz) * nz
        rows[PlaneRow.RESIDUAL, k] = distance
        rows[1, k] = nx
        rows[2, k] = ny
        rows[3, k] = nz
        rows[4, k] = Y * nz - Z * ny
        rows[5, k] = Z * nx - X * nz
        rows[6, k] = X * ny - Y * nx
        rows[PlaneRow.SURFACE_DEPTH, k] = pz


@njit(fastmath=FASTMATH, error_model="numpy", cache=True, nogil=True)
def weigh_points(static_weight, noise_polynomial, squared_cutoff, rows, weights):
    """Fill robust factors and weights of the points, and return the robust cost.

    Args:
        static_weight: (N,) float32, from 0 to 1.
        noise_polynomial: (3,) float32 a, b, c: at depth z the noise is a + b z + c
            z^2, metres.
        squared_cutoff: c^2 of the robust kernel, squared standard deviations,
            float32.
        rows: (11, N) float32, see :class:`PlaneRow`, linearized.
        weights: (N,) float32, filled; 0 where there is no surface.
    """
    a = noise_polynomial[0]
    b = noise_polynomial[1]
    c = noise_polynomial[2]
    r = rows[PlaneRow.RESIDUAL]
    surface_depth = rows[PlaneRow.SURFACE_DEPTH]
    robust_row = rows[PlaneRow.ROBUST]
    cost = ZERO
    for k in range(len(weights)):
        z = surface_depth[k]
        seen = z > ZERO
        sigma = max(a + (b + c * z) * z, NOISE_FLOOR * z)
        inverse = ONE / (sigma if seen else ONE)
        d = r[k] * inverse
        robust = squared_cutoff / (squared_cutoff + d * d) if seen else ZERO
        robust_row[k] = robust
        weights[k] = static_weight[k] * robust * robust * inverse * inverse
        cost += static_weight[k] * (ONE - robust)
    return HALF * squared_cutoff * cost
