"""Trajectory errors against ground truth: ATE and RPE through evo, KITTI drift, NEES.

evo aligns in place and raises on degenerate paths: every call works on copies, and a value that
cannot be computed is None with a reason.
"""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from scipy.spatial.transform import Rotation

from hybridvo.errors import InputError
from hybridvo.geometry import invert, rotation_angle, se3_log
from hybridvo.trajectory import Trajectory, read_trajectory

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
KITTI_LENGTHS = (100.0, 200.0, 300.0, 400.0, 500.0, 600.0, 700.0, 800.0)
"""Sub-path lengths of the KITTI odometry benchmark, metres."""
SHORT_LENGTHS = (5.0, 10.0, 15.0, 20.0, 25.0, 30.0, 35.0, 40.0)
"""Sub-path lengths for indoor sequences, metres (TartanAir's evaluator)."""
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
        return _statistics(self.translation).get("rmse")


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


@np.errstate(over="ignore", invalid="ignore")
def kitti_drift(
    T_world_cam_est: np.ndarray,
    T_world_cam_gt: np.ndarray,
    *,
    lengths: Sequence[float] = KITTI_LENGTHS,
) -> dict[str, Any]:
    """Drift as KITTI's odometry benchmark defines it (Geiger et al., CVPR 2012).

    From every frame and for every length L, the sub-path ends at the first frame whose distance
    along the true path exceeds L; translation and angle of its relative error are divided by L and
    averaged within each length, then over the lengths (as TartanAir's evaluator). Nothing is
    aligned or scaled.

    Args:
        T_world_cam_est: (N, 4, 4) estimated camera to world, metres.
        T_world_cam_gt: (N, 4, 4) true camera to world of the same frames, metres.
        lengths: of the sub-paths, metres.

    Returns:
        ``translation`` (fraction) and ``rotation_deg_per_m``, None with ``reasons`` where the path
        is shorter than every length; ``segments``, ``path_length_m``.
    """
    est, gt = np.asarray(T_world_cam_est), np.asarray(T_world_cam_gt)
    steps = np.linalg.norm(np.diff(gt[:, :3, 3], axis=0), axis=1)
    distance = np.concatenate([[0.0], np.cumsum(steps)])
    means, segments = [], 0
    for length in lengths:
        last = np.searchsorted(distance, distance + length, side="right")
        (first,) = np.nonzero(last < len(gt))
        if len(first):
            last = last[first]
            error = invert(invert(est[first]) @ est[last]) @ (invert(gt[first]) @ gt[last])
            translation = np.linalg.norm(error[:, :3, 3], axis=1).mean() / length
            rotation = np.degrees(rotation_angle(error[:, :3, :3])).mean() / length
            means.append((translation, rotation))
            segments += len(first)
    values = [float(x) for x in np.mean(means, axis=0)] if means else [np.nan, np.nan]
    report: dict[str, Any] = {
        "segments": segments,
        "path_length_m": float(distance[-1]) if np.isfinite(distance[-1]) else None,
        "reasons": {},
    }
    for name, value in zip(("translation", "rotation_deg_per_m"), values, strict=True):
        report[name] = value if np.isfinite(value) else None
        if report[name] is None:
            short = f"the true path of {distance[-1]:.4g} m is shorter than {min(lengths):g} m"
            report["reasons"][name] = NOT_FINITE if means else short
    return report


def nees(T_est: np.ndarray, T_gt: np.ndarray, covariance: np.ndarray) -> float:
    """Normalised estimation error squared of one motion: 6 on average where sigma is right.

    Args:
        T_est: (4, 4) estimated T_curr_prev.
        T_gt: (4, 4) true T_curr_prev.
        covariance: (6, 6) of ``Exp(delta) T_est``, translation first, m^2 and rad^2.
    """
    error = se3_log(T_gt @ invert(T_est))
    # whitened by the standard deviations: metres and radians may differ by many powers of ten
    std = np.sqrt(np.diag(covariance))
    return float(error / std @ np.linalg.solve(covariance / np.outer(std, std), error / std))


def _statistics(errors: np.ndarray) -> dict[str, float]:
    """rmse, mean, median and max; empty for no errors."""
    if not len(errors):
        return {}
    values = (np.sqrt(np.mean(errors**2)), errors.mean(), np.median(errors), errors.max())
    return dict(zip(("rmse", "mean", "median", "max"), map(float, values), strict=True))


