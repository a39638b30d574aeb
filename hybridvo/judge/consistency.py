"""Whether the images agree with a motion by flow that was not computed from them.

The static pixels of an answer are aligned once more, from its motion on, by the images alone. Where
they lead clearly elsewhere the flow is wrong: it belongs to another pair, or has another unit.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from hybridvo.core.geometry import invert, mean_flow, se3_log
from hybridvo.core.options import RefineOptions
from hybridvo.core.results import Reason, RelativePose, Status
from hybridvo.core.types import FramePair
from hybridvo.flow.frame_images import blurred
from hybridvo.judge.calibration import (
    CONTRADICTED_RIGHT,
    IMAGE_LEAD,
    IMAGE_LEAD_GAIN,
    MIN_LEAD,
)
from hybridvo.judge.findings import Finding, Question, towards
from hybridvo.solver.calibration import (
    MIN_IMAGE_CORRELATION,
    MIN_IN_VIEW,
    MIN_TEXTURED_PIXELS,
)
from hybridvo.solver.coarse_images import follow_images
from hybridvo.solver.image_factor import ImageFactor, ImagesAt
from hybridvo.solver.images import choose_pixels
from hybridvo.solver.newton import positive_inverse

# cells of the image, of which each gives one pixel or none
IMAGE_PIXELS = 4000
# times that the noise of the images is estimated anew, and Newton steps under each
# estimate
IMAGE_ROUNDS = 2
IMAGE_STEPS = 2
# guards divisions
TINY = 1e-12


class Contradiction(NamedTuple):
    """Evidence of the images against a motion."""

    # (4, 4) where they lead; the identity where they lead nowhere
    T_curr_prev: np.ndarray
    message: str


class ImageMatch(NamedTuple):
    """How well two images match along a motion."""

    noise: float  # standard deviation of the residual, grey levels
    correlation: float
    in_view: float  # fraction of the weight inside the current image


def against_images(question: Question) -> Finding | None:
    """Find what the images state against a motion by flow of another origin.

    Returns:
        Where they contradict it, that it is degraded and hardly probable, with a covariance that
        covers the motion to which they lead; where they lead a little away, a covariance that
        covers that; else None.
    """
    pair = question.pair
    motion = question.motion
    if motion.weights is None or pair.prev.depth is None:
        return None
    # the two depth maps already contradict each other
    if motion.status.reason is Reason.NO_VALID_DEPTH:
        return None
    if question.flow_source == "dis":
        return None
    images = by_images_alone(pair, motion, question.options)
    if images is None:
        return None
    contradiction = _against(pair, motion, images, question.flow_source)
    if contradiction is not None:
        return Finding(
            towards(motion, contradiction.T_curr_prev),
            CONTRADICTED_RIGHT,
            Status.degraded(Reason.CONTRADICTED, contradiction.message),
        )
    return disagreement(motion, images)


class ByImages(NamedTuple):
    """Where the images alone lead from a motion, and how well they match there."""

    T_curr_prev: np.ndarray  # (4, 4)
    covariance: np.ndarray | None  # (6, 6) of it; None where it is not determined
    there: ImageMatch
    here: ImageMatch  # along the motion itself


def by_images_alone(
    pair: FramePair, motion: RelativePose, options: RefineOptions | None = None
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
    covariance = positive_inverse(there.information)
    return ByImages(T, covariance, _match(there), _match(here))


def disagreement(motion: RelativePose, images: ByImages) -> Finding | None:
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
    pair: FramePair, motion: RelativePose, images: ByImages, flow_source: str
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


def _match(images: ImagesAt) -> ImageMatch:
    grey_noise = float(images.noise[0])
    return ImageMatch(grey_noise, images.correlation, images.in_view)
