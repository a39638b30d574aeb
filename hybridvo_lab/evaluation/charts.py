"""The charts of ``report.html``."""

from __future__ import annotations

import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import plotly.express as px
from plotly.graph_objects import Figure
from scipy.stats import chi2

from hybridvo.core.geometry import invert
from hybridvo.core.trajectory import Trajectory, read_trajectory
from hybridvo_lab.calibration import WRONG_PX
from hybridvo_lab.evaluation.belief import DOF, is_wrong, reliability
from hybridvo_lab.evaluation.metrics import aligned
from hybridvo_lab.evaluation.scores import FACTORS

SMALLEST_DRAWN_PX = 1e-4
"""Smaller errors are drawn as this one, pixels: rounding must not squeeze a logarithmic axis."""
MAX_DRAWN_POSES = 1500
"""Poses of a path that are drawn, about."""
CHART_HEIGHT_PX = 420
NEES_FRACTIONS = (0.001, 0.999)
"""Ends of the curve of a true covariance, as fractions of all pairs."""
NEES_POINTS = 200
"""Points of that curve."""
DOT_OPACITY = 0.6
PERFECT: dict[str, Any] = {
    "mode": "lines",
    "line": {"color": "#000", "dash": "dot", "width": 1.5},
}
"""How the line of a perfect statement is drawn."""
TRUTH = "ground truth"
LABELS = {
    "epe_l2_px": "EPE [px]",
    "epe_l2_px_median": "median EPE [px]",
    "index": "pair",
    "nees": "NEES, squared error over covariance",
    "sigma_mm": "stated sigma [mm]",
    "error_mm": "error [mm]",
    "probability": "stated probability",
    "percent": "right [%]",
    "right": "x, right [m]",
    "forward": "z, forward [m]",
}
"""What the axes of charts are called."""


def summary_charts(
    totals: list[dict[str, Any]], scored: pd.DataFrame, methods: list[str]
) -> list[tuple[str, list[str]]]:
    """Return the titles and the charts over all sequences.

    They show one source of flow: pairs with true flow, an oracle, are not pooled with others.
    """
    flow = totals[0]["flow_source"] if totals else "no"
    pooled = scored[scored["flow_source"] == flow]
    sections = (
        (
            f"How the errors are distributed, {flow} flow",
            error_distribution(pooled, methods),
        ),
        (f"What makes it fail, {flow} flow", factor_charts(pooled, methods)),
    )
    return [(title, _json(charts)) for title, charts in sections if charts]


def belief_charts(
    totals: list[dict[str, Any]], scored: pd.DataFrame, methods: list[str]
) -> list[str]:
    """Return the charts of what motions state of themselves, against what is true.

    They show one source of flow, as those over all sequences do.
    """
    flow = totals[0]["flow_source"] if totals else "no"
    pooled = scored[scored["flow_source"] == flow]
    if pooled.empty:
        return []
    drawn = [
        *nees_chart(pooled, methods),
        *sigma_chart(pooled, methods),
        *reliability_chart(pooled, methods),
    ]
    return _json(drawn)


def nees_chart(scored: pd.DataFrame, methods: list[str]) -> list[Figure]:
    """Draw the fraction of the right motions whose NEES is below a value."""
    known = scored[~is_wrong(scored) & (scored["nees"] > 0)]
    if known.empty:
        return []
    title = "NEES of the right motions"
    figure = _chart(
        px.ecdf,
        known,
        methods,
        x="nees",
        ecdfnorm="percent",
        title=title,
        log_x=True,
    )
    fractions = np.linspace(*NEES_FRACTIONS, NEES_POINTS)
    figure.add_scatter(
        x=chi2.ppf(fractions, DOF),
        y=100 * fractions,
        **PERFECT,
        name="true covariance",
    )
    return [figure.update_yaxes(title="pairs below it [%]")]


def sigma_chart(scored: pd.DataFrame, methods: list[str]) -> list[Figure]:
    """Draw the error of each translation over its stated standard deviation."""
    known = scored[(scored["sigma_trans"] > 0) & (scored["trans_err"] > 0)]
    known = known[~known["status"].str.startswith("failed")]
    if known.empty:
        return []
    known = known.assign(
        sigma_mm=1e3 * known["sigma_trans"], error_mm=1e3 * known["trans_err"]
    )
    figure = _chart(
        px.scatter,
        known,
        methods,
        x="sigma_mm",
        y="error_mm",
        title="Error of the translation over its sigma",
        hover_data=["sequence", "index", "status"],
        log_x=True,
        log_y=True,
        opacity=DOT_OPACITY,
    )
    ends = np.array([known["sigma_mm"].min(), known["sigma_mm"].max()])
    for times in (1, 3):
        figure.add_scatter(x=ends, y=times * ends, **PERFECT, name=f"{times} sigma")
    return [figure]


def reliability_chart(scored: pd.DataFrame, methods: list[str]) -> list[Figure]:
    """Draw how often motions of about one probability are right."""
    rows = reliability(scored)
    if rows.empty:
        return []
    rows["percent"] = 100 * rows["right"]
    figure = _chart(
        px.line,
        rows,
        methods,
        x="probability",
        y="percent",
        markers=True,
        hover_data=["motions"],
        title="How often a motion of some probability is right",
    )
    figure.add_scatter(x=[0, 1], y=[0, 100], **PERFECT, name="true probability")
    return [figure]


def _json(figures: list[Figure]) -> list[str]:
    """Return charts as JSON that may stand inside of a script element."""
    return [figure.to_json().replace("<", "\\u003c") for figure in figures]


