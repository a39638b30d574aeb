"""RGB-D odometry of OpenCV and Open3D: dense alignment of two images with their depth.

What an RGB-D user would pick today, as a baseline. These methods read the images and both depth
maps; the flow of the pair serves only to check the answer and to give it a covariance.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass

import cv2
import numpy as np

from hybridvo.baselines.correspondences import (
    DEPTH_RANGE_M,
    POINTS,
    Correspondences,
    check_arguments,
    check_pose,
    depth_valid,
    is_rigid,
    sample_correspondences,
)
from hybridvo.errors import InputError
from hybridvo.geometry import make_transform
from hybridvo.results import Reason, RelativePose, Status
from hybridvo.types import Camera, FramePair

__all__ = ["open3d_rgbd", "opencv_rgbd"]

REMEDIES = {
    "opencv-rgbd": (
        "this OpenCV has no cv2.Odometry (it came with 5.0); "
        "pip install 'opencv-python-headless>=5'"
    ),
    "open3d-rgbd": "Open3D is not installed; pip install open3d",
}
"""What is missing and how to get it, by method."""

INLIER_THRESHOLD_PX = 8.0
"""Flow within this of the motion supports it; wide, for these methods never saw the flow."""

_FOUND_NOTHING = (cv2.error, ValueError, RuntimeError, ArithmeticError)


def opencv_rgbd(pair: FramePair, *, seed: int = 0) -> RelativePose:
    """OpenCV 5's dense RGB-D odometry (``cv2.Odometry``, ``RGB_DEPTH``); reads both RGB-D frames.

    OpenCV takes one K, so the current frame is resampled to ``K_prev`` where the two differ. Depth
    limits are opened to those of the frames (its default is 4 m). Covariance: see
    :func:`open3d_rgbd`.

    Args:
        pair: both frames with images and depth; without images the status is failed.
        seed: of the pixels on which the answer is checked.

    Returns:
        ``T_curr_prev`` with covariance and status.

    Raises:
        InputError: this OpenCV has no ``cv2.Odometry``, or ``pair`` is no FramePair.
    """
    if not hasattr(cv2, "Odometry"):
        raise InputError(f"opencv-rgbd: {REMEDIES['opencv-rgbd']}.")

    def solve(frames: _RgbdFrames) -> np.ndarray | None:
        settings = cv2.OdometrySettings()
        settings.setCameraMatrix(frames.camera.K.astype(np.float32))
        settings.setMinDepth(1e-3)
        settings.setMaxDepth(float(np.nanmax(frames.depth_prev)) + 1.0)
        odometry = cv2.Odometry(
            cv2.ODOMETRY_TYPE_RGB_DEPTH, settings, cv2.ODOMETRY_ALGO_TYPE_COMMON
        )
        found, T = odometry.compute(
            frames.depth_prev, frames.rgb_prev, frames.depth_curr, frames.rgb_curr
        )
        return np.asarray(T, dtype=np.float64) if found else None

    return _dense("opencv-rgbd", solve, pair, seed)


def open3d_rgbd(pair: FramePair, *, seed: int = 0) -> RelativePose:
    """Open3D's ``compute_rgbd_odometry`` with the hybrid term; reads both RGB-D frames.

    The pose does not depend on the flow. The covariance is that of the flow's inliers, as for the
    other methods, where the pair has flow; else that of one pixel of noise at every sampled pixel.

    Args and returns as :func:`opencv_rgbd`.

    Raises:
        InputError: Open3D is not installed, or ``pair`` is no FramePair.
    """
    try:
        import open3d
    except ImportError:
        raise InputError(f"open3d-rgbd: {REMEDIES['open3d-rgbd']}.") from None

    def solve(frames: _RgbdFrames) -> np.ndarray | None:
        camera = frames.camera
        intrinsic = open3d.camera.PinholeCameraIntrinsic(
            camera.width, camera.height, camera.fx, camera.fy, camera.cx, camera.cy
        )
        deepest = float(np.nanmax(frames.depth_prev)) + 1.0

        def image(rgb: np.ndarray, depth: np.ndarray) -> object:
            return open3d.geometry.RGBDImage.create_from_color_and_depth(
                open3d.geometry.Image(np.ascontiguousarray(rgb)),
                open3d.geometry.Image(np.nan_to_num(depth, nan=0.0)),
                depth_scale=1.0,
                depth_trunc=deepest,
            )

        option = open3d.pipelines.odometry.OdometryOption()
        option.depth_max = deepest
        found, T, _ = open3d.pipelines.odometry.compute_rgbd_odometry(
            image(frames.rgb_prev, frames.depth_prev),
            image(frames.rgb_curr, frames.depth_curr),
            intrinsic,
            np.eye(4),
            open3d.pipelines.odometry.RGBDOdometryJacobianFromHybridTerm(),
            option,
        )
        return np.asarray(T, dtype=np.float64) if found else None

    return _dense("open3d-rgbd", solve, pair, seed)


@dataclass(frozen=True, eq=False)
class _RgbdFrames:
    """Both RGB-D frames under one camera; invalid depth is NaN."""

    rgb_prev: np.ndarray
    depth_prev: np.ndarray
    rgb_curr: np.ndarray
    depth_curr: np.ndarray
    camera: Camera


def _dense(
    method: str,
    solve: Callable[[_RgbdFrames], np.ndarray | None],
    pair: FramePair,
    seed: int,
) -> RelativePose:
    """Prepare both RGB-D frames, solve, check: what the image aligners share."""
    start = time.perf_counter()
    check_arguments(method, pair, seed)
    frames = _rgbd_frames(pair)
    if isinstance(frames, Status):
        result = RelativePose.failed(frames.reason, frames.message, method)
    else:
        try:
            T = solve(frames)
        except _FOUND_NOTHING:
            T = None
        result = _check(method, None if T is None else _orthonormal(T), pair, int(seed))
    return result.replace(ms=1e3 * (time.perf_counter() - start))


def _orthonormal(T: np.ndarray) -> np.ndarray | None:
    """Nearest rigid transform: both libraries chain small updates into not quite a rotation."""
    if T.shape != (4, 4) or not np.isfinite(T).all():
        return None
    U, _, V = np.linalg.svd(T[:3, :3])
    return make_transform(U @ np.diag([1.0, 1.0, np.linalg.det(U @ V)]) @ V, T[:3, 3])


def _check(method: str, T: np.ndarray | None, pair: FramePair, seed: int) -> RelativePose:
    camera = pair.curr.camera
    data = sample_correspondences(pair, POINTS, seed)
    if isinstance(data, Correspondences):
        return check_pose(method, T, data, camera, INLIER_THRESHOLD_PX)
    # without flow: the motion's own projection, with an assumed pixel of noise
    ego = FramePair(pair.prev, pair.curr, np.zeros((*camera.shape, 2), np.float32))
    still = sample_correspondences(ego, POINTS, seed)
    if isinstance(still, Status):
        return RelativePose.failed(still.reason, still.message, method)
    if T is None or not is_rigid(T):
        return check_pose(method, None, still, camera, INLIER_THRESHOLD_PX)
    moved = still.xyz @ T[:3, :3].T + T[:3, 3]
    front = moved[:, 2] > DEPTH_RANGE_M[0]
    z = np.where(front, moved[:, 2], 1.0)
    uv = moved[:, :2] / z[:, None] * (camera.fx, camera.fy) + (camera.cx, camera.cy)
    return check_pose(
        method, T, Correspondences(still.xyz, uv), camera, INLIER_THRESHOLD_PX, sigma_px=1.0
    )


def _rgbd_frames(pair: FramePair) -> _RgbdFrames | Status:
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
    return _RgbdFrames(pair.prev.rgb, depths[0], rgb_curr, depths[1], camera)
