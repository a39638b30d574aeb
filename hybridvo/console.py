"""What a run shows and hears: progress on stderr, and the signals that ask it to stop."""

from __future__ import annotations

import contextlib
import os
import re
import signal
import sys
import threading
import time
from collections.abc import Iterator
from types import FrameType
from typing import IO, Any

__all__ = [
    "Interruption",
    "Progress",
    "interruptible",
    "leave_closed_terminals",
    "open_terminals",
    "printable",
    "stop_signals",
]

_CONTROL = re.compile(r"[\x00-\x08\x0b-\x1f\x7f-\x9f]")
PLAIN_INTERVAL_S = 5.0
"""Seconds between progress lines where stderr is no terminal."""


class Interruption:
    """Whether the user, or the system, has asked to stop; true after one of the signals."""

    def __init__(self) -> None:
        self.signal: int | None = None

    def __bool__(self) -> bool:
        return self.signal is not None


def stop_signals() -> list[int]:
    """SIGINT, SIGTERM, and a closed terminal's SIGHUP unless it is ignored, as with ``nohup``."""
    hangup = getattr(signal, "SIGHUP", None)  # not on Windows
    heard = [] if hangup is None or signal.getsignal(hangup) is signal.SIG_IGN else [hangup]
    return [signal.SIGINT, signal.SIGTERM, *heard]


@contextlib.contextmanager
def interruptible() -> Iterator[Interruption]:
    """Turns the first of the signals into a flag; a second one aborts (KeyboardInterrupt).

    A closed terminal may send its SIGHUP twice, from the shell and from the kernel, so that one
    never aborts. Outside the main thread, where Python delivers no signals, the flag just stays
    unset.
    """
    interruption = Interruption()
    hangup = getattr(signal, "SIGHUP", None)

    def handle(number: int, frame: FrameType | None) -> None:
        leave_closed_terminals(terminals)
        if interruption and number != hangup:
            raise KeyboardInterrupt
        interruption.signal = number

    if threading.current_thread() is not threading.main_thread():
        yield interruption
        return
    terminals = open_terminals()
    before = {number: signal.getsignal(number) for number in stop_signals()}
    for number in before:
        signal.signal(number, handle)
    try:
        yield interruption
    finally:
        for number, handler in before.items():
            signal.signal(number, handler if handler is not None else signal.SIG_DFL)


def open_terminals() -> list[int]:
    """Which of stdin, stdout and stderr are a terminal."""
    return [number for number in (0, 1, 2) if os.isatty(number)]


def leave_closed_terminals(terminals: list[int]) -> None:
    """Give the streams whose terminal is gone another end: what is still said must not fail.

    Args:
        terminals: of :func:`open_terminals`, from before.
    """
    with contextlib.suppress(OSError):
        for number in terminals:
            if not os.isatty(number):
                null = os.open(os.devnull, os.O_RDWR)
                os.dup2(null, number)
                os.close(null)


def printable(text: str) -> str:
    """Text without what a terminal would obey: names of files and folders can hold anything.

    Line ends and tabs stay; other control characters are shown by their number.
    """
    return _CONTROL.sub(lambda found: f"\\x{ord(found[0]):02x}", text)


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
                TextColumn("{task.description}", markup=False),  # a folder may be named [x]
                BarColumn(),
                MofNCompleteColumn(),
                TextColumn("{task.fields[rate]}"),
                TimeRemainingColumn(),
                console=Console(file=self._stream),
            )
            self._task = self._bar.add_task(
                printable(self._label), total=self._total, completed=self._before, rate=""
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
            self._bar.console.print(printable(text), markup=False, highlight=False)
        else:
            self._write(text)

    def _write(self, text: str) -> None:
        # a reader of stderr that has gone away must not end the run
        with contextlib.suppress(OSError, ValueError):
            print(printable(text), file=self._stream, flush=True)
