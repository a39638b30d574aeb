"""What the records of :mod:`hybridvo.comparison.hybrid_sequences` say: errors, doubt, goals."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any

import numpy as np

from hybridvo.comparison.hybrid_sequences import FLOWS, ORACLE
from hybridvo.evaluation.calibration import (
    flag_cost,
    nees_summary,
    proportion,
    recalibrate,
    recalibrated,
    reliability,
)
from hybridvo.hypotheses.confidence import LEAST_NOISE_PX, MAX_SHARE
from hybridvo.pipeline import JUDGED

__all__ = ["THRESHOLDS", "goals", "summarise"]

THRESHOLDS = (0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.85, 0.9, 0.95)
"""Probabilities below which an answer could be degraded."""
RATIOS = {"pnp-ransac-tuned": 0.1, "poselib": 1 / 3}
"""Method -> goal for the hybrid's ATE over its own."""
NEES_RANGE = (3.0, 12.0)
"""A factor of two about the expectation of 6."""

Record = Mapping[str, Any]


def summarise(
    records: Sequence[Record],
    paths: Sequence[Record],
    coefficients: Mapping[str, float] | None = None,
) -> dict[str, Any]:
    """Everything but the conditions.

    Args:
        records: one per answer, of sequences (flow ``true``, ``true+noise``, ``dis``) and of cells
            (flow ``cell``).
        paths: one per sequence, flow and method.
        coefficients: of the map that the status applies to the judge's probability, see
            :func:`hybridvo.evaluation.calibration.recalibrate`; None for none.

    Returns:
        ``sequences`` (``paths`` as they are), ``ate``, ``failures``, ``nees``, ``flags``,
        ``reliability``, ``thresholds``, ``recalibration`` and ``goals``.
    """
    groups = _groups(records)
    own = {name: [r["probability"] for r in group] for name, group in groups.items()}
    stated = own
    if coefficients is not None:
        stated = {
            name: recalibrated(own[name], _evidence(group), coefficients).tolist()
            for name, group in groups.items()
        }
    result = {
        "sequences": [dict(row) for row in paths],
        "ate": _ate(paths),
        "failures": _by(records, _failures, kinds=True),
        "nees": _by(records, _nees, cells=True),
        "flags": _by(records, flag_cost, cells=True),
        "reliability": {
            name: {
                "stated": reliability(stated[name], _good(group)),
                "judge": reliability(own[name], _good(group)),
                "judge_right": reliability(own[name], [r["right"] for r in group]),
            }
            for name, group in groups.items()
        },
        "thresholds": {
            name: {
                "stated": _flagged(stated[name], _good(group)),
                "judge": _flagged(own[name], _good(group)),
            }
            for name, group in groups.items()
        },
        "recalibration": _recalibration(groups),
    }
    return result | {"goals": goals(result)}


def _unique(values: Iterable[Any]) -> list[Any]:
    return list(dict.fromkeys(values))


def _by(
    records: Sequence[Record],
    summary: Callable[[list[Record]], Any],
    *,
    kinds: bool = False,
    cells: bool = False,
) -> dict[str, dict[str, dict[str, Any]]]:
    """Summary of [flow][kind or total][method]; of the cells, where wanted, as one more flow."""
    table: dict[str, dict[str, dict[str, Any]]] = {}
    for flow in (*FLOWS, *(("cell",) if cells else ())):
        mine = [r for r in records if r["flow"] == flow]
        if not mine:
            continue
        names = _unique(r["kind"] for r in mine) if kinds or flow == "cell" else []
        table[flow] = {
            kind: {
                method: summary([r for r in here if r["method"] == method])
                for method in _unique(r["method"] for r in here)
            }
            for kind in ("total", *names)
            for here in [[r for r in mine if kind in ("total", r["kind"])]]
        }
    return table


def _failures(records: list[Record]) -> dict[str, Any]:
    epe = np.array([r["epe_px"] for r in records])
    quartiles = np.quantile(epe, [0.25, 0.5, 0.75])
    moving = [r["moving_share"] for r in records if r.get("moving_share") is not None]
    return {
        "failures": proportion(sum(r["failure"] for r in records), len(records)),
        "epe_px": dict(zip(("q25", "median", "q75"), map(float, quartiles), strict=True)),
        "ms": float(np.median([r["ms"] for r in records])),
        "moving_share": float(np.mean(moving)) if moving else None,
    }


def _nees(records: list[Record]) -> dict[str, Any]:
    """Of all answers, and of those that are no failures: one wrong motion is worth a million."""
    good = [r for r in records if not r["failure"]]
    return {
        "all": nees_summary([r["nees"] for r in records]),
        "without_failures": nees_summary([r["nees"] for r in good]),
    }


def _ate(paths: Sequence[Record]) -> dict[str, dict[str, Any]]:
    """[flow][method]: means over sequences, and for the hybrid its ratios to others."""
    table: dict[str, dict[str, Any]] = {}
    for flow in _unique(row["flow"] for row in paths):
        mine = [row for row in paths if row["flow"] == flow and row["ate_m"] is not None]
        table[flow] = {}
        for method in _unique(row["method"] for row in mine):
            rows = [row for row in mine if row["method"] == method]
            table[flow][method] = {
                "sequences": len(rows),
                "mean_m": float(np.mean([row["ate_m"] for row in rows])),
                "median_m": float(np.median([row["ate_m"] for row in rows])),
                "max_m": max(row["ate_m"] for row in rows),
                "mean_share": float(np.mean([row["ate_share"] for row in rows])),
            }
        for name in JUDGED:
            if name not in table[flow]:
                continue
            own = table[flow][name]
            own["over"] = {
                other: own["mean_m"] / table[flow][other]["mean_m"]
                for other in RATIOS
                if other in table[flow]
            }
            own["worst_over"] = {other: _worst(mine, name, other) for other in own["over"]}
    return table


