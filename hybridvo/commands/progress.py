"""Progress on stderr."""

from __future__ import annotations

import time

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, TextColumn, TimeRemainingColumn
from rich.progress import Progress as Bar


class Progress:
    """Work done, on stderr: a bar on a terminal, a line every few seconds elsewhere.

    ``done`` units of the ``total`` were finished before and do not count for the speed.
    """

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
        self._console = console or Console(stderr=True, quiet=quiet, soft_wrap=True)
        self._bar = Bar(
            TextColumn("{task.description}", markup=False),  # a folder may be named [x]
            BarColumn(),
            MofNCompleteColumn(),
            TextColumn("{task.fields[rate]}", markup=False),
            TimeRemainingColumn(),
            console=self._console,
            disable=not self._console.is_terminal,
        )
        self._task = self._bar.add_task(label, total=total, completed=done, rate="")
        self._label, self._total, self._unit, self._before = label, total, unit, done
        self._started = self._last = time.monotonic()

    def __enter__(self) -> Progress:
        self._bar.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._bar.stop()

    def update(self, done: int, failed: int = 0) -> None:
        """``done`` units are finished, ``failed`` of them have failed."""
        now = time.monotonic()
        speed = (done - self._before) / max(now - self._started, 1e-9)
        rate = f"{speed:.1f} {self._unit}/s" + (f", {failed} failed" if failed else "")
        self._bar.update(self._task, completed=done, rate=rate)
        if not self._console.is_terminal and (now - self._last >= 5.0 or done == self._total):
            self._last = now
            self.say(f"{self._label}: {done}/{self._total} {self._unit}, {rate}")

    def say(self, text: str) -> None:
        """A line for the user, above the bar."""
        self._console.print(text, markup=False, highlight=False)
