"""``hybridvo run``: a sequence goes in; trajectory, steps and scores come out."""

from __future__ import annotations

import contextlib
import dataclasses
import re
import time
from collections.abc import Iterable
from dataclasses import dataclass
from hashlib import sha256
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from rich.console import Console
from rich.markup import escape
from rich.progress import Progress

from hybridvo.commands.doubts import doubts_in_words
from hybridvo.commands.recording import Recording, check_recording
from hybridvo.commands.run_folder import RECORDING, RESULTS, STATE, RunFolder
from hybridvo.commands.stopping import stop_requested
from hybridvo.data.sequence import Sequence
from hybridvo.errors import InputError, OutputError, printable
from hybridvo.evaluation.metrics import evaluate
from hybridvo.evaluation.scores import (
    pair_scores,
    pair_table,
    step_errors,
    true_trajectory,
)
from hybridvo.files import (
    Mode,
    atomic_write,
    check_name,
    fingerprint,
    locked_folder,
    provenance,
    write_json,
)
from hybridvo.flow import FlowProvider, MeasuredFlow, dis_flow, file_flow
from hybridvo.geometry import se3_log
from hybridvo.keyframes import Keyframe
from hybridvo.network.models import Models
from hybridvo.odometry import MotionModel, Odometry, TrackerState
from hybridvo.options import Options, RunOptions
from hybridvo.pipeline import NETWORKS, check_method
from hybridvo.trajectory import Trajectory
from hybridvo.types import Frame
from hybridvo.visualization.trajectory import plot_trajectory

ARRAYS = (
    "index",
    "timestamp",
    "status",
    "probability",
    "T_curr_prev",
    "covariance",
)
"""The columns of the steps that ``steps.npz`` holds."""
STATES = {kind.__name__: kind for kind in (TrackerState, MotionModel, Keyframe)}
"""The classes of which a tracker's state is made, beside frames and arrays."""


def run(
    sequence: Sequence,
    out: str | Path | None,
    options: Options,
    *,
    models: Models | None = None,
    mode: Mode = "new",
    command: Iterable[str] = (),
    quiet: bool = False,
    rrd: str | Path | None = None,
    picture: bool = True,
) -> tuple[dict[str, Any], int]:
    """Track a sequence, write and score the result; returns a summary, JSON-ready, and exit code.

    ``out`` is by default ``runs/NAME``; an empty ``rrd`` stands for ``recording.rrd`` in it.
    """
    method = check_method(options.run.method)
    options = dataclasses.replace(
        options, run=dataclasses.replace(options.run, method=method)
    )
    models = models or Models(options.run.device)
    frames = frames_of(sequence, options)
    flow = MeasuredFlow(flow_provider(sequence, options)[0])
    name = re.sub(r"[^\w.-]+", "_", sequence.name).strip("._") or "sequence"
    out = Path("runs") / name if out is None else Path(out)
    check_name(out)
    if rrd is not None:
        check_recording(rrd or out / RECORDING)
    if out.resolve() in {
        path.parent.resolve() for path in sequence.rgb_files if path is not None
    }:
        raise InputError(
            f"{out}: holds frames of the sequence; choose another --out."
        )
    vo = Odometry(
        models, flow=flow, method=method, options=options, seed=options.run.seed
    )
    vo.warm_up()  # before the folder is taken: it may last
    header = {
        "command": list(command),
        "input_hash": fingerprint(sequence.files()),
        **provenance(),
        "weights": weights_hash(method, models),
        "options": dataclasses.asdict(options),
        "sequence": str(sequence.root),
        "opened_with": sequence.opened_with(),
    }
    with locked_folder(out), contextlib.ExitStack() as stack:
        folder = RunFolder(out, header, mode)
        stack.callback(folder.close)
        summary = folder.summary
        if summary is None:
            this = _Run(sequence, frames, vo, flow, folder)
            if rrd is not None:
                this.recording = Recording(rrd or out / RECORDING, sequence, frames)
                stack.callback(this.recording.close)
            summary = this.estimate_and_write(quiet, picture)
            if this.recording is not None:
                summary["recording"] = str(this.recording.path)
    too_many = summary["failed_fraction"] > options.run.max_failed
    return summary, 3 if too_many else 0


def saved(value: Any) -> Any:
    """Return a tracker's state, or a part of it, for JSON; a frame, which is on disk, by index."""
    if isinstance(value, Frame):
        return {"frame": value.index}
    if isinstance(value, np.ndarray):
        return {"array": value.tolist(), "dtype": str(value.dtype)}
    if isinstance(value, list | tuple):
        return [saved(part) for part in value]
    if type(value).__name__ in STATES:
        fields = {name: saved(part) for name, part in vars(value).items()}
        return {"state": type(value).__name__, **fields}
    return value


