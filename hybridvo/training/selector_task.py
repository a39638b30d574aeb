"""Training of the selector: choose, refit inside the masks it draws, choose again.

The fits are those of the pipeline: the final choice is learned on what it will be asked about.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
import torch.nn.functional as F

from hybridvo.errors import InputError
from hybridvo.network.selector_inputs import SelectorInputs
from hybridvo.network.selector_net import SelectorNetwork, SelectorOutput
from hybridvo.synthetic.dataset import MOVING, SOURCES, STATIC
from hybridvo.training.options import SelectorOptions
from hybridvo.training.selector_batches import (
    SelectorBatch,
    ego_flow_error,
    read_batches,
    refits_of,
)

RIGHT_PX = 1.0
"""px at a width of 1024: mean error of the ego flow up to which a motion is right."""
WORST_RIGHT_PX = 3.0
"""The same where flow allows no better: three times the error of the best motion, at most this."""
RIGHT_SLOPE = 0.15
"""Softness of that limit as a target, of itself."""


def choice_loss(
    score: torch.Tensor, error: torch.Tensor, owner: torch.Tensor, samples: int
) -> torch.Tensor:
    """Cross entropy against a soft target: motions nearly as good as the best share it."""
    losses = []
    for b in range(samples):
        mine = owner == b
        wrong = error[mine]
        best = wrong.min()
        target = torch.softmax(-(wrong - best) / (0.1 + 0.3 * best), 0)
        weight = 1.0 / (1.0 + (best / 4.0) ** 2)
        losses.append(-weight * (target * torch.log_softmax(score[mine], 0)).sum())
    return torch.stack(losses).mean()


def mask_loss(out: SelectorOutput, inputs: SelectorInputs, label: torch.Tensor) -> torch.Tensor:
    """Binary cross entropy of the masks over usable pixels of known kind."""
    label = label[inputs.owner]
    known = inputs.usable[inputs.owner] & ((label == STATIC) | (label == MOVING))
    static = (label == STATIC).float()
    assert out.mask is not None
    loss = F.binary_cross_entropy_with_logits(out.mask, static, reduction="none")
    return ((loss * known).sum((1, 2)) / known.sum((1, 2)).clamp(min=1)).mean()


def trust_loss(
    logit: torch.Tensor, score: torch.Tensor, error: torch.Tensor, owner: torch.Tensor
) -> torch.Tensor:
    """Binary cross entropy of the probability that the chosen motion is right."""
    target = []
    for b in range(len(logit)):
        mine = owner == b
        chosen = error[mine][score[mine].argmax()]
        limit = (3 * error[mine].min()).clamp(RIGHT_PX, WORST_RIGHT_PX)
        target.append(torch.sigmoid((1 - chosen / limit) / RIGHT_SLOPE))
    return F.binary_cross_entropy_with_logits(logit, torch.stack(target))


class Looks:
    """What a network answers about the motions of a batch, and about their refits."""

    def __init__(
        self,
        model: torch.nn.Module,
        batch: SelectorBatch,
        mirror: torch.Tensor | None = None,
        half: bool = False,
    ) -> None:
        self.model, self.batch, self.mirror, self.half = model, batch, mirror, half
        self.first = self._ask(batch.inputs, None)
        self.owner, self.score = batch.inputs.owner, self.first.score
        self.hidden = self.first.hidden
        self.error = ego_flow_error(batch.inputs.pose, self.owner, batch)

    def _ask(
        self, inputs: SelectorInputs, first: tuple[SelectorInputs, SelectorOutput] | None
    ) -> SelectorOutput:
        with torch.autocast("cpu", torch.bfloat16, enabled=self.half):
            out = self.model(inputs, first, self.mirror)
        single = {name: getattr(out, name).float() for name in ("score", "hidden", "mask")}
        return replace(out, **single)

    def again(
        self, refits: int, draw: torch.Generator | None = None
    ) -> tuple[SelectorOutput, SelectorInputs] | None:
        """Fit the best inside their masks and add the answers about these; None without a fit."""
        with torch.no_grad():
            more = refits_of(self.batch, self.first, refits, draw)
        if more is None:
            return None
        out = self._ask(more, (self.batch.inputs, self.first))
        self.owner = torch.cat([self.owner, more.owner])
        self.score = torch.cat([self.score, out.score])
        self.hidden = torch.cat([self.hidden, out.hidden])
        self.error = torch.cat([self.error, ego_flow_error(more.pose, more.owner, self.batch)])
        return out, more


class SelectorTask:
    """The selector, a folder of shards (more may appear while training) and the losses."""

    all_parameters_used = False

    def __init__(self, options: SelectorOptions, folder: Path) -> None:
        self.options, self.folder, self.data = options, Path(folder), str(folder)
        torch.manual_seed(options.seed)
        self.network = SelectorNetwork(options.network)

    def batches(self, samples: int, workers: int, rank: int, world: int) -> Iterator[SelectorBatch]:
        """Batches of shards that are picked and mixed anew each round."""
        round_number = 0
        while True:
            files = sorted(self.folder.glob("*.npz"))
            if not files:
                raise InputError(f"{self.folder}: no shards of samples; make some first.")
            rng = np.random.default_rng([self.options.seed, samples, rank, round_number])
            picked = rng.permutation(len(files))[: self.options.files]
            yield from read_batches([files[k] for k in picked], self.options.batch_size, rng)
            round_number += 1

    def loss(
        self, model: torch.nn.Module, batch: SelectorBatch, step: int, progress: float
    ) -> tuple[torch.Tensor, dict[str, torch.Tensor]]:
        """Losses of the choice, of the masks and of the stated probability."""
        o, count = self.options, len(batch)
        draw = torch.Generator().manual_seed((o.seed << 32) + step)
        asked = torch.rand(count, generator=draw) < o.asked_share
        batch = batch.expecting(np.random.default_rng([o.seed, step])).shown(asked)
        mirror = torch.rand(count, generator=draw) < 0.5
        looks = Looks(model, batch, mirror, o.precision == "bfloat16")
        losses = {
            "choice": choice_loss(looks.score, looks.error, looks.owner, count),
            "mask": o.mask_weight * mask_loss(looks.first, batch.inputs, batch.label),
        }
        if progress >= o.second_look_from:
            # one fit less in half of the updates: cheaper, and the best one is seen most
            fewer = o.refits > 1 and bool(torch.rand((), generator=draw) < 0.5)
            again = looks.again(o.refits - fewer, draw)
            if again is not None:
                losses["second"] = choice_loss(looks.score, looks.error, looks.owner, count)
                losses["second_mask"] = 0.5 * o.mask_weight * mask_loss(*again, batch.label)
        trust = self.network.confidence(looks.score, looks.hidden, looks.owner, count)
        losses["trust"] = o.trust_weight * trust_loss(
            trust, looks.score.detach(), looks.error, looks.owner
        )
        total = torch.stack(list(losses.values())).sum()
        return total, {name: value.detach() for name, value in losses.items()}

    def evaluate(self, network: torch.nn.Module) -> dict[str, Any]:
        """Figures on the held-out shards beside the training's, ``FOLDER_held_out``."""
        folder = self.folder.with_name(f"{self.folder.name}_held_out")
        files = sorted(folder.glob("*.npz"))
        return evaluate_selector(network, files, self.options.refits) if files else {}


