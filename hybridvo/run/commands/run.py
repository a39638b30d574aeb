"""``hybridvo run``: a sequence goes in; trajectory, steps and scores come out."""

from __future__ import annotations

import contextlib
import dataclasses
import math
import re
import time
from collections import Counter
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from statistics import median
from typing import Any

import numpy as np
from rich.console import Console
from rich.markup import escape
from rich.progress import Progress

from hybridvo.core import laboratory
from hybridvo.core.errors import InputError, OutputError, printable
from hybridvo.core.files import (
    Mode,
    atomic_write,
    check_name,
    fingerprint,
    locked_folder,
    provenance,
    write_json,
)
from hybridvo.core.geometry import invert
from hybridvo.core.options import NETWORK, Options, RunOptions
from hybridvo.core.results import Edge, RelativePose, Step, stated_sigmas
from hybridvo.core.stages import stage, stage_summary, stage_times
from hybridvo.core.trajectory import Trajectory
from hybridvo.core.types import Frame
from hybridvo.flow.providers import FlowProvider, MeasuredFlow, dis_flow, file_flow
from hybridvo.io.data.sequence import Sequence
from hybridvo.io.data.truth import true_trajectory
from hybridvo.io.onnx.flow import FlowNetwork
from hybridvo.io.viewer.address import parse_address
from hybridvo.io.viewer.recording import RecordingWriter, check_recording
from hybridvo.io.viewer.scene import Seen, Sink, position_covariance
from hybridvo.io.viewer.viewer import Viewer
from hybridvo.network.models import Models
from hybridvo.odometry import Odometry
from hybridvo.pipeline import check_method
from hybridvo.run.commands.advice import advice_on, likely_causes
from hybridvo.run.commands.diagnosis.causes import depth_delay, likely_cause
from hybridvo.run.commands.export.run_export import (
    RunExport,
    check_kinds,
    clear_export,
)
from hybridvo.run.commands.frame_reading import FramesAhead, samples_before, skipped
from hybridvo.run.commands.object_rows import (
    OBJECTS,
    motion_columns,
    object_rows,
    write_objects,
)
from hybridvo.run.commands.passes import InTimeSequence, times_after_passes
from hybridvo.run.commands.run_folder import (
    PICTURE,
    RECORDING,
    RESULTS,
    STATE,
    RunFolder,
    weights_hash,
)
from hybridvo.run.commands.run_hints import hint_of_run, next_command
from hybridvo.run.commands.stopping import stop_requested
from hybridvo.run.commands.stored_state import restored, saved
from hybridvo.run.commands.terminal import STYLES
from hybridvo.run.commands.text import text_of
from hybridvo.tracking.chains import PathCovariance
from hybridvo.tracking.depth_scale import (
    common_scales,
    in_one_scale,
    scale_factors,
)
from hybridvo.tracking.passes import PixelTimes, TimesFinder

