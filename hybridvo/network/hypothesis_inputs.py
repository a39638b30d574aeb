"""What PWVO reads of a pair and of each motion hypothesis: what the motion leaves unexplained.

For each hypothesis these are the residuals of the flow and of the current depth, how well the
two images and the two depth maps agree under it, and what the other hypotheses explain.
Flow, depth and rays of a pair are the same for all its hypotheses.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np
import torch

from hybridvo.core.results import MotionPrior
from hybridvo.hypotheses.search import REFERENCE_WIDTH
from hybridvo.network.grid_maps import GridMaps
from hybridvo.network.hypothesis_kernels import (
    MIN_DEPTH_STD,
    MIN_FLOW_NOISE,
    HypothesisReadings,
)
from hybridvo.network.hypothesis_readings import read_hypotheses

SAME_DEPTH = 0.05
"""Largest difference in log depth of two readings of one surface."""
USUAL_CHANGE = 0.01
"""Usual difference of a motion from the one before, as an angle in the image, rad."""
RESIDUAL_QUANTILE = 0.4
"""Quantile of the lengths of a hypothesis' residuals that is their unit."""
RESIDUAL_LIMITS = (2e-5, 0.2)
"""Smallest and largest unit, as an angle, rad."""
USUAL_DEPTH_NOISE = 0.01
"""Standard deviation of log depth of a hypothesis that was not fitted."""


@dataclass(frozen=True, eq=False)
class HypothesisInputs(GridMaps):
    """B pairs on their coarse grids (h, w), and N motion hypotheses of them.

    The maps of :class:`GridMaps` have a first axis of length B.

    Attributes:
        T_prior: (B, 3, 4) expected motion.
        prior_information: (B, 6, 6) inverse covariance of delta in ``Exp(delta) T_prior``.
        has_prior: (B,) bool, whether a motion is expected.
        owner: (N,) int64, the pair of each hypothesis.
        parent: (N,) int64, the motion of the search that a refit started from; a motion of
            the search is its own parent.
        pose: (N, 3, 4) ``T_curr_prev``, metres.
        flow_noise: (N,) standard deviation of the flow, px.
        depth_noise: (N,) standard deviation of log depth.
    """

    T_prior: torch.Tensor
    prior_information: torch.Tensor
    has_prior: torch.Tensor
    owner: torch.Tensor
    parent: torch.Tensor
    pose: torch.Tensor
    flow_noise: torch.Tensor
    depth_noise: torch.Tensor

    @property
    def flow(self) -> torch.Tensor:
        """(B, 2, h, w) px from where a pixel would be without motion."""
        return self.target - _own_pixels(self)

    def with_flow(self, flow: torch.Tensor) -> HypothesisInputs:
        """Return the same with another flow (B, 2, h, w), px."""
        return replace(self, target=_own_pixels(self) + flow)

    def with_hypotheses(
        self, poses: Any, noise: Any, parents: Any, owner: Any = None
    ) -> HypothesisInputs:
        """Return the same pairs with other hypotheses.

        Args:
            poses: (N, 3, 4) ``T_curr_prev``, metres.
            noise: (N, 2) standard deviations of the flow, px, and of log depth.
            parents: (N,) see the attributes.
            owner: (N,) see the attributes; None: all hypotheses are of the first pair.
        """

        def tensor(x: Any, dtype: torch.dtype = torch.float32) -> torch.Tensor:
            return torch.as_tensor(x, dtype=dtype, device=self.depth.device)

        if owner is None:
            owner = [0] * len(poses)
        flow_noise, depth_noise = np.transpose(noise)
        return replace(
            self,
            owner=tensor(owner, torch.int64),
            parent=tensor(parents, torch.int64),
            pose=tensor(poses),
            flow_noise=tensor(flow_noise),
            depth_noise=tensor(depth_noise),
        )


