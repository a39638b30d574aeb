"""Training of the judge: choose, refit inside the masks it draws, choose again.

Every update judges the motions of a few pictures, fits the best of them inside the network's own
second-look masks with the solver of the pipeline, and judges the fits beside the old ones: the
final choice is learned on what it will be asked about.
"""

from __future__ import annotations

import json
import math
import time
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
import torch.nn.functional as F
from safetensors import SafetensorError
from safetensors.torch import load_file

from hybridvo.errors import CheckpointError, InputError
from hybridvo.network.judge import JudgeInputs, JudgeNetwork, JudgeOptions, JudgeOutput
from hybridvo.training.checkpoint import check_seed, load_checkpoint, save_checkpoint
from hybridvo.training.judge_batches import (
    PictureBatch,
    ego_flow_error,
    read_batches,
    refits_of,
)
from hybridvo.training.rendered_pictures import MOVING, STATIC

__all__ = ["JudgeTrainer", "JudgeTrainingOptions"]

RIGHT_PX = 1.0
"""px at a width of 1024: mean error of the ego flow up to which a motion is right."""


@dataclass(frozen=True)
class JudgeTrainingOptions:
    """Options of a training of the judge.

    Args:
        network: shapes.
        seed: of the weights and the order of the pictures.
        batch_size: pictures an update.
        learning_rate: Adam's, at its peak.
        warmup: share of the run in which the rate rises.
        final_share: of the peak that is left at the end.
        clip_norm: largest norm of the gradient.
        ema_decay: of the running average of the weights, which is exported.
        second_look_from: share of the run after which refits take part.
        refits: candidates of a picture that are fitted inside their masks.
        mask_weight: of the loss of the masks beside that of the choice.
        trust_weight: of the loss of the probability that the choice is right.
        asked_share: share of the pictures in which the pixel-wise network's static world is shown
            and its motion takes part, as where the judge alone is in doubt.
        files: shards from which the pictures of a round are mixed.
        bfloat16: run the network's convolutions in bfloat16 while training.

    Raises:
        InputError: values that cannot be meant.
    """

    network: JudgeOptions = field(default_factory=JudgeOptions)
    seed: int = 0
    batch_size: int = 8
    learning_rate: float = 1e-3
    warmup: float = 0.02
    final_share: float = 0.02
    clip_norm: float = 1.0
    ema_decay: float = 0.998
    second_look_from: float = 0.1
    refits: int = 2
    mask_weight: float = 1.0
    trust_weight: float = 0.5
    asked_share: float = 0.5
    files: int = 48
    bfloat16: bool = True

    def __post_init__(self) -> None:
        for name in ("batch_size", "refits", "files"):
            if getattr(self, name) < 1:
                raise InputError(f"JudgeTrainingOptions.{name}: expected at least 1.")
        if not 0 <= self.ema_decay < 1 or not self.learning_rate > 0:
            raise InputError(
                "JudgeTrainingOptions: expected 0 <= ema_decay < 1 and learning_rate > 0."
            )


def choice_loss(
    score: torch.Tensor, error: torch.Tensor, owner: torch.Tensor, pictures: int
) -> torch.Tensor:
    """Cross entropy against a soft target: motions nearly as good as the best share it.

    Pictures in which all motions are far off count little: there the choice does not matter.
    """
    losses = []
    for b in range(pictures):
        mine = owner == b
        wrong = error[mine]
        best = wrong.min()
        target = torch.softmax(-(wrong - best) / (0.1 + 0.3 * best), 0)
        weight = 1.0 / (1.0 + (best / 4.0) ** 2)
        losses.append(-weight * (target * torch.log_softmax(score[mine], 0)).sum())
    return torch.stack(losses).mean()


def mask_loss(mask: torch.Tensor, inputs: JudgeInputs, label: torch.Tensor) -> torch.Tensor:
    """Binary cross entropy of the masks over usable pixels of known kind."""
    label = label[inputs.owner]
    known = inputs.usable[inputs.owner] & ((label == STATIC) | (label == MOVING))
    loss = F.binary_cross_entropy_with_logits(
        mask, (label == STATIC).to(mask.dtype), reduction="none"
    )
    return ((loss * known).sum((1, 2)) / known.sum((1, 2)).clamp(min=1)).mean()