Row = dict[str, Any]
"""What is kept of a step, JSON-ready: the columns of ``steps.csv`` and more."""
ARRAYS = (
    "index",
    "timestamp",
    "status",
    "probability",
    "T_curr_prev",
    "covariance",
    "edge_start",
    "T_curr_start",
    "edge_covariance",
    "depth_scale",
    "scale_change",
)
"""The columns of the steps that ``steps.npz`` holds."""
RUN_FIELDS = (
    "method",
    "degraded",
    "flow_source",
    "depth_source",
    "oracle",
    "sequence",
)
"""Fields of the summary that ``metrics.json`` repeats."""
NOT_SCORED = (
    f"no errors and no picture: they need hybridvo-lab: {laboratory.REMEDY}"
)
SHOWN_DOUBTS = 20
"""Motions with one reason not to be ok that are shown while a run goes on."""
DOUBT = ("failed", "degraded", "ok")
"""The states of a motion, the least sure one first."""
TIMES = ("flow_ms", "motion_ms", "frame_ms")
"""The columns of the steps that hold times, milliseconds."""


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
    view: str | None = None,
    picture: bool = True,
    export: tuple[str, ...] = (),
) -> tuple[dict[str, Any], int]:
    """Track a sequence, write the results and score them.

    Args:
        sequence: The sequence.
        out: The output folder; by default ``runs/NAME``.
        options: The options.
        models: The networks; by default the pretrained ones.
        mode: What happens to results that are there already.
        command: The words of the command line, which are kept with the results.
        quiet: Whether no progress is shown.
        rrd: The file of a Rerun recording; empty stands for ``recording.rrd`` in the folder.
        view: ``spawn`` shows the run in a viewer while it goes on, ``connect:HOST:PORT`` in one
            that runs already, ``serve`` in a browser.
        picture: Whether the trajectory is drawn.
        export: Which of ``colmap``, ``transforms``, ``euroc``, ``g2o`` is written into ``export``.

    Returns:
        A summary, JSON-ready, and the exit code: 3 where too many motions failed.

    Raises:
        InputError: The options do not suit the sequence, or the folder holds other results.
        LockedError: Another run holds the folder.
        OutputError: A result cannot be written.
    """
    options = _with_method(options, check_method(options.run.method))
    check_kinds(export)
    models = models or Models(options.run.device)
    frames = frames_of(sequence, options)
    provider, _ = flow_provider(sequence, options)
    flow = MeasuredFlow(provider)
    out = _output_folder(sequence, out)
    recording_path = None
    if rrd is not None:
        recording_path = Path(rrd or out / RECORDING)
        check_recording(recording_path)
    if view is not None:
        parse_address(view)

    def make_tracker() -> Odometry:
        """A tracker that has seen nothing."""
        return Odometry(
            models,
            flow=flow,
            method=options.run.method,
            options=options,
            seed=options.run.seed,
        )

    tracker = make_tracker()
    # Both take long, and must not happen while the folder is locked.
    tracker.warm_up()
    scores = _scores_of_runs()
    header = _header(sequence, options, models, command)
    with locked_folder(out), contextlib.ExitStack() as stack:
        folder = RunFolder(out, header, mode)
        stack.callback(folder.close)
        exporter = RunExport(out, export, sequence, mode) if export else None
        if mode == "overwrite":
            clear_export(out)
        summary = folder.summary
        if summary is not None:
            with folder.stored_is_whole():
                _check_summary(summary)
        else:
            times = PixelTimes()
            if options.run.passes > 1:
                earlier = options.run.passes - 1
                with _interruption_is_kept(folder):
                    times = times_after_passes(
                        sequence, frames, make_tracker, earlier, quiet
                    )
                sequence = InTimeSequence(sequence, times)
            job = _Run(
                sequence,
                frames,
                tracker,
                flow,
                folder,
                TimesFinder(times),
                export=exporter,
                scores=scores,
            )
            truth = None
            if recording_path is not None or view is not None:
                truth = _path_from_origin(sequence, frames)
            if recording_path is not None:
                count = len(frames)
                recording = RecordingWriter(
                    recording_path, sequence.name, count, truth
                )
                stack.callback(recording.close)
                job.sinks.append(recording)
            if view is not None:
                viewer = Viewer(view, sequence.name, truth)
                stack.callback(viewer.close)
                job.sinks.append(viewer)
            summary = job.estimate_and_write(quiet, picture)
            summary["warnings_shown"] = job.warnings_shown
            if recording_path is not None:
                summary["recording"] = str(recording_path)
            if view is not None:
                summary["page"] = viewer.served()
        if exporter is not None:
            summary["export"] = exporter.finish()
    too_many_failed = summary["failed_fraction"] > options.run.max_failed
    return summary, 3 if too_many_failed else 0


def _check_summary(summary: dict[str, Any]) -> None:
    """Raise an exception of any kind where nobody could print a summary that a folder holds."""
    float(summary["failed_fraction"])
    has_frame = summary["least_sure"] is not None
    text_of("run", summary | {"next": "a command" if has_frame else ""})


