"""Exceptions of hybridvo. Bad input raises one of these; a failed estimate never does."""

from __future__ import annotations

LONGEST_MESSAGE = 2000  # characters; a value of the user's may be of any length


def printable(text: str, keep: str = "\n\t") -> str:
    r"""Return a text that is safe to print: what a terminal obeys or cannot encode is escaped.

    The names of files may hold control characters and bytes that are not UTF-8.

    Args:
        text: Any text, such as a name or a message.
        keep: Characters that stay as they are although they cannot be printed.

    Returns:
        The text without the control characters C0 and C1, without invisible ones that turn the
        direction of writing, and without what UTF-8 cannot encode: they become ``\x1b``.
    """
    kept = (c if c.isprintable() or c in keep else _escaped(c) for c in text)
    return "".join(kept)


def _escaped(character: str) -> str:
    return character.encode("unicode_escape").decode("ascii")


class HybridVOError(Exception):
    """Base class of everything that hybridvo raises on purpose; ``exit_code`` of the commands.

    Its text can be printed on a terminal, whatever the names and values in it.
    """

    exit_code = 2

    def __str__(self) -> str:
        text = printable(super().__str__())
        if len(text) <= LONGEST_MESSAGE:
            return text
        return text[:LONGEST_MESSAGE] + " ..."


class InputError(HybridVOError, ValueError):
    """An argument, option or sequence that cannot be used as it is (exit code 2)."""


class FormatError(InputError):
    """A file whose content does not fit its format (exit code 2)."""


class CheckpointError(InputError):
    """A weights file that is damaged, foreign or of another architecture (exit code 2)."""


class DegenerateError(HybridVOError, ValueError):
    """A quantity that the data does not determine, asked for outside the estimation loop."""


class OutputError(HybridVOError, OSError):
    """A result that could not be written (exit code 5)."""

    exit_code = 5


class LockedError(HybridVOError, RuntimeError):
    """An output folder that another run holds (exit code 4)."""

    exit_code = 4


class Interrupted(KeyboardInterrupt):
    """A run that a signal has stopped, after it saved what there was (exit code 128 and more).

    It is no HybridVOError: nobody who handles errors means to go on with the next sequence.
    """

    def __init__(self, message: str, signal_number: int) -> None:
        super().__init__(message)
        self.exit_code = 128 + signal_number
