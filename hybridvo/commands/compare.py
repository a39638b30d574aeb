"""``hybridvo compare``: methods beside each other on sequences, scored against ground truth.

Every method and source of flow is a ``hybridvo run`` of its own below ``runs/``, which is also what
is resumed; their steps become one table of pairs, and that the scores and the report.
"""

from __future__ import annotations

import contextlib
import dataclasses
import itertools
import logging
import os
import platform
import re
import shutil
from collections.abc import Iterable, Mapping
from collections.abc import Sequence as Several
from dataclasses import replace
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np
import pandas as pd

from hybridvo.commands.run import flow_provider, frames_of, run
from hybridvo.data.sequence import Sequence, open_sequence
from hybridvo.errors import HybridVOError, InputError
from hybridvo.evaluation import scores
from hybridvo.evaluation.pair_errors import ERRORS, pair_facts, true_motion, true_trajectory
from hybridvo.evaluation.protocols import check_protocol, protocol_summary, same_intrinsics
from hybridvo.evaluation.report import write_report
from hybridvo.files import Mode, atomic_write, held, make_folder, versions, write_json
from hybridvo.network.models import Models
from hybridvo.options import Options
from hybridvo.pipeline import METHODS, check_method, warm_up, weights_hash

_logger = logging.getLogger(__name__)
WRITTEN = ("results.json", "results.csv", "pairs.csv", "report.md", "report.html")
"""What a finished comparison leaves, beside ``runs/``."""
CAMERA_FLOW_KINDS = ("tartanair",)
"""Data sets whose true flow is that of the camera alone: it does not show what moves by itself."""


def compare(
    sequences: Several[str | os.PathLike[str]],
    out: str | os.PathLike[str],
    *,
    methods: Several[str] = ("all",),
    options: Options | None = None,
    dataset: str | None = None,
    protocol: Literal["paper"] | None = None,
    weights: Mapping[str, str] | None = None,
    mode: Mode = "new",
    command: Iterable[str] = (),
    quiet: bool = True,
) -> list[Path]:
    """Run every method on every sequence and write the results; returns paths of :data:`WRITTEN`.

    A folder of ``sequences`` stands for all that it holds; the method ``all`` for all that can run,
    the flow ``auto`` for every source that a sequence has, side by side. ``protocol`` scores MPI
    Sintel as the paper does, ``weights`` names files of networks. ``resume`` keeps finished runs.
    """
    out, options = Path(out), options or Options()
    models = Models(options.run.device, weights)
    names, missing = methods_to_run(methods, models)
    jobs = _jobs(sequences, dataset, options, out)
    if protocol is not None:
        check_protocol([job.sequence for job in jobs], options.run)
    present = [name for name in (*WRITTEN, "runs") if (out / name).exists()]
    if present and mode == "new":
        raise InputError(
            f"{out}: holds {', '.join(present)}; pass --resume to go on, --overwrite to replace "
            f"them, or another --out."
        )
    with held(out):
        if mode == "overwrite":
            shutil.rmtree(out / "runs", ignore_errors=True)
        make_folder(out / "runs")
        for name, reason in missing.items():
            _logger.warning("not run: %s: %s", name, reason)
        for name in names:
            warm_up(name, models)
        tables, rows, facts = [], [], []
        for job in jobs:
            given = {"models": models, "command": list(command), "quiet": quiet}
            runs = _run_all(job, names, options, given, missing)
            table, fact = _read(job, runs, protocol is not None)
            rows += [_row(job, table, key, run, out) for key, run in runs.items()]
            tables.append(table)
            facts.append(fact)
        table = pd.concat(tables, ignore_index=True)
        totals = scores.totals(table, rows)
        result: dict[str, Any] = {
            "command": list(command),
            "versions": versions(),
            "machine": {"platform": platform.platform(), "cpus": os.cpu_count()},
            "options": dataclasses.asdict(options),
            "weights": {name: weights_hash(name, models) for name in names},
            "timing": "one estimate at a time",
            "missing": missing,
            "rows": rows,
            "totals": totals,
            "sequences": facts,
            "protocol": None if protocol is None else protocol_summary(totals, facts),
        }
        write_json(out / "results.json", result)
        lines = pd.DataFrame(rows, dtype=object).drop(columns="reasons")
        pairs = table[list(scores.PAIR_COLUMNS)]
        for name, data in (("results.csv", lines), ("pairs.csv", pairs)):
            with atomic_write(out / name) as file:
                data.to_csv(file, index=False, lineterminator="\n")
        write_report(out, result, table)
    return [out / name for name in WRITTEN]


