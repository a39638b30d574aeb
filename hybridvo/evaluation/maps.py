"""Maps of one pair: flow in parts, errors, uncertainty, saliency; arrays in, arrays out.

The input flow is the ego flow (what the camera's motion causes on a static scene) plus the object
flow (what is left): ``F = F_ego + F_object``.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from hybridvo.errors import InputError
from hybridvo.evaluation.pair_errors import MOVING_PX
from hybridvo.geometry import ego_flow
from hybridvo.results import PixelwisePrediction
from hybridvo.types import Camera, FramePair

if TYPE_CHECKING:
    import torch

# Baker et al., "A Database and Evaluation Methodology for Optical Flow" (IJCV 2011): hues between
# six corners of the colour circle, as many steps as the eye tells apart in each part
_WHEEL_STEPS = (
    *(("R", "Y", 15), ("Y", "G", 6), ("G", "C", 4)),
    *(("C", "B", 11), ("B", "M", 13), ("M", "R", 6)),
)
_CORNERS = {
    **{"R": (255, 0, 0), "Y": (255, 255, 0), "G": (0, 255, 0)},
    **{"C": (0, 255, 255), "B": (0, 0, 255), "M": (255, 0, 255)},
}


def _wheel() -> np.ndarray:
    """(55, 3) colours of the circle, 0 to 255."""
    parts = []
    for first, second, steps in _WHEEL_STEPS:
        a, b = np.array(_CORNERS[first], float), np.array(_CORNERS[second], float)
        parts.append(a + (b - a) * (np.arange(steps) / steps)[:, None])
    return np.concatenate(parts)


_WHEEL = _wheel()


def flow_colours(flow: np.ndarray, longest: float | None = None) -> np.ndarray:
    """Flow in the standard colours of Middlebury: hue is the direction, saturation the length.

    Args:
        flow: (H, W, 2) px; NaN and inf are black.
        longest: length that has full saturation, px; default: the 99th percentile. Longer vectors
            are darker, as in the benchmark's own pictures.

    Returns:
        (H, W, 3) uint8 RGB; white is no motion, red to the right, yellow-green downwards.

    Raises:
        InputError: another shape.
    """
    flow = np.asarray(flow)
    if flow.ndim != 3 or flow.shape[2] != 2:
        raise InputError(f"flow_colours: expected flow of shape (H, W, 2), got {flow.shape}.")
    u, v = (flow[..., k].astype(np.float64) for k in (0, 1))
    known = np.isfinite(u) & np.isfinite(v)
    u, v = np.where(known, u, 0.0), np.where(known, v, 0.0)
    length = np.hypot(u, v)
    if longest is None:
        longest = longest_flow(flow)
    radius = length / longest
    angle = np.arctan2(-v, -u) / np.pi  # -1 to 1
    place = (angle + 1) / 2 * (len(_WHEEL) - 1)
    low = np.floor(place).astype(int)
    high = (low + 1) % len(_WHEEL)
    share = (place - low)[..., None]
    colour = ((1 - share) * _WHEEL[low] + share * _WHEEL[high]) / 255.0
    inside = (radius <= 1)[..., None]
    colour = np.where(inside, 1 - radius[..., None] * (1 - colour), 0.75 * colour)
    return (255 * np.where(known[..., None], colour, 0.0) + 0.5).astype(np.uint8)


def longest_flow(flow: np.ndarray) -> float:
    """99th percentile of the lengths of a flow, px; 1 where nothing is known."""
    length = np.hypot(flow[..., 0], flow[..., 1])
    length = length[np.isfinite(length)]
    return max(float(np.percentile(length, 99)), 1e-6) if length.size else 1.0


def colour_wheel(size: int = 65) -> np.ndarray:
    """Legend of :func:`flow_colours`: (size, size, 4) uint8 RGBA, the longest vectors at the rim.

    A pixel of the wheel has the colour of a flow that points from the centre to it.
    """
    half = (size - 1) / 2
    v, u = (np.mgrid[0:size, 0:size] - half) / half
    rgb = flow_colours(np.dstack([u, v]), 1.0)
    alpha = np.where(np.hypot(u, v) <= 1.0, 255, 0).astype(np.uint8)
    return np.dstack([rgb, alpha])


def object_flow(pair: FramePair, T_curr_prev: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(ego flow, object flow) of a pair, (H, W, 2) px each, NaN where a part is not known.

    Args:
        pair: with flow and previous depth.
        T_curr_prev: (4, 4) camera motion, metres.

    Raises:
        InputError: a pair without flow or depth.
    """
    if pair.flow is None or pair.prev.depth is None:
        missing = "flow" if pair.flow is None else "previous depth"
        raise InputError(f"object_flow: the pair has no {missing}.")
    ego = ego_flow(pair.prev.depth, T_curr_prev, pair.prev.camera, pair.curr.camera)
    return ego, pair.flow - ego


def moving_pixels(objects: np.ndarray) -> np.ndarray:
    """(H, W) bool: pixels whose object flow (H, W, 2) is longer than a pixel."""
    with np.errstate(invalid="ignore"):
        return np.hypot(objects[..., 0], objects[..., 1]) > MOVING_PX


