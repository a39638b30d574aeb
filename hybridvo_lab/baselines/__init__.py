"""Methods of other libraries, for comparison.

These are the point solvers of OpenCV and PoseLib, and what a user of an RGB-D camera would
pick today: the RGB-D odometry of OpenCV and Open3D, the registration of point clouds by
small_gicp and KISS-ICP, and SIFT matches with PnP-RANSAC.
"""

from __future__ import annotations

import importlib

import cv2
import numpy as np

from hybridvo.core.results import RelativePose, StageFailed
from hybridvo.core.types import FramePair

SOLVERS = ("pnp-ransac", "pnp-ransac-tuned", "usac-magsac", "poselib")
"""Point solvers."""
ALIGNERS = ("opencv-rgbd", "open3d-rgbd")
"""RGB-D odometry."""
REGISTRATIONS = ("small-gicp", "kiss-icp")
"""Registration of point clouds."""
FEATURES = "sift-pnp"
WITHOUT_FLOW = (*REGISTRATIONS, FEATURES)
"""Methods for which no flow is computed; RGB-D odometry takes it for its covariance alone."""
METHODS = (*SOLVERS, *ALIGNERS, *WITHOUT_FLOW)
NEEDED = {
    "poselib": ("poselib", "pip install 'hybridvo[baselines]'"),
    "open3d-rgbd": (
        "open3d",
        "pip install 'hybridvo[peers]' or pip install open3d",
    ),
    "small-gicp": ("small_gicp", "pip install 'hybridvo[peers]'"),
    "kiss-icp": ("kiss_icp", "pip install 'hybridvo[peers]'"),
}
"""Packages that a method needs, and how they are installed."""


def missing(method: str) -> str:
    """Return why a method cannot run here and the remedy; empty where it can."""
    if method == "opencv-rgbd" and not hasattr(cv2, "Odometry"):
        remedy = "pip install 'opencv-python-headless>=5'"
        return f"cv2.Odometry came with OpenCV 5; {remedy}"
    if method not in NEEDED:
        return ""
    library, remedy = NEEDED[method]
    try:
        importlib.import_module(library)
    # not installed; or Open3D without its system libraries
    except ImportError as error:
        return f"{library} cannot be imported: {error}; {remedy}"
    return ""


def estimate(
    method: str,
    pair: FramePair,
    seed: int = 0,
    inlier_px: float | None = None,
    start: np.ndarray | None = None,
) -> RelativePose:
    """Estimate the motion of a pair by one of :data:`METHODS`.

    Args:
        method: a name of :data:`METHODS`.
        pair: the frames, with flow for the point solvers.
        seed: of the sampled pixels, and of the solvers that take one.
        inlier_px: largest residual of an inlier of a point solver, px. None:
            OpenCV's default for ``pnp-ransac``, by the noise that the flow states
            for the others.
        start: (4, 4) T_curr_prev from which a registration of point clouds begins;
            None: no motion.

    Returns:
        The motion; failed where the data determine none.
    """
    from hybridvo_lab.baselines import clouds, features, images, solvers

    try:
        if method in REGISTRATIONS:
            return clouds.estimate_by_clouds(method, pair, seed, start)
        if method == FEATURES:
            return features.estimate_by_features(pair, seed)
        if method in ALIGNERS:
            return images.estimate_by_images(method, pair, seed)
        return solvers.estimate_by_points(method, pair, seed, inlier_px)
    except StageFailed as failure:
        return RelativePose.failed(
            failure.reason, str(failure), inlier_ratio=failure.inlier_ratio
        )
