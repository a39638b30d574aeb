"""Samples as an endless, seeded, resumable stream of batches, for any number of workers and ranks.

Sample ``i`` of seed ``s`` is drawn from a generator keyed with (s, i) and nothing else.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch.utils.data import IterableDataset, get_worker_info

from hybridvo.network.inputs import NetworkInputs, assemble_aligned
from hybridvo.network.losses import LossTargets
from hybridvo.synthetic.dataset import Preset
from hybridvo.synthetic.draws import TRAINING, sample_generator
from hybridvo.synthetic.layered import Sample


@dataclass(frozen=True)
class Mixture:
    """Presets with the share of each; shares need not add up to one."""

    presets: tuple[Preset, ...]
    weights: tuple[float, ...]

    def sample(self, rng: np.random.Generator) -> Sample:
        """One pair of one of the presets."""
        limits = np.cumsum(self.weights)
        choice = int(np.searchsorted(limits, rng.random() * limits[-1], side="right"))
        return self.presets[min(choice, len(self.presets) - 1)].sample(rng)


@dataclass(frozen=True, eq=False)
class TrainingBatch:
    """Inputs and ground truth of B samples; ``moving``: (B, h, w) bool, pixels that move."""

    inputs: NetworkInputs
    targets: LossTargets
    moving: torch.Tensor

    def __len__(self) -> int:
        return len(self.inputs)

    def to(self, device: torch.device | str) -> TrainingBatch:
        """Copy on another device."""
        return TrainingBatch(
            self.inputs.to(device), self.targets.to(device), self.moving.to(device)
        )


def collate(samples: Sequence[Sample]) -> TrainingBatch:
    """Batch of at least one sample, all of one size."""

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
    """Endless batches of a preset, from the sample ``start`` of a seed.

    Batch b of rank r holds the samples ``start + (b world + r) batch_size`` and those that follow:
    all ranks together see what one process with a batch ``world`` times as large would see. Workers
    of a ``DataLoader(stream, batch_size=None)`` take batches in turn, and the loader hands them
    over in order, so that their number changes nothing.
    """

    def __init__(
        self, preset: Preset, seed: int, start: int, batch_size: int, rank: int = 0, world: int = 1
    ) -> None:
        super().__init__()
        self.preset, self.seed, self.start, self.batch_size = preset, seed, start, batch_size
        self.rank, self.world = rank, world

    def __iter__(self) -> Iterator[TrainingBatch]:
        worker = get_worker_info()
        turn, turns = (0, 1) if worker is None else (worker.id, worker.num_workers)
        while True:
            first = self.start + (turn * self.world + self.rank) * self.batch_size
            numbers = range(first, first + self.batch_size)
            draws = (sample_generator(self.seed, i, TRAINING) for i in numbers)
            yield collate([self.preset.sample(rng) for rng in draws])
            turn += turns
