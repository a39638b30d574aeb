"""The paper's networks as estimators: a pair in, the selected motion out, with its covariance."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch
from torch import nn

from hybridvo.network.inputs import assemble_inputs
from hybridvo.network.layers import plain_torch
from hybridvo.network.normalization import predict
from hybridvo.network.selection import fitted_motion, pixel_weights, select_pose
from hybridvo.refinement.pixels import too_few
from hybridvo.results import MotionPrediction, Reason, RelativePose, Status
from hybridvo.torch_geometry import euler_transform
from hybridvo.types import FramePair

STATIC_AT, STATIC_SLOPE = 1.64, 1.63
"""Where the probability to be static is one half, in units of s above the trusted pixels', and the
slope of its logit: logistic regression over development pairs, both kinds of pixels weighing alike.
Over 300 pairs (wide, crowd, rendered) stated and observed ratios differ by at most 0.09."""
MIN_PIXELS = 64
"""Pixels of the network's input with flow and depth below which it is not asked."""


def static_probability(log_scale: torch.Tensor, valid: torch.Tensor) -> torch.Tensor:
    """(B, h, w) logistic in how far log scales (B, 6, h, w) lie above the trusted pixels'."""
    s = log_scale[:, :3].mean(dim=1)
    trusted = (pixel_weights(log_scale, valid) * s).flatten(1).sum(dim=1)[:, None, None]
    return ((STATIC_AT - (s - trusted)) * STATIC_SLOPE).sigmoid() * valid


def propose_motion(network: nn.Module, pair: FramePair) -> MotionPrediction | None:
    """The motion that a PWVO's trusted pixels agree on, and its static world; None without."""
    with plain_torch():
        inputs = assemble_inputs(pair)
        if int(inputs.valid.sum()) < MIN_PIXELS:
            return None
        maps = predict(network, inputs)
        if maps.log_scale is None:
            return None
        T = fitted_motion(maps, inputs)[0].double().numpy()
        valid = inputs.on_grid_of(maps.log_scale).valid
        static = static_probability(maps.log_scale, valid)[0].numpy()
    finite = np.isfinite(T).all() and np.isfinite(static).all()
    return MotionPrediction(T, static) if finite else None


def estimate_by_network(pair: FramePair, how: str, network: nn.Module) -> RelativePose:
    """Camera motion of one pair by a network and a selection of the paper, without any refinement.

    The covariance is diagonal: of a Laplace variable with the scales that the selected pixels state
    (2 U^2). Bad data give a failed status.
    """
    if pair.flow is None:
        return RelativePose.failed(Reason.NO_FLOW, "no optical flow for this pair")
    if pair.prev.depth is None:
        return RelativePose.failed(Reason.NO_VALID_DEPTH, "no depth for this frame")
    with plain_torch():
        inputs = assemble_inputs(pair)
        if (seen := int(inputs.valid.sum())) < MIN_PIXELS:
            return RelativePose.failed(*too_few(pair.prev.depth, pair.flow, seen, MIN_PIXELS))
        maps = predict(network, inputs, how)
        T = euler_transform(select_pose(maps, how).double())[0].numpy()
        # the largest usual motions, where none are stated: nobody trusts a network that states none
        U = np.repeat([1.0, 0.3], 3)
        if maps.log_scale is not None:
            # the scales go the way of the values: same pixels, same weights
            stated = select_pose(replace(maps, motion=maps.log_scale.exp()), how)
            U = np.maximum(stated[0].double().numpy(), 1e-4)  # half-precision knows no better
    if not (np.isfinite(T).all() and np.isfinite(U).all()):
        reason = Reason.DEGENERATE_GEOMETRY, "the network's answer is not finite"
        return RelativePose.failed(*reason)
    status = Status()
    if U[:3].max() > 2.0:  # degrees: larger than most motions between frames
        doubt = f"the network is uncertain by {U[:3].max():.1f} degrees"
        status = Status.degraded(Reason.LOW_INLIERS, doubt)
    variance = 2 * np.concatenate([U[3:], np.deg2rad(U[:3])]) ** 2
    return RelativePose(T, np.diag(variance), status, terms=("flow", "depth"))
