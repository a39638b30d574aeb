"""Errors of a trajectory against ground truth: ATE and RPE through evo, drift as KITTI measures it.

What the paths do not determine is a :class:`DegenerateError`; a report holds None and its reason.
"""

from __future__ import annotations

import functools
import os
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from typing import Any, Literal, get_args

import numpy as np
from scipy.spatial.transform import Rotation

from hybridvo.data.lists import MAX_STAMP_DIFFERENCE_S
from hybridvo.data.lists import associate as associate_stamps
from hybridvo.errors import DegenerateError, InputError
from hybridvo.geometry import invert, rotation_angle
from hybridvo.trajectory import Trajectory, read_trajectory

Alignment = Literal["se3", "sim3", "origin", "none"]
DeltaUnit = Literal["frames", "s"]

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
    """Poses of two trajectories that belong together: (M,) indices into each.

    ``total`` counts the poses of the shorter one, ``by`` is ``time`` or ``index``, ``reason`` says
    why no error can be computed from the matches, ``max_diff`` is in seconds.
    """

    est_indices: np.ndarray
    gt_indices: np.ndarray
    total: int
    by: str
    max_diff: float | None = None
    reason: str = ""


@dataclass(frozen=True, eq=False)
class TrajectoryError:
    """Errors of matched poses: (M,) metres and degrees at (M,) stamps of the ground truth.

    An estimated position p was taken as ``T_gt_est @ (scale p)``.
    """

    translation: np.ndarray
    rotation_deg: np.ndarray
    timestamps: np.ndarray
    scale: float
    T_gt_est: np.ndarray

    def __post_init__(self) -> None:
        with np.errstate(over="ignore", invalid="ignore"):
            if not np.isfinite(self.translation**2).all():
                raise DegenerateError(NOT_FINITE)

    @property
    def rmse(self) -> float:
        """Root mean square of the translation errors, metres."""
        return float(np.sqrt(np.mean(self.translation**2)))

    @property
    def rotation_rmse_deg(self) -> float:
        """Root mean square of the rotation errors, degrees."""
        return float(np.sqrt(np.mean(self.rotation_deg**2)))


def associate(est: Trajectory, gt: Trajectory, *, max_diff: float | None = None) -> Association:
    """Match poses one to one: by nearest timestamp, or by index where one has no timestamps.

    ``max_diff`` is the largest difference of matched timestamps, seconds; by default 0.02, or half
    the median spacing of the sparser trajectory if that is smaller.
    """
    total, reason = min(len(est), len(gt)), ""
    if not (est.has_timestamps and gt.has_timestamps):
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
    if 2 * len(i) < total:
        reason = (
            f"only {len(i)} of {total} poses match within {max_diff:.4g} s (estimate "
            f"{est.timestamps[0]:.6f} to {est.timestamps[-1]:.6f} s, ground truth "
            f"{gt.timestamps[0]:.6f} to {gt.timestamps[-1]:.6f} s)"
        )
    return Association(i, j, total, "time", max_diff, reason)


def _evo_paths(est: Trajectory, gt: Trajectory, match: Association | None) -> tuple[Any, ...]:
    """Matched poses as evo's paths (copies: evo aligns in place), and the true stamps."""
    from evo.core.trajectory import PosePath3D

    match = match or associate(est, gt)
    if match.reason:
        raise DegenerateError(match.reason)
    matched = (est.T_world_cam[match.est_indices], gt.T_world_cam[match.gt_indices])
    paths = (PosePath3D(poses_se3=[T.copy() for T in poses]) for poses in matched)
    return (*paths, gt.timestamps[match.gt_indices])


def _check_width(est: np.ndarray, gt: np.ndarray) -> None:
    """Refuse (M, 3) positions of estimate and truth that determine no alignment."""
    if len(est) < 3:
        raise DegenerateError(f"not enough poses: {len(est)} matched, an alignment needs 3")
    centred = []
    for name, positions in (("estimate", est), ("ground truth", gt)):
        moved = positions - positions.mean(axis=0)
        size = float(np.linalg.norm(moved))
        if not np.isfinite(size):
            raise DegenerateError(NOT_FINITE)
        if size <= 1e-12 * float(np.abs(positions).max()):
            raise DegenerateError(f"static camera: the positions of the {name} do not move")
        centred.append(moved / size)
    if np.linalg.svd(centred[1].T @ centred[0], compute_uv=False)[1] <= MIN_WIDTH:
        raise DegenerateError("straight line: the camera path leaves the rotation about it open")


