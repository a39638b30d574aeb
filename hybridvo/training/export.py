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
from hybridvo.synthetic.dataset import Mixture, build_options, make_preset
from hybridvo.training.options import PwvoOptions, SelectorOptions
from hybridvo.training.pwvo_task import PwvoTask
from hybridvo.training.selector_task import SelectorTask
from hybridvo.training.trainer import CHECKPOINT, Trainer, read_checkpoint
from hybridvo.training.validation import calibrate_scales

RUN = "run.json"
"""Command, commit and versions of a training, beside its checkpoint."""


def source_commit() -> str | None:
    """Commit of the working tree, with a mark if it was changed; None outside of a repository."""
    command = "git describe --always --dirty --abbrev=40 --exclude *".split()
    how: dict[str, Any] = {"cwd": Path(__file__).parent, "stderr": subprocess.DEVNULL}
    try:
        return subprocess.check_output(command, text=True, **how).strip()
    except (OSError, subprocess.SubprocessError):
        return None


def open_run(folder: str | Path) -> Trainer:
    """A run as its checkpoint describes it."""
    path = Path(folder) / CHECKPOINT
    record = read_checkpoint(path)["record"]
    task: PwvoTask | SelectorTask
    if record["options"]["network"]["kind"] == "selector":
        chosen = build_options(SelectorOptions, record["options"], str(path))
        task = SelectorTask(chosen, Path(record["data"]))
    else:
        options = build_options(PwvoOptions, record["options"], str(path))
        presets = tuple(make_preset(mapping, str(path)) for mapping in record["data"])
        task = PwvoTask(options, Mixture(presets, options.data_weights))
    trainer = Trainer(task, Path(folder))
    trainer.resume()
    return trainer


def export_run(
    folder: str | Path, path: str | Path, count: int = 1000, calibrate: int = 0
) -> dict[str, Any]:
    """Write a run's weights as float16 safetensors, and its card beside them as JSON.

    ``count``: held-out pairs of each preset for the figures of the card; ``calibrate``: development
    pairs over which PWVO's scales of the translation are calibrated.
    """
    trainer = open_run(folder)
    card = {
        "updates": trainer.step,
        "samples": trainer.samples,
        "skipped_updates": trainer.skipped,
        "training_hours": round(trainer.elapsed_s / 3600, 2),
        **trainer.record,
    }
    try:
        card |= json.loads(read_text(Path(folder) / RUN))
    except (OSError, ValueError) as error:
        raise InputError(f"{folder}: no {RUN} of a training: {error}.") from None
    task, network = trainer.task, trainer.exported
    if calibrate and isinstance(task, PwvoTask):
        main = task.mixture.presets[int(np.argmax(task.options.data_weights))]
        shift = calibrate_scales(network, main, calibrate)
        card["calibration"] = {"pairs": calibrate, "seed": 0, "added_to_s": shift}
    network = network.half().float()
    card["held_out"] = task.evaluate(network, count)
    save_weights(path, network, card, "float16")
    write_json(Path(path).with_suffix(".json"), card)
    return card
