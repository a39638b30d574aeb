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

from hybridvo.errors import InputError
from hybridvo.geometry import backproject, make_transform, pose_matrix, project, projection_rows
from hybridvo.results import Reason, RelativePose
from hybridvo.types import Camera, FramePair, as_rigid

POINTS = 10_000  # random valid pixels for a solver; all cost 50 times more for no accuracy
MIN_POINTS = 6  # correspondences and inliers: four always fit some pose, so they prove nothing
DEPTH_RANGE_M = (1e-6, 1e6)  # outside it squares leave the floating-point range
MIN_INLIER_RATIO = 0.05  # below this share of the sampled pixels a consensus is chance: failed
SINGULAR_RATIO = 1e-10  # of the information's eigenvalues; a patch of 20 px has 1e-9
TUNED_PX, DEFAULT_PX = 2.0, 8.0  # residual of an inlier: of the tuned solvers, OpenCV's default
TUNED: Any = {"iterationsCount": 1000, "reprojectionError": TUNED_PX, "confidence": 0.999}
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


def missing(method: str) -> str:
    """Return why a method cannot run here and the remedy; empty where nothing is missing."""
    if method == "opencv-rgbd" and not hasattr(cv2, "Odometry"):
        return "cv2.Odometry came with OpenCV 5; pip install 'opencv-python-headless>=5'"
    if method not in NEEDED:
        return ""
    library, remedy = NEEDED[method]
    try:
        importlib.import_module(library)
    except ImportError as error:  # not installed; or Open3D without its system libraries
        return f"{library} cannot be imported: {error}; {remedy}"
    return ""


# -- point solvers: correspondences, current camera, seed -> (4, 4) T_curr_prev, or None -----------


def solve_opencv(
    data: Correspondences, camera: Camera, seed: int, *, polish: bool = False, **options: Any
) -> np.ndarray | None:
    """Call ``cv2.solvePnPRansac``, then LM on the inliers (``polish``); its generator is fixed."""
    found, rvec, tvec, inliers = cv2.solvePnPRansac(data.xyz, data.uv, camera.K, None, **options)
    if polish and found and inliers is not None and len(inliers) >= MIN_POINTS:
        xyz, uv = data.xyz[inliers[:, 0]], data.uv[inliers[:, 0]]
        rvec, tvec = cv2.solvePnPRefineLM(xyz, uv, camera.K, None, rvec, tvec)
    if not found or not np.isfinite(rvec).all() or not np.isfinite(tvec).all():
        return None
    return make_transform(cv2.Rodrigues(rvec)[0], tvec[:, 0])


def solve_poselib(data: Correspondences, camera: Camera, seed: int) -> np.ndarray | None:
    """Call PoseLib's LO-RANSAC, bundle adjustment included."""
    import poselib

    fx, fy, cx, cy, height, width = vars(camera).values()
    model = {"model": "PINHOLE", "width": width, "height": height, "params": [fx, fy, cx, cy]}
    options = {
        "max_reproj_error": TUNED_PX,
        # its default of at least 1000 takes three times as long and is no more accurate here
        "min_iterations": 100,
        "max_iterations": TUNED["iterationsCount"],
        "success_prob": TUNED["confidence"],
        "seed": seed,
    }
    pose, _ = poselib.estimate_absolute_pose(data.uv, data.xyz, model, options, {})
    return make_transform(np.asarray(pose.R), np.asarray(pose.t))


Solver = Callable[[Correspondences, Camera, int], np.ndarray | None]
SOLVERS: dict[str, tuple[Solver, float]] = {
    "pnp-ransac": (solve_opencv, DEFAULT_PX),
    "pnp-ransac-tuned": (partial(solve_opencv, polish=True, **TUNED), TUNED_PX),
    "usac-magsac": (partial(solve_opencv, flags=cv2.USAC_MAGSAC, **TUNED), TUNED_PX),
    "poselib": (solve_poselib, TUNED_PX),
}
"""The solver of each method, and the largest residual of an inlier, px."""


# -- RGB-D odometry: images, depths or NaN, camera, largest depth in m -> T_curr_prev, or None -----


def align_opencv(
    rgb: list[np.ndarray], depth: list[np.ndarray], camera: Camera, deepest: float
) -> np.ndarray | None:
    """Call OpenCV 5's ``cv2.Odometry`` with image and depth."""
    settings = cv2.OdometrySettings()
    settings.setCameraMatrix(camera.K.astype(np.float32))
    settings.setMinDepth(1e-3)
    settings.setMaxDepth(deepest)
    odometry = cv2.Odometry(cv2.ODOMETRY_TYPE_RGB_DEPTH, settings, cv2.ODOMETRY_ALGO_TYPE_COMMON)
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
    option, term = odometry.OdometryOption(), odometry.RGBDOdometryJacobianFromHybridTerm()
    option.depth_max = deepest
    found, T, _ = odometry.compute_rgbd_odometry(*images, pinhole, np.eye(4), term, option)
    return np.asarray(T, dtype=np.float64) if found else None


Aligner = Callable[[list[np.ndarray], list[np.ndarray], Camera, float], np.ndarray | None]
ALIGNERS: dict[str, Aligner] = {"opencv-rgbd": align_opencv, "open3d-rgbd": align_open3d}
METHODS = (*SOLVERS, *ALIGNERS)


# -- what is the same for all ----------------------------------------------------------------------


