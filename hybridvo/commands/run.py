"""``hybridvo run``: a sequence from disk in; trajectory, steps and scores out.

Ground truth is used for scoring alone; what the estimate took from an oracle (true flow, true
depth) is named in every output.
"""

from __future__ import annotations

import contextlib
import dataclasses
import os
import platform
import re
import time
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

import hybridvo
from hybridvo.commands.progress import Progress, interruptible
from hybridvo.commands.recording import Recording, check_recording
from hybridvo.commands.run_folder import RESULTS, STATE, RunFolder
from hybridvo.data.sequence import Sequence
from hybridvo.errors import InputError
from hybridvo.evaluation.metrics import evaluate
from hybridvo.evaluation.pair_errors import mean_pair_errors, step_errors, true_trajectory
from hybridvo.evaluation.plots import plot_trajectories
from hybridvo.files import Mode, atomic_write, fingerprint, held, versions, write_json
from hybridvo.flow import FlowField, FlowProvider, MeasuredFlow, dis_flow, fallback, file_flow
from hybridvo.geometry import se3_log
from hybridvo.network.models import Models
from hybridvo.odometry import Odometry, TrackerState
from hybridvo.options import Options, RunOptions
from hybridvo.pipeline import check_method, weights_hash
from hybridvo.trajectory import Trajectory

EXIT_DONE, EXIT_FAILED_FRAMES, EXIT_INTERRUPTED = 0, 3, 130

RECORDING = "recording.rrd"
"""Name of a Rerun recording within the output folder."""
SAVE_EVERY = 50
"""Frames after which the run can be resumed."""
DARK_LEVEL = 20.0
"""Grey levels (of 255) below which nine tenths of a dark image lie; of a street at night, 60."""


def run(
    sequence: Sequence,
    out: str | os.PathLike[str] | None,
    options: Options,
    *,
    models: Models | None = None,
    mode: Mode = "new",
    command: Iterable[str] = (),
    quiet: bool = False,
    rrd: str | os.PathLike[str] | None = None,
    quick: bool = False,
) -> tuple[dict[str, Any], int]:
    """Estimate, chain, write and score a sequence: a summary, JSON-ready, and the exit code.

    ``out`` is by default ``runs/NAME``; ``rrd`` is the file of a Rerun recording, empty for
    ``recording.rrd`` in the output folder; ``quick``: no warming up and no picture.
    """
    method = options.run.method
    models = models or Models(options.run.device)
    check_method(method)
    if rrd is not None:
        check_recording(rrd or RECORDING)
    frames = frames_of(sequence, options)
    flow = MeasuredFlow(flow_provider(sequence, options))
    out = _folder(out, sequence)
    vo = Odometry(models, flow=flow, method=method, options=options, seed=options.run.seed)
    if not quick:
        vo.warm_up()  # before the folder is taken: it may last
    header = _header(sequence, options, weights_hash(method, models))
    header["command"] = list(command)
    with held(out), contextlib.ExitStack() as stack:
        folder = RunFolder(out, header, mode)
        if folder.summary is not None:
            return folder.summary, _exit_code(folder.summary, options)
        recording = None
        if rrd is not None:
            poses = None if sequence.poses is None else sequence.poses[list(frames)]
            named = (rrd or out / RECORDING, sequence.name, header["input_hash"])
            first = len(folder.rows)
            recording = Recording(*named, len(frames), first=first, poses=poses)
            stack.enter_context(recording)
        job = _Job(sequence, frames, options, vo, flow, folder, recording, quick)
        summary, exit_code = job.run(quiet)
        if recording is not None:
            summary["recording"] = os.fspath(recording.path)
        return summary, exit_code