def hypothesis_inputs(
    maps: GridMaps,
    prior: MotionPrior | None,
    device: torch.device,
) -> HypothesisInputs:
    """Make a batch of one pair, without hypotheses.

    Args:
        maps: the pair on its grid.
        prior: the expected motion, or None.
        device: of the tensors.
    """
    batch = GridMaps(
        **{name: np.asarray(value)[None] for name, value in vars(maps).items()}
    )
    inputs = stacked_inputs(batch, device)
    is_given = torch.ones(1, dtype=torch.bool, device=device)
    if prior is not None:
        T, information = (
            torch.as_tensor(x, dtype=torch.float32, device=device)[None]
            for x in (prior.T_curr_prev[:3], np.linalg.inv(prior.covariance))
        )
        inputs = replace(
            inputs, T_prior=T, prior_information=information, has_prior=is_given
        )
    return inputs


def stacked_inputs(maps: GridMaps, device: torch.device) -> HypothesisInputs:
    """Make inputs of pairs whose maps have a first axis, without prior knowledge."""
    values: dict[str, torch.Tensor] = {}
    for name, x in vars(maps).items():
        dtype = torch.bool if name in ("usable", "has_depth") else torch.float32
        values[name] = torch.as_tensor(np.ascontiguousarray(x)).to(device, dtype)
    depth = values["depth"]
    usable = values["usable"]
    none = torch.zeros(0, dtype=torch.float32, device=device)
    nothing = torch.zeros(len(depth), dtype=torch.bool, device=device)
    # the default information of a prior: a motion usually differs from the one before by an
    # angle, and by the same angle times the typical depth
    inverse = torch.where(usable, 1.0 / depth.clamp(min=1e-6), 0.0).sum((1, 2))
    inverse = (inverse / usable.sum((1, 2)).clamp(min=1)).clamp(min=1e-6)
    usual = (
        torch.stack([inverse] * 3 + [torch.ones_like(inverse)] * 3, dim=1)
        / USUAL_CHANGE
    )
    return HypothesisInputs(
        **values,
        T_prior=torch.eye(3, 4, dtype=torch.float32, device=device).repeat(
            len(depth), 1, 1
        ),
        prior_information=torch.diag_embed(usual * usual),
        has_prior=nothing,
        **dict.fromkeys(
            ("owner", "parent", "pose", "flow_noise", "depth_noise"), none
        ),
    )


def quantiles(
    x: torch.Tensor, mask: torch.Tensor, q: tuple[float, ...]
) -> torch.Tensor:
    """Quantiles (len(q), B) of maps (B, h, w) over a mask; 1 where that is empty.

    Every second pixel of both axes is enough for a scale.
    """
    kept = torch.where(mask, x, torch.nan)[..., ::2, ::2].flatten(1)
    found = torch.nanquantile(kept, kept.new_tensor(q), dim=1)
    return found.nan_to_num(1.0, 1.0, 1.0)


def with_no_motion(
    inputs: HypothesisInputs, wanted: torch.Tensor
) -> HypothesisInputs:
    """Add the hypothesis "no motion", which the paper's network sees, of some pairs.

    Args:
        inputs: pairs and hypotheses.
        wanted: (B,) bool, of which pairs.
    """
    owner = torch.nonzero(wanted)[:, 0]
    count = len(owner)
    first = len(inputs.owner)
    still = torch.eye(3, 4).to(inputs.pose).repeat(count, 1, 1)
    numbers = first + torch.arange(count, device=owner.device)
    length = inputs.flow.norm(dim=1)
    (typical,) = quantiles(length, inputs.usable, (RESIDUAL_QUANTILE,))
    depth_noise = inputs.depth_noise.new_full((count,), USUAL_DEPTH_NOISE)
    return replace(
        inputs,
        owner=torch.cat([inputs.owner, owner]),
        parent=torch.cat([inputs.parent, numbers]),
        pose=torch.cat([inputs.pose, still]),
        flow_noise=torch.cat([inputs.flow_noise, typical[owner]]),
        depth_noise=torch.cat([inputs.depth_noise, depth_noise]),
    )


def _own_pixels(inputs: HypothesisInputs) -> torch.Tensor:
    """(B, 2, h, w) where the rays meet the current image if nothing moves, px."""
    K = inputs.K[:, :, None, None]
    return K[:, :2] * inputs.ray + K[:, 2:]


