"""The rows of the paper's three tables as trainings that differ in nothing else.

Every row is trained on the same samples, in the same order and as many updates as the others, from
one base recipe; only what the row is about changes. Which switches make which row follows the
published code (reference: PWVO's tables 1 to 3).
"""

from __future__ import annotations

import dataclasses
import json
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, cast

import numpy as np
import torch

from hybridvo.errors import InputError
from hybridvo.network.options import NetworkOptions
from hybridvo.synthetic.paper import Sample
from hybridvo.training.held_out import evaluate_network
from hybridvo.training.loop import Trainer
from hybridvo.training.options import TrainingOptions
from hybridvo.training.stream import Mixture, Preset, TrainingBatch

__all__ = [
    "DECIDING",
    "ROWS",
    "AblationRow",
    "KeptSamples",
    "plan",
    "row_options",
    "score_row",
    "train_row",
]


@dataclass(frozen=True)
class AblationRow:
    """One network of the tables.

    Args:
        name: key in results and name of the run's folder.
        kind: of :class:`~hybridvo.network.options.NetworkOptions`.
        pose_uncertainty: U^R and U^T, distribution learning.
        reconstruction_uncertainty: U^F and U^D.
        flow: whether L^F is on; L^D always is.
        selection: how one motion comes out of the pixels, in training and in use.
    """

    name: str
    kind: str = "pwvo"
    pose_uncertainty: bool = False
    reconstruction_uncertainty: bool = False
    flow: bool = True
    selection: str = "mean"


ROWS = (
    AblationRow("vonet", "vonet"),
    AblationRow("vonet-attention", "vonet-attention"),
    AblationRow("pixelwise"),
    AblationRow("naive", pose_uncertainty=True),
    AblationRow("uncertain", pose_uncertainty=True, reconstruction_uncertainty=True),
    AblationRow(
        "pwvo", pose_uncertainty=True, reconstruction_uncertainty=True, selection="softmax"
    ),
    AblationRow("vonet-without-flow", "vonet", flow=False),
    AblationRow("vonet-attention-without-flow", "vonet-attention", flow=False),
    AblationRow("naive-without-flow", pose_uncertainty=True, flow=False),
)
"""Every different network of the three tables, once. ``naive-without-flow`` is what table 3 calls
"PWVO": the figures beside it are those of the naive model."""

DECIDING = ("pwvo", "naive", "vonet")
"""Rows whose order is the paper's claim, best first: these are trained with several seeds."""


def row_options(
    base: TrainingOptions, row: AblationRow, seed: int, samples: int
) -> TrainingOptions:
    """Options of one row: the base recipe with the row's own switches.

    What is no part of the paper's tables is off in every row (``moving_weight``, evaluations on
    the way), and the schedule counts updates, so that a slow row is not trained less. Where L^F and
    L^D are weighed by uncertainty every pixel counts: there ``loss_stride`` is 1, and the weight
    and limit of the flow are those of the same loss in pixels of the whole picture.

    Args:
        base: recipe of all rows. Its switches for losses, kind and uncertainty do not count.
        row: which network.
        seed: of the weights and the samples.
        samples: to train on; the last update is a whole one.

    Raises:
        InputError: fewer samples than one.
    """
    if samples < 1:
        raise InputError(f"row_options: expected at least one sample, got {samples}.")
    pixelwise = row.kind == "pwvo"
    network: NetworkOptions = dataclasses.replace(
        base.network,
        kind=row.kind,
        uncertainty=row.pose_uncertainty if pixelwise else True,
        decoders=base.network.decoders if row.pose_uncertainty else 1,
    )
    stride, loss = base.loss_stride, base.loss
    if row.reconstruction_uncertainty and stride > 1:
        loss = dataclasses.replace(
            loss, flow_weight=loss.flow_weight / stride, flow_limit_px=loss.flow_limit_px * stride
        )
        stride = 1
    return dataclasses.replace(
        base,
        network=network,
        loss=dataclasses.replace(
            loss,
            pose=True,
            pose_uncertainty=row.pose_uncertainty,
            flow=row.flow,
            depth=True,
            flow_uncertainty=row.flow and row.reconstruction_uncertainty,
            depth_uncertainty=row.reconstruction_uncertainty,
        ),
        loss_stride=stride,
        moving_weight=0.0,
        selection=row.selection,
        seed=seed,
        steps=math.ceil(samples / base.batch_size),
        schedule=dataclasses.replace(base.schedule, by="steps"),
        evaluate_every=0,
    )


def plan(seeds: int, rows: Sequence[str] | None = None) -> list[tuple[AblationRow, int]]:
    """Trainings in the order in which they are done: those that decide first, then the other rows,
    then the further seeds of those that decide, one seed after the other.

    Args:
        seeds: seeds of each row of :data:`DECIDING`; all others have one.
        rows: names to train, or None for all.

    Returns:
        (row, seed) of each training.

    Raises:
        InputError: no seed, or an unknown name.
    """
    if seeds < 1:
        raise InputError(f"ablation: expected at least one seed, got {seeds}.")
    known = {row.name: row for row in ROWS}
    names = list(known) if rows is None else list(dict.fromkeys(rows))
    unknown = [name for name in names if name not in known]
    if unknown or not names:
        raise InputError(
            f"ablation: unknown rows {', '.join(unknown) or '(none given)'}; known: "
            f"{', '.join(known)}."
        )
    first = [name for name in DECIDING if name in names]
    order = [(name, 0) for name in first]
    order += [(name, 0) for name in names if name not in first]
    order += [(name, seed) for seed in range(1, seeds) for name in first]
    return [(known[name], seed) for name, seed in order]


