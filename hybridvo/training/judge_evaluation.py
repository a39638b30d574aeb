"""How often the judge is wrong on held-out pictures, beside counting and beside oracles."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import torch

from hybridvo.hypotheses.generate import fit_in_mask
from hybridvo.network.judge import JudgeNetwork
from hybridvo.options import RefineOptions
from hybridvo.training.judge_batches import ego_flow_error, read_batches, refits_of
from hybridvo.training.judge_loop import RIGHT_PX
from hybridvo.training.rendered_pictures import MOVING, STATIC

__all__ = ["evaluate_judge"]


@torch.no_grad()
def evaluate_judge(
    network: JudgeNetwork,
    files: list[Path],
    refits: int = 2,
    batch_size: int = 8,
    asked: bool = False,
) -> dict[str, dict[str, Any]]:
    """Shares of wrong answers on pictures of shards, by source.

    Args:
        network: the judge.
        files: shards.
        refits: motions of a picture that are fitted again.
        batch_size: pictures at once.
        asked: whether the pixel-wise network takes part.

    Returns:
        For each source: ``pictures``, and the share of pictures whose motion is further than a
        pixel from the truth for ``support`` (the first motion found), ``chosen`` (the judge's
        first choice), ``final`` (after the second look), ``best`` and ``best_final`` (the best of
        them, an oracle) and ``true_mask`` (fitted in the true mask, an oracle); ``auc_mask``;
        ``trust_right`` and ``trust_wrong``, the mean probability given to right and wrong answers.
    """
    rows: dict[int, list[list[float]]] = {0: [], 1: [], 2: []}
    for batch in read_batches(files, batch_size, None):
        batch = batch.shown(torch.full((len(batch.T),), asked))
        inputs = batch.inputs
        out = network(inputs)
        more = refits_of(batch, out, refits)
        assert more is not None
        again = network(more, (inputs, out))
        owner = torch.cat([inputs.owner, more.owner])
        score, hidden = torch.cat([out.score, again.score]), torch.cat([out.hidden, again.hidden])
        error = torch.cat(
            [
                ego_flow_error(inputs.pose, inputs.owner, batch),
                ego_flow_error(more.pose, more.owner, batch),
            ]
        )
        trust = torch.sigmoid(network.confidence(score, hidden, owner, len(batch.T)))
        old = len(inputs.owner)
        cutoff = RefineOptions().cutoff
        for b in range(len(batch.T)):
            mine = torch.nonzero(owner == b)[:, 0]
            first = mine[mine < old]
            pick = first[out.score[first].argmax()]
            final = mine[score[mine].argmax()]
            static = (batch.label[b] == STATIC).numpy().astype(np.float32)
            pose, _ = fit_in_mask(
                batch.samples[b],
                static,
                inputs.K[b].numpy(),
                batch.T[b].numpy().astype(float),
                cutoff,
            )
            true_mask = ego_flow_error(
                torch.as_tensor(pose, dtype=torch.float32)[None], torch.tensor([b]), batch
            )
            rows[int(batch.source[b])].append(
                [
                    float(error[first[0]]),
                    float(error[pick]),
                    float(error[final]),
                    float(error[first].min()),
                    float(error[mine].min()),
                    float(true_mask),
                    float(trust[b]),
                    float((batch.label[b] == MOVING).float().mean()),
                    float(final >= old),
                ]
            )
    result: dict[str, dict[str, Any]] = {}
    names = ("support", "chosen", "final", "best", "best_final", "true_mask")
    for source, name in enumerate(("wide", "true", "dis")):
        table = np.array(rows[source]).reshape(-1, 9)
        for part, keep in ((name, table[:, 7] >= 0), (f"{name}_heavy", table[:, 7] >= 0.45)):
            t = table[keep]
            if not len(t):
                continue
            wrong = t[:, 2] > RIGHT_PX
            result[part] = {
                "pictures": len(t),
                **{k: round(float((t[:, i] > RIGHT_PX).mean()), 4) for i, k in enumerate(names)},
                "median_final_px": round(float(np.median(t[:, 2])), 3),
                "median_support_px": round(float(np.median(t[:, 0])), 3),
                "refit_share": round(float(t[:, 8].mean()), 3),
                "trust_right": round(float(t[~wrong, 6].mean()), 3) if (~wrong).any() else None,
                "trust_wrong": round(float(t[wrong, 6].mean()), 3) if wrong.any() else None,
            }
    return result
