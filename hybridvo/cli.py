"""The command line: ``hybridvo run | compare | show | evaluate | doctor | demo | train | ...``.

Heavy modules are imported after parsing, so that ``--help`` is instant. Data goes to stdout,
progress and errors to stderr. Exit codes: 0 done, 1 a bug, 2 bad input or usage (or ``doctor``
found that something differs: 1), 3 too many failed frames, 4 folder locked, 5 output cannot be
written, 130 interrupted.
"""

from __future__ import annotations

import argparse
import inspect
import json
import logging
import os
import sys
import traceback
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

from hybridvo import __version__
from hybridvo.commands import arguments
from hybridvo.commands.train import add_train, train

Result = tuple[Any, int]
"""What a command gives, JSON-ready, and the exit code."""


def build_parser() -> argparse.ArgumentParser:
    """Parser of the whole command line."""
    parser = argparse.ArgumentParser(
        prog="hybridvo",
        description="Metric camera motion with covariance from optical flow, depth and intrinsics.",
    )
    parser.add_argument("--version", action="version", version=f"hybridvo {__version__}")
    commands = parser.add_subparsers(dest="command", required=True, metavar="COMMAND")
    common = argparse.ArgumentParser(add_help=False)
    common.add_argument("--json", action="store_true", help="print the result as JSON on stdout")
    loudness = common.add_mutually_exclusive_group()
    loudness.add_argument("-v", "--verbose", action="store_true", help="tracebacks of errors")
    loudness.add_argument("-q", "--quiet", action="store_true", help="errors only")
    for name, (add_arguments, call) in COMMANDS.items():
        about = add_arguments.__doc__ or ""
        made = commands.add_parser(name, help=about, description=about, parents=[common])
        made.set_defaults(call=call)
        add_arguments(made)
    add_train(commands.add_parser("train", help="train a network"), common, train)
    return parser


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line; returns the exit code. Errors become one line on stderr."""
    from hybridvo.errors import HybridVOError

    given = sys.argv[1:] if argv is None else list(argv)
    try:
        args = build_parser().parse_args(given)
    except SystemExit as end:  # argparse: 0 after --help and --version, 2 for wrong usage
        return int(end.code or 0)
    logging.getLogger("hybridvo").setLevel(logging.ERROR if args.quiet else logging.NOTSET)
    try:
        content, code = args.call(args, ["hybridvo", *given])
        as_json = json.dumps(content, indent=1, allow_nan=False)
        print(as_json if args.json else text_of(args.command, content) or as_json, flush=True)
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


def text_of(command: str, content: Mapping[str, Any]) -> str:
    """The result of a command for people; empty where JSON serves them too."""
    import jinja2

    if "files" in content and command != "run":
        return "\n".join(content["files"])
    folder = Path(__file__).parent / "commands" / "templates"
    if not (folder / f"{command}.txt").is_file() or "run.method" in content:
        return ""
    loader = jinja2.FileSystemLoader(folder)
    template = jinja2.Environment(loader=loader, trim_blocks=True).get_template(f"{command}.txt")
    return template.render(content, content=content).rstrip()


def _call(function: Callable[..., Any], args: argparse.Namespace, **more: Any) -> Any:
    """The function, with those arguments of the command line that it has, and others."""
    names = inspect.signature(function).parameters
    return function(**{name: v for name, v in vars(args).items() if name in names} | more)


def _open(args: argparse.Namespace) -> Any:
    from hybridvo.data.sequence import open_sequence

    given = {name: getattr(args, name) for name in ("camera", "depth_scale", "mask")}
    given = {name: value for name, value in given.items() if value is not None}
    return open_sequence(args.path, args.dataset, **given)


def _run(args: argparse.Namespace, command: list[str]) -> Result:
    from hybridvo.commands.run import run
    from hybridvo.network.models import Models

    if "help" in args.given:
        return arguments.option_defaults(), 0
    options = arguments.run_options(args)
    files = arguments.weight_files(args.weights, [options.run.method])
    given = {"options": options, "models": Models(options.run.device, files), "command": command}
    summary, code = _call(run, args, sequence=_open(args), **given)
    if not args.quiet:
        for warning in summary.get("warnings", []):
            print(f"hybridvo: warning: {warning}", file=sys.stderr)
    return summary, code


def _compare(args: argparse.Namespace, command: list[str]) -> Result:
    from hybridvo.commands.compare import compare
    from hybridvo.pipeline import METHODS

    methods = tuple(name.strip() for name in args.methods.split(",") if name.strip())
    weights = arguments.weight_files(args.weights, METHODS if methods == ("all",) else methods)
    given = {"methods": methods, "weights": weights, "options": arguments.run_options(args)}
    return {"files": [str(p) for p in _call(compare, args, **given, command=command)]}, 0


def _show(args: argparse.Namespace, command: list[str]) -> Result:
    from hybridvo.evaluation.drawing import draw
    from hybridvo.network.models import Models

    models = Models(weights=arguments.weight_files(args.weights, [args.method, "pwvo"]))
    return {"files": [str(_call(draw, args, sequence=_open(args), models=models))]}, 0


def _evaluate(args: argparse.Namespace, command: list[str]) -> Result:
    from hybridvo.evaluation.metrics import evaluate
    from hybridvo.trajectory import read_trajectory

    est = read_trajectory(args.estimate, args.format_est)
    gt = read_trajectory(args.gt, args.format_gt)
    report = _call(evaluate, args, estimate=est, gt=gt)
    report |= {"estimate": args.estimate, "gt": args.gt}
    report["warnings"] = [*est.warnings, *gt.warnings]
    # not one figure: the files do not belong together
    code = 2 if report["ate_rmse_unaligned"] is None else 0
    if code:
        reason = report["reasons"]["ate_rmse_unaligned"]
        print(f"hybridvo: nothing could be compared: {reason}.", file=sys.stderr)
    return report, code


def _doctor(args: argparse.Namespace, command: list[str]) -> Result:
    from hybridvo.commands.doctor import diagnose, doctor

    if not args.path:
        return doctor(), 0
    found = diagnose(_open(args), pairs=args.pairs)
    return found, 0 if found["ok"] else 1


def _demo(args: argparse.Namespace, command: list[str]) -> Result:
    from hybridvo.commands.demo import demo

    return _call(demo, args, command=command), 0


def _generate(args: argparse.Namespace, command: list[str]) -> Result:
    from hybridvo.commands.generate import generate

    return {"files": [str(_call(generate, args))]}, 0


def _init(args: argparse.Namespace, command: list[str]) -> Result:
    from hybridvo.data.camera_file import write_camera_template

    path = write_camera_template(args.directory)
    print(f"fill it in, then: hybridvo run {args.directory}", file=sys.stderr)
    return {"files": [str(path)]}, 0


COMMANDS: dict[str, tuple[Callable[..., None], Callable[..., Result]]] = {
    "run": (arguments.run, _run),
    "compare": (arguments.compare, _compare),
    "show": (arguments.show, _show),
    "evaluate": (arguments.evaluate, _evaluate),
    "doctor": (arguments.doctor, _doctor),
    "demo": (arguments.demo, _demo),
    "generate": (arguments.generate, _generate),
    "init": (arguments.init, _init),
}
"""Name -> what adds its arguments and says what it does, and what runs it; beside ``train``."""


if __name__ == "__main__":
    sys.exit(main())
