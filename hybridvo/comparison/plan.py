"""What a comparison is about: methods that can run, and the sequences that a folder stands for."""

from __future__ import annotations

import hashlib
import os
from collections.abc import Sequence
from pathlib import Path

import hybridvo
from hybridvo.data.sequence import READERS
from hybridvo.data.sintel import SintelSequence
from hybridvo.errors import InputError
from hybridvo.evaluation.report_data import visible
from hybridvo.pipeline import METHODS, check_method

__all__ = ["chosen_methods", "expand", "shown_name", "unique_names", "weights_of"]

_SINTEL_FOLDERS = ("camdata_left", "depth", "final", "clean", "flow")


def chosen_methods(names: Sequence[str]) -> tuple[tuple[str, ...], dict[str, str]]:
    """Methods to run, and of those that ``all`` leaves out the reason with its remedy.

    Raises:
        InputError: no name, an unknown one, or one that cannot run here.
    """
    if list(names) != ["all"]:
        if not names:
            raise InputError(f"--methods: expected names, got none; known: {', '.join(METHODS)}.")
        for name in names:
            check_method(name)
        return tuple(dict.fromkeys(names)), {}
    runnable, missing = [], {}
    for name in METHODS:
        try:
            check_method(name)
        except InputError as error:
            missing[name] = str(error)
        else:
            runnable.append(name)
    return tuple(runnable), missing


def weights_of(methods: Sequence[str], shipped: Path | None = None) -> dict[str, str]:
    """Name and SHA-256 of the shipped weights that methods use: part of what a result depends on.

    Args:
        methods: in the comparison; those without a network use none.
        shipped: folder of the weights; default: the package's own.
    """
    folder = Path(hybridvo.__file__).parent / "network" / "shipped" if shipped is None else shipped
    used = set(methods) | ({"judge"} if {"hybrid", "hybrid-flow"} & set(methods) else set())
    return {
        path.stem: hashlib.sha256(path.read_bytes()).hexdigest()
        for path in sorted(folder.glob("*.safetensors"))
        if path.stem in used
    }


def expand(path: str | os.PathLike[str], dataset: str | None = None) -> list[Path]:
    """Sequence folders that a path stands for: itself, or all sequences that it holds.

    A folder that is no sequence is searched one level down; MPI Sintel may be given as it was
    unpacked: the folder of ``training``, ``training`` itself or one of its passes.

    Returns:
        Folders in alphabetical order; the path itself where nothing is found, so that opening it
        says what was looked for.
    """
    folder = Path(path)
    if not folder.is_dir() or any(r.matches(folder) for r in READERS if _wanted(r, dataset)):
        return [folder]
    if dataset in (None, "sintel"):
        scenes = _sintel_scenes(folder)
        if scenes:
            return scenes
    inside = [child for child in sorted(folder.iterdir()) if child.is_dir()]
    found = [c for c in inside if any(r.matches(c) for r in READERS if _wanted(r, dataset))]
    return found or [folder]


def _wanted(reader: type, dataset: str | None) -> bool:
    return dataset is None or reader.kind == dataset  # type: ignore[attr-defined]


def _sintel_scenes(folder: Path) -> list[Path]:
    """Scenes of an unpacked data set, each once; the final pass is read where there is one."""
    scenes: dict[str, Path] = {}
    absolute = folder.absolute()
    if absolute.name in _SINTEL_FOLDERS:  # a pass: its own images
        passes = [absolute]
    else:
        bases = [absolute, absolute / "training", *sorted(absolute.glob("*/training"))]
        passes = [base / name for base in bases for name in _SINTEL_FOLDERS]
    for place in passes:
        if not place.is_dir():
            continue
        for child in sorted(place.iterdir()):
            if child.name not in scenes and child.is_dir() and SintelSequence.matches(child):
                scenes[child.name] = child
    return [scenes[name] for name in sorted(scenes)]


def shown_name(name: str) -> str:
    """A name for results: one line, of characters that UTF-8 has and a reader sees.

    One that a spreadsheet would take for a formula gets ``./`` before it, in every file, so that
    all of them can still be joined by it.
    """
    shown = visible(name)
    return f"./{shown}" if shown.startswith(("=", "+", "-", "@")) else shown


def unique_names(paths: Sequence[Path], names: Sequence[str]) -> list[str]:
    """Names of sequences, with parts of their paths before those that would be told twice.

    They are fit to be shown: see :func:`shown_name`.

    Raises:
        InputError: one folder given twice.
    """
    result = [shown_name(name) for name in names]
    absolute = [path.absolute() for path in paths]
    if len(set(absolute)) < len(absolute):
        twice = next(p for p in paths if absolute.count(p.absolute()) > 1)
        raise InputError(f"--sequence {twice}: is given twice.")
    for depth in range(1, 8):
        double = {name for name in result if result.count(name) > 1}
        if not double:
            break
        for i, name in enumerate(result):
            if name in double:
                parts = absolute[i].parent.parts[-depth:]
                result[i] = shown_name("/".join((*parts, names[i])))
    return result
