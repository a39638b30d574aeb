"""The paper's way of scoring MPI Sintel, and what others published; ``protocols.yaml`` holds it."""

from __future__ import annotations

import functools
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import yaml

from hybridvo.errors import InputError
from hybridvo.types import Camera


@functools.cache
def paper_protocol() -> dict[str, Any]:
    """The complete set (``sequences`` with their frames, ``pairs``), columns, published lines."""
    path = Path(__file__).parent / "protocols.yaml"
    content: dict[str, Any] = yaml.safe_load(path.read_text(encoding="utf-8"))
    return content


def same_intrinsics(first: Camera, second: Camera) -> bool:
    """Whether two cameras are one: the pairs that the paper keeps."""
    pairs = ((getattr(c, n) for c in (first, second)) for n in ("fx", "fy", "cx", "cy"))
    return first.shape == second.shape and all(abs(a - b) <= 1e-9 * first.fx for a, b in pairs)


def check_protocol(sequences: Sequence[Any]) -> None:
    """Refuse sequences that the protocol does not score."""
    for sequence in sequences:
        if sequence.kind != "sintel" or sequence.name not in paper_protocol()["sequences"]:
            raise InputError(
                f"--protocol paper: expected training sequences of MPI Sintel, got {sequence.name}."
            )


def protocol_summary(scored: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """What stands under ``protocol`` in ``results.json``, beside the totals: the published lines.

    ``scored`` has the ``name`` and ``pairs_scored`` of each sequence; ``note`` says what of the
    complete set is missing.
    """
    protocol = paper_protocol()
    names, count = [s["name"] for s in scored], sum(s["pairs_scored"] for s in scored)
    absent = [name for name in protocol["sequences"] if name not in names]
    note = ""
    if absent or count != protocol["pairs"]:
        note = f"{count} pairs, the complete set has {protocol['pairs']}: not those of the "
        note += f"published figures; missing: {', '.join(absent) or 'no sequence'}"
    return protocol | {"note": note, "missing_sequences": absent, "pairs": count}
