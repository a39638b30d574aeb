"""What a recording tells about itself without any truth: measured from single frames."""

from __future__ import annotations

import cv2
import numpy as np

# relative step of depth between neighbours that an image shows as an edge
DEPTH_EDGE = 0.05
# grey levels a pixel from which a gradient stands above the noise of a camera
TEXTURED = 2.0
STRONGEST = 95  # percentile of the gradients at which focus is judged
CLIPPED = 10.0  # grey levels a pixel: one bright edge counts no more than others
REACH = 0.15  # share of width and height within which a displacement is looked for


def valid_share(depth: np.ndarray) -> float:
    """Return the share of the pixels of a depth map (H, W) that have depth."""
    return float((np.isfinite(depth) & (depth > 0)).mean())


def texture_and_focus(rgb: np.ndarray) -> tuple[float, float]:
    """Measure how much there is to see in an image, and how sharp it is.

    Args:
        rgb: (H, W, 3) uint8.

    Returns:
        The share of the pixels with a gradient above the noise; the ratio of the second
        derivative to the first at the strongest edges, which are 0.9 and more in focus and below
        0.3 where a blur of three pixels (standard deviation) lies over the image.
    """
    gray = cv2.cvtColor(rgb, cv2.COLOR_RGB2GRAY)
    gradient = _gradient(gray)
    strong = gradient >= np.percentile(gradient, STRONGEST)
    curved = np.abs(cv2.Laplacian(gray, cv2.CV_32F))
    focus = curved[strong].mean() / max(float(gradient[strong].mean()), 1e-6)
    return float((gradient > TEXTURED).mean()), float(focus)


def edge_agreement(rgb: np.ndarray, depth: np.ndarray) -> np.ndarray:
    """Sum the image's gradients at the edges of depth, moved by every displacement.

    Args:
        rgb: (H, W, 3) uint8.
        depth: (H, W) metres.

    Returns:
        (2 m + 1, 2 n + 1): at ``[m + y, n + x]`` for depth whose edges lie ``y`` px below and
        ``x`` px right of the image's; per edge pixel, grey levels above the surroundings.
    """
    edges = _depth_edges(depth)
    gray = cv2.GaussianBlur(cv2.cvtColor(rgb, cv2.COLOR_RGB2GRAY), (0, 0), 1)
    gradient = np.minimum(_gradient(gray), CLIPPED)
    gradient -= cv2.blur(gradient, (31, 31))
    product = np.fft.rfft2(edges) * np.conj(np.fft.rfft2(gradient))
    sums = np.fft.irfft2(product, s=edges.shape)
    m, n = (int(REACH * size) for size in edges.shape)
    cut = np.roll(sums, (m, n), (0, 1))[: 2 * m + 1, : 2 * n + 1]
    return cut / max(float(edges.sum()), 1.0)


def _gradient(gray: np.ndarray) -> np.ndarray:
    """Length of the gradient of an image (H, W), grey levels a pixel."""
    du = cv2.Sobel(gray, cv2.CV_32F, 1, 0) / 8
    dv = cv2.Sobel(gray, cv2.CV_32F, 0, 1) / 8
    return cv2.magnitude(du, dv)


def _depth_edges(depth: np.ndarray) -> np.ndarray:
    """Where depth jumps between two neighbours that both have it, (H, W) of 0 and 1."""
    known = np.isfinite(depth) & (depth > 0)
    log = np.where(known, np.log(np.where(known, depth, 1.0)), np.nan)
    edges = np.zeros(depth.shape, np.float32)
    edges[:, 1:] += np.nan_to_num(np.abs(np.diff(log, axis=1))) > DEPTH_EDGE
    edges[1:] += np.nan_to_num(np.abs(np.diff(log, axis=0))) > DEPTH_EDGE
    return np.minimum(edges, 1.0)
