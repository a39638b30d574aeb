"""Images that belong to a frame: grey, blurred, reduced. Each is computed once.

They are kept as long as their frame, which is the current one of a pair and then the previous
one of the next.
"""

from __future__ import annotations

import cv2
import numpy as np

from hybridvo.compiled.numba_tools import as_contiguous, njit
from hybridvo.core.kept import kept_with_frame
from hybridvo.core.types import Frame
from hybridvo.core.unchecked import changed

# Standard deviation of the blur of both images, px.
IMAGE_BLUR_PX = 1.0

# luma weights of red, green and blue
RED = np.float32(0.299)
GREEN = np.float32(0.587)
BLUE = np.float32(0.114)
# makes gain and offset independent
MID_GREY = np.float32(128.0)


@kept_with_frame
def grey_bytes(frame: Frame) -> np.ndarray:
    """The grey image of a frame, (H, W) uint8."""
    assert frame.rgb is not None
    return cv2.cvtColor(frame.rgb, cv2.COLOR_RGB2GRAY)


@kept_with_frame
def grey(frame: Frame) -> np.ndarray:
    """The grey image of a frame, (H, W) float32, less mid grey.

    It is not rounded: 8 bits of grey would add as much noise as the camera's own
    rounding.
    """
    assert frame.rgb is not None
    return luma(as_contiguous(frame.rgb))


@njit(error_model="numpy", cache=True, nogil=True)
def luma(rgb):
    """Return the grey image (H, W) float32, less mid grey, of one (H, W, 3) uint8."""
    height, width, _ = rgb.shape
    grey = np.empty((height, width), np.float32)
    for v in range(height):
        for u in range(width):
            red = RED * np.float32(rgb[v, u, 0])
            green = GREEN * np.float32(rgb[v, u, 1])
            blue = BLUE * np.float32(rgb[v, u, 2])
            grey[v, u] = red + green + blue - MID_GREY
    return grey


@kept_with_frame
def blurred(frame: Frame) -> np.ndarray:
    """The blurred grey image of a frame, (H, W) float32, less mid grey."""
    return cv2.GaussianBlur(grey(frame), (0, 0), IMAGE_BLUR_PX)


def reduced(frame: Frame, factor: int) -> Frame:
    """Return a frame at 1 / ``factor`` of its size: image averaged, depth picked.

    Args:
        frame: with an image.
        factor: a power of two.

    Returns:
        A frame whose image only :func:`grey` and :func:`blurred` return.
    """
    if factor == 1:
        return frame
    sizes = _reductions(frame)
    if factor not in sizes:
        sizes[factor] = _reduce(frame, factor)
    return sizes[factor]


@kept_with_frame
def _reductions(frame: Frame) -> dict[int, Frame]:
    """The reduced frames that exist so far, by their reduction."""
    return {}


def _reduce(frame: Frame, factor: int) -> Frame:
    height = frame.camera.height // factor
    width = frame.camera.width // factor
    # the rows and columns that are left over are cut off
    used = np.s_[: height * factor, : width * factor]
    depth = None
    if frame.depth is not None:
        middle = factor // 2
        picked = frame.depth[used][middle::factor, middle::factor]
        depth = np.ascontiguousarray(picked)
    K = frame.camera
    # the centre of the first block is the pixel (factor - 1) / 2
    first = (factor - 1) / 2
    camera = changed(
        K,
        fx=K.fx / factor,
        fy=K.fy / factor,
        cx=(K.cx - first) / factor,
        cy=(K.cy - first) / factor,
        height=height,
        width=width,
    )
    small = changed(
        frame, rgb=None, depth=depth, camera=camera, depth_variance=None, mask=None
    )
    larger = grey(reduced(frame, factor // 2))
    averaged = cv2.resize(
        larger[: 2 * height, : 2 * width],
        (width, height),
        interpolation=cv2.INTER_AREA,
    )
    grey.keep(small, averaged)
    return small


def gradient_at(grey: np.ndarray, v: np.ndarray, u: np.ndarray) -> np.ndarray:
    """Return (2, N) grey levels a pixel along x and y, at some pixels by their neighbours."""
    height, width = grey.shape
    right = grey[v, np.minimum(u + 1, width - 1)]
    left = grey[v, np.maximum(u - 1, 0)]
    below = grey[np.minimum(v + 1, height - 1), u]
    above = grey[np.maximum(v - 1, 0), u]
    return np.stack([right - left, below - above]) / 2
