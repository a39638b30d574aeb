"""Methods of other libraries, for comparison: point solvers of OpenCV and PoseLib, and the RGB-D
odometry of OpenCV and Open3D, which is what a user of an RGB-D camera would pick today.
"""

from __future__ import annotations

import contextlib
import importlib
from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import cv2
import numpy as np

from hybridvo.calibration import INLIER_STDS, MIN_INLIER_PX, UNSTATED_FLOW_STD_PX
from hybridvo.checks import as_rigid
from hybridvo.errors import InputError
from hybridvo.geometry import (
    backproject,
    make_transform,
    pose_matrix,
    project,
    projection_rows,
)
from hybridvo.results import Reason, RelativePose
from hybridvo.types import Camera, FramePair

# random valid pixels for a solver; all cost 50 times more for no accuracy
POINTS = 10_000
# correspondences and inliers: four always fit some pose, so they prove nothing
MIN_POINTS = 6
DEPTH_RANGE_M = (1e-6, 1e6)  # outside it squares leave the floating-point range
# below this share of the sampled pixels a consensus is chance: failed
MIN_INLIER_RATIO = 0.05
# of the information's eigenvalues; a patch of 20 px has 1e-9
SINGULAR_RATIO = 1e-10
DEFAULT_PX = 8.0  # OpenCV's own limit on the residual of an inlier
# of the tuned solvers; the defaults are 100 of OpenCV, 100 000 of PoseLib
MAX_ITERATIONS = 1000
CONFIDENCE = 0.999  # that one sample of the tuned solvers is free of outliers
TUNED: dict[str, Any] = {
    "iterationsCount": MAX_ITERATIONS,
    "confidence": CONFIDENCE,
}
FOUND_NOTHING = (cv2.error, ValueError, RuntimeError, ArithmeticError)
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


def missing(method: str) -> str:
    """Return why a method cannot run here and the remedy; empty where nothing is missing."""
    if method == "opencv-rgbd" and not hasattr(cv2, "Odometry"):
        return "cv2.Odometry came with OpenCV 5; pip install 'opencv-python-headless>=5'"
    if method not in NEEDED:
        return ""
    library, remedy = NEEDED[method]
    try:
        importlib.import_module(library)
    # not installed; or Open3D without its system libraries
    except ImportError as error:
        return f"{library} cannot be imported: {error}; {remedy}"
    return ""


# -- point solvers: correspondences, current camera, seed, largest residual -> T_curr_prev, or None


def solve_opencv(
    data: Correspondences,
    camera: Camera,
    seed: int,
    inlier_px: float,
    **options: Any,
) -> np.ndarray | None:
    """Call ``cv2.solvePnPRansac``; its generator is fixed."""
    found, rvec, tvec, _ = _pnp_ransac(data, camera, inlier_px, options)
    return _transform(rvec, tvec) if found else None


def solve_opencv_tuned(
    data: Correspondences, camera: Camera, seed: int, inlier_px: float
) -> np.ndarray | None:
    """Call ``cv2.solvePnPRansac`` with more samples, then Levenberg-Marquardt on the inliers."""
    found, rvec, tvec, inliers = _pnp_ransac(data, camera, inlier_px, TUNED)
    if not found:
        return None
    if inliers is not None and len(inliers) >= MIN_POINTS:
        xyz = data.xyz[inliers[:, 0]]
        uv = data.uv[inliers[:, 0]]
        rvec, tvec = cv2.solvePnPRefineLM(xyz, uv, camera.K, None, rvec, tvec)
    return _transform(rvec, tvec)


def _pnp_ransac(
    data: Correspondences, camera: Camera, inlier_px: float, options: dict[str, Any]
) -> Any:
    """(found, rvec, tvec, rows of the inliers or None)."""
    limit: Any = {"reprojectionError": inlier_px}
    return cv2.solvePnPRansac(data.xyz, data.uv, camera.K, None, **limit, **options)


def _transform(rvec: np.ndarray, tvec: np.ndarray) -> np.ndarray | None:
    """(4, 4) of OpenCV's rotation vector and translation; None where they are not finite."""
    if not np.isfinite(rvec).all() or not np.isfinite(tvec).all():
        return None
    return make_transform(cv2.Rodrigues(rvec)[0], tvec[:, 0])


