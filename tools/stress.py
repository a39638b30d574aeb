r"""Tries to break runs, and counts: kills, signals, full disks, long walks, threads.

    python tools/stress.py --out docs/results/stress.json --overwrite

Writes one JSON file with the figures of every campaign, the command, the machine and the commit.
``--campaigns kills,signals --scale 0.1`` runs some of them, shorter.
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

COUNTS = {
    "kills": 200,
    "signals": 40,
    "full_disk": 40,
    "small_disk": 20,
    "two_runs": 20,
    "deleted_input": 12,
    "denied": 1,
    "streams": 1,
    "determinism": 1,
    "long_run": 20000,
    "long_recording": 10000,
    "long_default": 20000,
}
"""Campaign -> how often, or over how many frames, at scale 1."""


def build_parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="stress.py", description=__doc__.splitlines()[0])
    parser.add_argument("--campaigns", default="all", help=f"of {', '.join(COUNTS)}; or 'all'")
    parser.add_argument("--scale", type=float, default=1.0, help="factor on every count")
    parser.add_argument("--counts", default="", help="as in kills=20,long_run=1000; over --scale")
    parser.add_argument("--seed", type=int, default=0, help="of the random moments")
    parser.add_argument("--no-cold", action="store_true", help="determinism: warm cache only")
    parser.add_argument("--out", type=Path, default=Path("runs/stress.json"), metavar="FILE")
    parser.add_argument("--overwrite", action="store_true", help="replace FILE")
    parser.add_argument(
        "--update", action="store_true", help="keep the other campaigns' figures in FILE"
    )
    return parser


def main(argv: list[str] | None = None) -> int:
    args = build_parser().parse_args(argv)
    names = list(COUNTS) if args.campaigns == "all" else args.campaigns.split(",")
    if unknown := [name for name in names if name not in COUNTS]:
        return complain(f"--campaigns: unknown: {', '.join(unknown)}; known: {', '.join(COUNTS)}.")
    try:
        args.counts = {k: int(v) for k, v in (x.split("=") for x in args.counts.split(",") if x)}
    except ValueError:
        return complain(f"--counts: expected NAME=NUMBER,..., got {args.counts!r}.")
    if not args.scale > 0:
        return complain(f"--scale: expected a positive factor, got {args.scale}.")
    if args.out.exists() and not (args.overwrite or args.update):
        return complain(f"{args.out}: is there already; pass --overwrite, or --update.")
    # before numpy is imported: forks of a process with one thread only
    from stress_parts import ONE_THREAD

    os.environ.update(ONE_THREAD)
    report: dict[str, Any] = {}
    if args.update and args.out.exists():
        report = json.loads(args.out.read_text())
    with tempfile.TemporaryDirectory(prefix="stress-") as folder:
        for name, figures in campaigns(Path(folder), names, args):
            report[name] = figures
            print(f"{name}: {json.dumps(figures)}", file=sys.stderr, flush=True)
            report["machine"] = {"platform": platform.platform(), "cpus": os.cpu_count()}
            args.out.parent.mkdir(parents=True, exist_ok=True)
            args.out.write_text(json.dumps(report, indent=2, sort_keys=True) + "\n")
    print(args.out)
    return 0


def campaigns(where: Path, names: list[str], args: argparse.Namespace) -> Any:
    """(name, figures) of every campaign, with its command, its commit and its seconds."""
    import stress_campaigns as dying
    import stress_doors as doors

    from hybridvo.training.provenance import source_commit

    lab = None
    for name in names:
        count = args.counts.get(name, max(1, round(COUNTS[name] * args.scale)))
        started = time.perf_counter()
        if name.startswith("long_"):
            kind = name.removeprefix("long_")
            figures = dying.long_run(where / name, max(count, 200), args.seed, kind)
        else:
            lab = lab or dying.Lab(where)
            act: Callable[..., dict[str, Any]] = getattr(
                doors if name in ("denied", "streams", "determinism") else dying, name
            )
            extra = {"cold": not args.no_cold} if name == "determinism" else {}
            figures = act(lab, count, args.seed, **extra)
        yield (
            name,
            figures
            | {
                "command": f"python tools/stress.py --campaigns {name} --counts {name}={count}",
                "commit": source_commit(),
                "seconds": round(time.perf_counter() - started, 1),
            },
        )


def complain(message: str) -> int:
    print(f"stress.py: {message}", file=sys.stderr)
    return 2


if __name__ == "__main__":
    sys.exit(main())
