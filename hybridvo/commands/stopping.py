"""Signals that ask a run to stop: the frame at hand is finished first."""

from __future__ import annotations

import contextlib
import signal
import threading
from collections.abc import Iterator
from typing import Any

from hybridvo.errors import Interrupted

ASKING = ("SIGINT", "SIGTERM", "SIGHUP")
"""Names of the signals; Windows has no SIGHUP."""
AS_USUAL = (signal.SIG_DFL, signal.default_int_handler)
"""Handlers that are replaced: not those of a program around us, nor nohup's to ignore a signal."""


class StopRequest:
    """Whether a signal has asked to stop."""

    number = 0  # of the signal

    def obey(self, done: str) -> None:
        """Raise Interrupted, which says what is ``done``, where a signal has asked to stop."""
        if self.number:
            name = signal.Signals(self.number).name
            raise Interrupted(
                f"{name}: stopped after {done}. Go on with --resume.", self.number
            )


@contextlib.contextmanager
def stop_requested() -> Iterator[StopRequest]:
    """Note signals that ask to stop, in place of being stopped; a second one acts as usual."""
    request = StopRequest()
    usual: dict[int, Any] = {}

    def restore() -> None:
        for number, handler in usual.items():
            signal.signal(number, handler)

    def note(number: int, _: object) -> None:
        request.number = number
        restore()

    # Python lets no other thread handle signals
    if threading.current_thread() is threading.main_thread():
        numbers = [
            getattr(signal, name) for name in ASKING if hasattr(signal, name)
        ]
        for number in numbers:
            if signal.getsignal(number) in AS_USUAL:
                usual[number] = signal.signal(number, note)
    try:
        yield request
    finally:
        restore()
