"""Lines of ``results.json``: one method on one sequence, and one method on all of them.

``reasons`` says of every value that is None why. A failed estimate counts with the motion it
carries, which is none, in every mean and median.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np
import pandas as pd
from scipy.stats import binomtest

from hybridvo.evaluation.pair_errors import ERRORS, mean_pair_errors

FAILURE_PX = 1.0
"""Error of the ego flow at native size above which an estimate has failed, px."""
CONFIDENCE = 0.95
READS_NO_FLOW = ("opencv-rgbd", "open3d-rgbd", "identity")
"""Methods whose result is the same whatever the flow."""
PATH_KEYS = (
    *("ate_rmse", "rpe_trans_rmse", "rpe_rot_rmse_deg"),
    *("ate_rmse_sim3", "rpe_trans_rmse_sim3", "rpe_rot_rmse_deg_sim3"),
)
"""Errors of a whole trajectory; those without a suffix are after a rigid alignment."""
NO_PAIRS = "no pair was estimated"
NO_TRUTH = "the sequence has no ground truth for these frames"
NO_MOVING = "needs true flow of the whole scene (moving objects included) and ground truth"
FACTORS: Mapping[str, tuple[str, str, tuple[float, ...]]] = {
    "dynamic_fraction": ("share of pixels that move", "", (0, 0.02, 0.05, 0.1, 0.2, 0.3, 0.5, 1)),
    "flow_magnitude_px": ("median true ego flow", "px", (0, 1, 2, 5, 10, 20, 50, math.inf)),
    "rotation_deg": ("true rotation", "deg", (0, 0.1, 0.3, 1, 3, 10, 180)),
    "translation_m": ("true translation", "m", (0, 0.003, 0.01, 0.03, 0.1, 0.3, 1, math.inf)),
    "depth_spread": ("90th over 10th percentile of depth", "", (1, 1.5, 2, 4, 8, 16, math.inf)),
}
"""Column of ``pairs.csv`` -> label, unit, edges of the bins (a bin holds its lower edge)."""
PAIR_COLUMNS = (
    *("sequence", "index", "method", "flow_source", "status"),
    *("epe_l2_px", "rot_err_deg", "trans_err", "ms"),
    *("r_err_deg", "t_err", "epe", "flow_ms", *FACTORS, "prev", "next", "message"),
)
"""Columns of ``pairs.csv``."""


def pair_table(pairs: Iterable[Mapping[str, Any]]) -> pd.DataFrame:
    """Pairs as a table with every column; unknown numbers are NaN."""
    table = pd.DataFrame(list(pairs), columns=[*PAIR_COLUMNS, "T_curr_prev"])
    text = ("sequence", "method", "flow_source", "status", "message")
    numbers = [name for name in PAIR_COLUMNS if name not in text]
    table[numbers] = table[numbers].apply(pd.to_numeric)
    return table


def failure_rate(pairs: pd.DataFrame) -> dict[str, Any]:
    """``pairs``, ``failures``, ``failure_rate`` and its Wilson interval over a table of pairs.

    A failure is a failed estimate or an error of the ego flow above one pixel. Pairs whose error is
    unknown and whose estimate did not fail are left out.
    """
    failed, epe = is_failed(pairs), pairs["epe_l2_px"]
    total, failures = int((failed | epe.notna()).sum()), int((failed | (epe > FAILURE_PX)).sum())
    names = ("failures", "failure_rate", "failure_rate_low", "failure_rate_high")
    if not total:
        return {"pairs": 0, **dict.fromkeys(names)}
    interval = binomtest(failures, total).proportion_ci(CONFIDENCE, method="wilson")
    values = (failures, failures / total, float(interval.low), float(interval.high))
    return {"pairs": total, **dict(zip(names, values, strict=True))}


def is_failed(pairs: pd.DataFrame) -> pd.Series:
    """Which estimates failed."""
    return pairs["status"].str.startswith("failed")


def known_number(value: float) -> float | None:
    """The number, None for NaN."""
    return None if math.isnan(value) else float(value)


def pair_scores(pairs: pd.DataFrame) -> dict[str, Any]:
    """Everything that is a mean, median or count over the pairs of one method and flow."""
    scored = pairs[pairs["rot_err_deg"].notna()]
    scores = mean_pair_errors(scored[list(ERRORS)].to_dict("records"))
    reasons = scores["reasons"]
    if pairs.empty:
        reasons |= dict.fromkeys(reasons, NO_PAIRS)
    flow_ms = pairs["flow_ms"].where(~pairs["method"].isin(READS_NO_FLOW), 0.0)
    medians = {
        "epe_l2_px_median": pairs["epe_l2_px"],
        "ms_per_pair_median": pairs["ms"],
        "flow_ms_median": flow_ms,
        "ms_with_flow_median": pairs["ms"] + flow_ms,
    }
    scores |= failure_rate(pairs)
    scores |= {name: known_number(values.median()) for name, values in medians.items()}
    scores["dynamic_fraction"] = known_number(pairs["dynamic_fraction"].mean())
    counts = {"pairs": len(pairs), "failed": int(is_failed(pairs).sum())}
    scores |= counts | {"pairs_scored": len(scored)}
    for name, value in scores.items():
        if value is None and name not in reasons:
            missing = NO_PAIRS if "ms" in name else reasons.get("epe_l2_px", NO_PAIRS)
            reasons[name] = NO_MOVING if name == "dynamic_fraction" else missing
    return scores


def sequence_row(
    pairs: pd.DataFrame, path: Mapping[str, Any] | None, named: Mapping[str, Any]
) -> dict[str, Any]:
    """Line of one method on one sequence; ``path`` is what ``evaluate`` says, where it can."""
    scores, names = pair_scores(pairs), (*PATH_KEYS, "scale_sim3")
    if path is None or pairs.empty:
        reason = NO_PAIRS if pairs.empty else NO_TRUTH
        path = {"alignment": "se3", "reasons": dict.fromkeys(names, reason)}
    scores["reasons"] |= {k: v for k, v in path["reasons"].items() if k in names}
    scores |= {name: path.get(name) for name in ("alignment", *names)}
    return {**named, **scores}


def summary(table: pd.DataFrame, rows: list[dict[str, Any]]) -> dict[str, Any]:
    """``rows`` of single sequences, ``totals`` over all of them, and the ``breakdown``."""
    totals = [
        total_row(group, [row for row in rows if (row["method"], row["flow_source"]) == key])
        for key, group in table.groupby(["method", "flow_source"], sort=False)
    ]
    return {"rows": rows, "totals": totals, "breakdown": breakdown(table)}


def total_row(pairs: pd.DataFrame, rows: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """Line of one method over all sequences: pairs pooled, trajectory errors as plain means.

    A trajectory error that one of its ``rows`` of single sequences lacks is the mean over the
    others, and ``reasons`` says which are missing.
    """
    scores = pair_scores(pairs)
    for key in PATH_KEYS:
        known = [row[key] for row in rows if row[key] is not None]
        scores[key] = float(np.mean(known)) if known else None
        missing = [row for row in rows if row[key] is None]
        if missing:
            without = "; ".join(f"{row['sequence']}: {row['reasons'][key]}" for row in missing)
            text = f"mean over {len(known)} of {len(rows)} sequences; without {without}"
            scores["reasons"][key] = text
    depth = ", ".join(dict.fromkeys(row["depth_source"] for row in rows))
    named = {"method": rows[0]["method"], "flow_source": rows[0]["flow_source"]}
    named |= {"sequence": "all", "depth_source": depth, "alignment": "se3"}
    return {**named, "sequences": len(rows), **scores}


def breakdown(pairs: pd.DataFrame) -> dict[str, Any]:
    """Errors and failure rates by factor, of a table of all pairs and methods.

    ``cells`` holds for each method, flow source, factor and bin that has a pair: ``low``, ``high``
    (None where open), failure rate with interval and EPE quartiles. ``factors`` count the pairs
    that know them.
    """
    cells = []
    for name, (_, _, edges) in FACTORS.items():
        values = pairs[name].clip(upper=edges[-1] * (1 - 1e-12))  # the last bin holds its end
        bins = pd.cut(values, edges, right=False, labels=False)
        for key, group in pairs.groupby(["method", "flow_source", bins], sort=False):
            k = int(key[2])
            cell = {"method": key[0], "flow_source": key[1], "factor": name, "bin": k}
            cell |= {"low": edges[k], "high": edges[k + 1] if edges[k + 1] < math.inf else None}
            cell |= failure_rate(group)
            for quantile, part in ((0.25, "q25"), (0.5, "median"), (0.75, "q75")):
                cell[f"epe_l2_px_{part}"] = known_number(group["epe_l2_px"].quantile(quantile))
            cells.append(cell)
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
    """The ``count`` worst pairs of each method and flow source, worst first.

    Pairs without a known error come last, and only if their estimate failed.
    """
    columns = ["sequence", "index", "status", "message", *ERRORS, *FACTORS]
    found = []
    for (method, flow), group in pairs.groupby(["method", "flow_source"], sort=False):
        known = group[group["epe_l2_px"].notna() | is_failed(group)]
        worst = known.sort_values("epe_l2_px", ascending=False, kind="stable").head(count)
        for rank, row in enumerate(worst[columns].to_dict("records"), 1):
            values = {k: known_number(v) if isinstance(v, float) else v for k, v in row.items()}
            found.append({"method": method, "flow_source": flow, "rank": rank, **values})
    return found
