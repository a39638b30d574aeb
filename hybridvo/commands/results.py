"""Files of a run, from the rows of its frames."""

from __future__ import annotations

import os
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
