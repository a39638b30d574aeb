"""Registration of point clouds: small_gicp and KISS-ICP on the two depth maps.

Neither sees the images. Their settings scale with the scene. For a median depth of 2 m they
are those that a user of a Kinect would choose: points up to 4 m, voxels of 3 cm
(small_gicp) and 4 cm (KISS-ICP).
"""

from __future__ import annotations

import contextlib
from typing import Any, NamedTuple

import numpy as np

from hybridvo.core.geometry import adjoint, backproject, invert, pose_matrix
from hybridvo.core.results import Reason, RelativePose, StageFailed, Status
from hybridvo.core.types import Frame, FramePair
from hybridvo_lab.baselines.correspondences import (
    MIN_CONSENSUS_RATIO,
    OPENCV_INLIER_PX,
    SELF_FLOW_STD_PX,
    SINGULAR_RATIO,
    depth_in_range,
    self_consistent,
    with_covariance,
)
from hybridvo_lab.baselines.solvers import SOLVER_ERRORS

# median depths, of the farthest point: the noise of depth cameras grows with the
# square of depth, and the sky of renderers is no surface
CLOUD_RANGE_RATIO = 2.0
# median depths, of the side of small_gicp's voxels
CLOUD_VOXEL_RATIO = 0.015
# voxels between two points that belong together in small_gicp
CLOUD_MATCH_VOXELS = 5.0
# points that a registration needs: each looks at ten neighbours
CLOUD_MIN_POINTS = 50
# ranges, of the side of KISS-ICP's voxels: its own rule
KISS_VOXEL_RATIO = 0.01
# voxels, of its first threshold: its default of 2 m at voxels of 1 m
KISS_THRESHOLD_VOXELS = 2.0

PIXEL_STEP = 2
"""Every second row and column becomes a point."""
ITERATIONS = 30
"""Largest number of small_gicp's steps; its default is 20."""
ROTATION_TOLERANCE_RAD = 1e-4
"""Change of the rotation below which small_gicp stops; its default, .0017, is a lidar's."""
TRANSLATION_TOLERANCE = 1e-4
"""The same of the translation, in voxels."""
ROTATION_FIRST = [3, 4, 5, 0, 1, 2]
"""Order of the tangent of small_gicp, in places of ours."""


class Clouds(NamedTuple):
    """The points of both frames, each in its own camera."""

    prev: np.ndarray  # (N, 3) metres
    curr: np.ndarray  # (M, 3) metres
    depth: float  # median depth of the previous frame, metres


def estimate_by_clouds(
    method: str, pair: FramePair, seed: int, start: np.ndarray | None
) -> RelativePose:
    """Register the points of the previous frame with those of the current one.

    Raises:
        StageFailed: where a frame has no depth, or too few points are in range.
    """
    clouds = clouds_of(pair)
    T_start = np.eye(4) if start is None else start
    if method == "small-gicp":
        return _by_small_gicp(clouds, T_start)
    return _by_kiss_icp(clouds, T_start, pair, seed)


def clouds_of(pair: FramePair) -> Clouds:
    """Return the points of both frames up to a range that follows the median depth.

    Raises:
        StageFailed: where a frame has no depth, or too few points are in range.
    """
    for name, frame in (("previous", pair.prev), ("current", pair.curr)):
        if frame.depth is None or not depth_in_range(frame.depth).any():
            raise StageFailed(
                Reason.NO_VALID_DEPTH, f"the {name} frame has no valid depth"
            )
    depth = median_depth(pair.prev)
    prev = points_of(pair.prev, CLOUD_RANGE_RATIO * depth)
    curr = points_of(pair.curr, CLOUD_RANGE_RATIO * depth)
    count = min(len(prev), len(curr))
    if count < CLOUD_MIN_POINTS:
        raise StageFailed(
            Reason.LOW_INLIERS,
            f"{count} points in range, need {CLOUD_MIN_POINTS}",
        )
    return Clouds(prev, curr, depth)


def median_depth(frame: Frame) -> float:
    """Return the median of the valid depth of a frame, metres."""
    assert frame.depth is not None
    return float(np.median(frame.depth[depth_in_range(frame.depth)]))


def points_of(frame: Frame, max_depth: float) -> np.ndarray:
    """Return the points (N, 3), metres, of every second pixel up to some depth."""
    assert frame.depth is not None
    depth = frame.depth[::PIXEL_STEP, ::PIXEL_STEP]
    is_used = depth_in_range(depth) & (depth < max_depth)
    pixels = PIXEL_STEP * np.argwhere(is_used)
    points = backproject(frame.depth, frame.camera, pixels)
    return np.asarray(points, np.float64)


# -- small_gicp --------------------------------------------------------------------------


