"""``hybridvo run``: a sequence from disk in; trajectory, steps and scores out.

Ground truth is used for scoring alone; what the estimate took from an oracle (true flow, true
depth) is named in every output.
"""

from __future__ import annotations

import contextlib
import os
import time
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

import hybridvo
from hybridvo.commands import results
from hybridvo.commands.inputs import (
    TimedFlow,
    check_outside,
    deciding,
    flow_provider,
    is_dark,
    is_repeated,
    run_header,
    run_name,
)
from hybridvo.commands.progress import Progress, interruptible
from hybridvo.commands.recording import Recording, check_recording
from hybridvo.commands.run_folder import RESULTS, Mode, RunFolder
from hybridvo.data.sequence import Sequence
from hybridvo.depth_steps import depth_ratio
from hybridvo.errors import InputError
from hybridvo.evaluation.pair_errors import pair_errors
from hybridvo.files import fingerprint, write_json
from hybridvo.geometry import invert
from hybridvo.odometry import Odometry
from hybridvo.options import Options
from hybridvo.pipeline import Models, check_method, weights_hash
from hybridvo.tracking.state import TrackerState
from hybridvo.trajectory import Trajectory, read_trajectory
from hybridvo.types import Frame, State, Step

EXIT_DONE, EXIT_FAILED_FRAMES, EXIT_INTERRUPTED = 0, 3, 130

RECORDING = "recording.rrd"
"""Name of a Rerun recording within the output folder."""
SAVE_EVERY = 50
"""Frames after which the tracker's state is written."""


@dataclass(frozen=True, eq=False)
class RunResult:
    """Outcome of a run.

    Args:
        exit_code: 0, 3 (too many failed frames) or 130 (interrupted).
        summary: JSON-ready: state, counts, oracles, times, metrics, files.
        trajectory: the poses so far, or None where no frame was finished.
        gt: true poses, or None.
    """

    exit_code: int
    summary: dict[str, Any]
    trajectory: Trajectory | None
    gt: Trajectory | None


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
) -> RunResult:
    """Estimate, chain, write and score a sequence.

    Args:
        sequence: an open one, see :func:`hybridvo.data.sequence.open_sequence`.
        out: output folder, default ``runs/NAME``.
        options: see :class:`hybridvo.options.Options`.
        models: networks instead of the pretrained ones.
        mode: ``new``, ``resume`` or ``overwrite``.
        command: for ``run.json``.
        quiet: no progress.
        rrd: file of a Rerun recording; empty for ``recording.rrd`` in the output folder.

    Raises:
        InputError: input or options that cannot be used, or a broken frame with ``strict``.
        LockedError: another run holds the folder. OutputError: a result cannot be written.
    """
    method = options.run.method
    models = models or Models(options.run.device)
    check_method(method, models)
    if rrd is not None:
        check_recording(rrd or RECORDING)
    stop = min(options.run.stop or len(sequence), len(sequence))
    frames = range(options.run.start, stop, options.run.stride)
    if not frames:
        raise InputError(
            f"{sequence.name}: no frames from {options.run.start} to {stop}: there are "
            f"{len(sequence)}."
        )
    flow = TimedFlow(flow_provider(sequence, options), options.run.strict)
    out = Path("runs") / run_name(sequence) if out is None else Path(out)
    check_outside(out, sequence)
    vo = Odometry(models, flow=flow, method=method, options=options, seed=options.run.seed)
    vo.warm_up()  # before the folder is taken: it may last
    identity = {
        "input_hash": fingerprint(sequence.files()),
        "options": deciding(options),
        "weights": weights_hash(method, models),
        "hybridvo": hybridvo.__version__,
    }
    header = run_header(sequence, frames, options, command) | {"input_hash": identity["input_hash"]}
    with RunFolder(out, identity, header, mode, (*RESULTS, RECORDING)) as folder:
        if folder.finished:
            return _finished_before(folder)
        with contextlib.ExitStack() as stack:
            recording = None
            if rrd is not None:
                recording = Recording(
                    rrd or out / RECORDING,
                    sequence.name,
                    str(identity["input_hash"]),
                    len(frames),
                    first=folder.frames_done,
                    poses=None if sequence.poses is None else sequence.poses[list(frames)],
                )
                stack.enter_context(recording)
            job = _Job(sequence, frames, options, vo, flow, folder, recording)
            result = job.run(quiet)
        if recording is not None:
            result.summary["recording"] = os.fspath(recording.path)
        return result


