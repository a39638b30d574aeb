"""Figures of a golden case, and the comparison of new figures with frozen ones."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Sequence
from typing import Any

import numpy as np
from measuring import digits, score

Record = dict[str, Any]
"""What one answer contributes to the figures of its case."""
Row = dict[str, Any]
"""The figures of a case."""
Finding = tuple[str, str]
"""``WORSE``, ``MOVED`` or ``better``, and a sentence."""

EXPECTED_NEES = 5.35
"""Median of chi-square with six degrees of freedom."""
MODEL_NEES = (4.0, 8.0)
"""Median under the noise that the refinement assumes, over 60 pairs."""
NEES_FACTOR = 1.5
"""By how much more the normalised error may miss its expectation."""
MEDIAN_FACTOR = 1.05
ELSEWHERE_FACTOR = 1.2
"""Factor on a median error on another processor."""
PRIOR_FACTOR = 1.2
"""Factor on a median error with a prior: it is another start, answers differ within their noise."""
WORST_FACTOR = 1.5
TOLERANCE = {"px": 1e-5, "m": 1e-6}
"""Differences of the error that say nothing: below the last digits of the inputs."""
STATUS_SHARE = 0.1
"""Share of the pairs of a case, one pair at least, whose status or terms may change."""
STD_FACTOR = 1.06
"""Factor on the standard deviation that an estimator states, both ways."""
LOG_ODDS = 0.12
"""Difference of the median log odds of being right, both ways."""
INLIERS = 0.02
"""Difference of the median share of pixels that follow a motion, both ways."""
MAX_LOG_ODDS = 8.0
"""Log odds are cut there: probabilities of 0 and 1 are finite then."""


def record(motion: Any, T_true: np.ndarray, depth: np.ndarray, pair: Any) -> Record:
    """Errors of one answer, and what it states about itself.

    Args:
        motion: the answer, a ``RelativePose``.
        T_true: (4, 4) true T_curr_prev.
        depth: (H, W) metres, the best that is known.
        pair: the pair, for its cameras.
    """
    made = score(motion, T_true, depth, pair)
    made["terms"] = "+".join(motion.terms)
    made["inliers"] = float(motion.inlier_ratio)
    if not made["failed"] or not made["status"].startswith("failed"):
        variance = np.trace(motion.covariance[:3, :3])
        made["std"] = 1e3 * math.sqrt(max(float(variance), 0.0))
        made["log_odds"] = log_odds(motion.probability)
    return made


def log_odds(probability: float) -> float:
    """Log odds of a probability, cut at :data:`MAX_LOG_ODDS`."""
    if not math.isfinite(probability):
        return -MAX_LOG_ODDS
    low = 1.0 / (1.0 + math.exp(MAX_LOG_ODDS))
    inside = min(max(probability, low), 1.0 - low)
    return math.log(inside / (1.0 - inside))


def labelled(label: str, **figures: Any) -> Record:
    """Return a record of something that is no motion: a word, in place of the status."""
    none = dict.fromkeys(("failed", "unflagged", "overconfident"), False)
    return {"error": 0.0, "status": label, "nees": None} | none | figures


def summarise(records: Sequence[Record]) -> Row:
    """Return the figures of one case."""
    row: Row = {
        "pairs": len(records),
        "median": digits(np.median([each["error"] for each in records])),
        "worst": digits(max(each["error"] for each in records)),
    }
    for key in ("failed", "unflagged", "overconfident"):
        row[key] = sum(each[key] for each in records)
    row["status"] = counts(each["status"] for each in records)
    row["nees"] = median_of(records, "nees")
    for key in ("std", "log_odds", "inliers"):
        if any(key in each for each in records):
            row[key] = median_of(records, key)
    terms = [each["terms"] for each in records if "terms" in each]
    if terms:
        row["terms"] = counts(terms)
    return row


def counts(words: Any) -> dict[str, int]:
    """Return how often each word comes, in alphabetical order."""
    return dict(sorted(Counter(words).items()))


def median_of(records: Sequence[Record], key: str) -> float | None:
    """Return the median over the records that have a figure; None where none has."""
    known = [each[key] for each in records if each.get(key) is not None]
    return digits(np.median(known)) if known else None


def spread(rows: Sequence[Row]) -> dict[str, float]:
    """Return by how much the figures of the same pairs differ between seeds, at most."""
    found: dict[str, float] = {}
    numbers = ("median", "worst", "failed", "unflagged", "overconfident")
    for key in (*numbers, "std", "log_odds", "inliers"):
        values = [row[key] for row in rows if row.get(key) is not None]
        if values:
            found[key] = digits(max(values) - min(values))
    for key in ("status", "terms"):
        if key in rows[0]:
            found[key] = max(moved(rows[0][key], row[key]) for row in rows)
    return {key: value for key, value in found.items() if value}


def moved(old: dict[str, int], new: dict[str, int]) -> int:
    """Return how many pairs have another word than before, at least."""
    return int((Counter(old) - Counter(new)).total())


# -- comparison ----------------------------------------------------------------


def compare(old: dict[str, Any], new: dict[str, Any]) -> list[str]:
    """Return findings, a line each: WORSE, MOVED or better.

    Bounds are wider where the processor differs. A case that the old figures do not
    have is judged by itself alone; one that the new ones lack is left out.
    """
    findings = []
    same = old["processor"] == new["processor"]
    factor = MEDIAN_FACTOR if same else ELSEWHERE_FACTOR
    for name, row in new["cases"].items():
        lines = judge_alone(name, row)
        if name in old["cases"]:
            lines += judge_beside(old["cases"][name], row, factor)
        findings += [f"{level} {name}: {text}" for level, text in lines]
    return sorted(findings, key=lambda line: line.startswith("better"))


def judge_alone(name: str, row: Row) -> list[Finding]:
    """Return findings of one case that need no earlier figures."""
    found = []
    if "without" in row:
        found += [
            (level, f"than without it: {text}")
            for level, text in beside_none(name, row)
        ]
    low, high = MODEL_NEES
    if name.startswith("model_noise") and not low <= row["nees"] <= high:
        found.append(
            ("WORSE", f"normalised error {row['nees']:.3g}, not in {MODEL_NEES}")
        )
    trusted = row["status"].get("ok", 0)
    if name.startswith("contradicting") and trusted:
        found.append(("WORSE", f"{trusted} of {row['pairs']} wrong inputs are ok"))
    return found


def judge_beside(old: Row, new: Row, factor: float) -> list[Finding]:
    """Return findings of one case beside its earlier figures."""
    found = judge_errors(old, new, factor)
    allowed = old.get("spread", {})
    for key in ("status", "terms"):
        if key not in old or key not in new:
            continue
        bound = 0.0 if old.get("exact") else max(1, STATUS_SHARE * old["pairs"])
        if moved(old[key], new[key]) > bound + allowed.get(key, 0):
            found.append(("WORSE", f"{key} {old[key]} -> {new[key]}"))
    # the covariance of a degraded motion is widened: more of them lower the median
    before = degraded(old)
    now = degraded(new)
    wider = now > before and (new["nees"] or 0) < EXPECTED_NEES
    worse = miss(new["nees"]) > miss(old["nees"]) + math.log(NEES_FACTOR)
    if worse and not wider:
        found.append(("WORSE", f"normalised error {old['nees']} -> {new['nees']}"))
    return found + judge_stated(old, new)


def judge_errors(old: Row, new: Row, factor: float) -> list[Finding]:
    """Return findings about errors, failures and how they were flagged."""
    found = []
    allowed = old.get("spread", {})
    tolerance = TOLERANCE[new.get("unit", "px")]
    # factor on the earlier figure, and what may come on top
    bounds: dict[str, tuple[float, float]] = {
        "failed": (1.0, 0.0),
        "unflagged": (1.0, 0.0),
        "overconfident": (1.0, max(1, 0.05 * old["pairs"])),
        "median": (factor, tolerance),
    }
    if not new["failed"]:  # with failures the worst says nothing
        bounds["worst"] = WORST_FACTOR, tolerance
    for key, (times, more) in bounds.items():
        if new[key] > times * old[key] + more + allowed.get(key, 0):
            found.append(("WORSE", f"{key} {old[key]:.4g} -> {new[key]:.4g}"))
    smaller = factor * new["median"] + tolerance + allowed.get("median", 0)
    if old["median"] > smaller:
        found.append(
            ("better", f"median error {old['median']:.4g} -> {new['median']:.4g}")
        )
    return found


def judge_stated(old: Row, new: Row) -> list[Finding]:
    """Return findings about what answers state of themselves, which may not move.

    Neither way is better as such: whoever changes them on purpose freezes new figures.
    """
    found = []
    allowed = old.get("spread", {})
    if old.get("std") is not None and new.get("std") is not None:
        low, high = sorted((old["std"], new["std"]))
        if high > STD_FACTOR * low + allowed.get("std", 0) + 1e-9:
            found.append(
                ("MOVED", f"stated std {old['std']:.4g} -> {new['std']:.4g}")
            )
    for key, bound in (("log_odds", LOG_ODDS), ("inliers", INLIERS)):
        if old.get(key) is None or new.get(key) is None:
            continue
        if abs(old[key] - new[key]) > bound + allowed.get(key, 0):
            found.append(("MOVED", f"{key} {old[key]:.4g} -> {new[key]:.4g}"))
    return found


def beside_none(name: str, row: Row) -> list[Finding]:
    """Return findings of a prior beside none: a true one makes no answer worse."""
    without = row["without"]
    lenient = 0 if name.startswith("prior_true") else 1
    found = []
    for key in ("failed", "unflagged"):
        if row[key] > without[key] + lenient:
            text = f"{key} {without[key]} -> {row[key]} of {row['pairs']}"
            found.append(("WORSE", text))
    if row["median"] > PRIOR_FACTOR * without["median"] + TOLERANCE["px"]:
        text = f"median error {without['median']:.4g} -> {row['median']:.4g}"
        found.append(("WORSE", text))
    return found


def degraded(row: Row) -> int:
    """Return how many motions of a case are degraded."""
    return sum(
        count
        for status, count in row["status"].items()
        if status.startswith("degraded")
    )


def miss(nees: float | None) -> float:
    """Return how far, in logarithms, a median normalised error is from its expectation."""
    if nees is None:
        return 0.0
    return abs(math.log(max(nees, 1e-9) / EXPECTED_NEES))
