"""The one place where intrinsics are scaled together with images, depth and flow.

Pixel (0, 0) is a centre, so resizing by s moves a point to u' = s (u + 0.5) - 0.5, the principal
point with it, while focal lengths and flow vectors are multiplied by s. Depth is never averaged:
a mean across an edge is a surface that does not exist.
"""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np

from hybridvo.errors import InputError
from hybridvo.types import Camera, Frame, FramePair

__all__ = ["resize_camera", "resize_flow", "resize_frame", "resize_nearest", "resize_pair"]


def resize_camera(camera: Camera, height: int, width: int) -> Camera:
    """Camera of the same view with another image size in pixels.

    Raises:
        InputError: a size that is not positive.
    """
    _check_size(height, width)
    sx, sy = width / camera.width, height / camera.height
    return Camera(
        camera.fx * sx,
        camera.fy * sy,
        sx * (camera.cx + 0.5) - 0.5,
        sy * (camera.cy + 0.5) - 0.5,
        height,
        width,
    )


def resize_nearest(array: np.ndarray, height: int, width: int) -> np.ndarray:
    """(height, width, ...) values of the source pixels whose centres are nearest; nothing mixed."""
    _check_size(height, width)
    rows = np.floor((np.arange(height) + 0.5) * (array.shape[0] / height)).astype(np.intp)
    columns = np.floor((np.arange(width) + 0.5) * (array.shape[1] / width)).astype(np.intp)
    rows, columns = rows.clip(0, array.shape[0] - 1), columns.clip(0, array.shape[1] - 1)
    return np.ascontiguousarray(array[rows[:, None], columns[None, :]])


def resize_frame(frame: Frame, height: int, width: int) -> Frame:
    """Frame of another size: image by area (or bilinear when it grows), the rest by nearest.

    Raises:
        InputError: a size that is not positive.
    """
    camera = resize_camera(frame.camera, height, width)
    rgb = frame.rgb
    if rgb is not None:
        shrinks = height <= rgb.shape[0] and width <= rgb.shape[1]
        mode = cv2.INTER_AREA if shrinks else cv2.INTER_LINEAR
        rgb = cv2.resize(rgb, (width, height), interpolation=mode)
    return replace(
        frame,
        rgb=rgb,
        depth=_nearest_or_none(frame.depth, height, width),
        camera=camera,
        depth_variance=_nearest_or_none(frame.depth_variance, height, width),
        mask=_nearest_or_none(frame.mask, height, width),
    )


def resize_flow(
    flow: np.ndarray,
    height: int,
    width: int,
    valid: np.ndarray | None = None,
    *,
    average: bool = False,
) -> tuple[np.ndarray, np.ndarray | None]:
    """Flow on another grid, with its vectors scaled.

    Args:
        flow: (H, W, 2) float pixels; NaN is invalid.
        height: rows of the new grid.
        width: columns of the new grid.
        valid: (H, W) bool or None.
        average: mean of the valid vectors under each new pixel instead of the nearest one; smoother
            within a surface, but it mixes motions at edges.

    Returns:
        (height, width, 2) float32 and (height, width) bool (None if ``valid`` is None and nothing
        was averaged). With ``average`` pixels without a valid source are NaN and not valid.

    Raises:
        InputError: shapes that do not fit, or a size that is not positive.
    """
    flow = np.asarray(flow)
    if flow.ndim != 3 or flow.shape[2] != 2 or flow.dtype.kind != "f" or flow.size == 0:
        raise InputError(
            f"resize_flow: expected floating-point flow (H, W, 2), got {flow.dtype} {flow.shape}."
        )
    if valid is not None and (valid.shape != flow.shape[:2] or valid.dtype != np.bool_):
        raise InputError(
            f"resize_flow: expected valid as bool {flow.shape[:2]}, "
            f"got {valid.dtype} {valid.shape}."
        )
    _check_size(height, width)
    scale = np.array([width / flow.shape[1], height / flow.shape[0]], dtype=np.float32)
    if not average:
        resized = resize_nearest(flow, height, width).astype(np.float32) * scale
        return resized, _nearest_or_none(valid, height, width)
    usable = np.isfinite(flow).all(axis=2)
    if valid is not None:
        usable &= valid
    shrinks = height <= flow.shape[0] and width <= flow.shape[1]
    mode = cv2.INTER_AREA if shrinks else cv2.INTER_LINEAR
    filled = np.where(usable[..., None], flow, 0).astype(np.float32)
    total = cv2.resize(filled, (width, height), interpolation=mode)
    weight = cv2.resize(usable.astype(np.float32), (width, height), interpolation=mode)
    enough = weight > 1e-3
    mean = np.full((height, width, 2), np.nan, dtype=np.float32)
    mean[enough] = total[enough] / weight[enough][:, None] * scale
    return mean, enough


def resize_pair(pair: FramePair, height: int, width: int, *, average: bool = False) -> FramePair:
    """Pair of another size: both frames, both cameras, and the flow between them.

    Args:
        pair: two frames and flow.
        height: new number of rows.
        width: new number of columns.
        average: how the flow is resized, see :func:`resize_flow`.

    Returns:
        The pair; flow variance (px^2) is scaled with the area of a pixel.

    Raises:
        InputError: a size that is not positive.
    """
    flow, valid, variance = pair.flow, pair.flow_valid, pair.flow_variance
    area = (height / pair.prev.camera.height) * (width / pair.prev.camera.width)
    if flow is not None:
        flow, valid = resize_flow(flow, height, width, valid, average=average)
    else:
        valid = _nearest_or_none(valid, height, width)
    variance = _nearest_or_none(variance, height, width)
    return replace(
        pair,
        prev=resize_frame(pair.prev, height, width),
        curr=resize_frame(pair.curr, height, width),
        flow=flow,
        flow_valid=valid,
        flow_variance=None if variance is None else variance * np.float32(area),
    )


def _nearest_or_none(array: np.ndarray | None, height: int, width: int) -> np.ndarray | None:
    return None if array is None else resize_nearest(array, height, width)


def _check_size(height: int, width: int) -> None:
    for name, value in (("height", height), ("width", width)):
        if isinstance(value, bool) or int(value) != value or value <= 0:
            raise InputError(f"resize: expected a positive {name} in pixels, got {value!r}.")