@dataclass
class _Job:
    """One run under way."""

    sequence: Sequence
    frames: range
    options: Options
    vo: Odometry
    flow: MeasuredFlow
    folder: RunFolder
    recording: Recording | None
    quick: bool

    def run(self, quiet: bool) -> tuple[dict[str, Any], int]:
        label = f"{self.sequence.name} [{self.options.run.method}]"
        folder, rows, total = self.folder, self.folder.rows, len(self.frames)
        with (
            interruptible() as interrupted,
            Progress(label, total, "frames", quiet=quiet, done=len(rows)) as progress,
        ):
            for warning in self.sequence.warnings:
                progress.say(f"warning: {warning}")
            if folder.tracker is not None:
                self.vo.resume(TrackerState.from_arrays(folder.tracker))
                progress.say(f"resumed after {len(rows)} of {total} frames")
            for index in self.frames[len(rows) :]:
                if interrupted.is_set():
                    break
                rows.append(row := self._track(index))
                if row["status"] != "ok":
                    text = f"frame {index}: {row['status']} ({row['reason']}), probability "
                    progress.say(f"{text}{row['probability']:.2f}: {row['message']}")
                progress.update(len(rows), sum(row["status"] == "failed" for row in rows))
                if len(rows) % SAVE_EVERY == 0:
                    folder.save_rows(self.vo.state.to_arrays())
            if interrupted.is_set():
                progress.say(f"interrupted: {len(rows)} frames are kept; go on with --resume")
                folder.save_rows(self.vo.state.to_arrays() if rows else None)
                folder.save("interrupted")
                return {"state": "interrupted", "frames": len(rows)}, EXIT_INTERRUPTED
            folder.save_rows()
            given = (folder.path, rows, self.sequence, self.frames, self.options.run)
            summary = _write_results(*given, picture=not self.quick)
            folder.save("done", summary=summary)
            return summary, _exit_code(summary, self.options)

    def _track(self, index: int) -> dict[str, Any]:
        """What is kept of a frame, JSON-ready: the columns of ``steps.csv`` and more."""
        prev, frame, ms = self.vo.state.frame, None, 0.0
        self.flow.reset()
        try:
            frame = self.sequence.frame(index)
        except (InputError, OSError) as error:
            if self.options.run.strict:
                raise InputError(f"frame {index}: {error}") from error
            step = self.vo.skip(index, float(self.sequence.timestamps[index]), str(error))
        else:
            started = time.perf_counter()
            step = self.vo.track(frame)
            ms = 1e3 * (time.perf_counter() - started)
        field = next(iter(self.flow.fields.values()), FlowField(None, source=""))
        if frame is not None and self.recording is not None:
            self.recording.add(frame, step, field.flow)
        motion, message = step.motion, " ".join(step.status.message.split())
        if frame is not None and not step.ok and is_dark(frame.rgb):
            message = f"the image is dark; {message}"
        values = [*motion.T_curr_prev[:3, 3].tolist(), *se3_log(motion.T_curr_prev)[3:].tolist()]
        return {
            "index": step.index,
            "timestamp": step.timestamp,
            "status": step.status.state.value,
            "reason": step.status.reason.value,
            "probability": float(motion.probability),
            **dict(zip(("tx", "ty", "tz", "rx", "ry", "rz"), values, strict=True)),
            "inlier_ratio": float(motion.inlier_ratio),
            "iterations": int(motion.iterations),
            "cost": float(motion.cost),
            "flow_ms": round(self.flow.ms, 3),
            "motion_ms": round(ms - self.flow.ms, 3),
            "frame_ms": round(ms, 3),
            "prev_index": None if prev is None else prev.index,
            "flow_source": field.source,
            "message": message,
            "T_curr_prev": motion.T_curr_prev.tolist(),
            "T_world_cam": step.T_world_cam.tolist(),
            "covariance": motion.covariance.tolist(),
            "flow_is_true": field.flow is not None and field.is_true,
            **step_errors(self.sequence, prev, step.index, step.T_curr_prev),
        }


def _write_results(
    folder: Path,
    rows: list[dict[str, Any]],
    sequence: Sequence,
    frames: range,
    options: RunOptions,
    *,
    picture: bool,
) -> dict[str, Any]:
    """Write what a finished run leaves beside its steps; its summary, JSON-ready."""
    trajectory = Trajectory(
        np.array([row["timestamp"] for row in rows]), np.array([row["T_world_cam"] for row in rows])
    )
    trajectory.save(folder / "trajectory.tum")
    trajectory.save(folder / "trajectory.kitti")
    names = ("index", "timestamp", "status", "probability", "T_curr_prev", "covariance")
    with atomic_write(folder / "steps.npz", "wb") as file:
        arrays: dict[str, Any] = {name: np.array([row[name] for row in rows]) for name in names}
        np.savez(file, **arrays)
    summary = _summarise(pd.DataFrame(rows), sequence, options.method)
    if summary["failed_fraction"] > options.max_failed:
        text = f"more motions failed than --max-failed {options.max_failed:g} allows"
        summary["warnings"].append(text)
    metrics, gt = None, true_trajectory(sequence, frames)
    if gt is not None:
        report = evaluate(trajectory, gt, alignment=options.alignment)
        pairs = mean_pair_errors(row for row in rows if "rot_err_deg" in row)
        reasons = report["reasons"] | pairs["reasons"]
        named = ("method", "failed", "degraded", "flow_source", "depth_source", "oracle")
        metrics = report | pairs | {key: summary[key] for key in (*named, "sequence")}
        metrics["reasons"] = reasons
        write_json(folder / "metrics.json", metrics)
    if picture:
        title = f"{sequence.name}, flow: {', '.join(summary['flow_source']) or 'none'}"
        if summary["oracle"]:
            title += f" (oracle: {', '.join(summary['oracle'])})"
        path = folder / "trajectory.png"
        plot_trajectories({options.method: trajectory}, path, truth=gt, title=title)
    files = [os.fspath(folder / name) for name in RESULTS if (folder / name).exists()]
    files.append(os.fspath(folder / STATE))
    return summary | {"state": "done", "out": os.fspath(folder), "files": files, "metrics": metrics}


