"""The report of a comparison: ``report.html`` (one file, interactive) and ``report.md``.

Estimated flow stands before true flow (an oracle) everywhere.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import pandas as pd

from hybridvo.evaluation import charts
from hybridvo.files import atomic_write

COLUMNS: tuple[tuple[str, str, float], ...] = (
    ("epe_l2_px_median", "EPE, median [px]", 1.0),
    ("epe_l2_px", "EPE, mean [px]", 1.0),
    ("failures", "failures (> 1 px)", 1.0),
    ("failure_rate", "failures [%]", 100.0),
    ("rot_err_deg_median", "rotation [deg]", 1.0),
    ("trans_err_median", "translation [cm]", 100.0),
    ("ate_rmse", "ATE [cm]", 100.0),
    ("rpe_trans_rmse", "RPE [cm]", 100.0),
    ("rpe_rot_rmse_deg", "RPE [deg]", 1.0),
    ("ms_per_pair_median", "time [ms]", 1.0),
    ("flow_ms_median", "+ flow [ms]", 1.0),
    ("pairs", "pairs", 1.0),
    ("failed", "given up", 1.0),
    ("rot_err_deg_mean", "rotation, mean [deg]", 1.0),
    ("trans_err_mean", "translation, mean [cm]", 100.0),
    ("epe", "paper's EPE [px]", 1.0),
    ("r_err_deg", "paper's R_err [deg]", 1.0),
    ("t_err", "paper's T_err [cm]", 100.0),
    ("dynamic_fraction", "moving [%]", 100.0),
)


def write_report(folder: Path, result: Mapping[str, Any], pairs: pd.DataFrame) -> None:
    """Write both reports; ``result`` is what ``results.json`` holds, ``pairs`` all pairs."""
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
    flow = totals[0]["flow_source"]  # an oracle is never pooled with what a sensor gives
    pooled = pairs[pairs["flow_source"] == flow]
    sections = {
        f"How the errors are distributed, {flow} flow": charts.error_distribution(pooled, methods),
        f"What makes it fail, {flow} flow": charts.factor_charts(pooled, methods),
    }
    paths = {
        facts["name"]: charts.path_charts(folder, facts, result["rows"], pairs, methods)
        for facts in result["sequences"]
    }
    content = {
        "result": result,
        "pairs": len(pairs.drop_duplicates(["sequence", "index"])),
        "methods": methods,
        "totals": (totals, COLUMNS, ("method", "flow_source")),
        "sections": [(name, _json(some)) for name, some in sections.items() if some],
        "sequences": [(name, _json(some)) for name, some in paths.items()],
        "protocol": _protocol_tables(result.get("protocol"), totals),
        "numbers": (every, COLUMNS, ("sequence", "method", "flow_source")),
        "number": number,
    }
    for name in ("report.html", "report.md"):
        text = environment.get_template(name).render(content, plotly=get_plotlyjs())
        with atomic_write(folder / name) as file:
            file.write(text)


def _rank(row: Mapping[str, Any]) -> tuple[float, ...]:
    """Estimated flow before true flow, then the fewest failures first."""
    errors = row["failure_rate"], row["epe_l2_px_median"]
    is_oracle = "(true)" in row["flow_source"]
    return is_oracle, *(math.inf if error is None else error for error in errors)


def number(value: float | None, digits: int = 3) -> str:
    """Significant digits without an exponent where it is readable; a dash for None.

    Example:
        >>> number(1234.5), number(0.012345), number(0.0), number(None)
        ('1234', '0.0123', '0', '-')
    """
    if value is None or not math.isfinite(value):
        return "-"
    if value == 0 or abs(value) >= 10**digits:
        return f"{value:.0f}"
    return f"{value:.{digits}g}"


def _protocol_tables(protocol: Mapping[str, Any] | None, totals: Any) -> list[tuple[str, Any]]:
    """Measured here, and what others published: rows, columns, names."""
    if protocol is None:
        return []
    columns = [(m["key"], f"{m['label']} [{m['unit']}]", 1.0) for m in protocol["metrics"]]
    here = [*columns, ("pairs", "pairs", 1.0)]
    others = ("name", "inputs", "source", "note")
    return [
        ("Measured here", (totals, here, ("method", "flow_source"))),
        ("Published by others", (protocol["published"], columns, others)),
    ]


def _json(figures: Sequence[Any]) -> list[str]:
    """JSON that may stand inside of a script element."""
    return [figure.to_json().replace("<", "\\u003c") for figure in figures]
