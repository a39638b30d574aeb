"""Progress on stderr: a bar on a terminal, its last state elsewhere."""

from __future__ import annotations

from rich import progress
from rich.console import Console


class Progress(progress.Progress):
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
        super().__init__(
            progress.TextColumn("{task.description}", markup=False),  # a folder may be named [x]
            progress.BarColumn(),
            progress.MofNCompleteColumn(),
            progress.TextColumn(f"{unit}{{task.fields[failed]}}", markup=False),
            progress.TimeRemainingColumn(),
            console=console or Console(stderr=True, quiet=quiet, soft_wrap=True),
        )
        self._task = self.add_task(label, total=total, completed=done, failed="")

    def show(self, done: int, failed: int = 0) -> None:
        """``done`` units are finished, ``failed`` of them have failed."""
        self.update(self._task, completed=done, failed=f", {failed} failed" if failed else "")

    def say(self, text: str) -> None:
        """A line for the user, above the bar."""
        self.console.print(text, markup=False, highlight=False)
