"""Numba kernels of the images: pixels to use, residuals, Jacobians, weights.

- The residual is r = B(pi(X')) - gain A - offset. A and B are grey values of the
  previous and of the current image. B is read by cubic convolution: bilinear
  reading blurs by an amount that depends on the place between the pixels (twice the
  error on clean images).
- The gradient of B at pi(X') is computed from that of A at x, carried over by the
  warp of a patch of constant depth (inverse compositional, Baker and Matthews, IJCV
  2004): the noise of A's gradient is independent of that of B.
- The variance of r is s^2 + sd^2 v_d (G^T q)^2, with s the noise of the residual in
  grey levels and the rest as in :mod:`hybridvo.solver.kernels`.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from hybridvo.compiled.numba_tools import njit
from hybridvo.solver import kernels
from hybridvo.solver.calibration import (
    EVEN_PARTS,
    MAX_IMAGE_GAIN,
    MIN_IMAGE_GAIN,
    SHARED_SHIFT,
)
from hybridvo.solver.correlated_errors import (
    Information,
    Tiling,
    estimate_information,
    robust_std,
)
from hybridvo.solver.kernels import FASTMATH, MAX_VALUE, MIN_DEPTH, ONE, ZERO
from hybridvo.solver.newton_kernels import DAMPING, solve_definite
from hybridvo.solver.products import add_products
from hybridvo.solver.rows import IMAGE_ROWS, IMAGE_TERMS, ImageRow, PixelRow

# Smallest standard deviation of the photometric residual, grey levels: rounding to 8 bits leaves
# 0.08 after the blur.
GREY_NOISE_FLOOR = 0.1
# Area in the current image, px, of a pixel of the previous one, below which its surface is viewed
# edge-on and its gradient is not carried over.
MIN_PATCH_AREA = 1e-3

# pixels this close to the border are not read, because reading needs neighbours
MARGIN = 3
MIN_AREA = np.float32(MIN_PATCH_AREA)
HALF = np.float32(0.5)


class ComparedImages(NamedTuple):
    """Two images that are compared: pixels of one, and the other."""

    pixels: np.ndarray  # (8, N) float32, see PixelRow
    image: np.ndarray  # (H, W) float32 grey values of the current image
    camera: np.ndarray  # (6,) float32, see project_pixels
    squared_cutoff: np.float32  # of the robust kernel
    contrast: float  # root mean square of the gradients of the pixels
    places: Tiling  # where the pixels lie in the previous image


class ImagesAt(NamedTuple):
    """Differences of two images at one motion, under the gain and offset that fit there."""

    rows: np.ndarray  # (12, N) float32 residuals and derivatives, see ImageRow
    weights: np.ndarray  # (N,) float32 robust weights, in units of information
    # (2,) gain of the current image over the previous one, offset in grey levels
    gain_offset: np.ndarray
    # (2,) float32 standard deviations: of the residual, grey levels; of the typical log depth
    noise: np.ndarray
    information: Information


# -- selection of pixels -----------------------------------------------------------


@njit(fastmath=FASTMATH, error_model="numpy", cache=True, nogil=True)
def update_strongest(v, grey, depth, weights, min_weight, strongest, row_of):
    """Update each column's strongest squared gradient, and its row, with row ``v``."""
    kernels.noinline()  # type: ignore[call-arg]
    left = grey[v][MARGIN - 1 :]
    right = grey[v][MARGIN + 1 :]
    above = grey[v - 1][MARGIN:]
    below = grey[v + 1][MARGIN:]
    depth_row = depth[v][MARGIN:]
    weight_row = weights[v][MARGIN:]
    strongest = strongest[MARGIN:]
    row_of = row_of[MARGIN:]
    for u in range(len(depth_row) - MARGIN):
        gx = right[u] - left[u]
        gy = below[u] - above[u]
        z = depth_row[u]
        usable = (weight_row[u] >= min_weight) & (z > MIN_DEPTH) & (z < MAX_VALUE)
        strength = gx * gx + gy * gy if usable else ZERO
        row_of[u] = v if strength > strongest[u] else row_of[u]
        strongest[u] = max(strength, strongest[u])


