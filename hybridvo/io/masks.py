"""Which pixels of a frame stand still, by the weights of a motion."""

from __future__ import annotations

import cv2
import numpy as np

from hybridvo.core.geometry import valid_depth
from hybridvo.core.types import Frame

MIN_SUPPORT = 0.2
"""Mean weight of the pixels around one, below which it moves."""
WINDOW = 1 / 32
"""Side of the square of these pixels, as a fraction of the image's width."""


def mask_of(frame: Frame, weights: np.ndarray | None) -> np.ndarray:
    """Return which pixels of a frame stand still, as far as is known.

    A pixel moves where the weights around it are small: single ones are small by noise. Where
    there is no depth, nothing is known, and the pixel is kept.

    Args:
        frame: The frame, whose own mask counts as well.
        weights: (H, W) from 0 to 1, of the motion that starts at it; None where there is none.

    Returns:
        (H, W) bool, False where a pixel is to be ignored.
    """
    mask = np.full(frame.camera.shape, True)
    if frame.mask is not None:
        mask &= frame.mask
    depth = frame.depth
    if weights is None or depth is None or weights.shape != depth.shape:
        return mask
    is_known = valid_depth(depth)
    side = 2 * int(WINDOW * depth.shape[1] / 2) + 1
    support = _mean(np.where(is_known, weights, 0), side)
    known = _mean(is_known, side)
    moves = is_known & (support < MIN_SUPPORT * known)
    return mask & ~moves


def _mean(values: np.ndarray, side: int) -> np.ndarray:
    """The mean (H, W) in the square around each pixel."""
    return cv2.boxFilter(values.astype(np.float32), -1, (side, side))
