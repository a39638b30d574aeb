"""Errors of a trajectory against the ground truth: ATE and RPE as evo has them, drift as KITTI.

Tests compare them with evo's, which is under GPL and therefore not used here.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, Literal, NamedTuple, get_args

import numpy as np

from hybridvo.core.checks import as_number
from hybridvo.core.errors import DegenerateError, InputError
from hybridvo.core.geometry import invert, make_transform, rotation_angle
from hybridvo.core.trajectory import Trajectory, read_trajectory
from hybridvo.io.calibration import MAX_STAMP_DIFFERENCE_S

# m: a double resolves 0.1 mm there; beyond it errors of millimetres are rounding,
# and squares of 1e160 overflow
MAX_COORDINATE_M = 1e12
# fraction of the poses that must match in time; below it clocks or units differ
MIN_MATCHED_RATIO = 0.5

Alignment = Literal["se3", "sim3", "origin", "none"]
DeltaUnit = Literal["frames", "s"]

KITTI_LENGTHS = tuple(range(100, 801, 100))
"""Lengths of the sub-paths of KITTI's odometry benchmark, metres."""
STAMP_ROUNDING = 1.01
"""Factor on half a frame that allows for the rounding of time stamps."""


class Match(NamedTuple):
    """The poses of an estimate and of the ground truth that belong together."""

    est: np.ndarray  # (M, 4, 4) T_world_cam
    gt: np.ndarray  # (M, 4, 4) T_world_cam
    stamps: np.ndarray  # (M,) seconds, of the ground truth
    by: str  # time or index
    reason: str  # why no error can be computed; empty where it can


class PathError(NamedTuple):
    """The distances of matched positions after an alignment.

    A position p of the estimate was compared as ``T_gt_est @ (scale * p)``.
    """

    translation: np.ndarray  # (M,) metres
    stamps: np.ndarray  # (M,) seconds
    rmse: float  # metres
    T_gt_est: np.ndarray  # (4, 4)
    scale: float


class AlignedPath(NamedTuple):
    """An estimate in the world frame of the ground truth."""

    trajectory: Trajectory
    error: PathError | None  # None where nothing matches
    kind: Alignment  # the alignment that was possible


class RelativeErrors(NamedTuple):
    """Errors of motions between two poses."""

    translation: np.ndarray  # (M,) metres
    rotation_deg: np.ndarray  # (M,) degrees


# -- matching ----------------------------------------------------------------------------


def match(
    est: Trajectory, gt: Trajectory, max_diff: float = MAX_STAMP_DIFFERENCE_S
) -> Match:
    """Match poses by the nearest time stamp, or by index where one path has no time stamps.

    Each pose of the path with fewer of them gets the nearest one of the other.

    Args:
        est: The estimate.
        gt: The ground truth.
        max_diff: Largest difference of stamps that belong together, seconds.
    """
    if not (est.has_timestamps and gt.has_timestamps):
        return _match_by_index(est, gt)
    if len(gt) > len(est):
        j = _nearest(est.timestamps, gt.timestamps, max_diff)
        i = np.flatnonzero(j >= 0)
        j = j[i]
    else:
        i = _nearest(gt.timestamps, est.timestamps, max_diff)
        j = np.flatnonzero(i >= 0)
        i = i[j]
    total = min(len(est), len(gt))
    reason = ""
    if len(i) < MIN_MATCHED_RATIO * total:
        reason = (
            f"only {len(i)} of {total} poses match within {max_diff:.4g} s "
            f"(estimate {_span(est)} s, ground truth {_span(gt)} s)"
        )
    return Match(
        est.T_world_cam[i], gt.T_world_cam[j], gt.timestamps[j], "time", reason
    )


def _nearest(wanted: np.ndarray, stamps: np.ndarray, max_diff: float) -> np.ndarray:
    """Return the place of the nearest of ``stamps``, which increase; -1 where none is near enough.

    Of two that are as near it is the earlier one.
    """
    middles = (stamps[:-1] + stamps[1:]) / 2
    places = np.searchsorted(middles, wanted)
    is_near = np.abs(stamps[places] - wanted) <= max_diff
    return np.where(is_near, places, -1)


