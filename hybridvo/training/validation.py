"""Batches of samples, and figures of a network on held-out synthetic pairs."""

from __future__ import annotations

import functools
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
import torch.nn.functional as F
from scipy.stats import mannwhitneyu, spearmanr
from torch.utils.data import default_collate

from hybridvo.errors import InputError
from hybridvo.network.inputs import NetworkInputs, assemble_inputs
from hybridvo.network.losses import LossTargets
from hybridvo.network.passes import predict
from hybridvo.network.selection import select_pose
from hybridvo.results import PixelwisePrediction
from hybridvo.synthetic.dataset import Preset
from hybridvo.synthetic.draws import sample_generator
from hybridvo.synthetic.layered import Sample
from hybridvo.torch_geometry import euler_motion, euler_transform
from hybridvo.types import PairBatch

PUBLISHED_SEED = 1000
"""First seed of published figures; smaller ones are for development. No training sees either."""
EPE_LIMIT_PX = 400.0
"""Pixels with a true ego flow of this length or more count as 0 in EPE, as published."""
FIGURES = ("r_err_deg", "t_err", "epe")
BATCH = 20


@dataclass(frozen=True)
class TrainingBatch:
    """Fields of B samples; what networks and losses take of them is made where they are."""

    fields: dict[str, torch.Tensor]

    def __len__(self) -> int:
        return len(self.moving)

    def to(self, device: torch.device | str) -> TrainingBatch:
        """Copy on another device."""
        return TrainingBatch(
            {name: field.to(device) for name, field in self.fields.items()}
        )

    @property
    def moving(self) -> torch.Tensor:
        """(B, h, w) bool, pixels that move."""
        return self.fields["moving"]

    @functools.cached_property
    def inputs(self) -> NetworkInputs:
        """Inputs of a network."""
        of = self.fields
        K = self.fields["K"]
        pairs = PairBatch(of["flow"], of["depth_prev"], K, K, of["depth_curr"])
        return assemble_inputs(pairs, None, is_aligned=True)

    @functools.cached_property
    def targets(self) -> LossTargets:
        """Ground truth of the losses."""
        of = self.fields
        K = self.fields["K"]
        truth = euler_motion(of["T_curr_prev"]), of["ego_flow"].permute(0, 3, 1, 2)
        return LossTargets(*truth, of["depth_true"], of["depth_target"], K, K)


def collate(samples: Sequence[Sample]) -> TrainingBatch:
    """Batch of at least one sample, all of one size."""
    return TrainingBatch(default_collate([vars(sample) for sample in samples]))


def held_out(preset: Preset, seed: int, count: int) -> list[TrainingBatch]:
    """Batches of the samples 0 to ``count`` - 1 of a seed; of a folder, as it was drawn."""
    preset = (
        preset.for_evaluation() if hasattr(preset, "for_evaluation") else preset
    )
    samples = [preset.sample(sample_generator(seed, i)) for i in range(count)]
    return [
        collate(samples[first : first + BATCH]) for first in range(0, count, BATCH)
    ]


def area_under_curve(score: np.ndarray, label: np.ndarray) -> float | None:
    """Area under the ROC curve of a score (N,) for a label (N,) bool; None if a class is absent."""
    if label.all() or not label.any():
        return None
    wins = mannwhitneyu(score[label], score[~label], method="asymptotic").statistic
    return float(wins) / (int(label.sum()) * int((~label).sum()))


