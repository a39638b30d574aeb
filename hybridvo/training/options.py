"""Options of a training run: the frozen dataclasses behind ``configs/train_*.yaml``."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from pathlib import Path

from hybridvo.data.presets import build_options, load_preset, read_yaml
from hybridvo.errors import InputError
from hybridvo.network.losses import LossOptions
from hybridvo.network.pwvo import NetworkOptions
from hybridvo.training.stream import Mixture

__all__ = ["OptimizerOptions", "ScheduleOptions", "TrainingOptions", "load_training_options"]


@dataclass(frozen=True)
class OptimizerOptions:
    """Adam; the defaults are the published ones.

    Args:
        learning_rate: at its peak.
        betas: of Adam.
        clip_norm: largest global norm of the gradient.
        head_rate: factor on the rate of the motion heads' last layer. Its output is scaled by
            0.01; at the common rate a short run spends itself on growing that layer's weights. 100
            undoes the scale for Adam.

    Raises:
        InputError: a rate or a norm that is not positive, betas outside [0, 1).
    """

    learning_rate: float = 1e-4
    betas: tuple[float, float] = (0.5, 0.999)
    clip_norm: float = 1.0
    head_rate: float = 1.0

    def __post_init__(self) -> None:
        if not (self.learning_rate > 0 and self.clip_norm > 0 and self.head_rate > 0):
            raise InputError(
                "OptimizerOptions: expected learning_rate, clip_norm and head_rate above 0."
            )
        if not all(0 <= beta < 1 for beta in self.betas):
            raise InputError(f"OptimizerOptions.betas: expected 0 <= beta < 1, got {self.betas}.")


@dataclass(frozen=True)
class ScheduleOptions:
    """Factor on the learning rate over the run, of which p in [0, 1] is done.

    Args:
        kind: ``halving`` (the paper's staircase), ``cosine`` or ``constant``.
        warmup: share of the run over which the rate grows from 0.
        halvings: shares of the run at which ``halving`` halves.
        final_share: share of the peak at which ``cosine`` ends.
        by: ``steps`` = p counts updates (bit-equal however often the run is cut), ``time`` = p is
            the larger of that and the share of the time limit that is spent.

    Raises:
        InputError: an unknown word or a share outside [0, 1].
    """

    kind: str = "halving"
    warmup: float = 0.0
    halvings: tuple[float, ...] = (0.25, 0.5, 0.75)
    final_share: float = 0.0
    by: str = "steps"

    def __post_init__(self) -> None:
        if self.kind not in ("halving", "cosine", "constant"):
            raise InputError(
                f"ScheduleOptions.kind: expected halving, cosine or constant, got {self.kind!r}."
            )
        if self.by not in ("steps", "time"):
            raise InputError(f"ScheduleOptions.by: expected steps or time, got {self.by!r}.")
        if not all(0 <= p <= 1 for p in (self.warmup, self.final_share, *self.halvings)):
            raise InputError("ScheduleOptions: expected shares of the run in [0, 1].")

    def factor(self, progress: float) -> float:
        """Factor on the peak learning rate when ``progress`` in [0, 1] of the run is done."""
        progress = min(max(progress, 0.0), 1.0)
        if progress < self.warmup:
            return max(progress / self.warmup, 1e-3)
        if self.kind == "halving":
            return 0.5 ** sum(progress >= p for p in self.halvings)
        if self.kind == "cosine":
            done = (progress - self.warmup) / max(1.0 - self.warmup, 1e-9)
            share = 0.5 * (1 + math.cos(math.pi * done))
            return self.final_share + (1 - self.final_share) * share
        return 1.0


@dataclass(frozen=True)
class TrainingOptions:
    """A whole run; the defaults are the paper's.

    Args:
        network: kind and shapes.
        loss: terms and switches.
        translation_loss: ``direction`` (the paper's: direction and length) or ``laplace``
            (L1 of each component in metres with its own s: exp(s) is then in metres).
        moving_weight: weight of a term that the paper does not have: s of the rotation should be
            larger on moving pixels than on static ones. 0 = none, as in the paper, whose s need
            not tell the two apart once every pixel knows the answer of its neighbours.
        fit_weight: weight of the error of the motion that the trusted pixels agree on, with the
            gradient through the fit into s (:func:`hybridvo.learned.fitted_motion`); 0 = none, as
            in the paper.
        selection: method of ``hybridvo.network.selection.select`` that L^F and L^D look through.
        loss_stride: L^F and L^D, without uncertainty, look at every n-th pixel of every n-th row,
            in pixels of that smaller picture. 1 as published.
        data: preset files, beside the file that names them.
        data_weights: share of each.
        seed: of the weights and the samples.
        steps: updates.
        batch_size: samples an update and process.
        precision: ``float32`` or ``bfloat16`` (autocast of the network's forward pass).
        channels_last: memory format of the network.
        ema_decay: of a running average of the weights, which is then what is exported; 0 = none.
        optimizer, schedule: see there.
        checkpoint_minutes: between checkpoints.
        log_every: updates between lines of the log.
        evaluate_every: updates between evaluations on development seeds; 0 = none.
        evaluate_count: held-out samples of each preset.

    Raises:
        InputError: values that cannot be meant.
    """

    network: NetworkOptions = field(default_factory=NetworkOptions)
    loss: LossOptions = field(default_factory=LossOptions)
    translation_loss: str = "direction"
    moving_weight: float = 0.0
    fit_weight: float = 0.0
    selection: str = "softmax"
    loss_stride: int = 1
    data: tuple[str, ...] = ("data_paper.yaml",)
    data_weights: tuple[float, ...] = (1.0,)
    seed: int = 0
    steps: int = 100_000
    batch_size: int = 100
    precision: str = "float32"
    channels_last: bool = True
    ema_decay: float = 0.0
    optimizer: OptimizerOptions = field(default_factory=OptimizerOptions)
    schedule: ScheduleOptions = field(default_factory=ScheduleOptions)
    checkpoint_minutes: float = 5.0
    log_every: int = 50
    evaluate_every: int = 0
    evaluate_count: int = 200

    def __post_init__(self) -> None:
        if self.precision not in ("float32", "bfloat16"):
            raise InputError(
                f"TrainingOptions.precision: expected float32 or bfloat16, got {self.precision!r}."
            )
        if self.translation_loss not in ("direction", "laplace"):
            raise InputError(
                f"TrainingOptions.translation_loss: expected direction or laplace, got "
                f"{self.translation_loss!r}."
            )
        if self.loss_stride > 1 and (self.loss.flow_uncertainty or self.loss.depth_uncertainty):
            raise InputError(
                "TrainingOptions.loss_stride: above 1 needs loss.flow_uncertainty and "
                "loss.depth_uncertainty off; weighed by s, every pixel counts."
            )
        for name in ("steps", "batch_size", "log_every", "evaluate_count", "loss_stride"):
            if getattr(self, name) < 1:
                raise InputError(f"TrainingOptions.{name}: expected at least 1.")
        if not 0 <= self.ema_decay < 1:
            raise InputError("TrainingOptions.ema_decay: expected 0 <= decay < 1.")
        if self.checkpoint_minutes <= 0 or self.evaluate_every < 0:
            raise InputError(
                "TrainingOptions: expected checkpoint_minutes > 0 and evaluate_every >= 0."
            )
        for name in ("moving_weight", "fit_weight"):
            if not getattr(self, name) >= 0:
                raise InputError(f"TrainingOptions.{name}: expected a number >= 0.")
        if self.fit_weight and not (self.network.kind == "pwvo" and self.network.uncertainty):
            raise InputError("TrainingOptions.fit_weight: needs a pwvo network with uncertainty.")
        if len(self.data) != len(self.data_weights):
            raise InputError("TrainingOptions: expected one of data_weights for each of data.")


def load_training_options(path: str | Path) -> tuple[TrainingOptions, Mixture]:
    """Options of a ``configs/train_*.yaml`` and the mixture of the presets that it names.

    Raises:
        InputError: a missing file, an unknown key, or a value that cannot be meant.
    """
    path = Path(path)
    options = build_options(TrainingOptions, read_yaml(path), str(path))
    presets = tuple(load_preset(path.parent / name) for name in options.data)
    return options, Mixture(presets, options.data_weights)
