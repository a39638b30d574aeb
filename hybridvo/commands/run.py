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

import hybridvo
from hybridvo.commands import results
from hybridvo.commands.diagnose import is_dark
from hybridvo.commands.progress import Progress, interruptible
from hybridvo.commands.recording import Recording, check_recording
from hybridvo.commands.run_folder import RESULTS, STATE, RunFolder
from hybridvo.data.sequence import Sequence
from hybridvo.errors import InputError
from hybridvo.evaluation.pair_errors import pair_errors, true_motion, true_trajectory
from hybridvo.files import Mode, fingerprint, versions
from hybridvo.flow import (
    FlowField,
    FlowProvider,
    MeasuredFlow,
    dis_flow,
    fallback,
    file_flow,
)
from hybridvo.geometry import se3_log
from hybridvo.network.models import Models
from hybridvo.odometry import Odometry
from hybridvo.options import Options
from hybridvo.pipeline import check_method, weights_hash
from hybridvo.results import Step
from hybridvo.tracking.state import TrackerState
from hybridvo.types import Frame

EXIT_DONE, EXIT_FAILED_FRAMES, EXIT_INTERRUPTED = 0, 3, 130

RECORDING = "recording.rrd"
"""Name of a Rerun recording within the output folder."""
SAVE_EVERY = 50
"""Frames after which the run can be resumed."""


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
) -> tuple[dict[str, Any], int]:
    """Estimate, chain, write and score a sequence: a summary, JSON-ready, and the exit code.

    ``out`` is by default ``runs/NAME``; ``rrd`` is the file of a Rerun recording, empty for
    ``recording.rrd`` in the output folder.
    """
    method = options.run.method
    models = models or Models(options.run.device)
    check_method(method, models)
    if rrd is not None:
        check_recording(rrd or RECORDING)
    frames = _frames(sequence, options)
    flow = MeasuredFlow(_flow_provider(sequence, options))
    out = _folder(out, sequence)
    vo = Odometry(models, flow=flow, method=method, options=options, seed=options.run.seed)
    vo.warm_up()  # before the folder is taken: it may last
    deciding = dataclasses.asdict(options)
    for name in ("max_failed", "strict", "device"):
        del deciding["run"][name]
    identity = {  # what a resumed run must share
        "input_hash": fingerprint(sequence.files()),
        "options": deciding,
        "weights": weights_hash(method, models),
        "hybridvo": hybridvo.__version__,
    }
    header = _header(sequence, len(frames), options) | {"command": list(command)}
    header["input_hash"] = identity["input_hash"]
    with RunFolder(out, identity, header, mode) as folder, contextlib.ExitStack() as stack:
        if folder.finished:
            summary = folder.read_json(STATE)["summary"]
            summary |= {"state": "done", "metrics": folder.read_json("metrics.json") or None}
            return summary, _exit_code(summary, options)
        recording = None
        if rrd is not None:
            poses = None if sequence.poses is None else sequence.poses[list(frames)]
            named = (rrd or out / RECORDING, sequence.name, str(identity["input_hash"]))
            first = len(folder.rows)
            recording = Recording(*named, len(frames), first=first, poses=poses)
            stack.enter_context(recording)
        job = _Job(sequence, frames, options, vo, flow, folder, recording)
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

    def run(self, quiet: bool) -> tuple[dict[str, Any], int]:
        label = f"{self.sequence.name} [{self.options.run.method}]"
        rows, total = self.folder.rows, len(self.frames)
        with (
            interruptible() as interrupted,
            Progress(total, label, quiet=quiet, done=len(rows)) as progress,
        ):
            for warning in self.sequence.warnings:
                progress.say(f"warning: {warning}")
            if self.folder.tracker is not None:
                self.vo.resume(TrackerState.from_arrays(self.folder.tracker))
                progress.say(f"resumed after {len(rows)} of {total} frames")
            failed = sum(row["status"] == "failed" for row in rows)
            for index in self.frames[len(rows) :]:
                if interrupted.is_set():
                    break
                row = self._track(index, progress)
                failed += row["status"] == "failed"
                self.folder.append(row)
                progress.update(len(rows), failed)
                if len(rows) % SAVE_EVERY == 0:
                    self.folder.save_checkpoint(self.vo.state.to_arrays())
            if interrupted.is_set():
                if rows:
                    self.folder.save_checkpoint(self.vo.state.to_arrays())
                progress.say(f"interrupted: {len(rows)} frames are kept; go on with --resume")
            return self._write(interrupted.is_set())

    def _track(self, index: int, progress: Progress) -> dict[str, Any]:
        """Row of one frame; says so on the screen where its motion is not ok."""
        stamp = float(self.sequence.timestamps[index])
        prev = self.vo.state.frame
        frame, ms = None, 0.0
        self.flow.reset()
        try:
            frame = self.sequence.frame(index)
        except (InputError, OSError) as error:
            if self.options.run.strict:
                raise InputError(f"frame {index}: {error}") from error
            step = self.vo.skip(index, stamp, str(error))
        else:
            started = time.perf_counter()
            step = self.vo.track(frame)
            ms = 1e3 * (time.perf_counter() - started)
        # the window may have asked for more, from its key frames
        field = next(iter(self.flow.fields.values()), FlowField(None, source=""))
        row = self._row(step, prev, frame, field, ms)
        if frame is not None and self.recording is not None:
            self.recording.add(frame, step, field.flow)
        if row["status"] != "ok":
            text = f"frame {index}: {row['status']} ({row['reason']}), probability "
            progress.say(f"{text}{row['probability']:.2f}: {row['message']}")
        return row

    def _row(
        self, step: Step, prev: Frame | None, frame: Frame | None, field: FlowField, ms: float
    ) -> dict[str, Any]:
        """What is kept of a frame, JSON-ready: the columns of ``steps.csv`` and more."""
        motion = step.motion
        message = " ".join(step.status.message.split())
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
            "errors": self._errors(prev, step),
        }

    def _errors(self, prev: Frame | None, step: Step) -> dict[str, Any] | None:
        """Errors of a step against the ground truth, or None where there is none."""
        T_true = None if prev is None else true_motion(self.sequence, prev.index, step.index)
        if T_true is None or prev is None or prev.depth is None:
            return None
        camera = self.sequence.camera(step.index)
        return pair_errors(step.T_curr_prev, T_true, prev.depth, prev.camera, camera)

    def _write(self, interrupted: bool) -> tuple[dict[str, Any], int]:
        """Results of the rows kept so far, and the scores where the run is complete."""
        folder, path, rows = self.folder, self.folder.path, self.folder.rows
        if not rows:  # interrupted before the first frame
            folder.write_state("interrupted")
            return {"state": "interrupted", "frames": 0}, EXIT_INTERRUPTED
        trajectory = results.write_motions(path, rows)
        gt = true_trajectory(self.sequence, self.frames)
        summary = results.summarise(rows, self.sequence, self.options.run.method)
        summary["out"] = os.fspath(path)
        if interrupted:
            folder.write_state("interrupted", summary=summary)
            return summary | {"state": "interrupted"}, EXIT_INTERRUPTED
        exit_code = _exit_code(summary, self.options)
        if exit_code == EXIT_FAILED_FRAMES:
            allowed = self.options.run.max_failed
            summary["warnings"].append(f"more motions failed than --max-failed {allowed:g} allows")
        metrics = None
        if gt is not None:
            alignment = self.options.run.alignment
            metrics = results.write_metrics(path, rows, trajectory, gt, summary, alignment)
        results.draw(path / "trajectory.png", trajectory, gt, summary)
        written = (path / name for name in (*RESULTS, STATE))
        summary["files"] = [os.fspath(file) for file in written if file.exists()]
        folder.write_state("done", summary=summary)
        return summary | {"state": "done", "metrics": metrics}, exit_code


def _frames(sequence: Sequence, options: Options) -> range:
    """Indices of the frames that the options ask for."""
    stop = min(options.run.stop or len(sequence), len(sequence))
    frames = range(options.run.start, stop, options.run.stride)
    if not frames:
        raise InputError(
            f"{sequence.name}: no frames from {options.run.start} to {stop}: there are "
            f"{len(sequence)}."
        )
    return frames


def _flow_provider(sequence: Sequence, options: Options) -> FlowProvider:
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


def _header(sequence: Sequence, frames: int, options: Options) -> dict[str, Any]:
    """What ``run.json`` says of a run beside its state."""
    return {
        "versions": versions(),
        "machine": {"platform": platform.platform(), "cpus": os.cpu_count()},
        "options": dataclasses.asdict(options),
        "sequence": {
            "name": sequence.name,
            "kind": sequence.kind,
            "path": os.fspath(sequence.root),
            "frames": frames,
            "depth_source": sequence.depth_source,
            "warnings": list(sequence.warnings),
        },
    }


def _exit_code(summary: dict[str, Any], options: Options) -> int:
    too_many = summary["failed_fraction"] > options.run.max_failed
    return EXIT_FAILED_FRAMES if too_many else EXIT_DONE
