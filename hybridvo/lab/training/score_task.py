"""Training of PWVO's score alone: its last layers learn to choose, masks and encoder stay.

What the encoder makes of every motion does not change then. It is computed once for each
sample, with the refits that the product makes, and kept beside the shards; an update takes
milliseconds. The loss is that of the whole training: -log softmax over the motions of a pair,
of the score less what the refined motion leaves unexplained.
"""

from __future__ import annotations

import hashlib
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch

from hybridvo.core.errors import InputError
from hybridvo.core.files import atomic_write, make_folder
from hybridvo.lab.training.options import PWVOTrainingOptions
from hybridvo.lab.training.pwvo_task import (
    HypothesisBatch,
    PWVOTask,
    TwoLooks,
    choice_loss,
    read_batches,
)
from hybridvo.network.hypothesis_maps import HypothesisMaps, Looks
from hybridvo.network.pwvo import PWVO

SCORE_LAYERS = ("summary.", "inner.", "score.", "score_")
"""How the names of the weights begin that are trained."""
COPIED = {
    "score_down4.": "down4.",
    "score_scalars.": "scalars.",
    "score_block4.": "block4.",
}
"""Layers of the score's own stage, and those of the masks that they begin with."""
LOOKED_AT = 8
"""Samples that the encoder sees at a time."""


@dataclass(frozen=True, eq=False)
class ScoreBatch:
    """What the score is made of, for the N motions of B pairs.

    Attributes:
        x3: (N, C, h, w) features of the third stage; or (N, F), what the layers that are
            trained see of them.
        scalars: (N, 12) numbers of each motion.
        cost: (N,) fraction of the static scene that the motion leaves unexplained.
        error: (N,) error of the motion, px at a width of 1024.
        owner: (N,) number of its pair.
        limit: (B,) error up to which a motion of the pair is right, px.
    """

    x3: torch.Tensor
    scalars: torch.Tensor
    cost: torch.Tensor
    error: torch.Tensor
    owner: torch.Tensor
    limit: torch.Tensor

    def __len__(self) -> int:
        return len(self.limit)

    def to(self, device: torch.device) -> ScoreBatch:
        """Copy to another device."""
        return ScoreBatch(
            **{name: value.to(device) for name, value in vars(self).items()}
        )

    def part(self, numbers: np.ndarray) -> ScoreBatch:
        """Return the batch of some of the pairs."""
        new_number = torch.full((len(self),), -1)
        new_number[torch.as_tensor(numbers)] = torch.arange(len(numbers))
        owner = new_number[self.owner]
        mine = owner >= 0
        return ScoreBatch(
            self.x3[mine],
            self.scalars[mine],
            self.cost[mine],
            self.error[mine],
            owner[mine],
            self.limit[torch.as_tensor(numbers)],
        )


class ScoreTask(PWVOTask):
    """The layers of PWVO's score, and features of a folder of shards.

    Args:
        options: of the training, with ``score_only``.
        folder: the shards; the features come into a folder below it.
    """

    def __init__(self, options: PWVOTrainingOptions, folder: Path) -> None:
        super().__init__(options, folder)
        for name, parameter in self.network.named_parameters():
            parameter.requires_grad_(name.startswith(SCORE_LAYERS))

    def batches(self, samples: int, workers: int) -> Iterator[ScoreBatch]:  # type: ignore[override]
        """Yield batches of the samples of all shards, shuffled in each round."""
        loaded: dict[Path, ScoreBatch] = {}
        round_number = 0
        while True:
            for path in self._features(self._shards()):
                if path not in loaded:
                    loaded[path] = self._seen(_read(path))
            by_shape: dict[tuple[int, ...], list[ScoreBatch]] = {}
            for each in loaded.values():
                by_shape.setdefault(tuple(each.x3.shape[1:]), []).append(each)
            rng = np.random.default_rng([self.options.seed, samples, round_number])
            jobs = []
            for some in by_shape.values():
                everything = _joined(some)
                order = rng.permutation(len(everything))
                for first in range(0, len(order), self.options.batch_size):
                    picked = order[first : first + self.options.batch_size]
                    jobs.append((everything, picked))
            rng.shuffle(jobs)
            for everything, picked in jobs:
                yield everything.part(picked)
            round_number += 1

    def count(self, batch: ScoreBatch) -> int:  # type: ignore[override]
        """Samples of a batch."""
        return len(batch)

    def loss(  # type: ignore[override]
        self, batch: ScoreBatch, step: int
    ) -> tuple[torch.Tensor, dict[str, torch.Tensor]]:
        """-log softmax of the right motions, over all motions of a pair and none of them."""
        if self.options.network.score_stage:
            score = self.network.score_of(batch.x3, batch.scalars)
        else:
            score = self.network.score_of_pooled(batch.x3)
        score = score - self.options.cost_weight * batch.cost
        loss = choice_loss(score, batch.error, batch.owner, batch.limit)
        loss = loss / len(batch)
        return loss, {"choice": loss.detach()}

    def _seen(self, batch: ScoreBatch) -> ScoreBatch:
        """What the layers that are trained see of features."""
        if self.options.network.score_stage:
            return batch
        network = self.network
        with torch.no_grad():
            x4 = network.coarse(batch.x3, batch.scalars)
            return replace(batch, x3=network.pooled(batch.x3, batch.scalars, x4))

    def _shards(self) -> list[Path]:
        files = sorted(self.folder.glob("*.npz"))
        if not files:
            raise InputError(
                f"{self.folder}: no shards of samples; write some with "
                f"hybridvo train samples."
            )
        return files

    def _features(self, shards: list[Path]) -> Iterator[Path]:
        """Yield files of features, and write those that are not there."""
        folder = self.folder / f"features_{_checksum(self.network)}"
        make_folder(folder)
        for number in range(self.options.rounds):
            for shard in shards:
                path = folder / f"{shard.stem}_{number}.npz"
                if not path.exists():
                    batch = features_of(self.network, shard, number, self.options)
                    _write(path, batch)
                yield path


