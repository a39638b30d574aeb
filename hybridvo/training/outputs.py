"""What a training may replace: what a training has written, and nothing of anybody else's."""

from __future__ import annotations

import json
import os
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

from hybridvo.checks import make_folder
from hybridvo.errors import CheckpointError, InputError
from hybridvo.network.weights import load_weights
from hybridvo.training.checkpoint import load_checkpoint

__all__ = ["check_export", "check_folder"]

CHECKPOINT, LOG = "checkpoint.pt", "log.jsonl"


def check_folder(out: Path, record: str, wrote_it: Iterable[str]) -> None:
    """Refuse a folder in which a training would write over files that no training has written.

    A training's folder has a record that says so, or a checkpoint that can be read. A record that
    is damaged counts as a training's: a killed one may have left it.

    Args:
        out: folder of the training; need not exist.
        record: name of the file in which the training says what it is.
        wrote_it: keys of that file.

    Raises:
        InputError: files of a training's names, and no training wrote them.
    """
    present = [name for name in (CHECKPOINT, LOG, record) if os.path.lexists(out / name)]
    for name in present:
        if not (out / name).is_file():
            raise InputError(f"{out / name}: a training writes a file of that name. Move it away.")
    if not present:
        return
    if record in present:
        content = _read_json(out / record)
        ours = content is None or (isinstance(content, dict) and set(wrote_it) <= set(content))
    else:
        ours = CHECKPOINT in present and _is_read_by(load_checkpoint, out / CHECKPOINT)
    if not ours:
        raise InputError(
            f"{out}: holds {', '.join(present)}, and no {record} that says a training wrote it: "
            f"not replaced. Move it away, or choose another --out."
        )


def check_export(path: Path, out: Path, record: str) -> None:
    """Refuse a name for weights that is taken by something else, hours before they are written.

    Weights of this program and their card are replaced as before: the same command goes on with a
    training and exports again.

    Args:
        path: of the weights; the card stands beside them, as ``.json``.
        out: folder of the training.
        record: name of the file in which the training says what it is.

    Raises:
        InputError: a name that is the card's or the training's own, of no file, or of a file that
            holds no weights.
        OutputError: no folder for it.
    """
    if path.is_dir() or path.suffix == ".json":
        got = "a folder" if path.is_dir() else "that of its model card"
        raise InputError(f"--export {path}: expected the name of a file of weights, got {got}.")
    make_folder(path.parent)
    card = path.with_suffix(".json")
    own = {_place(out / name) for name in (CHECKPOINT, LOG, record)}
    for target, ours in ((path, _is_weights), (card, _is_card)):
        if _place(target) in own:
            raise InputError(
                f"--export {path}: {target} is a file of the training itself. Choose another name."
            )
        if not os.path.lexists(target):
            continue
        if target.exists() and not target.is_file():
            raise InputError(f"--export {path}: {target} is no file, and is not replaced.")
        if not ours(target):
            raise InputError(
                f"--export {path}: {target} is there already, and no training wrote it: not "
                f"replaced. Move it away, or choose another name."
            )


def _place(path: Path) -> str:
    """Where a name lies: its folder without links, itself as it is (writing replaces a link)."""
    return os.path.join(os.path.realpath(path.parent), path.name)


def _read_json(path: Path) -> Any:
    try:
        return json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError, RecursionError):
        return None


def _is_read_by(load: Callable[[Path], Any], path: Path) -> bool:
    try:
        load(path)
    except CheckpointError:
        return False
    return True


def _is_weights(path: Path) -> bool:
    return _is_read_by(load_weights, path)


def _is_card(path: Path) -> bool:
    card = _read_json(path)
    return isinstance(card, dict) and {"options", "held_out", "command"} <= set(card)