def evaluate_network(
    network: torch.nn.Module,
    batches: Sequence[TrainingBatch],
    selection: str = "softmax",
) -> dict[str, Any]:
    """Errors of a network's selected pose on :func:`held_out` samples.

    The paper's component means, EPE in px at the sample's size; ``zero_*``: of zero motion;
    ``auroc_*``: of s as a detector of moving pixels; ``spearman_*``: of s and the pixel's error;
    ``median_ratio_*``: median of |error| / exp(s), 0.69 where s is calibrated.
    """
    if not batches:
        raise InputError(
            "evaluate_network: expected at least one batch of samples, got none."
        )
    device = next(network.parameters()).device
    errors = []
    pixels = []
    for batch in batches:
        batch = batch.to(device)
        with torch.inference_mode():
            output = predict(network, batch.inputs, selection)
            errors.append(_errors(output, batch, selection))
            if output.log_scale is not None:
                pixels.append(_uncertainty(output, batch))
    table = np.concatenate(errors)
    names = (*FIGURES, *(f"zero_{name}" for name in FIGURES))
    result: dict[str, Any] = dict(
        zip(names, table.mean(axis=0).tolist(), strict=True)
    )
    result |= {"count": len(table), "epe_of_pairs": table[:, 2].round(5).tolist()}
    for half, name in enumerate(("rotation", "translation")):
        figures = _uncertainty_figures([p for batch in pixels for p in batch[half]])
        result |= {f"{key}_{name}": value for key, value in figures.items()}
    return result


def _errors(
    output: PixelwisePrediction, batch: TrainingBatch, selection: str
) -> np.ndarray:
    """(B, 6) R_err, T_err and EPE of the network and of zero motion."""
    gt = batch.targets
    motion = select_pose(output, selection)
    flow, _, defined = gt.reconstruct(euler_transform(motion))
    near = gt.ego_flow.norm(dim=1) < EPE_LIMIT_PX
    # Sky has no depth to reproject; a point behind the camera has no flow: neither counts.
    counts = defined & near
    total = (defined | ~near).flatten(1).sum(1).clamp(min=1)
    columns = []
    for m, f in (
        (motion, flow),
        (torch.zeros_like(motion), torch.zeros_like(flow)),
    ):
        error = torch.where(counts[:, None], (f - gt.ego_flow).abs(), 0.0).mean(
            dim=1
        )
        columns += [x.mean(1) for x in (m - gt.motion).abs().split(3, dim=1)]
        columns.append(error.flatten(1).sum(1) / total)
    return torch.stack(columns, dim=1).double().cpu().numpy()


def _uncertainty(
    output: PixelwisePrediction, batch: TrainingBatch
) -> list[list[np.ndarray]]:
    """Of both halves, each pair's pixels (N, 6): moving, mean s, mean |error|, |error| / U."""
    gt = batch.targets
    size = batch.moving.shape[1:]
    pick = np.s_[..., ::4, ::4]  # enough for the figures
    halves = []
    errors = (output.motion - gt.motion[:, :, None, None]).abs()
    assert output.log_scale is not None
    for error, s in zip(
        errors.split(3, 1), output.log_scale.split(3, 1), strict=True
    ):
        maps = [
            s.mean(1, keepdim=True),
            error.mean(1, keepdim=True),
            error * (-s).exp(),
        ]
        table = F.interpolate(
            torch.cat(maps, dim=1).float(), size=size, mode="nearest"
        )
        table = torch.cat([batch.moving[:, None].float(), table], dim=1)[
            pick
        ].permute(0, 2, 3, 1)
        pairs = zip(table, batch.inputs.valid[pick], strict=True)
        halves.append([pair[valid].cpu().numpy() for pair, valid in pairs])
    return halves


def _uncertainty_figures(pairs: list[np.ndarray]) -> dict[str, float | None]:
    """Figures of one half; the rank correlation is the mean of that inside each pair."""
    if not pairs:
        return dict.fromkeys(("auroc", "spearman", "median_ratio"))
    table = np.concatenate(pairs)
    # where s or the error is constant there is no rank correlation
    listed = [
        p[:, 1:3] for p in pairs if len(p) and np.ptp(p[:, 1:3], axis=0).all()
    ]
    return {
        "auroc": area_under_curve(table[:, 1], table[:, 0] > 0.5),
        "spearman": float(np.mean([spearmanr(x).statistic for x in listed]))
        if listed
        else None,
        "median_ratio": float(np.median(table[:, 3:])),
    }