def pwvo_task(options: PWVOTrainingOptions, folder: Path) -> PWVOTask:
    """Return the training of all layers, or of those of the score."""
    return (ScoreTask if options.score_only else PWVOTask)(options, folder)


def with_score_stage(
    weights: Mapping[str, torch.Tensor], network: PWVO
) -> dict[str, torch.Tensor]:
    """Return weights in which a stage of the score that is new begins as that of the masks."""
    complete = dict(weights)
    for name in network.state_dict():
        for new, old in COPIED.items():
            if name.startswith(new) and name not in complete:
                complete[name] = weights[old + name.removeprefix(new)].clone()
    return complete


def features_of(
    network: PWVO, shard: Path, number: int, options: PWVOTrainingOptions
) -> ScoreBatch:
    """Look at all motions of a shard, and at their refits.

    Args:
        network: PWVO.
        shard: the file of samples.
        number: which time this is; in the first one no motion is expected, and nothing is
            mirrored.
        options: of the training.
    """
    rng = np.random.default_rng([options.seed, number])
    draw = torch.Generator().manual_seed((options.seed << 32) + number)
    parts = []
    with torch.no_grad():
        for batch in read_batches([shard], LOOKED_AT, rng):
            size = len(batch)
            mirror = torch.zeros(size, dtype=torch.bool)
            if number:
                batch = batch.with_motion_prior(rng)
                mirror = torch.rand(size, generator=draw) < 0.5
            lots = torch.rand(size, 2, generator=draw)
            parts.append(_looked(network, batch, mirror, options.refits, lots))
    return _joined(parts)


def _looked(
    network: PWVO,
    batch: HypothesisBatch,
    mirror: torch.Tensor,
    refits: int,
    lots: torch.Tensor,
) -> ScoreBatch:
    """The features of both looks at a batch."""
    looks = TwoLooks(network, batch, mirror)
    seen = [_Seen(looks.looks, looks.first)]
    second = looks.second(refits, lots)
    if second is not None:
        seen.append(_Seen(looks.last, second[0]))
    return ScoreBatch(
        x3=torch.cat([each.looks.features[2] for each in seen]),
        scalars=torch.cat([each.looks.scalars for each in seen]),
        cost=torch.cat([unexplained(each.looks, each.maps) for each in seen]),
        error=looks.error,
        owner=looks.owner,
        limit=batch.limit,
    )


class _Seen(NamedTuple):
    """A look at motions, and the maps of it."""

    looks: Looks
    maps: HypothesisMaps


def unexplained(looks: Looks, maps: HypothesisMaps) -> torch.Tensor:
    """(N,) the mean robust cost over the pixels that are static if a motion is right, 0 to 1.

    1 - w, w the weight that a pixel has in the robust fit of the motion.
    """
    static = torch.sigmoid(maps.static) * looks.usable
    support = looks.evidence[:, 0]
    total = static.sum((1, 2)).clamp(min=1.0)
    return (static * (1 - support)).sum((1, 2)) / total


def _joined(batches: list[ScoreBatch]) -> ScoreBatch:
    """One batch of all samples."""
    first = 0
    owners = []
    for batch in batches:
        owners.append(batch.owner + first)
        first += len(batch)
    values = {
        field.name: torch.cat([getattr(batch, field.name) for batch in batches])
        for field in fields(ScoreBatch)
    }
    return ScoreBatch(**{**values, "owner": torch.cat(owners)})


def _checksum(network: PWVO) -> str:
    """Eight characters that change with the layers that are not trained."""
    summed = hashlib.sha256()
    for name, value in sorted(network.state_dict().items()):
        if not name.startswith(SCORE_LAYERS):
            summed.update(value.detach().cpu().contiguous().numpy().tobytes())
    return summed.hexdigest()[:8]


def _write(path: Path, batch: ScoreBatch) -> None:
    """Write features; those of the encoder in half precision."""
    arrays = {name: value.numpy() for name, value in vars(batch).items()}
    arrays["x3"] = arrays["x3"].astype(np.float16)
    with atomic_write(path, "wb") as file:
        np.savez(file, **arrays)


def _read(path: Path) -> ScoreBatch:
    """Read features."""
    with np.load(path) as file:
        arrays = {name: torch.as_tensor(value) for name, value in file.items()}
    return ScoreBatch(**{**arrays, "x3": arrays["x3"].float()})
