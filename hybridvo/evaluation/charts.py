"""Charts of a comparison as plotly figures: plain mappings with ``data`` and ``layout``."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from hybridvo.evaluation.trajectory_errors import ate
from hybridvo.geometry import invert
from hybridvo.trajectory import Trajectory, read_trajectory

Chart = dict[str, Any]

COLOURS = (
    *("#d62728", "#1f77b4", "#2ca02c", "#ff7f0e", "#9467bd", "#17becf", "#8c564b", "#e377c2"),
    *("#bcbd22", "#003f5c", "#7a9a01", "#b15928", "#f781bf", "#00997a", "#6a3d9a", "#c7a500"),
    "#708090",
)
"""One for each method, told apart on white; black is the ground truth."""
FLOOR_PX = 1e-4
"""Smaller errors are drawn here: rounding must not squeeze the logarithmic axis."""
SHOWN_PATHS = 5
"""Methods whose lines are shown at first; the legend turns on the others."""
MAX_POINTS = 1500
"""Points of a line; longer ones are thinned."""


def _layout(title: str, x: str, y: str, **more: Any) -> Chart:
    return {
        "title": {"text": title, "font": {"size": 14}, "x": 0, "xref": "paper"},
        "xaxis": {"title": {"text": x}, "gridcolor": "#e3e7eb", "zeroline": False},
        "yaxis": {"title": {"text": y}, "gridcolor": "#e3e7eb", "zeroline": False},
        "height": 420,
        "margin": {"l": 70, "r": 20, "t": 45, "b": 55},
        "plot_bgcolor": "#fff",
        "legend": {"itemclick": "toggle", "font": {"size": 11}},
        **more,
    }


def _log(axis: Chart) -> Chart:
    return axis | {"type": "log", "exponentformat": "power", "dtick": 1}


def _flows(rows: Sequence[Mapping[str, Any]]) -> list[str]:
    """Sources of flow, estimated ones first."""
    return sorted(dict.fromkeys(row["flow_source"] for row in rows), key=lambda f: "(true)" in f)


def _colour(method: str, methods: Sequence[str]) -> str:
    return COLOURS[list(methods).index(method) % len(COLOURS)]


def error_distribution(pairs: pd.DataFrame, methods: Sequence[str]) -> list[Chart]:
    """Share of the pairs below an error, one chart for each flow, all on one scale."""
    known = pairs[pairs["epe_l2_px"].notna()]
    if known.empty:
        return []
    low, high = np.log10(known["epe_l2_px"].clip(lower=FLOOR_PX).quantile([0.0, 1.0]))
    charts = []
    for flow in _flows(known.to_dict("records")):
        data = []
        for method in methods:
            mine = known[(known["method"] == method) & (known["flow_source"] == flow)]
            if mine.empty:
                continue
            x = np.sort(mine["epe_l2_px"].clip(lower=FLOOR_PX).to_numpy())
            y = 100 * np.arange(1, len(x) + 1) / len(x)
            data.append(_line(method, methods, x, y, shape="hv"))
        layout = _layout(f"{flow} flow", "error of the ego flow, EPE [px]", "pairs below it [%]")
        layout["xaxis"] = _log(layout["xaxis"]) | {"range": [float(low) - 0.1, float(high) + 0.1]}
        layout["shapes"] = [_limit("x")]
        charts.append({"data": data, "layout": layout})
    return charts


def _limit(axis: str) -> Chart:
    """Mark at one pixel, where an estimate counts as failed."""
    other = "y" if axis == "x" else "x"
    ends = {f"{axis}0": 1, f"{axis}1": 1, f"{other}0": 0, f"{other}1": 1}
    line = {"dash": "dot", "color": "#444", "width": 1}
    return {"type": "line", f"{other}ref": "paper", **ends, "line": line}


def _line(
    method: str, methods: Sequence[str], x: Any, y: Any, *, shape: str = "linear", **more: Any
) -> Chart:
    keep = np.unique(np.linspace(0, len(x) - 1, min(len(x), MAX_POINTS)).round().astype(int))
    # earlier methods are thinner and drawn last: lines that coincide show as bands
    place = list(methods).index(method)
    return {
        "type": "scatter",
        "mode": "lines" if len(x) > 1 else "markers",
        "name": method,
        "x": _numbers(np.asarray(x, float)[keep]),
        "y": _numbers(np.asarray(y, float)[keep]),
        "line": {
            "color": _colour(method, methods),
            "width": 1.6 + min(place, 6) * 0.5,
            "shape": shape,
        },
        "zorder": -place,
        **more,
    }


def _numbers(values: np.ndarray) -> list[float | None]:
    """Plain numbers, five digits, None where unknown."""
    return [float(f"{v:.5g}") if np.isfinite(v) else None for v in values]


def failure_chart(breakdown: Mapping[str, Any], methods: Sequence[str]) -> list[Chart]:
    """Failure rate of every method with its interval, one chart for each flow."""
    charts = []
    for flow in _flows(breakdown["failure_rates"]):
        rates = [
            rate
            for rate in breakdown["failure_rates"]
            if rate["flow_source"] == flow and rate["failure_rate"] is not None
        ]
        if not rates:
            continue
        rates.sort(key=lambda rate: rate["failure_rate"], reverse=True)
        middle = [100 * rate["failure_rate"] for rate in rates]
        high = [100 * rate["failure_rate_high"] for rate in rates]
        low = [100 * rate["failure_rate_low"] for rate in rates]
        error = {
            "type": "data",
            "symmetric": False,
            "array": _numbers(np.subtract(high, middle)),
            "arrayminus": _numbers(np.subtract(middle, low)),
        }
        trace = {
            "type": "scatter",
            "mode": "markers",
            "x": _numbers(np.array(middle)),
            "y": [rate["method"] for rate in rates],
            "error_x": error,
            "marker": {"size": 9, "color": [_colour(r["method"], methods) for r in rates]},
            "showlegend": False,
        }
        title = f"{flow} flow: above 1 px or given up, with 95 % interval"
        layout = _layout(title, "failures [%]", "")
        layout["xaxis"] |= {"range": [-2, 102]}
        layout["yaxis"] |= {"automargin": True}
        charts.append({"data": [trace], "layout": layout})
    return charts


def factor_charts(breakdown: Mapping[str, Any], methods: Sequence[str]) -> list[Chart]:
    """Median error over the bins of each factor; a factor with one bin tells nothing."""
    charts = []
    flow = next(iter(_flows(breakdown["cells"])), None)
    for factor in breakdown["factors"]:
        cells = [
            cell
            for cell in breakdown["cells"]
            if (cell["factor"], cell["flow_source"]) == (factor["name"], flow)
            and cell["epe_l2_px_median"] is not None
        ]
        bins = sorted({cell["bin"] for cell in cells})
        if len(bins) < 2:
            continue
        labels = {c["bin"]: f"{_bin(c, factor)}<br>{c['pairs']} pairs" for c in cells}
        data = []
        for method in methods:
            mine = {c["bin"]: c for c in cells if c["method"] == method}
            y = [mine[b]["epe_l2_px_median"] if b in mine else np.nan for b in bins]
            trace = _line(method, methods, np.arange(len(bins)), np.maximum(y, FLOOR_PX))
            trace |= {"mode": "lines+markers"}
            data.append(trace)
        unit = f" [{factor['unit']}]" if factor["unit"] else ""
        layout = _layout(f"{flow} flow", f"{factor['label']}{unit}", "median EPE [px]")
        layout["xaxis"] |= {
            "tickvals": list(range(len(bins))),
            "ticktext": [labels[b] for b in bins],
        }
        layout["yaxis"] = _log(layout["yaxis"])
        layout["shapes"] = [_limit("y")]
        charts.append({"data": data, "layout": layout})
    return charts


def _bin(cell: Mapping[str, Any], factor: Mapping[str, Any]) -> str:
    scale, unit = (100, " %") if factor["name"] == "dynamic_fraction" else (1, "")
    if cell["high"] is None:
        return f"≥ {scale * cell['low']:.4g}{unit}"
    return f"{scale * cell['low']:.4g} to {scale * cell['high']:.4g}{unit}"


def time_chart(totals: Sequence[Mapping[str, Any]], methods: Sequence[str]) -> list[Chart]:
    """Median error over median time, of the first source of flow."""
    flow = next(iter(_flows(totals)), None)
    rows = [
        row
        for row in totals
        if row["flow_source"] == flow
        and row["epe_l2_px_median"] is not None
        and row["ms_per_pair_median"] is not None
        and row["method"] != "identity"
    ]
    if len(rows) < 2:
        return []
    data = [
        {
            "type": "scatter",
            "mode": "markers+text",
            "name": row["method"],
            "text": [row["method"]],
            "textposition": "top center",
            "x": [row["ms_per_pair_median"]],
            "y": [max(row["epe_l2_px_median"], FLOOR_PX)],
            "marker": {"size": 11, "color": _colour(row["method"], methods)},
            "showlegend": False,
        }
        for row in rows
    ]
    layout = _layout(f"{flow} flow", "time per pair, flow not included [ms]", "median EPE [px]")
    layout["xaxis"], layout["yaxis"] = _log(layout["xaxis"]), _log(layout["yaxis"])
    layout["shapes"] = [_limit("y")]
    return [{"data": data, "layout": layout}]


# -- paths ----------------------------------------------------------------------------------------


def path_charts(
    folder: Path,
    result: Mapping[str, Any],
    pairs: pd.DataFrame,
    sequence: str,
    methods: Sequence[str],
) -> list[Chart]:
    """Path from above, error of every pair and path in space, of the first source of flow."""
    known = [entry for entry in result["trajectories"] if entry["sequence"] == sequence]
    flow = next(iter(_flows([entry for entry in known if entry["method"]])), None)
    mine = pairs[(pairs["sequence"] == sequence) & (pairs["flow_source"] == flow)]
    medians = mine.groupby("method")["epe_l2_px"].median().sort_values()
    shown = [*medians.index[:SHOWN_PATHS]] or list(methods[:SHOWN_PATHS])
    gt = next((_read(folder, entry) for entry in known if not entry["method"]), None)
    above, space, errors = [], [], []
    if gt is not None:
        x, y, z = gt.transformed(invert(gt.T_world_cam[0])).positions.T
        style = {"name": "ground truth", "mode": "lines", "line": {"color": "#000", "width": 7}}
        above.append(
            style | {"type": "scatter", "x": _numbers(x), "y": _numbers(z), "opacity": 0.3}
        )
        space.append(style | {"type": "scatter3d"} | _space(x, y, z))
    for entry in known:
        method = entry["method"]
        if entry["flow_source"] != flow or method not in methods:
            continue
        path = _read(folder, entry)
        x, y, z = _in_first_camera(path, gt).T
        visible = True if method in shown else "legendonly"
        trace = _line(method, methods, x, z, visible=visible)
        above.append(trace | {"mode": "lines"})
        colour = {"color": _colour(method, methods), "width": 4}
        named = {"type": "scatter3d", "mode": "lines", "name": method, "visible": visible}
        space.append({**named, "line": colour, **_space(x, y, z)})
    for method in methods:
        rows = mine[(mine["method"] == method) & mine["epe_l2_px"].notna()]
        if len(rows):
            y = rows["epe_l2_px"].clip(lower=FLOOR_PX)
            visible = True if method in shown else "legendonly"
            errors.append(_line(method, methods, rows["index"], y, visible=visible))
    charts = []
    if above:
        layout = _layout(f"Path from above, {flow} flow", "x, right [m]", "z, forward [m]")
        layout["yaxis"] |= {"scaleanchor": "x"}
        charts.append({"data": above, "layout": layout})
    if errors:
        layout = _layout(f"Error of every pair, {flow} flow", "pair", "EPE [px]")
        layout["yaxis"] = _log(layout["yaxis"])
        layout["shapes"] = [_limit("y")]
        charts.append({"data": errors, "layout": layout})
    if space:
        layout = _layout(f"Path in space, {flow} flow", "", "")
        titles = (("xaxis", "x, right [m]"), ("yaxis", "z, forward [m]"), ("zaxis", "up [m]"))
        scene = {axis: {"title": {"text": text}} for axis, text in titles}
        layout["scene"] = scene | {"aspectmode": "data"}
        charts.append({"data": space, "layout": layout})
    return charts


def _space(x: np.ndarray, y: np.ndarray, z: np.ndarray) -> Chart:
    """Camera axes (y down) as plotly's (z up)."""
    return {"x": _numbers(x), "y": _numbers(z), "z": _numbers(-y)}


def _read(folder: Path, entry: Mapping[str, Any]) -> Trajectory:
    return read_trajectory(folder / entry["path"], "tum")


def _in_first_camera(path: Trajectory, gt: Trajectory | None) -> np.ndarray:
    """(N, 3) positions in the first true camera, aligned as far as the paths determine it."""
    if gt is None:
        return path.transformed(invert(path.T_world_cam[0])).positions
    for alignment in ("se3", "origin"):
        error = ate(path, gt, alignment)
        if error.T_gt_est is not None:
            path = path.transformed(error.T_gt_est)
            break
    return path.transformed(invert(gt.T_world_cam[0])).positions
