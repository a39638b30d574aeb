"""Whether focal length and readout of a camera are wrong, by what images show beside the motion.

A wrong focal length bends the flow of a turning camera: towards the border it is longer or
shorter than any rotation and translation of the scene. A rolling shutter lengthens flow that goes
down the image, whose pixels took longer, and shortens flow that goes up. In one pair both are
below the errors of the images. The residuals of some tens of pairs add up: of each one number
along each of the two bends.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple, Self

import cv2
import numpy as np

from hybridvo.core.geometry import (
    backproject,
    mean_flow,
    project,
    projection_rows,
    rotation_angle,
    transform_points,
)
from hybridvo.core.options import RefineOptions
from hybridvo.core.results import RelativePose
from hybridvo.core.types import Camera, Frame, FramePair
from hybridvo.evidence.one_time import moved_on, pair_at_image_times
from hybridvo.flow.frame_images import blurred
from hybridvo.solver.correlated_errors import robust_std
from hybridvo.solver.images import choose_pixels
from hybridvo.tracking.calibration import (
    MAX_FOCAL_ERROR,
    MIN_FOCAL_INFORMATION,
    MIN_TURN_PX,
)

# Motions before which nothing is stated of the focal length or of the readout.
MIN_CAMERA_STEPS = 30
# Standard deviations by which a readout must differ from 0 before it is used, and a focal length
# from what is allowed before it is off.
CAMERA_SIGMAS = 3.0
# Time between two frames, ms, up to which a hand turns a camera evenly.
MAX_EVEN_MS = 100.0
# Standard deviations from which a pair counts less in the mean of what pairs show of lag or
# readout.
BEND_CUTOFF = 2.0

# cells of the image, of which each gives one pixel or none; with fewer there is no answer
PIXELS = 1000
MIN_PIXELS = 100
# step of the derivative in the log focal length
STEP = 1e-3
# times that outliers are weighed anew
ROUNDS = 3
# the same for the mean of what pairs show
MEAN_ROUNDS = 10
# pixels at the image's border whose gradient is not known
BORDER = 2
# of the residual, grey levels
MIN_NOISE = 0.2
# which of the fitted numbers is which
FOCAL = 0
READOUT = 1
# information of what a pair does not show
TINY = 1e-12


class Bend(NamedTuple):
    """What a pair of images shows of one number of the camera."""

    error: float  # by how much the number that fits differs from the given one
    information: float  # 1 / variance, as if all pixels erred on their own


class Bends(NamedTuple):
    """What a pair of images shows of the camera."""

    focal: Bend  # log of the right focal length over the given one
    # readout of the rows, ms; None where the time between the frames is unknown or too long
    readout: Bend | None


class Mean(NamedTuple):
    """What some pairs show together."""

    error: float
    std: float  # by how much they differ
    pairs: int


def robust_mean(shown: Sequence[Bend]) -> Mean:
    """Return the mean of what some pairs show, in which those far from it count less.

    Example:
        >>> mean = robust_mean([Bend(12.0, 1.0), Bend(13.0, 1.0), Bend(11.0, 1.0)])
        >>> round(mean.error, 6), mean.pairs
        (12.0, 3)
    """
    errors = np.array([bend.error for bend in shown])
    information = np.array([bend.information for bend in shown])
    weight = information
    mean = float(np.average(errors, weights=weight))
    for _ in range(MEAN_ROUNDS):
        distance = (errors - mean) * np.sqrt(information)
        scale = max(BEND_CUTOFF * robust_std(np.abs(distance)), TINY)
        weight = information / (1 + (distance / scale) ** 2)
        mean = float(np.average(errors, weights=weight))
    variance = np.sum((weight * (errors - mean)) ** 2) / np.sum(weight) ** 2
    return Mean(mean, float(np.sqrt(variance)), len(shown))


@dataclass(frozen=True)
class FocalDrift:
    """What the motions so far show of the focal length: the log of its error.

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

    def with_bend(self, bend: Bend) -> Self:
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
        """The mean of the errors; 0 before the first motion."""
        return self.weighted / self.information if self.information else 0.0

    @property
    def std(self) -> float:
        """Standard deviation of the mean, by how much the motions differ."""
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
        is_enough = self.steps >= MIN_CAMERA_STEPS
        return is_enough and self.information >= MIN_FOCAL_INFORMATION

    @property
    def is_off(self) -> bool:
        """Whether the focal length is wrong, as far as can be known."""
        if not self.is_known:
            return False
        surplus = abs(self.error) - MAX_FOCAL_ERROR
        return surplus > CAMERA_SIGMAS * self.std

    @property
    def message(self) -> str:
        """What is wrong, and what to do."""
        return (
            f"the images of {self.steps} motions fit a focal length of {self.factor:.2f} "
            f"+- {self.factor * self.std:.2f} times the given one: calibrate the camera, or "
            f"see that its intrinsics are those of images of this size"
        )


