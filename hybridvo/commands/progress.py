"""Progress on stderr: a bar on a terminal, its last state elsewhere."""

from __future__ import annotations

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, TextColumn, TimeRemainingColumn
from rich.progress import Progress as Bar


class Progress:
    """Units of work done, of a total; ``done`` of them were finished before."""

    def __init__(
        self,
        label: str,
        total: int,
        unit: str,
        *,
        quiet: bool = False,
        done: int = 0,
        console: Console | None = None,
    ) -> None:
        self._bar = Bar(
            TextColumn("{task.description}", markup=False),  # a folder may be named [x]
            BarColumn(),
            MofNCompleteColumn(),
            TextColumn(f"{unit}{{task.fields[failed]}}", markup=False),
            TimeRemainingColumn(),
            console=console or Console(stderr=True, quiet=quiet, soft_wrap=True),
        )
        self._task = self._bar.add_task(label, total=total, completed=done, failed="")

    def __enter__(self) -> Progress:
        self._bar.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._bar.stop()

    def update(self, done: int, failed: int = 0) -> None:
        """``done`` units are finished, ``failed`` of them have failed."""
        self._bar.update(self._task, completed=done, failed=f", {failed} failed" if failed else "")

    def say(self, text: str) -> None:
        """A line for the user, above the bar."""
        self._bar.console.print(text, markup=False, highlight=False)
