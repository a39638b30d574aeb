"""The output folder of one run: refusal to overwrite, and what is kept until the run is done."""

from __future__ import annotations

import json
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from hybridvo.errors import InputError, OutputError
from hybridvo.evaluation.pair_errors import ERRORS
from hybridvo.files import Mode, atomic_write, write_json

RESULTS = (
    *("trajectory.tum", "trajectory.kitti", "trajectory.png"),
    *("steps.csv", "steps.npz", "metrics.json", "recording.rrd"),
)
"""Files that a finished run may leave beside ``run.json``."""
STATE, STEPS, CHECKPOINT = "run.json", "steps.csv", "checkpoint.json"
STEP_COLUMNS = (
    *("index", "timestamp", "status", "reason", "probability"),
    *("tx", "ty", "tz", "rx", "ry", "rz"),
    *("inlier_ratio", "iterations", "cost", "flow_ms", "motion_ms", "frame_ms"),
    *("prev_index", "flow_source", "message"),
    *ERRORS,
)


class RunFolder:
    """An output folder that is held by one run: ``rows`` of its finished frames, JSON-ready.

    ``header`` (JSON-ready) is what ``run.json`` says. ``new`` refuses a folder with results,
    ``overwrite`` removes those (and no other files), ``resume`` goes on where the ``identity`` of
    the header is the same: ``tracker`` is then the state after the rows, or ``summary`` that of a
    run that was complete.
    """

    def __init__(self, path: Path, header: Mapping[str, Any], mode: Mode = "new") -> None:
        self.path, self.header = path, json.loads(json.dumps(header))
        self.rows: list[dict[str, Any]] = []
        self.tracker: dict[str, Any] | None = None
        self.summary: dict[str, Any] | None = None
        present = [name for name in (STATE, *RESULTS) if os.path.lexists(path / name)]
        if present and mode == "new":
            raise InputError(
                f"{path}: holds results of a run already ({', '.join(present[:3])}). Pass "
                f"--overwrite to replace them, --resume to go on, or another --out."
            )
        if present and mode == "resume":
            self._load()
        if self.summary is None:
            self.save("running")
            if not self.rows:
                self._remove(CHECKPOINT, *RESULTS)

    def _load(self) -> None:
        """Rows and tracker of an earlier run of the same identity."""
        try:
            before = json.loads((self.path / STATE).read_text(encoding="utf-8"))
            both = pd.json_normalize([before["identity"], self.header["identity"]]).map(str)
        except (OSError, ValueError, KeyError):
            raise InputError(
                f"{self.path}: no {STATE} of a run to resume. Pass --overwrite to start anew."
            ) from None
        for key, (then, now) in both.items():
            if then != now:
                raise InputError(
                    f"{self.path}: cannot be resumed: {key} differs ({then[:40]} then, {now[:40]} "
                    f"now). Pass --overwrite to start anew."
                )
        self.summary = before.get("summary")
        if self.summary is None and (self.path / CHECKPOINT).is_file():
            self.rows, self.tracker = json.loads((self.path / CHECKPOINT).read_bytes())

    def save(self, state: str, **more: Any) -> None:
        """Write ``run.json``; ``state`` is ``running`` or ``done``."""
        content = {**self.header, **more, "state": state, "frames_done": len(self.rows)}
        write_json(self.path / STATE, content)
        if state == "done":  # the results are written
            self._remove(CHECKPOINT)

    def save_rows(self, tracker: Mapping[str, Any] | None = None) -> None:
        """Write ``steps.csv``, and with the tracker's state after the rows the checkpoint."""
        with atomic_write(self.path / STEPS) as file:
            table = pd.DataFrame(self.rows, columns=[*STEP_COLUMNS], dtype=object)
            table.to_csv(file, index=False, lineterminator="\n")
        if tracker is not None:
            with atomic_write(self.path / CHECKPOINT) as file:
                file.write(json.dumps([self.rows, tracker], default=np.ndarray.tolist))

    def _remove(self, *names: str) -> None:
        for name in names:
            try:
                (self.path / name).unlink(missing_ok=True)
            except OSError as error:
                raise OutputError(f"{self.path / name}: cannot be replaced: {error}.") from error
