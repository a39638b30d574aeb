"""One sequence of a comparison: every method and flow on each of its frames, scored."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

import numpy as np
import pandas as pd

from hybridvo.data.sequence import Sequence, open_sequence
from hybridvo.errors import InputError
from hybridvo.evaluation.pair_errors import pair_errors, pair_facts, true_motion, true_trajectory
from hybridvo.evaluation.protocols import same_intrinsics
from hybridvo.evaluation.scores import FACTORS, sequence_row
from hybridvo.flow import MeasuredFlow, dis_flow, file_flow
from hybridvo.geometry import invert
from hybridvo.network.models import Models
from hybridvo.odometry import Odometry
from hybridvo.options import Count, Natural, option_group
from hybridvo.trajectory import Trajectory
from hybridvo.types import Frame

PAIR_COLUMNS = (
    *("sequence", "index", "method", "flow_source", "status"),
    *("epe_l2_px", "rot_err_deg", "trans_err", "ms"),
    *("r_err_deg", "t_err", "epe", "flow_ms", *FACTORS, "prev", "next", "message"),
)
"""Columns of ``pairs.csv``."""
CAMERA_FLOW_KINDS = ("tartanair",)
"""Data sets whose true flow is that of the camera alone: it does not show what moves by itself."""


@option_group
class ComparisonOptions:
    """What to compare, and where to work.

    Args:
        sequences: folders; a folder of sequences stands for all of them.
        methods: names, or ``("all",)`` for all that can run.
        flow: ``auto``: every source that a sequence has, side by side.
        dataset: kind of the sequences; None detects it.
        start, stop, stride: range of frames.
        seed: of everything drawn at random.
        protocol: ``paper`` or ``trajectory14`` (MPI Sintel as others score it), or None.
        weights: name of a network -> its file; the pretrained one where absent.
        device: of the networks.
        worst: pairs shown for each method and flow.
    """

    sequences: tuple[str, ...]
    methods: tuple[str, ...] = ("all",)
    flow: Literal["auto", "file", "dis"] = "auto"
    dataset: str | None = None
    start: Natural = 0
    stop: int | None = None
    stride: Count = 1
    seed: Natural = 0
    protocol: str | None = None
    weights: Mapping[str, str] = field(default_factory=dict)
    device: Literal["auto", "cpu", "cuda"] = "auto"
    worst: Natural = 3


@dataclass(frozen=True)
class Job:
    """All methods and flows (``dis``, ``file``) on one sequence.

    ``stem`` begins the names of its files, ``fingerprint`` stands for all that decides the result.
    """

    path: str
    name: str
    stem: str
    options: ComparisonOptions
    flows: tuple[str, ...]
    methods: tuple[str, ...]
    indices: range
    same_camera_only: bool
    fingerprint: str

    @property
    def pairs(self) -> int:
        """Number of pairs of neighbouring frames."""
        return len(self.indices) - 1

    def open(self) -> tuple[Sequence, Models, dict[str, MeasuredFlow]]:
        """The sequence, the networks, and a provider for each flow, by its name in the results."""
        sequence = open_sequence(self.path, self.options.dataset)
        flows = {}
        for name in self.flows:
            if name == "dis":
                flows[name] = MeasuredFlow(dis_flow())
            else:  # an oracle is named
                label = f"{name} (true)" if sequence.flow_is_true else name
                flows[label] = MeasuredFlow(file_flow(sequence, strict=False))
        return sequence, Models(self.options.device, self.options.weights), flows


@dataclass
class _Run:
    """One method on one source of flow, and the poses T_world_cam that it found, by frame."""

    method: str
    flow_source: str
    vo: Odometry
    poses: dict[int, np.ndarray] = field(default_factory=dict)

    def step(self, frame: Frame | None, index: int, stamp: float) -> dict[str, Any]:
        """Status and time of one frame; a bug of a method costs its pair, not the comparison."""
        ms, raised = None, None
        started = time.perf_counter()
        if frame is None:
            step = self.vo.skip(index, stamp)
        else:
            try:
                step = self.vo.track(frame)
                ms = 1e3 * (time.perf_counter() - started)
            except InputError:
                raise
            except Exception as error:
                step, raised = self.vo.skip(index, stamp), f"{type(error).__name__}: {error}"
        self.poses[index] = step.T_world_cam
        status = "failed(raised)" if raised else str(step.status)
        message = " ".join((raised or step.status.message).split())
        return {"status": status, "message": message, "ms": ms}


def run_sequence(job: Job, out: Path, progress: Callable[[int], None]) -> dict[str, Any]:
    """Estimate and score every pair of a sequence.

    JSON-ready: ``rows`` has a line per method and flow; paths are written to ``out``.
    """
    sequence, models, flows = job.open()
    runs = [
        _Run(method, label, Odometry(models, flow=flow, method=method, seed=job.options.seed))
        for label, flow in flows.items()
        for method in job.methods
    ]
    pairs: list[dict[str, Any]] = []
    left_out: list[dict[str, Any]] = []
    prev: Frame | None = None
    for done, index in enumerate(job.indices):
        frame: Frame | None = None
        facts: dict[str, Any] = {}
        flow_ms: dict[str, float] = {}
        is_scored = prev is not None
        try:
            frame = sequence.frame(index)
        except (InputError, OSError) as error:
            left_out.append({"index": index, "reason": f"frame cannot be read: {error}"})
        if frame is not None and prev is not None:
            for label, flow in flows.items():  # once for all methods, and timed apart
                flow.reset()
                flow(prev, frame)
                flow_ms[label] = flow.ms
            facts = _facts(sequence, prev, frame)
            if job.same_camera_only and not same_intrinsics(prev.camera, frame.camera):
                is_scored = False
                left_out.append({"index": prev.index, "reason": "the intrinsics change"})
        first = done % len(runs)  # another one first at every frame: none always has a cold cache
        for run in (*runs[first:], *runs[:first]):
            outcome = run.step(frame, index, float(sequence.timestamps[index]))
            if is_scored and prev is not None:
                T = invert(run.poses[index]) @ run.poses[prev.index]
                pairs.append(
                    {
                        "sequence": job.name,
                        "index": index - job.indices.step,
                        "prev": prev.index,
                        "next": index,
                        "method": run.method,
                        "flow_source": run.flow_source,
                        "flow_ms": flow_ms.get(run.flow_source),
                        "T_curr_prev": T.ravel().tolist(),
                        **facts,
                        **outcome,
                        **({} if frame is None else _errors(sequence, prev, frame, T)),
                    }
                )
        prev = prev if frame is None else frame
        if done:
            progress(done)
    order = {(run.method, run.flow_source): k for k, run in enumerate(runs)}
    pairs.sort(key=lambda row: (row["index"], order[row["method"], row["flow_source"]]))
    return _result(job, out, sequence, runs, pairs, left_out)


def _facts(sequence: Sequence, prev: Frame, curr: Frame) -> dict[str, Any]:
    """What may explain an error. The true flow serves for this alone: no estimate ever sees it."""
    T_gt, flow_gt = true_motion(sequence, prev.index, curr.index), None
    whole = sequence.flow_is_true and sequence.kind not in CAMERA_FLOW_KINDS
    if whole and curr.index == prev.index + 1:
        try:
            flow_gt = sequence.flow(prev.index)[0]
        except (InputError, OSError):
            pass
    return pair_facts(T_gt, prev.depth, prev.camera, curr.camera, flow_gt)


def _errors(sequence: Sequence, prev: Frame, curr: Frame, T: np.ndarray) -> dict[str, Any]:
    T_gt = true_motion(sequence, prev.index, curr.index)
    if T_gt is None:
        return {}
    depth = prev.depth if prev.depth is not None else np.full(prev.camera.shape, np.nan)
    return pair_errors(T, T_gt, depth, prev.camera, curr.camera)


def _result(
    job: Job,
    out: Path,
    sequence: Sequence,
    runs: Iterable[_Run],
    pairs: list[dict[str, Any]],
    left_out: list[dict[str, Any]],
) -> dict[str, Any]:
    table = pair_table(pairs)
    gt = true_trajectory(sequence, job.indices)
    stamps = sequence.timestamps[list(job.indices)]
    rows, written = [], []

    def write(path: Trajectory, method: str | None = None, flow: str | None = None) -> None:
        words = [job.stem, method or "ground_truth", *(flow or "").split()[:1]]
        name = f"trajectories/{'_'.join(words)}.tum"
        path.save(out / name)
        named = {"sequence": job.name, "method": method, "flow_source": flow}
        written.append({**named, "path": name})

    if gt is not None:
        write(gt)
    for run in runs:
        est = Trajectory(stamps, np.stack([run.poses[i] for i in job.indices]))
        write(est, run.method, run.flow_source)
        named = {"method": run.method, "flow_source": run.flow_source}
        mine = table[(table[list(named)] == pd.Series(named)).all(axis=1)]
        named |= {"sequence": job.name, "depth_source": sequence.depth_source}
        rows.append(sequence_row(mine, est if len(est) > 1 else None, gt, named))
    facts = {
        "name": job.name,
        "kind": sequence.kind,
        "path": job.path,
        "frames": len(job.indices),
        "pairs_scored": table["next"].nunique(),
        "left_out": left_out,
        "depth_source": sequence.depth_source,
        "flow_sources": list(dict.fromkeys(row["flow_source"] for row in rows)),
        "warnings": list(sequence.warnings),
    }
    return {"sequence": facts, "rows": rows, "pairs": pairs, "trajectories": written}


def pair_table(pairs: Iterable[Mapping[str, Any]]) -> pd.DataFrame:
    """Pairs as a table with every column; unknown numbers are NaN."""
    table = pd.DataFrame(list(pairs), columns=[*PAIR_COLUMNS, "T_curr_prev"])
    text = ("sequence", "method", "flow_source", "status", "message", "T_curr_prev")
    numbers = [name for name in PAIR_COLUMNS if name not in text]
    table[numbers] = table[numbers].apply(pd.to_numeric)
    return table
