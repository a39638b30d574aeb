"""Methods beside each other on sequences: same frames, same flow, same clock, scored against truth.

Every method runs as :class:`hybridvo.odometry.Odometry`, exactly as in ``hybridvo run``: for the
same frames and the same flow both give the same motions. One sequence is the unit of work and of
resume: what it gave is one file in ``parts/`` until the comparison is done.
"""

from __future__ import annotations

import contextlib
import json
import multiprocessing
import os
import platform
import shutil
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ProcessPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from dataclasses import asdict
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, Literal

import filelock
import numpy as np
import pandas as pd

from hybridvo.errors import HybridVOError, InputError, LockedError
from hybridvo.evaluation.drawing import draw_worst
from hybridvo.evaluation.plan import methods_to_run, plan
from hybridvo.evaluation.protocols import Protocol, protocol_summary
from hybridvo.evaluation.scores import ROW_COLUMNS, breakdown, total_row, worst_pairs
from hybridvo.evaluation.sequence_job import (
    PAIR_COLUMNS,
    ComparisonOptions,
    Job,
    pair_table,
    run_sequence,
)
from hybridvo.files import make_folder, versions, write_csv, write_json
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
    """Run every method on every sequence and write the results; returns paths of :data:`WRITTEN`.

    ``new`` refuses a folder with results, ``resume`` keeps finished sequences, ``overwrite`` starts
    anew. ``command`` is for ``results.json``; ``progress`` is told of every pair (of every
    sequence, where several run at a time).

    Raises:
        InputError: options, sequences or methods that cannot be used. LockedError: another run
            holds the folder. OutputError: a result cannot be written. HybridVOError: a worker died.
        KeyboardInterrupt: finished sequences are kept for ``resume``.
    """
    from hybridvo.evaluation.report import write_report

    out, report = Path(out), progress or (lambda message, done, total: None)
    started = datetime.now(UTC).isoformat(timespec="seconds")
    models = Models(options.device, options.weights)
    methods, missing = methods_to_run(options.methods, models)
    jobs, protocol = plan(options, methods)
    total = sum(job.pairs for job in jobs)
    with _folder(out, mode):
        for name, reason in missing.items():
            report(f"not run: {name}: {reason}", 0, total)
        parts = _work(jobs, options.jobs, out / "parts", report)
        report("scores and report", total, total)
        for part in parts:
            for warning in part["sequence"]["warnings"]:
                report(f"{part['sequence']['name']}: {warning}", total, total)
        table = pair_table(row for part in parts for row in part["pairs"])
        at_a_time = "up to {} estimates at the same time: times are upper bounds"
        result = {
            "command": list(command),
            "versions": versions(),
            "machine": {"platform": platform.platform(), "cpus": os.cpu_count()},
            "options": asdict(options),
            "weights": {name: weights_hash(name, models) for name in methods},
            "timing": at_a_time.format(options.jobs) if options.jobs > 1 else "one at a time",
            "started": started,
            "finished": datetime.now(UTC).isoformat(timespec="seconds"),
            "missing": missing,
            **_scores(table, parts, protocol),
            **_write_sequences(out, jobs, parts, worst_pairs(table, options.worst)),
        }
        write_csv(out / "pairs.csv", PAIR_COLUMNS, (r for part in parts for r in part["pairs"]))
        write_json(out / "results.json", result)
        write_csv(out / "results.csv", ROW_COLUMNS, result["rows"])
        write_report(out, result, table)
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
    make_folder(out)
    try:
        with filelock.FileLock(out / ".lock", timeout=0):
            if mode == "overwrite":
                for name in ("parts", "trajectories", "worst"):
                    shutil.rmtree(out / name, ignore_errors=True)
            yield
    except filelock.Timeout:
        raise LockedError(f"{out}: another run holds this folder.") from None


# -- work -----------------------------------------------------------------------------------------