def trust_loss(
    logit: torch.Tensor, score: torch.Tensor, error: torch.Tensor, owner: torch.Tensor
) -> torch.Tensor:
    """Binary cross entropy of the probability that the chosen motion is right."""
    target = []
    for b in range(len(logit)):
        mine = owner == b
        chosen = error[mine][score[mine].argmax()]
        target.append(torch.sigmoid((RIGHT_PX - chosen) / 0.15))
    return F.binary_cross_entropy_with_logits(logit, torch.stack(target))


def _float(out: JudgeOutput) -> JudgeOutput:
    """The answers in single precision."""
    return JudgeOutput(out.score.float(), out.mask.float(), out.hidden.float(), out.support)


class JudgeTrainer:
    """One training run on the shards of a folder; resumable.

    Args:
        options: of the run.
        data: folder with shards; more may appear while training.
        out: folder of ``checkpoint.pt`` and ``log.jsonl``.
    """

    def __init__(self, options: JudgeTrainingOptions, data: Path, out: Path) -> None:
        self.options, self.data, self.out = options, Path(data), Path(out)
        torch.manual_seed(options.seed)
        self.network = JudgeNetwork(options.network).to(memory_format=torch.channels_last)  # type: ignore[call-overload]
        self.average = {k: v.clone() for k, v in self.network.state_dict().items()}
        self.optimizer = torch.optim.AdamW(
            self.network.parameters(), options.learning_rate, weight_decay=1e-4
        )
        self.rng = np.random.default_rng(options.seed)
        self.draw = torch.Generator().manual_seed(options.seed)
        self.step = self.pictures = 0
        self.elapsed = 0.0

    def update(self, batch: PictureBatch, progress: float) -> dict[str, float]:
        """One step; returns the losses."""
        o = self.options
        rise = min(1.0, (progress + 1e-3) / o.warmup)
        cosine = 0.5 * (1 + math.cos(math.pi * min(progress, 1.0)))
        for group in self.optimizer.param_groups:
            group["lr"] = o.learning_rate * rise * (o.final_share + (1 - o.final_share) * cosine)
        network, count = self.network, len(batch.T)
        asked = torch.rand(count, generator=self.draw) < o.asked_share
        batch = batch.expecting(self.rng).shown(asked)
        inputs = batch.inputs
        mirror = torch.rand(count, generator=self.draw) < 0.5
        with torch.autocast("cpu", torch.bfloat16, enabled=o.bfloat16):
            out = _float(network(inputs, mirror=mirror))
        error = ego_flow_error(inputs.pose, inputs.owner, batch)
        losses = {
            "choice": choice_loss(out.score, error, inputs.owner, count),
            "mask": o.mask_weight * mask_loss(out.mask, inputs, batch.label),
        }
        score, hidden, owner = out.score, out.hidden, inputs.owner
        if progress >= o.second_look_from:
            with torch.no_grad():
                told = replace(out, score=out.score.detach(), mask=out.mask.detach())
                # one fit less in half of the updates: cheaper, and the best one is seen most
                fewer = o.refits > 1 and bool(torch.rand((), generator=self.draw) < 0.5)
                more = refits_of(batch, told, o.refits - fewer, self.draw)
            if more is not None:
                with torch.autocast("cpu", torch.bfloat16, enabled=o.bfloat16):
                    again = _float(network(more, (inputs, out), mirror))
                owner = torch.cat([owner, more.owner])
                score = torch.cat([score, again.score])
                hidden = torch.cat([hidden, again.hidden])
                error = torch.cat([error, ego_flow_error(more.pose, more.owner, batch)])
                losses["second"] = choice_loss(score, error, owner, count)
                losses["second_mask"] = (
                    0.5 * o.mask_weight * mask_loss(again.mask, more, batch.label)
                )
        trust = network.confidence(score, hidden, owner, count)
        losses["trust"] = o.trust_weight * trust_loss(trust, score.detach(), error, owner)
        total = torch.stack(list(losses.values())).sum()
        self.optimizer.zero_grad(set_to_none=True)
        total.backward()
        norm = torch.nn.utils.clip_grad_norm_(network.parameters(), o.clip_norm)
        if torch.isfinite(norm):
            self.optimizer.step()
        decay = min(o.ema_decay, (1 + self.step) / (10 + self.step))
        for key, value in network.state_dict().items():
            self.average[key].lerp_(value, 1 - decay)
        self.step += 1
        self.pictures += count
        return {k: float(v.detach()) for k, v in losses.items()} | {"norm": float(norm)}

    def run(self, minutes: float, checkpoint_minutes: float = 3.0) -> None:
        """Train until ``minutes`` of the run, earlier parts counted in, have passed."""
        started, before = time.perf_counter(), self.elapsed
        saved = started
        sums: dict[str, list[float]] = {}
        while True:
            files = sorted(self.data.glob("*.npz"))
            if not files:
                raise InputError(f"{self.data}: no shards of pictures; make some first.")
            picked = self.rng.permutation(len(files))[: self.options.files]
            for batch in read_batches(
                [files[k] for k in picked], self.options.batch_size, self.rng
            ):
                self.elapsed = before + (time.perf_counter() - started) / 60
                progress = self.elapsed / minutes
                if progress >= 1.0:
                    self.save()
                    return
                for key, value in self.update(batch, progress).items():
                    sums.setdefault(key, []).append(value)
                if self.step % 100 == 0:
                    self._log(sums, len(files))
                    sums = {}
                if time.perf_counter() - saved > 60 * checkpoint_minutes:
                    self.save()
                    saved = time.perf_counter()

    def _log(self, sums: dict[str, list[float]], files: int) -> None:
        line: dict[str, Any] = {k: round(float(np.mean(v)), 4) for k, v in sums.items()}
        line |= {"step": self.step, "pictures": self.pictures, "files": files}
        line["minutes"] = round(self.elapsed, 2)
        with open(self.out / "log.jsonl", "a", encoding="utf-8") as file:
            file.write(json.dumps(line) + "\n")

    def exported(self) -> JudgeNetwork:
        """The network with the averaged weights."""
        network = JudgeNetwork(self.options.network)
        network.load_state_dict(self.average)
        return network.eval()

    def start_from(self, path: str | Path) -> None:
        """Take the weights of another judge; everything else starts anew.

        One that was shown less than this one is taken as well: what it did not see counts nothing
        at first.

        Raises:
            CheckpointError: a damaged file, or weights of other shapes.
        """
        try:
            stored = load_file(path)
        except (OSError, SafetensorError) as error:
            raise CheckpointError(f"{path}: not a file of weights: {error}") from error
        state = self.network.state_dict()
        if set(stored) != set(state):
            raise CheckpointError(f"{path}: not the weights of a judge.")
        for name, new in state.items():
            old = stored[name].float()
            narrow = old.ndim > 1 and old.shape[0] == new.shape[0] and old.shape[1] < new.shape[1]
            if old.shape != new.shape and not (narrow and old.shape[2:] == new.shape[2:]):
                raise CheckpointError(
                    f"{path}: {name} has shape {tuple(old.shape)}, expected {tuple(new.shape)}."
                )
            if narrow:
                state[name] = torch.zeros_like(new)
                state[name][:, : old.shape[1]] = old
            else:
                state[name] = old
        self.network.load_state_dict(state)
        self.average = {k: v.clone() for k, v in self.network.state_dict().items()}

    def save(self) -> None:
        """Write ``checkpoint.pt``."""
        save_checkpoint(
            self.out / "checkpoint.pt",
            {
                "options": {"width": self.options.network.width, "seed": self.options.seed},
                "network": self.network.state_dict(),
                "optimizer": self.optimizer.state_dict(),
                "ema": self.average,
                "progress": {"step": self.step, "pictures": self.pictures, "minutes": self.elapsed},
                "rng": {
                    "draw": self.draw.get_state(),
                    "order": json.dumps(self.rng.bit_generator.state),
                },
            },
        )

    def resume(self) -> bool:
        """Go on from ``checkpoint.pt`` if there is one.

        Raises:
            CheckpointError: a damaged file, or one of another training or seed.
        """
        path = self.out / "checkpoint.pt"
        if not path.exists():
            return False
        state = load_checkpoint(path)
        remedy = ". Set seed: {seed} in the configuration, or choose another --out."
        check_seed(path, state, self.options.seed, remedy)
        try:
            self.network.load_state_dict(state["network"])
            self.optimizer.load_state_dict(state["optimizer"])
            self.average = state["ema"]
            progress = state["progress"]
            self.step, self.pictures = progress["step"], progress["pictures"]
            self.elapsed = progress["minutes"]
            self.draw.set_state(state["rng"]["draw"])
            self.rng.bit_generator.state = json.loads(state["rng"]["order"])
        except (RuntimeError, ValueError, TypeError, LookupError) as error:
            raise CheckpointError(f"{path}: not of this training of a judge: {error}") from error
        return True
