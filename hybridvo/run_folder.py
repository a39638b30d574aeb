"""The folder of one run: lock, refusal to overwrite, steps kept as they finish, atomic results.

``run.json`` says what the run is and how far it came; ``steps.partial.jsonl`` holds a line for
every finished frame until the results are written. A run that was killed loses at most the frame
it was working on, and a resumed one ends with the bytes of an uninterrupted one.
"""

from __future__ import annotations

import contextlib
import io
import json
import os
import re
import secrets
import socket
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any, Literal

from hybridvo.checks import make_folder
from hybridvo.errors import InputError, LockedError, OutputError
from hybridvo.evaluation.report import jsonable, write_json

__all__ = ["RESULTS", "RunFolder"]

RESULTS = (
    "trajectory.tum",
    "trajectory.kitti",
    "steps.csv",
    "steps.npz",
    "metrics.json",
    "trajectory.png",
)
"""Files that a finished run leaves beside ``run.json``."""
STATE = "run.json"
PARTIAL = "steps.partial.jsonl"
LOCK = "run.lock"

Mode = Literal["new", "resume", "overwrite"]


class RunFolder:
    """An output folder held by this process; use as a context manager.

    Args:
        path: the folder; created where absent.
        identity: what must be equal for a run to be resumed (options, input hash, versions of the
            estimator); a mapping that JSON can hold.
        header: what else ``run.json`` says (command, versions, machine).
        mode: ``new`` refuses a folder with results, ``overwrite`` removes those of a run (and no
            others), ``resume`` goes on.
        results: names of the files that a finished run leaves.

    ``frames_done`` counts the kept rows, ``last`` is the latest of an earlier run; the rows stay on
    disk, so that memory does not grow with the sequence.

    Raises:
        LockedError: another run holds the folder.
        InputError: results are there and ``mode`` is ``new``; ``resume`` of another run; or
            ``overwrite`` of files that no run has written.
        OutputError: the folder cannot be written.
    """

    def __init__(
        self,
        path: str | os.PathLike[str],
        identity: Mapping[str, Any],
        header: Mapping[str, Any],
        mode: Mode = "new",
        results: Iterable[str] = RESULTS,
    ) -> None:
        self.path = Path(path)
        self._results = tuple(results)
        self._identity = json.loads(json.dumps(jsonable(identity)))
        self._header = dict(header)
        self._partial: io.RawIOBase | None = None
        self._lock = _Lock(self.path / LOCK)
        self.frames_done = 0
        self.state: dict[str, Any] = {}
        self.last: dict[str, Any] | None = None
        make_folder(self.path)
        self._lock.acquire()
        try:
            self._prepare(mode)
        except BaseException:
            self._lock.release()
            raise

    def __enter__(self) -> RunFolder:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    @property
    def finished(self) -> bool:
        """Whether the run that is resumed was finished already."""
        return self._done

    def _prepare(self, mode: Mode) -> None:
        self._done = False
        present = [n for n in (STATE, PARTIAL, *self._results) if os.path.lexists(self.path / n)]
        if mode == "new" and present:
            raise InputError(
                f"{self.path}: holds results of a run already ({', '.join(present[:3])}"
                f"{', ...' if len(present) > 3 else ''}). Pass --overwrite to replace them, "
                f"--resume to go on, or another --out."
            )
        if mode == "resume" and present:
            self._load()
        elif present:
            self._check_replaceable(present)
            with _as_output_error(self.path):
                self._remove(PARTIAL)
        with _as_output_error(self.path):
            self._sweep()
            if self._done:
                self._remove(PARTIAL)
                return
        # before the old results go: without it nothing would say that what is left is a run's
        self.write_state("running")
        if mode == "overwrite":
            with _as_output_error(self.path):
                for name in self._results:
                    self._remove(name)
        # O_NOFOLLOW: a link planted under this name must not lead the rows elsewhere
        flags = os.O_WRONLY | os.O_CREAT | os.O_APPEND | getattr(os, "O_NOFOLLOW", 0)
        with _as_output_error(self.path / PARTIAL):
            descriptor = os.open(self.path / PARTIAL, flags, 0o666)
            self._partial = os.fdopen(descriptor, "ab", buffering=0)

    def _check_replaceable(self, present: list[str]) -> None:
        """Refuse to replace what no run has written: a user's own file of such a name.

        A ``run.json`` that is damaged counts as a run's.
        """
        for name in present:
            if (self.path / name).is_dir() and not (self.path / name).is_symlink():
                raise InputError(
                    f"{self.path / name}: is a folder, a run writes a file of that name. Remove it."
                )
        state = self.read_json(STATE)
        ours = state is None or (isinstance(state, dict) and "identity" in state)
        if not ({STATE, PARTIAL} & set(present) and ours):
            raise InputError(
                f"{self.path}: holds {', '.join(present[:3])}{', ...' if len(present) > 3 else ''},"
                f" and no {STATE} that says a run wrote it: not replaced. Move it away, or choose "
                f"another --out."
            )

    def _load(self) -> None:
        """Rows and state of an earlier run of the same identity."""
        try:
            state = json.loads((self.path / STATE).read_text(encoding="utf-8"))
            identity, self._done = dict(state["identity"]), state["state"] == "done"
            self.state = state
        except (OSError, ValueError, KeyError, TypeError, RecursionError):
            raise InputError(
                f"{self.path / STATE}: cannot be read, so the run cannot be resumed. "
                f"Pass --overwrite to start anew."
            ) from None
        different = sorted(
            key
            for key in {*identity, *self._identity}
            if identity.get(key) != self._identity.get(key)
        )
        if different:
            key = different[0]
            what, then, now = _difference(key, identity.get(key), self._identity.get(key))
            raise InputError(
                f"{self.path}: cannot be resumed: {', '.join(different)} differ from the run that "
                f"was started there ({what}: {_short(then)} then, {_short(now)} now). "
                f"Pass --overwrite to start anew."
            )
        if self._done:
            return
        path = self.path / PARTIAL
        if not os.path.lexists(path):
            return
        with _as_output_error(path):
            good = 0
            # not through a link: what is cut off below must be this run's own
            descriptor = os.open(path, os.O_RDWR | getattr(os, "O_NOFOLLOW", 0))
            with os.fdopen(descriptor, "r+b") as file:
                for line in file:
                    try:
                        row = json.loads(line) if line.endswith(b"\n") else None
                    except (ValueError, RecursionError):
                        row = None
                    if not isinstance(row, dict):
                        break  # torn by the end of the process: what follows is computed again
                    self.frames_done += 1
                    self.last = row
                    good += len(line)
                if good < os.fstat(descriptor).st_size:
                    os.ftruncate(descriptor, good)

    def rows(self) -> Iterator[dict[str, Any]]:
        """The kept rows, in order."""
        with _as_output_error(self.path / PARTIAL), (self.path / PARTIAL).open("rb") as file:
            for line in file:
                yield json.loads(line)

    def read_json(self, name: str) -> Any:
        """Content of a JSON file of the folder; None where it is absent or damaged."""
        try:
            return json.loads((self.path / name).read_text(encoding="utf-8"))
        except (OSError, ValueError, RecursionError):
            return None

    def append(self, row: Mapping[str, Any]) -> None:
        """Keep the row of a finished frame, handed to the operating system before this returns.

        Raises:
            OutputError: the disk is full or the folder is gone; rows kept before stay valid.
        """
        line = json.dumps(jsonable(row), separators=(",", ":")).encode() + b"\n"
        if self._partial is None:
            raise OutputError(f"{self.path}: the run is closed.")
        with _as_output_error(self.path / PARTIAL):
            while line:  # a nearly full disk takes a part and refuses the rest
                line = line[self._partial.write(line) :]
        self.frames_done += 1

    def write_state(self, state: str, **more: Any) -> None:
        """Write ``run.json``.

        Args:
            state: ``running``, ``interrupted``, ``failed`` or ``done``.
            **more: further entries.

        Raises:
            OutputError: it cannot be written.
        """
        self._header |= more
        content = {
            **self._header,
            "identity": self._identity,
            "state": state,
            "frames_done": self.frames_done,
        }
        write_json(self.path / STATE, content)

    def finish(self, **more: Any) -> None:
        """The results are written: the kept rows are not needed any more; ``more`` for run.json."""
        self.write_state("done", **more)
        self._close_partial()
        with _as_output_error(self.path):
            self._remove(PARTIAL)

    def close(self) -> None:
        """Let go of the folder; also done at the end of a ``with`` block."""
        self._close_partial()
        self._lock.release()

    def _close_partial(self) -> None:
        if self._partial is not None:
            with contextlib.suppress(OSError):
                self._partial.close()
            self._partial = None

    def _sweep(self) -> None:
        """Remove what a killed run left half written; nobody else writes here: the lock is ours."""
        names = "|".join(map(re.escape, (STATE, *self._results)))
        leftover = re.compile(rf"\.({names})\.\d+-[0-9a-f]{{8}}\.tmp")
        for path in self.path.iterdir():
            if leftover.fullmatch(path.name):
                path.unlink(missing_ok=True)
        self._lock.sweep()

    def _remove(self, name: str) -> None:
        path = self.path / name
        path.unlink(missing_ok=True)


