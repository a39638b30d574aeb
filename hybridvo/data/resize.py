"""Resizes images, depth and intrinsics together.

Pixel (0, 0) is a centre, so resizing by s moves a point to u' = s (u + 0.5) - 0.5, the principal
point with it, while focal lengths are multiplied by s.
"""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np

from hybridvo.types import Camera, Frame


def resize_camera(camera: Camera, height: int, width: int) -> Camera:
    """Camera of the same view with another image size in pixels."""
    sx, sy = width / camera.width, height / camera.height
    cx, cy = sx * (camera.cx + 0.5) - 0.5, sy * (camera.cy + 0.5) - 0.5
    return Camera(camera.fx * sx, camera.fy * sy, cx, cy, height, width)


def resize_frame(frame: Frame, height: int, width: int) -> Frame:
    """Frame of another size: image by area (or bilinear when it grows), the rest by nearest.

    A mean of depths across an edge would be a surface that does not exist.
    """
    # source pixels whose centres are nearest (cv2's INTER_NEAREST takes corners, and no bool)
    rows, columns = (
        ((np.arange(size) + 0.5) * (old / size)).astype(np.intp).clip(0, old - 1)
        for size, old in zip((height, width), frame.camera.shape, strict=True)
    )

    def nearest(array: np.ndarray | None) -> np.ndarray | None:
        return None if array is None else array[np.ix_(rows, columns)]

    rgb = frame.rgb
    if rgb is not None:
        shrinks = height <= rgb.shape[0] and width <= rgb.shape[1]
        mode = cv2.INTER_AREA if shrinks else cv2.INTER_LINEAR
        rgb = cv2.resize(rgb, (width, height), interpolation=mode)
    return replace(
        frame,
        rgb=rgb,
        depth=nearest(frame.depth),
        camera=resize_camera(frame.camera, height, width),
        depth_variance=nearest(frame.depth_variance),
        mask=nearest(frame.mask),
    )
