"""The training loop: one process or many, stopped and resumed without a trace.

Two runs that are given the same options take the same updates bit by bit on the same machine,
whether or not they were interrupted, as long as the schedule counts updates.
"""

from __future__ import annotations

import copy
import dataclasses
import json
import math
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import torch
import torch.distributed as dist
import torch.nn.functional as F
from torch import nn
from torch.nn.parallel import DistributedDataParallel

from hybridvo.errors import CheckpointError, DegenerateError
from hybridvo.learned import fitted_motion, next_start
from hybridvo.network.losses import NetworkOutput, reconstruct, total_loss
from hybridvo.network.passes import first_motions
from hybridvo.network.pwvo import build_network
from hybridvo.network.selection import chosen_motion
from hybridvo.network.weights import load_weights
from hybridvo.training.checkpoint import check_seed, load_checkpoint, save_checkpoint
from hybridvo.training.held_out import evaluate_network
from hybridvo.training.options import TrainingOptions
from hybridvo.training.stream import Mixture, SampleStream, TrainingBatch
from hybridvo.types import PixelwisePrediction

__all__ = ["Trainer", "training_loss"]

MAX_SKIPPED_IN_A_ROW = 50
"""Updates with a loss or gradient that is not finite, after which a run gives up."""

FIT_FLOOR_PX = 0.05
"""Pixels of the inputs."""

SEPARATION_SLOPE = 2.0
"""Logits per unit of s."""
SEPARATION_PIXELS = 700
"""Of each kind in a batch."""

STOPPED_BY = ("steps", "time", "signal")


def training_loss(
    output: NetworkOutput, batch: TrainingBatch, options: TrainingOptions
) -> tuple[torch.Tensor, dict[str, torch.Tensor]]:
    """Loss of a network's output and its parts, see :func:`hybridvo.network.losses.total_loss`."""
    T = chosen_motion(output, options.selection) if options.loss.reconstructs else None
    laplace = options.translation_loss == "laplace" and isinstance(output, PixelwisePrediction)
    loss_options = options.loss
    if laplace:
        loss_options = dataclasses.replace(loss_options, translation_weight=0.0)
    loss, parts = total_loss(output, batch.targets.subsample(options.loss_stride), loss_options, T)
    if laplace and options.loss.pose and isinstance(output, PixelwisePrediction):
        error = (output.translation - batch.targets.translation[:, :, None, None]).abs()
        s = output.log_scale_translation
        if s is None or not options.loss.pose_uncertainty:
            term = error.mean()
        else:
            # Bounded where the error is tiny: exp(-s) of a scale below 1e-5 m means nothing.
            term = 0.5 * (error * (-s.clamp(min=-11.5)).exp() + s.clamp(min=-11.5)).mean()
        loss = loss + options.loss.translation_weight * term
        parts = {**parts, "translation": term.detach()}
    if options.fit_weight and isinstance(output, PixelwisePrediction):
        term = _fit_loss(output, batch, options)
        loss = loss + options.fit_weight * term
        parts = {**parts, "fit": term.detach()}
    if options.moving_weight and isinstance(output, PixelwisePrediction):
        term = _separation(output, batch)
        loss = loss + options.moving_weight * term
        parts = {**parts, "moving": term.detach()}
    return loss, parts


def _fit_loss(
    output: PixelwisePrediction, batch: TrainingBatch, options: TrainingOptions
) -> torch.Tensor:
    """Log of the error of the ego flow that the fit to the trusted pixels gives, mean over pairs.

    The gradient goes through the fit into s. The logarithm lets pairs that are far off and pairs
    that are nearly right learn alike; below ``FIT_FLOOR_PX`` the noise of the inputs decides.
    """
    T = fitted_motion(output, batch.inputs, options.selection)
    truth = batch.targets.subsample(options.loss_stride)
    flow, _, defined = reconstruct(truth.depth_prev, T, truth.K_prev, truth.K_curr)
    defined = defined & torch.isfinite(truth.ego_flow).all(dim=1)
    error = torch.where(defined[:, None], flow - truth.ego_flow, 0.0).abs().sum(1).clamp(max=100.0)
    error = options.loss_stride * error.flatten(1).sum(1) / defined.flatten(1).sum(1).clamp(min=1)
    return torch.log1p(error / FIT_FLOOR_PX).mean()


