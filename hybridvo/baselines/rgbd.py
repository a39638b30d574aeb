"""RGB-D odometry of OpenCV and Open3D: dense alignment of two images with their depth.

What an RGB-D user would pick today. The flow of the pair serves only to check the motion and to
give it a covariance; without flow that of one pixel of noise at every sampled pixel is given.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import cv2
import numpy as np

from hybridvo.baselines.pnp import (
    DEFAULT_PX,
    FOUND_NOTHING,
    Correspondences,
    check,
    depth_valid,
    is_rigid,
    sample,
)
from hybridvo.geometry import pose_matrix, project
from hybridvo.results import Reason, RelativePose, Status
from hybridvo.types import Camera, FramePair


@dataclass(frozen=True, eq=False)
class RgbdFrames:
    """Both RGB-D frames under one camera; invalid depth is NaN."""

    rgb_prev: np.ndarray
    depth_prev: np.ndarray
    rgb_curr: np.ndarray
    depth_curr: np.ndarray
    camera: Camera

    @property
    def deepest(self) -> float:
        """Metres beyond every depth: the default limits of both libraries are opened to it."""
        return float(np.nanmax(self.depth_prev)) + 1.0


def align_opencv(frames: RgbdFrames) -> np.ndarray | None:
    """OpenCV 5's ``cv2.Odometry`` with image and depth."""
    settings = cv2.OdometrySettings()
    settings.setCameraMatrix(frames.camera.K.astype(np.float32))
    settings.setMinDepth(1e-3)
    settings.setMaxDepth(frames.deepest)
    odometry = cv2.Odometry(cv2.ODOMETRY_TYPE_RGB_DEPTH, settings, cv2.ODOMETRY_ALGO_TYPE_COMMON)
    found, T = odometry.compute(
        frames.depth_prev, frames.rgb_prev, frames.depth_curr, frames.rgb_curr
    )
    return np.asarray(T, dtype=np.float64) if found else None


def align_open3d(frames: RgbdFrames) -> np.ndarray | None:
    """Open3D's ``compute_rgbd_odometry`` with the hybrid term."""
    import open3d

    camera = frames.camera

    def image(rgb: np.ndarray, depth: np.ndarray) -> object:
        return open3d.geometry.RGBDImage.create_from_color_and_depth(
            open3d.geometry.Image(np.ascontiguousarray(rgb)),
            open3d.geometry.Image(np.nan_to_num(depth, nan=0.0)),
            depth_scale=1.0,
            depth_trunc=frames.deepest,
        )

    option = open3d.pipelines.odometry.OdometryOption()
    option.depth_max = frames.deepest
    found, T, _ = open3d.pipelines.odometry.compute_rgbd_odometry(
        image(frames.rgb_prev, frames.depth_prev),
        image(frames.rgb_curr, frames.depth_curr),
        open3d.camera.PinholeCameraIntrinsic(
            camera.width, camera.height, camera.fx, camera.fy, camera.cx, camera.cy
        ),
        np.eye(4),
        open3d.pipelines.odometry.RGBDOdometryJacobianFromHybridTerm(),
        option,
    )
    return np.asarray(T, dtype=np.float64) if found else None


ALIGNERS: dict[str, Callable[[RgbdFrames], np.ndarray | None]] = {
    "opencv-rgbd": align_opencv,
    "open3d-rgbd": align_open3d,
}
"""(4, 4) T_curr_prev of two RGB-D frames, or None, by method."""


def estimate_by_images(method: str, pair: FramePair, seed: int = 0) -> RelativePose:
    """Motion of a pair by one of :data:`ALIGNERS`; its status is failed without images."""
    frames = rgbd_frames(pair)
    if isinstance(frames, Status):
        return RelativePose.failed(frames.reason, frames.message, method)
    try:
        T = ALIGNERS[method](frames)
    except FOUND_NOTHING:
        T = None
    if T is not None and np.isfinite(T).all():
        # both libraries chain small updates into not quite a rotation
        T = pose_matrix(T[:3])
    camera, sigma_px = pair.curr.camera, None
    data = sample(pair, seed)
    if isinstance(data, Status):
        still = FramePair(pair.prev, pair.curr, np.zeros((*camera.shape, 2), np.float32))
        data, sigma_px = sample(still, seed), 1.0
        if isinstance(data, Status):
            return RelativePose.failed(data.reason, data.message, method)
        if T is not None and is_rigid(T):
            uv = project(data.xyz @ T[:3, :3].T + T[:3, 3], camera)
            data = Correspondences(data.xyz, uv)
    # wide, for these methods never saw the flow
    return check(method, T, data, camera, DEFAULT_PX, sigma_px)


def rgbd_frames(pair: FramePair) -> RgbdFrames | Status:
    """Both frames as OpenCV and Open3D take them, the current one resampled to the previous K."""
    if pair.prev.rgb is None or pair.curr.rgb is None:
        return Status.failed(Reason.MISSING_FRAME, "this method aligns images; the pair has none")
    depths: list[np.ndarray] = []
    for name, frame in (("previous", pair.prev), ("current", pair.curr)):
        if frame.depth is None or not depth_valid(frame.depth).any():
            return Status.failed(Reason.NO_VALID_DEPTH, f"the {name} frame has no valid depth")
        keep = depth_valid(frame.depth)
        if frame.mask is not None:
            keep &= frame.mask
        depths.append(np.where(keep, frame.depth, np.nan).astype(np.float32))
    camera, rgb_curr = pair.prev.camera, pair.curr.rgb
    if not np.allclose(camera.K, pair.curr.camera.K):
        A = (camera.K @ np.linalg.inv(pair.curr.camera.K))[:2]
        size = (camera.width, camera.height)
        rgb_curr = np.asarray(cv2.warpAffine(rgb_curr, A, size, flags=cv2.INTER_LINEAR))
        depths[1] = cv2.warpAffine(
            depths[1], A, size, flags=cv2.INTER_NEAREST, borderValue=float("nan")
        )
    return RgbdFrames(pair.prev.rgb, depths[0], rgb_curr, depths[1], camera)
