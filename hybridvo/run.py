"""One run: a sequence from disk in, trajectory, steps and scores out.

Truth is used for scoring alone; what the estimate took from an oracle (true flow, true depth) is
said in every output.
"""

from __future__ import annotations

import contextlib
import dataclasses
import logging
import os
import platform
import re
import time
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

import hybridvo
from hybridvo.configuration import RunOptions, option_tree
from hybridvo.console import Progress, interruptible
from hybridvo.data.sequence import Sequence, open_sequence
from hybridvo.depth_steps import depth_ratio
from hybridvo.errors import InputError
from hybridvo.evaluation.pair_errors import pair_errors
from hybridvo.evaluation.report import write_json
from hybridvo.files import fingerprint
from hybridvo.flow import FlowField, FlowProvider, dis_flow, fallback, file_flow
from hybridvo.geometry import invert
from hybridvo.odometry import Odometry
from hybridvo.pipeline import check_method, weights_hash
from hybridvo.recording import Recording, check_recording
from hybridvo.run_folder import PARTIAL, RESULTS, Mode, RunFolder
from hybridvo.run_results import (
    compact,
    draw,
    is_repeated,
    score,
    summarise,
    true_trajectory,
    write_steps,
)
from hybridvo.trajectory import Trajectory, write_kitti, write_tum
from hybridvo.types import Frame, Step

__all__ = [
    "EXIT_DONE",
    "EXIT_FAILED_FRAMES",
    "EXIT_INTERRUPTED",
    "RunResult",
    "check_device",
    "flow_provider",
    "run",
    "run_name",
    "versions",
]

EXIT_DONE, EXIT_FAILED_FRAMES, EXIT_INTERRUPTED = 0, 3, 130

RECORDING = "recording.rrd"
"""Name of a Rerun recording within the output folder."""

_logger = logging.getLogger(__name__)


@dataclass(frozen=True, eq=False)
class RunResult:
    """What a run leaves.

    Args:
        exit_code: 0, 3 (too many failed frames) or 130 (interrupted).
        summary: JSON-ready: state, counts, oracles, times, metrics, files.
        trajectory: the poses so far. truth: true poses, or None.
    """

    exit_code: int
    summary: dict[str, Any]
    trajectory: Trajectory
    truth: Trajectory | None


def run_name(sequence: Sequence) -> str:
    """Name of a sequence as one plain path part."""
    return re.sub(r"[^\w.-]+", "_", sequence.name).strip("._") or "sequence"


def run(
    path: str | os.PathLike[str],
    out: str | os.PathLike[str] | None,
    options: RunOptions,
    *,
    dataset: str | None = None,
    mode: Mode = "new",
    command: Iterable[str] = (),
    quiet: bool = False,
    rrd: str | os.PathLike[str] | None = None,
) -> RunResult:
    """Estimate, chain, write and score a sequence.

    Args:
        path: sequence folder.
        out: output folder, default ``runs/NAME``.
        options: see :class:`hybridvo.configuration.RunOptions`.
        dataset: kind of the sequence; detected by default.
        mode: ``new``, ``resume`` or ``overwrite``.
        command: for ``run.json``.
        quiet: no progress.
        rrd: file of a Rerun recording; empty for ``recording.rrd`` in the output folder.

    Raises:
        InputError: input or options that cannot be used, or a broken frame with ``strict``.
        LockedError: another run holds the folder. OutputError: a result cannot be written.
    """
    check_method(options.method)
    check_device(options.device)
    if rrd is not None:
        # one in the output folder is the folder's affair
        check_recording(rrd or RECORDING, replace=mode != "new" or not rrd)
    sequence = open_sequence(path, dataset)
    frames = range(options.start, min(options.stop or len(sequence), len(sequence)), options.stride)
    if not frames:
        raise InputError(
            f"{sequence.name}: no frames from {options.start} on: there are {len(sequence)}."
        )
    provider = flow_provider(sequence, options)
    out = Path("runs") / run_name(sequence) if out is None else Path(out)
    check_outside(out, sequence)
    identity = {
        "input_hash": fingerprint(sequence.files()),
        "options": _deciding(options),
        "weights": weights_hash(options.method),
        "hybridvo": hybridvo.__version__,
    }
    header = {
        "command": list(command),
        "versions": versions(),
        "machine": {"platform": platform.platform(), "cpus": os.cpu_count()},
        "options": dataclasses.asdict(options),
        "input_hash": identity["input_hash"],
        "sequence": {
            "name": sequence.name,
            "kind": sequence.kind,
            "path": os.fspath(path),
            "frames": len(frames),
            "depth_source": sequence.depth_source,
            "notices": list(sequence.warnings),
        },
    }
    with RunFolder(out, identity, header, mode, (*RESULTS, RECORDING)) as folder:
        if folder.finished:
            return _finished_before(folder, sequence)
        with contextlib.ExitStack() as stack:
            tape = None
            if rrd is not None:
                tape = Recording(
                    rrd or out / RECORDING,
                    sequence.name,
                    str(identity["input_hash"]),
                    len(frames),
                    first=folder.frames_done,
                    truth=None if sequence.poses is None else sequence.poses[frames],
                )
                stack.enter_context(tape)
            result = _run(sequence, frames, provider, options, folder, quiet, tape)
        if tape is not None and not tape.failed:
            result.summary["recording"] = os.fspath(tape.path)
        return result


