"""A sequence that a child process reads: it looks and behaves as the reader in the child."""

from __future__ import annotations

import contextlib
import mmap
import operator
import os
import shutil
import signal
import threading
import weakref
from multiprocessing import reduction
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any, NoReturn

import numpy as np

from hybridvo.core.errors import FormatError, InputError
from hybridvo.core.trajectory import check_increasing
from hybridvo.core.types import Camera, Frame
from hybridvo.io.data.bags.topics import Topics
from hybridvo.io.data.confined import child
from hybridvo.io.data.confined.fork_server import Fork, fork, server
from hybridvo.io.data.confined.limits import CONFINED, MIB, Limits, limits_of
from hybridvo.io.data.confined.wire import POLL_S, array_at, receive, send
from hybridvo.io.data.sequence import Files, Sequence

MAX_RESTARTS = 3
"""Children that are started anew for one sequence: each frame of it may be one that kills."""
READ_AHEAD_AFTER = 3
"""Frames at one distance after which the next one is read ahead."""
STUCK_S = 15
"""Seconds in which a child neither computes nor reads before it is ended."""
TRUST = (
    "If you trust the file, read it without limits: --trust, or open_sequence(..., "
    "trust=True)"
)
"""The remedy of all errors of a child."""


class ReaderStopped(FormatError):
    """The child that reads a recording has died, or was stopped at one of its limits.

    Attributes:
        reason: ``memory``, ``time``, ``stuck``, ``died``, ``unexpected``.
    """

    def __init__(self, message: str, reason: str) -> None:
        super().__init__(message)
        self.reason = reason


class _Child:
    """A child and the way to it; it ends when nothing refers to it any more."""

    def __init__(self, kind: str, module: str, limits: Limits) -> None:
        forked = fork((module, *CONFINED[kind].modules))
        self.process = os.getpid()
        self.limits = limits
        self.memory = mmap.mmap(-1, 1)
        self._forked = forked
        self._close = weakref.finalize(self, _leave, forked, self.process)
        self._activity = ""
        self._idle = 0.0

    @property
    def connection(self) -> Connection:
        return self._forked.connection

    def hand_over_memory(self, size: int) -> None:
        """Make memory into which the child writes images, and hand it over.

        It has no name, so nothing is left of it, and cannot be made smaller under a reader.
        """
        # Windows has none
        import fcntl

        handle = os.memfd_create("hybridvo", os.MFD_CLOEXEC | os.MFD_ALLOW_SEALING)
        try:
            os.ftruncate(handle, size)
            seals = fcntl.F_SEAL_SHRINK | fcntl.F_SEAL_GROW
            fcntl.fcntl(handle, fcntl.F_ADD_SEALS, seals)
            self.memory = mmap.mmap(handle, size)
            reduction.send_handle(self.connection, handle, self._forked.pid)
        finally:
            os.close(handle)

    def ask(self, request: dict[str, Any]) -> None:
        """Send a request."""
        # where the child is gone, the answer is its end
        with contextlib.suppress(OSError):
            send(self.connection, request)

    def answer(self) -> tuple[dict[str, Any], dict[str, np.ndarray]]:
        """Wait for the answer to a request.

        Raises:
            ReaderStopped: There will be none; the message states why.
        """
        self._idle = 0.0
        try:
            return receive(self.connection, self._still_waiting)
        except ReaderStopped:
            raise
        except (EOFError, OSError):
            reason, text = self._end()
        except FormatError as error:
            self._end()
            reason = "died"
            text = f"sent what is no answer: {error}"
        raise ReaderStopped(text, reason)

    def _still_waiting(self) -> None:
        """End the waiting for a child that neither computes nor reads."""
        activity = _activity(self._forked.pid)
        self._idle = self._idle + POLL_S if activity == self._activity else 0.0
        self._activity = activity
        if self._idle >= STUCK_S:
            self._end()
            raise ReaderStopped(f"did nothing for {STUCK_S} s", "stuck")

    def _end(self) -> tuple[str, str]:
        """End the child; return how it had ended, as a word and as a part of a sentence."""
        try:
            status = server().end(self._forked.pid)
        except (OSError, EOFError):
            status = 0
        # after its end, so that it writes nothing more
        self._close()
        number = os.WTERMSIG(status) if os.WIFSIGNALED(status) else 0
        if number == signal.SIGXCPU:
            return "time", f"took more than {self.limits.cpu_s} s of processor time"
        if number:
            return "died", f"was ended by {signal.Signals(number).name}"
        return "died", "ended"


