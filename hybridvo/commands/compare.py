"""``hybridvo compare``: methods side by side, each as a ``hybridvo run``."""

from __future__ import annotations

import contextlib
import dataclasses
import logging
import os
import re
import shutil
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, Literal

import numpy as np
import pandas as pd

from hybridvo.commands.run import flow_provider, frames_of, run, weights_hash
from hybridvo.data.open import open_sequence
from hybridvo.data.sequence import Sequence
from hybridvo.errors import HybridVOError, InputError, OutputError
from hybridvo.evaluation import scores
from hybridvo.evaluation.report import write_report
from hybridvo.files import (
    Mode,
    atomic_write,
    locked_folder,
    make_folder,
    provenance,
    write_json,
)
from hybridvo.network.models import Models
from hybridvo.options import Options
from hybridvo.pipeline import METHODS, check_method
from hybridvo.trajectory import Trajectory

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


@dataclass(frozen=True)
class _Comparison:
    """What all runs of a comparison share."""

    out: Path
    methods: tuple[str, ...]
    options: Options
    models: Models
    protocol: str | None
    command: list[str]
    quiet: bool
    missing: dict[str, str]  # methods that did not run, and why; grows


@dataclass(frozen=True)
class _Scored:
    """The results of all methods on one sequence."""

    pairs: pd.DataFrame  # as in scores.pair_table
    rows: list[dict[str, Any]]  # a line of results.csv for each method
    description: dict[str, Any]  # what results.json says of the sequence


def compare(
    sequences: Iterable[str | Path],
    out: str | Path,
    *,
    methods: Iterable[str] = ("all",),
    options: Options | None = None,
    dataset: str | None = None,
    camera: str | None = None,
    depth_scale: float | None = None,
    mask: str | None = None,
    chosen: Mapping[str, Any] | None = None,
    protocol: Literal["paper"] | None = None,
    models: Models | None = None,
    mode: Mode = "new",
    command: Iterable[str] = (),
    quiet: bool = True,
) -> dict[str, Any]:
    """Run every method on every sequence, and write tables and a report.

    Args:
        sequences: Folders of sequences; a folder may also hold several sequences.
        out: The output folder.
        methods: Names of methods; ``all`` stands for every method that can run here.
        options: The options of all runs.
        dataset: As in ``open_sequence``, for all sequences.
        camera: Likewise.
        depth_scale: Likewise.
        mask: Likewise.
        chosen: Its keyword arguments, such as the topics of a bag, likewise.
        protocol: ``paper`` scores MPI Sintel as PWVO's paper does.
        models: The networks; by default the pretrained ones.
        mode: What happens to results that are there already.
        command: The words of the command line, which are kept with the results.
        quiet: Whether no progress is shown.

    Returns:
        A summary, JSON-ready: ``totals``, ``missing`` and ``files``.

    Raises:
        InputError: A sequence or a method cannot be used, or the folder holds results.
        OutputError: A result cannot be written.
    """
    out = Path(out)
    options = options or Options()
    models = models or Models(options.run.device)
    names, missing = methods_to_run(methods)
    open_one = partial(
        open_sequence,
        dataset=dataset,
        camera=camera,
        depth_scale=depth_scale,
        mask=mask,
        **(chosen or {}),
    )
    opened = _open_each(sequences, options, open_one)
    if protocol is not None:
        scores.check_protocol(opened)
    if mode == "new":
        _refuse_results(out)
    comparison = _Comparison(
        out, names, options, models, protocol, list(command), quiet, missing
    )
    with locked_folder(out):
        if mode == "overwrite":
            _remove_runs(out)
        for name, reason in missing.items():
            _logger.warning("not run: %s: %s", name, reason)
        scored = [_score(comparison, sequence) for sequence in opened]
        pairs = scores.pair_table(
            [pair for part in scored for pair in part.pairs.to_dict("records")]
        )
        result = _result(comparison, scored, pairs)
        files = _write(out, result, pairs)
    if not result["rows"]:
        raise RuntimeError(f"every method failed; {out / 'results.json'} says how.")
    return {
        "totals": result["totals"],
        "missing": missing,
        "files": files,
    }


def _refuse_results(out: Path) -> None:
    """Raise an InputError where a folder holds results of a comparison."""
    present = [name for name in (*WRITTEN, RUNS) if (out / name).exists()]
    if present:
        choices = "--resume to go on, --overwrite to replace them, or another --out"
        raise InputError(f"{out}: holds {', '.join(present)}; pass {choices}.")


def _remove_runs(out: Path) -> None:
    """Delete the runs of an earlier comparison."""
    runs = out / RUNS
    shutil.rmtree(runs, ignore_errors=True)
    if os.path.lexists(runs):
        raise OutputError(f"{runs}: cannot be replaced.")


# -- which methods, which sequences ------------------------------------------------------


