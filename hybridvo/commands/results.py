"""Files and texts of a run, from the rows of its frames."""

from __future__ import annotations

import os
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from hybridvo.commands.run_folder import RESULTS, STATE
from hybridvo.data.sequence import Sequence
from hybridvo.evaluation.metrics import evaluate
from hybridvo.evaluation.pair_errors import mean_pair_errors, true_trajectory
from hybridvo.evaluation.plots import plot_trajectories
from hybridvo.files import atomic_write, write_json
from hybridvo.options import RunOptions
from hybridvo.trajectory import Trajectory

Row = Mapping[str, Any]


def write_results(
    folder: Path,
    rows: list[dict[str, Any]],
    sequence: Sequence,
    frames: range,
    options: RunOptions,
    *,
    picture: bool,
) -> dict[str, Any]:
    """Write what a finished run leaves beside its steps; its summary, JSON-ready."""
    trajectory = Trajectory(
        np.array([row["timestamp"] for row in rows]), np.array([row["T_world_cam"] for row in rows])
    )
    trajectory.save(folder / "trajectory.tum")
    trajectory.save(folder / "trajectory.kitti")
    names = ("index", "timestamp", "status", "probability", "T_curr_prev", "covariance")
    with atomic_write(folder / "steps.npz", "wb") as file:
        arrays: dict[str, Any] = {name: np.array([row[name] for row in rows]) for name in names}
        np.savez(file, **arrays)
    summary = _summarise(pd.DataFrame(rows), sequence, options.method)
    if summary["failed_fraction"] > options.max_failed:
        text = f"more motions failed than --max-failed {options.max_failed:g} allows"
        summary["warnings"].append(text)
    metrics, gt = None, true_trajectory(sequence, frames)
    if gt is not None:
        report = evaluate(trajectory, gt, alignment=options.alignment)
        pairs = mean_pair_errors(row for row in rows if "rot_err_deg" in row)
        reasons = report["reasons"] | pairs["reasons"]
        named = ("method", "failed", "degraded", "flow_source", "depth_source", "oracle")
        metrics = report | pairs | {key: summary[key] for key in (*named, "sequence")}
        metrics["reasons"] = reasons
        write_json(folder / "metrics.json", metrics)
    if picture:
        title = f"{sequence.name}, flow: {', '.join(summary['flow_source']) or 'none'}"
        if summary["oracle"]:
            title += f" (oracle: {', '.join(summary['oracle'])})"
        path = folder / "trajectory.png"
        plot_trajectories({options.method: trajectory}, path, truth=gt, title=title)
    files = [os.fspath(folder / name) for name in RESULTS if (folder / name).exists()]
    files.append(os.fspath(folder / STATE))
    return summary | {"state": "done", "out": os.fspath(folder), "files": files, "metrics": metrics}


def _summarise(table: pd.DataFrame, sequence: Sequence, method: str) -> dict[str, Any]:
    """Counts, sources, oracles, times and warnings of a run."""
    motions = table[1:]  # the first frame has none
    timed = motions[motions["reason"] != "missing_frame"]
    failed = int((motions["status"] == "failed").sum())
    doubts = motions[(motions["status"] == "ok") & (motions["message"] != "")]
    if any("the median depth" in text for text in sequence.warnings):  # said before the run
        doubts = doubts[:0]
    # what the estimate was given that no sensor gives
    oracle = ["true flow"] if table["flow_is_true"].any() else []
    oracle += ["true depth"] if sequence.depth_source == "true" else []
    return {
        "sequence": sequence.name,
        "method": method,
        "frames": len(table),
        "motions": len(motions),
        "failed": failed,
        "failed_fraction": failed / max(len(motions), 1),
        "degraded": int((motions["status"] == "degraded").sum()),
        "missing_frames": table["index"][table["reason"] == "missing_frame"].tolist(),
        "flow_source": sorted(set(table["flow_source"]) - {""}),
        "depth_source": sequence.depth_source,
        "oracle": oracle,
        **{
            f"{name}_median": float(timed[name].median()) if len(timed) else None
            for name in ("flow_ms", "motion_ms", "frame_ms")
        },
        "warnings": [f"frame {row['index']}: {row['message']}" for _, row in doubts[:1].iterrows()],
    }