def _with_method(options: Options, method: str) -> Options:
    """Return the options with another method."""
    run_options = dataclasses.replace(options.run, method=method)
    return dataclasses.replace(options, run=run_options)


def _output_folder(sequence: Sequence, out: str | Path | None) -> Path:
    """Return the output folder; an InputError if it holds frames of the sequence."""
    if out is None:
        name = re.sub(r"[^\w.-]+", "_", sequence.name).strip("._")
        out = Path("runs") / (name or "sequence")
    out = Path(out)
    check_name(out)
    image_folders = {
        path.parent.resolve() for path in sequence.rgb_files if path is not None
    }
    if out.resolve() in image_folders:
        raise InputError(
            f"{out}: holds frames of the sequence; choose another --out."
        )
    return out


def _path_from_origin(sequence: Sequence, frames: range) -> np.ndarray | None:
    """Return the true positions (N, 3), metres, that begin at the origin; None: not known."""
    truth = true_trajectory(sequence, frames)
    if truth is None:
        return None
    positions: np.ndarray = truth.transformed(
        invert(truth.T_world_cam[0])
    ).positions
    return positions


def _header(
    sequence: Sequence, options: Options, models: Models, command: Iterable[str]
) -> dict[str, Any]:
    """Return what ``run.json`` states of the inputs of a run."""
    return {
        "command": list(command),
        "input_hash": fingerprint(sequence.files()),
        **provenance(),
        "weights": weights_hash(options.run.method, models),
        "options": dataclasses.asdict(options),
        "sequence": str(sequence.root),
        "opened_with": sequence.opened_with(),
    }


@contextlib.contextmanager
def _interruption_is_kept(folder: RunFolder) -> Iterator[None]:
    """Let ``run.json`` state that a run was interrupted, where a part of it raises."""
    try:
        yield
    except BaseException:
        # A full disk is reported by the error that it caused first.
        with contextlib.suppress(OutputError):
            folder.save("interrupted")
        raise


# -- one run -----------------------------------------------------------------------------


def _scores_of_runs() -> Any:
    """What scores and draws a run: a module of hybridvo-lab; None where that is not installed."""
    return laboratory.find(laboratory.FUNCTIONS, "scores_of_runs")


