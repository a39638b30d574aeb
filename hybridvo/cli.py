"""The command line: ``hybridvo run | demo | evaluate | doctor``.

Parses, calls, prints. Heavy modules are imported after parsing, so that ``--help`` is instant. Data
goes to stdout, progress and errors to stderr. Exit codes: 0 done, 1 a bug, 2 bad input or usage,
3 too many failed frames, 4 folder locked, 5 output cannot be written, 130 interrupted.
"""

from __future__ import annotations

import argparse
import contextlib
import io
import logging
import os
import stat
import sys
import tempfile
import traceback
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from hybridvo import __version__
from hybridvo.console import printable

__all__ = ["build_parser", "main"]

EXIT_BUG, EXIT_INPUT, EXIT_LOCKED, EXIT_OUTPUT, EXIT_INTERRUPTED = 1, 2, 4, 5, 130
CV2_NO_MEMORY = -4
"""``cv::Error::StsNoMem``."""


def build_parser() -> argparse.ArgumentParser:
    """Parser of the whole command line."""
    parser = argparse.ArgumentParser(
        prog="hybridvo",
        description="Metric camera motion with covariance from optical flow, depth and intrinsics.",
    )
    parser.add_argument("--version", action="version", version=f"hybridvo {__version__}")
    commands = parser.add_subparsers(dest="command", required=True, metavar="COMMAND")
    _add_run(commands)
    _add_demo(commands)
    _add_evaluate(commands)
    doctor = commands.add_parser(
        "doctor", help="what is missing here, or wrong with a sequence", parents=[_common()]
    )
    doctor.add_argument(
        "--sequence",
        type=_path,
        action=_Once,
        metavar="DIR",
        help="look for systematic faults of this sequence instead",
    )
    doctor.add_argument(
        "--dataset", metavar="KIND", help="kind of the sequence (default: detected)"
    )
    doctor.add_argument("--pairs", type=int, default=40, metavar="N", help="pairs (default 40)")
    doctor.set_defaults(call=_doctor)
    return parser


def _common() -> argparse.ArgumentParser:
    common = argparse.ArgumentParser(add_help=False)
    common.add_argument("--json", action="store_true", help="print the result as JSON on stdout")
    loudness = common.add_mutually_exclusive_group()
    loudness.add_argument("-v", "--verbose", action="store_true", help="more, and tracebacks")
    loudness.add_argument("-q", "--quiet", action="store_true", help="errors only")
    return common


def _path(text: str) -> str:
    """A path that was given: an empty one, of a variable that is not set, is no folder at all."""
    if not text:
        raise argparse.ArgumentTypeError("expected a path, got an empty word")
    return text


class _Once(argparse.Action):
    """An option that may be given once: of two sequences the first would silently be left out."""

    def __call__(self, parser: Any, namespace: Any, values: Any, option: Any = None) -> None:
        if getattr(namespace, f"_{self.dest}_given", False):
            parser.error(f"argument {option}: given twice; one run takes one")
        setattr(namespace, f"_{self.dest}_given", True)
        setattr(namespace, self.dest, values)


