"""Options of a training: what stands in ``configs/train_*.yaml``."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import Field

from hybridvo.errors import InputError
from hybridvo.network.layers import NetworkOptions
from hybridvo.network.losses import LossOptions
from hybridvo.network.selection import SELECTION_METHODS
from hybridvo.network.selector_net import SelectorNetworkOptions
from hybridvo.options import Count, Positive, Share, option_group
from hybridvo.synthetic import dataset
from hybridvo.synthetic.dataset import Mixture, build_options, read_yaml

Below1 = Annotated[float, Field(ge=0, lt=1)]
NotNegative = Annotated[float, Field(ge=0)]


@option_group
class OptimizerOptions:
    """AdamW, decoupled weight decay and the gradient's largest norm; as published: Adam."""

    learning_rate: Positive = 1e-4
    betas: tuple[Below1, Below1] = (0.5, 0.999)
    weight_decay: NotNegative = 0.0
    clip_norm: Positive = 1.0


@option_group
class ScheduleOptions:
    """Factor on the learning rate over the run."""

    kind: Literal["halving", "cosine"] = "halving"
    warmup: Share = 0.0  # of the run, from 0
    # of the run: the paper's staircase
    halvings: tuple[Share, ...] = (0.25, 0.5, 0.75)
    final_share: Share = 0.0  # of the peak, at which cosine ends
    by: Literal["steps", "time"] = "steps"  # what the progress is counted by

    def factor(self, progress: float) -> float:
        """Factor on the peak learning rate when ``progress`` in [0, 1] of the run is done."""
        progress = min(max(progress, 0.0), 1.0)
        if progress < self.warmup:
            return max(progress / self.warmup, 1e-3)
        if self.kind == "halving":
            return 0.5 ** sum(progress >= p for p in self.halvings)
        done = (progress - self.warmup) / max(1.0 - self.warmup, 1e-9)
        return self.final_share + (1 - self.final_share) * 0.5 * (
            1 + math.cos(math.pi * done)
        )


@option_group
class RunOptions:
    """What every training has; the defaults are the paper's."""

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
class PwvoOptions(RunOptions):
    """A training of PWVO or of a baseline: ``configs/train_pwvo.yaml`` says what each option is."""

    network: NetworkOptions = NetworkOptions()
    loss: LossOptions = LossOptions()
    # of the network's pass; processors without bfloat16 take five times as long with it
    precision: Literal["float32", "bfloat16"] = "float32"
    moving_weight: NotNegative = 0.0  # of terms that the paper does not have
    fit_weight: NotNegative = 0.0
    selection: Literal[SELECTION_METHODS] = "softmax"  # type: ignore[valid-type]
    loss_stride: Count = 1
    data: Annotated[tuple[str, ...], Field(min_length=1)] = ("data_paper.yaml",)
    data_weights: tuple[NotNegative, ...] = (1.0,)
    # (height, width) instead of the presets' own
    data_size: tuple[Count, Count] | None = None

    def __post_init__(self) -> None:
        if self.loss_stride > 1 and (
            self.loss.flow_uncertainty or self.loss.depth_uncertainty
        ):
            raise InputError(
                "loss_stride: expected 1, or more with loss.flow_uncertainty and "
                "loss.depth_uncertainty off; weighed by s, every pixel counts"
            )
        certain = self.network.kind != "pwvo" or not self.network.uncertainty
        if certain and (self.fit_weight or self.loss.needs_uncertainty):
            raise InputError(
                "fit_weight and the *_uncertainty of the loss need a pwvo network with uncertainty"
            )
        if len(self.data) != len(self.data_weights) or not sum(self.data_weights):
            raise InputError(
                "data_weights: expected a share for each of data, not all of them 0"
            )


@option_group
class SelectorOptions(RunOptions):
    """A training of the selector; ``configs/train_selector.yaml`` says what each option is."""

    network: SelectorNetworkOptions = SelectorNetworkOptions()
    refits: Count = 2
    mask_weight: NotNegative = 1.0
    asked_share: Share = 0.5
    files: Count = 48


def load_pwvo_options(
    path: str | Path, changes: dict[str, Any] | None = None
) -> tuple[PwvoOptions, Mixture]:
    """Options of a ``configs/train_*.yaml`` under changes, and the data that they name."""
    path = Path(path)
    mapping = dataset.merged(read_yaml(path), changes or {})
    options = build_options(PwvoOptions, mapping, str(path))
    presets = [
        dataset.load_preset(path.parent / name, options.data_size)
        for name in options.data
    ]
    return options, Mixture(tuple(presets), options.data_weights)


def load_selector_options(path: str | Path) -> SelectorOptions:
    """Options of a ``configs/train_selector.yaml``."""
    return build_options(SelectorOptions, read_yaml(path), str(path))
