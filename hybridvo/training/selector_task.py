"""Training of the selector: choose, refit inside the predicted masks, choose again.

The fits are those of the pipeline, so that the final choice is learned on the
motions that it gets there.
"""

from __future__ import annotations

import zipfile
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
import torch.nn.functional as F

from hybridvo.errors import FormatError, InputError
from hybridvo.geometry import pose_matrix
from hybridvo.hypotheses.refit import fit_in_mask, mask_weights, nearest_motion
from hybridvo.network.grid_maps import GridMaps
from hybridvo.network.selector_inputs import SelectorInputs, stacked_inputs
from hybridvo.network.selector_net import (
    FirstPass,
    SelectorNetwork,
    SelectorOutput,
)
from hybridvo.options import RefineOptions
from hybridvo.refinement import kernels
from hybridvo.training.options import SelectorOptions
from hybridvo.training.selector_data import MOVING, STATIC, expected_motion

RIGHT_SLOPE = 0.15
"""Softness of the target "right", as a share of the largest
error of a right motion."""
NEARLY = 0.2
"""Difference of two errors, as the same share, at which
their targets are as 1 to e."""


@dataclass(frozen=True, eq=False)
class SelectorBatch:
    """B samples of one grid shape, their motions as N candidates, and ground truth.

    Args:
        samples: (B, 8, n) float32 pixel buffers of the solver.
        depth_true: (B, h, w) metres, 0 where unknown. label: (B, h,
            w) of ``selector_data``.
        T: (B, 3, 4) true T_curr_prev.
        limit: (B,) error of the ego flow up to which a motion is
            right, px at a width of 1024.
        static: (B, h, w) probability of the static scene that a
            pixel-wise network predicts.
        proposal: (B, 3, 4) float64 motion that it predicts,
            NaN where there is none.
    """

    inputs: SelectorInputs
    samples: np.ndarray
    depth_true: torch.Tensor
    label: torch.Tensor
    T: torch.Tensor
    limit: torch.Tensor
    static: torch.Tensor
    proposal: torch.Tensor

    def __len__(self) -> int:
        return len(self.T)

    def to(self, device: torch.device) -> SelectorBatch:
        """The same: fits inside masks run on the CPU."""
        return self

    def with_static_prior(self, wanted: torch.Tensor) -> SelectorBatch:
        """The same with the other network's static mask as an input
        where ``wanted`` (B,) bool.
        """
        wanted = wanted & torch.isfinite(self.proposal).all(dim=(1, 2))
        logit = torch.logit(self.static, eps=1e-4)
        return replace(
            self, inputs=replace(self.inputs, static=logit, has_static=wanted)
        )

    def with_motion_prior(self, rng: np.random.Generator) -> SelectorBatch:
        """The same with motion priors of all kinds, or none.

        Some are priors of another motion of the pair, as after a moving object was
        mistaken for the static scene.
        """
        T_prior = self.T.clone()
        information = self.inputs.prior_information.clone()
        known = rng.random(len(self)) < 0.6
        for b in np.flatnonzero(known):
            mine = self.inputs.pose[self.inputs.owner == b]
            followed = (
                mine[int(rng.integers(len(mine)))]
                if rng.random() < 0.3
                else self.T[b]
            )
            T, std = expected_motion(
                rng, pose_matrix(followed.numpy().astype(np.float64))
            )
            T_prior[b] = torch.as_tensor(T[:3])
            if rng.random() < 0.6:
                information[b] = torch.diag(torch.as_tensor(1.0 / std**2))
        inputs = replace(
            self.inputs,
            T_prior=T_prior,
            prior_information=information,
            has_prior=torch.as_tensor(known),
        )
        return replace(self, inputs=inputs)


def _collate(p: dict[str, np.ndarray]) -> SelectorBatch:
    """Stacked arrays of samples -> batch."""
    size = len(p["count"])
    rows = [
        p["ray"],
        p["depth"][:, None],
        p["target"],
        1 / p["flow_variance"][:, None],
    ]
    rows += [p["depth_variance"][:, None], p["usable"][:, None]]
    # in the order of the solver's buffers
    samples = np.concatenate(rows, axis=1, dtype=np.float32).reshape(
        size, kernels.BUFFER_ROWS, -1
    )
    maps: dict[str, Any] = {field.name: p[field.name] for field in fields(GridMaps)}
    is_motion = np.arange(p["poses"].shape[1]) < p["count"][:, None]
    owner = np.nonzero(is_motion)[0]
    inputs = stacked_inputs(GridMaps(**maps), torch.device("cpu"))
    inputs = inputs.with_candidates(
        p["poses"][is_motion], p["noise"][is_motion], np.arange(len(owner)), owner
    )
    truth = {"depth_true": np.float32, "label": np.int64, "T": np.float32}
    truth |= {"limit": np.float32, "static": np.float32, "proposal": np.float64}
    tensors = {
        name: torch.as_tensor(p[name].astype(kind)) for name, kind in truth.items()
    }
    return SelectorBatch(inputs, samples, **tensors)


