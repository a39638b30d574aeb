"""Resizing of frames, together with the camera that belongs to them."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np

from hybridvo.core.checks import as_number, check_kind
from hybridvo.core.types import Camera, Frame


def resize_camera(camera: Camera, height: int, width: int) -> Camera:
    """Return the camera of the same view with another image size.

    Args:
        camera: The camera of the original image.
        height: Rows of the new image, pixels.
        width: Columns of the new image, pixels.

    Returns:
        The camera of the resized image.

    Raises:
        InputError: The camera is no :class:`Camera`, or the new size is not positive.

    Example:
        >>> camera = resize_camera(Camera(500, 500, 319.5, 239.5, height=480, width=640), 240, 320)
        >>> camera.fx, camera.cx
        (250.0, 159.5)
    """
    check_kind("resize_camera: camera", camera, Camera)
    scale_x = as_number(width) / camera.width
    scale_y = as_number(height) / camera.height
    # Pixel (0, 0) is the centre of the first pixel, which lies half a pixel inside the
    # image: u' = s (u + 0.5) - 0.5. The same holds for the principal point.
    cx = scale_x * (camera.cx + 0.5) - 0.5
    cy = scale_y * (camera.cy + 0.5) - 0.5
    fx = camera.fx * scale_x
    fy = camera.fy * scale_y
    return replace(camera, fx=fx, fy=fy, cx=cx, cy=cy, height=height, width=width)


def resize_frame(frame: Frame, height: int, width: int) -> Frame:
    """Resize the image, the maps and the camera of a frame.

    The image is averaged over areas when it shrinks and interpolated when it grows. Depth,
    its variance and the mask take the value of the nearest pixel, because a mean of two
    depths is the depth of neither surface.

    Args:
        frame: The original frame.
        height: Rows of the new frame, pixels.
        width: Columns of the new frame, pixels.

    Returns:
        The resized frame with its own camera.

    Raises:
        InputError: The frame is no :class:`Frame`, or the new size is not positive.

    Example:
        >>> camera = Camera(500, 500, 319.5, 239.5, height=480, width=640)
        >>> frame = Frame(None, np.ones((480, 640), np.float32), camera)
        >>> half = resize_frame(frame, 240, 320)
        >>> half.depth.shape, half.camera.fx
        ((240, 320), 250.0)
    """
    check_kind("resize_frame: frame", frame, Frame)
    old = frame.camera
    camera = resize_camera(old, height, width)
    shrinks = camera.height <= old.height and camera.width <= old.width
    image_mode = cv2.INTER_AREA if shrinks else cv2.INTER_LINEAR
    map_mode = cv2.INTER_NEAREST_EXACT
    return replace(
        frame,
        rgb=_resized(frame.rgb, camera, image_mode),
        depth=_resized(frame.depth, camera, map_mode),
        camera=camera,
        depth_variance=_resized(frame.depth_variance, camera, map_mode),
        mask=_resized(frame.mask, camera, map_mode),
    )


def _resized(
    image: np.ndarray | None, camera: Camera, interpolation: int
) -> np.ndarray | None:
    """Resize an image or a map to the size of a camera; None stays None."""
    if image is None:
        return None
    # OpenCV has no boolean images.
    plain = image.view(np.uint8) if image.dtype == bool else image
    size = (camera.width, camera.height)
    resized = cv2.resize(plain, size, interpolation=interpolation)
    return resized.astype(image.dtype)
