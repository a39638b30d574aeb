"""A comparison from its options to its files: plan, segments, what is kept, results, report."""

from __future__ import annotations

import os
import platform
from collections.abc import Iterable, Mapping
from concurrent.futures import FIRST_COMPLETED, CancelledError, Future, wait
from concurrent.futures.process import BrokenProcessPool
from dataclasses import asdict, dataclass, field
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import hybridvo
from hybridvo.comparison.executors import Workers, open_workers
from hybridvo.comparison.job import Job, run_segment
from hybridvo.comparison.plan import chosen_methods, expand, unique_names, weights_of
from hybridvo.comparison.results import ROW_COLUMNS, Segments, collect
from hybridvo.comparison.scores import scale_notice
from hybridvo.configuration import RunOptions
from hybridvo.console import Interruption, Progress, interruptible
from hybridvo.data.sequence import Sequence, open_sequence
from hybridvo.errors import HybridVOError, InputError, OutputError
from hybridvo.evaluation.breakdown import breakdown, worst_pairs
from hybridvo.evaluation.protocols import Protocol, check_protocol, protocol_summary
from hybridvo.evaluation.report import write_csv, write_json
from hybridvo.evaluation.report_data import one_line
from hybridvo.files import fingerprint
from hybridvo.run import check_device, check_outside, flow_provider, versions
from hybridvo.run_folder import PARTIAL, Mode, RunFolder

__all__ = ["WRITTEN", "ComparisonOptions", "WorkerError", "compare"]

WRITTEN = ("results.json", "results.csv", "pairs.csv", "report.md", "report.html")
"""What a finished comparison leaves, beside run.json and :data:`FOLDERS`."""
FOLDERS = {"trajectories": "*.tum", "worst": "*.jpg", "figures": "*_[0-9]*"}
"""Folders inside of the output folder, and what a comparison writes there."""


class WorkerError(HybridVOError, RuntimeError):
    """A worker died; what was finished is kept."""


@dataclass(frozen=True)
class ComparisonOptions:
    """What to compare, and where to work.

    Args:
        sequences: folders; a folder of sequences stands for all of them. dataset: their kind, or
            None to detect it. methods: names, or ``("all",)``. flow: ``auto`` (every source that a
            sequence has, side by side), ``file`` or ``dis``. start, stop, stride: range of frames.
        seed: of everything drawn at random. protocol: of Sintel, or None. device: see RunOptions.
        jobs, scheduler: see :func:`hybridvo.comparison.executors.open_workers`.
        worst: pairs shown for each method and flow.

    Raises:
        InputError: ``jobs`` below 1 or ``worst`` below 0.
    """

    sequences: tuple[str, ...]
    dataset: str | None = None
    methods: tuple[str, ...] = ("all",)
    flow: str = "auto"
    start: int = 0
    stop: int | None = None
    stride: int = 1
    seed: int = 0
    protocol: str | None = None
    device: str = "auto"
    jobs: int = 1
    scheduler: str | None = None
    worst: int = 3

    def __post_init__(self) -> None:
        for name, least in (("jobs", 1), ("worst", 0)):
            if getattr(self, name) < least:
                raise InputError(f"--{name}: expected at least {least}, got {getattr(self, name)}.")


@dataclass
class _Plan:
    """Jobs with their open sequences."""

    jobs: list[Job]
    sequences: list[Sequence]
    methods: tuple[str, ...]
    missing: dict[str, str]
    protocol: Protocol | None
    left_aside: list[str] = field(default_factory=list)

    @property
    def each(self) -> Iterable[tuple[Job, Sequence]]:
        """Jobs beside their sequences."""
        return zip(self.jobs, self.sequences, strict=True)