def _leave(forked: Fork, owner: int) -> None:
    """Close the way to a child, which ends it, and remove its temporary files.

    A copy of the process that has requested the child leaves the files to that process.
    """
    forked.connection.close()
    if os.getpid() == owner:
        shutil.rmtree(forked.scratch, ignore_errors=True)


def _activity(pid: int) -> str:
    """Return what changes while a process computes or reads."""
    # /proc names no process that is gone
    with contextlib.suppress(OSError):
        times = Path(f"/proc/{pid}/stat").read_text(encoding="utf-8").split()[-39:]
        read = Path(f"/proc/{pid}/io").read_text(encoding="utf-8").split("\n")[0]
        return " ".join((*times[:2], read))
    return ""


class ConfinedSequence(Sequence):
    """A sequence that is read in a child process with limits on memory, time and files.

    Frames come through shared memory, and the child reads the next one meanwhile. A child that
    dies, or is ended at a limit, costs the frame that it read; another one is started then.

    Args:
        reader: The class that reads the recording.
        root: Its file or folder.
        camera: As in ``open_sequence``.
        depth_scale: Likewise.
        mask: Likewise.
        needs_depth: Likewise.
        chosen: Further choices of the reader.

    Raises:
        InputError: The recording cannot be opened, or its reader was stopped.

    Example:
        >>> sequence = open_sequence("drive.bag")  # doctest: +SKIP
        >>> type(sequence).__name__, sequence.kind  # doctest: +SKIP
        ('ConfinedSequence', 'bag')
    """

    def __init__(
        self,
        reader: type[Sequence],
        root: Path,
        camera: str | Path | Camera | None = None,
        depth_scale: float | None = None,
        mask: str | Path | None = None,
        needs_depth: bool = True,
        chosen: dict[str, str] | None = None,
    ) -> None:
        self._begin(root, root.name, camera, depth_scale, mask)
        self._needs_depth = needs_depth
        self._request = {
            "do": "open",
            "module": reader.__module__,
            "reader": reader.__qualname__,
            "root": str(root),
            "camera": child.camera_message(camera),
            "depth_scale": depth_scale,
            "mask": None if mask is None else str(mask),
            "needs_depth": needs_depth,
            "chosen": chosen or {},
            "limits": limits_of(reader.kind, root)._asdict(),
        }
        self._reader = reader
        self._lock = threading.RLock()
        self._restarts = 0
        # the frame that the child reads ahead, and the last that were requested
        self._ahead: int | None = None
        self._asked: list[int] = []
        self._child: _Child | None = None
        self._stopped: ReaderStopped | None = None
        stated, arrays = self._open_child()
        self._take(stated, arrays)

    def __getstate__(self) -> NoReturn:
        raise TypeError("a sequence that a child process reads cannot be copied.")

    def camera(self, index: int) -> Camera:
        """Return the pinhole camera of a frame."""
        return self._cameras[index if len(self._cameras) > 1 else 0]

    def frame(self, index: int) -> Frame:
        """Read a frame; an InputError states what is wrong with what it is made of."""
        index = operator.index(index)
        where = f"{self.name}: frame {index}"
        with self._lock:
            self._drop_other_than(index)
            if self._ahead is None:
                self._ask({"do": "frame", "index": index}, where)
            self._ahead = None
            answer, _ = self._answer(where)
            try:
                frame = self._frame_of(answer, index)
            except (KeyError, TypeError, ValueError, AttributeError) as error:
                raise FormatError(f"{where}: {error}") from None
            self._read_ahead(index)
        return frame

    def files(self) -> list[Path]:
        """Return every file that is read."""
        with self._lock:
            self._drop_other_than(None)
            self._ask({"do": "files"}, self.name)
            answer, _ = self._answer(self.name)
        return [Path(path) for path in answer["files"]]

    def opened_with(self) -> dict[str, Any]:
        """Return what decides how the files are read beside themselves, JSON-ready."""
        return dict(self._opened_with)

    # -- the child ---------------------------------------------------------------------

    def _open_child(self) -> tuple[dict[str, Any], dict[str, np.ndarray]]:
        """Start a child that opens the recording; return what it states of it."""
        limits = Limits(**self._request["limits"])
        self._child = _Child(self._reader.kind, self._reader.__module__, limits)
        self._child.ask(self._request)
        stated, arrays = self._answer(str(self.root))
        height = int(stated["height"])
        width = int(stated["width"])
        self._child.hand_over_memory(child.memory_bytes(height, width))
        return stated, arrays

    def _ask(self, request: dict[str, Any], where: str) -> None:
        """Send a request to the child, and to a new one where the last was stopped."""
        # of a process that was forked from this one
        is_of_another = (
            self._child is not None and self._child.process != os.getpid()
        )
        if self._child is None or is_of_another:
            if self._restarts >= MAX_RESTARTS and self._stopped is not None:
                count = f"for the {MAX_RESTARTS + 1}th time"
                raise ReaderStopped(
                    f"{where}: not read, because the reader was stopped {count}: "
                    f"{self._stopped}",
                    self._stopped.reason,
                )
            self._restarts += not is_of_another
            self._open_child()
        if self._child is not None:
            self._child.ask(request)

    def _answer(self, where: str) -> tuple[dict[str, Any], dict[str, np.ndarray]]:
        """Wait for an answer; raises what the child has raised."""
        if self._child is None:
            raise FormatError(f"{where}: there is no reader.")
        try:
            answer, arrays = self._child.answer()
        except ReaderStopped as stop:
            self._child = None
            self._stopped = _stopped(stop, where)
            raise self._stopped from None
        if "failure" in answer:
            _raise(answer["failure"], where, self._request["limits"]["memory"])
        return answer, arrays

    # -- frames ------------------------------------------------------------------------

    def _frame_of(self, answer: dict[str, Any], index: int) -> Frame:
        """Copy a frame out of the shared memory."""
        if self._child is None:
            raise FormatError("there is no reader.")
        images: dict[str, np.ndarray] = {}
        for name, (form, place) in answer["images"].items():
            if name in child.IMAGES:
                images[name] = array_at(self._child.memory, place, form).copy()
        return Frame(
            images.get("rgb"),
            images.get("depth"),
            self.camera(index),
            float(self.timestamps[index]),
            index,
            depth_variance=images.get("depth_variance"),
            mask=images.get("mask"),
        )

    def _read_ahead(self, index: int) -> None:
        """Let the child read the frame that comes next, where frames come evenly."""
        self._asked = [*self._asked, index][-READ_AHEAD_AFTER:]
        steps = set(np.diff(self._asked).tolist())
        is_even = len(self._asked) == READ_AHEAD_AFTER and len(steps) == 1
        following = index + steps.pop() if is_even else index
        if index < following < len(self) and self._child is not None:
            self._child.ask({"do": "frame", "index": following})
            self._ahead = following

    def _drop_other_than(self, index: int | None) -> None:
        """Drop the frame that was read ahead, where it is another one."""
        if self._ahead is None or self._ahead == index:
            return
        where = f"{self.name}: frame {self._ahead}"
        self._ahead = None
        # what is wrong with that frame is reported when it is requested
        with contextlib.suppress(InputError, OSError, IndexError):
            self._answer(where)

    # -- what the child states -----------------------------------------------------------

    def _take(self, stated: dict[str, Any], arrays: dict[str, np.ndarray]) -> None:
        """Take over what a child states of a recording, checked."""
        try:
            self._take_texts(stated)
            self._take_arrays(arrays)
            self._cameras = [Camera(**each) for each in stated["cameras"]]
            self._camera = self._cameras[0]
        except (LookupError, TypeError, ValueError, AttributeError) as error:
            raise FormatError(
                f"{self.root}: its reader states nonsense ({error})."
            ) from None
        count = len(self)
        lengths = (len(self.mask_files), len(self._cameras))
        if not count or any(length not in (1, count) for length in lengths):
            raise FormatError(f"{self.root}: its reader states nonsense.")
        check_increasing(self.timestamps, str(self.root))
        self._clean_texts()

    def _take_texts(self, stated: dict[str, Any]) -> None:
        self.kind = self._reader.kind
        for name in (*child.STATED[1:], *child.SOURCES):
            setattr(self, name, stated[name])
        self.name = str(self.name)
        self.warnings = [str(text) for text in self.warnings]
        self.assumed = tuple(str(text) for text in self.assumed)
        for name in child.FILES:
            setattr(self, name, _paths(stated[name]))
        self._opened_with = dict(stated["opened_with"])
        self.chosen = dict(stated["chosen"])
        if stated["topics"] is not None:
            self.topics = Topics(**stated["topics"])

    def _take_arrays(self, arrays: dict[str, np.ndarray]) -> None:
        self.timestamps = arrays["timestamps"].copy()
        for name in child.ARRAYS[1:]:
            found = arrays.get(name)
            setattr(self, name, None if found is None else found.copy())
        shapes = self.timestamps.ndim == 1 and (
            self.poses is None or self.poses.shape == (len(self.timestamps), 4, 4)
        )
        samples = self.imu_samples
        if samples is not None:
            shapes = shapes and samples.ndim == 2 and samples.shape[1] == 7
            turned = self.R_cam_imu
            shapes = shapes and turned is not None and turned.shape == (3, 3)
        if self.T_cam_frame is not None:
            shapes = shapes and self.T_cam_frame.shape == (4, 4)
        if not shapes:
            raise FormatError("arrays of another shape")


