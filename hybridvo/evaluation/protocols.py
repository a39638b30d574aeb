"""Ways of scoring MPI Sintel that published tables use; ``protocols.yaml`` holds them."""

from __future__ import annotations

import functools
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import yaml

from hybridvo.errors import InputError
from hybridvo.options import RunOptions
from hybridvo.types import Camera


@dataclass(frozen=True)
class Protocol:
    """A way of scoring: its complete set, its columns, and the lines that others published.

    ``sequences`` maps names to frames; ``same_camera_only``: pairs whose intrinsics change do not
    count; ``over``: what the means are taken over, ``pairs`` or ``sequences``.
    """

    name: str
    title: str
    sequences: Mapping[str, int]
    pairs: int
    same_camera_only: bool
    metrics: Sequence[Mapping[str, str]]
    over: str
    published: Sequence[Mapping[str, Any]]


@functools.cache
def protocols() -> dict[str, Protocol]:
    """Option value of ``--protocol`` -> protocol."""
    text = (Path(__file__).parent / "protocols.yaml").read_text(encoding="utf-8")
    content = yaml.safe_load(text)
    frames, found = content["frames"], {}
    for name, fields in content["protocols"].items():
        names = fields.pop("sequences")
        sequences = frames if names == "all" else {key: frames[key] for key in names}
        found[name] = Protocol(name=name, sequences=sequences, **fields)
    return found


def same_intrinsics(first: Camera, second: Camera) -> bool:
    """Whether two cameras are one: the pairs that the paper keeps."""
    pairs = ((getattr(c, n) for c in (first, second)) for n in ("fx", "fy", "cx", "cy"))
    return first.shape == second.shape and all(abs(a - b) <= 1e-9 * first.fx for a, b in pairs)


def check_protocol(
    name: str, sequences: Sequence[Any], run: RunOptions
) -> tuple[Protocol, list[Any]]:
    """Protocol of this name, and those of the open sequences that it scores."""
    known = protocols()
    if name not in known:
        raise InputError(f"protocol: '{name}' is unknown; known: {', '.join(known)}.")
    if run.stride != 1 or run.start or run.stop is not None:
        raise InputError(
            f"--protocol {name} is defined on whole sequences: leave out --start, --stop and "
            f"--stride."
        )
    for sequence in sequences:
        if sequence.kind != "sintel" or sequence.name not in known["paper"].sequences:
            raise InputError(
                f"--protocol {name}: '{sequence.name}' ({sequence.kind}) is none of the training "
                f"sequences of MPI Sintel. Pass the folder 'training' of the data set, or leave "
                f"--protocol out."
            )
    scored = [sequence for sequence in sequences if sequence.name in known[name].sequences]
    if not scored:
        names = ", ".join(known[name].sequences)
        raise InputError(f"--protocol {name}: expected some of {names}, got none.")
    return known[name], scored


def protocol_summary(
    protocol: Protocol, totals: Sequence[Mapping[str, Any]], scored: Sequence[Mapping[str, Any]]
) -> dict[str, Any]:
    """What stands under ``protocol`` in ``results.json``: what was scored, beside the published.

    ``totals`` has a line per method and flow source over all sequences, ``scored`` the ``name`` and
    ``pairs_scored`` of each sequence; ``note`` says what of the complete set is missing.
    """
    names, count = [s["name"] for s in scored], sum(s["pairs_scored"] for s in scored)
    absent = [name for name in protocol.sequences if name not in names]
    notes = []
    if absent:
        what = f"{len(absent)} of {len(protocol.sequences)} sequences are missing"
        notes.append(f"{what}: {', '.join(absent)}")
    if count != protocol.pairs:
        notes.append(f"{count} pairs, the complete set has {protocol.pairs}")
    if notes:
        notes.append("these figures and the published ones are not over the same pairs")
    published = {line["method"]: line for line in protocol.published if line["method"]}
    return asdict(protocol) | {
        "complete": not notes,
        "note": "; ".join(notes),
        "missing_sequences": absent,
        "pairs": count,
        "pairs_expected": protocol.pairs,
        "table": [{**row, "published": published.get(row["method"])} for row in totals],
    }
