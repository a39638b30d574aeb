"""The README's tables, from the JSON files that the tools wrote.

    python tools/make_readme_tables.py            # fill README.md
    python tools/make_readme_tables.py --check    # exit code 1 if README.md is not up to date

Fills what stands between ``<!-- table:NAME -->`` and ``<!-- end:NAME -->`` from
``docs/results/NAME.json``; where there is no such file, nothing stands between them.
"""

from __future__ import annotations

import argparse
import itertools
import json
import re
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[1]
RESULTS = ROOT / "docs" / "results"
PART = re.compile(r"(<!-- table:(\w+) -->\n)(.*?)(<!-- end:\2 -->)", re.DOTALL)

MID_CELL = "moving30"
FAILURE_NOTE = "[n]: pairs that are wrong by more than a pixel, or without an answer"


def build_parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="make_readme_tables.py", description=(__doc__ or "").splitlines()[0]
    )
    parser.add_argument("--readme", type=Path, default=ROOT / "README.md")
    parser.add_argument("--results", type=Path, default=RESULTS, help="folder of the JSON files")
    parser.add_argument("--check", action="store_true", help="write nothing, only compare")
    return parser


def main(argv: list[str] | None = None) -> int:
    args = build_parser().parse_args(argv)
    try:
        before = args.readme.read_text(encoding="utf-8")
        after = fill(before, args.results)
    except (OSError, ValueError) as error:
        print(f"make_readme_tables.py: {error}", file=sys.stderr)
        return 2
    if args.check:
        if after != before:
            print(f"{args.readme}: tables differ from {args.results}", file=sys.stderr)
        return int(after != before)
    if after != before:
        try:
            args.readme.write_text(after, encoding="utf-8")
        except OSError as error:
            print(f"make_readme_tables.py: {args.readme}: {error}", file=sys.stderr)
            return 5
    print(args.readme)
    return 0


def fill(text: str, results: Path) -> str:
    """The text with every marked part made anew."""

    def part(match: re.Match[str]) -> str:
        name = match.group(2)
        if name not in TABLES:
            raise ValueError(f"table:{name} is unknown; known: {', '.join(TABLES)}.")
        path = results / f"{name}.json"
        if not path.is_file():
            return match.group(1) + match.group(4)
        try:
            content = json.loads(path.read_text(encoding="utf-8"))
            lines = TABLES[name](content)
        except (KeyError, TypeError, json.JSONDecodeError) as error:
            raise ValueError(f"{path}: not as its tool writes it: {error!r}.") from error
        return match.group(1) + "\n".join(["", *lines, "", ""]) + match.group(4)

    return PART.sub(part, text)


def number(value: float | None, digits: int = 3) -> str:
    """Three significant digits, and never an exponent for what is readable without one."""
    if value is None:
        return "-"
    if value == 0 or abs(value) < 1e-4:
        return f"{value:.{digits - 1}g}"
    text = f"{value:.{digits}g}"
    return f"{value:.0f}" if "e" in text else text


def table(header: list[str], rows: list[list[str]]) -> list[str]:
    """Markdown table; the first columns hold text, the others numbers."""
    lines = ["| " + " | ".join(header) + " |"]
    is_text = [all(not re.match(r"-?\d", row[i]) for row in rows) for i in range(len(header))]
    lines.append("|" + "|".join("---" if text else "---:" for text in is_text) + "|")
    return lines + ["| " + " | ".join(row) + " |" for row in rows]


def demo_table(content: dict[str, Any]) -> list[str]:
    """What ``hybridvo demo`` prints, up to the widths of its columns."""
    scene = content["scene"]
    header = ["method", "ATE [cm]*", "RPE [cm/pair]", "rotation [deg/pair]", "EPE [px]"]
    header += ["failed", "ms/pair"]
    rows = [
        [
            row["method"],
            *(f"{row['ate_cm']:.3f}", f"{row['rpe_cm']:.3f}", f"{row['rotation_deg']:.4f}"),
            *(f"{row['epe_px']:.3f}", f"{row['failed']}", f"{row['ms']:.1f}"),
        ]
        for row in content["rows"]
    ]
    widths = [max(len(line[i]) for line in [header, *rows]) for i in range(len(header))]

    def line(cells: list[str]) -> str:
        first = cells[0].ljust(widths[0])
        return "  ".join([first, *(c.rjust(w) for c, w in zip(cells[1:], widths[1:], strict=True))])

    return [
        "```text",
        f"{scene['frames']} rendered frames of {scene['width']}x{scene['height']}, "
        f"{100 * content['moving_fraction']:.0f} % of the pixels moving; flow: OpenCV DIS on the "
        "images; depth: the renderer's (true).",
        "",
        line(header),
        line(["-" * width for width in widths]),
        *(line(row) for row in rows),
        "* paths put on each other by their first pose: a path that stands still has no other fit.",
        "",
        str(content["picture"]),
        "```",
    ]


