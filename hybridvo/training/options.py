"""Options of a training: the frozen dataclasses behind ``configs/train_*.yaml``."""

from __future__ import annotations

import dataclasses
import math
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, cast

from hybridvo.errors import InputError
from hybridvo.network.judge import JudgeOptions
from hybridvo.network.losses import LossOptions
from hybridvo.network.options import NetworkOptions
from hybridvo.network.selection import SELECTION_METHODS as SELECTIONS
from hybridvo.synthetic.dataset import StoredSamples
from hybridvo.synthetic.presets import (
    PRESETS,
    Preset,
    build_options,
    load_preset,
    read_yaml,
)
from hybridvo.training.rendered import RenderedOptions
from hybridvo.training.stream import Mixture

KINDS = PRESETS | {"rendered": RenderedOptions, "folder": StoredSamples}
"""Data that a training can name."""


@dataclass(frozen=True)
class OptimizerOptions:
    """AdamW; the defaults are the published Adam.

    Args:
        learning_rate: at its peak.
        betas: moments' decay.
        weight_decay: decoupled; 0 is Adam.
        clip_norm: largest global norm of the gradient.
        head_rate: factor on the rate of the motion heads' last layer. Its output is scaled by
            0.01; at the common rate a short run spends itself on growing that layer's weights. 100
            undoes the scale for Adam.

    Raises:
        InputError: a rate or a norm that is not positive, betas outside [0, 1).
    """

    learning_rate: float = 1e-4
    betas: tuple[float, float] = (0.5, 0.999)
    weight_decay: float = 0.0
    clip_norm: float = 1.0
    head_rate: float = 1.0

    def __post_init__(self) -> None:
        if not min(self.learning_rate, self.clip_norm, self.head_rate) > 0:
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
        by: ``steps`` = p counts updates (the same however often the run is cut), ``time`` = p is
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
        _one_of("ScheduleOptions.kind", self.kind, ("halving", "cosine", "constant"))
        _one_of("ScheduleOptions.by", self.by, ("steps", "time"))
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
class RunOptions:
    """What every training has; the defaults are the paper's.

    Args:
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
        _one_of(f"{type(self).__name__}.precision", self.precision, ("float32", "bfloat16"))
        for name in ("steps", "batch_size", "log_every", "evaluate_count"):
            if getattr(self, name) < 1:
                raise InputError(f"{type(self).__name__}.{name}: expected at least 1.")
        if not 0 <= self.ema_decay < 1 or self.checkpoint_minutes <= 0 or self.evaluate_every < 0:
            raise InputError(
                f"{type(self).__name__}: expected 0 <= ema_decay < 1, checkpoint_minutes > 0 and "
                f"evaluate_every >= 0."
            )


@dataclass(frozen=True)
class PwvoOptions(RunOptions):
    """A training of PWVO or of a baseline; the defaults are the paper's.

    Args:
        network: kind and shapes.
        loss: terms and switches.
        moving_weight: weight of a term that the paper does not have: s of the rotation should be
            larger on moving pixels than on static ones. 0 = none, as in the paper.
        fit_weight: weight of the error of the motion that the trusted pixels agree on, with the
            gradient through the fit into s; 0 = none, as in the paper.
        selection: rule by which L^F and L^D see one motion of the pixels, and by which the network
            is used.
        loss_stride: L^F and L^D, without uncertainty, look at every n-th pixel of every n-th row,
            in pixels of that smaller image. 1 as published.
        data: preset files, beside the file that names them.
        data_weights: share of each.
        data_size: (height, width) of the drawn samples instead of the presets' own, or None.

    Raises:
        InputError: values that cannot be meant.
    """

    network: NetworkOptions = field(default_factory=NetworkOptions)
    loss: LossOptions = field(default_factory=LossOptions)
    moving_weight: float = 0.0
    fit_weight: float = 0.0
    selection: str = "softmax"
    loss_stride: int = 1
    data: tuple[str, ...] = ("data_paper.yaml",)
    data_weights: tuple[float, ...] = (1.0,)
    data_size: tuple[int, int] | None = None

    def __post_init__(self) -> None:
        super().__post_init__()
        _one_of("PwvoOptions.selection", self.selection, SELECTIONS)
        weighs_pixels = self.loss.flow_uncertainty or self.loss.depth_uncertainty
        if self.loss_stride < 1 or (self.loss_stride > 1 and weighs_pixels):
            raise InputError(
                "PwvoOptions.loss_stride: expected 1, or more with loss.flow_uncertainty and "
                "loss.depth_uncertainty off; weighed by s, every pixel counts."
            )
        if not (self.moving_weight >= 0 and self.fit_weight >= 0):
            raise InputError("PwvoOptions: expected moving_weight and fit_weight >= 0.")
        if self.fit_weight and not (self.network.kind == "pwvo" and self.network.uncertainty):
            raise InputError("PwvoOptions.fit_weight: needs a pwvo network with uncertainty.")
        if not self.data or len(self.data) != len(self.data_weights):
            raise InputError("PwvoOptions: expected one of data_weights for each of data.")


@dataclass(frozen=True)
class SelectorOptions(RunOptions):
    """A training of the selector.

    Args:
        network: shapes.
        second_look_from: share of the run after which fits inside the masks take part.
        refits: candidates of a sample that are fitted inside their masks.
        mask_weight: of the loss of the masks beside that of the choice.
        trust_weight: of the loss of the probability that the choice is right.
        asked_share: share of the samples in which the pixel-wise network's static world is shown
            and its motion takes part, as where the selector alone is in doubt.
        files: shards from which the samples of a round are mixed.

    Raises:
        InputError: values that cannot be meant.
    """

    network: JudgeOptions = field(default_factory=JudgeOptions)
    second_look_from: float = 0.1
    refits: int = 2
    mask_weight: float = 1.0
    trust_weight: float = 0.5
    asked_share: float = 0.5
    files: int = 48

    def __post_init__(self) -> None:
        super().__post_init__()
        if min(self.refits, self.files) < 1:
            raise InputError("SelectorOptions: expected refits and files of at least 1.")


def _one_of(name: str, value: str, known: tuple[str, ...]) -> None:
    if value not in known:
        raise InputError(f"{name}: expected {' or '.join(known)}, got {value!r}.")


def load_pwvo_options(path: str | Path) -> tuple[PwvoOptions, Mixture]:
    """Options of a ``configs/train_*.yaml`` and the mixture of the data that it names.

    Raises:
        InputError: a missing file, an unknown key, or a value that cannot be meant.
    """
    path = Path(path)
    options = build_options(PwvoOptions, read_yaml(path), str(path))
    return options, load_mixture(options, path.parent)


def load_mixture(options: PwvoOptions, folder: Path) -> Mixture:
    """Data of a training, whose files are named from ``folder``; see :func:`load_pwvo_options`."""
    presets = [load_preset(folder / name, KINDS, options.data_size) for name in options.data]
    return Mixture(tuple(presets), options.data_weights)


def described(preset: Preset) -> dict[str, Any]:
    """Kind and options of a preset as plain values; :func:`recorded_run` reads them back."""
    kind = next(name for name, cls in KINDS.items() if type(preset) is cls)
    return {"preset": kind} | dataclasses.asdict(cast(Any, preset))


def recorded_run(record: dict[str, Any], where: str) -> tuple[PwvoOptions, Mixture]:
    """Options and data of a run from the record in its checkpoint.

    Raises:
        InputError: not the record of such a run; named by ``where``.
    """
    options = build_options(PwvoOptions, record["options"], where)
    presets: list[Any] = []
    for mapping in record["data"]:
        values = {key: value for key, value in mapping.items() if key != "preset"}
        presets.append(build_options(KINDS[mapping["preset"]], values, where))
    return options, Mixture(tuple(presets), options.data_weights)


def load_selector_options(path: str | Path) -> SelectorOptions:
    """Options of a ``configs/train_selector.yaml``; raises as :func:`load_pwvo_options`."""
    return build_options(SelectorOptions, read_yaml(path), str(path))
