"""The tables of the README, of docs/paper.md and of docs/results.md, from docs/results.

    python tools/make_docs.py            # fill README.md and docs/paper.md, write docs/results.md
    python tools/make_docs.py --check    # exit code 1 if they are not up to date

In the first two, what stands between ``<!-- table:NAME -->`` and ``<!-- end:NAME -->`` is made
here.
"""

from __future__ import annotations

import argparse
import json
import re
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import paper_tables
from markdown_table import number, table
from measuring import ROOT, parser_of

PART = re.compile(r"(<!-- table:(\w+) -->\n)(.*?)(<!-- end:\2 -->)", re.DOTALL)
FAILURES = "[n]: pairs that are wrong by more than a pixel, or without an answer"

Results = dict[str, dict[str, Any]]


def build_parser() -> argparse.ArgumentParser:
    parser = parser_of(__file__, __doc__)
    parser.add_argument("--check", action="store_true", help="write nothing, only compare")
    return parser


def main(argv: list[str] | None = None) -> int:
    args = build_parser().parse_args(argv)
    docs = ROOT / "docs"
    results = read(docs / "results")
    texts = {docs / "results.md": page(results)}
    for path in (ROOT / "README.md", docs / "paper.md"):
        texts[path] = fill(path.read_text(encoding="utf-8"), results)
    stale = [path for path, text in texts.items() if path.read_text(encoding="utf-8") != text]
    for path in stale:
        print(f"{path}: not up to date" if args.check else path)
        if not args.check:
            path.write_text(texts[path], encoding="utf-8")
    return int(args.check and bool(stale))


def read(folder: Path) -> Results:
    """Every JSON file of the folder by its stem."""
    return {
        path.stem: json.loads(path.read_text(encoding="utf-8"))
        for path in sorted(folder.glob("*.json"))
    }


def fill(text: str, results: Results) -> str:
    """The text with every marked part made anew; empty where its figures are missing."""

    def part(match: re.Match[str]) -> str:
        lines = lines_of(match.group(2), results)
        return match.group(1) + ("\n" + "\n".join(lines) + "\n\n" if lines else "") + match.group(4)

    return PART.sub(part, text)


def page(results: Results) -> str:
    """docs/results.md: a title and a table for each kind of measurement."""
    lines = [
        "# Results",
        "",
        "Made by `python tools/make_docs.py` from the JSON files in `docs/results`. Ground truth "
        "that a method is given (true flow, true depth, a true mask) is named: an oracle. "
        f"{FAILURES}. Times are wall times on a shared machine.",
        "",
    ]
    for title, *names in PAGE:
        tables = [made for name in names if (made := lines_of(name, results))]
        if tables:
            lines += [f"## {title}", ""]
        for made in tables:
            lines += [*made, ""]
    return "\n".join(lines).rstrip() + "\n"


def error(row: dict[str, Any]) -> str:
    """Median error in px, with the number of failures."""
    count = row["failures"]["count"]
    return number(row["epe_px"]["median"]) + (f" [{count}]" if count else "")


def failed(row: dict[str, Any]) -> str:
    return f"{100 * row['failures']['count'] / row['pairs']:.0f} %"


def source(content: dict[str, Any]) -> str:
    """Where figures come from; times of a loaded machine are to be read as ratios."""
    machine = content["machine"]
    load = machine["load"][0] if machine["load"] else 0.0
    return (
        f"`{content['command']}`, commit `{content['commit']}`; {machine['processor']}, "
        f"{machine['cores']} cores, load {load:.1f}."
    )


def heavy(part: dict[str, Any]) -> list[str]:
    """Scenes in which most of the image moves: median error in px, and failures."""
    kinds = [kind for kind in part["summary"] if kind != "total"]
    rows = []
    for flow in ("dis", "true"):
        total = part["summary"]["total"][flow]
        for method, row in total.items():
            cells = [error(part["summary"][kind][flow][method]) for kind in kinds]
            rows.append([f"`{method}`, {flow} flow", *cells, failed(row), number(row["ms"])])
    height, width = part["size"]
    return [
        *table(["method", *kinds, "failures", "ms"], rows),
        "",
        f"Median error of the ego flow, px; seeds {part['seeds'][0]} to {part['seeds'][1]} of each "
        f"kind, {width}x{height}, depth {part['depth']}. True flow is an oracle. {source(part)}",
    ]


