"""Tables of a report: cells with the text that people read and the value that sorting needs."""

from __future__ import annotations

import math
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from hybridvo.evaluation.report import MISSING
from hybridvo.evaluation.report_data import Comparison, Series, one_line

__all__ = [
    "Cell",
    "Column",
    "Table",
    "headline_table",
    "number",
    "plain_markdown",
    "protocol_table",
    "published_table",
    "sequence_table",
]


_MARKDOWN = str.maketrans({c: f"\\{c}" for c in "\\`*|<&$"})


def plain_markdown(text: str) -> str:
    r"""Text that Markdown shows as it stands: no tag, image, link, cell or code out of a name.

    Example:
        >>> print(plain_markdown("![a](b) <img> [px]"))
        ![a\](b) \<img> [px]
    """
    escaped = one_line(text).translate(_MARKDOWN)
    # a bracket does something only before one of these; units in brackets stay readable
    return re.sub(r"\](?=[(\[:])", r"\\]", escaped)


def number(value: float | None, digits: int = 3) -> str:
    """Significant digits without an exponent where it is readable without one; a dash for None.

    Example:
        >>> number(1234.5), number(0.012345), number(0.0), number(None)
        ('1234', '0.0123', '0', '-')
    """
    if value is None or not math.isfinite(value):
        return MISSING
    if value == 0:
        return "0"
    if abs(value) < 1e-4:
        return f"{value:.{digits - 1}g}"
    text = f"{value:.{digits}g}"
    return f"{value:.0f}" if "e" in text else text


@dataclass(frozen=True)
class Column:
    """A column.

    Args:
        key: of the rows. label: heading. factor: to the unit of the heading. text: left-aligned.
        better: -1 where less is better, 1 where more is, 0 where neither.
        count: key of the number of values that went in, shown where it is not that of all pairs.
    """

    key: str
    label: str
    factor: float = 1.0
    text: bool = False
    better: int = 0


@dataclass(frozen=True)
class Cell:
    """What stands in a table: text, an addition in small print, sort value, reason if empty."""

    text: str
    value: str = ""
    reason: str = ""
    best: bool = False
    small: str = ""


@dataclass(frozen=True)
class Table:
    """Columns, and rows with the classes that hide them."""

    columns: tuple[Column, ...]
    rows: tuple[tuple[str, tuple[Cell, ...]], ...]

    def markdown(self) -> str:
        """As a Markdown table."""

        def line(items: Iterable[str]) -> str:
            return "| " + " | ".join(items) + " |"

        rule = "|" + "|".join("---" if column.text else "---:" for column in self.columns) + "|"
        rows = (
            line(
                (f"**{c.text}**" if c.best else plain_markdown(c.text))
                + (f" {c.small}" if c.small else "")
                for c in cells
            )
            for _, cells in self.rows
        )
        return "\n".join([line(plain_markdown(c.label) for c in self.columns), rule, *rows]) + "\n"

    @property
    def reasons(self) -> tuple[str, ...]:
        """Why cells are empty, each reason once."""
        found = (cell.reason for _, cells in self.rows for cell in cells)
        return tuple(dict.fromkeys(reason for reason in found if reason))


def _classes(series: Series | None) -> str:
    return "" if series is None else f"m{series.m} f{series.f}"


def _idle(column: Column, row: Mapping[str, Any]) -> bool:
    """Whether a value is no merit: the time of doing nothing, all of giving up on every pair."""
    gave_up = bool(row.get("pairs")) and row.get("failed") == row.get("pairs")
    return gave_up or (column.key.startswith("ms_") and row.get("method") == "identity")


def _build(
    columns: Sequence[Column],
    rows: Sequence[Mapping[str, Any]],
    series: Sequence[Series | None],
    compared: Sequence[Any],
) -> Table:
    """Cells of rows; ``compared`` names the rows among which the best one is told."""
    best: dict[tuple[str, Any], float] = {}
    counts: dict[Any, int] = {}
    for row, group in zip(rows, compared, strict=True):
        counts[group] = counts.get(group, 0) + 1
        for column in columns:
            value = row.get(column.key)
            if column.better and value is not None and not _idle(column, row):
                known = best.get((column.key, group), math.inf)
                best[column.key, group] = min(known, -column.better * float(value))
    made = []
    for row, one, group in zip(rows, series, compared, strict=True):
        cells = []
        for column in columns:
            value = row.get(column.key)
            if column.text:
                text = MISSING if value in (None, "") else str(value)
                cells.append(Cell(text, "" if value is None else text))
            elif value is None:
                reason = (row.get("reasons") or {}).get(column.key, "")
                cells.append(Cell(MISSING, reason=str(reason)))
            else:
                scaled = float(value) * column.factor
                shown = str(value) if isinstance(value, int) else number(scaled)
                # one alone is not the best of anything
                winner = (
                    column.better != 0
                    and counts[group] > 1
                    and not _idle(column, row)
                    and -column.better * float(value) == best.get((column.key, group))
                )
                small = str(row.get(f"{column.key}_small", ""))
                cells.append(Cell(shown, repr(scaled), "", winner, small))
        made.append((_classes(one), tuple(cells)))
    return Table(tuple(columns), tuple(made))


