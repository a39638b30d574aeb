"""The command line: ``hybridvo run | compare | show | evaluate | doctor | demo | train | ...``.

Parses, calls, prints. Heavy modules are imported after parsing, so that ``--help`` is instant. Data
goes to stdout, progress and errors to stderr. Exit codes: 0 done, 1 a bug, 2 bad input or usage (or
``doctor`` found that something differs: 1), 3 too many failed frames, 4 folder locked, 5 output
cannot be written, 130 interrupted.
"""

from __future__ import annotations

import argparse
import inspect
import json
import logging
import os
import sys
import traceback
from collections.abc import Callable, Iterable, Sequence
from typing import Any

from hybridvo import __version__
from hybridvo.commands import arguments
from hybridvo.commands.train import add_train, train

Result = tuple[Any, str, int]
"""What a command gives: JSON-ready, for people, and the exit code."""
Call = Callable[[argparse.Namespace, list[str]], Result]


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
            parents=[arguments.common(), *parents],
            formatter_class=argparse.RawDescriptionHelpFormatter,
        )
        command.set_defaults(call=call)
        return command

    sequence = arguments.input()
    arguments.add_run(add("run", _run, "estimate the camera motion of a sequence", sequence))
    arguments.add_compare(add("compare", _compare, "run methods side by side and write a report"))
    arguments.add_show(add("show", _show, "draw the maps of one pair of a sequence", sequence))
    errors = "errors of a trajectory file against ground truth"
    arguments.add_evaluate(add("evaluate", _evaluate, errors))
    wrong, optional = "what is missing here, or wrong with a sequence", arguments.input(False)
    doctor = add("doctor", _doctor, wrong, optional)
    doctor.add_argument("--pairs", type=int, default=40, metavar="N", help="pairs (default 40)")
    arguments.add_demo(add("demo", _demo, "render a scene with moving objects and run on it"))
    arguments.add_generate(add("generate", _generate, "draw training samples into a folder"))
    training = commands.add_parser("train", help="train a network")
    training.set_defaults(call=train)
    add_train(training, arguments.common())
    init = add("init", _init, "write a camera.yaml to fill in, for a recording of your own")
    init.add_argument("directory", metavar="DIR", help="folder with rgb/ and depth/")
    return parser


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line; returns the exit code."""
    given = sys.argv[1:] if argv is None else list(argv)
    try:
        args = build_parser().parse_args(given)
    except SystemExit as end:  # argparse: 0 after --help and --version, 2 for wrong usage
        return int(end.code or 0)
    return _guarded(args, ["hybridvo", *given])


def _guarded(args: argparse.Namespace, command: list[str]) -> int:
    """Exit code of a command; errors become one line on stderr."""
    from hybridvo.errors import HybridVOError

    logger, handler = logging.getLogger("hybridvo"), logging.StreamHandler()
    handler.setLevel(logging.ERROR if args.quiet else logging.NOTSET)
    before = logger.level
    logger.addHandler(handler)
    if args.verbose:
        logger.setLevel(logging.DEBUG)
    try:
        content, text, code = args.call(args, command)
        # the result on stdout, as JSON or for people
        print(json.dumps(content, indent=1, allow_nan=False) if args.json else text, flush=True)
        return code
    except KeyboardInterrupt:
        print("hybridvo: interrupted.", file=sys.stderr)
        return 130
    except BrokenPipeError:  # the reader of stdout has gone (`| head`)
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 0
    except HybridVOError as error:
        if args.verbose:
            traceback.print_exc()
        print(f"hybridvo: {error}", file=sys.stderr)
        return error.exit_code
    except Exception:
        traceback.print_exc()
        print("hybridvo: this is a bug; please report it with the lines above.", file=sys.stderr)
        return 1
    finally:
        logger.removeHandler(handler)
        logger.setLevel(before)


def _call(function: Callable[..., Any], args: argparse.Namespace, **more: Any) -> Any:
    """The function, with those arguments of the command line that it has, and others."""
    names = inspect.signature(function).parameters
    return function(**{name: v for name, v in vars(args).items() if name in names} | more)


def _open(args: argparse.Namespace) -> Any:
    from hybridvo.data.sequence import open_sequence

    given = {name: getattr(args, name) for name in ("camera", "depth_scale", "mask")}
    given = {name: value for name, value in given.items() if value is not None}
    return open_sequence(args.path or args.sequence, args.dataset, **given)


def _run(args: argparse.Namespace, command: list[str]) -> Result:
    from hybridvo.commands.results import summary_text
    from hybridvo.commands.run import run
    from hybridvo.network.models import Models

    if "help" in args.given:
        defaults = arguments.option_defaults()
        return defaults, "\n".join(f"{key}={value}" for key, value in defaults.items()), 0
    options = arguments.run_options(args)
    files = arguments.weight_files(args.weights, [options.run.method])
    given = {"options": options, "models": Models(options.run.device, files), "command": command}
    summary, code = _call(run, args, sequence=_open(args), **given)
    if not args.quiet:
        for warning in summary.get("warnings", []):
            print(f"hybridvo: warning: {warning}", file=sys.stderr)
    return summary, summary_text(summary), code


def _files(paths: Iterable[Any]) -> Result:
    written = [str(path) for path in paths]
    return {"files": written}, "\n".join(written), 0


def _show(args: argparse.Namespace, command: list[str]) -> Result:
    from hybridvo.evaluation.drawing import draw

    return _files(_call(draw, args, sequence=_open(args)))


def _compare(args: argparse.Namespace, command: list[str]) -> Result:
    from hybridvo.commands.compare import compare
    from hybridvo.pipeline import METHODS

    methods = tuple(name.strip() for name in args.methods.split(",") if name.strip())
    weights = arguments.weight_files(args.weights, METHODS if methods == ("all",) else methods)
    given = {"methods": methods, "weights": weights, "options": arguments.run_options(args)}
    given |= {"sequences": (*args.paths, *args.sequence), "command": command}
    say = (lambda text: None) if args.quiet else (lambda text: print(text, file=sys.stderr))
    return _files(_call(compare, args, **given, say=say))


def _evaluate(args: argparse.Namespace, command: list[str]) -> Result:
    from hybridvo.commands.results import evaluation_text
    from hybridvo.evaluation.metrics import evaluate
    from hybridvo.trajectory import read_trajectory

    est = read_trajectory(args.estimate, args.format_est, axes=args.axes_est)
    gt = read_trajectory(args.gt, args.format_gt, axes=args.axes_gt)
    report = _call(evaluate, args, estimate=est, gt=gt)
    report |= {"estimate": args.estimate, "gt": args.gt}
    report["warnings"] = [*est.warnings, *gt.warnings]
    # not one figure: the files do not belong together
    code = 2 if report["ate_rmse_unaligned"] is None else 0
    if code:
        reason = report["reasons"]["ate_rmse_unaligned"]
        print(f"hybridvo: nothing could be compared: {reason}.", file=sys.stderr)
    return report, evaluation_text(report), code


def _doctor(args: argparse.Namespace, command: list[str]) -> Result:
    from hybridvo.commands.doctor import diagnose, diagnosis_text, doctor, doctor_text

    if args.path or args.sequence:
        found = diagnose(_open(args), pairs=args.pairs)
        return found, diagnosis_text(found), 0 if found["ok"] else 1
    report = doctor()
    return report, doctor_text(report), 0


def _demo(args: argparse.Namespace, command: list[str]) -> Result:
    from hybridvo.commands.demo import demo, demo_text

    content = _call(demo, args, command=command)
    return content, demo_text(content), 0


def _generate(args: argparse.Namespace, command: list[str]) -> Result:
    from hybridvo.commands.generate import generate
    from hybridvo.commands.progress import Progress

    with Progress(args.count, "generate", quiet=args.quiet, unit="samples") as bar:
        sheet = _call(generate, args, preset=args.path or args.preset, report=bar.update)
    return {"contact_sheet": str(sheet)}, str(sheet), 0


def _init(args: argparse.Namespace, command: list[str]) -> Result:
    from hybridvo.data.camera_file import write_camera_template

    path = write_camera_template(args.directory)
    next_step = f"fill it in, then: hybridvo run {args.directory}"
    return {"file": str(path)}, f"{path}\n{next_step}", 0


if __name__ == "__main__":
    sys.exit(main())
