"""Options from a YAML file and from ``--set group.key=value``, and ``--weights NAME=FILE``."""

from __future__ import annotations

import dataclasses
import difflib
import re
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

from hybridvo.errors import FormatError, InputError
from hybridvo.files import parse_yaml, read_text
from hybridvo.options import Options
from hybridvo.pipeline import networks_of


def option_defaults() -> dict[str, Any]:
    """Every key that ``--set`` knows, such as ``refine.cutoff``, with its default."""
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
    """Options from a file, then from ``group.key=value`` texts, then from named values.

    ``path`` is a YAML file, or None for the defaults; the values of ``assignments`` are YAML;
    those of ``given``, such as ``{"run.method": "refine"}``, are left out where they are None.

    Raises:
        InputError: no such file, an unknown key (the nearest known one is named), a value that is
            out of bounds. FormatError: the file is no YAML mapping.

    Example:
        >>> load_options(assignments=["refine.cutoff=2.5"]).refine.cutoff
        2.5
    """
    groups: dict[str, Any] = {}
    where = [] if path is None else [str(path)]
    if path is not None:
        try:
            groups = parse_yaml(read_text(path), str(path)) or {}
        except FileNotFoundError:
            raise InputError(f"{path}: no such file.") from None
        if not isinstance(groups, dict):
            raise FormatError(f"{path}: expected 'group:' lines, got a {type(groups).__name__}.")
    values: dict[str, Any] = {}
    for text in assignments:
        where = [str(path), "--set"] if path is not None else ["--set"]
        key, sign, value = text.partition("=")
        if not sign or "." not in key:
            raise InputError(
                f"--set: expected group.key=value, as in refine.cutoff=3, got {text!r}."
            )
        values[key.strip()] = parse_yaml(value, f"--set {key}")
    values |= {key: value for key, value in (given or {}).items() if value is not None}
    for key, value in values.items():
        group, _, name = key.partition(".")
        if isinstance(entries := groups.setdefault(group, {}), dict):
            entries[name] = value
    try:
        return Options(**groups)
    except InputError as error:
        found = re.match(r"Options\.([\w.]+): unexpected", str(error))
        near = difflib.get_close_matches(found[1], option_defaults(), n=1) if found else []
        hint = f" Did you mean '{near[0]}'?" if near else ""
        raise InputError(f"{' and '.join(where)}: {error}{hint}") from None


def weight_files(weights: Iterable[str], methods: Iterable[str]) -> dict[str, str]:
    """Network -> file of the ``NAME=FILE`` that ``--weights`` was given."""
    files = {}
    known = sorted({name for method in methods for name in networks_of(method)})
    for text in weights:
        name, sign, path = text.partition("=")
        if not sign or name not in known:
            raise InputError(
                f"--weights: expected NAME=FILE with {' or '.join(known) or 'no name'} for these "
                f"methods, got {text!r}."
            )
        if not Path(path).is_file():
            raise InputError(f"--weights {name}: {path}: no such file.")
        files[name] = path
    return files
