"""Options of a training: the content of ``configs/train_*.yaml``."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Annotated, Any, Literal, NamedTuple

from pydantic import Field

from hybridvo.core.errors import InputError
from hybridvo.core.options import Count, Fraction, Positive, option_group
from hybridvo.network.pwvo import PWVOOptions
from hybridvo.network.selection import SELECTION_METHODS
from hybridvo_lab.paper.layers import NetworkOptions
from hybridvo_lab.paper.losses import LossOptions
from hybridvo_lab.synthetic import dataset
from hybridvo_lab.synthetic.dataset import Mixture, build_options, read_yaml

Below1 = Annotated[float, Field(ge=0, lt=1)]
NotNegative = Annotated[float, Field(ge=0)]
MIN_WARMUP_FACTOR = 1e-3
"""Factor on the learning rate in the first update: zero would waste it."""


@option_group
class OptimizerOptions:
    """Options of AdamW (without weight decay it is Adam, as
    published), and gradient clipping.
    """

    learning_rate: Positive = 1e-4
    betas: tuple[Below1, Below1] = (0.5, 0.999)
    weight_decay: NotNegative = 0.0  # decoupled
    clip_norm: Positive = 1.0  # largest norm of the gradient


@option_group
class ScheduleOptions:
    """Factor on the learning rate over the run."""

    kind: Literal["halving", "cosine"] = "halving"
    warmup: Fraction = 0.0  # fraction of the run in which the rate rises from 0
    # fractions of the run after which the rate is halved, as in the paper
    halvings: tuple[Fraction, ...] = (0.25, 0.5, 0.75)
    final_share: Fraction = 0.0  # fraction of the peak at which cosine ends
    by: Literal["steps", "time"] = "steps"  # how the progress is measured

    def factor(self, progress: float) -> float:
        """Factor on the peak learning rate when ``progress`` in
        [0, 1] of the run is done.

        >>> ScheduleOptions(kind="halving", halvings=(0.5,)).factor(0.6)
        0.5
        """
        progress = min(max(progress, 0.0), 1.0)
        if progress < self.warmup:
            return max(progress / self.warmup, MIN_WARMUP_FACTOR)
        if self.kind == "halving":
            return 0.5 ** sum(progress >= p for p in self.halvings)
        done = (progress - self.warmup) / max(1.0 - self.warmup, 1e-9)
        falling = 0.5 * (1 + math.cos(math.pi * done))
        return self.final_share + (1 - self.final_share) * falling


@option_group
class TrainingRun:
    """Options of every training; the defaults are the paper's."""

    seed: int = 0
    steps: Count = 100_000
    batch_size: Count = 100
    # of the running average of the weights, which is what is exported
    ema_decay: Below1 = 0.0
    optimizer: OptimizerOptions = OptimizerOptions()
    schedule: ScheduleOptions = ScheduleOptions()
    checkpoint_minutes: Positive = 5.0
    log_every: Count = 50


@option_group
class PaperTrainingOptions(TrainingRun):
    """Options of a training of PWVO or of a baseline.

    ``configs/train_paper.yaml`` explains them.
    """

    network: NetworkOptions = NetworkOptions()
    loss: LossOptions = LossOptions()
    # of the network's forward pass; processors without bfloat16 take five times as
    # long with it
    precision: Literal["float32", "bfloat16"] = "float32"
    moving_weight: NotNegative = 0.0  # of terms that the paper does not have
    fit_weight: NotNegative = 0.0
    selection: Literal[SELECTION_METHODS] = "softmax"  # type: ignore[valid-type]
    loss_stride: Count = 1
    data: Annotated[tuple[str, ...], Field(min_length=1)] = ("data_paper.yaml",)
    data_weights: tuple[NotNegative, ...] = (1.0,)
    # (height, width) in place of the presets' own
    data_size: tuple[Count, Count] | None = None

    def __post_init__(self) -> None:
        weighs_flow = self.loss.flow_uncertainty or self.loss.depth_uncertainty
        if self.loss_stride > 1 and weighs_flow:
            raise InputError(
                "loss_stride: expected 1, or more with loss.flow_uncertainty and "
                "loss.depth_uncertainty off; a loss that is weighted by s uses every pixel"
            )
        has_uncertainty = self.network.kind == "pwvo" and self.network.uncertainty
        wants_uncertainty = self.fit_weight or self.loss.needs_uncertainty
        if wants_uncertainty and not has_uncertainty:
            raise InputError(
                "fit_weight and the *_uncertainty of the loss need a pwvo network with uncertainty"
            )
        if len(self.data) != len(self.data_weights) or not sum(self.data_weights):
            raise InputError(
                "data_weights: expected a weight for each of data, not all of them 0"
            )


@option_group
class PWVOTrainingOptions(TrainingRun):
    """Options of a training of PWVO.

    ``configs/train_pwvo.yaml`` explains them.
    """

    network: PWVOOptions = PWVOOptions()
    layers: Literal["all", "score"] = "all"  # which are trained
    refits: Count = 2
    mask_weight: NotNegative = 1.0
    pose_weight: NotNegative = 0.1
    no_motion_share: Fraction = 0.3
    files: Count = 48


class PaperRecipe(NamedTuple):
    """A training of PWVO or of a baseline, and the data that it names."""

    options: PaperTrainingOptions
    mixture: Mixture


def load_paper_options(
    path: str | Path, changes: dict[str, Any] | None = None
) -> PaperRecipe:
    """Read a ``configs/train_*.yaml`` and the presets that it names.

    Args:
        path: the file.
        changes: options laid over those of the file, as nested mappings.
    """
    path = Path(path)
    mapping = dataset.merged(read_yaml(path), changes or {})
    options = build_options(PaperTrainingOptions, mapping, str(path))
    presets = [
        dataset.load_preset(path.parent / name, options.data_size)
        for name in options.data
    ]
    return PaperRecipe(options, Mixture(tuple(presets), options.data_weights))


def load_training_options(path: str | Path) -> PWVOTrainingOptions:
    """Read a ``configs/train_pwvo.yaml``."""
    return build_options(PWVOTrainingOptions, read_yaml(path), str(path))
