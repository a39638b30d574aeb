"""Training of PWVO: look at every hypothesis, refit inside the static masks, look again.

The fits are those of the pipeline, so that the last choice is learned on the motions that
it gets there.
"""

from __future__ import annotations

import zipfile
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
import torch.nn.functional as F

from hybridvo.core.errors import FormatError, InputError
from hybridvo.core.geometry import pose_matrix
from hybridvo.core.options import RefineOptions
from hybridvo.hypotheses.refit import fit_in_mask, mask_weights
from hybridvo.network.euler import euler_motion
from hybridvo.network.grid_maps import GridMaps
from hybridvo.network.hypothesis_inputs import (
    HypothesisInputs,
    stacked_inputs,
    with_no_motion,
)
from hybridvo.network.hypothesis_maps import FirstLook, HypothesisMaps, Looks
from hybridvo.network.pwvo import PWVO
from hybridvo.network.scorer import selected_poses
from hybridvo.solver import kernels
from hybridvo_lab.training import ranks
from hybridvo_lab.training.hypothesis_samples import MOVING, STATIC, expected_motion
from hybridvo_lab.training.options import PWVOTrainingOptions

RIGHT_SLOPE = 0.15
"""Softness of the target "right", as a fraction of the largest error of a right motion."""
NEARLY = 0.2
"""Difference of two errors, as the same fraction, at which their targets are as 1 to e."""
MAX_POSE_ERROR = 20.0
"""Largest error of a pixel's pose that counts, in units of what a hypothesis leaves open."""
PRIOR_FRACTION = 0.6
"""Fraction of the samples with an expected motion."""
FOLLOWED_FRACTION = 0.3
"""Fraction of these whose expected motion is one of the hypotheses, right or not."""
RANDOM_REFIT_FRACTION = 0.3
"""Fraction of the samples in which a motion drawn by lot is refitted."""
OF_MOTIONS = ("owner", "parent", "pose", "flow_noise", "depth_noise")
"""Fields of the inputs with a row for each motion; the others have one for each sample."""


@dataclass(frozen=True, eq=False)
class HypothesisBatch:
    """B samples of one grid shape, their motions as N hypotheses, and ground truth.

    Attributes:
        inputs: pairs and hypotheses.
        samples: (B, 8, n) float32 pixel buffers of the solver.
        depth_true: (B, h, w) metres, 0 where unknown.
        label: (B, h, w) of ``hypothesis_samples``.
        T: (B, 3, 4) true T_curr_prev.
        limit: (B,) error of the ego flow up to which a motion is right, px at a width of
            1024.
    """

    inputs: HypothesisInputs
    samples: np.ndarray
    depth_true: torch.Tensor
    label: torch.Tensor
    T: torch.Tensor
    limit: torch.Tensor

    def __len__(self) -> int:
        return len(self.T)

    def to(self, device: torch.device) -> HypothesisBatch:
        """Return the same: fits inside masks run on the CPU."""
        return self

    def with_motion_prior(self, rng: np.random.Generator) -> HypothesisBatch:
        """Return the same with motion priors of all kinds, or none.

        Some are priors of another motion of the pair, as after a moving object was
        mistaken for the static scene.
        """
        T_prior = self.T.clone()
        information = self.inputs.prior_information.clone()
        known = rng.random(len(self)) < PRIOR_FRACTION
        for b in np.flatnonzero(known):
            expected = self.T[b]
            if rng.random() < FOLLOWED_FRACTION:
                motions = self.inputs.pose[self.inputs.owner == b]
                expected = motions[int(rng.integers(len(motions)))]
            T = pose_matrix(expected.numpy().astype(np.float64))
            T, std = expected_motion(rng, T)
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

    def with_no_motion(self, wanted: torch.Tensor) -> HypothesisBatch:
        """Return the same with the hypothesis "no motion" of the samples ``wanted`` (B,)."""
        return replace(self, inputs=with_no_motion(self.inputs, wanted))

    def part(self, numbers: Sequence[int]) -> HypothesisBatch:
        """Return the batch of some of the samples, whose motions are their own parents."""
        picked = torch.as_tensor(list(numbers), dtype=torch.int64)
        inputs = self.inputs
        new_number = torch.full((len(self),), -1)
        new_number[picked] = torch.arange(len(picked))
        owner = new_number[inputs.owner]
        motions = torch.nonzero(owner >= 0)[:, 0]
        of_samples = {
            name: value[picked]
            for name, value in vars(inputs).items()
            if name not in OF_MOTIONS
        }
        of_motions = {name: getattr(inputs, name)[motions] for name in OF_MOTIONS}
        of_motions["owner"] = owner[motions]
        of_motions["parent"] = torch.arange(len(motions))
        return HypothesisBatch(
            inputs=HypothesisInputs(**of_samples, **of_motions),
            samples=self.samples[picked.numpy()],
            depth_true=self.depth_true[picked],
            label=self.label[picked],
            T=self.T[picked],
            limit=self.limit[picked],
        )


