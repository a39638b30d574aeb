"""The maps of one pair: flow, ego flow, weights, what moves, and what a network predicts."""

from __future__ import annotations

from typing import NamedTuple

import cv2
import numpy as np

from hybridvo.core.geometry import ego_flow
from hybridvo.core.results import PixelwisePrediction, RelativePose
from hybridvo.core.types import FramePair
from hybridvo.flow.colours import high_value, longest_flow
from hybridvo_lab.evaluation.scores import MOVING_PX
from hybridvo_lab.visualization.panels import (
    Panel,
    flow_panel,
)

# standard deviations of the flow beyond which a difference is no noise
MOVING_FLOW_STDS = 3.0
# weight of a pixel below which the estimate does not rest on it
UNUSED_WEIGHT = 0.5
# grey levels by which a region fits its flow better than the camera's motion: shown by
# ``hybridvo show`` on a scene with smooth walls
MOVING_GREY_LEVELS = 3.0
# fractions of the image, and of its width, that a region needs to be outlined
MIN_REGION_AREA = 0.01
MIN_REGION_THICKNESS = 0.02
# px, of the window in which grey levels are averaged before regions are outlined
MOVING_BLUR_PX = 5

PARTS = ("rotation", "translation")
"""The two halves of a motion with six components, as a network predicts it."""
UNITS = ("deg", "m")
"""The units of these halves."""
OUTSIDE_PX = -1e6
"""Place, pixels, that lies outside of every image; stands for unknown flow."""


class TrueMotion(NamedTuple):
    """The true motion of a pair, in the form in which a network predicts it."""

    euler_deg: np.ndarray  # (3,) angles X-Y-Z of T_curr_prev, degrees
    translation: np.ndarray  # (3,) metres


def pair_panels(
    pair: FramePair,
    motion: RelativePose,
    T_gt: np.ndarray | None,
    moving: np.ndarray,
    everything: bool = True,
) -> list[Panel]:
    """Make the panels of a pair that need no network.

    Args:
        pair: The pair, with flow and the depth of its previous frame.
        motion: Its estimated motion.
        T_gt: The true T_curr_prev (4, 4), or None.
        moving: (H, W) bool, which pixels move by themselves; they are outlined.
        everything: Whether the current image, the ego flow and, if the ground truth is known, its
            error are shown as well.

    Returns:
        Image, depth, flow, what of it the motion leaves, and the weights if the method has some.
    """
    flow = np.asarray(pair.flow)
    ego = _ego_flow(pair, motion.T_curr_prev)
    # The flow and its two parts have one scale.
    longest = longest_flow(flow)
    panels = _image_panel("previous image", pair.prev.rgb)
    if everything:
        panels += _image_panel("current image", pair.curr.rgb)
    panels += [_depth_panel(pair), flow_panel("flow F", flow, longest)]
    if everything:
        panels.append(flow_panel("ego flow", ego, longest))
    panels.append(flow_panel("F minus ego flow", flow - ego, longest))
    if everything and T_gt is not None:
        difference = ego - _ego_flow(pair, T_gt)
        error = np.linalg.norm(difference, axis=2)
        panels.append(Panel("error of the ego flow", error, "px"))
    return panels + _weight_panel(motion, moving)


def _image_panel(title: str, image: np.ndarray | None) -> list[Panel]:
    """The panel of an image, where there is one."""
    return [] if image is None else [Panel(title, image)]


def _depth_panel(pair: FramePair) -> Panel:
    """The panel of the previous frame's depth."""
    depth = np.asarray(pair.prev.depth)
    valid_depth = np.where(depth > 0, depth, np.nan)
    return Panel("depth", valid_depth, "m", high_value(valid_depth))


def _weight_panel(motion: RelativePose, moving: np.ndarray) -> list[Panel]:
    """The panel of the weights, where a method has some."""
    if motion.weights is None:
        return []
    title = "weights (outline: moving)" if moving.any() else "weights"
    return [Panel(title, motion.weights, "0 to 1", 1.0, moving)]


def _ego_flow(pair: FramePair, T_curr_prev: np.ndarray) -> np.ndarray:
    """Return the flow (H, W, 2), pixels, that a camera motion causes."""
    depth = np.asarray(pair.prev.depth)
    return ego_flow(depth, T_curr_prev, pair.prev.camera, pair.curr.camera)


# -- which pixels move by themselves -----------------------------------------------------


def moving_pixels(
    pair: FramePair,
    motion: RelativePose,
    T_gt: np.ndarray | None,
    flow_gt: np.ndarray | None,
) -> np.ndarray:
    """Find the regions that move by themselves.

    Where the true motion and the true flow are known, they decide. Else a region moves if its
    flow differs from the estimated ego flow beyond the noise of the flow, the estimate does not
    use it, and the images agree with the flow: in smooth regions flow is often wrong by pixels.

    Args:
        pair: The pair, with flow and the depth of its previous frame.
        motion: Its estimated motion.
        T_gt: The true T_curr_prev (4, 4), or None.
        flow_gt: The true flow (H, W, 2), pixels, or None.

    Returns:
        (H, W) bool.
    """
    if T_gt is not None and flow_gt is not None:
        own_flow = flow_gt - _ego_flow(pair, T_gt)
        return coherent(_longer(own_flow, MOVING_PX))
    ego = _ego_flow(pair, motion.T_curr_prev)
    own_flow = np.asarray(pair.flow) - ego
    limit: np.ndarray | float = MOVING_PX
    if pair.flow_variance is not None:
        noise = MOVING_FLOW_STDS * np.sqrt(pair.flow_variance)
        limit = np.maximum(MOVING_PX, noise)
    moving = _longer(own_flow, limit)
    if motion.weights is not None:
        height, width = moving.shape
        weights = cv2.resize(
            motion.weights, (width, height), interpolation=cv2.INTER_NEAREST
        )
        moving &= weights < UNUSED_WEIGHT
    return _confirmed_by_images(coherent(moving), pair, ego)


