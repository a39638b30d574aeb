"""The errors of a path as a protocol defines them, and their means over its sequences."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from hybridvo.core.errors import DegenerateError, InputError
from hybridvo.core.geometry import invert
from hybridvo.core.trajectory import Trajectory, read_trajectory
from hybridvo.io.data.open import open_sequence
from hybridvo.io.data.truth import true_trajectory
from hybridvo_lab.evaluation import scores
from hybridvo_lab.evaluation.metrics import (
    MIN_MATCHED_RATIO,
    Match,
    RelativeErrors,
    ate,
    errors_between,
    match,
    rms,
    rpe,
)
from hybridvo_lab.evaluation.protocols import (
    Protocol,
    check_protocol,
    choose,
    match_stamps,
    missing_sequences,
    prepare,
    published_truth,
)

STILL_M = 1e-6
"""Extent of a true path below which the camera stands still, metres."""
FIGURES = ("ate", "rpe_t", "rpe_r")
"""Absolute error, and relative errors of translation and rotation (degrees)."""


# -- one path ----------------------------------------------------------------------------


def evaluate_path(
    protocol: str, estimate: str | Path, gt: str | Path
) -> dict[str, Any]:
    """Compute the errors of a path in a file as a protocol defines them; JSON-ready.

    Args:
        protocol: One of ``protocols.yaml`` that scores paths.
        estimate: The file of the path.
        gt: A sequence of the protocol, or the file of its true path as it is published: Bonn's
            is corrected here.

    Returns:
        What ``score_path`` returns, with ``protocol``, its ``columns`` and ``warnings``.

    Raises:
        InputError: A file cannot be read, or the sequence is not of the protocol.
    """
    rules = check_protocol(protocol)
    if not rules.scores_paths:
        raise InputError(
            f"--protocol {protocol} scores pairs with depth: use hybridvo compare."
        )
    path = read_trajectory(estimate)
    warnings = list(path.warnings)
    if Path(gt).is_dir():
        sequence = open_sequence(gt)
        choose(rules, [sequence], is_named=True)
        sequence = prepare(rules, sequence)
        truth = true_trajectory(sequence, range(len(sequence)))
        if truth is None:
            raise InputError(f"{gt}: {scores.NO_TRUTH}.")
        warnings += sequence.warnings
        if len(path) < len(truth):
            warnings.append(
                f"{len(path)} of {len(truth)} frames have a pose: a path of keyframes "
                "does not compare with one of all frames"
            )
    else:
        truth = published_truth(rules, read_trajectory(gt))
        warnings.append(
            "the file does not state whether this is a sequence of the protocol, "
            "and which of its frames; name the sequence's folder to check"
        )
    report = score_path(rules, path, truth)
    return report | {
        "protocol": rules.name,
        "title": rules.title,
        "columns": [list(column) for column in rules.columns],
        "alignment": rules.alignment,
        "warnings": warnings,
    }


def score_path(
    protocol: Protocol, estimate: Trajectory, truth: Trajectory
) -> dict[str, Any]:
    """Compute the errors of a path as a protocol defines them; JSON-ready.

    Args:
        protocol: A protocol that scores paths.
        estimate: The estimated path.
        truth: The true one, of the camera.

    Returns:
        ``ate``, ``rpe_t`` and ``rpe_r`` (degrees), in the protocol's units; None where they
        cannot be computed, and ``reasons`` states why. ``matched`` of ``total`` true poses,
        ``scale`` of the alignment.

    Example:
        >>> from hybridvo_lab.evaluation.protocols import check_protocol
        >>> poses = np.tile(np.eye(4), (3, 1, 1))
        >>> poses[:, :3, 3] = [[0, 0, 0], [1, 0, 0], [1, 1, 0]]
        >>> path = Trajectory(np.arange(3), poses)
        >>> round(score_path(check_protocol("sintel14"), path, path)["ate"], 9)
        0.0
    """
    matched = match_paths(protocol, estimate, truth)
    values: dict[str, Any] = dict.fromkeys((*FIGURES, "scale"))
    reasons: dict[str, str] = {}
    try:
        if matched.reason:
            raise DegenerateError(matched.reason)
        values |= _aligned_errors(protocol, matched)
    except DegenerateError as error:
        reasons = dict.fromkeys(_figures_of(protocol), str(error))
    return values | {
        "matched": len(matched.est),
        "total": len(truth),
        "reasons": reasons,
    }


def _figures_of(protocol: Protocol) -> tuple[str, ...]:
    """Return the figures that a protocol defines."""
    return FIGURES[:1] if protocol.rpe == "none" else FIGURES


def match_paths(
    protocol: Protocol, estimate: Trajectory, truth: Trajectory
) -> Match:
    """Match the poses of an estimate and of the ground truth as a protocol does."""
    has_times = estimate.has_timestamps and truth.has_timestamps
    if protocol.max_difference_s is None or not has_times:
        return match(estimate, truth)
    pairs = match_stamps(protocol, estimate.timestamps, truth.timestamps)
    places = np.array(pairs, dtype=int).reshape(-1, 2)
    i = places[:, 0]
    j = places[:, 1]
    reason = ""
    if len(pairs) < MIN_MATCHED_RATIO * len(estimate):
        reason = (
            f"only {len(pairs)} of {len(estimate)} poses match within "
            f"{protocol.max_difference_s:g} s"
        )
    est = estimate.T_world_cam[i]
    # the nearest true pose may be that of two images: their own stamps increase
    return Match(est, truth.T_world_cam[j], estimate.timestamps[i], "time", reason)


def _aligned_errors(protocol: Protocol, matched: Match) -> dict[str, Any]:
    """Compute the errors after the protocol's alignment.

    Raises:
        DegenerateError: The camera stands still, or the poses determine no alignment.
    """
    matched = in_units_of(protocol, matched)
    error = ate(matched, protocol.alignment)
    # a rigid alignment leaves motions as they are; a scale does not
    scaled = matched._replace(est=_with_lengths(matched.est, error.scale))
    values = {"ate": error.rmse, "scale": error.scale}
    if protocol.rpe == "none":
        return values
    if protocol.rpe == "inverse":
        relative = inverse_rpe(scaled)
    elif protocol.rpe == "s":
        relative = rpe(scaled, 1.0, "s")
    else:
        relative = rpe(scaled)
    values["rpe_t"] = rms(relative.translation)
    values["rpe_r"] = rms(relative.rotation_deg)
    return values


def in_units_of(protocol: Protocol, matched: Match) -> Match:
    """Return matched poses with the true lengths in the protocol's unit.

    Raises:
        DegenerateError: The true camera stands still, or ends where it started.
    """
    gt = matched.gt
    extent = np.linalg.norm(gt[:, :3, 3] - gt[0, :3, 3], axis=1).max()
    if extent < STILL_M:
        raise DegenerateError(
            "the true camera stands still: no alignment is determined"
        )
    if not protocol.divided:
        return matched
    last_to_first = invert(gt[-1]) @ gt[0]
    length = float(np.linalg.norm(last_to_first[:3, 3]))
    if length < STILL_M:
        raise DegenerateError(
            "the true camera ends where it started: that distance is the unit of lengths"
        )
    unit = length + protocol.added_length
    return matched._replace(gt=_with_lengths(gt, 1 / unit))


def _with_lengths(T: np.ndarray, factor: float) -> np.ndarray:
    """Return poses (N, 4, 4) with their translations in another unit."""
    scaled = T.copy()
    scaled[:, :3, 3] *= factor
    return scaled


def inverse_rpe(matched: Match) -> RelativeErrors:
    """Compute relative errors of neighbours as inv(est_j^-1 est_i) (gt_j^-1 gt_i), j = i + 1.

    The angle is that of the usual order. The translation differs from it where rotations err.
    """
    last = np.arange(len(matched.est) - 1)
    return errors_between(matched, last + 1, last)


# -- all sequences of a protocol ---------------------------------------------------------


def total_rows(
    protocol: Protocol, rows: Sequence[dict[str, Any]]
) -> list[dict[str, Any]]:
    """Return a line for each method and source of flow: what stands beside published lines.

    A mean is that of all sequences of the protocol. Where one is missing, is not complete or
    has no figure, there is no mean, and ``reasons`` states why.

    Args:
        protocol: The protocol.
        rows: Of each sequence and method: ``sequence``, ``method``, ``flow_source``,
            ``inputs``, ``frames`` and what :func:`score_path` returns.
    """
    keys = [(row["method"], row["flow_source"]) for row in rows]
    totals = []
    for key in dict.fromkeys(keys):
        own = [row for row, other in zip(rows, keys, strict=True) if other == key]
        totals.append(_total_row(protocol, own))
    return totals


def _total_row(protocol: Protocol, rows: list[dict[str, Any]]) -> dict[str, Any]:
    """Return the line of one method."""
    first = rows[0]
    total: dict[str, Any] = {
        "method": first["method"],
        "name": first["method"],
        "flow_source": first["flow_source"],
        "inputs": ", ".join(dict.fromkeys(row["inputs"] for row in rows)),
        "sequences": len(rows),
        "reasons": {},
    }
    if protocol.by_sequence:
        for name, short in protocol.by_sequence.items():
            own = [row for row in rows if row["sequence"] == name]
            for figure in _figures_of(protocol):
                _add(total, f"{figure}_{short}", figure, own, _absent(own, name))
        return total
    absent = _incomplete(protocol, rows)
    for figure in _figures_of(protocol):
        _add(total, figure, figure, rows, absent)
    return total


def _absent(rows: list[dict[str, Any]], name: str) -> list[str]:
    """State that a sequence is missing."""
    return [] if rows else [f"{name} is missing"]


def _incomplete(protocol: Protocol, rows: list[dict[str, Any]]) -> list[str]:
    """State which sequences are missing, and which do not have all of their frames."""
    missing = missing_sequences(protocol, [row["sequence"] for row in rows])
    texts = []
    if missing:
        texts.append(f"missing: {', '.join(missing)}")
    for row in rows:
        complete = protocol.sequences[row["sequence"]]
        if complete is not None and row["frames"] != complete:
            texts.append(f"{row['sequence']}: {row['frames']} of {complete} frames")
    return texts


def _add(
    total: dict[str, Any],
    key: str,
    figure: str,
    rows: list[dict[str, Any]],
    absent: list[str],
) -> None:
    """Add the mean of a figure over sequences; None and a reason where one has none."""
    problems = [
        *absent,
        *(
            f"{row['sequence']}: {row['reasons'].get(figure, 'unknown')}"
            for row in rows
            if row[figure] is None
        ),
    ]
    total[key] = None
    if problems:
        total["reasons"][key] = f"no mean: {'; '.join(problems)}"
    else:
        total[key] = float(np.mean([row[figure] for row in rows]))


def paths_summary(
    protocol: Protocol, rows: list[dict[str, Any]], left_out: Iterable[str]
) -> dict[str, Any]:
    """Return what ``results.json`` states of a protocol that scores paths.

    Args:
        protocol: The protocol.
        rows: As in :func:`total_rows`.
        left_out: Names of sequences in the given folders that are not of the protocol.
    """
    there = dict.fromkeys(row["sequence"] for row in rows)
    missing = missing_sequences(protocol, there)
    others = list(left_out)
    notes = [f"{len(there)} of {len(protocol.sequences)} sequences"]
    if missing:
        notes.append(f"missing: {', '.join(missing)}")
    if others:
        notes.append(f"not of the protocol, and left out: {', '.join(others)}")
    return asdict(protocol) | {
        "note": "; ".join(notes),
        "missing_sequences": missing,
        "rows": rows,
        "totals": total_rows(protocol, rows),
    }
