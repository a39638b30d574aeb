"""Checkpoints of a training run: written atomically, read without running anything.

``torch.save`` of tensors and plain values, loaded with ``weights_only=True``: a checkpoint is data.
What a file declares is checked before: the few types that a training run writes, no compression,
no tensor larger than the file. A crash while writing leaves the previous checkpoint in place.
"""

from __future__ import annotations

import contextlib
import os
import pickletools
import tempfile
import zipfile
from pathlib import Path
from typing import Any

import torch

from hybridvo.errors import CheckpointError, OutputError

__all__ = ["FORMAT", "check_seed", "load_checkpoint", "save_checkpoint"]

FORMAT = "hybridvo-training-1"
"""Value of the ``format`` key."""

KEYS: dict[str, tuple[type, ...]] = {
    "options": (dict,),
    "network": (dict,),
    "optimizer": (dict,),
    "ema": (dict, type(None)),
    "progress": (dict,),
    "rng": (dict, torch.Tensor),
}
"""What a checkpoint holds beside its format."""

MAGIC = b"PK\x03\x04"
MAX_STRUCTURE = 2**24
"""Bytes of the file without its tensors; a training run's are below 0.1 MB."""

_NUMBERS = ("Float", "Double", "Half", "BFloat16", "Byte", "Char", "Short", "Int", "Long", "Bool")
WRITTEN = {
    "collections OrderedDict",
    "torch._utils _rebuild_tensor_v2",
    *(f"torch {number}Storage" for number in _NUMBERS),
}
"""What a training run's checkpoint names. ``weights_only`` allows more, such as a bytearray of any
length."""


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
    if not os.path.isfile(path):  # where Path.is_file() raises: a name that is too long
        raise CheckpointError(f"{path}: no such checkpoint.")
    try:
        _check_archive(path)
        state = torch.load(path, map_location="cpu", weights_only=True)
    except CheckpointError:
        raise
    except OSError as error:
        raise CheckpointError(f"{path}: cannot be read: {error.strerror or error}.") from None
    # zipfile and the stack machine of weights_only raise whatever damaged bytes lead them to
    except Exception as error:
        reason = str(error).strip().splitlines()[0] if str(error).strip() else "unreadable"
        raise _damaged(path, reason[:200]) from None
    if not isinstance(state, dict) or state.get("format") != FORMAT:
        found = repr(state.get("format")) if isinstance(state, dict) else type(state).__name__
        raise CheckpointError(f"{path}: expected format {FORMAT!r}, got {found[:80]}.")
    missing = [key for key in KEYS if key not in state]
    if missing:
        raise CheckpointError(f"{path}: incomplete, without {', '.join(missing)}.")
    for key, kinds in KEYS.items():
        if not isinstance(state[key], kinds):
            raise _damaged(path, f"{key} is of type {type(state[key]).__name__}")
    _check_tensors(path, state)
    broken = [
        str(name)[:80]
        for name, value in state["network"].items()
        if not isinstance(value, torch.Tensor)
        or (value.is_floating_point() and not torch.isfinite(value).all())
    ]
    if broken:
        raise CheckpointError(f"{path}: weights that are not finite in {', '.join(broken[:6])}.")
    return state


def check_seed(path: str | Path, state: dict[str, Any], asked: int, remedy: str) -> None:
    """Refuse to go on with a training under another seed.

    Args:
        path: of the checkpoint.
        state: its content.
        asked: seed of this run.
        remedy: end of the message, in which ``{seed}`` is that of the checkpoint.

    Raises:
        CheckpointError: the seeds differ.
    """
    seed = state["options"].get("seed", asked)
    if seed != asked:
        raise CheckpointError(
            f"{path}: was trained with seed {seed}, this run asks for seed {asked}"
            + remedy.format(seed=seed)
        )


def _damaged(path: Path, reason: str) -> CheckpointError:
    return CheckpointError(
        f"{path}: not a whole checkpoint of a training run ({reason}). Delete it, or point "
        f"--out at another folder."
    )


def _check_archive(path: Path) -> None:
    """Refuse a file that is no plain archive of ``torch.save``, before torch looks at it."""
    with path.open("rb") as file:
        head = file.read(len(MAGIC))
    if head != MAGIC:
        raise _damaged(path, f"expected a zip archive, got bytes {head!r}")
    with zipfile.ZipFile(path) as archive:
        entries = archive.infolist()
        if any(entry.compress_type != zipfile.ZIP_STORED for entry in entries):
            raise _damaged(path, "compressed entries, which torch does not write")
        if sum(entry.file_size for entry in entries) > path.stat().st_size:
            raise _damaged(path, "entries that are larger than the file")
        structures = [entry for entry in entries if entry.filename.endswith("data.pkl")]
        if len(structures) != 1 or structures[0].file_size > MAX_STRUCTURE:
            raise _damaged(path, "expected one data.pkl of at most 16 MiB")
        content = archive.read(structures[0])
    # read as a list of opcodes: nothing is run
    for opcode, argument, _ in pickletools.genops(content):
        if opcode.name in ("GLOBAL", "STACK_GLOBAL", "INST") and argument not in WRITTEN:
            raise _damaged(path, f"names {str(argument)[:80]!r}, which no training run writes")


def _check_tensors(path: Path, state: dict[str, Any]) -> None:
    """Refuse tensors that repeat their storage: a few bytes may stand for terabytes."""
    most = path.stat().st_size
    seen: set[int] = set()
    waiting: list[Any] = [state]
    while waiting:
        value = waiting.pop()
        if id(value) in seen:
            continue
        seen.add(id(value))
        if isinstance(value, torch.Tensor):
            if value.numel() * value.element_size() > most:
                raise _damaged(path, f"a tensor of shape {tuple(value.shape)} in {most} bytes")
        elif isinstance(value, dict):
            waiting += value.values()
        elif isinstance(value, list | tuple):
            waiting += value
