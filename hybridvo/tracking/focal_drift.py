"""Whether the focal length is wrong, by what the images show beside the motion.

A wrong focal length bends the flow of a turning camera: towards the border it is longer or
shorter than any rotation and translation of the scene. In one pair this is below the errors of
the images. The residuals of some tens of pairs, of each one number along that bend, add up.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import NamedTuple

import cv2
import numpy as np

from hybridvo.core.geometry import (
    backproject,
    mean_flow,
    project,
    projection_rows,
    transform_points,
)
from hybridvo.core.options import RefineOptions
from hybridvo.core.results import RelativePose
from hybridvo.core.types import Camera, Frame
from hybridvo.flow.frame_images import blurred
from hybridvo.solver.correlated_errors import robust_std
from hybridvo.solver.images import choose_pixels
from hybridvo.tracking.calibration import (
    FOCAL_SIGMAS,
    MAX_FOCAL_ERROR,
    MIN_FOCAL_INFORMATION,
    MIN_FOCAL_STEPS,
)

# cells of the image, of which each gives one pixel or none; with fewer there is no answer
PIXELS = 1000
MIN_PIXELS = 100
# step of the derivative in the log focal length
STEP = 1e-3
# times that outliers are weighed anew
ROUNDS = 3
# pixels at the image's border whose gradient is not known
BORDER = 2
# of the residual, grey levels
MIN_NOISE = 0.2


class Bend(NamedTuple):
    """What a pair of images shows of the focal length."""

    error: float  # log of the right focal length over the given one
    information: float  # 1 / variance, as if all pixels erred on their own


@dataclass(frozen=True)
class FocalDrift:
    """What the motions so far show of the focal length.

    Attributes:
        steps: motions so far.
        information: sum of their informations.
        weighted: sum of information times error.
        squares: (3,) sums of the squared information times error to the power 0, 1, 2.

    Example:
        >>> FocalDrift().is_off
        False
    """

    steps: int = 0
    information: float = 0.0
    weighted: float = 0.0
    squares: tuple[float, ...] = (0.0, 0.0, 0.0)

    def observed(
        self, prev: Frame, curr: Frame, motion: RelativePose
    ) -> FocalDrift:
        """Return what is known after one more motion; one that is not ok counts for nothing."""
        bend = bend_of(prev, curr, motion) if motion.ok else None
        return self if bend is None else self.with_bend(bend)

    def with_bend(self, bend: Bend) -> FocalDrift:
        """Return what is known after one more pair."""
        error, information = bend
        squared = information**2
        added = (squared, squared * error, squared * error**2)
        return replace(
            self,
            steps=self.steps + 1,
            information=self.information + information,
            weighted=self.weighted + information * error,
            squares=tuple(a + b for a, b in zip(self.squares, added, strict=True)),
        )

    @property
    def error(self) -> float:
        """Log of the right focal length over the given one; 0 before the first motion."""
        return self.weighted / self.information if self.information else 0.0

    @property
    def std(self) -> float:
        """Standard deviation of the error, by how much the motions differ."""
        if not self.information:
            return np.inf
        constant, linear, square = self.squares
        mean = self.error
        scatter = square - 2 * mean * linear + mean**2 * constant
        return float(np.sqrt(max(scatter, 0.0)) / self.information)

    @property
    def factor(self) -> float:
        """The right focal length over the given one."""
        return float(np.exp(self.error))

    @property
    def is_known(self) -> bool:
        """Whether the motions so far show the focal length at all."""
        is_enough = self.steps >= MIN_FOCAL_STEPS
        return is_enough and self.information >= MIN_FOCAL_INFORMATION

    @property
    def is_off(self) -> bool:
        """Whether the focal length is wrong, as far as can be known."""
        if not self.is_known:
            return False
        surplus = abs(self.error) - MAX_FOCAL_ERROR
        return surplus > FOCAL_SIGMAS * self.std

    @property
    def message(self) -> str:
        """What is wrong, and what to do."""
        return (
            f"the images of {self.steps} motions fit a focal length of {self.factor:.2f} "
            f"+- {self.factor * self.std:.2f} times the given one: calibrate the camera, or "
            f"see that its intrinsics are those of images of this size"
        )


def bend_of(prev: Frame, curr: Frame, motion: RelativePose) -> Bend | None:
    """Return what two images show of the focal length, along a motion.

    Args:
        prev: the frame that the motion starts from.
        curr: the current one.
        motion: with the weights of its pixels.

    Returns:
        The error in the log focal length of both frames, whatever motion, shift of the
        disparity, gain and offset fit best beside it; None where the images do not show it.
    """
    if prev.rgb is None or curr.rgb is None or prev.depth is None:
        return None
    if motion.weights is None or not _turns(prev, motion):
        return None
    before = blurred(prev)
    now = blurred(curr)
    index = choose_pixels(before, prev.depth, motion.weights, PIXELS)
    points = _moved(prev, motion, index, prev.camera)
    places = project(points, curr.camera)
    longer = project(
        _moved(prev, motion, index, _scaled(prev.camera)), _scaled(curr.camera)
    )
    by_focal = (longer - places) / STEP
    # a depth sensor that errs in its disparity bends the flow of a translation
    nearer = replace(prev, depth=prev.depth / (1 + STEP * prev.depth))
    shifted = project(_moved(nearer, motion, index, prev.camera), curr.camera)
    by_disparity = (shifted - places) / STEP
    height, width = curr.camera.shape
    low = BORDER
    x = places[:, 0]
    y = places[:, 1]
    inside = (x > low) & (y > low) & (x < width - 1 - low) & (y < height - 1 - low)
    inside &= np.isfinite(by_focal).all(axis=1)
    if np.count_nonzero(inside) < MIN_PIXELS:
        return None
    index = index[inside]
    u = places[inside, :1].astype(np.float32)
    v = places[inside, 1:].astype(np.float32)

    def read(right: int, down: int) -> np.ndarray:
        moved = cv2.remap(now, u + right, v + down, cv2.INTER_LINEAR)
        return moved[:, 0].astype(np.float64)

    across = (read(1, 0) - read(-1, 0))[:, None] / 2
    along = (read(0, 1) - read(0, -1))[:, None] / 2
    du, dv = projection_rows(points[inside], curr.camera)
    grey = before[index[:, 0], index[:, 1]].astype(np.float64)
    bend = across * by_focal[inside, :1] + along * by_focal[inside, 1:]
    by_shift = across * by_disparity[inside, :1] + along * by_disparity[inside, 1:]
    others = [across * du + along * dv, by_shift, grey[:, None], np.ones_like(bend)]
    return _fitted(np.hstack([bend, *others]), grey - read(0, 0))


def _turns(prev: Frame, motion: RelativePose) -> bool:
    """Whether a motion turns the view as much as it shifts it.

    What bends the flow of a translation is the error of the depth as well.
    """
    turn = np.array(motion.T_curr_prev)
    turn[:3, 3] = 0.0
    shift = np.eye(4)
    shift[:3, 3] = motion.T_curr_prev[:3, 3]
    return mean_flow(prev, turn) >= mean_flow(prev, shift)


def _scaled(camera: Camera) -> Camera:
    """A camera whose focal length is longer by a step."""
    return replace(camera, fx=camera.fx * (1 + STEP), fy=camera.fy * (1 + STEP))


def _moved(
    prev: Frame, motion: RelativePose, index: np.ndarray, camera: Camera
) -> np.ndarray:
    """(N, 3) the points of some pixels after a motion, in the view of a camera."""
    assert prev.depth is not None
    return transform_points(
        motion.T_curr_prev, backproject(prev.depth, camera, index)
    )


def _fitted(columns: np.ndarray, values: np.ndarray) -> Bend | None:
    """Fit the columns (N, 10) to values (N,), robustly; the first is that of the bend."""
    found = np.zeros(columns.shape[1])
    for _ in range(ROUNDS):
        residual = values - columns @ found
        noise = max(robust_std(np.abs(residual)), MIN_NOISE)
        weight = 1 / (1 + (residual / (RefineOptions.cutoff * noise)) ** 2)
        products = (columns * weight[:, None]).T @ columns
        found = np.linalg.lstsq(
            products, (columns * weight[:, None]).T @ values, rcond=None
        )[0]
    own = products[0, 0]
    mixed = products[0, 1:]
    shared = mixed @ np.linalg.lstsq(products[1:, 1:], mixed, rcond=None)[0]
    information = (own - shared) / noise**2
    if not (np.isfinite(found[0]) and information > 0):
        return None
    return Bend(float(found[0]), float(information))