def _match_by_index(est: Trajectory, gt: Trajectory) -> Match:
    """Match the first pose to the first one, and so on; both paths must have as many."""
    count = len(est) if len(est) == len(gt) else 0
    reason = ""
    if not count:
        reason = (
            "poses without timestamps can only be matched one by one, but the estimate "
            f"has {len(est)} and the ground truth {len(gt)}"
        )
    return Match(
        est.T_world_cam[:count],
        gt.T_world_cam[:count],
        gt.timestamps[:count],
        "index",
        reason,
    )


def _span(path: Trajectory) -> str:
    """Return the first and the last time stamp, for a message."""
    return f"{path.timestamps[0]:.6f} to {path.timestamps[-1]:.6f}"


# -- absolute errors ---------------------------------------------------------------------


def ate(matched: Match, alignment: Alignment = "se3") -> PathError:
    """Compute the absolute trajectory error: distances of matched positions after an alignment.

    Args:
        matched: The poses.
        alignment: ``se3`` is rigid, ``sim3`` has a scale too, ``origin`` makes the first matched
            poses equal, ``none`` leaves the estimate as it is.

    Raises:
        DegenerateError: The poses do not determine the alignment.
    """
    est = matched.est[:, :3, 3]
    gt = matched.gt[:, :3, 3]
    T_gt_est, scale = _alignment(matched, alignment)
    moved = scale * est @ T_gt_est[:3, :3].T + T_gt_est[:3, 3]
    distances = np.linalg.norm(moved - gt, axis=1)
    return PathError(distances, matched.stamps, rms(distances), T_gt_est, scale)


def _alignment(matched: Match, alignment: Alignment) -> tuple[np.ndarray, float]:
    """Return the transform (4, 4) and the scale that align an estimate to the ground truth."""
    if alignment == "none":
        return np.eye(4), 1.0
    if alignment == "origin":
        return matched.gt[0] @ invert(matched.est[0]), 1.0
    return umeyama(
        matched.est[:, :3, 3], matched.gt[:, :3, 3], with_scale=alignment == "sim3"
    )


def umeyama(
    points: np.ndarray, targets: np.ndarray, *, with_scale: bool
) -> tuple[np.ndarray, float]:
    """Return the transform (4, 4) and the scale s for which T (s p) is nearest to the targets.

    S. Umeyama, "Least-squares estimation of transformation parameters between two point
    patterns", PAMI 1991.

    Args:
        points: (N, 3).
        targets: (N, 3).
        with_scale: Whether the scale is sought; else it is 1.

    Raises:
        DegenerateError: The points are fewer than three, or on a line.
    """
    centre = points.mean(axis=0)
    target_centre = targets.mean(axis=0)
    spread = points - centre
    covariance = (targets - target_centre).T @ spread / len(points)
    U, sizes, Vt = np.linalg.svd(covariance)
    if sizes[1] <= np.finfo(float).eps:
        reason = "not enough poses, or all in one place or on a line: an alignment needs more"
        raise DegenerateError(reason)
    # a mirror image is no rotation
    signs = np.array([1.0, 1.0, np.sign(np.linalg.det(U @ Vt))])
    R = U @ np.diag(signs) @ Vt
    scale = 1.0
    if with_scale:
        scale = float(sizes @ signs / np.mean(np.sum(spread**2, axis=1)))
    return make_transform(R, target_centre - scale * R @ centre), scale


