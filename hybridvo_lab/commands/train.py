"""``hybridvo generate`` and ``hybridvo train``: training samples, PWVO, the paper's networks."""

from __future__ import annotations

import functools
import json
import shlex
import sys
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np
import torch
from rich.console import Console
from rich.progress import Progress

from hybridvo.core.errors import InputError
from hybridvo.core.files import make_folder, read_text, write_json
from hybridvo.flow.colours import flow_colours, longest_flow
from hybridvo.network.models import load_weights, torch_device
from hybridvo.run.commands.stopping import stop_requested
from hybridvo_lab.cluster import Workers
from hybridvo_lab.synthetic.dataset import load_preset, read_sample, write_samples
from hybridvo_lab.synthetic.paper_samples import Sample, rays
from hybridvo_lab.synthetic.semi_real import PIXELS, Recording, load_split
from hybridvo_lab.synthetic.turned_windows import TripodRecording, load_tripod
from hybridvo_lab.synthetic.two_recordings import load_places
from hybridvo_lab.training import ranks
from hybridvo_lab.training.hypothesis_samples import (
    PER_SHARD,
    Makers,
    Shares,
    write_shard,
)
from hybridvo_lab.training.options import load_paper_options, load_training_options
from hybridvo_lab.training.paper_task import PaperTask
from hybridvo_lab.training.pwvo_task import PWVOTask
from hybridvo_lab.training.trainer import RUN, Trainer, source_commit
from hybridvo_lab.visualization.panels import Panel, write_panels

SHEET_SAMPLES = 6
"""Samples on the contact sheet of a folder of samples."""
SHEET_COLUMNS = 7
SHEET_PANEL_INCHES = 2.0
MIN_DEPTH_M = 1e-9
"""Depth below which its inverse is not drawn, metres."""


def generate(
    preset: str,
    count: int,
    out: str | Path,
    *,
    seed: int = 0,
    size: Sequence[int] | None = None,
    workers: Workers | None = None,
    quiet: bool = True,
) -> Path:
    """Draw training samples and a contact sheet of the first ones.

    A run that was interrupted goes on where it was.

    Args:
        preset: ``paper``, ``diverse`` or a YAML file.
        count: Number of samples.
        out: The output folder.
        seed: Seed of the first sample.
        size: Height and width, pixels; by default those of the preset.
        workers: Where samples are drawn; by default here.
        quiet: Whether no progress is shown.

    Returns:
        The contact sheet.
    """
    options = load_preset(preset, size)
    with Progress(console=Console(stderr=True, quiet=quiet)) as bar:
        task = bar.add_task("samples", total=count)
        for done in write_samples(options, count, out, seed, workers):
            bar.update(task, completed=done)
    first = range(min(SHEET_SAMPLES, count))
    sheet = Path(out) / "contact_sheet.png"
    write_sheet([read_sample(out, i) for i in first], sheet)
    return sheet


def write_sheet(samples: Sequence[Sample], path: str | Path) -> None:
    """Write a PNG with the five steps of each sample in a row; what is near is bright."""
    panels = [panel for sample in samples for panel in _sample_panels(sample)]
    height, width = samples[0].moving.shape
    write_panels(
        path,
        panels,
        "",
        width / height,
        columns=SHEET_COLUMNS,
        inches=SHEET_PANEL_INCHES,
    )


def _sample_panels(sample: Sample) -> list[Panel]:
    """Make the panels of the five steps of a sample."""
    directions = np.moveaxis(rays(sample.K, sample.moving.shape), 0, 2)
    objects_flow = sample.flow - sample.ego_flow
    longest = longest_flow(sample.flow)
    return [
        Panel("1 rays of K", flow_colours(directions, 1.0)),
        Panel(
            "2 inverse depth of t",
            _inverse_depth(sample.depth_prev),
            "1/m",
            log=True,
        ),
        Panel("3 what moves", sample.moving.astype(float), "", 1.0),
        Panel("4 camera's flow", flow_colours(sample.ego_flow, longest)),
        Panel("4 objects' flow", flow_colours(objects_flow, longest)),
        Panel("5 total flow", flow_colours(sample.flow, longest)),
        Panel(
            "5 inverse depth of t+1",
            _inverse_depth(sample.depth_curr),
            "1/m",
            log=True,
        ),
    ]


def _inverse_depth(depth: np.ndarray) -> np.ndarray:
    """Return the inverse of a depth map (H, W), 1/m, NaN where it is invalid."""
    return np.where(depth > 0, 1 / np.maximum(depth, MIN_DEPTH_M), np.nan)


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
    """Train PWVO, or a network of the paper; a run goes on where it was.

    The processes that torchrun starts train together; all of them see the folder of the run.

    Args:
        training: ``pwvo`` or ``paper``.
        config: The configuration, a YAML file.
        out: The folder of the run.
        data: The folder of PWVO's shards.
        init: Weights to start from: a file, or a pretrained name.
        time_limit: Minutes after which training ends.
        seed: Replaces the seed of the configuration.
        device: ``auto``, ``cpu`` or ``cuda``.
        workers: Processes that draw samples.
        command: The words of the command line, which are kept with the results.

    Returns:
        The number of updates, JSON-ready.
    """
    device = ranks.device_of(torch_device(device))
    # Samples are small: threads inside OpenCV cost more than they save.
    cv2.setNumThreads(0)
    with ranks.joined(device):
        task = _make_task(training, config, data, seed)
        trainer = Trainer(
            task, out, device, workers, report=_print_figures, on_progress=_print
        )
        _begin_run(trainer, init, command)

        def stop() -> None:
            trainer.stop_requested = True

        # The current update is finished, and a checkpoint is written.
        with stop_requested(stop):
            reason = trainer.run(60 * time_limit)
        _print(f"ended by {reason} at update {trainer.step}")
    return {"updates": trainer.step}