# --- reading samples --------------------------------------------------------------


def _collate(arrays: dict[str, np.ndarray]) -> HypothesisBatch:
    """Stacked arrays of samples -> batch."""
    size = len(arrays["count"])
    # in the order of the solver's buffers
    rows = [
        arrays["ray"],
        arrays["depth"][:, None],
        arrays["target"],
        1 / arrays["flow_variance"][:, None],
        arrays["depth_variance"][:, None],
        arrays["usable"][:, None],
    ]
    samples = np.concatenate(rows, axis=1, dtype=np.float32)
    samples = samples.reshape(size, kernels.BUFFER_ROWS, -1)
    maps: dict[str, Any] = {
        field.name: arrays[field.name] for field in fields(GridMaps)
    }
    poses = arrays["poses"]
    is_motion = np.arange(poses.shape[1]) < arrays["count"][:, None]
    owner = np.nonzero(is_motion)[0]
    inputs = stacked_inputs(GridMaps(**maps), torch.device("cpu"))
    inputs = inputs.with_hypotheses(
        poses[is_motion], arrays["noise"][is_motion], np.arange(len(owner)), owner
    )
    return HypothesisBatch(
        inputs=inputs,
        samples=samples,
        depth_true=torch.as_tensor(arrays["depth_true"].astype(np.float32)),
        label=torch.as_tensor(arrays["label"].astype(np.int64)),
        T=torch.as_tensor(arrays["T"].astype(np.float32)),
        limit=torch.as_tensor(arrays["limit"].astype(np.float32)),
    )


def read_batches(
    files: Sequence[Path], batch_size: int, rng: np.random.Generator
) -> Iterator[HypothesisBatch]:
    """Shuffled batches of the samples of some shards, each of one grid shape.

    Raises:
        FormatError: a file holds no such samples.
    """
    by_shape: dict[tuple[int, ...], list[dict[str, np.ndarray]]] = {}
    for path in files:
        shard = _read_shard(path)
        by_shape.setdefault(shard["label"].shape[1:], []).append(shard)
    jobs = []
    for shards in by_shape.values():
        samples = {
            name: np.concatenate([s[name] for s in shards]) for name in shards[0]
        }
        order = rng.permutation(len(samples["count"]))
        for first in range(0, len(order), batch_size):
            jobs.append((samples, order[first : first + batch_size]))
    rng.shuffle(jobs)
    for samples, index in jobs:
        yield _collate({key: value[index] for key, value in samples.items()})


def _read_shard(path: Path) -> dict[str, np.ndarray]:
    """The arrays of a shard."""
    try:
        with np.load(path) as file:
            shard = dict(file)
        shard["label"].shape[2]
    except (
        OSError,
        ValueError,
        EOFError,
        KeyError,
        IndexError,
        zipfile.BadZipFile,
    ) as error:
        raise FormatError(f"{path}: not a shard of samples ({error}).") from None
    return shard


# --- errors and fits --------------------------------------------------------------


