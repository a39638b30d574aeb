"""Exceptions of hybridvo: for bad input, never for a failed estimate."""

from __future__ import annotations

import contextlib
import difflib
import re
from collections.abc import Iterable, Iterator

# characters; a value that a user hands in may be of any length
MAX_MESSAGE_LENGTH = 2000


def printable(text: str, keep: str = "") -> str:
    r"""Return a text that is safe to print on a terminal, on one line.

    The names of files may hold control characters, such as the end of a line, after which a
    name could forge a message of its own, and bytes that are not UTF-8.

    Args:
        text: Any text, such as a name or a message.
        keep: Characters that stay as they are although they cannot be printed, such as the ends of
            the lines of a traceback.

    Returns:
        The text with escapes such as ``\x1b`` in place of control characters (C0
        and C1), of invisible ones that change the direction of writing, and of what
        UTF-8 cannot encode.

    >>> printable("a\x1b[2Jb")
    'a\\x1b[2Jb'
    """
    return "".join(c if c.isprintable() or c in keep else _escaped(c) for c in text)


def did_you_mean(
    written: object, known: Iterable[str], similarity: float = 0.6
) -> str:
    """Return a question about the name that a misspelt one may stand for, for a message.

    Args:
        written: The name that is not known.
        known: Those that are.
        similarity: Of the two names at least, from 0 to 1.

    Returns:
        The question, after a blank; empty where no name is near.

    >>> did_you_mean("hybird", ["hybrid", "pwvo"]), did_you_mean("--sed", ["--seed"])
    (" (did you mean 'hybrid'?)", ' (did you mean --seed?)')
    """
    near = difflib.get_close_matches(str(written), list(known), 1, similarity)
    if not near:
        return ""
    name = near[0]
    # an option of the command line stands for itself
    quoted = name if name.startswith("-") else f"'{name}'"
    return f" (did you mean {quoted}?)"


@contextlib.contextmanager
def format_errors(where: object) -> Iterator[None]:
    """Turn an InputError about what a file holds into a FormatError that names the file."""
    try:
        yield
    except InputError as error:
        if isinstance(error, FormatError):
            raise
        raise FormatError(f"{where}: {error}") from None


def missing_sequence(path: object) -> str:
    """Return what is wrong with the path of a sequence that is not there, for a message.

    >>> missing_sequence("drive.bag")
    'drive.bag: expected a sequence folder or the file of a recording, got no such file.'
    """
    # as .bag or .r3d; the name of a folder may have a number behind a point
    is_file = re.search(r"\.[A-Za-z]\w{1,5}$", str(path)) is not None
    got = "file" if is_file else "folder"
    expected = "expected a sequence folder"
    if is_file:
        expected += " or the file of a recording"
    return f"{path}: {expected}, got no such {got}."


def _escaped(character: str) -> str:
    return character.encode("unicode_escape").decode("ascii")


class HybridVOError(Exception):
    """Base class of everything that hybridvo raises on purpose.

    Its text can be printed on a terminal, and is one line, whatever the names and values in it.

    Attributes:
        exit_code: of a command that ends with it.
    """

    exit_code = 2

    def __str__(self) -> str:
        text = printable(super().__str__())
        if len(text) <= MAX_MESSAGE_LENGTH:
            return text
        return text[:MAX_MESSAGE_LENGTH] + " ..."


class InputError(HybridVOError, ValueError):
    """An argument, option or sequence that cannot be used as it is (exit code 2).

    Attributes:
        exit_code: of a command that ends with it.

    >>> from hybridvo import Camera
    >>> try:
    ...     Camera(fx=-1, fy=500, cx=320, cy=240, height=480, width=640)
    ... except InputError as error:
    ...     print(str(error).partition(":")[0])
    Camera.fx
    """


class FormatError(InputError):
    """A file whose content does not fit its format (exit code 2)."""


class CheckpointError(InputError):
    """A weights file that is damaged or of another architecture (exit code 2)."""


class DegenerateError(HybridVOError, ValueError):
    """A quantity that the data does not determine, outside of the estimation loop."""


class OutputError(HybridVOError, OSError):
    """A result that could not be written (exit code 5)."""

    exit_code = 5


class LockedError(HybridVOError, RuntimeError):
    """An output folder that another run holds (exit code 4)."""

    exit_code = 4


class Interrupted(KeyboardInterrupt):
    """A run that a signal has stopped after it saved its results.

    It is no HybridVOError: code that handles errors and goes on with the next
    sequence must not catch it.
    """

    def __init__(self, message: str, signal_number: int) -> None:
        super().__init__(message)
        self.exit_code = 128 + signal_number
