"""Batches of samples, and figures of a network on held-out synthetic pairs."""

from __future__ import annotations

import functools
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import torch
import torch.nn.functional as F
from scipy.stats import mannwhitneyu, spearmanr
from torch.utils.data import default_collate

from hybridvo.core.errors import InputError
from hybridvo.core.results import PixelwisePrediction
from hybridvo.core.types import PairBatch
from hybridvo.network.euler import euler_motion, euler_transform
from hybridvo.network.selection import select_pose
from hybridvo_lab.calibration import (
    MAX_RIGHT_PX,
    RIGHT_FACTOR,
    WRONG_PX,
)
from hybridvo_lab.paper.inputs import NetworkInputs, assemble_inputs
from hybridvo_lab.paper.losses import LossTargets
from hybridvo_lab.synthetic.dataset import Preset
from hybridvo_lab.synthetic.draws import sample_generator
from hybridvo_lab.synthetic.paper_samples import Sample

PUBLISHED_SEED = 1000
"""First seed of published figures; smaller ones are for development.
No training uses either."""
EPE_LIMIT_PX = 400.0
"""Pixels with a true ego flow of this length or more count
as 0 in EPE, as published."""
FIGURES = ("r_err_deg", "t_err", "epe")
"""The paper's three errors: degrees, metres, px."""
BATCH = 20
"""Held-out samples of a batch."""
PIXEL_STRIDE = 4
"""Every so many-th pixel is enough for the figures of the uncertainty."""


@dataclass(frozen=True)
class TrainingBatch:
    """Fields of B samples, by the names of
    :class:`~hybridvo_lab.synthetic.paper_samples.Sample`.
    """

    fields: dict[str, torch.Tensor]

    def __len__(self) -> int:
        return len(self.moving)

    def to(self, device: torch.device | str) -> TrainingBatch:
        """Copy to another device."""
        moved = {name: field.to(device) for name, field in self.fields.items()}
        return TrainingBatch(moved)

    @property
    def moving(self) -> torch.Tensor:
        """(B, h, w) bool, pixels that move."""
        return self.fields["moving"]

    @functools.cached_property
    def inputs(self) -> NetworkInputs:
        """Inputs of a network."""
        fields = self.fields
        pairs = PairBatch(
            fields["flow"],
            fields["depth_prev"],
            fields["K"],
            fields["K"],
            fields["depth_curr"],
        )
        return assemble_inputs(pairs, None, is_aligned=True)

    @functools.cached_property
    def targets(self) -> LossTargets:
        """Ground truth of the losses."""
        fields = self.fields
        return LossTargets(
            euler_motion(fields["T_curr_prev"]),
            fields["ego_flow"].permute(0, 3, 1, 2),
            fields["depth_true"],
            fields["depth_target"],
            fields["K"],
            fields["K"],
        )


def collate(samples: Sequence[Sample]) -> TrainingBatch:
    """Batch of at least one sample, all of one size."""
    return TrainingBatch(default_collate([vars(sample) for sample in samples]))


def held_out(preset: Preset, seed: int, count: int) -> list[TrainingBatch]:
    """Batches of the samples 0 to ``count`` - 1 of a seed, which no training uses."""
    samples = [preset.sample(sample_generator(seed, i)) for i in range(count)]
    return [
        collate(samples[first : first + BATCH]) for first in range(0, count, BATCH)
    ]


def allowed_error_px(oracle_px: float, least_px: float = WRONG_PX) -> float:
    """Largest error of a right motion, px.

    Args:
        oracle_px: error of the fit to the true static pixels: flow, depth and the
            ground truth of recordings allow no better.
        least_px: what is right at any rate.

    >>> allowed_error_px(0.2), allowed_error_px(0.5), allowed_error_px(4.0)
    (1.0, 1.5, 3.0)
    """
    return max(least_px, min(RIGHT_FACTOR * oracle_px, MAX_RIGHT_PX))


