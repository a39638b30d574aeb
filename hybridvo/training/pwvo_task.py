"""Training of the pixel-wise networks and of the VONet baselines."""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import torch
import torch.nn.functional as F
from torch import nn
from torch.utils.data import DataLoader, Dataset

from hybridvo.network.losses import total_loss
from hybridvo.network.passes import first_motions
from hybridvo.network.pwvo import build_network
from hybridvo.network.selection import select_motion
from hybridvo.network.weighted_fit import fitted_motion
from hybridvo.results import PixelwisePrediction
from hybridvo.synthetic.dataset import Mixture
from hybridvo.synthetic.draws import TRAINING, sample_generator
from hybridvo.synthetic.layered import Sample
from hybridvo.training.options import PwvoOptions
from hybridvo.training.validation import (
    PUBLISHED_SEED,
    TrainingBatch,
    collate,
    evaluate_network,
    held_out,
)

FIT_FLOOR_PX = 0.05
FIT_LIMIT_PX = 100.0
"""px of the inputs: error of the fit below which their noise decides it, and the most that a pixel
is charged, also behind the camera."""


@dataclasses.dataclass
class _Drawn(Dataset[Sample]):
    """The training samples of a seed by their number."""

    mixture: Mixture
    seed: int

    def __getitem__(self, index: int) -> Sample:
        return self.mixture.sample(sample_generator(self.seed, index, TRAINING))


def sample_stream(
    mixture: Mixture, seed: int, start: int, batch_size: int, workers: int = 0
) -> Iterator[TrainingBatch]:
    """Endless batches of a mixture, from sample ``start`` of a seed, however many workers draw."""
    numbers: Any = (
        range(k, k + batch_size) for k in itertools.count(start, batch_size)
    )
    return iter(
        DataLoader(
            _Drawn(mixture, seed),
            batch_sampler=numbers,
            collate_fn=collate,
            num_workers=workers,
            multiprocessing_context="fork" if workers else None,
        )
    )


class PwvoTask:
    """One of the paper's networks, its data and its loss."""

    def __init__(self, options: PwvoOptions, mixture: Mixture) -> None:
        self.options = options
        self.mixture = mixture
        torch.manual_seed(options.seed)
        self.network = build_network(options.network)
        self.data = [dataclasses.asdict(preset) for preset in mixture.presets]

    def batches(self, samples: int, workers: int) -> Iterator[TrainingBatch]:
        """Batches of the run's stream from sample number ``samples`` on."""
        o = self.options
        return sample_stream(self.mixture, o.seed, samples, o.batch_size, workers)

    def loss(
        self, batch: TrainingBatch, step: int
    ) -> tuple[torch.Tensor, dict[str, torch.Tensor]]:
        """Loss of a batch and its parts."""
        half = self.options.precision == "bfloat16"
        with torch.autocast(batch.moving.device.type, torch.bfloat16, enabled=half):
            starts = self._starts(batch, step)
            output = self.network(
                batch.inputs, *(() if starts is None else (starts,))
            )
        o = self.options
        targets = batch.targets.subsample(self.options.loss_stride)
        loss, parts = total_loss(
            output, targets, o.loss, select_motion(output, o.selection)
        )
        extra = {
            "fit": (o.fit_weight, fit_loss),
            "moving": (o.moving_weight, separation_loss),
        }
        for name, (weight, term) in extra.items():
            if weight:
                value = term(output, batch, o)
                loss = loss + weight * value
                parts[name] = value.detach()
        return loss, parts

    def _starts(self, batch: TrainingBatch, step: int) -> torch.Tensor | None:
        """(B, 4, 4) first motions: none for half of the batch, the network's own for the rest."""
        passes = self.options.network.passes
        first = len(batch) // 2
        if passes == 1 or first == 0:
            return None
        count = 1 + step % (passes - 1)
        made, _ = first_motions(
            self.network, batch.inputs[first:], self.options.selection, count
        )
        assert made is not None
        return torch.cat([torch.eye(4).to(made).repeat(first, 1, 1), made])

    def evaluate(self, network: nn.Module, count: int) -> dict[str, Any]:
        """Figures on so many held-out pairs of each preset."""
        options = self.options
        found = {}
        for name, preset in zip(options.data, self.mixture.presets, strict=True):
            batches = held_out(preset, PUBLISHED_SEED, count)
            figures = evaluate_network(network, batches, options.selection)
            found[Path(name).stem] = {
                k: v for k, v in figures.items() if k != "epe_of_pairs"
            }
        return found


def fit_loss(
    output: PixelwisePrediction, batch: TrainingBatch, options: PwvoOptions
) -> torch.Tensor:
    """Log error of the ego flow that the fit to the trusted pixels gives, mean over pairs."""
    T = fitted_motion(output, batch.inputs, options.selection)
    gt = batch.targets.subsample(options.loss_stride)
    flow, _, defined = gt.reconstruct(T)
    known = (gt.depth_prev > 0) & torch.isfinite(gt.ego_flow).all(dim=1)
    error = torch.where(known[:, None], flow - gt.ego_flow, 0.0).abs().sum(1)
    error = torch.where(
        defined, error.clamp(max=FIT_LIMIT_PX), known * FIT_LIMIT_PX
    )
    mean = (
        options.loss_stride
        * error.flatten(1).sum(1)
        / known.flatten(1).sum(1).clamp(min=1)
    )
    return torch.log1p(mean / FIT_FLOOR_PX).mean()


def separation_loss(
    output: PixelwisePrediction, batch: TrainingBatch, options: PwvoOptions
) -> torch.Tensor:
    """Logistic bound of one minus the area under the ROC curve of s as a detector of movers.

    Over pixels of the whole batch: s has to tell movers apart across pairs as well.
    """
    s = output.log_scale
    if s is None:
        return output.motion.new_zeros(())
    cells = s.shape[2:]
    moving = F.interpolate(batch.moving[:, None].to(s.dtype), cells, mode="area")[
        :, 0
    ]
    valid = (
        F.interpolate(batch.inputs.valid[:, None].to(s.dtype), cells, mode="area")[
            :, 0
        ]
        > 0.5
    )
    apart = valid & (moving > 0.5), valid & (moving < 0.5)
    terms = []
    for half in s.split(3, dim=1):  # of the rotation, of the translation
        above, below = (half.mean(1)[kind] for kind in apart)
        if not len(above) or not len(below):
            return s.new_zeros(())
        # 700 of each kind make enough pairs; apart by a factor of three in U they count little
        above, below = (kind[:: -(-len(kind) // 700)] for kind in (above, below))
        terms.append(F.softplus(2.0 * (below[None] - above[:, None])).mean())
    return torch.stack(terms).mean()
