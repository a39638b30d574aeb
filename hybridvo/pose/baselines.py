"""The estimators that others use today, behind one signature, with their answers checked.

Every estimator is called as ``estimator(pair, seed=0)`` and returns a
:class:`~hybridvo.types.RelativePose`. 3-D points come from the previous depth and ``K_prev``, 2-D
points from the flow, seen by ``K_curr``. A solver's own "success" is not believed: the answer must
be finite, keep its inliers in front of the camera, have enough of them, and they must determine all
six degrees of freedom. Bad data gives a failed status, never an exception and never NaN.
"""

from __future__ import annotations

import importlib.util
import time
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

import cv2
import numpy as np

from hybridvo.errors import InputError
from hybridvo.geometry import make_transform
from hybridvo.types import Camera, FramePair, Reason, RelativePose, Status

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

POINTS = 10_000
"""Random valid pixels handed to a sparse solver; all pixels cost 50 times more for no accuracy."""

MIN_POINTS = 6
"""Fewest correspondences and inliers: four always fit some pose, so they prove nothing."""

DEPTH_RANGE_M = (1e-6, 1e6)
"""Open interval of depths that can be metres; outside it squares leave the floating-point range."""

MIN_INLIER_RATIO = 0.05
"""Below this share of the sampled pixels a consensus is chance: failed."""

DOUBTFUL_INLIER_RATIO = 0.25
"""Below this share the largest motion need not be the camera's: degraded."""

SINGULAR_RATIO = 1e-10
"""Eigenvalue ratio of the scaled information at which a direction is free: failed."""

WEAK_RATIO = 1e-6
"""Eigenvalue ratio below which a direction is weak: degraded. A frontal plane over a field of view
of 20 degrees has 1e-4, a patch of 20 px at fx = 1000 has 1e-9."""

_IDENTITY_COVARIANCE = np.diag([1.0] * 3 + [0.1] * 3)
_NO_DISTORTION = np.zeros(4)


@dataclass(frozen=True, eq=False)
class _Points:
    """Sampled correspondences: (n, 3) metres in the previous camera, (n, 2) px in the current."""

    xyz: np.ndarray
    uv: np.ndarray


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

    def solve(data: _Points, camera: Camera, seed: int) -> np.ndarray | None:
        found, rvec, tvec, _ = cv2.solvePnPRansac(data.xyz, data.uv, camera.K, _NO_DISTORTION)
        return _opencv_pose(found, rvec, tvec)

    return _sparse("pnp-ransac", solve, pair, seed, points, threshold_px=8.0)