@njit(error_model="numpy", cache=True, nogil=True)
def select_pixels(grey, depth, weights, min_weight, cell):
    """Return the pixel with the strongest gradient in each cell of an image.

    Args:
        grey: (H, W) float32 grey values.
        depth: (H, W) float32 metres; pixels without valid depth are left out.
        weights: (H, W) float32.
        min_weight: smallest weight of a pixel that is used.
        cell: side of a cell, px; it need not be a whole number.

    Returns:
        (N, 2) int32 rows and columns.
    """
    height, width = grey.shape
    strongest = np.zeros(width, np.float32)
    row_of = np.zeros(width, np.int32)
    cell_rows = int(height / cell + 1)
    cell_columns = int(width / cell + 1)
    index = np.empty((cell_rows * cell_columns, 2), np.int32)
    count = 0
    for v in range(MARGIN, height - MARGIN):
        update_strongest(
            np.int32(v), grey, depth, weights, min_weight, strongest, row_of
        )
        is_last_row_of_cell = int((v + 1) / cell) != int(v / cell)
        if not is_last_row_of_cell:
            continue
        for k in range(int(width / cell) + 1):
            u = int(k * cell)
            for other in range(u + 1, min(int((k + 1) * cell), width)):
                if strongest[other] > strongest[u]:
                    u = other
            if u < width and strongest[u] > ZERO:
                index[count, 0] = row_of[u]
                index[count, 1] = u
                count += 1
        strongest[:] = ZERO
    return index[:count]


@njit(error_model="numpy", cache=True, nogil=True)
def fill_pixels(index, grey, depth, weights, camera, pixels):
    """Fill what is known of some pixels of the previous frame, but for the variance of depth.

    Args:
        index: (N, 2) rows and columns, none at the border.
        grey: (H, W) float32 grey values.
        depth: (H, W) metres.
        weights: (H, W) static weights; more than 1 counts as 1.
        camera: (4,) float64 fx, fy, cx, cy.
        pixels: (8, N) float32, see :class:`PixelRow`; changed.
    """
    fx, fy, cx, cy = camera
    for k in range(len(index)):
        v = index[k, 0]
        u = index[k, 1]
        pixels[PixelRow.RAY_X, k] = (u - cx) / fx
        pixels[PixelRow.RAY_Y, k] = (v - cy) / fy
        pixels[PixelRow.DEPTH, k] = depth[v, u]
        pixels[PixelRow.GREY, k] = grey[v, u]
        pixels[PixelRow.GRADIENT_X, k] = HALF * (grey[v, u + 1] - grey[v, u - 1])
        pixels[PixelRow.GRADIENT_Y, k] = HALF * (grey[v + 1, u] - grey[v - 1, u])
        pixels[PixelRow.WEIGHT, k] = min(weights[v, u], ONE)


# -- reading between pixels --------------------------------------------------------


@njit(fastmath=FASTMATH, error_model="numpy", cache=True, nogil=True)
def cubic_weights(f):
    """Return the weights of four neighbours, ``f`` of the way between the inner two."""
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
    """Read an image at (u, v) by cubic convolution with a = -1/2 (Keys 1981)."""
    column = int(u)
    row = int(v)
    x0, x1, x2, x3 = cubic_weights(u - np.float32(column))
    y0, y1, y2, y3 = cubic_weights(v - np.float32(row))
    a = image[row - 1]
    b = image[row]
    c = image[row + 1]
    d = image[row + 2]
    j = column - 1
    return (
        y0 * (x0 * a[j] + x1 * a[j + 1] + x2 * a[j + 2] + x3 * a[j + 3])
        + y1 * (x0 * b[j] + x1 * b[j + 1] + x2 * b[j + 2] + x3 * b[j + 3])
        + y2 * (x0 * c[j] + x1 * c[j + 1] + x2 * c[j + 2] + x3 * c[j + 3])
        + y3 * (x0 * d[j] + x1 * d[j + 1] + x2 * d[j + 2] + x3 * d[j + 3])
    )