def methods_to_run(
    names: Several[str], models: Models | None = None
) -> tuple[tuple[str, ...], dict[str, str]]:
    """Methods to run, and of those that ``all`` leaves out the reason with its remedy."""
    if not names:
        raise InputError(f"--methods: expected names, got none; known: {', '.join(METHODS)}.")
    is_all = list(names) == ["all"]
    missing: dict[str, str] = {}
    wanted = dict.fromkeys(METHODS if is_all else names)
    for name in wanted:
        try:
            check_method(name)
        except InputError as error:
            if not is_all:
                raise
            missing[name] = str(error)
    return tuple(name for name in wanted if name not in missing), missing


def open_all(path: str | os.PathLike[str], dataset: str | None = None) -> list[Sequence]:
    """Sequences that a path stands for: the one of this folder, or all that it holds.

    A folder that is no sequence is searched one level down; of MPI Sintel its final or clean pass.
    """
    try:
        return [open_sequence(path, dataset)]
    except HybridVOError:
        inner, found = Path(path), []
        for names in (("training",), ("final", "clean")):
            inner = next((inner / name for name in names if (inner / name).is_dir()), inner)
        for child in sorted(inner.iterdir()) if inner.is_dir() else ():
            with contextlib.suppress(HybridVOError):
                found += [open_sequence(child, dataset)] if child.is_dir() else []
        if not found:
            raise
        return found


class _Job(NamedTuple):
    """One sequence: its flows by label, and the folder of its runs."""

    sequence: Sequence
    name: str
    folder: Path
    flows: tuple[str, ...]


Runs = dict[tuple[str, str], dict[str, Any]]
"""Summaries of the runs of a sequence that are done, by method and flow."""


def _run_all(
    job: _Job,
    methods: Iterable[str],
    options: Options,
    given: dict[str, Any],
    missing: dict[str, str],
) -> Runs:
    """Every method on every flow; a bug of one costs its run, and is told in ``missing``."""
    runs = {}
    for flow, method in itertools.product(job.flows, methods):
        source = flow.split()[0]
        folder = job.folder / f"{method}-{source}"
        single = {"method": method, "max_failed": 1.0}
        asked = _with(options, run=single, flow={"source": source})
        try:
            summary, _ = run(job.sequence, folder, asked, mode="resume", quick=True, **given)
        except HybridVOError:
            raise
        except Exception as error:
            missing[f"{method} on {job.name}"] = f"{type(error).__name__}: {error}"
            _logger.exception("%s on %s", method, job.name)
            continue
        runs[method, flow] = summary | {"out": folder}  # a resumed one may have been elsewhere
    return runs


def _with(options: Options, **groups: dict[str, Any]) -> Options:
    """The options with other values in some groups."""
    return replace(options, **{k: replace(getattr(options, k), **v) for k, v in groups.items()})


def _jobs(
    paths: Several[str | os.PathLike[str]], dataset: str | None, options: Options, out: Path
) -> list[_Job]:
    """What is to be done on every sequence; both flows where it has both."""
    opened = [sequence for path in paths for sequence in open_all(path, dataset)]
    if not opened:
        raise InputError("compare: expected at least one folder of a sequence, got none.")
    jobs: list[_Job] = []
    for sequence in opened:
        frames_of(sequence, options)
        name = sequence.name
        if [other.name for other in opened].count(name) > 1:
            name = f"{Path(sequence.root).absolute().parent.name}/{name}"
        sources: list[str] = [options.flow.source]
        if sources == ["auto"]:
            usable = sequence.has_flow and options.run.stride == 1
            images = any(file is not None for file in sequence.rgb_files)
            sources = ["dis"] * (images or not usable) + ["file"] * usable
        for source in sources:
            flow_provider(sequence, _with(options, flow={"source": source}))
        is_true = sequence.flow_is_true  # an oracle is named
        flows = tuple("file (true)" if s == "file" and is_true else s for s in sources)
        folder = out / "runs" / re.sub(r"[^\w.-]", "_", name)
        if folder in [job.folder for job in jobs]:
            raise InputError(f"--sequence: {name} is given twice.")
        jobs.append(_Job(sequence, name, folder, flows))
    return jobs


