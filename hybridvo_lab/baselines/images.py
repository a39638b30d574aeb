"""RGB-D odometry of OpenCV and Open3D: images and depth maps, without flow.

Each takes the images, the previous camera and the largest depth, m, and returns
T_curr_prev (4, 4), or None where it finds none.
"""

from __future__ import annotations

import contextlib
from collections.abc import Callable
from typing import Any, NamedTuple

import cv2
import numpy as np

from hybridvo.core.geometry import pose_matrix
from hybridvo.core.results import Reason, RelativePose, StageFailed
from hybridvo.core.types import Camera, Frame, FramePair
from hybridvo_lab.baselines.correspondences import (
    OPENCV_INLIER_PX,
    SELF_FLOW_STD_PX,
    depth_in_range,
    sample,
    self_consistent,
    with_covariance,
)
from hybridvo_lab.baselines.solvers import SOLVER_ERRORS


class PairImages(NamedTuple):
    """Both images and depth maps of a pair, with the previous intrinsics."""

    rgb: list[np.ndarray]  # (H, W, 3) uint8, previous and current
    depth: list[np.ndarray]  # (H, W) float32 metres, NaN where invalid


def align_opencv(
    images: PairImages, camera: Camera, max_depth: float
) -> np.ndarray | None:
    """Call OpenCV 5's ``cv2.Odometry`` with image and depth."""
    settings = cv2.OdometrySettings()
    settings.setCameraMatrix(camera.K.astype(np.float32))
    settings.setMinDepth(1e-3)
    settings.setMaxDepth(max_depth)
    odometry = cv2.Odometry(
        cv2.ODOMETRY_TYPE_RGB_DEPTH, settings, cv2.ODOMETRY_ALGO_TYPE_COMMON
    )
    found, T = odometry.compute(
        images.depth[0], images.rgb[0], images.depth[1], images.rgb[1]
    )
    return np.asarray(T, dtype=np.float64) if found else None


def align_open3d(
    images: PairImages, camera: Camera, max_depth: float
) -> np.ndarray | None:
    """Call Open3D's ``compute_rgbd_odometry`` with the hybrid term."""
    import open3d

    odometry = open3d.pipelines.odometry
    make_image: Any = open3d.geometry.Image
    rgbd = [
        open3d.geometry.RGBDImage.create_from_color_and_depth(
            make_image(np.ascontiguousarray(rgb)),
            make_image(np.nan_to_num(depth)),  # 0 is unknown to Open3D
            depth_scale=1.0,
            depth_trunc=max_depth,
        )
        for rgb, depth in zip(images.rgb, images.depth, strict=True)
    ]
    pinhole = open3d.camera.PinholeCameraIntrinsic(
        camera.width, camera.height, camera.fx, camera.fy, camera.cx, camera.cy
    )
    term = odometry.RGBDOdometryJacobianFromHybridTerm()
    option = odometry.OdometryOption()
    option.depth_max = max_depth
    found, T, _ = odometry.compute_rgbd_odometry(
        *rgbd, pinhole, np.eye(4), term, option
    )
    return np.asarray(T, dtype=np.float64) if found else None


Aligner = Callable[[PairImages, Camera, float], np.ndarray | None]
ALIGNERS: dict[str, Aligner] = {
    "opencv-rgbd": align_opencv,
    "open3d-rgbd": align_open3d,
}


def estimate_by_images(method: str, pair: FramePair, seed: int) -> RelativePose:
    """Align images and depth maps; flow serves for the check and the covariance."""
    images = _images(pair)
    max_depth = float(np.nanmax(images.depth[0])) + 1.0
    T = None
    with contextlib.suppress(*SOLVER_ERRORS):
        T = ALIGNERS[method](images, pair.prev.camera, max_depth)
    if T is not None:
        # both libraries chain small updates into not quite a rotation
        T = pose_matrix(T[:3]) if np.isfinite(T).all() else None
    camera = pair.curr.camera
    sigma_px = None
    try:
        data = sample(pair, seed)
    except StageFailed:
        data = self_consistent(pair, T, seed)
        sigma_px = SELF_FLOW_STD_PX
    # the limit is wide, for these methods never saw the flow
    return with_covariance(T, data, camera, OPENCV_INLIER_PX, sigma_px)


def _images(pair: FramePair) -> PairImages:
    """Both images and depth maps, the current ones resampled to the previous K.

    Raises:
        StageFailed: where an image is missing, or has no valid depth.
    """
    camera = pair.prev.camera
    images = PairImages([], [])
    for name, frame in (("previous", pair.prev), ("current", pair.curr)):
        if frame.rgb is None:
            raise StageFailed(
                Reason.MISSING_FRAME, "this method aligns images: none is there"
            )
        if frame.depth is None or not depth_in_range(frame.depth).any():
            raise StageFailed(
                Reason.NO_VALID_DEPTH, f"the {name} frame has no valid depth"
            )
        rgb, depth = _resampled(frame.rgb, frame.depth, frame, camera)
        images.rgb.append(rgb)
        images.depth.append(depth)
    return images


def _resampled(
    rgb: np.ndarray, depth: np.ndarray, frame: Frame, camera: Camera
) -> tuple[np.ndarray, np.ndarray]:
    """Image and valid depth of a frame as a camera with other intrinsics sees them."""
    depth = np.where(depth_in_range(depth), depth, np.nan).astype(np.float32)
    if np.allclose(camera.K, frame.camera.K):
        return rgb, depth
    A = (camera.K @ np.linalg.inv(frame.camera.K))[:2]
    height, width = camera.shape
    nearest: Any = {"flags": cv2.INTER_NEAREST, "borderValue": np.nan}
    rgb = cv2.warpAffine(rgb, A, (width, height))
    depth = cv2.warpAffine(depth, A, (width, height), **nearest)
    return rgb, depth