def peers(part: dict[str, Any]) -> list[str]:
    """The README's one table: every method on estimated flow."""
    total = part["summary"]["total"]["dis"]
    rows = []
    for method, row in total.items():
        errors = (row["epe_px"]["median"], row["translation_cm"], row["rotation_deg"])
        if "oracle" not in method:
            cells = [*map(number, errors), failed(row), number(row["ms"])]
            rows.append([f"`{method}`", *cells])
    pairs = next(iter(total.values()))["pairs"]
    return [
        *table(["method", "error, px", "cm", "deg", "wrong by more than 1 px", "ms a pair"], rows),
        "",
        f"Medians over {pairs} pairs of rendered scenes in which most of the image moves; flow: "
        f"OpenCV DIS, depth {part['depth']}; flow not in the time. {source(part)}",
    ]


def scenarios(part: dict[str, Any]) -> list[str]:
    """Pairs with known noise: median error in px of every method in every scenario."""
    names = list(part["summary"])
    methods = list(part["summary"][names[0]])
    rows = [[name, *(error(part["summary"][name][method]) for method in methods)] for name in names]
    means = [number(part["geometric_mean_px"][method]) for method in methods]
    rows.append([f"geometric mean of the first {len(part['main'])}", *means])
    return [
        *table(["scenario", *(f"`{method}`" for method in methods)], rows),
        "",
        f"Median error of the ego flow, px; seeds {part['seeds'][0]} to {part['seeds'][1]}. "
        f"{source(part)}",
    ]


def model_noise(part: dict[str, Any]) -> list[str]:
    """The covariance under the noise that the refinement assumes."""
    row = part["refine"]
    return [
        f"Covariance of `refine` under the noise that it assumes: mean normalised error "
        f"{row['nees_mean']:.2f} +- {row['nees_standard_error']:.2f} over {row['pairs']} pairs "
        f"(right: 6), {row['overconfident']} outside of 3 sigma (right: 0.3 %).",
    ]


def real(part: dict[str, Any]) -> list[str]:
    """Recorded sequences: medians over the pairs, and the error at the end of the chain."""
    rows = []
    for name, sequence in part["summary"].items():
        for flow, by_method in sequence["flows"].items():
            for k, (method, row) in enumerate(by_method.items()):
                first = f"{name}, {flow}" if k == 0 else ""
                keys = ("rotation_deg", "translation_cm")
                ends = ("end_rotation_deg", "end_translation_cm", "ms")
                values = [*(number(row[key]) for key in keys), error(row)]
                values += [number(row[key]) for key in ends]
                rows.append([first, f"`{method}`", *values])
    header = ["sequence, flow", "method", "deg", "cm", "px", "end, deg", "end, cm", "ms"]
    return [*table(header, rows), "", f"Medians over the pairs. {source(part)}"]


def sequences(content: dict[str, Any]) -> list[str]:
    """Paths of whole rendered sequences, and how often the stated probability comes true."""
    kinds = content["kinds"]
    rows = []
    for flow, by_method in content["paths"].items():
        for method, by_kind in by_method.items():
            cells = [number(by_kind[kind]["rmse_cm"]) for kind in kinds]
            pairs = content["pairs"][flow][method]
            count = f"{pairs['failures']['count']} of {pairs['pairs']}"
            rows.append([f"`{method}`, {flow} flow", *cells, count, number(pairs["nees_median"])])
    lines = [
        *table(["method", *kinds, "failed pairs", "median NEES"], rows),
        "",
        f"Root mean square error of the position, cm, both paths from the same first pose; "
        f"{content['frames']} frames a sequence, depth {content['depth']}; the NEES of a right "
        f"covariance has the median 5.35. {source(content)}",
    ]
    stated = content["probability"]["dis"].get("hybrid")
    if stated:
        bins = "; ".join(
            f"{row['from']:g} to {row['to']:g}: {row['count']} of {row['of']}"
            for row in stated["bins"]
        )
        lines += [
            "",
            f"Probability that `hybrid` states, DIS flow, and how many of these motions are right "
            f"within a pixel: {bins}. Flagged: {stated['failures_flagged']} of "
            f"{stated['failures']} failures, and {stated['right_flagged']} right motions.",
        ]
    return lines