def _squash(x: torch.Tensor) -> torch.Tensor:
    """sign(x) log(1 + |x|)."""
    return torch.copysign(torch.log1p(x.abs()), x)


class HypothesisChannels(NamedTuple):
    """What the network reads about N hypotheses.

    Attributes:
        maps: (N, 14, h, w).
        scalars: (N, 12).
        evidence: (N, 2, h, w) robust weight of the flow, and correlation of the images
            times their texture.
        unit: (N, 6) what a hypothesis leaves unexplained, as a motion: degrees, metres.
    """

    maps: torch.Tensor
    scalars: torch.Tensor
    evidence: torch.Tensor
    unit: torch.Tensor


def hypothesis_channels(
    inputs: HypothesisInputs, first: tuple[HypothesisInputs, torch.Tensor] | None
) -> HypothesisChannels:
    """Compute what the network reads about every hypothesis.

    Args:
        inputs: pairs and hypotheses.
        first: inputs and evidence of the motions of the search, if the hypotheses are
            refits; else None.

    Returns:
        Channels (N, 14, h, w), scalars (N, 12), and evidence (N, 2, h, w): the robust weight
        of the flow, and the correlation of the images times their texture.
    """
    read = read_hypotheses(inputs)
    own = inputs.owner
    usable = inputs.usable[own]
    support = read.support
    texture = read.texture
    agreement = read.agreement
    depth_ratio = read.depth_ratio
    is_compared = read.is_compared
    wide = REFERENCE_WIDTH / inputs.width[own]
    evidence = torch.stack([support, agreement], 1)
    rivals = _rivals(inputs, *((inputs, evidence) if first is None else first))
    sd = inputs.depth_noise[:, None, None]
    depth_variance = sd * sd * inputs.depth_variance[own]
    noise = torch.sqrt(2.0 * depth_variance + MIN_DEPTH_STD**2)
    size = torch.where(read.known, read.length * wide[:, None, None], 0.0)
    rz = read.depth_residual
    by_flow = [
        0.5 * _squash(read.eu),
        0.5 * _squash(read.ev),
        0.3 * torch.log1p(size),
        0.5 * _squash(rz / noise),
        read.has_depth,
        0.3 * _squash(50.0 * rz),
    ]
    by_flow += [support, rivals[:, 0]]
    by_images = [texture, agreement, rivals[:, 1]]
    by_images += [
        0.5 * _squash(depth_ratio / noise),
        is_compared,
        0.3 * _squash(50.0 * depth_ratio),
    ]
    channels = torch.stack([*(x * usable for x in by_flow), *by_images], 1)
    # areas of the image, also where there is no flow
    best = rivals[:, 1] * (texture > 0)
    areas = [agreement.clamp(min=0), texture - agreement, agreement - best]
    areas += [
        (depth_ratio.abs() < SAME_DEPTH) * is_compared,
        (depth_ratio > SAME_DEPTH) * is_compared,
    ]
    scalars = _scalars(inputs, support, wide, first is not None)
    fractions = 2.0 * torch.stack(areas, 1).mean((2, 3))
    return HypothesisChannels(
        maps=channels,
        scalars=torch.cat([scalars, fractions], 1),
        evidence=evidence,
        unit=_motion_unit(inputs, read),
    )


def _motion_unit(
    inputs: HypothesisInputs, read: HypothesisReadings
) -> torch.Tensor:
    """(N, 6) the usual residual as a motion: as an angle, degrees, and at the usual depth."""
    (length,) = quantiles(read.length, read.known, (RESIDUAL_QUANTILE,))
    focal = inputs.K[inputs.owner, 0]
    angle = (length / focal).clamp(*RESIDUAL_LIMITS)
    (depth,) = quantiles(inputs.depth, inputs.usable, (0.5,))
    shift = angle * depth[inputs.owner]
    unit = torch.stack([torch.rad2deg(angle), shift], dim=1)
    return unit.repeat_interleave(3, dim=1)


