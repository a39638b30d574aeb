"""Maps of one pair: flow and its parts, errors, uncertainty; arrays in, arrays out.

The input flow is the ego flow (what the camera's motion causes on a static scene) plus the object
flow (what is left): ``F = F_ego + F_object``.
"""

from __future__ import annotations

import numpy as np

from hybridvo.evaluation.pair_errors import MOVING_PX
from hybridvo.geometry import ego_flow
from hybridvo.results import PixelwisePrediction
from hybridvo.types import Camera, FramePair

# Baker et al., "A Database and Evaluation Methodology for Optical Flow" (IJCV 2011): hues between
# six corners of the colour circle, as many steps as the eye tells apart in each part
_CORNERS = np.cumsum([0, 15, 6, 4, 11, 13, 6])
_COLOURS = 255 * np.array(
    [[1, 0, 0], [1, 1, 0], [0, 1, 0], [0, 1, 1], [0, 0, 1], [1, 0, 1], [1, 0, 0]]
)


def flow_colours(flow: np.ndarray, longest: float | None = None) -> np.ndarray:
    """(H, W, 3) uint8 RGB of a flow (H, W, 2) in the standard colours of Middlebury.

    Hue is the direction (red to the right, yellow-green downwards), saturation the length. Vectors
    of ``longest`` px have full saturation (default: the 99th percentile), longer ones are darker;
    no motion is white, NaN and inf are black.
    """
    flow = np.asarray(flow)
    known = np.isfinite(flow).all(axis=2)
    u, v = np.moveaxis(np.where(known[..., None], flow, 0.0), 2, 0)
    radius = (np.hypot(u, v) / (longest or longest_flow(flow)))[..., None]
    step = (np.arctan2(-v, -u) / np.pi + 1) / 2 * (_CORNERS[-1] - 1)
    colour = np.stack([np.interp(step, _CORNERS, channel) for channel in _COLOURS.T], axis=-1)
    colour = np.where(radius <= 1, 255 - radius * (255 - colour), 0.75 * colour)
    return (np.where(known[..., None], colour, 0.0) + 0.5).astype(np.uint8)


def longest_flow(flow: np.ndarray) -> float:
    """99th percentile of the lengths of a flow, px; 1 where nothing is known."""
    length = np.hypot(flow[..., 0], flow[..., 1])
    length = length[np.isfinite(length)]
    return max(float(np.percentile(length, 99)), 1e-6) if length.size else 1.0


def object_flow(pair: FramePair, T_curr_prev: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(ego flow, object flow) of a pair with flow and depth, (H, W, 2) px, NaN where unknown."""
    depth = np.asarray(pair.prev.depth)
    ego = ego_flow(depth, T_curr_prev, pair.prev.camera, pair.curr.camera)
    return ego, np.asarray(pair.flow) - ego


def moving_pixels(objects: np.ndarray) -> np.ndarray:
    """(H, W) bool: pixels whose object flow (H, W, 2) is longer than a pixel."""
    with np.errstate(invalid="ignore"):
        return np.hypot(objects[..., 0], objects[..., 1]) > MOVING_PX


def error_map(
    T_est: np.ndarray, T_true: np.ndarray, depth: np.ndarray, prev: Camera, curr: Camera
) -> np.ndarray:
    """(H, W) distance of the ego flows of two motions ``T_curr_prev``, px; NaN without depth."""
    difference = ego_flow(depth, T_est, prev, curr) - ego_flow(depth, T_true, prev, curr)
    return np.hypot(difference[..., 0], difference[..., 1])


def uncertainty_maps(prediction: PixelwisePrediction) -> list[np.ndarray]:
    """Predicted uncertainty of rotation (degrees) and translation (m) of the first pair.

    Two (h, w) maps: the geometric mean of the three Laplace scales U at every pixel.
    """
    scales = (prediction.log_scale_rotation, prediction.log_scale_translation)
    return [s[0].detach().float().mean(0).exp().cpu().numpy() for s in scales if s is not None]


def prediction_errors(
    prediction: PixelwisePrediction, euler_deg: np.ndarray, translation: np.ndarray
) -> list[np.ndarray]:
    """Error of the predicted motion at every pixel of the first pair: the paper's error maps.

    Two (h, w) maps: mean absolute difference from the true Euler angles X-Y-Z (3,) of T_curr_prev,
    degrees, and from its translation (3,), metres.
    """
    parts = ((prediction.rotation, euler_deg), (prediction.translation, translation))
    return [
        np.abs(value[0].detach().cpu().double().numpy() - np.reshape(true, (3, 1, 1))).mean(axis=0)
        for value, true in parts
    ]
