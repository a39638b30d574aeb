"""Samples on the fly: an endless, seeded, resumable stream for any number of workers and ranks.

Sample ``i`` of seed ``s`` is drawn from a generator keyed with (s, i) and nothing else. Training
and held-out samples use different halves of the key space, so that no training run, whatever its
seed, has seen a held-out pair.
"""

from __future__ import annotations

import os
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

import numpy as np
import torch
from torch.utils.data import IterableDataset, get_worker_info

from hybridvo.errors import InputError
from hybridvo.network.inputs import NetworkInputs, assemble_aligned
from hybridvo.network.losses import LossTargets
from hybridvo.synthetic.paper import Sample

__all__ = [
    "Mixture",
    "SampleStream",
    "TrainingBatch",
    "check_batch_fits",
    "collate",
    "sample_generator",
]

TRAINING_KEYS = 1 << 32
"""Added to the seed of training samples; held-out seeds lie below."""


SMALL_BATCH = 200
"""Samples of a batch that need no look at the memory: twice the paper's."""


class Preset(Protocol):
    """What can draw a sample: ``PaperOptions``, ``WideOptions``, ``Mixture``."""

    def sample(self, rng: np.random.Generator) -> Sample:
        """One pair from a generator."""


@dataclass(frozen=True)
class Mixture:
    """Presets with the share of each.

    Args:
        presets: what to draw from.
        weights: non-negative shares; they need not add up to one.

    Raises:
        InputError: no preset, another number of weights, or weights that cannot be shares.
    """

    presets: tuple[Preset, ...]
    weights: tuple[float, ...]

    def __post_init__(self) -> None:
        weights = np.asarray(self.weights, dtype=np.float64)
        if not self.presets or len(self.presets) != len(self.weights):
            raise InputError(
                f"Mixture: expected one weight for each preset, got {len(self.weights)} for "
                f"{len(self.presets)}."
            )
        if not (np.isfinite(weights).all() and (weights >= 0).all() and weights.sum() > 0):
            raise InputError(f"Mixture: expected non-negative weights, got {self.weights}.")

    def sample(self, rng: np.random.Generator) -> Sample:
        """One pair of one of the presets."""
        limits = np.cumsum(self.weights)
        choice = int(np.searchsorted(limits, rng.random() * limits[-1], side="right"))
        return self.presets[min(choice, len(self.presets) - 1)].sample(rng)


def sample_generator(seed: int, index: int, training: bool = False) -> np.random.Generator:
    """Generator of sample ``index`` of a seed, the same on every machine and in every process.

    Raises:
        InputError: a seed or an index that is negative or does not fit.
    """
    if not (0 <= seed < TRAINING_KEYS and 0 <= index < 1 << 63):
        raise InputError(
            f"sample_generator: expected 0 <= seed < 2^32 and 0 <= index < 2^63, got seed {seed} "
            f"and index {index}."
        )
    key = np.array([seed + TRAINING_KEYS * training, index], dtype=np.uint64)
    return np.random.Generator(np.random.Philox(key=key))


@dataclass(frozen=True, eq=False)
class TrainingBatch:
    """Inputs and truth of B samples at the network's size.

    Args:
        inputs: what the network reads.
        targets: the truth.
        moving: (B, h, w) bool, pixels with a motion of their own.
    """

    inputs: NetworkInputs
    targets: LossTargets
    moving: torch.Tensor

    def to(self, device: torch.device | str) -> TrainingBatch:
        """Copy on another device."""
        return TrainingBatch(
            self.inputs.to(device), self.targets.to(device), self.moving.to(device)
        )


