"""The tables of the README, of the pages FILLED and of docs/results.md, from docs/results.

    python tools/make_docs.py            # fill all but the last, write docs/results.md
    python tools/make_docs.py --check    # exit code 1 if they are not up to date

In all but the last, the text between ``<!-- table:NAME -->`` and ``<!-- end:NAME -->``
is that of the macro NAME in tools/templates/tables.md.
"""

from __future__ import annotations

import json
import re
import sys
from functools import reduce
from pathlib import Path
from typing import Any, NamedTuple

import jinja2
import numpy as np
from matplotlib.figure import Figure
from measuring import ROOT, parser_of
from paper import ROWS

from hybridvo.core.calibration import MIN_PROBABILITY
from hybridvo_lab.evaluation.protocols import protocols
from hybridvo_lab.evaluation.report import number

PART = re.compile(r"(<!-- table:([\w ]+) -->\n)(.*?)(<!-- end:\2 -->)", re.DOTALL)
"""A part of a page that is filled: its first line, name, content and last line."""
PAGE = {
    "Most of the image moves": ("demo", "heavy", "pwvo_parts"),
    "Real surfaces with moving objects": (
        "sure_when_wrong",
        "two_recordings",
        "semi_real",
    ),
    "Known noise": ("scenarios", "model_noise"),
    "Recorded sequences": ("real", "wide_steps", "tracked_peers", "slam_static"),
    "Whole sequences": ("sequences", "memory", "video_rate", "lost"),
    "Time and memory": ("costs", "recorded"),
    "How these figures were made": ("measured",),
}
"""Titles of docs/results.md and their tables."""
FILLED = (
    "install.md",
    "model-card.md",
    "how-it-works.md",
    "paper.md",
    "scale.md",
    "moving-people.md",
    "uncertainty.md",
    "library.md",
    "live.md",
    "instead-of-a-t265.md",
    "own-data.md",
)
"""Pages with marked parts."""
INTRODUCTION = """# Results

All measured figures, for readers who want to check a claim of the other pages. An input from the \
ground truth (true flow, true depth, a true mask) is called an oracle. [n]: pairs that are wrong \
by more than a pixel, or without an answer. Times are wall times on a shared machine. The \
[glossary](glossary.md) explains the words, [methods](methods.md) the names.
"""
RELIABILITY_COLOURS = {"hybrid-flow": "#D55E00", "hybrid": "#0072B2"}
"""Methods of the figure and their colours (Okabe and Ito)."""

Results = dict[str, dict[str, Any]]
"""The JSON files by the stem of their name."""


def main(argv: list[str] | None = None) -> int:
    parser = parser_of(__file__, __doc__)
    parser.add_argument(
        "--check", action="store_true", help="write nothing, only compare"
    )
    args = parser.parse_args(argv)
    docs = ROOT / "docs"
    results = read(docs / "results")
    texts = {docs / "results.md": page(results)}
    for path in (ROOT / "README.md", *(docs / name for name in FILLED)):
        texts[path] = fill(path.read_text(encoding="utf-8"), results)

    stale = []
    for path, text in texts.items():
        if path.read_text(encoding="utf-8") != text:
            stale.append(path)
    if args.check:
        for path in stale:
            print(f"{path}: not up to date")
        return int(bool(stale))
    for path in stale:
        print(path)
        path.write_text(texts[path], encoding="utf-8")
    figure = docs / "figures" / "reliability.png"
    draw_reliability(results["semi_real"]["summary"], figure)
    return 0


def read(folder: Path) -> Results:
    """Every JSON file of the folder by its stem."""
    return {
        path.stem: json.loads(path.read_text(encoding="utf-8"))
        for path in sorted(folder.glob("*.json"))
    }


def draw_reliability(summary: dict[str, Any], path: Path) -> None:
    """Stated probability against the fraction of right answers.

    Areas grow with their number.
    """
    axes = Figure(figsize=(4.2, 4.2), layout="constrained").subplots()
    axes.plot([0, 1], [0, 1], color="#222222", linewidth=0.8)
    for name, colour in RELIABILITY_COLOURS.items():
        bins = summary[name]["reliability"]
        stated = [row["stated"] for row in bins]
        right = [row["right"] for row in bins]
        area = 8 * np.array([row["count"] for row in bins])
        axes.scatter(stated, right, area, colour, alpha=0.6, label=name)
    axes.set(xlabel="stated probability", ylabel="fraction of right answers")
    axes.legend(markerscale=0.3)
    axes.figure.savefig(path, dpi=120)


# --- pages ------------------------------------------------------------------------


def fill(text: str, results: Results) -> str:
    """The text with every marked part written again."""
    made = tables(results)
    return PART.sub(lambda m: f"{m[1]}\n{table(made, m[2])}\n\n{m[4]}", text)


def page(results: Results) -> str:
    """docs/results.md: a title and tables for each kind of measurement."""
    made = tables(results)
    parts = [INTRODUCTION.strip()]
    for title, names in PAGE.items():
        parts.append(f"## {title}")
        texts = [table(made, name) for name in names]
        # a table whose figures were not measured yet is empty
        parts += [text for text in texts if text]
    return "\n\n".join(parts) + "\n"


def table(made: Any, name: str) -> str:
    """Text of one table: the name of its macro and, behind it,
    the files that it is of.
    """
    macro, *files = name.split()
    text = getattr(made, macro)(*files)
    text = re.sub(r" +\n", "\n", text)
    return re.sub(r"\n{3,}", "\n\n", text).strip()


