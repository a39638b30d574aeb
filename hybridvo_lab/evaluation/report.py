"""The report of a comparison: ``report.html`` (one file, interactive), ``.md`` and ``.tex``."""

from __future__ import annotations

import logging
import math
import shlex
from collections.abc import Mapping
from importlib.util import find_spec
from pathlib import Path
from typing import Any, NamedTuple

import pandas as pd

from hybridvo.core.files import atomic_write
from hybridvo.core.options import option_defaults
from hybridvo_lab.evaluation.belief import belief_rows
from hybridvo_lab.evaluation.protocols import beside_published

_logger = logging.getLogger(__name__)


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
BELIEF_COLUMNS: tuple[Column, ...] = (
    Column("pairs", "pairs", 1.0),
    Column("ok", "called ok", 1.0),
    Column("wrong_ok", "wrong, called ok", 1.0),
    Column("wrong_ok_share", "of those called ok [%]", 100.0),
    Column("wrong_told", "wrong ones not called ok [%]", 100.0),
    Column("nees_median", "NEES, median (5.35)", 1.0),
    Column("beyond_share", "beyond 3 sigma [%] (0.27)", 100.0),
)
"""The columns of the table of what methods state of themselves."""
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
"""The columns of the short table, on the screen and, without a protocol, for LaTeX."""
TEXT_COLUMNS = ("method", "flow", "inputs", "source")
"""Columns of the short table, and of that of a protocol, that hold texts."""


NEEDED = {"report.md": ("jinja2",), "report.html": ("jinja2", "plotly")}
"""The files of the report that need libraries of the extra ``report``."""
LEFT_OUT = "%s is not written: %s is not installed: pip install 'hybridvo[report]'"


class Table(NamedTuple):
    """A table of the report."""

    rows: list[dict[str, Any]]
    columns: Any  # Column, or the protocol's lists of the same three
    names: tuple[str, ...]  # keys of the texts that each row begins with


def write_report(
    folder: Path, result: Mapping[str, Any], pairs: pd.DataFrame
) -> list[str]:
    """Write the report of a comparison: HTML, Markdown and LaTeX.

    What needs a library that is not installed is left out, with a warning.

    Args:
        folder: The output folder, which holds the runs.
        result: The content of ``results.json``.
        pairs: The content of ``pairs.csv``.

    Returns:
        The names of the files that were left out.
    """
    totals = sorted(result["totals"], key=_rank)
    _write_latex(folder / "report.tex", totals, result["protocol"])
    left_out = []
    for name, libraries in NEEDED.items():
        absent = [library for library in libraries if find_spec(library) is None]
        if absent:
            left_out.append(name)
            _logger.warning(LEFT_OUT, name, absent[0])
            continue
        content = _content(result, totals, pairs)
        if name == "report.html":
            content |= _html_content(folder, result, totals, pairs)
        text = _environment().get_template(name).render(content)
        with atomic_write(folder / name) as file:
            file.write(text)
    return left_out


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
    result: Mapping[str, Any], totals: list[dict[str, Any]], pairs: pd.DataFrame
) -> dict[str, Any]:
    """Return what both templates of the report use."""
    protocol = result["protocol"]
    compared = None
    by_sequence = None
    if protocol:
        lines = [{"note": "", **line} for line in beside_published(protocol)]
        names = ("method", "inputs", "source", "note")
        compared = Table(lines, protocol["columns"], names)
        if protocol["rows"]:
            by_sequence = _by_sequence(protocol)
    rows = sorted(result["rows"], key=_rank)
    return {
        "result": result,
        "pairs": len(pairs.drop_duplicates(["sequence", "index"])),
        "methods": _methods(result),
        "totals": Table(totals, COLUMNS, ("method", "flow_source")),
        "compared": compared,
        "by_sequence": by_sequence,
        "belief": Table(belief_rows(pairs), BELIEF_COLUMNS, ("method",)),
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


def _html_content(
    folder: Path,
    result: Mapping[str, Any],
    totals: list[dict[str, Any]],
    pairs: pd.DataFrame,
) -> dict[str, Any]:
    """Return the charts, and what draws them in a browser."""
    from plotly.offline import get_plotlyjs

    from hybridvo_lab.evaluation.charts import (
        belief_charts,
        sequence_charts,
        summary_charts,
    )

    methods = _methods(result)
    scored = pairs.dropna(subset=["epe_l2_px"])
    return {
        "plotly": get_plotlyjs(),
        "belief_charts": belief_charts(totals, scored, methods),
        "sections": summary_charts(totals, scored, methods),
        "sequences": sequence_charts(folder, result, scored, methods),
    }


def _methods(result: Mapping[str, Any]) -> list[str]:
    """Return the methods of a comparison, in the order of its lines."""
    return list(dict.fromkeys(row["method"] for row in result["rows"]))


def _write_latex(
    path: Path,
    totals: list[dict[str, Any]],
    protocol: Mapping[str, Any] | None,
) -> None:
    """Write the table for LaTeX: that of a protocol with published lines, or the short one."""
    rows = protocol_rows(protocol) if protocol else summary_rows(totals)
    table = pd.DataFrame(rows)
    alignment = "".join("l" if name in TEXT_COLUMNS else "r" for name in table)
    text = table.to_latex(index=False, escape=True, column_format=alignment)
    with atomic_write(path) as file:
        if protocol:
            # a comment, so that a figure of other pairs is not taken for the published ones'
            note = " ".join(protocol["note"].split())
            file.write(f"% protocol {protocol['name']}: {note}\n")
        file.write(text)


def protocol_rows(protocol: Mapping[str, Any]) -> list[dict[str, str]]:
    """Return the table of a protocol: our methods, then the published lines.

    Args:
        protocol: What ``results.json`` states of it.

    Returns:
        For each line a text under ``method``, ``inputs``, ``source`` and every label.
    """
    rows = []
    for line in beside_published(protocol):
        row = {name: line[name] for name in ("method", "inputs", "source")}
        for key, label, factor in protocol["columns"]:
            value = line.get(key)
            row[label] = number(None if value is None else factor * value)
        rows.append(row)
    return rows


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
