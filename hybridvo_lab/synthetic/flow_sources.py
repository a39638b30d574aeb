"""Flow of many makers, so that what is learned is not the errors of one estimator."""

from __future__ import annotations

import cv2
import numpy as np

from hybridvo.core.types import Frame
from hybridvo.flow.providers import FlowField, dis_flow, forward_backward_check
from hybridvo_lab.synthetic.draws import log_uniform, smooth_field
from hybridvo_lab.synthetic.sensors import noisy_flow

ESTIMATORS = ("medium", "fast", "ultrafast", "farneback")
"""Presets of DIS, and Farneback's method."""
ESTIMATOR_PROBABILITIES = (0.6, 0.15, 0.1, 0.15)
DISTURBANCES = ("none", "independent", "smooth")
DISTURBANCE_PROBABILITIES = (0.35, 0.25, 0.4)
INDEPENDENT_PX = (0.02, 1.0)
"""Standard deviations of independent noise, px."""
SMOOTH_PX = (0.02, 0.6)
"""Standard deviations of smooth errors, px at a width of 512."""
EDGE_BLUR_PX = (0.5, 4.0)
"""Standard deviations of the blur over the edges of moving objects, px at a width of 512."""
OUTLIER_REACH = 0.06
"""Largest gross error of a flow component, as a fraction of the width."""


def draw_estimated_flow(
    rng: np.random.Generator, prev: Frame, curr: Frame
) -> FlowField:
    """Estimate the flow of two images by an estimator that is drawn."""
    estimator = str(rng.choice(ESTIMATORS, p=ESTIMATOR_PROBABILITIES))
    if estimator == "farneback":
        return farneback_flow(prev, curr)
    return dis_flow(estimator)(prev, curr)


def farneback_flow(prev: Frame, curr: Frame) -> FlowField:
    """Farneback's flow in both directions, by OpenCV; none without images."""
    if prev.rgb is None or curr.rgb is None:
        return FlowField(None, source="farneback")
    grey_prev = cv2.cvtColor(prev.rgb, cv2.COLOR_RGB2GRAY)
    grey_curr = cv2.cvtColor(curr.rgb, cv2.COLOR_RGB2GRAY)
    forward = _farneback(grey_prev, grey_curr)
    backward = _farneback(grey_curr, grey_prev)
    variance, valid = forward_backward_check(forward, backward, True)
    return FlowField(forward, variance, valid, "farneback")


def _farneback(grey_prev: np.ndarray, grey_curr: np.ndarray) -> np.ndarray:
    """(H, W, 2) float32 px."""
    start = np.zeros((*grey_prev.shape, 2), np.float32)
    return cv2.calcOpticalFlowFarneback(
        grey_prev,
        grey_curr,
        start,
        pyr_scale=0.5,
        levels=5,
        winsize=15,
        iterations=3,
        poly_n=5,
        poly_sigma=1.1,
        flags=0,
    )


def draw_disturbed_flow(rng: np.random.Generator, flow: np.ndarray) -> np.ndarray:
    """Disturb a true flow, or leave it exact.

    Smooth errors are those of learned estimators: alike over a neighbourhood, with
    edges of moving objects that are washed out.

    Args:
        rng: the source of randomness.
        flow: (H, W, 2) px; NaN where it is unknown.

    Returns:
        (H, W, 2) float32 px.
    """
    kind = str(rng.choice(DISTURBANCES, p=DISTURBANCE_PROBABILITIES))
    flow = np.ascontiguousarray(flow, np.float32)
    width = flow.shape[1]
    if kind == "none":
        return flow
    if kind == "independent":
        outliers = rng.uniform(0, 0.3) if rng.random() < 0.5 else 0.0
        return draw_noisy_flow(rng, flow, outliers)
    scale = width / 512
    if rng.random() < 0.7:
        flow = _blurred(flow, log_uniform(rng, EDGE_BLUR_PX) * scale)
    cells = int(rng.integers(4, 32))
    error = smooth_field(rng, flow.shape[:2], cells, 2)
    return flow + np.float32(log_uniform(rng, SMOOTH_PX) * scale) * error


def draw_noisy_flow(
    rng: np.random.Generator, flow: np.ndarray, outlier_fraction: float
) -> np.ndarray:
    """The flow (H, W, 2) with noise as in the benchmark's
    scenarios, but of any strength.
    """
    noise_px = log_uniform(rng, INDEPENDENT_PX)
    reach_px = OUTLIER_REACH * flow.shape[1]
    return noisy_flow(rng, flow, noise_px, outlier_fraction, reach_px).flow


def _blurred(flow: np.ndarray, sigma_px: float) -> np.ndarray:
    """A flow, blurred over its known pixels."""
    known = np.isfinite(flow).all(axis=2).astype(np.float32)
    total = cv2.GaussianBlur(np.nan_to_num(flow), (0, 0), sigma_px)
    fraction = cv2.GaussianBlur(known, (0, 0), sigma_px)
    blurred = total / np.maximum(fraction, 1e-3)[..., None]
    return np.where(known[..., None] > 0, blurred, np.nan).astype(np.float32)
