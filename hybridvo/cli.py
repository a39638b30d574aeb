"""The command line: ``hybridvo run | compare | show | evaluate | doctor | demo | train | ...``.

Heavy modules are imported after parsing, so that ``--help`` is instant. Exit codes: 0 done, 1 a bug
(or ``doctor`` found something), 2 bad input, 3 too many failed frames, 4 folder locked, 5 output
cannot be written, 130 interrupted.
"""

from __future__ import annotations

import argparse
import dataclasses
import importlib
import inspect
import json
import logging
import os
import sys
import traceback
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import yaml

from hybridvo import __version__

if TYPE_CHECKING:
    from hybridvo.options import Options

COMMANDS = Path(__file__).parent / "commands"
TYPES: dict[str, Callable[[str], Any]] = {
    "int": int,
    "float": float,
    "path": Path,
    "names": lambda text: text.replace(" ", "").split(","),
}
"""Types of arguments by their names in ``commands.yaml``."""


def build_parser() -> argparse.ArgumentParser:
    """Parser of the whole command line."""
    described = yaml.safe_load((COMMANDS / "commands.yaml").read_text(encoding="utf-8"))
    parser = argparse.ArgumentParser(prog="hybridvo", description=described["about"])
    parser.add_argument("--version", action="version", version=f"hybridvo {__version__}")
    _add_commands(parser, described["commands"], described["shared"])
    return parser


def _add_commands(
    parser: argparse.ArgumentParser, commands: dict[str, Any], shared: dict[str, Any]
) -> None:
    below = parser.add_subparsers(dest="command", required=True, metavar="COMMAND")
    for name, content in commands.items():
        made = below.add_parser(
            name,
            help=content["help"],
            description=content.get("about", content["help"]),
            formatter_class=argparse.RawDescriptionHelpFormatter,
        )
        if "commands" in content:
            _add_commands(made, content["commands"], shared)
            continue
        made.set_defaults(calls=content["calls"])
        for group in ("output", *content.get("shares", ())):
            _add_arguments(made, shared[group])
        _add_arguments(made, content["arguments"])


def _add_arguments(to: Any, arguments: dict[str, Any]) -> None:
    for names, how in arguments.items():
        if names in ("one of", "exactly one of"):
            required = names == "exactly one of"
            _add_arguments(to.add_mutually_exclusive_group(required=required), how)
        else:
            made: dict[str, Any] = {"type": TYPES[how["type"]]} if "type" in how else {}
            if how.get("default") == argparse.SUPPRESS:  # which argparse compares by identity
                made["default"] = argparse.SUPPRESS
            to.add_argument(*names.split(), **how | made)


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
        content, code = _execute(args, ["hybridvo", *given])
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
    folder = COMMANDS / "templates"
    if not (folder / f"{command}.txt").is_file() or "run.method" in content:
        return ""
    loader = jinja2.FileSystemLoader(folder)
    template = jinja2.Environment(loader=loader, trim_blocks=True).get_template(f"{command}.txt")
    return template.render(content, content=content).rstrip()


def _call(function: Callable[..., Any], given: Mapping[str, Any]) -> Any:
    """The function, with those of the arguments that it has."""
    names = inspect.signature(function).parameters
    return function(**{name: value for name, value in given.items() if name in names})


def _execute(args: argparse.Namespace, command: list[str]) -> tuple[Any, int]:
    """Call the function of a command; what it gives, JSON-ready, and the exit code."""
    from hybridvo.data.sequence import open_sequence
    from hybridvo.errors import InputError
    from hybridvo.network.models import Models

    given = vars(args) | {"args": args, "command": command}
    if "given" in given:
        if "help" in args.given:
            return option_defaults(), 0
        named = {key: value for key, value in given.items() if "." in key}
        given["options"] = load_options(args.config, args.given, named)
    if "weights" in given:
        device = given["options"].run.device if "options" in given else "cpu"
        given["models"] = Models(device, weight_files(args.weights))
    if given.get("path") is not None:
        given["sequence"] = _call(open_sequence, given)
    module, _, name = args.calls.partition(":")
    found = _call(getattr(importlib.import_module(f"hybridvo.{module}"), name), given)
    if isinstance(found, tuple):
        return found
    if isinstance(found, Path | list):
        return {"files": [str(path) for path in (found if isinstance(found, list) else [found])]}, 0
    if found.get("matched") == 0:  # the files do not belong together
        raise InputError(f"nothing could be compared: {found['reasons']['ate_rmse_unaligned']}.")
    return found, 0 if found.get("ok", True) else 1


# -- options from arguments ------------------------------------------------------------------------


def option_defaults() -> dict[str, Any]:
    """Every key that ``--set`` knows, such as ``refine.cutoff``, with its default."""
    from hybridvo.options import Options

    return {
        f"{group}.{name}": value
        for group, options in dataclasses.asdict(Options()).items()
        for name, value in options.items()
    }


def load_options(
    path: str | Path | None = None,
    assignments: Iterable[str] = (),
    given: Mapping[str, Any] | None = None,
) -> Options:
    """Options from a YAML file, then from ``group.key=value`` texts, then from named values."""
    from hybridvo.errors import FormatError, InputError
    from hybridvo.files import parse_yaml, read_text
    from hybridvo.options import Options

    groups: dict[str, Any] = {}
    if path is not None:
        try:
            groups = parse_yaml(read_text(path), str(path)) or {}
        except FileNotFoundError:
            raise InputError(f"{path}: no such file.") from None
        if not isinstance(groups, dict):
            raise FormatError(f"{path}: expected 'group:' lines, got a {type(groups).__name__}.")
    values: dict[str, Any] = {}
    for text in assignments:
        key, sign, value = text.partition("=")
        if not sign or "." not in key:
            raise InputError(f"--set: expected group.key=value, as refine.cutoff=3, got {text!r}.")
        values[key.strip()] = parse_yaml(value, f"--set {key}")
    values |= {key: value for key, value in (given or {}).items() if value is not None}
    for key, value in values.items():
        group, _, name = key.partition(".")
        if isinstance(entries := groups.setdefault(group, {}), dict):
            entries[name] = value
    try:
        return Options(**groups)
    except InputError as error:
        where = " and ".join(str(x) for x in (path, assignments and "--set") if x)
        raise InputError(f"{where or 'options'}: {error} --set help lists the keys.") from None


def weight_files(weights: Iterable[str]) -> dict[str, str]:
    """Network -> file of the ``NAME=FILE`` that ``--weights`` was given."""
    from hybridvo.errors import InputError
    from hybridvo.network.models import SELECTION

    known = ("selector", *SELECTION)
    files = dict(text.partition("=")[::2] for text in weights)
    for name, path in files.items():
        if name not in known or not Path(path).is_file():
            expected = f"NAME=FILE with {' or '.join(known)} and a file that exists"
            raise InputError(f"--weights: expected {expected}, got {name}={path}.")
    return files


if __name__ == "__main__":
    sys.exit(main())