def pnp_ransac_tuned(pair: FramePair, *, seed: int = 0, points: int = POINTS) -> RelativePose:
    """``cv2.solvePnPRansac`` at 2 px, 1000 iterations, 0.999, then LM on the inliers.

    Args, returns and raises as :func:`pnp_ransac`.
    """

    def solve(data: _Points, camera: Camera, seed: int) -> np.ndarray | None:
        found, rvec, tvec, inliers = cv2.solvePnPRansac(
            data.xyz,
            data.uv,
            camera.K,
            _NO_DISTORTION,
            iterationsCount=1000,
            reprojectionError=2.0,
            confidence=0.999,
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

    def solve(data: _Points, camera: Camera, seed: int) -> np.ndarray | None:
        found, rvec, tvec, _ = cv2.solvePnPRansac(
            data.xyz,
            data.uv,
            camera.K,
            _NO_DISTORTION,
            iterationsCount=1000,
            reprojectionError=2.0,
            confidence=0.999,
            flags=cv2.USAC_MAGSAC,
        )
        return _opencv_pose(found, rvec, tvec)

    return _sparse("usac-magsac", solve, pair, seed, points)


def poselib(pair: FramePair, *, seed: int = 0, points: int = POINTS) -> RelativePose:
    """PoseLib's LO-RANSAC at 2 px with its default iterations, bundle adjustment included.

    PoseLib takes one camera, that of the 2-D points: ``K_curr``.

    Args, returns and raises as :func:`pnp_ransac`.

    Raises:
        InputError: PoseLib is not installed.
    """
    try:
        import poselib as library
    except ImportError:
        raise InputError(f"poselib: {missing().get('poselib', 'cannot be imported')}.") from None

    def solve(data: _Points, camera: Camera, seed: int) -> np.ndarray | None:
        model = {
            "model": "PINHOLE",
            "width": camera.width,
            "height": camera.height,
            "params": [camera.fx, camera.fy, camera.cx, camera.cy],
        }
        options = {"max_reproj_error": 2.0, "seed": seed}
        pose, _ = library.estimate_absolute_pose(data.uv, data.xyz, model, options, {})
        return make_transform(np.asarray(pose.R), np.asarray(pose.t))

    return _sparse("poselib", solve, pair, seed, points)


def identity(pair: FramePair, *, seed: int = 0) -> RelativePose:
    """The zero-motion predictor: the floor every method must beat.

    Its covariance is a fixed prior of 1 m and 0.3 rad a step; nothing of the pair is read.
    """
    _check_arguments("identity", pair, seed, MIN_POINTS)
    return RelativePose(covariance=_IDENTITY_COVARIANCE.copy(), method="identity")


def opencv_rgbd(pair: FramePair, *, seed: int = 0) -> RelativePose:
    """OpenCV 5's dense RGB-D odometry (``cv2.Odometry``, ``RGB_DEPTH``); reads both RGB-D frames.

    OpenCV takes one K, so the current frame is resampled to ``K_prev`` where the two differ. Depth
    limits are opened to those of the frames (its default is 4 m). Covariance: see
    :func:`open3d_rgbd`.

    Raises:
        InputError: this OpenCV has no ``cv2.Odometry``, or ``pair`` is no FramePair.
    """
    if not hasattr(cv2, "Odometry"):
        raise InputError(f"opencv-rgbd: {missing()['opencv-rgbd']}.")

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

    Raises:
        InputError: Open3D is not installed, or ``pair`` is no FramePair.
    """
    try:
        import open3d
    except ImportError:
        raise InputError(f"open3d-rgbd: {missing()['open3d-rgbd']}.") from None

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
    if importlib.util.find_spec("poselib") is None:
        absent["poselib"] = "PoseLib is not installed; pip install 'hybridvo[baselines]'"
    if not hasattr(cv2, "Odometry"):
        absent["opencv-rgbd"] = (
            f"OpenCV {cv2.__version__} has no cv2.Odometry; pip install 'opencv-python-headless>=5'"
        )
    if importlib.util.find_spec("open3d") is None:
        absent["open3d-rgbd"] = "Open3D is not installed; pip install open3d"
    return absent


def _check_arguments(method: str, pair: FramePair, seed: int, points: int) -> None:
    if not isinstance(pair, FramePair):
        raise InputError(f"{method}: expected a FramePair, got {type(pair).__name__}.")
    for name, value, low in (("seed", seed, 0), ("points", points, MIN_POINTS)):
        if isinstance(value, bool) or not isinstance(value, int | np.integer) or value < low:
            raise InputError(f"{method}: {name}: expected an integer >= {low}, got {value!r}.")


def _sparse(
    method: str,
    solve: Callable[[_Points, Camera, int], np.ndarray | None],
    pair: FramePair,
    seed: int,
    points: int,
    threshold_px: float = 2.0,
) -> RelativePose:
    """Sample, solve, check: what all point solvers share."""
    start = time.perf_counter()
    _check_arguments(method, pair, seed, points)
    sampled = _sample(pair, points, int(seed))
    if isinstance(sampled, Status):
        result = RelativePose.failed(sampled.reason, sampled.message, method)
    else:
        T = _attempt(partial(solve, sampled, pair.curr.camera, int(seed) % 2**31))
        result = _checked(method, T, sampled, pair.curr.camera, threshold_px)
    return result.replace(ms=1e3 * (time.perf_counter() - start))


def _attempt(solve: Callable[[], np.ndarray | None]) -> np.ndarray | None:
    """The solver's pose, or None where it raises on the data (cv2.error: singular systems)."""
    try:
        return solve()
    except (cv2.error, ValueError, RuntimeError, ArithmeticError):
        return None


def _opencv_pose(found: bool, rvec: np.ndarray, tvec: np.ndarray) -> np.ndarray | None:
    if not found or not np.isfinite(rvec).all() or not np.isfinite(tvec).all():
        return None
    return make_transform(cv2.Rodrigues(rvec)[0], tvec[:, 0])


def _sample(pair: FramePair, points: int, seed: int) -> _Points | Status:
    """Random valid pixels as correspondences, or the reason why there are too few.

    Candidates are drawn first and checked after, so that a large image is not read as a whole for
    ten thousand of its pixels; only where too many of them are invalid is the full mask made.
    """
    if pair.flow is None:
        return Status.failed(Reason.NO_FLOW, "the pair has no flow")
    depth = None if pair.prev.depth is None else pair.prev.depth.reshape(-1)
    if depth is None:
        return Status.failed(Reason.NO_VALID_DEPTH, "the previous frame has no depth")
    rng = np.random.default_rng(seed)
    candidates = np.arange(depth.size)
    if depth.size > 4 * points:
        candidates = rng.choice(depth.size, 2 * points, replace=False)
    keep = _usable(pair, candidates)
    if len(keep) < points and len(candidates) < depth.size:
        keep = _usable(pair, np.arange(depth.size))
    if len(keep) < MIN_POINTS:
        return _why_empty(pair, len(keep))
    if len(keep) > points:
        keep = rng.choice(keep, points, replace=False)
    z, flow = depth[keep].astype(np.float64), pair.flow.reshape(-1, 2)[keep].astype(np.float64)
    v, u = np.divmod(keep, pair.prev.camera.width)
    return _Points(_rays(u, v, pair.prev.camera) * z[:, None], flow + np.stack([u, v], axis=-1))


def _rays(u: np.ndarray, v: np.ndarray, camera: Camera) -> np.ndarray:
    return np.stack(
        [(u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy, np.ones(len(u))], axis=-1
    )


def _depth_valid(depth: np.ndarray) -> np.ndarray:
    return (depth > DEPTH_RANGE_M[0]) & (depth < DEPTH_RANGE_M[1])


def _usable(pair: FramePair, index: np.ndarray) -> np.ndarray:
    """Flat pixel indices with valid depth and a finite flow that ends inside the current image."""
    camera = pair.prev.camera
    depth, flow = pair.prev.depth, pair.flow
    if depth is None or flow is None:
        return index[:0]
    index = index[_depth_valid(depth.reshape(-1)[index])]
    for mask in (pair.prev.mask, pair.flow_valid):
        if mask is not None:
            index = index[mask.reshape(-1)[index]]
    end = flow.reshape(-1, 2)[index]
    v, u = np.divmod(index, camera.width)
    x, y = u + end[:, 0], v + end[:, 1]
    inside = (x > -0.5) & (x < camera.width - 0.5) & (y > -0.5) & (y < camera.height - 0.5)
    return index[inside]


def _why_empty(pair: FramePair, count: int) -> Status:
    """Status for fewer than MIN_POINTS correspondences, by the input that is to blame."""
    if pair.prev.depth is None or not _depth_valid(pair.prev.depth).any():
        return Status.failed(
            Reason.NO_VALID_DEPTH, "the previous depth has no finite positive value (metres)"
        )
    if pair.flow is None or not np.isfinite(pair.flow).all(axis=-1).any():
        return Status.failed(Reason.NO_FLOW, "the flow has no finite value")
    return Status.failed(
        Reason.LOW_INLIERS, f"{count} pixels with valid depth and flow, need {MIN_POINTS}"
    )


def _checked(
    method: str,
    T: np.ndarray | None,
    data: _Points,
    camera: Camera,
    threshold_px: float,
    sigma_px: float | None = None,
) -> RelativePose:
    """The solver's answer after the checks, with covariance and status.

    Inliers are counted again: in front of the camera after the motion and within ``threshold_px``.
    Covariance sigma^2 (J^T J)^-1 over them, sigma^2 = |r|^2 / (2 n - 6) unless ``sigma_px`` is
    given, J by the left perturbation, translation first.
    """
    if T is None or not _is_rigid(T):
        return RelativePose.failed(
            Reason.SOLVER_DIVERGED, f"{method}: the solver found no finite rigid motion", method
        )
    moved = data.xyz @ T[:3, :3].T + T[:3, 3]
    front = moved[:, 2] > DEPTH_RANGE_M[0]
    z = np.where(front, moved[:, 2], 1.0)
    x, y = moved[:, 0] / z, moved[:, 1] / z
    residual = np.stack([camera.fx * x + camera.cx, camera.fy * y + camera.cy], -1) - data.uv
    squared = (residual**2).sum(axis=-1)
    inlier = front & (squared < threshold_px**2)
    count = int(inlier.sum())
    ratio = count / len(inlier)
    if count < MIN_POINTS or ratio < MIN_INLIER_RATIO:
        message = f"{method}: {count} of {len(inlier)} sampled pixels follow the motion"
        return RelativePose.failed(Reason.LOW_INLIERS, message, method, inlier_ratio=ratio)

    x, y, z = x[inlier], y[inlier], z[inlier]
    zero = np.zeros_like(x)
    J = np.concatenate(
        [
            camera.fx * np.stack([1 / z, zero, -x / z, -x * y, 1 + x * x, -y], axis=-1),
            camera.fy * np.stack([zero, 1 / z, -y / z, -1 - y * y, x * y, x], axis=-1),
        ]
    )
    # metres in units of the typical depth: both halves of the tangent are then in radians
    scale = np.array([float(np.median(z))] * 3 + [1.0] * 3)
    information = (J * scale).T @ (J * scale)
    values, vectors = np.linalg.eigh(information)
    if values[0] <= SINGULAR_RATIO * values[-1]:
        message = f"{method}: the {count} inliers leave a direction of the motion undetermined"
        return RelativePose.failed(
            Reason.DEGENERATE_GEOMETRY,
            message,
            method,
            inlier_ratio=ratio,
            information_eigenvalues=np.maximum(values, 0.0),
        )
    status = Status()
    if values[0] <= WEAK_RATIO * values[-1]:
        status = Status.degraded(
            Reason.DEGENERATE_GEOMETRY, f"{method}: a direction of the motion is barely determined"
        )
    elif ratio < DOUBTFUL_INLIER_RATIO:
        status = Status.degraded(
            Reason.LOW_INLIERS, f"{method}: only {ratio:.0%} of the pixels follow the motion"
        )
    cost = float(squared[inlier].sum())
    sigma = np.sqrt(cost / (2 * count - 6)) if sigma_px is None else sigma_px
    half = vectors * scale[:, None] / np.sqrt(values)
    # exact data has no residual; float32 flow near 1000 px is rounded at 6e-5 px all the same
    covariance = max(sigma, 1e-4) ** 2 * (half @ half.T)
    t = T[:3, 3]
    return RelativePose(
        T_curr_prev=T,
        covariance=covariance,
        status=status,
        inlier_ratio=ratio,
        cost=cost / len(inlier),
        residual_scale_px=float(sigma),
        translation_direction_valid=bool(t @ np.linalg.solve(covariance[:3, :3], t) > 9.0),
        information_eigenvalues=values,
        method=method,
    )


def _is_rigid(T: np.ndarray) -> bool:
    if T.shape != (4, 4) or not np.isfinite(T).all() or np.abs(T[:3, 3]).max() > DEPTH_RANGE_M[1]:
        return False
    R = T[:3, :3]
    return bool(np.abs(R @ R.T - np.eye(3)).max() < 1e-6 and np.linalg.det(R) > 0)


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
    _check_arguments(method, pair, seed, MIN_POINTS)
    frames = _rgbd_frames(pair)
    if isinstance(frames, Status):
        result = RelativePose.failed(frames.reason, frames.message, method)
    else:
        T = _attempt(partial(solve, frames))
        if T is not None and np.isfinite(T).all() and T.shape == (4, 4):
            # Open3D and OpenCV accumulate small updates; the product is not quite a rotation
            U, _, V = np.linalg.svd(T[:3, :3])
            T = make_transform(U @ np.diag([1.0, 1.0, np.linalg.det(U @ V)]) @ V, T[:3, 3])
        sampled = _sample(pair, POINTS, int(seed))
        if isinstance(sampled, _Points):
            result = _checked(method, T, sampled, pair.curr.camera, threshold_px=8.0)
        else:
            result = _checked_without_flow(method, T, pair)
    return result.replace(ms=1e3 * (time.perf_counter() - start))


def _checked_without_flow(method: str, T: np.ndarray | None, pair: FramePair) -> RelativePose:
    depth = np.zeros(0) if pair.prev.depth is None else pair.prev.depth.reshape(-1)
    index = np.flatnonzero(_depth_valid(depth))[:: max(1, depth.size // POINTS)]
    if T is None or not _is_rigid(T) or len(index) < MIN_POINTS:
        return _checked(
            method, None, _Points(np.zeros((0, 3)), np.zeros((0, 2))), pair.curr.camera, 8
        )
    v, u = np.divmod(index, pair.prev.camera.width)
    xyz = _rays(u, v, pair.prev.camera) * depth[index, None].astype(np.float64)
    moved = xyz @ T[:3, :3].T + T[:3, 3]
    camera = pair.curr.camera
    z = np.where(moved[:, 2] > DEPTH_RANGE_M[0], moved[:, 2], np.nan)
    uv = np.stack(
        [camera.fx * moved[:, 0] / z + camera.cx, camera.fy * moved[:, 1] / z + camera.cy], -1
    )
    return _checked(method, T, _Points(xyz, np.nan_to_num(uv, nan=1e9)), camera, 8.0, sigma_px=1.0)


def _rgbd_frames(pair: FramePair) -> _RgbdFrames | Status:
    if pair.prev.rgb is None or pair.curr.rgb is None:
        return Status.failed(Reason.MISSING_FRAME, "this method aligns images; the pair has none")
    depths = []
    for name, frame in (("previous", pair.prev), ("current", pair.curr)):
        if frame.depth is None or not _depth_valid(frame.depth).any():
            return Status.failed(Reason.NO_VALID_DEPTH, f"the {name} frame has no valid depth")
        keep = _depth_valid(frame.depth)
        if frame.mask is not None:
            keep &= frame.mask
        depths.append(np.where(keep, frame.depth, np.nan).astype(np.float32))
    camera, rgb_curr = pair.prev.camera, pair.curr.rgb
    if not np.allclose(camera.K, pair.curr.camera.K):
        A = (camera.K @ np.linalg.inv(pair.curr.camera.K))[:2]
        size = (camera.width, camera.height)
        rgb_curr = cv2.warpAffine(rgb_curr, A, size, flags=cv2.INTER_LINEAR)
        depths[1] = cv2.warpAffine(
            depths[1], A, size, flags=cv2.INTER_NEAREST, borderValue=float("nan")
        )
    return _RgbdFrames(pair.prev.rgb, depths[0], rgb_curr, depths[1], camera)
