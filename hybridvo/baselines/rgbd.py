"""RGB-D odometry of OpenCV and Open3D: what an RGB-D user would pick today.

The flow of the pair serves only to check the motion and to give it a covariance.
"""

from __future__ import annotations

import contextlib
from collections.abc import Callable
from typing import NamedTuple

import cv2
import numpy as np

from hybridvo.baselines.pnp import (
    DEFAULT_PX,
    FOUND_NOTHING,
    Correspondences,
    check,
    depth_valid,
    sample,
)
from hybridvo.geometry import pose_matrix, project
from hybridvo.results import Reason, RelativePose, Status
from hybridvo.types import Camera, FramePair


class Rgbd(NamedTuple):
    """An image and its depth, NaN where that is invalid."""

    rgb: np.ndarray
    depth: np.ndarray
    camera: Camera


def align_opencv(prev: Rgbd, curr: Rgbd) -> np.ndarray | None:
    """OpenCV 5's ``cv2.Odometry`` with image and depth."""
    settings = cv2.OdometrySettings()
    settings.setCameraMatrix(prev.camera.K.astype(np.float32))
    settings.setMinDepth(1e-3)
    settings.setMaxDepth(_deepest(prev))
    odometry = cv2.Odometry(cv2.ODOMETRY_TYPE_RGB_DEPTH, settings, cv2.ODOMETRY_ALGO_TYPE_COMMON)
    found, T = odometry.compute(prev.depth, prev.rgb, curr.depth, curr.rgb)
    return np.asarray(T, dtype=np.float64) if found else None


def align_open3d(prev: Rgbd, curr: Rgbd) -> np.ndarray | None:
    """Open3D's ``compute_rgbd_odometry`` with the hybrid term."""
    import open3d

    deepest, c, odometry = _deepest(prev), prev.camera, open3d.pipelines.odometry
    images = [
        open3d.geometry.RGBDImage.create_from_color_and_depth(
            open3d.geometry.Image(np.ascontiguousarray(frame.rgb)),
            open3d.geometry.Image(np.nan_to_num(frame.depth)),  # 0 is unknown to Open3D
            depth_scale=1.0,
            depth_trunc=deepest,
        )
        for frame in (prev, curr)
    ]
    pinhole = open3d.camera.PinholeCameraIntrinsic(c.width, c.height, c.fx, c.fy, c.cx, c.cy)
    option, term = odometry.OdometryOption(), odometry.RGBDOdometryJacobianFromHybridTerm()
    option.depth_max = deepest
    found, T, _ = odometry.compute_rgbd_odometry(*images, pinhole, np.eye(4), term, option)
    return np.asarray(T, dtype=np.float64) if found else None


def _deepest(frame: Rgbd) -> float:
    """Metres beyond every depth: the default limits of both libraries are opened to it."""
    return float(np.nanmax(frame.depth)) + 1.0


ALIGNERS: dict[str, Callable[[Rgbd, Rgbd], np.ndarray | None]] = {
    "opencv-rgbd": align_opencv,
    "open3d-rgbd": align_open3d,
}
"""(4, 4) T_curr_prev of two RGB-D images under one camera, or None."""


def estimate_by_images(method: str, pair: FramePair, seed: int = 0) -> RelativePose:
    """Motion of a pair by one of :data:`ALIGNERS`; its status is failed without images."""
    frames, T = _prepared(pair), None
    if isinstance(frames, Status):
        return RelativePose.failed(frames.reason, frames.message, method)
    with contextlib.suppress(*FOUND_NOTHING):
        T = ALIGNERS[method](*frames)
    # both libraries chain small updates into not quite a rotation
    T = pose_matrix(T[:3]) if T is not None and np.isfinite(T).all() else None
    camera, sigma_px = pair.curr.camera, None
    data = sample(pair, seed)
    if isinstance(data, Status):
        still = FramePair(pair.prev, pair.curr, np.zeros((*camera.shape, 2), np.float32))
        data, sigma_px = sample(still, seed), 1.0
        if T is not None and not isinstance(data, Status):
            uv = project(data.xyz @ T[:3, :3].T + T[:3, 3], camera)
            data = Correspondences(data.xyz, uv)
    # wide, for these methods never saw the flow
    return check(method, T, data, camera, DEFAULT_PX, sigma_px)


def _prepared(pair: FramePair) -> tuple[Rgbd, Rgbd] | Status:
    """Both frames as OpenCV and Open3D take them, the current one resampled to the previous K."""
    camera = pair.prev.camera
    frames = []
    for name, frame in (("previous", pair.prev), ("current", pair.curr)):
        rgb, depth = frame.rgb, frame.depth
        if rgb is None:
            return Status.failed(Reason.MISSING_FRAME, "this method aligns images: none is there")
        if depth is None or not depth_valid(depth).any():
            return Status.failed(Reason.NO_VALID_DEPTH, f"the {name} frame has no valid depth")
        keep = depth_valid(depth) & (True if frame.mask is None else frame.mask)
        depth = np.where(keep, depth, np.nan).astype(np.float32)
        if not np.allclose(camera.K, frame.camera.K):
            A, size = (camera.K @ np.linalg.inv(frame.camera.K))[:2], camera.shape[::-1]
            rgb = np.asarray(cv2.warpAffine(rgb, A, size))
            nearest, nan = cv2.INTER_NEAREST, float("nan")
            depth = np.asarray(cv2.warpAffine(depth, A, size, flags=nearest, borderValue=nan))
        frames.append(Rgbd(rgb, depth, camera))
    return frames[0], frames[1]
