"""The output folder of a run: what stands in it while it is filled, and how a run is taken up."""

from __future__ import annotations

import csv
import io
import json
import logging
import os
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any

from hybridvo.errors import FormatError, InputError
from hybridvo.files import (
    Journal,
    LineFile,
    Mode,
    checksum,
    read_bytes,
    remove,
    write_json,
)

_logger = logging.getLogger(__name__)

STATE = "run.json"
STEPS = "steps.csv"
CHECKPOINT = "checkpoint.jsonl"
RECORDING = "recording.rrd"
PICTURE = "trajectory.png"
RESULTS = (
    *("trajectory.tum", "trajectory.kitti", PICTURE),
    *(STEPS, "steps.npz", "metrics.json", RECORDING),
)
"""The files that a finished run may leave beside ``run.json``."""
TO_LOOK_AT = (PICTURE, RECORDING)
"""Results without which a finished run is still whole."""
NO_COLUMNS = ("T_curr_prev", "T_world_cam", "covariance", "flow_is_true")
"""What is kept of a step but does not stand in ``steps.csv``."""
DECIDING = (
    "input_hash",
    "opened_with.",
    "weights",
    "options.",
    "versions.hybridvo",
)
"""Beginnings of the keys in ``run.json`` that must be equal in a resumed run."""
FREE = ("options.run.max_failed", "options.run.strict", "options.run.device")
"""Keys among them that need not be."""
REMEDY = "Pass --overwrite to start anew"


class RunFolder:
    """The output folder of a run, with the ``rows`` of its finished frames, JSON-ready.

    ``header`` goes into ``run.json``. A resumed run, for which all that decides must be equal, has
    the ``tracker``'s state after the rows, or the ``summary`` if it was complete.
    """

    def __init__(
        self, path: Path, header: Mapping[str, Any], mode: Mode = "new"
    ) -> None:
        self.path = path
        self.header = json.loads(json.dumps(header))
        self.rows: list[dict[str, Any]] = []
        self.tracker: Any = None
        self.summary: dict[str, Any] | None = None
        present = [
            name
            for name in (STATE, CHECKPOINT, *RESULTS)
            if os.path.lexists(path / name)
        ]
        if present and mode == "new":
            choices = (
                "--overwrite to replace them, --resume to go on, or another --out"
            )
            raise InputError(
                f"{path}: holds results ({', '.join(present[:3])}). Pass {choices}."
            )
        goes_on = False
        if present and mode == "resume":
            before = self._state_before()
            goes_on = before["state"] != "done"
            if not goes_on:
                self.summary = self._still_there(before["summary"])
        if self.summary is None:
            self._open(goes_on)

    def add(self, row: dict[str, Any], tracker: Any) -> None:
        """Keep the row of one more frame, and the tracker's state after it."""
        self._checkpoint.add([row, tracker])
        self.rows.append(row)
        for line in _csv_lines([row], head=len(self.rows) == 1):
            self._steps.add(line)

    def save(self, state: str, **more: Any) -> None:
        """Write ``run.json``: ``running``, ``interrupted``, or ``done`` after the results."""
        if state == "done":
            self.close()
        content = {
            **self.header,
            **more,
            "state": state,
            "frames_done": len(self.rows),
        }
        write_json(
            self.path / STATE, content | {"checksum": checksum(json.dumps(content))}
        )
        if state == "done":
            remove(self.path / CHECKPOINT)

    def close(self) -> None:
        """Close the files that grow with the run, if they are open."""
        if self.summary is None:
            self._steps.close()
            self._checkpoint.close()

    def _state_before(self) -> dict[str, Any]:
        """What ``run.json`` says of the run to go on with; an InputError if that cannot be."""
        before = self._read_state()
        then = _deciding(before)
        now = _deciding(self.header)
        for key in (now | then).keys():
            old = then.get(key, "unknown")
            new = now.get(key, "unknown")
            if old != new:
                what = f"{key} differs ({old[:40]} then, {new[:40]} now)"
                raise InputError(
                    f"{self.path}: cannot be resumed: {what}. {REMEDY}."
                )
        return before

    def _read_state(self) -> dict[str, Any]:
        """What ``run.json`` says, if it is as it was written."""
        path = self.path / STATE
        try:
            content = json.loads(read_bytes(path))
            stated = content.pop("checksum")
        except FileNotFoundError:
            raise InputError(
                f"{self.path}: no {STATE} of a run to resume. {REMEDY}."
            ) from None
        # no JSON, or of another type than a mapping, or nested too deep
        except (ValueError, LookupError, TypeError, AttributeError, RecursionError):
            stated = None
        if stated is None or stated != checksum(json.dumps(content)):
            what = "damaged, changed by hand, or of another version"
            raise InputError(
                f"{path}: {what}: the run cannot be resumed. {REMEDY}."
            )
        return content

    def _still_there(self, summary: dict[str, Any]) -> dict[str, Any] | None:
        """The summary of a finished run with the files of now; None if some must come again."""
        names = [Path(name).name for name in summary["files"]]
        gone = [name for name in names if not (self.path / name).is_file()]
        lost = [name for name in gone if name not in TO_LOOK_AT]
        if lost:
            _logger.warning(
                "%s: %s gone: computed again", self.path, ", ".join(lost)
            )
            return None
        files = [str(self.path / name) for name in names if name not in gone]
        return summary | {"out": str(self.path), "files": files}

    def _open(self, goes_on: bool) -> None:
        """Open the files that grow with the run, with what there is of them if it goes on."""
        path = self.path / CHECKPOINT
        if not goes_on:
            remove(path)
        try:
            self._checkpoint = Journal(
                path, seed=json.dumps(_deciding(self.header))
            )
        except FormatError as error:
            raise InputError(
                f"{error} The run cannot be resumed. {REMEDY}."
            ) from None
        for row, tracker in self._checkpoint.values:
            self.rows.append(row)
            self.tracker = tracker
        self.save("running")
        if not self.rows:
            remove(*(self.path / name for name in RESULTS))
        self._steps = LineFile(self.path / STEPS, _csv_lines(self.rows))


def _deciding(header: Mapping[str, Any]) -> dict[str, str]:
    """What must be equal in a resumed run, by keys such as ``options.run.seed``."""
    return {
        key: value
        for key, value in sorted(_flat(header))
        if key.startswith(DECIDING) and key not in FREE
    }


def _flat(header: Mapping[str, Any], above: str = "") -> Iterator[tuple[str, str]]:
    """The entries of mappings in mappings, each with the keys above it."""
    for key, value in header.items():
        if isinstance(value, dict):
            yield from _flat(value, f"{above}{key}.")
        else:
            yield f"{above}{key}", str(value)


def _csv_lines(
    rows: Iterable[Mapping[str, Any]], head: bool = True
) -> Iterator[str]:
    """The lines of ``steps.csv``, if asked with the names of the columns before them."""
    for row in rows:
        columns = {
            name: value for name, value in row.items() if name not in NO_COLUMNS
        }
        if head:
            yield _csv_line(columns)
            head = False
        yield _csv_line(columns.values())


def _csv_line(values: Iterable[Any]) -> str:
    """One line of ``steps.csv``; a number that is not known is empty."""
    line = io.StringIO()
    known = ["" if value is None or value != value else value for value in values]
    csv.writer(line, lineterminator="").writerow(known)
    return line.getvalue()
