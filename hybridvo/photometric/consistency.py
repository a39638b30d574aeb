"""Whether images and depth maps agree with a motion that was found, whatever it was found from.

The static pixels of an answer are aligned once more, from its motion on: by the images alone, and
by the depth maps alone. Where one of them leads clearly elsewhere, one of the inputs is wrong: the
flow belongs to another pair or has another unit, an image was handed out twice, a cover lies on the
lens.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from hybridvo.calibration import (
    CLEAR_DEPTH_LEAD,
    CONTRADICTED_RIGHT,
    DEPTH_LEAD,
    DEPTH_LEAD_GAIN,
    DEPTH_LEAD_STD,
    IMAGE_LEAD,
    IMAGE_LEAD_GAIN,
    LEAST_LEAD,
)
from hybridvo.geometry import invert, mean_flow, se3_exp, se3_log
from hybridvo.photometric import kernels
from hybridvo.photometric.factors import ImageFactor, PlaneFactor, blurred, products
from hybridvo.photometric.refine import (
    MIN_CORRELATION,
    MIN_PIXELS,
    MIN_SEEN,
    NO_PRIOR,
    choose_pixels,
    follow_images,
)
from hybridvo.results import Reason, RelativePose, Status
from hybridvo.types import FramePair

IMAGE_PIXELS = 4000  # about, of the whole image
IMAGE_ROUNDS = 2
IMAGE_STEPS = 3
DEPTH_POINTS = 1250
DEPTH_STEPS = 5
LEAST_STATIC_SHARE = 0.05  # of the pixels; with fewer the points become fewer
# least robust weight of a pixel that an answer takes for static
STATIC_WEIGHT = 0.5
# share of the largest eigenvalue below which depth does not tell a direction
UNTOLD = 1e-3


class Lead(NamedTuple):
    """Another motion than the answer's, to which images or depth maps lead."""

    T_curr_prev: np.ndarray  # (4, 4)
    message: str


def verified(
    pair: FramePair, motion: RelativePose, flow_source: str
) -> RelativePose:
    """Return a motion, degraded where the images or the depth maps contradict it.

    Flow that was computed from the images themselves is not held against them.

    Args:
        pair: two frames.
        motion: an answer with the weights of its pixels.
        flow_source: of the flow that it was found from; ``dis`` where that comes from the images.

    Returns:
        The motion as it is; or, where it is contradicted, degraded, with a covariance that covers
        what leads away from it, and with a small probability.
    """
    if not motion.usable or motion.weights is None or pair.prev.depth is None:
        return motion
    # the depth maps are doubted already
    if motion.status.reason is Reason.NO_VALID_DEPTH:
        return motion
    lead = None
    if flow_source != "dis":
        lead = image_lead(pair, motion, flow_source)
    if lead is None:
        lead = depth_lead(pair, motion)
    if lead is None:
        return motion
    step = se3_log(lead.T_curr_prev @ invert(motion.T_curr_prev))
    return motion.replace(
        covariance=motion.covariance + np.outer(step, step),
        probability=min(motion.probability, CONTRADICTED_RIGHT),
        status=Status.degraded(Reason.CONTRADICTED, lead.message),
    )


