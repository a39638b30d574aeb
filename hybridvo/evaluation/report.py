"""The report of a comparison: ``report.html`` (one file, interactive), ``.md`` and ``.tex``."""

from __future__ import annotations

import math
import shlex
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import pandas as pd
import plotly.express as px
from plotly.graph_objects import Figure

from hybridvo.calibration import WRONG_PX
from hybridvo.evaluation.metrics import aligned
from hybridvo.evaluation.scores import FACTORS
from hybridvo.files import atomic_write
from hybridvo.geometry import invert
from hybridvo.options import option_defaults
from hybridvo.trajectory import read_trajectory

COLUMNS: tuple[tuple[str, str, float], ...] = (
    ("epe_l2_px_median", "EPE, median [px]", 1.0),
    ("epe_l2_px", "EPE, mean [px]", 1.0),
    ("wrong", "wrong", 1.0),
    ("wrong_share", "wrong [%]", 100.0),
    ("wrong_limit_px", "wrong above [px]", 1.0),
    ("rot_err_deg_median", "rotation [deg]", 1.0),
    ("trans_err_median", "translation [cm]", 100.0),
    ("ate_rmse", "ATE [cm]", 100.0),
    ("rpe_trans_rmse", "RPE [cm]", 100.0),
    ("rpe_rot_rmse_deg", "RPE [deg]", 1.0),
    ("ms_per_pair_median", "time [ms]", 1.0),
    ("flow_ms_median", "+ flow [ms]", 1.0),
    ("pairs", "pairs", 1.0),
    ("failed", "failed", 1.0),
    ("degraded", "degraded", 1.0),
    ("rot_err_deg_mean", "rotation, mean [deg]", 1.0),
    ("trans_err_mean", "translation, mean [cm]", 100.0),
    ("epe", "paper's EPE [px]", 1.0),
    ("r_err_deg", "paper's R_err [deg]", 1.0),
    ("t_err", "paper's T_err [m]", 1.0),
    ("dynamic_fraction", "moving [%]", 100.0),
)
SUMMARY = (
    *("epe_l2_px_median", "wrong_share", "rot_err_deg_median", "trans_err_median"),
    *("ate_rmse", "rpe_trans_rmse", "ms_per_pair_median", "flow_ms_median"),
)
"""The columns of the short table, on the screen and for LaTeX."""
# smaller errors are drawn as this one, for rounding must not squeeze the axis
FLOOR_PX = 1e-4
TRUTH = "ground truth"
LABELS = {
    "epe_l2_px": "EPE [px]",
    "epe_l2_px_median": "median EPE [px]",
    "index": "pair",
    "right": "x, right [m]",
    "forward": "z, forward [m]",
}


def write_report(
    folder: Path, result: Mapping[str, Any], pairs: pd.DataFrame
) -> None:
    """Write both reports of the content of ``results.json`` and of all pairs."""
    import jinja2
    from plotly.offline import get_plotlyjs

    environment = jinja2.Environment(
        loader=jinja2.FileSystemLoader(Path(__file__).parent / "templates"),
        autoescape=jinja2.select_autoescape(["html"]),
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
    )
    totals, every = (sorted(result[key], key=_rank) for key in ("totals", "rows"))
    methods = list(dict.fromkeys(row["method"] for row in result["rows"]))
    # pairs with true flow, an oracle, are never pooled with others
    flow = totals[0]["flow_source"] if totals else "no"
    known = pairs.dropna(subset=["epe_l2_px"])
    pooled = known[known["flow_source"] == flow]
    sections = {
        f"How the errors are distributed, {flow} flow": error_distribution(
            pooled, methods
        ),
        f"What makes it fail, {flow} flow": factor_charts(pooled, methods),
    }
    shared = result["rows"], known, methods
    paths = {
        some["name"]: path_charts(folder, some, *shared)
        for some in result["sequences"]
    }
    protocol = result["protocol"]
    named = ("name", "inputs", "source", "note")
    content = {
        "result": result,
        "pairs": len(pairs.drop_duplicates(["sequence", "index"])),
        "methods": methods,
        "totals": (totals, COLUMNS, ("method", "flow_source")),
        "sections": [
            (name, _json(some)) for name, some in sections.items() if some
        ],
        "sequences": [(name, _json(some)) for name, some in paths.items()],
        "published": protocol
        and (protocol["published"], protocol["columns"], named),
        "numbers": (every, COLUMNS, ("sequence", "method", "flow_source")),
        "origin": origin_of(result),
        "number": number,
    }
    for name in ("report.html", "report.md"):
        text = environment.get_template(name).render(content, plotly=get_plotlyjs())
        with atomic_write(folder / name) as file:
            file.write(text)
    short = pd.DataFrame(summary_rows(totals))
    sides = "".join("l" if name in ("method", "flow") else "r" for name in short)
    with atomic_write(folder / "report.tex") as file:
        file.write(short.to_latex(index=False, escape=True, column_format=sides))


def summary_rows(totals: list[dict[str, Any]]) -> list[dict[str, str]]:
    """Return the short table: for each method a text under every label, the best one first."""
    labels = {key: (label, factor) for key, label, factor in COLUMNS}
    rows = []
    for total in sorted(totals, key=_rank):
        row = {"method": total["method"], "flow": total["flow_source"]}
        for key in SUMMARY:
            label, factor = labels[key]
            value = total.get(key)
            row[label] = number(None if value is None else factor * value)
        rows.append(row)
    return rows


