"""The output folder of one run: lock, refusal to overwrite, frames kept as they finish.

``run.json`` says what the run is and how far it came. Until the results are written,
``steps.partial.jsonl`` holds a line for every finished frame, and ``tracker.npz`` the tracker's
state after every fiftieth: a run that was killed goes on from there and loses at most 50 frames.
"""

from __future__ import annotations

import json
import os
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any, Literal

import filelock
import numpy as np

from hybridvo.errors import InputError, LockedError, OutputError
from hybridvo.files import atomic_write, write_json

RESULTS = (
    *("trajectory.tum", "trajectory.kitti", "trajectory.png"),
    *("steps.csv", "steps.npz", "metrics.json"),
)
"""Files that a finished run leaves beside ``run.json``."""
STATE, PARTIAL, TRACKER, LOCK = "run.json", "steps.partial.jsonl", "tracker.npz", ".run.lock"

Mode = Literal["new", "resume", "overwrite"]


def make_folder(path: Path) -> None:
    """Make a folder for results, and those above it.

    Raises:
        OutputError: it cannot be made.
    """
    try:
        path.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise OutputError(f"{path}: cannot be created: {error.strerror or error}.") from error


class RunFolder:
    """An output folder that one run holds; use as a context manager.

    Args:
        path: the folder; created where absent.
        identity: what must be equal for a run to be resumed (options, input, weights, version);
            JSON-ready.
        header: what else ``run.json`` says.
        mode: ``new`` refuses a folder with results, ``overwrite`` removes those of a run (and no
            other files), ``resume`` goes on.
        results: names of the files that a finished run leaves.

    Attributes:
        frames_done: frames whose rows are kept.
        tracker: arrays of the tracker's state after them, or None.
        finished: whether the run that is resumed was complete already.

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
        self.frames_done, self.finished = 0, False
        self.tracker: dict[str, np.ndarray] | None = None
        self.state: dict[str, Any] = {}
        self._results = tuple(results)
        self._identity = json.loads(json.dumps(identity))
        self._header = dict(header)
        make_folder(self.path)
        self._lock = filelock.FileLock(self.path / LOCK)
        try:
            self._lock.acquire(timeout=0)
        except filelock.Timeout:
            raise LockedError(
                f"{self.path}: held by another run. Wait for it, or choose another --out."
            ) from None
        except OSError as error:
            raise OutputError(f"{self.path}: cannot be written: {error.strerror}.") from error
        try:
            self._prepare(mode)
        except BaseException:
            self._lock.release()
            raise

    def __enter__(self) -> RunFolder:
        return self

    def __exit__(self, *_: object) -> None:
        self._lock.release()

    def _prepare(self, mode: Mode) -> None:
        present = [n for n in (STATE, PARTIAL, *self._results) if os.path.lexists(self.path / n)]
        if present and mode == "new":
            raise InputError(
                f"{self.path}: holds results of a run already ({', '.join(present[:3])}"
                f"{', ...' if len(present) > 3 else ''}). Pass --overwrite to replace them, "
                f"--resume to go on, or another --out."
            )
        if present and mode == "resume":
            self._load()
            if self.finished:
                return
        elif present and not self._is_a_run():
            raise InputError(
                f"{self.path}: holds {', '.join(present[:3])} and no {STATE} of a run: not "
                f"replaced. Move the files away, or choose another --out."
            )
        # before the old results go: without it nothing would say that what is left is a run's
        self.write_state("running")
        if self.frames_done == 0:
            self._remove(PARTIAL, TRACKER, *self._results)

    def _is_a_run(self) -> bool:
        state = self.read_json(STATE)
        return isinstance(state, dict) and "identity" in state

    def _load(self) -> None:
        """State, rows and tracker of an earlier run of the same identity."""
        if not self._is_a_run():
            raise InputError(
                f"{self.path / STATE}: cannot be read, so the run cannot be resumed. "
                f"Pass --overwrite to start anew."
            )
        self.state = self.read_json(STATE)
        then = self.state["identity"]
        for key in sorted({*then, *self._identity}):
            if then.get(key) != self._identity.get(key):
                raise InputError(
                    f"{self.path}: cannot be resumed: {_difference(key, then, self._identity)}. "
                    f"Pass --overwrite to start anew."
                )
        self.finished = self.state["state"] == "done"
        if self.finished or not (self.path / TRACKER).is_file():
            return
        try:
            with np.load(self.path / TRACKER, allow_pickle=False) as stored:
                tracker = dict(stored)
            done = int(tracker.pop("frames_done"))
            rows = list(self.rows(done))
        except (OSError, ValueError, KeyError) as error:
            raise InputError(
                f"{self.path / TRACKER}: cannot be read ({error}), so the run cannot be resumed. "
                f"Pass --overwrite to start anew."
            ) from None
        # what follows the tracker's state is computed again
        with atomic_write(self.path / PARTIAL) as file:
            file.writelines(json.dumps(row) + "\n" for row in rows)
        self.frames_done, self.tracker = done, tracker

    def rows(self, count: int | None = None) -> Iterator[dict[str, Any]]:
        """The rows kept so far, in order: ``count`` of them, by default all."""
        if not (self.path / PARTIAL).exists():
            return
        with (self.path / PARTIAL).open(encoding="utf-8") as file:
            for number, line in enumerate(file):
                if number == (self.frames_done if count is None else count):
                    break
                yield json.loads(line)

    def read_json(self, name: str) -> Any:
        """Content of a JSON file of the folder; None where it is absent or damaged."""
        try:
            return json.loads((self.path / name).read_text(encoding="utf-8"))
        except (OSError, ValueError):
            return None

    def append(self, row: Mapping[str, Any]) -> None:
        """Keep the row of a finished frame.

        Raises:
            OutputError: it cannot be written; rows kept before stay valid.
        """
        try:
            with (self.path / PARTIAL).open("a", encoding="utf-8") as file:
                file.write(json.dumps(row, separators=(",", ":")) + "\n")
        except OSError as error:
            raise OutputError(
                f"{self.path / PARTIAL}: cannot be written: {error.strerror or error}."
            ) from error
        self.frames_done += 1

    def save_tracker(self, arrays: Mapping[str, np.ndarray]) -> None:
        """Keep the tracker's state after the rows kept so far."""
        with atomic_write(self.path / TRACKER, "wb") as file:
            content: dict[str, Any] = {"frames_done": self.frames_done, **arrays}
            np.savez(file, **content)

    def write_state(self, state: str, **more: Any) -> None:
        """Write ``run.json``; ``state`` is ``running``, ``interrupted`` or ``done``."""
        self._header |= more
        content = {"identity": self._identity, "state": state, "frames_done": self.frames_done}
        write_json(self.path / STATE, {**self._header, **content})

    def finish(self, **more: Any) -> None:
        """The results are written: the kept rows are not needed any more."""
        self.write_state("done", **more)
        self._remove(PARTIAL, TRACKER)

    def _remove(self, *names: str) -> None:
        for name in names:
            try:
                (self.path / name).unlink(missing_ok=True)
            except OSError as error:
                raise OutputError(
                    f"{self.path / name}: cannot be replaced: {error.strerror or error}."
                ) from error


def _difference(key: str, then: Any, now: Any) -> str:
    """``options.run.seed: 0 then, 1 now``: the first thing in which two settings differ."""
    path = [key]
    then, now = then.get(key), now.get(key)
    while isinstance(then, dict) and isinstance(now, dict):
        inner = next(k for k in sorted({*then, *now}) if then.get(k) != now.get(k))
        path.append(inner)
        then, now = then.get(inner), now.get(inner)
    return f"{'.'.join(path)} differs ({str(then)[:40]} then, {str(now)[:40]} now)"