def _longer(flow: np.ndarray, limit: np.ndarray | float) -> np.ndarray:
    """Return where a flow (H, W, 2) is longer than a limit; unknown flow is not."""
    with np.errstate(invalid="ignore"):
        return np.linalg.norm(flow, axis=2) > limit


def _confirmed_by_images(
    regions: np.ndarray, pair: FramePair, ego: np.ndarray
) -> np.ndarray:
    """Keep the regions (H, W) bool whose image fits the flow clearly better than the ego flow."""
    if pair.prev.rgb is None or pair.curr.rgb is None:
        return regions
    prev = _smooth_grey(pair.prev.rgb)
    curr = _smooth_grey(pair.curr.rgb)
    by_flow = _warping_difference(prev, curr, np.asarray(pair.flow))
    by_ego_flow = _warping_difference(prev, curr, ego)
    count, labels = cv2.connectedComponents(regions.astype(np.uint8))
    kept = []
    for label in range(1, count):
        inside = labels == label
        gain = np.median(by_ego_flow[inside]) - np.median(by_flow[inside])
        if gain > MOVING_GREY_LEVELS:
            kept.append(label)
    return np.isin(labels, kept)


def _smooth_grey(rgb: np.ndarray) -> np.ndarray:
    """Return the grey values (H, W) float32 of an image, without its noise."""
    grey = cv2.cvtColor(rgb, cv2.COLOR_RGB2GRAY).astype(np.float32)
    return cv2.blur(grey, (MOVING_BLUR_PX, MOVING_BLUR_PX))


def _warping_difference(
    prev: np.ndarray, curr: np.ndarray, flow: np.ndarray
) -> np.ndarray:
    """Return the grey levels between an image and the next one, warped onto it by a flow."""
    v, u = np.indices(prev.shape, dtype=np.float32)
    known_flow = np.nan_to_num(flow.astype(np.float32), nan=OUTSIDE_PX)
    x = u + known_flow[..., 0]
    y = v + known_flow[..., 1]
    warped = cv2.remap(curr, x, y, cv2.INTER_LINEAR)
    return np.abs(warped - prev)


def coherent(mask: np.ndarray) -> np.ndarray:
    """Keep the regions of a mask that an object can fill: neither specks nor thin lines.

    Args:
        mask: (H, W) bool.

    Returns:
        (H, W) bool, without parts that are thinner than ``MIN_REGION_THICKNESS`` of the width,
        and without regions that are smaller than ``MIN_REGION_AREA`` of the image.
    """
    height, width = mask.shape
    radius = max(1, round(width * MIN_REGION_THICKNESS / 2))
    diameter = 2 * radius + 1
    disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (diameter, diameter))
    opened = cv2.morphologyEx(mask.astype(np.uint8), cv2.MORPH_OPEN, disc)
    _, labels, statistics, _ = cv2.connectedComponentsWithStats(opened)
    areas = statistics[:, cv2.CC_STAT_AREA]
    is_large = areas >= MIN_REGION_AREA * height * width
    is_large[0] = False  # label 0 is what is not in the mask
    return is_large[labels]


# -- what a network predicts -------------------------------------------------------------


def prediction_panels(
    prediction: PixelwisePrediction,
    true: TrueMotion | tuple[np.ndarray, np.ndarray] | None,
    moving: np.ndarray,
    known: np.ndarray | None = None,
) -> list[Panel]:
    """Make the paper's maps of the first pair of a batch: uncertainty and error.

    A map of the uncertainty is the geometric mean of U over three components, a map of the error
    the mean absolute error of three components.

    Args:
        prediction: What a network predicts.
        true: The true motion, if it is known.
        moving: (H, W) bool, what is outlined.
        known: (h, w) bool, the pixels that have an uncertainty; by default all.

    Returns:
        Two or four panels, those of the rotation first.
    """
    panels = []
    for k, (part, unit) in enumerate(zip(PARTS, UNITS, strict=True)):
        components = slice(3 * k, 3 * k + 3)
        if prediction.log_scale is not None:
            log_scale = prediction.log_scale[0, components].detach().float()
            uncertainty = log_scale.mean(0).exp().cpu().numpy()
            if known is not None:
                uncertainty = np.where(known, uncertainty, np.nan)
            # The scale is its own: the paper shows where uncertainty and error are large.
            title = f"PWVO: uncertainty of the {part}"
            panels.append(
                Panel(title, uncertainty, f"{unit}, U", outline=moving, log=True)
            )
        if true is not None:
            maps = prediction.motion[0, components].detach().cpu().double().numpy()
            expected = np.reshape(true[k], (3, 1, 1))
            error = np.abs(maps - expected).mean(axis=0)
            title = f"PWVO: error of the {part}"
            panels.append(Panel(title, error, unit, None, moving))
    return panels