class KeptSamples:
    """A preset that remembers what it drew: all rows see the same pairs, which are drawn once.

    Args:
        preset: what to draw from.
        limit_bytes: memory that the samples may take (about 1.1 MB each at 128x256); further ones
            are drawn anew each time.
    """

    def __init__(self, preset: Preset, limit_bytes: int = 3 << 30) -> None:
        self._preset, self._limit = preset, limit_bytes
        self._left = limit_bytes
        self._kept: dict[tuple[int, ...], Sample] = {}

    def __len__(self) -> int:
        return len(self._kept)

    def forget(self) -> None:
        """Give the memory back: the next row has another seed."""
        self._kept.clear()
        self._left = self._limit

    def sample(self, rng: np.random.Generator) -> Sample:
        """One pair; ``rng`` must be a fresh generator of ``sample_generator``."""
        state: Mapping[str, Any] = rng.bit_generator.state
        key = tuple(int(word) for word in state["state"]["key"])
        if key not in self._kept:
            drawn = self._preset.sample(rng)
            size = sum(np.asarray(getattr(drawn, f.name)).nbytes for f in dataclasses.fields(drawn))
            if size > self._left:
                return drawn
            self._left -= size
            self._kept[key] = drawn
        return self._kept[key]


class _Interruptible(Trainer):
    """Asks after every update whether to go on."""

    should_stop: Callable[[], bool]

    def update(self, batch: TrainingBatch, progress: float) -> dict[str, float]:
        figures = super().update(batch, progress)
        self.stop_requested = self.should_stop()
        return figures


def train_row(
    options: TrainingOptions,
    mixture: Mixture,
    folder: Path,
    device: str = "cpu",
    workers: int = 0,
    kept: KeptSamples | None = None,
    report: Callable[[dict[str, Any]], None] | None = None,
    should_stop: Callable[[], bool] | None = None,
) -> Trainer:
    """Train one row, or go on with what its folder holds; a finished one is only read.

    Args:
        options: of :func:`row_options`.
        mixture: what samples are drawn from.
        folder: of this row and seed; is made. Gets ``checkpoint.pt``, ``log.jsonl`` and
            ``options.json``.
        device: of the network.
        workers: processes that draw samples.
        kept: draws from ``mixture``, and remembers; needs ``workers`` = 0 to be of use.
        report: called with every entry of the log.
        should_stop: asked after every update; True ends the run with a checkpoint.

    Returns:
        The trainer; the row is finished if ``trainer.step == options.steps``.

    Raises:
        InputError: the folder is of other options or other data.
        CheckpointError: its checkpoint is damaged.
    """
    record = _plain(
        {
            "options": dataclasses.asdict(options),
            "data": [dataclasses.asdict(p) for p in mixture.presets],  # type: ignore[call-overload]
        }
    )
    folder.mkdir(parents=True, exist_ok=True)
    stated, checkpoint = folder / "options.json", folder / "checkpoint.pt"
    if checkpoint.exists():
        try:
            before = json.loads(stated.read_text(encoding="utf-8"))
        except (OSError, ValueError):
            before = None
        if before != record:
            raise InputError(
                f"{folder}: holds a run of other options ({_difference(before, record)}). Give "
                f"another --out, or --overwrite to train anew."
            )
    else:
        stated.write_text(json.dumps(record, indent=2), encoding="utf-8")
    asked = should_stop or (lambda: False)
    # The trainer only draws from it: evaluations on the way are off.
    source = mixture if kept is None else cast(Mixture, kept)
    trainer = _Interruptible(options, source, folder, device, workers, report)
    trainer.should_stop = asked
    if checkpoint.exists():
        trainer.resume(checkpoint)
    if trainer.step < options.steps and not asked():
        trainer.run()
    return trainer


def score_row(
    network: torch.nn.Module,
    presets: Mapping[str, Preset],
    seed: int,
    count: int,
    options: TrainingOptions,
) -> dict[str, dict[str, Any]]:
    """Figures of a trained row on held-out pairs of each preset, see ``evaluate_network``."""
    return {
        name: evaluate_network(
            network,
            preset,
            seed,
            count,
            selection=options.selection,
            precision=options.precision,
        )
        for name, preset in presets.items()
    }


def _plain(value: Any) -> Any:
    """As JSON gives it back: lists for tuples."""
    return json.loads(json.dumps(value))


def _difference(before: Any, now: dict[str, Any]) -> str:
    """First key in which two records differ."""
    if not isinstance(before, dict) or not isinstance(before.get("options"), dict):
        return "options.json cannot be read"
    for key, value in now["options"].items():
        if before["options"].get(key) != value:
            return f"{key} was {before['options'].get(key)!r}, now {value!r}"
    return "the data presets differ"
