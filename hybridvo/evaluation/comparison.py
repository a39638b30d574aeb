"""Methods beside each other on sequences: same frames, same flow, same clock, scored against truth.

Every method runs as in ``hybridvo run`` and gives the same motions. One sequence is the unit of
resume: what it gave is one file in ``parts/`` until the comparison is done.
"""

from __future__ import annotations

import contextlib
import hashlib
import json
import os
import platform
import shutil
from collections.abc import Callable, Iterable, Iterator
from collections.abc import Sequence as Several
from dataclasses import asdict
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import pandas as pd

import hybridvo
from hybridvo.data.sequence import Sequence, open_sequence
from hybridvo.errors import HybridVOError, InputError
from hybridvo.evaluation.drawing import draw_worst
from hybridvo.evaluation.protocols import Protocol, check_protocol, protocol_summary
from hybridvo.evaluation.scores import ROW_COLUMNS, breakdown, total_row, worst_pairs
from hybridvo.evaluation.sequence_job import (
    PAIR_COLUMNS,
    ComparisonOptions,
    Job,
    pair_table,
    run_sequence,
)
from hybridvo.files import Mode, fingerprint, held, make_folder, versions, write_csv, write_json
from hybridvo.network.models import Models
from hybridvo.pipeline import METHODS, check_method, weights_hash

