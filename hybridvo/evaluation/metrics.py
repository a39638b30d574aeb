"""Errors of a trajectory against ground truth: ATE and RPE through evo, KITTI's drift.

A value that cannot be computed is None with a reason. evo aligns in place and raises on degenerate
paths: it gets copies, and only paths that determine the alignment.
"""

from __future__ import annotations

import os
from collections.abc import Iterable
from dataclasses import dataclass, field
from typing import Any, Literal

import numpy as np
from scipy.spatial.transform import Rotation

from hybridvo.data.base import Sequence
from hybridvo.data.lists import MAX_STAMP_DIFFERENCE_S
from hybridvo.data.lists import associate as associate_stamps
from hybridvo.errors import InputError
from hybridvo.evaluation.drift import KITTI_LENGTHS, NOT_FINITE, SHORT_LENGTHS, kitti_drift
from hybridvo.geometry import invert, pose_matrix
from hybridvo.trajectory import Trajectory, read_trajectory

Alignment = Literal["se3", "sim3", "origin", "none"]
DeltaUnit = Literal["frames", "s"]

MIN_WIDTH = 1e-12
"""Product of the relative widths of both paths below which they are straight: above rounding
(1e-16), below one millimetre aside on a hundred metres (1e-10)."""


@dataclass(frozen=True, eq=False)
class Association:
    """Poses of two trajectories that belong together: (M,) indices into each.

    Args:
        est_indices, gt_indices: matched poses. total: poses of the shorter trajectory.
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
        alignment: how the estimate was aligned. reason: why there are no errors.
        translation: (M,) metres. rotation_deg: (M,) degrees, of relative errors only.
        timestamps: (M,) of the ground truth, seconds.
        scale: factor that the alignment put on the estimate, or None.
        T_gt_est: (4, 4) alignment: an estimated position p becomes ``T_gt_est @ (scale p)``.
    """

    alignment: Alignment
    reason: str = ""
    translation: np.ndarray = field(default_factory=lambda: np.zeros(0))
    rotation_deg: np.ndarray = field(default_factory=lambda: np.zeros(0))
    timestamps: np.ndarray = field(default_factory=lambda: np.zeros(0))
    scale: float | None = None
    T_gt_est: np.ndarray | None = None

    @property
    def rmse(self) -> float | None:
        """Root mean square of the translation errors, metres; None with a ``reason``."""
        return float(np.sqrt(np.mean(self.translation**2))) if len(self.translation) else None

    @property
    def rotation_rmse_deg(self) -> float | None:
        """Root mean square of the rotation errors, degrees; None with a ``reason``."""
        return float(np.sqrt(np.mean(self.rotation_deg**2))) if len(self.rotation_deg) else None


def associate(est: Trajectory, gt: Trajectory, *, max_diff: float | None = None) -> Association:
    """Match poses one to one: by nearest timestamp, or by index where one has no timestamps.

    Args:
        est: estimated trajectory.
        gt: ground truth.
        max_diff: largest difference of matched timestamps, seconds. Default: 0.02, or half the
            median spacing of the sparser trajectory if that is smaller.
    """
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
        max_diff = min(MAX_STAMP_DIFFERENCE_S, max(spacings, default=np.inf) / 2)
    within = np.nextafter(max_diff, np.inf)
    matches = associate_stamps(est.timestamps, gt.timestamps, within)
    i, j = np.array(matches, dtype=int).reshape(-1, 2).T
    reason = ""
    if 2 * len(i) < total:
        reason = (
            f"only {len(i)} of {total} poses match within {max_diff:.4g} s (estimate "
            f"{est.timestamps[0]:.6f} to {est.timestamps[-1]:.6f} s, ground truth "
            f"{gt.timestamps[0]:.6f} to {gt.timestamps[-1]:.6f} s)"
        )
    return Association(i, j, total, "time", max_diff, reason)


def _to_evo(trajectory: Trajectory, indices: np.ndarray) -> Any:
    from evo.core.trajectory import PosePath3D

    return PosePath3D(poses_se3=[T.copy() for T in trajectory.T_world_cam[indices]])


def _degeneracy(est: np.ndarray, gt: np.ndarray) -> str:
    """Why (M, 3) positions of estimate and truth determine no alignment, or the empty string."""
    if len(est) < 3:
        return f"not enough poses: {len(est)} matched, an alignment needs 3"
    centred = []
    for name, positions in (("estimate", est), ("ground truth", gt)):
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


@np.errstate(over="ignore", invalid="ignore")
def _align(est: Any, gt: Any, alignment: Alignment) -> tuple[np.ndarray, float, str]:
    """Align the evo path ``est`` to ``gt`` in place: (T_gt_est, scale, reason why it failed)."""
    from evo import EvoException

    T = np.eye(4)
    if alignment == "none":
        return T, 1.0, ""
    if alignment == "origin":
        return np.asarray(est.align_origin(gt)), 1.0, ""
    reason = _degeneracy(est.positions_xyz, gt.positions_xyz)
    if reason:
        return T, 1.0, reason
    try:
        T[:3, :3], T[:3, 3], scale = est.align(gt, correct_scale=alignment == "sim3")
    except (EvoException, np.linalg.LinAlgError) as error:
        return T, 1.0, f"evo: {error}"
    if scale <= 0:
        return T, 1.0, "the paths are not correlated: no positive scale fits"
    return T, float(scale), ""


