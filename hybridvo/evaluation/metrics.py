"""Trajectory errors against truth: absolute and relative pose error through evo, and KITTI drift.

The only file that imports evo's metrics. evo aligns in place and raises on degenerate paths: every
call works on copies, and a value that cannot be computed is None with a reason. Per-pair errors
(the paper's R_err, T_err and EPE) live in :mod:`hybridvo.evaluation.pairs` and are offered
here too.
"""

from __future__ import annotations

import inspect
import os
from numbers import Real
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from hybridvo.errors import InputError
from hybridvo.evaluation.drift import KITTI_LENGTHS, SHORT_LENGTHS, KittiDrift, kitti_drift
from hybridvo.evaluation.pairs import dynamic_fraction, mean_pair_errors, pair_errors
from hybridvo.evaluation.results import (
    AbsoluteError,
    Alignment,
    Association,
    RelativeError,
    Scale,
)
from hybridvo.geometry import xyzw_to_wxyz
from hybridvo.trajectory import Axes, Format, Trajectory, read_trajectory

__all__ = [
    "AbsoluteError",
    "Association",
    "KittiDrift",
    "RelativeError",
    "associate",
    "ate",
    "dynamic_fraction",
    "evaluate_files",
    "evaluate_trajectories",
    "kitti_drift",
    "mean_pair_errors",
    "pair_errors",
    "rpe",
]

MAX_TIME_DIFFERENCE = 0.02
"""Largest difference in seconds between the stamps of matched poses (TUM RGB-D's tools)."""
MIN_MATCHED_SHARE = 0.5
"""Smallest share of the shorter trajectory that has to find a partner."""
MIN_POSES = 3
"""Fewest poses that determine a rigid alignment."""

# Product of the relative widths of both paths below which they count as straight: far above
# rounding (1e-16), far below one millimetre aside on a hundred metres (1e-10).
_STRAIGHT = 1e-12


def _evo_version() -> str:
    import evo

    return str(evo.__version__).lstrip("v")


def associate(est: Trajectory, gt: Trajectory, *, max_diff: float | None = None) -> Association:
    """Match the poses of two trajectories one to one: by nearest stamp, through evo.

    Where one of them has no stamps, poses are matched by index, which needs equal lengths.

    Args:
        est: estimated trajectory.
        gt: true trajectory.
        max_diff: largest difference of matched stamps, seconds. Default: 0.02, or half the median
            spacing of the sparser trajectory if that is smaller, so that no pose can be matched
            with its neighbour's partner.

    Raises:
        InputError: no trajectories, or ``max_diff`` is negative or not finite.
    """
    if max_diff is not None and not (isinstance(max_diff, Real) and 0 <= max_diff < np.inf):
        raise InputError(f"max_diff: expected seconds >= 0, got {max_diff!r}.")
    total = min(len(est), len(gt))
    if not (est.has_timestamps and gt.has_timestamps):
        if len(est) != len(gt):
            empty = np.zeros(0, dtype=int)
            reason = (
                f"poses without timestamps can only be matched one by one, but the estimate has "
                f"{len(est)} and the truth {len(gt)}"
            )
            return Association(empty, empty, total, "index", None, reason)
        indices = np.arange(total)
        return Association(indices, indices, total, "index")
    if max_diff is None:
        spacings = [np.median(np.diff(t.timestamps)) for t in (est, gt) if len(t) > 1]
        max_diff = float(min([MAX_TIME_DIFFERENCE] + ([max(spacings) / 2] if spacings else [])))

    from evo.core.sync import matching_time_indices

    short, long = (est, gt) if len(est) <= len(gt) else (gt, est)
    found = matching_time_indices(short.timestamps, long.timestamps, max_diff)
    short_indices, long_indices = (np.array(indices, dtype=int) for indices in found)
    # evo may give one pose of the longer trajectory to two of the shorter: the nearer one keeps it
    difference = np.abs(short.timestamps[short_indices] - long.timestamps[long_indices])
    order = np.lexsort((difference, long_indices))
    _, keep = np.unique(long_indices[order], return_index=True)
    chosen = np.sort(order[keep])
    short_indices, long_indices = short_indices[chosen], long_indices[chosen]
    reason = ""
    if len(chosen) < MIN_MATCHED_SHARE * total or not len(chosen):
        reason = (
            f"only {len(chosen)} of {total} poses match within {max_diff:.4g} s (estimate "
            f"{est.timestamps[0]:.6f} to {est.timestamps[-1]:.6f} s, truth "
            f"{gt.timestamps[0]:.6f} to {gt.timestamps[-1]:.6f} s)"
        )
    indices_est, indices_gt = (
        (short_indices, long_indices) if short is est else (long_indices, short_indices)
    )
    return Association(indices_est, indices_gt, total, "time", max_diff, reason)