def check_outside(out: Path, sequence: Sequence) -> None:
    """Refuse to write among the frames of the sequence: the next run would read what is drawn."""
    frames = (".png", ".jpg", ".jpeg", ".npy", ".dpt", ".flo")
    folders = {path.parent for path in sequence.files() if path.suffix.lower() in frames}
    if out.resolve() in {folder.resolve() for folder in folders}:
        raise InputError(
            f"{out}: holds frames of the sequence, and results among them would be taken for "
            f"input. Choose another --out."
        )


def _run(
    sequence: Sequence,
    frames: range,
    provider: _Recorder,
    options: RunOptions,
    folder: RunFolder,
    quiet: bool,
    tape: Recording | None,
) -> RunResult:
    label = f"{sequence.name} [{options.method}]"
    with interruptible() as interruption, Progress(len(frames), label, quiet=quiet) as progress:
        for notice in sequence.warnings:
            progress.say(f"note: {notice}")
        vo = Odometry(
            flow=provider,
            method=options.method,
            options=option_tree(options),
            seed=options.seed,
        )
        done = folder.frames_done
        failed = 0
        if folder.last is not None:
            failed = _resume(vo, folder, sequence, frames)
            progress.say(f"resumed after {done} of {len(frames)} frames")
        for index in frames[done:]:
            if interruption:
                break
            row = _track(vo, sequence, index, provider, options.strict, progress, tape)
            failed += row["status"] == "failed"
            folder.append(row | {"failed_so_far": failed})
            progress.update(folder.frames_done, failed)
        if interruption:
            progress.say(f"interrupted: {folder.frames_done} frames are kept; go on with --resume")
            return _write(sequence, frames, options, folder, interrupted=True)
        return _write(sequence, frames, options, folder, interrupted=False)


def _resume(vo: Odometry, folder: RunFolder, sequence: Sequence, frames: range) -> int:
    """Put the tracker where the last kept row left it; returns the failures up to there."""
    assert folder.last is not None
    try:
        for number, row in enumerate(folder.rows()):
            index = frames[number]
            if row["index"] != index or row["timestamp"] != sequence.timestamps[index]:
                raise ValueError(f"row {number + 1} is another frame's")
        for number in range(folder.frames_done):
            vo.track(sequence.frame(frames[number]))
        return int(folder.last["failed_so_far"])
    except (KeyError, TypeError, ValueError, IndexError, OSError) as error:
        raise InputError(
            f"{folder.path / PARTIAL}: row {folder.frames_done} cannot be used "
            f"({type(error).__name__}: {error}). Remove its last lines, or pass --overwrite."
        ) from error


