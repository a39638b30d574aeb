"""One training loop for every task: updates, running average,
checkpoints, weights for users.

An interrupted run takes the same updates as one that was not, if the
schedule counts updates. Several processes that torchrun started take the same
updates as one does, within rounding: each computes a part of every batch.
"""

from __future__ import annotations

import contextlib
import copy
import dataclasses
import json
import math
import pickle
import subprocess
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import nn
from torch.optim.swa_utils import get_ema_multi_avg_fn

from hybridvo.core.errors import CheckpointError, DegenerateError, InputError
from hybridvo.core.files import atomic_write, read_text, write_json
from hybridvo.network.models import load_weights
from hybridvo.network.weights import save_weights
from hybridvo_lab.synthetic.dataset import Mixture, build_options, make_preset
from hybridvo_lab.training import ranks
from hybridvo_lab.training.options import (
    PaperTrainingOptions,
    PWVOTrainingOptions,
    TrainingRun,
)
from hybridvo_lab.training.paper_task import PaperTask
from hybridvo_lab.training.pwvo_task import PWVOTask

FREE_TO_CHANGE = {"checkpoint_minutes", "log_every"}
"""Options in which a resumed run may differ: they do not change what is learned."""
STATED_EVERY_S = 10.0
"""Time between two sentences about the progress, seconds."""
PROGRESS = ("step", "samples", "elapsed_s")
"""Attributes of a trainer that its checkpoint keeps."""
CHECKPOINT = "checkpoint.pt"
"""File with the state of a run."""
LOG = "log.jsonl"
"""File with one entry of figures a line."""
RUN = "run.json"
"""File with the command, commit and versions of a run."""
UNREADABLE = (
    OSError,
    RuntimeError,
    EOFError,
    LookupError,
    TypeError,
    ValueError,
    pickle.UnpicklingError,
)
"""Errors that reading damaged or foreign weights may raise."""


class _Loss(nn.Module):
    """A task's loss as a module, so that its gradients can be averaged over the ranks."""

    def __init__(self, task: PaperTask | PWVOTask) -> None:
        super().__init__()
        self.network = task.network
        self._task = task

    def forward(
        self, batch: Any, step: int
    ) -> tuple[torch.Tensor, dict[str, torch.Tensor]]:
        """Loss of a batch in an update, and its parts."""
        loss, parts = self._task.loss(batch, step)
        if ranks.count() > 1:
            # every parameter needs a gradient, also where a part of a batch is empty
            sums = [
                parameter.sum()
                for parameter in self.network.parameters()
                if parameter.requires_grad
            ]
            loss = loss + 0.0 * torch.stack(sums).sum()
        return loss, parts


