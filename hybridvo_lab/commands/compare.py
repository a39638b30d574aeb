"""``hybridvo compare``: methods side by side, each as a ``hybridvo run``."""

from __future__ import annotations

import contextlib
import dataclasses
import logging
import os
import re
import shutil
import signal
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pandas as pd
from rich.console import Console
from rich.progress import track

from hybridvo.core.errors import HybridVOError, InputError, Interrupted, OutputError
from hybridvo.core.files import (
    Mode,
    atomic_write,
    locked_folder,
    make_folder,
    provenance,
    write_json,
)
from hybridvo.core.options import Options
from hybridvo.core.trajectory import read_trajectory
from hybridvo.io.data.open import open_sequence
from hybridvo.io.data.sequence import Sequence
from hybridvo.io.data.truth import true_trajectory
from hybridvo.network.models import Models
from hybridvo.odometry import Odometry
from hybridvo.run.commands.ready_methods import methods_to_run
from hybridvo.run.commands.run import flow_provider, frames_of, run
from hybridvo.run.commands.run_folder import weights_hash
from hybridvo.run.commands.text import reasons_of
from hybridvo_lab import baselines
from hybridvo_lab.cluster import Workers
from hybridvo_lab.evaluation import protocols, scores
from hybridvo_lab.evaluation.metrics import rpe_over_a_second
from hybridvo_lab.evaluation.path_scores import paths_summary, score_path
from hybridvo_lab.evaluation.protocols import Protocol
from hybridvo_lab.evaluation.report import write_report
from hybridvo_lab.methods import in_order

_logger = logging.getLogger(__name__)

WRITTEN = (
    "results.json",
    "results.csv",
    "pairs.csv",
    "report.md",
    "report.html",
    "report.tex",
)
"""The files that a finished comparison leaves beside ``runs/``."""
RUNS = "runs"
"""The folder of the runs of a comparison."""
Opener = Callable[[str | Path], Sequence]
"""Opens the sequence in a folder."""
SINTEL_PASSES = ("final", "clean")
"""Folders of MPI Sintel that stand for its scenes, the one that is used by default first."""


@dataclass(frozen=True)
class _Comparison:
    """What all runs of a comparison share."""

    out: Path
    methods: tuple[str, ...]
    options: Options
    models: Models
    protocol: Protocol | None
    left_out: list[str]  # sequences that are not of the protocol
    command: list[str]
    quiet: bool
    missing: dict[str, str]  # methods that did not run, and why; grows
    workers: Workers


class _Task(NamedTuple):
    """One method on one sequence."""

    open: Callable[[], Sequence]
    name: str  # of the sequence
    method: str


class _Ran(NamedTuple):
    """What is left of a task."""

    metrics: dict[str, Any] | None = None  # None without ground truth
    bug: str = ""  # why there are no results


class _Scoring(NamedTuple):
    """A sequence with the metrics of the methods that ran on it."""

    open: Callable[[], Sequence]
    metrics: dict[str, Any]


@dataclass(frozen=True)
class _Scored:
    """The results of all methods on one sequence."""

    pairs: pd.DataFrame  # as in scores.pair_table
    rows: list[dict[str, Any]]  # a line of results.csv for each method
    description: dict[str, Any]  # what results.json states of the sequence
    # by the protocol's definitions, where it scores paths
    protocol_rows: list[dict[str, Any]]


