"""What the tools share that measure a way of estimation on rendered scenes and real sequences."""

from __future__ import annotations

import argparse
import shlex
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

REAL = (
    "tartanair_v2/P000",
    "tum/redwood_livingroom_5",
    "tum/rgbd_dataset_freiburg1_xyz_first10",
)


def pairs_parser(prog: str, doc: str | None, scenes: int) -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog=prog, description=(doc or "").splitlines()[0])
    parser.add_argument("--data", type=Path, default=Path("../shared/data"), metavar="DIR")
    parser.add_argument("--out", type=Path, required=True, metavar="FILE")
    parser.add_argument("--seed", type=int, default=100, help="first seed of the scenes")
    parser.add_argument("--scenes", type=int, default=scenes, help="scenes of each kind")
    parser.add_argument("--overwrite", action="store_true", help="replace --out")
    return parser


def write_rows(
    parser: argparse.ArgumentParser,
    argv: list[str] | None,
    measure: Callable[[argparse.Namespace], list[dict[str, Any]]],
    show: Callable[[list[dict[str, Any]]], str] | None = None,
) -> int:
    """Read the command line, measure, write the rows with their command; the exit code."""
    given = sys.argv[1:] if argv is None else argv
    args = parser.parse_args(given)
    from hybridvo.commands.inputs import versions
    from hybridvo.errors import HybridVOError
    from hybridvo.evaluation.report import write_json
    from hybridvo.pipeline import warm_up

    if args.out.exists() and not args.overwrite:
        print(f"{parser.prog}: {args.out} exists; pass --overwrite.", file=sys.stderr)
        return 2
    try:
        warm_up("refine", "on")
        rows = measure(args)
        args.out.parent.mkdir(parents=True, exist_ok=True)
        command = f"python tools/{parser.prog} {shlex.join(given)}"
        write_json(args.out, {"command": command, "versions": versions(), "rows": rows})
    except HybridVOError as error:
        print(f"{parser.prog}: {error}", file=sys.stderr)
        return 2
    if show is not None:
        print(show(rows))
    print(args.out)
    return 0