def _track(
    vo: Odometry,
    sequence: Sequence,
    index: int,
    provider: _Recorder,
    strict: bool,
    progress: Progress,
    tape: Recording | None,
) -> dict[str, Any]:
    """Row of one frame."""
    stamp = float(sequence.timestamps[index])
    before = vo.state
    provider.field = None
    ratio: float | None = None
    repeated = False
    try:
        frame = sequence.frame(index)
    except (InputError, OSError) as error:
        if strict:
            raise InputError(f"frame {index}: {error}") from error
        progress.say(f"frame {index} cannot be read: {error}")
        step, ms = vo.skip(index, stamp, str(error)), 0.0
    else:
        started = time.perf_counter()
        step = vo.track(frame)
        ms = 1e3 * (time.perf_counter() - started)
        flow = None if provider.field is None else provider.field.flow
        repeated = step.usable and is_repeated(before.frame, frame)
        if before.frame is not None and step.usable:
            ratio = depth_ratio(before.frame, frame, flow, step.T_curr_prev)
        if tape is not None:
            tape.add(frame, step, flow)
    field = provider.field
    motion = step.motion
    row: dict[str, Any] = {
        "index": index,
        "timestamp": stamp,
        "status": step.status.state.value,
        "reason": step.status.reason.value,
        "message": step.status.message,
        "T_curr_prev": motion.T_curr_prev.ravel(),
        "T_world_cam": step.T_world_cam.ravel(),
        "covariance": motion.covariance.ravel(),
        "inlier_ratio": motion.inlier_ratio,
        "iterations": motion.iterations,
        "cost": motion.cost,
        "ms": round(ms, 3),
        "prev_index": None if before.frame is None else before.frame.index,
        "flow_source": None if field is None else field.source,
        "terms": "+".join(motion.terms),
        "polish": _polish_word(motion.photometric),
        "flow_is_true": field is not None and field.flow is not None and field.is_true,
        "errors": _errors(sequence, before.frame, step),
        "depth_ratio": ratio,
        "repeated": repeated,
        "window": "+".join(str(e.prev) for e in vo.edges if e.ok and e.kind != "chain"),
    }
    return row


def _polish_word(report: Any) -> str:
    """What became of the polish: empty where it was not asked for, ``taken``, or why not."""
    if report is None:
        return ""
    return report.reason or "taken"


def _errors(sequence: Sequence, prev: Frame | None, step: Step) -> dict[str, Any] | None:
    """Errors of a step against the truth, or None where there is none."""
    if sequence.poses is None or prev is None or prev.depth is None:
        return None
    T_world_prev, T_world_curr = sequence.poses[prev.index], sequence.poses[step.index]
    if not (np.isfinite(T_world_prev).all() and np.isfinite(T_world_curr).all()):
        return None
    T_true = invert(T_world_curr) @ T_world_prev
    camera = sequence.camera(step.index)
    return pair_errors(step.T_curr_prev, T_true, prev.depth, prev.camera, camera)


def _write(
    sequence: Sequence,
    frames: range,
    options: RunOptions,
    folder: RunFolder,
    *,
    interrupted: bool,
    warnings: Iterable[str] = (),
) -> RunResult:
    """Results of the rows kept so far; all of them and the scores where the run is complete."""
    rows = [compact(row) for row in folder.rows()]
    if not rows:  # interrupted before the first frame
        folder.write_state("interrupted")
        empty = Trajectory(np.zeros(1), np.eye(4)[None], has_timestamps=False)
        return RunResult(EXIT_INTERRUPTED, {"state": "interrupted", "frames": 0}, empty, None)
    poses = np.array([row["T_world_cam"] for row in rows]).reshape(-1, 4, 4)
    trajectory = Trajectory(np.array([row["timestamp"] for row in rows]), poses)
    truth = true_trajectory(sequence, frames)
    write_tum(trajectory, folder.path / "trajectory.tum")
    write_kitti(trajectory, folder.path / "trajectory.kitti")
    write_steps(folder.path, rows)
    summary = summarise(rows, sequence, options.method, len(frames) - 1) | {
        "out": os.fspath(folder.path)
    }
    if interrupted:
        folder.write_state("interrupted", summary=summary)
        return RunResult(EXIT_INTERRUPTED, summary | {"state": "interrupted"}, trajectory, truth)
    summary["warnings"] += warnings
    if len(rows) == 1:
        summary["warnings"].append("one frame: one pose at the identity, there is no motion to see")
    if truth is not None:
        metrics = score(rows, trajectory, truth, options.alignment, summary)
        write_json(folder.path / "metrics.json", metrics)
        summary["metrics"] = metrics
    draw(folder.path / "trajectory.png", trajectory, truth, summary)
    too_many = summary["failed_share"] > options.max_failed
    if too_many:
        summary["warnings"].append(
            f"{min(summary['failed'], len(rows) - 1)} of {len(rows) - 1} motions failed, more than "
            f"--max-failed {options.max_failed:g} allows"
        )
    folder.finish(summary={k: v for k, v in summary.items() if k != "metrics"})
    summary["files"] = [
        os.fspath(folder.path / name)
        for name in (*RESULTS, "run.json")
        if (folder.path / name).exists()
    ]
    exit_code = EXIT_FAILED_FRAMES if too_many else EXIT_DONE
    return RunResult(exit_code, summary | {"state": "done"}, trajectory, truth)


