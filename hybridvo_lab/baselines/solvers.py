"""Point solvers of OpenCV and PoseLib, on the correspondences of the flow.

Each takes correspondences, the current camera, a seed and the largest residual of an
inlier, px, and returns T_curr_prev (4, 4), or None where it finds none.
"""

from __future__ import annotations

import contextlib
from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import cv2
import numpy as np

from hybridvo.core.geometry import make_transform
from hybridvo.core.results import RelativePose
from hybridvo.core.types import Camera, FramePair
from hybridvo_lab.baselines.correspondences import (
    MIN_SOLVER_POINTS,
    OPENCV_INLIER_PX,
    Correspondences,
    sample,
    with_covariance,
)

# probability that one sample of the tuned solvers is free of outliers
SOLVER_CONFIDENCE = 0.999

# samples of the tuned solvers; the defaults are 100 of OpenCV, 100 000 of PoseLib
MAX_ITERATIONS = 1000
# PoseLib's default of at least 1000 takes three times as long and is no more
# accurate here
MIN_ITERATIONS = 100
TUNED: dict[str, Any] = {
    "iterationsCount": MAX_ITERATIONS,
    "confidence": SOLVER_CONFIDENCE,
}
SOLVER_ERRORS = (cv2.error, ValueError, RuntimeError, ArithmeticError)
"""What the libraries raise on data that determine no pose."""


class PnpAnswer(NamedTuple):
    """What ``cv2.solvePnPRansac`` returns."""

    found: bool
    rvec: np.ndarray  # (3, 1) rotation vector, rad
    tvec: np.ndarray  # (3, 1) metres
    inliers: np.ndarray | None  # (n, 1) rows of the correspondences


def solve_opencv(
    data: Correspondences,
    camera: Camera,
    seed: int,
    inlier_px: float,
    **options: Any,
) -> np.ndarray | None:
    """Call ``cv2.solvePnPRansac``, which takes no seed."""
    answer = pnp_ransac(data, camera.K, inlier_px, options)
    return transform_of(answer.rvec, answer.tvec) if answer.found else None


def solve_opencv_tuned(
    data: Correspondences, camera: Camera, seed: int, inlier_px: float
) -> np.ndarray | None:
    """Call ``cv2.solvePnPRansac`` with more samples, then refine on the inliers."""
    answer = pnp_ransac(data, camera.K, inlier_px, TUNED)
    if not answer.found:
        return None
    rvec = answer.rvec
    tvec = answer.tvec
    inliers = answer.inliers
    if inliers is not None and len(inliers) >= MIN_SOLVER_POINTS:
        xyz = data.xyz[inliers[:, 0]]
        uv = data.uv[inliers[:, 0]]
        rvec, tvec = cv2.solvePnPRefineLM(xyz, uv, camera.K, None, rvec, tvec)
    return transform_of(rvec, tvec)


def pnp_ransac(
    data: Correspondences, K: np.ndarray, inlier_px: float, options: dict[str, Any]
) -> PnpAnswer:
    """Call ``cv2.solvePnPRansac`` with the largest residual of an inlier, px."""
    settings = {"reprojectionError": inlier_px, **options}
    answer = cv2.solvePnPRansac(data.xyz, data.uv, K, None, **settings)
    return PnpAnswer(*answer)


def transform_of(rvec: np.ndarray, tvec: np.ndarray) -> np.ndarray | None:
    """(4, 4) of OpenCV's rotation and translation vectors; None where not finite."""
    if not np.isfinite(rvec).all() or not np.isfinite(tvec).all():
        return None
    return make_transform(cv2.Rodrigues(rvec)[0], tvec[:, 0])


def solve_poselib(
    data: Correspondences, camera: Camera, seed: int, inlier_px: float
) -> np.ndarray | None:
    """Call PoseLib's LO-RANSAC, bundle adjustment included."""
    import poselib

    model = {
        "model": "PINHOLE",
        "width": camera.width,
        "height": camera.height,
        "params": [camera.fx, camera.fy, camera.cx, camera.cy],
    }
    options = {
        "max_reproj_error": inlier_px,
        "min_iterations": MIN_ITERATIONS,
        "max_iterations": MAX_ITERATIONS,
        "success_prob": SOLVER_CONFIDENCE,
        "seed": seed,
    }
    pose, _ = poselib.estimate_absolute_pose(data.uv, data.xyz, model, options, {})
    return make_transform(np.asarray(pose.R), np.asarray(pose.t))


Solver = Callable[[Correspondences, Camera, int, float], np.ndarray | None]
SOLVERS: dict[str, Solver] = {
    "pnp-ransac": solve_opencv,
    "pnp-ransac-tuned": solve_opencv_tuned,
    "usac-magsac": partial(solve_opencv, flags=cv2.USAC_MAGSAC, **TUNED),
    "poselib": solve_poselib,
}
FIXED_PX = {"pnp-ransac": OPENCV_INLIER_PX}
"""Largest residual of an inlier, px, of solvers where it does not follow the flow.
"""


def estimate_by_points(
    method: str, pair: FramePair, seed: int, inlier_px: float | None
) -> RelativePose:
    """Sample the flow of a pair and solve."""
    data = sample(pair, seed)
    camera = pair.curr.camera
    if inlier_px is None:
        inlier_px = FIXED_PX.get(method, data.inlier_px)
    T = None
    with contextlib.suppress(*SOLVER_ERRORS):
        T = SOLVERS[method](data, camera, seed, inlier_px)
    return with_covariance(T, data, camera, inlier_px)
