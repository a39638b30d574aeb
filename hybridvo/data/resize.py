"""Resizes images, depth, flow and intrinsics together.

Pixel (0, 0) is a centre, so resizing by s moves a point to u' = s (u + 0.5) - 0.5, the principal
point with it, while focal lengths and flow vectors are multiplied by s. Depth and flow take the
nearest value: a mean across an edge is a surface, or a motion, that does not exist.
"""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np

from hybridvo.types import Camera, Frame, FramePair


def resize_camera(camera: Camera, height: int, width: int) -> Camera:
    """Camera of the same view with another image size in pixels."""
    sx, sy = width / camera.width, height / camera.height
    cx, cy = sx * (camera.cx + 0.5) - 0.5, sy * (camera.cy + 0.5) - 0.5
    return Camera(camera.fx * sx, camera.fy * sy, cx, cy, height, width)


def resize_frame(frame: Frame, height: int, width: int) -> Frame:
    """Frame of another size: image by area (or bilinear when it grows), the rest by nearest."""
    camera = resize_camera(frame.camera, height, width)
    rgb = frame.rgb
    if rgb is not None:
        shrinks = height <= rgb.shape[0] and width <= rgb.shape[1]
        mode = cv2.INTER_AREA if shrinks else cv2.INTER_LINEAR
        rgb = cv2.resize(rgb, (width, height), interpolation=mode)
    return replace(
        frame,
        rgb=rgb,
        depth=_nearest(frame.depth, camera),
        camera=camera,
        depth_variance=_nearest(frame.depth_variance, camera),
        mask=_nearest(frame.mask, camera),
    )


def resize_pair(pair: FramePair, height: int, width: int) -> FramePair:
    """Pair of another size: both frames, both cameras, and the flow with its vectors (px) scaled.

    Flow variance (px^2) is scaled with the area of a pixel.
    """
    prev, curr = (resize_frame(frame, height, width) for frame in (pair.prev, pair.curr))
    scale = np.array([width, height]) / (pair.prev.camera.width, pair.prev.camera.height)
    flow = _nearest(pair.flow, prev.camera)
    variance = _nearest(pair.flow_variance, prev.camera)
    return replace(
        pair,
        prev=prev,
        curr=curr,
        flow=None if flow is None else flow * scale.astype(np.float32),
        flow_valid=_nearest(pair.flow_valid, prev.camera),
        flow_variance=None if variance is None else variance * np.float32(scale.prod()),
    )


def _nearest(array: np.ndarray | None, camera: Camera) -> np.ndarray | None:
    """(height, width, ...) values of the source pixels whose centres are nearest to the camera's.

    cv2's INTER_NEAREST takes corners, not centres, and no bool.
    """
    if array is None:
        return None
    rows, columns = (
        ((np.arange(size) + 0.5) * (old / size)).astype(np.intp).clip(0, old - 1)
        for size, old in zip(camera.shape, array.shape, strict=False)
    )
    return np.ascontiguousarray(array[rows[:, None], columns[None, :]])