def compare(
    sequences: Iterable[str | Path],
    out: str | Path,
    *,
    methods: Iterable[str] = ("all",),
    options: Options | None = None,
    opened_with: Mapping[str, Any] | None = None,
    protocol: str | None = None,
    models: Models | None = None,
    mode: Mode = "new",
    command: Iterable[str] = (),
    quiet: bool = True,
    workers: Workers | None = None,
) -> dict[str, Any]:
    """Run every method on every sequence, and write tables and a report.

    Args:
        sequences: Folders of sequences; a folder may also hold several sequences.
        out: The output folder.
        methods: Names of methods; ``all`` stands for every method that can run here.
        options: The options of all runs.
        opened_with: Keyword arguments of ``open_sequence``, such as ``camera``, for all sequences.
        protocol: One of ``protocols.yaml``: it chooses sequences and frames, and scores them
            as ``docs/protocols.md`` states.
        models: The networks; by default the pretrained ones.
        mode: What happens to results that are there already.
        command: The words of the command line, which are kept with the results.
        quiet: Whether no progress is shown.
        workers: Where the runs are done; by default here, one after the other.

    Returns:
        A summary, JSON-ready: ``totals``, ``missing``, ``protocol`` and ``files``.

    Raises:
        InputError: A sequence or a method cannot be used, or the folder holds results.
        OutputError: A result cannot be written.
    """
    workers = workers or Workers()
    out = Path(out)
    reading = dict(opened_with or {})
    if workers.are_remote:
        # workers are in other folders
        out = out.absolute()
        reading |= {
            name: _absolute(value)
            for name, value in reading.items()
            if name != "dataset"
        }
    options = options or Options()
    models = models or Models(options.run.device)
    names, missing = methods_to_run(methods, models, in_order())
    open_one = partial(open_sequence, **reading)
    rules = None if protocol is None else protocols.check_protocol(protocol)
    if rules is not None:
        _check_frames_are_free(rules, options)
    opened = _open_each(sequences, options, open_one, rules)
    if mode == "new":
        _refuse_results(out)
    comparison = _Comparison(
        out,
        names,
        options,
        models,
        rules,
        opened.left_out,
        list(command),
        quiet or workers.are_elsewhere,
        missing,
        workers,
    )
    with locked_folder(out):
        if mode == "overwrite":
            _remove_runs(out)
        _warn_of(missing)
        scored = _run_and_score(comparison, opened.sequences, open_one, quiet)
        pairs = pd.concat([part.pairs for part in scored], ignore_index=True)
        result = _result(comparison, scored, pairs)
        files = _write(out, result, pairs)
    if not result["rows"]:
        raise RuntimeError(
            f"every method failed; {out / 'results.json'} states how."
        )
    return {
        "totals": result["totals"],
        "missing": missing,
        "protocol": result["protocol"],
        "files": files,
    }


def _warn_of(missing: Mapping[str, str]) -> None:
    """Log which methods do not run."""
    for reason in reasons_of(missing):
        _logger.warning("not run: %s", reason)


def _run_and_score(
    comparison: _Comparison,
    sequences: list[Sequence],
    open_one: Opener,
    quiet: bool,
) -> list[_Scored]:
    """Run every method on every sequence; return the results of each sequence."""
    openers = [_opener(comparison, open_one, sequence) for sequence in sequences]
    metrics = _run_all(comparison, sequences, openers, quiet)
    return _score_all(comparison, openers, metrics, quiet)


def _absolute(value: Any) -> Any:
    """Return what was given with the whole path of a file or folder, if it is one."""
    is_path = isinstance(value, str | Path) and value and os.path.exists(value)
    return os.path.abspath(value) if is_path else value


def _refuse_results(out: Path) -> None:
    """Raise an InputError where a folder holds results of a comparison."""
    present = [name for name in (*WRITTEN, RUNS) if (out / name).exists()]
    if present:
        choices = "--resume to go on, another --out, or --overwrite to replace them"
        raise InputError(f"{out}: holds {', '.join(present)}; pass {choices}.")


def _remove_runs(out: Path) -> None:
    """Delete the runs of an earlier comparison."""
    runs = out / RUNS
    shutil.rmtree(runs, ignore_errors=True)
    if os.path.lexists(runs):
        raise OutputError(f"{runs}: cannot be replaced.")


# -- which methods, which sequences ------------------------------------------------------