def _to_evo(trajectory: Trajectory, indices: np.ndarray) -> Any:
    from evo.core.trajectory import PosePath3D

    T = trajectory.T_world_cam[indices]
    xyzw = Rotation.from_matrix(T[:, :3, :3]).as_quat()
    return PosePath3D(
        positions_xyz=T[:, :3, 3].copy(),
        orientations_quat_wxyz=xyzw_to_wxyz(xyzw),
        poses_se3=[pose.copy() for pose in T],
    )


def _degeneracy(est: np.ndarray, gt: np.ndarray) -> str:
    """Why (M, 3) positions do not determine an alignment, or the empty string."""
    if len(est) < MIN_POSES:
        return f"not enough poses: {len(est)} matched, an alignment needs {MIN_POSES}"
    x, y = est - est.mean(axis=0), gt - gt.mean(axis=0)
    size_x, size_y = np.linalg.norm(x), np.linalg.norm(y)
    if not np.isfinite([size_x, size_y]).all():
        return "positions too large: the error is not a finite number"
    for name, positions, size in (("estimate", est, size_x), ("truth", gt, size_y)):
        if size <= 1e-12 * max(float(np.abs(positions).max()), 1e-300):
            return f"static camera: the positions of the {name} do not move"
    widths = np.linalg.svd((y / size_y).T @ (x / size_x), compute_uv=False)
    if widths[1] <= _STRAIGHT:
        return (
            "degenerate covariance rank: the camera moves on a straight line, which leaves the "
            "rotation about it open"
        )
    return ""


def _align(est: Any, gt: Any, alignment: Alignment, scale: Scale) -> tuple[np.ndarray, float, str]:
    """Align the evo path ``est`` to ``gt`` in place: (T_gt_est, scale, reason why it failed)."""
    from evo import EvoException
    from evo.core.geometry import umeyama_alignment
    from evo.core.lie_algebra import se3

    if alignment == "none":
        return np.eye(4), 1.0, ""
    if alignment == "origin":
        return np.asarray(est.align_origin(gt)), 1.0, ""
    x, y = est.positions_xyz, gt.positions_xyz
    reason = _degeneracy(x, y)
    if reason:
        return np.eye(4), 1.0, reason
    try:
        R, t, s = umeyama_alignment(x.T, y.T, with_scale=alignment == "sim3")
    except (EvoException, np.linalg.LinAlgError) as error:
        return np.eye(4), 1.0, f"evo: {error}"
    if alignment == "sim3" and scale == "norms":
        # |y|^2 / <y, R x>: the inverse of the factor that brings the truth onto the estimate;
        # larger than Umeyama's <y, R x> / |x|^2
        centred = y - y.mean(axis=0)
        dots = float((centred * (x @ R.T)).sum())
        s = float((centred**2).sum()) / dots if dots > 0 else 0.0
        t = y.mean(axis=0) - s * (R @ x.mean(axis=0))
    if s <= 0:
        return np.eye(4), 1.0, "the paths are not correlated: no positive scale fits"
    est.scale(s)
    est.transform(se3(R, t))
    return se3(R, t), float(s), ""


