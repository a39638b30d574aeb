"""The passes of a network that refines its own answer.

The first pass gives a motion. The second one reads what each of several possible motions
leaves unexplained, because where much of the image moves, the first answer may be a moving
object's. From then on the motions compete: those of which the network is most certain stay.
"""

from __future__ import annotations

from dataclasses import replace

import torch
from torch import nn

from hybridvo.calibration import (
    BEAM_WIDTH,
    BEST_QUANTILE,
    DISTINCT_MOTION_PX,
    MAX_LOG_SCALE_MARGIN,
)
from hybridvo.hypotheses.search import REFERENCE_WIDTH
from hybridvo.network.inputs import NETWORK_SIZE, NetworkInputs, quantiles
from hybridvo.network.normalization import ego_change
from hybridvo.network.weighted_fit import fitted_motion, starting_motions
from hybridvo.refinement.torch_backend import uncompiled
from hybridvo.results import PixelwisePrediction

# px of the network's usual input; the search compares motions at another width
DISTINCT_INPUT_PX = DISTINCT_MOTION_PX * NETWORK_SIZE[1] / REFERENCE_WIDTH
# motions are compared on every so many pixels of both axes
COMPARED_STRIDE = 4


@uncompiled
def predict(
    network: nn.Module, inputs: NetworkInputs, selection: str = "softmax"
) -> PixelwisePrediction:
    """Run all passes of a network.

    Args:
        network: of any kind.
        inputs: of B pairs.
        selection: method of :func:`hybridvo.network.selection.select_motion` that gives
            the start of the next pass.

    Returns:
        The output of the last pass.
    """
    passes: int = network.options.passes  # type: ignore[union-attr, assignment]
    T, lead = first_motions(network, inputs, selection, passes - 1)
    return replace(network(inputs, T), lead=lead)


@torch.no_grad()
def first_motions(
    network: nn.Module, inputs: NetworkInputs, selection: str, passes: int
) -> tuple[torch.Tensor | None, torch.Tensor | None]:
    """Run some passes of a network, without gradients.

    Returns:
        Motions (B, 4, 4) after the passes, None for no pass at all; and by how much the
        log scales are higher under the best other motion, (B,), None for fewer than two
        passes.
    """
    if passes == 0:
        return None, None
    maps = network(inputs)
    if passes == 1:
        return fitted_motion(maps, inputs, selection), None
    T = starting_motions(maps, inputs, selection)
    tried_motions = []
    tried_scales = []
    for passes_left in range(passes - 2, -1, -1):
        T, log_scale = _improve(network, inputs, T, selection)
        tried_motions.append(T)
        tried_scales.append(log_scale)
        count = BEAM_WIDTH if passes_left else 1
        best_scale, best = log_scale.topk(count, largest=False)
        T = torch.take_along_dim(T, best[:, :, None, None], dim=1)
    all_motions = torch.cat(tried_motions, dim=1)
    all_scales = torch.cat(tried_scales, dim=1)
    is_other = _distance(inputs, all_motions, T) > DISTINCT_INPUT_PX
    other_scale = torch.where(is_other, all_scales, torch.inf).amin(dim=1)
    margin = other_scale - best_scale[:, 0]
    return T[:, 0], margin.clamp(max=MAX_LOG_SCALE_MARGIN)


def _improve(
    network: nn.Module, inputs: NetworkInputs, T: torch.Tensor, selection: str
) -> tuple[torch.Tensor, torch.Tensor]:
    """Run one pass from each of S motions (B, S, 4, 4) of every pair.

    Returns:
        The motions after it, and the log scales (B, S) that the surest pixels stay below.
    """
    repeated = inputs.repeated(T.shape[1])
    maps = network(repeated, T.flatten(0, 1))
    improved = fitted_motion(maps, repeated, selection)
    rotation_scale = maps.log_scale[:, :3].mean(dim=1)
    valid = repeated.on_grid_of(maps.log_scale).valid
    (log_scale,) = quantiles(rotation_scale, valid, (BEST_QUANTILE,))
    return improved.unflatten(0, (len(inputs), -1)), log_scale.view(T.shape[:2])


def _distance(
    inputs: NetworkInputs, T: torch.Tensor, reference: torch.Tensor
) -> torch.Tensor:
    """Mean distance of the ego flows of motions (B, S, 4, 4) and of one (B, 1, 4, 4).

    Returns:
        (B, S) px of the inputs, over the valid pixels.
    """
    both = torch.cat([reference, T], dim=1)
    shape = both.shape[:2]
    repeated = inputs.subsample(COMPARED_STRIDE).repeated(both.shape[1])
    ego = ego_change(repeated, repeated.inverse_depth[:, 0], both.flatten(0, 1))
    flow = COMPARED_STRIDE * ego.flow * repeated.valid[:, None]
    flow = flow.unflatten(0, shape)
    distance = (flow[:, 1:] - flow[:, :1]).norm(dim=2).sum(dim=(2, 3))
    count = repeated.valid.unflatten(0, shape)[:, 1:].sum(dim=(2, 3))
    return distance / count.clamp(min=1)