def image_lead(
    pair: FramePair, motion: RelativePose, flow_source: str
) -> Lead | None:
    """Where the images lead from a motion, if they clearly contradict it; else None."""
    prev = pair.prev
    curr = pair.curr
    weights = motion.weights
    if (
        prev.rgb is None
        or curr.rgb is None
        or prev.depth is None
        or weights is None
    ):
        return None
    index = choose_pixels(blurred(prev), prev.depth, weights, IMAGE_PIXELS)
    if len(index) < MIN_PIXELS:
        return None
    start = np.ascontiguousarray(motion.T_curr_prev)
    no_planes = PlaneFactor(pair, np.zeros_like(weights), STATIC_WEIGHT)
    T, _ = follow_images(pair, start, weights, no_planes)
    factor = ImageFactor(pair, motion.replace(T_curr_prev=T), index)
    for _ in range(IMAGE_ROUNDS):
        T = factor.follow(no_planes, NO_PRIOR, T, IMAGE_STEPS)
        factor.estimate(T)
    noise_there = factor.noise
    correlated_there = factor.correlation()
    factor.estimate(start)
    if factor.seen < MIN_SEEN:
        return None
    correlated = factor.correlation()
    away = mean_flow(prev, T @ invert(start))
    least = LEAST_LEAD + IMAGE_LEAD * mean_flow(prev, start)
    better = factor.noise > IMAGE_LEAD_GAIN * noise_there and away > least
    matched = correlated_there >= MIN_CORRELATION
    if better and matched:
        pixels = prev.camera.width * away
        return Lead(
            T,
            f"the images lead {pixels:.1f} px away from the motion that the flow "
            f"({flow_source}) says: check the flow's unit, direction and pair",
        )
    if correlated < MIN_CORRELATION and not matched:
        return Lead(
            np.eye(4),
            f"the two images do not match along the motion ({correlated:.2f} correlated): check "
            f"that the flow ({flow_source}) belongs to them",
        )
    return None


def depth_lead(pair: FramePair, motion: RelativePose) -> Lead | None:
    """Where the depth maps lead from a motion, if they have nothing in common with it; else None.

    Colour and depth of a turning sensor are not taken at the same time: the depth maps may lead
    away by a share of the motion. They contradict it where they lead away by more than all of it,
    or by less where all of them agree on that.
    """
    if pair.curr.depth is None or motion.weights is None:
        return None
    # where few pixels are static, the grid is finer, so that about as many points lie on them
    share = float(np.mean(motion.weights[::8, ::8] >= STATIC_WEIGHT))
    points = int(DEPTH_POINTS / max(share, LEAST_STATIC_SHARE))
    planes = PlaneFactor(pair, motion.weights, STATIC_WEIGHT, points)
    start = np.ascontiguousarray(motion.T_curr_prev)
    own_flow = mean_flow(pair.prev, start)
    T = start
    for step in range(DEPTH_STEPS):
        if not planes.estimate(T):
            return None
        if step == 0:
            residual_at_start = _median_residual(planes)
        T = se3_exp(_told_step(planes)) @ T
        # most answers end here: half of the way is more than the first step leaves
        if step == 0 and mean_flow(pair.prev, T @ invert(start)) < 0.5 * LEAST_LEAD:
            return None
    if not planes.estimate(T):
        return None
    away = T @ invert(start)
    pixels = mean_flow(pair.prev, away)
    delta = se3_log(away)
    std = float(np.sqrt(max(delta @ planes.information @ delta, 0.0)))
    is_clear = residual_at_start > DEPTH_LEAD_GAIN * _median_residual(planes)
    least = LEAST_LEAD + (CLEAR_DEPTH_LEAD if is_clear else DEPTH_LEAD) * own_flow
    if not (least < pixels < np.inf) or std < DEPTH_LEAD_STD:
        return None
    return Lead(
        T,
        f"the depth maps moved by {pair.prev.camera.width * pixels:.1f} px where the motion found "
        f"does not: image and depth may not belong together, or a cover lies on the lens",
    )


def _median_residual(planes: PlaneFactor) -> float:
    """Median distance of the points from the surface that they are seen on, metres."""
    seen = planes.rows[kernels.SURFACE] > 0
    return float(np.median(np.abs(planes.rows[kernels.R, seen])))


def _told_step(planes: PlaneFactor) -> np.ndarray:
    """The Gauss-Newton step (6,) of depth maps alone, along the directions that they tell."""
    sums = products(planes.rows[: kernels.PLANE_TERMS], planes.point_weights)
    H = sums[1:, 1:]
    scale = 1 / np.sqrt(np.diag(H) + 1e-12)
    eigenvalues, vectors = np.linalg.eigh(H * np.outer(scale, scale))
    told = eigenvalues > UNTOLD * eigenvalues[-1]
    inverse = (vectors[:, told] / eigenvalues[told]) @ vectors[:, told].T
    return np.asarray(-scale * (inverse @ (scale * sums[1:, 0])))
