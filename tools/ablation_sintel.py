"""Trained rows on MPI Sintel by the paper's protocol: true flow, true depth, 128x256."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import numpy as np

BATCH = 16
"""Pairs at once."""


def open_sintel(folder: Path) -> list[Path]:
    """Sequence folders of a copy of the data set.

    Raises:
        InputError: none is there, or one that is not of the training set.
    """
    from hybridvo.data.sequence import open_sequence
    from hybridvo.evaluation.protocols import check_protocol
    from hybridvo.evaluation.sources import expand

    paths = expand(folder, "sintel")
    opened = [open_sequence(path, "sintel") for path in paths]
    check_protocol("paper", opened)
    return paths


def score_sintel(
    folder: Path, out: Path, runs: list[dict[str, Any]], device: str, quiet: bool
) -> dict[str, Any]:
    """All finished rows in one pass over the data set.

    Args:
        folder: the copy.
        out: folder of the ablation, with the checkpoints of ``runs``.
        runs: ``row`` and ``seed`` of each.
        device: of the networks.
        quiet: no lines of progress.

    Returns:
        ``scores``: mean errors by "row-seedN"; ``pairs`` and ``note``, which says what is missing
        of the 992 pairs of the paper.
    """
    from hybridvo.data.sequence import iter_pairs, open_sequence
    from hybridvo.evaluation.pair_errors import mean_pair_errors
    from hybridvo.evaluation.protocols import protocols, same_intrinsics

    names = [f"{run['row']}-seed{run['seed']}" for run in runs]
    networks = {name: _network(out / name, device) for name in names}
    errors: dict[str, list[dict[str, float | None]]] = {name: [] for name in names}
    found = []
    for path in open_sintel(folder):
        sequence = open_sequence(path, "sintel")
        found.append(sequence.name)
        if not quiet:
            print(f"Sintel: {sequence.name}", file=sys.stderr)
        waiting = []
        for pair in iter_pairs(sequence):
            if same_intrinsics(pair.prev.camera, pair.curr.camera):
                waiting.append(pair)
            if len(waiting) == BATCH:
                _score(networks, waiting, sequence, errors)
                waiting = []
        if waiting:
            _score(networks, waiting, sequence, errors)
    protocol = protocols()["paper"]
    pairs = len(next(iter(errors.values())))
    missing = len(set(protocol.sequences) - set(found))
    note = ""
    if missing or pairs != protocol.pairs:
        note = f"{pairs} of the paper's {protocol.pairs} pairs; {missing} sequences are missing"
    scores = {name: mean_pair_errors(rows) for name, rows in errors.items()}
    return {"pairs": pairs, "note": note, "scores": scores}


def _network(folder: Path, device: str) -> tuple[Any, str]:
    """Network of a finished row, and how one motion comes out of its pixels."""
    import torch

    from hybridvo.data.presets import build_options
    from hybridvo.network.options import NetworkOptions
    from hybridvo.network.pwvo import build_network
    from hybridvo.training.checkpoint import load_checkpoint

    state = load_checkpoint(folder / "checkpoint.pt")
    options = state["options"]
    network = build_network(build_options(NetworkOptions, options["network"], str(folder)))
    network.load_state_dict(state["network"] if state["ema"] is None else state["ema"])
    return network.to(torch.device(device)).eval(), options["selection"]


def _score(
    networks: dict[str, tuple[Any, str]],
    pairs: list[Any],
    sequence: Any,
    errors: dict[str, list[dict[str, float | None]]],
) -> None:
    import torch

    from hybridvo.evaluation.pair_errors import pair_errors
    from hybridvo.evaluation.sequence_job import true_motion
    from hybridvo.learned import next_start
    from hybridvo.network.inputs import assemble_inputs
    from hybridvo.network.passes import predict
    from hybridvo.network.selection import chosen_motion

    inputs = assemble_inputs(pairs)
    truth = [true_motion(sequence, pair.prev.index, pair.curr.index) for pair in pairs]
    for name, (network, selection) in networks.items():
        with torch.inference_mode():
            given = inputs.to(next(network.parameters()).device)
            output = predict(network, given, next_start(network, selection))
            motions = chosen_motion(output, selection).double().cpu().numpy()
        for pair, T_true, T in zip(pairs, truth, motions, strict=True):
            if T_true is None:
                continue
            depth = pair.prev.depth
            cameras = (pair.prev.camera, pair.curr.camera)
            errors[name].append(pair_errors(np.asarray(T), T_true, depth, *cameras))
