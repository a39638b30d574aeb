"""Why a method fails: errors against what is in the pairs, failure rates, paired differences.

Everything is computed from the rows of ``pairs.csv``: a mapping per pair and method with
``sequence``, ``index``, ``method``, ``flow_source``, ``status``, ``epe_l2_px``, ``rot_err_deg``,
``trans_err`` and the facts of the pair (:data:`FACTORS`). ``results.json`` holds the outcome under
two keys, which reports read:

``breakdown``
    ``failure_px`` (1.0), ``confidence`` (0.95);
    ``factors``: a list of ``name``, ``label``, ``unit``, ``edges`` (null where open), ``pairs``
    (pairs that know the factor) and ``reason`` (why no pair does, or null);
    ``cells``: a list with one entry per method, flow source, factor and bin that holds a pair:
    ``method``, ``flow_source``, ``factor``, ``bin`` (0, 1, ...), ``low``, ``high`` (null where
    open), ``pairs``, ``failed``, ``failures``, ``failure_rate``, ``failure_rate_low``,
    ``failure_rate_high``, ``epe_l2_px_median``, ``epe_l2_px_q25``, ``epe_l2_px_q75``,
    ``rot_err_deg_median``, ``trans_err_median``;
    ``failure_rates``: a list with one entry per method and flow source: ``method``,
    ``flow_source``, ``pairs``, ``failed``, ``failures``, ``failure_rate``, ``failure_rate_low``,
    ``failure_rate_high``;
    ``differences``: a list with one entry per flow source and two methods: ``flow_source``,
    ``method``, ``other``, ``pairs`` (that both were scored on), ``blocks``, ``reason`` (why there
    are no intervals, or null) and three values with their intervals, each under ``NAME``,
    ``NAME_low``, ``NAME_high``: ``epe_difference_px`` (mean of EPE of method minus other, below 0:
    method is better), ``epe_ratio`` (geometric mean of EPE of method over other, below 1: method
    is better), ``failure_rate_difference`` (failure rate of method minus other); ``better_share``
    (share of the pairs on which the EPE of method is the smaller one);
    ``bootstrap``: ``resamples``, ``seed``, ``block_pairs``, ``confidence``.
``worst_pairs``
    a list, worst first within each method and flow source: ``method``, ``flow_source``, ``rank``
    (1, 2, ...), ``sequence``, ``index``, ``status``, ``message``, ``epe_l2_px``, ``rot_err_deg``,
    ``trans_err``, the facts of the pair, and ``picture`` (path of a JPEG relative to the output
    folder: previous frame, flow, and the error that the motion makes; null with
    ``picture_reason``).

A failure is a failed estimate, or an error of the ego flow above one pixel; a failed estimate has
the error of the motion it carries, which is none. Pairs whose error is unknown (no truth, no depth)
and whose estimate did not fail are left out. A value that cannot be computed is None.
"""

from __future__ import annotations

import itertools
import math
from array import array
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from statistics import NormalDist
from typing import Any

import numpy as np

from hybridvo.errors import InputError

__all__ = [
    "FACTORS",
    "FAILURE_PX",
    "Factor",
    "PairTable",
    "breakdown",
    "failure_rate",
    "wilson",
    "worst_pairs",
]

FAILURE_PX = 1.0
"""Error of the ego flow at native size above which an estimate has failed, px."""
CONFIDENCE = 0.95
RESAMPLES = 2000
"""Resamples of the bootstrap: the ends of a 95 % interval are known to 0.5 % of probability."""
BLOCK_PAIRS = 10
"""Consecutive pairs that are drawn together: neighbours see the same scene and are no independent
samples. Fewer where there are less than a hundred pairs."""
MIN_BLOCKS = 8
"""Fewer blocks than this give no interval."""
_EPE_FLOOR_PX = 1e-6  # below float32 rounding of a flow; keeps the ratio of two zeros at one


@dataclass(frozen=True)
class Factor:
    """Something about a pair that may explain an error.

    Args:
        label: for people. unit: of its values, empty for a number without.
        edges: increasing bounds of the bins, the last one may be infinite; a bin holds its lower
            bound, the last bin both.
    """

    label: str
    unit: str
    edges: tuple[float, ...]

    def bins(self, values: np.ndarray) -> np.ndarray:
        """(N,) number of the bin of each value; -1 for NaN and outside of the edges."""
        inner = np.searchsorted(self.edges, values, side="right") - 1
        inner[values == self.edges[-1]] = len(self.edges) - 2
        outside = ~((values >= self.edges[0]) & (values <= self.edges[-1]))
        return np.where(outside, -1, inner)