def restored(value: Any, sequence: Sequence) -> Any:
    """Return what :func:`saved` was given, by way of JSON; lists and tuples come as tuples."""
    if isinstance(value, list):
        return tuple(restored(part, sequence) for part in value)
    if not isinstance(value, dict):
        return value
    if "frame" in value and "state" not in value:
        return sequence.frame(value["frame"])
    if "array" in value:
        return np.array(value["array"], dtype=value["dtype"])
    fields = {
        name: restored(part, sequence)
        for name, part in value.items()
        if name != "state"
    }
    return STATES[value["state"]](**fields)


@dataclass
class _Run:
    """A sequence, its tracker, and the folder of the results."""

    sequence: Sequence
    frames: range
    vo: Odometry
    flow: MeasuredFlow
    folder: RunFolder
    recording: Recording | None = None

    def estimate_and_write(self, quiet: bool, picture: bool) -> dict[str, Any]:
        """Track the frames, and write the results; returns their summary, JSON-ready."""
        try:
            self.estimate(quiet)
            summary = self.write_results(picture)
        except BaseException:
            # a full disk is reported by what it stopped
            with contextlib.suppress(OutputError):
                self.folder.save("interrupted")
            raise
        self.folder.save("done", summary=summary)
        return summary

    def estimate(self, quiet: bool) -> None:
        """Track the frames of which the folder has no rows yet."""
        vo = self.vo
        rows = self.folder.rows
        tracker = self.folder.tracker
        failed = sum(row["status"] == "failed" for row in rows)
        console = Console(
            stderr=True, quiet=quiet, soft_wrap=True, markup=False, highlight=False
        )
        name = printable(self.sequence.name, keep="")
        label = escape(f"{name} [{vo.method}]")  # square brackets are markup
        total = len(self.frames)

        def say(text: str) -> None:
            console.print(printable(text))

        with Progress(console=console) as bar, stop_requested() as stop:
            task = bar.add_task(label, total=total, completed=len(rows))
            for warning in self.sequence.warnings:
                say(f"warning: {warning}")
            if tracker is not None:
                vo.resume(restored(tracker, self.sequence))
                say(f"resumed after {len(rows)} of {total} frames")
            for index in self.frames[len(rows) :]:
                row = self._track(index)
                self.folder.add(row, saved(vo.state))
                if row["status"] != "ok":
                    text = f"frame {index}: {row['status']} ({row['reason']}), probability "
                    say(f"{text}{row['probability']:.2f}: {row['message']}")
                failed += row["status"] == "failed"
                so_far = f"{label} {len(rows)}/{total} frames, {failed} failed"
                bar.update(task, completed=len(rows), description=so_far)
                stop.obey(
                    done=f"{len(rows)} of {total} frames, which are in {self.folder.path}"
                )

    def _track(self, index: int) -> dict[str, Any]:
        """Track a frame; returns its row, JSON-ready: the columns of ``steps.csv`` and more."""
        vo = self.vo
        flow = self.flow
        sequence = self.sequence
        prev = vo.state.frame
        ms = 0.0
        flow.reset()
        try:
            frame = sequence.frame(index)
        except (InputError, OSError) as error:
            if vo.options.run.strict:
                raise InputError(f"frame {index}: {error}") from error
            step = vo.skip(index, float(sequence.timestamps[index]), str(error))
        else:
            started = time.perf_counter()
            step = vo.track(frame)
            ms = 1e3 * (time.perf_counter() - started)
            if self.recording is not None:
                self.recording.add(frame, step, flow.last.flow)
        field = flow.last
        motion = step.motion
        values = [
            *motion.T_curr_prev[:3, 3].tolist(),
            *se3_log(motion.T_curr_prev)[3:].tolist(),
        ]
        return {
            "index": step.index,
            "timestamp": step.timestamp,
            "status": step.status.state.value,
            "reason": step.status.reason.value,
            "probability": float(motion.probability),
            **dict(zip("tx ty tz rx ry rz".split(), values, strict=True)),
            "inlier_ratio": float(motion.inlier_ratio),
            "iterations": int(motion.iterations),
            "cost": float(motion.cost),
            "flow_ms": round(flow.ms, 3),
            "motion_ms": round(ms - flow.ms, 3),
            "frame_ms": round(ms, 3),
            "prev_index": step.prev_index,
            "flow_source": field.source,
            "message": _one_line(step.status.message),
            "T_curr_prev": motion.T_curr_prev.tolist(),
            "T_world_cam": step.T_world_cam.tolist(),
            "covariance": motion.covariance.tolist(),
            "flow_is_true": field.flow is not None and field.is_true,
            **step_errors(sequence, prev, step.index, step.T_curr_prev),
        }

    def write_results(self, picture: bool) -> dict[str, Any]:
        """Write what a finished run leaves beside its steps; returns its summary, JSON-ready."""
        folder = self.folder.path
        options = self.vo.options.run
        table = pd.DataFrame(self.folder.rows)
        gt = true_trajectory(self.sequence, self.frames)
        columns: dict[str, Any] = {
            name: np.array(table[name].tolist()) for name in ARRAYS
        }
        trajectory = Trajectory(
            columns["timestamp"], np.array(table["T_world_cam"].tolist())
        )
        trajectory.save(folder / "trajectory.tum")
        trajectory.save(folder / "trajectory.kitti")
        with atomic_write(folder / "steps.npz", "wb") as file:
            np.savez(file, **columns)
        summary = _summarise(table, self.sequence, options)
        metrics = None
        if gt is not None:
            metrics = evaluate(trajectory, gt, alignment=options.alignment)
            pairs = pair_scores(
                pair_table(table[1:].rename(columns={"motion_ms": "ms"}))
            )
            reasons = metrics["reasons"] | pairs["reasons"]
            named = (
                "method",
                "degraded",
                "flow_source",
                "depth_source",
                "oracle",
                "sequence",
            )
            metrics |= (
                pairs | {key: summary[key] for key in named} | {"reasons": reasons}
            )
            write_json(folder / "metrics.json", metrics)
        if picture:
            title = f"{self.sequence.name}, flow: {', '.join(summary['flow_source']) or 'none'}"
            title += (
                f" (oracle: {', '.join(summary['oracle'])})"
                if summary["oracle"]
                else ""
            )
            path = folder / "trajectory.png"
            known = {"truth": gt, "title": title, "states": columns["status"]}
            plot_trajectory(options.method, trajectory, path, **known)
        files = [
            str(folder / name)
            for name in (*RESULTS, STATE)
            if (folder / name).exists()
        ]
        made = {
            "state": "done",
            "out": str(folder),
            "files": files,
            "metrics": metrics,
        }
        return summary | made


