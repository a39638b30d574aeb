"""Methods beside each other on sequences: same frames, same flow, same clock, scored against truth.

Every method runs as in ``hybridvo run`` and gives the same motions. One sequence is the unit of
resume: what it gave is one file in ``parts/`` until the comparison is done.
"""

from __future__ import annotations

import hashlib
import json
import os
import platform
import shutil
from collections.abc import Callable, Iterable, Mapping
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
from hybridvo.evaluation.scores import (
    PAIR_COLUMNS,
    breakdown,
    pair_table,
    sequence_row,
    total_row,
    worst_pairs,
)
from hybridvo.evaluation.sequence_job import Job, run_sequence
from hybridvo.files import Mode, fingerprint, held, make_folder, versions, write_csv, write_json
from hybridvo.flow import MeasuredFlow, dis_flow, file_flow
from hybridvo.network.models import Models
from hybridvo.options import Options
from hybridvo.pipeline import METHODS, check_method, weights_hash
from hybridvo.trajectory import read_trajectory

WRITTEN = ("results.json", "results.csv", "pairs.csv", "report.md", "report.html")
"""What a finished comparison leaves, beside ``trajectories/`` and ``worst/``."""


def compare(
    sequences: Several[str | os.PathLike[str]],
    out: str | os.PathLike[str],
    *,
    methods: Several[str] = ("all",),
    options: Options | None = None,
    dataset: str | None = None,
    protocol: str | None = None,
    weights: Mapping[str, str] | None = None,
    worst: int = 3,
    mode: Mode = "new",
    command: Iterable[str] = (),
    say: Callable[[str], None] = lambda text: None,
    progress: Callable[[int, int], None] = lambda done, total: None,
) -> list[Path]:
    """Run every method on every sequence and write the results; returns paths of :data:`WRITTEN`.

    A folder of ``sequences`` stands for all that it holds; the method ``all`` for all that can run,
    the flow ``auto`` for every source that a sequence has, side by side. ``protocol`` is ``paper``
    or ``trajectory14`` (MPI Sintel as others score it), ``weights`` names files of networks,
    ``worst`` counts the pairs shown for each method and flow. ``resume`` keeps finished sequences.
    ``progress`` is told of the pairs done and in all.
    """
    from hybridvo.evaluation.report import write_report

    out, options = Path(out), options or Options()
    if worst < 0:
        raise InputError(f"--worst: expected 0 or more, got {worst}.")
    started = datetime.now(UTC).isoformat(timespec="seconds")
    models = Models(options.run.device, weights)
    names, missing = methods_to_run(methods, models)
    hashes = {name: weights_hash(name, models) for name in names}
    chosen, opened = _open(sequences, options, dataset, protocol)
    jobs = [_job(path, opened, names, options, chosen, k) for k, path in enumerate(opened)]
    if doubled := [job.name for job in jobs if [j.name for j in jobs].count(job.name) > 1]:
        raise InputError(f"--sequence: two sequences are called {doubled[0]}; give each once.")
    present = [name for name in (*WRITTEN, "parts") if (out / name).exists()]
    if present and mode == "new":
        raise InputError(
            f"{out}: holds {', '.join(present)}; pass --resume to go on, --overwrite to replace "
            f"them, or another --out."
        )
    with held(out):
        for name in ("parts", "trajectories", "worst"):
            if mode == "overwrite":
                shutil.rmtree(out / name, ignore_errors=True)
            make_folder(out / name)
        for name, reason in missing.items():
            say(f"not run: {name}: {reason}")
        parts = _work(jobs, options, models, hashes, out, say, progress)
        say("scores and report")
        for part in parts:
            for warning in part["sequence"]["warnings"]:
                say(f"{part['sequence']['name']}: {warning}")
        pairs = [row for part in parts for row in part["pairs"]]
        table = pair_table(pairs)
        shown = worst_pairs(table, worst)
        for job in jobs:
            mine = [entry for entry in shown if entry["sequence"] == job.name]
            draw_worst(out, job, options, models, mine, table[table["sequence"] == job.name])
        result = {
            "command": list(command),
            "versions": versions(),
            "machine": {"platform": platform.platform(), "cpus": os.cpu_count()},
            "options": asdict(options),
            "weights": hashes,
            "timing": "one estimate at a time",
            "started": started,
            "finished": datetime.now(UTC).isoformat(timespec="seconds"),
            "missing": missing,
            **_scores(table, parts, chosen, out),
            "worst_pairs": shown,
        }
        write_csv(out / "pairs.csv", PAIR_COLUMNS, pairs)
        write_json(out / "results.json", result)
        columns = [name for name in result["rows"][0] if name != "reasons"]
        write_csv(out / "results.csv", columns, result["rows"])
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
    missing: dict[str, str] = {}
    for name in METHODS if is_all else names:
        try:
            check_method(name, models)
        except InputError as error:
            if not is_all:
                raise
            missing[name] = str(error)
    wanted = dict.fromkeys(METHODS if is_all else names)
    return tuple(name for name in wanted if name not in missing), missing


