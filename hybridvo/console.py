"""What a run shows and hears: progress on stderr, and the signals that ask it to stop."""

from __future__ import annotations

import contextlib
import signal
import sys
import threading
import time
from collections.abc import Iterator
from types import FrameType
from typing import IO, Any

__all__ = ["Interruption", "Progress", "interruptible"]

PLAIN_INTERVAL_S = 5.0
"""Seconds between progress lines where stderr is no terminal."""


class Interruption:
    """Whether the user, or the system, has asked to stop; true after SIGINT or SIGTERM."""

    def __init__(self) -> None:
        self.signal: int | None = None

    def __bool__(self) -> bool:
        return self.signal is not None


@contextlib.contextmanager
def interruptible() -> Iterator[Interruption]:
    """Turns the first SIGINT or SIGTERM into a flag; a second one aborts (KeyboardInterrupt).

    Outside the main thread, where Python delivers no signals, the flag just stays unset.
    """
    interruption = Interruption()

    def handle(number: int, frame: FrameType | None) -> None:
        if interruption:
            raise KeyboardInterrupt
        interruption.signal = number

    if threading.current_thread() is not threading.main_thread():
        yield interruption
        return
    before = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)}
    for number in before:
        signal.signal(number, handle)
    try:
        yield interruption
    finally:
        for number, handler in before.items():
            signal.signal(number, handler if handler is not None else signal.SIG_DFL)


class Progress:
    """Frames done, on stderr, with the time left: a bar on a terminal, plain lines elsewhere.

    Args:
        total: frames. label: what is run. quiet: show nothing. stream: default stderr. unit: what
            is counted. before: how many an earlier session has done, which tell nothing of the
            speed of this one.
    """

    def __init__(
        self,
        total: int,
        label: str,
        *,
        quiet: bool = False,
        stream: IO[str] | None = None,
        unit: str = "frames",
        before: int = 0,
    ) -> None:
        self._unit, self._before = unit, before
        self._stream = stream if stream is not None else sys.stderr
        self._total, self._label, self._quiet = total, label, quiet
        self._done = 0
        self._failed = 0
        self._bar: Any = None

    def __enter__(self) -> Progress:
        self._started = self._last = time.monotonic()
        if not self._quiet and self._stream.isatty():
            from rich.console import Console
            from rich.progress import (
                BarColumn,
                MofNCompleteColumn,
                TextColumn,
                TimeRemainingColumn,
            )
            from rich.progress import Progress as Bar

            self._bar = Bar(
                TextColumn("{task.description}"),
                BarColumn(),
                MofNCompleteColumn(),
                TextColumn("{task.fields[rate]}"),
                TimeRemainingColumn(),
                console=Console(file=self._stream),
            )
            self._task = self._bar.add_task(
                self._label, total=self._total, completed=self._before, rate=""
            )
            self._bar.start()
        return self

    def __exit__(self, *_: object) -> None:
        if self._bar is not None:
            self._bar.stop()

    def update(self, done: int, failed: int) -> None:
        """``done`` frames are finished, ``failed`` of them have failed."""
        self._done, self._failed = done, failed
        now = time.monotonic()
        speed = (done - self._before) / max(now - self._started, 1e-9)
        rate = f"{speed:.1f} pairs/s"
        if failed:
            rate += f", {failed} failed"
        if self._bar is not None:
            self._bar.update(self._task, completed=done, rate=rate)
        elif not self._quiet and (now - self._last >= PLAIN_INTERVAL_S or done == self._total):
            self._last = now
            left = ""
            if speed > 0 and done < self._total:
                minutes, seconds = divmod(round((self._total - done) / speed), 60)
                left = f", {minutes}:{seconds:02d} min left"
            self._write(f"{self._label}: {done}/{self._total} {self._unit}, {rate}{left}")

    def say(self, text: str) -> None:
        """A line for the user, above the bar."""
        if self._quiet:
            return
        if self._bar is not None:
            self._bar.console.print(text, markup=False, highlight=False)
        else:
            self._write(text)

    def _write(self, text: str) -> None:
        # a reader of stderr that has gone away must not end the run
        with contextlib.suppress(OSError, ValueError):
            print(text, file=self._stream, flush=True)
