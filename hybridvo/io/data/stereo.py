"""Depth of two cameras: rectification, matching, and how far the depth errs."""

from __future__ import annotations

from dataclasses import replace
from typing import Any, NamedTuple

import cv2
import numpy as np

from hybridvo.core.checks import as_rigid
from hybridvo.core.errors import InputError
from hybridvo.core.geometry import invert
from hybridvo.core.types import Camera
from hybridvo.io.calibration import DISPARITY_STD_PX
from hybridvo.io.data.sequence import UndistortionMaps, undistort
from hybridvo.io.data.streams import FrameImages, Lens

# px that are searched: at KITTI's focal length and baseline all beyond 3 m, at
# EuRoC's beyond 0.4 m
MAX_DISPARITY_PX = 128
# px, of the side of the blocks of two images that are compared
STEREO_BLOCK_PX = 5
DISPARITY_STEPS = 16
"""OpenCV states disparities in steps of 1/16 pixel."""
MIN_BASELINE_M = 1e-4
"""Two cameras that are closer are one."""


class StereoRig(NamedTuple):
    """Two cameras as they are calibrated."""

    left: Lens
    right: Lens
    # (4, 4) maps points of the left camera into the right one, metres
    T_right_left: np.ndarray


class Rectified(NamedTuple):
    """Two views of which each row of one is the same row of the other."""

    camera: Camera  # of both views
    baseline: float  # m, of the right camera to the right of the left one
    # (3, 3) turns the left camera's axes into those of the view
    R_rectified_left: np.ndarray
    left_maps: UndistortionMaps | None  # None where the images are rectified
    right_maps: UndistortionMaps | None


def rectify(rig: StereoRig, where: str) -> Rectified:
    """Return how two images become views of two cameras that stand side by side.

    Args:
        rig: The two cameras, with images of one size.
        where: For messages.

    Raises:
        InputError: The cameras are of two sizes or two models, or the right one does not stand to
            the right.
    """
    left = rig.left.camera
    right = rig.right.camera
    if left.shape != right.shape:
        sizes = (
            f"{left.width}x{left.height} and {right.width}x{right.height} pixels"
        )
        raise InputError(f"{where}: expected two cameras of one size, got {sizes}.")
    if rig.left.is_fisheye != rig.right.is_fisheye:
        raise InputError(f"{where}: expected two lenses of one model.")
    T = as_rigid(rig.T_right_left, f"{where}: T_right_left", 1e-3)
    if not T[0, 3] < -MIN_BASELINE_M or abs(T[0, 3]) < abs(T[1, 3]):
        place = -T[:3, :3].T @ T[:3, 3]
        raise InputError(
            f"{where}: expected the right camera to the right of the left one, got it at "
            f"{np.round(place, 4).tolist()} m (x right, y down, z forward)."
        )
    size = (left.width, left.height)
    lenses = (rig.left, rig.right)
    parts = [
        (lens.camera.K, np.array(lens.distortion or (0.0,) * 4)) for lens in lenses
    ]
    R = np.ascontiguousarray(T[:3, :3])
    t = np.ascontiguousarray(T[:3, 3:])
    numbers: list[Any] = [*parts[0], *parts[1], size, R, t]
    opencv: Any = cv2.fisheye if rig.left.is_fisheye else cv2
    without_borders = {"balance": 0.0} if rig.left.is_fisheye else {"alpha": 0.0}
    R_left, R_right, P_left, P_right, *_ = opencv.stereoRectify(
        *numbers, flags=cv2.CALIB_ZERO_DISPARITY, **without_borders
    )
    K = np.array(P_left[:, :3])
    return Rectified(
        replace(Camera.from_matrix(K, *left.shape), readout_ms=left.readout_ms),
        float(-P_right[0, 3] / P_right[0, 0]),
        np.array(R_left),
        rig.left.maps(np.array(R_left), K),
        rig.right.maps(np.array(R_right), K),
    )


def rectified_already(camera: Camera, baseline: float, where: str) -> Rectified:
    """Return what stands for two images that are rectified."""
    if not baseline > MIN_BASELINE_M:
        raise InputError(
            f"{where}: baseline: expected metres to the right, got {baseline}."
        )
    return Rectified(camera, float(baseline), np.eye(3), None, None)