def expand(path: str | os.PathLike[str], dataset: str | None = None) -> list[Path]:
    """Sequence folders that a path stands for: itself, or all sequences that it holds.

    A folder that is no sequence is searched one level down; of MPI Sintel its final or clean pass.
    """

    def opens(folder: Path) -> bool:
        try:
            open_sequence(folder, dataset)
        except HybridVOError:
            return False
        return True

    folder = Path(path)
    if not folder.is_dir() or opens(folder):
        return [folder]
    inner = folder
    for names in (("training",), ("final", "clean")):
        inner = next((inner / name for name in names if (inner / name).is_dir()), inner)
    inside = [child for child in sorted(inner.iterdir()) if child.is_dir()]
    return [child for child in inside if opens(child)] or [folder]


def _open(
    sequences: Several[str | os.PathLike[str]],
    options: Options,
    dataset: str | None,
    protocol: str | None,
) -> tuple[Protocol | None, dict[Path, Sequence]]:
    """The protocol, and the sequences by their folders."""
    if not sequences:
        raise InputError("compare: expected at least one folder of a sequence, got none.")
    paths = [path for given in sequences for path in expand(given, dataset)]
    opened = {path: open_sequence(path, dataset) for path in paths}
    if protocol is None:
        return None, opened
    if options.run.stride != 1 or options.run.start or options.run.stop is not None:
        raise InputError(
            f"--protocol {protocol} is defined on whole sequences: leave out --start, --stop and "
            f"--stride."
        )
    chosen = check_protocol(protocol, list(opened.values()))
    opened = {path: s for path, s in opened.items() if s.name in chosen.sequences}
    if not opened:
        known = ", ".join(chosen.sequences)
        raise InputError(f"--protocol {protocol}: expected some of {known}, got none.")
    return chosen, opened


def _job(
    path: Path,
    opened: Mapping[Path, Sequence],
    methods: tuple[str, ...],
    options: Options,
    protocol: Protocol | None,
    number: int,
) -> Job:
    """What is to be done on the sequence of a folder; both flows where it has both."""
    sequence, run, source = opened[path], options.run, options.flow.source
    name = sequence.name
    if [other.name for other in opened.values()].count(name) > 1:
        name = f"{path.absolute().parent.name}/{name}"
    frames = range(*slice(run.start, run.stop, run.stride).indices(len(sequence)))
    if not frames:
        raise InputError(f"{name}: no frames from {run.start} on: it has {len(sequence)}.")
    if source == "file":
        sequence.check_flow(run.stride)
    from_files = source == "file" or (source == "auto" and sequence.has_flow and run.stride == 1)
    images = any(file is not None for file in sequence.rgb_files)
    flows = {}
    if source == "dis" or (source == "auto" and (images or not from_files)):
        flows["dis"] = MeasuredFlow(dis_flow(options.flow.dis_preset))
    if from_files:  # an oracle is named
        label = "file (true)" if sequence.flow_is_true else "file"
        flows[label] = MeasuredFlow(file_flow(sequence, strict=False))
    plain = "".join(c if c.isalnum() or c in "-_." else "_" for c in name)[:60]
    same_camera_only = protocol is not None and protocol.same_camera_only
    return Job(sequence, name, f"{number:03d}_{plain}", frames, methods, flows, same_camera_only)


# -- work -----------------------------------------------------------------------------------------


def _work(
    jobs: list[Job],
    options: Options,
    models: Models,
    hashes: Mapping[str, str | None],
    out: Path,
    say: Callable[[str], None],
    progress: Callable[[int, int], None],
) -> list[dict[str, Any]]:
    """What every job gave, in order; kept from an earlier try where that is finished."""
    parts = []
    for job in jobs:
        deciding = [job.name, fingerprint(job.sequence.files()), list(job.frames), list(job.flows)]
        deciding += [job.same_camera_only, asdict(options), hashes, hybridvo.__version__]
        digest = hashlib.sha256(json.dumps(deciding).encode()).hexdigest()
        parts.append(out / "parts" / f"{digest}.json")
    todo = [k for k, part in enumerate(parts) if not part.exists()]
    total = sum(job.pairs for job in jobs)
    done = total - sum(jobs[k].pairs for k in todo)
    if len(todo) < len(jobs):
        say(f"resumed: {len(jobs) - len(todo)} of {len(jobs)} sequences are finished")
    for k in todo:

        def report(pairs: int, before: int = done) -> None:
            progress(before + pairs, total)

        write_json(parts[k], run_sequence(jobs[k], options, models, out, report))
        done += jobs[k].pairs
    return [json.loads(part.read_text(encoding="utf-8")) for part in parts]


def _scores(
    table: pd.DataFrame, parts: list[dict[str, Any]], protocol: Protocol | None, out: Path
) -> dict[str, Any]:
    """Lines and tables of all sequences."""
    rows = []
    for part in parts:
        facts = part["sequence"]
        paths = {
            (entry["method"], entry["flow_source"]): read_trajectory(out / entry["path"], "tum")
            for entry in part["trajectories"]
        }
        gt = paths.pop((None, None), None)
        for (method, flow), est in paths.items():
            named = {"sequence": facts["name"], "method": method, "flow_source": flow}
            mine = table[(table[list(named)] == pd.Series(named)).all(axis=1)]
            named["depth_source"] = facts["depth_source"]
            rows.append(sequence_row(mine, est if len(est) > 1 else None, gt, named))
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
        "trajectories": [path for part in parts for path in part["trajectories"]],
    }