def _work(
    jobs: list[Job], processes: int, folder: Path, report: ReportProgress
) -> list[dict[str, Any]]:
    """What every job gave, in order; kept from an earlier try where that is finished."""
    make_folder(folder)
    paths = {job.name: folder / f"{number:03d}.json" for number, job in enumerate(jobs)}
    todo = [job for job in jobs if not _is_finished(job, paths[job.name])]
    total = sum(job.pairs for job in jobs)
    done = total - sum(job.pairs for job in todo)
    if len(todo) < len(jobs):
        text = f"resumed: {len(jobs) - len(todo)} of {len(jobs)} sequences are finished"
        report(text, done, total)
    if min(processes, len(todo)) <= 1:
        for job in todo:

            def report_pairs(pairs: int, before: int = done) -> None:
                report("", before + pairs, total)

            write_json(paths[job.name], run_sequence(job, report_pairs))
            done += job.pairs
    else:
        # a fork would copy the threads' locks of numba and OpenCV in whatever state they are
        context = multiprocessing.get_context("spawn")
        threads = max(1, (os.cpu_count() or 1) // processes)
        with ProcessPoolExecutor(processes, context, _start_worker, (threads,)) as executor:
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
                done += job.pairs
                report(f"{job.name} is finished", done, total)
    return [json.loads(paths[job.name].read_text(encoding="utf-8")) for job in jobs]


def _is_finished(job: Job, path: Path) -> bool:
    if not path.exists():
        return False
    if json.loads(path.read_text(encoding="utf-8"))["fingerprint"] != job.fingerprint:
        raise InputError(
            f"{path}: was made of other frames, options, methods or weights; pass --overwrite, "
            f"or another --out."
        )
    return True


def _start_worker(threads: int) -> None:
    """A worker's share of the cores."""
    import cv2
    import numba

    cv2.setNumThreads(threads)
    numba.set_num_threads(min(threads, numba.get_num_threads()))


# -- results --------------------------------------------------------------------------------------


def _scores(
    table: pd.DataFrame, parts: list[dict[str, Any]], protocol: Protocol | None
) -> dict[str, Any]:
    """Lines and tables of all sequences."""
    rows = [row for part in parts for row in part["rows"]]
    totals = [
        total_row(group, [row for row in rows if (row["method"], row["flow_source"]) == key])
        for key, group in table.groupby(["method", "flow_source"], sort=False)
    ]
    counts = {part["sequence"]["name"]: part["sequence"]["pairs_scored"] for part in parts}
    return {
        "rows": rows,
        "totals": totals,
        "sequences": [part["sequence"] for part in parts],
        "breakdown": breakdown(table),
        "protocol": protocol and protocol_summary(protocol, totals, counts),
    }


def _write_sequences(
    out: Path, jobs: list[Job], parts: list[dict[str, Any]], worst: list[dict[str, Any]]
) -> dict[str, Any]:
    """Write the paths of every sequence and the images of its worst pairs, and say where."""
    trajectories = []
    for folder in ("trajectories", "worst"):
        make_folder(out / folder)
    for number, (job, part) in enumerate(zip(jobs, parts, strict=True)):
        plain = "".join(c if c.isalnum() or c in "-_." else "_" for c in job.name)[:60]
        stem = f"{number:03d}_{plain}"
        for key, poses in part["trajectories"].items():
            if poses is None:
                continue
            method, _, flow = key.partition("|")
            stamps = part["timestamps"]["estimate" if flow else "ground_truth"]
            path = "_".join([f"trajectories/{stem}", method, *flow.split()[:1]]) + ".tum"
            Trajectory(np.array(stamps), np.array(poses)).save(out / path)
            named = {"method": method if flow else None, "flow_source": flow or None}
            trajectories.append({"sequence": job.name, **named, "path": path})
        mine = [entry for entry in worst if entry["sequence"] == job.name]
        draw_worst(out, f"worst/{stem}", job, mine, part["pairs"])
    return {"trajectories": trajectories, "worst_pairs": worst}