def error_map(
    T_est: np.ndarray, T_true: np.ndarray, depth: np.ndarray, prev: Camera, curr: Camera
) -> np.ndarray:
    """(H, W) distance of the ego flows of two motions, px; NaN without depth.

    Args:
        T_est: (4, 4) estimated T_curr_prev.
        T_true: (4, 4) true T_curr_prev.
        depth: (H, W) metres, of the previous frame.
        prev: previous camera.
        curr: current camera.
    """
    difference = ego_flow(depth, T_est, prev, curr) - ego_flow(depth, T_true, prev, curr)
    return np.hypot(difference[..., 0], difference[..., 1])


def uncertainty_maps(prediction: PixelwisePrediction) -> tuple[np.ndarray, np.ndarray]:
    """Predicted uncertainty of rotation and translation at every pixel of the first pair.

    Args:
        prediction: with log scales.

    Returns:
        Two (h, w) maps: the geometric mean of the three Laplace scales U, in degrees and metres.

    Raises:
        InputError: the network predicts no uncertainty.
    """
    rotation, translation = prediction.log_scale_rotation, prediction.log_scale_translation
    if rotation is None or translation is None:
        raise InputError("uncertainty_maps: the network predicts no uncertainty.")
    means = [_array(scale[0].float().mean(0)) for scale in (rotation, translation)]
    return np.exp(means[0]), np.exp(means[1])


def prediction_errors(
    prediction: PixelwisePrediction, euler_deg: np.ndarray, translation: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Error of the predicted motion at every pixel of the first pair: the paper's error maps.

    Args:
        prediction: maps of (B, 3, h, w).
        euler_deg: (3,) true Euler angles X-Y-Z of T_curr_prev, degrees.
        translation: (3,) true translation of T_curr_prev, metres.

    Returns:
        Two (h, w) maps: mean absolute difference over the three components, degrees and metres.
    """
    maps = []
    for value, true in ((prediction.rotation, euler_deg), (prediction.translation, translation)):
        predicted = value[0].detach().cpu().double().numpy()
        maps.append(np.abs(predicted - np.asarray(true, dtype=float)[:, None, None]).mean(axis=0))
    return maps[0], maps[1]


@dataclass(frozen=True, eq=False)
class Saliency:
    """How much each pixel of a network's input matters to its answer.

    Args:
        magnitude: (h, w) sum over the channels of the absolute attributions.
        total: sum of all attributions, with their signs.
        change: answer for the input minus answer for zeros. Equal to ``total`` up to the
            error of the integral (completeness).
    """

    magnitude: np.ndarray
    total: float
    change: float

    @property
    def completeness_error(self) -> float:
        """Share of the change that the attributions miss; 0 where nothing changes."""
        return abs(self.total - self.change) / max(abs(self.change), 1e-12) if self.change else 0.0


def integrated_gradients(
    answer: Callable[..., torch.Tensor],
    inputs: tuple[torch.Tensor, ...],
    steps: int = 32,
) -> Saliency:
    """Integrated gradients of a scalar answer (Sundararajan, Taly and Yan, ICML 2017).

    The integral from zero to the input goes over Gauss-Legendre nodes: for smooth networks
    32 of them leave less than a percent of the change unexplained.

    Args:
        answer: takes tensors like ``inputs``, returns one number, differentiable.
        inputs: tensors of (1, C, h, w), all of one (h, w).
        steps: nodes of the integral, at least 1; each costs one forward and one backward pass.
    """
    import torch

    starts = tuple(torch.zeros_like(x) for x in inputs)
    nodes, weights = np.polynomial.legendre.leggauss(steps)
    sums = [torch.zeros_like(x) for x in inputs]
    for node, weight in zip((nodes + 1) / 2, weights / 2, strict=True):
        points = [
            (start + float(node) * (x - start)).detach().requires_grad_()
            for x, start in zip(inputs, starts, strict=True)
        ]
        value = answer(*points)
        # an input that the answer does not depend on has no gradient
        gradients = torch.autograd.grad(value, points, allow_unused=True)
        for total, gradient in zip(sums, gradients, strict=True):
            if gradient is not None:
                total += float(weight) * gradient
    with torch.no_grad():
        attributions = [
            total * (x - start) for total, x, start in zip(sums, inputs, starts, strict=True)
        ]
        change = float(answer(*inputs)) - float(answer(*starts))
        magnitude = sum(a[0].abs().sum(0) for a in attributions)
        total_ = float(sum(a.double().sum() for a in attributions))
    return Saliency(_array(magnitude), total_, change)


def _array(value: Any) -> np.ndarray:
    return value.detach().cpu().numpy()


def share_on(magnitude: np.ndarray, mask: np.ndarray) -> float | None:
    """Share of a saliency (h, w) that falls on a mask, in [0, 1]; None where there is none at all.

    Args:
        magnitude: (h, w), not negative.
        mask: (H, W) bool of any size; taken at the nearest pixels.
    """
    rows = ((np.arange(magnitude.shape[0]) + 0.5) * mask.shape[0] / magnitude.shape[0]).astype(int)
    cols = ((np.arange(magnitude.shape[1]) + 0.5) * mask.shape[1] / magnitude.shape[1]).astype(int)
    total = float(magnitude.sum(dtype=np.float64))
    if not math.isfinite(total) or total <= 0:
        return None
    return float((magnitude * mask[np.ix_(rows, cols)]).sum(dtype=np.float64)) / total
