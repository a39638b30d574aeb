"""What moved between two sets of golden figures, see ``tools/golden.py``."""

from __future__ import annotations

import math
from collections import Counter
from typing import Any

EXPECTED_NEES = 5.35
"""Median of chi-square with six degrees of freedom."""
MODEL_NEES = (4.0, 8.0)
"""Median under the noise that the refinement assumes, over 60 pairs."""
NEES_FACTOR = 1.5
"""By how much more the normalised error may miss its expectation."""
MEDIAN_FACTOR, ELSEWHERE_FACTOR, WORST_FACTOR, TIME_FACTOR = 1.05, 1.2, 1.5, 1.25
TOLERANCE = {"px": 1e-5, "m": 1e-6}
"""Differences that say nothing: below the last digits of the inputs."""
STATUS_SHARE = 0.1
"""Share of the pairs of a case, one pair at least, whose status or reason may change."""


def compare(old: dict[str, Any], new: dict[str, Any]) -> list[str]:
    """Findings, a line each: WORSE, WARNING (time) or better.

    Bounds are wider where the processor differs. A case that the old figures do not have is judged
    by itself alone; one that the new ones lack is left out.
    """
    findings = []
    factor = MEDIAN_FACTOR if old["processor"] == new["processor"] else ELSEWHERE_FACTOR
    for name, row in new["cases"].items():
        if "without" in row:
            lines = [(level, f"than without it: {text}") for level, text in beside_none(name, row)]
        else:
            lines = judge_alone(name, row)
            if name in old["cases"]:
                lines += judge_beside(old["cases"][name], row, factor)
        findings += [f"{level} {name}: {text}" for level, text in lines]
    return sorted(findings, key=lambda line: line.split(" ")[0] == "better")


def judge_alone(name: str, row: dict[str, Any]) -> list[tuple[str, str]]:
    """What no earlier figures are needed for."""
    low, high = MODEL_NEES
    if name.startswith("model_noise") and not low <= row["nees"] <= high:
        return [("WORSE", f"normalised error {row['nees']:.3g}, expected {low:g} to {high:g}")]
    return []


def judge_beside(old: dict[str, Any], new: dict[str, Any], factor: float) -> list[tuple[str, str]]:
    """Findings of one case beside its earlier figures."""
    found = []
    spread = old.get("spread", {})
    tolerance = TOLERANCE[new.get("unit", "px")]

    def limit(key: str, times: float, more: float) -> float:
        return times * old[key] + more + spread.get(key, 0)

    allowed = {"failed": 0, "unflagged": 0, "overconfident": max(1, 0.05 * old["pairs"])}
    for key, more in allowed.items():
        if new[key] > limit(key, 1, more):
            found.append(("WORSE", f"{key} {old[key]} -> {new[key]} of {new['pairs']}"))
    bounds = [("median", factor)]
    if not new["failed"]:
        bounds.append(("worst", WORST_FACTOR))  # with failures the worst says nothing
    for key, times in bounds:
        if new[key] > limit(key, times, tolerance):
            found.append(("WORSE", f"{key} error {old[key]:.4g} -> {new[key]:.4g}"))
    if old["median"] > limit("median", 0, 0) + factor * new["median"] + tolerance:
        found.append(("better", f"median error {old['median']:.4g} -> {new['median']:.4g}"))
    changed = (Counter(old["status"]) - Counter(new["status"])).total()
    if changed > max(1, STATUS_SHARE * old["pairs"]) + spread.get("status", 0):
        found.append(("WORSE", f"status {old['status']} -> {new['status']}"))
    # the covariance of a degraded motion covers its doubt: more of them lower the median
    doubted = degraded(new) > degraded(old) and (new["nees"] or 0) < EXPECTED_NEES
    if not doubted and miss(new["nees"]) > miss(old["nees"]) + math.log(NEES_FACTOR):
        found.append(("WORSE", f"normalised error {old['nees']:.3g} -> {new['nees']:.3g}"))
    if old.get("ms") and new.get("ms", 0) > TIME_FACTOR * old["ms"]:
        found.append(("WARNING", f"{old['ms']:.3g} -> {new['ms']:.3g} ms of processor time"))
    return found


def beside_none(name: str, row: dict[str, Any]) -> list[tuple[str, str]]:
    """A prior beside none on the same pairs: a true one never makes an answer worse."""
    without = row["without"]
    lenient = 0 if name.startswith("prior_true") else 1
    found = []
    for key in ("failed", "unflagged"):
        if row[key] > without[key] + lenient:
            found.append(("WORSE", f"{key} {without[key]} -> {row[key]} of {row['pairs']}"))
    if row["median"] > MEDIAN_FACTOR * without["median"] + TOLERANCE["px"]:
        found.append(("WORSE", f"median error {without['median']:.4g} -> {row['median']:.4g}"))
    return found


def degraded(row: dict[str, Any]) -> int:
    return sum(n for status, n in row["status"].items() if status.startswith("degraded"))


def miss(nees: float | None) -> float:
    """How far, in logarithms, a median normalised error is from what is expected."""
    return 0.0 if nees is None else abs(math.log(max(nees, 1e-9) / EXPECTED_NEES))
