"""One training loop for every task: updates, running average, checkpoints, weights for users.

An interrupted run takes the same updates as one that was not, if the schedule counts updates.
"""

from __future__ import annotations

import contextlib
import copy
import dataclasses
import itertools
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

from hybridvo.errors import CheckpointError, DegenerateError, InputError
from hybridvo.files import atomic_write, read_text, write_json
from hybridvo.network.models import load_weights
from hybridvo.network.weights import save_weights
from hybridvo.synthetic.dataset import Mixture, build_options, make_preset
from hybridvo.training.options import PwvoOptions, RunOptions, SelectorOptions
from hybridvo.training.pwvo_task import PwvoTask
from hybridvo.training.selector_task import SelectorTask

FREE_TO_CHANGE = {"checkpoint_minutes", "log_every"}
"""Options in which a resumed run may differ: they do not touch what is learned."""
PROGRESS = ("step", "samples", "elapsed_s")
"""Numbers of a run that its checkpoint keeps."""
CHECKPOINT = "checkpoint.pt"
LOG = "log.jsonl"
RUN = "run.json"
"""State of a run, its log, and its command, commit and versions."""


class Trainer:
    """A run: task, optimiser, and their state in a folder.

    ``workers``: processes that draw samples; 0: this one. ``report`` gets every entry of the log.
    """

    def __init__(
        self,
        task: PwvoTask | SelectorTask,
        folder: Path,
        device: torch.device | str = "cpu",
        workers: int = 0,
        report: Callable[[dict[str, float]], None] = lambda entry: None,
    ) -> None:
        self.task = task
        self.folder = folder
        self.options: RunOptions = task.options
        self.device = torch.device(device)
        self.workers = workers
        self.report = report
        # the order of memory that convolutions prefer
        self.network = task.network.to(self.device).to(
            memory_format=torch.channels_last
        )  # type: ignore[call-overload]
        # the network that a user should get: the running average
        self.exported = copy.deepcopy(self.network).requires_grad_(False)
        how = self.options.optimizer
        self.optimizer = torch.optim.AdamW(
            self.network.parameters(),
            how.learning_rate,
            how.betas,
            weight_decay=how.weight_decay,
        )
        self._parts: dict[str, Any] = {
            "network": self.network, "optimizer": self.optimizer, "ema": self.exported,
        }  # fmt: skip
        self.step = self.samples = 0
        self.elapsed_s = self._saved_s = self._logged_s = 0.0
        self._seen: list[dict[str, float]] = []
        self.stop_requested = False  # ends a run after the update at hand

    @property
    def record(self) -> dict[str, Any]:
        """Options and data as plain values: what a resumed run has to agree with."""
        record = {
            "options": dataclasses.asdict(self.options),
            "data": self.task.data,
        }
        return json.loads(json.dumps(record))

    def update(self, batch: Any, progress: float) -> dict[str, float]:
        """One step of the optimiser when ``progress`` of the run is done; returns its figures."""
        optimizer = self.options.optimizer
        rate = optimizer.learning_rate * self.options.schedule.factor(progress)
        for group in self.optimizer.param_groups:
            group["lr"] = rate
        self.optimizer.zero_grad(set_to_none=True)
        loss, parts = self.task.loss(batch.to(self.device), self.step)
        loss.backward()
        norm = nn.utils.clip_grad_norm_(
            self.network.parameters(), optimizer.clip_norm
        )
        if not math.isfinite(float(norm)):
            raise DegenerateError(
                f"training: loss or gradient not finite at update {self.step}. Lower the learning "
                f"rate; the last checkpoint is sound."
            )
        self.optimizer.step()
        # A young average follows quickly: it must forget the random start.
        decay = min(self.options.ema_decay, (1 + self.step) / (10 + self.step))
        both = list(self.exported.parameters()), list(self.network.parameters())
        get_ema_multi_avg_fn(decay)(*both, 0)
        self.step += 1
        self.samples += len(batch)
        figures = {
            "loss": float(loss.detach()),
            "grad_norm": float(norm),
            "lr": rate,
        }
        return figures | {name: float(part) for name, part in parts.items()}

    def run(self, time_limit_s: float = math.inf) -> str:
        """Train, save, and say why it ended: ``steps``, ``time``, ``signal``.

        ``time_limit_s`` counts over all interruptions.
        """
        batches = self.task.batches(self.samples, self.workers)
        why = "steps"
        while self.step < self.options.steps and why == "steps":
            started = time.monotonic()
            batch = next(batches)
            self.elapsed_s += time.monotonic() - started
            self.advance(batch, time_limit_s)
            if self.stop_requested or self.elapsed_s >= time_limit_s:
                why = "signal" if self.stop_requested else "time"
        self.save()
        return why

    def advance(self, batch: Any, time_limit_s: float = math.inf) -> None:
        """One update on a batch, and what is due after it: log, checkpoint."""
        options = self.options
        started = time.monotonic()
        progress = self.step / options.steps
        if options.schedule.by == "time" and math.isfinite(time_limit_s):
            progress = max(progress, self.elapsed_s / time_limit_s)
        self._seen.append(self.update(batch, progress))
        self.elapsed_s += time.monotonic() - started
        if self.step % options.log_every == 0:
            rate = (
                options.batch_size
                * len(self._seen)
                / (self.elapsed_s - self._logged_s)
            )
            names = dict.fromkeys(itertools.chain(*self._seen))
            means = {
                n: float(np.mean([e[n] for e in self._seen if n in e]))
                for n in names
            }
            entry = (
                {key: getattr(self, key) for key in PROGRESS}
                | means
                | {"samples_per_s": rate}
            )
            with (self.folder / LOG).open("a", encoding="utf-8") as file:
                file.write(json.dumps(entry) + "\n")
            self.report(entry)
            self._seen = []
            self._logged_s = self.elapsed_s
        if self.elapsed_s - self._saved_s > 60 * options.checkpoint_minutes:
            self.save()
            self._saved_s = self.elapsed_s

    def save(self) -> None:
        """Write ``checkpoint.pt``: everything that a later process needs to go on."""
        state: dict[str, Any] = {
            name: part.state_dict() for name, part in self._parts.items()
        }
        state["progress"] = {key: getattr(self, key) for key in PROGRESS}
        with atomic_write(self.folder / CHECKPOINT, "wb") as file:
            torch.save(state | {"record": self.record}, file)

    def start_from(self, weights: dict[str, torch.Tensor], name: str) -> None:
        """Take the weights of another network of the same shapes; everything else starts anew."""
        with _reading(name):
            self.network.load_state_dict(weights)
            self.exported.load_state_dict(weights)

    def resume(self) -> bool:
        """Go on where the folder's checkpoint ended, if there is one, of the same options."""
        path = self.folder / CHECKPOINT
        if not path.exists():
            return False
        state = read_checkpoint(path, self.device)
        before, now = (
            {**r["options"], "data": r["data"]}
            for r in (state["record"], self.record)
        )
        for name in sorted((before | now).keys() - FREE_TO_CHANGE):
            if before.get(name) != now.get(name):
                raise InputError(
                    f"{path}: is of a run with another {name}: it was {before.get(name)!r}, now "
                    f"{now.get(name)!r}. Choose another folder."
                )
        with _reading(str(path)):
            for name, part in self._parts.items():
                part.load_state_dict(state[name])
            vars(self).update(state["progress"])
        self._saved_s = self._logged_s = self.elapsed_s
        return True


