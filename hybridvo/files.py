"""Writing results completely or not at all; reading text, lists and YAML."""

from __future__ import annotations

import contextlib
import errno
import hashlib
import json
import os
import platform
import re
import secrets
import stat
from collections.abc import Iterable, Iterator
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import IO, Any, Literal, NamedTuple

import filelock
import numpy as np
import yaml

from hybridvo.errors import FormatError, InputError, LockedError, OutputError

Mode = Literal["new", "resume", "overwrite"]
"""What to do with the results that a folder holds already."""
LOCK = ".run.lock"
TEXT: dict[str, Any] = {
    "encoding": "utf-8",
    "newline": "\n",
    "errors": "backslashreplace",
}
"""How text is written. A file's name may hold bytes that are no text: JSON reads them back so."""
UNFINISHED = re.compile(r"\..+\.\d+-[0-9a-f]{8}\.tmp")
"""Names of files that :func:`atomic_write` has not completed."""

# What a file may cost that a stranger made; no file of use comes near.
LARGEST_FILE = 2**30  # bytes
LARGEST_TEXT = 2**26  # bytes of a list: 64 MB, four hours of poses at 50 Hz
MOST_ROWS = 2**20  # lines of a list: half an hour at 500 Hz
LARGEST_YAML = 2**20  # characters
MOST_NODES = 10_000  # keys, values, lists of a YAML file
LONGEST_NUMBER = 60  # characters of a number in one


@contextlib.contextmanager
def _output_errors(path: Path, failure: str) -> Iterator[None]:
    """Turn an OSError into an OutputError that names the path and what failed."""
    try:
        yield
    except OSError as error:
        raise OutputError(
            f"{path}: {failure}: {error.strerror or error}."
        ) from error


@contextlib.contextmanager
def atomic_write(
    path: str | Path, mode: Literal["w", "wb"] = "w"
) -> Iterator[IO[Any]]:
    """Open a file whose content appears under its name completely, or not at all.

    A symbolic link is replaced, never followed. Text is UTF-8 with Unix line ends. What cannot be
    written is an OutputError.
    """
    path = Path(path)
    if path.exists() and not (path.is_file() or path.is_dir()):
        raise OutputError(
            f"{path}: expected a file or a new name, got a device or a pipe."
        )
    # not tempfile.mkstemp: its files are private (0600), results should follow the umask
    temporary = path.with_name(
        f".{path.name[:100]}.{os.getpid()}-{secrets.token_hex(4)}.tmp"
    )
    text = {} if mode == "wb" else TEXT
    try:
        with _output_errors(path, "cannot be written"):
            with open(temporary, mode.replace("w", "x"), **text) as file:
                yield file
                file.flush()
                os.fsync(file.fileno())
            os.replace(temporary, path)
    finally:
        with contextlib.suppress(OSError):
            os.unlink(temporary)


class LineFile:
    """A text file that grows by whole lines, of which each is handed to the system at once.

    It begins with ``lines``; without them it goes on where the file ends.
    """

    def __init__(self, path: Path, lines: Iterable[str] | None = None) -> None:
        self._path = path
        self._file: IO[str] | None = None
        if lines is not None:
            with atomic_write(path) as file:
                file.writelines(f"{line}\n" for line in lines)

    def add(self, line: str) -> None:
        """Write one more line."""
        with _output_errors(self._path, "cannot be written"):
            if self._file is None:
                self._file = open(self._path, "a", **TEXT)
            self._file.write(f"{line}\n")
            self._file.flush()

    def close(self) -> None:
        """Close the file when all of it is on the disk; another line opens it again."""
        if self._file is None:
            return
        with _output_errors(self._path, "cannot be written"):
            try:
                self._file.flush()
                os.fsync(self._file.fileno())
            finally:
                # of what the flush has reported already
                with contextlib.suppress(OSError):
                    self._file.close()
                self._file = None


