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
from hybridvo.core.results import Motion
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
from hybridvo.solver.plane_kernels import PlanesAt
from hybridvo.solver.planes import WeightedPlanes
from hybridvo.solver.products import weighted_products
from hybridvo.solver.rows import PlaneRow

# Sides of the squares, in points of the grid, over which the change of light is averaged and over
# which a region is called explained or not.
LIGHT_SIDE = 3
REGION_SIDE = 5

# guards divisions where no point is inside the image
TINY = 1e-6

# What is added to the standard deviation of the ego flow and to its length, fractions of the
# image's width, to a shift of regions, standard errors, and to a fraction of the texture, before
# a logarithm is taken.
LEAST_STD = 1e-5
LEAST_FLOW = 0.0125
LEAST_REGION_SHIFT = 0.3
LEAST_UNEXPLAINED = 0.01


class DirectEvidence(NamedTuple):
    """What speaks for a motion that was found without flow.

    Attributes:
        log_std: log of the standard deviation of the ego flow, fraction of the image's width.
        log_flow: log of the mean length of the ego flow, fraction of the image's width.
        log_region_shift: log of the shift of the image's regions beside the motion, in standard
            errors.
        log_unexplained: log of the fraction of the texture in regions that it leaves unexplained.
    """

    log_std: float
    log_flow: float
    log_region_shift: float
    log_unexplained: float


class RememberedEvidence(NamedTuple):
    """The same of what is believed static alone.

    Attributes:
        log_std: see :class:`DirectEvidence`.
        log_flow: likewise.
        log_region_shift: likewise.
        log_unexplained: likewise.
        certainty: log odds that the belief is right.
    """

    log_std: float
    log_flow: float
    log_region_shift: float
    log_unexplained: float
    certainty: float


def direct_evidence(
    std: float, flow: float, region_shift: float, unexplained: float
) -> DirectEvidence:
    """Collect the evidence on a motion that was found without flow.

    Args:
        std: standard deviation of the ego flow, fraction of the image's width.
        flow: mean length of the ego flow, fraction of the image's width.
        region_shift: shift of the image's regions beside the motion, in standard errors.
        unexplained: fraction of the texture in regions that it leaves unexplained.
    """
    return DirectEvidence(
        log_std=float(np.log(std + LEAST_STD)),
        log_flow=float(np.log(flow + LEAST_FLOW)),
        log_region_shift=float(np.log(region_shift + LEAST_REGION_SHIFT)),
        log_unexplained=float(np.log(unexplained + LEAST_UNEXPLAINED)),
    )


