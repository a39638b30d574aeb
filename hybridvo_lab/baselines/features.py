"""SIFT matches of the two images with the depth of the first one, and PnP-RANSAC."""

from __future__ import annotations

import contextlib

import cv2
import numpy as np

from hybridvo.core.geometry import backproject
from hybridvo.core.results import Reason, RelativePose, StageFailed
from hybridvo.core.types import Frame, FramePair
from hybridvo_lab.baselines.correspondences import (
    MIN_SOLVER_POINTS,
    Correspondences,
    depth_in_range,
    with_covariance,
)
from hybridvo_lab.baselines.solvers import (
    MAX_ITERATIONS,
    SOLVER_CONFIDENCE,
    SOLVER_ERRORS,
    pnp_ransac,
    transform_of,
)

# features of an image that are kept, the strongest first
SIFT_FEATURES = 2000
# of the distances to the nearest and the next descriptor: Lowe's (IJCV 2004)
SIFT_RATIO = 0.8
# px, of the residual of an inlier: SIFT places features to about half a pixel
SIFT_INLIER_PX = 2.0


def estimate_by_features(pair: FramePair, seed: int) -> RelativePose:
    """Match SIFT features, solve PnP in a RANSAC, then refine on the inliers.

    Raises:
        StageFailed: where images or depth are missing, or matches are too few.
    """
    data = match_features(pair)
    camera = pair.curr.camera
    cv2.setRNGSeed(seed)
    T = None
    with contextlib.suppress(*SOLVER_ERRORS):
        T = _solve(data, camera.K)
    return with_covariance(T, data, camera, SIFT_INLIER_PX)


def match_features(pair: FramePair) -> Correspondences:
    """Return the points of matched features by the ratio test, both ways.

    Raises:
        StageFailed: where images or depth are missing, or matches are too few.
    """
    depth = pair.prev.depth
    if not pair.has_images:
        raise StageFailed(
            Reason.MISSING_FRAME, "this method matches images: none is there"
        )
    if depth is None or not depth_in_range(depth).any():
        raise StageFailed(
            Reason.NO_VALID_DEPTH, "the previous frame has no valid depth"
        )
    detector = cv2.SIFT.create(SIFT_FEATURES)
    at_prev, descriptors_prev = _features(detector, pair.prev)
    at_curr, descriptors_curr = _features(detector, pair.curr)
    there = _matches(descriptors_prev, descriptors_curr)
    back = _matches(descriptors_curr, descriptors_prev)
    mutual = [(i, j) for i, j in there.items() if back.get(j) == i]
    pairs = np.array(mutual, dtype=int).reshape(-1, 2)
    uv_prev = at_prev[pairs[:, 0]]
    uv_curr = at_curr[pairs[:, 1]]
    rows, columns = depth.shape
    cells = np.rint(uv_prev[:, ::-1]).astype(int)
    cells = np.clip(cells, 0, (rows - 1, columns - 1))
    is_known = depth_in_range(depth[cells[:, 0], cells[:, 1]])
    count = int(is_known.sum())
    if count < MIN_SOLVER_POINTS:
        raise StageFailed(
            Reason.LOW_INLIERS,
            f"{count} matches with valid depth, need {MIN_SOLVER_POINTS}",
        )
    # the depth of the nearest pixel, and the ray of the feature itself
    at_cells = backproject(depth, pair.prev.camera, cells[is_known])
    rays = np.column_stack([uv_prev[is_known], np.ones(count)])
    rays = rays @ np.linalg.inv(pair.prev.camera.K).T
    return Correspondences(rays * at_cells[:, 2:], uv_curr[is_known])


def _features(
    detector: cv2.SIFT, frame: Frame
) -> tuple[np.ndarray, np.ndarray | None]:
    """Places (N, 2) px and descriptors (N, 128) of the features of an image."""
    assert frame.rgb is not None
    grey = cv2.cvtColor(frame.rgb, cv2.COLOR_RGB2GRAY)
    keypoints, descriptors = detector.detectAndCompute(grey, None)
    places = np.array([keypoint.pt for keypoint in keypoints])
    return places.reshape(-1, 2), descriptors


def _matches(first: np.ndarray | None, second: np.ndarray | None) -> dict[int, int]:
    """The match of each feature whose nearest neighbour is much nearer than the next one."""
    if first is None or second is None or len(second) < 2:
        return {}
    found = cv2.BFMatcher(cv2.NORM_L2).knnMatch(first, second, k=2)
    return {
        best.queryIdx: best.trainIdx
        for best, other in found
        if best.distance < SIFT_RATIO * other.distance
    }


def _solve(data: Correspondences, K: np.ndarray) -> np.ndarray | None:
    """T_curr_prev (4, 4) by PnP-RANSAC, refined on its inliers; None where it finds none."""
    options = {
        "iterationsCount": MAX_ITERATIONS,
        "confidence": SOLVER_CONFIDENCE,
        "flags": cv2.SOLVEPNP_AP3P,
    }
    answer = pnp_ransac(data, K, SIFT_INLIER_PX, options)
    inliers = answer.inliers
    if not answer.found or inliers is None:
        return None
    rvec = answer.rvec
    tvec = answer.tvec
    if len(inliers) >= MIN_SOLVER_POINTS:
        xyz = data.xyz[inliers[:, 0]]
        uv = data.uv[inliers[:, 0]]
        rvec, tvec = cv2.solvePnPRefineLM(xyz, uv, K, None, rvec, tvec)
    return transform_of(rvec, tvec)