def ego_flow_error(
    pose: torch.Tensor, owner: torch.Tensor, batch: HypothesisBatch
) -> torch.Tensor:
    """(N,) mean ego-flow error of the poses, px at a width of 1024.

    Over the static pixels; over all where none is static.
    """
    z = batch.depth_true[:, ::2, ::2].flatten(1)
    static = batch.label[:, ::2, ::2].flatten(1) == STATIC
    has_static = (static & (z > 0)).any(1, keepdim=True)
    z = torch.where(static | ~has_static, z, 0.0)
    ray = batch.inputs.ray[:, :, ::2, ::2].flatten(2)
    points = torch.cat([ray, torch.ones_like(ray[:, :1])], 1) * z[:, None]
    focal = batch.inputs.K[:, :2, None]

    def project(P: torch.Tensor, of: torch.Tensor) -> torch.Tensor:
        """Where motions P (N, 3, 4) take the points of the samples ``of`` (N,)."""
        moved = P[:, :, :3] @ points[of] + P[:, :, 3:]
        return focal[of] * moved[:, :2] / moved[:, 2:].clamp(min=1e-3)

    truth = project(batch.T, torch.arange(len(batch)))
    distance = (project(pose, owner) - truth[owner]).norm(dim=1)
    known = (z > 0)[owner]
    total = torch.where(known, distance.clamp(max=1e3), 0.0).sum(1)
    error = total / known.sum(1).clamp(min=1)
    return error * 1024.0 / batch.inputs.width[owner]


def refits_of(
    batch: HypothesisBatch,
    score: torch.Tensor,
    maps: HypothesisMaps,
    count: int,
    lots: torch.Tensor,
) -> HypothesisInputs | None:
    """Fit the ``count`` best motions of every sample inside their masks, as new hypotheses.

    The fits start from the poses that are selected from those of all pixels. In some
    samples one motion is drawn by lot, so that the training covers more than the best ones.

    Args:
        batch: the samples, with their motions.
        score: (N,) of the motions.
        maps: of the motions.
        count: motions of a sample that are fitted.
        lots: (B, 2) uniform in [0, 1): whether a motion is drawn, and which one.
    """
    inputs = batch.inputs
    cutoff = RefineOptions().cutoff
    probability = torch.sigmoid(maps.static).numpy()
    starts = selected_poses(maps.motion, maps.log_scale)
    poses = []
    noise = []
    parents = []
    for b in range(len(batch)):
        for k in _to_refit(score, inputs.owner == b, count, lots[b]):
            weights = mask_weights(probability[k])
            if weights.max() <= 0:
                continue
            K = inputs.K[b].numpy()
            refit = fit_in_mask(batch.samples[b], weights, K, starts[k], cutoff)
            if np.isfinite(refit.pose).all():
                poses.append(refit.pose)
                noise.append(refit.noise)
                parents.append(k)
    if not poses:
        return None
    return inputs.with_hypotheses(
        np.stack(poses), np.array(noise), parents, inputs.owner[parents]
    )


def _to_refit(
    score: torch.Tensor, mine: torch.Tensor, count: int, lots: torch.Tensor
) -> list[int]:
    """Numbers of the hypotheses of a sample that are refitted."""
    numbers = torch.nonzero(mine)[:, 0]
    order = numbers[score[numbers].argsort(descending=True)].tolist()
    by_lot, which = lots.tolist()
    if len(order) > count and by_lot < RANDOM_REFIT_FRACTION:
        drawn = count + int(which * (len(order) - count))
        order[count - 1] = order[drawn]
    return order[:count]


# --- losses -----------------------------------------------------------------------


