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
from hybridvo.evaluation.pair_errors import pair_errors, pair_facts
from hybridvo.evaluation.protocols import same_intrinsics
from hybridvo.evaluation.scores import FACTORS, scale_warning, sequence_row
from hybridvo.evaluation.sources import SharedFlow, true_flow
from hybridvo.geometry import invert, pose_matrix
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


@dataclass(frozen=True)
class ComparisonOptions:
    """What to compare, and where to work.

    Args:
        sequences: folders; a folder of sequences stands for all of them.
        methods: names, or ``("all",)`` for all that can run.
        flow: ``auto`` (every source that a sequence has, side by side), ``file`` or ``dis``.
        dataset: kind of the sequences; None detects it.
        start, stop, stride: range of frames.
        seed: of everything drawn at random.
        protocol: ``paper`` or ``trajectory14`` (MPI Sintel as others score it), or None.
        weights: name of a network -> its file; the pretrained one where absent.
        device: ``auto``, ``cpu`` or ``cuda``.
        jobs: sequences at a time, a process each. scheduler: address of a Dask cluster
            (``tcp://host:8786``) that works instead.
        worst: pairs shown for each method and flow.

    Raises:
        InputError: a number out of range.
    """

    sequences: tuple[str, ...]
    methods: tuple[str, ...] = ("all",)
    flow: str = "auto"
    dataset: str | None = None
    start: int = 0
    stop: int | None = None
    stride: int = 1
    seed: int = 0
    protocol: str | None = None
    weights: Mapping[str, str] = field(default_factory=dict)
    device: str = "auto"
    jobs: int = 1
    scheduler: str | None = None
    worst: int = 3

    def __post_init__(self) -> None:
        if not self.sequences:
            raise InputError("compare: expected at least one folder of a sequence, got none.")
        lowest = (("start", 0), ("stride", 1), ("seed", 0), ("jobs", 1), ("worst", 0))
        for name, least in lowest:
            if getattr(self, name) < least:
                raise InputError(f"--{name}: expected at least {least}, got {getattr(self, name)}.")
        for name, value, known in (
            ("flow", self.flow, ("auto", "file", "dis")),
            ("device", self.device, ("auto", "cpu", "cuda")),
        ):
            if value not in known:
                raise InputError(f"--{name}: expected {', '.join(known)}, got {value!r}.")


@dataclass(frozen=True)
class Job:
    """All methods and flows on one sequence."""

    path: str
    name: str
    flows: tuple[str, ...]
    methods: tuple[str, ...]
    frames: int
    same_camera_only: bool
    fingerprint: str
    options: ComparisonOptions


def run_sequence(job: Job, progress: Callable[[int], None] | None = None) -> dict[str, Any]:
    """Estimate and score every pair of a sequence: rows, pairs, trajectories, facts; plain data."""
    options = job.options
    sequence = open_sequence(job.path, options.dataset)
    flows = {name: SharedFlow(name, sequence) for name in job.flows}
    models = Models(options.device, options.weights)
    trackers = {
        (flow, method): Odometry(models, flow=flows[flow], method=method, seed=options.seed)
        for flow in job.flows
        for method in job.methods
    }
    frames = range(options.start, options.start + job.frames * options.stride, options.stride)
    poses: dict[tuple[str, str], dict[int, np.ndarray]] = {key: {} for key in trackers}
    pairs: list[dict[str, Any]] = []
    left_out: list[dict[str, Any]] = []
    prev: Frame | None = None
    for done, index in enumerate(frames):
        stamp = float(sequence.timestamps[index])
        facts: dict[str, Any] = {}
        frame: Frame | None
        try:
            frame = sequence.frame(index)
        except (InputError, OSError) as error:
            frame = None
            left_out.append({"index": index, "reason": f"frame cannot be read: {error}"})
        else:
            if prev is not None and frame is not None:
                for flow in flows.values():
                    flow.prepare(prev, frame)
                facts = _facts(sequence, prev, frame, options.stride)
        scored = prev is not None
        if frame is not None and prev is not None and job.same_camera_only:
            scored = same_intrinsics(prev.camera, frame.camera)
            if not scored:
                left_out.append({"index": prev.index, "reason": "the intrinsics change"})
        for (flow, method), vo in _rotated(trackers, done):
            result = _track(vo, frame, index, stamp)
            poses[flow, method][index] = result.pop("T_world_cam")
            if scored and prev is not None:
                T = invert(poses[flow, method][index]) @ poses[flow, method][prev.index]
                named = {
                    "sequence": job.name,
                    "index": index - options.stride,
                    "prev": prev.index,
                    "next": index,
                    "method": method,
                    "flow_source": flows[flow].label,
                    "flow_ms": None if frame is None else flows[flow].ms,
                    "T_curr_prev": T.ravel().tolist(),
                }
                errors = {} if frame is None else _errors(sequence, prev, frame, T)
                pairs.append({**named, **facts, **result, **errors})
        prev = prev if frame is None else frame
        if progress is not None and done:
            progress(done)
    return _part(job, sequence, flows, poses, pairs, left_out)