def compare(
    options: ComparisonOptions,
    out: str | os.PathLike[str],
    *,
    mode: Mode = "new",
    command: Iterable[str] = (),
    quiet: bool = False,
) -> list[Path] | None:
    """Run every method on every sequence and write the results.

    Args:
        options: what and where.
        out: output folder.
        mode: ``new``, ``resume`` or ``overwrite``.
        command: for the provenance.
        quiet: no progress.

    Returns:
        Paths of :data:`WRITTEN`; None where the user interrupted: what was done is kept.

    Raises:
        InputError: options, sequences or methods that cannot be used.
        LockedError: another run holds the folder. OutputError: a result cannot be written.
        WorkerError: a worker died.
    """
    from hybridvo.evaluation.report_page import write_report

    out = Path(out)
    present = [name for name in WRITTEN if os.path.lexists(out / name)]
    if present and mode == "new":
        raise InputError(
            f"{out}: holds {', '.join(present)}; pass --overwrite to replace them, or another "
            f"--out."
        )
    _check_folders(out, mode)
    plan = _plan(options)
    for sequence in plan.sequences:
        check_outside(out, sequence)
    settings = asdict(options)
    weights = weights_of(plan.methods)
    identity = {
        "sequences": [[job.name, job.input_hash] for job in plan.jobs],
        "methods": list(plan.methods),
        "options": {
            key: settings[key] for key in ("flow", "start", "stop", "stride", "seed", "protocol")
        },
        "weights": weights,
        "hybridvo": hybridvo.__version__,
    }
    header = {
        "command": list(command),
        "versions": versions(),
        "machine": {"platform": platform.platform(), "cpus": os.cpu_count()},
        "options": settings,
        "weights": weights,
        "timing": _timing(options),
        "started": _now(),
    }
    with (
        interruptible() as interruption,
        # before the folder is taken: an address that is wrong leaves nothing behind
        open_workers(_jobs(options, plan), options.scheduler) as workers,
        RunFolder(out, identity, header, mode, WRITTEN) as folder,
    ):
        if folder.finished:
            absent = [name for name in WRITTEN if not (out / name).is_file()]
            if absent and not any(name.endswith((".json", ".csv")) for name in absent):
                write_report(out)  # made of the others
            elif absent:
                raise InputError(
                    f"{out}: this comparison is done, but {', '.join(absent)} is missing. Pass "
                    f"--overwrite to start anew."
                )
            return [out / name for name in WRITTEN]
        if mode == "overwrite":
            _clear_folders(out)
        total = sum(job.pairs for job in plan.jobs)
        count = len(plan.jobs)
        label = f"{count} sequence{'s' * (count > 1)}, {len(plan.methods)} methods"
        segments = Segments(out / PARTIAL, plan.jobs)
        before = sum(segments.done.values())
        with Progress(total, label, quiet=quiet, unit="pairs", before=before) as progress:
            for name, reason in plan.missing.items():
                progress.say(f"not run: {name}: {reason}")
            notices = [
                f"{job.name}: {one_line(notice.removeprefix(f'{sequence.name}: '))}"
                for job, sequence in plan.each
                for notice in sequence.warnings
            ]
            for line in (*plan.left_aside, *notices):
                progress.say(f"note: {line}")
            _work(plan.jobs, segments, folder, workers, interruption, progress)
            if interruption:
                done = sum(segments.done.values())
                progress.say(f"interrupted: {done} of {total} pairs are kept; go on with --resume")
                folder.write_state("interrupted")
                return None
            progress.say("all pairs are done: scores and report")
            for line in _write(out, plan, options, header, segments):
                progress.say(f"warning: {line}")
        folder.finish()
    return [out / name for name in WRITTEN]


def _jobs(options: ComparisonOptions, plan: _Plan) -> int:
    """Processes that have something to do."""
    return options.jobs if options.scheduler is not None else min(options.jobs, len(plan.jobs))


def _check_folders(out: Path, mode: Mode) -> None:
    """Refuse folders inside of ``out`` that lead elsewhere, or that hold what others wrote.

    Raises:
        InputError: a link or a file under the name of a folder, or files in one for a new run.
    """
    for name in FOLDERS:
        path = out / name
        if os.path.islink(path) or (os.path.exists(path) and not os.path.isdir(path)):
            what = "a link" if os.path.islink(path) else "a file"
            raise InputError(f"{path}: {what}, where results go. Move it, or choose another --out.")
        if mode == "new" and os.path.isdir(path) and any(path.iterdir()):
            raise InputError(
                f"{path}: holds files already. Move them away, or choose another --out."
            )