def sequence_charts(
    folder: Path,
    result: Mapping[str, Any],
    scored: pd.DataFrame,
    methods: list[str],
) -> list[tuple[str, list[str]]]:
    """Return the names of the sequences and their charts."""
    rows = result["rows"]
    found = []
    for sequence in result["sequences"]:
        charts = path_charts(folder, sequence, rows, scored, methods)
        found.append((sequence["name"], _json(charts)))
    return found


def _chart(
    kind: Any, rows: pd.DataFrame, methods: list[str], **more: Any
) -> Figure:
    """Make a chart with a colour for each method, black for the ground truth.

    Axes of errors are logarithmic, and have a line where a motion begins to count as wrong.

    Args:
        kind: A function of plotly.express.
        rows: The table, with a column ``method``.
        methods: All methods of the report, so that colours are the same in every chart.
        more: Further arguments of ``kind``; ``x`` and ``y`` are columns.
    """
    palette = px.colors.qualitative.Dark24
    colours = {
        method: palette[k % len(palette)] for k, method in enumerate(methods)
    }
    error_axes = [axis for axis in "xy" if more.get(axis, "").startswith("epe")]
    drawn = rows.copy()
    for axis in error_axes:
        name = more[axis]
        drawn[name] = drawn[name].clip(lower=SMALLEST_DRAWN_PX)
        more[f"log_{axis}"] = True
    figure = kind(
        drawn,
        color="method",
        color_discrete_map=colours | {TRUTH: "#000"},
        category_orders={"method": [TRUTH, *methods]},
        labels=LABELS,
        template="plotly_white",
        height=CHART_HEIGHT_PX,
        **more,
    )
    limit = _wrong_limit(rows)
    if "x" in error_axes:
        figure.add_vline(limit, line_dash="dot")
    if "y" in error_axes:
        figure.add_hline(limit, line_dash="dot")
    return figure


def _wrong_limit(rows: pd.DataFrame) -> float:
    """Return the median error, pixels, beyond which a motion is called wrong."""
    if "wrong_limit_px" not in rows:
        return WRONG_PX
    median = float(rows["wrong_limit_px"].median())
    return WRONG_PX if math.isnan(median) else median


def error_distribution(scored: pd.DataFrame, methods: list[str]) -> list[Figure]:
    """Draw the fraction of the pairs whose error is below a value."""
    if scored.empty:
        return []
    figure = _chart(px.ecdf, scored, methods, x="epe_l2_px", ecdfnorm="percent")
    return [figure.update_yaxes(title="pairs below it [%]")]


def factor_charts(scored: pd.DataFrame, methods: list[str]) -> list[Figure]:
    """Draw the median error over the bins of each factor that has more than one bin."""
    figures = []
    for name, factor in FACTORS.items():
        bins = pd.cut(scored[name], list(factor.edges), include_lowest=True)
        groups = scored.groupby(["method", bins], observed=True)["epe_l2_px"]
        medians = groups.median().rename("epe_l2_px_median").reset_index()
        medians = medians.sort_values(name)
        if medians[name].nunique() > 1:
            medians[factor.label] = medians[name].astype(str)
            # the line of the other charts: medians of groups have none of their own
            medians["wrong_limit_px"] = _wrong_limit(scored)
            chart = _chart(
                px.line,
                medians,
                methods,
                x=factor.label,
                y="epe_l2_px_median",
                markers=True,
            )
            figures.append(chart)
    return figures


def path_charts(
    folder: Path,
    sequence: Mapping[str, Any],
    rows: list[dict[str, Any]],
    scored: pd.DataFrame,
    methods: list[str],
) -> list[Figure]:
    """Draw the paths on a sequence from above, and the error of every pair.

    Args:
        folder: The output folder, which holds the trajectories.
        sequence: What ``results.json`` states of the sequence.
        rows: The lines of all methods on all sequences.
        scored: The pairs with a known error.
        methods: All methods of the report.
    """
    name = sequence["name"]
    own_rows = [row for row in rows if row["sequence"] == name]
    paths = {
        row["method"]: read_trajectory(folder / row["trajectory"])
        for row in own_rows
    }
    truth = None
    if sequence["ground_truth"]:
        truth = read_trajectory(folder / sequence["ground_truth"])
        paths = {
            method: aligned(path, truth).trajectory
            for method, path in paths.items()
        }
        paths = {TRUTH: truth, **paths}
    if not paths:
        return []
    tables = [
        _path_table(method, path, truth or path) for method, path in paths.items()
    ]
    above = _chart(
        px.line,
        pd.concat(tables),
        methods,
        x="right",
        y="forward",
        title="From above",
    )
    charts = [above.update_yaxes(scaleanchor="x")]
    own_pairs = scored[scored["sequence"] == name]
    if len(own_pairs):
        errors = _chart(
            px.line,
            own_pairs,
            methods,
            x="index",
            y="epe_l2_px",
            title="Error of every pair",
        )
        charts.append(errors)
    return charts


def _path_table(method: str, path: Trajectory, first: Trajectory) -> pd.DataFrame:
    """Return a path from above, metres, in the first camera frame of another path."""
    step = len(path) // MAX_DRAWN_POSES + 1
    in_first_camera = path.transformed(invert(first.T_world_cam[0]))
    positions: np.ndarray = in_first_camera.positions[::step]
    return pd.DataFrame(
        {"method": method, "right": positions[:, 0], "forward": positions[:, 2]}
    )