# -- texts --------------------------------------------------------------------------------------


Errors = tuple[tuple[str, str, float, str], ...]
"""Label, name in the report, factor, and what follows the number."""
PATH_ERRORS: Errors = (
    ("ATE", "ate_rmse", 100, "cm RMSE ({alignment})"),
    ("RPE translation", "rpe_trans_rmse", 100, "cm RMSE over {delta:g} {delta_unit}"),
    ("RPE rotation", "rpe_rot_rmse_deg", 1, "deg RMSE over {delta:g} {delta_unit}"),
)
PAIR_ERRORS: Errors = (
    ("rotation error", "rot_err_deg_median", 1, "deg, median of the pairs"),
    ("translation error", "trans_err_median", 100, "cm, median of the pairs"),
    ("ego-flow error", "epe_l2_px", 1, "px, mean of the pairs"),
)
OTHER_ALIGNMENTS: Errors = (
    ("ATE unaligned", "ate_rmse_unaligned", 100, "cm RMSE"),
    ("ATE with scale", "ate_rmse_sim3", 100, "cm RMSE (sim3)"),
)


def _facts(report: Row, errors: Errors) -> list[tuple[str, str]]:
    """Labels and numbers, or why there are none."""
    return [
        (label, f"- ({report['reasons'].get(key, 'unknown')})")
        if report[key] is None
        else (label, f"{factor * report[key]:.4g} {text.format(**report)}")
        for label, key, factor, text in errors
    ]


def _lines(facts: Iterable[tuple[str, str]]) -> str:
    return "\n".join(f"{name:17}  {value}" for name, value in facts)


def summary_text(summary: Row) -> str:
    """Summary of a run, a line a fact; oracles are named."""
    if summary["state"] == "interrupted":
        return f"interrupted after {summary['frames']} frames"
    flow = ", ".join(summary["flow_source"]) or "none"
    failed = f"failed {summary['failed']} of {summary['motions']} motions"
    facts = [
        ("sequence", f"{summary['sequence']}, {summary['frames']} frames"),
        ("method", str(summary["method"])),
        ("inputs", f"flow: {flow}; depth: {summary['depth_source']}"),
    ]
    if summary["oracle"]:
        facts.append(("ORACLE", f"uses {' and '.join(summary['oracle'])} (ground truth)"))
    facts.append(("status", f"{failed}, {summary['degraded']} degraded"))
    if summary["frame_ms_median"] is not None:
        times = (summary[f"{part}_ms_median"] for part in ("frame", "flow", "motion"))
        facts.append(("time", "{:.1f} ms a frame: flow {:.1f}, motion {:.1f}".format(*times)))
    if metrics := summary.get("metrics"):
        facts += _facts(metrics, PATH_ERRORS + PAIR_ERRORS)
    facts.append(("results", str(summary["out"])))
    if "recording" in summary:
        facts.append(("recording", f"{summary['recording']} (open it with: rerun FILE)"))
    return _lines(facts)


def evaluation_text(report: Row) -> str:
    """Errors between two trajectory files."""
    facts = [
        ("matched", f"{report['matched']} of {report['total']} poses, by {report['matched_by']}"),
        *_facts(report, PATH_ERRORS + OTHER_ALIGNMENTS),
    ]
    for label, key in (("KITTI drift", "kitti_drift"), ("drift 5 to 40 m", "kitti_drift_short")):
        drift = report[key]
        if drift is not None and drift["translation"] is not None:
            rotation = f"{drift['rotation_deg_per_m']:.4g} deg/m"
            facts.append((label, f"{100 * drift['translation']:.4g} %, {rotation}"))
    facts.append(("evo", str(report["evo_version"])))
    return _lines(facts + [("warning", text) for text in report["warnings"]])
