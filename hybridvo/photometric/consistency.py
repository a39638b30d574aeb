"""Whether images and depth maps agree with a motion, however it was estimated.

The static pixels of an answer are aligned once more, from its motion on: by the
images alone, and by the depth maps alone. Where one of them leads clearly
elsewhere, one of the inputs is wrong: the flow belongs to another pair or has
another unit, an image was handed out twice, a cover lies on the lens.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from hybridvo.calibration import (
    CLEAR_DEPTH_LEAD,
    CONSISTENT_WEIGHT,
    CONTRADICTED_RIGHT,
    DEPTH_LEAD,
    DEPTH_LEAD_GAIN,
    DEPTH_LEAD_STD,
    IMAGE_LEAD,
    IMAGE_LEAD_GAIN,
    MIN_DEPTH_EIGENVALUE,
    MIN_IMAGE_CORRELATION,
    MIN_IN_VIEW,
    MIN_LEAD,
    MIN_TEXTURED_PIXELS,
)
from hybridvo.frame_images import blurred
from hybridvo.geometry import invert, mean_flow, se3_exp, se3_log
from hybridvo.photometric.align import NO_PRIOR
from hybridvo.photometric.direct import follow_images
from hybridvo.photometric.image_factor import ImageFactor
from hybridvo.photometric.images import choose_pixels
from hybridvo.photometric.planes import PlaneFactor
from hybridvo.photometric.products import weighted_products
from hybridvo.photometric.rows import PLANE_TERMS, PlaneRow
from hybridvo.results import Reason, RelativePose, Status
from hybridvo.types import FramePair

# cells of the image, of which each gives one pixel or none
IMAGE_PIXELS = 4000
# times that the noise of the images is estimated anew, and Newton steps under each
# estimate
IMAGE_ROUNDS = 2
IMAGE_STEPS = 3
# points of the depth maps at most, and Gauss-Newton steps
DEPTH_POINTS = 1250
DEPTH_STEPS = 5
# guards the scale of a direction that no point determines
TINY = 1e-12
# of the pixels that are static; with fewer the points become fewer
LEAST_STATIC_RATIO = 0.05


class Contradiction(NamedTuple):
    """Evidence of images or depth maps against a motion."""

    # (4, 4) where they lead; the identity where they lead nowhere
    T_curr_prev: np.ndarray
    message: str


class ImageMatch(NamedTuple):
    """How well two images match along a motion."""

    noise: float  # standard deviation of the residual, grey levels
    correlation: float
    in_view: float  # fraction of the weight inside the current image


def verified(
    pair: FramePair, motion: RelativePose, flow_source: str
) -> RelativePose:
    """Return a motion, degraded where the images or the depth maps contradict it.

    Flow that was computed from the images themselves is not compared with them.

    Args:
        pair: two frames.
        motion: an answer with the weights of its pixels.
        flow_source: what its flow came from; ``dis`` where that was the images.

    Returns:
        The motion as it is; or, where it is contradicted, degraded, with a
        covariance that covers the motion to which images or depth maps lead, and
        with a small probability.
    """
    if not motion.usable or motion.weights is None or pair.prev.depth is None:
        return motion
    # the two depth maps already contradict each other
    if motion.status.reason is Reason.NO_VALID_DEPTH:
        return motion
    contradiction = None
    if flow_source != "dis":
        contradiction = contradiction_by_images(pair, motion, flow_source)
    if contradiction is None:
        contradiction = contradiction_by_depth(pair, motion)
    if contradiction is None:
        return motion
    step = se3_log(contradiction.T_curr_prev @ invert(motion.T_curr_prev))
    return motion.replace(
        covariance=motion.covariance + np.outer(step, step),
        probability=min(motion.probability, CONTRADICTED_RIGHT),
        status=Status.degraded(Reason.CONTRADICTED, contradiction.message),
    )


def contradiction_by_images(
    pair: FramePair, motion: RelativePose, flow_source: str
) -> Contradiction | None:
    """Return the evidence of the images against a motion, or None.

    They contradict it where they match clearly better along another motion, or
    match along none.

    Args:
        pair: two frames.
        motion: an answer with the weights of its pixels.
        flow_source: of its flow, for the message.
    """
    prev = pair.prev
    weights = motion.weights
    if prev.rgb is None or pair.curr.rgb is None:
        return None
    if prev.depth is None or weights is None:
        return None
    index = choose_pixels(blurred(prev), prev.depth, weights, IMAGE_PIXELS)
    if len(index) < MIN_TEXTURED_PIXELS:
        return None

    start = np.ascontiguousarray(motion.T_curr_prev)
    no_planes = PlaneFactor(pair, np.zeros_like(weights), CONSISTENT_WEIGHT)
    T, _ = follow_images(pair, start, weights, no_planes)
    images = ImageFactor(pair, motion.replace(T_curr_prev=T), index)
    for _ in range(IMAGE_ROUNDS):
        T = images.follow(no_planes, NO_PRIOR, T, IMAGE_STEPS)
        images.estimate(T)
    there = _match(images)
    images.estimate(start)
    here = _match(images)

    if here.in_view < MIN_IN_VIEW:
        return None
    matches_there = there.correlation >= MIN_IMAGE_CORRELATION
    matches_here = here.correlation >= MIN_IMAGE_CORRELATION
    distance = mean_flow(prev, T @ invert(start))
    least_distance = MIN_LEAD + IMAGE_LEAD * mean_flow(prev, start)
    is_clearly_better = here.noise > IMAGE_LEAD_GAIN * there.noise
    if matches_there and is_clearly_better and distance > least_distance:
        pixels = prev.camera.width * distance
        return Contradiction(
            T,
            f"the images lead {pixels:.1f} px away from the motion by the flow "
            f"({flow_source}): check the flow's unit, direction and pair",
        )
    if not matches_there and not matches_here:
        return Contradiction(
            np.eye(4),
            f"the two images do not match along the motion ({here.correlation:.2f} "
            f"correlated): check that the flow ({flow_source}) belongs to them",
        )
    return None


def _match(images: ImageFactor) -> ImageMatch:
    return ImageMatch(images.noise, images.correlation, images.in_view)


def contradiction_by_depth(
    pair: FramePair, motion: RelativePose
) -> Contradiction | None:
    """Return the evidence of the depth maps against a motion, or None.

    Colour and depth of a turning sensor are not taken at the same time: the depth
    maps may lead away by a fraction of the motion. They contradict it where they
    lead away by more than all of it, or by less if they fit each other much better
    there.

    Args:
        pair: two frames.
        motion: an answer with the weights of its pixels.
    """
    if pair.curr.depth is None or motion.weights is None:
        return None
    # where few pixels are static the grid is finer, for about as many points
    static_ratio = float(np.mean(motion.weights[::8, ::8] >= CONSISTENT_WEIGHT))
    points = int(DEPTH_POINTS / max(static_ratio, LEAST_STATIC_RATIO))
    planes = PlaneFactor(pair, motion.weights, CONSISTENT_WEIGHT, points)
    start = np.ascontiguousarray(motion.T_curr_prev)
    T = start
    for iteration in range(DEPTH_STEPS):
        if not planes.estimate(T):
            return None
        if iteration == 0:
            residual_at_start = _median_residual(planes)
        T = se3_exp(determined_step(planes)) @ T
        # the first step covers more than half of the way: most answers are
        # confirmed here
        distance = mean_flow(pair.prev, T @ invert(start))
        if iteration == 0 and distance < 0.5 * MIN_LEAD:
            return None
    if not planes.estimate(T):
        return None
    step = se3_log(T @ invert(start))
    stds = float(np.sqrt(max(step @ planes.information @ step, 0.0)))
    fits_better = residual_at_start > DEPTH_LEAD_GAIN * _median_residual(planes)
    lead = CLEAR_DEPTH_LEAD if fits_better else DEPTH_LEAD
    least_distance = MIN_LEAD + lead * mean_flow(pair.prev, start)
    is_far = least_distance < distance < np.inf
    if not is_far or stds < DEPTH_LEAD_STD:
        return None
    pixels = pair.prev.camera.width * distance
    return Contradiction(
        T,
        f"the depth maps moved by {pixels:.1f} px where the motion found "
        f"does not: image and depth may not belong together, or a cover lies "
        f"on the lens",
    )


def _median_residual(planes: PlaneFactor) -> float:
    """Median distance of the points from the surfaces that they are visible on, metres."""
    seen = planes.rows[PlaneRow.SURFACE_DEPTH] > 0
    return float(np.median(np.abs(planes.rows[PlaneRow.RESIDUAL, seen])))


def determined_step(planes: PlaneFactor) -> np.ndarray:
    """Gauss-Newton step (6,) of the depth maps alone where they determine it."""
    products = weighted_products(planes.rows[:PLANE_TERMS], planes.point_weights)
    H = products[PlaneRow.MOTION :, PlaneRow.MOTION :]
    gradient = products[PlaneRow.MOTION :, PlaneRow.RESIDUAL]
    scale = 1 / np.sqrt(np.diag(H) + TINY)
    eigenvalues, vectors = np.linalg.eigh(H * np.outer(scale, scale))
    determined = eigenvalues > MIN_DEPTH_EIGENVALUE * eigenvalues[-1]
    vectors = vectors[:, determined]
    inverse = (vectors / eigenvalues[determined]) @ vectors.T
    return np.asarray(-scale * (inverse @ (scale * gradient)))
