"""What a run and an evaluation print for people."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from hybridvo.evaluation.report import MISSING

__all__ = ["evaluation_text", "summary_text"]

_ERRORS = (
    ("ATE", "ate_rmse", 100.0, "cm RMSE"),
    ("RPE translation", "rpe_trans_rmse", 100.0, "cm RMSE a step"),
    ("RPE rotation", "rpe_rot_rmse_deg", 1.0, "deg RMSE a step"),
)
_PAIR_ERRORS = (
    ("rotation error", "rot_err_deg_median", "rot_err_deg_mean", 1.0, "deg a pair"),
    ("translation error", "trans_err_median", "trans_err_mean", 100.0, "cm a pair"),
)


def _number(value: Any, factor: float = 1.0) -> str:
    return MISSING if value is None else f"{factor * value:.4g}"


def _lines(rows: list[tuple[str, str]]) -> str:
    width = max(len(name) for name, _ in rows)
    return "".join(f"{name.ljust(width)}  {value}\n" for name, value in rows)


def _error_rows(report: Mapping[str, Any]) -> list[tuple[str, str]]:
    rows = []
    reasons = report.get("reasons", {})
    for label, key, factor, unit in _ERRORS:
        value = report.get(key)
        text = f"{_number(value, factor)} {unit}"
        if value is None:
            text = f"{MISSING} ({reasons.get(key, 'unknown')})"
        rows.append((label, text + (f" ({report['alignment']})" if key == "ate_rmse" else "")))
    return rows


def summary_text(summary: Mapping[str, Any]) -> str:
    """Summary of a run, a line per fact; oracles are named."""
    if not summary.get("frames"):
        return "no frame was finished\n"
    flow = ", ".join(summary["flow_source"]) or "none"
    rows = [
        ("sequence", f"{summary['sequence']}, {summary['frames']} frames"),
        ("method", str(summary["method"])),
        ("inputs", f"flow: {flow}; depth: {summary['depth_source']}"),
    ]
    if summary["oracle"]:
        rows.append(("ORACLE", f"uses {' and '.join(summary['oracle'])} (ground truth)"))
    rows.append(("failed", f"{summary['failed']} ({summary['degraded']} degraded)"))
    ms = summary["ms_per_pair_median"]
    rows.append(("time", MISSING if ms is None else f"{ms:.1f} ms a pair, flow included (median)"))
    metrics = summary.get("metrics")
    if metrics:
        rows += _error_rows(metrics)
        for label, median, mean, factor, unit in _PAIR_ERRORS:
            values = f"{_number(metrics.get(median), factor)} median"
            rows.append((label, f"{values}, {_number(metrics.get(mean), factor)} mean {unit}"))
        rows.append(("end-point error", f"{_number(metrics.get('epe_l2_px'))} px mean"))
    rows.append(("results", str(summary["out"])))
    if "recording" in summary:
        rows.append(("recording", f"{summary['recording']} (open it with: rerun FILE)"))
    return _lines(rows)


def evaluation_text(report: Mapping[str, Any]) -> str:
    """Errors between two trajectory files."""
    drift = report.get("kitti_drift") or {}
    short = report.get("kitti_drift_short") or {}
    rows = [
        ("matched", f"{report['matched']} of {report['total']} poses, by {report['matched_by']}"),
        *_error_rows(report),
        ("ATE unaligned", f"{_number(report['ate_rmse_unaligned'], 100.0)} cm RMSE"),
        ("ATE with scale", f"{_number(report['ate_rmse_sim3'], 100.0)} cm RMSE (sim3)"),
    ]
    for label, value in (("KITTI drift", drift), ("drift 5 to 40 m", short)):
        translation, rotation = value.get("translation"), value.get("rotation_deg_per_m")
        rows.append((label, f"{_number(translation, 100.0)} %, {_number(rotation)} deg/m"))
    rows.append(("evo", str(report["evo_version"])))
    rows += [("note", notice) for notice in report.get("notices", ())]
    return _lines(rows)
