"""A rolling shutter: the rows of an image are exposed one after the other.

A camera that moves at a constant rate between two frames makes the same motion in any interval of
that length. So a pixel's flow is right for the motion from frame to frame once it is brought to
the time between the frames: it took that time, and the difference of its two rows' times more.
"""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np

from hybridvo.core.geometry import (
    backproject,
    project,
    transform_points,
    valid_depth,
)
from hybridvo.core.types import Camera, Frame, FramePair
from hybridvo.evidence.calibration import NEGLIGIBLE_SHIFT_PX

# the flow at the place where it ends is found by so many steps
STEPS = 2
# every so many pixels the ego flow is computed
REDUCTION = 8


def at_one_time(pair: FramePair) -> FramePair:
    """Take the time between the rows out of a pair with flow.

    Args:
        pair: with flow. The current camera's ``readout_ms`` and the stamps of both frames give
            the time that the rows took.

    Returns:
        The pair with the flow, and the current image and depth map, that a camera would have
        whose every pixel is exposed one frame's time after its previous one. The same pair where
        the readout or the time between the frames is unknown.
    """
    per_row = readout_per_row(pair)
    if per_row == 0 or pair.flow is None:
        return pair
    # how long a pixel took, as a fraction of the time between the frames
    taken = 1 + per_row * pair.flow[..., 1]
    # all else leads out of the image
    is_possible = (taken > 0) & (taken <= 2)  # noqa: PLR2004
    taken = np.where(is_possible, taken, np.nan)
    flow = (pair.flow / taken[..., None]).astype(np.float32)
    return replace(pair, flow=flow, curr=_moved_back(pair.curr, flow, per_row))


def images_at_one_time(pair: FramePair, T_near: np.ndarray) -> FramePair:
    """Take the time between the rows out of the images of a pair, by about which motion it is.

    Args:
        pair: the previous frame has depth; its flow is not used.
        T_near: (4, 4) T_curr_prev, about.

    Returns:
        The pair with the current image and depth map as :func:`at_one_time` returns them. The
        same pair where the rows' times are unknown or make no difference.
    """
    per_row = readout_per_row(pair)
    if per_row == 0 or pair.prev.depth is None:
        return pair
    flow = smooth_ego_flow(pair.prev, T_near, pair.curr.camera)
    shift_px = np.abs(per_row * flow[..., 1]) * np.linalg.norm(flow, axis=-1)
    if np.max(shift_px) < NEGLIGIBLE_SHIFT_PX:
        return pair
    height, width = pair.curr.camera.shape
    flow = cv2.resize(flow, (width, height), interpolation=cv2.INTER_LINEAR)
    return replace(pair, curr=_moved_back(pair.curr, flow, per_row))


def smooth_ego_flow(
    prev: Frame, T_curr_prev: np.ndarray, curr: Camera
) -> np.ndarray:
    """Return the ego flow of a motion at a fraction of the image's size.

    Args:
        prev: with depth.
        T_curr_prev: (4, 4) the motion.
        curr: the camera after it.

    Returns:
        (h, w, 2) float32, px of the image. Where no depth is known, that of the median depth.
    """
    camera = prev.camera
    first = REDUCTION // 2
    rows, columns = np.mgrid[
        first : camera.height : REDUCTION, first : camera.width : REDUCTION
    ]
    depth = np.asarray(prev.depth)[rows, columns]
    is_valid = valid_depth(depth)
    typical = np.median(depth[is_valid]) if is_valid.any() else 1.0
    z = np.where(is_valid, depth, typical)
    index = np.stack([rows.ravel(), columns.ravel()], axis=1)
    rays = backproject(np.ones(camera.shape), camera, index)
    points = rays * z.reshape(-1, 1)
    ends = project(transform_points(T_curr_prev, points), curr)
    flow = (ends - index[:, ::-1]).reshape(*z.shape, 2)
    longest = max(camera.shape)
    return np.clip(np.nan_to_num(flow), -longest, longest).astype(np.float32)


def readout_per_row(pair: FramePair) -> float:
    """Time from one row to the next, as a fraction of the time between the frames."""
    camera = pair.curr.camera
    between_s = pair.curr.timestamp - pair.prev.timestamp
    if camera.readout_ms <= 0 or between_s <= 0:
        return 0.0
    readout_s = camera.readout_ms / 1000
    return min(readout_s / between_s, 1.0) / camera.height


def _moved_back(curr: Frame, flow: np.ndarray, per_row: float) -> Frame:
    """The current frame, each pixel where it was one frame's time after its previous one."""
    rows, columns = np.indices(curr.camera.shape, dtype=np.float32)
    known = np.nan_to_num(flow)
    # the flow that ends at a pixel: that of where it began
    ending = known
    for _ in range(STEPS):
        ending = cv2.remap(
            known,
            columns - ending[..., 0],
            rows - ending[..., 1],
            cv2.INTER_LINEAR,
            borderMode=cv2.BORDER_REPLICATE,
        )
    # the flow over the longer time that the rows took
    late = per_row * ending[..., 1] / (1 - per_row * ending[..., 1])
    u = columns + late * ending[..., 0]
    v = rows + late * ending[..., 1]
    rgb = curr.rgb
    if rgb is not None:
        rgb = cv2.remap(rgb, u, v, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE)
    depth = curr.depth
    if depth is not None:
        depth = cv2.remap(depth, u, v, cv2.INTER_NEAREST)
    return replace(curr, rgb=rgb, depth=depth, depth_variance=None)
