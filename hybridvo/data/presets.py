"""YAML files: a strict reader from plain mappings to frozen option dataclasses."""

from __future__ import annotations

import dataclasses
import difflib
import math
import types
import typing
from pathlib import Path
from typing import Any, TypeVar

from hybridvo.data.image_io import read_text
from hybridvo.errors import FormatError, InputError
from hybridvo.files import parse_yaml

LARGEST = 1e300
"""No whole number is larger: beyond it there is no float."""

OptionsT = TypeVar("OptionsT")


def read_yaml(path: str | Path) -> dict[str, Any]:
    """Mapping stored in a YAML file.

    Raises:
        InputError: no such file. FormatError: not plain YAML, not a mapping, or above 64 KiB.
    """
    path = Path(path)
    try:
        text = read_text(path, limit=2**16)
    except FileNotFoundError:
        message = f"{path}: no such file; presets of the project are in configs/."
        raise InputError(message) from None
    mapping = parse_yaml(text, str(path))
    if not isinstance(mapping, dict):
        raise FormatError(f"{path}: expected a mapping of keys, got {type(mapping).__name__}.")
    return mapping


def build_options(cls: type[OptionsT], mapping: Any, where: str) -> OptionsT:
    """Frozen dataclass ``cls`` from a plain mapping; fields that are left out keep their default.

    Args:
        cls: a dataclass whose fields are numbers, strings, booleans, tuples of these, or further
            such dataclasses.
        mapping: keys and values as YAML delivers them.
        where: file and key, for the message.

    Raises:
        InputError: an unknown key (the nearest known one is named) or a value of another type.
    """
    if isinstance(mapping, cls):
        return mapping
    if not isinstance(mapping, dict):
        raise InputError(f"{where}: expected a mapping of keys, got {_shown(mapping)}.")
    names = [field.name for field in dataclasses.fields(typing.cast(Any, cls))]
    hints = typing.get_type_hints(cls)
    values = {}
    for key, value in mapping.items():
        if key not in names:
            word = str(key)[:80]
            near = difflib.get_close_matches(word, names, n=1, cutoff=0.0)
            hint = f" (did you mean '{near[0]}'?)" if near else ""
            known = ", ".join(names)
            raise InputError(f"{where}: unknown key '{word}'{hint}. Known keys: {known}.")
        values[key] = _convert(hints[key], value, f"{where}: '{key}'")
    try:
        return cls(**values)
    except InputError as error:
        raise InputError(f"{where}: {error}") from error
    except TypeError as error:
        raise InputError(f"{where}: {error}.") from error


def _convert(hint: Any, value: Any, where: str) -> Any:
    """The value as the annotated type, or an InputError."""
    origin = typing.get_origin(hint)
    arguments = typing.get_args(hint)
    if origin in (types.UnionType, typing.Union):
        if value is None and type(None) in arguments:
            return None
        return _convert(next(a for a in arguments if a is not type(None)), value, where)
    if dataclasses.is_dataclass(hint):
        return build_options(typing.cast(Any, hint), value, where)
    if origin is tuple:
        if not isinstance(value, list | tuple):
            raise InputError(f"{where}: expected a list, got {_shown(value)}.")
        if len(arguments) == 2 and arguments[1] is Ellipsis:
            kinds = (arguments[0],) * len(value)
        else:
            kinds = arguments
        if len(kinds) != len(value):
            raise InputError(
                f"{where}: expected {len(kinds)} values, got {len(value)}: {_shown(value)}."
            )
        return tuple(
            _convert(kind, item, f"{where}[{i}]")
            for i, (kind, item) in enumerate(zip(kinds, value, strict=True))
        )
    if hint is Any:
        return value
    is_number = isinstance(value, int | float) and not isinstance(value, bool)
    # neither NaN nor a whole number beyond every float; infinity may be meant
    is_number = is_number and (abs(value) <= LARGEST or abs(value) == math.inf)
    if hint is float and is_number:
        return float(value)
    if hint is int and is_number and float(value).is_integer():
        return int(value)
    if hint in (bool, str) and isinstance(value, hint):
        return value
    name = getattr(hint, "__name__", str(hint))
    raise InputError(f"{where}: expected {name}, got {_shown(value)}.")


def _shown(value: Any) -> str:
    """A value as a message may hold it."""
    huge = isinstance(value, int) and value.bit_length() > 1000  # repr refuses above 4300 digits
    text = "a number of more than 300 digits" if huge else repr(value)
    return text if len(text) <= 80 else text[:77] + "..."
