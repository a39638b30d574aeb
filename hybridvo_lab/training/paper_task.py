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

from hybridvo.core.errors import InputError
from hybridvo.core.results import PixelwisePrediction
from hybridvo.network.selection import select_motion
from hybridvo_lab.paper.losses import total_loss
from hybridvo_lab.paper.networks import build_network
from hybridvo_lab.paper.weighted_fit import fitted_motion
from hybridvo_lab.synthetic.dataset import Mixture
from hybridvo_lab.synthetic.draws import TRAINING, sample_generator
from hybridvo_lab.synthetic.paper_samples import Sample
from hybridvo_lab.training import ranks
from hybridvo_lab.training.options import PaperTrainingOptions
from hybridvo_lab.training.validation import (
    PUBLISHED_SEED,
    TrainingBatch,
    collate,
    evaluate_network,
    held_out,
)

FIT_FLOOR_PX = 0.05
"""Error of the fit, px of the inputs, below which the noise
of the inputs decides it."""
FIT_LIMIT_PX = 100.0
"""Largest error that counts for a pixel; that of points behind the camera."""
MAX_PAIR_PIXELS = 700
"""Pixels of each kind that are compared: these make 490 000 comparisons."""
SEPARATION_SLOPE = 2.0
"""Slope of the logistic bound: where s differs by a factor of
three in U the loss is small."""


@dataclasses.dataclass
class _DrawnSamples(Dataset[Sample]):
    """The training samples of a seed by their number."""

    mixture: Mixture
    seed: int

    def __getitem__(self, index: int) -> Sample:
        return self.mixture.sample(sample_generator(self.seed, index, TRAINING))


def sample_stream(
    mixture: Mixture, seed: int, start: int, batch_size: int, workers: int = 0
) -> Iterator[TrainingBatch]:
    """Endless batches of a mixture; the number of workers does not change them.

    Of several ranks, each draws its part of every batch.

    Args:
        mixture: the presets to draw from.
        seed: the seed of the stream.
        start: number of the first sample.
        batch_size: samples of a batch.
        workers: processes that draw; 0: this one.
    """
    numbers: Any = (
        ranks.part(range(first, first + batch_size))
        for first in itertools.count(start, batch_size)
    )
    return iter(
        DataLoader(
            _DrawnSamples(mixture, seed),
            batch_sampler=numbers,
            collate_fn=collate,
            num_workers=workers,
            multiprocessing_context="fork" if workers else None,
        )
    )


class PaperTask:
    """One of the paper's networks, its data and its loss."""

    def __init__(self, options: PaperTrainingOptions, mixture: Mixture) -> None:
        self.options = options
        self.mixture = mixture
        torch.manual_seed(options.seed)
        self.network = build_network(options.network)
        self.data = [dataclasses.asdict(preset) for preset in mixture.presets]

    def batches(self, samples: int, workers: int) -> Iterator[TrainingBatch]:
        """Batches of the run's stream from sample number ``samples`` on."""
        seed = self.options.seed
        size = self.options.batch_size
        if size % ranks.count():
            raise InputError(
                f"batch_size: {size} samples cannot be divided among {ranks.count()} processes."
            )
        return sample_stream(self.mixture, seed, samples, size, workers)

    def count(self, batch: TrainingBatch) -> int:
        """Samples of a batch, the parts of other ranks included."""
        return ranks.count() * len(batch)

    def loss(
        self, batch: TrainingBatch, step: int
    ) -> tuple[torch.Tensor, dict[str, torch.Tensor]]:
        """Loss of a batch in update ``step``, and its parts by name, detached."""
        options = self.options
        output = self._predict(batch)
        targets = batch.targets.subsample(options.loss_stride)
        motion = select_motion(output, options.selection)
        loss, parts = total_loss(output, targets, options.loss, motion)
        if options.fit_weight:
            fit = fit_loss(output, batch, options)
            loss = loss + options.fit_weight * fit
            parts["fit"] = fit.detach()
        if options.moving_weight:
            moving = separation_loss(output, batch)
            loss = loss + options.moving_weight * moving
            parts["moving"] = moving.detach()
        return loss, parts

    def _predict(self, batch: TrainingBatch) -> PixelwisePrediction:
        """The network's maps, in the precision of the run."""
        is_half = self.options.precision == "bfloat16"
        device = batch.moving.device.type
        with torch.autocast(device, torch.bfloat16, enabled=is_half):
            return self.network(batch.inputs)

    def evaluate(self, network: nn.Module, count: int) -> dict[str, Any]:
        """Figures on ``count`` held-out pairs of each preset, by its name."""
        options = self.options
        by_preset = {}
        for name, preset in zip(options.data, self.mixture.presets, strict=True):
            batches = held_out(preset, PUBLISHED_SEED, count)
            figures = evaluate_network(network, batches, options.selection)
            del figures["epe_of_pairs"]
            by_preset[Path(name).stem] = figures
        return by_preset


def fit_loss(
    output: PixelwisePrediction, batch: TrainingBatch, options: PaperTrainingOptions
) -> torch.Tensor:
    """Logarithm of the ego-flow error of the fit to the pixels of low uncertainty.

    The mean over pairs of log(1 + e / FIT_FLOOR_PX), e the
    mean error of a pair in px.
    """
    T = fitted_motion(output, batch.inputs, options.selection)
    gt = batch.targets.subsample(options.loss_stride)
    flow, _, is_defined = gt.reconstruct(T)
    known = (gt.depth_prev > 0) & torch.isfinite(gt.ego_flow).all(dim=1)
    error = torch.where(known[:, None], flow - gt.ego_flow, 0.0).abs().sum(1)
    limited = error.clamp(max=FIT_LIMIT_PX)
    error = torch.where(is_defined, limited, known * FIT_LIMIT_PX)
    total = options.loss_stride * error.flatten(1).sum(1)
    mean = total / known.flatten(1).sum(1).clamp(min=1)
    return torch.log1p(mean / FIT_FLOOR_PX).mean()


def separation_loss(
    output: PixelwisePrediction, batch: TrainingBatch
) -> torch.Tensor:
    """Logistic bound of one minus the area under the ROC curve of s,
    which detects moving pixels.

    Pixels of the entire batch are compared, or of a rank's part of it: s has to be larger
    on moving objects across pairs too.
    """
    s = output.log_scale
    if s is None:
        return output.motion.new_zeros(())
    moving = _resized(batch.moving, s)
    valid = _resized(batch.inputs.valid, s) > 0.5
    is_moving = valid & (moving > 0.5)
    is_static = valid & (moving < 0.5)
    terms = []
    for part in s.split(3, dim=1):  # of the rotation, of the translation
        mean = part.mean(1)
        above = mean[is_moving]
        below = mean[is_static]
        if not len(above) or not len(below):
            return s.new_zeros(())
        above = _thinned(above)
        below = _thinned(below)
        margin = below[None] - above[:, None]
        terms.append(F.softplus(SEPARATION_SLOPE * margin).mean())
    return torch.stack(terms).mean()


def _resized(mask: torch.Tensor, maps: torch.Tensor) -> torch.Tensor:
    """A mask (B, H, W) as fractions (B, h, w) on the grid of ``maps`` (B, C, h, w)."""
    values = mask[:, None].to(maps.dtype)
    return F.interpolate(values, maps.shape[2:], mode="area")[:, 0]


def _thinned(values: torch.Tensor) -> torch.Tensor:
    """Every n-th value, so that at most MAX_PAIR_PIXELS are left."""
    stride = -(-len(values) // MAX_PAIR_PIXELS)
    return values[::stride]
