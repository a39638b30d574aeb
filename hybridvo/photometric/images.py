"""Grey images for the photometric refinement: blurred, reduced, sampled."""

from __future__ import annotations

from weakref import WeakKeyDictionary

import cv2
import numpy as np

from hybridvo.calibration import (
    IMAGE_BLUR_PX,
    MIN_STATIC_WEIGHT,
)
from hybridvo.numba_tools import as_contiguous
from hybridvo.photometric.image_kernels import select_pixels
from hybridvo.types import Camera, Frame

# luma weights of red, green and blue, and mid grey, which makes gain and offset
# independent
RGB_TO_GREY = np.array([[0.299, 0.587, 0.114, -128.0]])

_GREY: WeakKeyDictionary[Frame, np.ndarray] = WeakKeyDictionary()
"""Grey images, as long as the frame is kept."""
_BLURRED: WeakKeyDictionary[Frame, np.ndarray] = WeakKeyDictionary()
"""Blurred images, as long as the frame is kept."""
_REDUCED: WeakKeyDictionary[Frame, dict[int, Frame]] = WeakKeyDictionary()
"""Reduced frames by reduction, as long as the frame is kept."""


def grey(frame: Frame) -> np.ndarray:
    """Return the grey image of a frame, (H, W) float32, less mid grey.

    It is not rounded: 8 bits of grey would add as much noise as the camera's own
    rounding.
    """
    if frame not in _GREY:
        rgb = np.ascontiguousarray(frame.rgb).astype(np.float32)
        _GREY[frame] = cv2.transform(rgb, RGB_TO_GREY)
    return _GREY[frame]


def blurred(frame: Frame) -> np.ndarray:
    """Return the blurred grey image of a frame, (H, W) float32, less mid grey."""
    if frame not in _BLURRED:
        _BLURRED[frame] = cv2.GaussianBlur(grey(frame), (0, 0), IMAGE_BLUR_PX)
    return _BLURRED[frame]


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
    sizes = _REDUCED.setdefault(frame, {})
    if factor not in sizes:
        sizes[factor] = _reduce(frame, factor)
    return sizes[factor]


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
    camera = Camera(
        fx=K.fx / factor,
        fy=K.fy / factor,
        cx=(K.cx - first) / factor,
        cy=(K.cy - first) / factor,
        height=height,
        width=width,
    )
    small = Frame(None, depth, camera)
    larger = grey(reduced(frame, factor // 2))
    _GREY[small] = cv2.resize(
        larger[: 2 * height, : 2 * width],
        (width, height),
        interpolation=cv2.INTER_AREA,
    )
    return small


def choose_pixels(
    grey: np.ndarray, depth: np.ndarray, weights: np.ndarray, count: int
) -> np.ndarray:
    """Return static pixels with strong gradients, evenly distributed over the image.

    Args:
        grey: (H, W) float32 grey values.
        depth: (H, W) metres.
        weights: (H, W) static weights, from 0 to 1.
        count: number of cells, of which each gives one pixel or none.

    Returns:
        (N, 2) int32 rows and columns.
    """
    cell = np.sqrt(grey.size / count)
    return select_pixels(
        grey,
        as_contiguous(depth),
        as_contiguous(weights, np.float32),
        np.float32(MIN_STATIC_WEIGHT),
        cell,
    )
