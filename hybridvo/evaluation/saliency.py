"""What a network looks at: integrated gradients of its answer over flow and depth."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import torch

from hybridvo.network.selection import select_pose
from hybridvo.results import PixelwisePrediction

PARTS = ("rotation", "translation")


def integrated_gradients(
    answer: Callable[..., torch.Tensor], inputs: tuple[torch.Tensor, ...], steps: int = 32
) -> list[torch.Tensor]:
    """Attributions of a scalar answer, like its inputs (Sundararajan, Taly and Yan, ICML 2017).

    Their sum is the answer for the inputs minus that for zeros, up to the error of the integral:
    ``steps`` Gauss-Legendre nodes, a forward and a backward pass each; for smooth networks 32 of
    them leave less than a percent unexplained.
    """
    nodes, weights = np.polynomial.legendre.leggauss(steps)
    sums = [torch.zeros_like(x) for x in inputs]
    for node, weight in zip((nodes + 1) / 2, weights / 2, strict=True):
        points = [(float(node) * x).detach().requires_grad_() for x in inputs]
        # an input that the answer does not depend on has no gradient
        gradients = torch.autograd.grad(answer(*points), points, allow_unused=True)
        for total, gradient in zip(sums, gradients, strict=True):
            if gradient is not None:
                total += float(weight) * gradient
    return [total * x for total, x in zip(sums, inputs, strict=True)]


def saliencies(
    network: Any, inputs: Any, T_start: Any = None, steps: int = 32
) -> dict[str, np.ndarray]:
    """Absolute attributions (h, w) of rotation and translation to flow and inverse depth.

    The answer is the length of the predicted rotation (or translation) along its own direction; of
    a pixel-wise network with the pixels and weights chosen for the real input: the choice would
    make it jump. The path starts at zero; scale-free networks see the logarithm of the depth, which
    is held fixed, as is what earlier passes found.
    """
    names = ("flow",) if network.options.scale_free else ("flow", "inverse_depth")
    given = tuple(getattr(inputs, name) for name in names)

    def run(*tensors: torch.Tensor) -> Any:
        return network(replace(inputs, **dict(zip(names, tensors, strict=True))), T_start)

    def part(output: Any, k: int) -> torch.Tensor:
        is_map = isinstance(output, PixelwisePrediction)
        return getattr(output, PARTS[k]) if is_map else output[k]

    with torch.no_grad():
        output = run(*given)
    found = {}
    for k, what in enumerate(PARTS):
        motion = weights = part(output, k).clone().requires_grad_()
        if isinstance(output, PixelwisePrediction):
            own: dict[str, Any] = {what: weights}
            motion = select_pose(replace(output, **own))[k]
        direction = (motion / motion.norm().clamp(min=1e-12)).detach()
        (weights,) = torch.autograd.grad((direction * motion).sum(), weights)
        answer = lambda *x, k=k, w=weights: (w * part(run(*x), k)).sum()  # noqa: E731
        attributions = integrated_gradients(answer, given, steps)
        found[what] = torch.cat(attributions, dim=1)[0].abs().sum(0).cpu().numpy()
    return found