def _check(alignment: str, delta: float, delta_unit: str, max_diff: float | None) -> None:
    if alignment not in ("se3", "sim3", "origin", "none"):
        raise InputError(f"alignment: expected se3, sim3, origin or none, got {alignment!r}.")
    if delta_unit not in ("frames", "s"):
        raise InputError(f"delta_unit: expected frames or s, got {delta_unit!r}.")
    whole = delta_unit == "s" or float(delta).is_integer()
    if not (0 < delta < np.inf and whole):
        raise InputError(f"delta: expected a positive number of {delta_unit}, got {delta!r}.")
    if max_diff is not None and not 0 <= max_diff < np.inf:
        raise InputError(f"max_diff: expected seconds >= 0, got {max_diff!r}.")


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
        alignment: of ``ate_rmse`` and its companions; ``se3`` for metric methods.
        delta: of the relative error.
        delta_unit: ``frames`` or ``s``.
        max_diff: see :func:`associate`.

    Returns:
        ``ate_rmse``, ``ate_mean``, ``ate_median``, ``ate_max`` (m, after ``alignment``),
        ``ate_rmse_unaligned``, ``ate_rmse_origin``, ``ate_rmse_sim3`` with ``scale_sim3``;
        ``rpe_trans_rmse`` (m), ``rpe_rot_rmse_deg`` and their mean and median, with the suffix
        ``_sim3`` after a similarity; ``kitti_drift`` (100 to 800 m) and ``kitti_drift_short``
        (5 to 40 m); ``matched``, ``total``; ``reasons`` for every None.

    Raises:
        InputError: no trajectory, or an unknown option.
    """
    import evo

    for name, value in (("estimate", estimate), ("gt", gt)):
        if not isinstance(value, Trajectory):
            raise InputError(
                f"evaluate.{name}: expected a Trajectory, got {type(value).__name__}. Files are "
                f"read by hybridvo.trajectory.read_trajectory."
            )
    _check(alignment, delta, delta_unit, max_diff)
    match = associate(estimate, gt, max_diff=max_diff)
    report: dict[str, Any] = {
        "alignment": alignment,
        "delta": float(delta),
        "delta_unit": delta_unit,
        "matched": len(match.est_indices),
        "total": match.total,
        "matched_by": match.by,
        "max_time_difference_s": match.max_diff,
        "poses_estimate": len(estimate),
        "poses_gt": len(gt),
        "evo_version": str(evo.__version__).lstrip("v"),
    }
    reasons: dict[str, str] = {}

    def put(key: str, value: float | None, reason: str) -> None:
        report[key] = value
        if value is None:
            reasons[key] = reason

    main = ate(estimate, gt, alignment, association=match)
    for name in ("rmse", "mean", "median", "max"):
        put(f"ate_{name}", _statistics(main.translation).get(name), main.reason)
    put("scale", main.scale, main.reason)
    other: Alignment
    for other, suffix in (("none", "unaligned"), ("origin", "origin"), ("sim3", "sim3")):
        error = ate(estimate, gt, other, association=match)
        put(f"ate_rmse_{suffix}", error.rmse, error.reason)
    put("scale_sim3", error.scale, error.reason)
    for other, suffix in ((alignment, ""), ("sim3", "_sim3")):
        relative = rpe(estimate, gt, delta, delta_unit, other, association=match)
        for values, name, unit in (
            (relative.translation, "trans", ""),
            (relative.rotation_deg, "rot", "_deg"),
        ):
            for kind in ("rmse",) if suffix else ("rmse", "mean", "median"):
                put(
                    f"rpe_{name}_{kind}{unit}{suffix}",
                    _statistics(values).get(kind),
                    relative.reason,
                )
    poses = estimate.T_world_cam[match.est_indices], gt.T_world_cam[match.gt_indices]
    for key, lengths in (("kitti_drift", KITTI_LENGTHS), ("kitti_drift_short", SHORT_LENGTHS)):
        put(key, None if match.reason else kitti_drift(*poses, lengths=lengths), match.reason)
    for key, path in (("length_estimate_m", estimate), ("length_gt_m", gt)):
        with np.errstate(over="ignore", invalid="ignore"):
            length = path.length
        put(key, length if np.isfinite(length) else None, NOT_FINITE)
    report["reasons"] = reasons
    return report


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

    Args:
        est_path: estimated trajectory.
        gt_path: ground truth.
        format_est: see :func:`hybridvo.trajectory.read_trajectory`.
        format_gt: the same for the ground truth.
        axes_est: see :func:`hybridvo.trajectory.read_trajectory`.
        axes_gt: the same for the ground truth.
        **options: of :func:`evaluate`.

    Returns:
        The report of :func:`evaluate` with ``estimate``, ``gt`` (paths) and ``warnings`` (what the
        readers changed).

    Raises:
        InputError: a file that is missing or malformed, or an unknown option.
    """
    est = read_trajectory(est_path, format_est, axes=axes_est)
    gt = read_trajectory(gt_path, format_gt, axes=axes_gt)
    report = evaluate(est, gt, **options)
    report["estimate"], report["gt"] = os.fsdecode(est_path), os.fsdecode(gt_path)
    report["warnings"] = [*est.warnings, *gt.warnings]
    return report