class _Lock:
    """A file that exists while a run holds its folder; says which process on which machine."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self._content = b""

    def acquire(self) -> None:
        mine = {"pid": os.getpid(), "host": socket.gethostname(), "started": _start_of(os.getpid())}
        content = json.dumps(mine | {"token": secrets.token_hex(8)}).encode()
        # written beside it and then linked: a lock that stands there is never half written
        ready = self.path.with_name(f".{LOCK}.{secrets.token_hex(4)}")
        try:
            with _as_output_error(self.path.parent):
                _write_new(ready, content)
            for _ in range(3):
                try:
                    with _as_output_error(self.path.parent):
                        self._place(ready, content)
                except FileExistsError:
                    self._clear_stale()
                    continue
                self._content = content
                return
        finally:
            with contextlib.suppress(OSError):
                ready.unlink()
        raise LockedError(f"{self.path}: other runs are taking this folder at the same moment.")

    def _place(self, ready: Path, content: bytes) -> None:
        try:
            os.link(ready, self.path)
        except FileExistsError:
            raise
        except OSError:  # a file system without hard links
            _write_new(self.path, content)

    def release(self) -> None:
        if self._content:
            with contextlib.suppress(OSError):
                if self.path.read_bytes() == self._content:
                    self.path.unlink()
            self._content = b""

    def sweep(self) -> None:
        """Remove the unplaced locks of runs that were killed while they took the folder."""
        for path in self.path.parent.glob(f".{LOCK}.*"):
            with contextlib.suppress(OSError, ValueError, KeyError, TypeError):
                holder = json.loads(path.read_bytes())
                if holder["host"] == socket.gethostname() and not _holds(holder):
                    path.unlink()

    def _clear_stale(self) -> None:
        """Remove the lock of a dead process; raise LockedError for a living one."""
        try:
            content = self.path.read_bytes()
        except FileNotFoundError:
            return
        except OSError as error:
            raise OutputError(f"{self.path}: cannot be read: {error.strerror or error}.") from error
        try:
            holder = json.loads(content)
            pid, host = int(holder["pid"]), holder["host"]
        except (ValueError, KeyError, TypeError):
            raise LockedError(
                f"{self.path}: a lock that cannot be read (a run is just starting, or was cut "
                f"off). If no run is using the folder, remove the file."
            ) from None
        if host != socket.gethostname():
            raise LockedError(
                f"{self.path.parent}: held by process {pid} on {host}. If that run is dead, "
                f"remove {self.path}."
            )
        if _holds(holder):
            raise LockedError(
                f"{self.path.parent}: held by another run (process {pid}). Wait for it, or choose "
                f"another --out."
            )
        # moved before it is removed: of two runs that find the same dead lock one gets the file
        aside = self.path.with_name(f".{LOCK}.{secrets.token_hex(4)}")
        try:
            os.rename(self.path, aside)
        except OSError:
            return
        with contextlib.suppress(OSError):
            if aside.read_bytes() != content:  # a new run was faster: give its lock back
                os.link(aside, self.path)
            aside.unlink()


def _write_new(path: Path, content: bytes) -> None:
    """Write a file that must not be there yet, or leave none."""
    descriptor = os.open(path, os.O_CREAT | os.O_EXCL | os.O_WRONLY, 0o666)
    try:
        with os.fdopen(descriptor, "wb") as file:
            file.write(content)
    except BaseException:
        path.unlink(missing_ok=True)
        raise


def _holds(holder: Mapping[str, Any]) -> bool:
    """Whether the process that wrote a lock on this machine is still the one that runs."""
    pid, started = int(holder["pid"]), holder.get("started")
    return _alive(pid) and (started is None or started == _start_of(pid))


def _alive(pid: int) -> bool:
    """Whether a process runs; a killed one that nobody has waited for does not."""
    if _stat(pid)[:1] in (["Z"], ["X"]):
        return False
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    except (OSError, OverflowError):
        return True
    return True


def _start_of(pid: int) -> str | None:
    """When a process started, in the kernel's own count: tells a reused pid; None if unknown."""
    fields = _stat(pid)
    return fields[19] if len(fields) > 19 else None


def _stat(pid: int) -> list[str]:
    """Fields of the kernel's line on a process from its state on; empty if unknown."""
    try:
        return Path(f"/proc/{pid}/stat").read_text().rsplit(")", 1)[1].split()
    except (OSError, IndexError, UnicodeDecodeError):
        return []


@contextlib.contextmanager
def _as_output_error(path: Path) -> Iterator[None]:
    try:
        yield
    except (OutputError, FileExistsError):
        raise
    except OSError as error:
        raise OutputError(f"{path}: cannot be written: {error.strerror or error}.") from error


def _difference(key: str, then: Any, now: Any) -> tuple[str, Any, Any]:
    """Dotted name and both values of the first thing in which two settings differ."""
    while isinstance(then, Mapping) and isinstance(now, Mapping):
        inner = min(k for k in {*then, *now} if then.get(k) != now.get(k))
        key, then, now = f"{key}.{inner}", then.get(inner), now.get(inner)
    return key, then, now


def _short(value: Any) -> str:
    text = json.dumps(value, sort_keys=True)
    return text if len(text) <= 80 else text[:77] + "..."
