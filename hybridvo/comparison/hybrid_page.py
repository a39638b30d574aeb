"""The page of the hybrid's sequences: every number is from the JSON of ``evaluate_hybrid.py``."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

from hybridvo.errors import FormatError

__all__ = ["START", "STOP", "fill", "section"]

START, STOP = "<!-- from {name}.json -->", "<!-- end -->"
NOT_MEASURED = "-"
SHOWN = (0.5, 0.7, 0.8, 0.85, 0.9)
"""Thresholds of the page, among those of the JSON."""
EVENTS = {
    "stated": "of the status, no failure",
    "judge": "the judge's own, no failure",
    "judge_right": "the judge's own, error <= 1 px at width 1024",
}


def fill(page: str, name: str, result: Mapping[str, Any]) -> str:
    """The page with the part between its markers made anew.

    Args:
        page: text with one pair of markers for ``name``.
        name: of the JSON file, without its ending.
        result: its content.

    Raises:
        FormatError: the markers are not there, or the JSON is not as the tool writes it.
    """
    start = START.format(name=name)
    before, found, rest = page.partition(start)
    _, ended, after = rest.partition(STOP)
    if not (found and ended):
        raise FormatError(f"page: expected the markers '{start}' and '{STOP}'.")
    try:
        made = section(result, name)
    except (KeyError, TypeError, IndexError) as error:
        raise FormatError(
            f"{name}.json: not as evaluate_hybrid.py writes it: {error!r}."
        ) from error
    return f"{before}{start}\n{made}\n{STOP}{after}"


def number(value: float | None, digits: int = 3) -> str:
    """Significant digits; a dash where nothing was measured."""
    if value is None:
        return NOT_MEASURED
    return f"{value:.{digits}g}" if value else "0"


def percent(row: Mapping[str, Any] | None) -> str:
    """A proportion as share, count and total."""
    if not row or row["share"] is None:
        return NOT_MEASURED
    return f"{100 * row['share']:.1f} % ({row['count']}/{row['of']})"


def table(head: Sequence[str], rows: Iterable[Sequence[str]]) -> list[str]:
    """Lines of a table, the first column to the left, an empty line after it."""
    lines = ["| " + " | ".join(head) + " |", "|---|" + "---:|" * (len(head) - 1)]
    return [*lines, *("| " + " | ".join(row) + " |" for row in rows), ""]


def section(result: Mapping[str, Any], name: str) -> str:
    """Everything between the markers."""
    conditions = result["conditions"]
    height, width = conditions["size"]
    seeds = conditions["seeds"]
    lines = [
        f"{len(conditions['kinds'])} families x {len(seeds)} seed(s) from {seeds[0]} on, "
        f"{conditions['frames']} frames of {width}x{height} px each, depth and camera true; "
        f"{conditions['cell_pairs']} pairs a cell from seed {seeds[0]} on. "
        f"`{result['command']}`, commit `{result['commit']}`, "
        f"{result['cpu_s'] / 60:.1f} minutes of processor time.",
        "",
        "### Goals",
        "",
        *_goals(result["goals"]),
        "### Trajectories",
        "",
        "Root mean square error of the position after rigid alignment, mean over the sequences "
        "(share of the path in brackets).",
        "",
        *_trajectories(result),
        "### Failures of single pairs",
        "",
        *_failures(result["failures"], conditions["failure_px"]),
        "### Is the covariance right?",
        "",
        "Normalised error squared of six parameters, failures aside: a right covariance has mean "
        "6, median 5.35 and 99.7 % inside 3 sigma.",
        "",
        *_nees(result["nees"]),
        "### What a status other than ok catches, and what it costs",
        "",
        *_flags(result["flags"]),
        "### Is the stated probability right?",
        "",
        f"![Stated probability against observed frequency]({conditions['picture']})",
        "",
        *_reliability(result["reliability"]),
        "### What another threshold would flag",
        "",
        "Share of the failures / of the right answers below it: of the probability that the status "
        "states, of the judge's own, and of a map fitted to the other kinds of scenes.",
        "",
        *_thresholds(result),
    ]
    return "\n".join(lines).rstrip()


def _goals(goals: Iterable[Mapping[str, Any]]) -> list[str]:
    rows = []
    for goal in goals:
        wanted = f"<= {number(goal['goal'])}"
        if goal["low"] is not None:
            wanted = f"{number(goal['low'])} to {number(goal['goal'])}"
        met = {True: "yes", False: "no", None: "not measured"}[goal["met"]]
        rows.append((goal["what"], wanted, number(goal["value"]), met))
    return table(("what", "goal", "measured", "met"), rows)


def _trajectories(result: Mapping[str, Any]) -> list[str]:
    ate = result["ate"]
    methods = list(dict.fromkeys(m for flow in ate.values() for m in flow))
    kinds = list(dict.fromkeys(row["kind"] for row in result["sequences"]))
    lines = []
    for flow, rows in ate.items():
        body = []
        for method in methods:
            if method not in rows:
                continue
            row = rows[method]
            cells = [f"`{method}`", f"{_metres(row['mean_m'])} ({100 * row['mean_share']:.2g} %)"]
            for kind in kinds:
                errors = [
                    r["ate_m"] for r in result["sequences"]
                    if (r["kind"], r["flow"], r["method"]) == (kind, flow, method)
                    and r["ate_m"] is not None
                ]  # fmt: skip
                cells.append(_metres(sum(errors) / len(errors)) if errors else NOT_MEASURED)
            body.append(cells)
        lines += [f"Flow: {flow}", "", *table(("method", "ATE", *kinds), body)]
    return lines


def _metres(value: float) -> str:
    return f"{number(value)} m" if value >= 1 else f"{number(100 * value)} cm"


def _failures(failures: Mapping[str, Any], limit: float) -> list[str]:
    rows = []
    for flow, kinds in failures.items():
        for method, total in kinds["total"].items():
            cells = [flow, f"`{method}`", percent(total["failures"])]
            cells += [
                percent(kinds[kind].get(method, {}).get("failures"))
                for kind in kinds
                if kind != "total"
            ]
            rows.append([*cells, number(total["epe_px"]["median"])])
    kinds = [kind for kind in next(iter(failures.values()), {}) if kind != "total"]
    head = ("flow", "method", f"error above {number(limit)} px", *kinds, "median, px")
    return table(head, rows)


def _nees(nees: Mapping[str, Any]) -> list[str]:
    rows = []
    for flow, kinds in nees.items():
        for kind, methods in kinds.items():
            for method, row in methods.items():
                if kind != "total" and method != "hybrid-flow":
                    continue
                good = row["without_failures"]
                where = flow if kind == "total" else f"{flow}: {kind}"
                rows.append((where, f"`{method}`", str(good["pairs"]), number(good["mean"]),
                             number(good["median"]), percent(good["contained"])))  # fmt: skip
    return table(("flow", "method", "pairs", "mean", "median", "inside 3 sigma"), rows)


def _flags(flags: Mapping[str, Any]) -> list[str]:
    rows = []
    for flow, kinds in flags.items():
        for kind, methods in kinds.items():
            for method, row in methods.items():
                quiet = not (row["failures"]["count"] or row["degraded"]["count"])
                if kind != "total" and (quiet or method != "hybrid-flow"):
                    continue
                where = flow if kind == "total" else f"{flow}: {kind}"
                cells = (row["failures"], row["flagged"], row["caught"], row["degraded"])
                rows.append((where, f"`{method}`", *map(percent, cells)))
    head = ("flow", "method", "failures", "of these flagged", "flagged or inside 3 sigma",
            "right answers degraded")  # fmt: skip
    return table(head, rows)


def _reliability(groups: Mapping[str, Any]) -> list[str]:
    rows = []
    for name, events in groups.items():
        for event, row in events.items():
            what = EVENTS[event]
            rows.append((name, what, str(row["answers"]), *(number(row[key]) for key in (
                "stated", "right", "brier", "brier_base_rate", "ece"))))  # fmt: skip
    head = ("answers of", "probability", "judged", "stated", "observed", "Brier",
            "Brier of the base rate", "ECE")  # fmt: skip
    return table(head, rows)


def _thresholds(result: Mapping[str, Any]) -> list[str]:
    rows = []
    new = result["recalibration"].get("leave_one_kind_out", {})
    for name, found in result["thresholds"].items():
        tables = (*found.items(), ("fitted to the other kinds", new[name]["thresholds"]))
        for kind, lines in tables:
            shown = [row for row in lines if row["threshold"] in SHOWN]
            pairs = [(row["failures_flagged"], row["right_degraded"]) for row in shown]
            rows.append((name, kind, *(f"{brief(a)} / {brief(b)}" for a, b in pairs)))
    return table(("answers of", "probability", *(f"below {t}" for t in SHOWN)), rows)


def brief(row: Mapping[str, Any]) -> str:
    """A proportion in per cent."""
    return NOT_MEASURED if row["share"] is None else f"{100 * row['share']:.0f} %"