def _add_run(commands: Any) -> None:
    run = commands.add_parser(
        "run", help="estimate the camera motion of a sequence", parents=[_common()]
    )
    run.add_argument(
        "--sequence",
        required=True,
        type=_path,
        action=_Once,
        metavar="DIR",
        help="folder of the sequence",
    )
    run.add_argument("--dataset", metavar="KIND", help="kind of the sequence (default: detected)")
    run.add_argument(
        "--out",
        type=_path,
        action=_Once,
        metavar="DIR",
        help="output folder (default: runs/NAME)",
    )
    run.add_argument("--method", metavar="NAME", help="estimator (default: hybrid)")
    run.add_argument(
        "--flow", metavar="WHAT", help="auto (default), file or dis; auto: files, else DIS"
    )
    run.add_argument(
        "--polish", metavar="WHAT", help="auto (default: with --method hybrid), on or off"
    )
    run.add_argument(
        "--window",
        type=int,
        metavar="N",
        help="key frames that frames are registered to, 1: none (default: 3 with --polish, else 1)",
    )
    run.add_argument("--start", type=int, metavar="N", help="first frame (default 0)")
    run.add_argument("--stop", type=int, metavar="N", help="the one after the last frame")
    run.add_argument("--stride", type=int, metavar="N", help="step between frames (default 1)")
    run.add_argument("--device", metavar="NAME", help="auto (default), cpu or cuda")
    run.add_argument("--config", type=_path, metavar="FILE", help="YAML file of options")
    run.add_argument(
        "--set",
        action="append",
        default=[],
        dest="assignments",
        metavar="KEY=VALUE",
        help="one option, as in refinement.cutoff=2.5; may be repeated",
    )
    exists = run.add_mutually_exclusive_group()
    exists.add_argument("--resume", action="store_true", help="go on with a run that was cut off")
    exists.add_argument("--overwrite", action="store_true", help="replace the results in --out")
    run.add_argument(
        "--max-failed", type=float, metavar="SHARE", help="failed frames allowed (default 0.2)"
    )
    run.add_argument(
        "--strict",
        action="store_true",
        default=None,
        help="a broken frame ends the run with exit code 2",
    )
    run.add_argument(
        "--rrd",
        nargs="?",
        const="",
        metavar="FILE",
        help="write a Rerun recording (extra 'viz'; default: recording.rrd in the output folder)",
    )
    run.set_defaults(call=_run)


def _add_demo(commands: Any) -> None:
    demo = commands.add_parser(
        "demo", help="render a scene with moving objects and run on it", parents=[_common()]
    )
    demo.add_argument(
        "--out", type=_path, default="runs/demo", metavar="DIR", help="default: runs/demo"
    )
    demo.add_argument("--overwrite", action="store_true", help="replace the results in --out")
    demo.add_argument("--frames", type=int, default=20, metavar="N", help="default: 20")
    demo.add_argument("--seed", type=int, default=0, metavar="N", help="of the scene")
    demo.set_defaults(call=_demo)