def _rotated(trackers: Mapping[Any, Any], step: int) -> list[tuple[Any, Any]]:
    """Another one first at every frame: none always finds a cold cache."""
    items = list(trackers.items())
    shift = step % len(items)
    return items[shift:] + items[:shift]


def _track(vo: Odometry, frame: Frame | None, index: int, stamp: float) -> dict[str, Any]:
    """Status, time and pose of one step; a bug of a method costs its pair, not the comparison."""
    ms = None
    if frame is None:
        step = vo.skip(index, stamp)
        status, message = str(step.status), step.status.message
    else:
        started = time.perf_counter()
        try:
            step = vo.track(frame)
            ms = 1e3 * (time.perf_counter() - started)
            status, message = str(step.status), step.status.message
        except InputError:
            raise
        except Exception as error:
            step = vo.skip(index, stamp)
            status, message = "failed(raised)", f"{type(error).__name__}: {error}"
    pose = step.T_world_cam
    return {"status": status, "message": " ".join(message.split()), "ms": ms, "T_world_cam": pose}


def true_motion(sequence: Sequence, prev: int, curr: int) -> np.ndarray | None:
    """True T_curr_prev (4, 4), or None where it is not known."""
    if sequence.poses is None:
        return None
    T = invert(sequence.poses[curr]) @ sequence.poses[prev]
    return T if np.isfinite(T).all() else None


def _facts(sequence: Sequence, prev: Frame, curr: Frame, stride: int) -> dict[str, Any]:
    T_gt = true_motion(sequence, prev.index, curr.index)
    flow_gt = true_flow(sequence, prev.index) if stride == 1 else None
    return pair_facts(T_gt, prev.depth, prev.camera, curr.camera, flow_gt)


def _errors(sequence: Sequence, prev: Frame, curr: Frame, T: np.ndarray) -> dict[str, Any]:
    T_gt = true_motion(sequence, prev.index, curr.index)
    if T_gt is None:
        return {}
    depth = prev.depth if prev.depth is not None else np.full(prev.camera.shape, np.nan)
    return pair_errors(T, T_gt, depth, prev.camera, curr.camera)


def _part(
    job: Job,
    sequence: Sequence,
    flows: Mapping[str, SharedFlow],
    poses: Mapping[tuple[str, str], Mapping[int, np.ndarray]],
    pairs: list[dict[str, Any]],
    left_out: list[dict[str, Any]],
) -> dict[str, Any]:
    """What one job leaves, JSON-ready."""
    order = [(method, flows[flow].label) for flow in job.flows for method in job.methods]
    pairs.sort(key=lambda row: (row["index"], order.index((row["method"], row["flow_source"]))))
    table = pair_table(pairs)
    indices = list(next(iter(poses.values())))
    gt = _true_trajectory(sequence, indices)
    paths: dict[str, Any] = {"ground_truth": None if gt is None else gt.T_world_cam.tolist()}
    rows = []
    for flow in job.flows:
        for method in job.methods:
            label = flows[flow].label
            est = Trajectory(
                sequence.timestamps[indices], np.stack([poses[flow, method][i] for i in indices])
            )
            mine = table[(table["method"] == method) & (table["flow_source"] == label)]
            named = {
                "sequence": job.name,
                "method": method,
                "flow_source": label,
                "depth_source": sequence.depth_source,
            }
            rows.append(sequence_row(mine, est if len(est) > 1 else None, gt, named))
            paths[f"{method}|{label}"] = est.T_world_cam.tolist()
    entry = {
        "name": job.name,
        "kind": sequence.kind,
        "path": job.path,
        "frames": job.frames,
        "pairs_scored": table["next"].nunique(),
        "left_out": left_out,
        "depth_source": sequence.depth_source,
        "flow_sources": [flow.label for flow in flows.values()],
        "warnings": [*sequence.warnings, *scale_warning(rows)],
    }
    known = [] if gt is None else gt.timestamps.tolist()
    stamps = {"estimate": sequence.timestamps[indices].tolist(), "ground_truth": known}
    return {
        "fingerprint": job.fingerprint,
        "sequence": entry,
        "rows": rows,
        "pairs": pairs,
        "timestamps": stamps,
        "trajectories": paths,
    }


def pair_table(pairs: Iterable[Mapping[str, Any]]) -> pd.DataFrame:
    """Pairs as a table with every column; unknown numbers are NaN."""
    table = pd.DataFrame(list(pairs), columns=[*PAIR_COLUMNS, "T_curr_prev"])
    text = ("sequence", "method", "flow_source", "status", "message", "T_curr_prev")
    numbers = [name for name in PAIR_COLUMNS if name not in text]
    table[numbers] = table[numbers].apply(pd.to_numeric)
    return table


def _true_trajectory(sequence: Sequence, indices: Iterable[int]) -> Trajectory | None:
    """True poses of the frames that have one."""
    if sequence.poses is None:
        return None
    known = [i for i in indices if np.isfinite(sequence.poses[i]).all()]
    if not known:
        return None
    # text files carry six digits: made orthonormal as the trajectory demands
    T = np.stack([pose_matrix(sequence.poses[i][:3]) for i in known])
    return Trajectory(sequence.timestamps[known], T)
