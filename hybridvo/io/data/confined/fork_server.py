"""The process from which the children are forked, and how one is requested.

Importing the readers takes a second or more, a fork some milliseconds. The process of a run must
not be forked itself: it has threads and memory of its own. So it starts this one, which imports
the readers, never reads a recording, and forks a child for each. It ends with the process of the
run, and its children with it.
"""

from __future__ import annotations

import atexit
import contextlib
import gc
import importlib
import itertools
import json
import os
import shutil
import signal
import subprocess
import sys
import tempfile
import threading
from collections.abc import Iterable
from multiprocessing import Pipe, reduction
from multiprocessing.connection import Connection
from pathlib import Path
from typing import NamedTuple

from hybridvo.core.errors import InputError
from hybridvo.io.data.confined.limits import ROSBAGS, is_available

MAX_REQUEST = 2**16
"""Bytes."""
END_S = 5
"""Seconds in which the process ends by itself."""
START = (
    "import json, sys; sys.path[:] = json.loads(sys.argv[1]); "
    "from hybridvo.io.data.confined.fork_server import main; "
    "main(int(sys.argv[2]), sys.argv[3])"
)
"""What the process runs: with the path of the one that starts it, but without its folder."""
CHILD = "hybridvo.io.data.confined.child"
"""The module of what a child does. The process of the run need not import it."""
BAG_READER = "hybridvo.io.data.bags.reader"
"""The module of the reader of bags, which takes longest to import."""
BAGS = {".bag", ".mcap", ".db3"}
OTHERS = {".mp4", ".avi", ".mov", ".m4v", ".webm", ".mkv", ".npz", ".sens", ".r3d"}
"""Endings of further recordings that a child reads."""
MAX_LOOKED_AT = 100
"""Files of a folder by whose names it is decided that a child will be needed."""
TEMPORARY = ("TMPDIR", "SQLITE_TMPDIR")
"""Variables that name the folder of temporary files to libraries in C."""
ONE_THREAD = {"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}
"""A process of several threads cannot be forked safely."""


class Fork(NamedTuple):
    """A child."""

    pid: int
    connection: Connection
    scratch: (
        Path  # the folder of its temporary files, which whoever requests it removes
    )


class ForkServer:
    """The other end of the process that forks.

    Attributes:
        scratch: The folder of all temporary files of its children. Whichever of both processes
            ends last removes it.
    """

    def __init__(self) -> None:
        """Start it."""
        self.connection, theirs = Pipe()
        self.scratch = Path(tempfile.mkdtemp(prefix="hybridvo-"))
        package = str(Path(__file__).resolve().parents[4])
        # an empty entry is the folder of the user, in which a stranger's files may be
        path = [entry for entry in sys.path if entry] + [package]
        words = [json.dumps(path), str(theirs.fileno()), str(self.scratch)]
        with theirs:
            self._process = subprocess.Popen(
                [sys.executable, "-P", "-c", START, *words],
                stdin=subprocess.DEVNULL,
                stdout=subprocess.DEVNULL,
                # FFmpeg's messages
                stderr=subprocess.DEVNULL,
                env=os.environ | ONE_THREAD,
                pass_fds=[theirs.fileno()],
            )
        self._lock = threading.Lock()

    def fork(self, modules: tuple[str, ...]) -> Fork:
        """Fork a child, after some modules were imported where they are installed."""
        ours, theirs = Pipe()
        with theirs, self._lock:
            scratch = tempfile.mkdtemp(dir=self.scratch)
            self._send(
                {"do": "fork", "modules": (CHILD, *modules), "scratch": scratch}
            )
            reduction.send_handle(
                self.connection, theirs.fileno(), self._process.pid
            )
            return Fork(self._answer(), ours, Path(scratch))

    def prepare(self, modules: tuple[str, ...]) -> None:
        """Let it import some modules, without waiting for it."""
        with self._lock:
            self._send({"do": "import", "modules": modules})

    def end(self, pid: int) -> int:
        """End a child; return its status, as of ``waitpid``."""
        with self._lock:
            self._send({"do": "end", "pid": pid})
            return self._answer()

    def close(self) -> None:
        """End the process, and its children with it."""
        self.connection.close()
        try:
            self._process.wait(END_S)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()
        shutil.rmtree(self.scratch, ignore_errors=True)

    def _send(self, request: dict[str, object]) -> None:
        self.connection.send_bytes(json.dumps(request).encode("ascii"))

    def _answer(self) -> int:
        return int(self.connection.recv_bytes(MAX_REQUEST))


_servers: dict[int, ForkServer] = {}
"""The server of each process: one that was forked has that of its parent beside its own."""
_starting = threading.Lock()


def server() -> ForkServer:
    """Return the server of this process, which is started where there is none."""
    with _starting:
        here = os.getpid()
        if here not in _servers:
            _servers[here] = ForkServer()
            atexit.register(_close, here)
        return _servers[here]


def _close(pid: int) -> None:
    """End the server of a process when that ends."""
    if pid == os.getpid() and pid in _servers:
        _servers.pop(pid).close()


def prepare(path: Path) -> None:
    """Start the server early where a recording needs it: importing takes it a second.

    Args:
        path: Of a recording; by its name alone it is decided.
    """
    # what goes wrong is reported when a child is needed
    with contextlib.suppress(OSError, ValueError):
        inside = path.iterdir() if path.is_dir() else iter([path])
        names = itertools.islice(inside, MAX_LOOKED_AT)
        endings = {each.suffix.lower() for each in names} & (BAGS | OTHERS)
        if not endings or not is_available():
            return
        modules = (BAG_READER, *ROSBAGS) if endings & BAGS else ()
        server().prepare((CHILD, *modules))


def fork(modules: tuple[str, ...]) -> Fork:
    """Fork a child.

    Args:
        modules: What it imports; what is not installed is left out.

    Raises:
        InputError: This machine starts no further process.
    """
    for _ in range(2):
        try:
            return server().fork(modules)
        except (OSError, EOFError, ValueError):
            # the server was killed: another is started
            _close(os.getpid())
    raise InputError(
        "the process that reads recordings could not be started. Read them in this one: --trust."
    )


# -- in the process that forks -----------------------------------------------------------


def main(handle: int, scratch: str) -> None:
    """Fork children until the process that requests them has gone.

    Args:
        handle: Of the connection to it.
        scratch: The folder of all temporary files of the children, which is removed then.
    """
    # the process that requests children decides when this one ends
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        signal.signal(number, signal.SIG_IGN)
    connection = Connection(handle)
    living: set[int] = set()
    # of children whose end was not requested
    statuses: dict[int, int] = {}
    with contextlib.suppress(EOFError, OSError):
        while True:
            request = json.loads(connection.recv_bytes(MAX_REQUEST))
            _import(request.get("modules", ()))
            if request["do"] == "import":
                continue
            if request["do"] == "fork":
                statuses |= _ended(living)
                answer = _fork(connection, request["scratch"])
                living.add(answer)
                # a number may be given a second time
                statuses.pop(answer, None)
            else:
                pid = int(request["pid"])
                answer = _end(pid) if pid in living else statuses.pop(pid, 0)
                living.discard(pid)
            connection.send_bytes(str(answer).encode("ascii"))
    for pid in living:
        _end(pid)
    shutil.rmtree(scratch, ignore_errors=True)


def _import(modules: Iterable[str]) -> None:
    """Import modules, those that are installed."""
    for name in modules:
        with contextlib.suppress(ImportError):
            importlib.import_module(name)


def _fork(connection: Connection, scratch: str) -> int:
    """Fork a child that talks to the process that requests it; return its number.

    All temporary files of the child lie in the folder that is named: those of Python, those of
    SQLite and those of other libraries.
    """
    handle = reduction.recv_handle(connection)
    # what is imported stays shared with the child
    gc.freeze()
    pid = os.fork()
    if pid:
        os.close(handle)
        return pid
    try:
        connection.close()
        tempfile.tempdir = scratch
        os.environ |= dict.fromkeys(TEMPORARY, scratch)
        importlib.import_module(CHILD).serve(Connection(handle))
    finally:
        os._exit(0)


def _ended(living: set[int]) -> dict[int, int]:
    """Return the status of each child that has ended, which is taken from those that live."""
    statuses = {}
    for pid in tuple(living):
        ended, status = os.waitpid(pid, os.WNOHANG)
        if ended:
            statuses[pid] = status
            living.discard(pid)
    return statuses


def _end(pid: int) -> int:
    """End a child, if it has not ended; return its status."""
    os.kill(pid, signal.SIGKILL)
    return os.waitpid(pid, 0)[1]
