"""Methods beside each other on sequences: same pairs, same flow, same clock, scored against truth.

    python tools/compare_methods.py --sequence DIR [--sequence DIR ...] --out runs/comparison
    python tools/compare_methods.py --sequence MPI-Sintel --protocol paper --out runs/sintel

Every method sees the same pairs, with the flow of the files and OpenCV's DIS flow side by side.
What is timed is the estimate from a ``FramePair`` on; the time of the flow stands beside it. Writes
``results.json``, ``results.csv``, ``pairs.csv``, ``report.md`` and ``report.html``, and beside them
``trajectories/`` (TUM files), ``worst/`` (pictures of the worst pairs) and ``figures/`` (maps of
some of them). The work is kept as it is done: after an interruption ``--resume`` goes on.
"""

from __future__ import annotations

import argparse
import json
import sys
from pathlib import Path


def build_parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="compare_methods.py", description=(__doc__ or "").splitlines()[0]
    )
    parser.add_argument(
        "--sequence",
        action="extend",
        nargs="+",
        required=True,
        metavar="DIR",
        help="sequence, or a folder of sequences (MPI Sintel as it was unpacked); repeatable",
    )
    parser.add_argument("--out", required=True, metavar="DIR")
    parser.add_argument("--methods", default="all", help="comma-separated; default: all that run")
    parser.add_argument(
        "--flow",
        choices=("auto", "file", "dis"),
        default="auto",
        help="auto: the sequence's flow files and DIS, side by side",
    )
    parser.add_argument("--dataset", help="kind of the sequences (default: detected)")
    parser.add_argument("--start", type=int, default=0)
    parser.add_argument("--stop", type=int)
    parser.add_argument("--stride", type=int, default=1)
    parser.add_argument("--device", choices=("auto", "cpu", "cuda"), default="auto")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument(
        "--protocol",
        choices=("paper", "all", "trajectory14"),
        help="MPI Sintel as others score it: PWVO's 992 pairs, all 1041, or fourteen trajectories",
    )
    parser.add_argument("--worst", type=int, default=3, help="worst pairs shown for each method")
    parser.add_argument(
        "--maps",
        type=int,
        default=1,
        metavar="N",
        help="worst pairs of the first method whose maps the report shows; a few seconds each",
    )
    parser.add_argument(
        "--jobs", type=int, default=1, metavar="N", help="sequences at a time, a process each"
    )
    parser.add_argument(
        "--scheduler",
        metavar="ADDRESS",
        help="of a Dask cluster (tcp://host:8786) that works instead; extra 'cluster'",
    )
    group = parser.add_mutually_exclusive_group()
    group.add_argument("--resume", action="store_true", help="go on with an interrupted comparison")
    group.add_argument("--overwrite", action="store_true", help="replace results in --out")
    parser.add_argument("-q", "--quiet", action="store_true", help="no progress")
    return parser


def main(argv: list[str] | None = None) -> int:
    try:
        args = build_parser().parse_args(argv)
    except SystemExit as end:
        return int(end.code or 0)
    from hybridvo.comparison.runner import ComparisonOptions, WorkerError, compare
    from hybridvo.console import printable
    from hybridvo.errors import HybridVOError, InputError, LockedError, OutputError

    given = sys.argv[1:] if argv is None else argv
    mode = "overwrite" if args.overwrite else "resume" if args.resume else "new"
    try:
        for option, values in (("--sequence", args.sequence), ("--out", [args.out])):
            if "" in values:  # a variable that is not set, not the working folder
                raise InputError(f"{option}: expected a folder, got an empty path.")
        if args.maps < 0:
            raise InputError(f"--maps: expected at least 0, got {args.maps}.")
        options = ComparisonOptions(
            sequences=tuple(args.sequence),
            dataset=args.dataset,
            methods=tuple(name.strip() for name in args.methods.split(",") if name.strip()),
            flow=args.flow,
            start=args.start,
            stop=args.stop,
            stride=args.stride,
            seed=args.seed,
            protocol=args.protocol,
            device=args.device,
            jobs=args.jobs,
            scheduler=args.scheduler,
            worst=args.worst,
        )
        written = compare(
            options,
            Path(args.out),
            mode=mode,
            command=["tools/compare_methods.py", *given],
            quiet=args.quiet,
        )
    except HybridVOError as error:
        print(printable(f"compare_methods.py: {error}"), file=sys.stderr)
        codes = ((OutputError, 5), (LockedError, 4), (WorkerError, 1))
        return next((code for kind, code in codes if isinstance(error, kind)), 2)
    except KeyboardInterrupt:
        print("compare_methods.py: interrupted.", file=sys.stderr)
        return 130
    if written is None:
        return 130
    written += draw_maps(Path(args.out), args.maps, args.quiet)
    for path in dict.fromkeys(written):
        print(printable(str(path)))
    return 0


def draw_maps(out: Path, count: int, quiet: bool) -> list[Path]:
    """Maps of the worst pairs of the first method, added to the report; a failure is one line."""
    from hybridvo.console import printable
    from hybridvo.errors import HybridVOError
    from hybridvo.visualization import PictureOptions, visualize

    if not count:
        return []
    try:
        results = json.loads((out / "results.json").read_text(encoding="utf-8"))
        paths = {row["name"]: row["path"] for row in results["sequences"]}
        kinds = {row["name"]: row["kind"] for row in results["sequences"]}
        worst = results["worst_pairs"] or []
    except (OSError, ValueError, KeyError, TypeError, RecursionError) as error:
        print(f"compare_methods.py: no maps: results.json: {error!r}", file=sys.stderr)
        return []
    pairs = [row for row in worst if row["method"] == worst[0]["method"]][:count]
    written: list[Path] = []
    for row in pairs:
        name = row["sequence"]
        flow = "dis" if row["flow_source"] == "dis" else "file"
        options = PictureOptions(
            sequence=paths[name],
            pair=row["index"],
            dataset=kinds[name],
            flow=flow,
            method=row["method"],
            into=out,
            overwrite=True,
            name=name,
        )
        command = ["tools/visualize.py", "--sequence", paths[name], "--dataset", kinds[name]]
        command += ["--pair", str(row["index"]), "--method", row["method"], "--into", str(out)]
        command += ["--flow", flow, "--overwrite"]
        if not quiet:
            print(f"maps of {name}, pair {row['index']}", file=sys.stderr)
        try:
            written += visualize(options, command)
        except HybridVOError as error:
            told = f"compare_methods.py: no maps of {name}: {error}"
            print(printable(told), file=sys.stderr)
    return written


if __name__ == "__main__":
    sys.exit(main())
