"""What the images and depth maps of a pair show of a motion: which points follow it, how exactly.

A point follows a motion where its grey value and its depth are as they would be. That is not enough
at video rate: things that move are then less than a pixel beside the scene, and of a motion between
both every point seems to follow it. What a point does not show a region does: the mean shift of its
points is known better than that of any one of them.
"""

from __future__ import annotations

from typing import NamedTuple

import cv2
import numpy as np

from hybridvo.core.geometry import projection_rows, transform_points
from hybridvo.core.results import RelativePose
from hybridvo.core.types import FramePair
from hybridvo.flow.frame_images import blurred, gradient_at
from hybridvo.solver.calibration import (
    FLAT_GRADIENT,
    MAX_REGION_SHIFT_PX,
    MIN_FOLLOWING,
    MIN_SEEN_OF_REGION,
    NOISE_GREY,
    NOISE_SHIFT_PX,
    REGION_CUTOFF,
    SHOWN_SHIFT,
)
from hybridvo.solver.correlated_errors import MAD_TO_STD
from hybridvo.solver.planes import PlaneFactor, PlanesAt
from hybridvo.solver.products import weighted_products
from hybridvo.solver.rows import PlaneRow

# Sides of the squares, in points of the grid, over which the change of light is averaged and over
# which a region is called explained or not.
LIGHT_SIDE = 3
REGION_SIDE = 5

# guards divisions where no point is inside the image
TINY = 1e-6


class PointResiduals(NamedTuple):
    """What the two images show of moved points (N,)."""

    inside: np.ndarray  # bool: visible inside the current image
    flow_px: np.ndarray  # how far the motion moves them in the image
    # grey levels between the two images, under the motion's gain
    difference: np.ndarray
    # the same, less the change of brightness around the point
    residual: np.ndarray
    gradient: np.ndarray  # (2, N) of the previous image, grey levels a pixel

    @property
    def squared_gradient(self) -> np.ndarray:
        """(N,) of the previous image, (grey levels a pixel)^2."""
        return np.asarray(np.sum(self.gradient**2, axis=0))

    @property
    def mean_flow_px(self) -> float:
        """Mean length of the ego flow inside the image."""
        return float(self.flow_px[self.inside].mean()) if self.inside.any() else 0.0


def compare_points(
    pair: FramePair,
    planes: PlaneFactor,
    at: PlanesAt,
    motion: RelativePose,
) -> PointResiduals:
    """Return the differences of the images at the points of the depth maps, at a motion.

    Args:
        pair: two frames with images.
        planes: the points.
        at: the depth maps at the motion.
        motion: with the gain of the images.
    """
    assert motion.photometric is not None
    height, width = pair.prev.camera.shape
    grey_prev = blurred(pair.prev)
    grey_curr = blurred(pair.curr)
    v, u = planes.index.T
    x = at.rows[PlaneRow.U]
    y = at.rows[PlaneRow.V]
    inside = (x >= 0) & (x <= width - 1) & (y >= 0) & (y <= height - 1)
    read = cv2.remap(grey_curr, x, y, cv2.INTER_CUBIC).reshape(-1)
    difference = read - motion.photometric.gain * grey_prev[v, u]
    # brightness may change over the image
    change = _around(planes, np.where(inside, difference, 0), LIGHT_SIDE)
    covered = _around(planes, inside, LIGHT_SIDE)
    return PointResiduals(
        inside=inside,
        flow_px=np.hypot(x - u, y - v),
        difference=difference,
        residual=difference - change / np.maximum(covered, TINY),
        gradient=gradient_at(grey_prev, v, u),
    )


def following(images: PointResiduals, at: PlanesAt, cutoff: float) -> np.ndarray:
    """Return (N,) whether the grey value and the depth of a point follow the motion.

    Args:
        images: at the motion.
        at: the depth maps at the motion.
        cutoff: of the robust kernel, standard deviations.
    """
    shift_variance = NOISE_SHIFT_PX**2 * images.squared_gradient
    limit2 = cutoff**2 * (NOISE_GREY**2 + shift_variance)
    residual = images.residual
    by_grey = limit2 / (limit2 + residual * residual)
    by_depth = np.where(at.surface_depth > 0, at.rows[PlaneRow.ROBUST], 1.0)
    return np.asarray(images.inside & (by_grey * by_depth > MIN_FOLLOWING))


