"""``hybridvo compare``: methods beside each other on sequences, scored against ground truth."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Literal

from hybridvo.commands.inputs import weight_files
from hybridvo.commands.progress import Progress
from hybridvo.evaluation.comparison import compare
from hybridvo.evaluation.plan import ComparisonOptions
from hybridvo.pipeline import METHODS


def compare_command(args: argparse.Namespace, command: list[str]) -> list[Path]:
    """Run a comparison with the arguments of the command line; the files written."""
    given = (
        *("flow", "dataset", "start", "stop", "stride", "seed", "device"),
        *("protocol", "worst", "jobs"),
    )
    methods = tuple(name.strip() for name in args.methods.split(",") if name.strip())
    options = ComparisonOptions(
        sequences=(*args.paths, *args.sequence),
        methods=methods,
        weights=weight_files(args.weights, METHODS if methods == ("all",) else methods),
        **{name: getattr(args, name) for name in given},
    )
    mode: Literal["new", "resume", "overwrite"]
    mode = "resume" if args.resume else "overwrite" if args.overwrite else "new"
    with Progress(0, "compare", quiet=args.quiet, unit="pairs") as progress:

        def report(message: str, done: int, total: int) -> None:
            if message:
                progress.say(message)
            progress.update(done, total=total)

        return compare(options, args.out, mode=mode, command=command, progress=report)
