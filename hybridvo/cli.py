"""The command line: ``hybridvo run | compare | show | evaluate | doctor | demo | init | ...``.

Parses, calls, prints. Heavy modules are imported after parsing, so that ``--help`` is instant. Data
goes to stdout, progress and errors to stderr. Exit codes: 0 done, 1 a bug, 2 bad input or usage (or
``doctor`` found that something differs: 1), 3 too many failed frames, 4 folder locked, 5 output
cannot be written, 130 interrupted.
"""

from __future__ import annotations

import argparse
import json
import logging
import os
import sys
import traceback
from collections.abc import Callable, Sequence
from typing import Any

from hybridvo import __version__

METHODS = (
    *("hybrid", "hybrid-flow", "refine", "pwvo-refine"),
    *("pwvo", "pwvo-paper", "pwvo-uncertain", "pwvo-naive", "pixelwise"),
    *("vonet", "vonet-attention", "pnp-ransac", "pnp-ransac-tuned", "usac-magsac", "poselib"),
    *("opencv-rgbd", "open3d-rgbd", "identity"),
)
"""For the help alone, which must not load what the methods need."""
KINDS = ("sintel", "tartanair", "7scenes", "folder", "kitti", "tum")

Call = Callable[[argparse.Namespace, list[str]], int]


def build_parser() -> argparse.ArgumentParser:
    """Parser of the whole command line."""
    parser = argparse.ArgumentParser(
        prog="hybridvo",
        description="Metric camera motion with covariance from optical flow, depth and intrinsics.",
    )
    parser.add_argument("--version", action="version", version=f"hybridvo {__version__}")
    commands = parser.add_subparsers(dest="command", required=True, metavar="COMMAND")

    def add(name: str, call: Call, help: str, *parents: argparse.ArgumentParser) -> Any:
        command = commands.add_parser(
            name,
            help=help,
            description=help[0].upper() + help[1:] + ".",
            parents=[_common(), *parents],
            formatter_class=argparse.RawDescriptionHelpFormatter,
        )
        command.set_defaults(call=call)
        return command

    _add_run(add("run", _run, "estimate the camera motion of a sequence", _input()))
    _add_compare(add("compare", _compare, "run methods side by side and write a report"))
    _add_show(add("show", _show, "draw the maps of one pair of a sequence", _where()))
    _add_evaluate(add("evaluate", _evaluate, "errors of a trajectory file against ground truth"))
    doctor = add(
        "doctor", _doctor, "what is missing here, or wrong with a sequence", _input(required=False)
    )
    doctor.add_argument("--pairs", type=int, default=40, metavar="N", help="pairs (default 40)")
    demo = add("demo", _demo, "render a scene with moving objects and run on it")
    demo.add_argument("--out", default="runs/demo", metavar="DIR", help="default: runs/demo")
    demo.add_argument("--overwrite", action="store_true", help="replace the results in --out")
    demo.add_argument("--frames", type=int, default=20, metavar="N", help="default: 20")
    demo.add_argument("--seed", type=int, default=0, metavar="N", help="of the scene")
    init = add("init", _init, "write a camera.yaml to fill in, for a recording of your own")
    init.add_argument("directory", metavar="DIR", help="folder with rgb/ and depth/")
    return parser


def _common() -> argparse.ArgumentParser:
    common = argparse.ArgumentParser(add_help=False)
    common.add_argument("--json", action="store_true", help="print the result as JSON on stdout")
    loudness = common.add_mutually_exclusive_group()
    loudness.add_argument("-v", "--verbose", action="store_true", help="more, and tracebacks")
    loudness.add_argument("-q", "--quiet", action="store_true", help="errors only")
    return common


def _where(required: bool = True) -> argparse.ArgumentParser:
    """Which sequence."""
    given = argparse.ArgumentParser(add_help=False)
    where = given.add_mutually_exclusive_group(required=required)
    where.add_argument("path", nargs="?", metavar="DIR", help="folder of the sequence")
    where.add_argument("--sequence", metavar="DIR", help="the same, by name")
    given.add_argument(
        "--dataset", metavar="KIND", help=f"one of {', '.join(KINDS)} (default: detected)"
    )
    return given


def _input(required: bool = True) -> argparse.ArgumentParser:
    """Which sequence, and what its folder does not say."""
    given = _where(required)
    given.add_argument(
        "--camera", metavar="FILE|fx,fy,cx,cy", help="camera.yaml, ROS camera_info, or numbers"
    )
    given.add_argument(
        "--depth-scale", type=float, metavar="N", help="depth units per metre, 1000: millimetres"
    )
    given.add_argument("--mask", metavar="DIR", help="images that are 0 where pixels do not count")
    return given


