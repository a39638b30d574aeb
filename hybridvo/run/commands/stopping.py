"""Signals that stop a run: the current frame is finished first."""

from __future__ import annotations

import contextlib
import signal
import threading
from collections.abc import Callable, Iterator
from typing import Any

from hybridvo.core.errors import Interrupted

STOPPING = ("SIGINT", "SIGTERM", "SIGHUP")
"""Names of the signals; Windows has no SIGHUP."""
DEFAULT_HANDLERS = (signal.SIG_DFL, signal.default_int_handler)
"""Handlers that are replaced. Others stay: those of a program around us, or nohup's, which
ignores a signal."""


class StopRequest:
    """Whether a signal has requested a stop.

    Attributes:
        number: The number of the signal; 0 if there was none.
    """

    number = 0

    def raise_if_requested(self, done: str) -> None:
        """Raise Interrupted if a signal has requested a stop.

        Args:
            done: What was done so far, for the message.
        """
        if not self.number:
            return
        name = signal.Signals(self.number).name
        raise Interrupted(
            f"{name}: stopped after {done}. Go on with --resume.", self.number
        )


@contextlib.contextmanager
def stop_requested(
    tell: Callable[[], None] = lambda: None,
) -> Iterator[StopRequest]:
    """Note signals that request a stop, instead of stopping; a second one has its usual effect.

    Args:
        tell: Is called when a stop is requested.
    """
    request = StopRequest()
    previous: dict[int, Any] = {}

    def restore() -> None:
        for number, handler in previous.items():
            signal.signal(number, handler)

    def note(number: int, _: object) -> None:
        request.number = number
        restore()
        tell()

    # In Python, only the main thread may handle signals.
    if threading.current_thread() is threading.main_thread():
        for number in _stopping_signals():
            if signal.getsignal(number) in DEFAULT_HANDLERS:
                previous[number] = signal.signal(number, note)
    try:
        yield request
    finally:
        restore()


def _stopping_signals() -> list[int]:
    """Return the numbers of the signals that this system has."""
    return [getattr(signal, name) for name in STOPPING if hasattr(signal, name)]