def read_batches(
    files: Sequence[Path], batch_size: int, rng: np.random.Generator
) -> Iterator[SelectorBatch]:
    """Shuffled batches of the samples of some shards, each of one grid shape.

    Raises:
        FormatError: a file holds no such samples.
    """
    by_shape: dict[tuple[int, ...], list[dict[str, np.ndarray]]] = {}
    for path in files:
        try:
            with np.load(path) as file:
                shard = dict(file)
            shape = shard["label"].shape[1:]
        except (
            OSError,
            ValueError,
            EOFError,
            KeyError,
            zipfile.BadZipFile,
        ) as error:
            raise FormatError(
                f"{path}: not a shard of samples ({error})."
            ) from None
        by_shape.setdefault(shape, []).append(shard)
    jobs = []
    for shards in by_shape.values():
        samples = {
            name: np.concatenate([s[name] for s in shards]) for name in shards[0]
        }
        order = rng.permutation(len(samples["count"]))
        jobs += [
            (samples, order[k : k + batch_size])
            for k in range(0, len(order), batch_size)
        ]
    rng.shuffle(jobs)
    for samples, index in jobs:
        yield _collate({key: value[index] for key, value in samples.items()})


def ego_flow_error(
    pose: torch.Tensor, owner: torch.Tensor, batch: SelectorBatch
) -> torch.Tensor:
    """(N,) mean ego-flow error of the poses, px at a width of 1024."""
    z = batch.depth_true[:, ::2, ::2].flatten(1)
    ray = batch.inputs.ray[:, :, ::2, ::2].flatten(2)
    points = torch.cat([ray, torch.ones_like(ray[:, :1])], 1) * z[:, None]
    focal = batch.inputs.K[:, :2, None]

    def project(P: torch.Tensor, of: torch.Tensor) -> torch.Tensor:
        """Where motions P (N, 3, 4) take the points of the samples
        ``of`` (N,), less the centre.
        """
        moved = P[:, :, :3] @ points[of] + P[:, :, 3:]
        return focal[of] * moved[:, :2] / moved[:, 2:].clamp(min=1e-3)

    truth = project(batch.T, torch.arange(len(batch)))
    distance = (project(pose, owner) - truth[owner]).norm(dim=1)
    known = (z > 0)[owner]
    total = torch.where(known, distance.clamp(max=1e3), 0.0).sum(1)
    error = total / known.sum(1).clamp(min=1)
    return error * 1024.0 / batch.inputs.width[owner]


def refits_of(
    batch: SelectorBatch, out: SelectorOutput, count: int, draw: torch.Generator
) -> SelectorInputs | None:
    """Fit the ``count`` best motions of every sample inside their
    masks, as new candidates.

    Where another network's static mask is an input, that network's motion is fitted
    too. In some samples one motion is drawn at random, so that the training covers
    more than the best ones.
    """
    inputs = batch.inputs
    cutoff = RefineOptions().cutoff
    probability = torch.sigmoid(out.mask).numpy()
    poses = []
    noise = []
    parents = []
    for b in range(len(batch)):
        mine = torch.nonzero(inputs.owner == b)[:, 0]
        order = mine[out.score[mine].argsort(descending=True)].tolist()
        if len(order) > count and torch.rand((), generator=draw) < 0.3:
            order[count - 1] = order[
                int(torch.randint(count, len(order), (), generator=draw))
            ]
        starts = [
            (inputs.pose[k].numpy(), probability[k], k) for k in order[:count]
        ]
        if inputs.has_static[b]:
            start = batch.proposal[b].numpy()
            z = inputs.depth[b][inputs.usable[b]]
            near = nearest_motion(
                inputs.pose[mine].numpy(), start, 1.0 / float(z.median())
            )
            starts.append((start, batch.static[b].numpy(), int(mine[near])))
        for start, mask, k in starts:
            weights = mask_weights(mask)
            K = inputs.K[b].numpy()
            if weights.max() <= 0:
                continue
            start = start.astype(np.float64)
            pose, stats = fit_in_mask(batch.samples[b], weights, K, start, cutoff)
            if np.isfinite(pose).all():
                poses.append(pose)
                noise.append(stats.noise)
                parents.append(k)
    if not poses:
        return None
    return inputs.with_candidates(
        np.stack(poses), np.array(noise), parents, inputs.owner[parents]
    )


