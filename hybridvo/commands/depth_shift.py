"""Where the depth map stands against its image, from the images at depth edges."""

from __future__ import annotations

import cv2
import numpy as np

from hybridvo.results import RelativePose
from hybridvo.types import FramePair

REACH_PX = 4
"""Largest shift of the depth map that is tried."""
MIN_PIXELS, MAX_PIXELS = 100, 3000
"""Pixels at depth edges that a pair needs, and that are looked at."""


def shift_costs(pair: FramePair, motion: RelativePose) -> np.ndarray | None:
    """(9, 9) image cost of the pixels at depth edges under shifts of the previous depth map.

    A depth map that is shifted against its image gives pixels at the edges of near things the depth
    of what lies beside them, which the motion moves to the wrong place.

    Args:
        pair: both frames with images, the previous one with depth.
        motion: of the pair, with weights of the full image.

    Returns:
        Mean robust cost, 0 to 1 a pixel, for shifts of -4 to 4 px down (rows) and right (columns);
        None where there are too few edges.
    """
    prev, curr, weights = pair.prev, pair.curr, motion.weights
    if weights is None or weights.shape != prev.camera.shape or prev.depth is None:
        return None
    first, second = (
        cv2.GaussianBlur(cv2.cvtColor(f.rgb, cv2.COLOR_RGB2GRAY), (0, 0), 1.0).astype(np.float32)
        for f in (prev, curr)
        if f.rgb is not None
    )
    rows, columns = _edge_pixels(first, prev.depth, weights)
    if len(rows) < MIN_PIXELS:
        return None
    R, t = motion.T_curr_prev[:3, :3], motion.T_curr_prev[:3, 3]
    rays = np.stack([columns, rows, np.ones_like(rows)], axis=1) @ np.linalg.inv(prev.camera.K).T

    def difference(down: int, right: int) -> np.ndarray:
        z = prev.depth[rows + down, columns + right]  # type: ignore[index]
        points = (z[:, None] * rays @ R.T + t) @ curr.camera.K.T
        place = (points[:, :2] / np.maximum(points[:, 2:], 1e-6)).astype(np.float32)
        there = cv2.remap(second, place[:, :1], place[:, 1:], cv2.INTER_LINEAR)[:, 0]
        return there - first[rows, columns]

    shifts = range(-REACH_PX, REACH_PX + 1)
    residuals = np.array([[difference(down, right) for right in shifts] for down in shifts])
    residuals -= np.median(residuals, axis=2, keepdims=True)  # a change of brightness
    scale = max(1.4826 * float(np.median(np.abs(residuals))), 1.0)
    return (residuals**2 / (residuals**2 + scale**2)).mean(axis=2)


def _edge_pixels(
    grey: np.ndarray, depth: np.ndarray, weights: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Rows and columns of textured static pixels near edges of 5 % in depth."""
    valid = np.isfinite(depth) & (depth > 0)
    log = np.log(np.where(valid, depth, 1.0)).astype(np.float32)
    reach = np.ones((2 * REACH_PX + 1,) * 2, np.uint8)
    usable = cv2.dilate(log, reach) - cv2.erode(log, reach) > 0.05
    usable &= cv2.erode(valid.astype(np.uint8), reach) > 0
    usable &= cv2.blur(weights.astype(np.float32), (15, 15)) > 0.5
    inside = np.zeros_like(usable)
    inside[REACH_PX + 1 : -REACH_PX - 1, REACH_PX + 1 : -REACH_PX - 1] = True
    gradient = cv2.magnitude(cv2.Sobel(grey, cv2.CV_32F, 1, 0), cv2.Sobel(grey, cv2.CV_32F, 0, 1))
    rows, columns = np.nonzero(usable & inside)
    if len(rows):
        strong = gradient[rows, columns] > max(float(np.median(gradient[rows, columns])), 16.0)
        rows, columns = rows[strong], columns[strong]
    step = max(1, len(rows) // MAX_PIXELS)
    return rows[::step], columns[::step]


def minimum(cost: np.ndarray) -> np.ndarray:
    """(right, down) px of the minimum of a cost over shifts, between the pixels by parabolas.

    The depth of a pixel is found at x + shift: so far it stands from its image.
    """
    row, column = np.unravel_index(np.argmin(cost), cost.shape)

    def vertex(values: np.ndarray, k: int) -> float:
        if not 0 < k < len(values) - 1:
            return k - REACH_PX
        before, here, after = values[k - 1 : k + 2]
        bend = before - 2 * here + after
        offset = np.clip(0.5 * (before - after) / bend, -0.5, 0.5) if bend > 0 else 0.0
        return k + float(offset) - REACH_PX

    return np.array([vertex(cost[row], int(column)), vertex(cost[:, column], int(row))])
