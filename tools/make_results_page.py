"""The page of results, from the JSON files that the tools wrote.

    python tools/make_results_page.py            # write docs/results.md
    python tools/make_results_page.py --check    # exit code 1 if it is not up to date

Parts whose JSON is not there are left out; the tables of MPI Sintel stay, empty, with the command
that fills them, because the data set may not be passed on.
"""

from __future__ import annotations

import argparse
import importlib.util
import json
import sys
from collections.abc import Callable, Mapping
from pathlib import Path
from types import ModuleType
from typing import Any

ROOT = Path(__file__).resolve().parents[1]
RESULTS = ROOT / "docs" / "results"
PAGE = ROOT / "docs" / "results.md"
PROTOCOLS = ("paper", "trajectory14")
NETWORKS = ("hybrid", "hybrid-flow", "pwvo", "pwvo-naive", "pixelwise", "vonet", "vonet-attention")
CLASSICAL = ("refine", "pnp-ransac", "pnp-ransac-tuned", "usac-magsac", "poselib", "identity")

Part = Callable[[Mapping[str, Any]], list[str]]


def build_parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="make_results_page.py", description=(__doc__ or "").splitlines()[0]
    )
    parser.add_argument("--results", type=Path, default=RESULTS, help="folder of the JSON files")
    parser.add_argument("--page", type=Path, default=PAGE)
    parser.add_argument("--check", action="store_true", help="write nothing, only compare")
    return parser


def main(argv: list[str] | None = None) -> int:
    args = build_parser().parse_args(argv)
    try:
        made = page(args.results)
        before = args.page.read_text(encoding="utf-8") if args.page.is_file() else ""
    except (OSError, ValueError) as error:
        print(f"make_results_page.py: {error}", file=sys.stderr)
        return 2
    if args.check:
        if made != before:
            print(f"{args.page}: differs from {args.results}", file=sys.stderr)
        return int(made != before)
    try:
        args.page.write_text(made, encoding="utf-8")
    except OSError as error:
        print(f"make_results_page.py: {args.page}: {error}", file=sys.stderr)
        return 5
    print(args.page)
    return 0


def sibling(name: str) -> ModuleType:
    """A tool beside this one: a table is written once."""
    path = Path(__file__).with_name(f"{name}.py")
    spec = importlib.util.spec_from_file_location(name, path)
    if spec is None or spec.loader is None:
        raise ValueError(f"{path}: cannot be read as a module.")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def page(results: Path) -> str:
    """The whole page.

    Raises:
        ValueError: a JSON file is not as its tool writes it.
    """
    lines = [
        "# Results",
        "",
        "Made by `python tools/make_results_page.py` from the JSON files in `docs/results`; each "
        "part names its file. What is an oracle (true flow, true depth) is named so. A dash stands "
        "where nothing was, or could be, measured.",
        "",
    ]
    for name, part in PARTS.items():
        content = _read(results / f"{name}.json")
        if content is not None:
            lines += _part(results / f"{name}.json", part, content)
    lines += [
        "## MPI Sintel",
        "",
        "The data set is not part of this repository. With a folder as it was unpacked, every "
        "table below is filled by the command above it; published figures are what their authors "
        "wrote, and none of them was measured here.",
        "",
    ]
    for name in PROTOCOLS:
        path = results / f"sintel_{name}.json"
        content = _read(path)
        lines += _part(path, lambda found, name=name: sintel(name, found or None), content or {})
    return "\n".join(lines).rstrip() + "\n"


def _read(path: Path) -> dict[str, Any] | None:
    if not path.is_file():
        return None
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
    except json.JSONDecodeError as error:
        raise ValueError(f"{path}: no JSON: {error}.") from error
    if not isinstance(content, dict):
        raise ValueError(f"{path}: expected a JSON object.")
    return content


def _part(path: Path, part: Part, content: Mapping[str, Any]) -> list[str]:
    try:
        lines = part(content)
    except (KeyError, TypeError, AttributeError, IndexError) as error:
        raise ValueError(f"{path}: not as its tool writes it: {error!r}.") from error
    return [f"<!-- from {path.name} -->", *lines, "<!-- end -->", ""]


def benchmark(content: Mapping[str, Any]) -> list[str]:
    made = sibling("make_readme_tables")
    lines = [
        "## Synthetic pairs",
        "",
        "Exact pairs with noise and movers, a cell per condition; every table, with consistency, "
        "costs and memory, is in [results/benchmark.md](results/benchmark.md).",
        "",
        "![Error of every method in every cell, and time](results/benchmark.png)",
        "",
        *made.benchmark_table(content),
        "",
    ]
    if content.get("goals"):
        lines += ["### Goals", "", *_goals(content["goals"], made), ""]
    return lines