FACTORS: Mapping[str, Factor] = {
    "dynamic_fraction": Factor(
        "share of pixels that move by themselves", "", (0.0, 0.02, 0.05, 0.1, 0.2, 0.3, 0.5, 1.0)
    ),
    "flow_magnitude_px": Factor(
        "median length of the true ego flow", "px", (0.0, 1.0, 2.0, 5.0, 10.0, 20.0, 50.0, math.inf)
    ),
    "rotation_deg": Factor("true rotation", "deg", (0.0, 0.1, 0.3, 1.0, 3.0, 10.0, 180.0)),
    "translation_m": Factor(
        "true translation", "m", (0.0, 0.003, 0.01, 0.03, 0.1, 0.3, 1.0, math.inf)
    ),
    "depth_spread": Factor(
        "90th over 10th percentile of the depth", "", (1.0, 1.5, 2.0, 4.0, 8.0, 16.0, math.inf)
    ),
}
"""Name in ``pairs.csv`` -> what it is; see :func:`hybridvo.evaluation.pairs.pair_facts`."""

_NO_FACTOR = {
    "dynamic_fraction": "needs true flow of the whole scene (moving objects included) and truth",
    "flow_magnitude_px": "needs truth and a valid depth",
    "rotation_deg": "needs truth",
    "translation_m": "needs truth",
    "depth_spread": "needs a valid depth",
}
_ERRORS = ("epe_l2_px", "rot_err_deg", "trans_err")
_COLUMNS = (*("failed", *_ERRORS, "r_err_deg", "t_err", "epe", "ms", "flow_ms"), *FACTORS)


def wilson(
    failures: int, total: int, confidence: float = CONFIDENCE
) -> tuple[float | None, float | None]:
    """Wilson's score interval of a rate (E. B. Wilson, JASA 22, 1927).

    Args:
        failures: how often it happened.
        total: how often it could have.
        confidence: probability of the interval, inside (0, 1).

    Returns:
        (low, high) within [0, 1]; (None, None) for ``total`` 0.

    Raises:
        InputError: ``failures`` outside of 0 to ``total``, or a confidence that is no probability.

    Example:
        >>> low, high = wilson(0, 10)
        >>> f"{low:.3f} {high:.3f}"
        '0.000 0.278'
    """
    if not 0 <= failures <= total:
        raise InputError(f"wilson: expected 0 <= failures <= total, got {failures} of {total}.")
    if not 0 < confidence < 1:
        raise InputError(f"wilson: expected a confidence inside (0, 1), got {confidence}.")
    if total == 0:
        return None, None
    z = NormalDist().inv_cdf(0.5 + confidence / 2)
    rate = failures / total
    centre = (rate + z * z / (2 * total)) / (1 + z * z / total)
    half = z / (1 + z * z / total) * math.sqrt(rate * (1 - rate) / total + (z / (2 * total)) ** 2)
    # exact at the ends, where rounding would leave 1e-17
    low = 0.0 if failures == 0 else max(0.0, centre - half)
    return low, 1.0 if failures == total else min(1.0, centre + half)


class PairTable:
    """Errors and facts of all pairs, method by method, as columns of numbers.

    Takes some 250 bytes for a pair and a method: a million of them fit into memory.
    """

    def __init__(self) -> None:
        self._columns: dict[tuple[str, str], dict[str, array[float]]] = {}
        self._keys: dict[tuple[str, str], list[tuple[str, int]]] = {}

    def add(self, row: Mapping[str, Any]) -> None:
        """Take a row of ``pairs.csv``."""
        group = str(row["method"]), str(row["flow_source"])
        columns = self._columns.setdefault(group, {name: array("d") for name in _COLUMNS})
        self._keys.setdefault(group, []).append((str(row["sequence"]), int(row["index"])))
        columns["failed"].append(float(str(row["status"]).startswith("failed")))
        for name in _COLUMNS[1:]:
            value = row.get(name)
            columns[name].append(math.nan if value is None else float(value))

    @property
    def groups(self) -> list[tuple[str, str]]:
        """(method, flow source) in the order in which they were first seen."""
        return list(self._columns)

    def count(self, group: tuple[str, str]) -> int:
        """Pairs of a group so far; 0 for an unknown one."""
        return len(self._keys.get(group, ()))

    def columns(self, group: tuple[str, str], start: int = 0) -> dict[str, np.ndarray]:
        """Columns of a group: arrays (N,), NaN where unknown; empty for an unknown group.

        Args:
            group: (method, flow source).
            start: pairs at the beginning that are left out.

        Returns:
            ``failed`` (0 or 1), the errors, the times and the facts, by name.
        """
        columns = self._columns.get(group) or {name: array("d") for name in _COLUMNS}
        return {name: np.array(values[start:]) for name, values in columns.items()}

    def keys(self, group: tuple[str, str]) -> list[tuple[str, int]]:
        """(sequence, index) of each pair of a group."""
        return self._keys[group]