def ate(
    est: Trajectory,
    gt: Trajectory,
    alignment: Alignment = "se3",
    *,
    association: Association | None = None,
) -> TrajectoryError:
    """Absolute trajectory error: distances of matched positions after the alignment.

    ``se3`` (rigid, least squares) is the rule for metric methods; ``sim3`` has a scale, ``origin``
    makes the first matched poses equal. ``association``: matches found before.
    """
    from evo.core.metrics import APE, PoseRelation

    match = association or associate(est, gt)
    if match.reason:
        return TrajectoryError(alignment, match.reason)
    paths = _to_evo(est, match.est_indices), _to_evo(gt, match.gt_indices)
    T, scale, reason = _align(*paths, alignment)
    if reason:
        return TrajectoryError(alignment, reason)
    metric = APE(PoseRelation.translation_part)
    with np.errstate(over="ignore", invalid="ignore"):
        metric.process_data((paths[1], paths[0]))
        errors = np.asarray(metric.error)
        if not np.isfinite(errors**2).all():
            return TrajectoryError(alignment, NOT_FINITE)
    stamps = gt.timestamps[match.gt_indices]
    return TrajectoryError(
        alignment, translation=errors, timestamps=stamps, scale=scale, T_gt_est=T
    )


def aligned(
    est: Trajectory, gt: Trajectory, alignment: Alignment = "se3"
) -> tuple[Trajectory, TrajectoryError | None]:
    """Estimate in the truth's world by the best alignment that the paths determine, and its ATE.

    Paths of which nothing matches start at the same place, and their error is None.
    """
    for kind in dict.fromkeys((alignment, "origin")):
        error = ate(est, gt, kind)
        if error.T_gt_est is not None:
            return est.transformed(error.T_gt_est, error.scale or 1.0), error
    return est.transformed(gt.T_world_cam[0] @ invert(est.T_world_cam[0])), None


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
    if match.reason:
        return TrajectoryError(alignment, match.reason)
    if delta_unit == "s" and match.by != "time":
        reason = "a distance in seconds needs timestamps in both trajectories"
        return TrajectoryError(alignment, reason)
    stamps = gt.timestamps[match.gt_indices]
    first, last = _pairs(stamps, delta, delta_unit)
    if not len(first):
        reason = f"not enough poses: of {len(stamps)} no two are {delta:g} {delta_unit} apart"
        return TrajectoryError(alignment, reason)
    paths, scale = (_to_evo(est, match.est_indices), _to_evo(gt, match.gt_indices)), 1.0
    if alignment == "sim3":
        _, scale, reason = _align(*paths, "sim3")
        if reason:
            return TrajectoryError(alignment, reason)
    P, Q = (path.poses_se3 for path in paths)
    with np.errstate(over="ignore", invalid="ignore"):
        errors = [RPE.rpe_base(Q[i], Q[j], P[i], P[j]) for i, j in zip(first, last, strict=True)]
        E = np.array(errors)
        translation = np.linalg.norm(E[:, :3, 3], axis=1)
        if not np.isfinite(translation**2).all():
            return TrajectoryError(alignment, NOT_FINITE)
    angles = np.degrees(Rotation.from_matrix(E[:, :3, :3]).magnitude())
    return TrajectoryError(alignment, "", translation, angles, stamps[first], scale)


def _pairs(stamps: np.ndarray, delta: float, unit: DeltaUnit) -> tuple[np.ndarray, np.ndarray]:
    """Indices of the first and last pose of each pair."""
    first = np.arange(len(stamps))
    if unit == "frames":
        last = first + int(delta)
    else:
        goal = stamps + delta
        after = np.searchsorted(stamps, goal).clip(max=len(stamps) - 1)
        before = (after - 1).clip(min=0)
        is_nearer = np.abs(stamps[before] - goal) < np.abs(stamps[after] - goal)
        last = np.where(is_nearer, before, after)
        # half a frame, and rounding of the stamps
        reach = 1.01 * np.median(np.diff(stamps)) / 2 if len(stamps) > 1 else 0.0
        last[np.abs(stamps[last] - goal) > reach] = len(stamps)
    inside = (last < len(stamps)) & (last > first)
    return first[inside], last[inside]


def true_trajectory(sequence: Sequence, indices: Iterable[int]) -> Trajectory | None:
    """True poses of those frames that have one; None where there are none."""
    if sequence.poses is None:
        return None
    known = [i for i in indices if np.isfinite(sequence.poses[i]).all()]
    if not known:
        return None
    # text files carry six digits: made orthonormal as the trajectory demands
    T = np.stack([pose_matrix(sequence.poses[i][:3]) for i in known])
    return Trajectory(sequence.timestamps[known], T)