class TwoLooks:
    """The network's looks at the motions of a batch, and at their refits.

    ``owner``, ``score`` and ``error`` (px) are those of all motions so far; ``looks`` is the
    first look.
    """

    def __init__(
        self, network: PWVO, batch: HypothesisBatch, mirror: torch.Tensor
    ) -> None:
        self.network = network
        self.batch = batch
        self.mirror = mirror
        self._answers: list[tuple[torch.Tensor, ...]] = []
        self.looks = self._look(batch.inputs, None)
        self.first = network.maps(self.looks)

    def _look(self, inputs: HypothesisInputs, first: FirstLook) -> Looks:
        looks = self.network.look(inputs, first, self.mirror)
        error = ego_flow_error(inputs.pose, inputs.owner, self.batch)
        self._answers.append((inputs.owner, looks.score, error))
        self.owner, self.score, self.error = map(
            torch.cat, zip(*self._answers, strict=True)
        )
        return looks

    def second(
        self, refits: int, lots: torch.Tensor
    ) -> tuple[HypothesisMaps, HypothesisInputs] | None:
        """Fit the best motions inside their masks and look at these too.

        None without a fit.
        """
        with torch.no_grad():
            score = self.looks.score
            more = refits_of(self.batch, score, self.first, refits, lots)
        if more is None:
            return None
        last = self._look(more, (self.batch.inputs, self.looks))
        return self.network.maps(last), more

    def choice_loss(self) -> torch.Tensor:
        """Cross entropy of the choice among the motions and "none of them", summed.

        The targets are soft: motions that are nearly as good as the best have a part of
        it.
        """
        losses = []
        for b, limit in enumerate(self.batch.limit):
            mine = self.error[self.owner == b]
            best = mine.min()
            right = torch.sigmoid((1 - best / limit) / RIGHT_SLOPE)
            target = right * torch.softmax((best - mine) / (NEARLY * limit), 0)
            target = torch.cat([target, (1 - right)[None]])
            score = F.pad(self.score[self.owner == b], (0, 1))
            losses.append(-(target * torch.log_softmax(score, 0)).sum())
        return torch.stack(losses).sum()

    def mask_loss(
        self, maps: HypothesisMaps, inputs: HypothesisInputs
    ) -> torch.Tensor:
        """Binary cross entropy of the static masks over usable pixels with a label.

        The sum over the motions of the mean over their pixels.
        """
        label = self.batch.label[inputs.owner]
        has_label = (label == STATIC) | (label == MOVING)
        known = inputs.usable[inputs.owner] & has_label
        static = (label == STATIC).float()
        loss = F.binary_cross_entropy_with_logits(
            maps.static, static, reduction="none"
        )
        return _sum_of_means(loss, known)

    def pose_loss(
        self, maps: HypothesisMaps, inputs: HypothesisInputs
    ) -> torch.Tensor:
        """L^R and L^T (paper, section 3.2.2): every pixel must predict the camera's motion.

        A Laplace likelihood of each component, in units of what the hypothesis leaves
        unexplained, so that a desk and a street count alike. The sum over the motions of the
        mean over their pixels.
        """
        own = inputs.owner
        truth = euler_motion(self.batch.T)[own][:, :, None, None]
        unit = maps.unit[:, :, None, None]
        error = ((maps.motion - truth) / unit).abs().clamp(max=MAX_POSE_ERROR)
        s = maps.log_scale - unit.log()
        loss = (error * torch.exp(-s) + s).mean(1)
        return _sum_of_means(loss, inputs.usable[own])


def _sum_of_means(loss: torch.Tensor, mask: torch.Tensor) -> torch.Tensor:
    """Sum over the hypotheses of the mean of their maps (N, h, w) over a mask."""
    count = mask.sum((1, 2)).clamp(min=1)
    return ((loss * mask).sum((1, 2)) / count).sum()


class Sums(NamedTuple):
    """Sums of the losses of the first and of the second look."""

    choice: torch.Tensor
    mask: torch.Tensor
    pose: torch.Tensor
    second_choice: torch.Tensor
    second_mask: torch.Tensor
    second_pose: torch.Tensor
    motions: tuple[int, int]  # in the first and in the second look