@dataclass
class _Run:
    """A sequence, its tracker, and the folder of the results."""

    sequence: Sequence
    frames: range
    tracker: Odometry
    flow: MeasuredFlow
    folder: RunFolder
    # what the pass shows of the times of the pixels
    finder: TimesFinder = field(default_factory=TimesFinder)
    sinks: list[Sink] = field(default_factory=list)
    export: RunExport | None = None
    warnings_shown: int = 0
    # of hybridvo-lab: errors and the picture; None where it is not installed
    scores: Any = None

    def __post_init__(self) -> None:
        self.ahead = FramesAhead(self.sequence, self.frames)

    def estimate_and_write(self, quiet: bool, picture: bool) -> dict[str, Any]:
        """Track the frames and write the results; returns their summary, JSON-ready."""
        with _interruption_is_kept(self.folder), self.folder.stored_is_whole():
            self.estimate(quiet)
            summary = self.write_results(picture)
        self.folder.save("done", summary=summary)
        return summary

    def estimate(self, quiet: bool) -> None:
        """Track the frames of which the folder has no rows yet, and show the progress."""
        rows = self.folder.rows
        total = len(self.frames)
        failed = sum(row["status"] == "failed" for row in rows)
        console = Console(
            stderr=True, quiet=quiet, soft_wrap=True, markup=False, highlight=False
        )
        name = printable(self.sequence.name)
        # In rich's markup, square brackets are tags.
        label = escape(f"{name} [{self.tracker.method}]")

        def say(text: str, style: str = "") -> None:
            console.print(printable(text), style=style)

        with Progress(console=console) as bar, stop_requested() as stop:
            task = bar.add_task(label, total=total, completed=len(rows))
            for warning in self.sequence.warnings:
                say(f"warning: {warning}")
            self.warnings_shown = len(self.sequence.warnings)
            if self.folder.tracker is not None:
                state, things = restored(self.folder.tracker, self.sequence)
                self.tracker.resume(state, things)
                say(f"resumed after {len(rows)} of {total} frames")
            doubts = _Doubts()
            for index in self.frames[len(rows) :]:
                with stage_times() as times:
                    row = self._track(index)
                row["stages"] = times.rounded()
                known = (self.tracker.state, self.tracker.things)
                self.folder.add(row, saved(known))
                if text := doubts.line(row):
                    say(text, STYLES[row["status"]])
                failed += row["status"] == "failed"
                progress = f"{len(rows)}/{total} frames, {failed} failed"
                bar.update(
                    task, completed=len(rows), description=f"{label} {progress}"
                )
                place = f"which are in {self.folder.path}"
                stop.raise_if_requested(
                    done=f"{len(rows)} of {total} frames, {place}"
                )

    def _track(self, index: int) -> dict[str, Any]:
        """Track a frame; returns its row, JSON-ready: the columns of ``steps.csv`` and more."""
        tracker = self.tracker
        starts = tracker.state.starts
        frame_ms = 0.0
        cause = ""
        self.flow.reset()
        try:
            with stage("reading"):
                frame = self.ahead.frame(index)
                following = self.ahead.after(frame)
        except (InputError, OSError) as error:
            step = skipped(self.sequence, index, tracker, error)
        else:
            started = time.perf_counter()
            samples = samples_before(self.sequence, frame, tracker)
            step = tracker.track(frame, imu=samples, following=following)
            frame_ms = 1e3 * (time.perf_counter() - started)
            self.finder.add(frame, step)
            prev = _start_of(step, starts)
            delay_s = depth_delay(self.sequence, index)
            cause = likely_cause(step, prev, frame, delay_s)
            # the first frame is only kept
            rate = None if prev is None else 1e3 / frame_ms
            seen = Seen(frame, step, prev, self.flow.last.flow, rate)
            for sink in self.sinks:
                sink.add(seen)
            if self.export is not None:
                self.export.add(frame, step, prev)
        row = self._row(step, _start_of(step, starts), frame_ms)
        return row | {"likely_cause": cause}

    def _row(
        self, step: Step, prev: Frame | None, frame_ms: float
    ) -> dict[str, Any]:
        """Return the row of a step.

        Args:
            step: What the tracker returned.
            prev: The frame from which its motion starts.
            frame_ms: How long it took, milliseconds.
        """
        motion = step.motion
        field = self.flow.last
        errors = {}
        if self.scores is not None:
            errors = self.scores.errors_of_step(self.sequence, prev, step)
        # the first frame is joined to itself
        edge = step.edge or Edge(step.index, motion.T_curr_prev, motion.covariance)
        return {
            "index": step.index,
            "timestamp": step.timestamp,
            "status": step.status.state.value,
            "reason": step.status.reason.value,
            "probability": float(motion.probability),
            **motion_columns(motion.T_curr_prev),
            "inlier_ratio": float(motion.inlier_ratio),
            "iterations": int(motion.iterations),
            "cost": float(motion.cost),
            "flow_ms": round(self.flow.ms, 3),
            "motion_ms": round(frame_ms - self.flow.ms, 3),
            "frame_ms": round(frame_ms, 3),
            "depth_scale": float(step.depth_scale),
            "scale_change": float(step.scale_change),
            "prev_index": step.prev_index,
            "flow_source": field.source,
            "message": _one_line(step.status.message),
            "T_curr_prev": motion.T_curr_prev.tolist(),
            "T_world_cam": step.T_world_cam.tolist(),
            "covariance": motion.covariance.tolist(),
            "edge_start": edge.start,
            "T_curr_start": edge.T_curr_start.tolist(),
            "edge_covariance": edge.covariance.tolist(),
            "objects": object_rows(step),
            "flow_is_true": field.flow is not None and field.is_true,
            **{name: value for name, value in errors.items() if name != "nees"},
            **stated_sigmas(step.covariance),
            "nees": errors.get("nees"),
        }

    def write_results(self, picture: bool) -> dict[str, Any]:
        """Write what a finished run leaves beside its steps; returns its summary, JSON-ready."""
        folder = self.folder.path
        options = self.tracker.options.run
        rows = self.folder.rows
        trajectory = self._write_trajectory()
        summary = _summarise(rows, self.sequence, options)
        if self.tracker.options.track.objects != "off":
            write_objects(
                folder / OBJECTS, [each for row in rows for each in row["objects"]]
            )
        summary["passes"] = options.passes
        if "frame" in self.sequence.chosen:
            summary["frame"] = self.sequence.chosen["frame"]
        times = self.finder.found()
        if times.readout is not None and times.readout_is_known:
            summary["readout_ms"] = times.readout_ms
            summary["readout_std_ms"] = times.readout.std
        gravity = self.tracker.state.gravity
        if gravity is not None:
            summary["gravity"] = gravity.summary()
        truth = true_trajectory(self.sequence, self.frames)
        metrics = None
        if self.scores is None:
            summary["warnings"].append(NOT_SCORED)
        elif truth is not None:
            metrics = self.scores.errors_of_run(
                trajectory, truth, rows, options.alignment
            )
            metrics |= {key: summary[key] for key in RUN_FIELDS}
            write_json(folder / "metrics.json", metrics)
        if picture and self.scores is not None:
            self.scores.draw(
                options.method,
                trajectory,
                folder / PICTURE,
                truth=truth,
                title=_title(summary),
                states=[row["status"] for row in rows],
                covariances=_position_covariances(rows),
            )
        hint = hint_of_run(
            self.sequence,
            self.folder.rows,
            summary.get("readout_ms", 0.0),
            options.passes,
        )
        if hint is not None:
            words = self.folder.header["command"]
            summary["likely"] = {
                "cause": hint.cause,
                "command": next_command(words, self.sequence, hint, folder),
            }
        existing = [
            folder / name for name in (*RESULTS, STATE) if (folder / name).exists()
        ]
        return summary | {
            "state": "done",
            "out": str(folder),
            "files": [str(path) for path in existing],
            "metrics": metrics,
        }

    def _write_trajectory(self) -> Trajectory:
        """Write the path and the motions of a run; returns the path of the camera."""
        folder = self.folder.path
        rows = self.folder.rows
        columns: dict[str, Any] = {name: _column(rows, name) for name in ARRAYS}
        poses = _column(rows, "T_world_cam")
        row_of = {row["index"]: i for i, row in enumerate(rows)}
        poses = in_one_scale(
            poses,
            columns["T_curr_prev"],
            [row_of.get(row["prev_index"]) for row in rows],
            scale_factors(
                _column(rows, "depth_scale"), _column(rows, "scale_change")
            ),
        )
        trajectory = Trajectory(columns["timestamp"], poses)
        written = trajectory
        if self.sequence.T_cam_frame is not None:
            written = trajectory.of_frame(self.sequence.T_cam_frame)
        written.save(folder / "trajectory.tum")
        written.save(folder / "trajectory.kitti")
        with atomic_write(folder / "steps.npz", "wb") as file:
            np.savez(file, **columns)
        return trajectory