def _check_frames_are_free(protocol: Protocol, options: Options) -> None:
    """Refuse a choice of frames where the protocol makes it."""
    run_options = options.run
    chosen = (run_options.start, run_options.stop, run_options.stride)
    if protocol.scores_paths and chosen != (0, None, 1):
        raise InputError(
            f"--protocol {protocol.name} chooses the frames itself: expected no --start, "
            f"--stop or --stride, got {', '.join(map(str, chosen))}."
        )


def open_all(
    path: str | Path,
    open_one: Opener = open_sequence,
    passes: tuple[str, ...] = SINTEL_PASSES,
) -> list[Sequence]:
    """Open the sequence in a folder, or all sequences one level below it.

    Of MPI Sintel as it was unpacked, those are the scenes of the first pass that is there.

    Args:
        path: The folder.
        open_one: Opens one sequence.
        passes: Passes of MPI Sintel.

    Raises:
        HybridVOError: The folder is no sequence and holds none.
    """
    try:
        return [open_one(path)]
    except HybridVOError:
        sequences = list(_open_below(Path(path), open_one, passes))
        if not sequences:
            raise
        return sequences


def _open_below(
    folder: Path, open_one: Opener, passes: tuple[str, ...]
) -> Iterator[Sequence]:
    """Open the sequences in a folder, and skip what is none."""
    if (folder / "training").is_dir():
        folder = folder / "training"
    for name in passes:
        if (folder / name).is_dir():
            folder = folder / name
            break
    if not folder.is_dir():
        return
    for child in sorted(folder.iterdir()):
        if child.is_dir():
            with contextlib.suppress(HybridVOError):
                yield open_one(child)


def _open_each(
    paths: Iterable[str | Path],
    options: Options,
    open_one: Opener,
    protocol: Protocol | None,
) -> protocols.Chosen:
    """Open all sequences, give each a name of its own, and refuse at once what cannot be run."""
    opened: list[Sequence] = []
    left_out: list[str] = []
    for path in paths:
        if protocol is None:
            sequences = open_all(path, open_one)
        else:
            chosen = _of_protocol(protocol, path, open_one)
            sequences = chosen.sequences
            left_out += chosen.left_out
            protocols.check_once(protocol, [*opened, *sequences])
        for sequence in sequences:
            frames_of(sequence, options, at_least=2)
            flow_provider(sequence, options)
            used = {other.name for other in opened}
            sequence.name = _unused_name(sequence.name, used)
            opened.append(sequence)
    if not opened:
        raise InputError(
            "compare: expected at least one folder of a sequence, got none."
        )
    return protocols.Chosen(opened, left_out)


def _of_protocol(
    protocol: Protocol, path: str | Path, open_one: Opener
) -> protocols.Chosen:
    """Open the sequences of a protocol in a folder, with the frames that it takes."""
    wanted = protocol.image_pass
    others = [name for name in SINTEL_PASSES if name != wanted]
    passes = (wanted, *others) if wanted else SINTEL_PASSES
    found = open_all(path, open_one, passes)
    is_named = [sequence.root for sequence in found] == [Path(path).absolute()]
    chosen = protocols.choose(protocol, found, is_named)
    prepared = [protocols.prepare(protocol, one) for one in chosen.sequences]
    return chosen._replace(sequences=prepared)


def _unused_name(name: str, used: set[str]) -> str:
    """Return a name, with a number behind it if it is used already."""
    count = 1
    unused = name
    while unused in used:
        count += 1
        unused = f"{name}_{count}"
    return unused


# -- the runs and their scores -----------------------------------------------------------


def _opener(
    comparison: _Comparison, open_one: Opener, sequence: Sequence
) -> Callable[[], Sequence]:
    """Return how a task comes by its sequence: other processes open it themselves."""
    if comparison.workers.are_elsewhere:
        rules = comparison.protocol
        return partial(_open_again, open_one, rules, sequence.root, sequence.name)
    return lambda: sequence


def _open_again(
    open_one: Opener, rules: Protocol | None, root: Path, name: str
) -> Sequence:
    """Open a sequence in another process, with the frames that a protocol takes."""
    sequence = open_one(root)
    if rules is not None:
        sequence = protocols.prepare(rules, sequence)
    sequence.name = name
    return sequence


