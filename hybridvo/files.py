"""Writing result files: completely or not at all, and always in the same form."""

from __future__ import annotations

import contextlib
import csv
import hashlib
import json
import os
import secrets
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import IO, Any, Literal

from hybridvo.errors import OutputError

__all__ = ["atomic_write", "sha256", "write_csv", "write_json"]


@contextlib.contextmanager
def atomic_write(path: str | os.PathLike[str], mode: Literal["w", "wb"] = "w") -> Iterator[IO[Any]]:
    """Open a file whose content appears under its name completely or not at all.

    The content goes into a new file of the same folder, is flushed to the disk and renamed over
    ``path``. A symbolic link at ``path`` is replaced, never followed. Text is UTF-8 with Unix line
    ends.

    Raises:
        OutputError: the file cannot be created, written or renamed; ``path`` is then unchanged.
    """
    path = Path(path)
    if path.exists() and not (path.is_file() or path.is_dir()):
        raise OutputError(f"{path}: expected a file or a new name, got a device or a pipe.")
    # not tempfile.mkstemp: its files are private (0600), results should follow the umask
    temporary = path.with_name(f".{path.name[:100]}.{os.getpid()}-{secrets.token_hex(4)}.tmp")
    text = {} if mode == "wb" else {"encoding": "utf-8", "newline": "\n"}
    try:
        with open(temporary, mode.replace("w", "x"), **text) as file:  # type: ignore[call-overload]
            yield file
            file.flush()
            os.fsync(file.fileno())
        os.replace(temporary, path)
    except OSError as error:
        raise OutputError(f"{path}: cannot be written: {error.strerror or error}.") from error
    finally:
        with contextlib.suppress(OSError):
            os.unlink(temporary)


def write_json(path: str | os.PathLike[str], value: Any) -> None:
    """Write a value as indented JSON; a number that is not finite is refused by ``json``.

    Raises:
        OutputError: the file cannot be written.
    """
    text = json.dumps(value, indent=1, allow_nan=False, ensure_ascii=False) + "\n"
    with atomic_write(path) as file:
        file.write(text)


def write_csv(
    path: str | os.PathLike[str], columns: Sequence[str], rows: Iterable[Mapping[str, Any]]
) -> None:
    """Write rows as CSV with a header line; a missing value is an empty cell.

    Raises:
        OutputError: the file cannot be written.
    """
    with atomic_write(path) as file:
        writer = csv.DictWriter(file, columns, extrasaction="ignore", lineterminator="\n")
        writer.writeheader()
        writer.writerows(rows)


def sha256(*paths: str | os.PathLike[str]) -> str:
    """Hash of the content of files, in the order given."""
    digest = hashlib.sha256()
    for path in paths:
        digest.update(Path(path).read_bytes())
    return digest.hexdigest()