def methods_to_run(names: Iterable[str]) -> tuple[tuple[str, ...], dict[str, str]]:
    """Check the names of methods.

    Args:
        names: The names; ``all`` alone stands for every method.

    Returns:
        The methods to run, and why ``all`` leaves some out, with the remedy.

    Raises:
        InputError: A method that was named cannot run here.
    """
    given = list(names)
    is_all = given == ["all"]
    missing: dict[str, str] = {}
    ready: list[str] = []
    for name in METHODS if is_all else given:
        try:
            method = check_method(name)
        except InputError as error:
            if not is_all:
                raise
            missing[name] = str(error)
        else:
            if method not in ready:
                ready.append(method)
    return tuple(ready), missing


def open_all(path: str | Path, open_one: Opener = open_sequence) -> list[Sequence]:
    """Open the sequence in a folder, or all sequences one level below it.

    Of MPI Sintel as it was unpacked, those are the scenes of the final pass, else of the clean one.

    Args:
        path: The folder.
        open_one: Opens one sequence.

    Raises:
        HybridVOError: The folder is no sequence and holds none.
    """
    try:
        return [open_one(path)]
    except HybridVOError:
        sequences = list(_open_below(Path(path), open_one))
        if not sequences:
            raise
        return sequences


def _open_below(folder: Path, open_one: Opener) -> Iterator[Sequence]:
    """Open the sequences in a folder, and skip what is none."""
    if (folder / "training").is_dir():
        folder = folder / "training"
    for name in ("final", "clean"):
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
    paths: Iterable[str | Path], options: Options, open_one: Opener
) -> list[Sequence]:
    """Open all sequences, give each a name of its own, and refuse at once what cannot be run."""
    opened: list[Sequence] = []
    for path in paths:
        for sequence in open_all(path, open_one):
            frames_of(sequence, options, at_least=2)
            flow_provider(sequence, options)
            used = {other.name for other in opened}
            sequence.name = _unused_name(sequence.name, used)
            opened.append(sequence)
    if not opened:
        raise InputError(
            "compare: expected at least one folder of a sequence, got none."
        )
    return opened


def _unused_name(name: str, used: set[str]) -> str:
    """Return a name, with a number behind it if it is used already."""
    count = 1
    unused = name
    while unused in used:
        count += 1
        unused = f"{name}_{count}"
    return unused


# -- the runs and their scores -----------------------------------------------------------


def _score(comparison: _Comparison, sequence: Sequence) -> _Scored:
    """Run all methods on a sequence and score their motions."""
    out = comparison.out
    options = comparison.options
    folder = f"{RUNS}/" + re.sub(r"[^\w.-]", "_", sequence.name)
    metrics: dict[str, Any] = {}
    motions = []
    for method in comparison.methods:
        target = out / folder / method
        try:
            metrics[method] = _run_method(comparison, sequence, method, target)
            motions.append(_read_motions(target, options.run.stride))
        except HybridVOError:
            raise
        except Exception as error:
            # A bug of one method costs its own run only.
            name = f"{method} on {sequence.name}"
            comparison.missing[name] = f"{type(error).__name__}: {error}"
            _logger.exception("%s on %s", method, sequence.name)
    _, flow_source = flow_provider(sequence, options)
    pairs, left_out = _score_pairs(
        sequence, motions, flow_source, comparison.protocol
    )
    truth = scores.true_trajectory(sequence, frames_of(sequence, options))
    truth_file = None
    if truth is not None:
        truth_file = f"{folder}/ground_truth.tum"
        _save(truth, out / truth_file)
    inputs = {"flow_source": flow_source, "depth_source": sequence.depth_source}
    rows = []
    for method, path in metrics.items():
        named = {"sequence": sequence.name, "method": method, **inputs}
        row = scores.sequence_row(pairs[pairs["method"] == method], path, named)
        rows.append(row | {"trajectory": f"{folder}/{method}/trajectory.tum"})
    description = {
        "name": sequence.name,
        "path": str(sequence.root),
        **inputs,
        "pairs_scored": pairs["next"].nunique(),
        "left_out": left_out,
        "warnings": list(sequence.warnings),
        "ground_truth": truth_file,
    }
    return _Scored(pairs, rows, description)


def _save(trajectory: Trajectory, path: Path) -> None:
    """Save a trajectory in a folder that need not be there."""
    make_folder(path.parent)
    trajectory.save(path)


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
    protocol: str | None,
) -> tuple[pd.DataFrame, list[dict[str, Any]]]:
    """Join the motions of all methods with what is known of the pairs.

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
        if protocol is not None and not _has_same_camera(sequence, prev, curr):
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


def _has_same_camera(sequence: Sequence, prev: int, curr: int) -> bool:
    """Return whether two frames have the same intrinsics."""
    return scores.same_intrinsics(sequence.camera(prev), sequence.camera(curr))


# -- the results -------------------------------------------------------------------------


def _result(
    comparison: _Comparison, scored: list[_Scored], pairs: pd.DataFrame
) -> dict[str, Any]:
    """Return the content of ``results.json``."""
    rows = [row for part in scored for row in part.rows]
    descriptions = [part.description for part in scored]
    protocol = None
    if comparison.protocol is not None:
        protocol = scores.protocol_summary(descriptions)
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
        "totals": _totals(rows, pairs),
        "sequences": descriptions,
        "protocol": protocol,
    }


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