def _run_all(
    comparison: _Comparison,
    opened: list[Sequence],
    openers: list[Callable[[], Sequence]],
    quiet: bool,
) -> list[dict[str, Any]]:
    """Run all methods on all sequences.

    Returns:
        For each sequence the metrics of the methods that ran, by their name.
    """
    tasks = [
        _Task(open_it, sequence.name, method)
        for sequence, open_it in zip(opened, openers, strict=True)
        for method in comparison.methods
    ]
    if comparison.workers.are_elsewhere:
        _compile_once(comparison)
    ran: dict[tuple[str, str], dict[str, Any] | None] = {}
    work = partial(_run_task, comparison)
    for done in _tracked(comparison, work, tasks, "runs", quiet):
        task = tasks[done.number]
        result = done.result or _Ran(bug=done.lost)
        if result.bug:
            comparison.missing[f"{task.method} on {task.name}"] = result.bug
        else:
            ran[task.name, task.method] = result.metrics
    return [
        {
            method: ran[sequence.name, method]
            for method in comparison.methods
            if (sequence.name, method) in ran
        }
        for sequence in opened
    ]


def _tracked(
    comparison: _Comparison,
    work: Callable[[Any], Any],
    tasks: list[Any],
    what: str,
    quiet: bool,
) -> Iterator[Any]:
    """Yield what is done of tasks, and show the progress of tasks in other processes."""
    workers = comparison.workers
    console = Console(stderr=True, quiet=quiet or not workers.are_elsewhere)
    coming = workers.each(work, tasks)
    count = 0
    try:
        for done in track(coming, what, len(tasks), console=console):
            count += 1
            yield done
    except KeyboardInterrupt as stop:
        # a run in this process reports itself what it has saved
        if isinstance(stop, Interrupted) or not workers.are_elsewhere:
            raise
        raise Interrupted(
            f"stopped after {count} of {len(tasks)} {what}. Go on with --resume.",
            signal.SIGINT,
        ) from None


def _compile_once(comparison: _Comparison) -> None:
    """Compile what is not in the cache yet, before several processes do so at once."""
    for method in comparison.methods:
        Odometry(
            comparison.models, method=method, options=comparison.options
        ).warm_up()


def _run_task(comparison: _Comparison, task: _Task) -> _Ran:
    """Run a method on a sequence; its results are in a folder of its own."""
    target = comparison.out / _folder(task.name) / task.method
    try:
        return _Ran(_run_method(comparison, task.open(), task.method, target))
    except HybridVOError:
        raise
    except Exception as error:
        # A bug of one method costs its own run only.
        _logger.exception("%s on %s", task.method, task.name)
        return _Ran(bug=f"{type(error).__name__}: {error}")


def _folder(name: str) -> str:
    """Return the folder of the runs on a sequence, in that of the comparison."""
    return f"{RUNS}/" + re.sub(r"[^\w.-]", "_", name)


def _score_all(
    comparison: _Comparison,
    openers: list[Callable[[], Sequence]],
    metrics: list[dict[str, Any]],
    quiet: bool,
) -> list[_Scored]:
    """Score the motions on all sequences, in their order."""
    tasks = [
        _Scoring(open_it, own)
        for open_it, own in zip(openers, metrics, strict=True)
    ]
    scored: dict[int, _Scored] = {}
    work = partial(_score, comparison)
    for done in _tracked(comparison, work, tasks, "scores", quiet):
        if done.lost:
            raise RuntimeError(f"scores of a sequence: {done.lost}")
        scored[done.number] = done.result
    return [scored[number] for number in range(len(tasks))]


