"""Writing of results, completely or not at all; reading of text, lists and YAML."""

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

from hybridvo.core.errors import FormatError, InputError, LockedError, OutputError

Mode = Literal["new", "resume", "overwrite"]
"""What to do with the results that a folder holds already."""
LOCK = ".run.lock"
"""The file in an output folder that a running command holds."""
TEXT_MODE: dict[str, Any] = {
    "encoding": "utf-8",
    "newline": "\n",
    # File names may hold bytes that are no text. JSON reads these escapes back.
    "errors": "backslashreplace",
}
"""How text files are opened for writing."""
UNFINISHED = re.compile(r"\..+\.\d+-[0-9a-f]{8}\.tmp")
"""Names of files that :func:`atomic_write` has not completed."""
NUMERIC_PACKAGES = (
    "hybridvo",
    "numpy",
    "scipy",
    "opencv-python-headless",
    "numba",
    "torch",
    "poselib",
)
"""Packages on whose versions numbers depend."""
CHECKSUM_DIGITS = 16

# Limits on what a file from a stranger may cost. No useful file comes near them.

MAX_FILE_BYTES = 2**30
MAX_TEXT_BYTES = 2**26
"""Bytes of a list: 64 MB, four hours of poses at 50 Hz."""
MAX_ROWS = 2**20
"""Lines of a list: half an hour at 500 Hz."""
MAX_YAML_LENGTH = 2**20
"""Characters of a YAML file."""
MAX_YAML_NODES = 10_000
"""Keys, values and lists of a YAML file."""
MAX_NUMBER_LENGTH = 60
"""Characters of a number in a YAML file."""
FREE_UNPACKED_BYTES = 2**26
"""Bytes to which a packed file may unpack however small it is."""
UNPACKED_PER_BYTE = 30
"""Further ones for each of its own bytes. Images of a camera pack to a half or a third, drawn ones
to a twentieth."""


def unpacked_limit(packed_bytes: int) -> int:
    """Return to how many bytes a packed file of a length may unpack.

    >>> unpacked_limit(1_000_000)
    97108864
    """
    return FREE_UNPACKED_BYTES + UNPACKED_PER_BYTE * packed_bytes


@contextlib.contextmanager
def _output_errors(path: Path, failure: str) -> Iterator[None]:
    """Turn an OSError into an OutputError that names the path and what failed."""
    try:
        yield
    except OSError as error:
        reason = error.strerror or error
        raise OutputError(f"{path}: {failure}: {reason}.") from error


@contextlib.contextmanager
def atomic_write(
    path: str | Path, mode: Literal["w", "wb"] = "w"
) -> Iterator[IO[Any]]:
    """Open a file whose content appears under its name completely, or not at all.

    The content goes to a temporary file beside it, which replaces the file at the end. A symbolic
    link is replaced, never followed. Text is UTF-8 with Unix line ends.

    Args:
        path: The file.
        mode: ``w`` for text, ``wb`` for bytes.

    Yields:
        The open file.

    Raises:
        OutputError: The file cannot be written.
    """
    path = Path(path)
    if path.exists() and not (path.is_file() or path.is_dir()):
        raise OutputError(
            f"{path}: expected a file or a new name, got a device or a pipe."
        )
    # Not tempfile.mkstemp: its files are private (0600), but results should follow the umask.
    suffix = f"{os.getpid()}-{secrets.token_hex(4)}.tmp"
    temporary = path.with_name(f".{path.name[:100]}.{suffix}")
    create_mode = mode.replace("w", "x")
    text_mode = {} if mode == "wb" else TEXT_MODE
    try:
        with _output_errors(path, "cannot be written"):
            with open(temporary, create_mode, **text_mode) as file:
                yield file
                file.flush()
                os.fsync(file.fileno())
            os.replace(temporary, path)
    finally:
        with contextlib.suppress(OSError):
            os.unlink(temporary)


