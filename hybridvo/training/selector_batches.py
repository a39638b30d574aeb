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
from hybridvo.synthetic.dataset import read_shards
from hybridvo.synthetic.draws import log_uniform


@dataclass(frozen=True, eq=False)
class SelectorBatch:
    """B samples of one grid shape, their motions as N candidates, and ground truth.

    Args:
        samples: (B, 8, n) float32 pixel buffers of the solver.
        depth_true: (B, h, w) metres, 0 where unknown. label: (B, h, w) of ``synthetic.dataset``.
        T: (B, 3, 4) true T_curr_prev. source: (B,) number in ``SOURCES``.
        static: (B, h, w) probability to be static world that a pixel-wise network states.
        proposal: (B, 3, 4) float64 its motion, NaN where it was not asked.
    """

    inputs: SelectorInputs
    samples: np.ndarray
    depth_true: torch.Tensor
    label: torch.Tensor
    T: torch.Tensor
    source: torch.Tensor
    static: torch.Tensor
    proposal: torch.Tensor

    def __len__(self) -> int:
        return len(self.T)

    def to(self, device: torch.device) -> SelectorBatch:
        """The same: the solver that fits inside masks runs on the CPU."""
        return self

    def shown(self, asked: torch.Tensor) -> SelectorBatch:
        """The same with the static world of the other network shown for ``asked`` (B,) bool."""
        asked = asked & torch.isfinite(self.proposal).all(dim=(1, 2))
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
    maps: dict[str, Any] = {field.name: p[field.name] for field in fields(GridMaps)}
    there = np.arange(p["poses"].shape[1]) < p["count"][:, None]
    owner = np.nonzero(there)[0]
    inputs = replace(
        stacked_inputs(GridMaps(**maps), torch.device("cpu")),
        T_prior=torch.as_tensor(p["T_prior"].astype(np.float32)),
        has_prior=torch.as_tensor(p["has_prior"]),
    ).asking(p["poses"][there], p["facts"][there], np.arange(len(owner)), owner)
    truth = {"depth_true": np.float32, "label": np.int64, "T": np.float32, "source": np.int64}
    truth |= {"static": np.float32, "proposal": np.float64}
    tensors = {name: torch.as_tensor(p[name].astype(kind)) for name, kind in truth.items()}
    return SelectorBatch(inputs, samples, **tensors)


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
    inputs, cutoff = batch.inputs, RefineOptions().cutoff
    assert out.mask is not None
    probability = torch.sigmoid(out.mask).numpy()
    poses, facts, parents = [], [], []
    for b in range(len(batch)):
        mine = torch.nonzero(inputs.owner == b)[:, 0]
        order = mine[out.score[mine].argsort(descending=True)].tolist()
        if extra is not None and len(order) > count and torch.rand((), generator=extra) < 0.3:
            swap = int(torch.randint(count, len(order), (), generator=extra))
            order[count - 1], order[swap] = order[swap], order[count - 1]
        starts = [(inputs.pose[k].numpy().astype(np.float64), k) for k in order[:count]]
        masks = [probability[k] for k in order[:count]]
        if inputs.has_static[b]:
            start, z = batch.proposal[b].numpy(), inputs.depth[b][inputs.usable[b]]
            near = nearest_motion(inputs.pose[mine].numpy(), start, 1.0 / float(z.median()))
            starts.append((start, int(mine[near])))
            masks.append(batch.static[b].numpy())
        for (start, k), mask in zip(starts, masks, strict=True):
            weights, K = mask_weights(mask), inputs.K[b].numpy()
            if weights.max() <= 0:
                continue
            pose, fact = fit_in_mask(batch.samples[b], weights, K, start, cutoff)
            if np.isfinite(pose).all():
                poses.append(pose)
                facts.append(fact)
                parents.append(k)
    if not poses:
        return None
    return inputs.asking(np.stack(poses), np.stack(facts), parents, inputs.owner[parents])
