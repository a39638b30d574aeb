"""What a comparison works on: sequences that a folder stands for, methods that run, shared flow."""

from __future__ import annotations

import logging
import os
import time
from collections.abc import Sequence as Several
from pathlib import Path

import numpy as np

from hybridvo.data.sequence import Sequence, open_sequence
from hybridvo.errors import HybridVOError, InputError
from hybridvo.flow import FlowField, dis_flow, file_flow
from hybridvo.network.models import Models
from hybridvo.pipeline import METHODS, check_method
from hybridvo.types import Frame

SINTEL_FOLDERS = ("camdata_left", "depth", "flow", "clean", "final")
"""Folders of MPI Sintel that hold a folder per scene; the images of the last one are read."""
CAMERA_FLOW_KINDS = ("tartanair",)
"""Data sets whose true flow is that of the camera alone: it does not show what moves by itself."""

_logger = logging.getLogger(__name__)


def methods_to_run(
    names: Several[str], models: Models | None = None
) -> tuple[tuple[str, ...], dict[str, str]]:
    """Methods to run, and of those that ``all`` leaves out the reason with its remedy.

    Raises:
        InputError: no name, an unknown one, or one that cannot run here.
    """
    if list(names) != ["all"]:
        if not names:
            raise InputError(f"--methods: expected names, got none; known: {', '.join(METHODS)}.")
        for name in names:
            check_method(name, models)
        return tuple(dict.fromkeys(names)), {}
    runnable, missing = [], {}
    for name in METHODS:
        try:
            check_method(name, models)
            runnable.append(name)
        except InputError as error:
            missing[name] = str(error)
    return tuple(runnable), missing


def expand(path: str | os.PathLike[str], dataset: str | None = None) -> list[Path]:
    """Sequence folders that a path stands for: itself, or all sequences that it holds.

    A folder that is no sequence is searched one level down; MPI Sintel may be given as it was
    unpacked, as its folder ``training``, or as one of its passes.
    """
    folder = Path(path)
    if not folder.is_dir():
        return [folder]
    if dataset in (None, "sintel"):
        absolute = folder.absolute()
        if absolute.name in SINTEL_FOLDERS and (absolute.parent / "camdata_left").is_dir():
            return [child for child in sorted(absolute.iterdir()) if child.is_dir()]
        for base in (absolute, absolute / "training", *sorted(absolute.glob("*/training"))):
            if (base / "camdata_left").is_dir():
                scenes = {}
                for name in SINTEL_FOLDERS:
                    for child in sorted((base / name).glob("*/")):
                        scenes[child.name] = child
                return [scenes[name] for name in sorted(scenes)]
    if _opens(folder, dataset):
        return [folder]
    inside = [child for child in sorted(folder.iterdir()) if child.is_dir()]
    return [child for child in inside if _opens(child, dataset)] or [folder]


def _opens(folder: Path, dataset: str | None) -> bool:
    try:
        open_sequence(folder, dataset)
    except HybridVOError:
        return False
    return True


class SharedFlow:
    """Flow provider that several trackers ask for the same pairs, computed once and timed apart.

    Attributes:
        label: what results call the source; ``(true)`` names an oracle.
        ms: of the last pair, milliseconds.
    """

    def __init__(self, name: str, sequence: Sequence) -> None:
        self._provider = file_flow(sequence) if name == "file" else dis_flow()
        self._name = name
        self._known: dict[tuple[int, int], FlowField] = {}
        self.label = f"{name} (true)" if name == "file" and sequence.flow_is_true else name
        self.ms = 0.0

    def prepare(self, prev: Frame, curr: Frame) -> None:
        """Compute the flow of the next pair and forget those before."""
        self._known.clear()
        started = time.perf_counter()
        self(prev, curr)
        self.ms = 1e3 * (time.perf_counter() - started)

    def __call__(self, prev: Frame, curr: Frame) -> FlowField:
        """Flow from ``prev`` to ``curr``; none where its file is damaged."""
        key = prev.index, curr.index
        if key not in self._known:
            try:
                self._known[key] = self._provider(prev, curr)
            except (InputError, OSError) as error:
                _logger.warning("flow of frame %d: %s", prev.index, error)
                self._known[key] = FlowField(None, source=self._name)
        return self._known[key]


def true_flow(sequence: Sequence, index: int) -> np.ndarray | None:
    """True flow (H, W, 2) of the whole scene from a frame to the next, NaN where it is unknown.

    None where there is none, or where it is that of the camera alone. No estimate ever sees it.
    """
    if not (sequence.has_flow and sequence.flow_is_true) or sequence.kind in CAMERA_FLOW_KINDS:
        return None
    try:
        return sequence.flow(index)[0]
    except (InputError, OSError):
        return None