def _add_evaluate(commands: Any) -> None:
    evaluate = commands.add_parser(
        "evaluate", help="errors of a trajectory file against the truth", parents=[_common()]
    )
    evaluate.add_argument("estimate", metavar="EST", help="estimated trajectory")
    evaluate.add_argument("truth", metavar="GT", help="true trajectory")
    evaluate.add_argument(
        "--alignment", choices=("se3", "sim3", "origin", "none"), default="se3", help="of the ATE"
    )
    evaluate.add_argument("--delta", type=int, default=1, metavar="N", help="frames of the RPE")
    evaluate.add_argument("--max-diff", type=float, metavar="S", help="seconds between matches")
    formats = ("auto", "tum", "kitti", "tartanair")
    evaluate.add_argument("--format-est", choices=formats, default="auto")
    evaluate.add_argument("--format-gt", choices=formats, default="auto")
    evaluate.add_argument("--axes-est", choices=("auto", "camera", "ned"), default="auto")
    evaluate.add_argument("--axes-gt", choices=("auto", "camera", "ned"), default="auto")
    evaluate.set_defaults(call=_evaluate)


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line; returns the exit code."""
    # One pair is too little work for several threads of torch, which wait for each other on a busy
    # machine. Here, before torch is imported, and not in the library: threads are its user's.
    os.environ.setdefault("OMP_NUM_THREADS", "1")
    _open_standard_streams()
    try:
        args = build_parser().parse_args(argv)
    except SystemExit as end:  # argparse: 0 after --help and --version, 2 for wrong usage
        return int(end.code or 0)
    command = ["hybridvo", *(sys.argv[1:] if argv is None else argv)]
    try:
        return _guarded(args.call, args, command)
    except BrokenPipeError:  # the reader of stdout has gone (`| head`)
        _drop_stdout()
        return 0


def _guarded(
    call: Callable[[argparse.Namespace, list[str]], int],
    args: argparse.Namespace,
    command: list[str],
) -> int:
    """Exit code of a command; errors become one line on stderr."""
    from hybridvo.errors import HybridVOError, LockedError, OutputError

    _prepare_caches()
    handler = logging.StreamHandler()
    handler.setFormatter(_PlainText("%(message)s"))
    logger = logging.getLogger("hybridvo")
    level = logging.DEBUG if args.verbose else logging.ERROR if args.quiet else logging.WARNING
    before = logger.level
    logger.addHandler(handler)
    logger.setLevel(level)
    try:
        return call(args, command)
    except KeyboardInterrupt:
        _complain("interrupted.")
        return EXIT_INTERRUPTED
    except BrokenPipeError:
        raise
    except HybridVOError as error:
        if args.verbose:
            traceback.print_exc()
        _complain(str(error))
        if isinstance(error, OutputError):
            return EXIT_OUTPUT
        return EXIT_LOCKED if isinstance(error, LockedError) else EXIT_INPUT
    except Exception as error:
        if lack := _lack_of_memory(error):
            if args.verbose:
                traceback.print_exc()
            _complain(lack)
            return EXIT_INPUT
        traceback.print_exc()
        _complain("this is a bug in hybridvo; please report it with the lines above.")
        return EXIT_BUG
    finally:
        logger.removeHandler(handler)
        logger.setLevel(before)


def _lack_of_memory(error: Exception) -> str:
    """What to say where memory is exhausted, else nothing; libraries' errors by name and words."""
    words = str(error)
    if (
        isinstance(error, MemoryError)
        or (type(error).__name__ == "error" and getattr(error, "code", 0) == CV2_NO_MEMORY)
        or (isinstance(error, RuntimeError) and "not enough memory" in words)
        or (isinstance(error, RuntimeError) and "can't allocate memory" in words)
    ):
        why = f" ({words.splitlines()[0].strip()})" if words.strip() else ""
        return f"out of memory{why}; smaller pictures, or fewer at a time, need less."
    if type(error).__name__ == "OutOfMemoryError":
        return "the CUDA device is out of memory; use --device cpu, or smaller pictures."
    return ""


class _PlainText(logging.Formatter):
    """Log lines without what a terminal would obey."""

    def format(self, record: logging.LogRecord) -> str:
        """The message as :func:`hybridvo.console.printable` shows it."""
        return printable(super().format(record))


def _complain(message: str) -> None:
    with contextlib.suppress(OSError, ValueError):
        print(f"hybridvo: {printable(message)}", file=sys.stderr)


def _open_standard_streams() -> None:
    """Give a closed stdin, stdout or stderr its place back, as a stream to nowhere.

    Else the next file that is opened gets the number, and what a library writes to stderr (libpng's
    warnings) lands among the results. What the terminal's alphabet lacks is written as an escape:
    a name must not end a run whose results are there.
    """
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):
            with contextlib.suppress(OSError, ValueError):
                stream.reconfigure(errors="backslashreplace")
    for number, name in enumerate(("stdin", "stdout", "stderr")):
        try:
            os.fstat(number)
        except OSError:
            if os.open(os.devnull, os.O_RDWR) != number:  # the lowest free number
                return
        if getattr(sys, name) is None:
            setattr(sys, name, open(os.devnull, "r" if number == 0 else "w", encoding="utf-8"))


def _drop_stdout() -> None:
    """Forget what stdout still holds: Python would complain again at exit."""
    with contextlib.suppress(OSError, ValueError):
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