class PWVOTask:
    """PWVO, its folder of shards (more may be added during training) and its losses."""

    def __init__(self, options: PWVOTrainingOptions, folder: Path) -> None:
        self.options = options
        self.folder = Path(folder)
        self.data = str(folder)
        torch.manual_seed(options.seed)
        self.network = PWVO(options.network)
        if options.layers == "score":
            self.network.requires_grad_(False)
            for layer in (
                self.network.summary,
                self.network.inner,
                self.network.score,
            ):
                layer.requires_grad_(True)

    def batches(self, samples: int, workers: int) -> Iterator[HypothesisBatch]:
        """Yield batches of the samples of shards, which are chosen and shuffled in each round.

        Args:
            samples: number of samples that the run has used already: a run that goes on
                draws others.
            workers: not used; the shards are read in this process.
        """
        round_number = 0
        while True:
            files = sorted(self.folder.glob("*.npz"))
            if not files:
                raise InputError(
                    f"{self.folder}: no shards of samples; write some with "
                    f"hybridvo train samples."
                )
            rng = np.random.default_rng([self.options.seed, samples, round_number])
            picked = rng.permutation(len(files))[: self.options.files]
            chosen = [files[k] for k in picked]
            yield from read_batches(chosen, self.options.batch_size, rng)
            round_number += 1

    def count(self, batch: HypothesisBatch) -> int:
        """Samples of a batch, which every rank reads as a whole."""
        return len(batch)

    def loss(
        self, batch: HypothesisBatch, step: int
    ) -> tuple[torch.Tensor, dict[str, torch.Tensor]]:
        """Losses of the choice, of the masks and of the poses, in both looks.

        Of several ranks, each looks at its part of the batch. All of them draw the same
        numbers for the whole batch.
        """
        options = self.options
        size = len(batch)
        draw = torch.Generator().manual_seed((options.seed << 32) + step)
        has_no_motion = torch.rand(size, generator=draw) < options.no_motion_share
        batch = batch.with_motion_prior(np.random.default_rng([options.seed, step]))
        batch = batch.with_no_motion(has_no_motion)
        mirror = torch.rand(size, generator=draw) < 0.5
        # one fit less in half of the updates: this is cheaper
        fewer = options.refits > 1 and bool(torch.rand((), generator=draw) < 0.5)
        lots = torch.rand(size, 2, generator=draw)

        numbers = ranks.part(range(size))
        if len(numbers) < size:
            batch = batch.part(numbers)
            mirror = mirror[list(numbers)]
            lots = lots[list(numbers)]
        sums = self._sums(batch, mirror, options.refits - fewer, lots)
        counts = ranks.mean(
            torch.tensor([size / ranks.count(), *sums.motions], dtype=torch.float64)
        )
        samples, first, second = counts.tolist()
        losses = {
            "choice": sums.choice / samples,
            "mask": options.mask_weight * sums.mask / first,
            "pose": options.pose_weight * sums.pose / first,
        }
        if second:
            losses["second"] = sums.second_choice / samples
            losses["second_mask"] = (
                0.5 * options.mask_weight * sums.second_mask / second
            )
            losses["second_pose"] = (
                0.5 * options.pose_weight * sums.second_pose / second
            )
        total = torch.stack(list(losses.values())).sum()
        return total, {name: value.detach() for name, value in losses.items()}

    def _sums(
        self,
        batch: HypothesisBatch,
        mirror: torch.Tensor,
        refits: int,
        lots: torch.Tensor,
    ) -> Sums:
        """Sums of the losses over the samples and motions of a batch."""
        nothing = torch.zeros(())
        if not len(batch):
            zero = (nothing, nothing, nothing)
            return Sums(*zero, *zero, (0, 0))
        looks = TwoLooks(self.network, batch, mirror)
        choice = looks.choice_loss()
        mask = looks.mask_loss(looks.first, batch.inputs)
        pose = looks.pose_loss(looks.first, batch.inputs)
        count = len(batch.inputs.owner)
        second = looks.second(refits, lots)
        if second is None:
            # other ranks may have some
            no_second = (choice, nothing, nothing)
            return Sums(choice, mask, pose, *no_second, (count, 0))
        _, more = second
        return Sums(
            choice,
            mask,
            pose,
            looks.choice_loss(),
            looks.mask_loss(*second),
            looks.pose_loss(*second),
            (count, len(more.owner)),
        )
