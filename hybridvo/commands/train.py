"""``hybridvo generate`` and ``hybridvo train``: training samples, PWVO, the selector."""

from __future__ import annotations

import shlex
import signal
import sys
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch
from rich.console import Console
from rich.progress import Progress

from hybridvo.errors import InputError
from hybridvo.files import make_folder, write_json
from hybridvo.network.models import load_weights, torch_device
from hybridvo.synthetic.dataset import load_preset, read_sample, write_samples
from hybridvo.synthetic.layered import Sample, rays
from hybridvo.synthetic.semi_real import PIXELS, load_split
from hybridvo.training.options import load_pwvo_options, load_selector_options
from hybridvo.training.pwvo_task import PwvoTask
from hybridvo.training.selector_data import PER_SHARD, write_shard
from hybridvo.training.selector_task import SelectorTask
from hybridvo.training.trainer import RUN, Trainer, source_commit
from hybridvo.visualization.panels import (
    Panel,
    flow_colours,
    longest_flow,
    write_panels,
)


def generate(
    preset: str,
    count: int,
    out: str | Path,
    *,
    seed: int = 0,
    size: Sequence[int] | None = None,
    workers: int = 1,
    quiet: bool = True,
) -> Path:
    """Draw samples and a contact sheet of the first six; goes on where it was interrupted."""
    with Progress(console=Console(stderr=True, quiet=quiet)) as bar:
        task = bar.add_task("samples", total=count)
        for done in write_samples(
            load_preset(preset, size), count, out, seed, workers
        ):
            bar.update(task, completed=done)
    sheet = Path(out) / "contact_sheet.png"
    write_sheet([read_sample(out, i) for i in range(min(6, count))], sheet)
    return sheet


def write_sheet(samples: Sequence[Sample], path: str | Path) -> None:
    """Write a PNG with the five steps of each sample in a row; what is near is bright."""
    panels = [panel for sample in samples for panel in _steps(sample)]
    height, width = samples[0].moving.shape
    write_panels(path, panels, "", width / height, columns=7, inches=2.0)


def _steps(sample: Sample) -> list[Panel]:
    """The panels of the five steps of a sample."""
    directions = np.moveaxis(rays(sample.K, sample.moving.shape), 0, 2)
    longest = longest_flow(sample.flow)
    depths = (sample.depth_prev, sample.depth_curr)
    near = [np.where(z > 0, 1 / np.maximum(z, 1e-9), np.nan) for z in depths]
    return [
        Panel("1 rays of K", flow_colours(directions, 1.0)),
        Panel("2 inverse depth of t", near[0], "1/m", log=True),
        Panel("3 what moves", sample.moving.astype(float), "", 1.0),
        Panel("4 camera's flow", flow_colours(sample.ego_flow, longest)),
        Panel(
            "4 objects' flow", flow_colours(sample.flow - sample.ego_flow, longest)
        ),
        Panel("5 total flow", flow_colours(sample.flow, longest)),
        Panel("5 inverse depth of t+1", near[1], "1/m", log=True),
    ]


def train_network(
    training: str,
    config: Path,
    out: Path,
    *,
    data: Path = Path(),
    init: str | None = None,
    time_limit: float = float("inf"),
    seed: int | None = None,
    device: str = "cpu",
    workers: int = 0,
    command: Sequence[str] = (),
) -> dict[str, Any]:
    """Train a network of the paper, or the selector on the shards in the folder ``data``."""
    task: PwvoTask | SelectorTask
    if training == "selector":
        task = SelectorTask(load_selector_options(config), data)
    else:
        options, mixture = load_pwvo_options(config)
        task = PwvoTask(
            options if seed is None else replace(options, seed=seed), mixture
        )
    # samples are small: threads inside OpenCV cost more than they give
    cv2.setNumThreads(0)
    make_folder(out)

    def report(entry: dict[str, float]) -> None:
        print(
            *(f"{key}={value:.5g}" for key, value in entry.items()), file=sys.stderr
        )

    trainer = Trainer(task, out, torch_device(device), workers, report=report)
    if trainer.resume():
        print(f"goes on at update {trainer.step}", file=sys.stderr)
    else:
        if init is not None:
            trainer.start_from(load_weights(init)[0].state_dict(), init)
        about = {"command": shlex.join(command), "commit": source_commit()}
        write_json(out / RUN, about | {"torch": torch.__version__})
    # the update at hand ends, with a checkpoint
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda *_: setattr(trainer, "stop_requested", True))
    why = trainer.run(60 * time_limit)
    print(f"ended by {why} at update {trainer.step}", file=sys.stderr)
    return {"updates": trainer.step}


def draw_selector_data(
    data: Path, first_seed: int, seeds: int, *, recordings: Path | None = None
) -> dict[str, Any]:
    """Draw samples for the selector from scenes or recordings, with the motions found in them."""
    if first_seed < 0 or seeds < 0:
        raise InputError(
            f"expected --first-seed and --seeds >= 0, got {first_seed}, {seeds}."
        )
    make_folder(data)
    network = load_weights("pwvo")[0]
    total = 0
    for seed in range(first_seed, first_seed + seeds, PER_SHARD):
        pixels = PIXELS[seed // PER_SHARD % 2]
        known = (
            () if recordings is None else load_split(recordings, "train", pixels)
        )
        total += write_shard(data, seed, network, known)
        print(
            f"seeds to {seed + PER_SHARD}: {total} samples",
            file=sys.stderr,
            flush=True,
        )
    return {"samples": total}
