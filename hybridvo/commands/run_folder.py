"""The output folder of one run: lock, refusal to overwrite, frames kept as they finish.

``checkpoint.npz`` holds the rows and the tracker's state: a run that was killed goes on from there.
"""

from __future__ import annotations

import contextlib
import csv
import json
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from hybridvo.errors import InputError, OutputError
from hybridvo.files import Mode, atomic_write, held, write_csv, write_json

RESULTS = (
    *("trajectory.tum", "trajectory.kitti", "trajectory.png"),
    *("steps.csv", "steps.npz", "metrics.json", "recording.rrd"),
)
"""Files that a finished run may leave beside ``run.json``."""
STATE, STEPS, CHECKPOINT = "run.json", "steps.csv", "checkpoint.npz"
STEP_COLUMNS = (
    *("index", "timestamp", "status", "reason", "probability"),
    *("tx", "ty", "tz", "rx", "ry", "rz"),
    *("inlier_ratio", "iterations", "cost", "flow_ms", "motion_ms", "frame_ms"),
    *("prev_index", "flow_source", "message"),
)


class RunFolder:
    """An output folder that one run holds; use as a context manager.

    ``identity`` (JSON-ready) is what must be equal for a run to be resumed, ``header`` what else
    ``run.json`` says. ``new`` refuses a folder with results, ``overwrite`` removes those of a run
    (and no other files), ``resume`` goes on.

    Attributes:
        rows: of the finished frames, JSON-ready, in order.
        tracker: arrays of the tracker's state after them where the run is resumed, or None.
        finished: whether the run that is resumed was complete already.
    """

    def __init__(
        self,
        path: str | os.PathLike[str],
        identity: Mapping[str, Any],
        header: Mapping[str, Any],
        mode: Mode = "new",
    ) -> None:
        self.path = Path(path)
        self.rows: list[dict[str, Any]] = []
        self.tracker: dict[str, np.ndarray] | None = None
        self.finished = False
        self._identity = json.loads(json.dumps(identity))
        self._header = dict(header)
        with contextlib.ExitStack() as stack:
            stack.enter_context(held(self.path))
            self._prepare(mode)
            self._held = stack.pop_all()

    def __enter__(self) -> RunFolder:
        return self

    def __exit__(self, *_: object) -> None:
        self._held.close()

    def _prepare(self, mode: Mode) -> None:
        present = [name for name in (STATE, *RESULTS) if os.path.lexists(self.path / name)]
        if present and mode == "new":
            raise InputError(
                f"{self.path}: holds results of a run already ({', '.join(present[:3])}). Pass "
                f"--overwrite to replace them, --resume to go on, or another --out."
            )
        if present:
            before = self.read_json(STATE)
            if "identity" not in before:
                raise InputError(
                    f"{self.path}: holds {', '.join(present[:3])} and no {STATE} of a run: neither "
                    f"--resume nor --overwrite can go on. Choose another --out."
                )
            if mode == "resume":
                self._load(before)
        if self.finished:
            return
        # before the old results go: without it nothing would say that what is left is a run's
        self.write_state("running")
        if self.rows:  # what follows the checkpoint is computed again
            write_csv(self.path / STEPS, STEP_COLUMNS, self.rows)
        else:
            self._remove(CHECKPOINT, *RESULTS)

    def _load(self, before: Mapping[str, Any]) -> None:
        """Rows and tracker of an earlier run of the same identity."""
        then, now = _flat(before["identity"]), _flat(self._identity)
        for key in sorted({*then, *now}):
            if then.get(key) != now.get(key):
                raise InputError(
                    f"{self.path}: cannot be resumed: {key} differs ({str(then.get(key))[:40]} "
                    f"then, {str(now.get(key))[:40]} now). Pass --overwrite to start anew."
                )
        self.finished = before["state"] == "done"
        if not self.finished and (self.path / CHECKPOINT).is_file():
            with np.load(self.path / CHECKPOINT, allow_pickle=False) as stored:
                arrays = dict(stored)
            self.rows, self.tracker = json.loads(arrays.pop("rows").tobytes()), arrays

    def read_json(self, name: str) -> dict[str, Any]:
        """Content of a JSON file of the folder; empty where it is absent or damaged."""
        try:
            return json.loads((self.path / name).read_text(encoding="utf-8"))
        except (OSError, ValueError):
            return {}

    def append(self, row: dict[str, Any]) -> None:
        """Keep the row of a finished frame, and write its line of ``steps.csv``."""
        path = self.path / STEPS
        try:
            with path.open("a", encoding="utf-8", newline="") as file:
                writer = csv.DictWriter(
                    file, STEP_COLUMNS, extrasaction="ignore", lineterminator="\n"
                )
                if not self.rows:
                    writer.writeheader()
                writer.writerow(row)
        except OSError as error:
            raise OutputError(f"{path}: cannot be written: {error.strerror or error}.") from error
        self.rows.append(row)

    def save_checkpoint(self, tracker: Mapping[str, np.ndarray]) -> None:
        """Keep the rows and the tracker's state after them."""
        rows = np.frombuffer(json.dumps(self.rows).encode(), np.uint8)
        content: dict[str, Any] = {"rows": rows, **tracker}
        with atomic_write(self.path / CHECKPOINT, "wb") as file:
            np.savez(file, **content)

    def write_state(self, state: str, **more: Any) -> None:
        """Write ``run.json``; ``state`` is ``running``, ``interrupted`` or ``done``."""
        content = {"identity": self._identity, "state": state, "frames_done": len(self.rows)}
        write_json(self.path / STATE, {**self._header, **more, **content})
        if state == "done":  # the results are written
            self._remove(CHECKPOINT)

    def _remove(self, *names: str) -> None:
        for name in names:
            try:
                (self.path / name).unlink(missing_ok=True)
            except OSError as error:
                raise OutputError(f"{self.path / name}: cannot be replaced: {error}.") from error


def _flat(values: Mapping[str, Any], prefix: str = "") -> dict[str, Any]:
    """``{"options.run.seed": 0}`` of ``{"options": {"run": {"seed": 0}}}``."""
    found: dict[str, Any] = {}
    for key, value in values.items():
        inner = isinstance(value, dict)
        found |= _flat(value, f"{prefix}{key}.") if inner else {f"{prefix}{key}": value}
    return found