def _add_run(run: argparse.ArgumentParser) -> None:
    run.add_argument("--out", metavar="DIR", help="output folder (default: runs/NAME)")
    run.add_argument(
        "--method", metavar="NAME", help=f"one of {', '.join(METHODS)} (default: hybrid)"
    )
    run.add_argument(
        "--flow", metavar="WHAT", help="auto, file or dis (default: files where there are, or dis)"
    )
    run.add_argument("--start", type=int, metavar="N", help="first frame (default 0)")
    run.add_argument("--stop", type=int, metavar="N", help="the one after the last frame")
    run.add_argument("--stride", type=int, metavar="N", help="step between frames (default 1)")
    run.add_argument(
        "--weights",
        action="append",
        default=[],
        metavar="NAME=FILE",
        help="network weights instead of the pretrained ones, as in pwvo=mine.safetensors",
    )
    run.add_argument("--device", metavar="NAME", help="auto (default), cpu or cuda")
    run.add_argument("--config", metavar="FILE", help="YAML file of options")
    run.add_argument(
        "--set",
        action=_KeysInHelp,
        default=[],
        dest="assignments",
        metavar="KEY=VALUE",
        help="one option, as in refine.cutoff=2.5; may be repeated; --set help lists the keys",
    )
    exists = run.add_mutually_exclusive_group()
    exists.add_argument("--resume", action="store_true", help="go on with a run that was cut off")
    exists.add_argument("--overwrite", action="store_true", help="replace the results in --out")
    run.add_argument(
        "--max-failed", type=float, metavar="X", help="fraction of failed motions (default 0.2)"
    )
    run.add_argument(
        "--strict", action="store_true", default=None, help="a broken frame ends the run"
    )
    run.add_argument(
        "--rrd",
        nargs="?",
        const="",
        metavar="FILE",
        help="write a Rerun recording (extra 'viz'; default: recording.rrd in the output folder)",
    )


class _KeysInHelp(argparse.Action):
    """Collects assignments; ``--set help`` prints every key with its default."""

    def __call__(self, parser: Any, namespace: Any, values: Any, option: Any = None) -> None:
        if values == "help":
            from hybridvo.commands.configuration import option_defaults

            print("\n".join(f"{key}={value}" for key, value in option_defaults().items()))
            parser.exit()
        setattr(namespace, self.dest, [*getattr(namespace, self.dest), values])


def _add_compare(compare: argparse.ArgumentParser) -> None:
    add = compare.add_argument
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
    own = "network weights instead of the pretrained ones; repeatable"
    add("--weights", action="append", default=[], metavar="NAME=FILE", help=own)
    paper = "MPI Sintel as others score it: PWVO's 992 pairs, or fourteen trajectories"
    add("--protocol", choices=("paper", "trajectory14"), help=paper)
    add("--worst", type=int, default=3, help="worst pairs shown for each method")
    add("--jobs", type=int, default=1, metavar="N", help="sequences at a time, a process each")
    cluster = "of a Dask cluster (tcp://host:8786) that works instead; extra 'cluster'"
    add("--scheduler", metavar="ADDRESS", help=cluster)
    exists = compare.add_mutually_exclusive_group()
    exists.add_argument("--resume", action="store_true", help="keep the finished sequences")
    exists.add_argument("--overwrite", action="store_true", help="replace results in --out")


def _add_show(show: argparse.ArgumentParser) -> None:
    show.add_argument("--pair", type=int, default=0, metavar="N", help="first frame (default 0)")
    show.add_argument("--out", default="pair.png", metavar="FILE", help="default: pair.png")
    show.add_argument("--method", metavar="NAME", help="estimator (default: hybrid)")
    show.add_argument("--flow", choices=("auto", "file", "dis"), default="auto")
    show.add_argument("--weights", action="append", default=[], metavar="FILE", help="a network")
    show.add_argument("--steps", type=int, default=32, help="of the integrated gradients")
    show.add_argument("--overwrite", action="store_true", help="replace the image")


