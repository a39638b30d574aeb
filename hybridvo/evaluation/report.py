"""The report of a comparison: ``report.html`` (one file, interactive), ``.md`` and ``.tex``."""

from __future__ import annotations

import math
import shlex
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pandas as pd
import plotly.express as px
from plotly.graph_objects import Figure

from hybridvo.calibration import WRONG_PX
from hybridvo.evaluation.metrics import aligned
from hybridvo.evaluation.scores import FACTORS
from hybridvo.files import atomic_write
from hybridvo.geometry import invert
from hybridvo.options import option_defaults
from hybridvo.trajectory import Trajectory, read_trajectory


class Column(NamedTuple):
    """A column of a table of results."""

    key: str  # of a line in results.json
    label: str
    factor: float  # from the stored unit to that of the label


COLUMNS: tuple[Column, ...] = (
    Column("epe_l2_px_median", "EPE, median [px]", 1.0),
    Column("epe_l2_px", "EPE, mean [px]", 1.0),
    Column("wrong", "wrong", 1.0),
    Column("wrong_share", "wrong [%]", 100.0),
    Column("wrong_limit_px", "wrong above [px]", 1.0),
    Column("rot_err_deg_median", "rotation [deg]", 1.0),
    Column("trans_err_median", "translation [cm]", 100.0),
    Column("ate_rmse", "ATE [cm]", 100.0),
    Column("rpe_trans_rmse", "RPE [cm]", 100.0),
    Column("rpe_rot_rmse_deg", "RPE [deg]", 1.0),
    Column("rpe_trans_rmse_s", "RPE over 1 s [m/s]", 1.0),
    Column("rpe_rot_rmse_deg_s", "RPE over 1 s [deg/s]", 1.0),
    Column("ms_per_pair_median", "time [ms]", 1.0),
    Column("flow_ms_median", "+ flow [ms]", 1.0),
    Column("pairs", "pairs", 1.0),
    Column("failed", "failed", 1.0),
    Column("degraded", "degraded", 1.0),
    Column("rot_err_deg_mean", "rotation, mean [deg]", 1.0),
    Column("trans_err_mean", "translation, mean [cm]", 100.0),
    Column("epe", "paper's EPE [px]", 1.0),
    Column("r_err_deg", "paper's R_err [deg]", 1.0),
    Column("t_err", "paper's T_err [m]", 1.0),
    Column("dynamic_fraction", "moving [%]", 100.0),
)
"""The columns of the full tables."""
SUMMARY = (
    "epe_l2_px_median",
    "wrong_share",
    "rot_err_deg_median",
    "trans_err_median",
    "ate_rmse",
    "rpe_trans_rmse",
    "ms_per_pair_median",
    "flow_ms_median",
)
"""The columns of the short table, on the screen and for LaTeX."""
TEXT_COLUMNS = ("method", "flow")
"""Columns of the short table that hold texts."""
SMALLEST_DRAWN_PX = 1e-4
"""Smaller errors are drawn as this one, pixels: rounding must not squeeze a logarithmic axis."""
MAX_DRAWN_POSES = 1500
"""Poses of a path that are drawn, about."""
CHART_HEIGHT_PX = 420
TRUTH = "ground truth"
LABELS = {
    "epe_l2_px": "EPE [px]",
    "epe_l2_px_median": "median EPE [px]",
    "index": "pair",
    "right": "x, right [m]",
    "forward": "z, forward [m]",
}
"""What the axes of charts are called."""


class Table(NamedTuple):
    """A table of the report."""

    rows: list[dict[str, Any]]
    columns: Any  # Column, or the protocol's lists of the same three
    names: tuple[str, ...]  # keys of the texts that each row begins with


def write_report(
    folder: Path, result: Mapping[str, Any], pairs: pd.DataFrame
) -> None:
    """Write the report of a comparison: HTML, Markdown and LaTeX.

    Args:
        folder: The output folder, which holds the runs.
        result: The content of ``results.json``.
        pairs: The content of ``pairs.csv``.
    """
    from plotly.offline import get_plotlyjs

    totals = sorted(result["totals"], key=_rank)
    content = _content(folder, result, totals, pairs)
    environment = _environment()
    for name in ("report.html", "report.md"):
        template = environment.get_template(name)
        text = template.render(content, plotly=get_plotlyjs())
        with atomic_write(folder / name) as file:
            file.write(text)
    _write_latex(folder / "report.tex", totals)


def _environment() -> Any:
    """Return jinja's environment for the templates beside this file."""
    import jinja2

    return jinja2.Environment(
        loader=jinja2.FileSystemLoader(Path(__file__).parent / "templates"),
        autoescape=jinja2.select_autoescape(["html"]),
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
    )


