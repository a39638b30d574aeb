r"""The hybrid on whole sequences in which most of the picture moves; is its doubt honest?

    python tools/evaluate_hybrid.py --seed0 900 --out runs/hybrid_dev.json          # development
    python tools/evaluate_hybrid.py --seed0 7000 --page docs/hybrid.md --overwrite  # published

Sequences are rendered by families of the synthetic world from which the judge was not trained, and
tracked from the first frame to the last; the solver's cells are measured beside them. Writes the
JSON, beside it the reliability plot of the same name, and fills the page.
"""

from __future__ import annotations

import argparse
import shlex
import sys
import time
from pathlib import Path
from typing import Any


def build_parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="evaluate_hybrid.py", description=(__doc__ or "").splitlines()[0]
    )
    parser.add_argument("--seed0", type=int, default=7000, help="0-999 development, else published")
    parser.add_argument("--seeds", type=int, default=1, help="sequences of each family")
    parser.add_argument("--kinds", default="", help="comma-separated families; default: heavy ones")
    parser.add_argument("--methods", default="", help="comma-separated rows; default: all")
    parser.add_argument("--frames", type=int, default=200, help="of a sequence")
    parser.add_argument("--size", default="218x512", help="HEIGHTxWIDTH, px")
    parser.add_argument("--noisy-stride", type=int, default=4, help="also with noise; 0: never")
    parser.add_argument("--cell-pairs", type=int, default=20, help="pairs of each cell; 0: none")
    parser.add_argument("--jobs", type=int, default=1, help="processes")
    parser.add_argument("--parts", type=Path, help="folder of finished sequences, to go on from")
    parser.add_argument("--out", type=Path, default=Path("docs/results/hybrid_sequences.json"))
    parser.add_argument("--answers", type=Path, help="CSV with one row per answer")
    parser.add_argument("--page", type=Path, help="page whose marked part is made from --out")
    parser.add_argument("--page-only", action="store_true", help="measure nothing, read --out")
    parser.add_argument("--overwrite", action="store_true", help="replace --out")
    return parser


def main(argv: list[str] | None = None) -> int:
    args = build_parser().parse_args(argv)
    from hybridvo.errors import HybridVOError

    try:
        if args.page_only:
            return _fill_page(args)
        if args.out.exists() and not args.overwrite:
            return _bad_usage(f"{args.out} exists; pass --overwrite.")
        if args.seed0 < 0 or args.seeds < 1 or args.cell_pairs < 0:
            return _bad_usage("expected --seed0 >= 0, --seeds >= 1 and --cell-pairs >= 0.")
        args.out.parent.mkdir(parents=True, exist_ok=True)
        result = measure(args)
        command = shlex.join(_command(sys.argv[1:] if argv is None else argv))
        result = {"command": f"python tools/evaluate_hybrid.py {command}".rstrip()} | result
        _write(args, result)
        return _fill_page(args) if args.page else 0
    except HybridVOError as error:
        print(f"evaluate_hybrid.py: {error}", file=sys.stderr)
        return getattr(error, "exit_code", 2)
    except OSError as error:
        print(f"evaluate_hybrid.py: {error}", file=sys.stderr)
        return 5


def _command(argv: list[str]) -> list[str]:
    """The arguments that the numbers depend on: no folders of this machine."""
    kept, skip = [], False
    for word in argv:
        skip, said = False, skip
        if said or word.startswith(("--parts=", "--answers=")):
            continue
        skip = word in ("--parts", "--answers")
        if not skip:
            kept.append(word)
    return kept


def _bad_usage(message: str) -> int:
    print(f"evaluate_hybrid.py: {message}", file=sys.stderr)
    return 2