@dataclass
class _Job:
    """One run under way."""

    sequence: Sequence
    frames: range
    options: Options
    vo: Odometry
    flow: TimedFlow
    folder: RunFolder
    recording: Recording | None

    def run(self, quiet: bool) -> RunResult:
        label = f"{self.sequence.name} [{self.options.run.method}]"
        done = self.folder.frames_done
        with (
            interruptible() as interrupted,
            Progress(len(self.frames), label, quiet=quiet, done=done) as progress,
        ):
            for warning in self.sequence.warnings:
                progress.say(f"warning: {warning}")
            if self.folder.tracker is not None:
                self.vo.resume(TrackerState.from_arrays(self.folder.tracker))
                progress.say(f"resumed after {done} of {len(self.frames)} frames")
            failed = sum(row["status"] == "failed" for row in self.folder.rows())
            for index in self.frames[done:]:
                if interrupted.is_set():
                    break
                row = self._track(index, progress)
                failed += row["status"] == "failed"
                self.folder.append(row)
                progress.update(self.folder.frames_done, failed)
                if self.folder.frames_done % SAVE_EVERY == 0:
                    self.folder.save_tracker(self.vo.state.to_arrays())
            if interrupted.is_set():
                self.folder.save_tracker(self.vo.state.to_arrays())
                kept = self.folder.frames_done
                progress.say(f"interrupted: {kept} frames are kept; go on with --resume")
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
        row = self._row(step, prev, frame, ms)
        if frame is not None and self.recording is not None:
            self.recording.add(
                frame, step, None if self.flow.field is None else self.flow.field.flow
            )
        if row["status"] != "ok":
            text = f"frame {index}: {row['status']} ({row['reason']}), probability "
            progress.say(f"{text}{row['probability']:.2f}: {row['message']}")
        return row

    def _row(
        self, step: Step, prev: Frame | None, frame: Frame | None, ms: float
    ) -> dict[str, Any]:
        motion, field = step.motion, self.flow.field
        flow = None if field is None else field.flow
        message = step.status.message
        if frame is not None and not step.ok and is_dark(frame.rgb):
            message = f"the image is dark; {message}"
        ratio, repeated = None, False
        if prev is not None and frame is not None and step.status.state is not State.FAILED:
            ratio = depth_ratio(prev, frame, flow, step.T_curr_prev)
            repeated = is_repeated(prev, frame)
        return {
            "index": step.index,
            "timestamp": step.timestamp,
            "status": step.status.state.value,
            "reason": step.status.reason.value,
            "probability": float(motion.probability),
            "message": message,
            "T_curr_prev": motion.T_curr_prev.ravel().tolist(),
            "T_world_cam": step.T_world_cam.ravel().tolist(),
            "covariance": motion.covariance.ravel().tolist(),
            "inlier_ratio": float(motion.inlier_ratio),
            "iterations": int(motion.iterations),
            "cost": float(motion.cost),
            "flow_ms": round(self.flow.ms, 3),
            "motion_ms": round(ms - self.flow.ms, 3),
            "frame_ms": round(ms, 3),
            "prev_index": None if prev is None else prev.index,
            "flow_source": None if field is None else field.source,
            "flow_is_true": flow is not None and field is not None and field.is_true,
            "errors": self._errors(prev, step),
            "depth_ratio": ratio,
            "repeated": repeated,
        }

    def _errors(self, prev: Frame | None, step: Step) -> dict[str, Any] | None:
        """Errors of a step against the ground truth, or None where there is none."""
        poses = self.sequence.poses
        if poses is None or prev is None or prev.depth is None:
            return None
        T_world_prev, T_world_curr = poses[prev.index], poses[step.index]
        if not (np.isfinite(T_world_prev).all() and np.isfinite(T_world_curr).all()):
            return None
        T_true = invert(T_world_curr) @ T_world_prev
        camera = self.sequence.camera(step.index)
        return pair_errors(step.T_curr_prev, T_true, prev.depth, prev.camera, camera)

    def _write(self, interrupted: bool) -> RunResult:
        """Results of the rows kept so far; all of them and the scores where the run is complete."""
        folder, path = self.folder, self.folder.path
        rows = list(folder.rows())
        if not rows:  # interrupted before the first frame
            folder.write_state("interrupted")
            return RunResult(EXIT_INTERRUPTED, {"state": "interrupted", "frames": 0}, None, None)
        poses = np.array([row["T_world_cam"] for row in rows]).reshape(-1, 4, 4)
        trajectory = Trajectory(np.array([row["timestamp"] for row in rows]), poses)
        gt = results.ground_truth(self.sequence, self.frames)
        trajectory.save(path / "trajectory.tum")
        trajectory.save(path / "trajectory.kitti")
        results.write_steps(path, rows)
        summary = results.summarise(rows, self.sequence, self.options.run.method)
        summary["out"] = os.fspath(path)
        if interrupted:
            folder.write_state("interrupted", summary=summary)
            return RunResult(EXIT_INTERRUPTED, summary | {"state": "interrupted"}, trajectory, gt)
        allowed = self.options.run.max_failed
        too_many = summary["failed_fraction"] > allowed
        if too_many:
            summary["warnings"].append(f"more motions failed than --max-failed {allowed:g} allows")
        metrics = None
        if gt is not None:
            metrics = results.score(rows, trajectory, gt, summary, self.options.run.alignment)
            write_json(path / "metrics.json", metrics)
        results.draw(path / "trajectory.png", trajectory, gt, summary)
        folder.finish(summary=summary)
        names = (*RESULTS, "run.json")
        summary["files"] = [os.fspath(path / name) for name in names if (path / name).exists()]
        summary |= {"state": "done", "metrics": metrics}
        return RunResult(EXIT_FAILED_FRAMES if too_many else EXIT_DONE, summary, trajectory, gt)


def _finished_before(folder: RunFolder) -> RunResult:
    """Result of a run that was complete when it was resumed."""
    summary = folder.state["summary"] | {"state": "done"}
    summary["metrics"] = folder.read_json("metrics.json")
    trajectory = read_trajectory(folder.path / "trajectory.tum", "tum")
    too_many = summary["failed_fraction"] > folder.state["options"]["run"]["max_failed"]
    return RunResult(EXIT_FAILED_FRAMES if too_many else EXIT_DONE, summary, trajectory, None)