def _read(job: _Job, runs: Runs, same_camera_only: bool) -> tuple[pd.DataFrame, dict[str, Any]]:
    """Pairs of all runs as one table, and what is said of the sequence."""
    sequence = job.sequence
    table = pd.concat([_pairs(job.name, *key, run["out"]) for key, run in runs.items()])
    first = table.drop_duplicates("next")
    missing = first[first["missing"]]
    left_out = [
        {"index": row.next, "reason": f"frame cannot be read: {row.message}"}
        for row in missing.itertuples()
    ]
    if same_camera_only:
        cameras = first[["prev", "next"]].map(sequence.camera)
        changed = first[~cameras.apply(lambda pair: same_intrinsics(*pair), axis=1)]
        left_out += [{"index": i, "reason": "the intrinsics change"} for i in changed["prev"]]
        table = table[~table["next"].isin(changed["next"])]
        first = table.drop_duplicates("next")
    facts = [
        {"next": row.next} | _facts(sequence, row.prev, row.next)
        for row in first[~first["missing"]].itertuples()
    ]
    table = table.merge(pd.DataFrame(facts, columns=["next", *scores.FACTORS]), "left", "next")
    table = scores.pair_table(table.sort_values("index", kind="stable").to_dict("records"))
    gt = true_trajectory(sequence, range(len(sequence)))
    if gt is not None:
        gt.save(job.folder / "ground_truth.tum")
    return table, {
        "name": job.name,
        "kind": sequence.kind,
        "path": str(sequence.root),
        "pairs_scored": len(first),
        "left_out": left_out,
        "depth_source": sequence.depth_source,
        "flow_sources": list(job.flows),
        "warnings": list(sequence.warnings),
        "ground_truth": gt and f"runs/{job.folder.name}/ground_truth.tum",
    }


def _pairs(name: str, method: str, flow: str, folder: Path) -> pd.DataFrame:
    """Motions of one run."""
    steps = pd.read_csv(folder / "steps.csv", dtype={"reason": str, "message": str})
    stride = int(np.diff(steps["index"][:2]).sum())
    steps = steps[steps["prev_index"].notna()].fillna({"reason": "", "message": ""})
    missing = steps["reason"] == "missing_frame"
    steps.loc[missing, [*ERRORS, "motion_ms", "flow_ms"]] = np.nan
    return steps.assign(
        sequence=name,
        method=method,
        flow_source=flow,
        status=steps["status"] + steps["reason"].map(lambda why: f"({why})" if why else ""),
        ms=steps["motion_ms"],
        prev=steps["prev_index"].astype(int),
        next=steps["index"],
        index=steps["index"] - stride,
        missing=missing,
    )


def _row(
    job: _Job, table: pd.DataFrame, key: tuple[str, str], run: dict[str, Any], out: Path
) -> dict[str, Any]:
    """Line of the results of a run."""
    mine = table[(table["method"] == key[0]) & (table["flow_source"] == key[1])]
    named = {"sequence": job.name, "method": key[0], "flow_source": key[1]}
    named |= {"depth_source": job.sequence.depth_source}
    path = (run["out"] / "trajectory.tum").relative_to(out).as_posix()
    return scores.sequence_row(mine, run["metrics"], named) | {"trajectory": path}


def _facts(sequence: Sequence, prev: int, curr: int) -> dict[str, Any]:
    """What may explain an error. The true flow serves for this alone: no estimate ever sees it."""
    T_gt, flow_gt = true_motion(sequence, prev, curr), None
    whole = sequence.flow_is_true and sequence.kind not in CAMERA_FLOW_KINDS
    if whole and curr == prev + 1:
        with contextlib.suppress(InputError, OSError):
            flow_gt = sequence.flow(prev)[0]
    cameras = sequence.camera(prev), sequence.camera(curr)
    return pair_facts(T_gt, sequence.frame(prev).depth, *cameras, flow_gt)
