"""Options from a YAML file and from ``--set group.key=value``, and ``--weights NAME=FILE``."""

from __future__ import annotations

import dataclasses
import difflib
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

    Example:
        >>> load_options(assignments=["refine.cutoff=2.5"]).refine.cutoff
        2.5
    """
    values = _from_file(Path(path)) if path is not None else {}
    texts = list(assignments)
    for text in texts:
        key, sign, value = text.partition("=")
        if not sign or not key.strip():
            raise InputError(
                f"--set: expected group.key=value, as in refine.cutoff=3, got {text!r}."
            )
        values[_known(key.strip(), "--set")] = parse_yaml(value, f"--set {key}")
    values |= {key: value for key, value in (given or {}).items() if value is not None}
    groups: dict[str, dict[str, Any]] = {}
    for key, value in values.items():
        group, name = key.split(".")
        groups.setdefault(group, {})[name] = value
    where = " and ".join(
        [*([str(path)] if path is not None else []), *(["--set"] if texts else [])]
    )
    try:
        return Options(
            **{
                field.name: type(getattr(Options(), field.name))(**groups.get(field.name, {}))
                for field in dataclasses.fields(Options)
            }
        )
    except InputError as error:
        raise InputError(f"{where}: {error}" if where else str(error)) from None


def _from_file(path: Path) -> dict[str, Any]:
    """Content of an options file as ``group.key`` and value."""
    try:
        content = parse_yaml(read_text(path), str(path)) or {}
    except FileNotFoundError:
        raise InputError(f"{path}: no such file.") from None
    if not isinstance(content, dict):
        raise FormatError(f"{path}: expected 'group:' lines, got a {type(content).__name__}.")
    values = {}
    for group, entries in content.items():
        if not isinstance(entries, dict):
            groups = ", ".join(field.name for field in dataclasses.fields(Options))
            raise InputError(
                f"{path}: '{group}': expected a group ({groups}) with indented keys, "
                f"got {entries!r}."
            )
        for name, value in entries.items():
            values[_known(f"{group}.{name}", str(path))] = value
    return values


def _known(key: str, where: str) -> str:
    known = list(option_defaults())
    if key not in known:
        last = key.rsplit(".", 1)[-1]
        near = difflib.get_close_matches(key, known, n=1) or [
            other for other in known if other.endswith(f".{last}")
        ]
        hint = f" (did you mean '{near[0]}'?)" if near else f"; known: {', '.join(known)}"
        raise InputError(f"{where}: unknown key '{key}'{hint}.")
    return key


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
