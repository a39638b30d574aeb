"""How camera motion is scored on MPI Sintel elsewhere, and what was published there.

``paper``: the 992 of 1041 pairs whose intrinsics do not change, R_err, T_err and EPE at 128x256 as
in PWVO's published code. ``all``: the same on all 1041 pairs, each frame with its own camera.
``trajectory14``: the trajectories of the fourteen sequences of ParticleSfM, LEAP-VO, MonST3R and
CUT3R: ATE and RPE over one frame, plain means over the sequences, after a similarity (theirs) and
after a rigid alignment (for methods that know metres).

Published figures are what others wrote, not what was measured here; each names its source.
``results.json`` holds under ``protocol`` what :func:`protocol_summary` returns.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from hybridvo.errors import InputError
from hybridvo.types import Camera

__all__ = [
    "PROTOCOLS",
    "SINTEL_FRAMES",
    "Metric",
    "Protocol",
    "Published",
    "check_protocol",
    "protocol_summary",
    "same_intrinsics",
]

SINTEL_FRAMES: Mapping[str, int] = {
    **{"alley_1": 50, "alley_2": 50, "ambush_2": 21, "ambush_4": 33, "ambush_5": 50},
    **{"ambush_6": 20, "ambush_7": 50, "bamboo_1": 50, "bamboo_2": 50, "bandage_1": 50},
    **{"bandage_2": 50, "cave_2": 50, "cave_4": 50, "market_2": 50, "market_5": 50},
    **{"market_6": 40, "mountain_1": 50, "shaman_2": 50, "shaman_3": 50, "sleeping_1": 50},
    **{"sleeping_2": 50, "temple_2": 50, "temple_3": 50},
}
"""Frames of the 23 training sequences: 1064, thus 1041 pairs."""

_FOURTEEN = (
    *("alley_2", "ambush_4", "ambush_5", "ambush_6", "cave_2", "cave_4", "market_2", "market_5"),
    *("market_6", "shaman_3", "sleeping_1", "sleeping_2", "temple_2", "temple_3"),
)
_SAME_FOCAL = 1e-9  # relative; unchanged cameras are stored with the same bytes


@dataclass(frozen=True)
class Metric:
    """A column: key in rows and published figures, label, unit (empty for none)."""

    key: str
    label: str
    unit: str


@dataclass(frozen=True)
class Published:
    """A line of somebody's table.

    Args:
        name: what the authors call it. values: metric key -> figure.
        source: where it was read. inputs: what the method was given.
        method: our name of the same method, or empty. note: what differs, or empty.
    """

    name: str
    values: Mapping[str, float]
    source: str
    inputs: str
    method: str = ""
    note: str = ""


@dataclass(frozen=True)
class Protocol:
    """A way of scoring.

    Args:
        name: option value. title: for people. sequences: names that belong to it.
        pairs: number of pairs of the complete set. same_camera_only: whether pairs whose
            intrinsics change are left out. metrics: columns. over: ``pairs`` or ``sequences``:
            what the means are taken over. published: lines of others.
    """

    name: str
    title: str
    sequences: tuple[str, ...]
    pairs: int
    same_camera_only: bool
    metrics: tuple[Metric, ...]
    over: str
    published: tuple[Published, ...]


_PAPER_METRICS = (
    Metric("epe", "EPE (component mean, 128x256)", "px"),
    Metric("r_err_deg", "R_err (Euler)", "deg"),
    Metric("t_err", "T_err", "m"),
)
_TRAJECTORY_METRICS = (
    Metric("ate_rmse_sim3", "ATE, Sim(3)", "m"),
    Metric("rpe_trans_rmse_sim3", "RPE-t, Sim(3)", "m"),
    Metric("rpe_rot_rmse_deg_sim3", "RPE-r, Sim(3)", "deg"),
    Metric("ate_rmse", "ATE, SE(3)", "m"),
    Metric("rpe_trans_rmse", "RPE-t, SE(3)", "m"),
    Metric("rpe_rot_rmse_deg", "RPE-r, SE(3)", "deg"),
)


def _paper(name: str, epe: float, r_err: float, t_err: float, method: str, note: str) -> Published:
    return Published(
        name,
        {"epe": epe, "r_err_deg": r_err, "t_err": t_err},
        "PWVO paper, " + ("Table 2" if "ablation" in note else "Table 1"),
        "true flow, true depth of both frames",
        method,
        note,
    )


def _paper_lines(note: str) -> tuple[Published, ...]:
    also = f"; {note}" if note else ""
    return (
        _paper("VONet", 0.909, 0.110, 0.061, "vonet", note),
        _paper("VONet + self-att.", 0.894, 0.117, 0.076, "vonet-attention", note),
        _paper("pixel-wise", 1.07, 0.106, 0.055, "pixelwise", f"ablation{also}"),
        _paper("PWVO (naive)", 0.829, 0.091, 0.061, "pwvo-naive", note),
        _paper("PWVO, U^D and U^F, no selection", 0.766, 0.087, 0.062, "", f"ablation{also}"),
        _paper("PWVO", 0.626, 0.081, 0.043, "pwvo", note),
    )


def _path(
    name: str, ate: float, trans: float, rot: float, source: str, note: str = ""
) -> Published:
    values = (ate, trans, rot)
    keys = [metric.key for metric in _TRAJECTORY_METRICS[:3]]
    return Published(name, dict(zip(keys, values, strict=True)), source, "images", "", note)


_CUT3R = "CUT3R paper"
_D4RT = "D4RT paper, Table 6, from transcriptions"
_CALIBRATED = "true intrinsics"
_LITERATURE = (
    _path("DROID-SLAM", 0.175, 0.084, 1.912, _CUT3R, _CALIBRATED),
    _path("DPVO", 0.115, 0.072, 1.975, _CUT3R, _CALIBRATED),
    _path("LEAP-VO", 0.089, 0.066, 1.250, _CUT3R, _CALIBRATED),
    _path("ParticleSfM", 0.129, 0.031, 0.535, _CUT3R, "offline"),
    _path(
        "ParticleSfM + GLOMAP", 0.057, 0.031, 0.201, "ParticleSfM README, 2025-02", "13 sequences"
    ),
    _path("Robust-CVD", 0.360, 0.154, 3.443, _CUT3R),
    _path("CasualSAM", 0.141, 0.035, 0.615, _CUT3R),
    _path("DUSt3R with global alignment", 0.417, 0.250, 5.796, _CUT3R, "no intrinsics"),
    _path("MASt3R with global alignment", 0.185, 0.060, 1.496, _CUT3R),
    _path("MonST3R with global alignment", 0.111, 0.044, 0.869, _CUT3R),
    _path("Spann3R", 0.329, 0.110, 4.471, _CUT3R, "online"),
    _path("CUT3R", 0.213, 0.066, 0.621, _CUT3R, "online"),
    _path("VGGT", 0.168, 0.056, 0.428, _D4RT),
    _path("MegaSaM", 0.074, 0.030, 0.126, _D4RT),
    _path("D4RT", 0.065, 0.024, 0.126, _D4RT),
)

_ALL_PAIRS = sum(SINTEL_FRAMES.values()) - len(SINTEL_FRAMES)
PROTOCOLS: Mapping[str, Protocol] = {
    protocol.name: protocol
    for protocol in (
        Protocol(
            "paper",
            "PWVO's: pairs of Sintel with unchanged intrinsics, means over pairs",
            tuple(SINTEL_FRAMES),
            992,
            True,
            _PAPER_METRICS,
            "pairs",
            _paper_lines(""),
        ),
        Protocol(
            "all",
            "all pairs of Sintel, a camera per frame, means over pairs",
            tuple(SINTEL_FRAMES),
            _ALL_PAIRS,
            False,
            _PAPER_METRICS,
            "pairs",
            _paper_lines("on the 992 pairs of the paper, not on all"),
        ),
        Protocol(
            "trajectory14",
            "trajectories of fourteen sequences of Sintel, means over sequences",
            _FOURTEEN,
            sum(SINTEL_FRAMES[name] - 1 for name in _FOURTEEN),
            False,
            _TRAJECTORY_METRICS,
            "sequences",
            _LITERATURE,
        ),
    )
}
"""Option value of ``--protocol`` -> protocol."""


def same_intrinsics(first: Camera, second: Camera) -> bool:
    """Whether two cameras are one: the pairs that the paper keeps."""
    pairs = ((getattr(c, n) for c in (first, second)) for n in ("fx", "fy", "cx", "cy"))
    return first.shape == second.shape and all(
        abs(a - b) <= _SAME_FOCAL * first.fx for a, b in pairs
    )


def check_protocol(name: str, sequences: Iterable[tuple[str, str]]) -> Protocol:
    """Protocol of this name, for these sequences.

    Args:
        name: key of :data:`PROTOCOLS`.
        sequences: (name, kind) of each sequence.

    Raises:
        InputError: an unknown protocol; a sequence that is not one of Sintel's.
    """
    if name not in PROTOCOLS:
        raise InputError(f"protocol: '{name}' is unknown; known: {', '.join(PROTOCOLS)}.")
    for sequence, kind in sequences:
        if kind != "sintel" or sequence not in SINTEL_FRAMES:
            raise InputError(
                f"--protocol {name}: '{sequence}' ({kind}) is none of the {len(SINTEL_FRAMES)} "
                f"training sequences of MPI Sintel. Pass the folder 'training' of the data set, or "
                f"leave --protocol out."
            )
    return PROTOCOLS[name]


def protocol_summary(
    protocol: Protocol,
    totals: Sequence[Mapping[str, Any]],
    sequences: Sequence[Mapping[str, Any]],
) -> dict[str, Any]:
    """What stands under ``protocol`` in ``results.json``.

    Args:
        protocol: which one.
        totals: a line per method and flow source over all sequences, with the metrics of the
            protocol, ``pairs``, ``sequences`` and ``reasons``.
        sequences: ``name`` and ``pairs`` of each sequence that took part.

    Returns:
        ``name``, ``title``, ``over``; ``metrics`` (``key``, ``label``, ``unit``);
        ``complete`` (every sequence is there, with every pair), ``note`` (what is missing, or
        empty), ``sequences``, ``missing_sequences``, ``pairs``, ``pairs_expected``; ``table``: a
        line per method and flow source, its metrics and, under ``published``, the authors' own
        line of the same method, or null; ``published``: all lines of others with ``name``,
        ``method``, ``source``, ``inputs``, ``note`` and the metrics they give.
    """
    present = [str(sequence["name"]) for sequence in sequences]
    absent = [name for name in protocol.sequences if name not in present]
    pairs = sum(int(sequence["pairs"]) for sequence in sequences)
    notes = []
    if absent:
        notes.append(
            f"{len(absent)} of {len(protocol.sequences)} sequences are missing: {', '.join(absent)}"
        )
    if pairs != protocol.pairs:
        notes.append(f"{pairs} pairs, the complete set has {protocol.pairs}")
    if notes:
        notes.append("these figures and the published ones are not over the same pairs")
    published = [
        {
            "name": line.name,
            "method": line.method or None,
            "source": line.source,
            "inputs": line.inputs,
            "note": line.note,
            **line.values,
        }
        for line in protocol.published
    ]
    by_method = {line["method"]: line for line in published if line["method"]}
    keys = [metric.key for metric in protocol.metrics]
    table = [
        {
            **{name: row.get(name) for name in ("method", "flow_source", "depth_source")},
            **{name: row.get(name) for name in ("pairs", "failed", "sequences", *keys)},
            "reasons": {key: row["reasons"][key] for key in keys if key in row["reasons"]},
            "published": by_method.get(row["method"]),
        }
        for row in totals
    ]
    return {
        "name": protocol.name,
        "title": protocol.title,
        "over": protocol.over,
        "metrics": [vars(metric) for metric in protocol.metrics],
        "complete": not notes,
        "note": "; ".join(notes),
        "sequences": present,
        "missing_sequences": absent,
        "pairs": pairs,
        "pairs_expected": protocol.pairs,
        "table": table,
        "published": published,
    }
