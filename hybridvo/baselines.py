"""Methods of other libraries, for comparison.

These are the point solvers of OpenCV and PoseLib, and the RGB-D odometry of OpenCV
and Open3D, which is what a user of an RGB-D camera would pick today.
"""

from __future__ import annotations

import contextlib
import importlib
from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import cv2
import numpy as np

from hybridvo.calibration import (
    INLIER_STDS,
    MIN_CONSENSUS_RATIO,
    MIN_INLIER_PX,
    MIN_SOLVER_POINTS,
    OPENCV_INLIER_PX,
    SELF_FLOW_STD_PX,
    SINGULAR_RATIO,
    SOLVER_CONFIDENCE,
    UNSTATED_FLOW_STD_PX,
)
from hybridvo.checks import as_rigid
from hybridvo.errors import InputError
from hybridvo.geometry import (
    backproject,
    make_transform,
    pose_matrix,
    project,
    projection_rows,
    transform_points,
)
from hybridvo.results import Reason, RelativePose, StageFailed
from hybridvo.types import Camera, Frame, FramePair

# random valid pixels for a solver; all of them cost 50 times more for no accuracy
POINTS = 10_000
# samples of the tuned solvers; the defaults are 100 of OpenCV, 100 000 of PoseLib
MAX_ITERATIONS = 1000
# PoseLib's default of at least 1000 takes three times as long and is no more
# accurate here
MIN_ITERATIONS = 100
# metres; outside of them squares leave the floating-point range
MIN_DEPTH_M = 1e-6
MAX_DEPTH_M = 1e6
# px; exact data has no residual, but float32 flow near 1000 px is rounded at 6e-5
# px
MIN_RESIDUAL_PX = 1e-4
TUNED: dict[str, Any] = {
    "iterationsCount": MAX_ITERATIONS,
    "confidence": SOLVER_CONFIDENCE,
}
SOLVER_ERRORS = (cv2.error, ValueError, RuntimeError, ArithmeticError)
"""What the libraries raise on data that determine no pose."""
NEEDED = {
    "poselib": ("poselib", "pip install 'hybridvo[baselines]'"),
    "open3d-rgbd": ("open3d", "pip install open3d"),
}
"""Packages that a method needs, and how they are installed."""


class Correspondences(NamedTuple):
    """Sampled pixels of a pair."""

    xyz: np.ndarray  # (n, 3) metres, in the previous camera
    uv: np.ndarray  # (n, 2) px, in the current image
    # largest residual of an inlier, by the noise of the flow
    inlier_px: float = MIN_INLIER_PX


class Images(NamedTuple):
    """Both images and depth maps of a pair, with the previous intrinsics."""

    rgb: list[np.ndarray]  # (H, W, 3) uint8, previous and current
    depth: list[np.ndarray]  # (H, W) float32 metres, NaN where invalid


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


# -- point solvers
# -------------------------------------------------------------------
#
# Each takes correspondences, the current camera, a seed and the largest residual of
# an inlier, px, and returns T_curr_prev (4, 4), or None where it finds none.


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
    answer = _pnp_ransac(data, camera, inlier_px, options)
    return _transform(answer.rvec, answer.tvec) if answer.found else None


def solve_opencv_tuned(
    data: Correspondences, camera: Camera, seed: int, inlier_px: float
) -> np.ndarray | None:
    """Call ``cv2.solvePnPRansac`` with more samples, then refine on the inliers."""
    answer = _pnp_ransac(data, camera, inlier_px, TUNED)
    if not answer.found:
        return None
    rvec = answer.rvec
    tvec = answer.tvec
    inliers = answer.inliers
    if inliers is not None and len(inliers) >= MIN_SOLVER_POINTS:
        xyz = data.xyz[inliers[:, 0]]
        uv = data.uv[inliers[:, 0]]
        rvec, tvec = cv2.solvePnPRefineLM(xyz, uv, camera.K, None, rvec, tvec)
    return _transform(rvec, tvec)


