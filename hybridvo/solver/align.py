"""Newton's method for motion, gain and offset over images, depth maps and a prior."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from hybridvo.compiled.numba_tools import njit
from hybridvo.solver.calibration import (
    DAMPING_DECREASE,
    DAMPING_INCREASE,
    FAILED_DAMPING,
    IMAGE_TOLERANCE,
    MAX_IMAGE_GAIN,
    MIN_IMAGE_GAIN,
    PRIOR_FREEDOM,
    ROBUST_CURVATURE,
)
from hybridvo.solver.image_kernels import (
    RELATIVE_RIDGE,
    RIDGE,
    linearize_images,
    weigh_pixels,
)
from hybridvo.solver.plane_kernels import linearize_planes, weigh_points
from hybridvo.solver.products import add_products
from hybridvo.solver.robust_fit import exponential
from hybridvo.solver.rows import (
    IMAGE_TERMS,
    PLANE_ROWS,
    PLANE_TERMS,
    ImageRow,
)


class ImageInputs(NamedTuple):
    """What the alignment needs of the images."""

    pixels: np.ndarray  # (8, N) float32, see PixelRow
    image: np.ndarray  # (H, W) float32 grey values of the current image
    camera: np.ndarray  # (6,) float32, see project_pixels
    noise: np.ndarray  # (2,) float32 standard deviations, see weigh_pixels
    squared_cutoff: np.float32  # of the robust kernel
    rows: np.ndarray  # (12, N) float32, filled, see ImageRow
    weights: np.ndarray  # (N,) float32, filled
    information_scale: float  # factor on the information of these residuals


class PlaneInputs(NamedTuple):
    """What the alignment needs of the depth maps."""

    points: np.ndarray  # (N, 3) float32 metres, in the previous camera
    depth: np.ndarray  # (H, W) float32 metres, the current depth map
    camera: np.ndarray  # (4,) float32 (fx, fy, cx, cy) of the current frame
    static_weight: np.ndarray  # (N,) float32
    noise_polynomial: np.ndarray  # (3,) float32, see weigh_points
    squared_cutoff: np.float32  # of the robust kernel
    rows: np.ndarray  # (11, N) float32, filled, see PlaneRow
    weights: np.ndarray  # (N,) float32, filled
    # factor on the information; 0: depth maps are not used
    information_scale: float


class Prior(NamedTuple):
    """A motion that is known without the images."""

    T_prev_curr: np.ndarray  # (4, 4) its inverse
    information: np.ndarray  # (6, 6) of its left tangent


NO_PRIOR = Prior(np.eye(4), np.zeros((6, 6)))
NO_PLANES = PlaneInputs(
    points=np.zeros((0, 3), np.float32),
    depth=np.zeros((1, 1), np.float32),
    camera=np.ones(4, np.float32),
    static_weight=np.zeros(0, np.float32),
    noise_polynomial=np.array([0, 0, 1], np.float32),
    squared_cutoff=np.float32(1),
    rows=np.zeros((PLANE_ROWS, 0), np.float32),
    weights=np.zeros(0, np.float32),
    information_scale=0.0,
)


@njit(error_model="numpy", cache=True, nogil=True)
def tangent_from(T_prev_curr, T):
    """Return the left tangent (6,) from a motion, given its inverse, to ``T``.

    It is exact to second order in the angle, which suffices near the prior.
    """
    E = T @ T_prev_curr
    phi = 0.5 * np.array([E[2, 1] - E[1, 2], E[0, 2] - E[2, 0], E[1, 0] - E[0, 1]])
    t = E[:3, 3].copy()
    return np.concatenate((t - 0.5 * np.cross(phi, t), phi))


@njit(error_model="numpy", cache=True, nogil=True)
def add_prior(T_prev_curr, information, T, sums):
    """Add a prior under Student's kernel to the normal equations of the images.

    Args:
        T_prev_curr: (4, 4) inverse of the prior motion.
        information: (6, 6) of the prior.
        T: (4, 4) the motion.
        sums: (9, 9) normal equations, see :class:`ImageRow`; changed.

    Returns:
        The cost, and the squared distance in standard deviations.
    """
    xi = tangent_from(T_prev_curr, T)
    d2 = xi @ information @ xi
    H = (PRIOR_FREEDOM + 6) / (PRIOR_FREEDOM + d2) * information
    sums[1:7, 1:7] += H
    sums[1:7, ImageRow.RESIDUAL] += H @ xi
    return 0.5 * (PRIOR_FREEDOM + 6) * np.log1p(d2 / PRIOR_FREEDOM), d2


@njit(error_model="numpy", cache=True, nogil=True)
def normal_equations(images, planes, prior, T, gain_offset):
    """Return the normal equations (9, 9) at a motion, gain and offset, and the cost."""
    sums = np.zeros((IMAGE_TERMS, IMAGE_TERMS))
    linearize_images(
        images.pixels, images.image, images.camera, T, gain_offset, images.rows
    )
    cost = images.information_scale * weigh_pixels(
        images.pixels,
        images.noise,
        images.squared_cutoff,
        images.rows,
        images.weights,
    )
    add_products(
        images.rows[:IMAGE_TERMS], images.weights, images.information_scale, sums
    )
    if planes.information_scale > 0:
        linearize_planes(planes.points, planes.depth, planes.camera, T, planes.rows)
        cost += planes.information_scale * weigh_points(
            planes.static_weight,
            planes.noise_polynomial,
            planes.squared_cutoff,
            planes.rows,
            planes.weights,
        )
        add_products(
            planes.rows[:PLANE_TERMS],
            planes.weights,
            planes.information_scale,
            sums,
        )
    sums[1:, 1:] *= ROBUST_CURVATURE
    cost += add_prior(prior.T_prev_curr, prior.information, T, sums)[0]
    return sums, cost


@njit(error_model="numpy", cache=True, nogil=True)
def newton_step(sums, damping):
    """Return a damped Newton step (8,) and its squared length in sigmas."""
    H = sums[1:, 1:].copy()
    g = -sums[1:, ImageRow.RESIDUAL].copy()
    for p in range(IMAGE_TERMS - 1):
        H[p, p] += (damping + RELATIVE_RIDGE) * H[p, p] + RIDGE
    step = np.linalg.solve(H, g)
    return step, step @ g


@njit(error_model="numpy", cache=True, nogil=True)
def align(images, planes, prior, T, gain_offset, steps):
    """Follow images, depth maps and prior from a motion to one of least cost.

    A step after which the cost is higher is taken back and made shorter.

    Args:
        images: an :class:`ImageInputs`.
        planes: a :class:`PlaneInputs`.
        prior: a :class:`Prior`.
        T: (4, 4) T_curr_prev to start from.
        gain_offset: (2,) gain and offset to start from.
        steps: largest number of steps.

    Returns:
        The motion (4, 4), and gain and offset (2,).
    """
    best_T = T
    best_gain_offset = gain_offset
    best_sums = np.zeros((IMAGE_TERMS, IMAGE_TERMS))
    least_cost = np.inf
    damping = 0.0
    for _ in range(steps):
        sums, cost = normal_equations(images, planes, prior, T, gain_offset)
        falls = cost <= least_cost
        if falls:
            best_T = T
            best_gain_offset = gain_offset
            best_sums = sums
            least_cost = cost
            damping = DAMPING_DECREASE * damping
        else:
            damping = max(DAMPING_INCREASE * damping, FAILED_DAMPING)
        step, squared_length = newton_step(best_sums, damping)
        T = exponential(step[:6]) @ best_T
        gain_offset = best_gain_offset + step[6:]
        gain_offset[0] = min(max(gain_offset[0], MIN_IMAGE_GAIN), MAX_IMAGE_GAIN)
        if falls and squared_length < IMAGE_TOLERANCE * IMAGE_TOLERANCE:
            break
    return T, gain_offset
