"""Text for the terminal. Names of files may hold characters that steer it: none reaches it raw."""

from __future__ import annotations

import logging
import sys
from typing import Any

from hybridvo.errors import printable


def printable_content(content: Any) -> Any:
    """Return the result of a command with every text in it on one line and printable."""
    if isinstance(content, str):
        return printable(content, keep="")
    if isinstance(content, dict):
        return {
            printable_content(key): printable_content(x)
            for key, x in content.items()
        }
    if isinstance(content, list | tuple):
        return [printable_content(x) for x in content]
    return content


def table(rows: list[dict[str, str]]) -> str:
    """Return rows of texts as a table, as wide as the terminal, that Markdown understands too."""
    # imported here, for help loads nothing heavy
    from rich.box import MARKDOWN
    from rich.console import Console
    from rich.table import Table

    drawn = Table(box=MARKDOWN)
    for name in rows[0] if rows else ():
        is_text = name in ("method", "flow")
        drawn.add_column(
            name, justify="left" if is_text else "right", no_wrap=is_text
        )
    for row in rows:
        drawn.add_row(*row.values())
    console = Console(markup=False, highlight=False, color_system=None)
    with console.capture() as capture:
        console.print(drawn)
    return "\n".join(line.rstrip() for line in capture.get().splitlines()).strip(
        "\n"
    )


class TerminalHandler(logging.Handler):
    """Writes what the library logs to the terminal, as it is at that moment."""

    def emit(self, record: logging.LogRecord) -> None:
        """Write a record as a line on stderr."""
        print(printable(self.format(record)), file=sys.stderr)
