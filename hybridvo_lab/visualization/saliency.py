"""Which pixels of the input a network's motion depends on (needs torch)."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Any

import cv2
import numpy as np
import torch

from hybridvo.core.results import PixelwisePrediction
from hybridvo.flow.colours import high_value
from hybridvo.network.selection import select_pose
from hybridvo_lab.visualization.pair import PARTS
from hybridvo_lab.visualization.panels import Panel

QUADRATURE_STEPS = 32
"""Points of the integral along the path from zero to the input."""
SMOOTHING_PX = 4
"""Side of the mean filter over saliency, pixels. Networks with a stride read only some pixels."""
MIN_LENGTH = 1e-12
"""Length of a motion below which it has no direction."""


def integrated_gradients(
    answer: Callable[..., torch.Tensor],
    inputs: tuple[torch.Tensor, ...],
    steps: int = QUADRATURE_STEPS,
) -> list[torch.Tensor]:
    """Attribute a scalar answer to its inputs (Sundararajan, Taly and Yan, ICML 2017).

    Args:
        answer: A function of the inputs that returns a scalar.
        inputs: The tensors.
        steps: Points of the Gauss-Legendre quadrature.

    Returns:
        A tensor for each input. Their sum is the answer for the inputs minus that for zeros, to a
        percent or less.
    """
    nodes, weights = np.polynomial.legendre.leggauss(steps)
    fractions = (nodes + 1) / 2
    weights = weights / 2
    sums = [torch.zeros_like(x) for x in inputs]
    for fraction, weight in zip(fractions, weights, strict=True):
        points = [(float(fraction) * x).detach().requires_grad_() for x in inputs]
        # An input that the answer does not depend on has no gradient.
        gradients = torch.autograd.grad(answer(*points), points, allow_unused=True)
        for total, gradient in zip(sums, gradients, strict=True):
            if gradient is not None:
                total += float(weight) * gradient
    return [total * x for total, x in zip(sums, inputs, strict=True)]


def network_saliencies(
    network: Any, inputs: Any, steps: int = QUADRATURE_STEPS
) -> dict[str, np.ndarray]:
    """Compute the saliencies of flow and inverse depth for a network of the paper.

    The depth of scale-free networks is held fixed.

    Args:
        network: A network that predicts a motion at every pixel.
        inputs: What it reads.
        steps: Points of the quadrature.
    """
    names = ("flow",) if network.options.scale_free else ("flow", "inverse_depth")

    def predict(*tensors: torch.Tensor) -> PixelwisePrediction:
        changed = dict(zip(names, tensors, strict=True))
        return network(replace(inputs, **changed))

    given = tuple(getattr(inputs, name) for name in names)
    return saliencies(predict, given, steps)


def saliencies(
    predict: Callable[..., PixelwisePrediction],
    given: tuple[torch.Tensor, ...],
    steps: int = QUADRATURE_STEPS,
) -> dict[str, np.ndarray]:
    """Compute how much each pixel of some inputs matters to the selected motion.

    The pixels and weights that select the motion are those of the real input.

    Args:
        predict: A function of the inputs that predicts a motion at every pixel.
        given: The inputs, (1, C, h, w).
        steps: Points of the quadrature.

    Returns:
        For ``rotation`` and ``translation`` a map (h, w) of absolute attributions of its length.
    """
    with torch.no_grad():
        prediction = predict(*given)
    maps = {}
    for k, part in enumerate(PARTS):
        components = slice(3 * k, 3 * k + 3)
        weights = _weights_of_length(prediction, components)

        def length(
            *tensors: torch.Tensor, weights: torch.Tensor = weights
        ) -> torch.Tensor:
            return (weights * predict(*tensors).motion).sum()

        attributions = integrated_gradients(length, given, steps)
        stacked = torch.cat(attributions, dim=1)[0]
        maps[part] = stacked.abs().sum(0).cpu().numpy()
    return maps


def _weights_of_length(
    prediction: PixelwisePrediction, components: slice
) -> torch.Tensor:
    """Return the weight of each pixel's components in the length of the selected motion.

    The selection is a weighted mean of the pixels' motions, so that its gradient has the weights.
    """
    motions = prediction.motion.clone().requires_grad_()
    selected = select_pose(replace(prediction, motion=motions))[:, components]
    direction = (selected / selected.norm().clamp(min=MIN_LENGTH)).detach()
    (weights,) = torch.autograd.grad((direction * selected).sum(), motions)
    return weights


def saliency_panels(
    name: str, maps: Mapping[str, np.ndarray], moving: np.ndarray
) -> list[Panel]:
    """Make the panels of :func:`saliencies`.

    Args:
        name: Name of the network.
        maps: What :func:`saliencies` returns.
        moving: (H, W) bool, what is outlined.
    """
    panels = []
    for part, saliency in maps.items():
        smooth = cv2.blur(saliency, (SMOOTHING_PX, SMOOTHING_PX))
        relative = smooth / high_value(smooth)
        title = f"{name}: saliency, {part}"
        panels.append(Panel(title, relative, "relative", 1.0, moving))
    return panels
