"""Results of a run from its rows: steps, summary, scores and the picture."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from hybridvo.data.sequence import Sequence
from hybridvo.depth_steps import depth_step_warning
from hybridvo.evaluation.metrics import evaluate
from hybridvo.evaluation.pair_errors import mean_pair_errors
from hybridvo.evaluation.report import write_csv
from hybridvo.files import atomic_write
from hybridvo.geometry import pose_matrix, se3_log
from hybridvo.trajectory import Trajectory
from hybridvo.types import Frame

__all__ = [
    "STEP_COLUMNS",
    "compact",
    "draw",
    "is_repeated",
    "score",
    "summarise",
    "true_trajectory",
    "write_steps",
]

STEP_COLUMNS = (
    *("index", "timestamp", "status", "reason", "tx", "ty", "tz", "rx", "ry", "rz"),
    *("inlier_ratio", "iterations", "cost", "ms", "prev_index", "flow_source"),
    *("terms", "polish", "window", "message"),
)

ARRAYS = ("T_curr_prev", "T_world_cam", "covariance")

Row = Mapping[str, Any]


def compact(row: Row) -> dict[str, Any]:
    """A kept row in a third of the memory: numbers as arrays, without the tracker's state."""
    return {
        key: np.array(value) if key in ARRAYS else value
        for key, value in row.items()
        if key != "anchor"
    }


def summarise(
    rows: list[dict[str, Any]], sequence: Sequence, method: str, pairs: int
) -> dict[str, Any]:
    """Counts, sources, oracles and times of a run, JSON-ready.

    Args:
        rows: of the frames done, at least one.
        sequence: what was run on.
        method: name of the estimator.
        pairs: motions that a complete run has.
    """
    tracked = [row["ms"] for row in rows[1:] if row["reason"] != "missing_frame"]
    failed = rows[-1]["failed_so_far"]
    return {
        "sequence": sequence.name,
        "method": method,
        "frames": len(rows),
        "failed": failed,
        "failed_share": min(failed / max(pairs, 1), 1.0),  # the first frame may fail beside them
        "degraded": sum(row["status"] == "degraded" for row in rows),
        "missing_frames": [row["index"] for row in rows if row["reason"] == "missing_frame"],
        "flow_source": _names(row["flow_source"] for row in rows),
        "polish": dict(Counter(row["polish"] for row in rows if row["polish"])),
        "depth_source": sequence.depth_source,
        "oracle": _oracles(rows, sequence),
        "ms_per_pair_median": float(np.median(tracked)) if tracked else None,
        "warnings": [text for text in (depth_step_warning(rows), _repeat_warning(rows)) if text],
    }


def is_repeated(prev: Frame | None, curr: Frame) -> bool:
    """Whether a frame has the very picture of the one before, but another depth map.

    A camera that stands still gives no two equal pictures, and a rendered one equal depth as well:
    a driver has handed out an old picture.
    """
    if prev is None or prev.rgb is None or curr.rgb is None:
        return False
    if prev.depth is None or curr.depth is None or not np.array_equal(prev.rgb, curr.rgb):
        return False
    return not np.array_equal(prev.depth, curr.depth, equal_nan=True)


def _repeat_warning(rows: Iterable[Row]) -> str:
    repeated = [row for row in rows if row["repeated"]]
    if not repeated:
        return ""
    first, more = repeated[0], f", and {len(repeated) - 1} more" if len(repeated) > 1 else ""
    return (
        f"frame {first['index']} has the very picture of frame {first['prev_index']}, and another "
        f"depth map{more}: pictures that are handed out twice stand still where the camera moves"
    )


def score(
    rows: list[dict[str, Any]],
    trajectory: Trajectory,
    truth: Trajectory,
    alignment: str,
    summary: Mapping[str, Any],
) -> dict[str, Any]:
    """Content of ``metrics.json``; no times, so that equal runs give equal bytes."""
    report = evaluate(trajectory, truth, alignment=alignment)  # type: ignore[arg-type]
    per_pair = mean_pair_errors(row["errors"] for row in rows if row["errors"] is not None)
    reasons = report.pop("reasons") | per_pair.pop("reasons")
    named = ("method", "failed", "degraded", "flow_source", "depth_source", "oracle", "sequence")
    return report | per_pair | {"reasons": reasons} | {key: summary[key] for key in named}


def write_steps(folder: Path, rows: list[dict[str, Any]]) -> None:
    """Write ``steps.csv`` (a line per frame) and ``steps.npz`` (motions and covariances)."""
    T = np.array([row["T_curr_prev"] for row in rows]).reshape(-1, 4, 4)
    table = []
    for row, motion in zip(rows, T, strict=True):
        rotation = se3_log(motion)[3:]
        values = dict(
            zip(("tx", "ty", "tz", "rx", "ry", "rz"), [*motion[:3, 3], *rotation], strict=True)
        )
        message = " ".join(str(row["message"]).split())
        table.append({**row, **values, "message": message})
    write_csv(folder / "steps.csv", table, STEP_COLUMNS)
    covariance = np.array([row["covariance"] for row in rows]).reshape(-1, 6, 6)
    with atomic_write(folder / "steps.npz", "wb") as file:
        np.savez(file, T_curr_prev=T, covariance=covariance)


def draw(
    path: Path, trajectory: Trajectory, truth: Trajectory | None, summary: Mapping[str, Any]
) -> None:
    """Draw the trajectory, over the truth where there is one."""
    from hybridvo.evaluation.plots import plot_trajectories

    title = f"{summary['sequence']}, flow: {', '.join(summary['flow_source']) or 'none'}"
    if summary["oracle"]:
        title += f" (oracle: {', '.join(summary['oracle'])})"
    plot_trajectories({summary["method"]: trajectory}, path, truth=truth, title=title)


def true_trajectory(sequence: Sequence, frames: Iterable[int]) -> Trajectory | None:
    """True poses of the frames of the run that have one."""
    if sequence.poses is None:
        return None
    known = [i for i in frames if np.isfinite(sequence.poses[i]).all()]
    if not known:
        return None
    # text files carry six digits: made orthonormal as the trajectory demands
    T = np.stack([pose_matrix(sequence.poses[i][:3]) for i in known])
    return Trajectory(sequence.timestamps[known], T)


def _names(values: Iterable[str | None]) -> list[str]:
    return sorted({value for value in values if value})


def _oracles(rows: list[dict[str, Any]], sequence: Sequence) -> list[str]:
    """What the estimate was given that no sensor gives."""
    oracles = ["true flow"] if any(row["flow_is_true"] for row in rows) else []
    return oracles + (["true depth"] if sequence.depth_source == "true" else [])