@torch.no_grad()
def evaluate_selector(
    network: Any, files: list[Path], refits: int = 2, asked: bool = False
) -> dict[str, dict[str, Any]]:
    """Shares of wrong answers on samples of shards, by source; ``asked``: with the other network.

    For each source: ``samples``, the share of them whose motion is further from the ground truth
    than is right for ``support`` (the first motion found), ``chosen`` (the first choice), ``final``
    (after the second look) and ``best`` (the best of them, an oracle), and ``trust_right`` and
    ``trust_wrong``, the mean probability given to right and wrong answers.
    """
    rows: dict[int, list[list[float]]] = {source: [] for source in range(len(SOURCES))}
    for batch in read_batches(files, 8, None):
        batch = batch.shown(torch.full((len(batch),), asked))
        looks = Looks(network, batch)
        first_look = len(looks.owner)
        looks.again(refits)
        score, error = looks.score, looks.error
        trust = network.confidence(score, looks.hidden, looks.owner, len(batch)).sigmoid()
        for b in range(len(batch)):
            mine = torch.nonzero(looks.owner == b)[:, 0]
            first = mine[mine < first_look]
            picks = (first[0], first[score[first].argmax()], mine[score[mine].argmax()])
            wrong = [float(error[k]) for k in picks] + [float(error[mine].min()), float(trust[b])]
            rows[int(batch.source[b])].append(wrong)
    return {name: _shares(np.array(rows[i])) for i, name in enumerate(SOURCES) if rows[i]}


def _shares(table: np.ndarray) -> dict[str, Any]:
    limit = np.clip(3 * table[:, 3], RIGHT_PX, WORST_RIGHT_PX)
    wrong = table[:, 2] > limit
    result: dict[str, Any] = {"samples": len(table)}
    for i, name in enumerate(("support", "chosen", "final", "best")):
        result[name] = round(float((table[:, i] > limit).mean()), 4)
    result["median_final_px"] = round(float(np.median(table[:, 2])), 3)
    for name, rows in (("trust_right", ~wrong), ("trust_wrong", wrong)):
        result[name] = round(float(table[rows, 4].mean()), 3) if rows.any() else None
    return result
