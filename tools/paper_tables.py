"""The tables of docs/paper.md, from docs/results/ablation.json and docs/results/paper.json."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from markdown_table import number, table

from hybridvo.evaluation.protocols import paper_protocol

Results = dict[str, dict[str, Any]]

ROWS = {
    "vonet": "VONet",
    "vonet-attention": "VONet + self-attention",
    "pixelwise": "+ pixel-wise",
    "pwvo-naive": "+ U^R + U^T (PWVO naive)",
    "pwvo-uncertain": "+ U^D + U^F",
    "pwvo-paper": "+ selection (PWVO)",
}
WITHOUT_FLOW = {  # the paper's Table 3: EPE px, R_err deg, T_err m
    "vonet": (1.276, 0.113, 0.069),
    "vonet-attention": (1.312, 0.118, 0.065),
    "pwvo-naive": (1.241, 0.144, 0.095),
    "pwvo-paper": (None, None, None),
}
"""The line that the paper calls PWVO there has the figures of its PWVO (naive)."""
FIGURES = {"epe": "EPE", "r_err_deg": "R_err", "t_err": "T_err"}
PRESETS = {"data_paper": "paper's data", "data_diverse": "diverse data"}


def runs_of(results: Results, row: str) -> list[dict[str, Any]]:
    """Curves of the finished seeds of a row."""
    content = results.get("ablation", {})
    last = str(content.get("samples"))
    return [
        run["curve"]
        for run in content.get("runs", ())
        if run["row"] == row and last in run["curve"]
    ]


def final(results: Results, row: str, preset: str, key: str) -> str:
    """Mean of a figure over the seeds at the end of the training, with its spread."""
    last = str(results["ablation"]["samples"])
    values = [curve[last][preset][key] for curve in runs_of(results, row)]
    if not values or None in values:
        return "-"
    spread = f" +- {number(float(np.std(values, ddof=1)))}" if len(values) > 1 else ""
    return number(float(np.mean(values))) + spread


def published(row: str) -> Mapping[str, Any]:
    """Figures of a row in the paper."""
    return next(line for line in paper_protocol()["published"] if line["method"] == row)


def budget(results: Results) -> str:
    """One line on what the rows were trained with."""
    content = results["ablation"]
    seeds = sorted({len(runs_of(results, row)) for row in ROWS if runs_of(results, row)})
    counted = " to ".join(map(str, dict.fromkeys((seeds[0], seeds[-1]))))
    return (
        f"Ours: {content['samples']} samples a row (the paper: 10 000 000), seeds: {counted}, "
        "quarter width, 64x128, inputs without units, batches of 8; "
        f"{content['held_out']['count']} held-out pairs, EPE in px of 64x128 (component mean). "
        f"Published: Sintel, px of 128x256. `{content['command']}`"
    )


def main_table(results: Results) -> list[str]:
    """Tables 1 and 2 of the paper."""
    if not any(runs_of(results, row) for row in ROWS):
        return []
    rows = []
    for row, title in ROWS.items():
        cells = [number(published(row)[key]) for key in FIGURES]
        cells += [final(results, row, preset, key) for preset in PRESETS for key in FIGURES]
        rows.append([title, *cells])
    columns = ("published", *PRESETS.values())
    header = [f"{name}, {whose}" for whose in columns for name in FIGURES.values()]
    return [*table(["row", *header], rows), "", budget(results)]


def flow_table(results: Results) -> list[str]:
    """Table 3 of the paper: with and without L^F."""
    rows = []
    for row, without in WITHOUT_FLOW.items():
        if not runs_of(results, f"{row}-without-flow"):
            continue
        cells = []
        for key, value in zip(FIGURES, without, strict=True):
            ours = [
                final(results, name, "data_paper", key) for name in (row, f"{row}-without-flow")
            ]
            cells += [f"{number(published(row)[key])} / {number(value)}", " / ".join(ours)]
        rows.append([ROWS[row], *cells])
    if not rows:
        return []
    names = [f"{name}, {whose}" for name in FIGURES.values() for whose in ("published", "ours")]
    return [*table(["row, with / without L^F", *names], rows), "", budget(results)]


def claims_table(results: Results) -> list[str]:
    """The paper's orders as paired differences at the end of the training."""
    content = results.get("ablation", {})
    rows = []
    for claim in content.get("claims", ()):
        if claim["samples"] != content["samples"]:
            continue
        title = " < ".join(claim[side] for side in ("better", "worse"))
        spread = claim["spread_of_seeds_px"]
        rows.append(
            [f"{title}, {PRESETS[claim['preset']]}", f"{claim['difference_px']:+.3f}",
             f"{claim['error_over_pairs_px']:.3f}", "-" if spread is None else f"{spread:.3f}",
             claim["as_claimed"]]
        )  # fmt: skip
    header = ["claim (EPE)", "difference, px", "standard error over pairs", "spread of seeds"]
    header += ["seeds as claimed"]
    return table(header, rows)


