"""The command line: parse the arguments, call a function, print its result or its error.

``commands/arguments.py`` states what a command calls, ``commands/dispatch.py`` calls it.

Exit codes: 0 done, 1 a bug (or ``doctor`` found something), 2 bad input, 3 too many failed frames,
4 folder locked, 5 output cannot be written, 128 + N stopped by signal N (130: interrupted).
"""

from __future__ import annotations

import contextlib
import io
import json
import logging
import os
import signal
import sys
import traceback
from argparse import Namespace
from collections.abc import Sequence
from typing import Any

from hybridvo.core.errors import HybridVOError, InputError, OutputError, printable
from hybridvo.run.commands.arguments import build_parser
from hybridvo.run.commands.terminal import TerminalHandler, show
from hybridvo.run.commands.text import text_of

BUG = 1
INTERRUPTED = 130

TERMINAL = TerminalHandler()


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line.

    Args:
        argv: The words after ``hybridvo``; by default those of the process.

    Returns:
        The exit code. An error is one line on stderr.
    """
    words = sys.argv[1:] if argv is None else list(argv)
    _accept_any_name_on_output()
    if any("\0" in word for word in words):
        _say("expected arguments without a NUL character.")
        return InputError.exit_code
    try:
        args = build_parser().parse_args(
            words, Namespace(words=["hybridvo", *words])
        )
    except SystemExit as end:
        # argparse: 0 after --help and --version, 2 for wrong usage
        return int(end.code or 0)
    except BrokenPipeError:
        # The reader of what `--set help` prints has gone.
        _discard_stdout()
        return 0
    logger = logging.getLogger("hybridvo")
    level = logger.level
    logger.setLevel(logging.ERROR if args.quiet else logging.NOTSET)
    logger.addHandler(TERMINAL)
    try:
        return _run_command(args)
    finally:
        # a program that calls this keeps its own settings
        logger.setLevel(level)


def _accept_any_name_on_output() -> None:
    """Let both streams print file names that are no text."""
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="backslashreplace")


def _run_command(args: Namespace) -> int:
    """Call the function of a command and print its result; returns the exit code."""
    try:
        outcome = args.call(args)
        _print_result(args, outcome.content)
        _wait_while_served(outcome.content)
        return outcome.exit_code
    except KeyboardInterrupt as stop:
        # A run states what it has saved.
        _say(str(stop) or "interrupted.")
        return getattr(stop, "exit_code", INTERRUPTED)
    except BrokenPipeError:
        # The reader of stdout has gone, as in `hybridvo ... | head`.
        _discard_stdout()
        return 0
    except HybridVOError as error:
        if args.verbose:
            _say_traceback()
        _say(str(error))
        return error.exit_code
    except OSError as error:
        # a name that is too long, a folder that may not be read
        if args.verbose:
            _say_traceback()
        name = str(error.filename)[:100]
        _say(f"{name}: cannot be used: {error.strerror or error}.")
        return InputError.exit_code
    except Exception:
        _say_traceback()
        _say("this is a bug; please report it with the lines above.")
        return BUG


def _wait_while_served(content: Any) -> None:
    """Keep a page that shows the run until Ctrl-C, where somebody can press it."""
    page = content.get("page") if isinstance(content, dict) else None
    if not page or not sys.stdin.isatty():
        return
    _say(f"{page} is there until you press Ctrl-C.")
    with contextlib.suppress(KeyboardInterrupt):
        signal.pause()


def _say(text: str) -> None:
    """Print a sentence on stderr."""
    print(printable(f"hybridvo: {text}"), file=sys.stderr)


def _say_traceback() -> None:
    """Print on stderr where the current error came from."""
    print(printable(traceback.format_exc(), keep="\n"), end="", file=sys.stderr)


def _print_result(args: Namespace, content: Any) -> None:
    """Print the result of a command on stdout: as JSON, for people, or not at all."""
    if args.quiet and not args.json:
        return
    as_json = json.dumps(content, indent=1, allow_nan=False)
    if args.json:
        text = as_json
    else:
        text = text_of(args.command, content) or as_json
    try:
        if args.json:
            print(text, flush=True)
        else:
            show(text)
    except BrokenPipeError:
        raise
    except OSError as error:
        _discard_stdout()
        raise OutputError(
            f"stdout: cannot be written: {error.strerror}."
        ) from error


def _discard_stdout() -> None:
    """Discard what stdout still holds: else Python fails once more when it ends."""
    os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


if __name__ == "__main__":
    sys.exit(main())
