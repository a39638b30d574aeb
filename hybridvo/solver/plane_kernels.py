"""Numba kernels of the depth maps: distances of points to the surface.

The residual is r = n . (T X - P). X is a point of the previous depth map, P and n
are point and normal of the current one at the pixel where T X is visible.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from hybridvo.compiled.numba_tools import njit
from hybridvo.solver import kernels
from hybridvo.solver.calibration import (
    MIN_PLANE_POINTS,
    PLANE_EDGE,
    PLANE_REACH_PX,
    SHARED_DEPTH_ERROR,
)
from hybridvo.solver.correlated_errors import (
    Information,
    Tiling,
    estimate_information,
    robust_std,
)
from hybridvo.solver.image_kernels import HALF
from hybridvo.solver.kernels import FASTMATH, MAX_VALUE, MIN_DEPTH, ONE, ZERO
from hybridvo.solver.newton_kernels import inverse_or_nan
from hybridvo.solver.products import add_products
from hybridvo.solver.rows import (
    MOTION_TERMS,
    PLANE_ROWS,
    PLANE_TERMS,
    PlaneRow,
)

# Smallest standard deviation of a distance to a plane, as a fraction of the depth.
PLANE_NOISE_FLOOR = 1e-4

REACH = PLANE_REACH_PX
EDGE = np.float32(PLANE_EDGE)
NOISE_FLOOR = np.float32(PLANE_NOISE_FLOOR)
# the cross product of two steps on the surface, m^2: below, it has no direction
MIN_NORMAL = np.float32(1e-12)
SHARED_ERROR = np.float32(SHARED_DEPTH_ERROR)
# every fourth residual is used to fit the noise polynomial, which has three numbers
NOISE_STEP = 4
NOISE_TERMS = 3
# times that the polynomial is fitted: the first identifies which residuals are outliers
# of the second
NOISE_ROUNDS = 2
# mean of the absolute value of a standard normal number
MEAN_ABSOLUTE_NORMAL = np.sqrt(2 / np.pi)


class Surfaces(NamedTuple):
    """Two depth maps that are compared: points of one, and the surface of the other."""

    points: np.ndarray  # (N, 3) float32 metres, in the previous camera
    static_weight: np.ndarray  # (N,) float32, from 0 to 1
    depth: np.ndarray  # (H, W) float32 metres, the current depth map
    camera: np.ndarray  # (4,) float32 (fx, fy, cx, cy) of the current frame
    cutoff: float  # of the robust kernel, standard deviations
    quantum: (
        float  # step of the sensor over depth squared, 1 / m; 0: it does not round
    )
    places: Tiling  # where the points lie in the previous image


class PlanesAt(NamedTuple):
    """Distances of the points of a factor to the current surface, at one motion."""

    rows: np.ndarray  # (11, N) float32 residuals and derivatives, see PlaneRow
    weights: np.ndarray  # (N,) float32 robust weights, in units of information
    noise_polynomial: np.ndarray  # (3,) float32, see weigh_points
    information: Information

    @property
    def determine_motion(self) -> bool:
        """Whether enough points are visible on the current surface."""
        return self.information.scale > 0

    @property
    def surface_depth(self) -> np.ndarray:
        """(N,) depth of the surface that a point is visible on, metres; 0 where it is not."""
        return np.asarray(self.rows[PlaneRow.SURFACE_DEPTH])

    def noise(self, z: np.ndarray) -> np.ndarray:
        """Return the fitted standard deviation (N,) at depths (N,), metres."""
        a, b, c = self.noise_polynomial
        return np.maximum(a + (b + c * z) * z, NOISE_FLOOR * z)


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


@njit(error_model="numpy", cache=True, nogil=True)
def noise_at(polynomial, z):
    """Return the standard deviation of a distance at a depth, metres."""
    fitted = polynomial[0] + (polynomial[1] + polynomial[2] * z) * z
    return max(fitted, NOISE_FLOOR * z)


@njit(error_model="numpy", cache=True, nogil=True)
def fit_noise(z, lengths, cutoff):
    """Fit the noise a + b z + c z^2, without negative terms, to residuals.

    Args:
        z: (N,) float32 depths, metres.
        lengths: (N,) float32 absolute values of the residuals at these depths, metres.
        cutoff: standard deviations beyond which a residual is an outlier.

    Returns:
        (3,) float32 a, b, c.
    """
    polynomial = np.zeros(NOISE_TERMS, np.float32)
    polynomial[2] = robust_std(lengths / (z * z))
    row = np.ones(NOISE_TERMS)
    for _ in range(NOISE_ROUNDS):
        products = np.zeros((NOISE_TERMS, NOISE_TERMS))
        targets = np.zeros(NOISE_TERMS)
        for k in range(len(z)):
            if not lengths[k] < cutoff * noise_at(polynomial, z[k]):
                continue
            # relative errors are fitted
            row[0] = 1 / z[k]
            row[2] = z[k]
            relative = lengths[k] * row[0]
            for p in range(NOISE_TERMS):
                targets[p] += row[p] * relative
                for q in range(NOISE_TERMS):
                    products[p, q] += row[p] * row[q]
        polynomial[:] = non_negative(products, targets) / MEAN_ABSOLUTE_NORMAL
    return polynomial


@njit(error_model="numpy", cache=True, nogil=True)
def non_negative(products, targets):
    """Return the least-squares solution (N,) without negative terms, of a few unknowns.

    Each choice of the terms that are not zero is tried.

    Args:
        products: (N, N) of the columns.
        targets: (N,) products of the columns and the values.
    """
    size = len(targets)
    best = np.zeros(size)
    most_explained = 0.0
    for choice in range(1, 2**size):
        used = np.array([k for k in range(size) if choice >> k & 1])
        inverse = inverse_or_nan(products[used][:, used].copy())
        found = inverse @ targets[used]
        # False where they are not determined as well
        if not np.all(found >= 0):
            continue
        explained = np.sum(found * targets[used])
        if explained > most_explained:
            most_explained = explained
            best[:] = 0.0
            best[used] = found
    return best


@njit(error_model="numpy", cache=True, nogil=True)
def compare_surfaces(surfaces, T):
    """Return the :class:`PlanesAt` of two depth maps at a motion (4, 4)."""
    count = len(surfaces.points)
    rows = np.zeros((PLANE_ROWS, count), np.float32)
    weights = np.zeros(count, np.float32)
    # it grows with the square of the depth where nothing is known of it
    polynomial = np.array([0, 0, 1], np.float32)
    unknown = Information(np.zeros((MOTION_TERMS, MOTION_TERMS)), 0.0, 1.0)
    linearize_planes(surfaces.points, surfaces.depth, surfaces.camera, T, rows)
    surface_depth = rows[PlaneRow.SURFACE_DEPTH]
    seen = np.flatnonzero(surface_depth > ZERO)
    if len(seen) < MIN_PLANE_POINTS:
        return PlanesAt(rows, weights, polynomial, unknown)
    some = seen[::NOISE_STEP]
    polynomial[:] = fit_noise(
        surface_depth[some],
        np.abs(rows[PlaneRow.RESIDUAL][some]),
        surfaces.cutoff,
    )
    # of two maps that err by up to half a quantum each
    polynomial[2] = max(polynomial[2], np.float32(surfaces.quantum / np.sqrt(6)))
    squared_cutoff = np.float32(surfaces.cutoff * surfaces.cutoff)
    weigh_points(surfaces.static_weight, polynomial, squared_cutoff, rows, weights)
    shared = np.empty((1, count), np.float32)
    for k in range(count):
        shared[0, k] = SHARED_ERROR * noise_at(polynomial, surface_depth[k])
    terms = rows[:PLANE_TERMS]
    products = np.zeros((PLANE_TERMS, PLANE_TERMS))
    add_products(terms, weights, 1.0, products)
    information = estimate_information(
        terms, weights, shared, products, surfaces.places, 0.0
    )
    return PlanesAt(rows, weights, polynomial, information)


@njit(error_model="numpy", cache=True, nogil=True)
def sum_planes(noisy, T):
    """Return the sums (7, 7) of the weighted products of the rows of all points, and the cost.

    Args:
        noisy: a :class:`hybridvo.solver.planes.NoisyPlanes`.
        T: (4, 4) T_curr_prev.
    """
    sums = np.zeros((PLANE_TERMS, PLANE_TERMS))
    if noisy.information_scale == 0:
        return sums, 0.0
    surfaces = noisy.surfaces
    rows = noisy.rows
    linearize_planes(surfaces.points, surfaces.depth, surfaces.camera, T, rows)
    cost = weigh_points(
        surfaces.static_weight,
        noisy.noise_polynomial,
        np.float32(surfaces.cutoff * surfaces.cutoff),
        rows,
        noisy.weights,
    )
    add_products(rows[:PLANE_TERMS], noisy.weights, noisy.information_scale, sums)
    return sums, noisy.information_scale * cost
