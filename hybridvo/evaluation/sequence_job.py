"""One sequence of a comparison: every method and flow on each of its frames, scored."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from hybridvo.data.sequence import Sequence
from hybridvo.errors import InputError
from hybridvo.evaluation.pair_errors import pair_facts, step_errors, true_motion, true_trajectory
from hybridvo.evaluation.protocols import same_intrinsics
from hybridvo.flow import MeasuredFlow
from hybridvo.geometry import invert
from hybridvo.network.models import Models
from hybridvo.odometry import Odometry
from hybridvo.options import Options
from hybridvo.trajectory import Trajectory
from hybridvo.types import Frame

CAMERA_FLOW_KINDS = ("tartanair",)
"""Data sets whose true flow is that of the camera alone: it does not show what moves by itself."""
Key = tuple[str, str]
"""Method and source of flow."""


@dataclass(frozen=True)
class Job:
    """Methods and flows (providers by their name in the results) on frames of one sequence.

    ``stem`` begins the names of its files.
    """

    sequence: Sequence
    name: str
    stem: str
    frames: range
    methods: tuple[str, ...]
    flows: dict[str, MeasuredFlow]
    same_camera_only: bool

    @property
    def pairs(self) -> int:
        """Number of pairs of neighbouring frames."""
        return len(self.frames) - 1


def run_sequence(
    job: Job, options: Options, models: Models, out: Path, progress: Callable[[int], None]
) -> dict[str, Any]:
    """Estimate and score every pair of a sequence, write the paths below ``out``; JSON-ready."""
    sequence, seed = job.sequence, options.run.seed
    runs: dict[Key, Odometry] = {
        (method, label): Odometry(models, flow=flow, method=method, options=options, seed=seed)
        for label, flow in job.flows.items()
        for method in job.methods
    }
    poses: dict[Key, dict[int, np.ndarray]] = {key: {} for key in runs}
    order = list(runs)
    pairs: list[dict[str, Any]] = []
    left_out: list[dict[str, Any]] = []
    prev: Frame | None = None
    for done, index in enumerate(job.frames):
        frame: Frame | None = None
        pair: dict[str, Any] | None = None
        flow_ms: dict[str, float] = {}
        try:
            frame = sequence.frame(index)
        except (InputError, OSError) as error:
            left_out.append({"index": index, "reason": f"frame cannot be read: {error}"})
        if prev is not None:
            pair = {"sequence": job.name, "index": index - job.frames.step}
            pair |= {"prev": prev.index, "next": index}
        if frame is not None and prev is not None:
            for label, flow in job.flows.items():  # once for all methods, and timed apart
                flow.reset()
                flow(prev, frame)
                flow_ms[label] = flow.ms
            if job.same_camera_only and not same_intrinsics(prev.camera, frame.camera):
                left_out.append({"index": prev.index, "reason": "the intrinsics change"})
                pair = None
            else:
                pair = _facts(sequence, prev, frame) | (pair or {})
        first = done % len(runs)  # another one first at every frame: none always has a cold cache
        for key in (*order[first:], *order[:first]):
            stamp = float(sequence.timestamps[index])
            poses[key][index], outcome = _step(runs[key], frame, index, stamp)
            if pair is not None and prev is not None:
                T = invert(poses[key][index]) @ poses[key][prev.index]
                errors = {} if frame is None else step_errors(sequence, prev, index, T) or {}
                named = {"method": key[0], "flow_source": key[1], "flow_ms": flow_ms.get(key[1])}
                pairs.append({**pair, **named, "T_curr_prev": T.tolist(), **outcome, **errors})
        prev = prev if frame is None else frame
        if done:
            progress(done)
    pairs.sort(key=lambda row: (row["index"], order.index((row["method"], row["flow_source"]))))
    facts = {
        "name": job.name,
        "kind": sequence.kind,
        "path": str(sequence.root),
        "frames": len(job.frames),
        "pairs_scored": len({row["next"] for row in pairs}),
        "left_out": left_out,
        "depth_source": sequence.depth_source,
        "flow_sources": list(job.flows),
        "warnings": list(sequence.warnings),
    }
    return {"sequence": facts, "pairs": pairs, "trajectories": _write_paths(job, poses, out)}


def _step(
    vo: Odometry, frame: Frame | None, index: int, stamp: float
) -> tuple[np.ndarray, dict[str, Any]]:
    """Pose, status and time of one frame; a bug of a method costs its pair, not the comparison."""
    ms, raised = None, None
    started = time.perf_counter()
    if frame is None:
        step = vo.skip(index, stamp)
    else:
        try:
            step = vo.track(frame)
            ms = 1e3 * (time.perf_counter() - started)
        except InputError:
            raise
        except Exception as error:
            step, raised = vo.skip(index, stamp), f"{type(error).__name__}: {error}"
    status = "failed(raised)" if raised else str(step.status)
    message = " ".join((raised or step.status.message).split())
    return step.T_world_cam, {"status": status, "message": message, "ms": ms}


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


def _write_paths(
    job: Job, poses: dict[Key, dict[int, np.ndarray]], out: Path
) -> list[dict[str, Any]]:
    """Write the true path, where there is one, and the estimated ones; where each stands."""
    stamps = job.sequence.timestamps[list(job.frames)]
    paths: dict[tuple[str | None, str | None], Trajectory] = {
        key: Trajectory(stamps, np.stack(list(found.values()))) for key, found in poses.items()
    }
    if (gt := true_trajectory(job.sequence, job.frames)) is not None:
        paths = {(None, None): gt} | paths
    written = []
    for (method, flow), path in paths.items():
        words = [job.stem, method or "ground_truth", *(flow or "").split()[:1]]
        name = f"trajectories/{'_'.join(words)}.tum"
        path.save(out / name)
        named = {"sequence": job.name, "method": method, "flow_source": flow}
        written.append({**named, "path": name})
    return written