def _clear_folders(out: Path) -> None:
    """Remove what an earlier comparison left: a report shows every figure that it finds."""
    for name, pattern in FOLDERS.items():
        for path in (out / name).glob(pattern):
            if path.is_file() or path.is_symlink():
                try:
                    path.unlink()
                except OSError as error:
                    why = error.strerror or error
                    raise OutputError(f"{path}: cannot be removed: {why}.") from error


def _refuse_twins(paths: list[Path], opened: list[Sequence]) -> None:
    """Refuse a sequence that is given twice under two names: it would count double."""
    seen: dict[Path, Path] = {}
    for path, sequence in zip(paths, opened, strict=True):
        suffixes = (".png", ".jpg", ".jpeg", ".npy", ".dpt")
        first = next((f for f in sequence.files() if f.suffix.lower() in suffixes), path)
        other = seen.setdefault(first.resolve(), path)
        if other is not path:
            raise InputError(f"--sequence {path}: the same frames as {other}; give them once.")


def _plan(options: ComparisonOptions) -> _Plan:
    """Open every sequence once, before the first hour is spent."""
    check_device(options.device)
    wanted = {name: getattr(options, name) for name in ("flow", "start", "stop", "stride", "seed")}
    RunOptions(**wanted)
    methods, missing = chosen_methods(options.methods)
    paths = [path for given in options.sequences for path in expand(given, options.dataset)]
    opened = [open_sequence(path, options.dataset) for path in paths]
    protocol, left_aside = None, []
    if options.protocol is not None:
        if options.stride != 1 or options.start or options.stop is not None:
            raise InputError(
                f"--protocol {options.protocol} is defined on whole sequences: leave out --start, "
                f"--stop and --stride."
            )
        protocol = check_protocol(options.protocol, [(s.name, s.kind) for s in opened])
        inside = [s.name in protocol.sequences for s in opened]
        left_aside = [
            f"{s.name} is no part of the protocol {protocol.name}"
            for s, wanted in zip(opened, inside, strict=True)
            if not wanted
        ]
        paths = [path for path, wanted in zip(paths, inside, strict=True) if wanted]
        opened = [s for s, wanted in zip(opened, inside, strict=True) if wanted]
        if not opened:
            raise InputError(
                f"--protocol {protocol.name}: none of the sequences belongs to it; it has "
                f"{', '.join(protocol.sequences)}."
            )
    names = unique_names(paths, [s.name for s in opened])
    _refuse_twins(paths, opened)
    jobs = []
    for path, sequence, name in zip(paths, opened, names, strict=True):
        stop = len(sequence) if options.stop is None else min(options.stop, len(sequence))
        frames = len(range(options.start, stop, options.stride))
        if frames < 1:
            raise InputError(
                f"{name}: no frames from {options.start} on: there are {len(sequence)}."
            )
        jobs.append(
            Job(
                str(path),
                options.dataset,
                name,
                fingerprint(sequence.files()),
                _flows(sequence, options),
                methods,
                frames,
                options.start,
                options.stride,
                options.seed,
                protocol is not None and protocol.same_camera_only,
            )
        )
    return _Plan(jobs, opened, methods, missing, protocol, left_aside)


def _flows(sequence: Sequence, options: ComparisonOptions) -> tuple[str, ...]:
    """Sources of flow: both side by side where the sequence has both.

    Raises:
        InputError: flow files asked for where there are none, or with a stride.
    """
    if options.flow != "auto":
        flow_provider(sequence, RunOptions(flow=options.flow, stride=options.stride))
        return (options.flow,)
    files = ("file",) if sequence.has_flow and options.stride == 1 else ()
    try:
        images = not files or sequence.frame(options.start).rgb is not None
    except (InputError, OSError):  # a broken frame tells nothing of the others
        images = True
    return (*files, "dis") if images else files