class LineFile:
    """A text file that grows line by line; each line is flushed at once.

    Args:
        path: The file.
        lines: With lines, a new file that begins with them; without, the file is continued.
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
                self._file = open(self._path, "a", **TEXT_MODE)
            self._file.write(f"{line}\n")
            self._file.flush()

    def close(self) -> None:
        """Close the file after all of it is on the disk; a further line opens it again."""
        if self._file is None:
            return
        with _output_errors(self._path, "cannot be written"):
            try:
                self._file.flush()
                os.fsync(self._file.fileno())
            finally:
                # An error here was reported by the flush already.
                with contextlib.suppress(OSError):
                    self._file.close()
                self._file = None


class Journal:
    """A file of JSON values, one a line, that only grows and survives a killed writer.

    Each line bears a checksum of itself and of all lines before it, so that a line that was
    changed, or belongs to another file, is found. A last line that was cut off is dropped.

    Args:
        path: The file, which may exist already.
        seed: A text that states to whom the file belongs. It goes into all checksums.

    Attributes:
        values: The values that the file held when it was opened.

    Raises:
        FormatError: A line was changed, or comes from elsewhere. The message names it.
    """

    def __init__(self, path: Path, seed: str) -> None:
        self.values: list[Any] = []
        self._checksum = checksum(seed)
        if path.is_file():
            length = self._read(path)
            with _output_errors(path, "cannot be written"):
                os.truncate(path, length)
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
        """Return the line that holds a text, with its checksum."""
        self._checksum = checksum(text, self._checksum)
        return f'["{self._checksum}", {text}]'

    def _read(self, path: Path) -> int:
        """Read the values of the file; returns how many bytes of it are complete lines."""
        content = read_bytes(path)
        *lines, cut_off = content.split(b"\n")
        prefix_length = len(f'["{self._checksum}", ')
        for number, line in enumerate(lines, start=1):
            text = line[prefix_length:-1].decode("ascii", "replace")
            if line != self._next_line(text).encode():
                raise FormatError(f"{path}:{number}: damaged, or of another run.")
            try:
                self.values.append(json.loads(text))
            # thousands of brackets, or no JSON although its checksum is right
            except (ValueError, RecursionError):
                raise FormatError(f"{path}:{number}: expected JSON.") from None
        return len(content) - len(cut_off)


def checksum(text: str, before: str = "") -> str:
    """Return a checksum of a text.

    Args:
        text: Any text.
        before: The checksum of an earlier text, to chain both.
    """
    digest = hashlib.sha256(f"{before}{text}".encode()).hexdigest()
    return digest[:CHECKSUM_DIGITS]


def make_folder(path: Path) -> None:
    """Create a folder for results, and the folders above it."""
    check_name(path)
    with _output_errors(path, "cannot be created"):
        path.mkdir(parents=True, exist_ok=True)


def check_name(path: Path) -> None:
    """Raise an InputError where a path cannot name a file."""
    try:
        os.lstat(path)
    except ValueError:
        # The name holds a zero byte, which repr shows.
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
    """Create a folder for results and lock it against other runs.

    Unfinished files of writers that were killed are removed.

    Raises:
        LockedError: Another run holds the folder.
        OutputError: The folder cannot be written.
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
        # It is removed before it is released: afterwards it may be the lock of another run.
        (folder / LOCK).unlink(missing_ok=True)
        lock.release()


def give_name(part: Path, path: Path) -> None:
    """Rename a file or folder that is whole now; an empty folder of that name is replaced."""
    with _output_errors(path, "cannot be written"):
        os.replace(part, path)


def remove(*paths: Path) -> None:
    """Delete files of results, if they are there."""
    for path in paths:
        with _output_errors(path, "cannot be replaced"):
            path.unlink(missing_ok=True)


def write_lines(path: str | Path, lines: Iterable[str]) -> None:
    """Write lines of text."""
    with atomic_write(path) as file:
        file.writelines(f"{line}\n" for line in lines)


def write_json(path: str | Path, value: Any) -> None:
    """Write a value as indented JSON; a ValueError refuses numbers that are not finite."""
    text = json.dumps(value, indent=1, allow_nan=False, ensure_ascii=False) + "\n"
    with atomic_write(path) as file:
        file.write(text)


def fingerprint(paths: Iterable[Path]) -> str:
    """Return a SHA-256 of the names, sizes and times of files, which changes when they do."""
    properties = []
    for path in paths:
        info = path.stat()
        properties.append((path.name, info.st_size, info.st_mtime_ns))
    return hashlib.sha256(repr(properties).encode()).hexdigest()