def _scored(columns: Mapping[str, np.ndarray]) -> np.ndarray:
    """(N,) bool: estimates whose success is known."""
    return (columns["failed"] > 0) | np.isfinite(columns["epe_l2_px"])


def _failures(columns: Mapping[str, np.ndarray]) -> np.ndarray:
    """(N,) bool; NaN compares false."""
    return (columns["failed"] > 0) | (columns["epe_l2_px"] > FAILURE_PX)


def failure_rate(columns: Mapping[str, np.ndarray]) -> dict[str, Any]:
    """``pairs``, ``failed``, ``failures``, ``failure_rate`` and its Wilson interval."""
    scored = _scored(columns)
    total = int(scored.sum())
    failures = int(_failures(columns)[scored].sum())
    low, high = wilson(failures, total)
    return {
        "pairs": total,
        "failed": int(columns["failed"].sum()),
        "failures": failures,
        "failure_rate": failures / total if total else None,
        "failure_rate_low": low,
        "failure_rate_high": high,
    }


def _quantile(values: np.ndarray, q: float) -> float | None:
    known = values[np.isfinite(values)]
    return float(np.quantile(known, q)) if known.size else None


def _open_edge(value: float) -> float | None:
    return None if math.isinf(value) else value


def _cells(group: tuple[str, str], columns: Mapping[str, np.ndarray]) -> Iterable[dict[str, Any]]:
    scored = _scored(columns)
    for name, factor in FACTORS.items():
        bins = factor.bins(columns[name])
        for k in range(len(factor.edges) - 1):
            inside = scored & (bins == k)
            if not inside.any():
                continue
            part = {key: values[inside] for key, values in columns.items()}
            yield {
                "method": group[0],
                "flow_source": group[1],
                "factor": name,
                "bin": k,
                "low": factor.edges[k],
                "high": _open_edge(factor.edges[k + 1]),
                **failure_rate(part),
                "epe_l2_px_median": _quantile(part["epe_l2_px"], 0.5),
                "epe_l2_px_q25": _quantile(part["epe_l2_px"], 0.25),
                "epe_l2_px_q75": _quantile(part["epe_l2_px"], 0.75),
                "rot_err_deg_median": _quantile(part["rot_err_deg"], 0.5),
                "trans_err_median": _quantile(part["trans_err"], 0.5),
            }


def _blocks(keys: Sequence[tuple[str, int]], size: int) -> np.ndarray:
    """(N,) number of the block of each pair: ``size`` consecutive pairs of one sequence."""
    numbers: list[int] = []
    block, inside, before = -1, size, None
    for sequence, _ in keys:
        if sequence != before or inside == size:
            block, inside, before = block + 1, 0, sequence
        inside += 1
        numbers.append(block)
    return np.array(numbers, dtype=int)


