"""Whether images and depth maps agree with a motion, however it was estimated.

The static pixels of an answer are aligned once more, from its motion on: by the
images alone, and by the depth maps alone. Where one of them leads clearly
elsewhere, one of the inputs is wrong: the flow belongs to another pair or has
another unit, an image was handed out twice, a cover lies on the lens.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from hybridvo.core.geometry import invert, mean_flow, se3_exp, se3_log
from hybridvo.core.options import RefineOptions
from hybridvo.core.results import Motion, Reason, Status, Term
from hybridvo.core.types import FramePair
from hybridvo.evidence.pair import PairEvidence
from hybridvo.flow.frame_images import blurred
from hybridvo.judge.calibration import (
    CLEAR_DEPTH_LEAD,
    CONTRADICTED_RIGHT,
    DEPTH_LEAD,
    DEPTH_LEAD_GAIN,
    DEPTH_LEAD_STD,
    IMAGE_LEAD,
    IMAGE_LEAD_GAIN,
    MIN_LEAD,
)
from hybridvo.judge.findings import Finding, towards
from hybridvo.solver.calibration import (
    MIN_IMAGE_CORRELATION,
    MIN_IN_VIEW,
    MIN_TEXTURED_PIXELS,
)
from hybridvo.solver.coarse_images import follow_images
from hybridvo.solver.image_factor import ImageFactor
from hybridvo.solver.image_kernels import ImagesAt
from hybridvo.solver.images import choose_pixels
from hybridvo.solver.newton import positive_inverse
from hybridvo.solver.plane_kernels import PlanesAt
from hybridvo.solver.planes import determined_step, planes_of
from hybridvo.solver.rows import PlaneRow

# Robust weight of a pixel that an answer takes for static.
CONSISTENT_WEIGHT = 0.5

# cells of the image, of which each gives one pixel or none
IMAGE_PIXELS = 4000
# times that the noise of the images is estimated anew, and Newton steps under each
# estimate
IMAGE_ROUNDS = 2
IMAGE_STEPS = 2
# points of the depth maps at most, and Gauss-Newton steps
DEPTH_POINTS = 1250
DEPTH_STEPS = 5
# guards divisions
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


def against_images_and_depth(
    evidence: PairEvidence, motion: Motion
) -> Finding | None:
    """Find what the images or the depth maps state against a motion.

    Flow that was computed from the images themselves is not compared with them.

    Args:
        evidence: of the pair.
        motion: of the pair, with the weights of its pixels.

    Returns:
        Where one of them contradicts it, that it is degraded and hardly probable, with a
        covariance that covers the motion to which they lead; where images of another origin than
        the flow lead a little away, a covariance that covers that; else None.
    """
    pair = evidence.pair
    options = evidence.options.refine
    if motion.weights is None or pair.prev.depth is None:
        return None
    # the two depth maps already contradict each other
    if motion.status.reason is Reason.NO_VALID_DEPTH:
        return None
    images = None
    contradiction = None
    if not (evidence.flow_is_of_the_images or _is_by_images_alone(motion)):
        images = by_images_alone(pair, motion, options)
    if images is not None:
        source = evidence.flow_source or "callable"
        contradiction = _against(pair, motion, images, source)
    if contradiction is None:
        contradiction = contradiction_by_depth(pair, motion, options)
    if contradiction is not None:
        return Finding(
            towards(motion, contradiction.T_curr_prev),
            CONTRADICTED_RIGHT,
            Status.degraded(Reason.CONTRADICTED, contradiction.message),
        )
    return None if images is None else disagreement(motion, images)


def _is_by_images_alone(motion: Motion) -> bool:
    """Whether no flow took part in a motion, but the images did."""
    return Term.IMAGES in motion.terms and Term.FLOW not in motion.terms


class ByImages(NamedTuple):
    """Where the images alone lead from a motion, and how well they match there."""

    T_curr_prev: np.ndarray  # (4, 4)
    covariance: np.ndarray | None  # (6, 6) of it; None where it is not determined
    there: ImageMatch
    here: ImageMatch  # along the motion itself


def by_images_alone(
    pair: FramePair, motion: Motion, options: RefineOptions | None = None
) -> ByImages | None:
    """Align the static pixels of an answer once more, by the images alone.

    Args:
        pair: two frames.
        motion: an answer with the weights of its pixels.
        options: of the refinement: cutoff of the robust kernels, number of tiles.

    Returns:
        Where they lead; None where images, depth or textured static pixels are missing.
    """
    options = options or RefineOptions()
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
    T, _ = follow_images(pair, start, weights, None, options)
    images = ImageFactor(pair, weights, index, options, motion.depth_noise)
    there = images.first(T)
    for _ in range(IMAGE_ROUNDS):
        T, gain_offset = images.follow(there, [], T, IMAGE_STEPS)
        there = images.at(T, gain_offset, there.noise)
    here = images.at(start, there.gain_offset, there.noise)
    covariance = positive_inverse(there.information.matrix)
    return ByImages(T, covariance, _match(images, there), _match(images, here))


def disagreement(motion: Motion, images: ByImages) -> Finding | None:
    """Find by how much the images disagree with a motion on flow that does not come from them.

    What flow of another origin errs by is not known from the flow. Where the images lead away
    by more than they themselves err, one of both is off by the rest.

    Args:
        motion: an answer on flow that does not come from the images.
        images: where these lead.
    """
    if (
        images.covariance is None
        or images.there.correlation < MIN_IMAGE_CORRELATION
    ):
        return None
    step = se3_log(images.T_curr_prev @ invert(motion.T_curr_prev))
    squared = float(step @ np.linalg.solve(images.covariance, step))
    # their own error has the expected square of as many numbers
    excess = max(0.0, 1.0 - len(step) / max(squared, TINY))
    # where the images lead, give or take what they err by themselves
    second_moment = towards(motion, images.T_curr_prev) + images.covariance
    return Finding(excess * second_moment)


def _against(
    pair: FramePair, motion: Motion, images: ByImages, flow_source: str
) -> Contradiction | None:
    """Return the evidence of the images against a motion, or None.

    They contradict it where they match clearly better along another motion, or match along none.
    """
    T, _, there, here = images
    start = motion.T_curr_prev
    prev = pair.prev
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


def _match(images: ImageFactor, at: ImagesAt) -> ImageMatch:
    grey_noise = float(at.noise[0])
    return ImageMatch(grey_noise, images.correlation(at), images.in_view(at))


def contradiction_by_depth(
    pair: FramePair, motion: Motion, options: RefineOptions | None = None
) -> Contradiction | None:
    """Return the evidence of the depth maps against a motion, or None.

    Colour and depth of a turning sensor are not taken at the same time: the depth
    maps may lead away by a fraction of the motion. They contradict it where they
    lead away by more than all of it, or by less if they fit each other much better
    there.

    Args:
        pair: two frames.
        motion: an answer with the weights of its pixels.
        options: of the refinement: cutoff of the robust kernels, number of tiles.
    """
    if pair.curr.depth is None or motion.weights is None:
        return None
    # where few pixels are static the grid is finer, for about as many points
    static_ratio = float(np.mean(motion.weights[::8, ::8] >= CONSISTENT_WEIGHT))
    points = int(DEPTH_POINTS / max(static_ratio, LEAST_STATIC_RATIO))
    options = options or RefineOptions()
    planes = planes_of(pair, points).weighted(
        motion.weights, CONSISTENT_WEIGHT, options
    )
    start = np.ascontiguousarray(motion.T_curr_prev)
    T = start
    at_start = planes.at(start)
    at = at_start
    for iteration in range(DEPTH_STEPS):
        if not at.determine_motion:
            return None
        T = se3_exp(determined_step(at)) @ T
        # the first step covers more than half of the way: most answers are
        # confirmed here
        distance = mean_flow(pair.prev, T @ invert(start))
        if iteration == 0 and distance < 0.5 * MIN_LEAD:
            return None
        at = planes.at(T)
    if not at.determine_motion:
        return None
    step = se3_log(T @ invert(start))
    stds = float(np.sqrt(max(step @ at.information.matrix @ step, 0.0)))
    before = _median_residual(at_start)
    fits_better = before > DEPTH_LEAD_GAIN * _median_residual(at)
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


def _median_residual(at: PlanesAt) -> float:
    """Median distance of the points from the surfaces that they are visible on, metres."""
    seen = at.surface_depth > 0
    return float(np.median(np.abs(at.rows[PlaneRow.RESIDUAL, seen])))