def _pnp_ransac(
    data: Correspondences, camera: Camera, inlier_px: float, options: dict[str, Any]
) -> PnpAnswer:
    settings = {"reprojectionError": inlier_px, **options}
    answer = cv2.solvePnPRansac(data.xyz, data.uv, camera.K, None, **settings)
    return PnpAnswer(*answer)


def _transform(rvec: np.ndarray, tvec: np.ndarray) -> np.ndarray | None:
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


# -- RGB-D odometry
# ----------------------------------------------------------------------
#
# Each takes the images, the previous camera and the largest depth, m, and returns
# T_curr_prev (4, 4), or None where it finds none.


def align_opencv(
    images: Images, camera: Camera, max_depth: float
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
    images: Images, camera: Camera, max_depth: float
) -> np.ndarray | None:
    """Call Open3D's ``compute_rgbd_odometry`` with the hybrid term."""
    import open3d

    odometry = open3d.pipelines.odometry
    rgbd = [
        open3d.geometry.RGBDImage.create_from_color_and_depth(
            open3d.geometry.Image(np.ascontiguousarray(rgb)),
            open3d.geometry.Image(np.nan_to_num(depth)),  # 0 is unknown to Open3D
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


Aligner = Callable[[Images, Camera, float], np.ndarray | None]
ALIGNERS: dict[str, Aligner] = {
    "opencv-rgbd": align_opencv,
    "open3d-rgbd": align_open3d,
}
METHODS = (*SOLVERS, *ALIGNERS)


# -- what is the same for all
# ------------------------------------------------------------


def estimate(
    method: str, pair: FramePair, seed: int = 0, inlier_px: float | None = None
) -> RelativePose:
    """Estimate the motion of a pair by one of :data:`METHODS`.

    Args:
        method: a name of :data:`METHODS`.
        pair: the frames, with flow for the point solvers.
        seed: of the sampled pixels, and of PoseLib.
        inlier_px: largest residual of an inlier of a point solver, px. None:
            OpenCV's default for ``pnp-ransac``, by the noise that the flow states
            for the others.

    Returns:
        The motion; failed where the data determine none.
    """
    try:
        if method in ALIGNERS:
            return _estimate_by_images(ALIGNERS[method], pair, seed)
        return _estimate_by_points(method, pair, seed, inlier_px)
    except StageFailed as failure:
        return RelativePose.failed(
            failure.reason, str(failure), inlier_ratio=failure.inlier_ratio
        )


def _estimate_by_points(
    method: str, pair: FramePair, seed: int, inlier_px: float | None
) -> RelativePose:
    data = sample(pair, seed)
    camera = pair.curr.camera
    if inlier_px is None:
        inlier_px = FIXED_PX.get(method, data.inlier_px)
    T = None
    with contextlib.suppress(*SOLVER_ERRORS):
        T = SOLVERS[method](data, camera, seed, inlier_px)
    return with_covariance(T, data, camera, inlier_px)


def _estimate_by_images(align: Aligner, pair: FramePair, seed: int) -> RelativePose:
    """Align images and depth maps; flow serves for the check and the covariance."""
    images = _images(pair)
    max_depth = float(np.nanmax(images.depth[0])) + 1.0
    T = None
    with contextlib.suppress(*SOLVER_ERRORS):
        T = align(images, pair.prev.camera, max_depth)
    if T is not None:
        # both libraries chain small updates into not quite a rotation
        T = pose_matrix(T[:3]) if np.isfinite(T).all() else None
    camera = pair.curr.camera
    sigma_px = None
    try:
        data = sample(pair, seed)
    except StageFailed:
        data = _self_consistent(pair, T, seed)
        sigma_px = SELF_FLOW_STD_PX
    # the limit is wide, for these methods never saw the flow
    return with_covariance(T, data, camera, OPENCV_INLIER_PX, sigma_px)


def _self_consistent(
    pair: FramePair, T: np.ndarray | None, seed: int
) -> Correspondences:
    """Pixels where a motion moves them, for a pair without usable flow."""
    camera = pair.curr.camera
    no_flow = np.zeros((*camera.shape, 2), np.float32)
    data = sample(FramePair(pair.prev, pair.curr, no_flow), seed)
    if T is None:
        return data
    uv = project(transform_points(T, data.xyz), camera)
    return Correspondences(data.xyz, uv)


# -- sampling
# ----------------------------------------------------------------------------


def sample(pair: FramePair, seed: int, points: int = POINTS) -> Correspondences:
    """Draw random pixels with valid depth whose flow stays inside the image.

    Args:
        pair: the frames, with flow.
        seed: of the random generator.
        points: how many pixels at most.

    Returns:
        Their points and where the flow moves them.

    Raises:
        StageFailed: where there are fewer than :data:`MIN_SOLVER_POINTS`.
    """
    if pair.flow is None:
        raise StageFailed(Reason.NO_FLOW, "the pair has no flow")
    if pair.prev.depth is None:
        raise StageFailed(Reason.NO_VALID_DEPTH, "the previous frame has no depth")
    count = pair.prev.depth.size
    rng = np.random.default_rng(seed)
    chosen = np.zeros(0, np.intp)
    # all pixels are checked only where too many of a draw are invalid
    if count > 4 * points:
        chosen = _usable(pair, rng.choice(count, 2 * points, replace=False))
    if len(chosen) < points:
        chosen = _usable(pair, np.arange(count))
    if len(chosen) < MIN_SOLVER_POINTS:
        raise _too_few(pair, len(chosen))
    if len(chosen) > points:
        chosen = rng.choice(chosen, points, replace=False)
    camera = pair.prev.camera
    v, u = np.divmod(chosen, camera.width)
    xyz = backproject(pair.prev.depth, camera, np.stack([v, u], axis=-1))
    flow = pair.flow.reshape(-1, 2)[chosen].astype(np.float64)
    uv = flow + np.stack([u, v], axis=-1)
    return Correspondences(xyz, uv, largest_residual(pair, chosen))


def _usable(pair: FramePair, index: np.ndarray) -> np.ndarray:
    """Those of some pixels (flat index) that can be corresponding ones."""
    assert pair.flow is not None
    assert pair.prev.depth is not None
    camera = pair.prev.camera
    depth = pair.prev.depth.reshape(-1)
    index = index[depth_in_range(depth[index])]
    if pair.flow_valid is not None:
        index = index[pair.flow_valid.reshape(-1)[index]]
    flow = pair.flow.reshape(-1, 2)[index]
    v, u = np.divmod(index, camera.width)
    x = u + flow[:, 0]
    y = v + flow[:, 1]
    inside = (x > -0.5) & (x < camera.width - 0.5)
    inside &= (y > -0.5) & (y < camera.height - 0.5)
    return index[inside]


def _too_few(pair: FramePair, count: int) -> StageFailed:
    assert pair.flow is not None
    assert pair.prev.depth is not None
    if not depth_in_range(pair.prev.depth).any():
        reason = Reason.NO_VALID_DEPTH
    elif not np.isfinite(pair.flow).any():
        reason = Reason.NO_FLOW
    else:
        reason = Reason.LOW_INLIERS
    return StageFailed(
        reason,
        f"{count} pixels with valid depth (metres) and flow, need {MIN_SOLVER_POINTS}",
    )


def largest_residual(pair: FramePair, index: np.ndarray) -> float:
    """Return the largest residual of an inlier at some pixels, px.

    It is a multiple of the flow's noise. The noise is the median standard deviation
    that the flow states there (``flow_variance``, taken to be px^2); half a pixel
    where an estimated flow states none; zero where the flow is the ground truth.

    Args:
        pair: the frames, with flow.
        index: (N,) pixels, as indices into the flattened image.
    """
    variance = np.zeros(0)
    if pair.flow_variance is not None:
        variance = pair.flow_variance.reshape(-1)[index]
        variance = variance[np.isfinite(variance) & (variance >= 0)]
    if variance.size:
        std_px = float(np.sqrt(np.median(variance)))
    elif pair.flow_is_true:
        std_px = 0.0
    else:
        std_px = UNSTATED_FLOW_STD_PX
    return max(MIN_INLIER_PX, INLIER_STDS * std_px)


def depth_in_range(depth: np.ndarray) -> np.ndarray:
    """Return where depth can be metres; False for NaN, inf and what is not positive."""
    return (depth > MIN_DEPTH_M) & (depth < MAX_DEPTH_M)


def _images(pair: FramePair) -> Images:
    """Both images and depth maps, the current ones resampled to the previous K.

    Raises:
        StageFailed: where an image is missing, or has no valid depth.
    """
    camera = pair.prev.camera
    images = Images([], [])
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


# -- covariance
# --------------------------------------------------------------------------


def with_covariance(
    T: Any,
    data: Correspondences,
    camera: Camera,
    limit_px: float,
    sigma_px: float | None = None,
) -> RelativePose:
    """Check a solver's motion, and give it a covariance.

    The covariance is sigma^2 (J^T J)^-1 over the inliers.

    Args:
        T: (4, 4) T_curr_prev, or whatever a solver returned.
        data: the correspondences it was found from.
        camera: the current camera.
        limit_px: largest residual of an inlier.
        sigma_px: standard deviation of the flow; None: sigma^2 = |r|^2 / (2 n - 6).

    Returns:
        The motion with status, covariance and residual scale.

    Raises:
        StageFailed: where T is no rigid motion, or where its inliers are too few or
            leave a direction undetermined.
    """
    undetermined = "leave a direction of the motion undetermined"
    if _covariance_root(data.xyz, camera) is None:
        raise StageFailed(
            Reason.DEGENERATE_GEOMETRY, f"the {len(data.xyz)} points {undetermined}"
        )
    try:
        T = as_rigid(T, "T")
    except InputError:
        raise StageFailed(
            Reason.SOLVER_DIVERGED, "the solver found no finite rigid motion"
        ) from None
    moved = transform_points(T, data.xyz)
    # NaN behind the camera
    squared = ((project(moved, camera) - data.uv) ** 2).sum(axis=-1)
    inlier = (moved[:, 2] > MIN_DEPTH_M) & (squared < limit_px**2)
    count = int(inlier.sum())
    ratio = float(inlier.mean())
    if count < MIN_SOLVER_POINTS or ratio < MIN_CONSENSUS_RATIO:
        raise StageFailed(
            Reason.LOW_INLIERS,
            f"{count} of {len(inlier)} sampled pixels follow the motion "
            f"to {limit_px:.3g} px",
            inlier_ratio=ratio,
        )
    root = _covariance_root(moved[inlier], camera)
    if root is None:
        raise StageFailed(
            Reason.DEGENERATE_GEOMETRY,
            f"the {count} inliers {undetermined}",
            inlier_ratio=ratio,
        )
    cost = float(squared[inlier].sum())
    if sigma_px is None:
        sigma_px = float(np.sqrt(cost / (2 * count - 6)))
    return RelativePose(
        T_curr_prev=T,
        covariance=max(sigma_px, MIN_RESIDUAL_PX) ** 2 * (root @ root.T),
        cost=cost / len(inlier),
        residual_scale_px=sigma_px,
        inlier_ratio=ratio,
    )


def _covariance_root(points: np.ndarray, camera: Camera) -> np.ndarray | None:
    """B (6, 6) with (J^T J)^-1 = B B^T; None where J^T J is singular."""
    # metres in units of a typical depth: both halves of the tangent are then in
    # radians
    typical_depth = float(np.median(points[:, 2]))
    scale = np.repeat([typical_depth, 1.0], 3)
    J = np.concatenate(projection_rows(points, camera)) * scale
    values, vectors = np.linalg.eigh(J.T @ J)
    if values[0] <= SINGULAR_RATIO * values[-1]:
        return None
    return np.asarray(vectors * scale[:, None] / np.sqrt(values))