def tables(results: Results) -> Any:
    """The macros of the template, with the figures that they show."""
    environment = jinja2.Environment(
        loader=jinja2.FileSystemLoader(Path(__file__).parent / "templates"),
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
    )
    paper = PaperFigures(results)
    environment.filters |= {
        "number": number,
        "error": error,
        "provenance": provenance,
        "best": best,
        "seeds": lambda rows, row: len(paper.curves(rows, row)),
        "sureness": sureness,
    }
    published = {line["method"]: line for line in protocols()["paper"].published}
    names = {
        "results": results,
        "at": paper.at,
        "zero": paper.zero,
        "rows": ROWS,
        "confidence": MIN_PROBABILITY,
        "published": published,
    }
    return environment.get_template("tables.md").make_module(names)


# --- figures ----------------------------------------------------------------------


class PaperFigures(NamedTuple):
    """Figures of the rows that ``tools/ablation.py`` trained."""

    results: Results

    def curves(self, rows: str, row: str) -> list[Any]:
        """Scores of the finished seeds of a row, by the number of samples."""
        content = self.results[rows]
        every = [run["curve"] for run in content["runs"] if run["row"] == row]
        return [curve for curve in every if str(content["samples"]) in curve]

    def at(
        self, rows: str, row: str, *keys: str, samples: int | None = None
    ) -> str:
        """Mean of a figure over the seeds, with its standard deviation.

        ``samples``: after so many samples; None: after all of them.
        """
        count = str(samples or self.results[rows]["samples"])
        path = (count, *keys)
        values = [
            reduce(lambda part, key: part[key], path, curve)
            for curve in self.curves(rows, row)
        ]
        if not values or None in values:
            return "-"
        mean = number(float(np.mean(values)))
        if len(values) == 1:
            return mean
        return f"{mean} +- {number(float(np.std(values, ddof=1)))}"

    def zero(self, rows: str, preset: str, key: str) -> float:
        """A figure of zero motion, on the pairs on which the rows are scored."""
        content = self.results[rows]
        if "zero" in content:
            return float(content["zero"][preset][key])
        scores = content["runs"][0]["curve"][str(content["samples"])]
        return float(scores[preset][f"zero_{key}"])


def error(row: dict[str, Any]) -> str:
    """Median error in px, with the number of failures."""
    median = number(row["epe_px"]["median"])
    count = row["failures"]["count"]
    return f"{median} [{count}]" if count else median


def best(
    by_limit: dict[str, Any], limits: list[float], figure: str
) -> tuple[str, dict[str, Any]]:
    """The limit on an inlier's residual with the smallest figure, and its row.

    ``failures`` counts; where they are equal, the median error decides.
    """

    def rank(name: str) -> tuple[float, float]:
        row = by_limit[name]
        first = row["failures"]["count"] if figure == "failures" else row[figure]
        return first, row["epe_px"]["median"]

    name = min((f"{px:g} px" for px in limits), key=rank)
    return name, by_limit[name]


class Sureness(NamedTuple):
    """How many answers of ``hybrid`` about a maker's frames are wrong, and of these ok."""

    maker: str
    answers: int
    wrong: int
    wrong_ok: int
    right_not_ok: int

    @property
    def oracle(self) -> bool:
        """Whether the method was given the true flow."""
        return "true flow" in self.maker

    @property
    def wrong_ok_share(self) -> float:
        """Fraction of all answers that is wrong and ok."""
        return self.wrong_ok / max(self.answers, 1)

    @property
    def wrong_share(self) -> float:
        """Fraction of all answers that is wrong."""
        return self.wrong / max(self.answers, 1)


def sureness(results: Results) -> list[Sureness]:
    """How sure wrong answers are, of pairs and of tracked steps, the worst maker first."""
    pairs = {
        name: by_method["hybrid"]
        for name, by_method in results["makers"]["makers"].items()
    }
    pairs["pieces of other recordings"] = results["semi_real"]["summary"]["hybrid"]
    tracked = results["memory"]["clips"] + results["memory_unseen"]["rows"]
    rows = [of_pairs(f"{name}, pairs", row) for name, row in pairs.items()]
    rows += [
        of_steps(f"{row['recording']}, tracked", row)
        for row in tracked
        if row["memory"] == "auto"
    ]
    return sorted(rows, key=lambda row: (-row.wrong_ok_share, -row.wrong_share))


def of_pairs(maker: str, row: dict[str, Any]) -> Sureness:
    """The row of a maker's pairs: those in which something moves, and static ones."""
    return Sureness(
        maker,
        row["wrong"]["of"] + row["wrong_static"]["of"],
        row["wrong"]["count"] + row["wrong_static"]["count"],
        row["wrong_ok"]["count"],
        row["right_not_ok"]["count"] + row["right_not_ok_static"]["count"],
    )


def of_steps(maker: str, row: dict[str, Any]) -> Sureness:
    """The row of a maker's clips, in which each step was tracked."""
    return Sureness(
        maker, row["steps"], row["wrong"], row["wrong_ok"], row["right_not_ok"]
    )


class Provenance(NamedTuple):
    """How the figures of a file, or of a part of one, were measured."""

    file: str
    command: str
    commit: str
    load: str


def provenance(results: Results) -> list[Provenance]:
    """Each command that was run for a table, once, without the names of folders."""
    rows = []
    for stem, content in results.items():
        if stem == "numbers":  # of the constants, in no table
            continue
        parts = [content, *(p for p in content.values() if isinstance(p, dict))]
        for part in parts:
            if "command" not in part:
                continue
            command = re.sub(
                r" (--(data|out|wheels) \S+|--overwrite)", "", part["command"]
            )
            loads = part["machine"]["load"]
            load = f"{loads[0]:.1f}" if loads else "-"
            rows.append(Provenance(f"{stem}.json", command, part["commit"], load))
    # the same command for several parts: the load of the first one
    return list({row[:3]: row for row in reversed(rows)}.values())[::-1]


if __name__ == "__main__":
    sys.exit(main())