def _prepare_caches() -> None:
    """Give numba and matplotlib a place to write where neither home nor package is writable."""
    package = Path(__file__).resolve().parent
    with contextlib.suppress(OSError, RuntimeError):  # no home at all
        if Path.home().is_dir() and os.access(Path.home(), os.W_OK):
            return
    user = os.getuid() if hasattr(os, "getuid") else 0
    with contextlib.suppress(OSError):
        scratch = Path(tempfile.gettempdir()) / f"hybridvo-{user}"
        scratch.mkdir(mode=0o700, exist_ok=True)
        found = scratch.lstat()
        # numba's cache runs what it holds: not out of a folder that somebody else has prepared
        if not stat.S_ISDIR(found.st_mode) or found.st_mode & 0o022 or found.st_uid != user:
            return
        os.environ.setdefault("MPLCONFIGDIR", str(scratch))
        if not os.access(package, os.W_OK):
            os.environ.setdefault("NUMBA_CACHE_DIR", str(scratch))


def _print(text: str) -> None:
    from hybridvo.errors import OutputError

    try:
        print(printable(text), end="" if text.endswith("\n") else "\n", flush=True)
    except BrokenPipeError:
        raise
    except OSError as error:
        _drop_stdout()
        raise OutputError(f"stdout: cannot be written: {error.strerror or error}.") from error


def _run(args: argparse.Namespace, command: list[str]) -> int:
    from hybridvo.configuration import load_options
    from hybridvo.evaluation.report import to_json
    from hybridvo.run import run
    from hybridvo.run_report import summary_text

    named = (
        *("method", "flow", "polish", "window", "start", "stop", "stride", "device"),
        *("max_failed", "strict"),
    )
    options = load_options(
        args.config, args.assignments, {name: getattr(args, name) for name in named}
    )
    mode: Any = "resume" if args.resume else "overwrite" if args.overwrite else "new"
    result = run(
        args.sequence,
        args.out,
        options,
        dataset=args.dataset,
        mode=mode,
        command=command,
        quiet=args.quiet,
        rrd=args.rrd,
    )
    _print(to_json(result.summary) if args.json else summary_text(result.summary))
    if not args.quiet:
        for warning in result.summary.get("warnings", []):
            _complain(f"warning: {warning}.")
    return result.exit_code


def _demo(args: argparse.Namespace, command: list[str]) -> int:
    from hybridvo.demo import demo

    text, code = demo(
        args.out,
        frames=args.frames,
        seed=args.seed,
        overwrite=args.overwrite,
        command=command,
        quiet=args.quiet,
        as_json=args.json,
    )
    _print(text)
    return code


def _evaluate(args: argparse.Namespace, command: list[str]) -> int:
    from hybridvo.evaluation.metrics import evaluate_files
    from hybridvo.evaluation.report import to_json
    from hybridvo.run_report import evaluation_text

    report = evaluate_files(
        args.estimate,
        args.truth,
        format_est=args.format_est,
        format_gt=args.format_gt,
        axes_est=args.axes_est,
        axes_gt=args.axes_gt,
        alignment=args.alignment,
        delta=args.delta,
        max_diff=args.max_diff,
    )
    _print(to_json(report) if args.json else evaluation_text(report))
    if report["ate_rmse_unaligned"] is None:  # not one figure: the files do not belong together
        _complain(f"nothing could be compared: {report['reasons']['ate_rmse_unaligned']}.")
        return EXIT_INPUT
    return 0


def _doctor(args: argparse.Namespace, command: list[str]) -> int:
    from hybridvo.doctor import doctor, doctor_text
    from hybridvo.evaluation.report import to_json

    if args.sequence:
        from hybridvo.data.sequence import open_sequence
        from hybridvo.diagnosis import diagnose, diagnosis_text

        found = diagnose(open_sequence(args.sequence, args.dataset), pairs=args.pairs)
        _print(to_json(found) if args.json else diagnosis_text(found))
        return 0
    report = doctor()
    _print(to_json(report) if args.json else doctor_text(report))
    return 0 if report["usable"] else EXIT_INPUT


if __name__ == "__main__":
    sys.exit(main())
