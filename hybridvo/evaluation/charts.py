"""Charts of a comparison as plotly figures, a function for each section of the page."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import pandas as pd
import plotly.express as px
from plotly.graph_objects import Figure

from hybridvo.evaluation.metrics import aligned
from hybridvo.evaluation.scores import FACTORS, FAILURE_PX
from hybridvo.geometry import invert
from hybridvo.trajectory import read_trajectory

FLOOR_PX = 1e-4
"""Smaller errors are drawn here: rounding must not squeeze the logarithmic axis."""
TRUTH = "ground truth"
LABELS = {
    "epe_l2_px": "EPE [px]",
    "epe_l2_px_median": "median EPE [px]",
    "index": "pair",
    "right": "x, right [m]",
    "forward": "z, forward [m]",
}


def _chart(kind: Any, rows: pd.DataFrame, methods: Sequence[str], **more: Any) -> Figure:
    """A chart with a colour for each method, black for the truth, and a line at one pixel."""
    palette = px.colors.qualitative.Dark24
    colours = {method: palette[k % len(palette)] for k, method in enumerate(methods)}
    errors = {axis: more[axis] for axis in "xy" if more.get(axis, "").startswith("epe")}
    figure = kind(
        rows.assign(**{name: rows[name].clip(lower=FLOOR_PX) for name in errors.values()}),
        color="method",
        color_discrete_map=colours | {TRUTH: "#000"},
        category_orders={"method": [TRUTH, *methods]},
        labels=LABELS,
        template="plotly_white",
        height=420,
        **{f"log_{axis}": True for axis in errors},
        **more,
    )
    for axis in errors:
        line = figure.add_vline if axis == "x" else figure.add_hline
        line(FAILURE_PX, line_dash="dot")
    return figure


def error_distribution(pairs: pd.DataFrame, methods: Sequence[str]) -> list[Figure]:
    """Share of the pairs below an error."""
    known = pairs.dropna(subset=["epe_l2_px"])
    if known.empty:
        return []
    figure = _chart(px.ecdf, known, methods, x="epe_l2_px", ecdfnorm="percent")
    return [figure.update_yaxes(title="pairs below it [%]")]


def factor_charts(pairs: pd.DataFrame, methods: Sequence[str]) -> list[Figure]:
    """Median error over the bins of each factor; a factor with one bin tells nothing."""
    figures = []
    known = pairs.dropna(subset=["epe_l2_px"])
    for name, (label, edges) in FACTORS.items():
        bins = pd.cut(known[name], edges, include_lowest=True)
        groups = known.groupby(["method", bins], observed=True)["epe_l2_px"]
        medians = groups.median().rename("epe_l2_px_median").reset_index().sort_values(name)
        if medians[name].nunique() > 1:
            medians = medians.assign(**{label: medians[name].astype(str)})
            axes = {"x": label, "y": "epe_l2_px_median", "markers": True}
            figures.append(_chart(px.line, medians, methods, **axes))
    return figures


def path_charts(
    folder: Path,
    facts: Mapping[str, Any],
    rows: Sequence[Mapping[str, Any]],
    pairs: pd.DataFrame,
    methods: Sequence[str],
) -> list[Figure]:
    """Path from above and error of every pair of one of the ``sequences`` of a result."""
    name, truth = facts["name"], facts["ground_truth"]
    files = {TRUTH: truth} if truth else {}
    files |= {row["method"]: row["trajectory"] for row in rows if row["sequence"] == name}
    paths = _positions({method: folder / file for method, file in files.items()})
    axes = {"x": "right", "y": "forward", "title": "From above"}
    figures = [_chart(px.line, paths, methods, **axes).update_yaxes(scaleanchor="x")]
    known = pairs[pairs["sequence"] == name].dropna(subset=["epe_l2_px"])
    if len(known):
        axes = {"x": "index", "y": "epe_l2_px", "title": "Error of every pair"}
        figures.append(_chart(px.line, known, methods, **axes))
    return figures


def _positions(files: Mapping[str, Path]) -> pd.DataFrame:
    """``method, right, forward`` of every path in the first true camera, metres."""
    paths = {name: read_trajectory(file, "tum") for name, file in files.items()}
    gt = paths.get(TRUTH)
    tables = []
    for method, path in paths.items():
        if gt is not None:
            path = aligned(path, gt)[0]
        first = path if gt is None else gt
        x, _, z = path.transformed(invert(first.T_world_cam[0])).positions.T
        thinned = slice(None, None, len(path) // 1500 + 1)
        rows = {"method": method, "right": x[thinned], "forward": z[thinned]}
        tables.append(pd.DataFrame(rows))
    return pd.concat(tables)