def bends_of(
    prev: Frame,
    curr: Frame,
    motion: RelativePose,
    velocities: tuple[np.ndarray, np.ndarray] | None = None,
) -> Bends | None:
    """Return what two images show of focal length and readout, along a motion.

    Args:
        prev: the frame that the motion starts from.
        curr: the current one.
        motion: with the weights of its pixels.
        velocities: (6,) of the camera at both frames, as of
            :func:`hybridvo.evidence.one_time.at_image_time`; None: it moves evenly. A hand does
            not, and what its velocity changes by bends the flow more than the velocity itself.

    Returns:
        The error in the log focal length of both frames, and the readout, whatever motion, shift
        of the disparity, gain and offset fit best beside them; None where the images do not show
        them.
    """
    if prev.rgb is None or curr.rgb is None or prev.depth is None:
        return None
    if motion.weights is None or not _turns(prev, motion):
        return None
    stated_ms = curr.camera.readout_ms
    in_time = pair_at_image_times(FramePair(prev, curr, None), motion.T_curr_prev)
    prev = in_time.prev
    curr = in_time.curr
    assert prev.depth is not None
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
    between_ms = 1000 * (curr.timestamp - prev.timestamp)
    if velocities is None:
        # a pixel that goes down by all rows takes one readout longer
        flow = places - index[:, ::-1]
        by_readout = flow * flow[:, 1:] / curr.camera.height
    else:
        by_readout = between_ms * _shift_a_millisecond(
            in_time, index, motion.T_curr_prev, velocities
        )
    height, width = curr.camera.shape
    low = BORDER
    x = places[:, 0]
    y = places[:, 1]
    inside = (x > low) & (y > low) & (x < width - 1 - low) & (y < height - 1 - low)
    inside &= np.isfinite(by_focal + by_readout).all(axis=1)
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

    def residual_by(shift: np.ndarray) -> np.ndarray:
        return across * shift[inside, :1] + along * shift[inside, 1:]

    columns = [
        residual_by(by_focal),
        residual_by(by_readout),
        across * du + along * dv,
        residual_by(by_disparity),
        grey[:, None],
        np.ones_like(across),
    ]
    fit = _fitted(np.hstack(columns), grey - read(0, 0))
    if fit is None:
        return None
    left = _readout(fit.of(READOUT), between_ms)
    if left is None:
        return Bends(fit.of(FOCAL), None)
    whole = left._replace(error=stated_ms + left.error)
    return Bends(fit.of(FOCAL), whole)


def _shift_a_millisecond(
    pair: FramePair,
    index: np.ndarray,
    T_curr_prev: np.ndarray,
    velocities: tuple[np.ndarray, np.ndarray],
) -> np.ndarray:
    """By how much a readout of a millisecond shifts where pixels of the previous frame are seen.

    Args:
        pair: two frames.
        index: (N, 2) rows and columns of the pixels.
        T_curr_prev: (4, 4) motion from the time of one middle row to that of the other.
        velocities: (6,) of the camera at both times.

    Returns:
        (N, 2) px.
    """
    assert pair.prev.depth is not None
    camera = pair.curr.camera
    middle = (camera.height - 1) / 2
    row_s = 1e-3 / camera.height
    points = backproject(pair.prev.depth, pair.prev.camera, index)
    unmoved = transform_points(T_curr_prev, points)
    places = project(unmoved, camera)
    exposed_s = row_s * (index[:, 0] - middle)
    at_middle = moved_on(points, velocities[0], -exposed_s)
    there = transform_points(T_curr_prev, at_middle)
    met_s = row_s * (places[:, 1] - middle)
    shifted = project(moved_on(there, velocities[1], met_s), camera)
    return shifted - places


def _readout(bend: Bend, between_ms: float) -> Bend | None:
    """What a pair shows of the readout, ms, from its fraction of the time between the frames."""
    # over a longer time no camera moves evenly
    if not 0 < between_ms <= MAX_EVEN_MS:
        return None
    return Bend(between_ms * bend.error, bend.information / between_ms**2)


def _turns(prev: Frame, motion: RelativePose) -> bool:
    """Whether a motion turns the view enough to show the camera, and as much as it shifts it.

    What bends the flow of a translation is the error of the depth as well.
    """
    turn_px = rotation_angle(motion.T_curr_prev[:3, :3]) * prev.camera.fx
    if turn_px < MIN_TURN_PX:
        return False
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


class _Fit(NamedTuple):
    """The numbers that fit the residuals of a pair."""

    found: np.ndarray  # (N,)
    products: np.ndarray  # (N, N) normal equations
    noise: float  # standard deviation of the residuals, grey levels

    def of(self, number: int) -> Bend:
        """One of the numbers, with its information whatever the others are."""
        others = np.delete(np.arange(len(self.found)), number)
        mixed = self.products[number, others]
        rest = self.products[np.ix_(others, others)]
        shared = mixed @ np.linalg.lstsq(rest, mixed, rcond=None)[0]
        information = (self.products[number, number] - shared) / self.noise**2
        return Bend(float(self.found[number]), float(max(information, TINY)))


def _fitted(columns: np.ndarray, values: np.ndarray) -> _Fit | None:
    """Fit columns (N, M) to values (N,), robustly; None where they do not determine it."""
    found = np.zeros(columns.shape[1])
    for _ in range(ROUNDS):
        residual = values - columns @ found
        noise = max(robust_std(np.abs(residual)), MIN_NOISE)
        weight = 1 / (1 + (residual / (RefineOptions.cutoff * noise)) ** 2)
        products = (columns * weight[:, None]).T @ columns
        found = np.linalg.lstsq(
            products, (columns * weight[:, None]).T @ values, rcond=None
        )[0]
    return _Fit(found, products, noise) if np.isfinite(found).all() else None