def area_under_curve(score: np.ndarray, label: np.ndarray) -> float | None:
    """Area under the ROC curve of a score (N,) for a label (N,) bool.

    None if a class is absent.

    >>> score = np.array([0.1, 0.4, 0.35, 0.8])
    >>> area_under_curve(score, np.array([False, False, True, True]))
    0.75
    """
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

    Args:
        network: PWVO or a baseline.
        batches: at least one batch.
        selection: rule by which a pose is selected from the maps.

    Returns:
        ``r_err_deg``, ``t_err``, ``epe``: the paper's component means, EPE in
        px at the sample's size. ``zero_*``: the same of zero motion. ``count``
        and ``epe_of_pairs``. For each of rotation and translation ``auroc_*``:
        of s as a detector of moving pixels; ``spearman_*``: rank correlation of
        s and the pixel's error; ``median_ratio_*``: median of |error| / exp(s),
        0.69 where s is calibrated.
    """
    if not batches:
        raise InputError(
            "evaluate_network: expected at least one batch of samples, got none."
        )
    device = next(network.parameters()).device
    errors = []
    uncertainties = []
    for batch in batches:
        batch = batch.to(device)
        with torch.inference_mode():
            output = network(batch.inputs)
            errors.append(_errors(output, batch, selection))
            if output.log_scale is not None:
                uncertainties.append(_uncertainty(output, batch))

    table = np.concatenate(errors)
    names = (*FIGURES, *(f"zero_{name}" for name in FIGURES))
    means = table.mean(axis=0).tolist()
    result: dict[str, Any] = dict(zip(names, means, strict=True))
    result["count"] = len(table)
    result["epe_of_pairs"] = table[:, FIGURES.index("epe")].round(5).tolist()
    rotation = [pixels for each in uncertainties for pixels in each.rotation]
    translation = [pixels for each in uncertainties for pixels in each.translation]
    for key, value in _uncertainty_figures(rotation).items():
        result[f"{key}_rotation"] = value
    for key, value in _uncertainty_figures(translation).items():
        result[f"{key}_translation"] = value
    return result


def _errors(
    output: PixelwisePrediction, batch: TrainingBatch, selection: str
) -> np.ndarray:
    """(B, 6) R_err, T_err and EPE of the network and of zero motion."""
    gt = batch.targets
    motion = select_pose(output, selection)
    flow, _, is_defined = gt.reconstruct(euler_transform(motion))
    is_near = gt.ego_flow.norm(dim=1) < EPE_LIMIT_PX
    # Sky has no depth to reproject; a point behind the camera has no flow: neither
    # counts.
    counts = is_defined & is_near
    total = (is_defined | ~is_near).flatten(1).sum(1).clamp(min=1)

    def columns(motion: torch.Tensor, flow: torch.Tensor) -> list[torch.Tensor]:
        """R_err, T_err and EPE (B,) of a motion (B, 6) and
        its ego flow (B, 2, H, W).
        """
        difference = (motion - gt.motion).abs()
        rotation = difference[:, :3].mean(1)
        translation = difference[:, 3:].mean(1)
        away = (flow - gt.ego_flow).abs()
        away = torch.where(counts[:, None], away, 0.0).mean(dim=1)
        return [rotation, translation, away.flatten(1).sum(1) / total]

    ours = columns(motion, flow)
    zero = columns(torch.zeros_like(motion), torch.zeros_like(flow))
    return torch.stack(ours + zero, dim=1).double().cpu().numpy()


class _Uncertainty(NamedTuple):
    """Pixels of each pair, (N, 6) with the columns MOVING to RATIOS below."""

    rotation: list[np.ndarray]
    translation: list[np.ndarray]


MOVING = 0
"""Column of the label: whether the pixel moves."""
SCALE = 1
"""Column of the mean s."""
ERROR = 2
"""Column of the mean |error|."""
RATIOS = slice(3, 6)
"""Columns of |error| / U of the three components."""


def _uncertainty(output: PixelwisePrediction, batch: TrainingBatch) -> _Uncertainty:
    """The uncertainty and error of the pixels of a batch."""
    gt = batch.targets
    assert output.log_scale is not None
    error = (output.motion - gt.motion[:, :, None, None]).abs()
    rotation_error, translation_error = error.split(3, dim=1)
    rotation_scale, translation_scale = output.log_scale.split(3, dim=1)
    return _Uncertainty(
        _pixel_table(rotation_error, rotation_scale, batch),
        _pixel_table(translation_error, translation_scale, batch),
    )


def _pixel_table(
    error: torch.Tensor, log_scale: torch.Tensor, batch: TrainingBatch
) -> list[np.ndarray]:
    """Valid pixels (N, 6) of each pair, of errors and log scales (B, 3, h, w)."""
    mean_scale = log_scale.mean(1, keepdim=True)
    mean_error = error.mean(1, keepdim=True)
    maps = torch.cat([mean_scale, mean_error, error * (-log_scale).exp()], dim=1)
    size = batch.moving.shape[1:]
    maps = F.interpolate(maps.float(), size=size, mode="nearest")
    table = torch.cat([batch.moving[:, None].float(), maps], dim=1)
    pick = np.s_[..., ::PIXEL_STRIDE, ::PIXEL_STRIDE]
    pixels = table[pick].permute(0, 2, 3, 1)
    valid = batch.inputs.valid[pick]
    return [
        pixels_of_pair[valid_of_pair].cpu().numpy()
        for pixels_of_pair, valid_of_pair in zip(pixels, valid, strict=True)
    ]


def _uncertainty_figures(pairs: list[np.ndarray]) -> dict[str, float | None]:
    """Figures of rotation or translation.

    The rank correlation is the mean of that in each pair.
    """
    if not pairs:
        return dict.fromkeys(("auroc", "spearman", "median_ratio"))
    table = np.concatenate(pairs)
    correlations = []
    for pixels in pairs:
        # where s or the error is constant there is no rank correlation
        both = pixels[:, [SCALE, ERROR]]
        if len(both) and np.ptp(both, axis=0).all():
            correlations.append(spearmanr(both).statistic)
    return {
        "auroc": area_under_curve(table[:, SCALE], table[:, MOVING] > 0.5),
        "spearman": float(np.mean(correlations)) if correlations else None,
        "median_ratio": float(np.median(table[:, RATIOS])),
    }