def _begin_run(trainer: Trainer, init: str | None, command: Sequence[str]) -> None:
    """Go on where the run was, or begin it and note what it is of."""
    make_folder(trainer.folder)
    if trainer.resume():
        _print(f"goes on at update {trainer.step}")
        return
    _print(f"begins: {trainer.options.steps} updates; the first samples are drawn")
    if init is not None:
        network, _ = load_weights(init)
        trainer.start_from(network.state_dict(), init)
    about = {
        "command": shlex.join(command),
        "commit": source_commit(),
        "torch": torch.__version__,
        "processes": ranks.count(),
    }
    if ranks.is_first():
        write_json(trainer.folder / RUN, about)


def _make_task(
    training: str, config: Path, data: Path, seed: int | None
) -> PaperTask | PWVOTask:
    """Return what is trained, by its configuration."""
    if training == "pwvo":
        options = load_training_options(config)
        if seed is not None:
            options = replace(options, seed=seed)
        return PWVOTask(options, data)
    paper, mixture = load_paper_options(config)
    if seed is not None:
        paper = replace(paper, seed=seed)
    return PaperTask(paper, mixture)


def _print_figures(figures: dict[str, float]) -> None:
    """Print the figures of a training step on stderr."""
    _print(" ".join(f"{key}={value:.5g}" for key, value in figures.items()))


def _print(text: str) -> None:
    """Print a line on stderr at once; of several ranks the first one does."""
    if ranks.is_first():
        print(text, file=sys.stderr, flush=True)


class _Shard(NamedTuple):
    """What decides about the samples of a shard, and where it is written."""

    data: Path
    seed: int  # the first one
    recordings: Path | None
    shares: Shares


def draw_training_samples(
    data: Path,
    first_seed: int,
    seeds: int,
    *,
    recordings: Path | None = None,
    shares: Sequence[float] = (),
    workers: Workers | None = None,
) -> dict[str, Any]:
    """Draw samples for PWVO: pairs of many makers, with the motions found in them.

    A run that was interrupted goes on where it was: finished shards are kept.

    Args:
        data: The folder of the shards.
        first_seed: The seed of the first sample.
        seeds: About as many samples are drawn.
        recordings: A folder of recordings of static scenes, with those of a tripod in
            ``tripod/``; by default all samples are rendered.
        shares: Of which makers they are, see
            :class:`hybridvo_lab.training.hypothesis_samples.Shares`.
        workers: Where shards are drawn; by default here.

    Returns:
        The number of samples, JSON-ready.

    Raises:
        InputError: A number is negative, or not all shares are given.
        RuntimeError: Several workers died of a shard.
    """
    names = Shares._fields
    if len(shares) not in (0, len(names)):
        raise InputError(
            f"--shares: expected {', '.join(names)}, got {len(shares)} numbers."
        )
    if first_seed < 0 or seeds < 0:
        raise InputError(
            f"expected --first-seed and --seeds >= 0, got {first_seed}, {seeds}."
        )
    make_folder(data)
    workers = workers or Workers()
    if workers.are_remote:
        # workers are in other folders
        data = data.absolute()
        recordings = None if recordings is None else recordings.absolute()
    shards = [
        _Shard(data, seed, recordings, Shares(*shares))
        for seed in range(first_seed, first_seed + seeds, PER_SHARD)
    ]
    total = 0
    for done in workers.each(_draw_shard, shards):
        seed = shards[done.number].seed
        if done.lost:
            raise RuntimeError(f"seeds from {seed}: {done.lost}")
        total += done.result
        _print(f"seeds {seed} to {seed + PER_SHARD}: {total} samples")
    return {"samples": total}


def _draw_shard(shard: _Shard) -> int:
    """Write a shard, unless it is finished; returns the number of its samples."""
    path = shard.data / f"{shard.seed:08d}.json"
    recordings = None if shard.recordings is None else shard.recordings.name
    made_by = {"recordings": recordings, "shares": list(shard.shares)}
    before = _finished_shard(path)
    if {name: before.get(name) for name in made_by} == made_by:
        return int(before["samples"])
    # The shards come in two sizes, in turns.
    pixels = PIXELS[shard.seed // PER_SHARD % 2]
    makers = Makers(shares=shard.shares)
    if shard.recordings is not None:
        makers = Makers(
            load_split(shard.recordings, "train", pixels),
            _tripod(shard.recordings),
            _places(shard.recordings, pixels),
            shard.shares,
        )
    samples = write_shard(shard.data, shard.seed, makers)
    write_json(path, {"samples": samples, **made_by})
    return samples


def _finished_shard(path: Path) -> dict[str, Any]:
    """Return what a finished shard states of itself; empty if it is not there."""
    try:
        return dict(json.loads(read_text(path)))
    except (FileNotFoundError, ValueError, TypeError):
        return {}


@functools.cache
def _tripod(recordings: Path) -> Sequence[TripodRecording]:
    """Return the recordings of a tripod, which a process reads once."""
    return load_tripod(recordings / "tripod")


@functools.cache
def _places(recordings: Path, pixels: int) -> Mapping[str, Sequence[Recording]]:
    """Return the recordings by place, which a process reads once."""
    return load_places(recordings, ("train",), pixels)