def file_size(path: str | Path) -> int:
    """Return the size of a file in bytes.

    Raises:
        FileNotFoundError: The file is not there.
        FormatError: It is a folder, or a pipe or a device, which may never end.
    """
    try:
        info = Path(path).stat()
    except FileNotFoundError:
        raise
    except (OSError, ValueError) as error:
        raise _unreadable(path, error) from None
    if stat.S_ISREG(info.st_mode):
        return info.st_size
    is_folder = stat.S_ISDIR(info.st_mode)
    got = "a folder" if is_folder else "a pipe or a device"
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


def read_bytes(path: str | Path, limit: int = MAX_FILE_BYTES) -> bytes:
    """Return the bytes of a file; raises as :func:`file_size`, and for more than ``limit``."""
    size = file_size(path)
    if size > limit:
        raise FormatError(f"{path}: expected at most {limit} bytes, got {size}.")
    return read_head(path, size)


def read_text(path: str | Path, limit: int = MAX_TEXT_BYTES) -> str:
    """Read a UTF-8 file as text, with Unix line ends and without a byte-order mark."""
    content = read_bytes(path, limit)
    try:
        text = content.decode("utf-8-sig")
    except UnicodeDecodeError:
        raise FormatError(
            f"{path}: expected a text file, got binary data."
        ) from None
    return text.replace("\r\n", "\n")


def _unreadable(path: str | Path, reason: object) -> FormatError:
    """Return the error of a file that cannot be read."""
    return FormatError(f"{str(path)[:200]!r}: cannot be read: {reason}.")


class Rows(NamedTuple):
    """The rows of a list on disk."""

    path: Path
    lines: list[int]  # (N,) the line of the file in which each row stands
    numbers: np.ndarray  # (N, C)
    words: list[list[str]]  # (N,) the texts after the numbers

    def refuse(self, bad: np.ndarray, expected: str) -> None:
        """Raise a FormatError that names the first bad row, if there is one.

        Args:
            bad: (N,) bool, which rows are bad.
            expected: What was expected, for the message.
        """
        if not bad.any():
            return
        k = int(np.argmax(bad))
        got = self.numbers[k].tolist()
        raise FormatError(
            f"{self.path}:{self.lines[k]}: expected {expected}, got {got}."
        )


def read_rows(path: Path, *columns: str, words: int = 0) -> Rows:
    """Read a list of numbers and texts.

    A row is a line. Without texts, commas may separate the numbers, and ``#`` starts a comment;
    with texts, a line that starts with ``#`` is a comment, and the last text may hold spaces.

    Args:
        path: The file.
        columns: The names of the columns, separated by spaces. Of several such forms, the first
            row decides which one the list has.
        words: How many of the last columns hold text.

    Raises:
        FormatError: A row has another form, or the file has too many lines.
    """
    content = read_text(path)
    line_count = content.count("\n")
    if line_count > MAX_ROWS:
        raise FormatError(
            f"{path}: expected at most {MAX_ROWS} lines, got {line_count}."
        )
    forms = [names.split() for names in columns]
    longest = max(len(form) for form in forms)
    lines: list[int] = []
    numbers: list[list[float]] = []
    texts: list[list[str]] = []
    for line, text in enumerate(content.split("\n"), start=1):
        if words:
            parts = _text_row(text, len(forms[0]))
        else:
            parts = _number_row(text, longest)
        if not parts:
            continue
        if not lines:
            forms = _forms_of_length(forms, len(parts))
        count = len(forms[0])
        number_count = count - words
        values = _floats(parts[:number_count])
        if values is None or len(parts) != count:
            expected = "' or '".join(" ".join(form) for form in forms)
            raise FormatError(
                f"{path}:{line}: expected '{expected}', got {text.strip()[:80]!r}."
            )
        lines.append(line)
        numbers.append(values)
        texts.append(parts[number_count:])
    shape = (len(lines), len(forms[0]) - words)
    return Rows(path, lines, np.array(numbers).reshape(shape), texts)


