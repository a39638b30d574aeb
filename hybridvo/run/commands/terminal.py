"""Text for the terminal, without characters that steer it: file names may hold some."""

from __future__ import annotations

import logging
import os
import sys
from typing import Any

from hybridvo.core.errors import printable

STYLES = {"ok": "green", "degraded": "yellow", "failed": "red"}
"""Colour of each state."""
STATES = (
    (r"\bfailed [1-9]\d* of \d+ motions", "red"),
    (r"\b[1-9]\d* degraded\b", "yellow"),
    (r"\bfailed 0 of \d+ motions, 0 degraded\b", "green"),
    (r"(?<=, )failed\b", "red"),
    (r"(?<=, )degraded\b", "yellow"),
    (r"\bDIFFERS\b", "yellow"),
)
"""What is coloured in a summary, and how."""
PIPE_WIDTH = 132
"""Width of tables that go to a file or another program, characters."""
TEXT_COLUMNS = (
    "method",
    "flow",
    "source",
    "stage",
    "topic",
    "type",
    "encoding",
    "taken for",
)
"""Columns of tables that hold names, not numbers."""


def printable_content(content: Any) -> Any:
    """Return the result of a command with every text in it on one line and printable."""
    if isinstance(content, str):
        return printable(content)
    if isinstance(content, dict):
        return {
            printable_content(key): printable_content(value)
            for key, value in content.items()
        }
    if isinstance(content, list | tuple):
        return [printable_content(value) for value in content]
    return content


def table(rows: list[dict[str, str]]) -> str:
    """Return rows of texts as a table, as wide as the terminal, that Markdown understands too.

    Args:
        rows: A text under the name of each column; all rows have the same columns.
    """
    # imported here, because help must not load heavy libraries
    from rich.box import MARKDOWN
    from rich.console import Console
    from rich.table import Table

    drawn = Table(box=MARKDOWN)
    columns = list(rows[0]) if rows else []
    for name in columns:
        is_text = name in TEXT_COLUMNS
        drawn.add_column(
            name,
            justify="left" if is_text else "right",
            no_wrap=is_text,
            overflow="fold",
        )
    for row in rows:
        drawn.add_row(*row.values())
    console = Console(markup=False, highlight=False, color_system=None)
    if not console.is_terminal:
        console.width = PIPE_WIDTH
    with console.capture() as capture:
        console.print(drawn)
    lines = [line.rstrip() for line in capture.get().splitlines()]
    return "\n".join(lines).strip("\n")


def show(text: str) -> None:
    """Print a text on stdout; where that is a terminal, states have their colours.

    Args:
        text: Lines without characters that steer a terminal.
    """
    if not sys.stdout.isatty() or os.environ.get("NO_COLOR"):
        print(text, flush=True)
        return
    # imported here, because help must not load heavy libraries
    from rich.console import Console
    from rich.text import Text

    drawn = Text(text)
    for pattern, style in STATES:
        drawn.highlight_regex(pattern, style)
    console = Console(markup=False, highlight=False, soft_wrap=True)
    console.print(drawn)
    console.file.flush()


class TerminalHandler(logging.Handler):
    """Writes what the library logs to stderr, wherever stderr leads at that moment."""

    def emit(self, record: logging.LogRecord) -> None:
        """Write a record as a line on stderr."""
        print(printable(self.format(record)), file=sys.stderr)
