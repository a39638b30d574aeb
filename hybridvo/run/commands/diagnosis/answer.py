"""What a question to a recording is answered by."""

from __future__ import annotations

from typing import NamedTuple


class Diagnosis(NamedTuple):
    """Whether data differs from what it should be."""

    differs: bool | None  # None: the data do not show it
    message: str
    # that removes the difference, with its value; None where no option does
    option: tuple[str, str] | None = None