def _rivals(
    inputs: HypothesisInputs, searched: HypothesisInputs, evidence: torch.Tensor
) -> torch.Tensor:
    """(N, 2, h, w) largest evidence among the other motions of the search of the same pair."""
    index = torch.arange(len(evidence), device=evidence.device)
    rivals = searched.owner == inputs.owner[:, None]
    rivals &= index != inputs.parent[:, None]
    none = torch.zeros_like(evidence[0])
    return torch.stack(
        [evidence[some].amax(0) if some.any() else none for some in rivals]
    )


def _scalars(
    inputs: HypothesisInputs,
    support: torch.Tensor,
    wide: torch.Tensor,
    refits: bool,
) -> torch.Tensor:
    """(N, 7) inlier ratio, noise, whether it is a refit, agreement with the prior."""
    own = inputs.owner
    count = inputs.usable[own].sum((1, 2)).clamp(min=1)
    inlier_ratio = support.sum((1, 2)) / count
    known = inputs.has_prior[own].to(inlier_ratio.dtype)
    step = _small_step(inputs.pose, inputs.T_prior[own])
    # bounded near the prior and logarithmic far from it, so that a wrong prior cannot decide
    away = (
        torch.einsum(
            "ni,nij,nj->n", step, inputs.prior_information[own], step
        ).clamp(0, 1e6)
        / 6
    )
    scalars = [
        inlier_ratio,
        0.3 * torch.log(inputs.flow_noise.clamp(min=MIN_FLOW_NOISE) * wide),
        0.2 * torch.log(inputs.depth_noise.clamp(min=1e-4) / 1e-2),
        torch.full_like(inlier_ratio, float(refits)),
        known / (1.0 + away),
        known,
        0.2 * known * torch.log1p(away),
    ]
    return torch.stack(scalars, dim=1)


def _small_step(pose: torch.Tensor, start: torch.Tensor) -> torch.Tensor:
    """(N, 6) delta with pose = Exp(delta) start, translation first, to first order in it."""
    R = pose[:, :, :3] @ start[:, :, :3].transpose(1, 2)
    shift = pose[:, :, 3:] - R @ start[:, :, 3:]
    S = (R - R.transpose(1, 2)) / 2
    return torch.cat(
        [shift[:, :, 0], torch.stack([S[:, 2, 1], S[:, 0, 2], S[:, 1, 0]], 1)], 1
    )


def shared_channels(inputs: HypothesisInputs) -> torch.Tensor:
    """(B, 9, h, w) flow, inverse depth, validity, rays, border, variance, size of the flow."""
    usable = inputs.usable
    # on the unit plane of the current camera, so that a change of the lens is no flow
    K = inputs.K[:, :, None, None]
    u, v = ((inputs.target - K[:, 2:]) / K[:, :2] - inputs.ray).unbind(1)
    size = torch.sqrt(u * u + v * v)
    typical = quantiles(size, usable, (0.5,))[0, :, None, None].clamp(min=1e-5)
    inverse = torch.where(usable, 1.0 / inputs.depth.clamp(min=1e-6), 0.0)
    near = inverse / quantiles(inverse, usable, (0.5,))[0, :, None, None].clamp(
        min=1e-9
    )
    h, w = usable.shape[1:]
    rows, columns = (
        torch.arange(n, device=u.device, dtype=u.dtype) for n in (h, w)
    )
    to_border = torch.minimum(
        torch.minimum(rows, h - 1 - rows)[:, None],
        torch.minimum(columns, w - 1 - columns),
    )
    border = torch.exp(-to_border / (0.06 * min(h, w))).expand(usable.shape)
    by_flow = [
        _squash(u / typical),
        _squash(v / typical),
        torch.log1p(near),
        usable.to(u.dtype),
        0.3 * torch.log(inputs.flow_variance.clamp(1e-3, 1e3)),
        0.2 * torch.log(size.clamp(min=1e-6) / 1e-2),
    ]
    by_flow = [torch.where(usable, x, 0.0) for x in by_flow]
    rays = inputs.ray.unbind(1)
    return torch.stack([*by_flow[:4], *rays, border, *by_flow[4:]], dim=1)