def aligned(est: Trajectory, gt: Trajectory) -> AlignedPath:
    """Align an estimate to the ground truth, rigidly if the poses allow it, else by the first
    poses.

    Paths of which nothing matches start at the same place.
    """
    matched = match(est, gt)
    if matched.reason:
        T_gt_est = gt.T_world_cam[0] @ invert(est.T_world_cam[0])
        return AlignedPath(est.transformed(T_gt_est), None, "origin")
    kind: Alignment = "se3"
    try:
        error = ate(matched, kind)
    except DegenerateError:
        kind = "origin"
        error = ate(matched, kind)
    return AlignedPath(est.transformed(error.T_gt_est), error, kind)


# -- relative errors ---------------------------------------------------------------------


def rpe(
    matched: Match, delta: float = 1, delta_unit: DeltaUnit = "frames"
) -> RelativeErrors:
    """Compute the relative pose errors of all pairs of poses that are ``delta`` apart.

    The pairs overlap.

    Args:
        matched: The poses.
        delta: The span.
        delta_unit: ``frames``, or ``s``: the partner of a pose is then the one that is nearest to
            that time, at most half a frame away.

    Raises:
        DegenerateError: No two poses are that far apart, or the poses have no times.
    """
    count = len(matched.stamps)
    if delta_unit == "s":
        first, last = _a_time_apart(matched, delta)
    else:
        # a span may be longer than an integer of numpy holds
        first = np.arange(max(count - int(delta), 0))
        last = first + min(int(delta), count)
    if not len(first):
        raise DegenerateError(
            f"not enough poses: of {count} no two are {delta:g} {delta_unit} apart"
        )
    return errors_between(matched, first, last)


def rpe_over_a_second(estimate: Trajectory, gt: Trajectory) -> dict[str, Any]:
    """Compute the relative errors over one second, as TUM's benchmark prints them; JSON-ready.

    Returns:
        ``rpe_trans_rmse_s`` (m/s), ``rpe_rot_rmse_deg_s`` (deg/s), or None with a reason in
        ``reasons_s``.
    """
    names = ("rpe_trans_rmse_s", "rpe_rot_rmse_deg_s")
    matched = match(estimate, gt)
    try:
        if matched.reason:
            raise DegenerateError(matched.reason)
        errors = rpe(matched, 1.0, "s")
    except DegenerateError as error:
        return {**dict.fromkeys(names), "reasons_s": str(error)}
    values = (rms(errors.translation), rms(errors.rotation_deg))
    return dict(zip(names, values, strict=True))


def _a_time_apart(matched: Match, delta: float) -> tuple[np.ndarray, np.ndarray]:
    """Return the places of poses, and of those that are ``delta`` seconds later."""
    if matched.by != "time":
        raise DegenerateError(
            "a distance in seconds needs timestamps in both trajectories"
        )
    stamps = matched.stamps
    half_frame = np.median(np.diff(stamps)) / 2 if len(stamps) > 1 else 0.0
    last = _nearest(stamps + delta, stamps, STAMP_ROUNDING * half_frame)
    first = np.flatnonzero(last > np.arange(len(stamps)))
    return first, last[first]


def errors_between(
    matched: Match, first: np.ndarray, last: np.ndarray
) -> RelativeErrors:
    """Compute the errors of the motions between poses, given by their places (K,)."""
    est_motion = invert(matched.est[first]) @ matched.est[last]
    gt_motion = invert(matched.gt[first]) @ matched.gt[last]
    error = invert(est_motion) @ gt_motion
    return RelativeErrors(
        np.linalg.norm(error[:, :3, 3], axis=1),
        np.degrees(rotation_angle(error[:, :3, :3])),
    )