def check_batch_fits(mixture: Mixture, batch_size: int) -> None:
    """Refuse a batch whose samples alone do not fit into the memory, before they are drawn.

    A lower bound: the samples and the tensors that they are stacked into. What the network makes of
    them depends on the device and comes on top.

    Raises:
        InputError: too many samples.
    """
    have = available_bytes()
    if have is None or batch_size <= SMALL_BATCH:
        return
    samples = (preset.sample(sample_generator(0, 0)) for preset in mixture.presets)
    largest = max(
        sum(value.nbytes for value in vars(sample).values() if value is not None)
        for sample in samples
    )
    need = 2 * largest * batch_size
    if need > have:
        raise InputError(
            f"batch_size: {batch_size} samples of {largest / 1e6:.1f} MB need {need / 1e9:.3g} GB "
            f"as arrays and as tensors, {have / 1e9:.3g} GB of memory are free. Expected at most "
            f"{have // (2 * largest)}; batches of 8 to 100 are usual."
        )


def available_bytes() -> int | None:
    """Memory that is free for programs, or all there is where that is not told; None if unknown."""
    try:
        for line in Path("/proc/meminfo").read_text(encoding="ascii").splitlines():
            if line.startswith("MemAvailable:"):
                return 1024 * int(line.split()[1])
    except (OSError, ValueError, IndexError):  # not on macOS and Windows
        pass
    try:
        return os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")
    except (AttributeError, OSError, ValueError):
        return None


def collate(samples: Sequence[Sample]) -> TrainingBatch:
    """Batch of samples of one size.

    Raises:
        InputError: no samples.
    """
    if not samples:
        raise InputError("collate: expected at least one sample.")

    def stack(name: str) -> torch.Tensor:
        return torch.from_numpy(np.stack([getattr(sample, name) for sample in samples]))

    K = stack("K")
    inputs = assemble_aligned(stack("flow"), stack("depth_prev"), stack("depth_curr"), K)
    for b, sample in enumerate(samples):
        if sample.rays is not None:
            inputs.rays[b] = torch.from_numpy(sample.rays).permute(2, 0, 1)
    targets = LossTargets(
        rotation_deg=stack("rotation_deg"),
        translation=stack("translation"),
        ego_flow=stack("ego_flow").permute(0, 3, 1, 2),
        depth_prev=stack("depth_true"),
        depth_curr=stack("depth_target"),
        K_prev=K,
        K_curr=K,
    )
    return TrainingBatch(inputs, targets, stack("moving"))


class SampleStream(IterableDataset):
    """Endless batches (or single samples) of a preset.

    Batch b of rank r holds the samples ``start + (b world + r) batch_size`` and those that follow:
    all ranks together see what one process with a batch ``world`` times as large would see. Workers
    of a ``DataLoader(stream, batch_size=None)`` take batches in turn, and the loader hands them
    over in order, so that their number changes nothing.

    Args:
        seed: of the samples.
        start: index of the first sample, to resume.
        preset: what to draw.
        rank: of this process.
        world: number of processes.
        batch_size: samples in a batch; None yields single :class:`Sample` objects.
        training: keys apart from every held-out seed.

    Raises:
        InputError: a rank outside of the world or a negative start.
    """

    def __init__(
        self,
        seed: int,
        start: int,
        preset: Preset,
        rank: int = 0,
        world: int = 1,
        batch_size: int | None = None,
        training: bool = True,
    ) -> None:
        super().__init__()
        if not 0 <= rank < world:
            raise InputError(f"SampleStream: expected 0 <= rank < world, got {rank} and {world}.")
        if start < 0 or (batch_size is not None and batch_size < 1):
            raise InputError(
                f"SampleStream: expected start >= 0 and batch_size >= 1, got {start} and "
                f"{batch_size}."
            )
        sample_generator(seed, start, training)
        self.seed, self.start, self.preset = seed, start, preset
        self.rank, self.world = rank, world
        self.batch_size, self.training = batch_size, training

    def draw(self, index: int) -> Sample:
        """Sample of an absolute index."""
        return self.preset.sample(sample_generator(self.seed, index, self.training))

    def __iter__(self) -> Iterator[TrainingBatch | Sample]:
        worker = get_worker_info()
        turn, turns = (0, 1) if worker is None else (worker.id, worker.num_workers)
        size = self.batch_size or 1
        number = turn
        while True:
            first = self.start + (number * self.world + self.rank) * size
            if self.batch_size is None:
                yield self.draw(first)
            else:
                yield collate([self.draw(first + j) for j in range(size)])
            number += turns
