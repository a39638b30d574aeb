"""The paper's networks as estimators: a pair in, the selected motion out, with its covariance."""

from __future__ import annotations

import contextlib
import functools
import time
from collections.abc import Iterator
from typing import TYPE_CHECKING, Any

import numpy as np

from hybridvo.errors import CheckpointError, InputError
from hybridvo.types import FramePair, MotionPrediction, Reason, RelativePose, Status

if TYPE_CHECKING:
    import torch

    from hybridvo.network.inputs import NetworkInputs
    from hybridvo.network.losses import NetworkOutput
    from hybridvo.network.passes import Chooser

__all__ = [
    "LEARNED",
    "estimate_learned",
    "fitted_motion",
    "next_start",
    "plain_torch",
    "propose_motion",
    "shipped_network",
    "static_probability",
]

LEARNED = {
    "pwvo": "softmax",
    "pwvo-naive": "mean",
    "pixelwise": "mean",
    "vonet": "",
    "vonet-attention": "",
}
"""Methods that are a network alone, and how one motion is selected from its pixels."""

STATIC_AT, STATIC_SLOPE = 1.64, 1.63
"""Where the probability to be static is one half, in units of s above the trusted pixels', and the
slope of its logit: logistic regression over development pairs, both kinds of pixels weighing alike.
Over 300 pairs (wide, crowd, rendered) stated and observed shares differ by at most 0.09."""
LEAST_PIXELS = 64
"""Pixels of the network's input with flow and depth below which it is not asked."""
LEAST_SCALE = 1e-4
"""Least Laplace scale believed, degrees and metres: half-precision weights know no better."""
UNCERTAIN_DEG = 2.0
"""Rotation scale above which the answer is degraded: larger than most motions between frames."""
UNKNOWN_DEG, UNKNOWN_M = 1.0, 0.3
"""Scales stated for networks that give none: the largest usual motions, so that nobody trusts."""


@contextlib.contextmanager
def plain_torch() -> Iterator[None]:
    """Inference in float32 on the CPU, whatever the caller set for networks of its own."""
    import torch

    with contextlib.ExitStack() as stack:
        stack.enter_context(torch.inference_mode())
        if torch.is_autocast_enabled("cpu"):
            stack.enter_context(torch.autocast("cpu", enabled=False))
        if torch.get_default_device().type != "cpu":
            stack.enter_context(torch.device("cpu"))
        yield


@functools.cache
def shipped_network(name: str) -> torch.nn.Module:
    """A network of the package in the form that is fastest on this machine; read once a process.

    Args:
        name: of the weights, which is that of the method.

    Raises:
        CheckpointError: no such weights, weights of another kind of network, or damaged ones.
    """
    import torch

    from hybridvo.network.weights import load_weights, pretrained

    path = pretrained(name)
    network, _ = load_weights(path)
    if not hasattr(getattr(network, "options", None), "passes"):
        raise CheckpointError(f"{path}: expected the weights of {name}, got another network's.")
    return network.eval().to(memory_format=torch.channels_last)  # type: ignore[call-overload]


def next_start(network: torch.nn.Module, selection: str = "softmax") -> Chooser:
    """What the next pass of a network starts from, as its options name it.

    Args:
        network: of ``build_network`` or ``load_weights``.
        selection: how one pose is selected from the pixels.
    """
    from hybridvo.network.selection import select_motion

    options = getattr(network, "options", None)
    if options is not None and options.pass_start == "fit":
        return lambda output, inputs: fitted_motion(output, inputs, selection)
    return lambda output, inputs: select_motion(output, selection)


def fitted_motion(
    output: NetworkOutput, inputs: NetworkInputs, selection: str = "softmax"
) -> torch.Tensor:
    """(B, 4, 4) motion that the pixels agree on which a prediction trusts.

    The selected pose is the start, the log scales of the rotation are the weights, and carry the
    gradient; see :func:`hybridvo.network.weighted_fit.weighted_fit`.

    Args:
        output: a :class:`~hybridvo.types.PixelwisePrediction` with log scales.
        inputs: that it was made from.
        selection: of the start.
    """
    import torch.nn.functional as F

    from hybridvo.network.selection import select_motion
    from hybridvo.network.weighted_fit import pixel_weights, weighted_fit
    from hybridvo.types import PixelwisePrediction

    if not isinstance(output, PixelwisePrediction) or output.log_scale_rotation is None:
        raise InputError("fitted_motion: expected a prediction with uncertainty.")
    log_scale = output.log_scale_rotation
    inputs = _on_grid_of(log_scale, inputs)
    if tuple(log_scale.shape[2:]) != inputs.size:
        log_scale = F.interpolate(log_scale, inputs.size, mode="nearest")
    flow = inputs.flow_px
    f_prev, f_curr = (
        K.diagonal(dim1=1, dim2=2)[:, :2, None, None] for K in (inputs.K_prev, inputs.K_curr)
    )
    c_prev, c_curr = (K[:, :2, 2, None, None] for K in (inputs.K_prev, inputs.K_curr))
    target = (inputs.rays * f_prev + c_prev + flow - c_curr) / f_curr
    return weighted_fit(
        inputs.rays.flatten(2),
        inputs.inverse_depth[:, 0].flatten(1),
        target.flatten(2),
        pixel_weights(log_scale, inputs.valid).flatten(1),
        select_motion(output, selection),
    )


