"""Writing results completely or not at all; reading text, lists and YAML."""

from __future__ import annotations

import contextlib
import hashlib
import json
import os
import platform
import secrets
from collections.abc import Iterable, Iterator
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import IO, Any, Literal, NamedTuple

import filelock
import numpy as np
import yaml

from hybridvo.errors import FormatError, LockedError, OutputError

Mode = Literal["new", "resume", "overwrite"]
"""What to do with the results that a folder holds already."""
LOCK = ".run.lock"


@contextlib.contextmanager
def _output_errors(path: Path, failure: str) -> Iterator[None]:
    """Turn an OSError into an OutputError that names the path and what failed."""
    try:
        yield
    except OSError as error:
        raise OutputError(f"{path}: {failure}: {error.strerror or error}.") from error


@contextlib.contextmanager
def atomic_write(path: str | Path, mode: Literal["w", "wb"] = "w") -> Iterator[IO[Any]]:
    """Open a file whose content appears under its name completely, or not at all.

    A symbolic link is replaced, never followed. Text is UTF-8 with Unix line ends. What cannot be
    written is an OutputError.
    """
    path = Path(path)
    if path.exists() and not (path.is_file() or path.is_dir()):
        raise OutputError(f"{path}: expected a file or a new name, got a device or a pipe.")
    # not tempfile.mkstemp: its files are private (0600), results should follow the umask
    temporary = path.with_name(f".{path.name[:100]}.{os.getpid()}-{secrets.token_hex(4)}.tmp")
    text = {} if mode == "wb" else {"encoding": "utf-8", "newline": "\n"}
    try:
        with _output_errors(path, "cannot be written"):
            with open(temporary, mode.replace("w", "x"), **text) as file:  # type: ignore[call-overload]
                yield file
                file.flush()
                os.fsync(file.fileno())
            os.replace(temporary, path)
    finally:
        with contextlib.suppress(OSError):
            os.unlink(temporary)


def make_folder(path: Path) -> None:
    """Make a folder for results, and those above it."""
    with _output_errors(path, "cannot be created"):
        path.mkdir(parents=True, exist_ok=True)


@contextlib.contextmanager
def held(folder: Path) -> Iterator[None]:
    """Make a folder for results and lock it; a LockedError says that another run has done so."""
    make_folder(folder)
    lock = filelock.FileLock(folder / LOCK, timeout=0)
    with _output_errors(folder, "cannot be written"):
        try:
            lock.acquire()
        except filelock.Timeout:
            text = f"{folder}: held by another run. Wait for it, or choose another --out."
            raise LockedError(text) from None
    try:
        yield
    finally:
        # removed before it is released: afterwards it may be another run's
        (folder / LOCK).unlink(missing_ok=True)
        lock.release()


def remove(*paths: Path) -> None:
    """Delete those files of results that are there."""
    for path in paths:
        with _output_errors(path, "cannot be replaced"):
            path.unlink(missing_ok=True)


def write_json(path: str | Path, value: Any) -> None:
    """Write a value as indented JSON; a ValueError refuses numbers that are not finite."""
    text = json.dumps(value, indent=1, allow_nan=False, ensure_ascii=False) + "\n"
    with atomic_write(path) as file:
        file.write(text)


def fingerprint(paths: Iterable[Path]) -> str:
    """Return the SHA-256 of names, sizes and times of files, which tells whether they changed."""
    facts = [(path.name, path.stat().st_size, path.stat().st_mtime_ns) for path in paths]
    return hashlib.sha256(repr(facts).encode()).hexdigest()


def read_bytes(path: str | Path) -> bytes:
    """Read a file; a FileNotFoundError says that it is not there, a FormatError anything else."""
    try:
        return Path(path).read_bytes()
    except FileNotFoundError:
        raise
    except (OSError, ValueError) as error:
        raise FormatError(f"{str(path)[:200]!r}: cannot be read: {error}.") from None


def read_text(path: str | Path) -> str:
    """Read a UTF-8 file as text, with Unix line ends and without a byte-order mark."""
    try:
        return read_bytes(path).decode("utf-8-sig").replace("\r\n", "\n")
    except UnicodeDecodeError:
        raise FormatError(f"{path}: expected a text file, got binary data.") from None


class Rows(NamedTuple):
    """The rows of a list on disk."""

    path: Path
    lines: list[int]  # (N,) line of the file in which each row stands
    numbers: np.ndarray  # (N, C)
    words: list[list[str]]  # (N,) the words after the numbers

    def refuse(self, bad: np.ndarray, expected: str) -> None:
        """Raise a FormatError that names the first bad row, if there is one."""
        if bad.any():
            k = int(np.argmax(bad))
            got = self.numbers[k].tolist()
            raise FormatError(f"{self.path}:{self.lines[k]}: expected {expected}, got {got}.")


def read_rows(path: Path, *columns: str, words: int = 0) -> Rows:
    """Read a list file: a number for each word of ``columns``, of which the last are text.

    ``words`` is the number of text columns. Of several ``columns`` those hold that have as many
    words as the first row. ``#`` starts a comment.
    """
    lines, numbers, after = list[int](), [], []
    for line, text in enumerate(read_text(path).split("\n"), start=1):
        count = len(columns[0].split())
        plain = text.strip() if words else text.partition("#")[0].replace(",", " ")
        parts = plain.split(maxsplit=count - 1 if words else -1)
        if not parts or plain.startswith("#"):
            continue
        if not lines:
            columns = tuple(c for c in columns if len(c.split()) == len(parts)) or columns
            count = len(columns[0].split())
        try:
            numbers.append([float(part) for part in parts[: count - words]])
        except ValueError:
            parts = []
        if len(parts) != count:
            expected = "' or '".join(columns)
            raise FormatError(f"{path}:{line}: expected '{expected}', got {text.strip()[:80]!r}.")
        lines.append(line)
        after.append(parts[count - words :])
    shape = len(lines), len(columns[0].split()) - words
    return Rows(path, lines, np.array(numbers).reshape(shape), after)


def versions() -> dict[str, str]:
    """Return the versions of Python and of the installed packages on which numbers depend."""
    found = {"python": platform.python_version()}
    for name in "hybridvo numpy scipy opencv-python-headless numba torch evo poselib".split():
        with contextlib.suppress(PackageNotFoundError):
            found[name] = version(name)
    return found


def made_with() -> dict[str, Any]:
    """Return versions and machine, which are written beside results."""
    machine = {"platform": platform.platform(), "cpus": os.cpu_count()}
    return {"versions": versions(), "machine": machine}


def parse_yaml(text: str, where: str) -> Any:
    """Parse a YAML document by the safe loader, to which 1e-3 is a text."""
    try:
        return yaml.safe_load(text)
    # ValueError: dates and numbers that are none; RecursionError: thousands of brackets
    except (yaml.YAMLError, ValueError, RecursionError) as error:
        mark = getattr(error, "problem_mark", None)
        line = f":{mark.line + 1}" if mark is not None else ""
        reason = getattr(error, "problem", None) or str(error)[:200] or type(error).__name__
        raise FormatError(f"{where}{line}: not a YAML file ({reason}).") from None
