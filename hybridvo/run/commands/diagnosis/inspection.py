"""Measurements on single frames that show, without ground truth, whether a recording is usable."""

from __future__ import annotations

from typing import NamedTuple

import cv2
import numpy as np

# relative step of depth between neighbours that an image shows as an edge
MIN_DEPTH_EDGE = 0.05
# grey levels per pixel: above the noise of a camera
MIN_TEXTURE_GRADIENT = 2.0
# of the gradients, from which edges are strong enough to judge focus
STRONG_EDGE_PERCENTILE = 95
# grey levels per pixel: one bright edge does not count more than others
MAX_EDGE_GRADIENT = 10.0
# fraction of width and height within which a displacement is looked for
MAX_EDGE_DISPLACEMENT = 0.15
# px, of the side of the surroundings whose mean gradient is subtracted
EDGE_SURROUNDINGS_PX = 31


class Sharpness(NamedTuple):
    """How much there is to see in an image, and how sharp it is."""

    textured: float  # fraction of the pixels with a gradient above the noise
    focus: float  # second over first derivative at the strongest edges


def valid_fraction(depth: np.ndarray) -> float:
    """Return the fraction of the pixels of a depth map (H, W) that have depth."""
    is_valid = np.isfinite(depth) & (depth > 0)
    return float(is_valid.mean())


def sharpness(rgb: np.ndarray) -> Sharpness:
    """Measure how much there is to see in an image, and how sharp it is.

    Args:
        rgb: (H, W, 3) uint8.

    Returns:
        The fraction of textured pixels, and the focus: 0.9 and more for a sharp image, below 0.3
        after a blur of three pixels (standard deviation).
    """
    grey = cv2.cvtColor(rgb, cv2.COLOR_RGB2GRAY)
    gradient = _gradient(grey)
    is_strong = gradient >= np.percentile(gradient, STRONG_EDGE_PERCENTILE)
    second_derivative = np.abs(cv2.Laplacian(grey, cv2.CV_32F))
    strong_gradient = max(float(gradient[is_strong].mean()), 1e-6)
    focus = second_derivative[is_strong].mean() / strong_gradient
    textured = (gradient > MIN_TEXTURE_GRADIENT).mean()
    return Sharpness(float(textured), float(focus))


def edge_agreement(rgb: np.ndarray, depth: np.ndarray) -> np.ndarray:
    """Correlate the image's gradients with the edges of depth, over displacements.

    Args:
        rgb: (H, W, 3) uint8.
        depth: (H, W) metres.

    Returns:
        (2 m + 1, 2 n + 1) grey levels above the surroundings, per edge pixel. Entry
        ``[m + y, n + x]`` is for depth whose edges lie ``y`` pixels below and ``x`` pixels right of
        the image's.
    """
    edges = _depth_edges(depth)
    grey = cv2.GaussianBlur(cv2.cvtColor(rgb, cv2.COLOR_RGB2GRAY), (0, 0), 1)
    gradient = np.minimum(_gradient(grey), MAX_EDGE_GRADIENT)
    gradient -= cv2.blur(gradient, (EDGE_SURROUNDINGS_PX, EDGE_SURROUNDINGS_PX))
    # A correlation is a product of the Fourier transforms.
    product = np.fft.rfft2(edges) * np.conj(np.fft.rfft2(gradient))
    sums = np.fft.irfft2(product, s=edges.shape)
    height, width = edges.shape
    m = int(MAX_EDGE_DISPLACEMENT * height)
    n = int(MAX_EDGE_DISPLACEMENT * width)
    # Negative displacements are at the end of each axis: shift zero to the middle.
    centred = np.roll(sums, (m, n), (0, 1))[: 2 * m + 1, : 2 * n + 1]
    return centred / max(float(edges.sum()), 1.0)


def _gradient(grey: np.ndarray) -> np.ndarray:
    """Return the length of the gradient of an image (H, W), grey levels per pixel."""
    # The weights of a Sobel filter sum to 8.
    du = cv2.Sobel(grey, cv2.CV_32F, 1, 0) / 8
    dv = cv2.Sobel(grey, cv2.CV_32F, 0, 1) / 8
    return cv2.magnitude(du, dv)


def _depth_edges(depth: np.ndarray) -> np.ndarray:
    """Return where depth jumps between two neighbours that both have it, (H, W) of 0 and 1."""
    is_valid = np.isfinite(depth) & (depth > 0)
    log_depth = np.where(is_valid, np.log(np.where(is_valid, depth, 1.0)), np.nan)
    step_x = np.nan_to_num(np.abs(np.diff(log_depth, axis=1)))
    step_y = np.nan_to_num(np.abs(np.diff(log_depth, axis=0)))
    edges = np.zeros(depth.shape, np.float32)
    edges[:, 1:] += step_x > MIN_DEPTH_EDGE
    edges[1:] += step_y > MIN_DEPTH_EDGE
    return np.minimum(edges, 1.0)
