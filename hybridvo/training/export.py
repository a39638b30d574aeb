"""Weights of a run for users, with a card that says what the run was trained with."""

from __future__ import annotations

import json
import subprocess
from pathlib import Path
from typing import Any

import numpy as np

from hybridvo.errors import InputError
from hybridvo.files import read_text, write_json
from hybridvo.network.weights import save_weights
from hybridvo.training.options import recorded_run
from hybridvo.training.pwvo_task import PwvoTask
from hybridvo.training.selector_task import evaluate_selector
from hybridvo.training.trainer import CHECKPOINT, Trainer, read_checkpoint
from hybridvo.training.validation import PUBLISHED_SEED, calibrate_scales, evaluate_network

RUN = "run.json"
"""Command, commit and versions of a training, beside its checkpoint."""


def source_commit() -> str | None:
    """Commit of the working tree, with a mark if it was changed; None outside of a repository."""
    command = "git describe --always --dirty --abbrev=40 --exclude *".split()
    here = Path(__file__).parent
    try:
        return subprocess.check_output(
            command, cwd=here, stderr=subprocess.DEVNULL, text=True
        ).strip()
    except (OSError, subprocess.SubprocessError):
        return None


def run_card(trainer: Trainer) -> dict[str, Any]:
    """What every card says of a run: its own record, never the options of the export."""
    card = {
        "updates": trainer.step,
        "samples": trainer.samples,
        "skipped_updates": trainer.skipped,
        "training_hours": round(trainer.elapsed_s / 3600, 2),
        **trainer.record,
    }
    try:
        return card | json.loads(read_text(Path(str(trainer.folder)) / RUN))
    except (OSError, ValueError) as error:
        raise InputError(f"{trainer.folder}: no {RUN} of a training: {error}.") from None


def open_run(folder: str | Path) -> Trainer:
    """A PWVO run as its checkpoint describes it."""
    path = Path(folder) / CHECKPOINT
    record = read_checkpoint(path)["record"]
    trainer = Trainer(PwvoTask(*recorded_run(record, str(path))), Path(folder))
    trainer.resume()
    return trainer


def _write(path: Path, network: Any, card: dict[str, Any]) -> dict[str, Any]:
    save_weights(path, network, card, "float16")
    write_json(path.with_suffix(".json"), card)
    return card


def export_pwvo(
    folder: str | Path, path: str | Path, count: int = 1000, calibrate: int = 0
) -> dict[str, Any]:
    """Write a run's weights as float16 safetensors, and its card beside them as JSON.

    The figures of the card are those of the stored, rounded weights, over ``count`` held-out pairs
    of each preset; ``calibrate``: development pairs over which the scales of the translation are
    calibrated; 0: as trained.

    Raises:
        CheckpointError, InputError: not the folder of a run.
    """
    trainer = open_run(folder)
    assert isinstance(trainer.task, PwvoTask)
    options, presets = trainer.task.options, trainer.task.mixture.presets
    card = run_card(trainer)
    if calibrate:
        main = presets[int(np.argmax(options.data_weights))]
        shift = calibrate_scales(trainer.exported, main, calibrate)
        card["calibration"] = {"pairs": calibrate, "seed": 0, "added_to_s": shift}
    network = trainer.exported.half().float()
    card["held_out"] = {}
    for name, preset in zip(options.data, presets, strict=True):
        how = {"selection": options.selection}
        figures = evaluate_network(network, preset, PUBLISHED_SEED, count, **how)
        del figures["epe_of_pairs"]
        card["held_out"][Path(name).stem] = figures
    return _write(Path(path), network, card)


def export_selector(trainer: Trainer, held_out: str | Path, path: str | Path) -> dict[str, Any]:
    """Write the selector's weights and card; ``held_out`` is a folder of held-out shards."""
    files = sorted(Path(held_out).glob("*.npz"))
    if not files:
        raise InputError(f"{held_out}: no shards; make some with seeds below 1000.")
    network = trainer.exported.eval()
    card = run_card(trainer) | {
        "what": "chooses the world among candidate motions, and where the world is",
        "held_out": evaluate_selector(network, files),
        "held_out_with_proposals": evaluate_selector(network, files, asked=True),
        "network": trainer.record["options"]["network"],
    }
    return _write(Path(path), network, card)