def kitti_drift(
    matched: Match, lengths: Sequence[float] = KITTI_LENGTHS
) -> dict[str, Any]:
    """Compute drift as KITTI's odometry benchmark defines it (Geiger et al., CVPR 2012).

    For every length it takes the motions from each frame to the first one that is farther along
    the true path. Their errors, divided by the length, are averaged within a length, then over
    the lengths.

    Args:
        matched: The poses.
        lengths: Lengths of the sub-paths, metres.

    Returns:
        ``translation``, a fraction of the path, and ``rotation_deg_per_m``.

    Raises:
        DegenerateError: The true path is shorter than every length.
    """
    gt = matched.gt
    steps = np.linalg.norm(np.diff(gt[:, :3, 3], axis=0), axis=1)
    distance = np.concatenate([[0.0], np.cumsum(steps)])
    means = []
    for length in lengths:
        last = np.searchsorted(distance, distance + length, side="right")
        (first,) = np.nonzero(last < len(gt))
        if len(first):
            errors = errors_between(matched, first, last[first])
            means.append([error.mean() / length for error in errors])
    if not means:
        reason = f"the true path of {distance[-1]:.4g} m is shorter than {min(lengths):g} m"
        raise DegenerateError(reason)
    translation, rotation = np.mean(means, axis=0).tolist()
    return {"translation": translation, "rotation_deg_per_m": rotation}


# -- all errors --------------------------------------------------------------------------


def evaluate(
    estimate: Trajectory | str | Path,
    gt: Trajectory | str | Path,
    *,
    alignment: Alignment = "se3",
    delta: float = 1,
    delta_unit: DeltaUnit = "frames",
    max_diff: float = MAX_STAMP_DIFFERENCE_S,
) -> dict[str, Any]:
    """Compute every error of a trajectory, or its file, against the ground truth; JSON-ready.

    Args:
        estimate: The trajectory, or a file in TUM's, KITTI's or TartanAir's form.
        gt: The ground truth, likewise.
        alignment: Of ``ate_rmse``: ``se3`` rigid, ``sim3`` with a scale, ``origin`` first poses
            equal, ``none``.
        delta: Span of the relative errors, in ``delta_unit``: ``frames`` or ``s``.
        delta_unit: See ``delta``.
        max_diff: Largest difference of stamps that belong together, seconds.

    Returns:
        A dictionary; a figure that cannot be computed is None, and ``reasons`` states why.

        - ``ate_rmse``: absolute trajectory error after the alignment, metres; ``scale`` is the
          alignment's (1 unless ``sim3``), ``alignment`` its name.
        - ``ate_rmse_origin``, ``ate_rmse_unaligned``: the same by first poses, and without any.
        - ``rpe_trans_rmse``, ``rpe_rot_rmse_deg``: relative errors over ``delta``, metres, degrees.
        - ``kitti_drift``: ``translation``, a fraction of the path, and ``rotation_deg_per_m``.
        - ``matched`` of ``total`` poses, ``matched_by`` ``time`` or ``index``.
        - ``delta``, ``delta_unit``, ``warnings`` of the files, ``reasons``.

    Raises:
        InputError: An argument is of no use, a file cannot be read, or a position is too far away.

    Example:
        >>> poses = np.tile(np.eye(4), (3, 1, 1))
        >>> poses[:, :3, 3] = [[0, 0, 0], [1, 0, 0], [1, 1, 0]]
        >>> path = Trajectory(np.arange(3), poses)
        >>> report = evaluate(path, path)
        >>> report["matched"], round(report["ate_rmse"], 9)
        (3, 0.0)
    """
    _check_choice("alignment", alignment, Alignment)
    _check_choice("delta_unit", delta_unit, DeltaUnit)
    delta = _checked_span(delta, delta_unit)
    max_diff = _checked_difference(max_diff)
    estimate = _read(estimate, "estimate")
    gt = _read(gt, "gt")
    matched = match(estimate, gt, max_diff)

    def absolute() -> dict[str, Any]:
        error = ate(matched, alignment)
        return {"ate_rmse": error.rmse, "scale": error.scale}

    def absolute_origin() -> dict[str, Any]:
        return {"ate_rmse_origin": ate(matched, "origin").rmse}

    def absolute_unaligned() -> dict[str, Any]:
        return {"ate_rmse_unaligned": ate(matched, "none").rmse}

    def relative() -> dict[str, Any]:
        errors = rpe(matched, delta, delta_unit)
        return {
            "rpe_trans_rmse": rms(errors.translation),
            "rpe_rot_rmse_deg": rms(errors.rotation_deg),
        }

    def drift() -> dict[str, Any]:
        return {"kitti_drift": kitti_drift(matched)}

    report: dict[str, Any] = {
        "alignment": alignment,
        "delta": delta,
        "delta_unit": delta_unit,
        "matched": len(matched.est),
        "matched_by": matched.by,
        "total": min(len(estimate), len(gt)),
        "reasons": {},
        "warnings": [*estimate.warnings, *gt.warnings],
    }
    _add_figures(report, matched, ("ate_rmse_unaligned",), absolute_unaligned)
    _add_figures(report, matched, ("ate_rmse_origin",), absolute_origin)
    _add_figures(report, matched, ("ate_rmse", "scale"), absolute)
    _add_figures(report, matched, ("rpe_trans_rmse", "rpe_rot_rmse_deg"), relative)
    _add_figures(report, matched, ("kitti_drift",), drift)
    return report


