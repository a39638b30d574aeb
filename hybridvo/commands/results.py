"""Files and texts of a run, from the rows of its frames."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from hybridvo.data.sequence import Sequence
from hybridvo.depth_steps import is_step
from hybridvo.evaluation.metrics import evaluate
from hybridvo.evaluation.pair_errors import mean_pair_errors
from hybridvo.files import atomic_write, write_csv
from hybridvo.geometry import pose_matrix, se3_log
from hybridvo.trajectory import Trajectory

STEP_COLUMNS = (
    *("index", "timestamp", "status", "reason", "probability"),
    *("tx", "ty", "tz", "rx", "ry", "rz"),
    *("inlier_ratio", "iterations", "cost", "flow_ms", "motion_ms", "frame_ms"),
    *("prev_index", "flow_source", "message"),
)
MISSING = "-"
"""In texts: a figure that could not be computed."""

Row = Mapping[str, Any]


def write_steps(folder: Path, rows: list[dict[str, Any]]) -> None:
    """Write ``steps.csv`` (a line a frame) and ``steps.npz`` (motions with their covariances)."""
    T = np.array([row["T_curr_prev"] for row in rows]).reshape(-1, 4, 4)
    table = []
    for row, motion in zip(rows, T, strict=True):
        values = [*motion[:3, 3], *se3_log(motion)[3:]]
        named = dict(zip(("tx", "ty", "tz", "rx", "ry", "rz"), values, strict=True))
        table.append({**row, **named, "message": " ".join(row["message"].split())})
    write_csv(folder / "steps.csv", STEP_COLUMNS, table)
    with atomic_write(folder / "steps.npz", "wb") as file:
        np.savez(
            file,
            index=np.array([row["index"] for row in rows]),
            timestamp=np.array([row["timestamp"] for row in rows]),
            status=np.array([row["status"] for row in rows]),
            probability=np.array([row["probability"] for row in rows]),
            T_curr_prev=T,
            covariance=np.array([row["covariance"] for row in rows]).reshape(-1, 6, 6),
        )


def ground_truth(sequence: Sequence, frames: Iterable[int]) -> Trajectory | None:
    """True poses of those frames that have one, or None."""
    if sequence.poses is None:
        return None
    known = [i for i in frames if np.isfinite(sequence.poses[i]).all()]
    if not known:
        return None
    # text files carry six digits: made orthonormal as the trajectory demands
    T = np.stack([pose_matrix(sequence.poses[i][:3]) for i in known])
    return Trajectory(sequence.timestamps[known], T)


def summarise(rows: list[dict[str, Any]], sequence: Sequence, method: str) -> dict[str, Any]:
    """Counts, sources, oracles, times and warnings of a run, JSON-ready.

    The first frame has no motion: a run of n frames has n - 1.
    """
    motions = rows[1:]
    failed = [row for row in motions if row["status"] == "failed"]
    timed = [row for row in motions if row["reason"] != "missing_frame"]

    def median(name: str) -> float | None:
        return float(np.median([row[name] for row in timed])) if timed else None

    return {
        "sequence": sequence.name,
        "method": method,
        "frames": len(rows),
        "motions": len(motions),
        "failed": len(failed),
        "failed_fraction": len(failed) / max(len(motions), 1),
        "degraded": sum(row["status"] == "degraded" for row in motions),
        "missing_frames": [row["index"] for row in rows if row["reason"] == "missing_frame"],
        "flow_source": sorted({row["flow_source"] for row in rows if row["flow_source"]}),
        "depth_source": sequence.depth_source,
        "oracle": _oracles(rows, sequence),
        "flow_ms_median": median("flow_ms"),
        "motion_ms_median": median("motion_ms"),
        "frame_ms_median": median("frame_ms"),
        "warnings": [text for text in (_scale_warning(rows), _repeat_warning(rows)) if text],
    }


def score(
    rows: list[dict[str, Any]], trajectory: Trajectory, gt: Trajectory, summary: Row, alignment: str
) -> dict[str, Any]:
    """Content of ``metrics.json``: errors against the ground truth, and what went in."""
    report = evaluate(trajectory, gt, alignment=alignment)  # type: ignore[arg-type]
    pairs = mean_pair_errors(row["errors"] for row in rows if row["errors"] is not None)
    reasons = report.pop("reasons") | pairs.pop("reasons")
    named = ("method", "failed", "degraded", "flow_source", "depth_source", "oracle", "sequence")
    return report | pairs | {"reasons": reasons} | {key: summary[key] for key in named}


def draw(path: Path, trajectory: Trajectory, gt: Trajectory | None, summary: Row) -> None:
    """Draw the trajectory, with the ground truth where there is one."""
    from hybridvo.evaluation.plots import plot_trajectories

    title = f"{summary['sequence']}, flow: {', '.join(summary['flow_source']) or 'none'}"
    if summary["oracle"]:
        title += f" (oracle: {', '.join(summary['oracle'])})"
    plot_trajectories({summary["method"]: trajectory}, path, truth=gt, title=title)


def _oracles(rows: Iterable[Row], sequence: Sequence) -> list[str]:
    """What the estimate was given that no sensor gives."""
    oracles = ["true flow"] if any(row["flow_is_true"] for row in rows) else []
    return oracles + (["true depth"] if sequence.depth_source == "true" else [])


def _scale_warning(rows: Iterable[Row]) -> str:
    steps = [row for row in rows if row["depth_ratio"] and is_step(row["depth_ratio"])]
    if not steps:
        return ""
    first, more = steps[0], f", and {len(steps) - 1} more" if len(steps) > 1 else ""
    return (
        f"the depth of frame {first['index']} is {first['depth_ratio']:.3g} times what frame "
        f"{first['prev_index']} and the motion between them say{more}: its unit or scale changes "
        f"within the sequence, and the trajectory's with it"
    )


def _repeat_warning(rows: Iterable[Row]) -> str:
    repeated = [row for row in rows if row["repeated"]]
    if not repeated:
        return ""
    first, more = repeated[0], f", and {len(repeated) - 1} more" if len(repeated) > 1 else ""
    return (
        f"frame {first['index']} has the very image of frame {first['prev_index']}, and another "
        f"depth map{more}: an image that a driver hands out twice looks like a camera at rest"
    )


# -- texts --------------------------------------------------------------------------------------

_ERRORS = (
    ("ATE", "ate_rmse", 100.0, "cm RMSE"),
    ("RPE translation", "rpe_trans_rmse", 100.0, "cm RMSE"),
    ("RPE rotation", "rpe_rot_rmse_deg", 1.0, "deg RMSE"),
)
_PAIR_ERRORS = (
    ("rotation error", "rot_err_deg_median", "rot_err_deg_mean", 1.0, "deg a pair"),
    ("translation error", "trans_err_median", "trans_err_mean", 100.0, "cm a pair"),
)


def _number(value: Any, factor: float = 1.0) -> str:
    return MISSING if value is None else f"{factor * value:.4g}"


def _lines(rows: list[tuple[str, str]]) -> str:
    width = max(len(name) for name, _ in rows)
    return "\n".join(f"{name.ljust(width)}  {value}" for name, value in rows)


def _error_rows(report: Row) -> list[tuple[str, str]]:
    rows = []
    for label, key, factor, unit in _ERRORS:
        value = report.get(key)
        if value is None:
            text = f"{MISSING} ({report['reasons'].get(key, 'unknown')})"
        else:
            text = f"{_number(value, factor)} {unit}"
        if key == "ate_rmse":
            text += f" ({report['alignment']})"
        elif report.get("delta") not in (None, 1):
            text += f" over {report['delta']:g} {report['delta_unit']}"
        else:
            text += " a frame" if report.get("delta_unit", "frames") == "frames" else " a second"
        rows.append((label, text))
    return rows


def summary_text(summary: Row) -> str:
    """Summary of a run, a line a fact; oracles are named."""
    if not summary.get("frames"):
        return "no frame was finished"
    flow = ", ".join(summary["flow_source"]) or "none"
    failed = f"failed {summary['failed']} of {summary['motions']} motions"
    rows = [
        ("sequence", f"{summary['sequence']}, {summary['frames']} frames"),
        ("method", str(summary["method"])),
        ("inputs", f"flow: {flow}; depth: {summary['depth_source']}"),
    ]
    if summary["oracle"]:
        rows.append(("ORACLE", f"uses {' and '.join(summary['oracle'])} (ground truth)"))
    rows.append(("status", f"{failed}, {summary['degraded']} degraded"))
    if summary["frame_ms_median"] is not None:
        times = (summary[f"{part}_ms_median"] for part in ("frame", "flow", "motion"))
        rows.append(("time", "{:.1f} ms a frame: flow {:.1f}, motion {:.1f}".format(*times)))
    metrics = summary.get("metrics")
    if metrics:
        rows += _error_rows(metrics)
        for label, median, mean, factor, unit in _PAIR_ERRORS:
            values = f"{_number(metrics.get(median), factor)} median"
            rows.append((label, f"{values}, {_number(metrics.get(mean), factor)} mean {unit}"))
        rows.append(("ego-flow error", f"{_number(metrics.get('epe_l2_px'))} px mean"))
    rows.append(("results", str(summary["out"])))
    if "recording" in summary:
        rows.append(("recording", f"{summary['recording']} (open it with: rerun FILE)"))
    return _lines(rows)


def evaluation_text(report: Row) -> str:
    """Errors between two trajectory files."""
    rows = [
        ("matched", f"{report['matched']} of {report['total']} poses, by {report['matched_by']}"),
        *_error_rows(report),
        ("ATE unaligned", f"{_number(report['ate_rmse_unaligned'], 100.0)} cm RMSE"),
        ("ATE with scale", f"{_number(report['ate_rmse_sim3'], 100.0)} cm RMSE (sim3)"),
    ]
    for label, key in (("KITTI drift", "kitti_drift"), ("drift 5 to 40 m", "kitti_drift_short")):
        drift = report.get(key) or {}
        translation, rotation = drift.get("translation"), drift.get("rotation_deg_per_m")
        rows.append((label, f"{_number(translation, 100.0)} %, {_number(rotation)} deg/m"))
    rows.append(("evo", str(report["evo_version"])))
    return _lines(rows + [("warning", text) for text in report.get("warnings", ())])
