"""Errors of a trajectory against the truth: ATE, RPE, and drift as KITTI measures it."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from operator import attrgetter
from pathlib import Path
from typing import Any, Literal, NamedTuple, get_args

import numpy as np
import pandas as pd

from hybridvo.calibration import MAX_COORDINATE_M
from hybridvo.checks import as_number
from hybridvo.data.lists import MAX_STAMP_DIFFERENCE_S, associate
from hybridvo.errors import DegenerateError, InputError
from hybridvo.geometry import invert, make_transform, rotation_angle
from hybridvo.trajectory import Trajectory, read_trajectory

Alignment = Literal["se3", "sim3", "origin", "none"]
DeltaUnit = Literal["frames", "s"]

# metres: sub-paths of KITTI's odometry benchmark
KITTI_LENGTHS = tuple(range(100, 801, 100))


class Match(NamedTuple):
    """The poses of an estimate and of the truth that belong together."""

    est: np.ndarray  # (M, 4, 4)
    gt: np.ndarray  # (M, 4, 4)
    stamps: np.ndarray  # (M,) of the truth
    by: str  # time or index
    reason: str  # why no error can be computed; empty where it can


class PathError(NamedTuple):
    """The distances of matched positions after an alignment."""

    translation: np.ndarray  # (M,) metres
    stamps: np.ndarray  # (M,)
    rmse: float  # metres
    # (4, 4): a position p of the estimate was taken as T_gt_est @ (scale p)
    T_gt_est: np.ndarray
    scale: float


def match(
    est: Trajectory, gt: Trajectory, max_diff: float = MAX_STAMP_DIFFERENCE_S
) -> Match:
    """Match poses one to one by the nearest timestamp, or by index where one has no timestamps."""
    total = min(len(est), len(gt))
    by = "time"
    reason = ""
    if est.has_timestamps and gt.has_timestamps:
        pairs = associate(est.timestamps, gt.timestamps, max_diff)
        if 2 * len(pairs) < total:
            spans = (
                f"{path.timestamps[0]:.6f} to {path.timestamps[-1]:.6f}"
                for path in (est, gt)
            )
            reason = (
                f"only {len(pairs)} of {total} poses match within {max_diff:.4g} s "
            )
            reason += "(estimate {} s, ground truth {} s)".format(*spans)
    else:
        by = "index"
        pairs = [(i, i) for i in range(total if len(est) == len(gt) else 0)]
        if not pairs:
            reason = "poses without timestamps can only be matched one by one, but the estimate "
            reason += f"has {len(est)} and the ground truth {len(gt)}"
    i, j = np.array(pairs, dtype=int).reshape(-1, 2).T
    return Match(
        est.T_world_cam[i], gt.T_world_cam[j], gt.timestamps[j], by, reason
    )


def ate(found: Match, alignment: Alignment = "se3") -> PathError:
    """Compute the absolute trajectory error: distances of matched positions after an alignment.

    ``se3`` is rigid, ``sim3`` has a scale too, ``origin`` makes the first matched poses equal. A
    DegenerateError says that the poses do not determine the alignment.
    """
    est = found.est[:, :3, 3]
    gt = found.gt[:, :3, 3]
    T = np.eye(4)
    scale = 1.0
    if alignment == "origin":
        T = found.gt[0] @ invert(found.est[0])
    elif alignment != "none":
        from evo.core.geometry import GeometryException, umeyama_alignment

        try:
            R, t, scale = umeyama_alignment(
                est.T, gt.T, with_scale=alignment == "sim3"
            )
        except GeometryException:
            reason = "not enough poses, or all in one place or on a line: an alignment needs more"
            raise DegenerateError(reason) from None
        T = make_transform(R, t)
    error = np.linalg.norm(scale * est @ T[:3, :3].T + T[:3, 3] - gt, axis=1)
    return PathError(
        error, found.stamps, np.sqrt(np.mean(error**2)).item(), T, float(scale)
    )


def aligned(
    est: Trajectory, gt: Trajectory
) -> tuple[Trajectory, PathError | None, Alignment]:
    """Align an estimate to the truth; returns it, its ATE, and which alignment was possible.

    Paths of which nothing matches start at the same place, and their error is None.
    """
    found = match(est, gt)
    if found.reason:
        return (
            est.transformed(gt.T_world_cam[0] @ invert(est.T_world_cam[0])),
            None,
            "origin",
        )
    kind: Alignment = "se3"
    try:
        error = ate(found, kind)
    except DegenerateError:
        error = ate(found, kind := "origin")
    return est.transformed(error.T_gt_est), error, kind


def _relative(
    est: np.ndarray, gt: np.ndarray, first: np.ndarray, last: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Errors of the motions between the poses ``first`` and ``last``, metres and degrees."""
    E = invert(invert(est[first]) @ est[last]) @ (invert(gt[first]) @ gt[last])
    return np.linalg.norm(E[:, :3, 3], axis=1), np.degrees(
        rotation_angle(E[:, :3, :3])
    )