def unexplained_texture(
    images: PointResiduals,
    follows: np.ndarray,
    planes: PlaneFactor,
    static: np.ndarray | float = 1.0,
) -> float:
    """Return the fraction of the texture in regions of which most does not follow the motion.

    Args:
        images: at the motion.
        follows: (N,) bool, see :func:`following`.
        planes: the points.
        static: (N,) probability of each point to be static, by which its texture counts.
    """
    gradient2 = images.squared_gradient
    texture = static * gradient2 / (gradient2 + FLAT_GRADIENT**2)
    texture = np.where(images.inside, texture, 0.0)
    not_following = _around(planes, texture * ~follows, REGION_SIDE)
    all_around = _around(planes, texture, REGION_SIDE)
    unexplained = not_following > 0.5 * all_around
    return float(texture[unexplained].sum() / np.maximum(texture.sum(), TINY))


def shift_of_regions(
    images: PointResiduals, planes: PlaneFactor, static: np.ndarray | float = 1.0
) -> float:
    """Return how far the regions of the image lie beside the motion, in standard errors.

    Each region is shifted so that the two images fit best there, whatever its brightness. Of a
    right motion most regions stay within what the noise of the images allows.

    Args:
        images: at the motion.
        planes: the points.
        static: (N,) probability of each point to be static, by which its texture counts.

    Returns:
        The median over the texture, per axis of the image; 0 where there is none.
    """
    inside = images.inside
    if not inside.any():
        return 0.0
    noise = MAD_TO_STD * float(np.median(np.abs(images.difference[inside])))
    noise = max(noise, NOISE_GREY)
    weights = inside / (1 + (images.difference / (REGION_CUTOFF * noise)) ** 2)
    pixels = [*images.gradient, images.difference]
    counted = _summed(planes, weights)
    means = [_summed(planes, weights * each) for each in pixels]
    seen = np.maximum(counted, TINY)

    def product(i: int, j: int) -> np.ndarray:
        """Sums over regions of two of x and y gradient and difference, less their means."""
        both = _summed(planes, weights * pixels[i] * pixels[j])
        return both - means[i] * means[j] / seen

    # of a shift that is 0 by what is known without the region
    prior = (noise / MAX_REGION_SHIFT_PX) ** 2
    xx = product(0, 0)
    yy = product(1, 1)
    xy = product(0, 1)
    bx = product(0, 2)
    by = product(1, 2)
    determinant = (xx + prior) * (yy + prior) - xy * xy
    adjugate = (yy + prior) * bx * bx - 2 * xy * bx * by + (xx + prior) * by * by
    # by how much the best shift lowers the squared differences: its own square in standard
    # errors, times that of the noise
    lowered = np.maximum(adjugate, 0) / np.maximum(determinant, TINY)
    shift = np.sqrt(lowered / 2) / noise
    is_seen = counted > MIN_SEEN_OF_REGION * REGION_SIDE**2
    texture = (xx + yy) / (xx + yy + SHOWN_SHIFT * prior)
    return weighted_median(shift, static * inside * is_seen * texture)


def weighted_median(values: np.ndarray, weights: np.ndarray) -> float:
    """Return the value (N,) below which half of the weight (N,) lies; 0 where there is none.

    >>> weighted_median(np.array([3.0, 1.0, 2.0]), np.array([1.0, 1.0, 5.0]))
    2.0
    """
    order = np.argsort(values)
    below = np.cumsum(weights[order])
    if not len(below) or below[-1] <= 0:
        return 0.0
    middle = np.searchsorted(below, below[-1] / 2)
    return float(values[order[middle]])


def _summed(planes: PlaneFactor, values: np.ndarray) -> np.ndarray:
    """(N,) sums of values (N,) of the points over the region around each."""
    return REGION_SIDE**2 * _around(planes, values, REGION_SIDE)


def ego_flow_std(
    pair: FramePair, points: np.ndarray, motion: RelativePose
) -> float:
    """Return the standard deviation of the ego flow of points (N, 3), px, by a covariance."""
    moved = transform_points(motion.T_curr_prev, points)
    J = np.concatenate(projection_rows(moved, pair.curr.camera))
    rows = np.ascontiguousarray(J.T, np.float32)
    products = weighted_products(rows, np.ones(len(J), np.float32))
    squared = np.sum(products * motion.covariance) / max(len(moved), 1)
    return float(np.sqrt(squared))


def _around(planes: PlaneFactor, values: np.ndarray, side: int) -> np.ndarray:
    """(N,) averages of values (N,) of the points over a square around each."""
    averaged = cv2.blur(planes.on_grid(values), (side, side))
    return np.asarray(averaged[planes.cells])
