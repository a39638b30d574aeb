"""A network used: pairs in, its prediction out, and what the methods take from it.

Inputs are divided by the pair's own scales, outputs multiplied by them: one network for a desk and
a street. What a first motion leaves unexplained looks, over its own scale, like any other pair: the
network refines its own answer in several passes.
"""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import numpy as np
import torch
from torch import nn

from hybridvo.network.inputs import (
    MIN_DEPTH,
    NetworkInputs,
    assemble_inputs,
    pinhole,
    quantiles,
)
from hybridvo.network.layers import NetworkOptions, single_threaded_inference
from hybridvo.network.selection import (
    fitted_motion,
    pixel_weights,
    select_pose,
    starting_motions,
)
from hybridvo.refinement.pixels import too_few
from hybridvo.refinement.torch_backend import uncompiled
from hybridvo.results import (
    MotionPrediction,
    PixelwisePrediction,
    Reason,
    RelativePose,
    Status,
)
from hybridvo.torch_geometry import euler_motion, euler_transform
from hybridvo.types import FramePair

FLOW_SCALE_PX = 200.0
OUTPUT_SCALE = 0.01
"""Without scales of the pair, flow is divided by the first, and raw outputs times the second are
degrees and metres, as published."""
# rad; smaller flow is not amplified: 0.1 px at 2000 px of focal length
MIN_MOTION = 5e-5
MIN_NEARNESS = 1 / 50  # 1 / metres; where all is farther, flow tells no translation
# motions so far apart, px of the inputs, are two; most that counts
OTHER_PX = 0.75
MAX_LEAD = 5.0
# part of the image by whose doubt motions compete; how many stay
SUREST = 0.25
KEPT = 2
# magnitude that squashed values approach; values of the order of one stay as they are
LIMIT = 10.0
STATIC_AT = 1.64
STATIC_SLOPE = 1.63
"""Where the probability to be static is one half, in units of s above the trusted pixels', and the
slope of its logit: logistic regression over development pairs, both kinds of pixels weighing alike.
Over 300 pairs (wide, crowd, rendered) stated and observed ratios differ by at most 0.09."""
# pixels of the network's input with flow and depth below which it is not asked
MIN_PIXELS = 64


class MotionScale(NamedTuple):
    """Scales (B, 6) of rx, ry, rz (degrees), tx, ty, tz (metres), and the motion taken out."""

    factor: torch.Tensor
    start: torch.Tensor

    def motion(self, raw: torch.Tensor) -> torch.Tensor:
        """Motions of a network's raw outputs (B, 6, h, w): the sum of two small ones."""
        factor, start = (x.to(raw.dtype)[:, :, None, None] for x in self)
        return start + factor * raw


@uncompiled
def predict(
    network: nn.Module, inputs: NetworkInputs, selection: str = "softmax"
) -> PixelwisePrediction:
    """Output of the last of the network's passes; ``selection``: of the start of the next one."""
    passes: int = network.options.passes  # type: ignore[union-attr, assignment]
    T, lead = first_motions(network, inputs, selection, passes - 1)
    return replace(network(inputs, T), lead=lead)


@torch.no_grad()
def first_motions(
    network: nn.Module, inputs: NetworkInputs, selection: str, passes: int
) -> tuple[torch.Tensor | None, torch.Tensor | None]:
    """(B, 4, 4) motions after a number of passes, without gradient, None for no pass at all; and
    (B,) by how much log scales rise under other motions, None for fewer than two.

    The second pass looks at several motions, and the later ones at those that are surest of the
    part of the image that they trust: where much moves, the first answer may be a mover's.
    """
    if passes == 0:
        return None, None
    maps = network(inputs)
    if passes == 1:
        return fitted_motion(maps, inputs, selection), None
    T = starting_motions(maps, inputs, selection)
    found = []
    doubts = []
    for left in range(passes - 2, -1, -1):
        many = inputs.repeated(T.shape[1])
        maps = network(many, T.flatten(0, 1))
        T = fitted_motion(maps, many, selection).unflatten(0, (len(inputs), -1))
        s = maps.log_scale[:, :3].mean(dim=1)
        valid = many.on_grid_of(maps.log_scale).valid
        doubts.append(quantiles(s, valid, (SUREST,))[0].view(T.shape[:2]))
        found.append(T)
        doubt, surest = doubts[-1].topk(KEPT if left else 1, largest=False)
        T = torch.take_along_dim(T, surest[:, :, None, None], dim=1)
    every = torch.cat(found, dim=1)
    other = _distance(inputs, every, T) > OTHER_PX
    rivals = torch.where(other, torch.cat(doubts, dim=1), torch.inf).amin(dim=1)
    return T[:, 0], (rivals - doubt[:, 0]).clamp(max=MAX_LEAD)


