"""Lines of ``results.json``: one method on one sequence, and one method on all of them.

A failed estimate counts with the motion it carries, which is none, in every mean and median.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from scipy.stats import binomtest

from hybridvo.errors import InputError
from hybridvo.evaluation.pair_errors import ERRORS
from hybridvo.files import parse_yaml
from hybridvo.types import Camera

FAILURE_PX = 1.0  # error of the ego flow at native size above which an estimate has failed
PATH_KEYS = ("ate_rmse", "rpe_trans_rmse", "rpe_rot_rmse_deg", "ate_rmse_origin")
NO_PAIRS = "no pair was estimated, or none has ground truth"
NO_TRUTH = "the sequence has no ground truth for these frames"
NO_MOVING = "needs true flow of the whole scene (moving objects included) and ground truth"
FACTORS: Mapping[str, tuple[str, tuple[float, ...]]] = {
    "dynamic_fraction": ("share of pixels that move", (0, 0.02, 0.05, 0.1, 0.2, 0.3, 0.5, 1)),
    "flow_magnitude_px": ("median true ego flow [px]", (0, 1, 2, 5, 10, 20, 50, math.inf)),
    "rotation_deg": ("true rotation [deg]", (0, 0.1, 0.3, 1, 3, 10, 180)),
    "translation_m": ("true translation [m]", (0, 0.003, 0.01, 0.03, 0.1, 0.3, 1, math.inf)),
    "depth_spread": ("90th over 10th percentile of depth", (1, 1.5, 2, 4, 8, 16, math.inf)),
}
"""What may explain an error, columns of ``pairs.csv`` -> label, edges of the bins."""
PAIR_COLUMNS = (
    *("sequence", "index", "method", "flow_source", "status"),
    *("epe_l2_px", "rot_err_deg", "trans_err", "ms"),
    *("r_err_deg", "t_err", "epe", "flow_ms", *FACTORS, "prev", "next", "message"),
)
"""Columns of ``pairs.csv``."""


def pair_table(pairs: Any) -> pd.DataFrame:
    """Pairs (dictionaries, or a table) with every column and no other; unknown numbers are NaN."""
    table = pd.DataFrame(pairs, columns=list(PAIR_COLUMNS))
    text = ("sequence", "method", "flow_source", "status", "message")
    numbers = [name for name in PAIR_COLUMNS if name not in text]
    table[numbers] = table[numbers].apply(pd.to_numeric)
    return table


def failure_rate(pairs: pd.DataFrame) -> dict[str, Any]:
    """``failures``, ``failure_rate`` and its Wilson interval (95 %) over a table; None of no pairs.

    A failure is a failed estimate or an error above one pixel; unknown errors are left out.
    """
    failed, epe = pairs["status"].str.startswith("failed"), pairs["epe_l2_px"]
    total, failures = int((failed | epe.notna()).sum()), int((failed | (epe > FAILURE_PX)).sum())
    names = ("failures", "failure_rate", "failure_rate_low", "failure_rate_high")
    if not total:
        return dict.fromkeys(names)
    low, high = binomtest(failures, total).proportion_ci(0.95, method="wilson")
    return dict(zip(names, (failures, failures / total, float(low), float(high)), strict=True))


def pair_scores(pairs: pd.DataFrame) -> dict[str, Any]:
    """Every mean, median and count over the pairs of one method and flow, JSON-ready.

    ``reasons`` say why a value is None.
    """
    scored = pairs[pairs["rot_err_deg"].notna()]
    figures = {name: scored[name].mean() for name in ERRORS[:4]}
    for name in ERRORS[4:]:
        figures |= {f"{name}_{how}": scored[name].agg(how) for how in ("mean", "median")}
    figures |= {
        "epe_l2_px_median": pairs["epe_l2_px"].median(),
        "ms_per_pair_median": pairs["ms"].median(),
        "flow_ms_median": pairs["flow_ms"].median(),
        "dynamic_fraction": pairs["dynamic_fraction"].mean(),
    }
    known = {name: None if math.isnan(value) else float(value) for name, value in figures.items()}
    scores = known | failure_rate(pairs) | {"pairs": len(pairs), "pairs_scored": len(scored)}
    reasons = {
        name: NO_MOVING if name == "dynamic_fraction" else NO_PAIRS
        for name, value in scores.items()
        if value is None
    }
    failed = int(pairs["status"].str.startswith("failed").sum())
    return scores | {"failed": failed, "reasons": reasons}


def sequence_row(
    pairs: pd.DataFrame, path: Mapping[str, Any] | None, named: Mapping[str, Any]
) -> dict[str, Any]:
    """Line of one method on one sequence; ``path`` is what ``evaluate`` says, where it can."""
    line = {**named, **pair_scores(pairs)}
    path = path or {"alignment": "se3", "reasons": dict.fromkeys(PATH_KEYS, NO_TRUTH)}
    line["reasons"] |= {k: v for k, v in path["reasons"].items() if k in PATH_KEYS}
    return line | {name: path.get(name) for name in ("alignment", *PATH_KEYS)}


def total_row(pairs: pd.DataFrame, rows: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """Line of one method over all sequences: pairs pooled, trajectory errors as plain means."""
    depth = ", ".join(dict.fromkeys(row["depth_source"] for row in rows))
    named = {"method": rows[0]["method"], "flow_source": rows[0]["flow_source"]}
    named |= {"sequence": "all", "depth_source": depth, "alignment": "se3"}
    line = {**named, "sequences": len(rows), **pair_scores(pairs)}
    for key in PATH_KEYS:
        known = [row[key] for row in rows if row[key] is not None]
        line[key] = float(np.mean(known)) if known else None
        missing = [f"{r['sequence']}: {r['reasons'][key]}" for r in rows if r[key] is None]
        if missing:
            text = f"mean over {len(known)} of {len(rows)} sequences; without {'; '.join(missing)}"
            line["reasons"][key] = text
    return line


# -- the paper's way of scoring MPI Sintel ---------------------------------------------------------


@functools.cache
def paper_protocol() -> dict[str, Any]:
    """The complete set (``sequences`` with their frames, ``pairs``), columns, published lines."""
    path = Path(__file__).parent / "protocols.yaml"
    content: dict[str, Any] = parse_yaml(path.read_text(encoding="utf-8"), path.name)
    return content


def same_intrinsics(first: Camera, second: Camera) -> bool:
    """Whether two cameras are one: the pairs that the paper keeps."""
    close = np.allclose(first.K, second.K, rtol=0, atol=1e-9 * first.fx)
    return first.shape == second.shape and close


def check_protocol(sequences: Sequence[Any]) -> None:
    """Refuse sequences that the protocol does not score."""
    for sequence in sequences:
        if sequence.kind != "sintel" or sequence.name not in paper_protocol()["sequences"]:
            raise InputError(
                f"--protocol paper: expected training sequences of MPI Sintel, got {sequence.name}."
            )


def protocol_summary(scored: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """What stands under ``protocol`` in ``results.json``: published lines, what is missing."""
    protocol = paper_protocol()
    names, count = [s["name"] for s in scored], sum(s["pairs_scored"] for s in scored)
    absent = [name for name in protocol["sequences"] if name not in names]
    note = ""
    if absent or count != protocol["pairs"]:
        note = f"{count} pairs, the complete set has {protocol['pairs']}: not those of the "
        note += f"published figures; missing: {', '.join(absent) or 'no sequence'}"
    return protocol | {"note": note, "missing_sequences": absent, "pairs": count}