@np.errstate(over="ignore", invalid="ignore")
def _align(est: Any, gt: Any, alignment: Alignment) -> tuple[np.ndarray, float]:
    """Align the evo path ``est`` to ``gt`` in place: T_gt_est and scale."""
    from evo import EvoException

    T = np.eye(4)
    if alignment == "none":
        return T, 1.0
    if alignment == "origin":
        return np.asarray(est.align_origin(gt)), 1.0
    _check_width(est.positions_xyz, gt.positions_xyz)
    try:
        T[:3, :3], T[:3, 3], scale = est.align(gt, correct_scale=alignment == "sim3")
    except (EvoException, np.linalg.LinAlgError) as error:
        raise DegenerateError(f"evo: {error}") from error
    if scale <= 0:
        raise DegenerateError("the paths are not correlated: no positive scale fits")
    return T, float(scale)


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

    Raises:
        DegenerateError: too few poses match, or they determine no alignment.
    """
    from evo.core.metrics import APE, PoseRelation

    path, true_path, stamps = _evo_paths(est, gt, association)
    T, scale = _align(path, true_path, alignment)
    metric = APE(PoseRelation.translation_part)
    with np.errstate(over="ignore", invalid="ignore"):
        metric.process_data((true_path, path))
    return TrajectoryError(np.asarray(metric.error), np.zeros(0), stamps, scale, T)


def aligned(
    est: Trajectory, gt: Trajectory, alignment: Alignment = "se3"
) -> tuple[Trajectory, TrajectoryError | None, Alignment]:
    """Estimate in the truth's world by the best alignment that the paths determine, and its ATE.

    Paths of which nothing matches start at the same place, and their error is None.
    """
    kinds: tuple[Alignment, ...] = (alignment, "origin")
    for kind in kinds:
        try:
            error = ate(est, gt, kind)
        except DegenerateError:
            continue
        return est.transformed(error.T_gt_est, error.scale), error, kind
    return est.transformed(gt.T_world_cam[0] @ invert(est.T_world_cam[0])), None, "origin"


def rpe(
    est: Trajectory,
    gt: Trajectory,
    delta: float = 1,
    delta_unit: DeltaUnit = "frames",
    alignment: Alignment = "se3",
    *,
    association: Association | None = None,
) -> TrajectoryError:
    """Relative pose error over all (overlapping) pairs of poses that are ``delta`` apart.

    In seconds the partner is the pose nearest to that time, at most half a frame away. Only
    ``sim3`` changes the values: its scale is applied to the estimate.

    Raises:
        DegenerateError: too few poses match, or no two are ``delta`` apart.
    """
    from evo.core.metrics import RPE

    match = association or associate(est, gt)
    path, true_path, stamps = _evo_paths(est, gt, match)
    if delta_unit == "s" and match.by != "time":
        raise DegenerateError("a distance in seconds needs timestamps in both trajectories")
    first, last = _pairs(stamps, delta, delta_unit)
    if not len(first):
        reason = f"not enough poses: of {len(stamps)} no two are {delta:g} {delta_unit} apart"
        raise DegenerateError(reason)
    T, scale = _align(path, true_path, "sim3" if alignment == "sim3" else "none")
    P, Q = path.poses_se3, true_path.poses_se3
    with np.errstate(over="ignore", invalid="ignore"):
        pairs = zip(first, last, strict=True)
        E = np.array([RPE.rpe_base(Q[i], Q[j], P[i], P[j]) for i, j in pairs])
        translation = np.linalg.norm(E[:, :3, 3], axis=1)
    angles = np.degrees(Rotation.from_matrix(E[:, :3, :3]).magnitude())
    return TrajectoryError(translation, angles, stamps[first], scale, T)


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


@np.errstate(over="ignore", invalid="ignore")
def kitti_drift(
    T_world_cam_est: np.ndarray,
    T_world_cam_gt: np.ndarray,
    *,
    lengths: Sequence[float] = KITTI_LENGTHS,
) -> dict[str, Any]:
    """Drift of (N, 4, 4) poses as KITTI's odometry benchmark defines it (Geiger et al., CVPR 2012).

    From every frame and for every length L (m), the sub-path ends at the first frame whose distance
    along the true path exceeds L; translation (a fraction) and angle of its relative error are
    divided by L and averaged within each length, then over the lengths. Nothing is aligned.
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
    names = ("translation", "rotation_deg_per_m")
    found = {n: v if np.isfinite(v) else None for n, v in zip(names, values, strict=True)}
    short = f"the true path of {distance[-1]:.4g} m is shorter than {min(lengths):g} m"
    return {
        **found,
        "segments": segments,
        "reasons": {n: NOT_FINITE if means else short for n in names if found[n] is None},
    }


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

    ``alignment`` is that of ``ate_rmse`` (m), ``delta`` that of the relative error, ``max_diff``
    (s) the largest difference of matched timestamps. The suffix ``_sim3`` is after a similarity,
    ``kitti_drift`` over 100 to 800 m, ``kitti_drift_short`` over 5 to 40 m; ``reasons`` holds why
    a value is None.

    """
    import evo

    _check(estimate, gt, alignment, delta, delta_unit, max_diff)
    match = associate(estimate, gt, max_diff=max_diff)
    report: dict[str, Any] = {"alignment": alignment, "delta": float(delta)}
    report |= {"delta_unit": delta_unit, "matched": len(match.est_indices), "total": match.total}
    report |= {"matched_by": match.by, "evo_version": str(evo.__version__).lstrip("v")}
    reasons: dict[str, str] = {}

    def put(names: Sequence[str], compute: Callable[[], Iterable[float | None]]) -> None:
        try:
            values = compute()
        except DegenerateError as error:
            values = [None] * len(names)
            reasons.update(dict.fromkeys(names, str(error)))
        report.update(zip(names, values, strict=False))

    def absolute(kind: Alignment) -> tuple[float, float]:
        error = ate(estimate, gt, kind, association=match)
        return error.rmse, error.scale

    def relative(kind: Alignment) -> tuple[float, float, float]:
        error = rpe(estimate, gt, delta, delta_unit, kind, association=match)
        return error.rmse, float(error.translation.mean()), error.rotation_rmse_deg

    put(["ate_rmse_unaligned"], lambda: absolute("none"))
    put(["ate_rmse_origin"], lambda: absolute("origin"))
    kinds: tuple[tuple[Alignment, str], ...] = ((alignment, ""), ("sim3", "_sim3"))
    for kind, suffix in kinds:
        put([f"ate_rmse{suffix}", f"scale{suffix}"], functools.partial(absolute, kind))
        names = ("rpe_trans_rmse", "rpe_trans_mean", "rpe_rot_rmse_deg")
        put([name + suffix for name in names], functools.partial(relative, kind))
    poses = estimate.T_world_cam[match.est_indices], gt.T_world_cam[match.gt_indices]
    for key, lengths in (("kitti_drift", KITTI_LENGTHS), ("kitti_drift_short", SHORT_LENGTHS)):
        report[key] = None if match.reason else kitti_drift(*poses, lengths=lengths)
        reasons |= {key: match.reason} if match.reason else {}
    return report | {"reasons": reasons}


def _check(
    estimate: Any, gt: Any, alignment: str, delta: float, delta_unit: str, max_diff: float | None
) -> None:
    """Refuse arguments of :func:`evaluate` that cannot be meant."""
    paths = [
        (name, isinstance(path, Trajectory), "a Trajectory (read_trajectory)", type(path).__name__)
        for name, path in (("estimate", estimate), ("gt", gt))
    ]
    is_whole = delta_unit != "frames" or float(delta).is_integer()
    for name, is_good, expected, got in (
        *paths,
        ("alignment", alignment in get_args(Alignment), "se3, sim3, origin or none", alignment),
        ("delta_unit", delta_unit in get_args(DeltaUnit), "frames or s", delta_unit),
        ("delta", 0 < delta < np.inf and is_whole, f"a positive number of {delta_unit}", delta),
        ("max_diff", max_diff is None or 0 <= max_diff < np.inf, "seconds >= 0", max_diff),
    ):
        if not is_good:
            raise InputError(f"{name}: expected {expected}, got {got!r}.")


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
    :func:`evaluate`; its report also has ``estimate``, ``gt`` (paths) and ``warnings``.
    """
    est = read_trajectory(est_path, format_est, axes=axes_est)
    gt = read_trajectory(gt_path, format_gt, axes=axes_gt)
    report = evaluate(est, gt, **options)
    report["estimate"], report["gt"] = os.fsdecode(est_path), os.fsdecode(gt_path)
    report["warnings"] = [*est.warnings, *gt.warnings]
    return report