def _check_options(alignment: str, scale: str) -> None:
    if alignment not in ("se3", "sim3", "origin", "none"):
        raise InputError(f"alignment: expected se3, sim3, origin or none, got {alignment!r}.")
    if scale not in ("umeyama", "norms"):
        raise InputError(f"scale: expected umeyama or norms, got {scale!r}.")


def _statistics(errors: np.ndarray) -> dict[str, float] | None:
    """rmse, mean, median and max of the errors, or None where one of them is not finite."""
    values = {
        "rmse": float(np.sqrt(np.mean(errors**2))),
        "mean": float(np.mean(errors)),
        "median": float(np.median(errors)),
        "max": float(np.max(errors)),
    }
    return values if np.isfinite(list(values.values())).all() else None


_NOT_FINITE = "positions too large: the error is not a finite number"


def _ape(est: Any, gt: Any) -> np.ndarray:
    from evo.core.metrics import APE, PoseRelation

    metric = APE(PoseRelation.translation_part)
    metric.process_data((gt, est))
    return np.asarray(metric.error, dtype=np.float64)


@np.errstate(over="ignore", invalid="ignore")
def ate(
    est: Trajectory,
    gt: Trajectory,
    alignment: Alignment = "se3",
    *,
    scale: Scale = "umeyama",
    max_diff: float | None = None,
    association: Association | None = None,
) -> AbsoluteError:
    """Absolute trajectory error through evo.

    Args:
        est: estimated trajectory.
        gt: true trajectory.
        alignment: ``se3`` (rigid, least squares over all positions: the rule for metric methods),
            ``sim3`` (with scale), ``origin`` (first matched poses made equal), ``none``.
        scale: with ``sim3``: ``umeyama``, or ``norms`` (squared norm of the truth over its dot
            product with the estimate, as TartanAir's evaluator scales).
        max_diff: see :func:`associate`.
        association: matches found before, to save the search.

    Returns:
        The error; None with a reason where it cannot be computed. Never raises on what the
        trajectories hold.

    Raises:
        InputError: an unknown option.
    """
    _check_options(alignment, scale)
    match = association or associate(est, gt, max_diff=max_diff)
    names = ("rmse", "mean", "median", "max")
    reasons: dict[str, str] = {}
    statistics: dict[str, float] | None = None
    unaligned: float | None = None
    T_gt_est = errors = stamps = factor = None
    if match.reason:
        reasons = dict.fromkeys((*names, "rmse_unaligned", "scale"), match.reason)
    else:
        est_path, gt_path = _to_evo(est, match.est_indices), _to_evo(gt, match.gt_indices)
        raw = _statistics(_ape(est_path, gt_path))
        if raw:
            unaligned = raw["rmse"]
        else:
            reasons["rmse_unaligned"] = _NOT_FINITE
        T, s, reason = _align(est_path, gt_path, alignment, scale)
        if not reason:
            found = _ape(est_path, gt_path)
            statistics = _statistics(found)
            reason = "" if statistics else _NOT_FINITE
        if reason:
            reasons.update(dict.fromkeys((*names, "scale"), reason))
        else:
            T_gt_est, factor, errors, stamps = T, s, found, gt.timestamps[match.gt_indices]
    return AbsoluteError(
        **{name: statistics[name] if statistics else None for name in names},
        rmse_unaligned=unaligned,
        alignment=alignment,
        scale=factor,
        scale_kind=scale,
        matched=match.matched,
        total=match.total,
        evo_version=_evo_version(),
        reasons=reasons,
        T_gt_est=T_gt_est,
        errors=errors,
        timestamps=stamps,
    )