def _separation(output: PixelwisePrediction, batch: TrainingBatch) -> torch.Tensor:
    """How often s of the rotation is larger on a static pixel than on a moving one, smoothed.

    The logistic bound of one minus the area under the ROC curve, over pixels of the whole batch:
    s has to tell movers apart across pairs as well. Pairs of pixels that are apart by a factor of
    three in U count little; the rest of s is left to the other terms.
    """
    s = output.log_scale_rotation
    if s is None:
        return output.rotation.new_zeros(())
    cells = s.shape[2:]
    moving = F.interpolate(batch.moving[:, None].to(s.dtype), cells, mode="area")[:, 0]
    valid = F.interpolate(batch.inputs.valid[:, None].to(s.dtype), cells, mode="area")[:, 0] > 0.5
    score = s.mean(1)
    kinds = [score[valid & (moving > 0.5)], score[valid & (moving < 0.5)]]
    if not all(len(kind) for kind in kinds):
        return s.new_zeros(())
    above, below = (kind[:: -(-len(kind) // SEPARATION_PIXELS)] for kind in kinds)
    return F.softplus(SEPARATION_SLOPE * (below[None] - above[:, None])).mean()


class Trainer:
    """A run: network, optimiser, place in the stream of samples, and their record on disk.

    Args:
        options: of the run.
        mixture: what samples are drawn from.
        folder: where ``checkpoint.pt`` and ``log.jsonl`` stand; must exist. None writes nothing.
        device: of the network.
        workers: processes that draw samples; 0 draws them in this one.
        report: called with every entry of the log, for a progress display.

    Under ``torch.distributed`` (``torchrun``) every process makes its own Trainer; gradients are
    averaged, and only rank 0 writes.
    """

    def __init__(
        self,
        options: TrainingOptions,
        mixture: Mixture,
        folder: Path | None = None,
        device: torch.device | str = "cpu",
        workers: int = 0,
        report: Callable[[dict[str, Any]], None] | None = None,
    ) -> None:
        self.options, self.mixture, self.folder = options, mixture, folder
        self.device, self.workers, self.report = torch.device(device), workers, report
        self.world = dist.get_world_size() if dist.is_initialized() else 1
        self.rank = dist.get_rank() if dist.is_initialized() else 0
        torch.manual_seed(options.seed)
        self.network = build_network(options.network).to(self.device)
        if options.channels_last:
            self.network = self.network.to(memory_format=torch.channels_last)  # type: ignore[call-overload]
        self.model: nn.Module = self.network
        if self.world > 1:
            self.model = DistributedDataParallel(
                self.network, find_unused_parameters=not options.loss.needs_uncertainty
            )
        self.ema = copy.deepcopy(self.network).requires_grad_(False) if options.ema_decay else None
        self.optimizer = torch.optim.Adam(
            self._groups(),
            lr=options.optimizer.learning_rate,
            betas=options.optimizer.betas,
            fused=True,
        )
        self.step = self.samples = self.skipped = self.skipped_in_a_row = 0
        self.elapsed_s = 0.0
        self.stop_requested = False

    @property
    def exported(self) -> nn.Module:
        """The network that a user should get: the running average where there is one."""
        return self.network if self.ema is None else self.ema

    def _groups(self) -> list[dict[str, Any]]:
        """Parameters in two groups: the motion heads' last layers have a rate of their own."""
        last = []
        for name in ("head_motion", "head_rotation", "head_translation"):
            head = getattr(self.network, name, None)
            if head is not None:
                last.append(f"{name}.{len(head) - 1}.")
        groups: list[dict[str, Any]] = [
            {"params": [], "rate_factor": 1.0},
            {"params": [], "rate_factor": self.options.optimizer.head_rate},
        ]
        for name, parameter in self.network.named_parameters():
            groups[name.startswith(tuple(last))]["params"].append(parameter)
        return groups

    def update(self, batch: TrainingBatch, progress: float) -> dict[str, float]:
        """One step of the optimiser.

        Args:
            batch: samples of this process.
            progress: share of the run that is done, for the learning rate.

        Returns:
            ``loss``, its parts, ``grad_norm`` and ``lr``.

        Raises:
            DegenerateError: the loss or the gradient was not finite 50 times in a row.
        """
        options = self.options
        rate = options.optimizer.learning_rate * options.schedule.factor(progress)
        for group in self.optimizer.param_groups:
            group["lr"] = rate * group["rate_factor"]
        batch = batch.to(self.device)
        self.optimizer.zero_grad(set_to_none=True)
        half = options.precision == "bfloat16"
        with torch.autocast(self.device.type, torch.bfloat16, enabled=half):
            starts = self._starts(batch)
            output = self.model(batch.inputs, *(() if starts is None else (starts,)))
        loss, parts = training_loss(output, batch, options)
        loss.backward()
        norm = nn.utils.clip_grad_norm_(self.network.parameters(), options.optimizer.clip_norm)
        # The averaged gradient is the same on all ranks, and not finite where any loss was not.
        if math.isfinite(float(norm)):
            self.optimizer.step()
            self.skipped_in_a_row = 0
            self._average()
        else:
            self.skipped += 1
            self.skipped_in_a_row += 1
            if self.skipped_in_a_row >= MAX_SKIPPED_IN_A_ROW:
                raise DegenerateError(
                    f"training: loss or gradient not finite {MAX_SKIPPED_IN_A_ROW} times in a row "
                    f"at update {self.step}. Lower optimizer.learning_rate or loss weights; the "
                    f"last checkpoint is sound."
                )
        self.step += 1
        self.samples += len(batch.inputs) * self.world
        figures = {"loss": float(loss.detach()), "grad_norm": float(norm), "lr": rate}
        return figures | {name: float(part) for name, part in parts.items()}

    def _starts(self, batch: TrainingBatch) -> torch.Tensor | None:
        """(B, 4, 4) first motions: none for one half of the batch, the network's own for the rest.

        The later passes of a network learn from the errors that the earlier ones really make.
        """
        passes = self.options.network.passes
        first = len(batch.inputs) // 2
        if passes == 1 or first == 0:
            return None
        T = torch.eye(4, device=self.device).repeat(len(batch.inputs), 1, 1)
        made = first_motions(
            self.network,
            batch.inputs[first:],
            next_start(self.network, self.options.selection),
            1 + self.step % (passes - 1),
        )
        assert made is not None
        T[first:] = made
        return T

    def _average(self) -> None:
        if self.ema is None:
            return
        # A young average follows quickly: it must forget the random start.
        decay = min(self.options.ema_decay, (1 + self.step) / (10 + self.step))
        with torch.no_grad():
            ours: list[torch.Tensor] = list(self.ema.parameters())
            theirs: list[torch.Tensor] = list(self.network.parameters())
            torch._foreach_lerp_(ours, theirs, 1 - decay)

    def run(self, time_limit_s: float = math.inf, max_steps: int | None = None) -> str:
        """Train until the options' steps, a time limit or a request to stop.

        Args:
            time_limit_s: seconds of training, over all interruptions; ends with a checkpoint.
            max_steps: stop at this update, with the schedule of the whole run (for tests).

        Returns:
            Why it ended: ``steps``, ``time`` or ``signal`` (``stop_requested`` was set).
        """
        options = self.options
        last = options.steps if max_steps is None else min(max_steps, options.steps)
        stream = SampleStream(
            options.seed, self.samples, self.mixture, self.rank, self.world, options.batch_size
        )
        context = "fork" if self.workers else None
        batches = iter(
            torch.utils.data.DataLoader(
                stream,
                batch_size=None,
                num_workers=self.workers,
                multiprocessing_context=context,
            )
        )
        self.network.train()
        started = time.monotonic()
        before = self.elapsed_s
        saved = logged = started
        sums: dict[str, float] = {}
        counted = 0
        why = "steps"
        while self.step < last:
            progress = self.step / options.steps
            if options.schedule.by == "time" and math.isfinite(time_limit_s):
                progress = max(progress, self.elapsed_s / time_limit_s)
            figures = self.update(next(batches), progress)
            now = time.monotonic()
            self.elapsed_s = before + now - started
            if all(math.isfinite(value) for value in figures.values()):
                counted += 1
                for name, value in figures.items():
                    sums[name] = sums.get(name, 0.0) + value
            if self.step % options.log_every == 0:
                means = {name: value / max(counted, 1) for name, value in sums.items()}
                rate = options.log_every * options.batch_size * self.world / (now - logged)
                self._log({"event": "train", **means, "samples_per_s": rate})
                sums, counted, logged = {}, 0, now
            if options.evaluate_every and self.step % options.evaluate_every == 0:
                self.evaluate()
            stop = self._agree(self.stop_requested, self.elapsed_s >= time_limit_s)
            if stop:
                why = STOPPED_BY[stop]
                break
            if now - saved > 60 * options.checkpoint_minutes:
                self.save()
                saved = now
        self.save()
        return why

    def _agree(self, signalled: bool, late: bool) -> int:
        """2 = a process was told to stop, 1 = time is up on one, 0 = go on; equal on all ranks."""
        stop = 2 if signalled else int(late)
        if self.world > 1:
            flag = torch.tensor(stop, device=self.device)
            dist.all_reduce(flag, dist.ReduceOp.MAX)
            stop = int(flag)
        return stop

    def evaluate(self, seed: int = 0) -> dict[str, Any]:
        """Figures of the exported network on each preset of the mixture, also into the log.

        The generators of the run are not touched.
        """
        results = {}
        if self.rank == 0:
            for name, preset in zip(self.options.data, self.mixture.presets, strict=True):
                results[Path(name).stem] = evaluate_network(
                    self.exported,
                    preset,
                    seed,
                    self.options.evaluate_count,
                    selection=self.options.selection,
                    precision=self.options.precision,
                )
            self._log({"event": "evaluation", "results": results})
        return results

    def _log(self, entry: dict[str, Any]) -> None:
        if self.rank != 0:
            return
        entry = {
            "step": self.step,
            "samples": self.samples,
            "skipped": self.skipped,
            "elapsed_s": round(self.elapsed_s, 1),
            **entry,
        }
        if self.folder is not None:
            with (self.folder / "log.jsonl").open("a", encoding="utf-8") as file:
                file.write(json.dumps(entry) + "\n")
        if self.report is not None:
            self.report(entry)

    def state(self) -> dict[str, Any]:
        """Everything that a later process needs to go on as if nothing had happened."""
        return {
            "options": dataclasses.asdict(self.options),
            "network": self.network.state_dict(),
            "optimizer": self.optimizer.state_dict(),
            "ema": None if self.ema is None else self.ema.state_dict(),
            "progress": {
                "step": self.step,
                "samples": self.samples,
                "skipped": self.skipped,
                "elapsed_s": self.elapsed_s,
                "world": self.world,
            },
            "rng": torch.get_rng_state(),
        }

    def save(self) -> None:
        """Write ``checkpoint.pt``."""
        if self.folder is not None and self.rank == 0:
            save_checkpoint(self.folder / "checkpoint.pt", self.state())

    def start_from(self, path: str | Path) -> None:
        """Take the weights of another network of the same shapes; everything else starts anew.

        Raises:
            CheckpointError: a damaged file, or weights of other shapes.
        """
        network, _ = load_weights(path)
        try:
            self.network.load_state_dict(network.state_dict())
            if self.ema is not None:
                self.ema.load_state_dict(network.state_dict())
        except RuntimeError as error:
            raise CheckpointError(f"{path}: does not fit this network: {error}") from error

    def resume(self, path: str | Path) -> None:
        """Go on where a checkpoint ended.

        Raises:
            CheckpointError: a damaged file, or one of another network or seed.
        """
        state = load_checkpoint(path)
        theirs = state.get("options", {}).get("network")
        if not isinstance(theirs, dict) or "ema" not in state:
            raise CheckpointError(f"{path}: is no checkpoint of tools/train.py's networks.")
        # how often the weights are used is no part of them
        ours = dataclasses.asdict(self.options.network) | {"passes": theirs.get("passes")}
        if theirs != ours:
            raise CheckpointError(f"{path}: is of network {theirs}, this run asks for {ours}.")
        remedy = (
            ": other samples from here on. Go on with --seed {seed}, or start anew with "
            "--overwrite or in another folder."
        )
        check_seed(path, state, self.options.seed, remedy)
        if (state["ema"] is None) != (self.ema is None):
            raise CheckpointError(
                f"{path}: ema_decay must be above 0 in both or in neither of the runs."
            )
        try:
            self.network.load_state_dict(state["network"])
            self.optimizer.load_state_dict(state["optimizer"])
            if self.ema is not None:
                self.ema.load_state_dict(state["ema"])
        except (RuntimeError, ValueError) as error:
            raise CheckpointError(f"{path}: does not fit this network: {error}") from error
        progress = state["progress"]
        self.step, self.samples = progress["step"], progress["samples"]
        self.skipped, self.elapsed_s = progress["skipped"], progress["elapsed_s"]
        torch.set_rng_state(state["rng"])
