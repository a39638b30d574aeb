"""What a network reads of its inputs, and the units of its outputs.

A scale-free network has no units: the inputs of a pair are divided by the pair's own
scales, and the outputs multiplied by them, so that one network serves a desk and a street.
It may be given a first motion. What that motion leaves unexplained looks, over its own
scale, like any other pair, and the network estimates the remaining motion.
"""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import torch

from hybridvo.network.inputs import MIN_DEPTH, NetworkInputs, pinhole, quantiles
from hybridvo.network.layers import NetworkOptions
from hybridvo.torch_geometry import euler_motion

# The networks were trained with the numbers of this file: a change of one of them needs
# new weights.

FLOW_SCALE_PX = 200.0
"""Divides the flow of a network with units, as published."""
OUTPUT_SCALE = 0.01
"""Multiplies its raw outputs: degrees and metres, as published."""
MIN_MOTION = 5e-5
"""Smallest scale of the flow, rad; smaller flow is not amplified: 0.1 px at a focal length
of 2000 px."""
MAX_MOTION = 1.0
"""Largest scale of the flow, rad."""
MIN_NEARNESS = 1 / 50
"""Smallest scale of inverse depth, 1 / m; where all points are farther, flow does not
determine the translation."""
MAX_NEARNESS = 1e3
"""Largest scale of inverse depth, 1 / m."""
FIRST_QUANTILE = 0.4
"""Quantile of the lengths of the flow that is its scale. Below one half, so that moving
objects on half of the image do not decide it."""
NEAR_QUANTILE = 0.9
"""Quantile of inverse depth that is its scale: near points determine the translation."""
LIMIT = 10.0
"""Magnitude that squashed values approach; values of the order of one stay as they are."""


class MotionScale(NamedTuple):
    """Converts raw outputs of a network to motions.

    Attributes:
        factor: (B, 6) scales of rx, ry, rz (degrees), tx, ty, tz (metres).
        start: (B, 6) the motion that was removed from the inputs.
    """

    factor: torch.Tensor
    start: torch.Tensor

    def motion(self, raw: torch.Tensor) -> torch.Tensor:
        """Motions of raw outputs (B, 6, h, w): the sum of two small ones."""
        factor = self.factor.to(raw.dtype)[:, :, None, None]
        start = self.start.to(raw.dtype)[:, :, None, None]
        return start + factor * raw


class EgoChange(NamedTuple):
    """What a camera motion changes; both are zero behind the camera.

    Attributes:
        flow: (B, 2, h, w) ego flow, px.
        log_depth: (B, 1, h, w) change of log depth.
    """

    flow: torch.Tensor
    log_depth: torch.Tensor


def normalize(
    inputs: NetworkInputs,
    options: NetworkOptions,
    T_start: torch.Tensor | None = None,
) -> tuple[NetworkInputs, MotionScale]:
    """Convert inputs to what a network with these options reads.

    Without units the flow is what ``T_start`` leaves unexplained, over the focal length
    and over its own typical length m. ``inverse_depth[:, 0]`` is over that of the near
    points; ``inverse_depth[:, 1]`` is the unexplained change of log depth over m. All are
    squashed. The scales of the output are m as an angle, and m times the near depth.

    Args:
        inputs: what :func:`hybridvo.network.inputs.assemble_inputs` returns.
        options: of the network.
        T_start: (B, 4, 4) a first motion, for a scale-free network.

    Returns:
        The inputs that the network reads, and the scales of its outputs.
    """
    inputs = inputs.subsample(options.input_stride)
    if options.scale_free:
        return _normalize_scale_free(inputs, options.later_quantile, T_start)
    shape = (len(inputs), 6)
    factor = torch.full(shape, OUTPUT_SCALE, device=inputs.flow.device)
    scale = MotionScale(factor, torch.zeros_like(factor))
    return replace(inputs, flow=inputs.flow / FLOW_SCALE_PX), scale