def _goals(rows: list[Mapping[str, Any]], made: ModuleType) -> list[str]:
    """What was asked for beside what was reached."""
    answers = {"yes": "yes", "no": "no", "least": "no, the least demand is"}
    cells = []
    for row in rows:
        bound = "≥" if row["at_least"] else "≤"
        least = "-" if row["least"] is None else f"{bound} {row['least']:.3g}"
        met = answers.get(
            str(row["met"]), "not measured" if row["met"] is None else str(row["met"])
        )
        name = f"{row['name']}, {row['unit']}"
        goal = f"{bound} {row['goal']:.3g}"
        cells.append([name, goal, least, made.number(row["measured"]), met, row["note"] or ""])
    header = ["what", "goal", "least demand", "measured", "met", "over"]
    lines = ["| " + " | ".join(header) + " |", "|---|---:|---:|---:|---|---|"]
    return lines + ["| " + " | ".join(row) + " |" for row in cells]


def rendered(content: Mapping[str, Any]) -> list[str]:
    return [
        "## Rendered sequences",
        "",
        "Scenes of `tools/generate_dataset.py`. In the heavy ones objects cover more than half of "
        "the picture.",
        "",
        *sibling("make_readme_tables").rendered_table(content),
        "",
    ]


def real_samples(content: Mapping[str, Any]) -> list[str]:
    return [
        "## Real sequences",
        "",
        "Medians over the pairs; *end* is the error of the chained motions at the last frame. "
        "`file (true)` is ground-truth flow.",
        "",
        *sibling("make_readme_tables").real_samples_table(content),
        "",
    ]


def ablation(content: Mapping[str, Any]) -> list[str]:
    """The page of `tools/ablation.py`, its headings a level lower."""
    text = sibling("ablation_report").markdown(content)
    lines = [f"#{line}" if line.startswith("#") else line for line in text.rstrip().splitlines()]
    return [*lines, ""]


def sintel(name: str, content: Mapping[str, Any] | None) -> list[str]:
    """Table of one protocol, empty where nothing was measured yet."""
    from hybridvo.evaluation.protocols import protocols

    number = sibling("make_readme_tables").number
    protocol = protocols()[name]
    measured = None if content is None else content["protocol"]
    labels = [f"{m['label']}, {m['unit']}" for m in protocol.metrics]
    keys = [m["key"] for m in protocol.metrics]
    title = protocol.title[0].upper() + protocol.title[1:]
    lines = [
        f"### {title}",
        "",
        f"{protocol.pairs} pairs of {len(protocol.sequences)} sequences.",
        "",
        "```sh",
        f"python tools/compare_methods.py --sequence path/to/MPI-Sintel-complete --protocol {name} "
        f"--out runs/sintel_{name}",
        f"cp runs/sintel_{name}/results.json docs/results/sintel_{name}.json",
        "python tools/make_results_page.py",
        "```",
        "",
    ]
    if measured is not None and measured["note"]:
        lines += [f"**Not the complete set:** {measured['note']}.", ""]
    if measured is None:
        rows = [[f"`{m}`", *("-" for _ in ("flow", "pairs", *keys))] for m in NETWORKS + CLASSICAL]
    else:
        rows = [
            [
                f"`{row['method']}`",
                str(row["flow_source"]),
                str(row["pairs"]),
                *(number(row[key]) for key in keys),
            ]
            for row in measured["table"]
        ]
    lines += [_line(["measured here", "flow", "pairs", *labels])]
    lines += ["|---|---|" + "---:|" * (1 + len(keys)), *map(_line, rows), ""]
    given = [m for m in protocol.metrics if any(m["key"] in p for p in protocol.published)]
    lines += [
        _line(["published", *(f"{m['label']}, {m['unit']}" for m in given), "source", "note"])
    ]
    lines += ["|---|" + "---:|" * len(given) + "---|---|"]
    for published in protocol.published:
        values = [number(published.get(m["key"])) for m in given]
        note = "; ".join(filter(None, (published["inputs"], published["note"])))
        lines.append(_line([published["name"], *values, published["source"], note]))
    return [*lines, ""]


def _line(cells: list[str]) -> str:
    return "| " + " | ".join(cells) + " |"


PARTS: dict[str, Part] = {
    "benchmark": benchmark,
    "rendered": rendered,
    "real_samples": real_samples,
    "ablation": ablation,
}
"""Name of the JSON file -> its part, in the order of the page."""


if __name__ == "__main__":
    sys.exit(main())