def _worst(rows: Sequence[Record], name: str, other: str) -> float:
    """Largest ratio of two methods' errors on one sequence."""
    error = {(r["kind"], r["seed"], r["method"]): r["ate_m"] for r in rows}
    ratios = [
        value / error[kind, seed, other]
        for (kind, seed, method), value in error.items()
        if method == name and (kind, seed, other) in error
    ]
    return max(ratios)


def _groups(records: Sequence[Record]) -> dict[str, list[Record]]:
    """Judged answers of ``hybrid-flow``: every flow, the cells, and the sequences together."""
    judged = [r for r in records if r["method"] == "hybrid-flow" and r["probability"] is not None]
    groups = {flow: [r for r in judged if r["flow"] == flow] for flow in (*FLOWS, "cell")}
    groups["sequences"] = [r for r in judged if r["flow"] in FLOWS]
    return {name: group for name, group in groups.items() if group}


def _good(group: Sequence[Record]) -> list[bool]:
    return [not r["failure"] for r in group]


def _flagged(stated: Iterable[float], good: Iterable[bool]) -> list[dict[str, Any]]:
    pairs = list(zip(stated, good, strict=True))
    wrong, right = ([p for p, g in pairs if g is kind] for kind in (False, True))
    return [
        {
            "threshold": t,
            "failures_flagged": proportion(sum(p < t for p in wrong), len(wrong)),
            "right_degraded": proportion(sum(p < t for p in right), len(right)),
        }
        for t in THRESHOLDS
    ]


def _evidence(group: Sequence[Record]) -> dict[str, np.ndarray]:
    """What the judge's probability leaves out."""
    noise = np.array([r["noise_px"] for r in group])
    return {
        "log_noise_px": np.log(np.maximum(noise, LEAST_NOISE_PX)),
        "share": np.minimum([r["share"] for r in group], MAX_SHARE),
    }


def _recalibration(groups: Mapping[str, list[Record]]) -> dict[str, Any]:
    """The map fitted anew: ``fit``, on these very answers, for development alone.

    ``leave_one_kind_out``: thresholds and reliability of fits that did not see the answer's kind.
    """
    records = list({id(r): r for rows in groups.values() for r in rows}.values())
    if not records:
        return {}
    own = np.array([r["probability"] for r in records])
    good, evidence = np.array(_good(records)), _evidence(records)
    kinds = np.array([r["kind"] for r in records])
    left_out = np.empty(len(records))
    for kind in np.unique(kinds):
        seen, mine = kinds != kind, kinds == kind
        fit = recalibrate(own[seen], good[seen], {k: v[seen] for k, v in evidence.items()})
        held_out = {k: v[mine] for k, v in evidence.items()}
        left_out[mine] = recalibrated(own[mine], held_out, fit["coefficients"])
    value = {id(r): float(p) for r, p in zip(records, left_out, strict=True)}
    table = {}
    for name, rows in groups.items():
        new = [value[id(r)] for r in rows]
        table[name] = {
            "thresholds": _flagged(new, _good(rows)),
            "reliability": reliability(new, _good(rows)),
        }
    return {"fit": recalibrate(own, good, evidence), "leave_one_kind_out": table}


def goals(result: Mapping[str, Any]) -> list[dict[str, Any]]:
    """The goals of these measurements: what was wanted, what came out, whether it is met.

    Args:
        result: of :func:`summarise`, goals aside.
    """
    rows: list[dict[str, Any]] = []

    def add(what: str, goal: float, value: float | None, *, low: float | None = None) -> None:
        met = None
        if value is not None:
            met = low <= value <= goal if low is not None else value <= goal
        rows.append({"what": what, "goal": goal, "low": low, "value": value, "met": met})

    for flow, methods in result["ate"].items():
        for name in JUDGED:
            for other, ratio in methods.get(name, {}).get("over", {}).items():
                add(f"{flow} flow: ATE of {name} over {other}", RATIOS[other], ratio)
    failures = result["failures"]
    if "true" in failures and "hybrid-flow" in failures["true"]["total"]:
        share = failures["true"]["total"]["hybrid-flow"]["failures"]["share"]
        add("true flow: share of failures of hybrid-flow", 0.02, share)
    dis = failures.get("dis", {}).get("total", {})
    for name in JUDGED:
        if name in dis and ORACLE in dis:
            mask = dis[ORACLE]["failures"]["count"]
            own = dis[name]["failures"]["count"]
            # no failure of the oracle allows none
            ratio = own / mask if mask else (0.0 if own == 0 else None)
            add(f"dis flow: failures of {name} over a fit in the true mask", 1.3, ratio)
    for flow in ("true+noise", "cell", "dis"):
        row = result["nees"].get(flow, {}).get("total", {}).get("hybrid-flow")
        if row:
            mean = row["without_failures"]["mean"]
            low, high = NEES_RANGE
            add(f"{flow}: mean NEES of hybrid-flow, failures aside", high, mean, low=low)
    row = result["nees"].get("dis", {}).get("total", {}).get("hybrid")
    if row:
        low, high = NEES_RANGE
        mean = row["without_failures"]["mean"]
        add("dis: mean NEES of hybrid, failures aside", high, mean, low=low)
    for name in JUDGED:
        caught = [
            table["total"][name]["caught"]
            for flow, table in result["flags"].items()
            if name in table["total"]
        ]
        total = sum(row["of"] for row in caught)
        share = sum(row["count"] for row in caught) / total if total else None
        add(f"failures of {name} that are neither flagged nor inside 3 sigma", 0.2,
            None if share is None else 1 - share)  # fmt: skip
    return rows