def curve_table(results: Results) -> list[str]:
    """EPE of every row while it learns."""
    rows = []
    order = sorted({int(k) for row in ROWS for curve in runs_of(results, row) for k in curve})
    for row, title in ROWS.items():
        curves = runs_of(results, row)
        if curves:
            means = [[c[str(k)]["data_paper"]["epe"] for c in curves] for k in order]
            rows.append([title, *(number(float(np.mean(x))) for x in means)])
    header = ["EPE, px, after samples", *(f"{k // 1000} k" for k in order)]
    return table(header, rows)


def selection_table(results: Results) -> list[str]:
    """The rules of the selection on one trained PWVO."""
    curves = runs_of(results, "pwvo-paper")
    if not curves:
        return []
    ends = [curve[str(results["ablation"]["samples"])] for curve in curves]
    rows = []
    for rule in ends[0]["rules_data_paper"]:
        found = [[end[f"rules_{p}"][rule][k] for p in PRESETS for k in FIGURES] for end in ends]
        rows.append([f"`{rule}`", *(number(float(x)) for x in np.mean(found, axis=0))])
    header = [f"{name}, {title}" for title in PRESETS.values() for name in FIGURES.values()]
    return table(["rule", *header], rows)


def uncertainty_table(results: Results) -> list[str]:
    """What the uncertainty of every row knows of movers and of its own error."""
    rows = []
    for row in ("pwvo-naive", "pwvo-uncertain", "pwvo-paper"):
        if not runs_of(results, row):
            continue
        for preset, title in PRESETS.items():
            cells = []
            for figure in ("auroc", "spearman", "median_ratio"):
                halves = (f"{figure}_{half}" for half in ("rotation", "translation"))
                cells.append(" / ".join(final(results, row, preset, name) for name in halves))
            rows.append([f"{ROWS[row]}, {title}", *cells])
    header = [
        "row",
        "AUROC as mover detector, R / T",
        "Spearman with the error, R / T",
        "median error / U, R / T (right: 0.69)",
    ]
    return table(header, rows)


def saliency_table(results: Results) -> list[str]:
    """Share of the saliency on moving pixels over their share of the image."""
    content = results.get("paper", {})
    rows = []
    for row, shares in content.get("saliency", {}).items():
        cells = [
            f"{shares[k]['mean']:.2f} +- {shares[k]['standard_error']:.2f}"
            for k in ("rotation", "translation")
        ]
        rows.append([ROWS[row], *cells, f"{100 * shares['median_part_missed']:.1f} %"])
    header = ["row", "rotation", "translation", "part of the answer that the integral misses"]
    return table(header, rows)


TABLES = {
    "paper_rows": main_table,
    "paper_flow": flow_table,
    "paper_claims": claims_table,
    "paper_curves": curve_table,
    "paper_selection": selection_table,
    "paper_uncertainty": uncertainty_table,
    "paper_saliency": saliency_table,
}
