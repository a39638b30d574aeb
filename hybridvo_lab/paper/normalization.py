"""What a network reads of its inputs, and the units of its outputs.

A scale-free network has no units: the inputs of a pair are divided by the pair's own
scales, and the outputs multiplied by them, so that one network serves a desk and a street.
"""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import torch

from hybridvo.network.hypothesis_inputs import quantiles
from hybridvo_lab.paper.inputs import NetworkInputs, pinhole
from hybridvo_lab.paper.layers import NetworkOptions

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
MOTION_QUANTILE = 0.4
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
    """

    factor: torch.Tensor

    def motion(self, raw: torch.Tensor) -> torch.Tensor:
        """Motions of raw outputs (B, 6, h, w)."""
        return self.factor.to(raw.dtype)[:, :, None, None] * raw


def normalize(
    inputs: NetworkInputs, options: NetworkOptions
) -> tuple[NetworkInputs, MotionScale]:
    """Convert inputs to what a network with these options reads.

    Without units the flow is over the focal length and over its own typical length m.
    ``inverse_depth[:, 0]`` is over that of the near points; ``inverse_depth[:, 1]`` is the
    change of log depth over m. All are squashed. The scales of the output are m as an
    angle, and m times the near depth.

    Args:
        inputs: what :func:`hybridvo_lab.paper.inputs.assemble_inputs` returns.
        options: of the network.

    Returns:
        The inputs that the network reads, and the scales of its outputs.
    """
    inputs = inputs.subsample(options.input_stride)
    if options.scale_free:
        return _normalize_scale_free(inputs)
    shape = (len(inputs), 6)
    factor = torch.full(shape, OUTPUT_SCALE, device=inputs.flow.device)
    scale = MotionScale(factor)
    return replace(inputs, flow=inputs.flow / FLOW_SCALE_PX), scale


def _normalize_scale_free(
    inputs: NetworkInputs,
) -> tuple[NetworkInputs, MotionScale]:
    """The part of :func:`normalize` for a network without units."""
    inverse_depth = torch.nan_to_num(inputs.inverse_depth, 0.0, 0.0, 0.0)
    inverse_prev = inverse_depth[:, 0]
    flow = torch.nan_to_num(inputs.flow, 0.0, 0.0, 0.0)
    has_both = (inverse_depth > 0).all(dim=1, keepdim=True)
    log_change = -torch.where(has_both, inverse_depth, 1.0).log().diff(dim=1)

    angle = flow / pinhole(inputs.K_prev)[0]
    length = (angle.square().sum(dim=1) + 1e-20).sqrt()
    (motion,) = quantiles(length, inputs.valid, (MOTION_QUANTILE,))
    motion = motion.clamp(MIN_MOTION, MAX_MOTION)
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
    return normalized, MotionScale(factor.repeat_interleave(3, dim=1))


def _squash(x: torch.Tensor) -> torch.Tensor:
    return x / (1 + x.abs() / LIMIT)
