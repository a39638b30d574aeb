"""The motion of a pair by a network of the paper alone."""

from __future__ import annotations

from torch import nn

from hybridvo.core.results import Motion
from hybridvo.core.types import FramePair
from hybridvo.network.prediction import selected_motion, usable_inputs
from hybridvo.network.threads import single_threaded_inference


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
