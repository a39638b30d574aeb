"""Points of the previous frame with their pixels in the current one, and their covariance."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from hybridvo.core.checks import as_rigid
from hybridvo.core.errors import InputError
from hybridvo.core.geometry import (
    backproject,
    project,
    projection_rows,
    transform_points,
)
from hybridvo.core.results import Reason, RelativePose, StageFailed
from hybridvo.core.types import Camera, FramePair
from hybridvo.flow.calibration import UNSTATED_FLOW_STD_PX
from hybridvo_lab.baselines.calibration import (
    INLIER_STDS,
    MIN_INLIER_PX,
)

# px: OpenCV's own limit on the residual of an inlier
OPENCV_INLIER_PX = 8.0
# fraction of the sampled pixels that must be inliers: below, a consensus is chance
MIN_CONSENSUS_RATIO = 0.05
# correspondences, and inliers, that a solver needs: four always fit some pose
MIN_SOLVER_POINTS = 6
# of the information's extreme eigenvalues, below which a covariance cannot be
# stated: a patch of 20 px has 1e-9
SINGULAR_RATIO = 1e-10
# px, of the flow of a motion without any given flow
SELF_FLOW_STD_PX = 1.0

# random valid pixels for a solver; all of them cost 50 times more for no accuracy
POINTS = 10_000
# metres; outside of them squares leave the floating-point range
MIN_DEPTH_M = 1e-6
MAX_DEPTH_M = 1e6
# px; exact data has no residual, but float32 flow near 1000 px is rounded at 6e-5
# px
MIN_RESIDUAL_PX = 1e-4


class Correspondences(NamedTuple):
    """Sampled pixels of a pair."""

    xyz: np.ndarray  # (n, 3) metres, in the previous camera
    uv: np.ndarray  # (n, 2) px, in the current image
    # largest residual of an inlier, by the noise of the flow
    inlier_px: float = MIN_INLIER_PX


# -- sampling


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


def self_consistent(
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
    where an estimated flow states none; zero where the flow is ground truth.

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


# -- covariance


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
