"""What a run has read, as a word: tells whether a resumed run would read the same.

Content counts and not its place or age, so that a copy on another machine is the same input. Beyond
:data:`WHOLE_BYTES` only parts of every file are read; there the times of the files say the rest.
"""

from __future__ import annotations

import hashlib
import os
from collections.abc import Iterable
from pathlib import Path
from typing import Any, Protocol

__all__ = ["input_hash", "input_times"]

WHOLE_BYTES = 4 * 2**30
"""Input up to this size is read from end to end: 600 frames of 1024x436 with depth and flow, in two
seconds of one core where the disk can follow."""
PARTS = 16
PART_BYTES = 4096
"""Parts of a file that are read where there is more: both ends, the rest spread evenly."""
_AT_ONCE = 2**20


class _Sequence(Protocol):
    def files(self) -> list[Path]:
        """Every file that it reads."""


def input_hash(sequence: _Sequence) -> str:
    """SHA-256 over names, sizes and content of every input file.

    Args:
        sequence: an open one.

    Returns:
        Hexadecimal; of parts of the content where there are more than :data:`WHOLE_BYTES`. A file
        that cannot be read counts as one without content.
    """
    paths = sequence.files()
    whole = _total(paths) <= WHOLE_BYTES
    digest = hashlib.sha256()
    for path in paths:
        # of a file of its own each: what has been read of one that ends early must not count
        size, content = -1, hashlib.sha256()
        try:
            with path.open("rb", buffering=0) as file:
                length = os.fstat(file.fileno()).st_size
                _read(file, length, content, whole)
            size = length
        except OSError:
            content = hashlib.sha256()
        digest.update(f"{path.name}\0{size}\0".encode(errors="surrogateescape"))
        digest.update(content.digest())
    return digest.hexdigest()


def input_times(sequence: _Sequence) -> str | None:
    """SHA-256 over the times of the input files, where their content is not read as a whole.

    Args:
        sequence: an open one.

    Returns:
        Hexadecimal, or None where :func:`input_hash` says everything.
    """
    paths = sequence.files()
    if _total(paths) <= WHOLE_BYTES:
        return None
    digest = hashlib.sha256()
    for path in paths:
        try:
            stamp = path.stat().st_mtime_ns
        except OSError:
            stamp = -1
        digest.update(f"{path.name}\0{stamp}\0".encode(errors="surrogateescape"))
    return digest.hexdigest()


def _total(paths: Iterable[Path]) -> int:
    total = 0
    for path in paths:
        try:
            total += path.stat().st_size
        except OSError:
            continue
    return total


def _read(file: Any, length: int, content: Any, whole: bool) -> None:
    if whole or length <= PARTS * PART_BYTES:
        while block := file.read(_AT_ONCE):
            content.update(block)
        return
    for part in range(PARTS):
        file.seek(part * (length - PART_BYTES) // (PARTS - 1))
        content.update(file.read(PART_BYTES))
