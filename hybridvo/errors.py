"""Exceptions of hybridvo. Bad input raises one of these; a failed estimate never does."""

from __future__ import annotations


class HybridVOError(Exception):
    """Base class of everything that hybridvo raises on purpose; ``exit_code`` of the commands."""

    exit_code = 2


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
