"""Measure: estimators, paths, uncertainty, times. One entry for all tools of tools/bench.

    python tools/benchmark.py                    # what can be measured
    python tools/benchmark.py makers --help      # the options of one tool
    python tools/benchmark.py makers --pairs 20 --out runs/makers.json

``tools/tables.py`` runs those of the published tables, with the options that they have there.
"""

from __future__ import annotations

import ast
import sys
from importlib import import_module
from pathlib import Path

TOOLS = (
    "methods",
    "makers",
    "semi_real",
    "two_recordings",
    "pwvo_parts",
    "passes",
    "wide_steps",
    "sequences",
    "moving_people",
    "objects",
    "memory",
    "memory_unseen",
    "lost",
    "sigmas",
    "peers",
    "slam_peers",
    "t265",
    "live",
    "scale",
    "install",
)
"""Modules of tools/bench that run alone; the others are parts of ``methods``."""
BAD_INPUT = 2
"""Exit code."""


def main(argv: list[str] | None = None) -> int:
    """Run the tool that the first argument names."""
    words = sys.argv[1:] if argv is None else argv
    if not words or words[0] in ("-h", "--help"):
        print((__doc__ or "").rstrip() + "\n")
        for name in TOOLS:
            print(f"{name:16s} {purpose(name)}")
        return 0
    name, *options = words
    if name not in TOOLS:
        known = ", ".join(TOOLS)
        text = f"got the tool {name!r}, expected one of {known}."
        print(f"benchmark.py: {text}", file=sys.stderr)
        return BAD_INPUT
    return import_module(f"bench.{name}").main(options)


def purpose(name: str) -> str:
    """What a tool measures: the first paragraph of its docstring, without an import."""
    path = Path(__file__).parent / "bench" / f"{name}.py"
    doc = ast.get_docstring(ast.parse(path.read_text(encoding="utf-8"))) or ""
    return " ".join(doc.split("\n\n")[0].split())


if __name__ == "__main__":
    sys.exit(main())