def _column(rows: list[Row], name: str) -> np.ndarray:
    """Return what stands under a name in every row."""
    return np.array([row[name] for row in rows])


def _position_covariances(rows: list[Row]) -> np.ndarray:
    """Return the covariance of every position since the first one, (N, 3, 3) m^2.

    Each motion adds its own to that of the frame from which it was measured. NaN where a motion
    failed, until a later one spans it.
    """
    path = PathCovariance()
    found = []
    for row in rows:
        motion = RelativePose(
            np.array(row["T_curr_prev"]), np.array(row["covariance"])
        )
        T_world_cam = np.array(row["T_world_cam"])
        edge = Edge(
            row["edge_start"],
            np.array(row["T_curr_start"]),
            np.array(row["edge_covariance"]),
        )
        step = Step(
            row["index"],
            row["timestamp"],
            T_world_cam,
            motion,
            row["prev_index"],
            measured=edge,
        )
        covariance = position_covariance(path.follow(step), T_world_cam)
        if covariance is None or row["status"] == "failed":
            covariance = np.full((3, 3), np.nan)
        found.append(covariance)
    return np.stack(found)


def _start_of(step: Step, starts: dict[int, Frame]) -> Frame | None:
    """Return the frame from which the motion of a step starts; None of the first step."""
    if step.prev_index is None:
        return None
    return starts[step.prev_index]