# -- residuals and weights ---------------------------------------------------------


@njit(fastmath=FASTMATH, error_model="numpy", cache=True, nogil=True)
def project_pixels(pixels, T, gain, shape, camera, rows):
    """Fill the places and the Jacobians of pixels in the current image.

    Args:
        pixels: (8, N) float32, see :class:`PixelRow`.
        T: (4, 4) T_curr_prev.
        gain: of the current image over the previous one.
        shape: (height, width) of the current image.
        camera: (6,) float32 (fx, fy, cx, cy) of the current frame, (1/fx, 1/fy) of
            the previous.
        rows: (12, N) float32, see :class:`ImageRow`; filled, but for the residual
            and its derivatives in gain and offset.
    """
    kernels.noinline()  # type: ignore[call-arg]
    fx = camera[0]
    fy = camera[1]
    cx = camera[2]
    cy = camera[3]
    # focal length of the current frame over that of the previous one
    ratio_xx = fx * camera[4]
    ratio_xy = fx * camera[5]
    ratio_yx = fy * camera[4]
    ratio_yy = fy * camera[5]
    entries = kernels.pose_entries(T.astype(np.float32))
    r00, r01, _, _, r10, r11, _, _, r20, r21, _, _ = entries
    low = np.float32(MARGIN - 1)
    high_u = np.float32(shape[1] - MARGIN)
    high_v = np.float32(shape[0] - MARGIN)
    ray_x = pixels[PixelRow.RAY_X]
    ray_y = pixels[PixelRow.RAY_Y]
    depth = pixels[PixelRow.DEPTH]
    gradient_x = pixels[PixelRow.GRADIENT_X]
    gradient_y = pixels[PixelRow.GRADIENT_Y]
    d_tx = rows[1]
    d_ty = rows[2]
    d_tz = rows[3]
    d_rx = rows[4]
    d_ry = rows[5]
    d_rz = rows[6]
    d_log_depth = rows[ImageRow.LOG_DEPTH]
    u_row = rows[ImageRow.U]
    v_row = rows[ImageRow.V]
    for k in range(len(ray_x)):
        z = depth[k]
        # (a, b) is the moved point at depth 1, i the inverse of its depth
        a, b, i, in_front = kernels.transform_and_project(
            ray_x[k], ray_y[k], z, entries
        )
        u = fx * a + cx
        v = fy * b + cy
        # the warp d pi / d x of a patch of constant depth: A's gradient is its
        # transpose times B's
        s = z * i
        w00 = s * ratio_xx * (r00 - a * r20)
        w01 = s * ratio_xy * (r01 - a * r21)
        w10 = s * ratio_yx * (r10 - b * r20)
        w11 = s * ratio_yy * (r11 - b * r21)
        area = w00 * w11 - w01 * w10
        seen = in_front & (u > low) & (u < high_u) & (v > low) & (v < high_v)
        seen &= area > MIN_AREA
        f = gain / (area if seen else ONE)
        gx = f * (w11 * gradient_x[k] - w10 * gradient_y[k])
        gy = f * (w00 * gradient_y[k] - w01 * gradient_x[k])
        # displacement of the pixel with the log depth
        qu, qv = kernels.depth_jacobian(a, b, i, entries, camera)
        d_log_depth[k] = gx * qu + gy * qv
        gx *= fx
        gy *= fy
        d_tx[k] = gx * i
        d_ty[k] = gy * i
        d_tz[k] = -(gx * a + gy * b) * i
        d_rx[k] = -(gx * a * b + gy * (ONE + b * b))
        d_ry[k] = gx * (ONE + a * a) + gy * a * b
        d_rz[k] = gy * a - gx * b
        u_row[k] = u if seen else -ONE
        v_row[k] = v


