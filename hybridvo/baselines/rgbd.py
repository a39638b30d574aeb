"""RGB-D odometry of OpenCV and Open3D: what an RGB-D user would pick today.

The flow of the pair serves only to check the motion and to give it a covariance.
"""

from __future__ import annotations

import contextlib
from collections.abc import Callable
from typing import Any

import cv2
import numpy as np

from hybridvo.baselines import pnp
from hybridvo.geometry import pose_matrix, project
from hybridvo.results import Reason, RelativePose
from hybridvo.types import Camera, FramePair

Aligner = Callable[[list[np.ndarray], list[np.ndarray], Camera, float], np.ndarray | None]
"""(two images, depths or NaN, camera, metres beyond every depth) -> (4, 4) T_curr_prev, or None."""


def align_opencv(
    rgb: list[np.ndarray], depth: list[np.ndarray], camera: Camera, deepest: float
) -> np.ndarray | None:
    """OpenCV 5's ``cv2.Odometry`` with image and depth."""
    settings = cv2.OdometrySettings()
    settings.setCameraMatrix(camera.K.astype(np.float32))
    settings.setMinDepth(1e-3)
    settings.setMaxDepth(deepest)
    odometry = cv2.Odometry(cv2.ODOMETRY_TYPE_RGB_DEPTH, settings, cv2.ODOMETRY_ALGO_TYPE_COMMON)
    found, T = odometry.compute(depth[0], rgb[0], depth[1], rgb[1])
    return np.asarray(T, dtype=np.float64) if found else None


def align_open3d(
    rgb: list[np.ndarray], depth: list[np.ndarray], camera: Camera, deepest: float
) -> np.ndarray | None:
    """Open3D's ``compute_rgbd_odometry`` with the hybrid term."""
    import open3d

    odometry = open3d.pipelines.odometry
    images = [
        open3d.geometry.RGBDImage.create_from_color_and_depth(
            open3d.geometry.Image(np.ascontiguousarray(image)),
            open3d.geometry.Image(np.nan_to_num(z)),  # 0 is unknown to Open3D
            depth_scale=1.0,
            depth_trunc=deepest,
        )
        for image, z in zip(rgb, depth, strict=True)
    ]
    fx, fy, cx, cy, height, width = vars(camera).values()
    pinhole = open3d.camera.PinholeCameraIntrinsic(width, height, fx, fy, cx, cy)
    option, term = odometry.OdometryOption(), odometry.RGBDOdometryJacobianFromHybridTerm()
    option.depth_max = deepest
    found, T, _ = odometry.compute_rgbd_odometry(*images, pinhole, np.eye(4), term, option)
    return np.asarray(T, dtype=np.float64) if found else None


ALIGNERS: dict[str, Aligner] = {"opencv-rgbd": align_opencv, "open3d-rgbd": align_open3d}


def estimate_by_images(method: str, pair: FramePair, seed: int = 0) -> RelativePose:
    """Motion of a pair by one of :data:`ALIGNERS`; its status is failed without images."""
    images, T = _prepared(pair), None
    if isinstance(images, RelativePose):
        return images
    rgb, depth = images
    with contextlib.suppress(*pnp.FOUND_NOTHING):
        T = ALIGNERS[method](rgb, depth, pair.prev.camera, float(np.nanmax(depth[0])) + 1.0)
    # both libraries chain small updates into not quite a rotation
    T = pose_matrix(T[:3]) if T is not None and np.isfinite(T).all() else None
    camera, sigma_px = pair.curr.camera, None
    data = pnp.sample(pair, seed)
    if isinstance(data, RelativePose):
        still = FramePair(pair.prev, pair.curr, np.zeros((*camera.shape, 2), np.float32))
        data, sigma_px = pnp.sample(still, seed), 1.0
        if isinstance(data, RelativePose):
            return data
        if T is not None:
            uv = project(data.xyz @ T[:3, :3].T + T[:3, 3], camera)
            data = pnp.Correspondences(data.xyz, uv)
    # wide, for these methods never saw the flow
    return pnp.check(T, data, camera, pnp.DEFAULT_PX, sigma_px)


def _prepared(pair: FramePair) -> tuple[list[np.ndarray], list[np.ndarray]] | RelativePose:
    """Both images and their depths, the current ones resampled to the previous K."""
    camera, images, depths = pair.prev.camera, list[np.ndarray](), list[np.ndarray]()
    for name, frame in (("previous", pair.prev), ("current", pair.curr)):
        rgb, depth = frame.rgb, frame.depth
        if rgb is None:
            what = "this method aligns images: none is there"
            return RelativePose.failed(Reason.MISSING_FRAME, what)
        if depth is None or not pnp.depth_valid(depth).any():
            what = f"the {name} frame has no valid depth"
            return RelativePose.failed(Reason.NO_VALID_DEPTH, what)
        keep = pnp.depth_valid(depth) & (True if frame.mask is None else frame.mask)
        depth = np.where(keep, depth, np.nan).astype(np.float32)
        if not np.allclose(camera.K, frame.camera.K):
            A, size = (camera.K @ np.linalg.inv(frame.camera.K))[:2], camera.shape[::-1]
            nearest: Any = {"flags": cv2.INTER_NEAREST, "borderValue": np.nan}
            rgb, depth = cv2.warpAffine(rgb, A, size), cv2.warpAffine(depth, A, size, **nearest)
        images.append(rgb)
        depths.append(depth)
    return images, depths