class _Doubts:
    """Which motions that are not ok are shown: the first ones with each reason."""

    def __init__(self) -> None:
        self._counts: Counter[tuple[str, str]] = Counter()

    def line(self, row: dict[str, Any]) -> str:
        """Return what is shown of a frame; empty where that is nothing."""
        if row["status"] == "ok":
            return ""
        kind = (row["status"], row["reason"])
        self._counts[kind] += 1
        if self._counts[kind] <= SHOWN_DOUBTS:
            return _warning(row)
        if self._counts[kind] == SHOWN_DOUBTS + 1:
            status, reason = kind
            return f"more motions are {status} ({reason}): steps.csv names each"
        return ""


def _warning(row: dict[str, Any]) -> str:
    """State that a motion is not ok, and why."""
    status = f"{row['status']} ({row['reason']})"
    probability = f"probability {row['probability']:.2f}"
    text = f"frame {row['index']}: {status}, {probability}: {row['message']}"
    cause = row["likely_cause"]
    return f"{text} (likely: {cause.replace('_', ' ')})" if cause else text


def _one_line(message: str) -> str:
    """Return a message for a table: without line ends, and without bytes that are no text."""
    return " ".join(message.split()).encode("utf-8", "backslashreplace").decode()


# -- the summary of a run ----------------------------------------------------------------


def _title(summary: dict[str, Any]) -> str:
    """Return the title of the picture of a run."""
    flow = ", ".join(summary["flow_source"]) or "not used"
    title = f"{summary['sequence']}, flow: {flow}"
    if summary["oracle"]:
        title += f" (oracle: {', '.join(summary['oracle'])})"
    return title


def _summarise(
    steps: list[Row], sequence: Sequence, options: RunOptions
) -> dict[str, Any]:
    """Return the counts, sources, oracles, times and warnings of a run."""
    motions = steps[1:]  # the first frame has none
    states = Counter(row["status"] for row in motions)
    failed = states["failed"]
    failed_fraction = failed / max(len(motions), 1)
    tracked = [row for row in motions if row["reason"] != "missing_frame"]
    medians = {
        f"{name}_median": median(row[name] for row in tracked) if tracked else None
        for name in TIMES
    }
    outcomes = [(row["status"], row["reason"]) for row in motions]
    causes = [row["likely_cause"] for row in motions]
    warnings = [*sequence.warnings, *_messages_of_ok(motions)]
    if not motions:
        warnings.append("one frame: no motion")
    if failed_fraction > options.max_failed:
        warnings.append(
            f"more motions failed than --max-failed {options.max_failed:g} allows"
        )
    return {
        "sequence": sequence.name,
        "method": options.method,
        "frames": len(steps),
        "motions": len(motions),
        "failed": failed,
        "failed_fraction": failed_fraction,
        "degraded": states["degraded"],
        "least_sure": _least_sure(tracked),
        "doubts": [*advice_on(outcomes), *likely_causes(causes)],
        "flow_source": sorted({row["flow_source"] for row in steps} - {""}),
        "depth_source": sequence.depth_source,
        "oracle": _oracles(steps, sequence),
        "depth_scale": _depth_scale(steps),
        **medians,
        "stages": stage_summary(row["stages"] for row in tracked),
        "warnings": warnings,
    }