def _score(comparison: _Comparison, task: _Scoring) -> _Scored:
    """Score the motions that all methods found on a sequence."""
    out = comparison.out
    options = comparison.options
    sequence = task.open()
    folder = _folder(sequence.name)
    motions = [
        _read_motions(out / folder / method, options.run.stride)
        for method in task.metrics
    ]
    _, flow_source = flow_provider(sequence, options)
    protocol = comparison.protocol
    keeps_all = protocol is None or protocol.scores_paths
    pairs, left_out = _score_pairs(sequence, motions, flow_source, keeps_all)
    truth = true_trajectory(sequence, frames_of(sequence, options))
    truth_file = None
    if truth is not None:
        truth_file = f"{folder}/ground_truth.tum"
        make_folder(out / folder)
        truth.save(out / truth_file)
    inputs = {"flow_source": flow_source, "depth_source": sequence.depth_source}
    rows = []
    protocol_rows = []
    for method, path in task.metrics.items():
        named = {"sequence": sequence.name, "method": method, **inputs}
        place = f"{folder}/{method}/trajectory.tum"
        if path is not None and truth is not None:
            estimate = read_trajectory(out / place)
            path = path | rpe_over_a_second(estimate, truth)
            if protocol is not None and protocol.scores_paths:
                given = _given(sequence.depth_source, named)
                line = named | {"inputs": given, "frames": len(sequence)}
                line |= score_path(protocol, estimate, truth)
                protocol_rows.append(line)
        row = scores.sequence_row(pairs[pairs["method"] == method], path, named)
        rows.append(row | {"trajectory": place})
    description = {
        "name": sequence.name,
        "path": str(sequence.root),
        **inputs,
        "pairs_scored": pairs["next"].nunique(),
        "left_out": left_out,
        "warnings": list(sequence.warnings),
        "ground_truth": truth_file,
    }
    return _Scored(pairs, rows, description, protocol_rows)


def _given(depth_source: str, line: Mapping[str, Any]) -> str:
    """State what a method is given, as published lines do.

    Args:
        depth_source: Where the depth comes from.
        line: ``method`` and ``flow_source``.
    """
    inputs = ["images", f"{depth_source} depth", "intrinsics"]
    if line["method"] not in baselines.WITHOUT_FLOW:
        inputs.append(f"{line['flow_source']} flow")
    return ", ".join(inputs)


def _run_method(
    comparison: _Comparison, sequence: Sequence, method: str, out: Path
) -> dict[str, Any] | None:
    """Run a method on a sequence; returns its metrics, None without ground truth."""
    options = comparison.options
    # However many motions fail, the comparison goes on.
    run_options = replace(options.run, method=method, max_failed=1.0)
    summary, _ = run(
        sequence,
        out,
        replace(options, run=run_options),
        models=comparison.models,
        mode="resume",
        command=comparison.command,
        quiet=comparison.quiet,
        picture=False,
    )
    return summary["metrics"]


def _read_motions(folder: Path, stride: int) -> pd.DataFrame:
    """Read the motions of a run, with the columns of a table of pairs."""
    texts = {"reason": str, "message": str}
    # pandas would expand a "~" in a name.
    with open(folder / "steps.csv", encoding="utf-8") as file:
        steps = pd.read_csv(file, dtype=texts)
    steps = steps[steps["prev_index"].notna()].fillna({"reason": "", "message": ""})
    missing = steps["reason"] == "missing_frame"
    steps.loc[missing, [*scores.ERRORS, "motion_ms", "flow_ms"]] = np.nan
    reasons = steps["reason"].map(lambda reason: f"({reason})" if reason else "")
    return steps.assign(
        method=folder.name,
        status=steps["status"] + reasons,
        ms=steps["motion_ms"],
        prev=steps["prev_index"].astype(int),
        next=steps["index"],
        index=steps["index"] - stride,
        missing=missing,
    )


