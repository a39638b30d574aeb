"""From the kept segments to the files of a comparison, one sequence in memory at a time."""

from __future__ import annotations

import csv
import json
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Any

import numpy as np

from hybridvo.checks import make_folder
from hybridvo.comparison.job import Job, flow_label
from hybridvo.comparison.kept import check_segment
from hybridvo.comparison.scores import ChainedPath, sequence_row, total_row
from hybridvo.data.sequence import Sequence as FrameSequence
from hybridvo.errors import FormatError
from hybridvo.evaluation.breakdown import FACTORS, PairTable
from hybridvo.evaluation.report_data import one_line, plain_stem
from hybridvo.files import atomic_write
from hybridvo.run_results import true_trajectory
from hybridvo.trajectory import Trajectory, write_tum

__all__ = ["PAIR_COLUMNS", "ROW_COLUMNS", "Collected", "Segments", "collect", "file_stem"]

PAIR_COLUMNS = (
    *("sequence", "index", "method", "flow_source", "status"),
    *("epe_l2_px", "rot_err_deg", "trans_err", "ms"),
    *("r_err_deg", "t_err", "epe", "flow_ms", *FACTORS, "next", "message"),
)
ROW_COLUMNS = (
    *("sequence", "method", "flow_source", "depth_source", "pairs", "failed", "r_err_deg", "t_err"),
    *("epe", "epe_l2_px", "rot_err_deg_mean", "rot_err_deg_median", "trans_err_mean"),
    *("trans_err_median", "ate_rmse", "rpe_trans_rmse", "rpe_rot_rmse_deg", "alignment"),
    *("ms_per_pair_median", "dynamic_fraction"),
    *("pairs_scored", "pairs_scored_epe", "epe_l2_px_median", "failures", "failure_rate"),
    *("failure_rate_low", "failure_rate_high", "ate_rmse_sim3", "scale_sim3"),
    *("rpe_trans_rmse_sim3", "rpe_rot_rmse_deg_sim3", "ms_per_pair_p95", "flow_ms_median"),
    "ms_with_flow_median",
)


class Segments:
    """Kept segments, found by their job without holding them.

    ``done`` and ``T_last`` say by job how far it came and what its next segment starts from,
    ``failed`` counts the failed estimates.

    Args:
        path: file with a JSON mapping a line: ``job`` and what ``run_segment`` returned.
        jobs: of the comparison, which every line must fit.

    Raises:
        FormatError: a line that this comparison has not written.
    """

    def __init__(self, path: Path, jobs: Sequence[Job]) -> None:
        self._path = path
        self._places: dict[int, list[int]] = {}
        self.done: dict[int, int] = {}
        self.T_last: dict[int, dict[str, list[float]]] = {}
        self.failed = 0
        if not path.exists():
            return
        with path.open("rb") as file:
            place = 0
            for number, line in enumerate(file, start=1):
                segment = json.loads(line)
                try:
                    check_segment(segment, jobs, self.done)
                except (ValueError, OverflowError) as error:
                    raise FormatError(
                        f"{path}:{number}: not as this comparison wrote it: {error}. Pass "
                        f"--overwrite to start anew."
                    ) from None
                self.took(segment, place)
                place += len(line)

    def took(self, segment: Mapping[str, Any], place: int) -> None:
        """Note a segment that starts at byte ``place`` of the file."""
        job = int(segment["job"])
        self._places.setdefault(job, []).append(place)
        self.done[job] = int(segment["done"])
        self.T_last[job] = dict(segment["T_last"])
        self.failed += sum(
            result["status"].startswith("failed")
            for pair in segment["pairs"]
            for result in pair["results"]
        )

    def of(self, job: int) -> Iterator[dict[str, Any]]:
        """Segments of one job, in order."""
        if job not in self._places:
            return
        with self._path.open("rb") as file:
            for place in self._places[job]:
                file.seek(place)
                yield json.loads(file.readline())


def file_stem(number: int, name: str) -> str:
    """Beginning of the names of a sequence's files: unique, and plain on every file system."""
    return f"{number:03d}_{plain_stem(name)}"