class Trainer:
    """A training run: its task, its optimiser, and their state in a folder.

    Of several ranks (:mod:`hybridvo_lab.training.ranks`), the first one writes files and reports.

    Args:
        task: the network with its data and loss.
        folder: where checkpoints and the log are written.
        device: where the network is trained.
        workers: processes that draw samples; 0: this one.
        report: called with every entry of the log.
        on_progress: called with a sentence after the first update, and then every ten seconds.
    """

    def __init__(
        self,
        task: PaperTask | PWVOTask,
        folder: Path,
        device: torch.device | str = "cpu",
        workers: int = 0,
        report: Callable[[dict[str, float]], None] = lambda entry: None,
        on_progress: Callable[[str], None] = lambda text: None,
    ) -> None:
        self.task = task
        self.folder = folder
        self.options: TrainingRun = task.options
        self.device = torch.device(device)
        self.workers = workers
        self.report = report
        self.on_progress = on_progress
        # the memory layout that convolutions prefer
        self.network = task.network.to(self.device).to(
            memory_format=torch.channels_last
        )  # type: ignore[call-overload]
        self._loss = ranks.parallel(_Loss(task))
        # the network that a user gets: the running average of the weights
        self.exported = copy.deepcopy(self.network).requires_grad_(False)
        optimizer = self.options.optimizer
        self.optimizer = torch.optim.AdamW(
            [each for each in self.network.parameters() if each.requires_grad],
            optimizer.learning_rate,
            optimizer.betas,
            weight_decay=optimizer.weight_decay,
            # one kernel instead of a dozen: small networks wait for their launches
            fused=self.device.type == "cuda",
        )
        self._parts: dict[str, Any] = {
            "network": self.network,
            "optimizer": self.optimizer,
            "ema": self.exported,
        }
        self.step = 0
        self.samples = 0
        self.elapsed_s = 0.0
        self._saved_s = 0.0
        self._logged_s = 0.0
        self._stated_s = -math.inf
        self._figures_to_log: list[dict[str, float]] = []
        self.stop_requested = False  # ends a run after the current update

    @property
    def record(self) -> dict[str, Any]:
        """Options and data as plain values; a resumed run must have the same."""
        record = {
            "options": dataclasses.asdict(self.options),
            "data": self.task.data,
        }
        return json.loads(json.dumps(record))

    def update(self, batch: Any, progress: float) -> dict[str, float]:
        """Take one step of the optimiser, and return its figures.

        Args:
            batch: samples of the task.
            progress: fraction of the run that is done, for the learning rate.

        Raises:
            DegenerateError: the loss or its gradient is not finite.
        """
        options = self.options
        rate = options.optimizer.learning_rate * options.schedule.factor(progress)
        for group in self.optimizer.param_groups:
            group["lr"] = rate
        self.optimizer.zero_grad(set_to_none=True)
        loss, parts = self._loss(batch.to(self.device), self.step)
        loss.backward()
        norm = nn.utils.clip_grad_norm_(
            self.network.parameters(), options.optimizer.clip_norm
        )
        if not math.isfinite(float(norm)):
            raise DegenerateError(
                f"training: loss or gradient not finite at update {self.step}. Lower the learning "
                f"rate; the last checkpoint is sound."
            )
        self.optimizer.step()
        self._average_weights()
        self.step += 1
        self.samples += self.task.count(batch)
        figures = {
            "loss": float(loss.detach()),
            "grad_norm": float(norm),
            "lr": rate,
        }
        return ranks.mean_figures(
            figures | {name: float(part) for name, part in parts.items()}
        )

    def _average_weights(self) -> None:
        """Add the network's weights to the running average."""
        # a young average follows quickly: it must forget the random start
        young = (1 + self.step) / (10 + self.step)
        decay = min(self.options.ema_decay, young)
        average = list(self.exported.parameters())
        current = list(self.network.parameters())
        get_ema_multi_avg_fn(decay)(average, current, 0)

    def run(self, time_limit_s: float = math.inf) -> str:
        """Train, save, and return why it ended: ``steps``, ``time`` or ``signal``.

        ``time_limit_s`` is the time of the entire run, earlier calls included.
        """
        batches = self.task.batches(self.samples, self.workers)
        reason = "steps"
        while self.step < self.options.steps and reason == "steps":
            started = time.monotonic()
            batch = next(batches)
            self.elapsed_s += time.monotonic() - started
            self.advance(batch, time_limit_s)
            if ranks.any_of(self.stop_requested):
                reason = "signal"
            elif self.elapsed_s >= time_limit_s:
                reason = "time"
        self.save()
        return reason

    def advance(self, batch: Any, time_limit_s: float = math.inf) -> None:
        """Take one update on a batch, then write the log and the
        checkpoint where they are due.
        """
        options = self.options
        started = time.monotonic()
        # the learning rate, and when a run ends, follow the first rank's clock
        self.elapsed_s = ranks.of_first(self.elapsed_s)
        progress = self.step / options.steps
        if options.schedule.by == "time" and math.isfinite(time_limit_s):
            progress = max(progress, self.elapsed_s / time_limit_s)
        self._figures_to_log.append(self.update(batch, progress))
        self.elapsed_s = ranks.of_first(self.elapsed_s + time.monotonic() - started)
        if self.elapsed_s - self._stated_s >= STATED_EVERY_S and ranks.is_first():
            self._stated_s = self.elapsed_s
            self.on_progress(self._progress(time_limit_s))
        if self.step % options.log_every == 0:
            self._log()
        if self.elapsed_s - self._saved_s > 60 * options.checkpoint_minutes:
            self.save()
            self._saved_s = self.elapsed_s

    def _progress(self, time_limit_s: float) -> str:
        """State how far the run is."""
        limit = ""
        if math.isfinite(time_limit_s):
            limit = f" of {time_limit_s:.0f}"
        return f"update {self.step} of {self.options.steps}, {self.elapsed_s:.0f}{limit} s"

    def _log(self) -> None:
        """Write the means of the figures since the last entry."""
        figures = self._figures_to_log
        samples = self.options.batch_size * len(figures)
        entry: dict[str, float] = {key: getattr(self, key) for key in PROGRESS}
        names = dict.fromkeys(name for each in figures for name in each)
        for name in names:
            values = [each[name] for each in figures if name in each]
            entry[name] = float(np.mean(values))
        entry["samples_per_s"] = samples / (self.elapsed_s - self._logged_s)
        if ranks.is_first():
            with (self.folder / LOG).open("a", encoding="utf-8") as file:
                file.write(json.dumps(entry) + "\n")
            self.report(entry)
        self._figures_to_log = []
        self._logged_s = self.elapsed_s

    def save(self) -> None:
        """Write ``checkpoint.pt``, from which a later process can continue."""
        if not ranks.is_first():
            return
        state: dict[str, Any] = {
            name: part.state_dict() for name, part in self._parts.items()
        }
        state["progress"] = {key: getattr(self, key) for key in PROGRESS}
        state["record"] = self.record
        with atomic_write(self.folder / CHECKPOINT, "wb") as file:
            torch.save(state, file)

    def start_from(self, weights: dict[str, torch.Tensor], name: str) -> None:
        """Take the weights of another network of the same
        shapes, and nothing else of it.

        Args:
            weights: the network's state.
            name: where they come from, for the error message.

        Raises:
            CheckpointError: they do not fit.
        """
        with _reading(name):
            self.network.load_state_dict(weights)
            self.exported.load_state_dict(weights)

    def resume(self) -> bool:
        """Continue from the folder's checkpoint, if there is one.

        Returns whether there is.

        Raises:
            InputError: the checkpoint is of a run with other options or data.
            CheckpointError: the checkpoint cannot be read.
        """
        path = self.folder / CHECKPOINT
        if not path.exists():
            return False
        state = read_checkpoint(path, self.device)
        self._check_record(state["record"], path)
        with _reading(str(path)):
            for name, part in self._parts.items():
                part.load_state_dict(state[name])
            vars(self).update(state["progress"])
        self._saved_s = self.elapsed_s
        self._logged_s = self.elapsed_s
        return True

    def _check_record(self, record: dict[str, Any], path: Path) -> None:
        """Raise an InputError where a checkpoint's options or data
        are not those of this run.
        """
        before = record["options"] | {"data": record["data"]}
        now = self.record["options"] | {"data": self.record["data"]}
        for name in sorted((before | now).keys() - FREE_TO_CHANGE):
            if before.get(name) != now.get(name):
                raise InputError(
                    f"{path}: is of a run with another {name}: it was {before.get(name)!r}, now "
                    f"{now.get(name)!r}. Choose another folder."
                )