def measure(args: argparse.Namespace) -> dict[str, Any]:
    """Everything that the JSON holds but the command."""
    from hybridvo.comparison import hybrid_sequences as sequences
    from hybridvo.comparison.executors import open_workers
    from hybridvo.comparison.hybrid_summary import summarise
    from hybridvo.errors import InputError
    from hybridvo.evaluation.report import write_csv
    from hybridvo.hypotheses.confidence import RECALIBRATION
    from hybridvo.training.provenance import source_commit

    def progress(line: str) -> None:
        print(line, file=sys.stderr, flush=True)

    able, absent = sequences.methods_here()
    commit = source_commit()
    try:
        height, width = (int(part) for part in args.size.split("x"))
    except ValueError:
        raise InputError(f"--size: expected HEIGHTxWIDTH, got {args.size!r}.") from None
    options = sequences.SequenceOptions(
        kinds=tuple(args.kinds.split(",")) if args.kinds else sequences.HEAVY_KINDS,
        seeds=tuple(range(args.seed0, args.seed0 + args.seeds)),
        frames=args.frames,
        height=height,
        width=width,
        methods=tuple(args.methods.split(",")) if args.methods else able,
        noisy_stride=args.noisy_stride,
    )
    started = time.process_time()
    records, paths = [], []
    if args.cell_pairs:
        records += sequences.run_cells(args.cell_pairs, args.seed0)
        progress(f"cells: {time.process_time() - started:.0f} s of processor time")
    cpu_s = time.process_time() - started
    with open_workers(args.jobs) as workers:
        running = [
            (
                kind,
                seed,
                workers.executor.submit(_sequence, kind, seed, options, args.parts, commit),
            )
            for kind in options.kinds
            for seed in options.seeds
        ]
        for kind, seed, future in running:
            found = future.result()
            records += found["records"]
            paths += found["paths"]
            cpu_s += found["cpu_s"]
            progress(f"{kind} {seed}: {found['cpu_s']:.0f} s of processor time")
    if args.answers:
        write_csv(args.answers, records)
    return {
        "commit": commit,
        "conditions": {
            "kinds": list(options.kinds),
            "seeds": list(options.seeds),
            "frames": options.frames,
            "size": [height, width],
            "cell_pairs": args.cell_pairs,
            "noisy_stride": options.noisy_stride,
            "noise": {"flow_px": sequences.NOISE_PX, "log_depth": sequences.NOISE_LOG_DEPTH},
            "failure_px": sequences.FAILURE_PX,
            "depth": "true (oracle)",
            "flows": {
                "true": "true (oracle)",
                "true+noise": "true, with the refinement's own noise on flow and depth",
                "dis": "OpenCV DIS, forward-backward variance",
                "cell": "the solver's cells, noise as each says",
            },
            "picture": f"results/{args.out.with_suffix('.png').name}",
        },
        "missing": absent,
        "cpu_s": cpu_s,
        "map": RECALIBRATION,
        **summarise(records, paths, RECALIBRATION),
    }


def _sequence(
    kind: str, seed: int, options: Any, parts: Path | None, commit: str | None
) -> dict[str, Any]:
    """One sequence; read from ``parts`` where the same sources measured the same before."""
    import json
    from dataclasses import asdict

    from hybridvo.comparison.hybrid_sequences import run_sequence
    from hybridvo.evaluation.report import write_json

    conditions = asdict(options) | {"kinds": [kind], "seeds": [seed], "commit": commit}
    conditions["methods"] = list(options.methods)
    path = None if parts is None else parts / f"{kind}_{seed}.json"
    if path is not None and path.is_file():
        kept = json.loads(path.read_text(encoding="utf-8"))
        if kept["conditions"] == conditions and commit and "dirty" not in commit:
            return kept
    found = asdict(run_sequence(kind, seed, options)) | {"conditions": conditions}
    if path is not None:
        path.parent.mkdir(parents=True, exist_ok=True)
        write_json(path, found)
    return found


def _write(args: argparse.Namespace, result: dict[str, Any]) -> None:
    from hybridvo.evaluation.plots_calibration import plot_calibration
    from hybridvo.evaluation.report import write_json

    write_json(args.out, result)
    print(args.out)
    groups = {k: v["stated"] for k, v in result["reliability"].items() if k != "sequences"}
    if groups:
        picture = args.out.with_suffix(".png")
        plot_calibration(groups, picture, title="hybrid-flow: is the stated probability right?")
        print(picture)
    for goal in result["goals"]:
        value = "not measured" if goal["value"] is None else f"{goal['value']:.3g}"
        print(f"{goal['what']}: {value} (goal {goal['goal']:.3g}, met: {goal['met']})")
    if result["recalibration"]:
        print(f"map shipped: {result['map']}")
        print(f"map fitted to these answers: {result['recalibration']['fit']['coefficients']}")


def _fill_page(args: argparse.Namespace) -> int:
    import json

    from hybridvo.comparison.hybrid_page import fill
    from hybridvo.files import atomic_write

    if args.page is None:
        return _bad_usage("--page-only needs --page.")
    result = json.loads(args.out.read_text(encoding="utf-8"))
    text = fill(args.page.read_text(encoding="utf-8"), args.out.stem, result)
    with atomic_write(args.page) as file:
        file.write(text)
    print(args.page)
    return 0


if __name__ == "__main__":
    sys.exit(main())
