"""Lines of ``results.json``: one method on one sequence, and one method on all of them.

Fields beyond those of ``design/interface.md``: ``pairs_scored`` (pairs over which the means and
medians of rotation and translation are taken) and ``pairs_scored_epe`` (those with a depth);
``epe_l2_px_median``; ``failures``, ``failure_rate`` and its Wilson interval; ``ate_rmse_sim3``,
``scale_sim3``, ``rpe_trans_rmse_sim3``, ``rpe_rot_rmse_deg_sim3``; ``kitti_drift`` (null where the
path is shorter than 100 m); ``ms_per_pair_p95``, ``flow_ms_median`` (zero for a method that reads
no flow) and ``ms_with_flow_median``; ``reasons``: why a value is null, by its name. A failed
estimate counts with the motion it carries, which is none, in every mean and median.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np

from hybridvo.comparison.job import READS_NO_FLOW
from hybridvo.evaluation.breakdown import failure_rate
from hybridvo.evaluation.metrics import evaluate_trajectories, mean_pair_errors, rpe
from hybridvo.trajectory import Trajectory, chain

__all__ = [
    "PATH_KEYS",
    "ChainedPath",
    "pair_scores",
    "scale_notice",
    "sequence_row",
    "total_row",
    "trajectory_scores",
]

_ERRORS = ("r_err_deg", "t_err", "epe", "epe_l2_px", "rot_err_deg", "trans_err")
PATH_KEYS = (
    *("ate_rmse", "rpe_trans_rmse", "rpe_rot_rmse_deg"),
    *("ate_rmse_sim3", "rpe_trans_rmse_sim3", "rpe_rot_rmse_deg_sim3"),
)
"""Errors of a whole trajectory; those without a suffix are after a rigid alignment."""
_SCALE = 3.0
"""Factor beyond which a truth and all estimates disagree about the unit."""
_AGREE = 1.5
"""Factor within which the estimates must agree about that."""
NO_TRUTH = "the sequence has no truth for these frames"
NO_PAIRS = "no pair was estimated"
LEFT_OUT = "the protocol leaves out pairs, which tears the trajectory"


class ChainedPath:
    """Poses of one method, chained as the motions come in; held over pairs that were left out."""

    def __init__(self) -> None:
        self.T_world_cam: dict[int, np.ndarray] = {}

    def add(self, prev: int, curr: int, T_curr_prev: np.ndarray) -> None:
        """Take the motion from frame ``prev`` to frame ``curr``."""
        last = next(reversed(self.T_world_cam.values())) if self.T_world_cam else np.eye(4)
        T_world_prev = self.T_world_cam.setdefault(prev, last)
        self.T_world_cam[curr] = chain(T_world_prev, T_curr_prev)

    def trajectory(self, timestamps: np.ndarray) -> Trajectory | None:
        """Camera to world, first camera at the identity; None where there is no pose."""
        if not self.T_world_cam:
            return None
        indices = list(self.T_world_cam)
        return Trajectory(timestamps[indices], np.stack(list(self.T_world_cam.values())))


def scale_notice(rows: Iterable[Mapping[str, Any]]) -> list[str]:
    """Notice of a truth whose unit is not that of the depth, from the rows of one sequence.

    Every method measures in the unit of the depth: where all of them are wrong by about the same
    large factor, the truth is. Two of them at least, and not the one that stands still; noise does
    not agree on a factor.
    """
    scales = [
        float(row["scale_sim3"])
        for row in rows
        if row.get("scale_sim3") and row["method"] != "identity" and row["failed"] < row["pairs"]
    ]
    if len(scales) < 2 or min(scales) <= 0 or max(scales) > _AGREE * min(scales):
        return []
    if 1 / _SCALE <= max(scales) and min(scales) <= _SCALE:
        return []
    low, high = (f"{value:.3g}" for value in (min(scales), max(scales)))
    return [
        f"the true path is {low} to {high} times as long as every estimate: the unit of the truth "
        f"or of the depth is wrong, and so are the errors in metres and pixels."
    ]


def pair_scores(columns: Mapping[str, np.ndarray], method: str) -> dict[str, Any]:
    """Everything that is a mean, median or count over pairs, with ``reasons``."""
    count = len(columns["failed"])
    known = np.isfinite(columns["rot_err_deg"])
    errors = [{name: _number(columns[name][i]) for name in _ERRORS} for i in np.flatnonzero(known)]
    scores = mean_pair_errors(errors)
    reasons = scores["reasons"]
    if not count:
        reasons |= dict.fromkeys(reasons, NO_PAIRS)
    epe = columns["epe_l2_px"][np.isfinite(columns["epe_l2_px"])]
    rates = failure_rate(columns)
    scores |= {
        "pairs": count,
        "failed": rates["failed"],
        "pairs_scored": len(errors),
        "pairs_scored_epe": len(epe),
        "epe_l2_px_median": float(np.median(epe)) if len(epe) else None,
        **{name: rates[name] for name in ("failures", "failure_rate")},
        **{name: rates[name] for name in ("failure_rate_low", "failure_rate_high")},
    }
    if not len(epe):
        reasons["epe_l2_px_median"] = reasons.get("epe_l2_px", NO_PAIRS)
    if not rates["pairs"]:
        scores["failures"] = None
        reasons |= dict.fromkeys(
            ("failures", "failure_rate", "failure_rate_low", "failure_rate_high"),
            reasons.get("epe_l2_px", NO_PAIRS),
        )
    ms, flow_ms = columns["ms"], columns["flow_ms"]
    if method in READS_NO_FLOW:
        flow_ms = np.zeros_like(ms)
    for name, values, statistic in (
        ("ms_per_pair_median", ms, np.median),
        ("ms_per_pair_p95", ms, lambda v: np.quantile(v, 0.95)),
        ("flow_ms_median", flow_ms, np.median),
        ("ms_with_flow_median", ms + flow_ms, np.median),
    ):
        finite = values[np.isfinite(values)]
        scores[name] = float(statistic(finite)) if len(finite) else None
        if not len(finite):
            reasons[name] = NO_PAIRS
    moving = columns["dynamic_fraction"][np.isfinite(columns["dynamic_fraction"])]
    scores["dynamic_fraction"] = float(moving.mean()) if len(moving) else None
    if not len(moving):
        reasons["dynamic_fraction"] = (
            "needs true flow of the whole scene (moving objects included) and truth"
        )
    return scores


def _number(value: float) -> float | None:
    return float(value) if np.isfinite(value) else None


def trajectory_scores(
    est: Trajectory | None, truth: Trajectory | None, torn: bool = False
) -> dict[str, Any]:
    """Errors of a trajectory: :data:`PATH_KEYS`, scale, drift, with ``reasons``.

    Args:
        est: estimate, or None.
        truth: true trajectory, or None.
        torn: whether pairs were left out on purpose: then nothing can be computed.
    """
    names = (*PATH_KEYS, "scale_sim3", "kitti_drift")
    scores: dict[str, Any] = {"alignment": "se3", **dict.fromkeys(names)}
    if est is None or truth is None or torn:
        reason = LEFT_OUT if torn else NO_PAIRS if est is None else NO_TRUTH
        return scores | {"reasons": dict.fromkeys(names, reason)}
    report = evaluate_trajectories(est, truth)
    similar = rpe(est, truth, alignment="sim3")
    reasons = {}
    for name in ("ate_rmse", "rpe_trans_rmse", "rpe_rot_rmse_deg", "ate_rmse_sim3", "scale_sim3"):
        scores[name] = report[name]
        if name in report["reasons"]:
            reasons[name] = report["reasons"][name]
    for name in ("rpe_trans_rmse", "rpe_rot_rmse_deg"):
        value = similar.trans_rmse if "trans" in name else similar.rot_rmse_deg
        key = f"{name}_sim3"
        scores[key] = value
        if value is None:
            field = "trans_rmse" if "trans" in name else "rot_rmse_deg"
            reasons[key] = similar.reasons[field]
    drift = report["kitti_drift"]
    if drift is None:
        reasons["kitti_drift"] = report["reasons"]["kitti_drift"]
    elif drift["translation"] is None:
        reasons["kitti_drift"] = drift["reasons"]["translation"]
    else:
        scores["kitti_drift"] = drift
    for name in names:  # whatever the metric said or left unsaid
        if scores[name] is None:
            reasons.setdefault(name, "cannot be computed on this path")
    return scores | {"reasons": reasons}


def sequence_row(
    columns: Mapping[str, np.ndarray],
    est: Trajectory | None,
    truth: Trajectory | None,
    named: Mapping[str, Any],
    torn: bool = False,
) -> dict[str, Any]:
    """Line of one method on one sequence; ``named`` says which (``method`` among others)."""
    pairs = pair_scores(columns, str(named["method"]))
    path = trajectory_scores(est, truth, torn)
    reasons = {**pairs.pop("reasons"), **path.pop("reasons")}
    return {**named, **pairs, **path, "reasons": reasons}


def total_row(
    columns: Mapping[str, np.ndarray], rows: Sequence[Mapping[str, Any]]
) -> dict[str, Any]:
    """Line of one method over all sequences: pairs pooled, trajectory errors as plain means.

    Args:
        columns: all pairs of the method.
        rows: its lines of the single sequences; a trajectory error that one of them lacks is the
            mean over the others, and ``reasons`` says which are missing.
    """
    first = rows[0]
    scores = pair_scores(columns, str(first["method"]))
    reasons = scores["reasons"]
    for key in PATH_KEYS:
        known = [row[key] for row in rows if row[key] is not None]
        scores[key] = float(np.mean(known)) if known else None
        if len(known) < len(rows):
            without: dict[str, list[str]] = {}
            for row in rows:
                if row[key] is None:
                    without.setdefault(row["reasons"][key], []).append(row["sequence"])
            reasons[key] = f"mean over {len(known)} of {len(rows)} sequences; without " + "; ".join(
                f"{', '.join(names)} ({reason})" for reason, names in without.items()
            )
    return {
        "sequence": "all",
        "sequences": len(rows),
        "method": first["method"],
        "flow_source": first["flow_source"],
        "depth_source": _joined(row["depth_source"] for row in rows),
        "alignment": "se3",
        **scores,
    }


def _joined(values: Iterable[str]) -> str:
    return ", ".join(dict.fromkeys(values))