def _distance(
    inputs: NetworkInputs, T: torch.Tensor, of: torch.Tensor
) -> torch.Tensor:
    """(B, S) mean distance, px of the inputs, between the ego flows of motions and of one."""
    both = torch.cat([of, T], dim=1)
    many = inputs.subsample(4).repeated(both.shape[1])
    flow = _ego_motion(many, many.inverse_depth[:, 0], both.flatten(0, 1))[0]
    apart = (4 * flow * many.valid[:, None]).unflatten(0, both.shape[:2])
    length = (apart[:, 1:] - apart[:, :1]).norm(dim=2).sum(dim=(2, 3))
    return length / many.valid.unflatten(0, both.shape[:2])[:, 1:].sum(
        dim=(2, 3)
    ).clamp(min=1)


def normalize(
    inputs: NetworkInputs,
    options: NetworkOptions,
    T_start: torch.Tensor | None = None,
) -> tuple[NetworkInputs, MotionScale]:
    """What a network with these options looks at, and the scale of its outputs.

    Without units: a first motion (B, 4, 4) is taken out, and what is left divided by each pair's
    scales. ``flow``: the unexplained, over the focal length and its own typical length m;
    ``inverse_depth[:, 0]``: over that of the near things; ``inverse_depth[:, 1]``: the unexplained
    log depth over m; all squashed. The scales are m as an angle, and m times the near depth.
    """
    inputs = inputs.subsample(options.input_stride)
    if not options.scale_free:
        factor = torch.full(
            (len(inputs), 6), OUTPUT_SCALE, device=inputs.flow.device
        )
        inputs = replace(inputs, flow=inputs.flow / FLOW_SCALE_PX)
        return inputs, MotionScale(factor, torch.zeros_like(factor))
    inverse = torch.nan_to_num(inputs.inverse_depth, 0.0, 0.0, 0.0)
    flow = torch.nan_to_num(inputs.flow, 0.0, 0.0, 0.0)
    both = (inverse > 0).all(dim=1, keepdim=True)
    change = -torch.where(both, inverse, 1.0).log().diff(dim=1)
    start = flow.new_zeros(len(inputs), 6)
    if T_start is not None:
        T_start = T_start.to(flow.dtype)
        start = euler_motion(T_start)
        ego, log_ratio = _ego_motion(inputs, inverse[:, 0], T_start)
        # No flow was measured where it is exactly zero in both components and the pixel is invalid.
        seen = inputs.valid[:, None] | (flow != 0).any(dim=1, keepdim=True)
        flow = torch.where(seen, flow - ego, flow)
        change = change - log_ratio
    angle = flow / pinhole(inputs.K_prev)[0]
    length = (angle.square().sum(dim=1) + 1e-20).sqrt()
    # below one half: movers on half of the image do not set the scale of what is left of the scene
    first, later = quantiles(length, inputs.valid, (0.4, options.later_quantile))
    motion = torch.where((start != 0).any(dim=1), later, first).clamp(
        MIN_MOTION, 1.0
    )
    # near things tell the translation, and set its scale
    (nearness,) = quantiles(
        inverse[:, 0], inputs.valid & (inverse[:, 0] > 0), (0.9,)
    )
    nearness = nearness.clamp(MIN_NEARNESS, 1e3)
    m, near = (x[:, None, None, None] for x in (motion, nearness))
    depth = torch.cat(
        [inverse[:, :1] / near, torch.where(both, change / m, 0.0)], dim=1
    )
    factor = torch.stack([torch.rad2deg(motion), motion / nearness], dim=1)
    scale = MotionScale(factor.repeat_interleave(3, dim=1), start)
    flow, depth = (x / (1 + x.abs() / LIMIT) for x in (angle / m, depth))
    return replace(inputs, flow=flow, inverse_depth=depth), scale


