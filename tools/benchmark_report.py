"""The benchmark's tables for people; every number comes from the JSON."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

MID_CELL = "moving30"


def markdown(result: dict[str, Any], cells: list[str], methods: list[str]) -> str:
    """The whole page: goals first, then the cells, then each part that was run."""
    first, last = result["seeds"]
    lines = [
        "# Pose solvers on the synthetic cells",
        "",
        f"{last - first + 1} pairs a cell, seeds {first}-{last}; {result['machine']['processor']}, "
        f"{result['machine']['cores']} cores, load {result['machine']['load_average']}. "
        "Medians; times are whole calls from the FramePair on.",
        "",
    ]
    if result.get("goals"):
        lines += _goals(result["goals"])
    lines += _cells(result, cells, methods)
    for key, section in (("heavy", _heavy), ("nees", _nees), ("kernel", _kernel)):
        if result.get(key):
            lines += section(result[key])
    if result.get("batch"):
        lines += _batch(result["batch"])
    if result.get("network"):
        lines += _network(result["network"])
    lines += _memory(result["memory"])
    lines += ["## Versions", ""]
    lines += [f"- {name}: {value}" for name, value in result["versions"].items() if value]
    lines += [f"- not run: {name}: {reason}" for name, reason in result["missing"].items()]
    return "\n".join(lines) + "\n"


def _goals(rows: list[dict[str, Any]]) -> list[str]:
    lines = [
        "## Goals",
        "",
        "| what | goal | at least demanded | measured | met | |",
        "|---|---|---|---|---|---|",
    ]
    for row in rows:
        bound = ">=" if row["at_least"] else "<="
        least = "" if row["least"] is None else f"{bound} {row['least']:.3g}"
        measured = "not measured" if row["measured"] is None else f"{row['measured']:.3g}"
        met = {"least": "no (the least demand is)", None: ""}.get(row["met"], row["met"])
        name = f"{row['name']}, {row['unit']}"
        lines.append(
            f"| {name} | {bound} {row['goal']:.3g} | {least} | {measured} | {met} "
            f"| {row['note'] or ''} |"
        )
    return [*lines, ""]


def _cells(result: dict[str, Any], cells: list[str], methods: list[str]) -> list[str]:
    summary = result["summary"]
    lines = [
        "## Error of the ego flow over true depth, px [failures: above 1 px, or no answer]",
        "",
        *_table(cells, methods, lambda c, m: _error_cell(summary[c][m])),
        "",
        "## Time, ms (quartiles)",
        "",
        *_table(cells, methods, lambda c, m: _spread(summary[c][m]["ms"], 2)),
        "",
        "## Error inside the 3 sigma ellipsoid of the covariance, per cent (mean NEES, ideal 6)",
        "",
        *_table(cells, methods, lambda c, m: _containment_cell(summary[c][m])),
        "",
    ]
    if any(summary[c][m]["hypothesis_hits"] is not None for c in cells for m in methods):
        with_any = [m for m in methods if summary[cells[0]][m]["hypothesis_hits"] is not None]
        lines += ["## Pairs whose true motion is among the hypotheses", ""]
        lines += _table(
            cells,
            with_any,
            lambda c, m: f"{summary[c][m]['hypothesis_hits']}/{summary[c][m]['pairs']}",
        )
        lines.append("")
    if result["ratios"]["refine_over"]:
        lines += [
            "## `refine` over each method",
            "",
            f"Error: geometric mean of the medians over {', '.join(result['ratios']['cells'])}. "
            f"Time: medians in {MID_CELL}.",
            "",
            "| against | error | time |",
            "|---|---|---|",
        ]
        for method, row in result["ratios"]["refine_over"].items():
            ratio = "" if row["time"] is None else f"{row['time']:.3f}"
            lines.append(f"| {method} | {row['error']:.3f} | {ratio} |")
        lines.append("")
    return lines


def _heavy(heavy: dict[str, Any]) -> list[str]:
    facts = heavy["conditions"]
    first, last = facts["seeds"]
    height, width = facts["size"]
    lines = [
        "## Heavy sequences: most of the picture moves",
        "",
        f"Rendered, seeds {first}-{last} of each kind, {facts['pairs_per_sequence']} pairs a "
        f"sequence, {width}x{height}. Depth: {facts['depth']}. True flow is an oracle; DIS flow "
        "comes with its forward-backward variance. "
        f"`{facts['oracle']}` is told which pixels are static: an oracle.",
        "Hit: the true motion (EPE < 1 px) is among the hypotheses; chosen: it is the first. "
        f"Brackets: {facts['interval']}.",
        "",
        "| kind | flow | method | pairs | hit, % | chosen, % | failures, % | EPE median, px | ms |",
        "|---|---|---|---|---|---|---|---|---|",
    ]
    for kind, flows in heavy["summary"].items():
        for flow, rows in flows.items():
            for method, row in rows.items():
                hit, chosen = (_share(row.get(key)) for key in ("hit", "chosen"))
                lines.append(
                    f"| {kind} | {flow} | {method} | {row['pairs']} | {hit} | {chosen} "
                    f"| {_share(row['failures'])} | {row['epe_px']['median']:.3g} "
                    f"| {row['ms']['median']:.1f} |"
                )
    return [*lines, ""]


def _nees(nees: dict[str, Any]) -> list[str]:
    lines = ["## Normalised error of the covariance (NEES, ideal mean 6)", ""]
    model = nees["model"]
    if model and model["mean"] is not None:
        first, last = model["seeds"]
        error = model["standard_error"]
        lines += [
            f"Model's own noise ({model['noise']}; {model['pairs']} pairs of "
            f"{model['shape'][1]}x{model['shape'][0]}, seeds {first}-{last}): mean "
            f"{model['mean']:.2f}{'' if error is None else f' +- {error:.2f} (standard error)'}, "
            f"median {model['median']:.2f} (ideal 5.35), within 3 sigma "
            f"{_share(model['contained'])} % (ideal 99.7), {model['not_estimated']} without an "
            "answer.",
            "",
        ]
    if nees["correlated noise"]:
        lines += [
            "Correlated noise (the cells: half of the depth noise's variance is correlated in "
            "space, 5-20 % of the flow is wrong):",
            "",
            "| cell | mean | median | within 3 sigma, % |",
            "|---|---|---|---|",
        ]
        for cell, row in nees["correlated noise"].items():
            values = ["" if row[k] is None else f"{row[k]:.3g}" for k in ("mean", "median")]
            lines.append(f"| {cell} | {' | '.join(values)} | {_share(row['contained'])} |")
        lines.append("")
    return lines


def _kernel(kernel: dict[str, Any]) -> list[str]:
    where = {"in_cache": "buffer of the same size", "beyond_cache": "buffer beyond the cache"}
    lines = [
        f"## One iteration over {kernel['pixels']} pixels ({kernel['bytes'] / 1e6:.1f} MB)",
        "",
        "| | median, ms | least, ms |",
        "|---|---|---|",
    ]
    for name, text in (
        ("shipped", f"{kernel['threads']} threads, as shipped"),
        ("serial", "serial"),
    ):
        row = kernel[name]
        lines.append(f"| {text} | {row['median_ms']:.2f} | {row['min_ms']:.2f} |")
    for key, text in where.items():
        limit, speed = kernel["limit_ms"][key], kernel["bytes"] / kernel["limit_ms"][key] / 1e6
        lines.append(f"| reading alone, {text}: {speed:.0f} GB/s | | {limit:.3f} |")
    lines += [
        "",
        "The limit is numpy's fastest of sum, sum on two threads, and copy, in this run; the "
        "shipped iteration takes "
        + " and ".join(f"{kernel['times_limit'][k]:.1f} times ({t})" for k, t in where.items())
        + " as long.",
        "",
    ]
    first = kernel["first_call"]
    if "error" in first:
        return [*lines, f"First call: not measured: {first['error']}", ""]
    return [
        *lines,
        f"First call, fresh process, kernels from the cache as it was: import "
        f"{first['import_s']:.2f} s, warm-up {first['warm_up_s']:.2f} s "
        f"(again: {first['again_s']:.2f} s).",
        "",
    ]


def _batch(batch: dict[str, Any]) -> list[str]:
    height, width = batch["shape"]
    lines = [
        f"## Batches: `refine_batch`, {width}x{height}, {batch['dtype']}, {batch['device']}, "
        f"{batch['torch_threads']} torch threads, {batch['repeats']} repeats ({batch['cell']})",
        "",
        "| pairs a batch | pairs/s (median) | best | EPE median, px | failures |",
        "|---|---|---|---|---|",
    ]
    for row in batch["rows"]:
        lines.append(
            f"| {row['batch']} | {row['pairs_per_s']:.3g} | {row['best_pairs_per_s']:.3g} "
            f"| {row['epe_px_median']:.3f} | {row['failures']} |"
        )
    return [*lines, ""]


def _network(network: dict[str, Any]) -> list[str]:
    height, width = network["shape"]
    options = network["options"]
    lines = [
        f"## Inference: {network['network']}, {width}x{height}, width {options['width']}, "
        f"{options['passes']} passes, {network['device']}, "
        f"{network['torch_threads']} torch threads",
        "",
        "| pairs a batch | precision | ms a pair (median) | best |",
        "|---|---|---|---|",
    ]
    for row in network["rows"]:
        lines.append(
            f"| {row['batch']} | {row['precision']} | {row['ms_per_pair']:.3g} "
            f"| {row['best_ms_per_pair']:.3g} |"
        )
    return [*lines, ""]


def _memory(memory: dict[str, Any]) -> list[str]:
    lines = [
        "## Extra memory of one call on 1024x436, MiB",
        "",
        "| method | Python's and numpy's allocators | resident set |",
        "|---|---|---|",
    ]
    for method, traced in memory["traced_peak_mib"].items():
        grown = memory["resident_peak_mib"].get(method)
        lines.append(f"| {method} | {traced:.1f} | {'' if grown is None else f'{grown:.1f}'} |")
    return [*lines, ""]


def _share(row: dict[str, Any] | None) -> str:
    if row is None or row["share"] is None:
        return ""
    return f"{100 * row['share']:.1f} [{100 * row['low']:.0f}-{100 * row['high']:.0f}]"


def _table(cells: list[str], methods: list[str], entry: Callable[[str, str], str]) -> list[str]:
    rows = ["| method | " + " | ".join(cells) + " |", "|---|" + "---|" * len(cells)]
    return rows + [f"| {m} | " + " | ".join(entry(c, m) for c in cells) + " |" for m in methods]


def _error_cell(row: dict[str, Any]) -> str:
    failures = f" [{row['failures']}]" if row["failures"] else ""
    return f"{_spread(row['epe_px'], 3)}{failures}"


def _containment_cell(row: dict[str, Any]) -> str:
    nees = "" if row["nees_mean"] is None else f" ({row['nees_mean']:.3g})"
    return f"{100 * row['contained'] / row['pairs']:.0f}{nees}"


def _spread(row: dict[str, float], digits: int) -> str:
    return f"{row['median']:.{digits}f} ({row['q25']:.{digits}f}-{row['q75']:.{digits}f})"
