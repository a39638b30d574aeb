"""Trajectory errors against ground truth: ATE, RPE, KITTI drift, NEES.

A value that cannot be computed is None with a reason.
"""

from __future__ import annotations

import os
from collections.abc import Sequence
from typing import Any

import numpy as np

from hybridvo.errors import InputError
from hybridvo.evaluation.trajectory_errors import (
    NOT_FINITE,
    Alignment,
    DeltaUnit,
    associate,
    ate,
    rpe,
)
from hybridvo.geometry import invert, rotation_angle, se3_log
from hybridvo.trajectory import Trajectory, read_trajectory

KITTI_LENGTHS = (100.0, 200.0, 300.0, 400.0, 500.0, 600.0, 700.0, 800.0)
"""Sub-path lengths of the KITTI odometry benchmark, metres."""
SHORT_LENGTHS = (5.0, 10.0, 15.0, 20.0, 25.0, 30.0, 35.0, 40.0)
"""Sub-path lengths for indoor sequences, metres (TartanAir's evaluator)."""


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

    def put(key: str, value: Any, reason: str) -> None:
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