@contextlib.contextmanager
def _reading(name: str) -> Iterator[None]:
    """Turn errors of weights that cannot be read or do not
    fit into a CheckpointError.
    """
    try:
        yield
    except UNREADABLE as error:
        reason = (str(error).strip() or type(error).__name__).splitlines()[0]
        raise CheckpointError(
            f"{name}: not a checkpoint of this network: {reason}."
        ) from None


def read_checkpoint(
    path: Path, device: torch.device | str = "cpu"
) -> dict[str, Any]:
    """Read a ``checkpoint.pt``; nothing in it can run.

    Raises:
        CheckpointError: the file is damaged, or not of a training.
    """
    with _reading(str(path)):
        state = torch.load(path, map_location=device, weights_only=True)
        state["record"]  # a KeyError where the file is of no training
        return state


# --- weights for users ------------------------------------------------------------


def source_commit() -> str | None:
    """Commit of the working tree, with a mark if it was changed.

    None outside of a repository.
    """
    command = "git describe --always --dirty --abbrev=40 --exclude *".split()
    with contextlib.suppress(OSError):
        done = subprocess.run(
            command, cwd=Path(__file__).parent, capture_output=True, text=True
        )
        return done.stdout.strip() or None
    return None


def export_run(
    folder: str | Path, path: str | Path, count: int = 1000
) -> dict[str, Any]:
    """Write a run's weights as int8 safetensors, and its card beside them as JSON.

    The card of a network holds the recipe of its training (options and data
    presets), the number of updates, samples and hours, the command, commit and
    versions, and for a network of the paper its figures on held-out pairs, measured with
    the rounded weights. PWVO has none: ``tools/benchmark.py semi_real --weights`` measures
    it.

    Args:
        folder: the folder of the run.
        path: the file of weights to write.
        count: held-out pairs of each preset.

    Returns:
        The card.
    """
    folder = Path(folder)
    path = Path(path)
    task = _task_of(folder / CHECKPOINT)
    trainer = Trainer(task, folder)
    trainer.resume()
    card = {
        "updates": trainer.step,
        "samples": trainer.samples,
        "training_hours": round(trainer.elapsed_s / 3600, 2),
        **trainer.record,
    }
    try:
        card |= json.loads(read_text(folder / RUN))
    except (OSError, ValueError) as error:
        raise InputError(f"{folder}: no {RUN} of a training: {error}.") from None
    save_weights(path, trainer.exported, card)
    if isinstance(task, PaperTask):
        rounded, _ = load_weights(path)
        card["held_out"] = task.evaluate(rounded, count)
        save_weights(path, trainer.exported, card)
    write_json(path.with_suffix(".json"), card)
    return card


def _task_of(checkpoint: Path) -> PaperTask | PWVOTask:
    """The task whose training wrote a checkpoint."""
    record = read_checkpoint(checkpoint)["record"]
    where = str(checkpoint)
    if record["options"]["network"]["kind"] == "pwvo-hypotheses":
        chosen = build_options(PWVOTrainingOptions, record["options"], where)
        return PWVOTask(chosen, Path(record["data"]))
    options = build_options(PaperTrainingOptions, record["options"], where)
    presets = tuple(make_preset(mapping, where) for mapping in record["data"])
    return PaperTask(options, Mixture(presets, options.data_weights))