def real_samples_table(content: dict[str, Any]) -> list[str]:
    """Medians over the pairs of each real sequence, and the error at its end."""
    keys = ("rot_err_deg_median", "trans_err_cm_median", "epe_l2_px_median")
    keys += ("end_rot_err_deg", "end_trans_err_cm", "ms_median")
    header = ["sequence", "flow", "method", "rotation, deg", "translation, cm", "EPE, px"]
    header += ["end, deg", "end, cm", "ms"]
    rows = [
        [row["sequence"], row["flow_source"], f"`{row['method']}`", *(number(row[k]) for k in keys)]
        for row in content["rows"]
    ]
    # a sequence and its flow are named once
    for above, row in reversed(list(itertools.pairwise(rows))):
        if row[0] == above[0]:
            row[1] = "" if row[1] == above[1] else row[1]
            row[0] = ""
    return [
        *table(header, rows),
        "",
        f"`{content['command']}`; {content['machine']}; hybridvo "
        f"{content['versions']['hybridvo']}, OpenCV "
        f"{content['versions']['opencv-python-headless']}.",
    ]


def rendered_table(content: dict[str, Any]) -> list[str]:
    """Mean end-point error of each method on each rendered sequence."""
    rows = content["rows"]
    sequences = list(dict.fromkeys(row["sequence"] for row in rows))
    methods = list(dict.fromkeys(row["method"] for row in rows))
    errors = {(row["sequence"], row["method"]): row["epe_l2_px"] for row in rows}
    lines = [
        [f"`{method}`", *(number(errors[name, method]) for name in sequences)] for method in methods
    ]
    flow = ", ".join(sorted({row["flow_source"] for row in rows}))
    depth = ", ".join(sorted({row["depth_source"] for row in rows}))
    chosen = content["command"][content["command"].index("--methods") + 1]
    return [
        *table(["method", *sequences], lines),
        "",
        f"Mean error of the ego flow, px; flow: {flow}, depth: {depth}. "
        f"`tools/compare_methods.py --methods {chosen} --flow dis`, one `--sequence` a column; "
        f"hybridvo {content['versions']['hybridvo']}.",
    ]


def benchmark_table(content: dict[str, Any]) -> list[str]:
    """Error of every method on the cells over which methods are compared, and the time."""
    summary, cells = content["summary"], content["ratios"]["cells"]
    cells = cells or list(summary)
    methods = list(summary[cells[0]])

    def error(cell: str, method: str) -> str:
        row = summary[cell][method]
        failures = f" [{row['failures']}]" if row["failures"] else ""
        return number(row["epe_px"]["median"]) + failures

    timed = MID_CELL if MID_CELL in summary else cells[0]
    rows = [
        [
            f"`{method}`",
            *(error(cell, method) for cell in cells),
            number(summary[timed][method]["ms"]["median"]),
        ]
        for method in methods
    ]
    first, last = content["seeds"]
    load = content["machine"].get("load_average")
    loaded = "" if load is None else f", load {load[0]:.1f}"
    lines = [
        *table(["method", *cells, f"ms ({timed})"], rows),
        "",
        f"Median error of the ego flow in px over {last - first + 1} pairs a cell (seeds {first} "
        f"to {last}); {FAILURE_NOTE}. `{' '.join(content['command'])}`; "
        f"{content['machine']['processor']}, {content['machine']['cores']} cores{loaded}.",
    ]
    over = content["ratios"]["refine_over"]
    if over:
        ratios = [[f"`{m}`", number(row["error"]), number(row["time"])] for m, row in over.items()]
        lines += [
            "",
            "`refine` over each other method (below 1 is better): error as geometric mean over the "
            f"cells, time in {timed}.",
            "",
            *table(["against", "error", "time"], ratios),
        ]
    return lines


TABLES: dict[str, Callable[[dict[str, Any]], list[str]]] = {
    "demo": demo_table,
    "real_samples": real_samples_table,
    "rendered": rendered_table,
    "benchmark": benchmark_table,
}


if __name__ == "__main__":
    sys.exit(main())