def _score_pairs(
    sequence: Sequence,
    motions: list[pd.DataFrame],
    flow_source: str,
    keeps_all: bool,
) -> tuple[pd.DataFrame, list[dict[str, Any]]]:
    """Join the motions of all methods with what is known of the pairs.

    Args:
        sequence: The sequence.
        motions: Of each method, as :func:`_read_motions` returns them.
        flow_source: Its name.
        keeps_all: Whether pairs with changing intrinsics are scored.

    Returns:
        A table of :func:`scores.pair_table`, and the pairs that are left out, with the reason.
    """
    if motions:
        table = pd.concat(motions)
    else:
        table = pd.DataFrame(columns=["index", "next", "missing"])
    left_out = []
    known = []
    # Each pair is measured once, whichever methods estimated it.
    for row in table.drop_duplicates("next").itertuples():
        prev: Any = row.prev
        curr: Any = row.next
        if not keeps_all and not scores.same_intrinsics(
            sequence.camera(prev), sequence.camera(curr)
        ):
            left_out.append({"index": prev, "reason": "the intrinsics change"})
            table = table[table["next"] != curr]
        elif row.missing:
            reason = f"cannot be read: {row.message}"
            left_out.append({"index": curr, "reason": reason})
        else:
            factors = scores.pair_factors(sequence, prev, curr)
            known.append({"next": curr, **factors})
    factors_table = pd.DataFrame(known, columns=["next", *scores.FACTORS])
    table = table.merge(factors_table, "left", "next")
    table = table.assign(sequence=sequence.name, flow_source=flow_source)
    table = table.sort_values("index", kind="stable")
    return scores.pair_table(table), left_out


# -- the results -------------------------------------------------------------------------


def _result(
    comparison: _Comparison, scored: list[_Scored], pairs: pd.DataFrame
) -> dict[str, Any]:
    """Return the content of ``results.json``."""
    rows = [row for part in scored for row in part.rows]
    descriptions = [part.description for part in scored]
    totals = _totals(rows, pairs)
    protocol = _protocol_result(comparison, scored, totals)
    return {
        "command": comparison.command,
        **provenance(),
        "options": dataclasses.asdict(comparison.options),
        "weights": {
            name: weights_hash(name, comparison.models)
            for name in comparison.methods
        },
        "missing": comparison.missing,
        "rows": rows,
        "totals": totals,
        "sequences": descriptions,
        "protocol": protocol,
    }


def _protocol_result(
    comparison: _Comparison,
    scored: list[_Scored],
    totals: list[dict[str, Any]],
) -> dict[str, Any] | None:
    """Return what ``results.json`` states of the protocol."""
    protocol = comparison.protocol
    if protocol is None:
        return None
    if not protocol.scores_paths:
        descriptions = [part.description for part in scored]
        lines = [
            total | {"inputs": _given(total["depth_source"], total)}
            for total in totals
        ]
        return protocols.pairs_summary(protocol, descriptions, lines)
    rows = [row for part in scored for row in part.protocol_rows]
    return paths_summary(protocol, rows, comparison.left_out)


def _totals(
    rows: list[dict[str, Any]], pairs: pd.DataFrame
) -> list[dict[str, Any]]:
    """Return a line for each method and flow source, over all sequences."""
    totals = []
    groups = pairs.groupby(["method", "flow_source"], sort=False)
    for key, group in groups:
        own = [row for row in rows if (row["method"], row["flow_source"]) == key]
        totals.append(scores.total_row(group, own))
    return totals


def _write(out: Path, result: dict[str, Any], pairs: pd.DataFrame) -> list[str]:
    """Write what a finished comparison leaves beside its runs; returns the files."""
    write_json(out / "results.json", result)
    rows = pd.DataFrame(result["rows"], dtype=object)
    _write_csv(out / "results.csv", rows.drop(columns="reasons", errors="ignore"))
    _write_csv(out / "pairs.csv", pairs)
    left_out = write_report(out, result, pairs)
    return [str(out / name) for name in WRITTEN if name not in left_out]


def _write_csv(path: Path, table: pd.DataFrame) -> None:
    """Write a table as CSV."""
    with atomic_write(path) as file:
        table.to_csv(file, index=False, lineterminator="\n")