def _finished_before(folder: RunFolder, sequence: Sequence) -> RunResult:
    """Result of a run that was complete when it was resumed."""
    from hybridvo.trajectory import read_trajectory

    summary = folder.state.get("summary", {})
    metrics = folder.read_json("metrics.json")
    if metrics is not None:
        summary["metrics"] = metrics
    trajectory = read_trajectory(folder.path / "trajectory.tum", "tum")
    limit = folder.state["options"]["max_failed"]
    exit_code = EXIT_FAILED_FRAMES if summary.get("failed_share", 0) > limit else EXIT_DONE
    return RunResult(exit_code, summary | {"state": "done"}, trajectory, None)


class _Recorder:
    """A flow provider that remembers the last field, and survives flow files that are damaged."""

    def __init__(self, provider: FlowProvider) -> None:
        self._provider = provider
        self.field: FlowField | None = None

    def __call__(self, prev: Frame, curr: Frame) -> FlowField:
        field = self._provider(prev, curr)
        if self.field is None:  # a window may ask for more, from its key frames
            self.field = field
        return field


def _tolerant(provider: FlowProvider, strict: bool) -> FlowProvider:
    """No flow, with a line in the log, where a file is damaged."""

    def provide(prev: Frame, curr: Frame) -> FlowField:
        try:
            return provider(prev, curr)
        except (InputError, OSError) as error:
            if strict:
                raise InputError(f"flow of frame {prev.index}: {error}") from error
            _logger.warning("flow of frame %d: %s", prev.index, error)
            return FlowField(None, source="file")

    return provide


def flow_provider(sequence: Sequence, options: RunOptions) -> _Recorder:
    """Provider of the flow that ``options`` ask for; damaged files give no flow unless strict.

    Raises:
        InputError: flow files asked for where there are none, or with a stride above 1.
    """
    if options.flow == "file":
        if not sequence.has_flow:
            raise InputError(f"{sequence.name}: there are no flow files; pass --flow dis.")
        if options.stride > 1:
            raise InputError(
                f"{sequence.name}: flow files lead from one frame to the next, not over a stride "
                f"of {options.stride}; pass --flow dis."
            )
        return _Recorder(_tolerant(file_flow(sequence), options.strict))
    dis = dis_flow(options.dis.preset, options.dis.forward_backward)
    if options.flow == "auto" and sequence.has_flow and options.stride == 1:
        return _Recorder(fallback(_tolerant(file_flow(sequence), options.strict), dis))
    return _Recorder(dis)


def check_device(device: str) -> None:
    """Refuse a device that is not there.

    Raises:
        InputError: ``cuda`` on a machine, or with a build of torch, that has none.
    """
    if device == "cuda":
        import torch

        if not torch.cuda.is_available():
            raise InputError(
                "--device cuda: this machine, or this build of torch, has no CUDA device; "
                "use --device cpu."
            )


def _deciding(options: RunOptions) -> dict[str, Any]:
    """The options that decide the result: what a resumed run must share."""
    values = dataclasses.asdict(options)
    for name in ("max_failed", "strict", "device"):
        del values[name]
    return values


def versions() -> dict[str, str]:
    """Versions of Python and of the packages that decide numbers; absent ones are left out."""
    from importlib.metadata import PackageNotFoundError, version

    found = {"python": platform.python_version(), "hybridvo": hybridvo.__version__}
    for name in ("numpy", "scipy", "opencv-python-headless", "numba", "torch", "evo", "poselib"):
        try:
            found[name] = version(name)
        except PackageNotFoundError:
            continue
    return found
