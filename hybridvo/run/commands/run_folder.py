"""The output folder of a run: its files while it is filled, and how a run is resumed."""

from __future__ import annotations

import contextlib
import csv
import io
import json
import logging
import os
import shlex
from collections.abc import Iterable, Iterator, Mapping
from hashlib import sha256
from pathlib import Path
from typing import Any

from hybridvo.core.errors import FormatError, HybridVOError, InputError
from hybridvo.core.files import (
    Journal,
    LineFile,
    Mode,
    checksum,
    read_bytes,
    remove,
    write_json,
)
from hybridvo.network.models import Models
from hybridvo.run.commands.object_rows import OBJECTS

_logger = logging.getLogger(__name__)

STATE = "run.json"
"""The file that describes a run, and states whether it is done."""
STEPS = "steps.csv"
CHECKPOINT = "checkpoint.jsonl"
"""The journal of an unfinished run: its rows, each with the tracker's state after it."""
RECORDING = "recording.rrd"
PICTURE = "trajectory.png"
RESULTS = (
    "trajectory.tum",
    "trajectory.kitti",
    PICTURE,
    STEPS,
    "steps.npz",
    "metrics.json",
    OBJECTS,
    RECORDING,
)
"""The files that a finished run may leave beside ``run.json``."""
LIVE_STEPS = "steps.jsonl"
"""One line of JSON a step, which ``hybridvo live`` writes."""
ALL_RESULTS = (STATE, CHECKPOINT, *RESULTS, LIVE_STEPS)
"""Files of a run, or of a live one, which may not lie beside those of another."""
OPTIONAL_RESULTS = (PICTURE, RECORDING)
"""Results without which a finished run is still complete."""
HIDDEN_COLUMNS = (
    "T_curr_prev",
    "T_world_cam",
    "covariance",
    "edge_start",
    "T_curr_start",
    "edge_covariance",
    "objects",
    "flow_is_true",
    "stages",
)
"""What is kept of a step but is not in ``steps.csv``."""
DECIDING = (
    "input_hash",
    "opened_with.",
    "weights",
    "options.",
    "versions.hybridvo",
)
"""Beginnings of the keys in ``run.json`` that must be equal in a resumed run."""
FREE = ("options.run.max_failed", "options.run.strict", "options.run.device")
"""Keys among them that may differ."""
REMEDY = "Start anew in another folder: --out DIR (--overwrite deletes the results in this one)"
"""What helps where a run cannot be resumed: the way that loses nothing first."""