def _by_small_gicp(clouds: Clouds, T_start: np.ndarray) -> RelativePose:
    """Call small_gicp's GICP; its Hessian and its cost give the covariance."""
    import small_gicp

    voxel = CLOUD_VOXEL_RATIO * clouds.depth
    # lengths in voxels: the covariances of GICP and its tolerances have a unit
    T_scaled = _with_length(T_start, 1 / voxel)
    found = None
    with contextlib.suppress(*SOLVER_ERRORS):
        target, tree = small_gicp.preprocess_points(clouds.curr / voxel, 1.0)
        source, _ = small_gicp.preprocess_points(clouds.prev / voxel, 1.0)
        found = small_gicp.align(
            target,
            source,
            tree,
            T_scaled,
            registration_type="GICP",
            max_correspondence_distance=CLOUD_MATCH_VOXELS,
            max_iterations=ITERATIONS,
            rotation_epsilon=ROTATION_TOLERANCE_RAD,
            translation_epsilon=TRANSLATION_TOLERANCE,
        )
    if found is None or not np.isfinite(found.T_target_source).all():
        raise StageFailed(Reason.SOLVER_DIVERGED, "small_gicp found no motion")
    count = source.size()
    ratio = found.num_inliers / max(count, 1)
    if found.num_inliers < CLOUD_MIN_POINTS or ratio < MIN_CONSENSUS_RATIO:
        raise StageFailed(
            Reason.LOW_INLIERS,
            f"{found.num_inliers} of {count} points have a partner",
            inlier_ratio=ratio,
        )
    T = pose_matrix(found.T_target_source[:3])
    covariance = _gicp_covariance(found, T)
    status = Status()
    if not found.converged:
        text = f"small_gicp has not converged in {ITERATIONS} steps"
        status = Status.degraded(Reason.SOLVER_DIVERGED, text)
    scale = np.repeat([voxel, 1.0], 3)
    return RelativePose(
        T_curr_prev=_with_length(T, voxel),
        covariance=covariance * np.outer(scale, scale),
        status=status,
        cost=found.error / found.num_inliers,
        inlier_ratio=ratio,
        iterations=found.iterations,
    )


def _with_length(T: np.ndarray, factor: float) -> np.ndarray:
    """Return a motion (4, 4) with its translation in another unit."""
    scaled = T.copy()
    scaled[:3, 3] *= factor
    return scaled


def _gicp_covariance(found: Any, T: np.ndarray) -> np.ndarray:
    """Return s^2 H^-1 (6, 6), as a left perturbation with the translation first.

    small_gicp perturbs on the right, rotation first. Each point has one residual that
    counts, along the normal, of which the cost is half the square.

    Raises:
        StageFailed: where H is singular.
    """
    H = found.H[np.ix_(ROTATION_FIRST, ROTATION_FIRST)]
    values, vectors = np.linalg.eigh(H)
    if not values[0] > SINGULAR_RATIO * values[-1]:
        raise StageFailed(
            Reason.DEGENERATE_GEOMETRY,
            "the points leave a direction of the motion undetermined",
        )
    variance = 2 * found.error / (found.num_inliers - 6)
    # exact data has no residual
    variance = max(variance, SINGULAR_RATIO)
    root = adjoint(T) @ (vectors / np.sqrt(values))
    return np.asarray(variance * (root @ root.T))


# -- KISS-ICP ----------------------------------------------------------------------------


def kiss_odometry(max_range: float) -> Any:
    """Return a KISS-ICP with its own defaults, all lengths scaled to a range in metres."""
    from kiss_icp.config import KISSConfig
    from kiss_icp.kiss_icp import KissICP

    config = KISSConfig()
    voxel = KISS_VOXEL_RATIO * max_range
    config.data.max_range = max_range
    # a depth map is taken at one moment
    config.data.deskew = False
    config.mapping.voxel_size = voxel
    threshold = config.adaptive_threshold
    threshold.initial_threshold = KISS_THRESHOLD_VOXELS * voxel
    # its default is 0.1 m at voxels of 1 m
    threshold.min_motion_th *= voxel
    # sums of several threads differ from run to run
    config.registration.max_num_threads = 1
    return KissICP(config)


def _by_kiss_icp(
    clouds: Clouds, T_start: np.ndarray, pair: FramePair, seed: int
) -> RelativePose:
    """Register the current points with a map of the previous ones.

    KISS-ICP states no covariance: it is that of a flow known to a pixel.
    """
    # in units of the median depth
    odometry = kiss_odometry(CLOUD_RANGE_RATIO)
    no_stamps = np.zeros(0)
    odometry.register_frame(clouds.prev / clouds.depth, no_stamps)
    odometry.last_delta = invert(_with_length(T_start, 1 / clouds.depth))
    T = None
    with contextlib.suppress(*SOLVER_ERRORS):
        odometry.register_frame(clouds.curr / clouds.depth, no_stamps)
        pose = odometry.last_pose
        if np.isfinite(pose).all():
            T_curr_prev = invert(pose_matrix(pose[:3]))
            T = _with_length(T_curr_prev, clouds.depth)
    data = self_consistent(pair, T, seed)
    return with_covariance(
        T, data, pair.curr.camera, OPENCV_INLIER_PX, SELF_FLOW_STD_PX
    )
