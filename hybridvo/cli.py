"""The command line; heavy modules are imported after parsing, so that ``--help`` is instant.

Exit codes: 0 done, 1 a bug (or ``doctor`` found something), 2 bad input, 3 too many failed frames,
4 folder locked, 5 output cannot be written, 128 + N stopped by signal N (130: interrupted).
"""

from __future__ import annotations

import importlib
import inspect
import io
import json
import logging
import os
import sys
import traceback
from argparse import Namespace
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from hybridvo.commands.arguments import build_parser
from hybridvo.commands.terminal import TerminalHandler, printable_content, table
from hybridvo.errors import printable

TERMINAL = TerminalHandler()

SCENE_FOLDERS = (
    *("final", "clean", "albedo", "flow"),
    *("depth", "camdata_left", "invalid", "occlusions"),
)
"""Where a scene of MPI Sintel may be named that lies below another of these folders."""


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line; returns the exit code. Errors become one line on stderr."""
    from hybridvo.errors import HybridVOError

    given = sys.argv[1:] if argv is None else list(argv)
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):
            # file names may be no text
            stream.reconfigure(errors="backslashreplace")
    if any("\0" in word for word in given):
        _say("expected arguments without a NUL character.")
        return 2
    try:
        args = build_parser().parse_args(
            given, Namespace(words=["hybridvo", *given])
        )
    # argparse: 0 after --help and --version, 2 for wrong usage
    except SystemExit as end:
        return int(end.code or 0)
    except BrokenPipeError:  # the reader of what `--set help` prints has gone
        _leave_stdout()
        return 0
    logger = logging.getLogger("hybridvo")
    logger.setLevel(logging.ERROR if args.quiet else logging.NOTSET)
    logger.addHandler(TERMINAL)
    try:
        content, code = _execute(args)
        _show(args, content)
        return code
    except KeyboardInterrupt as stop:  # a run says what it has saved
        _say(str(stop) or "interrupted.")
        return getattr(stop, "exit_code", 130)
    except BrokenPipeError:  # the reader of stdout has gone (`| head`)
        _leave_stdout()
        return 0
    except HybridVOError as error:
        if args.verbose:
            _say_traceback()
        _say(str(error))
        return error.exit_code
    # a name that is too long, a folder that may not be read
    except OSError as error:
        if args.verbose:
            _say_traceback()
        _say(
            f"{str(error.filename)[:100]}: cannot be used: {error.strerror or error}."
        )
        return 2
    except Exception:
        _say_traceback()
        _say("this is a bug; please report it with the lines above.")
        return 1


def _say(text: str) -> None:
    """Write a sentence on stderr."""
    print(printable(f"hybridvo: {text}"), file=sys.stderr)


def _say_traceback() -> None:
    """Write where the error at hand came from on stderr."""
    print(printable(traceback.format_exc()), end="", file=sys.stderr)


def _show(args: Namespace, content: Any) -> None:
    """Write the result of a command on stdout: as JSON, for people, or not at all."""
    if args.quiet and not args.json:
        return
    as_json = json.dumps(content, indent=1, allow_nan=False)
    text = as_json if args.json else text_of(args.command, content) or as_json
    try:
        print(text, flush=True)
    except BrokenPipeError:
        raise
    except OSError as error:
        from hybridvo.errors import OutputError

        _leave_stdout()
        raise OutputError(
            f"stdout: cannot be written: {error.strerror}."
        ) from error


def _leave_stdout() -> None:
    """Let what stdout still holds go nowhere, or Python fails once more at its end."""
    os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


def text_of(command: str, content: Mapping[str, Any]) -> str:
    """The result of a command for people; empty where JSON serves them too."""
    import jinja2

    content = printable_content(content)
    loader = jinja2.FileSystemLoader(
        Path(__file__).parent / "commands" / "templates"
    )
    if f"{command}.txt" in loader.list_templates():
        environment = jinja2.Environment(loader=loader, trim_blocks=True)
        environment.filters |= {"summary": _summary, "table": table}
        template = environment.get_template(f"{command}.txt")
        return template.render(content, content=content).rstrip()
    return "\n".join(content.get("files", ()))


def _summary(totals: list[dict[str, Any]]) -> list[dict[str, str]]:
    """The short table of a comparison."""
    from hybridvo.evaluation.report import summary_rows

    return summary_rows(totals)


def _execute(args: Namespace) -> tuple[Any, int]:
    """What a command's function gives, called with the arguments of its names; the exit code."""
    _check_folders(args)

    from hybridvo.data.open import open_sequence
    from hybridvo.errors import InputError
    from hybridvo.options import load_options

    given = vars(args) | {"command": args.words}
    device = "cpu"
    if "given" in given:
        named = {place: value for place, value in given.items() if "." in place}
        given["options"] = options = load_options(args.config, args.given, named)
        device = options.run.device
    if "weights" in given:
        given["models"] = _models(args.weights, device)
    if given.get("sequence") is not None:
        parts = (
            args.sequence,
            args.dataset,
            args.camera,
            args.depth_scale,
            args.mask,
        )
        given["sequence"] = open_sequence(*parts)
    module, name = args.call.split(":")
    function = getattr(importlib.import_module(f"hybridvo.{module}"), name)
    wanted = inspect.signature(function).parameters
    found = function(
        **{name: value for name, value in given.items() if name in wanted}
    )
    content, code = found if isinstance(found, tuple) else (found, 0)
    if isinstance(content, Path | list):  # what was written
        paths = [content] if isinstance(content, Path) else content
        content = {"files": [str(path) for path in paths]}
    if content.get("matched") == 0:  # trajectories that do not belong together
        why = content["reasons"]["ate_rmse_unaligned"]
        raise InputError(f"nothing could be compared: {why}.")
    return content, code


def _check_folders(args: Namespace) -> None:
    """Refuse sequences that are not there, and names that no file can have, before the imports."""
    from hybridvo.errors import InputError
    from hybridvo.files import check_name

    for name in ("out", "directory", "estimate", "gt"):
        check_name(Path(getattr(args, name, None) or "."))
    for path in (getattr(args, "sequence", None), *getattr(args, "sequences", ())):
        is_named = path is not None and "help" not in getattr(args, "given", ())
        if (
            is_named
            and not os.path.exists(path)
            and Path(path).parent.name not in SCENE_FOLDERS
        ):
            raise InputError(
                f"{path}: expected a sequence folder, got no such folder."
            )


def _models(given: Sequence[str], device: str) -> Any:
    """Networks, of which some weights are given as NAME=FILE."""
    from hybridvo.errors import InputError
    from hybridvo.network.models import SELECTION, Models

    known = ("selector", *SELECTION)
    files = {}
    for text in given:
        name, _, path = text.partition("=")
        if name not in known or not Path(path).is_file():
            expected = f"NAME=FILE with {' or '.join(known)} and a file that exists"
            example = "as in pwvo=mine.safetensors"
            raise InputError(
                f"--weights: expected {expected}, {example}; got {text}."
            )
        files[name] = path
    return Models(device, files)


if __name__ == "__main__":
    sys.exit(main())
