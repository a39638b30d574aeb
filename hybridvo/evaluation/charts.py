"""Charts of a comparison as plotly figures, a function for each section of the page."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import plotly.express as px
from plotly.graph_objects import Figure

from hybridvo.evaluation.metrics import aligned
from hybridvo.evaluation.scores import FAILURE_PX
from hybridvo.geometry import invert
from hybridvo.trajectory import read_trajectory

FLOOR_PX = 1e-4
"""Smaller errors are drawn here: rounding must not squeeze the logarithmic axis."""
TRUTH = "ground truth"
LABELS = {
    "epe_l2_px": "EPE [px]",
    "epe_l2_px_median": "median EPE [px]",
    "below": "pairs below it [%]",
    "failure_rate": "failures [%]",
    "ms_per_pair_median": "time per pair, flow not included [ms]",
    "index": "pair",
    "right": "x, right [m]",
    "forward": "z, forward [m]",
    "up": "up [m]",
}


def flow_sources(rows: pd.DataFrame) -> list[str]:
    """Sources of flow, estimated ones first."""
    return sorted(rows["flow_source"].dropna().unique(), key=is_oracle)


def is_oracle(flow: str) -> bool:
    """Whether a source of flow is ground truth."""
    return "(true)" in flow


def _chart(
    kind: Any, rows: pd.DataFrame, x: str, y: str, methods: Sequence[str], **more: Any
) -> Figure:
    """A chart with a colour for each method, black for the truth, and a line at one pixel."""
    palette = px.colors.qualitative.Dark24
    colours = {method: palette[k % len(palette)] for k, method in enumerate(methods)}
    orders = {"method": [TRUTH, *methods], "flow_source": flow_sources(rows)}
    if not pd.api.types.is_numeric_dtype(rows[x]):
        orders[x] = list(rows[x].unique())
    errors = [name for name in (x, y) if name.startswith("epe")]
    rows = rows.assign(**{name: rows[name].clip(lower=FLOOR_PX) for name in errors})
    figure = kind(
        rows,
        x=x,
        y=y,
        color="method",
        color_discrete_map=colours | {TRUTH: "#000"},
        category_orders=orders,
        labels=LABELS,
        template="plotly_white",
        height=420,
        **{f"log_{'x' if name == x else 'y'}": True for name in errors},
        **more,
    )
    for name in errors:
        line = figure.add_vline if name == x else figure.add_hline
        line(FAILURE_PX, line_dash="dot")
    return figure


def error_distribution(pairs: pd.DataFrame, methods: Sequence[str]) -> list[Figure]:
    """Share of the pairs below an error, the sources of flow side by side."""
    known = pairs.dropna(subset=["epe_l2_px"])
    if known.empty:
        return []
    groups = known.groupby(["flow_source", "method"])["epe_l2_px"]
    curves = groups.quantile(np.linspace(0, 1, 201))
    curves = curves.rename_axis(["flow_source", "method", "below"]).reset_index()
    curves["below"] *= 100
    return [_chart(px.line, curves, "epe_l2_px", "below", methods, facet_col="flow_source")]


def failure_chart(breakdown: Mapping[str, Any], methods: Sequence[str]) -> list[Figure]:
    """Failure rate of every method with its 95 % interval, sources of flow side by side."""
    rates = pd.DataFrame(breakdown["failure_rates"]).dropna(subset=["failure_rate"])
    if rates.empty:
        return []
    low, rate, high = (
        100 * rates[f"failure_rate{end}"].astype(float) for end in ("_low", "", "_high")
    )
    rates = rates.assign(failure_rate=rate, above=high - rate, under=rate - low)
    bars = {"error_x": "above", "error_x_minus": "under", "facet_col": "flow_source"}
    figure = _chart(px.scatter, rates, "failure_rate", "method", methods, **bars)
    return [figure.update_layout(showlegend=False)]


def factor_charts(breakdown: Mapping[str, Any], methods: Sequence[str]) -> list[Figure]:
    """Median error over the bins of each factor; a factor with one bin tells nothing."""
    if not breakdown["cells"]:
        return []
    cells = pd.DataFrame(breakdown["cells"])
    cells = cells[cells["flow_source"] == flow_sources(cells)[0]]
    cells = cells.dropna(subset=["epe_l2_px_median"])
    figures = []
    for factor in breakdown["factors"]:
        mine = cells[cells["factor"] == factor["name"]].sort_values("bin")
        if mine["bin"].nunique() > 1:
            column = factor["label"] + (f" [{factor['unit']}]" if factor["unit"] else "")
            mine = mine.assign(**{column: mine.apply(_bin, axis=1)})
            figure = _chart(px.line, mine, column, "epe_l2_px_median", methods, markers=True)
            figures.append(figure)
    return figures


def _bin(cell: Any) -> str:
    pairs = f"<br>{cell['pairs']} pairs"
    if pd.isna(cell["high"]):
        return f"≥ {cell['low']:.4g}{pairs}"
    return f"{cell['low']:.4g} to {cell['high']:.4g}{pairs}"


def time_chart(totals: Sequence[Mapping[str, Any]], methods: Sequence[str]) -> list[Figure]:
    """Median error over median time, of the first source of flow."""
    rows = pd.DataFrame(totals).dropna(subset=["epe_l2_px_median", "ms_per_pair_median"])
    rows = rows[rows["method"] != "identity"]
    if len(rows) < 2:
        return []
    rows = rows[rows["flow_source"] == flow_sources(rows)[0]]
    names = ("ms_per_pair_median", "epe_l2_px_median")
    figure = _chart(px.scatter, rows, *names, methods, text="method", log_x=True)
    return [figure.update_traces(textposition="top center", showlegend=False)]


def path_charts(
    folder: Path,
    result: Mapping[str, Any],
    pairs: pd.DataFrame,
    sequence: str,
    methods: Sequence[str],
) -> list[Figure]:
    """Path from above, error of every pair and path in space, of the first source of flow."""
    (truth,) = (s["ground_truth"] for s in result["sequences"] if s["name"] == sequence)
    rows = pd.DataFrame([row for row in result["rows"] if row["sequence"] == sequence])
    flow = flow_sources(rows)[0]
    mine = pairs[(pairs["sequence"] == sequence) & (pairs["flow_source"] == flow)]
    rows = rows[rows["flow_source"] == flow]
    files = ({TRUTH: truth} if truth else {}) | dict(
        zip(rows["method"], rows["trajectory"], strict=True)
    )
    paths = _positions({name: folder / file for name, file in files.items()})
    paths["flow_source"] = flow
    above = _chart(px.line, paths, "right", "forward", methods, title=f"From above, {flow} flow")
    above.update_yaxes(scaleanchor="x")
    titled = {"z": "up", "title": f"Path in space, {flow} flow"}
    space = _chart(px.line_3d, paths, "right", "forward", methods, **titled)
    figures = [above, space.update_layout(scene_aspectmode="data")]
    known = mine.dropna(subset=["epe_l2_px"])
    if len(known):
        title = f"Error of every pair, {flow} flow"
        figures.insert(1, _chart(px.line, known, "index", "epe_l2_px", methods, title=title))
    medians = mine.groupby("method")["epe_l2_px"].median().sort_values()
    shown = {TRUTH, *medians.index[:5]}  # the legend turns on the others
    for figure in figures:
        figure.for_each_trace(
            lambda trace: trace.update(visible=True if trace.name in shown else "legendonly")
        )
    return figures


def _positions(files: Mapping[str, Path]) -> pd.DataFrame:
    """``method, right, forward, up`` of every path in the first true camera, metres."""
    paths = {name: read_trajectory(file, "tum") for name, file in files.items()}
    gt = paths.get(TRUTH)
    tables = []
    for method, path in paths.items():
        first = path if gt is None else gt
        path = path if gt is None else aligned(path, gt)[0]
        places = path.transformed(invert(first.T_world_cam[0])).positions
        x, y, z = places.T[:, :: len(path) // 1500 + 1]  # long lines are thinned
        tables.append(pd.DataFrame({"method": method, "right": x, "forward": z, "up": -y}))
    return pd.concat(tables)
