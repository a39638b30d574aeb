"""Methods beside each other on sequences: same frames, same flow, same clock, scored against truth.

Every method runs as :class:`hybridvo.odometry.Odometry`, exactly as in ``hybridvo run``: for the
same frames and the same flow both give the same motions. One sequence is the unit of work and of
resume: what it gave is one file in ``parts/`` until the comparison is done.
"""

from __future__ import annotations

import contextlib
import hashlib
import json
import multiprocessing
import os
import platform
import shutil
from collections.abc import Callable, Iterable, Iterator, Mapping
from concurrent.futures import Executor, ProcessPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from dataclasses import asdict
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, Literal

import filelock
import numpy as np
import pandas as pd

import hybridvo
from hybridvo.data.sequence import Sequence, open_sequence
from hybridvo.errors import HybridVOError, InputError, LockedError
from hybridvo.evaluation.protocols import Protocol, check_protocol, protocol_summary
from hybridvo.evaluation.scores import ROW_COLUMNS, breakdown, total_row
from hybridvo.evaluation.sequence_job import (
    PAIR_COLUMNS,
    ComparisonOptions,
    Job,
    pair_table,
    run_sequence,
)
from hybridvo.evaluation.sources import expand, methods_to_run
from hybridvo.evaluation.worst import draw_worst, worst_pairs
from hybridvo.files import write_csv, write_json
from hybridvo.network.models import Models
from hybridvo.pipeline import weights_hash
from hybridvo.trajectory import Trajectory

WRITTEN = ("results.json", "results.csv", "pairs.csv", "report.md", "report.html")
"""What a finished comparison leaves, beside ``trajectories/`` and ``worst/``."""
Mode = Literal["new", "resume", "overwrite"]
ReportProgress = Callable[[str, int, int], None]
"""Called with a message (or the empty string), pairs done and pairs in all."""


def compare(
    options: ComparisonOptions,
    out: str | os.PathLike[str],
    *,
    mode: Mode = "new",
    command: Iterable[str] = (),
    progress: ReportProgress | None = None,
) -> list[Path]:
    """Run every method on every sequence and write the results.

    Args:
        options: what and where.
        out: output folder.
        mode: ``new`` refuses a folder with results, ``resume`` keeps finished sequences,
            ``overwrite`` starts anew.
        command: for ``results.json``.
        progress: told of every pair (of every sequence, where several run at a time).

    Returns:
        Paths of :data:`WRITTEN`.

    Raises:
        InputError: options, sequences or methods that cannot be used. LockedError: another run
            holds the folder. OutputError: a result cannot be written. HybridVOError: a worker died.
        KeyboardInterrupt: finished sequences are kept for ``resume``.
    """
    from hybridvo.evaluation.report import write_report

    out, report = Path(out), progress or (lambda message, done, total: None)
    started = _now()
    methods, missing = methods_to_run(options.methods, Models(options.device, options.weights))
    jobs, protocol = _plan(options, methods)
    with _folder(out, mode):
        total = sum(max(0, job.frames - 1) for job in jobs)
        for name, reason in missing.items():
            report(f"not run: {name}: {reason}", 0, total)
        parts = _work(jobs, out / "parts", report, total)
        report("scores and report", total, total)
        pairs = _write_pairs(out, parts)
        rows = [row for part in parts for row in part["rows"]]
        totals = [
            total_row(group, [r for r in rows if (r["method"], r["flow_source"]) == key])
            for key, group in pairs.groupby(["method", "flow_source"], sort=False)
        ]
        for part in parts:
            for warning in part["sequence"]["warnings"]:
                report(f"{part['sequence']['name']}: {warning}", total, total)
        counts = {p["sequence"]["name"]: p["sequence"]["pairs_scored"] for p in parts}
        result = {
            "command": list(command),
            "versions": _versions(),
            "machine": {"platform": platform.platform(), "cpus": os.cpu_count()},
            "options": asdict(options),
            "weights": _weights(methods, options),
            "timing": _timing(options),
            "started": started,
            "finished": _now(),
            "missing": missing,
            "rows": rows,
            "totals": totals,
            "sequences": [part["sequence"] for part in parts],
            "trajectories": _write_trajectories(out, parts),
            "breakdown": breakdown(pairs),
            "worst_pairs": _draw_worst(out, worst_pairs(pairs, options.worst), jobs, parts),
            "protocol": protocol and protocol_summary(protocol, totals, counts),
        }
        write_json(out / "results.json", result)
        write_csv(out / "results.csv", ROW_COLUMNS, rows)
        write_report(out)
        shutil.rmtree(out / "parts", ignore_errors=True)
    return [out / name for name in WRITTEN]


@contextlib.contextmanager
def _folder(out: Path, mode: Mode) -> Iterator[None]:
    """Hold the output folder; refuse or remove what is in it."""
    present = [name for name in (*WRITTEN, "parts") if (out / name).exists()]
    if present and mode == "new":
        raise InputError(
            f"{out}: holds {', '.join(present)}; pass --resume to go on, --overwrite to replace "
            f"them, or another --out."
        )
    out.mkdir(parents=True, exist_ok=True)
    try:
        with filelock.FileLock(out / ".lock", timeout=0):
            if mode == "overwrite":
                for name in ("parts", "trajectories", "worst"):
                    shutil.rmtree(out / name, ignore_errors=True)
            yield
    except filelock.Timeout:
        raise LockedError(f"{out}: another run holds this folder.") from None