def rpe(
    found: Match, delta: float = 1, delta_unit: DeltaUnit = "frames"
) -> tuple[np.ndarray, np.ndarray]:
    """Compute relative pose errors, metres and degrees, of all (overlapping) poses ``delta`` apart.

    With ``delta`` in seconds, a pose's partner is nearest to that time, at most half a frame away.
    """
    first = np.arange(len(found.stamps))
    last = first + int(min(delta, len(first)))
    if delta_unit == "s":
        if found.by != "time":
            raise DegenerateError(
                "a distance in seconds needs timestamps in both trajectories"
            )
        # half a frame, and rounding of the stamps
        reach = (
            1.01 * np.median(np.diff(found.stamps)) / 2 if len(first) > 1 else 0.0
        )
        nearest = {"method": "nearest", "tolerance": reach}
        # -1: none
        last = pd.Index(found.stamps).get_indexer(found.stamps + delta, **nearest)
    inside = (last < len(first)) & (last > first)
    if not inside.any():
        reason = f"not enough poses: of {len(first)} no two are {delta:g} {delta_unit} apart"
        raise DegenerateError(reason)
    return _relative(found.est, found.gt, first[inside], last[inside])


def kitti_drift(
    found: Match, lengths: Sequence[float] = KITTI_LENGTHS
) -> dict[str, Any]:
    """Compute drift as KITTI's odometry benchmark defines it (Geiger et al., CVPR 2012).

    For every length L, m, it takes the motions from each frame to the first one that is farther
    along the true path; their errors over L are averaged within a length, then over the lengths.
    """
    est = found.est
    gt = found.gt
    steps = np.linalg.norm(np.diff(gt[:, :3, 3], axis=0), axis=1)
    distance = np.concatenate([[0.0], np.cumsum(steps)])
    means = []
    for length in lengths:
        last = np.searchsorted(distance, distance + length, side="right")
        (first,) = np.nonzero(last < len(gt))
        if len(first):
            means.append(
                [e.mean() / length for e in _relative(est, gt, first, last[first])]
            )
    if not means:
        reason = f"the true path of {distance[-1]:.4g} m is shorter than {min(lengths):g} m"
        raise DegenerateError(reason)
    translation, rotation = np.mean(means, axis=0).tolist()
    return {"translation": translation, "rotation_deg_per_m": rotation}


def _check_arguments(
    estimate: Any,
    gt: Any,
    alignment: Any,
    delta: Any,
    delta_unit: Any,
    max_diff: Any,
) -> None:
    """Raise an InputError where an argument of :func:`evaluate` is of no use."""
    kinds = (Trajectory, str, Path)
    span = as_number(delta)
    difference = as_number(max_diff)
    is_whole = span % 1 == 0 or (
        isinstance(delta_unit, str) and delta_unit != "frames"
    )
    is_span = 0 < span < np.inf and is_whole
    for name, value, is_good, expected in (
        (
            "estimate",
            estimate,
            isinstance(estimate, kinds),
            "a Trajectory, or its file",
        ),
        ("gt", gt, isinstance(gt, kinds), "a Trajectory, or its file"),
        (
            "alignment",
            alignment,
            _is_one_of(alignment, Alignment),
            "se3, sim3, origin or none",
        ),
        (
            "delta_unit",
            delta_unit,
            _is_one_of(delta_unit, DeltaUnit),
            "frames or s",
        ),
        ("delta", delta, is_span, f"a positive number of {delta_unit}"),
        ("max_diff", max_diff, 0 < difference < np.inf, "seconds > 0"),
    ):
        if not is_good:
            raise InputError(f"{name}: expected {expected}, got {value!r}.")