def _add_figures(
    report: dict[str, Any],
    matched: Match,
    names: Sequence[str],
    compute: Callable[[], Mapping[str, Any]],
) -> None:
    """Add figures to a report; None and a reason for each where they cannot be computed."""
    try:
        if matched.reason:
            raise DegenerateError(matched.reason)
        report.update(compute())
    except DegenerateError as error:
        for name in names:
            report[name] = None
            report["reasons"][name] = str(error)


def rms(errors: np.ndarray) -> float:
    """Return the root of the mean square."""
    return float(np.sqrt(np.mean(errors**2)))


# -- arguments ---------------------------------------------------------------------------


def _check_choice(name: str, value: Any, choices: Any) -> None:
    """Raise an InputError where a value is none of the texts of a Literal."""
    known = get_args(choices)
    # Arrays are no texts, and must not be compared.
    if not isinstance(value, str) or value not in known:
        expected = f"{', '.join(known[:-1])} or {known[-1]}"
        raise InputError(f"{name}: expected {expected}, got {value!r}.")


def _checked_span(delta: Any, delta_unit: DeltaUnit) -> float:
    """Return the span of the relative errors as a float; an InputError if it is of no use."""
    span = as_number(delta)
    is_positive = 0 < span < np.inf
    is_usable = delta_unit == "s" or span % 1 == 0
    if not (is_positive and is_usable):
        raise InputError(
            f"delta: expected a positive number of {delta_unit}, got {delta!r}."
        )
    return span


def _checked_difference(max_diff: Any) -> float:
    """Return the largest difference of stamps as a float; an InputError if it is of no use."""
    seconds = as_number(max_diff)
    if not 0 < seconds < np.inf:
        raise InputError(f"max_diff: expected seconds > 0, got {max_diff!r}.")
    return seconds


def _read(path: Trajectory | str | Path, name: str) -> Trajectory:
    """Return a trajectory as it is given, or read it from its file.

    Raises:
        InputError: The argument is neither, the file cannot be read, or a position is so far away
            that its errors are rounding.
    """
    if isinstance(path, Trajectory):
        where = name
        trajectory = path
    elif isinstance(path, str | Path):
        where = str(path)
        trajectory = _read_file(path)
    else:
        expected = "a Trajectory, or its file"
        raise InputError(f"{name}: expected {expected}, got {path!r}.")
    farthest = float(np.abs(trajectory.positions).max())
    if farthest > MAX_COORDINATE_M:
        expected = f"positions in metres, up to {MAX_COORDINATE_M:g}"
        raise InputError(f"{where}: expected {expected}, got {farthest:g}.")
    return trajectory


def _read_file(path: str | Path) -> Trajectory:
    """Read a trajectory; an InputError if the system refuses the file."""
    try:
        return read_trajectory(path)
    # a name that is too long, a folder that may not be read
    except OSError as error:
        raise InputError(
            f"{str(path)[:100]}: cannot be read: {error.strerror}."
        ) from None
