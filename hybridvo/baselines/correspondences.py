"""Correspondences of a pair for the point solvers, and the checks of what those solvers answer.

The checks are the same for every method, so that "ok" means one thing in a comparison: a finite
rigid motion with enough inliers in front of the camera that determine all six degrees of freedom.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from hybridvo.errors import InputError
from hybridvo.results import Reason, RelativePose, Status
from hybridvo.types import Camera, FramePair

__all__ = [
    "DEPTH_RANGE_M",
    "MIN_POINTS",
    "POINTS",
    "Correspondences",
    "check_arguments",
    "check_pose",
    "depth_valid",
    "is_rigid",
    "sample_correspondences",
    "viewing_rays",
]

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


@dataclass(frozen=True, eq=False)
class Correspondences:
    """Sampled pixels of a pair.

    Args:
        xyz: (n, 3) float64 metres in the previous camera, from the depth and ``K_prev``.
        uv: (n, 2) float64 px in the current image: pixel plus flow.
    """

    xyz: np.ndarray
    uv: np.ndarray


def sample_correspondences(pair: FramePair, points: int, seed: int) -> Correspondences | Status:
    """Random valid pixels as correspondences, or the reason why there are too few.

    Candidates are drawn first and checked after, so that a large image is not read as a whole for
    ten thousand of its pixels; only where too many of them are invalid is the full mask made.

    Args:
        pair: depth, flow and masks are read.
        points: most correspondences returned.
        seed: of the draw.

    Returns:
        At least :data:`MIN_POINTS` correspondences, or a failed status.
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
    return Correspondences(
        viewing_rays(u, v, pair.prev.camera) * z[:, None], flow + np.stack([u, v], axis=-1)
    )


def check_arguments(method: str, pair: FramePair, seed: int, points: int = MIN_POINTS) -> None:
    """Raise InputError where an estimator was called with something it cannot mean."""
    if not isinstance(pair, FramePair):
        raise InputError(f"{method}: expected a FramePair, got {type(pair).__name__}.")
    for name, value, low in (("seed", seed, 0), ("points", points, MIN_POINTS)):
        if isinstance(value, bool) or not isinstance(value, int | np.integer) or value < low:
            raise InputError(f"{method}: {name}: expected an integer >= {low}, got {value!r}.")


def viewing_rays(u: np.ndarray, v: np.ndarray, camera: Camera) -> np.ndarray:
    """(n, 3) points at depth 1 seen at the (n,) pixels ``u``, ``v``."""
    return np.stack(
        [(u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy, np.ones(len(u))], axis=-1
    )


def depth_valid(depth: np.ndarray) -> np.ndarray:
    """Boolean array: depth that can be metres; False for NaN, inf, zero and negative values."""
    return (depth > DEPTH_RANGE_M[0]) & (depth < DEPTH_RANGE_M[1])


def _usable(pair: FramePair, index: np.ndarray) -> np.ndarray:
    """Flat pixel indices with valid depth and a finite flow that ends inside the current image."""
    camera = pair.prev.camera
    depth, flow = pair.prev.depth, pair.flow
    if depth is None or flow is None:
        return index[:0]
    index = index[depth_valid(depth.reshape(-1)[index])]
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
    if pair.prev.depth is None or not depth_valid(pair.prev.depth).any():
        return Status.failed(
            Reason.NO_VALID_DEPTH, "the previous depth has no finite positive value (metres)"
        )
    if pair.flow is None or not np.isfinite(pair.flow).all(axis=-1).any():
        return Status.failed(Reason.NO_FLOW, "the flow has no finite value")
    return Status.failed(
        Reason.LOW_INLIERS, f"{count} pixels with valid depth and flow, need {MIN_POINTS}"
    )


def check_pose(
    method: str,
    T: np.ndarray | None,
    data: Correspondences,
    camera: Camera,
    threshold_px: float,
    sigma_px: float | None = None,
) -> RelativePose:
    """The solver's answer after the checks, with covariance and status.

    Inliers are counted again: in front of the camera after the motion and within ``threshold_px``.
    Covariance sigma^2 (J^T J)^-1 over them, sigma^2 = |r|^2 / (2 n - 6) unless ``sigma_px`` is
    given, J by the left perturbation, translation first. With a solver that stops short of the
    least-squares optimum of its inliers this is the covariance of the optimum, thus optimistic.

    Args:
        method: name for the result and its messages.
        T: (4, 4) the solver's ``T_curr_prev``, or None where it found none.
        data: what the solver was given.
        camera: of the current frame.
        threshold_px: largest residual of an inlier.
        sigma_px: standard deviation of the residuals where it is known.

    Returns:
        The motion with its covariance; failed with the identity where a check says no.
    """
    if T is None or not is_rigid(T):
        if _undetermined(data, camera):
            return _degenerate(method, len(data.uv))
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
        if _undetermined(data, camera):
            return _degenerate(method, len(data.uv))
        message = f"{method}: {count} of {len(inlier)} sampled pixels follow the motion"
        return RelativePose.failed(Reason.LOW_INLIERS, message, method, inlier_ratio=ratio)

    # metres in units of the typical depth: both halves of the tangent are then in radians
    scale = np.array([float(np.median(z[inlier]))] * 3 + [1.0] * 3)
    values, vectors = _information(moved[inlier], camera, scale)
    if values[0] <= SINGULAR_RATIO * values[-1]:
        return _degenerate(method, count, ratio, np.maximum(values, 0.0))
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


def _information(
    points: np.ndarray, camera: Camera, scale: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Ascending eigenvalues and the eigenvectors of J^T J, its columns times ``scale``."""
    z = points[:, 2]
    x, y, zero = points[:, 0] / z, points[:, 1] / z, np.zeros_like(z)
    J = np.concatenate(
        [
            camera.fx * np.stack([1 / z, zero, -x / z, -x * y, 1 + x * x, -y], axis=-1),
            camera.fy * np.stack([zero, 1 / z, -y / z, -1 - y * y, x * y, x], axis=-1),
        ]
    )
    J *= scale
    values, vectors = np.linalg.eigh(J.T @ J)
    return values, vectors


def _undetermined(data: Correspondences, camera: Camera) -> bool:
    """Whether no solver could have found the motion: the points themselves are degenerate."""
    scale = np.array([float(np.median(data.xyz[:, 2]))] * 3 + [1.0] * 3)
    values, _ = _information(data.xyz, camera, scale)
    return bool(values[0] <= SINGULAR_RATIO * values[-1])


def _degenerate(
    method: str, count: int, ratio: float = 0.0, eigenvalues: np.ndarray | None = None
) -> RelativePose:
    return RelativePose.failed(
        Reason.DEGENERATE_GEOMETRY,
        f"{method}: the {count} points leave a direction of the motion undetermined",
        method,
        inlier_ratio=ratio,
        information_eigenvalues=np.zeros(6) if eigenvalues is None else eigenvalues,
    )


def is_rigid(T: np.ndarray) -> bool:
    """Whether ``T`` is a finite (4, 4) rigid transform of a length that can be metres."""
    if T.shape != (4, 4) or not np.isfinite(T).all() or np.abs(T[:3, 3]).max() > DEPTH_RANGE_M[1]:
        return False
    R = T[:3, :3]
    return bool(np.abs(R @ R.T - np.eye(3)).max() < 1e-6 and np.linalg.det(R) > 0)