class Journal:
    """A file of JSON values, one a line, that only grows, and outlives a writer that is killed.

    Each line bears a checksum of itself, of all lines before it and of ``seed``, which says whose
    file it is: a FormatError names the first line that was changed or comes from elsewhere. The
    values that the file holds already are ``found``; a last line that was cut off is dropped.
    """

    def __init__(self, path: Path, seed: str) -> None:
        self.found: list[Any] = []
        self._checksum = seal(seed)
        if path.is_file():
            whole = self._read(path)
            with _output_errors(path, "cannot be written"):
                os.truncate(path, whole)
            self._lines = LineFile(path)
        else:
            self._lines = LineFile(path, ())

    def add(self, value: Any) -> None:
        """Write one more value."""
        self._lines.add(self._next_line(json.dumps(value)))

    def close(self) -> None:
        """Close the file."""
        self._lines.close()

    def _next_line(self, text: str) -> str:
        self._checksum = seal(text, self._checksum)
        return f'["{self._checksum}", {text}]'

    def _read(self, path: Path) -> int:
        """Take what the file holds; returns how many bytes of it are whole lines."""
        content = read_bytes(path)
        *lines, cut_off = content.split(b"\n")
        before_text = len(f'["{self._checksum}", ')
        for number, line in enumerate(lines, start=1):
            text = line[before_text:-1].decode("ascii", "replace")
            if line != self._next_line(text).encode():
                raise FormatError(f"{path}:{number}: damaged, or of another run.")
            self.found.append(json.loads(text))
        return len(content) - len(cut_off)


def seal(text: str, before: str = "") -> str:
    """Return a checksum of a text, and of what ``before`` is the checksum of."""
    return hashlib.sha256(f"{before}{text}".encode()).hexdigest()[:16]


def make_folder(path: Path) -> None:
    """Make a folder for results, and those above it."""
    check_name(path)
    with _output_errors(path, "cannot be created"):
        path.mkdir(parents=True, exist_ok=True)


def check_name(path: Path) -> None:
    """Raise an InputError where a path can name no file."""
    try:
        os.lstat(path)
    except ValueError:  # of a zero byte, which is not shown
        got = repr(str(path)[:200])
        raise InputError(f"{got}: expected the name of a file or folder.") from None
    except OSError as error:
        if error.errno == errno.ENAMETOOLONG:
            got = f"{str(path)[:60]}..."
            raise InputError(
                f"{got}: expected a name of at most 255 bytes."
            ) from None


@contextlib.contextmanager
def locked_folder(folder: Path) -> Iterator[None]:
    """Make a folder for results and lock it; a LockedError says that another run has done so.

    What writers that were killed have left unfinished in it is removed.
    """
    make_folder(folder)
    lock = filelock.FileLock(folder / LOCK, timeout=0)
    with _output_errors(folder, "cannot be written"):
        try:
            lock.acquire()
        except filelock.Timeout:
            text = f"{folder}: held by another run. Wait for it, or choose another --out."
            raise LockedError(text) from None
    try:
        for path in folder.glob(".*.tmp"):
            if UNFINISHED.fullmatch(path.name):
                with contextlib.suppress(OSError):
                    path.unlink()
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
    facts = [
        (path.name, path.stat().st_size, path.stat().st_mtime_ns) for path in paths
    ]
    return hashlib.sha256(repr(facts).encode()).hexdigest()


def file_size(path: str | Path) -> int:
    """Return the size of a file in bytes, without a look inside.

    Raises:
        FileNotFoundError: The file is not there.
        FormatError: It is a folder, or a pipe or device, which may never end.
    """
    try:
        info = Path(path).stat()
    except FileNotFoundError:
        raise
    except (OSError, ValueError) as error:
        raise _unreadable(path, error) from None
    if stat.S_ISREG(info.st_mode):
        return info.st_size
    got = "a folder" if stat.S_ISDIR(info.st_mode) else "a pipe or a device"
    raise _unreadable(path, f"expected a file, got {got}")


def read_head(path: str | Path, count: int) -> bytes:
    """Return the first bytes of a file, at most ``count``; raises as :func:`file_size`."""
    count = min(count, file_size(path))
    try:
        with open(path, "rb") as file:
            return file.read(count)
    except FileNotFoundError:
        raise
    except (OSError, ValueError) as error:
        raise _unreadable(path, error) from None


def read_bytes(path: str | Path, limit: int = LARGEST_FILE) -> bytes:
    """Return the bytes of a file; raises as :func:`file_size`, and for more than ``limit``."""
    size = file_size(path)
    if size > limit:
        raise FormatError(f"{path}: expected at most {limit} bytes, got {size}.")
    return read_head(path, size)


