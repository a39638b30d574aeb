"""A network's answer in several passes, each on what the one before left unexplained."""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import nn

from hybridvo.network.inputs import NetworkInputs
from hybridvo.network.losses import NetworkOutput

__all__ = ["Chooser", "first_motions", "predict"]

Chooser = Callable[[NetworkOutput, NetworkInputs], torch.Tensor]
"""From a network's output and what it read to the motion T_curr_prev (B, 4, 4) that the next pass
starts from: :func:`hybridvo.learned.next_start`."""


def predict(
    network: nn.Module, inputs: NetworkInputs, choose: Chooser, passes: int | None = None
) -> NetworkOutput:
    """Output of the last of several passes.

    Args:
        network: of ``build_network``.
        inputs: of size (h, w).
        choose: how one motion comes out of a pass; the next one starts there.
        passes: their number; by default the one that the network's options name.
    """
    if passes is None:
        options = getattr(network, "options", None)
        passes = 1 if options is None else int(options.passes)
    T = first_motions(network, inputs, choose, passes - 1)
    return network(inputs) if T is None else network(inputs, T)


def first_motions(
    network: nn.Module, inputs: NetworkInputs, choose: Chooser, passes: int
) -> torch.Tensor | None:
    """(B, 4, 4) motions after a number of passes, without gradient; None for no pass at all."""
    T = None
    with torch.no_grad():
        for _ in range(passes):
            T = choose(network(inputs) if T is None else network(inputs, T), inputs)
    return T