def _summarise(table: pd.DataFrame, sequence: Sequence, method: str) -> dict[str, Any]:
    """Counts, sources, oracles, times and warnings of a run."""
    motions = table[1:]  # the first frame has none
    timed = motions[motions["reason"] != "missing_frame"]
    failed = int((motions["status"] == "failed").sum())
    doubts = motions[(motions["status"] == "ok") & (motions["message"] != "")]
    if any("the median depth" in text for text in sequence.warnings):  # said before the run
        doubts = doubts[:0]
    # what the estimate was given that no sensor gives
    oracle = ["true flow"] if table["flow_is_true"].any() else []
    oracle += ["true depth"] if sequence.depth_source == "true" else []
    return {
        "sequence": sequence.name,
        "method": method,
        "frames": len(table),
        "motions": len(motions),
        "failed": failed,
        "failed_fraction": failed / max(len(motions), 1),
        "degraded": int((motions["status"] == "degraded").sum()),
        "missing_frames": table["index"][table["reason"] == "missing_frame"].tolist(),
        "flow_source": sorted(set(table["flow_source"]) - {""}),
        "depth_source": sequence.depth_source,
        "oracle": oracle,
        **{
            f"{name}_median": float(timed[name].median()) if len(timed) else None
            for name in ("flow_ms", "motion_ms", "frame_ms")
        },
        "warnings": [f"frame {row['index']}: {row['message']}" for _, row in doubts[:1].iterrows()],
    }


def _header(sequence: Sequence, options: Options, weights: str | None) -> dict[str, Any]:
    """What ``run.json`` says of a run beside its state; ``identity``: what a resumed one shares."""
    tree, input_hash = dataclasses.asdict(options), fingerprint(sequence.files())
    free = ("max_failed", "strict", "device")
    deciding = tree | {"run": {k: v for k, v in tree["run"].items() if k not in free}}
    identity = {"input_hash": input_hash, "options": deciding}
    return {
        "identity": identity | {"weights": weights, "hybridvo": hybridvo.__version__},
        "input_hash": input_hash,
        "versions": versions(),
        "machine": {"platform": platform.platform(), "cpus": os.cpu_count()},
        "options": tree,
        "sequence": os.fspath(sequence.root),
    }


def is_dark(rgb: np.ndarray | None) -> bool:
    """Whether an image (H, W, 3) uint8 is too dark to see anything in."""
    return rgb is not None and float(np.percentile(rgb[::4, ::4].max(axis=2), 90)) < DARK_LEVEL


def frames_of(sequence: Sequence, options: Options) -> range:
    """Indices of the frames that the options ask for."""
    stop = min(options.run.stop or len(sequence), len(sequence))
    frames = range(options.run.start, stop, options.run.stride)
    if not frames:
        raise InputError(
            f"{sequence.name}: no frames from {options.run.start} to {stop}: there are "
            f"{len(sequence)}."
        )
    return frames


def flow_provider(sequence: Sequence, options: Options) -> FlowProvider:
    """Provider of the flow that the options ask for."""
    source, stride = options.flow.source, options.run.stride
    from_files = file_flow(sequence, strict=options.run.strict)
    if source == "file":
        sequence.check_flow(stride)
        return from_files
    dis = dis_flow(options.flow.dis_preset)
    if source == "auto" and sequence.has_flow and stride == 1:
        # a damaged file is no reason to stop where DIS can stand in
        return fallback(from_files, dis)
    return dis


def _folder(out: str | os.PathLike[str] | None, sequence: Sequence) -> Path:
    """The output folder; never that of the frames: the next run would read what is drawn."""
    name = re.sub(r"[^\w.-]+", "_", sequence.name).strip("._") or "sequence"
    out = Path("runs") / name if out is None else Path(out)
    images = (".png", ".jpg", ".jpeg", ".npy", ".dpt", ".flo")
    folders = {path.parent.resolve() for path in sequence.files() if path.suffix.lower() in images}
    if out.resolve() in folders:
        raise InputError(
            f"{out}: holds frames of the sequence, and results among them would be taken for "
            f"input. Choose another --out."
        )
    return out


def _exit_code(summary: dict[str, Any], options: Options) -> int:
    too_many = summary["failed_fraction"] > options.run.max_failed
    return EXIT_FAILED_FRAMES if too_many else EXIT_DONE