def _one_line(message: str) -> str:
    """A message for a table: without line ends, and without bytes that are no text."""
    return " ".join(message.split()).encode("utf-8", "backslashreplace").decode()


def _summarise(
    table: pd.DataFrame, sequence: Sequence, options: RunOptions
) -> dict[str, Any]:
    """The counts, sources, oracles, times and warnings of a run."""
    motions = table[1:]  # the first frame has none
    failed, degraded = (
        int((motions["status"] == x).sum()) for x in ("failed", "degraded")
    )
    failed_fraction = failed / max(len(motions), 1)
    times = motions[motions["reason"] != "missing_frame"][
        ["flow_ms", "motion_ms", "frame_ms"]
    ]
    doubts = motions[(motions["status"] == "ok") & (motions["message"] != "")][:1]
    warnings = list(sequence.warnings)
    warnings += [
        f"frame {row['index']}: {row['message']}"
        for row in doubts.to_dict("records")
    ]
    if motions.empty:
        warnings.append("one frame: no motion")
    if failed_fraction > options.max_failed:
        warnings.append(
            f"more motions failed than --max-failed {options.max_failed:g} allows"
        )
    # what the estimate was given that no sensor gives
    oracle = ["true flow"] if table["flow_is_true"].any() else []
    oracle += ["true depth"] if sequence.depth_source == "true" else []
    return {
        "sequence": sequence.name,
        "method": options.method,
        "frames": len(table),
        "motions": len(motions),
        "failed": failed,
        "failed_fraction": failed_fraction,
        "degraded": degraded,
        "doubts": doubts_in_words(
            motions[["status", "reason"]].itertuples(index=False)
        ),
        "flow_source": sorted(set(table["flow_source"]) - {""}),
        "depth_source": sequence.depth_source,
        "oracle": oracle,
        **{
            f"{k}_median": float(x.median()) if len(x) else None
            for k, x in times.items()
        },
        "warnings": warnings,
    }


def weights_hash(method: str, models: Models) -> str | None:
    """Return the SHA-256 of the weights that a method uses; None without a network."""
    files = [models.path(name) for name in NETWORKS.get(method, ())]
    return (
        sha256(b"".join(path.read_bytes() for path in files)).hexdigest()
        if files
        else None
    )


def frames_of(sequence: Sequence, options: Options, at_least: int = 1) -> range:
    """Return the indices of the frames that the options ask for."""
    stop = min(options.run.stop or len(sequence), len(sequence))
    frames = range(options.run.start, stop, options.run.stride)
    if len(frames) < at_least:
        asked = f"from {options.run.start} to {stop}, {options.run.stride} apart"
        found = "only one frame" if frames else "no frames"
        raise InputError(
            f"{sequence.name}: {found} {asked}: there are {len(sequence)}."
        )
    return frames


def flow_provider(sequence: Sequence, options: Options) -> tuple[FlowProvider, str]:
    """Return the provider of the flow that the options ask for, and its name, also of an oracle."""
    source = options.flow.source
    stride = options.run.stride
    dis = dis_flow(options.flow.dis_preset)
    if source == "dis" or (
        source == "auto" and not (sequence.has_flow and stride == 1)
    ):
        return dis, "dis"
    sequence.check_flow(stride)
    # where a file is missing or damaged DIS can stand in
    otherwise = dis if source == "auto" else None
    files = file_flow(sequence, strict=options.run.strict, otherwise=otherwise)
    return files, "file (true)" if sequence.flow_is_true else "file"
