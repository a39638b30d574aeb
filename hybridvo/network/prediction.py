"""The paper's networks as estimators: a pair in, the selected motion out, with its covariance."""

from __future__ import annotations

import time

import numpy as np
import torch
from torch import nn

from hybridvo.network.inputs import assemble_inputs
from hybridvo.network.layers import plain_torch
from hybridvo.network.models import SELECTION
from hybridvo.network.normalization import predict
from hybridvo.network.selection import (
    NetworkOutput,
    fitted_motion,
    joined,
    on_grid_of,
    pixel_weights,
    select_pose,
)
from hybridvo.results import MotionPrediction, PixelwisePrediction, Reason, RelativePose, Status
from hybridvo.torch_geometry import euler_transform
from hybridvo.types import FramePair

STATIC_AT, STATIC_SLOPE = 1.64, 1.63
"""Where the probability to be static is one half, in units of s above the trusted pixels', and the
slope of its logit: logistic regression over development pairs, both kinds of pixels weighing alike.
Over 300 pairs (wide, crowd, rendered) stated and observed ratios differ by at most 0.09."""
MIN_PIXELS = 64
"""Pixels of the network's input with flow and depth below which it is not asked."""


def static_probability(log_scale: torch.Tensor, valid: torch.Tensor) -> torch.Tensor:
    """(B, h, w) logistic in how far log scales (B, 3, h, w) lie above the trusted pixels'."""
    s = log_scale.mean(dim=1)
    trusted = (pixel_weights(log_scale, valid) * s).flatten(1).sum(dim=1)[:, None, None]
    return ((STATIC_AT - (s - trusted)) * STATIC_SLOPE).sigmoid() * valid


def propose_motion(network: nn.Module, pair: FramePair) -> MotionPrediction | None:
    """The motion that a PWVO's trusted pixels agree on, and its static world; None without."""
    with plain_torch():
        inputs = assemble_inputs(pair)
        if int(inputs.valid.sum()) < MIN_PIXELS:
            return None
        output = predict(network, inputs)
        log_scale = getattr(output, "log_scale_rotation", None)
        if log_scale is None:
            return None
        T = fitted_motion(output, inputs)[0].double().numpy()
        valid = on_grid_of(log_scale, inputs).valid
        static = static_probability(log_scale, valid)[0].numpy()
    finite = np.isfinite(T).all() and np.isfinite(static).all()
    return MotionPrediction(T, static) if finite else None


def estimate_by_network(pair: FramePair, method: str, network: nn.Module) -> RelativePose:
    """Camera motion of one pair by a network and the paper's selection, without any refinement.

    The covariance is diagonal: of a Laplace variable with the scales that the selected pixels state
    (2 U^2). Bad data give a failed status.
    """
    started = time.perf_counter()

    def failed(reason: Reason, message: str) -> RelativePose:
        return RelativePose.failed(reason, message, method, terms=("flow", "depth"))

    if pair.flow is None:
        return failed(Reason.NO_FLOW, "no optical flow for this pair")
    if pair.prev.depth is None:
        return failed(Reason.NO_VALID_DEPTH, "no depth for this frame")
    with plain_torch():
        inputs = assemble_inputs(pair)
        if (seen := int(inputs.valid.sum())) < MIN_PIXELS:
            return failed(
                Reason.NO_VALID_DEPTH,
                f"{seen} pixels of the network's input have flow and depth, {MIN_PIXELS} needed",
            )
        how = SELECTION[method]
        output = predict(network, inputs, how)
        T = euler_transform(*(x.double() for x in select_pose(output, how)))[0].numpy()
        U = np.maximum(_stated_scale(output, how), 1e-4)  # half-precision weights know no better
    if not (np.isfinite(T).all() and np.isfinite(U).all()):
        return failed(Reason.DEGENERATE_GEOMETRY, "the network's answer is not finite")
    status = Status()
    if U[3:].max() > 2.0:  # degrees: larger than most motions between frames
        status = Status.degraded(
            Reason.LOW_INLIERS, f"the network is uncertain by {U[3:].max():.1f} degrees"
        )
    sigma = np.sqrt(2.0) * np.concatenate([U[:3], np.deg2rad(U[3:])])
    return RelativePose(
        T_curr_prev=T,
        covariance=np.diag(sigma**2),
        status=status,
        method=method,
        ms=1e3 * (time.perf_counter() - started),
        terms=("flow", "depth"),
    )


def _stated_scale(output: NetworkOutput, how: str) -> np.ndarray:
    """(6,) Laplace scales of a selected motion: of its translation (m) and rotation (degrees)."""
    if not isinstance(output, PixelwisePrediction) or (s := joined(output)[1]) is None:
        # the largest usual motions: nobody trusts a network that states none
        return np.repeat([0.3, 1.0], 3)
    # The scales go the way of the values: same pixels, same weights.
    stated = PixelwisePrediction(*s.exp().split(3, dim=1), *s.split(3, dim=1))
    scale_r, scale_t = select_pose(stated, how)
    return torch.cat([scale_t, scale_r], dim=1)[0].double().numpy()