_HEADLINE = (
    Column("method", "method", text=True),
    Column("flow_source", "flow", text=True),
    Column("epe_l2_px_median", "EPE [px]", better=-1),
    Column("failure_rate", "failures above 1 px [%]", 100.0, better=-1),
    Column("rot_err_deg_median", "rotation [deg]", better=-1),
    Column("trans_err_median", "translation [cm]", 100.0, better=-1),
    Column("ate_rmse", "ATE [cm]", 100.0, better=-1),
    Column("rpe_trans_rmse", "RPE [cm]", 100.0, better=-1),
    Column("rpe_rot_rmse_deg", "RPE [deg]", better=-1),
    Column("ms_median", "time [ms]", better=-1),
    Column("flow_ms_median", "+ flow [ms]"),
    Column("pairs", "pairs"),
    Column("failed", "failed"),
)


def headline_table(comparison: Comparison) -> Table:
    """A line per method and flow over all sequences."""
    rows = []
    for line in comparison.headline:
        row = dict(line)
        if row["failure_rate"] is not None and row["failure_rate_low"] is not None:
            low, high = 100 * row["failure_rate_low"], 100 * row["failure_rate_high"]
            row["failure_rate_small"] = f"[{low:.0f}, {high:.0f}]"
        # a median over other pairs than the row says is marked with their number
        for name in ("epe_l2_px", "rot_err_deg", "trans_err"):
            if 0 < row[f"{name}_pairs"] != row["pairs"]:
                row[f"{name}_median_small"] = f"({row[f'{name}_pairs']})"
        rows.append(row)
    series = [line["series"] for line in comparison.headline]
    return _build(_HEADLINE, rows, series, [one.flow_source for one in series])


_SEQUENCE = (
    Column("sequence", "sequence", text=True),
    Column("method", "method", text=True),
    Column("flow_source", "flow", text=True),
    Column("depth_source", "depth", text=True),
    Column("pairs", "pairs"),
    Column("failed", "failed"),
    Column("epe_l2_px", "EPE, mean [px]", better=-1),
    Column("rot_err_deg_median", "rotation [deg]", better=-1),
    Column("rot_err_deg_mean", "rotation, mean [deg]", better=-1),
    Column("trans_err_median", "translation [cm]", 100.0, better=-1),
    Column("trans_err_mean", "translation, mean [cm]", 100.0, better=-1),
    Column("ate_rmse", "ATE [cm]", 100.0, better=-1),
    Column("rpe_trans_rmse", "RPE [cm]", 100.0, better=-1),
    Column("rpe_rot_rmse_deg", "RPE [deg]", better=-1),
    Column("epe", "paper's EPE [px]", better=-1),
    Column("r_err_deg", "paper's R_err [deg]", better=-1),
    Column("t_err", "paper's T_err [cm]", 100.0, better=-1),
    Column("ms_per_pair_median", "time [ms]", better=-1),
    Column("dynamic_fraction", "moving [%]", 100.0),
)


def sequence_table(comparison: Comparison) -> Table:
    """A line per sequence, method and flow."""
    rows = comparison.result["rows"]
    series = [comparison.series[str(r["method"]), str(r["flow_source"])] for r in rows]
    groups = [(r["sequence"], r["flow_source"]) for r in rows]
    return _build(_SEQUENCE, rows, series, groups)


def protocol_table(comparison: Comparison) -> Table | None:
    """Measured here, and the authors' own figures of the same methods in columns of their own."""
    protocol = comparison.result.get("protocol")
    if not protocol:
        return None
    metrics = [
        Column(m["key"], f"{m['label']} [{m['unit']}]", better=-1) for m in protocol["metrics"]
    ]
    both = any(line.get("published") for line in protocol["table"])
    theirs = [Column(f"published_{m.key}", f"published {m.label}") for m in metrics] if both else []
    columns = [*_HEADLINE[:2], Column("pairs", "pairs"), Column("failed", "failed")]
    rows, series = [], []
    for line in protocol["table"]:
        row = dict(line)
        row["flow_source"] = str(row.get("flow_source") or "none")
        for metric in metrics:
            row[f"published_{metric.key}"] = (line.get("published") or {}).get(metric.key)
        rows.append(row)
        series.append(comparison.series.get((str(row["method"]), row["flow_source"])))
    flows = [row["flow_source"] for row in rows]
    return _build([*columns, *metrics, *theirs], rows, series, flows)


def published_table(comparison: Comparison) -> Table | None:
    """Figures of others, none of them measured here."""
    protocol = comparison.result.get("protocol")
    if not protocol or not protocol.get("published"):
        return None
    known = [m for m in protocol["metrics"] if any(m["key"] in p for p in protocol["published"])]
    columns = [Column("name", "published as", text=True)]
    columns += [Column(m["key"], f"{m['label']} [{m['unit']}]") for m in known]
    columns += [Column(name, name, text=True) for name in ("inputs", "source", "note")]
    lines = protocol["published"]
    return _build(columns, lines, [None] * len(lines), [None] * len(lines))