def _on_grid_of(prediction: torch.Tensor, inputs: NetworkInputs) -> NetworkInputs:
    """Every n-th pixel of the inputs, one for each cell (.., h, w) of a prediction."""
    return inputs.subsample(max(1, round(inputs.size[0] / prediction.shape[-2])))


def static_probability(log_scale: torch.Tensor, valid: torch.Tensor) -> torch.Tensor:
    """Probability of every pixel to be static world, from the log scales of a network.

    Args:
        log_scale: (B, 3, h, w) of the rotation.
        valid: (B, h, w) bool; 0 where False.

    Returns:
        (B, h, w). What counts is how far s lies above that of the pixels with weight in the fit;
        the map from there is logistic, see :data:`STATIC_AT`.
    """
    from hybridvo.network.weighted_fit import pixel_weights

    s = log_scale.mean(dim=1)
    trusted = (pixel_weights(log_scale, valid) * s).flatten(1).sum(dim=1)[:, None, None]
    return ((STATIC_AT - (s - trusted)) * STATIC_SLOPE).sigmoid() * valid


def propose_motion(network: torch.nn.Module, pair: FramePair) -> MotionPrediction | None:
    """A pixel-wise network's motion and static world, for an ambiguous pair.

    Args:
        network: a PWVO with uncertainty.
        pair: two frames, the flow between them and the depth of the first.

    Returns:
        The motion that the trusted pixels agree on, after the last pass; None where too little is
        valid, or the answer is not finite.
    """
    from hybridvo.network.inputs import assemble_inputs
    from hybridvo.network.passes import predict

    with plain_torch():
        inputs = assemble_inputs(pair)
        if int(inputs.valid.sum()) < LEAST_PIXELS:
            return None
        output = predict(network, inputs, next_start(network))
        log_scale = getattr(output, "log_scale_rotation", None)
        if log_scale is None:
            return None
        T = fitted_motion(output, inputs)[0].double().numpy()
        valid = _on_grid_of(log_scale, inputs).valid
        static = static_probability(log_scale, valid)[0].numpy()
    return (
        MotionPrediction(T, static) if np.isfinite(T).all() and np.isfinite(static).all() else None
    )


def estimate_learned(
    pair: FramePair, method: str, network: torch.nn.Module | None = None
) -> RelativePose:
    """Camera motion of one pair by a network and the paper's selection, without any refinement.

    Args:
        pair: two frames and the flow between them.
        method: one of :data:`LEARNED`.
        network: of ``build_network`` or ``load_weights``; the one that is shipped by default.

    Returns:
        ``T_curr_prev``. Its covariance is diagonal: of a Laplace variable with the scales that the
        selected pixels state (2 U^2). Bad data give a failed status.

    Raises:
        CheckpointError: weights that are not shipped.
    """
    import torch

    from hybridvo.network.inputs import assemble_inputs
    from hybridvo.network.passes import predict
    from hybridvo.network.selection import select_motion, select_pose
    from hybridvo.types import PixelwisePrediction

    started = time.perf_counter()
    if pair.flow is None:
        return RelativePose.failed(Reason.NO_FLOW, "no optical flow for this pair", method)
    if pair.prev.depth is None:
        return RelativePose.failed(Reason.NO_VALID_DEPTH, "no depth for this frame", method)
    network = shipped_network(method) if network is None else network
    how = LEARNED[method]
    with plain_torch():
        inputs = assemble_inputs(pair)
        seen = int(inputs.valid.sum())
        if seen < LEAST_PIXELS:
            return RelativePose.failed(
                Reason.NO_VALID_DEPTH,
                f"{seen} pixels of the network's input have flow and depth, {LEAST_PIXELS} needed",
                method,
            )
        output = predict(network, inputs, next_start(network, how))
        rotation, translation = (x.double() for x in select_pose(output, how))
        T = select_motion((rotation, translation), how)[0].numpy()
        scales = torch.tensor([[UNKNOWN_M] * 3 + [UNKNOWN_DEG] * 3], dtype=torch.float64)
        log_r = log_t = None
        if isinstance(output, PixelwisePrediction):
            log_r, log_t = output.log_scale_rotation, output.log_scale_translation
        if log_r is not None and log_t is not None:
            # The scales go the way of the values: same pixels, same weights.
            stated = PixelwisePrediction(log_r.exp(), log_t.exp(), log_r, log_t)
            scale_r, scale_t = select_pose(stated, how)
            scales = torch.cat([scale_t, scale_r], dim=1).double()
    U = np.maximum(scales[0].numpy(), LEAST_SCALE)
    ms = 1e3 * (time.perf_counter() - started)
    common: dict[str, Any] = {"method": method, "ms": ms, "terms": ("flow", "depth")}
    if not (np.isfinite(T).all() and np.isfinite(U).all()):
        return RelativePose.failed(
            Reason.DEGENERATE_GEOMETRY, "the network's answer is not finite", **common
        )
    status = Status()
    if U[3:].max() > UNCERTAIN_DEG:
        status = Status.degraded(
            Reason.LOW_INLIERS, f"the network is uncertain by {U[3:].max():.1f} degrees"
        )
    sigma = np.sqrt(2.0) * np.concatenate([U[:3], np.deg2rad(U[3:])])
    return RelativePose(
        T_curr_prev=T,
        covariance=np.diag(sigma**2),
        status=status,
        translation_direction_valid=bool(np.linalg.norm(T[:3, 3]) > 3 * sigma[:3].max()),
        **common,
    )