class RunFolder:
    """The output folder of a run.

    A resumed run, for which all that decides must be equal, has the tracker's state after the
    rows, or the summary if it was complete.

    Args:
        path: The folder.
        header: What ``run.json`` states of the inputs.
        mode: What happens to results that are there already.

    Attributes:
        rows: What is kept of each finished frame, JSON-ready.
        tracker: The tracker's state after the rows; None in a new run.
        summary: The summary of a run that is complete, else None.

    Raises:
        InputError: The folder holds results, or a run that cannot be resumed.
        OutputError: A file cannot be written.
    """

    def __init__(
        self, path: Path, header: Mapping[str, Any], mode: Mode = "new"
    ) -> None:
        self.path = path
        # What JSON makes of it, so that it can be compared with what a file holds.
        self.header = json.loads(json.dumps(header))
        self.rows: list[dict[str, Any]] = []
        self.tracker: Any = None
        self.summary: dict[str, Any] | None = None
        present = self._present()
        self._is_resumed = bool(present) and mode == "resume"
        if present and mode == "new":
            names = ", ".join(present[:3])
            choices = "--resume to go on, another --out, or --overwrite to delete them first"
            raise InputError(f"{path}: holds results ({names}). Pass {choices}.")
        is_unfinished = False
        if present and mode == "resume":
            before = self._state_before()
            with self.stored_is_whole():
                if before["state"] == "done":
                    self.summary = self._checked_summary(before["summary"])
                else:
                    is_unfinished = True
        if self.summary is None:
            self._open(is_unfinished)

    @contextlib.contextmanager
    def stored_is_whole(self) -> Iterator[None]:
        """Name the folder where a resumed run fails as only one does that holds nonsense.

        Checksums find damage. What a stranger has made up has the right ones, and may be of any
        type and value.

        Raises:
            InputError: In place of any exception that is no answer to input; it bears that one.
        """
        try:
            yield
        except (HybridVOError, OSError):
            raise
        except Exception as error:
            if not self._is_resumed:
                raise
            reason = " ".join(f"{type(error).__name__}: {error}".split())[:200]
            raise InputError(
                f"{self.path}: cannot be resumed: what it holds of the run before is no such run "
                f"({reason}). {REMEDY}."
            ) from error

    def add(self, row: dict[str, Any], tracker: Any) -> None:
        """Keep the row of one more frame, and the tracker's state after it."""
        self._checkpoint.add([row, tracker])
        self.rows.append(row)
        is_first = len(self.rows) == 1
        for line in _csv_lines([row], with_names=is_first):
            self._steps.add(line)

    def save(self, state: str, **more: Any) -> None:
        """Write ``run.json``: ``running``, ``interrupted``, or ``done`` after the results."""
        is_done = state == "done"
        if is_done:
            self.close()
        content = {
            **self.header,
            **more,
            "state": state,
            "frames_done": len(self.rows),
        }
        sealed = content | {"checksum": checksum(json.dumps(content))}
        write_json(self.path / STATE, sealed)
        if is_done:
            remove(self.path / CHECKPOINT)

    def close(self) -> None:
        """Close the files that grow with the run, if they are open."""
        if self.summary is None:
            self._steps.close()
            self._checkpoint.close()

    def _present(self) -> list[str]:
        """Return the names of results that are in the folder."""
        return [name for name in ALL_RESULTS if os.path.lexists(self.path / name)]

    def _state_before(self) -> dict[str, Any]:
        """Read ``run.json`` of the run to resume; an InputError if its inputs differ."""
        before = self._read_state()
        then = _deciding(before)
        now = _deciding(self.header)
        for key in now | then:
            old = then.get(key, "unknown")
            new = now.get(key, "unknown")
            if old != new:
                problem = f"{key} differs ({old[:40]} then, {new[:40]} now)"
                if key == "input_hash":
                    recording = before.get("sequence", "unknown")
                    problem = f"the files are not those of the run, which read {recording}"
                raise InputError(
                    f"{self.path}: cannot be resumed: {problem}. "
                    f"{_resumed_as_started(before)}{REMEDY}."
                )
        return before

    def _read_state(self) -> dict[str, Any]:
        """Read ``run.json``; an InputError if it is not as it was written."""
        path = self.path / STATE
        content: Any = None
        stated = None
        try:
            content = json.loads(read_bytes(path))
            stated = content.pop("checksum")
        except FileNotFoundError:
            raise InputError(
                f"{self.path}: no {STATE} of a run to resume. {REMEDY}."
            ) from None
        # no JSON, or of another type than a mapping, or nested too deep
        except (ValueError, LookupError, TypeError, AttributeError, RecursionError):
            pass
        if stated is None or stated != checksum(json.dumps(content)):
            problem = "damaged, changed by hand, or of another version"
            raise InputError(
                f"{path}: {problem}: the run cannot be resumed. {REMEDY}."
            )
        return content

    def _checked_summary(self, summary: dict[str, Any]) -> dict[str, Any] | None:
        """Return the summary of a complete run, with the files that are there.

        It is None where a file is missing without which the run must be done again.
        """
        names = [Path(name).name for name in summary["files"]]
        existing = [name for name in names if (self.path / name).is_file()]
        lost = [
            name
            for name in names
            if name not in existing and name not in OPTIONAL_RESULTS
        ]
        if lost:
            _logger.warning(
                "%s: %s gone: computed again", self.path, ", ".join(lost)
            )
            return None
        files = [str(self.path / name) for name in existing]
        return summary | {"out": str(self.path), "files": files}

    def _open(self, is_unfinished: bool) -> None:
        """Open the files that grow with the run, and take over the rows of an unfinished run."""
        path = self.path / CHECKPOINT
        if not is_unfinished:
            remove(path)
        seed = json.dumps(_deciding(self.header))
        try:
            self._checkpoint = Journal(path, seed)
        except FormatError as error:
            raise InputError(
                f"{error} The run cannot be resumed. {REMEDY}."
            ) from None
        with self.stored_is_whole():
            for row, tracker in self._checkpoint.values:
                self.rows.append(row)
                self.tracker = tracker
            lines = list(_csv_lines(self.rows))
        self.save("running")
        if not self.rows:
            remove(*(self.path / name for name in (*RESULTS, LIVE_STEPS)))
        self._steps = LineFile(self.path / STEPS, lines)


def _resumed_as_started(before: Mapping[str, Any]) -> str:
    """The sentence that tells how a run is resumed as it was started; empty of a program's."""
    words = [str(word) for word in before.get("command", [])]
    # of which --overwrite would delete the run
    kept = [word for word in words[1:] if word not in ("--overwrite", "--resume")]
    if not kept:
        return ""
    # whatever the file names, it is this program
    command = shlex.join(["hybridvo", *kept, "--resume"])
    return f"Resume it as it was started: {command} . Or: "


def _deciding(header: Mapping[str, Any]) -> dict[str, str]:
    """Return what must be equal in a resumed run, by keys such as ``options.run.seed``."""
    return {
        key: value
        for key, value in sorted(_flat(header))
        if key.startswith(DECIDING) and key not in FREE
    }


def _flat(header: Mapping[str, Any], prefix: str = "") -> Iterator[tuple[str, str]]:
    """Yield the entries of nested mappings, each with the keys above it."""
    for key, value in header.items():
        if isinstance(value, dict):
            yield from _flat(value, f"{prefix}{key}.")
        else:
            yield f"{prefix}{key}", str(value)


def _csv_lines(
    rows: Iterable[Mapping[str, Any]], with_names: bool = True
) -> Iterator[str]:
    """Yield the lines of ``steps.csv``, the names of the columns first if ``with_names``."""
    for row in rows:
        columns = {
            name: value for name, value in row.items() if name not in HIDDEN_COLUMNS
        }
        if with_names:
            yield _csv_line(columns)
            with_names = False
        yield _csv_line(columns.values())


def _csv_line(values: Iterable[Any]) -> str:
    """Return one line of ``steps.csv``; a number that is not known is empty."""
    line = io.StringIO()
    fields = ["" if _is_unknown(value) else value for value in values]
    csv.writer(line, lineterminator="").writerow(fields)
    return line.getvalue()


def _is_unknown(value: Any) -> bool:
    """Return whether a value is None or NaN."""
    return value is None or value != value


def weights_hash(method: str, models: Models) -> str | None:
    """Return the SHA-256 of the weights that a method uses; None without a network."""
    from hybridvo.pipeline import method_of

    files = [models.path(name) for name in method_of(method).networks]
    if not files:
        return None
    content = b"".join(path.read_bytes() for path in files)
    return sha256(content).hexdigest()
