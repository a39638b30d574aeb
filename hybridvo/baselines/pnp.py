"""The estimators that others use today, behind one signature, with their answers checked.

Every estimator is called as ``estimator(pair, seed=0)`` and returns a
:class:`~hybridvo.results.RelativePose`. 3-D points come from the previous depth and ``K_prev``, 2-D
points from the flow, seen by ``K_curr``. A solver's own "success" is not believed: the answer must
be finite, keep its inliers in front of the camera, have enough of them, and they must determine all
six degrees of freedom. Bad data gives a failed status, never an exception and never NaN.
"""

from __future__ import annotations

import importlib
import importlib.util
import time
from collections.abc import Callable
from typing import Any

import cv2
import numpy as np

from hybridvo.baselines.correspondences import (
    MIN_POINTS,
    POINTS,
    Correspondences,
    check_arguments,
    check_pose,
    sample_correspondences,
)
from hybridvo.baselines.rgbd import REMEDIES, open3d_rgbd, opencv_rgbd
from hybridvo.errors import InputError
from hybridvo.geometry import make_transform
from hybridvo.results import RelativePose, Status
from hybridvo.types import Camera, FramePair

__all__ = [
    "baselines",
    "identity",
    "missing",
    "open3d_rgbd",
    "opencv_rgbd",
    "pnp_ransac",
    "pnp_ransac_tuned",
    "poselib",
    "usac_magsac",
]

Estimator = Callable[..., RelativePose]

POSELIB_REMEDY = "PoseLib is not installed; pip install 'hybridvo[baselines]'"

_IDENTITY_COVARIANCE = np.diag([1.0] * 3 + [0.1] * 3)
_TUNED: dict[str, Any] = {"iterationsCount": 1000, "reprojectionError": 2.0, "confidence": 0.999}
_NO_DISTORTION = np.zeros(4)
_FOUND_NOTHING = (cv2.error, ValueError, RuntimeError, ArithmeticError)
"""What the libraries raise on data that determine no pose."""


def pnp_ransac(pair: FramePair, *, seed: int = 0, points: int = POINTS) -> RelativePose:
    """``cv2.solvePnPRansac`` with its defaults: 8 px, 100 iterations, confidence 0.99, EPnP.

    Args:
        pair: depth of the previous frame (metres), flow (px) and both cameras are read.
        seed: chooses the sampled pixels; OpenCV's own generator is fixed.
        points: number of random valid pixels.

    Returns:
        ``T_curr_prev`` with covariance and status.

    Raises:
        InputError: ``pair`` is no FramePair, or ``seed`` or ``points`` cannot be used.
    """

    def solve(data: Correspondences, camera: Camera, seed: int) -> np.ndarray | None:
        found, rvec, tvec, _ = cv2.solvePnPRansac(data.xyz, data.uv, camera.K, _NO_DISTORTION)
        return _opencv_pose(found, rvec, tvec)

    return _sparse("pnp-ransac", solve, pair, seed, points, threshold_px=8.0)


def pnp_ransac_tuned(pair: FramePair, *, seed: int = 0, points: int = POINTS) -> RelativePose:
    """``cv2.solvePnPRansac`` at 2 px, 1000 iterations, 0.999, then LM on the inliers.

    Args, returns and raises as :func:`pnp_ransac`.
    """

    def solve(data: Correspondences, camera: Camera, seed: int) -> np.ndarray | None:
        found, rvec, tvec, inliers = cv2.solvePnPRansac(
            data.xyz,
            data.uv,
            camera.K,
            _NO_DISTORTION,
            **_TUNED,
        )
        if found and inliers is not None and len(inliers) >= MIN_POINTS:
            keep = inliers[:, 0]
            rvec, tvec = cv2.solvePnPRefineLM(
                data.xyz[keep], data.uv[keep], camera.K, _NO_DISTORTION, rvec, tvec
            )
        return _opencv_pose(found, rvec, tvec)

    return _sparse("pnp-ransac-tuned", solve, pair, seed, points)


def usac_magsac(pair: FramePair, *, seed: int = 0, points: int = POINTS) -> RelativePose:
    """``cv2.solvePnPRansac`` with ``cv2.USAC_MAGSAC`` at 2 px, 1000 iterations, 0.999.

    Args, returns and raises as :func:`pnp_ransac`.
    """

    def solve(data: Correspondences, camera: Camera, seed: int) -> np.ndarray | None:
        found, rvec, tvec, _ = cv2.solvePnPRansac(
            data.xyz,
            data.uv,
            camera.K,
            _NO_DISTORTION,
            **_TUNED,
            flags=cv2.USAC_MAGSAC,
        )
        return _opencv_pose(found, rvec, tvec)

    return _sparse("usac-magsac", solve, pair, seed, points)