@np.errstate(over="ignore", invalid="ignore")
def rpe(
    est: Trajectory,
    gt: Trajectory,
    delta: int = 1,
    alignment: Alignment = "se3",
    *,
    scale: Scale = "umeyama",
    max_diff: float | None = None,
    association: Association | None = None,
) -> RelativeError:
    """Relative pose error over ``delta`` matched frames through evo, all (overlapping) pairs.

    Args:
        est: estimated trajectory.
        gt: true trajectory.
        delta: frames between the two poses of a pair.
        alignment: only ``sim3`` changes the values: its scale is applied to the estimate.
        scale: see :func:`ate`.
        max_diff: see :func:`associate`.
        association: matches found before, to save the search.

    Returns:
        The error; None with a reason where it cannot be computed. Two poses are enough unless a
        scale is wanted.

    Raises:
        InputError: an unknown option, or ``delta`` below 1.
    """
    _check_options(alignment, scale)
    if isinstance(delta, bool) or not isinstance(delta, Real) or delta % 1 or delta < 1:
        raise InputError(f"delta: expected a number of frames >= 1, got {delta!r}.")
    match = association or associate(est, gt, max_diff=max_diff)
    reason, factor = match.reason, 1.0
    if not reason and match.matched <= delta:
        reason = f"not enough poses: {match.matched} matched, a pair spans {delta + 1}"
    trans = rot = None
    if not reason:
        est_path, gt_path = _to_evo(est, match.est_indices), _to_evo(gt, match.gt_indices)
        if alignment == "sim3":
            _, factor, reason = _align(est_path, gt_path, alignment, scale)
    if not reason:
        from evo.core.metrics import RPE, PoseRelation, Unit

        metric = RPE(PoseRelation.translation_part, int(delta), Unit.frames, all_pairs=True)
        metric.process_data((gt_path, est_path))
        trans = _statistics(np.asarray(metric.error, dtype=np.float64))
        # evo's formula for the angles, for all pairs at once: one by one they took most of the time
        turns = Rotation.from_matrix(np.array(metric.E)[:, :3, :3]).as_rotvec()
        rot = _statistics(np.rad2deg(np.linalg.norm(turns, axis=1)))
    values: dict[str, float | None] = {}
    reasons: dict[str, str] = {}
    for prefix, suffix, statistics in (("trans", "", trans), ("rot", "_deg", rot)):
        for name in ("rmse", "mean", "median"):
            key = f"{prefix}_{name}{suffix}"
            values[key] = statistics[name] if statistics else None
            if statistics is None:
                reasons[key] = reason or _NOT_FINITE
    return RelativeError(
        **values,
        delta=int(delta),
        pairs=0 if reason else match.matched - int(delta),
        alignment=alignment,
        scale=None if reason else factor,
        matched=match.matched,
        total=match.total,
        evo_version=_evo_version(),
        reasons=reasons,
    )


