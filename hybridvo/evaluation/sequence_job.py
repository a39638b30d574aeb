"""One sequence of a comparison: every method and flow on each of its frames, scored."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import pandas as pd

from hybridvo.data.sequence import Sequence, open_sequence
from hybridvo.errors import InputError
from hybridvo.evaluation.metrics import true_trajectory
from hybridvo.evaluation.pair_errors import pair_errors, pair_facts, true_motion
from hybridvo.evaluation.protocols import same_intrinsics
from hybridvo.evaluation.scores import FACTORS, scale_warning, sequence_row
from hybridvo.flow import MeasuredFlow, dis_flow, file_flow
from hybridvo.geometry import invert
from hybridvo.network.models import Models
from hybridvo.odometry import Odometry
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


@dataclass(frozen=True)
class Job:
    """All methods and flows on one sequence; plain data, for another process.

    Args:
        path, dataset: of the sequence. name: in the results.
        flows: ``dis``, ``file``. methods: names. indices: of the frames.
        same_camera_only: leave pairs unscored whose intrinsics change.
        seed, device, weights: of the estimates.
        fingerprint: what decides the result.
    """

    path: str
    dataset: str | None
    name: str
    flows: tuple[str, ...]
    methods: tuple[str, ...]
    indices: range
    same_camera_only: bool
    seed: int
    device: str
    weights: Mapping[str, str]
    fingerprint: str = ""

    @property
    def pairs(self) -> int:
        """Number of pairs of neighbouring frames."""
        return max(0, len(self.indices) - 1)


def open_flow(name: str, sequence: Sequence) -> tuple[str, MeasuredFlow]:
    """What results call a source of flow, ``(true)`` naming an oracle, and its provider."""
    if name == "dis":
        return name, MeasuredFlow(dis_flow())
    label = f"{name} (true)" if sequence.flow_is_true else name
    return label, MeasuredFlow(file_flow(sequence, strict=False))


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


def run_sequence(job: Job, progress: Callable[[int], None] | None = None) -> dict[str, Any]:
    """Estimate and score every pair of a sequence.

    Returns:
        JSON-ready: ``fingerprint``, ``sequence`` (facts), ``rows`` (a line per method and flow),
        ``pairs``, ``timestamps`` and ``trajectories`` (T_world_cam by ``method|flow``).
    """
    sequence = open_sequence(job.path, job.dataset)
    models = Models(job.device, job.weights)
    flows = dict(open_flow(name, sequence) for name in job.flows)
    runs = [
        _Run(method, label, Odometry(models, flow=flow, method=method, seed=job.seed))
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
        if progress is not None and done:
            progress(done)
    order = {(run.method, run.flow_source): k for k, run in enumerate(runs)}
    pairs.sort(key=lambda row: (row["index"], order[row["method"], row["flow_source"]]))
    return _result(job, sequence, runs, pairs, left_out)


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
    sequence: Sequence,
    runs: Iterable[_Run],
    pairs: list[dict[str, Any]],
    left_out: list[dict[str, Any]],
) -> dict[str, Any]:
    table = pair_table(pairs)
    gt = true_trajectory(sequence, job.indices)
    stamps = sequence.timestamps[list(job.indices)]
    paths: dict[str, Any] = {"ground_truth": None if gt is None else gt.T_world_cam.tolist()}
    rows = []
    for run in runs:
        est = Trajectory(stamps, np.stack([run.poses[i] for i in job.indices]))
        mine = (table["method"] == run.method) & (table["flow_source"] == run.flow_source)
        named = {
            "sequence": job.name,
            "method": run.method,
            "flow_source": run.flow_source,
            "depth_source": sequence.depth_source,
        }
        rows.append(sequence_row(table[mine], est if len(est) > 1 else None, gt, named))
        paths[f"{run.method}|{run.flow_source}"] = est.T_world_cam.tolist()
    facts = {
        "name": job.name,
        "kind": sequence.kind,
        "path": job.path,
        "frames": len(job.indices),
        "pairs_scored": table["next"].nunique(),
        "left_out": left_out,
        "depth_source": sequence.depth_source,
        "flow_sources": list(dict.fromkeys(row["flow_source"] for row in rows)),
        "warnings": [*sequence.warnings, *scale_warning(rows)],
    }
    true_stamps = [] if gt is None else gt.timestamps.tolist()
    return {
        "fingerprint": job.fingerprint,
        "sequence": facts,
        "rows": rows,
        "pairs": pairs,
        "timestamps": {"estimate": stamps.tolist(), "ground_truth": true_stamps},
        "trajectories": paths,
    }


def pair_table(pairs: Iterable[Mapping[str, Any]]) -> pd.DataFrame:
    """Pairs as a table with every column; unknown numbers are NaN."""
    table = pd.DataFrame(list(pairs), columns=[*PAIR_COLUMNS, "T_curr_prev"])
    text = ("sequence", "method", "flow_source", "status", "message", "T_curr_prev")
    numbers = [name for name in PAIR_COLUMNS if name not in text]
    table[numbers] = table[numbers].apply(pd.to_numeric)
    return table
