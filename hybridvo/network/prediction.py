"""What the methods take from a network for one pair."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch
from torch import nn

from hybridvo.calibration import (
    MAX_NETWORK_SCALE_DEG,
    MIN_NETWORK_PIXELS,
    STATIC_LOG_SCALE,
    STATIC_SLOPE,
    UNSTATED_ROTATION_DEG,
    UNSTATED_TRANSLATION_M,
)
from hybridvo.network.inputs import NetworkInputs, assemble_inputs
from hybridvo.network.layers import single_threaded_inference
from hybridvo.network.passes import predict
from hybridvo.network.selection import select_pose
from hybridvo.network.weighted_fit import fitted_motion, pixel_weights
from hybridvo.refinement.pixels import too_few
from hybridvo.results import (
    MotionPrediction,
    PixelwisePrediction,
    Reason,
    RelativePose,
    StageFailed,
    Status,
)
from hybridvo.torch_geometry import euler_transform
from hybridvo.types import FramePair

# numerical guard, degrees and metres: half precision resolves no smaller uncertainty
MIN_SCALE = 1e-4


def static_probability(
    log_scale: torch.Tensor, valid: torch.Tensor
) -> torch.Tensor:
    """Probability of each pixel to be static, logistic in its log scale.

    The log scale is compared with its mean over the pixels, weighted as in a fit.

    Args:
        log_scale: (B, 6, h, w) s = log U.
        valid: (B, h, w) bool.

    Returns:
        (B, h, w) from 0 to 1; 0 where invalid.
    """
    s = log_scale[:, :3].mean(dim=1)
    weights = pixel_weights(log_scale, valid)
    weighted_mean = (weights * s).flatten(1).sum(dim=1)[:, None, None]
    logit = (STATIC_LOG_SCALE - (s - weighted_mean)) * STATIC_SLOPE
    return logit.sigmoid() * valid


def propose_motion(network: nn.Module, pair: FramePair) -> MotionPrediction | None:
    """Predict the motion by a PWVO and a weighted fit, and where the scene is static.

    Args:
        network: a PWVO.
        pair: frames with flow.

    Returns:
        The prediction; None where too few pixels have flow and depth, or where the network
        predicts no uncertainty.
    """
    with single_threaded_inference():
        inputs = _inputs_of(pair, network)
        if int(inputs.valid.sum()) < MIN_NETWORK_PIXELS:
            return None
        maps = predict(network, inputs)
        if maps.log_scale is None:
            return None
        T = fitted_motion(maps, inputs)[0].double().cpu().numpy()
        valid = inputs.on_grid_of(maps.log_scale).valid
        static = static_probability(maps.log_scale, valid)[0].cpu().numpy()
    return MotionPrediction(T, static)


def estimate_by_network(
    pair: FramePair, selection: str, network: nn.Module
) -> RelativePose:
    """Estimate the camera motion of a pair by a network alone.

    Args:
        pair: frames with flow, and depth of the previous one.
        selection: a method of :func:`hybridvo.network.selection.select_pose`.
        network: any network of the paper.

    Returns:
        The motion, with the covariance 2 U^2 of the Laplace scales U that the network
        predicts.

    Raises:
        StageFailed: if flow, depth or usable pixels are missing.
    """
    if pair.flow is None:
        raise StageFailed(Reason.NO_FLOW, "no optical flow for this pair")
    depth = pair.prev.depth
    if depth is None:
        raise StageFailed(Reason.NO_VALID_DEPTH, "no depth for this frame")
    with single_threaded_inference():
        inputs = _inputs_of(pair, network)
        count = int(inputs.valid.sum())
        if count < MIN_NETWORK_PIXELS:
            why = too_few(depth, pair.flow, count, MIN_NETWORK_PIXELS)
            raise StageFailed(*why)
        maps = predict(network, inputs, selection)
        pose = select_pose(maps, selection).double()
        T = euler_transform(pose)[0].cpu().numpy()
        scales = _selected_scales(maps, selection)
    rotation_deg = scales[:3]
    translation_m = scales[3:]
    variance = 2 * np.concatenate([translation_m, np.deg2rad(rotation_deg)]) ** 2
    return RelativePose(
        T_curr_prev=T,
        covariance=np.diag(variance),
        status=_network_status(float(rotation_deg.max())),
        terms=("flow", "depth"),
    )


def _inputs_of(pair: FramePair, network: nn.Module) -> NetworkInputs:
    """The inputs of one pair on the network's device."""
    return assemble_inputs(pair).to(next(network.parameters()).device)


def _selected_scales(maps: PixelwisePrediction, selection: str) -> np.ndarray:
    """(6,) Laplace scales of the selected motion of one pair, degrees, then metres.

    The scales are selected as the motion is: same pixels, same weights.
    """
    if maps.log_scale is None:
        rotation_deg = np.full(3, UNSTATED_ROTATION_DEG)
        translation_m = np.full(3, UNSTATED_TRANSLATION_M)
        return np.concatenate([rotation_deg, translation_m])
    scales = replace(maps, motion=maps.log_scale.exp())
    selected = select_pose(scales, selection)[0].double().cpu().numpy()
    return np.maximum(selected, MIN_SCALE)


def _network_status(rotation_scale_deg: float) -> Status:
    """Degraded where the predicted uncertainty is larger than most motions."""
    if rotation_scale_deg <= MAX_NETWORK_SCALE_DEG:
        return Status()
    return Status.degraded(
        Reason.LOW_INLIERS,
        f"the network is uncertain by {rotation_scale_deg:.1f} degrees",
    )