def _ego_motion(
    inputs: NetworkInputs, inverse: torch.Tensor, T: torch.Tensor
) -> tuple[torch.Tensor, torch.Tensor]:
    """((B, 2, h, w) px, (B, 1, h, w)) flow and change of log depth; zero behind the camera."""
    # Over its depth, a point is ray + translation * inverse depth: finite for the farthest.
    rays = inputs.rays.flatten(2)
    near = inverse.flatten(1)[:, None]
    moved = T[:, :3, :2] @ rays + T[:, :3, 2:3] + T[:, :3, 3:] * near
    moved = moved.unflatten(2, inverse.shape[1:])
    front = moved[:, 2:] > MIN_DEPTH * inverse[:, None].clamp(min=1e-3)
    z = torch.where(front, moved[:, 2:], 1.0)
    focal, centre = pinhole(inputs.K_curr)
    flow = focal * moved[:, :2] / z + centre - inputs.pixels
    return torch.where(front, flow, 0.0), torch.where(front, z.log(), 0.0)


def static_probability(
    log_scale: torch.Tensor, valid: torch.Tensor
) -> torch.Tensor:
    """(B, h, w) logistic in how far log scales (B, 6, h, w) lie above the trusted pixels'."""
    s = log_scale[:, :3].mean(dim=1)
    trusted = (
        (pixel_weights(log_scale, valid) * s).flatten(1).sum(dim=1)[:, None, None]
    )
    return ((STATIC_AT - (s - trusted)) * STATIC_SLOPE).sigmoid() * valid


def propose_motion(network: nn.Module, pair: FramePair) -> MotionPrediction | None:
    """The motion that a PWVO's trusted pixels agree on, and its static world; None without."""
    with single_threaded_inference():
        inputs = assemble_inputs(pair).to(next(network.parameters()).device)
        if int(inputs.valid.sum()) < MIN_PIXELS:
            return None
        maps = predict(network, inputs)
        if maps.log_scale is None:
            return None
        T = fitted_motion(maps, inputs)[0].double().cpu().numpy()
        valid = inputs.on_grid_of(maps.log_scale).valid
        return MotionPrediction(
            T, static_probability(maps.log_scale, valid)[0].cpu().numpy()
        )


def estimate_by_network(
    pair: FramePair, how: str, network: nn.Module
) -> RelativePose:
    """Camera motion of one pair by a network and a selection of the paper; covariance 2 U^2."""
    if pair.flow is None:
        return RelativePose.failed(Reason.NO_FLOW, "no optical flow for this pair")
    if pair.prev.depth is None:
        return RelativePose.failed(Reason.NO_VALID_DEPTH, "no depth for this frame")
    with single_threaded_inference():
        inputs = assemble_inputs(pair).to(next(network.parameters()).device)
        if (seen := int(inputs.valid.sum())) < MIN_PIXELS:
            return RelativePose.failed(
                *too_few(pair.prev.depth, pair.flow, seen, MIN_PIXELS)
            )
        maps = predict(network, inputs, how)
        T = euler_transform(select_pose(maps, how).double())[0].cpu().numpy()
        # the largest usual motions, where none are stated: nobody trusts a network that states none
        U = np.repeat([1.0, 0.3], 3)
        if maps.log_scale is not None:
            # the scales go the way of the values: same pixels, same weights
            stated = select_pose(replace(maps, motion=maps.log_scale.exp()), how)
            # half-precision knows no better
            U = np.maximum(stated[0].double().cpu().numpy(), 1e-4)
    status = Status()
    if U[:3].max() > 2.0:  # degrees: larger than most motions between frames
        doubt = f"the network is uncertain by {U[:3].max():.1f} degrees"
        status = Status.degraded(Reason.LOW_INLIERS, doubt)
    variance = 2 * np.concatenate([U[3:], np.deg2rad(U[:3])]) ** 2
    return RelativePose(T, np.diag(variance), status, terms=("flow", "depth"))
