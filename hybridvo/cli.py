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
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

from hybridvo.commands import arguments
from hybridvo.commands.train import train

Result = tuple[Any, str, int]
"""What a command gives: JSON-ready, for people, and the exit code."""


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line; returns the exit code."""
    given = sys.argv[1:] if argv is None else list(argv)
    try:
        args = arguments.build_parser(CALLS).parse_args(given)
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


def text_of(name: str, content: Mapping[str, Any]) -> str:
    """The result of a command for people."""
    import jinja2

    environment = jinja2.Environment(
        loader=jinja2.FileSystemLoader(Path(__file__).parent / "commands" / "templates"),
        autoescape=jinja2.select_autoescape(["html"]),
        trim_blocks=True,
    )
    return environment.get_template(f"{name}.txt").render(content, report=content).rstrip()


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
        defaults = arguments.option_defaults()
        return defaults, "\n".join(f"{key}={value}" for key, value in defaults.items()), 0
    options = arguments.run_options(args)
    files = arguments.weight_files(args.weights, [options.run.method])
    given = {"options": options, "models": Models(options.run.device, files), "command": command}
    summary, code = _call(run, args, sequence=_open(args), **given)
    if not args.quiet:
        for warning in summary.get("warnings", []):
            print(f"hybridvo: warning: {warning}", file=sys.stderr)
    return summary, text_of("run", summary), code


def _files(paths: Iterable[Any]) -> Result:
    written = [str(path) for path in paths]
    return {"files": written}, "\n".join(written), 0


def _show(args: argparse.Namespace, command: list[str]) -> Result:
    from hybridvo.evaluation.drawing import draw

    return _files([_call(draw, args, sequence=_open(args))])


def _compare(args: argparse.Namespace, command: list[str]) -> Result:
    from hybridvo.commands.compare import compare
    from hybridvo.pipeline import METHODS

    methods = tuple(name.strip() for name in args.methods.split(",") if name.strip())
    weights = arguments.weight_files(args.weights, METHODS if methods == ("all",) else methods)
    given = {"methods": methods, "weights": weights, "options": arguments.run_options(args)}
    return _files(_call(compare, args, **given, command=command))


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
    return report, text_of("evaluate", report), code


def _doctor(args: argparse.Namespace, command: list[str]) -> Result:
    from hybridvo.commands.doctor import diagnose, doctor

    if args.path:
        found = diagnose(_open(args), pairs=args.pairs)
        return found, text_of("diagnosis", found), 0 if found["ok"] else 1
    report = doctor()
    return report, text_of("doctor", report), 0


def _demo(args: argparse.Namespace, command: list[str]) -> Result:
    from hybridvo.commands.demo import demo

    content = _call(demo, args, command=command)
    return content, text_of("demo", content), 0


def _generate(args: argparse.Namespace, command: list[str]) -> Result:
    from hybridvo.commands.generate import generate
    from hybridvo.commands.progress import Progress

    with Progress("generate", args.count, "samples", quiet=args.quiet) as bar:
        sheet = _call(generate, args, report=bar.update)
    return {"contact_sheet": str(sheet)}, str(sheet), 0


def _init(args: argparse.Namespace, command: list[str]) -> Result:
    from hybridvo.data.camera_file import write_camera_template

    path = write_camera_template(args.directory)
    next_step = f"fill it in, then: hybridvo run {args.directory}"
    return {"file": str(path)}, f"{path}\n{next_step}", 0


CALLS = {
    "run": _run,
    "compare": _compare,
    "show": _show,
    "evaluate": _evaluate,
    "doctor": _doctor,
    "demo": _demo,
    "train": train,
    "generate": _generate,
    "init": _init,
}


if __name__ == "__main__":
    sys.exit(main())