def _plan(
    options: ComparisonOptions, methods: tuple[str, ...]
) -> tuple[list[Job], Protocol | None]:
    """Open every sequence once, before the first hour is spent."""
    paths = [path for given in options.sequences for path in expand(given, options.dataset)]
    opened = [open_sequence(path, options.dataset) for path in paths]
    protocol = None
    if options.protocol is not None:
        if options.stride != 1 or options.start or options.stop is not None:
            raise InputError(
                f"--protocol {options.protocol} is defined on whole sequences: leave out --start, "
                f"--stop and --stride."
            )
        protocol = check_protocol(options.protocol, opened)
        inside = [sequence.name in protocol.sequences for sequence in opened]
        if not any(inside):
            known = ", ".join(protocol.sequences)
            raise InputError(f"--protocol {protocol.name}: expected some of {known}, got none.")
        paths = [path for path, wanted in zip(paths, inside, strict=True) if wanted]
        opened = [sequence for sequence, wanted in zip(opened, inside, strict=True) if wanted]
    names = [sequence.name for sequence in opened]
    names = [
        f"{path.absolute().parent.name}/{name}" if names.count(name) > 1 else name
        for path, name in zip(paths, names, strict=True)
    ]
    jobs = []
    for path, sequence, name in zip(paths, opened, names, strict=True):
        if names.count(name) > 1:
            raise InputError(f"--sequence: two sequences are called {name}; give each once.")
        frames = len(range(*slice(options.start, options.stop).indices(len(sequence))))
        frames = -(-frames // options.stride)
        if frames < 1:
            raise InputError(f"{name}: no frames from {options.start} on: it has {len(sequence)}.")
        jobs.append(
            Job(
                path=str(path),
                name=name,
                flows=_flows(sequence, options),
                methods=methods,
                frames=frames,
                same_camera_only=protocol is not None and protocol.same_camera_only,
                fingerprint=_fingerprint(sequence, methods, options),
                options=options,
            )
        )
    return jobs, protocol


def _flows(sequence: Sequence, options: ComparisonOptions) -> tuple[str, ...]:
    """Sources of flow: both side by side where the sequence has both."""
    usable = sequence.has_flow and options.stride == 1
    if options.flow == "file" and not usable:
        why = "a stride above 1" if sequence.has_flow else "no flow files"
        raise InputError(f"{sequence.name}: --flow file, but there are {why}; pass --flow dis.")
    if options.flow != "auto":
        return (options.flow,)
    try:
        images = sequence.frame(options.start).rgb is not None
    except (InputError, OSError):  # a broken frame tells nothing of the others
        images = True
    return (*(("dis",) if images or not usable else ()), *(("file",) if usable else ()))


def _weights(methods: Iterable[str], options: ComparisonOptions) -> dict[str, str | None]:
    """Method -> SHA-256 over all weights that it uses; None without a network."""
    models = Models(options.device, options.weights)
    return {name: weights_hash(name, models) for name in methods}


def _fingerprint(sequence: Sequence, methods: Iterable[str], options: ComparisonOptions) -> str:
    """What decides the rows of a sequence: a resumed comparison takes no others."""
    files = []
    for path in sequence.files():
        with contextlib.suppress(OSError):
            stat = path.stat()
            files.append((path.name, stat.st_size, stat.st_mtime_ns))
    deciding = ("flow", "start", "stop", "stride", "seed", "protocol", "device")
    chosen = {name: getattr(options, name) for name in deciding}
    weights = _weights(methods, options)
    content = json.dumps([files, chosen, weights, hybridvo.__version__], sort_keys=True)
    return hashlib.sha256(content.encode()).hexdigest()


# -- work -----------------------------------------------------------------------------------------


def _work(
    jobs: list[Job], folder: Path, report: ReportProgress, total: int
) -> list[dict[str, Any]]:
    """What every job gave, in order; kept from an earlier try where that is finished."""
    folder.mkdir(exist_ok=True)
    paths = {job.name: folder / f"{number:03d}.json" for number, job in enumerate(jobs)}
    for job in jobs:
        path = paths[job.name]
        if path.exists() and json.loads(path.read_text())["fingerprint"] != job.fingerprint:
            raise InputError(
                f"{path}: was made of other frames, options, methods or weights; pass --overwrite, "
                f"or another --out."
            )
    todo = [job for job in jobs if not paths[job.name].exists()]
    done = total - sum(max(0, job.frames - 1) for job in todo)
    if done:
        report(
            f"resumed: {len(jobs) - len(todo)} of {len(jobs)} sequences are finished", done, total
        )
    options = jobs[0].options
    if options.scheduler is None and min(options.jobs, len(todo)) <= 1:
        for job in todo:

            def report_pairs(pairs: int, before: int = done) -> None:
                report("", before + pairs, total)

            write_json(paths[job.name], run_sequence(job, report_pairs))
            done += max(0, job.frames - 1)
    else:
        with _executor(options) as executor:
            futures = {executor.submit(run_sequence, job): job for job in todo}
            for future in as_completed(futures):
                job = futures[future]
                try:
                    write_json(paths[job.name], future.result())
                except BrokenProcessPool as error:
                    raise HybridVOError(
                        "a worker died, perhaps for want of memory. Finished sequences are kept: "
                        "go on with --resume and fewer --jobs."
                    ) from error
                done += max(0, job.frames - 1)
                report(f"{job.name} is finished", done, total)
    return [json.loads(paths[job.name].read_text(encoding="utf-8")) for job in jobs]


@contextlib.contextmanager
def _executor(options: ComparisonOptions) -> Iterator[Executor]:
    """Processes of this machine, or the workers of a Dask cluster."""
    if options.scheduler is None:
        # a fork would copy the threads' locks of numba and OpenCV in whatever state they are
        context = multiprocessing.get_context("spawn")
        threads = max(1, (os.cpu_count() or 1) // options.jobs)
        with ProcessPoolExecutor(options.jobs, context, _start_worker, (threads,)) as executor:
            yield executor
        return
    try:
        from distributed import Client
    except ImportError:
        raise InputError("--scheduler: pip install 'hybridvo[cluster]' for Dask.") from None
    try:
        client = Client(options.scheduler, timeout=30, set_as_default=False)
    except (OSError, ValueError, TypeError) as error:
        raise InputError(
            f"--scheduler {options.scheduler}: no Dask scheduler answers ({error}); expected an "
            f"address such as tcp://host:8786."
        ) from None
    with client:
        yield client.get_executor(pure=False)


def _start_worker(threads: int) -> None:
    """A worker's share of the cores."""
    import cv2
    import numba

    cv2.setNumThreads(threads)
    numba.set_num_threads(min(threads, numba.get_num_threads()))


# -- files ----------------------------------------------------------------------------------------


def _write_pairs(out: Path, parts: Iterable[Mapping[str, Any]]) -> pd.DataFrame:
    pairs = [row for part in parts for row in part["pairs"]]
    write_csv(out / "pairs.csv", PAIR_COLUMNS, pairs)
    return pair_table(pairs)


def _write_trajectories(out: Path, parts: Iterable[Mapping[str, Any]]) -> list[dict[str, Any]]:
    """TUM files of every path, and what they are."""
    (out / "trajectories").mkdir(exist_ok=True)
    found = []
    for number, part in enumerate(parts):
        for key, poses in part["trajectories"].items():
            if poses is None:
                continue
            true = key == "ground_truth"
            method, _, flow = (key, "", "") if true else key.partition("|")
            stamps = part["timestamps"]["ground_truth" if true else "estimate"]
            kind = f"_{flow.split()[0]}" if flow else ""
            path = f"trajectories/{number:03d}_{_plain(part)}_{method}{kind}.tum"
            Trajectory(np.array(stamps), np.array(poses)).save(out / path)
            found.append(
                {
                    "sequence": part["sequence"]["name"],
                    "method": None if true else method,
                    "flow_source": flow or None,
                    "path": path,
                }
            )
    return found


def _plain(part: Mapping[str, Any]) -> str:
    """Name of a sequence as part of a file's name."""
    return "".join(c if c.isalnum() or c in "-_." else "_" for c in part["sequence"]["name"])[:60]


def _draw_worst(
    out: Path,
    worst: list[dict[str, Any]],
    jobs: Iterable[Job],
    parts: Iterable[Mapping[str, Any]],
) -> list[dict[str, Any]]:
    """``worst_pairs`` with ``picture`` (path of a JPEG) or ``picture_reason``."""
    (out / "worst").mkdir(exist_ok=True)
    for number, (job, part) in enumerate(zip(jobs, parts, strict=True)):
        mine = [entry for entry in worst if entry["sequence"] == job.name]
        motions = {(row["index"], row["method"], row["flow_source"]): row for row in part["pairs"]}
        if mine:
            sequence = open_sequence(job.path, job.options.dataset)
            stem = f"worst/{number:03d}_{_plain(part)}"
            models = Models(job.options.device, job.options.weights)
            draw_worst(out, stem, sequence, mine, motions, job.flows, models)
    return worst


def _now() -> str:
    return datetime.now(UTC).isoformat(timespec="seconds")


def _timing(options: ComparisonOptions) -> str:
    """What the times of the results mean."""
    if options.scheduler is not None:
        return "one estimate at a time on each worker of a cluster"
    if options.jobs > 1:
        return f"up to {options.jobs} estimates at the same time: times are upper bounds"
    return "one estimate at a time"


def _versions() -> dict[str, str]:
    from importlib.metadata import PackageNotFoundError, version

    found = {"python": platform.python_version(), "hybridvo": hybridvo.__version__}
    for name in ("numpy", "scipy", "opencv-python-headless", "numba", "torch", "evo", "poselib"):
        with contextlib.suppress(PackageNotFoundError):
            found[name] = version(name)
    return found