def _is_one_of(value: Any, kinds: Any) -> bool:
    """Whether a value is one of the texts of a Literal; arrays are none."""
    return isinstance(value, str) and value in get_args(kinds)


def _taken(path: Trajectory | str | Path, name: str) -> Trajectory:
    """A trajectory as it is given, or from its file; an InputError where no error can be taken."""
    where = name if isinstance(path, Trajectory) else str(path)
    try:
        found = path if isinstance(path, Trajectory) else read_trajectory(path)
    # a name that is too long, a folder that may not be read
    except OSError as error:
        raise InputError(
            f"{where[:100]}: cannot be read: {error.strerror}."
        ) from None
    farthest = float(np.abs(found.positions).max())
    if farthest > MAX_COORDINATE_M:
        expected = f"positions in metres, up to {MAX_COORDINATE_M:g}"
        raise InputError(f"{where}: expected {expected}, got {farthest:g}.")
    return found


def evaluate(
    estimate: Trajectory | str | Path,
    gt: Trajectory | str | Path,
    *,
    alignment: Alignment = "se3",
    delta: float = 1,
    delta_unit: DeltaUnit = "frames",
    max_diff: float = MAX_STAMP_DIFFERENCE_S,
) -> dict[str, Any]:
    """Compute every error of a trajectory, or its file, against the truth; JSON-ready.

    Args:
        estimate: The trajectory, or a file in TUM's, KITTI's or TartanAir's form.
        gt: The truth, likewise.
        alignment: Of ``ate_rmse``: ``se3`` rigid, ``sim3`` with a scale, ``origin`` first poses
            equal, ``none``.
        delta: Span of the relative errors, in ``delta_unit``: ``frames`` or ``s``.
        delta_unit: See ``delta``.
        max_diff: Largest difference of stamps that belong together, seconds.

    Returns:
        A dictionary; a figure that cannot be computed is None, and ``reasons`` says why.

        - ``ate_rmse``: absolute trajectory error after the alignment, metres; ``scale`` is the
          alignment's (1 unless ``sim3``), ``alignment`` its name.
        - ``ate_rmse_origin``, ``ate_rmse_unaligned``: the same by first poses, and without any.
        - ``rpe_trans_rmse``, ``rpe_rot_rmse_deg``: relative errors over ``delta``, metres, degrees.
        - ``kitti_drift``: ``translation``, a fraction of the path, and ``rotation_deg_per_m``.
        - ``matched`` of ``total`` poses, ``matched_by`` ``time`` or ``index``.
        - ``delta``, ``delta_unit``, ``warnings`` of the files, ``reasons``.

    Raises:
        InputError: An argument is of no use, a file cannot be read, or a position is too far away.
    """
    _check_arguments(estimate, gt, alignment, delta, delta_unit, max_diff)
    delta = float(delta)
    max_diff = float(max_diff)
    estimate = _taken(estimate, "estimate")
    gt = _taken(gt, "gt")
    found = match(estimate, gt, max_diff)

    def relative() -> list[float]:
        return [
            np.sqrt(np.mean(e**2)).item() for e in rpe(found, delta, delta_unit)
        ]

    figures: dict[tuple[str, ...], Callable[[], Any]] = {
        ("ate_rmse_unaligned",): lambda: [ate(found, "none").rmse],
        ("ate_rmse_origin",): lambda: [ate(found, "origin").rmse],
        ("ate_rmse", "scale"): lambda: attrgetter("rmse", "scale")(
            ate(found, alignment)
        ),
        ("rpe_trans_rmse", "rpe_rot_rmse_deg"): relative,
        ("kitti_drift",): lambda: [kitti_drift(found)],
    }
    report: dict[str, Any] = {
        "alignment": alignment,
        "delta": float(delta),
        "delta_unit": delta_unit,
        "matched": len(found.est),
        "matched_by": found.by,
        "total": min(len(estimate), len(gt)),
        "reasons": {},
        "warnings": [*estimate.warnings, *gt.warnings],
    }
    for names, compute in figures.items():
        try:
            if found.reason:
                raise DegenerateError(found.reason)
            report |= zip(names, compute(), strict=True)
        except DegenerateError as error:
            report |= dict.fromkeys(names)
            report["reasons"] |= dict.fromkeys(names, str(error))
    return report
