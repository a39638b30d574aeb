"""Methods beside each other on sequences: same frames, same flow, same clock, scored against truth.

    python tools/compare_methods.py --sequence DIR [--sequence DIR ...] --out runs/comparison
    python tools/compare_methods.py --sequence MPI-Sintel --protocol paper --out runs/sintel

Every method gives what ``hybridvo run --method NAME`` gives. Writes ``results.json``,
``results.csv``, ``pairs.csv``, ``report.md`` and ``report.html``, and beside them ``trajectories/``
(TUM files) and ``worst/`` (images of the worst pairs). Finished sequences are kept: after an
interruption ``--resume`` goes on.
"""

from __future__ import annotations

import argparse
import sys


def build_parser() -> argparse.ArgumentParser:
    text = (__doc__ or "").splitlines()[0]
    parser = argparse.ArgumentParser(prog="compare_methods.py", description=text)
    add = parser.add_argument
    add(
        "--sequence",
        action="extend",
        nargs="+",
        required=True,
        metavar="DIR",
        help="sequence, or a folder of sequences (MPI Sintel as it was unpacked); repeatable",
    )
    add("--out", required=True, metavar="DIR")
    add("--methods", default="all", help="comma-separated; default: all that run here")
    flow = "auto: the sequence's flow files and DIS, side by side"
    add("--flow", choices=("auto", "file", "dis"), default="auto", help=flow)
    add("--dataset", help="kind of the sequences (default: detected)")
    add("--start", type=int, default=0)
    add("--stop", type=int)
    add("--stride", type=int, default=1)
    add("--seed", type=int, default=0)
    add("--device", choices=("auto", "cpu", "cuda"), default="auto")
    own = "file of a network (selector, pwvo, ...) instead of the pretrained one; repeatable"
    add("--weights", action="append", default=[], metavar="NAME=FILE", help=own)
    paper = "MPI Sintel as others score it: PWVO's 992 pairs, or fourteen trajectories"
    add("--protocol", choices=("paper", "trajectory14"), help=paper)
    add("--worst", type=int, default=3, help="worst pairs shown for each method")
    add("--jobs", type=int, default=1, metavar="N", help="sequences at a time, a process each")
    cluster = "of a Dask cluster (tcp://host:8786) that works instead; extra 'cluster'"
    add("--scheduler", metavar="ADDRESS", help=cluster)
    group = parser.add_mutually_exclusive_group()
    group.add_argument("--resume", action="store_true", help="keep the sequences that are finished")
    group.add_argument("--overwrite", action="store_true", help="replace results in --out")
    add("-q", "--quiet", action="store_true", help="no progress")
    return parser


def main(argv: list[str] | None = None) -> int:
    try:
        args = vars(build_parser().parse_args(argv))
    except SystemExit as end:
        return int(end.code or 0)
    from hybridvo.errors import HybridVOError, InputError, LockedError, OutputError
    from hybridvo.evaluation.comparison import ComparisonOptions, compare

    mode = "overwrite" if args.pop("overwrite") else "resume" if args["resume"] else "new"
    del args["resume"]
    quiet, out = args.pop("quiet"), args.pop("out")
    try:
        pairs = [text.partition("=") for text in args.pop("weights")]
        options = ComparisonOptions(
            sequences=tuple(args.pop("sequence")),
            methods=tuple(n.strip() for n in args.pop("methods").split(",") if n.strip()),
            weights={name: file for name, _, file in pairs},
            **args,
        )
        command = ["tools/compare_methods.py", *(sys.argv[1:] if argv is None else argv)]
        written = compare(
            options, out, mode=mode, command=command, progress=None if quiet else show
        )
    except HybridVOError as error:
        print(f"compare_methods.py: {error}", file=sys.stderr)
        codes = ((InputError, 2), (LockedError, 4), (OutputError, 5))
        return next((code for kind, code in codes if isinstance(error, kind)), 1)
    except KeyboardInterrupt:
        print("compare_methods.py: interrupted; go on with --resume.", file=sys.stderr)
        return 130
    print(*written, sep="\n")
    return 0


def show(message: str, done: int, total: int) -> None:
    end = "\r" if sys.stderr.isatty() and not message else "\n"
    if message or sys.stderr.isatty():
        print(f"[{done}/{total} pairs] {message}", end=end, file=sys.stderr, flush=True)


if __name__ == "__main__":
    sys.exit(main())