def report_of(module: str, function: str, kind: str, path: Path) -> dict[str, Any]:
    """Return what a function states of a recording, which it reads in a child process.

    Args:
        module: Of the function.
        function: Its name; it takes the path, and its report is JSON-ready.
        kind: Of the recording, one of ``CONFINED``.
        path: Its file or folder.

    Raises:
        InputError: The function has raised it, or was stopped.
    """
    limits = limits_of(kind, path)
    reader = _Child(kind, module, limits)
    reader.ask(
        {
            "do": "report",
            "module": module,
            "function": function,
            "root": str(path),
            "limits": limits._asdict(),
        }
    )
    try:
        answer, _ = reader.answer()
    except ReaderStopped as stop:
        raise _stopped(stop, str(path)) from None
    if "failure" in answer:
        _raise(answer["failure"], str(path), limits.memory)
    return dict(answer["report"])


def _stopped(stop: ReaderStopped, where: str) -> ReaderStopped:
    """The error of a child that was stopped."""
    text = f"{where}: its reader {stop}, and was stopped. {TRUST}."
    return ReaderStopped(text, stop.reason)


def _raise(failure: dict[str, Any], where: str, memory: int) -> NoReturn:
    """Raise what a child has raised, which had so many bytes of memory."""
    kind = failure.get("type")
    text = str(failure.get("text"))
    if kind == "memory":
        raise ReaderStopped(
            f"{text or where + ':'} Its reader requested more than {memory // MIB} MiB of "
            f"memory, the limit for a recording of this size. {TRUST}.",
            "memory",
        )
    if kind == "OSError":
        if failure["number"] is None:
            raise OSError(text)
        raise OSError(failure["number"], failure["reason"], failure["file"])
    if kind == "IndexError":
        raise IndexError(text)
    for known in (FormatError, InputError):
        if kind == known.__name__:
            raise known(text)
    raise ReaderStopped(
        f"{where}: its reader failed ({text[:200]}). {TRUST}, which shows where.",
        "unexpected",
    )


def _paths(names: list[str | None]) -> Files:
    """Return files by their names."""
    return [None if name is None else Path(name) for name in names]
