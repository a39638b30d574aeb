"""Option files: YAML mappings to frozen dataclasses, and the kinds of data that a file can name."""

from __future__ import annotations

from pathlib import Path
from typing import Any, Protocol, TypeVar

import numpy as np

from hybridvo.errors import FormatError, InputError
from hybridvo.files import parse_yaml
from hybridvo.synthetic.diverse import DiverseOptions
from hybridvo.synthetic.layered import Sample
from hybridvo.synthetic.paper import PaperOptions

PRESETS: dict[str, type] = {"paper": PaperOptions, "diverse": DiverseOptions}
"""Generators by the name that a file gives under ``preset``."""

OptionsT = TypeVar("OptionsT")


class Preset(Protocol):
    """What training samples are drawn from."""

    def sample(self, rng: np.random.Generator) -> Sample:
        """One pair; depends on the generator alone."""


def read_yaml(path: str | Path) -> dict[str, Any]:
    """Mapping that a YAML file holds, over the one of the file that it ``extends``.

    Raises:
        InputError: no such file. FormatError: not YAML, or not a mapping.
    """
    try:
        mapping = parse_yaml(Path(path).read_text(encoding="utf-8"), str(path))
    except FileNotFoundError:
        raise InputError(f"{path}: no such file; those of the project are in configs/.") from None
    except UnicodeDecodeError as error:
        raise FormatError(f"{path}: not UTF-8: {error}.") from None
    if not isinstance(mapping, dict):
        raise FormatError(f"{path}: expected a mapping of keys, got {type(mapping).__name__}.")
    if "extends" in mapping:
        base = read_yaml(Path(path).parent / str(mapping.pop("extends")))
        mapping = _merged(base, mapping)
    return mapping


def _merged(base: dict[str, Any], changes: dict[str, Any]) -> dict[str, Any]:
    """Base with changes, mapping by mapping."""
    merged = dict(base)
    for key, value in changes.items():
        old = merged.get(key)
        if isinstance(old, dict) and isinstance(value, dict):
            merged[key] = _merged(old, value)
        else:
            merged[key] = value
    return merged


def build_options(cls: type[OptionsT], mapping: dict[str, Any], where: str) -> OptionsT:
    """Options of a class from plain values; keys that are left out keep their default.

    Raises:
        InputError: an unknown key or a value out of bounds, with its place.
    """
    try:
        return cls(**mapping)
    except (InputError, TypeError) as error:
        raise InputError(f"{where}: {error}") from None


def load_preset(
    path: str | Path,
    kinds: dict[str, type] = PRESETS,
    size: tuple[int, int] | None = None,
) -> Preset:
    """Generator that a file such as ``configs/data_paper.yaml`` describes.

    Args:
        path: of the file.
        kinds: what it may name under ``preset``.
        size: (height, width) of the samples instead of the file's own.

    Raises:
        InputError: no such file, an unknown kind or key, or a value that cannot be meant.
    """
    mapping = read_yaml(path)
    kind = mapping.pop("preset", None)
    if kind not in kinds:
        raise InputError(f"{path}: preset: expected one of {', '.join(kinds)}, got {kind!r}.")
    if size is not None:
        mapping |= dict(zip(("height", "width"), size, strict=True))
    return build_options(kinds[kind], mapping, str(path))
