"""Reduced images of a pair that are followed coarse to fine."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import cv2
import numpy as np

from hybridvo.core.options import RefineOptions
from hybridvo.core.results import MotionPrior
from hybridvo.core.types import FramePair
from hybridvo.core.unchecked import changed
from hybridvo.flow.frame_images import blurred, reduced
from hybridvo.solver.image_factor import ImageFactor
from hybridvo.solver.images import choose_pixels
from hybridvo.solver.newton import Factor, Linearization, positive_inverse
from hybridvo.solver.planes import WeightedPlanes
from hybridvo.solver.prior import Prior

# reductions of the images, coarse to fine, and the smallest side of a reduced
# image, px
REDUCTIONS = (8, 4, 2)
MIN_SIDE = 24
# of them, for a motion that need not be exact
ROUGH_REDUCTIONS = (8, 4)
# of them, from such a motion on: without 4 more pairs need flow (D435)
NEAR_REDUCTIONS = (4, 2)
# on reduced images: pixels at most, and Newton steps
REDUCED_PIXELS = 2500
REDUCED_STEPS = 5


def follow_images(
    pair: FramePair,
    T: np.ndarray,
    weights: np.ndarray,
    planes: WeightedPlanes | None,
    options: RefineOptions,
    is_near: bool = False,
) -> tuple[np.ndarray, float]:
    """Follow reduced images, coarse to fine, and depth maps from a motion (4, 4).

    Args:
        pair: two frames with images and the depth of the first.
        T: T_curr_prev to start from.
        weights: (H, W) of the pixels.
        planes: the depth maps; None: they are not used.
        options: cutoff of the robust kernel, and number of tiles.
        is_near: whether the motion is that of :func:`follow_roughly`.

    Returns:
        The motion, and the gain between the two images.
    """

    def beside(T: np.ndarray) -> list[Factor[Linearization]]:
        return [] if planes is None else [planes.under(planes.at(T))]

    reductions = NEAR_REDUCTIONS if is_near else REDUCTIONS
    return _followed(pair, T, weights, reductions, beside, options)


def follow_roughly(
    pair: FramePair, expected: MotionPrior, options: RefineOptions
) -> np.ndarray:
    """Follow the most reduced images from an expected motion, which takes part.

    Args:
        pair: two frames; their flow is not used.
        expected: the motion with its covariance.
        options: cutoff of the robust kernel, and number of tiles.

    Returns:
        (4, 4) T_curr_prev; the expected one where an image, or the depth of the first, is missing.
    """
    T = expected.T_curr_prev
    prev = pair.prev
    curr = pair.curr
    information = positive_inverse(expected.covariance)
    if not prev.is_rgbd or curr.rgb is None or information is None:
        return T
    prior = Prior.around(T, information)
    everywhere = np.ones(prev.camera.shape, np.float32)

    def beside(_: np.ndarray) -> list[Factor[Linearization]]:
        return [prior]

    return _followed(pair, T, everywhere, ROUGH_REDUCTIONS, beside, options)[0]


def _followed(
    pair: FramePair,
    T: np.ndarray,
    weights: np.ndarray,
    reductions: Sequence[int],
    beside: Callable[[np.ndarray], list[Factor[Linearization]]],
    options: RefineOptions,
) -> tuple[np.ndarray, float]:
    """The motion, and the gain, by reduced images and by the factors beside them at a motion."""
    gain = 1.0
    for factor in reductions:
        if min(pair.prev.camera.shape) < factor * MIN_SIDE:
            continue
        images = _reduced_images(pair, weights, factor, options)
        if images is None:
            continue
        T, gain_offset = images.follow(images.first(T), beside(T), T, REDUCED_STEPS)
        gain = float(gain_offset[0])
    return T, gain


def _reduced_images(
    pair: FramePair,
    weights: np.ndarray,
    factor: int,
    options: RefineOptions,
) -> ImageFactor | None:
    """The images at 1 / ``factor`` of their size; None where they have no texture."""
    prev = reduced(pair.prev, factor)
    curr = reduced(pair.curr, factor)
    height, width = prev.camera.shape
    small_weights = cv2.resize(
        weights, (width, height), interpolation=cv2.INTER_AREA
    )
    count = min(REDUCED_PIXELS, height * width // 4)
    depth = np.asarray(prev.depth)
    index = choose_pixels(blurred(prev), depth, small_weights, count)
    if not len(index):
        return None
    small = changed(pair, prev=prev, curr=curr, flow=None)
    return ImageFactor(small, small_weights, index, options)