def origin_of(result: Mapping[str, Any]) -> list[tuple[str, str]]:
    """Return where results come from, in words: names with a text each."""
    listed = {
        name: ", ".join(f"{key} {value}" for key, value in result[name].items())
        for name in ("versions", "machine")
    }
    weights = {name: text[:12] for name, text in result["weights"].items() if text}
    defaults = option_defaults()
    changed = [
        f"{group}.{name}={value}"
        for group, values in result["options"].items()
        for name, value in values.items()
        if value != defaults.get(f"{group}.{name}")
    ]
    return [
        ("command", shlex.join(result["command"])),
        *listed.items(),
        (
            "weights",
            ", ".join(f"{name} {text}" for name, text in weights.items()) or "none",
        ),
        ("options", ", ".join(changed) or "the defaults"),
    ]


def _rank(row: Mapping[str, Any]) -> tuple[float, ...]:
    """Sort key of a line: estimated flow before true flow, then the fewest wrong motions first."""
    errors = row["wrong_share"], row["epe_l2_px_median"]
    ranks = (math.inf if error is None else error for error in errors)
    return "(true)" in row["flow_source"], *ranks


def number(value: float | None) -> str:
    """Write a number with three significant digits, without exponent if large; a dash for None."""
    if value is None or not math.isfinite(value):
        return "-"
    return f"{value:.0f}" if value == 0 or abs(value) >= 1000 else f"{value:.3g}"


def _json(figures: list[Figure]) -> list[str]:
    """JSON of charts that may stand inside of a script element."""
    return [figure.to_json().replace("<", "\\u003c") for figure in figures]


# -- charts ----------------------------------------------------------------------------------------


def _chart(
    kind: Any, rows: pd.DataFrame, methods: list[str], **more: Any
) -> Figure:
    """A chart with a colour for each method, black for the truth, and a line where wrong begins."""
    palette = px.colors.qualitative.Dark24
    colours = {
        method: palette[k % len(palette)] for k, method in enumerate(methods)
    }
    errors = {
        axis: more[axis] for axis in "xy" if more.get(axis, "").startswith("epe")
    }
    figure = kind(
        rows.assign(
            **{name: rows[name].clip(lower=FLOOR_PX) for name in errors.values()}
        ),
        color="method",
        color_discrete_map=colours | {TRUTH: "#000"},
        category_orders={"method": [TRUTH, *methods]},
        labels=LABELS,
        template="plotly_white",
        height=420,
        **{f"log_{axis}": True for axis in errors},
        **more,
    )
    limit = (
        rows["wrong_limit_px"].median() if "wrong_limit_px" in rows else math.nan
    )
    for axis in errors:
        line = figure.add_vline if axis == "x" else figure.add_hline
        line(WRONG_PX if math.isnan(limit) else limit, line_dash="dot")
    return figure


def error_distribution(known: pd.DataFrame, methods: list[str]) -> list[Figure]:
    """Draw the share of the pairs whose error is below a value."""
    if known.empty:
        return []
    figure = _chart(px.ecdf, known, methods, x="epe_l2_px", ecdfnorm="percent")
    return [figure.update_yaxes(title="pairs below it [%]")]


def factor_charts(known: pd.DataFrame, methods: list[str]) -> list[Figure]:
    """Draw the median error over the bins of each factor that has more than one bin."""
    figures = []
    for name, (label, edges) in FACTORS.items():
        bins = pd.cut(known[name], edges, include_lowest=True)
        groups = known.groupby(["method", bins], observed=True)["epe_l2_px"]
        medians = (
            groups.median()
            .rename("epe_l2_px_median")
            .reset_index()
            .sort_values(name)
        )
        if medians[name].nunique() > 1:
            medians = medians.assign(**{label: medians[name].astype(str)})
            axes = {"x": label, "y": "epe_l2_px_median", "markers": True}
            figures.append(_chart(px.line, medians, methods, **axes))
    return figures


def path_charts(
    folder: Path,
    facts: Mapping[str, Any],
    rows: list[dict[str, Any]],
    known: pd.DataFrame,
    methods: list[str],
) -> list[Figure]:
    """Draw the paths from above, in the first true camera, and the error of every pair."""
    name = facts["name"]
    truth = facts["ground_truth"]
    files = {
        row["method"]: row["trajectory"] for row in rows if row["sequence"] == name
    }
    paths = {
        method: read_trajectory(folder / file) for method, file in files.items()
    }
    if truth:
        gt = read_trajectory(folder / truth)
        paths = {TRUTH: gt} | {
            method: aligned(path, gt).trajectory for method, path in paths.items()
        }
    if not paths:
        return []
    tables = []
    for method, path in paths.items():
        first = gt if truth else path
        step = len(path) // 1500 + 1
        x, _, z = path.transformed(invert(first.T_world_cam[0])).positions[::step].T
        tables.append(pd.DataFrame({"method": method, "right": x, "forward": z}))
    axes = {"x": "right", "y": "forward", "title": "From above"}
    charts = [
        _chart(px.line, pd.concat(tables), methods, **axes).update_yaxes(
            scaleanchor="x"
        )
    ]
    if len(mine := known[known["sequence"] == name]):
        axes = {"x": "index", "y": "epe_l2_px", "title": "Error of every pair"}
        charts.append(_chart(px.line, mine, methods, **axes))
    return charts
