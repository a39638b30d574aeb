"""The command line's parser, made of ``commands.yaml``, and options from arguments.

Loads nothing heavy: help must be instant.
"""

from __future__ import annotations

import argparse
import dataclasses
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import yaml

from hybridvo import __version__

if TYPE_CHECKING:
    from hybridvo.options import Options

TYPES: dict[str, Callable[[str], Any]] = {
    "int": int,
    "float": float,
    "path": Path,
    "names": lambda text: text.replace(" ", "").split(","),
}
"""Types of arguments by their names in ``commands.yaml``."""


def build_parser() -> argparse.ArgumentParser:
    """Parser of the whole command line."""
    text = Path(__file__).with_name("commands.yaml").read_text(encoding="utf-8")
    described = yaml.safe_load(text)
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


def option_defaults() -> dict[str, Any]:
    """Every key that ``--set`` knows, such as ``refine.cutoff``, with its default."""
    from hybridvo.options import Options

    return {
        f"{group}.{name}": value
        for group, options in dataclasses.asdict(Options()).items()
        for name, value in options.items()
    }


def run_options(args: argparse.Namespace) -> Options:
    """Options from the arguments of ``run`` or ``compare``."""
    names = ("method", "start", "stop", "stride", "device", "max_failed", "strict", "seed")
    named = {f"run.{name}": getattr(args, name, None) for name in names}
    return load_options(args.config, args.given, named | {"flow.source": args.flow})


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
