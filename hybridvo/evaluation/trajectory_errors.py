"""Matching, alignment and errors of two trajectories through evo: ATE and RPE.

evo aligns in place and raises on degenerate paths: every call works on copies, and where nothing
can be computed the result says why.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from scipy.spatial.transform import Rotation

from hybridvo.trajectory import Trajectory

Alignment = Literal["se3", "sim3", "origin", "none"]
DeltaUnit = Literal["frames", "s"]

MAX_TIME_DIFFERENCE = 0.02
"""Largest difference in seconds between the stamps of matched poses (TUM RGB-D's tools)."""
MIN_MATCHED_SHARE = 0.5
"""Smallest share of the shorter trajectory that has to find a partner."""
MIN_POSES = 3
"""Fewest poses that determine a rigid alignment."""
MIN_WIDTH = 1e-12
"""Product of the relative widths of both paths below which they are straight: above rounding
(1e-16), below one millimetre aside on a hundred metres (1e-10)."""
NOT_FINITE = "the error is not a finite number: positions are too large"


@dataclass(frozen=True, eq=False)
class Association:
    """Poses of two trajectories that belong together.

    Args:
        est_indices, gt_indices: (M,) indices into the estimate and the ground truth.
        total: poses of the shorter trajectory.
        by: ``time`` or, where a file has no timestamps, ``index``.
        max_diff: largest time difference allowed, seconds; None by index.
        reason: why no error can be computed from these matches, or the empty string.
    """

    est_indices: np.ndarray
    gt_indices: np.ndarray
    total: int
    by: str
    max_diff: float | None = None
    reason: str = ""


@dataclass(frozen=True, eq=False)
class TrajectoryError:
    """Absolute or relative errors of matched poses; empty arrays with a ``reason`` if none.

    Args:
        translation: (M,) metres. rotation_deg: (M,) degrees, of relative errors only.
        scale: factor that the alignment put on the estimate, or None.
        T_gt_est: (4, 4) alignment: an estimated position p becomes ``T_gt_est @ (scale p)``.
        timestamps: (M,) of the ground truth, seconds.
        alignment, reason: how it was aligned, and why there are no errors.
    """

    translation: np.ndarray
    rotation_deg: np.ndarray
    scale: float | None
    T_gt_est: np.ndarray | None
    timestamps: np.ndarray
    alignment: Alignment
    reason: str = ""

    @property
    def rmse(self) -> float | None:
        """Root mean square of the translation errors, metres; None with a ``reason``."""
        return float(np.sqrt(np.mean(self.translation**2))) if len(self.translation) else None


def associate(est: Trajectory, gt: Trajectory, *, max_diff: float | None = None) -> Association:
    """Match the poses of two trajectories one to one: by nearest timestamp, through evo.

    Where one of them has no timestamps, poses are matched by index, which needs equal lengths.

    Args:
        est: estimated trajectory.
        gt: ground truth.
        max_diff: largest difference of matched timestamps, seconds. Default: 0.02, or half the
            median spacing of the sparser trajectory if that is smaller.
    """
    from evo.core.sync import matching_time_indices

    total = min(len(est), len(gt))
    if not (est.has_timestamps and gt.has_timestamps):
        reason = ""
        if len(est) != len(gt):
            reason = (
                f"poses without timestamps can only be matched one by one, but the estimate has "
                f"{len(est)} and the ground truth {len(gt)}"
            )
        indices = np.arange(0 if reason else total)
        return Association(indices, indices, total, "index", None, reason)
    if max_diff is None:
        spacings = [float(np.median(np.diff(t.timestamps))) for t in (est, gt) if len(t) > 1]
        max_diff = min([MAX_TIME_DIFFERENCE] + ([max(spacings) / 2] if spacings else []))
    short, long = (est, gt) if len(est) <= len(gt) else (gt, est)
    found = matching_time_indices(short.timestamps, long.timestamps, max_diff)
    i, j = (np.array(indices, dtype=int) for indices in found)
    # evo may give one pose of the longer trajectory to two of the shorter: the nearer one keeps it
    order = np.lexsort((np.abs(short.timestamps[i] - long.timestamps[j]), j))
    chosen = np.sort(order[np.unique(j[order], return_index=True)[1]])
    i, j = i[chosen], j[chosen]
    reason = ""
    if len(i) < MIN_MATCHED_SHARE * total or not len(i):
        reason = (
            f"only {len(i)} of {total} poses match within {max_diff:.4g} s (estimate "
            f"{est.timestamps[0]:.6f} to {est.timestamps[-1]:.6f} s, ground truth "
            f"{gt.timestamps[0]:.6f} to {gt.timestamps[-1]:.6f} s)"
        )
    return Association(*((i, j) if short is est else (j, i)), total, "time", max_diff, reason)


def _to_evo(trajectory: Trajectory, indices: np.ndarray) -> Any:
    from evo.core.trajectory import PosePath3D

    return PosePath3D(poses_se3=[T.copy() for T in trajectory.T_world_cam[indices]])


def _degeneracy(x: np.ndarray, y: np.ndarray) -> str:
    """Why (M, 3) positions of estimate and truth determine no alignment, or the empty string."""
    if len(x) < MIN_POSES:
        return f"not enough poses: {len(x)} matched, an alignment needs {MIN_POSES}"
    centred = []
    for name, positions in (("estimate", x), ("ground truth", y)):
        moved = positions - positions.mean(axis=0)
        size = float(np.linalg.norm(moved))
        if not np.isfinite(size):
            return NOT_FINITE
        if size <= 1e-12 * float(np.abs(positions).max()):
            return f"static camera: the positions of the {name} do not move"
        centred.append(moved / size)
    if np.linalg.svd(centred[1].T @ centred[0], compute_uv=False)[1] <= MIN_WIDTH:
        return "straight line: the camera path leaves the rotation about it open"
    return ""


def _align(est: Any, gt: Any, alignment: Alignment) -> tuple[np.ndarray, float, str]:
    """Align the evo path ``est`` to ``gt`` in place: (T_gt_est, scale, reason why it failed)."""
    from evo import EvoException

    if alignment == "none":
        return np.eye(4), 1.0, ""
    if alignment == "origin":
        return np.asarray(est.align_origin(gt)), 1.0, ""
    reason = _degeneracy(est.positions_xyz, gt.positions_xyz)
    if reason:
        return np.eye(4), 1.0, reason
    try:
        R, t, scale = est.align(gt, correct_scale=alignment == "sim3")
    except (EvoException, np.linalg.LinAlgError) as error:
        return np.eye(4), 1.0, f"evo: {error}"
    if scale <= 0:
        return np.eye(4), 1.0, "the paths are not correlated: no positive scale fits"
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = R, t
    return T, float(scale), ""


@np.errstate(over="ignore", invalid="ignore")
def ate(
    est: Trajectory,
    gt: Trajectory,
    alignment: Alignment = "se3",
    *,
    association: Association | None = None,
) -> TrajectoryError:
    """Absolute trajectory error: distances of matched positions after the alignment.

    Args:
        est: estimated trajectory.
        gt: ground truth.
        alignment: ``se3`` (rigid, least squares: the rule for metric methods), ``sim3`` (with
            scale), ``origin`` (first matched poses made equal) or ``none``.
        association: matches found before.
    """
    from evo.core.metrics import APE, PoseRelation

    match = association or associate(est, gt)
    nothing = np.zeros(0)
    reason = match.reason
    if not reason:
        paths = _to_evo(est, match.est_indices), _to_evo(gt, match.gt_indices)
        T, scale, reason = _align(*paths, alignment)
    if not reason:
        metric = APE(PoseRelation.translation_part)
        metric.process_data((paths[1], paths[0]))
        errors = np.asarray(metric.error)
        if np.isfinite(errors**2).all():
            stamps = gt.timestamps[match.gt_indices]
            return TrajectoryError(errors, nothing, scale, T, stamps, alignment)
        reason = NOT_FINITE
    return TrajectoryError(nothing, nothing, None, None, nothing, alignment, reason)


@np.errstate(over="ignore", invalid="ignore")
def rpe(
    est: Trajectory,
    gt: Trajectory,
    delta: float = 1,
    delta_unit: DeltaUnit = "frames",
    alignment: Alignment = "se3",
    *,
    association: Association | None = None,
) -> TrajectoryError:
    """Relative pose error over all (overlapping) pairs that are ``delta`` apart.

    Args:
        est: estimated trajectory.
        gt: ground truth.
        delta: distance of the two poses of a pair.
        delta_unit: ``frames``, or ``s``: the partner is the pose nearest to that time, at most
            half a frame away.
        alignment: only ``sim3`` changes the values: its scale is applied to the estimate.
        association: matches found before.
    """
    from evo.core.metrics import RPE

    match = association or associate(est, gt)
    nothing = np.zeros(0)
    reason, scale = match.reason, 1.0
    if not reason and delta_unit == "s" and match.by != "time":
        reason = "a distance in seconds needs timestamps in both trajectories"
    if not reason:
        stamps = gt.timestamps[match.gt_indices]
        first, last = _pairs(stamps, delta, delta_unit)
        if not len(first):
            reason = f"not enough poses: of {len(stamps)} no two are {delta:g} {delta_unit} apart"
    if not reason:
        paths = _to_evo(est, match.est_indices), _to_evo(gt, match.gt_indices)
        if alignment == "sim3":
            _, scale, reason = _align(*paths, "sim3")
    if not reason:
        P, Q = (path.poses_se3 for path in paths)
        pairs = zip(first, last, strict=True)
        E = np.array([RPE.rpe_base(Q[i], Q[j], P[i], P[j]) for i, j in pairs])
        translation = np.linalg.norm(E[:, :3, 3], axis=1)
        if np.isfinite(translation**2).all():
            angles = np.degrees(Rotation.from_matrix(E[:, :3, :3]).magnitude())
            return TrajectoryError(translation, angles, scale, None, stamps[first], alignment)
        reason = NOT_FINITE
    return TrajectoryError(nothing, nothing, None, None, nothing, alignment, reason)


def _pairs(stamps: np.ndarray, delta: float, unit: DeltaUnit) -> tuple[np.ndarray, np.ndarray]:
    """Indices of the first and last pose of each pair."""
    first = np.arange(len(stamps))
    if unit == "frames":
        last = first + int(delta)
    else:
        goal = stamps + delta
        last = np.searchsorted(stamps, goal)
        before = np.clip(last - 1, 0, len(stamps) - 1)
        after = np.clip(last, 0, len(stamps) - 1)
        nearer = np.abs(stamps[before] - goal) < np.abs(stamps[after] - goal)
        last = np.where(nearer, before, after)
        half = np.median(np.diff(stamps)) / 2 if len(stamps) > 1 else 0.0
        # half a frame, and rounding of the stamps
        last[np.abs(stamps[last] - goal) > 1.01 * half] = len(stamps)
    inside = (last < len(stamps)) & (last > first)
    return first[inside], last[inside]