@dataclass(frozen=True)
class Collected:
    """What a comparison found.

    Args:
        rows: lines of ``results.json``. totals: lines over all sequences. sequences: what they are.
        trajectories: TUM files: ``sequence``, ``method`` and ``flow_source`` (both None for the
            truth), ``path``. table: errors of all pairs.
    """

    rows: list[dict[str, Any]]
    totals: list[dict[str, Any]]
    sequences: list[dict[str, Any]]
    trajectories: list[dict[str, Any]]
    table: PairTable


def collect(
    out: Path, jobs: Sequence[Job], sequences: Iterable[FrameSequence], segments: Segments
) -> Collected:
    """Write ``pairs.csv`` and the trajectories; score everything.

    Raises:
        OutputError: a file cannot be written.
    """
    found = Collected([], [], [], [], PairTable())
    make_folder(out / "trajectories")
    with atomic_write(out / "pairs.csv") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(PAIR_COLUMNS)
        for number, (job, sequence) in enumerate(zip(jobs, sequences, strict=True)):
            _one(out, number, job, sequence, segments, found, file)
    by_group: dict[tuple[str, str], list[dict[str, Any]]] = {}
    for row in found.rows:
        by_group.setdefault((row["method"], row["flow_source"]), []).append(row)
    for group, rows in by_group.items():
        found.totals.append(total_row(found.table.columns(group), rows))
    return found


def _one(
    out: Path,
    number: int,
    job: Job,
    sequence: FrameSequence,
    segments: Segments,
    found: Collected,
    file: IO[Any],
) -> None:
    """Add what one sequence gave; its pairs go to the file."""
    table = found.table
    writer = csv.writer(file, lineterminator="\n")
    labels = {flow: flow_label(flow, sequence) for flow in job.flows}
    paths = {(flow, method): ChainedPath() for flow in job.flows for method in job.methods}
    left_out: list[dict[str, Any]] = []
    frames: dict[int, None] = {}
    pairs = 0
    before = {key: table.count((method, labels[flow])) for key in paths for flow, method in [key]}
    for segment in segments.of(number):
        left_out += segment["left_out"]
        for pair in segment["pairs"]:
            pairs += 1
            frames |= {pair["index"]: None, pair["next"]: None}
            shared = {name: pair[name] for name in (*FACTORS, "index", "next")}
            for result in pair["results"]:
                flow, method = result["flow"], result["method"]
                row = shared | result | {"sequence": job.name, "flow_source": labels[flow]}
                row["flow_ms"] = pair["flow_ms"][flow]
                row["message"] = one_line(result["message"])
                table.add(row)
                cells = (row.get(name) for name in PAIR_COLUMNS)
                writer.writerow([repr(c) if isinstance(c, float) else c for c in cells])
                T = np.array(result["T_curr_prev"]).reshape(4, 4)
                paths[flow, method].add(pair["index"], pair["next"], T)
    truth = true_trajectory(sequence, frames)
    torn = job.same_camera_only and any("intrinsics" in row["reason"] for row in left_out)
    stem = file_stem(number, job.name)

    def keep(trajectory: Trajectory, method: str | None, flow: str | None) -> None:
        path = f"trajectories/{stem}_{method or 'truth'}{f'_{flow}' if flow else ''}.tum"
        write_tum(trajectory, out / path)
        label = labels[flow] if flow else None
        named = {"sequence": job.name, "method": method, "flow_source": label, "path": path}
        found.trajectories.append(named)

    if truth is not None:
        keep(truth, None, None)
    for (flow, method), path in paths.items():
        est = path.trajectory(sequence.timestamps)
        if est is not None:
            keep(est, method, flow)
        columns = table.columns((method, labels[flow]), before[flow, method])
        named = {
            "sequence": job.name,
            "method": method,
            "flow_source": labels[flow],
            "depth_source": sequence.depth_source,
        }
        found.rows.append(sequence_row(columns, est, truth, named, torn))
    found.sequences.append(
        {
            "name": job.name,
            "kind": sequence.kind,
            "path": job.path,
            "frames": job.frames,
            "pairs": pairs,
            "left_out": left_out,
            "depth_source": sequence.depth_source,
            "flow_sources": list(labels.values()),
            "notices": [n.removeprefix(f"{sequence.name}: ") for n in sequence.warnings],
        }
    )