WRITTEN = ("results.json", "results.csv", "pairs.csv", "report.md", "report.html")
"""What a finished comparison leaves, beside ``trajectories/`` and ``worst/``."""
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
    anew. ``command`` is for ``results.json``; ``progress`` is told of every pair.

    Raises:
        InputError: options, sequences or methods that cannot be used. LockedError: another run
            holds the folder. OutputError: a result cannot be written.
    """
    from hybridvo.evaluation.report import write_report

    out, report = Path(out), progress or (lambda message, done, total: None)
    started = datetime.now(UTC).isoformat(timespec="seconds")
    models = Models(options.device, options.weights)
    methods, missing = methods_to_run(options.methods, models)
    jobs, protocol = _plan(options, methods)
    total = sum(job.pairs for job in jobs)
    with _folder(out, mode):
        for name, reason in missing.items():
            report(f"not run: {name}: {reason}", 0, total)
        parts = _work(jobs, out, report)
        report("scores and report", total, total)
        for part in parts:
            for warning in part["sequence"]["warnings"]:
                report(f"{part['sequence']['name']}: {warning}", total, total)
        pairs = [row for part in parts for row in part["pairs"]]
        table = pair_table(pairs)
        worst = worst_pairs(table, options.worst)
        for job, part in zip(jobs, parts, strict=True):
            mine = [entry for entry in worst if entry["sequence"] == job.name]
            draw_worst(out, job, mine, part["pairs"])
        result = {
            "command": list(command),
            "versions": versions(),
            "machine": {"platform": platform.platform(), "cpus": os.cpu_count()},
            "options": asdict(options),
            "weights": {name: weights_hash(name, models) for name in methods},
            "timing": "one estimate at a time",
            "started": started,
            "finished": datetime.now(UTC).isoformat(timespec="seconds"),
            "missing": missing,
            **_scores(table, parts, protocol),
            "trajectories": [path for part in parts for path in part["trajectories"]],
            "worst_pairs": worst,
        }
        write_csv(out / "pairs.csv", PAIR_COLUMNS, pairs)
        write_json(out / "results.json", result)
        write_csv(out / "results.csv", ROW_COLUMNS, result["rows"])
        write_report(out, result, table)
        shutil.rmtree(out / "parts", ignore_errors=True)
    return [out / name for name in WRITTEN]


# -- what there is to do --------------------------------------------------------------------------


def methods_to_run(
    names: Several[str], models: Models | None = None
) -> tuple[tuple[str, ...], dict[str, str]]:
    """Methods to run, and of those that ``all`` leaves out the reason with its remedy."""
    if not names:
        raise InputError(f"--methods: expected names, got none; known: {', '.join(METHODS)}.")
    is_all = list(names) == ["all"]
    runnable: dict[str, None] = {}
    missing: dict[str, str] = {}
    for name in METHODS if is_all else names:
        try:
            check_method(name, models)
            runnable[name] = None
        except InputError as error:
            if not is_all:
                raise
            missing[name] = str(error)
    return tuple(runnable), missing


def expand(path: str | os.PathLike[str], dataset: str | None = None) -> list[Path]:
    """Sequence folders that a path stands for: itself, or all sequences that it holds.

    A folder that is no sequence is searched one level down; of MPI Sintel its final or clean pass.
    """
    folder = Path(path)
    if not folder.is_dir() or _opens(folder, dataset):
        return [folder]
    inner = folder
    for names in (("training",), ("final", "clean")):
        inner = next((inner / name for name in names if (inner / name).is_dir()), inner)
    inside = [child for child in sorted(inner.iterdir()) if child.is_dir()]
    return [child for child in inside if _opens(child, dataset)] or [folder]


def _opens(folder: Path, dataset: str | None) -> bool:
    try:
        open_sequence(folder, dataset)
    except HybridVOError:
        return False
    return True


def _plan(
    options: ComparisonOptions, methods: tuple[str, ...]
) -> tuple[list[Job], Protocol | None]:
    """A job for each sequence, and the protocol."""
    if not options.sequences:
        raise InputError("compare: expected at least one folder of a sequence, got none.")
    paths = [path for given in options.sequences for path in expand(given, options.dataset)]
    opened = {path: open_sequence(path, options.dataset) for path in paths}
    protocol = None
    if options.protocol is not None:
        if options.stride != 1 or options.start or options.stop is not None:
            raise InputError(
                f"--protocol {options.protocol} is defined on whole sequences: leave out --start, "
                f"--stop and --stride."
            )
        protocol = check_protocol(options.protocol, list(opened.values()))
        opened = {path: s for path, s in opened.items() if s.name in protocol.sequences}
        if not opened:
            known = ", ".join(protocol.sequences)
            raise InputError(f"--protocol {protocol.name}: expected some of {known}, got none.")
    names = [sequence.name for sequence in opened.values()]
    models = Models(options.device, options.weights)
    hashes = {name: weights_hash(name, models) for name in methods}
    jobs: list[Job] = []
    for path, sequence in opened.items():
        name = sequence.name
        if names.count(name) > 1:
            name = f"{path.absolute().parent.name}/{name}"
        if name in [job.name for job in jobs]:
            raise InputError(f"--sequence: two sequences are called {name}; give each once.")
        frames = range(*slice(options.start, options.stop, options.stride).indices(len(sequence)))
        if not frames:
            raise InputError(f"{name}: no frames from {options.start} on: it has {len(sequence)}.")
        flows = _flows(sequence, options)
        same_camera_only = protocol is not None and protocol.same_camera_only
        deciding = [name, fingerprint(sequence.files()), list(frames), flows, options.seed]
        deciding += [same_camera_only, options.device, hashes, hybridvo.__version__]
        digest = hashlib.sha256(json.dumps(deciding).encode()).hexdigest()
        plain = "".join(c if c.isalnum() or c in "-_." else "_" for c in name)[:60]
        named = (str(path), name, f"{len(jobs):03d}_{plain}")
        jobs.append(Job(*named, options, flows, methods, frames, same_camera_only, digest))
    return jobs, protocol


def _flows(sequence: Sequence, options: ComparisonOptions) -> tuple[str, ...]:
    """Sources of flow: both side by side where the sequence has both."""
    if options.flow == "file":
        sequence.check_flow(options.stride)
    if options.flow != "auto":
        return (options.flow,)
    usable = sequence.has_flow and options.stride == 1
    images = any(path is not None for path in sequence.rgb_files)
    return (*(("dis",) if images or not usable else ()), *(("file",) if usable else ()))


# -- work -----------------------------------------------------------------------------------------


@contextlib.contextmanager
def _folder(out: Path, mode: Mode) -> Iterator[None]:
    """Hold the output folder; refuse or remove what is in it."""
    present = [name for name in (*WRITTEN, "parts") if (out / name).exists()]
    if present and mode == "new":
        raise InputError(
            f"{out}: holds {', '.join(present)}; pass --resume to go on, --overwrite to replace "
            f"them, or another --out."
        )
    with held(out):
        if mode == "overwrite":
            for name in ("parts", "trajectories", "worst"):
                shutil.rmtree(out / name, ignore_errors=True)
        yield


def _work(jobs: list[Job], out: Path, report: ReportProgress) -> list[dict[str, Any]]:
    """What every job gave, in order; kept from an earlier try where that is finished."""
    for name in ("parts", "trajectories", "worst"):
        make_folder(out / name)
    paths = {job.name: out / "parts" / f"{job.fingerprint}.json" for job in jobs}
    todo = [job for job in jobs if not paths[job.name].exists()]
    total = sum(job.pairs for job in jobs)
    done = total - sum(job.pairs for job in todo)
    if len(todo) < len(jobs):
        text = f"resumed: {len(jobs) - len(todo)} of {len(jobs)} sequences are finished"
        report(text, done, total)
    for job in todo:

        def report_pairs(pairs: int, before: int = done) -> None:
            report("", before + pairs, total)

        write_json(paths[job.name], run_sequence(job, out, report_pairs))
        done += job.pairs
    return [json.loads(paths[job.name].read_text(encoding="utf-8")) for job in jobs]


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
