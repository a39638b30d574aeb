"""The ablation for people: rows with their spread, the order they show, tables and a picture.

Every number comes from the runs' own files; published figures stand in columns of their own.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import pairwise
from pathlib import Path
from statistics import fmean
from typing import Any

METRICS = ("epe", "r_err_deg", "t_err")
PAPER, WIDE = "data_paper", "data_wide"

LABELS = {
    "vonet": "VONet",
    "vonet-attention": "VONet + self-att.",
    "pixelwise": "+ pixel-wise",
    "naive": "PWVO (naive)",
    "uncertain": "+ U^D + U^F",
    "pwvo": "PWVO",
    "vonet-without-flow": "VONet, without L^F",
    "vonet-attention-without-flow": "VONet + self-att., without L^F",
    "naive-without-flow": '"PWVO" (naive), without L^F',
}
"""Row -> what results call it."""

IN_PROTOCOL = {
    "vonet": "VONet",
    "vonet-attention": "VONet + self-att.",
    "pixelwise": "pixel-wise",
    "naive": "PWVO (naive)",
    "uncertain": "PWVO, U^D and U^F, no selection",
    "pwvo": "PWVO",
}
"""Row -> its line among the published figures of ``hybridvo.evaluation.protocols``."""

WITHOUT_FLOW = {
    "vonet-without-flow": (1.276, 0.113, 0.069),
    "vonet-attention-without-flow": (1.312, 0.118, 0.065),
    "naive-without-flow": (1.241, 0.144, 0.095),
}
"""Published EPE, R_err, T_err of the trainings without L^F: table 3 of the paper."""

TABLES: dict[str, tuple[tuple[str, str], ...]] = {
    "Table 1: main": (
        ("VONet", "vonet"),
        ("VONet + self-att.", "vonet-attention"),
        ("PWVO (naive)", "naive"),
        ("PWVO", "pwvo"),
    ),
    "Table 2: components, cumulative": (
        ("VONet", "vonet"),
        ("+ pixel-wise", "pixelwise"),
        ("+ U^R + U^T (= naive)", "naive"),
        ("+ U^D + U^F", "uncertain"),
        ("+ selection module (= PWVO)", "pwvo"),
    ),
    "Table 3: with and without L^F": (
        ("VONet, with", "vonet"),
        ("VONet, without", "vonet-without-flow"),
        ("VONet + self-att., with", "vonet-attention"),
        ("VONet + self-att., without", "vonet-attention-without-flow"),
        ('"PWVO" (the naive model), with', "naive"),
        ('"PWVO" (the naive model), without', "naive-without-flow"),
    ),
}
"""Title -> (the paper's name of the row, row), in the paper's order."""

CLAIM = ("pwvo", "naive", "vonet")
"""The order in EPE that the paper reports, best first."""


def published() -> dict[str, dict[str, float]]:
    """Row -> the paper's EPE (px at 128x256), R_err (degrees) and T_err (m), on MPI Sintel."""
    from hybridvo.evaluation.protocols import protocols

    lines = {line["name"]: line for line in protocols()["paper"].published}
    figures = {row: {key: lines[name][key] for key in METRICS} for row, name in IN_PROTOCOL.items()}
    return figures | {
        row: dict(zip(METRICS, values, strict=True)) for row, values in WITHOUT_FLOW.items()
    }


def summary(
    runs: Sequence[Mapping[str, Any]], sintel: Mapping[str, Any] | None, seeds: int
) -> dict[str, Any]:
    """What stands in ``ablation.json`` beside the facts of the run.

    Args:
        runs: finished trainings: ``row``, ``seed``, ``scores`` by preset, and more.
        sintel: what ``ablation_sintel.score_sintel`` returned, or None.
        seeds: how many the deciding rows were to have.

    Returns:
        ``rows``: a flat line per row of :data:`LABELS` that was trained, means over its seeds, and
        the zero-motion predictor last. ``epe``, ``r_err_deg``, ``t_err`` are over held-out pairs of
        the paper preset, ``wide_*`` of the wide one, ``sintel_*`` of the given copy of Sintel, and
        ``published_*`` what the paper reports on Sintel; ``epe_low`` and ``epe_high`` the least and
        largest of the seeds. ``order``: what they say of the paper's claim. ``unfinished``: rows
        and seeds that are not there yet. ``runs``: as given. ``sintel``: pairs and note.
    """
    theirs = published()
    rows = []
    for name, label in LABELS.items():
        mine = [run for run in runs if run["row"] == name]
        if not mine:
            continue
        row: dict[str, Any] = {"row": label, "seeds": len(mine)}
        row |= _means([run["scores"][PAPER] for run in mine], "")
        epe = [run["scores"][PAPER]["epe"] for run in mine]
        row |= {"epe_low": min(epe), "epe_high": max(epe)}
        row |= _means([run["scores"][WIDE] for run in mine], "wide_")
        on_sintel = [] if sintel is None else [_of(sintel, run) for run in mine]
        row |= _means(on_sintel, "sintel_")
        row |= {f"published_{key}": theirs[name][key] for key in METRICS}
        row |= {"key": name}
        rows.append(row)
    if runs:
        rows.append(_zero_motion(runs[0]))
    there = {(run["row"], run["seed"]) for run in runs}
    wanted = [(name, 0) for name in LABELS]
    wanted += [(name, seed) for name in CLAIM for seed in range(1, seeds)]
    orders = {PAPER: order(runs, PAPER), WIDE: order(runs, WIDE)}
    if sintel is not None:
        scored = [{**run, "scores": {"sintel": _of(sintel, run)}} for run in runs]
        orders["sintel"] = order(scored, "sintel")
    return {
        "rows": rows,
        "order": orders,
        "unfinished": [f"{row}, seed {seed}" for row, seed in wanted if (row, seed) not in there],
        "sintel": None if sintel is None else {k: sintel[k] for k in ("pairs", "note")},
        "runs": list(runs),
    }


def _of(sintel: Mapping[str, Any], run: Mapping[str, Any]) -> Mapping[str, Any]:
    return sintel["scores"][f"{run['row']}-seed{run['seed']}"]


def _means(scores: Sequence[Mapping[str, Any]], prefix: str) -> dict[str, float | None]:
    means: dict[str, float | None] = {}
    for key in METRICS:
        values = [score[key] for score in scores]
        known = bool(values) and None not in values
        means[prefix + key] = fmean(values) if known else None
    return means


def _zero_motion(run: Mapping[str, Any]) -> dict[str, Any]:
    row: dict[str, Any] = {"row": "zero motion (predicts nothing)", "seeds": 0}
    for preset, prefix in ((PAPER, ""), (WIDE, "wide_")):
        row |= {prefix + key: run["scores"][preset][f"zero_{key}"] for key in METRICS}
    row |= {"epe_low": row["epe"], "epe_high": row["epe"]}
    missing = dict.fromkeys(f"{kind}_{key}" for kind in ("sintel", "published") for key in METRICS)
    return {**row, **missing, "key": "zero-motion"}


def order(runs: Sequence[Mapping[str, Any]], preset: str) -> dict[str, Any]:
    """Whether PWVO < naive < VONet in EPE, and how sure that is.

    Returns:
        ``found``: the rows that are there, best first. ``steps``: for each neighbours of the claim
        ``better``, ``worse``, ``difference`` (px, of the means; negative as claimed), ``agree``
        and ``seeds`` (in how many of the common seeds the sign is as claimed) and ``verdict``:
        ``reproduced`` (means and every seed, at least two), ``reproduced, one seed``,
        ``undecided`` (the seeds differ in sign), ``not reproduced``, ``not measured``.
        ``reproduced``: all steps are, None where one is not measured or undecided.
    """
    epe: dict[str, dict[int, float]] = {}
    for run in runs:
        epe.setdefault(run["row"], {})[run["seed"]] = run["scores"][preset]["epe"]
    steps: list[dict[str, Any]] = []
    for better, worse in pairwise(CLAIM):
        common = sorted(set(epe.get(better, {})) & set(epe.get(worse, {})))
        differences = [epe[better][seed] - epe[worse][seed] for seed in common]
        agree = sum(difference < 0 for difference in differences)
        if not common:
            verdict = "not measured"
        elif 0 < agree < len(common):
            verdict = "undecided"
        elif agree == 0:
            verdict = "not reproduced"
        else:
            verdict = "reproduced" if agree > 1 else "reproduced, one seed"
        steps.append(
            {
                "better": better,
                "worse": worse,
                "difference": fmean(differences) if common else None,
                "agree": agree,
                "seeds": len(common),
                "verdict": verdict,
            }
        )
    verdicts = [step["verdict"] for step in steps]
    open_ = any(verdict in ("undecided", "not measured") for verdict in verdicts)
    reproduced = None if open_ else all(verdict.startswith("reproduced") for verdict in verdicts)
    if "not reproduced" in verdicts:
        reproduced = False
    found = sorted((row for row in CLAIM if row in epe), key=lambda r: fmean(epe[r].values()))
    return {"claim": list(CLAIM), "found": found, "reproduced": reproduced, "steps": steps}


def markdown(result: Mapping[str, Any]) -> str:
    """The whole page."""
    held_out = result["held_out"]
    kind = "development" if held_out["seed"] < 1000 else "held-out"
    lines = [
        "# Ablation: the rows of the paper's tables under one budget",
        "",
        f"Every row: {result['samples']} training samples, the same ones in the same order, recipe "
        f"`{result['base']}`, {result['device']}, {result['threads']} thread(s). Scored on "
        f"{held_out['count']} {kind} pairs of each preset (seed {held_out['seed']}). EPE is the "
        "paper's component mean in px at 128x256, R_err in degrees, T_err in metres.",
        "",
        "**The published columns are not the same measurement:** the paper trained 100 000 updates "
        "of 100 samples at full width and scored on MPI Sintel. What can be compared is the order "
        "of the rows, not the level.",
        "",
    ]
    if result["unfinished"]:
        lines += [f"Not trained (yet): {'; '.join(result['unfinished'])}.", ""]
    lines += ["## The order of the rows", "", *_order_lines(result), ""]
    rows = {row["key"]: row for row in result["rows"]}
    for title, content in TABLES.items():
        lines += [f"## {title}", "", *_table(content, rows, result["sintel"] is not None), ""]
    zero = rows.get("zero-motion")
    if zero is not None:
        lines += [
            "Zero motion, for scale: paper preset EPE "
            f"{_number(zero['epe'])}, R_err {_number(zero['r_err_deg'])}, T_err "
            f"{_number(zero['t_err'])}; wide preset {_number(zero['wide_epe'])}, "
            f"{_number(zero['wide_r_err_deg'])}, {_number(zero['wide_t_err'])}.",
            "",
        ]
    if result["sintel"] is not None and result["sintel"]["note"]:
        lines += [f"Sintel: {result['sintel']['note']}.", ""]
    lines += ["## Trainings", "", "| row | seed | updates | skipped | minutes | samples/s | EPE |"]
    lines += ["|---|---:|---:|---:|---:|---:|---:|"]
    lines += [
        f"| {LABELS[run['row']]} | {run['seed']} | {run['updates']} | {run['skipped']} "
        f"| {run['seconds'] / 60:.1f} | {run['samples_per_s']:.1f} "
        f"| {_number(run['scores'][PAPER]['epe'])} |"
        for run in result["runs"]
    ]
    lines += ["", f"`python {' '.join(result['command'])}`, commit {result['commit']}", ""]
    return "\n".join(lines)


def _order_lines(result: Mapping[str, Any]) -> list[str]:
    words = {
        True: "reproduced",
        False: "not reproduced",
        None: "not decided by these runs",
    }
    titles = {PAPER: "paper preset", WIDE: "wide preset", "sintel": "Sintel"}
    lines = []
    for name, found in result["order"].items():
        lines.append(f"- PWVO < naive < VONet in EPE, {titles[name]}: {words[found['reproduced']]}")
        for step in found["steps"]:
            if step["difference"] is None:
                detail = "not measured"
            else:
                detail = (
                    f"{step['verdict']}: {step['difference']:+.3f} px in the mean, as claimed in "
                    f"{step['agree']} of {step['seeds']} seeds"
                )
            lines.append(f"  - {LABELS[step['better']]} < {LABELS[step['worse']]}: {detail}")
    return lines


def _table(
    content: Sequence[tuple[str, str]], rows: Mapping[str, Mapping[str, Any]], sintel: bool
) -> list[str]:
    groups = [("", "paper preset"), ("wide_", "wide preset")]
    groups += [("sintel_", "Sintel, here")] if sintel else []
    groups += [("published_", "**published**, Sintel")]
    names = ("EPE", "R_err", "T_err")
    heads = ["row", "seeds", *(f"{name}, {group}" for _, group in groups for name in names)]
    lines = ["| " + " | ".join(heads) + " |", "|---|" + "---:|" * (len(heads) - 1)]
    theirs = published()
    for label, key in content:
        missing = {f"published_{name}": theirs[key][name] for name in METRICS}
        row = rows.get(key, missing)
        cells = [label, str(row.get("seeds", 0))]
        for prefix, _ in groups:
            for metric in METRICS:
                cell = _number(row.get(prefix + metric))
                if prefix + metric == "epe" and row.get("seeds", 0) > 1:
                    cell += f" [{_number(row['epe_low'])} to {_number(row['epe_high'])}]"
                cells.append(cell)
        lines.append("| " + " | ".join(cells) + " |")
    return lines


def _number(value: float | None) -> str:
    return "-" if value is None else f"{value:.3f}"


def plot(result: Mapping[str, Any], path: Path) -> None:
    """EPE of every row here, with the range of its seeds, beside the published one.

    Raises:
        OutputError: it cannot be written.
    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    from hybridvo.files import atomic_write

    rows = result["rows"][::-1]
    figure = Figure(figsize=(9.5, 0.9 + 0.36 * len(rows)), dpi=130, layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.subplots(1, 2, sharey=True)
    panels = (
        ("here: held-out pairs, paper preset", "epe", "#0072B2"),
        ("published: MPI Sintel", "published_epe", "#777777"),
    )
    for axis, (title, key, colour) in zip(axes, panels, strict=True):
        for height, row in enumerate(rows):
            value = row[key]
            if value is None:
                continue
            axis.plot([value], [height], "o", color=colour, markersize=5)
            if key == "epe" and row["seeds"] > 1:
                axis.plot([row["epe_low"], row["epe_high"]], [height] * 2, color=colour, lw=1.5)
            axis.annotate(
                f"{value:.3f}", (value, height), xytext=(0, 5), textcoords="offset points",
                ha="center", fontsize=7, color="#444444",
            )  # fmt: skip
        axis.set_title(title, fontsize=10, loc="left")
        axis.set_xlabel("EPE [px at 128x256]", fontsize=9)
        axis.set_xlim(left=0)
        axis.margins(x=0.12)
        axis.tick_params(labelsize=8)
        axis.grid(True, axis="x", color="#e4e4e4", linewidth=0.8)
        for side in ("top", "right"):
            axis.spines[side].set_visible(False)
    axes[0].set_ylim(-0.6, len(rows) - 0.3)
    axes[0].set_yticks(range(len(rows)), [row["row"] for row in rows], fontsize=8)
    with atomic_write(path, "wb") as file:
        figure.savefig(file, format="png")
