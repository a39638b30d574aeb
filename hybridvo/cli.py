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
            stream.reconfigure(errors="backslashreplace")  # file names may be no text
    try:
        args = build_parser().parse_args(given, Namespace(words=["hybridvo", *given]))
    except SystemExit as end:  # argparse: 0 after --help and --version, 2 for wrong usage
        return int(end.code or 0)
    logging.getLogger("hybridvo").setLevel(logging.ERROR if args.quiet else logging.NOTSET)
    try:
        content, code = _execute(args)
        as_json = json.dumps(content, indent=1, allow_nan=False)
        _print(as_json if args.json else text_of(args.command, content) or as_json)
        return code
    except KeyboardInterrupt as stop:  # a run says what it has saved
        print(f"hybridvo: {str(stop) or 'interrupted.'}", file=sys.stderr)
        return getattr(stop, "exit_code", 130)
    except HybridVOError as error:
        if args.verbose:
            traceback.print_exc()
        print(f"hybridvo: {error}", file=sys.stderr)
        return error.exit_code
    except Exception:
        traceback.print_exc()
        print("hybridvo: this is a bug; please report it with the lines above.", file=sys.stderr)
        return 1


def _print(text: str) -> None:
    """Print a result on stdout; an OutputError says that it cannot be written."""
    from hybridvo.errors import OutputError

    try:
        print(text, flush=True)
    except OSError as error:
        # what is left in the buffer must not fail again at the end
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        if not isinstance(error, BrokenPipeError):  # its reader has gone (`| head`)
            raise OutputError(f"stdout: cannot be written: {error.strerror}.") from error


def text_of(command: str, content: Mapping[str, Any]) -> str:
    """The result of a command for people; empty where JSON serves them too."""
    import jinja2

    if "files" in content and command != "run":
        return "\n".join(content["files"])
    loader = jinja2.FileSystemLoader(Path(__file__).parent / "commands" / "templates")
    if f"{command}.txt" not in loader.list_templates() or "run.method" in content:
        return ""
    template = jinja2.Environment(loader=loader, trim_blocks=True).get_template(f"{command}.txt")
    return template.render(content, content=content).rstrip()


def _execute(args: Namespace) -> tuple[Any, int]:
    """What a command's function gives, called with the arguments of its names; the exit code."""
    _check_folders(args)

    from hybridvo.data.sequence import open_sequence
    from hybridvo.errors import InputError
    from hybridvo.options import load_options, option_defaults

    given, device = vars(args) | {"command": args.words}, "cpu"
    if "given" in given:
        if "help" in args.given:  # --set help
            return option_defaults(), 0
        named = {place: value for place, value in given.items() if "." in place}
        given["options"] = options = load_options(args.config, args.given, named)
        device = options.run.device
    if "weights" in given:
        given["models"] = _models(args.weights, device)
    if given.get("sequence") is not None:
        parts = args.sequence, args.dataset, args.camera, args.depth_scale, args.mask
        given["sequence"] = open_sequence(*parts)
    module, name = args.call.split(":")
    function = getattr(importlib.import_module(f"hybridvo.{module}"), name)
    wanted = inspect.signature(function).parameters
    found = function(**{name: value for name, value in given.items() if name in wanted})
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
        if is_named and not os.path.exists(path) and Path(path).parent.name not in SCENE_FOLDERS:
            raise InputError(f"{path}: expected a sequence folder, got no such folder.")


def _models(given: Sequence[str], device: str) -> Any:
    """Networks, of which some weights are given as NAME=FILE."""
    from hybridvo.errors import InputError
    from hybridvo.network.models import SELECTION, Models

    known = ("selector", *SELECTION)
    files = dict(text.partition("=")[::2] for text in given)
    for name, path in files.items():
        if name not in known or not Path(path).is_file():
            expected = f"NAME=FILE with {' or '.join(known)} and a file that exists"
            raise InputError(f"--weights: expected {expected}, got {name}={path}.")
    return Models(device, files)


if __name__ == "__main__":
    sys.exit(main())