def semi_real(content: dict[str, Any]) -> list[str]:
    """Real surfaces: wrong choices, and whether the stated probability tells them."""
    shares = ("wrong", "wrong_world_majority", "wrong_ok", "right_not_ok", "right_not_ok_static")
    rows = [
        [f"`{name}`", *(f"{row[k]['count']} of {row[k]['of']}" for k in shares)]
        + [number(row[k]) for k in ("auroc", "ece", "median_px_right")]
        for name, row in content["summary"].items()
    ]
    header = ["wrong", "world in the majority", "wrong but ok", "right, not ok", "static, not ok"]
    names = ["method", *header, "AUROC", "calibration error", "median px"]
    return [
        *table(names, rows),
        "",
        f"Recordings of the {content['split']} part. {source(content)}",
    ]


def costs(part: dict[str, Any]) -> list[str]:
    """Wall time of a pair and of a whole frame, memory, batches."""
    sizes = list(part["pair_ms"])
    rows = [
        [f"`{method}`", *(number(part[key][size][method]) for key in ("pair_ms", "frame_ms")
         for size in sizes), number(part["memory_mib"][method])]
        for method in part["pair_ms"][sizes[0]]
    ]  # fmt: skip
    header = [f"pair, {size}" for size in sizes] + [f"frame, {size}" for size in sizes]
    first = part["first_call"]
    batch = ", ".join(f"{row['pairs']}: {row['pairs_per_s']:g}/s" for row in part["batch"])
    return [
        *table(["method", *header, "MiB"], rows),
        "",
        "Tracked frames of static recordings, "
        + "; ".join(
            f"{name.rpartition('/')[2]}: "
            + ", ".join(f"{what} {number(ms)} ms" for what, ms in row.items())
            for name, row in part.get("recorded_frame_ms", {}).items()
        )
        + ".",
        "",
        "Milliseconds of an estimate with the flow given, and of a tracked frame with its flow "
        f"(OpenCV DIS). MiB: most that one estimate allocates at {sizes[-1]}. Import and first "
        f"call: {number(first.get('import_s'))} s and {number(first.get('warm_up_s'))} s. Batched "
        f"refinement of 256x128 on the CPU, pairs a batch: {batch}. {source(part)}",
    ]


def speed(part: dict[str, Any]) -> list[str]:
    """Frames a second of a whole tracked frame, its flow included."""
    rows = [
        [f"`{method}`", number(1e3 / ms), number(ms)]
        for method, ms in part["frame_ms"]["640x480"].items()
    ]
    return [
        *table(["method", "frames a second", "ms a frame"], rows),
        "",
        f"640x480, OpenCV DIS flow included, one process. {source(part)}",
    ]


def demo(content: dict[str, Any]) -> list[str]:
    """What ``hybridvo demo`` measures."""
    keys = ("ate_cm", "rotation_deg", "epe_px")
    rows = [[row["method"], *(number(row[key]) for key in keys)] for row in content["rows"]]
    scene = content["scene"]
    return [
        *table(["method", "ATE, cm", "rotation, deg a pair", "EPE, px"], rows),
        "",
        f"{scene['frames']} rendered frames of {scene['width']}x{scene['height']}, "
        f"{100 * content['moving_fraction']:.0f} % of the pixels move; flow: OpenCV DIS; "
        "depth: the renderer's (an oracle).",
    ]


def lines_of(name: str, results: Results) -> list[str]:
    """Lines of a table; none where its figures are missing."""
    if name in paper_tables.TABLES:
        return paper_tables.TABLES[name](results)
    if name in ALONE:
        return ALONE[name](results[name]) if name in results else []
    key, make = TABLES[name]
    content = results.get("benchmark", {})
    return make(content[key]) if key in content else []


TABLES: dict[str, tuple[str, Callable[[dict[str, Any]], list[str]]]] = {
    "demo": ("demo", demo),
    "speed": ("costs", speed),
    "peers": ("heavy", peers),
    "heavy": ("heavy", heavy),
    "scenarios": ("scenarios", scenarios),
    "model_noise": ("model_noise", model_noise),
    "real": ("real", real),
    "costs": ("costs", costs),
}
"""Tables by name: the part of docs/results/benchmark.json, and what makes lines of it."""
ALONE = {"sequences": sequences, "semi_real": semi_real}
"""Tables of a JSON file of their own."""
PAGE = (
    ("Most of the image moves", "heavy"),
    ("Real surfaces with movers", "semi_real"),
    ("Known noise", "scenarios", "model_noise"),
    ("Recorded sequences", "real"),
    ("Whole sequences", "sequences"),
    ("Time and memory", "costs"),
)


if __name__ == "__main__":
    sys.exit(main())
