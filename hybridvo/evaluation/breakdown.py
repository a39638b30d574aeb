"""Why a method fails: errors against what is in the pairs, and the worst pairs.

Computed from the table of pairs (``pairs.csv``). ``results.json`` holds :func:`breakdown` and
:func:`worst_pairs` under their names.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import pandas as pd

from hybridvo.evaluation.scores import CONFIDENCE, FAILURE_PX, PAIR_ERRORS, failure_rate, is_failed

FACTORS: Mapping[str, tuple[str, str, tuple[float, ...]]] = {
    "dynamic_fraction": (
        "share of pixels that move by themselves",
        "",
        (0.0, 0.02, 0.05, 0.1, 0.2, 0.3, 0.5, 1.0),
    ),
    "flow_magnitude_px": (
        "median length of the true ego flow",
        "px",
        (0.0, 1.0, 2.0, 5.0, 10.0, 20.0, 50.0, math.inf),
    ),
    "rotation_deg": ("true rotation", "deg", (0.0, 0.1, 0.3, 1.0, 3.0, 10.0, 180.0)),
    "translation_m": ("true translation", "m", (0.0, 0.003, 0.01, 0.03, 0.1, 0.3, 1.0, math.inf)),
    "depth_spread": (
        "90th over 10th percentile of the depth",
        "",
        (1.0, 1.5, 2.0, 4.0, 8.0, 16.0, math.inf),
    ),
}
"""Column of ``pairs.csv`` -> label, unit, edges of the bins (a bin holds its lower edge)."""


def breakdown(pairs: pd.DataFrame) -> dict[str, Any]:
    """Errors and failure rates by factor.

    Args:
        pairs: table of all pairs and methods.

    Returns:
        ``failure_px``, ``confidence``; ``factors``: ``name``, ``label``, ``unit``, ``pairs`` (that
        know it); ``cells``: for each method, flow source, factor and bin that holds a pair:
        ``low``, ``high`` (None where open), failure rate with interval and EPE quartiles;
        ``failure_rates``: one for each method and flow source.
    """
    cells = []
    for name, (_, _, edges) in FACTORS.items():
        values = pairs[name].clip(upper=edges[-1] * (1 - 1e-12))  # the last bin holds its end
        bins = pd.cut(values, edges, right=False, labels=False)
        for key, group in pairs.groupby(["method", "flow_source", bins], sort=False):
            method, flow, k = key
            low, high = edges[int(k)], edges[int(k) + 1]
            quartiles = group["epe_l2_px"].quantile([0.25, 0.5, 0.75])
            named = dict(method=method, flow_source=flow, factor=name, bin=int(k))
            limits = dict(low=low, high=None if math.isinf(high) else high)
            middle = ("epe_l2_px_q25", "epe_l2_px_median", "epe_l2_px_q75")
            epe = dict(zip(middle, map(_number, quartiles), strict=True))
            cells.append({**named, **limits, **failure_rate(group), **epe})
    rates = [
        {"method": method, "flow_source": flow, **failure_rate(group)}
        for (method, flow), group in pairs.groupby(["method", "flow_source"], sort=False)
    ]
    known = pairs.drop_duplicates(["sequence", "index"])
    return {
        "failure_px": FAILURE_PX,
        "confidence": CONFIDENCE,
        "factors": [
            {"name": name, "label": label, "unit": unit, "pairs": int(known[name].notna().sum())}
            for name, (label, unit, _) in FACTORS.items()
        ],
        "cells": cells,
        "failure_rates": rates,
    }


def worst_pairs(pairs: pd.DataFrame, count: int = 3) -> list[dict[str, Any]]:
    """The worst pairs of each method and flow source, worst first.

    Pairs without a known error come last, and only if their estimate failed.

    Args:
        pairs: table of all pairs and methods.
        count: pairs of each method and flow source.
    """
    columns = ["sequence", "index", "status", "message", *PAIR_ERRORS, *FACTORS]
    found = []
    for (method, flow), group in pairs.groupby(["method", "flow_source"], sort=False):
        known = group[group["epe_l2_px"].notna() | is_failed(group)]
        worst = known.sort_values("epe_l2_px", ascending=False, kind="stable").head(count)
        for rank, row in enumerate(worst[columns].to_dict("records"), 1):
            values = {k: _number(v) if isinstance(v, float) else v for k, v in row.items()}
            found.append({"method": method, "flow_source": flow, "rank": rank, **values})
    return found


def _number(value: float) -> float | None:
    return None if math.isnan(value) else float(value)
