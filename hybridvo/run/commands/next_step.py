"""What to do after a run: the command that shows its least sure step."""

from __future__ import annotations

import inspect
import shlex
from argparse import Namespace
from typing import Any


def command_that_shows(args: Namespace, frame: int) -> str:
    """Return the command line that draws a frame of a run and the one before.

    Args:
        args: The arguments of the run.
        frame: The index of the frame.

    Example:
        >>> command_that_shows(Namespace(sequence="my walk", flow="dis", trust=True), 7)
        "hybridvo show 'my walk' --trust --flow dis --frame 7"
    """
    from hybridvo.io.data.open import open_sequence

    reading = inspect.signature(open_sequence).parameters
    words = ["hybridvo", "show", str(args.sequence)]
    # '--frame' of 'show' names another thing
    names = [name for name in reading if name != "frame"]
    for name in (*names, "flow", "method"):
        words += _option(name, getattr(args, name, None))
    for weights in getattr(args, "weights", []):
        words += ["--weights", weights]
    return shlex.join([*words, "--frame", str(frame)])


def _option(name: str, value: Any) -> list[str]:
    """Return an option with its value as words; none where it was not given."""
    if value is None or value is False:
        return []
    flag = f"--{name.replace('_', '-')}"
    # a switch, and an option whose value may be left out
    if value is True or value == "":
        return [flag]
    return [flag, f"{value:g}" if isinstance(value, float) else str(value)]
