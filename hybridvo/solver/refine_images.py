"""The motion by images and depth maps, with the motion by flow as a prior.

The covariance of the motion by flow becomes a prior around it; the 6x6 normal
equations of prior, images and depth maps add up.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from hybridvo.core.geometry import invert, pose_matrix, se3_log
from hybridvo.core.options import RefineOptions
from hybridvo.core.results import Motion, PhotometricReport, Term
from hybridvo.core.types import FramePair
from hybridvo.flow.frame_images import blurred
from hybridvo.solver.calibration import (
    FLOW_PRIOR_INFLATION,
    MIN_ADDED_INFORMATION,
    MIN_STATIC_WEIGHT,
    MIN_TEXTURED_PIXELS,
)
from hybridvo.solver.covariance import covariance_of_sources
from hybridvo.solver.image_factor import ImageFactor
from hybridvo.solver.image_kernels import ImagesAt
from hybridvo.solver.images import choose_pixels
from hybridvo.solver.newton import MotionState, positive_inverse
from hybridvo.solver.plane_kernels import PlanesAt
from hybridvo.solver.planes import WeightedPlanes, planes_of
from hybridvo.solver.prior import Prior

# Standard deviations by which a round of the photometric refinement moves the motion at least, or
# it was the last one: the round after it moves by a tenth to a quarter of that (median of five
# recordings).
MIN_ROUND_STD = 0.3

# times at most that noise and information are estimated anew, and Newton steps under each
# estimate
ROUNDS = 3
STEPS = 2
# cells of the image, of which each gives one pixel or none
PIXELS = 16_000


def refine_photometric(
    pair: FramePair,
    pose: Motion,
    prior_inflation: float = FLOW_PRIOR_INFLATION,
    options: RefineOptions | None = None,
) -> Motion:
    """Refine the motion of a pair by its two images and its two depth maps.

    Args:
        pair: two frames.
        pose: the motion by flow, with the weights of its pixels and its covariance.
        prior_inflation: factor on that covariance.
        options: of the refinement: cutoff of the robust kernels, number of tiles.

    Returns:
        The refined motion; or ``pose`` where images are missing, refused, or add
        nothing. Its field ``photometric`` states which and why.
    """
    options = options or RefineOptions()
    if not _can_be_refined(pair, pose):
        return pose.replace(photometric=PhotometricReport())
    covariance = prior_inflation * pose.covariance
    flow_information = positive_inverse(covariance)
    if flow_information is None:
        return pose.replace(photometric=PhotometricReport())
    depth = np.asarray(pair.prev.depth)
    weights = np.asarray(pose.weights)
    index = choose_pixels(blurred(pair.prev), depth, weights, PIXELS)
    if len(index) < MIN_TEXTURED_PIXELS:
        refusal = (
            f"{len(index)} static pixels with texture and depth, "
            f"{MIN_TEXTURED_PIXELS} needed"
        )
        return pose.replace(photometric=PhotometricReport(refusal=refusal))

    prior = Prior.around(pose.T_curr_prev, flow_information)
    images = ImageFactor(pair, weights, index, options, pose.depth_noise)
    planes = planes_of(pair).weighted(weights, MIN_STATIC_WEIGHT, options)
    T, by_images, by_planes = _follow(images, planes, prior, pose.T_curr_prev)
    information = by_images.information.matrix
    joint_covariance = covariance_of_sources(
        prior.linearize(MotionState(T)).H, information, by_planes.information.matrix
    )
    report = PhotometricReport(
        gain=float(by_images.gain_offset[0]),
        agreement=by_images.information.agreement,
    )
    if joint_covariance is None:
        refusal = "the joint information is not definite"
        return pose.replace(photometric=replace(report, refusal=refusal))
    added = np.linalg.eigvals(covariance @ information).real
    if added.max() < MIN_ADDED_INFORMATION:
        return pose.replace(photometric=report)
    return pose.replace(
        T_curr_prev=pose_matrix(T[:3]),
        covariance=joint_covariance,
        terms=(*pose.terms, Term.IMAGES),
        photometric=replace(report, taken=True),
    )


def _can_be_refined(pair: FramePair, pose: Motion) -> bool:
    has_pixels = pose.weights is not None and pair.prev.depth is not None
    return pose.usable and pair.has_images and has_pixels


def _follow(
    images: ImageFactor, planes: WeightedPlanes, prior: Prior, T: np.ndarray
) -> tuple[np.ndarray, ImagesAt, PlanesAt]:
    """The motion (4, 4) of least cost, from a start, with images and depth maps there.

    Noise and information are updated on the way.
    """
    by_images = images.first(T)
    by_planes = planes.at(T)
    for _ in range(ROUNDS):
        others = (planes.under(by_planes), prior)
        ahead, gain_offset = images.follow(by_images, others, T, STEPS)
        step = se3_log(ahead @ invert(T))
        T = ahead
        by_images = images.at(T, gain_offset, by_images.noise)
        by_planes = planes.at(T)
        information = by_images.information.matrix + by_planes.information.matrix
        if step @ information @ step < MIN_ROUND_STD**2:
            break
    return T, by_images, by_planes