def _difference(
    table: PairTable, first: tuple[str, str], second: tuple[str, str], seed: int
) -> dict[str, Any]:
    """Paired comparison of two methods over the pairs that both were scored on."""
    columns = [table.columns(group) for group in (first, second)]
    places = [{key: i for i, key in enumerate(table.keys(group))} for group in (first, second)]
    keys = [
        key
        for key in sorted(places[0])
        if key in places[1]
        and all(math.isfinite(c["epe_l2_px"][p[key]]) for c, p in zip(columns, places, strict=True))
    ]
    result: dict[str, Any] = {
        "flow_source": first[1],
        "method": first[0],
        "other": second[0],
        "pairs": len(keys),
        "blocks": 0,
        "reason": None,
    }
    names = ("epe_difference_px", "epe_ratio", "failure_rate_difference")
    result |= dict.fromkeys((f"{n}{end}" for n in names for end in ("", "_low", "_high")), None)
    result["better_share"] = None
    if not keys:
        return result | {"reason": "no pair on which the error of both is known"}
    epe, failures = (
        [values[[place[key] for key in keys]] for values, place in zip(wanted, places, strict=True)]
        for wanted in ([c["epe_l2_px"] for c in columns], [_failures(c) for c in columns])
    )
    floored = [np.log(np.maximum(values, _EPE_FLOOR_PX)) for values in epe]
    samples = np.stack(
        [
            epe[0] - epe[1],
            floored[0] - floored[1],
            failures[0].astype(float) - failures[1].astype(float),
        ]
    )
    back = (float, math.exp, float)
    for name, value, to in zip(names, samples.mean(axis=1), back, strict=True):
        result[name] = to(float(value))
    result["better_share"] = float(np.mean(epe[0] < epe[1]))
    blocks = _blocks(keys, _block_size(len(keys)))
    result["blocks"] = count = int(blocks[-1]) + 1
    if count < MIN_BLOCKS:
        return result | {"reason": f"{count} blocks of pairs are too few for an interval"}
    sums = np.stack([np.bincount(blocks, row, count) for row in samples])
    sizes = np.bincount(blocks, minlength=count)
    rng = np.random.default_rng([seed, count])
    drawn = rng.multinomial(count, np.full(count, 1 / count), RESAMPLES)
    means = (sums @ drawn.T) / (drawn @ sizes)
    tail = (1 - CONFIDENCE) / 2
    for name, row, to in zip(names, means, back, strict=True):
        low, high = np.quantile(row, [tail, 1 - tail])
        result[f"{name}_low"], result[f"{name}_high"] = to(float(low)), to(float(high))
    return result


def _block_size(pairs: int) -> int:
    return max(1, min(BLOCK_PAIRS, pairs // BLOCK_PAIRS))


def breakdown(table: PairTable, *, seed: int = 0) -> dict[str, Any]:
    """What stands under ``breakdown`` in ``results.json``; the fields are listed above.

    Args:
        table: rows of all pairs and methods.
        seed: of the bootstrap.
    """
    columns = {group: table.columns(group) for group in table.groups}
    known = {
        name: max((int(np.isfinite(c[name]).sum()) for c in columns.values()), default=0)
        for name in FACTORS
    }
    by_flow: dict[str, list[tuple[str, str]]] = {}
    for group in table.groups:
        by_flow.setdefault(group[1], []).append(group)
    longest = max((len(table.keys(group)) for group in table.groups), default=0)
    return {
        "failure_px": FAILURE_PX,
        "confidence": CONFIDENCE,
        "factors": [
            {
                "name": name,
                "label": factor.label,
                "unit": factor.unit,
                "edges": [_open_edge(edge) for edge in factor.edges],
                "pairs": known[name],
                "reason": None if known[name] else _NO_FACTOR[name],
            }
            for name, factor in FACTORS.items()
        ],
        "cells": [cell for group, c in columns.items() for cell in _cells(group, c)],
        "failure_rates": [
            {"method": group[0], "flow_source": group[1], **failure_rate(c)}
            for group, c in columns.items()
        ],
        "differences": [
            _difference(table, first, second, seed)
            for groups in by_flow.values()
            for first, second in itertools.combinations(groups, 2)
        ],
        "bootstrap": {
            "resamples": RESAMPLES,
            "seed": seed,
            "block_pairs": _block_size(longest),
            "confidence": CONFIDENCE,
        },
    }


def worst_pairs(table: PairTable, count: int = 3) -> list[dict[str, Any]]:
    """What stands under ``worst_pairs`` in ``results.json``, without messages and pictures.

    Failed estimates count with the error of no motion, like everywhere; pairs without a known error
    come after all others and only if their estimate failed.

    Args:
        table: rows of all pairs and methods.
        count: pairs for each method and flow source.
    """
    found = []
    for group in table.groups:
        columns, keys = table.columns(group), table.keys(group)
        epe = columns["epe_l2_px"]
        candidates = np.flatnonzero(_scored(columns))
        order = sorted(candidates, key=lambda i: (-np.nan_to_num(epe[i], nan=-1.0), keys[i]))
        for rank, i in enumerate(order[:count], 1):
            row: dict[str, Any] = {
                "method": group[0],
                "flow_source": group[1],
                "rank": rank,
                "sequence": keys[i][0],
                "index": keys[i][1],
            }
            for name in (*_ERRORS, *FACTORS):
                value = float(columns[name][i])
                row[name] = value if math.isfinite(value) else None
            found.append(row)
    return found
