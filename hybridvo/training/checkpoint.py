"""Checkpoints of a training run: written atomically, read without running anything.

``torch.save`` of tensors and plain values, loaded with ``weights_only=True``: a checkpoint is data.
A crash while writing leaves the previous checkpoint in place.
"""

from __future__ import annotations

import contextlib
import os
import pickle
import tempfile
import zipfile
from pathlib import Path
from typing import Any

import torch

from hybridvo.errors import CheckpointError, OutputError

__all__ = ["FORMAT", "load_checkpoint", "save_checkpoint"]

FORMAT = "hybridvo-training-1"
"""Value of the ``format`` key."""

DAMAGE = (RuntimeError, pickle.UnpicklingError, EOFError, zipfile.BadZipFile, ValueError)
"""What ``torch.load`` raises for files that are no whole checkpoint."""

KEYS = ("format", "options", "network", "optimizer", "ema", "progress", "rng")


def save_checkpoint(path: str | Path, state: dict[str, Any]) -> Path:
    """Write a checkpoint so that ``path`` always holds a whole one.

    Args:
        path: of the file; its folder must exist.
        state: tensors and plain values under ``options``, ``network``, ``optimizer``, ``ema``,
            ``progress`` and ``rng``.

    Raises:
        OutputError: the file cannot be written.
    """
    path = Path(path)
    temporary = ""
    try:
        handle, temporary = tempfile.mkstemp(dir=path.parent, prefix=f".{path.name}.")
        with os.fdopen(handle, "wb") as file:
            torch.save({"format": FORMAT, **state}, file)
            file.flush()
            os.fsync(file.fileno())
        os.replace(temporary, path)
        # The rename itself must survive a power cut too.
        folder = os.open(path.parent, os.O_RDONLY)
        try:
            os.fsync(folder)
        finally:
            os.close(folder)
    except OSError as error:
        if temporary:
            with contextlib.suppress(OSError):
                os.unlink(temporary)
        raise OutputError(f"{path}: cannot write checkpoint: {error.strerror or error}.") from error
    return path


def load_checkpoint(path: str | Path) -> dict[str, Any]:
    """State of a checkpoint, on the CPU.

    Raises:
        CheckpointError: missing, truncated, not a checkpoint of this program, or with weights that
            are not finite; names the file.
    """
    path = Path(path)
    if not path.is_file():
        raise CheckpointError(f"{path}: no such checkpoint.")
    try:
        state = torch.load(path, map_location="cpu", weights_only=True)
    except (
        RuntimeError,
        pickle.UnpicklingError,
        EOFError,
        zipfile.BadZipFile,
        ValueError,
    ) as error:
        reason = str(error).strip().splitlines()[0] if str(error).strip() else "unreadable"
        raise CheckpointError(
            f"{path}: not a whole checkpoint of a training run ({reason}). Delete it, or point "
            f"--out at another folder."
        ) from None
    except OSError as error:
        raise CheckpointError(f"{path}: cannot be read: {error.strerror or error}.") from None
    if not isinstance(state, dict) or state.get("format") != FORMAT:
        found = state.get("format") if isinstance(state, dict) else type(state).__name__
        raise CheckpointError(f"{path}: expected format {FORMAT!r}, got {found!r}.")
    missing = [key for key in KEYS if key not in state]
    if missing:
        raise CheckpointError(f"{path}: incomplete, without {', '.join(missing)}.")
    broken = [
        name
        for name, value in state["network"].items()
        if value.is_floating_point() and not torch.isfinite(value).all()
    ]
    if broken:
        raise CheckpointError(f"{path}: weights that are not finite in {', '.join(broken[:6])}.")
    return state
