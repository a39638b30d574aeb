"""A depth map that is measured somewhat before or after its image, brought to the image's time.

A camera takes colour and depth with two sensors. In a turn of 150 degrees a second the depth map
of ten milliseconds later lies 1.5 degrees beside the image.
"""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np

from hybridvo.core.geometry import invert, se3_exp, se3_log
from hybridvo.core.types import Frame
from hybridvo.evidence.calibration import NEGLIGIBLE_SHIFT_PX
from hybridvo.evidence.shutter import smooth_ego_flow


def depth_at_image_time(
    frame: Frame, T_curr_prev: np.ndarray, duration_s: float
) -> Frame:
    """Bring the depth map of a frame to the time of its image.

    Args:
        frame: its camera states ``depth_lag_ms``.
        T_curr_prev: (4, 4) how the camera moves about then: a motion, metres.
        duration_s: how long that motion takes, seconds.

    Returns:
        The frame with the depth map that the image's time would show, and a camera without lag;
        the same frame where the lag is 0 or the duration is unknown.
    """
    lag_s = frame.camera.depth_lag_ms / 1000
    if lag_s == 0 or duration_s <= 0 or frame.depth is None:
        return frame
    camera = replace(frame.camera, depth_lag_ms=0.0)
    in_time = replace(frame, camera=camera)
    T_lag = se3_exp(lag_s / duration_s * se3_log(T_curr_prev))
    flow = smooth_ego_flow(in_time, T_lag, camera)
    if np.max(np.linalg.norm(flow, axis=-1)) < NEGLIGIBLE_SHIFT_PX:
        return in_time
    flow = cv2.resize(
        flow, (camera.width, camera.height), interpolation=cv2.INTER_LINEAR
    )
    rows, columns = np.indices(camera.shape, dtype=np.float32)
    u = columns + flow[..., 0]
    v = rows + flow[..., 1]
    later = cv2.remap(frame.depth, u, v, cv2.INTER_NEAREST)
    # the depth that such a point had at the image's time
    R, t = np.split(invert(T_lag)[2, :], [3])
    x = (u - camera.cx) / camera.fx
    y = (v - camera.cy) / camera.fy
    depth = later * (R[0] * x + R[1] * y + R[2]) + t[0]
    known = (later > 0) & (depth > 0)
    depth = np.where(known, depth, 0).astype(frame.depth.dtype)
    variance = frame.depth_variance
    if variance is not None:
        variance = cv2.remap(variance, u, v, cv2.INTER_NEAREST)
    return replace(in_time, depth=depth, depth_variance=variance)
