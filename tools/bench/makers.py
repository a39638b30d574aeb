"""Every maker's pairs apart: wrong answers, and whether the probability can be believed.

    python tools/benchmark.py makers --pairs 120 --out docs/results/makers.json

A maker is a generator or a set of recordings (tools/maker_pairs.py). An answer is wrong by the
rule of tools/bench/semi_real.py. The figure to look at is that of the worst maker.
"""

from __future__ import annotations

import argparse
from functools import partial
from pathlib import Path
from typing import Any

from maker_pairs import TEST
from measuring import add_workers, measured, parser_of, provenance, store

from bench.semi_real import Estimator, measure, summarise
from hybridvo import estimate
from hybridvo.network.models import Models

METHODS = ("hybrid", "hybrid-flow", "pwvo-refine", "classical", "poselib")


def build_parser() -> argparse.ArgumentParser:
    parser = parser_of(__file__, __doc__)
    add = parser.add_argument
    add("--pairs", type=int, default=120, help="of makers without a fixed number")
    add("--methods", default=",".join(METHODS))
    add("--makers", help="some of them, separated by a semicolon; default: all")
    add("--weights", metavar="FILE", help="of PWVO, in place of the shipped ones")
    add("--data", type=Path, default=Path("../shared/data"), metavar="DIR")
    add("--out", type=Path, metavar="FILE")
    add_workers(parser)
    return parser


def main(argv: list[str] | None = None) -> int:
    args = build_parser().parse_args(argv)
    args.data = args.data.absolute()
    names = args.makers.split(";") if args.makers else list(TEST)
    found = measured(
        args, "makers", partial(rows_of, args), {name: name for name in names}
    )
    summary = {}
    for name, rows in found.items():
        if not rows:
            print(f"{name}: no data")
            continue
        summary[name] = {
            method: summarise(rows, method) for method in args.methods.split(",")
        }
        for method, row in summary[name].items():
            print(name, method, row, flush=True)
    result = provenance("benchmark.py makers", argv) | {"makers": summary}
    store(args.out, result)
    return 0


def rows_of(args: argparse.Namespace, name: str) -> list[dict[str, Any]]:
    """Answers of every method to the pairs of a maker."""
    models = Models(weights={"pwvo": args.weights}) if args.weights else None
    methods: dict[str, Estimator] = {
        name: partial(estimate, method=name, models=models)
        for name in args.methods.split(",")
    }
    drawn = (
        known
        for known in TEST[name](args.data, args.pairs)
        if known.pair.flow is not None
    )
    return measure(drawn, methods)