def T_right_left_of(
    T_body_left: np.ndarray, T_body_right: np.ndarray
) -> np.ndarray:
    """Return ``T_right_left`` of two cameras whose places in a body are known, (4, 4)."""
    return invert(T_body_right) @ T_body_left


def stereo_images(
    left: np.ndarray, right: np.ndarray, rig: Rectified
) -> FrameImages:
    """Return the rectified left image with its depth, and how far that errs.

    Args:
        left: (H, W, 3) uint8 RGB, as the left camera takes it.
        right: (H, W, 3) uint8 RGB of the right one.
        rig: How they are rectified.
    """
    mask = None
    if rig.left_maps is not None and rig.right_maps is not None:
        rectified, _, mask = undistort(rig.left_maps, left, None, None)
        left = left if rectified is None else rectified
        right = cv2.remap(right, *rig.right_maps, cv2.INTER_LINEAR)
    disparity = match(left, right)
    disparity_at_1m = rig.camera.fx * rig.baseline
    depth, variance = depth_from_disparity(disparity, disparity_at_1m)
    return FrameImages(left, depth, variance, mask)


def matcher_of(width: int) -> cv2.StereoSGBM:
    """Return a matcher of rectified images with so many columns."""
    area = STEREO_BLOCK_PX * STEREO_BLOCK_PX
    return cv2.StereoSGBM.create(
        # narrow images cannot be searched as far
        numDisparities=min(MAX_DISPARITY_PX, max(16, width // 2 // 16 * 16)),
        blockSize=STEREO_BLOCK_PX,
        # OpenCV recommends 8 and 32 times the pixels of a block
        P1=8 * area,
        P2=32 * area,
        disp12MaxDiff=1,
        uniquenessRatio=10,
        speckleWindowSize=100,
        speckleRange=2,
        mode=cv2.STEREO_SGBM_MODE_SGBM_3WAY,
    )


def match(left: np.ndarray, right: np.ndarray) -> np.ndarray:
    """Return the disparity of rectified images by semi-global block matching.

    Args:
        left: (H, W, 3) uint8 RGB.
        right: (H, W, 3) uint8 RGB.

    Returns:
        (H, W) float32, px to the left in the right image, in steps of 1/16; not positive where
        unknown.
    """
    width = left.shape[1]
    matcher = matcher_of(width)
    reach = matcher.getNumDisparities()
    # the matcher leaves out as many columns at the left as it searches
    left_grey, right_grey = (
        cv2.copyMakeBorder(
            cv2.cvtColor(image, cv2.COLOR_RGB2GRAY),
            0,
            0,
            reach,
            0,
            cv2.BORDER_CONSTANT,
        )
        for image in (left, right)
    )
    steps = matcher.compute(left_grey, right_grey)[:, reach:]
    disparity = steps.astype(np.float32) / DISPARITY_STEPS
    # what the right camera does not see was matched to the border
    columns = np.arange(width, dtype=np.float32)
    return np.where(columns >= disparity, disparity, -1)


def depth_from_disparity(
    disparity: np.ndarray, disparity_at_1m: float
) -> tuple[np.ndarray, np.ndarray]:
    """Return depth and the variance of its logarithm.

    Depth is ``f b / d``: an error of the disparity by sigma is one of the log by ``sigma / d``.

    Args:
        disparity: (H, W) px, not positive where unknown.
        disparity_at_1m: Focal length, px, times baseline, m.

    Returns:
        Depth (H, W) float32 metres, 0 where unknown, and its variance (H, W) float32.

    Example:
        >>> import numpy as np
        >>> depth, variance = depth_from_disparity(np.float32([[10.0, -1.0]]), 20.0)
        >>> depth.tolist(), variance.astype(float).round(4).tolist()
        ([[2.0, 0.0]], [[0.0025, 1.0]])
    """
    is_known = disparity > 0
    divisor = np.where(is_known, disparity, 1).astype(np.float32)
    depth = np.where(is_known, disparity_at_1m / divisor, 0).astype(np.float32)
    variance = (DISPARITY_STD_PX / divisor) ** 2
    return depth, np.where(is_known, variance, 1).astype(np.float32)