def _text_row(text: str, count: int) -> list[str]:
    """Split a line of numbers and texts; empty for a comment. The last text may hold spaces."""
    text = text.strip()
    if text.startswith("#"):
        return []
    return text.split(maxsplit=count - 1)


def _number_row(text: str, longest: int) -> list[str]:
    """Split a line of numbers, without its comment, at spaces and commas."""
    text, _, _ = text.partition("#")
    # A wrong line gets one part more than there are columns, which is enough to see it.
    return text.replace(",", " ").split(maxsplit=longest)


def _forms_of_length(forms: list[list[str]], count: int) -> list[list[str]]:
    """Return the forms that have a number of columns; all if none has."""
    fitting = [form for form in forms if len(form) == count]
    return fitting or forms


def _floats(parts: list[str]) -> list[float] | None:
    """Convert words to numbers; None if one is no number."""
    try:
        return [float(part) for part in parts]
    except ValueError:
        return None


def versions() -> dict[str, str]:
    """Return the versions of Python and of the installed packages on which numbers depend."""
    installed = {"python": platform.python_version()}
    for name in NUMERIC_PACKAGES:
        with contextlib.suppress(PackageNotFoundError):
            installed[name] = version(name)
    return installed


def provenance() -> dict[str, Any]:
    """Return versions and machine, which are written beside results."""
    machine = {"platform": platform.platform(), "cpus": os.cpu_count()}
    return {"versions": versions(), "machine": machine}


class _LimitedLoader(yaml.SafeLoader):
    """PyYAML's safe loader with limits: a few bytes of YAML can stand for gigabytes."""

    node_count = 0
    max_nodes = MAX_YAML_NODES

    def compose_node(self, parent: Any, index: Any) -> Any:
        """Refuse aliases and files without end.

        Ten levels of aliases make a value of 10^10 parts.
        """
        self.node_count += 1
        mark = self.peek_event().start_mark
        if self.check_event(yaml.AliasEvent):
            problem = "aliases (*name) are not read: write the value out"
            raise yaml.MarkedYAMLError(problem=problem, problem_mark=mark)
        if self.node_count > self.max_nodes:
            problem = f"more than {self.max_nodes} keys and values"
            raise yaml.MarkedYAMLError(problem=problem, problem_mark=mark)
        return super().compose_node(parent, index)

    def construct_number(self, node: Any) -> Any:
        """Read a number of a sensible length: Python needs hours for one of megabytes."""
        if len(node.value) > MAX_NUMBER_LENGTH:
            problem = f"a number of {len(node.value)} characters"
            raise yaml.MarkedYAMLError(
                problem=problem, problem_mark=node.start_mark
            )
        if node.tag.endswith(":int"):
            return self.construct_yaml_int(node)
        return self.construct_yaml_float(node)


for _kind in ("int", "float"):
    _LimitedLoader.add_constructor(
        f"tag:yaml.org,2002:{_kind}", _LimitedLoader.construct_number
    )


def parse_yaml(text: str, where: str, max_nodes: int = MAX_YAML_NODES) -> Any:
    """Parse a YAML document within limits. A number such as 1e-3 is a text in YAML 1.1.

    Args:
        text: The document.
        where: The file, or what the text is, for messages.
        max_nodes: How many keys and values it may have.

    Returns:
        Dictionaries, lists, texts and numbers.

    Raises:
        FormatError: The text is no YAML, uses aliases, or is too long.
    """
    if len(text) > MAX_YAML_LENGTH:
        expected = f"at most {MAX_YAML_LENGTH} characters of YAML"
        raise FormatError(f"{where}: expected {expected}, got {len(text)}.")
    loader = None
    try:
        loader = _LimitedLoader(text)
        loader.max_nodes = max_nodes
        return loader.get_single_data()
    # ValueError: dates and numbers that are none; RecursionError: thousands of brackets
    except (yaml.YAMLError, ValueError, RecursionError) as error:
        mark = getattr(error, "problem_mark", None)
        line = "" if mark is None else f":{mark.line + 1}"
        problem = getattr(error, "problem", None)
        reason = problem or str(error)[:200] or type(error).__name__
        raise FormatError(f"{where}{line}: not a YAML file ({reason}).") from None
    finally:
        if loader is not None:
            loader.dispose()
