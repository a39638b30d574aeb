"""Samples of shards as batches of the selector, and fits inside the masks that it draws."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch

from hybridvo.geometry import pose_matrix, se3_exp
from hybridvo.hypotheses.generate import GridMaps, fit_in_mask
from hybridvo.hypotheses.selector import mask_weights, nearest_motion
from hybridvo.network.selector_inputs import SelectorInputs, stacked_inputs
from hybridvo.network.selector_net import SelectorOutput
from hybridvo.options import RefineOptions
from hybridvo.refinement import kernels
from hybridvo.synthetic.draws import log_uniform
from hybridvo.training.shards import read_shards


@dataclass(frozen=True, eq=False)
class SelectorBatch:
    """B samples of one grid shape, their motions as N candidates, and ground truth.

    Args:
        samples: (B, 8, n) float32 pixel buffers of the solver.
        depth_true: (B, h, w) metres, 0 where unknown. label: (B, h, w) of ``shards``.
        T: (B, 3, 4) true T_curr_prev.
        source: (B,) 0 layered, 1 rendered with true (or noisy) flow, 2 rendered with DIS flow.
        static: (B, h, w) probability to be static world that a pixel-wise network states.
        proposal: (B, 3, 4) its motion. proposed: (B,) bool, whether it was asked.
    """

    inputs: SelectorInputs
    samples: np.ndarray
    depth_true: torch.Tensor
    label: torch.Tensor
    T: torch.Tensor
    source: np.ndarray
    static: torch.Tensor
    proposal: np.ndarray
    proposed: torch.Tensor

    def __len__(self) -> int:
        return len(self.T)

    def to(self, device: torch.device) -> SelectorBatch:
        """The same: the solver that fits inside masks runs on the CPU."""
        return self

    def shown(self, asked: torch.Tensor) -> SelectorBatch:
        """The same with the static world of the other network shown for ``asked`` (B,) bool."""
        asked = asked & self.proposed
        logit = torch.logit(self.static, eps=1e-4)
        return replace(self, inputs=replace(self.inputs, static=logit, has_static=asked))

    def expecting(self, rng: np.random.Generator) -> SelectorBatch:
        """The same with motions expected by histories of all kinds: none, good, wrong, too sure."""
        count = len(self.T)
        truth = self.T.numpy().astype(np.float64)
        last = np.tile(np.eye(4), (count, 1, 1))
        information = self.inputs.prior_information.clone()
        known = rng.random(count) < 0.6
        for b in np.flatnonzero(known):
            length = max(float(np.linalg.norm(truth[b, :, 3])), 1e-3)
            spread = np.repeat([log_uniform(rng, (0.02, 0.6)) * length, 0.0], 3)
            spread[3:] = log_uniform(rng, (3e-4, 1e-2))
            spread *= np.exp(0.5 * rng.standard_normal(6))
            stated = spread * log_uniform(rng, (0.5, 2.0))
            if rng.random() < 0.12:  # the camera was pushed: the history knows nothing of it
                spread = np.array([2 * length] * 3 + [0.04] * 3)
            last[b] = se3_exp(spread * rng.standard_normal(6)) @ pose_matrix(truth[b])
            if rng.random() < 0.6:
                information[b] = torch.diag(torch.as_tensor(1.0 / stated**2).float())
        inputs = replace(
            self.inputs,
            T_prior=torch.as_tensor(last[:, :3], dtype=torch.float32),
            prior_information=information,
            has_prior=torch.as_tensor(known),
        )
        return replace(self, inputs=inputs)


def _collate(p: dict[str, np.ndarray]) -> SelectorBatch:
    """Stacked arrays of samples -> batch."""
    size = len(p["count"])
    rows = [p["ray"], p["depth"][:, None], p["target"], 1 / p["flow_variance"][:, None]]
    rows += [p["depth_variance"][:, None], p["usable"][:, None]]
    # in the order of the solver's buffers
    samples = np.concatenate(rows, axis=1, dtype=np.float32).reshape(size, kernels.BUFFER_ROWS, -1)
    owner = np.repeat(np.arange(size), p["count"])
    picks = [(b, k) for b in range(size) for k in range(p["count"][b])]
    pose = np.stack([p["poses"][i] for i in picks])
    facts = np.stack([p["facts"][i] for i in picks])

    def tensor(x: Any, kind: torch.dtype = torch.float32) -> torch.Tensor:
        return torch.as_tensor(np.ascontiguousarray(x)).to(kind)

    maps: dict[str, Any] = {field.name: p[field.name] for field in fields(GridMaps)}
    inputs = replace(
        stacked_inputs(GridMaps(**maps), torch.device("cpu")),
        T_prior=tensor(p["T_prior"]),
        has_prior=tensor(p["has_prior"], torch.bool),
    ).asking(pose, facts, np.arange(len(owner)), owner)
    return SelectorBatch(
        inputs,
        samples,
        tensor(p["depth_true"]),
        tensor(p["label"], torch.int64),
        tensor(p["T"]),
        np.asarray(p["source"]),
        tensor(p["static"]),
        p["proposal"].astype(np.float64),
        tensor(np.isfinite(p["proposal"]).all((1, 2)), torch.bool),
    )


def read_batches(
    files: list[Path], batch_size: int, rng: np.random.Generator | None
) -> Iterator[SelectorBatch]:
    """Batches of the samples of some shards, mixed if ``rng`` is given."""
    jobs = []
    for samples in read_shards(files):
        order = np.arange(len(samples["count"]))
        if rng is not None:
            rng.shuffle(order)
        for k in range(0, len(order), batch_size):
            jobs.append((samples, order[k : k + batch_size]))
    if rng is not None:
        rng.shuffle(jobs)
    for samples, index in jobs:
        yield _collate({key: value[index] for key, value in samples.items()})


def ego_flow_error(pose: torch.Tensor, owner: torch.Tensor, batch: SelectorBatch) -> torch.Tensor:
    """(N,) mean distance of the ego flows of pose and truth, px at a width of 1024."""
    z = batch.depth_true[:, ::2, ::2].flatten(1)
    ray = batch.inputs.ray[:, :, ::2, ::2].flatten(2)
    points = torch.cat([ray, torch.ones_like(ray[:, :1])], 1) * z[:, None]
    focal = batch.inputs.K[:, :2, None]

    def seen(P: torch.Tensor, of: torch.Tensor) -> torch.Tensor:
        moved = P[:, :, :3] @ points[of] + P[:, :, 3:]
        return focal[of] * moved[:, :2] / moved[:, 2:].clamp(min=1e-3)

    truth = seen(batch.T, torch.arange(len(batch)))
    distance = (seen(pose, owner) - truth[owner]).norm(dim=1)
    known = (z > 0)[owner]
    total = torch.where(known, distance.clamp(max=1e3), 0.0).sum(1)
    error = total / known.sum(1).clamp(min=1)
    return error * 1024.0 / batch.inputs.image_width[owner]


def refits_of(
    batch: SelectorBatch, out: SelectorOutput, count: int, extra: torch.Generator | None = None
) -> SelectorInputs | None:
    """The ``count`` best motions of every sample, fitted inside their masks, as new candidates.

    Where the selector is shown another network's static world, that network's motion takes part.
    ``extra`` draws one of them anew at times (training), so that more than the best is seen.
    """
    inputs = batch.inputs
    cutoff = RefineOptions().cutoff
    assert out.mask is not None
    probability = torch.sigmoid(out.mask).numpy()
    poses, found, parents = [], [], []
    for b in range(len(batch.T)):
        mine = torch.nonzero(inputs.owner == b)[:, 0]
        order = mine[out.score[mine].argsort(descending=True)].tolist()
        if extra is not None and len(order) > count and torch.rand((), generator=extra) < 0.3:
            swap = int(torch.randint(count, len(order), (), generator=extra))
            order[count - 1], order[swap] = order[swap], order[count - 1]
        entries = [
            (inputs.pose[k].numpy().astype(np.float64), mask_weights(probability[k]), k)
            for k in order[:count]
        ]
        if inputs.has_static[b]:
            weights = mask_weights(batch.static[b].numpy())
            z = inputs.depth[b][inputs.usable[b]]
            start = batch.proposal[b]
            near = nearest_motion(inputs.pose[mine].numpy(), start, 1.0 / float(z.median()))
            entries.append((start, weights, int(mine[near])))
        for start, weights, k in entries:
            if weights.max() <= 0:
                continue
            pose, fact = fit_in_mask(batch.samples[b], weights, inputs.K[b].numpy(), start, cutoff)
            if np.isfinite(pose).all():
                poses.append(pose)
                found.append(fact)
                parents.append(k)
    if not poses:
        return None
    owner = inputs.owner[torch.tensor(parents)]
    return inputs.asking(np.stack(poses), np.stack(found), parents, owner)