@njit(error_model="numpy", cache=True, nogil=True)
def linearize_images(pixels, image, camera, T, gain_offset, rows):
    """Fill residuals and derivatives of pixels at a motion, gain and offset.

    Args:
        pixels: (8, N) float32, see :class:`PixelRow`.
        image: (H, W) float32 grey values of the current image.
        camera: (6,) float32, see :func:`project_pixels`.
        T: (4, 4) T_curr_prev.
        gain_offset: (2,) gain, and offset in grey levels.
        rows: (12, N) float32, see :class:`ImageRow`; filled.
    """
    gain = np.float32(gain_offset[0])
    offset = np.float32(gain_offset[1])
    project_pixels(pixels, T, gain, image.shape, camera, rows)
    for k in range(rows.shape[1]):
        grey = pixels[PixelRow.GREY, k]
        rows[ImageRow.RESIDUAL, k] = ZERO
        rows[ImageRow.GAIN, k] = -grey
        rows[ImageRow.OFFSET, k] = -ONE
        u = rows[ImageRow.U, k]
        if u > ZERO:
            value = read_cubic(image, u, rows[ImageRow.V, k])
            rows[ImageRow.RESIDUAL, k] = value - gain * grey - offset


@njit(fastmath=FASTMATH, error_model="numpy", cache=True, nogil=True)
def weigh_pixels(pixels, noise, squared_cutoff, rows, weights):
    """Fill the weights of the residuals, and return the robust cost.

    Args:
        pixels: (8, N) float32, see :class:`PixelRow`.
        noise: (2,) standard deviations: of the residual, grey levels; of the
            typical log depth.
        squared_cutoff: c^2 of the robust kernel, squared standard deviations,
            float32.
        rows: (12, N) float32, see :class:`ImageRow`, linearized.
        weights: (N,) float32, filled; 0 where a pixel is not visible.
    """
    kernels.noinline()  # type: ignore[call-arg]
    grey_variance = noise[0] * noise[0]
    depth_std = noise[1]
    cost = ZERO
    static_weight = pixels[PixelRow.WEIGHT]
    depth_variance = pixels[PixelRow.DEPTH_VARIANCE]
    d_log_depth = rows[ImageRow.LOG_DEPTH]
    r = rows[ImageRow.RESIDUAL]
    u = rows[ImageRow.U]
    for k in range(len(weights)):
        q = depth_std * d_log_depth[k]
        information = ONE / (grey_variance + depth_variance[k] * q * q)
        d2 = r[k] * r[k] * information
        robust = squared_cutoff / (squared_cutoff + d2) if u[k] > ZERO else ZERO
        weights[k] = static_weight[k] * robust * robust * information
        cost += static_weight[k] * (ONE - robust)
    return HALF * squared_cutoff * cost


# -- differences at a motion ---------------------------------------------------------


@njit(error_model="numpy", cache=True, nogil=True)
def compare_images(images, T, gain_offset, noise):
    """Return the :class:`ImagesAt` of two images at a motion.

    Args:
        images: an :class:`ComparedImages`.
        T: (4, 4) T_curr_prev.
        gain_offset: (2,) gain and offset so far.
        noise: (2,) float32 standard deviations so far, see :func:`weigh_pixels`.
    """
    rows, weights, gain_offset, noise, products = weigh_images(
        images, T, gain_offset, noise
    )
    # px along each axis of the image
    shift = np.float32(SHARED_SHIFT * noise[0] / images.contrast)
    gradient = images.pixels[PixelRow.GRADIENT_X : PixelRow.GRADIENT_Y + 1]
    information = estimate_information(
        rows[:IMAGE_TERMS],
        weights,
        shift * gradient,
        products,
        images.places,
        EVEN_PARTS,
    )
    return ImagesAt(rows, weights, gain_offset, noise, information)