def _add_evaluate(evaluate: argparse.ArgumentParser) -> None:
    evaluate.add_argument("estimate", metavar="EST", help="estimated trajectory")
    evaluate.add_argument("gt", metavar="GT", help="true trajectory")
    evaluate.add_argument(
        "--alignment", choices=("se3", "sim3", "origin", "none"), default="se3", help="of the ATE"
    )
    evaluate.add_argument(
        "--delta", type=float, default=1, metavar="X", help="span of the RPE (default 1)"
    )
    evaluate.add_argument(
        "--delta-unit", choices=("frames", "s"), default="frames", help="unit of --delta"
    )
    evaluate.add_argument("--max-diff", type=float, metavar="S", help="seconds between matches")
    formats = ("auto", "tum", "kitti", "tartanair")
    for name in ("est", "gt"):
        evaluate.add_argument(f"--format-{name}", choices=formats, default="auto")
        evaluate.add_argument(f"--axes-{name}", choices=("auto", "camera", "ned"), default="auto")


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line; returns the exit code."""
    try:
        args = build_parser().parse_args(argv)
    except SystemExit as end:  # argparse: 0 after --help and --version, 2 for wrong usage
        return int(end.code or 0)
    command = ["hybridvo", *(sys.argv[1:] if argv is None else argv)]
    try:
        return _guarded(args, command)
    except BrokenPipeError:  # the reader of stdout has gone (`| head`)
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 0


def _guarded(args: argparse.Namespace, command: list[str]) -> int:
    """Exit code of a command; errors become one line on stderr."""
    from hybridvo.errors import HybridVOError

    logger, handler = logging.getLogger("hybridvo"), logging.StreamHandler()
    before = logger.level
    logger.addHandler(handler)
    logger.setLevel(
        logging.DEBUG if args.verbose else logging.ERROR if args.quiet else logging.WARNING
    )
    try:
        return args.call(args, command)
    except KeyboardInterrupt:
        print("hybridvo: interrupted.", file=sys.stderr)
        return 130
    except BrokenPipeError:
        raise
    except HybridVOError as error:
        if args.verbose:
            traceback.print_exc()
        print(f"hybridvo: {error}", file=sys.stderr)
        return error.exit_code
    except Exception:
        traceback.print_exc()
        print(
            "hybridvo: this is a bug in hybridvo; please report it with the lines above.",
            file=sys.stderr,
        )
        return 1
    finally:
        logger.removeHandler(handler)
        logger.setLevel(before)


def _print(args: argparse.Namespace, content: Any, text: str) -> None:
    """The result on stdout, as JSON or for people."""
    print(json.dumps(content, indent=1, allow_nan=False) if args.json else text, flush=True)


def _open(args: argparse.Namespace) -> Any:
    from hybridvo.data.sequence import open_sequence

    given = {name: getattr(args, name) for name in ("camera", "depth_scale", "mask")}
    given = {name: value for name, value in given.items() if value is not None}
    return open_sequence(args.path or args.sequence, args.dataset, **given)


def _run(args: argparse.Namespace, command: list[str]) -> int:
    from hybridvo.commands.configuration import load_options
    from hybridvo.commands.inputs import make_models
    from hybridvo.commands.results import summary_text
    from hybridvo.commands.run import Mode, run

    given = {
        f"run.{name}": getattr(args, name)
        for name in ("method", "start", "stop", "stride", "device", "max_failed", "strict")
    }
    options = load_options(args.config, args.assignments, given | {"flow.source": args.flow})
    mode: Mode = "resume" if args.resume else "overwrite" if args.overwrite else "new"
    result = run(
        _open(args),
        args.out,
        options,
        models=make_models(args.weights, options.run.method, options.run.device),
        mode=mode,
        command=command,
        quiet=args.quiet,
        rrd=args.rrd,
    )
    _print(args, result.summary, summary_text(result.summary))
    if not args.quiet:
        for warning in result.summary.get("warnings", []):
            print(f"hybridvo: warning: {warning}", file=sys.stderr)
    return result.exit_code


def _show(args: argparse.Namespace, command: list[str]) -> int:
    from hybridvo.commands.show import show

    written = show(args)
    _print(args, {"files": written}, "\n".join(written))
    return 0


def _compare(args: argparse.Namespace, command: list[str]) -> int:
    from hybridvo.commands.compare import compare_command

    written = [str(path) for path in compare_command(args, command)]
    _print(args, {"files": written}, "\n".join(written))
    return 0


def _evaluate(args: argparse.Namespace, command: list[str]) -> int:
    from hybridvo.commands.results import evaluation_text
    from hybridvo.evaluation.metrics import evaluate_files

    names = ["alignment", "delta", "delta_unit", "max_diff"]
    names += ["format_est", "format_gt", "axes_est", "axes_gt"]
    report = evaluate_files(args.estimate, args.gt, **{name: getattr(args, name) for name in names})
    _print(args, report, evaluation_text(report))
    if report["ate_rmse_unaligned"] is None:  # not one figure: the files do not belong together
        reason = report["reasons"]["ate_rmse_unaligned"]
        print(f"hybridvo: nothing could be compared: {reason}.", file=sys.stderr)
        return 2
    return 0


def _doctor(args: argparse.Namespace, command: list[str]) -> int:
    if args.path or args.sequence:
        from hybridvo.commands.diagnose import diagnose, diagnosis_text

        found = diagnose(_open(args), pairs=args.pairs)
        _print(args, found, diagnosis_text(found))
        return 0 if found["ok"] else 1
    from hybridvo.commands.doctor import doctor, doctor_text

    report = doctor()
    _print(args, report, doctor_text(report))
    return 0 if report["usable"] else 2


def _demo(args: argparse.Namespace, command: list[str]) -> int:
    from hybridvo.commands.demo import demo, demo_text

    content = demo(
        args.out,
        frames=args.frames,
        seed=args.seed,
        overwrite=args.overwrite,
        command=command,
        quiet=args.quiet,
    )
    if content is None:
        return 130
    _print(args, content, demo_text(content))
    return 0


def _init(args: argparse.Namespace, command: list[str]) -> int:
    from hybridvo.data.camera_file import write_camera_template

    path = write_camera_template(args.directory)
    next_step = f"fill it in, then: hybridvo run {args.directory}"
    _print(args, {"file": str(path)}, f"{path}\n{next_step}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