def _least_sure(motions: list[Row]) -> dict[str, Any] | None:
    """Return the frame of the least sure motion and its status; None where there is no motion."""
    if not motions:
        return None
    worst = min(motions, key=lambda row: (DOUBT.index(row["status"]), _chance(row)))
    return {
        "frame": worst["index"],
        "status": worst["status"],
        "reason": worst["reason"],
        "probability": _chance(worst),
    }


def _chance(row: Row) -> float:
    """Return the probability of a motion; 0 where it is not known."""
    probability: float = row["probability"]
    return 0.0 if math.isnan(probability) else probability


def _depth_scale(steps: list[Row]) -> dict[str, float] | None:
    """Return how the scale of depth varied from frame to frame; None where it was not measured."""
    scales = _column(steps, "depth_scale")
    changes = _column(steps, "scale_change")
    if np.all(scales == 1) and np.all(changes == 1):
        return None
    common = common_scales(scales, changes)
    at_its_time = np.concatenate([[0.0], np.cumsum(np.log(changes))[:-1]])
    # of each frame against the mean of those around it
    logs = np.log(scales) + at_its_time - common
    return {
        "log_std": float(np.std(logs)),
        "first_frame": float(np.exp(-common[0])),
        "drift_per_frame": float(
            (common[-1] - common[0]) / max(len(common) - 1, 1)
        ),
    }


def _messages_of_ok(motions: list[Row]) -> list[str]:
    """Return the first message of a motion that is ok all the same."""
    noted = [row for row in motions if row["status"] == "ok" and row["message"]]
    return [f"frame {row['index']}: {row['message']}" for row in noted[:1]]


def _oracles(steps: list[Row], sequence: Sequence) -> list[str]:
    """Name the inputs of a run that no sensor can give."""
    oracles = []
    if any(row["flow_is_true"] for row in steps):
        oracles.append("true flow")
    if sequence.depth_source == "true":
        oracles.append("true depth")
    return oracles


# -- what the options select -------------------------------------------------------------


def frames_of(sequence: Sequence, options: Options, at_least: int = 1) -> range:
    """Return the indices of the frames that the options select.

    Raises:
        InputError: They are fewer than ``at_least``.
    """
    run_options = options.run
    stop = min(run_options.stop or len(sequence), len(sequence))
    frames = range(run_options.start, stop, run_options.stride)
    if len(frames) < at_least:
        selection = (
            f"from {run_options.start} to {stop}, {run_options.stride} apart"
        )
        problem = "only one frame" if frames else "no frames"
        raise InputError(
            f"{sequence.name}: {problem} {selection}: there are {len(sequence)}."
        )
    return frames


def flow_provider(sequence: Sequence, options: Options) -> tuple[FlowProvider, str]:
    """Return the provider of the flow that the options select, and its name.

    The name is ``dis``, ``onnx FILE``, ``file``, or ``file (true)`` of an oracle.

    Raises:
        InputError: The options select flow files, and there are none that fit.
    """
    source = options.flow.source
    stride = options.run.stride
    if source.startswith(NETWORK):
        network = FlowNetwork(source)
        return network, network.source
    dis = dis_flow(options.flow.dis_preset)
    has_files = sequence.has_flow and stride == 1
    if source == "dis" or (source == "auto" and not has_files):
        return dis, "dis"
    if options.run.passes > 1:
        raise InputError(
            "run.passes: expected 1 where flow comes from files, which leads between the rows as "
            f"they were exposed; got {options.run.passes}. Pass --flow dis to compute it."
        )
    sequence.check_flow(stride)
    # DIS stands in where a file is missing or damaged.
    otherwise = dis if source == "auto" else None
    files = file_flow(sequence, strict=options.run.strict, otherwise=otherwise)
    return files, "file (true)" if sequence.flow_is_true else "file"