class SelectorPasses:
    """The two passes of a network over the motions of a
    batch and over their refits.

    ``owner``, ``pose``, ``score`` and ``error`` (px) are
    those of all motions so far.
    """

    def __init__(
        self, model: SelectorNetwork, batch: SelectorBatch, mirror: torch.Tensor
    ) -> None:
        self.model = model
        self.batch = batch
        self.mirror = mirror
        self._answers: list[tuple[torch.Tensor, ...]] = []
        self.first = self._score(batch.inputs, None)

    def _score(self, inputs: SelectorInputs, first: FirstPass) -> SelectorOutput:
        out = self.model(inputs, first, self.mirror)
        error = ego_flow_error(inputs.pose, inputs.owner, self.batch)
        self._answers.append((inputs.owner, inputs.pose, out.score, error))
        self.owner, self.pose, self.score, self.error = map(
            torch.cat, zip(*self._answers, strict=True)
        )
        return out

    def second(
        self, refits: int, draw: torch.Generator
    ) -> tuple[SelectorOutput, SelectorInputs] | None:
        """Fit the best motions inside their masks and score these too.

        None without a fit.
        """
        with torch.no_grad():
            more = refits_of(self.batch, self.first, refits, draw)
        if more is None:
            return None
        return self._score(more, (self.batch.inputs, self.first)), more

    def choice_loss(self) -> torch.Tensor:
        """Cross entropy of the choice among the motions and "none of them".

        The targets are soft: motions that are nearly as good as
        the best have a part of it.
        """
        losses = []
        for b, limit in enumerate(self.batch.limit):
            error = self.error[self.owner == b]
            score = self.score[self.owner == b]
            best = error.min()
            right = torch.sigmoid((1 - best / limit) / RIGHT_SLOPE)
            target = right * torch.softmax((best - error) / (NEARLY * limit), 0)
            target = torch.cat([target, (1 - right)[None]])
            losses.append(
                -(target * torch.log_softmax(F.pad(score, (0, 1)), 0)).sum()
            )
        return torch.stack(losses).mean()

    def mask_loss(
        self, out: SelectorOutput, inputs: SelectorInputs
    ) -> torch.Tensor:
        """Binary cross entropy of the masks over usable pixels with a label."""
        label = self.batch.label[inputs.owner]
        known = inputs.usable[inputs.owner] & (
            (label == STATIC) | (label == MOVING)
        )
        static = (label == STATIC).float()
        loss = F.binary_cross_entropy_with_logits(
            out.mask, static, reduction="none"
        )
        return ((loss * known).sum((1, 2)) / known.sum((1, 2)).clamp(min=1)).mean()


class SelectorTask:
    """The selector, its folder of shards (more may be added during
    training) and its losses.
    """

    def __init__(self, options: SelectorOptions, folder: Path) -> None:
        self.options = options
        self.folder = Path(folder)
        self.data = str(folder)
        torch.manual_seed(options.seed)
        self.network = SelectorNetwork(options.network)

    def batches(self, samples: int, workers: int) -> Iterator[SelectorBatch]:
        """Batches of the samples of shards, which are chosen and
        shuffled again in each round.
        """
        round_number = 0
        while True:
            files = sorted(self.folder.glob("*.npz"))
            if not files:
                raise InputError(
                    f"{self.folder}: no shards of samples; write some with "
                    f"hybridvo train selector-data."
                )
            rng = np.random.default_rng([self.options.seed, samples, round_number])
            picked = rng.permutation(len(files))[: self.options.files]
            yield from read_batches(
                [files[k] for k in picked], self.options.batch_size, rng
            )
            round_number += 1

    def loss(
        self, batch: SelectorBatch, step: int
    ) -> tuple[torch.Tensor, dict[str, torch.Tensor]]:
        """Losses of the choice and of the masks in both passes."""
        o = self.options
        count = len(batch)
        draw = torch.Generator().manual_seed((o.seed << 32) + step)
        asked = torch.rand(count, generator=draw) < o.asked_share
        batch = batch.with_motion_prior(np.random.default_rng([o.seed, step]))
        batch = batch.with_static_prior(asked)
        mirror = torch.rand(count, generator=draw) < 0.5
        passes = SelectorPasses(self.network, batch, mirror)
        mask = o.mask_weight * passes.mask_loss(passes.first, batch.inputs)
        losses = {"choice": passes.choice_loss(), "mask": mask}
        # one fit less in half of the updates: this is cheaper
        fewer = o.refits > 1 and bool(torch.rand((), generator=draw) < 0.5)
        second = passes.second(o.refits - fewer, draw)
        if second is not None:
            losses["second"] = passes.choice_loss()
            losses["second_mask"] = 0.5 * o.mask_weight * passes.mask_loss(*second)
        total = torch.stack(list(losses.values())).sum()
        return total, {name: value.detach() for name, value in losses.items()}
