"""The motions that may be the camera's, each refined, and what each leaves unexplained.

The choice among the M motions of a pair is learned from ::

    log P(motion) = log softmax(score - cost_weight * cost)

with a cost that is comparable among them: over the N usable pixels of the pair, w the weight that
a pixel has if the motion is the camera's, d its distance from the motion in standard deviations,

    cost = 1 - (1 / N) sum w c^2 / (c^2 + d^2).

A pixel without weight costs as much as an outlier, so that no motion wins by leaving pixels out.
The sum is that of the robust kernel of Geman and McClure, which the refinement minimises.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import torch

from hybridvo.core.calibration import MIN_PROBABILITY
from hybridvo.core.checks import brief, check_kind
from hybridvo.core.errors import InputError
from hybridvo.core.options import RefineOptions
from hybridvo.core.torch_geometry import pp, to_matrix
from hybridvo.core.types import PairBatch
from hybridvo.solver.torch import factors
from hybridvo.solver.torch.backend import given_noise, refine_batch
from hybridvo.solver.torch.batched_pose import BatchedPose
from hybridvo.solver.torch.factors import Pixels, ResidualModel
from hybridvo.solver.torch.tools import as_tensor, checked_batch, uncompiled

WHERE = "refine_rivals"
# (B, M, 4, 4)
MOTIONS_DIMENSIONS = 4
# What a refinement does not look at.
IMAGES = ("rgb_prev", "rgb_curr", "has_images")
# Logit of a motion that is not there: finite, for 0 times it is 0.
NO_LOGIT = -1e9


@dataclass(frozen=True, eq=False)
class RefinedRivals:
    """The refined motions of B pairs with M rivals each.

    Attributes:
        motions: of all B M rivals, pair after pair, as :func:`hybridvo.refine` gives them.
        cost: (B, M) fraction of the usable pixels that a motion leaves unexplained, 0 to 1; 1
            where it failed. It carries the gradient, that of the refined motion included.
        exists: (B, M) bool, False where no motion was handed in.
        noise: (B, 2) of the pairs: standard deviations of flow, px, and of log depth, by which
            all rivals of a pair are measured.
    """

    motions: BatchedPose
    cost: torch.Tensor
    exists: torch.Tensor
    noise: torch.Tensor

    @property
    def T_curr_prev(self) -> torch.Tensor:
        """Refined motions (B, M, 4, 4), metres, with their gradient."""
        return self.motions.T_curr_prev.unflatten(0, tuple(self.cost.shape))

    @property
    def failed(self) -> torch.Tensor:
        """(B, M) whether the refinement of a motion failed, or there is none."""
        return self.motions.failed.view_as(self.cost) | ~self.exists

    def log_probability(
        self, score: torch.Tensor, cost_weight: torch.Tensor | float = 1.0
    ) -> torch.Tensor:
        """Return the log of how probable each motion is the camera's.

        Args:
            score: (B, M) of the motions, nats, by a network or any other evidence.
            cost_weight: nats by which a motion that explains all pixels is more probable than
                one that explains none.

        Returns:
            (B, M) log softmax of ``score - cost_weight * cost``; about -1e9 where there is no
            motion.
        """
        score = as_tensor(
            score, "score", self.cost.device, f"{WHERE}.log_probability"
        )
        if score.shape != self.cost.shape:
            raise InputError(
                f"{WHERE}.log_probability: expected a score of shape "
                f"{tuple(self.cost.shape)}, got {tuple(score.shape)}."
            )
        logits = score - cost_weight * self.cost
        return logits.masked_fill(~self.exists, NO_LOGIT).log_softmax(dim=1)


@uncompiled
def refine_rivals(
    batch: PairBatch,
    T_init: Any,
    weights: Any = None,
    *,
    noise: Any = None,
    kernel: str = "geman-mcclure",
    options: RefineOptions | None = None,
    min_probability: float = MIN_PROBABILITY,
) -> RefinedRivals:
    """Refine all motions of each pair, and state what each leaves unexplained.

    Args:
        batch: B pairs.
        T_init: (B, M, 4, 4) T_curr_prev, metres; one that is not finite is no motion.
        weights: (B, M, H, W) from 0 to 1: probability of each pixel to be static if the motion
            is the camera's; None: 1.
        noise: standard deviations of flow, px, and of log depth, as (2,) or (B, 2); None:
            estimated for each motion, and that of the motion which most pixels follow measures
            all of a pair; held constant for the gradient.
        kernel: of the refinement; the cost is always that of ``geman-mcclure``.
        options: of the refinement.
        min_probability: the probability below which a motion is degraded.

    Returns:
        The motions and their costs.

    Raises:
        InputError: a value has another shape, type or device.
    """
    options = RefineOptions() if options is None else options
    check_kind(f"{WHERE}.batch", batch, PairBatch)
    batch, _ = checked_batch(batch, where=WHERE)
    T = _checked_motions(T_init, batch.flow)
    count = T.shape[1]
    weights = _checked_weights(weights, batch.flow, count)
    exists = torch.isfinite(T).flatten(2).all(dim=2)
    repeated = _repeated(batch, count)
    stated = given_noise(noise, batch.flow)
    motions = refine_batch(
        repeated,
        T.flatten(0, 1),
        weights,
        noise=None if stated is None else stated.repeat_interleave(count, dim=0),
        kernel=kernel,
        options=options,
        min_probability=min_probability,
    )
    pair_noise = _noise_of_most(motions, exists) if stated is None else stated
    cost = _cost_of(
        repeated,
        weights,
        motions,
        pair_noise.repeat_interleave(count, dim=0),
        options.cutoff,
    )
    is_known = ~motions.failed & exists.flatten()
    cost = torch.where(is_known, cost, torch.ones_like(cost))
    return RefinedRivals(motions, cost.view_as(exists), exists, pair_noise)


def _checked_motions(T_init: Any, flow: torch.Tensor) -> torch.Tensor:
    """The motions (B, M, 4, 4), without gradient."""
    T = as_tensor(T_init, "T_init", flow.device, WHERE).detach().double()
    fits = T.ndim == MOTIONS_DIMENSIONS and T.shape[2:] == (4, 4)
    if not fits or len(T) != len(flow) or T.shape[1] == 0:
        raise InputError(
            f"{WHERE}: expected T_init of shape ({len(flow)}, M, 4, 4), got {tuple(T.shape)}. "
            "Pairs with fewer motions have some of NaN."
        )
    return T


def _checked_weights(weights: Any, flow: torch.Tensor, count: int) -> torch.Tensor:
    """The weights (B M, H, W)."""
    shape = (len(flow), count, *flow.shape[1:3])
    if weights is None:
        return flow.new_ones(shape).flatten(0, 1)
    weights = as_tensor(weights, "weights", flow.device, WHERE)
    in_range = weights.shape == shape and not bool((weights.detach() > 1).any())
    if not in_range:
        got = brief(tuple(weights.shape))
        if weights.shape == shape:
            got = f"up to {float(weights.detach().nan_to_num().max()):g}"
        raise InputError(
            f"{WHERE}: expected weights of shape {shape}, probabilities of 0 to 1, got {got}."
        )
    return weights.to(flow).flatten(0, 1)


def _repeated(batch: PairBatch, count: int) -> PairBatch:
    """Each pair ``count`` times in a row, without its images."""
    tensors = {
        name: value.repeat_interleave(count, dim=0)
        for name, value in vars(batch).items()
        if value is not None and name not in IMAGES
    }
    return PairBatch(**tensors)


def _noise_of_most(motions: BatchedPose, exists: torch.Tensor) -> torch.Tensor:
    """The noise (B, 2) of the motion of each pair that most pixels follow."""
    followers = motions.weights.flatten(1).sum(dim=1) * ~motions.failed
    followers = followers.view_as(exists) * exists
    best = followers.argmax(dim=1)
    index = torch.arange(len(best), device=best.device)
    return motions.noise.unflatten(0, tuple(exists.shape))[index, best].detach()


def _cost_of(
    batch: PairBatch,
    weights: torch.Tensor,
    motions: BatchedPose,
    noise: torch.Tensor,
    cutoff: float,
) -> torch.Tensor:
    """The fraction (B M,) of the usable pixels that each motion leaves unexplained."""
    with torch.autocast(batch.flow.device.type, enabled=False):
        pixels = factors.gather_pixels(batch, weights)
        usable = (factors.gather_pixels(batch).weight > 0).sum(dim=1)
        return unexplained(pixels, usable, motions.SE3, noise, cutoff)


def unexplained(
    pixels: Pixels,
    usable: torch.Tensor,
    T: pp.LieTensor,
    noise: torch.Tensor,
    cutoff: float,
) -> torch.Tensor:
    """Return the fraction of its usable pixels that each motion leaves unexplained.

    Args:
        pixels: (B, N) of each motion, with the weights that they have if it is the camera's.
        usable: (B,) number of pixels that could have a weight.
        T: (B, 7) the motions.
        noise: (B, 2) standard deviations of flow, px, and of log depth.
        cutoff: c of the kernel, standard deviations.

    Returns:
        (B,) from 0 to 1, with the gradient of weights and motions.
    """
    model = ResidualModel(noise, cutoff, "geman-mcclure")
    at = factors.weigh(pixels, to_matrix(T), model)
    support = 1 - at.cost / (0.5 * cutoff**2)
    explained = (pixels.weight * support).sum(dim=1) / usable.clamp(min=1)
    return 1 - explained