@np.errstate(over="ignore", invalid="ignore")
def evaluate_trajectories(
    est: Trajectory,
    gt: Trajectory,
    *,
    alignment: Alignment = "se3",
    scale: Scale = "umeyama",
    delta: int = 1,
    max_diff: float | None = None,
    start_step: int = 1,
) -> dict[str, Any]:
    """Every trajectory error of one estimate, JSON-ready.

    Args:
        est: estimated trajectory.
        gt: true trajectory.
        alignment: of ``ate_rmse`` and its companions; ``se3`` for metric methods.
        scale: see :func:`ate`.
        delta: frames of the relative error.
        max_diff: see :func:`associate`.
        start_step: frames between the starts of the KITTI drift.

    Returns:
        ``ate_rmse``, ``ate_mean``, ``ate_median``, ``ate_max`` (m, ``alignment``),
        ``ate_rmse_unaligned``, ``ate_rmse_origin``, ``ate_rmse_sim3`` with ``scale_sim3`` and
        ``ate_rmse_norms`` with ``scale_norms``; ``rpe_trans_rmse`` (m) and ``rpe_rot_rmse_deg``;
        ``kitti_drift`` (100 to 800 m) and ``kitti_drift_short`` (5 to 40 m); ``alignment``,
        ``scale``, ``matched``, ``total``, ``evo_version``; ``reasons`` for every None.

    Raises:
        InputError: an unknown option.
    """
    match = associate(est, gt, max_diff=max_diff)
    main = ate(est, gt, alignment, scale=scale, association=match)
    others = {
        "origin": ate(est, gt, "origin", association=match),
        "sim3": ate(est, gt, "sim3", association=match),
        "norms": ate(est, gt, "sim3", scale="norms", association=match),
    }
    relative = rpe(est, gt, delta, alignment, scale=scale, association=match)
    report: dict[str, Any] = {
        "alignment": alignment,
        "scale": main.scale,
        "scale_kind": scale,
        "delta_frames": int(delta),
        "matched": match.matched,
        "total": match.total,
        "matched_by": match.by,
        "max_time_difference_s": match.max_diff,
        "poses_estimate": len(est),
        "poses_truth": len(gt),
        "evo_version": main.evo_version,
    }
    reasons: dict[str, str] = {}
    for key, trajectory in (("length_estimate_m", est), ("length_truth_m", gt)):
        report[key] = trajectory.length if np.isfinite(trajectory.length) else None
        if report[key] is None:
            reasons[key] = _NOT_FINITE

    def put(key: str, result: AbsoluteError | RelativeError, name: str) -> None:
        report[key] = getattr(result, name)
        if name in result.reasons:
            reasons[key] = result.reasons[name]

    for name in ("rmse", "mean", "median", "max", "rmse_unaligned"):
        put(f"ate_{name}", main, name)
    for label, result in others.items():
        put(f"ate_rmse_{label}", result, "rmse")
        if label != "origin":
            put(f"scale_{label}", result, "scale")
    for name in ("trans_rmse", "trans_mean", "trans_median"):
        put(f"rpe_{name}", relative, name)
    for name in ("rot_rmse_deg", "rot_mean_deg", "rot_median_deg"):
        put(f"rpe_{name}", relative, name)
    if "scale" in main.reasons:
        reasons["scale"] = main.reasons["scale"]
    for key, lengths in (("kitti_drift", KITTI_LENGTHS), ("kitti_drift_short", SHORT_LENGTHS)):
        report[key] = None
        if match.reason:
            reasons[key] = match.reason
        else:
            drift = kitti_drift(
                est.T_world_cam[match.est_indices],
                gt.T_world_cam[match.gt_indices],
                lengths=lengths,
                start_step=start_step,
            )
            report[key] = drift.to_dict()
    report["reasons"] = reasons
    return report


def evaluate_files(
    est_path: str | os.PathLike[str],
    gt_path: str | os.PathLike[str],
    *,
    format_est: Format = "auto",
    format_gt: Format = "auto",
    axes_est: Axes = "auto",
    axes_gt: Axes = "auto",
    **options: Any,
) -> dict[str, Any]:
    """Every trajectory error between two files: what ``hybridvo evaluate EST GT`` prints.

    Args:
        est_path: estimated trajectory.
        gt_path: true trajectory.
        format_est: see :func:`hybridvo.trajectory.read_trajectory`.
        format_gt: the same for the truth.
        axes_est: see :func:`hybridvo.trajectory.read_trajectory`.
        axes_gt: the same for the truth.
        **options: of :func:`evaluate_trajectories`.

    Returns:
        The report of :func:`evaluate_trajectories` with ``estimate``, ``truth`` (paths) and
        ``notices`` (what the readers changed).

    Raises:
        InputError: a file that is missing or malformed (the message names file and line), or an
            unknown option.
    """
    unknown = set(options) - set(inspect.signature(evaluate_trajectories).parameters)
    if unknown:
        raise InputError(f"evaluate_files: unknown option {', '.join(sorted(unknown))}.")
    est = read_trajectory(est_path, format_est, axes=axes_est)
    gt = read_trajectory(gt_path, format_gt, axes=axes_gt)
    report = evaluate_trajectories(est, gt, **options)
    report["estimate"], report["truth"] = os.fsdecode(est_path), os.fsdecode(gt_path)
    report["notices"] = [*est.warnings, *gt.warnings]
    return report