def read_text(path: str | Path, limit: int = LARGEST_TEXT) -> str:
    """Read a UTF-8 file as text, with Unix line ends and without a byte-order mark."""
    try:
        return read_bytes(path, limit).decode("utf-8-sig").replace("\r\n", "\n")
    except UnicodeDecodeError:
        raise FormatError(
            f"{path}: expected a text file, got binary data."
        ) from None


def _unreadable(path: str | Path, reason: object) -> FormatError:
    return FormatError(f"{str(path)[:200]!r}: cannot be read: {reason}.")


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
            raise FormatError(
                f"{self.path}:{self.lines[k]}: expected {expected}, got {got}."
            )


def read_rows(path: Path, *columns: str, words: int = 0) -> Rows:
    """Read a list file: a number for each word of ``columns``, of which the last are text.

    ``words`` is the number of text columns. Of several ``columns`` those hold that have as many
    words as the first row. ``#`` starts a comment.
    """
    lines = list[int]()
    numbers = list[list[float]]()
    after = list[list[str]]()
    content = read_text(path)
    if (count := content.count("\n")) > MOST_ROWS:
        raise FormatError(
            f"{path}: expected at most {MOST_ROWS} lines, got {count}."
        )
    most = max(len(names.split()) for names in columns)
    for line, text in enumerate(content.split("\n"), start=1):
        count = len(columns[0].split())
        plain = text.strip() if words else text.partition("#")[0].replace(",", " ")
        # one word more than there are columns tells that the line is wrong
        parts = plain.split(maxsplit=count - 1 if words else most)
        if not parts or plain.startswith("#"):
            continue
        if not lines:
            columns = (
                tuple(c for c in columns if len(c.split()) == len(parts)) or columns
            )
            count = len(columns[0].split())
        try:
            numbers.append([float(part) for part in parts[: count - words]])
        except ValueError:
            parts = []
        if len(parts) != count:
            expected = "' or '".join(columns)
            raise FormatError(
                f"{path}:{line}: expected '{expected}', got {text.strip()[:80]!r}."
            )
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


def provenance() -> dict[str, Any]:
    """Return versions and machine, which are written beside results."""
    machine = {"platform": platform.platform(), "cpus": os.cpu_count()}
    return {"versions": versions(), "machine": machine}


class _Loader(yaml.SafeLoader):
    """The safe loader within limits: a few bytes of YAML can stand for gigabytes."""

    nodes = 0

    def compose_node(self, parent: Any, index: Any) -> Any:
        """Refuse aliases, of which ten levels make a value of 10^10 parts, and endless files."""
        self.nodes += 1
        mark = self.peek_event().start_mark
        if self.check_event(yaml.AliasEvent):
            remedy = "aliases (*name) are not read: write the value out"
            raise yaml.MarkedYAMLError(problem=remedy, problem_mark=mark)
        if self.nodes > MOST_NODES:
            many = f"more than {MOST_NODES} keys and values"
            raise yaml.MarkedYAMLError(problem=many, problem_mark=mark)
        return super().compose_node(parent, index)

    def number(self, node: Any) -> Any:
        """A number of a length that can be computed with, and printed."""
        if len(node.value) > LONGEST_NUMBER:
            long = f"a number of {len(node.value)} characters"
            raise yaml.MarkedYAMLError(problem=long, problem_mark=node.start_mark)
        if node.tag.endswith(":int"):
            return self.construct_yaml_int(node)
        return self.construct_yaml_float(node)


for _kind in ("int", "float"):
    _Loader.add_constructor(f"tag:yaml.org,2002:{_kind}", _Loader.number)


def parse_yaml(text: str, where: str) -> Any:
    """Parse a YAML document by the safe loader, to which 1e-3 is a text."""
    if len(text) > LARGEST_YAML:
        expected = f"at most {LARGEST_YAML} characters of YAML"
        raise FormatError(f"{where}: expected {expected}, got {len(text)}.")
    loader = None
    try:
        loader = _Loader(text)
        return loader.get_single_data()
    # ValueError: dates and numbers that are none; RecursionError: thousands of brackets
    except (yaml.YAMLError, ValueError, RecursionError) as error:
        mark = getattr(error, "problem_mark", None)
        line = f":{mark.line + 1}" if mark is not None else ""
        reason = (
            getattr(error, "problem", None)
            or str(error)[:200]
            or type(error).__name__
        )
        raise FormatError(f"{where}{line}: not a YAML file ({reason}).") from None
    finally:
        if loader is not None:
            loader.dispose()
