"""Rerun's own program: a window, or a page for a browser, beside a run."""

from __future__ import annotations

import contextlib
import os
import socket
import subprocess
import sys
import tempfile
import time
from typing import IO
from urllib.parse import quote

from hybridvo.io.viewer.address import HOST, PAGE_PORT, PORT, SERVE, Address

# s within which the viewer has to listen: a window needs about one
VIEWER_START_S = 20.0
# s between two questions whether it listens
VIEWER_POLL_S = 0.1

DISPLAYS = ("DISPLAY", "WAYLAND_DISPLAY", "WAYLAND_SOCKET")
"""Variables of which one is set where Linux can show a window."""


class NoViewer(Exception):
    """There is no viewer; the message states why, and what to do."""


class Program:
    """A viewer that was started here.

    A window stays open when the run is over; a page ends with the process that started it.

    Args:
        kind: ``spawn`` or ``serve``.

    Raises:
        NoViewer: It cannot be started.
    """

    def __init__(self, kind: str) -> None:
        self.page = ""
        module = "rerun_cli"
        port = free_port(PORT)
        words = ["--bind", HOST, "--port", str(port)]
        self.address = Address(kind, HOST, port)
        listening = port
        if kind == SERVE:
            module = "hybridvo.io.viewer.page"
            listening = free_port(PAGE_PORT, port)
            words += ["--serve-web", "--web-viewer-port", str(listening)]
            self.page = (
                f"http://{HOST}:{listening}/?url={quote(self.address.url, '')}"
            )
        else:
            check_display()
            words += ["--hide-welcome-screen", "--expect-data-soon"]
        self._log: IO[bytes] = tempfile.TemporaryFile()
        self._process = subprocess.Popen(
            [sys.executable, "-m", module, *words],
            # a page ends when this end of the pipe is closed, at the latest with this process
            stdin=subprocess.PIPE if self.page else subprocess.DEVNULL,
            stdout=subprocess.DEVNULL,
            stderr=self._log,
            start_new_session=True,
            env=os.environ | {"RERUN_APP_ONLY": "true", "NO_COLOR": "1"},
        )
        self._wait_for(listening)

    def stop(self) -> None:
        """End a page; a window stays."""
        if self._process.stdin is not None:
            self._process.stdin.close()
            self._process.wait()

    def last_words(self) -> str:
        """Return the last line that it wrote before it ended; empty while it runs."""
        if self._process.poll() is None:
            return ""
        self._log.seek(0)
        lines = self._log.read().decode(errors="replace").split("\n")
        return next((line for line in reversed(lines) if line.strip()), "it ended")

    def _wait_for(self, port: int) -> None:
        """Wait until it listens."""
        deadline = time.monotonic() + VIEWER_START_S
        while time.monotonic() < deadline:
            if words := self.last_words():
                raise NoViewer(f"Rerun's viewer ended at once: {words}; {REMEDY}")
            if listens(HOST, port):
                return
            time.sleep(VIEWER_POLL_S)
        raise NoViewer(
            f"Rerun's viewer did not start within {VIEWER_START_S:g} s; {REMEDY}"
        )


REMEDY = "--rrd FILE records the same for later"
"""What helps whatever is wrong with a viewer."""


def check_display() -> None:
    """Raise NoViewer where no window can be opened."""
    if sys.platform == "linux" and not any(map(os.environ.get, DISPLAYS)):
        raise NoViewer(
            "no window can be opened here: no display; --view serve shows the run in a "
            f"browser, {REMEDY}"
        )


def listens(host: str, port: int) -> bool:
    """Whether something accepts connections at an address."""
    try:
        socket.create_connection((host, port), timeout=1.0).close()
    except OSError:
        return False
    return True


def free_port(wanted: int, *taken: int) -> int:
    """Return a port of this machine, the wanted one where it is free."""
    for port in (wanted, 0):
        with socket.socket() as probe:
            probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            with contextlib.suppress(OSError):
                probe.bind((HOST, port))
                found: int = probe.getsockname()[1]
                if found not in taken:
                    return found
    raise NoViewer(f"no port is free here; {REMEDY}")
