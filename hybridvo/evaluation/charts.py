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


def _style(methods: Sequence[str], **orders: Sequence[str]) -> dict[str, Any]:
    """What all charts share: a colour for each method, black for the ground truth; orders."""
    palette = px.colors.qualitative.Dark24
    colours = {method: palette[k % len(palette)] for k, method in enumerate(methods)}
    return {
        "labels": LABELS,
        "template": "plotly_white",
        "height": 420,
        "category_orders": {"method": [TRUTH, *methods], **orders},
        "color": "method",
        "color_discrete_map": colours | {TRUTH: "#000"},
    }


def error_distribution(pairs: pd.DataFrame, methods: Sequence[str]) -> list[Figure]:
    """Share of the pairs below an error, the sources of flow side by side."""
    known = pairs.dropna(subset=["epe_l2_px"])
    if known.empty:
        return []
    share = np.linspace(0, 1, 201)
    groups = known.groupby(["flow_source", "method"])["epe_l2_px"]
    curves = groups.quantile(share).clip(lower=FLOOR_PX)
    curves = curves.rename_axis(["flow_source", "method", "below"]).reset_index()
    curves["below"] *= 100
    figure = px.line(
        curves,
        x="epe_l2_px",
        y="below",
        facet_col="flow_source",
        log_x=True,
        **_style(methods, flow_source=flow_sources(known)),
    )
    return [figure.add_vline(FAILURE_PX, line_dash="dot")]


def failure_chart(breakdown: Mapping[str, Any], methods: Sequence[str]) -> list[Figure]:
    """Failure rate of every method with its 95 % interval, sources of flow side by side."""
    rates = pd.DataFrame(breakdown["failure_rates"]).dropna(subset=["failure_rate"])
    if rates.empty:
        return []
    names = ["failure_rate", "failure_rate_low", "failure_rate_high"]
    rates[names] = 100 * rates[names].astype(float)
    rates["above"] = rates["failure_rate_high"] - rates["failure_rate"]
    rates["under"] = rates["failure_rate"] - rates["failure_rate_low"]
    figure = px.scatter(
        rates,
        x="failure_rate",
        y="method",
        error_x="above",
        error_x_minus="under",
        facet_col="flow_source",
        **_style(methods, flow_source=flow_sources(rates)),
    )
    return [figure.update_layout(showlegend=False)]


def factor_charts(breakdown: Mapping[str, Any], methods: Sequence[str]) -> list[Figure]:
    """Median error over the bins of each factor; a factor with one bin tells nothing."""
    if not breakdown["cells"]:
        return []
    cells = pd.DataFrame(breakdown["cells"])
    cells = cells[cells["flow_source"] == flow_sources(cells)[0]].dropna(
        subset=["epe_l2_px_median"]
    )
    cells["epe_l2_px_median"] = cells["epe_l2_px_median"].clip(lower=FLOOR_PX)
    figures = []
    for factor in breakdown["factors"]:
        mine = cells[cells["factor"] == factor["name"]].sort_values("bin")
        if mine["bin"].nunique() < 2:
            continue
        unit = f" [{factor['unit']}]" if factor["unit"] else ""
        column = f"{factor['label']}{unit}"
        mine = mine.assign(**{column: mine.apply(_bin, axis=1)})
        style = _style(methods, **{column: list(mine[column].unique())})
        figure = px.line(mine, x=column, y="epe_l2_px_median", markers=True, log_y=True, **style)
        figures.append(figure.add_hline(FAILURE_PX, line_dash="dot"))
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
    rows["epe_l2_px_median"] = rows["epe_l2_px_median"].clip(lower=FLOOR_PX)
    x, y = "ms_per_pair_median", "epe_l2_px_median"
    figure = px.scatter(rows, x=x, y=y, text="method", log_x=True, log_y=True, **_style(methods))
    figure.update_traces(textposition="top center", showlegend=False)
    return [figure.add_hline(FAILURE_PX, line_dash="dot")]


# -- paths ----------------------------------------------------------------------------------------


def path_charts(
    folder: Path,
    result: Mapping[str, Any],
    pairs: pd.DataFrame,
    sequence: str,
    methods: Sequence[str],
) -> list[Figure]:
    """Path from above, error of every pair and path in space, of the first source of flow."""
    entries = pd.DataFrame(result["trajectories"])
    entries = entries[entries["sequence"] == sequence]
    flow = flow_sources(entries)[0]
    mine = pairs[(pairs["sequence"] == sequence) & (pairs["flow_source"] == flow)]
    wanted = entries["flow_source"].isna() | entries["flow_source"].eq(flow)
    paths = _positions(folder, entries[wanted])
    style = _style(methods)
    above = px.line(paths, x="right", y="forward", title=f"Path from above, {flow} flow", **style)
    above.update_yaxes(scaleanchor="x")
    axes = {"x": "right", "y": "forward", "z": "up"}
    space = px.line_3d(paths, **axes, title=f"Path in space, {flow} flow", **style)
    space.update_layout(scene_aspectmode="data")
    figures = [above, space]
    known = mine.dropna(subset=["epe_l2_px"])
    if len(known):
        known = known.assign(epe_l2_px=known["epe_l2_px"].clip(lower=FLOOR_PX))
        title = f"Error of every pair, {flow} flow"
        error = px.line(known, x="index", y="epe_l2_px", log_y=True, title=title, **style)
        figures.insert(1, error.add_hline(FAILURE_PX, line_dash="dot"))
    medians = mine.groupby("method")["epe_l2_px"].median().sort_values()
    shown = {TRUTH, *medians.index[:5]}  # the legend turns on the others
    for figure in figures:
        figure.for_each_trace(
            lambda trace: trace.update(visible=True if trace.name in shown else "legendonly")
        )
    return figures


def _positions(folder: Path, entries: pd.DataFrame) -> pd.DataFrame:
    """``method, right, forward, up`` of every path in the first true camera, metres."""
    paths = {
        entry["method"] if pd.notna(entry["method"]) else TRUTH: read_trajectory(
            folder / entry["path"], "tum"
        )
        for entry in entries.to_dict("records")
    }
    gt = paths.get(TRUTH)
    tables = []
    for method, path in paths.items():
        first = path if gt is None else gt
        path = path if gt is None else aligned(path, gt)[0]
        places = path.transformed(invert(first.T_world_cam[0])).positions
        x, y, z = places.T[:, :: len(path) // 1500 + 1]  # long lines are thinned
        tables.append(pd.DataFrame({"method": method, "right": x, "forward": z, "up": -y}))
    return pd.concat(tables)
