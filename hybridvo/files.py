"""Files: results written completely or not at all; text, lists and YAML read."""

from __future__ import annotations

import contextlib
import hashlib
import io
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
def atomic_write(path: str | os.PathLike[str], mode: Literal["w", "wb"] = "w") -> Iterator[IO[Any]]:
    """Open a file whose content appears under its name completely, or not at all (OutputError).

    A symbolic link is replaced, never followed. Text is UTF-8 with Unix line ends.
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


def make_folder(path: Path) -> None:
    """Make a folder for results, and those above it."""
    try:
        path.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise OutputError(f"{path}: cannot be created: {error.strerror or error}.") from error


@contextlib.contextmanager
def held(folder: Path) -> Iterator[None]:
    """Make a folder for results and hold it; a LockedError where another run does."""
    make_folder(folder)
    lock = filelock.FileLock(folder / LOCK, timeout=0)
    try:
        lock.acquire()
    except filelock.Timeout:
        text = f"{folder}: held by another run. Wait for it, or choose another --out."
        raise LockedError(text) from None
    except OSError as error:
        raise OutputError(f"{folder}: cannot be written: {error.strerror}.") from error
    try:
        yield
    finally:
        # removed before it is released: afterwards it may be another run's
        (folder / LOCK).unlink(missing_ok=True)
        lock.release()


def remove(*paths: Path) -> None:
    """Delete files of results that are there."""
    for path in paths:
        try:
            path.unlink(missing_ok=True)
        except OSError as error:
            raise OutputError(f"{path}: cannot be replaced: {error.strerror}.") from error


def write_json(path: str | os.PathLike[str], value: Any) -> None:
    """Write a value as indented JSON; a number that is not finite is refused by ``json``."""
    text = json.dumps(value, indent=1, allow_nan=False, ensure_ascii=False) + "\n"
    with atomic_write(path) as file:
        file.write(text)


def fingerprint(paths: Iterable[Path]) -> str:
    """SHA-256 over the names, sizes and times of files: tells whether input has changed since."""
    facts = [(path.name, path.stat().st_size, path.stat().st_mtime_ns) for path in paths]
    return hashlib.sha256(repr(facts).encode()).hexdigest()


def read_bytes(path: str | os.PathLike[str]) -> bytes:
    """Content of a file; FileNotFoundError where there is none."""
    try:
        return Path(path).read_bytes()
    except FileNotFoundError:
        raise
    except (OSError, ValueError) as error:
        raise FormatError(f"{str(path)[:200]!r}: cannot be read: {error}.") from None


def read_text(path: str | os.PathLike[str]) -> str:
    """Text of a UTF-8 file, without a byte-order mark."""
    try:
        return io.TextIOWrapper(io.BytesIO(read_bytes(path)), encoding="utf-8-sig").read()
    except UnicodeDecodeError:
        raise FormatError(f"{path}: expected a text file, got binary data.") from None


class Rows(NamedTuple):
    """A list on disk."""

    path: Path
    lines: list[int]  # of the file
    numbers: np.ndarray  # (N, C)
    words: list[list[str]]  # after the numbers

    def refuse(self, bad: np.ndarray, expected: str) -> None:
        """Name the first of the bad rows, if there is one."""
        if bad.any():
            k = int(np.argmax(bad))
            got = self.numbers[k].tolist()
            raise FormatError(f"{self.path}:{self.lines[k]}: expected {expected}, got {got}.")


def read_rows(path: Path, *columns: str, words: int = 0) -> Rows:
    """Rows of a list file: a number for each of ``columns``, the last ``words`` of them text.

    Of several ``columns`` those of the first row's number are meant; ``#`` starts a comment.
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
    """Versions of Python and of the packages that decide numbers; absent ones are left out."""
    found = {"python": platform.python_version()}
    for name in "hybridvo numpy scipy opencv-python-headless numba torch evo poselib".split():
        with contextlib.suppress(PackageNotFoundError):
            found[name] = version(name)
    return found


def made_with() -> dict[str, Any]:
    """What a record of results says of where they were made: versions, and the machine."""
    machine = {"platform": platform.platform(), "cpus": os.cpu_count()}
    return {"versions": versions(), "machine": machine}


def parse_yaml(text: str, where: str) -> Any:
    """Content of a YAML document by the safe loader, to which 1e-3 is a text."""
    try:
        return yaml.safe_load(text)
    # ValueError: dates and numbers that are none; RecursionError: thousands of brackets
    except (yaml.YAMLError, ValueError, RecursionError) as error:
        mark = getattr(error, "problem_mark", None)
        line = f":{mark.line + 1}" if mark is not None else ""
        reason = getattr(error, "problem", None) or str(error)[:200] or type(error).__name__
        raise FormatError(f"{where}{line}: not a YAML file ({reason}).") from None