@njit(error_model="numpy", cache=True, nogil=True)
def weigh_images(images, T, gain_offset, noise):
    """Linearize, estimate the noise, then gain and offset under it.

    Returns:
        Rows, weights, gain and offset, and noise as in :class:`ImagesAt`, and the sums (9, 9) of
        the weighted products of the rows.
    """
    count = images.pixels.shape[1]
    rows = np.empty((IMAGE_ROWS, count), np.float32)
    weights = np.empty(count, np.float32)
    linearize_images(
        images.pixels, images.image, images.camera, T, gain_offset, rows
    )
    lengths = np.abs(rows[ImageRow.RESIDUAL][rows[ImageRow.U] > ZERO])
    noise = noise.copy()
    if len(lengths) > 0:
        noise[0] = max(robust_std(lengths), GREY_NOISE_FLOOR)
    weigh_pixels(images.pixels, noise, images.squared_cutoff, rows, weights)
    products = np.zeros((IMAGE_TERMS, IMAGE_TERMS))
    add_products(rows[:IMAGE_TERMS], weights, 1.0, products)
    change = fitting_change(products, gain_offset)
    shift_residuals(rows, products, change)
    return rows, weights, gain_offset + change, noise, products


@njit(error_model="numpy", cache=True, nogil=True)
def fitting_change(products, gain_offset):
    """Return the change (2,) of gain and offset that fits under normal equations (9, 9).

    Without texture the gain stays as it is.
    """
    A = products[ImageRow.GAIN : IMAGE_TERMS, ImageRow.GAIN : IMAGE_TERMS].copy()
    b = products[ImageRow.GAIN : IMAGE_TERMS, ImageRow.RESIDUAL].copy()
    step = solve_definite(A, b, DAMPING)
    if np.isnan(step[0]):
        return np.zeros(2)
    after = gain_offset - step
    after[0] = min(max(after[0], MIN_IMAGE_GAIN), MAX_IMAGE_GAIN)
    return after - gain_offset


@njit(error_model="numpy", cache=True, nogil=True)
def shift_residuals(rows, products, change):
    """Update residuals and normal equations by a change (2,) of gain and offset."""
    by_gain = np.float32(change[0])
    by_offset = np.float32(change[1])
    for k in range(rows.shape[1]):
        residual = rows[ImageRow.RESIDUAL, k] + by_gain * rows[ImageRow.GAIN, k]
        rows[ImageRow.RESIDUAL, k] = residual + by_offset * rows[ImageRow.OFFSET, k]
    for p in range(IMAGE_TERMS):
        products[p, ImageRow.RESIDUAL] += (
            products[p, ImageRow.GAIN] * change[0]
            + products[p, ImageRow.OFFSET] * change[1]
        )
    for p in range(IMAGE_TERMS):
        products[ImageRow.RESIDUAL, p] += (
            change[0] * products[ImageRow.GAIN, p]
            + change[1] * products[ImageRow.OFFSET, p]
        )


# -- normal equations under a known noise ---------------------------------------------


@njit(error_model="numpy", cache=True, nogil=True)
def sum_images(noisy, T, gain_offset):
    """Return the sums (9, 9) of the weighted products of the rows of all pixels, and the cost.

    Args:
        noisy: a :class:`hybridvo.solver.image_factor.NoisyImages`.
        T: (4, 4) T_curr_prev.
        gain_offset: (2,) gain, and offset in grey levels.
    """
    sums = np.zeros((IMAGE_TERMS, IMAGE_TERMS))
    images = noisy.images
    rows = noisy.rows
    linearize_images(
        images.pixels, images.image, images.camera, T, gain_offset, rows
    )
    cost = weigh_pixels(
        images.pixels, noisy.noise, images.squared_cutoff, rows, noisy.weights
    )
    add_products(rows[:IMAGE_TERMS], noisy.weights, noisy.information_scale, sums)
    return sums, noisy.information_scale * cost