@contextlib.contextmanager
def _reading(name: str) -> Iterator[None]:
    """Say of weights that cannot be read or do not fit where they come from."""
    wrong = (OSError, RuntimeError, EOFError, LookupError, TypeError, ValueError)
    try:
        yield
    except (*wrong, pickle.UnpicklingError) as error:
        reason = (str(error).strip() or type(error).__name__).splitlines()[0]
        raise CheckpointError(
            f"{name}: not a checkpoint of this network: {reason}."
        ) from None


def read_checkpoint(
    path: Path, device: torch.device | str = "cpu"
) -> dict[str, Any]:
    """Content of a ``checkpoint.pt``; nothing in it can run."""
    with _reading(str(path)):
        state = torch.load(path, map_location=device, weights_only=True)
        state["record"]  # a KeyError where it is of no training
        return state


# --- weights for users ----------------------------------------------------------------------------


def source_commit() -> str | None:
    """Commit of the working tree, with a mark if it was changed; None outside of a repository."""
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

    Of PWVO, ``count`` held-out pairs of each preset give the figures of its card. A selector is
    measured by ``tools/benchmark_semi_real.py --selector``.
    """
    checkpoint = Path(folder) / CHECKPOINT
    record = read_checkpoint(checkpoint)["record"]
    task: PwvoTask | SelectorTask
    if record["options"]["network"]["kind"] == "selector":
        chosen = build_options(SelectorOptions, record["options"], str(checkpoint))
        task = SelectorTask(chosen, Path(record["data"]))
    else:
        options = build_options(PwvoOptions, record["options"], str(checkpoint))
        presets = tuple(
            make_preset(mapping, str(checkpoint)) for mapping in record["data"]
        )
        task = PwvoTask(options, Mixture(presets, options.data_weights))
    trainer = Trainer(task, Path(folder))
    trainer.resume()
    card = {
        "updates": trainer.step,
        "samples": trainer.samples,
        "training_hours": round(trainer.elapsed_s / 3600, 2),
        **trainer.record,
    }
    try:
        card |= json.loads(read_text(Path(folder) / RUN))
    except (OSError, ValueError) as error:
        raise InputError(f"{folder}: no {RUN} of a training: {error}.") from None
    save_weights(path, trainer.exported, card)
    if isinstance(task, PwvoTask):  # of the rounded weights
        card["held_out"] = task.evaluate(load_weights(path)[0], count)
        save_weights(path, trainer.exported, card)
    write_json(Path(path).with_suffix(".json"), card)
    return card