def evaluate(
    estimate: Trajectory,
    gt: Trajectory,
    *,
    alignment: Alignment = "se3",
    delta: float = 1,
    delta_unit: DeltaUnit = "frames",
    max_diff: float | None = None,
) -> dict[str, Any]:
    """Every trajectory error of one estimate, JSON-ready.

    Args:
        estimate: estimated trajectory.
        gt: ground truth.
        alignment: of ``ate_rmse``; ``se3`` for metric methods.
        delta: of the relative error.
        delta_unit: ``frames`` or ``s``.
        max_diff: see :func:`associate`.

    Returns:
        ``ate_rmse`` (m, after ``alignment``) with ``scale``, ``ate_rmse_unaligned``,
        ``ate_rmse_origin``, ``ate_rmse_sim3`` with ``scale_sim3``; ``rpe_trans_rmse``,
        ``rpe_trans_mean`` (m), ``rpe_rot_rmse_deg``, and the three with the suffix ``_sim3``
        after a similarity; ``kitti_drift`` (100 to 800 m) and ``kitti_drift_short`` (5 to
        40 m); ``matched``, ``total``, ``matched_by``; ``reasons`` for every None.

    Raises:
        InputError: no trajectory, or an unknown option.
    """
    import evo

    _check(estimate, gt, alignment, delta, delta_unit, max_diff)
    match = associate(estimate, gt, max_diff=max_diff)
    report: dict[str, Any] = {
        "alignment": alignment,
        "delta": float(delta),
        "delta_unit": delta_unit,
        "matched": len(match.est_indices),
        "total": match.total,
        "matched_by": match.by,
        "evo_version": str(evo.__version__).lstrip("v"),
    }
    reasons: dict[str, str] = {}

    def put(key: str, value: Any, reason: str) -> None:
        report[key] = value
        if value is None:
            reasons[key] = reason

    kinds: tuple[tuple[Alignment, str], ...] = (
        *((alignment, ""), ("none", "_unaligned"), ("origin", "_origin"), ("sim3", "_sim3")),
    )
    for kind, suffix in kinds:
        error = ate(estimate, gt, kind, association=match)
        put(f"ate_rmse{suffix}", error.rmse, error.reason)
        if suffix in ("", "_sim3"):
            put(f"scale{suffix}", error.scale, error.reason)
            relative = rpe(estimate, gt, delta, delta_unit, kind, association=match)
            put(f"rpe_trans_rmse{suffix}", relative.rmse, relative.reason)
            mean = float(relative.translation.mean()) if len(relative.translation) else None
            put(f"rpe_trans_mean{suffix}", mean, relative.reason)
            put(f"rpe_rot_rmse_deg{suffix}", relative.rotation_rmse_deg, relative.reason)
    poses = estimate.T_world_cam[match.est_indices], gt.T_world_cam[match.gt_indices]
    for key, lengths in (("kitti_drift", KITTI_LENGTHS), ("kitti_drift_short", SHORT_LENGTHS)):
        put(key, None if match.reason else kitti_drift(*poses, lengths=lengths), match.reason)
    return report | {"reasons": reasons}


def _check(
    estimate: Any, gt: Any, alignment: str, delta: float, delta_unit: str, max_diff: float | None
) -> None:
    for name, path in (("estimate", estimate), ("gt", gt)):
        if not isinstance(path, Trajectory):
            raise InputError(
                f"evaluate.{name}: expected a Trajectory, got {type(path).__name__}. Files are "
                f"read by hybridvo.trajectory.read_trajectory."
            )
    if alignment not in ("se3", "sim3", "origin", "none"):
        raise InputError(f"alignment: expected se3, sim3, origin or none, got {alignment!r}.")
    if delta_unit not in ("frames", "s"):
        raise InputError(f"delta_unit: expected frames or s, got {delta_unit!r}.")
    if not 0 < delta < np.inf or (delta_unit == "frames" and not float(delta).is_integer()):
        raise InputError(f"delta: expected a positive number of {delta_unit}, got {delta!r}.")
    if max_diff is not None and not 0 <= max_diff < np.inf:
        raise InputError(f"max_diff: expected seconds >= 0, got {max_diff!r}.")


def evaluate_files(
    est_path: str | os.PathLike[str],
    gt_path: str | os.PathLike[str],
    *,
    format_est: Any = "auto",
    format_gt: Any = "auto",
    axes_est: Any = "auto",
    axes_gt: Any = "auto",
    **options: Any,
) -> dict[str, Any]:
    """Errors between two trajectory files: what ``hybridvo evaluate EST GT`` prints.

    Formats and axes are those of :func:`hybridvo.trajectory.read_trajectory`, ``options`` those of
    :func:`evaluate`, whose report it returns with ``estimate``, ``gt`` (paths) and ``warnings``.

    Raises:
        InputError: a file that is missing or malformed, or an unknown option.
    """
    est = read_trajectory(est_path, format_est, axes=axes_est)
    gt = read_trajectory(gt_path, format_gt, axes=axes_gt)
    report = evaluate(est, gt, **options)
    report["estimate"], report["gt"] = os.fsdecode(est_path), os.fsdecode(gt_path)
    report["warnings"] = [*est.warnings, *gt.warnings]
    return report