def solve_poselib(
    data: Correspondences, camera: Camera, seed: int, inlier_px: float
) -> np.ndarray | None:
    """Call PoseLib's LO-RANSAC, bundle adjustment included."""
    import poselib

    fx, fy, cx, cy, height, width = vars(camera).values()
    model = {
        "model": "PINHOLE",
        "width": width,
        "height": height,
        "params": [fx, fy, cx, cy],
    }
    options = {
        "max_reproj_error": inlier_px,
        # its default of at least 1000 takes three times as long and is no more accurate here
        "min_iterations": 100,
        "max_iterations": MAX_ITERATIONS,
        "success_prob": CONFIDENCE,
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
FIXED_PX = {"pnp-ransac": DEFAULT_PX}
"""Largest residual of an inlier of the solvers for which it does not follow the flow's noise."""


# -- RGB-D odometry: images, depths or NaN, camera, largest depth in m -> T_curr_prev, or None -----


def align_opencv(
    rgb: list[np.ndarray], depth: list[np.ndarray], camera: Camera, deepest: float
) -> np.ndarray | None:
    """Call OpenCV 5's ``cv2.Odometry`` with image and depth."""
    settings = cv2.OdometrySettings()
    settings.setCameraMatrix(camera.K.astype(np.float32))
    settings.setMinDepth(1e-3)
    settings.setMaxDepth(deepest)
    odometry = cv2.Odometry(
        cv2.ODOMETRY_TYPE_RGB_DEPTH, settings, cv2.ODOMETRY_ALGO_TYPE_COMMON
    )
    found, T = odometry.compute(depth[0], rgb[0], depth[1], rgb[1])
    return np.asarray(T, dtype=np.float64) if found else None


def align_open3d(
    rgb: list[np.ndarray], depth: list[np.ndarray], camera: Camera, deepest: float
) -> np.ndarray | None:
    """Call Open3D's ``compute_rgbd_odometry`` with the hybrid term."""
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
    term = odometry.RGBDOdometryJacobianFromHybridTerm()
    option = odometry.OdometryOption()
    option.depth_max = deepest
    found, T, _ = odometry.compute_rgbd_odometry(
        *images, pinhole, np.eye(4), term, option
    )
    return np.asarray(T, dtype=np.float64) if found else None


Aligner = Callable[
    [list[np.ndarray], list[np.ndarray], Camera, float], np.ndarray | None
]
ALIGNERS: dict[str, Aligner] = {
    "opencv-rgbd": align_opencv,
    "open3d-rgbd": align_open3d,
}
METHODS = (*SOLVERS, *ALIGNERS)


# -- what is the same for all ----------------------------------------------------------------------


def estimate(
    method: str, pair: FramePair, seed: int = 0, inlier_px: float | None = None
) -> RelativePose:
    """Estimate the motion of a pair by one of :data:`METHODS`.

    Args:
        method: a name of :data:`METHODS`.
        pair: the frames, with flow for the point solvers.
        seed: of the sampled pixels, and of PoseLib.
        inlier_px: largest residual of an inlier of a point solver, px. None: OpenCV's default for
            ``pnp-ransac``, by the noise that the flow states for the others.

    Returns:
        The motion; failed where the data determine none.
    """
    if method in ALIGNERS:
        return _by_images(ALIGNERS[method], pair, seed)
    data = sample(pair, seed)
    if isinstance(data, RelativePose):
        return data
    if inlier_px is None:
        inlier_px = FIXED_PX.get(method, data.inlier_px)
    T = None
    with contextlib.suppress(*FOUND_NOTHING):
        T = SOLVERS[method](data, pair.curr.camera, seed, inlier_px)
    return check(T, data, pair.curr.camera, inlier_px)


def sample(
    pair: FramePair, seed: int, points: int = POINTS
) -> Correspondences | RelativePose:
    """Draw random valid pixels; returns the failure where there are fewer than six."""
    camera = pair.prev.camera
    depth = pair.prev.depth
    if pair.flow is None:
        return RelativePose.failed(Reason.NO_FLOW, "the pair has no flow")
    if depth is None:
        return RelativePose.failed(
            Reason.NO_VALID_DEPTH, "the previous frame has no depth"
        )
    rows = depth.reshape(-1)
    flow = pair.flow.reshape(-1, 2)
    rng = np.random.default_rng(seed)

    def usable(index: np.ndarray) -> np.ndarray:
        index = index[depth_valid(rows[index])]
        if pair.flow_valid is not None:
            index = index[pair.flow_valid.reshape(-1)[index]]
        v, u = np.divmod(index, camera.width)
        x = u + flow[index, 0]
        y = v + flow[index, 1]
        inside = (x > -0.5) & (x < camera.width - 0.5)
        inside &= (y > -0.5) & (y < camera.height - 0.5)
        return index[inside]

    keep = np.zeros(0, np.intp)
    # only where too many of a draw are invalid is all of it looked at
    if rows.size > 4 * points:
        keep = usable(rng.choice(rows.size, 2 * points, replace=False))
    if len(keep) < points:
        keep = usable(np.arange(rows.size))
    if len(keep) < MIN_POINTS:
        reason = Reason.LOW_INLIERS if np.isfinite(flow).any() else Reason.NO_FLOW
        if not depth_valid(depth).any():
            reason = Reason.NO_VALID_DEPTH
        what = f"{len(keep)} pixels with valid depth (metres) and flow, need {MIN_POINTS}"
        return RelativePose.failed(reason, what)
    if len(keep) > points:
        keep = rng.choice(keep, points, replace=False)
    v, u = np.divmod(keep, camera.width)
    xyz = backproject(depth, camera, np.stack([v, u], axis=-1))
    uv = flow[keep].astype(np.float64) + np.stack([u, v], axis=-1)
    return Correspondences(xyz, uv, largest_residual(pair, keep))


def largest_residual(pair: FramePair, index: np.ndarray) -> float:
    """Return the largest residual of an inlier at some pixels (flat index), px.

    It is a multiple of the flow's noise: the median standard deviation that the flow states there
    (``flow_variance``, taken to be px^2); half a pixel where an estimated flow states none; none
    where the flow is the truth.
    """
    if pair.flow_variance is not None:
        variance = pair.flow_variance.reshape(-1)[index]
        variance = variance[np.isfinite(variance) & (variance >= 0)]
    else:
        variance = np.zeros(0)
    if variance.size:
        std_px = float(np.sqrt(np.median(variance)))
    else:
        std_px = 0.0 if pair.flow_is_true else UNSTATED_FLOW_STD_PX
    return max(MIN_INLIER_PX, INLIER_STDS * std_px)


def depth_valid(depth: np.ndarray) -> np.ndarray:
    """Return where depth can be metres: False for NaN, inf, zero and negative values."""
    return (depth > DEPTH_RANGE_M[0]) & (depth < DEPTH_RANGE_M[1])


def check(
    T: Any,
    data: Correspondences,
    camera: Camera,
    limit_px: float,
    sigma_px: float | None = None,
) -> RelativePose:
    """Give a solver's motion a covariance; it failed unless inliers determine all six directions.

    The covariance is sigma^2 (J^T J)^-1 over the inliers, sigma^2 = |r|^2 / (2 n - 6) unless given.
    """
    failed = RelativePose.failed
    loose = "leave a direction of the motion undetermined"
    if _information(data.xyz, camera) is None:
        return failed(
            Reason.DEGENERATE_GEOMETRY, f"the {len(data.xyz)} points {loose}"
        )
    try:
        T = as_rigid(T, "T")
    except InputError:
        return failed(
            Reason.SOLVER_DIVERGED, "the solver found no finite rigid motion"
        )
    moved = data.xyz @ T[:3, :3].T + T[:3, 3]
    # NaN behind the camera
    squared = ((project(moved, camera) - data.uv) ** 2).sum(axis=-1)
    inlier = (moved[:, 2] > DEPTH_RANGE_M[0]) & (squared < limit_px**2)
    count = int(inlier.sum())
    ratio = float(inlier.mean())
    if count < MIN_POINTS or ratio < MIN_INLIER_RATIO:
        near = f"follow the motion to {limit_px:.3g} px"
        what = f"{count} of {len(inlier)} sampled pixels {near}"
        return failed(Reason.LOW_INLIERS, what, inlier_ratio=ratio)
    half = _information(moved[inlier], camera)
    if half is None:
        what = f"the {count} inliers {loose}"
        return failed(Reason.DEGENERATE_GEOMETRY, what, inlier_ratio=ratio)
    cost = float(squared[inlier].sum())
    sigma = np.sqrt(cost / (2 * count - 6)) if sigma_px is None else sigma_px
    return RelativePose(
        T_curr_prev=T,
        # exact data has no residual; float32 flow near 1000 px is rounded at 6e-5 px all the same
        covariance=max(sigma, 1e-4) ** 2 * (half @ half.T),
        cost=cost / len(inlier),
        residual_scale_px=float(sigma),
        inlier_ratio=ratio,
    )


def _information(points: np.ndarray, camera: Camera) -> np.ndarray | None:
    """B with (J^T J)^-1 = B B^T, None where that is singular."""
    # metres in typical depths: both halves of the tangent are then in radians
    scale = np.repeat([float(np.median(points[:, 2])), 1.0], 3)
    J = np.concatenate(projection_rows(points, camera)) * scale
    values, vectors = np.linalg.eigh(J.T @ J)
    if values[0] <= SINGULAR_RATIO * values[-1]:
        return None
    return np.asarray(vectors * scale[:, None] / np.sqrt(values))


def _by_images(align: Aligner, pair: FramePair, seed: int) -> RelativePose:
    """Motion by images and depths alone; flow serves only to check it and for its covariance."""
    images = _prepared(pair)
    if isinstance(images, RelativePose):
        return images
    rgb, depth = images
    T = None
    with contextlib.suppress(*FOUND_NOTHING):
        T = align(rgb, depth, pair.prev.camera, float(np.nanmax(depth[0])) + 1.0)
    # both libraries chain small updates into not quite a rotation
    T = pose_matrix(T[:3]) if T is not None and np.isfinite(T).all() else None
    camera = pair.curr.camera
    sigma_px = None
    data = sample(pair, seed)
    # without flow: that of the motion itself, known to a pixel
    if isinstance(data, RelativePose):
        still = FramePair(
            pair.prev, pair.curr, np.zeros((*camera.shape, 2), np.float32)
        )
        data = sample(still, seed)
        sigma_px = 1.0
        if isinstance(data, RelativePose):
            return data
        if T is not None:
            uv = project(data.xyz @ T[:3, :3].T + T[:3, 3], camera)
            data = Correspondences(data.xyz, uv)
    # the limit is wide, for these methods never saw the flow
    return check(T, data, camera, DEFAULT_PX, sigma_px)


def _prepared(
    pair: FramePair,
) -> tuple[list[np.ndarray], list[np.ndarray]] | RelativePose:
    """Both images and their depths, the current ones resampled to the previous K."""
    camera = pair.prev.camera
    images: list[np.ndarray] = []
    depths: list[np.ndarray] = []
    for name, frame in (("previous", pair.prev), ("current", pair.curr)):
        rgb = frame.rgb
        depth = frame.depth
        if rgb is None:
            what = "this method aligns images: none is there"
            return RelativePose.failed(Reason.MISSING_FRAME, what)
        if depth is None or not depth_valid(depth).any():
            what = f"the {name} frame has no valid depth"
            return RelativePose.failed(Reason.NO_VALID_DEPTH, what)
        depth = np.where(depth_valid(depth), depth, np.nan).astype(np.float32)
        if not np.allclose(camera.K, frame.camera.K):
            A = (camera.K @ np.linalg.inv(frame.camera.K))[:2]
            size = camera.shape[::-1]
            nearest: Any = {"flags": cv2.INTER_NEAREST, "borderValue": np.nan}
            rgb = cv2.warpAffine(rgb, A, size)
            depth = cv2.warpAffine(depth, A, size, **nearest)
        images.append(rgb)
        depths.append(depth)
    return images, depths