def _work(
    jobs: list[Job],
    segments: Segments,
    folder: RunFolder,
    workers: Workers,
    interruption: Interruption,
    progress: Progress,
) -> None:
    """Work through all jobs: segments of one job after another, jobs beside each other."""
    waiting = [n for n, job in enumerate(jobs) if segments.done.get(n, 0) < job.pairs]
    # the longest first, so that none is left alone at the end
    waiting.sort(key=lambda n: segments.done.get(n, 0) - jobs[n].pairs)
    running: dict[Future[Any], int] = {}
    if segments.done:
        progress.say(f"resumed after {sum(segments.done.values())} pairs")
    while waiting or running:
        while waiting and len(running) < workers.slots() and not interruption:
            n = waiting.pop(0)
            future = workers.executor.submit(
                run_segment, jobs[n], segments.done.get(n, 0), segments.T_last.get(n)
            )
            running[future] = n
        if not running:
            return
        finished, _ = wait(running, return_when=FIRST_COMPLETED)
        for future in finished:
            n = running.pop(future)
            segment = _outcome(future)
            place = _size(folder.path / PARTIAL)
            folder.append({"job": n, **segment})
            segments.took({"job": n, **segment}, place)
            for row in segment["left_out"]:
                if "intrinsics" not in row["reason"]:
                    progress.say(f"left out: {jobs[n].name}: frame {row['index']}: {row['reason']}")
            progress.update(sum(segments.done.values()), segments.failed)
            if segments.done[n] < jobs[n].pairs and not interruption:
                waiting.insert(0, n)  # goes on where its sequence is open


def _size(path: Path) -> int:
    try:
        return path.stat().st_size
    except OSError as error:  # the user, or another program, has removed the folder
        raise OutputError(f"{path}: is gone: {error.strerror or error}.") from error


def _outcome(future: Future[Any]) -> dict[str, Any]:
    try:
        segment: dict[str, Any] = future.result()
    except (BrokenProcessPool, CancelledError) as error:
        raise WorkerError(
            f"a worker died ({error or type(error).__name__}), perhaps for want of memory. What "
            f"was finished is kept: go on with --resume and fewer --jobs."
        ) from error
    except InputError as error:  # it was there when the comparison began
        raise InputError(
            f"{error} What was finished is kept: once the sequences are as they were, go on with "
            f"--resume."
        ) from error
    except Exception as error:
        if type(error).__name__ == "KilledWorker":  # of Dask, which may be absent
            raise WorkerError(
                f"a worker of the cluster died again and again: {error}. What was finished is "
                f"kept: go on with --resume."
            ) from error
        raise
    return segment


def _changes(job: Job) -> list[str]:
    """Notice of input that is no longer what it was when the comparison began."""
    try:
        same = fingerprint(open_sequence(job.path, job.dataset).files()) == job.input_hash
    except (InputError, OSError):
        same = False
    told = "its files changed while the comparison ran; these figures may mix both. Run it again."
    return [] if same else [told]


def _now() -> str:
    return datetime.now(UTC).isoformat(timespec="seconds")


def _timing(options: ComparisonOptions) -> str:
    """What the times of the results mean."""
    if options.scheduler is not None:
        return "one estimate at a time on each worker of a cluster: times are those of its machines"
    if options.jobs > 1:
        return f"up to {options.jobs} estimates at the same time: times are upper bounds"
    return "one estimate at a time"


def _write(
    out: Path,
    plan: _Plan,
    options: ComparisonOptions,
    header: Mapping[str, Any],
    segments: Segments,
) -> list[str]:
    """Every file of the comparison, from the kept segments; what the user must know of them."""
    from hybridvo.comparison.pictures import picture_worst
    from hybridvo.evaluation.report_page import write_report

    found = collect(out, plan.jobs, plan.sequences, segments)
    warnings = []
    for job, entry in zip(plan.jobs, found.sequences, strict=True):
        mine = [row for row in found.rows if row["sequence"] == job.name]
        told = [*_changes(job), *scale_notice(mine)]
        entry["notices"] += told
        warnings += [f"{job.name}: {line}" for line in told]
    worst = picture_worst(
        out, worst_pairs(found.table, options.worst), plan.jobs, plan.sequences, segments
    )
    result: dict[str, Any] = {
        **header,
        "finished": _now(),
        "missing": plan.missing,
        "rows": found.rows,
        "totals": found.totals,
        "sequences": found.sequences,
        "trajectories": found.trajectories,
        "breakdown": breakdown(found.table, seed=options.seed),
        "worst_pairs": worst,
        "protocol": None
        if plan.protocol is None
        else protocol_summary(plan.protocol, found.totals, found.sequences),
    }
    write_json(out / "results.json", result)
    write_csv(out / "results.csv", found.rows, ROW_COLUMNS)
    write_report(out)
    return warnings