def _normalize_scale_free(
    inputs: NetworkInputs, later_quantile: float, T_start: torch.Tensor | None
) -> tuple[NetworkInputs, MotionScale]:
    """The part of :func:`normalize` for a network without units."""
    inverse_depth = torch.nan_to_num(inputs.inverse_depth, 0.0, 0.0, 0.0)
    inverse_prev = inverse_depth[:, 0]
    flow = torch.nan_to_num(inputs.flow, 0.0, 0.0, 0.0)
    has_both = (inverse_depth > 0).all(dim=1, keepdim=True)
    log_change = -torch.where(has_both, inverse_depth, 1.0).log().diff(dim=1)

    start = flow.new_zeros(len(inputs), 6)
    if T_start is not None:
        T_start = T_start.to(flow.dtype)
        start = euler_motion(T_start)
        ego = ego_change(inputs, inverse_prev, T_start)
        # an invalid pixel whose flow is exactly zero has no measured flow
        is_measured = inputs.valid[:, None] | (flow != 0).any(dim=1, keepdim=True)
        flow = torch.where(is_measured, flow - ego.flow, flow)
        log_change = log_change - ego.log_depth

    angle = flow / pinhole(inputs.K_prev)[0]
    motion = _typical_motion(angle, inputs.valid, start, later_quantile)
    is_near_known = inputs.valid & (inverse_prev > 0)
    (nearness,) = quantiles(inverse_prev, is_near_known, (NEAR_QUANTILE,))
    nearness = nearness.clamp(MIN_NEARNESS, MAX_NEARNESS)

    m = motion[:, None, None, None]
    near = nearness[:, None, None, None]
    scaled_change = torch.where(has_both, log_change / m, 0.0)
    depth = torch.cat([inverse_depth[:, :1] / near, scaled_change], dim=1)
    normalized = replace(
        inputs, flow=_squash(angle / m), inverse_depth=_squash(depth)
    )
    factor = torch.stack([torch.rad2deg(motion), motion / nearness], dim=1)
    return normalized, MotionScale(factor.repeat_interleave(3, dim=1), start)


def _typical_motion(
    angle: torch.Tensor,
    valid: torch.Tensor,
    start: torch.Tensor,
    later_quantile: float,
) -> torch.Tensor:
    """(B,) typical length of flow (B, 2, h, w), rad; of later passes if there is a start."""
    length = (angle.square().sum(dim=1) + 1e-20).sqrt()
    first, later = quantiles(length, valid, (FIRST_QUANTILE, later_quantile))
    has_start = (start != 0).any(dim=1)
    return torch.where(has_start, later, first).clamp(MIN_MOTION, MAX_MOTION)


def _squash(x: torch.Tensor) -> torch.Tensor:
    return x / (1 + x.abs() / LIMIT)


def ego_change(
    inputs: NetworkInputs, inverse_depth: torch.Tensor, T: torch.Tensor
) -> EgoChange:
    """Flow and change of log depth that camera motions cause.

    Args:
        inputs: rays and cameras.
        inverse_depth: (B, h, w) 1 / metres of the previous frame; 0 is infinitely far.
        T: (B, 4, 4) ``T_curr_prev``.
    """
    # a point over its depth is ray + translation * inverse depth, which is finite for all
    rays = inputs.rays.flatten(2)
    near = inverse_depth.flatten(1)[:, None]
    moved = T[:, :3, :2] @ rays + T[:, :3, 2:3] + T[:, :3, 3:] * near
    moved = moved.unflatten(2, inverse_depth.shape[1:])
    min_z = MIN_DEPTH * inverse_depth[:, None].clamp(min=1e-3)
    in_front = moved[:, 2:] > min_z
    z = torch.where(in_front, moved[:, 2:], 1.0)
    focal, centre = pinhole(inputs.K_curr)
    flow = focal * moved[:, :2] / z + centre - inputs.pixels
    return EgoChange(
        flow=torch.where(in_front, flow, 0.0),
        log_depth=torch.where(in_front, z.log(), 0.0),
    )
