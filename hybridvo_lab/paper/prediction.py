"""The motion of a pair by a network of the paper alone."""

from __future__ import annotations

from torch import nn

from hybridvo.core.results import Motion, Reason, StageFailed
from hybridvo.core.types import FramePair
from hybridvo.network.prediction import selected_motion
from hybridvo.network.threads import single_threaded_inference
from hybridvo.solver.pixels import too_few
from hybridvo_lab.paper.inputs import NetworkInputs, assemble_inputs

# pixels of the input with flow and depth that a network needs
MIN_NETWORK_PIXELS = 64


def estimate_by_network(
    pair: FramePair, selection: str, network: nn.Module
) -> Motion:
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
    inputs = usable_inputs(pair).to(next(network.parameters()).device)
    with single_threaded_inference():
        return selected_motion(network(inputs), selection)


def usable_inputs(pair: FramePair) -> NetworkInputs:
    """The inputs of the paper's networks; fails where a pair has too little of them."""
    if pair.flow is None:
        raise StageFailed(Reason.NO_FLOW, "no optical flow for this pair")
    depth = pair.prev.depth
    if depth is None:
        raise StageFailed(Reason.NO_VALID_DEPTH, "no depth for this frame")
    inputs = assemble_inputs(pair)
    count = int(inputs.valid.sum())
    if count < MIN_NETWORK_PIXELS:
        raise StageFailed(*too_few(depth, pair.flow, count, MIN_NETWORK_PIXELS))
    return inputs