def poselib(pair: FramePair, *, seed: int = 0, points: int = POINTS) -> RelativePose:
    """PoseLib's LO-RANSAC at 2 px, 100 to 1000 iterations, 0.999, bundle adjustment included.

    Its default of at least 1000 iterations takes three times as long and is no more accurate here.
    PoseLib takes one camera, that of the 2-D points: ``K_curr``.

    Args, returns and raises as :func:`pnp_ransac`.

    Raises:
        InputError: PoseLib is not installed.
    """
    try:
        import poselib as library
    except ImportError:
        raise InputError(f"poselib: {POSELIB_REMEDY}.") from None

    def solve(data: Correspondences, camera: Camera, seed: int) -> np.ndarray | None:
        model = {
            "model": "PINHOLE",
            "width": camera.width,
            "height": camera.height,
            "params": [camera.fx, camera.fy, camera.cx, camera.cy],
        }
        options = {
            "max_reproj_error": 2.0,
            "min_iterations": 100,
            "max_iterations": 1000,
            "success_prob": 0.999,
            "seed": seed,
        }
        pose, _ = library.estimate_absolute_pose(data.uv, data.xyz, model, options, {})
        return make_transform(np.asarray(pose.R), np.asarray(pose.t))

    return _sparse("poselib", solve, pair, seed, points)


def identity(pair: FramePair, *, seed: int = 0) -> RelativePose:
    """The zero-motion predictor: the floor every method must beat.

    Its covariance is a fixed prior of 1 m and 0.3 rad a step; nothing of the pair is read.
    """
    check_arguments("identity", pair, seed)
    return RelativePose(covariance=_IDENTITY_COVARIANCE.copy(), method="identity")


def baselines() -> dict[str, Estimator]:
    """Name -> estimator, of every baseline that can run here; :func:`missing` names the others."""
    known: dict[str, Estimator] = {
        "pnp-ransac": pnp_ransac,
        "pnp-ransac-tuned": pnp_ransac_tuned,
        "usac-magsac": usac_magsac,
        "poselib": poselib,
        "opencv-rgbd": opencv_rgbd,
        "open3d-rgbd": open3d_rgbd,
        "identity": identity,
    }
    absent = missing()
    return {name: estimator for name, estimator in known.items() if name not in absent}


def missing() -> dict[str, str]:
    """Name -> reason and remedy, of every baseline that cannot run here."""
    absent = {}
    for name, library, remedy in (
        ("poselib", "poselib", POSELIB_REMEDY),
        ("open3d-rgbd", "open3d", REMEDIES["open3d-rgbd"]),
    ):
        if importlib.util.find_spec(library) is None:
            absent[name] = remedy
            continue
        try:
            importlib.import_module(library)
        except ImportError as error:  # Open3D without its system libraries
            absent[name] = f"{library} is installed but cannot be imported: {error}; {remedy}"
    if not hasattr(cv2, "Odometry"):
        absent["opencv-rgbd"] = REMEDIES["opencv-rgbd"]
    return absent


def _sparse(
    method: str,
    solve: Callable[[Correspondences, Camera, int], np.ndarray | None],
    pair: FramePair,
    seed: int,
    points: int,
    threshold_px: float = 2.0,
) -> RelativePose:
    """Sample, solve, check: what all point solvers share."""
    start = time.perf_counter()
    check_arguments(method, pair, seed, points)
    sampled = sample_correspondences(pair, points, int(seed))
    if isinstance(sampled, Status):
        result = RelativePose.failed(sampled.reason, sampled.message, method)
    else:
        try:
            T = solve(sampled, pair.curr.camera, int(seed) % 2**31)
        except _FOUND_NOTHING:
            T = None
        result = check_pose(method, T, sampled, pair.curr.camera, threshold_px)
    return result.replace(ms=1e3 * (time.perf_counter() - start))


def _opencv_pose(found: bool, rvec: np.ndarray, tvec: np.ndarray) -> np.ndarray | None:
    if not found or not np.isfinite(rvec).all() or not np.isfinite(tvec).all():
        return None
    return make_transform(cv2.Rodrigues(rvec)[0], tvec[:, 0])