def _content(
    folder: Path,
    result: Mapping[str, Any],
    totals: list[dict[str, Any]],
    pairs: pd.DataFrame,
) -> dict[str, Any]:
    """Return what the templates of the report use."""
    methods = list(dict.fromkeys(row["method"] for row in result["rows"]))
    scored = pairs.dropna(subset=["epe_l2_px"])
    protocol = result["protocol"]
    published = None
    ours = None
    by_sequence = None
    if protocol:
        columns = protocol["columns"]
        names = ("name", "inputs", "source", "note")
        published = Table(protocol["published"], columns, names)
        ours = Table(protocol["totals"], columns, ("method", "inputs"))
        by_sequence = _by_sequence(protocol)
    sequences = [
        (
            sequence["name"],
            _json(path_charts(folder, sequence, result["rows"], scored, methods)),
        )
        for sequence in result["sequences"]
    ]
    rows = sorted(result["rows"], key=_rank)
    return {
        "result": result,
        "pairs": len(pairs.drop_duplicates(["sequence", "index"])),
        "methods": methods,
        "totals": Table(totals, COLUMNS, ("method", "flow_source")),
        "sections": _sections(totals, scored, methods),
        "sequences": sequences,
        "published": published,
        "ours": ours,
        "by_sequence": by_sequence,
        "numbers": Table(rows, COLUMNS, ("sequence", "method", "flow_source")),
        "origin": origin_of(result),
        "number": number,
    }


def _by_sequence(protocol: Mapping[str, Any]) -> Table:
    """Return the table of every sequence by a protocol that scores paths."""
    columns = protocol["columns"]
    if protocol["by_sequence"]:
        # the columns of one sequence, without its name
        short = next(iter(protocol["by_sequence"].values()))
        columns = [
            (key.removesuffix(f"_{short}"), label.replace(f" {short}", ""), factor)
            for key, label, factor in columns
            if key.endswith(f"_{short}")
        ]
    return Table(protocol["rows"], columns, ("sequence", "method", "inputs"))


def _sections(
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


def _write_latex(path: Path, totals: list[dict[str, Any]]) -> None:
    """Write the short table for LaTeX."""
    table = pd.DataFrame(summary_rows(totals))
    alignment = "".join("l" if name in TEXT_COLUMNS else "r" for name in table)
    text = table.to_latex(index=False, escape=True, column_format=alignment)
    with atomic_write(path) as file:
        file.write(text)


def summary_rows(totals: list[dict[str, Any]]) -> list[dict[str, str]]:
    """Return the short table: for each method a text under every label, the best one first."""
    columns = {column.key: column for column in COLUMNS}
    rows = []
    for total in sorted(totals, key=_rank):
        row = {"method": total["method"], "flow": total["flow_source"]}
        for key in SUMMARY:
            column = columns[key]
            value = total.get(key)
            scaled = None if value is None else column.factor * value
            row[column.label] = number(scaled)
        rows.append(row)
    return rows


def origin_of(result: Mapping[str, Any]) -> list[tuple[str, str]]:
    """Return where results come from, in words: names with a text each."""
    weights = [
        f"{name} {checksum[:12]}"
        for name, checksum in result["weights"].items()
        if checksum
    ]
    changed = _changed_options(result["options"])
    return [
        ("command", shlex.join(result["command"])),
        ("versions", _listed(result["versions"])),
        ("machine", _listed(result["machine"])),
        ("weights", ", ".join(weights) or "none"),
        ("options", ", ".join(changed) or "the defaults"),
    ]


def _listed(values: Mapping[str, Any]) -> str:
    """Return keys and values as one text."""
    return ", ".join(f"{key} {value}" for key, value in values.items())


def _changed_options(options: Mapping[str, Mapping[str, Any]]) -> list[str]:
    """Return the options that differ from the defaults, as ``--set`` takes them."""
    defaults = option_defaults()
    changed = []
    for group, values in options.items():
        for name, value in values.items():
            key = f"{group}.{name}"
            if value != defaults.get(key):
                changed.append(f"{key}={value}")
    return changed


def _rank(row: Mapping[str, Any]) -> tuple[float, ...]:
    """Return the sort key of a line: estimated flow first, then the fewest wrong motions."""
    is_oracle = "(true)" in row["flow_source"]
    errors = (row["wrong_share"], row["epe_l2_px_median"])
    ranks = [math.inf if error is None else error for error in errors]
    return (is_oracle, *ranks)


def number(value: float | None) -> str:
    """Write a number with three significant digits, without exponent if large; a dash for None.

    Example:
        >>> number(0.012345), number(12345.6), number(None)
        ('0.0123', '12346', '-')
    """
    if value is None or not math.isfinite(value):
        return "-"
    if value == 0 or abs(value) >= 1000:
        return f"{value:.0f}"
    return f"{value:.3g}"


def _json(figures: list[Figure]) -> list[str]:
    """Return charts as JSON that may stand inside of a script element."""
    return [figure.to_json().replace("<", "\\u003c") for figure in figures]


# -- charts ------------------------------------------------------------------------------


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