def estimate(method: str, pair: FramePair, seed: int = 0) -> RelativePose:
    """Estimate the motion of a pair by one of :data:`METHODS`."""
    if method in ALIGNERS:
        return _by_images(ALIGNERS[method], pair, seed)
    solve, limit_px = SOLVERS[method]
    data, T = sample(pair, seed), None
    if isinstance(data, RelativePose):
        return data
    with contextlib.suppress(*FOUND_NOTHING):
        T = solve(data, pair.curr.camera, seed)
    return check(T, data, pair.curr.camera, limit_px)


def sample(pair: FramePair, seed: int, points: int = POINTS) -> Correspondences | RelativePose:
    """Draw random valid pixels; returns the failure where there are fewer than six."""
    depth, flow, camera = pair.prev.depth, pair.flow, pair.prev.camera
    if flow is None:
        return RelativePose.failed(Reason.NO_FLOW, "the pair has no flow")
    if depth is None:
        return RelativePose.failed(Reason.NO_VALID_DEPTH, "the previous frame has no depth")
    rows, flow = depth.reshape(-1), flow.reshape(-1, 2)
    rng = np.random.default_rng(seed)

    def usable(index: np.ndarray) -> np.ndarray:
        index = index[depth_valid(rows[index])]
        if pair.flow_valid is not None:
            index = index[pair.flow_valid.reshape(-1)[index]]
        v, u = np.divmod(index, camera.width)
        x, y = u + flow[index, 0], v + flow[index, 1]
        inside = (x > -0.5) & (x < camera.width - 0.5) & (y > -0.5) & (y < camera.height - 0.5)
        return index[inside]

    keep = np.zeros(0, np.intp)
    if rows.size > 4 * points:  # only where too many of a draw are invalid is all of it looked at
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
    return Correspondences(xyz, flow[keep].astype(np.float64) + np.stack([u, v], axis=-1))


def depth_valid(depth: np.ndarray) -> np.ndarray:
    """Return where depth can be metres: False for NaN, inf, zero and negative values."""
    return (depth > DEPTH_RANGE_M[0]) & (depth < DEPTH_RANGE_M[1])


def check(
    T: Any, data: Correspondences, camera: Camera, limit_px: float, sigma_px: float | None = None
) -> RelativePose:
    """Give a solver's motion a covariance; it failed unless inliers determine all six directions.

    The covariance is sigma^2 (J^T J)^-1 over the inliers, sigma^2 = |r|^2 / (2 n - 6) unless given.
    """
    failed, loose = RelativePose.failed, "leave a direction of the motion undetermined"
    if _information(data.xyz, camera) is None:
        return failed(Reason.DEGENERATE_GEOMETRY, f"the {len(data.xyz)} points {loose}")
    try:
        T = as_rigid(T, "T")
    except InputError:
        return failed(Reason.SOLVER_DIVERGED, "the solver found no finite rigid motion")
    moved = data.xyz @ T[:3, :3].T + T[:3, 3]
    squared = ((project(moved, camera) - data.uv) ** 2).sum(axis=-1)  # NaN behind the camera
    inlier = (moved[:, 2] > DEPTH_RANGE_M[0]) & (squared < limit_px**2)
    count, ratio = int(inlier.sum()), float(inlier.mean())
    if count < MIN_POINTS or ratio < MIN_INLIER_RATIO:
        what = f"{count} of {len(inlier)} sampled pixels follow the motion"
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
    images, T = _prepared(pair), None
    if isinstance(images, RelativePose):
        return images
    rgb, depth = images
    with contextlib.suppress(*FOUND_NOTHING):
        T = align(rgb, depth, pair.prev.camera, float(np.nanmax(depth[0])) + 1.0)
    # both libraries chain small updates into not quite a rotation
    T = pose_matrix(T[:3]) if T is not None and np.isfinite(T).all() else None
    camera, sigma_px = pair.curr.camera, None
    data = sample(pair, seed)
    if isinstance(data, RelativePose):  # without flow: that of the motion itself, known to a pixel
        still = FramePair(pair.prev, pair.curr, np.zeros((*camera.shape, 2), np.float32))
        data, sigma_px = sample(still, seed), 1.0
        if isinstance(data, RelativePose):
            return data
        if T is not None:
            uv = project(data.xyz @ T[:3, :3].T + T[:3, 3], camera)
            data = Correspondences(data.xyz, uv)
    # the limit is wide, for these methods never saw the flow
    return check(T, data, camera, DEFAULT_PX, sigma_px)


def _prepared(pair: FramePair) -> tuple[list[np.ndarray], list[np.ndarray]] | RelativePose:
    """Both images and their depths, the current ones resampled to the previous K."""
    camera, images, depths = pair.prev.camera, list[np.ndarray](), list[np.ndarray]()
    for name, frame in (("previous", pair.prev), ("current", pair.curr)):
        rgb, depth = frame.rgb, frame.depth
        if rgb is None:
            what = "this method aligns images: none is there"
            return RelativePose.failed(Reason.MISSING_FRAME, what)
        if depth is None or not depth_valid(depth).any():
            what = f"the {name} frame has no valid depth"
            return RelativePose.failed(Reason.NO_VALID_DEPTH, what)
        depth = np.where(depth_valid(depth), depth, np.nan).astype(np.float32)
        if not np.allclose(camera.K, frame.camera.K):
            A, size = (camera.K @ np.linalg.inv(frame.camera.K))[:2], camera.shape[::-1]
            nearest: Any = {"flags": cv2.INTER_NEAREST, "borderValue": np.nan}
            rgb, depth = cv2.warpAffine(rgb, A, size), cv2.warpAffine(depth, A, size, **nearest)
        images.append(rgb)
        depths.append(depth)
    return images, depths