class SeenPoints(NamedTuple):
    """What the two images show of the points (N,) of the depth maps, moved along a motion."""

    planes: WeightedPlanes
    follows: np.ndarray  # bool: whether grey value and depth are as they would be
    inside: np.ndarray  # bool: visible inside the current image
    flow_px: np.ndarray  # how far the motion moves them in the image
    # grey levels between the two images, under the motion's gain
    difference: np.ndarray
    gradient: np.ndarray  # (2, N) of the previous image, grey levels a pixel
    width: int  # of the image, px
    is_exact: bool  # whether the motion counts as exact

    @property
    def squared_gradient(self) -> np.ndarray:
        """(N,) of the previous image, (grey levels a pixel)^2."""
        return np.asarray(np.sum(self.gradient**2, axis=0))

    @property
    def mean_flow_px(self) -> float:
        """Mean length of the ego flow inside the image."""
        return float(self.flow_px[self.inside].mean()) if self.inside.any() else 0.0

    def evidence(
        self, std_px: float, static: np.ndarray | float = 1.0
    ) -> DirectEvidence:
        """What speaks for the motion.

        Args:
            std_px: standard deviation of the ego flow, px.
            static: (N,) probability of each point to be static, by which it counts.
        """
        shift = 0.0 if self.is_exact else self.shift_of_regions(static)
        unexplained = self.unexplained_texture(static)
        return direct_evidence(
            std_px / self.width, self.mean_flow_px / self.width, shift, unexplained
        )

    def unexplained_texture(self, static: np.ndarray | float = 1.0) -> float:
        """Return the fraction of the texture in regions of which most does not follow the motion.

        Args:
            static: (N,) probability of each point to be static, by which its texture counts.
        """
        gradient2 = self.squared_gradient
        texture = static * gradient2 / (gradient2 + FLAT_GRADIENT**2)
        texture = np.where(self.inside, texture, 0.0)
        not_following = _around(self.planes, texture * ~self.follows, REGION_SIDE)
        all_around = _around(self.planes, texture, REGION_SIDE)
        unexplained = not_following > 0.5 * all_around
        return float(texture[unexplained].sum() / np.maximum(texture.sum(), TINY))

    def shift_of_regions(self, static: np.ndarray | float = 1.0) -> float:
        """Return how far the regions of the image lie beside the motion, in standard errors.

        Each region is shifted so that the two images fit best there, whatever its brightness. Of
        a right motion most regions stay within what the noise of the images allows.

        Args:
            static: (N,) probability of each point to be static, by which its texture counts.

        Returns:
            The median over the texture, per axis of the image; 0 where there is none.
        """
        inside = self.inside
        if not inside.any():
            return 0.0
        noise = MAD_TO_STD * float(np.median(np.abs(self.difference[inside])))
        noise = max(noise, NOISE_GREY)
        weights = inside / (1 + (self.difference / (REGION_CUTOFF * noise)) ** 2)
        pixels = [*self.gradient, self.difference]
        counted = _summed(self.planes, weights)
        means = [_summed(self.planes, weights * each) for each in pixels]
        seen = np.maximum(counted, TINY)

        def product(i: int, j: int) -> np.ndarray:
            """Sums over regions of two of x and y gradient and difference, less their means."""
            both = _summed(self.planes, weights * pixels[i] * pixels[j])
            return both - means[i] * means[j] / seen

        # of a shift that is 0 by what is known without the region
        prior = (noise / MAX_REGION_SHIFT_PX) ** 2
        xx = product(0, 0)
        yy = product(1, 1)
        xy = product(0, 1)
        bx = product(0, 2)
        by = product(1, 2)
        determinant = (xx + prior) * (yy + prior) - xy * xy
        adjugate = (
            (yy + prior) * bx * bx - 2 * xy * bx * by + (xx + prior) * by * by
        )
        # by how much the best shift lowers the squared differences: its own square in standard
        # errors, times that of the noise
        lowered = np.maximum(adjugate, 0) / np.maximum(determinant, TINY)
        shift = np.sqrt(lowered / 2) / noise
        is_seen = counted > MIN_SEEN_OF_REGION * REGION_SIDE**2
        texture = (xx + yy) / (xx + yy + SHOWN_SHIFT * prior)
        return weighted_median(shift, static * inside * is_seen * texture)


def see_points(
    pair: FramePair,
    planes: WeightedPlanes,
    at: PlanesAt,
    motion: Motion,
    cutoff: float,
    is_exact: bool = False,
) -> SeenPoints:
    """Return what the images show of the points of the depth maps, at a motion.

    A point follows it where its grey value and its depth are as they would be.

    Args:
        pair: two frames with images.
        planes: the points.
        at: the depth maps at the motion.
        motion: with the gain of the images.
        cutoff: of the robust kernel, standard deviations.
        is_exact: whether the motion counts as exact.
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
    residual = difference - change / np.maximum(covered, TINY)
    gradient = gradient_at(grey_prev, v, u)
    shift_variance = NOISE_SHIFT_PX**2 * np.sum(gradient**2, axis=0)
    limit2 = cutoff**2 * (NOISE_GREY**2 + shift_variance)
    by_grey = limit2 / (limit2 + residual * residual)
    by_depth = np.where(at.surface_depth > 0, at.rows[PlaneRow.ROBUST], 1.0)
    return SeenPoints(
        planes=planes,
        follows=np.asarray(inside & (by_grey * by_depth > MIN_FOLLOWING)),
        inside=inside,
        flow_px=np.hypot(x - u, y - v),
        difference=difference,
        gradient=gradient,
        width=width,
        is_exact=is_exact,
    )


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


def _summed(planes: WeightedPlanes, values: np.ndarray) -> np.ndarray:
    """(N,) sums of values (N,) of the points over the region around each."""
    return REGION_SIDE**2 * _around(planes, values, REGION_SIDE)


def ego_flow_std(pair: FramePair, points: np.ndarray, motion: Motion) -> float:
    """Return the standard deviation of the ego flow of points (N, 3), px, by a covariance."""
    moved = transform_points(motion.T_curr_prev, points)
    J = np.concatenate(projection_rows(moved, pair.curr.camera))
    rows = np.ascontiguousarray(J.T, np.float32)
    products = weighted_products(rows, np.ones(len(J), np.float32))
    squared = np.sum(products * motion.covariance) / max(len(moved), 1)
    return float(np.sqrt(squared))


def _around(planes: WeightedPlanes, values: np.ndarray, side: int) -> np.ndarray:
    """(N,) averages of values (N,) of the points over a square around each."""
    averaged = cv2.blur(planes.on_grid(values), (side, side))
    return np.asarray(averaged[planes.cells])
