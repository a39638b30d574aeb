"""Photometric refinement: the motion that the flow found, made sharper by the images themselves.

The flow brings the motion close; the images hold far more than the flow. They join as information:
the flow's (and the second depth's) covariance becomes a prior of Student's form around the motion
of the refinement, and the 6x6 normal equations of both add up. The motion of the flow stays where
the images do not match along the motion, or lead outside of what the flow allows.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from hybridvo.errors import InputError
from hybridvo.geometry import pose_matrix, projection_rows
from hybridvo.images.image_factor import (
    MID_GREY,
    MIN_WEIGHT,
    ImageFactor,
    blurred,
    choose_pixels,
)
from hybridvo.images.plane_factor import PlaneFactor
from hybridvo.options import PhotometricOptions
from hybridvo.refinement.covariance import direction_is_known
from hybridvo.refinement.solver import (
    Factor,
    PriorFactor,
    gauss_newton,
    positive_inverse,
)
from hybridvo.results import RelativePose
from hybridvo.types import FramePair

MIN_PIXELS = 200
MIN_SEEN = 0.3
"""Share of the weight that must fall inside the current image."""
MIN_GAIN = 0.1
"""Share of the flow's information that the images must add in some direction."""
MAX_SHIFT = 9.0
"""Longest shift from the flow's motion, in its inflated standard deviations."""
MIN_AGREEMENT = 0.5
"""Agreement of the parts of the image below which the status mentions it."""
COARSE_SPREAD = 0.3
"""Coarser blurs are used where the flow leaves more than this many finest blurs undecided."""


@dataclass(frozen=True, eq=False)
class PhotometricReport:
    """What the images add to the motion of one pair.

    Args:
        taken: whether the motion was changed.
        reason: of a refusal, in a word: ``no_texture``, ``no_match`` (the images are not of one
            scene along the motion) or ``rejected`` (the flow excludes where they lead); empty where
            taken, not tried or not needed.
        message: the same for people.
        shift: (6,) left tangent from the flow's motion to that of the images and the flow.
        shift_sigma: its length in standard deviations of the flow (inflated).
        image_information: (6, 6) of the images alone; flow_information: of the flow alone;
            depth_information: of both depth maps, 0 without them; all as they were added up.
        gain, offset: of the current image over the previous one; offset in grey levels.
        agreement: factor in (0, 1] on the information of the images by which the parts of the
            image, held against each other, lowered it.
        uneven_light: whether gain and offset had to vary over the image.
    """

    taken: bool
    reason: str = ""
    message: str = ""
    shift: np.ndarray = field(default_factory=lambda: np.zeros(6))
    shift_sigma: float = 0.0
    image_information: np.ndarray = field(default_factory=lambda: np.zeros((6, 6)))
    flow_information: np.ndarray = field(default_factory=lambda: np.zeros((6, 6)))
    depth_information: np.ndarray = field(default_factory=lambda: np.zeros((6, 6)))
    gain: float = 1.0
    offset: float = 0.0
    agreement: float = 1.0
    uneven_light: bool = False


def refine_photometric(
    pair: FramePair,
    pose: RelativePose,
    options: PhotometricOptions | None = None,
) -> RelativePose:
    """The motion of a pair, sharpened by its two images.

    ``pose``: what :func:`hybridvo.refinement.refine.refine_pair` found, with its weights and
    covariance.

    Returns:
        The motion with its covariance, ``terms`` and report (``photometric``). Where images are
        missing or of no use, or the acceptance test refuses them, the motion is that of ``pose``,
        and the report and the status' message say why.

    Raises:
        InputError: weights of another shape than the image.
    """
    started = time.perf_counter()
    motion = _refine(pair, pose, options or PhotometricOptions())
    return motion.replace(ms=pose.ms + 1e3 * (time.perf_counter() - started))


def _refine(pair: FramePair, pose: RelativePose, options: PhotometricOptions) -> RelativePose:
    prev, curr = pair.prev, pair.curr
    if prev.rgb is None or curr.rgb is None:
        return _unchanged(pose, "", "an image of the pair is missing")
    if not pose.usable or pose.weights is None or prev.depth is None:
        return _unchanged(pose, "", "there is no weighted estimate to start from")
    if pose.weights.shape != prev.camera.shape:
        raise InputError(
            f"refine_photometric: expected weights of shape {prev.camera.shape}, "
            f"got {pose.weights.shape}."
        )
    inflated, blurs = pose.covariance * options.prior_inflation, options.blur_px
    flow_information = positive_inverse(inflated)
    if flow_information is None:
        return _unchanged(pose, "", "the estimate has no usable covariance")
    index = choose_pixels(blurred(prev, blurs[-1]), prev.depth, pose.weights, options.pixels)
    if len(index) < MIN_PIXELS:
        what = f"{len(index)} static pixels with texture and depth, {MIN_PIXELS} needed"
        return _unchanged(pose, "no_texture", what)
    factor = ImageFactor(pair, pose, index, options.image_inflation)
    factors: list[Factor] = [factor, PriorFactor(pose.T_curr_prev, flow_information)]
    depth = PlaneFactor.of(pair, pose.weights, MIN_WEIGHT, options.image_inflation)
    if depth is not None and depth.estimate(pose.T_curr_prev):
        factors.append(depth)
    # where the flow is sure to a fraction of the finest blur, that one is enough
    if _spread_px(pair, index, inflated) < COARSE_SPREAD * blurs[-1]:
        blurs = blurs[-1:]
    T = pose.T_curr_prev
    for blur in blurs:
        factor.use(blurred(prev, blur), blurred(curr, blur), T)
        half = (options.iterations + 1) // 2
        for steps in (half, options.iterations - half):
            T = gauss_newton(factors, T, steps, tolerance=0.1).T
            factor.estimate(T)
            if depth is not None:
                depth.estimate(T)
    return _judged(pose, factors, T, options)


def _spread_px(pair: FramePair, index: np.ndarray, covariance: np.ndarray) -> float:
    """How far a covariance (6, 6) lets the pixels move in the image, root mean square, px."""
    v, u = index[:: max(1, len(index) // 200)].T
    K, z = pair.prev.camera, np.asarray(pair.prev.depth)[v, u].astype(np.float64)
    points = np.stack([(u - K.cx) / K.fx * z, (v - K.cy) / K.fy * z, z], axis=1)
    J = np.stack(projection_rows(points, pair.curr.camera))
    return float(np.sqrt(np.einsum("cnp,pq,cnq->", J, covariance, J) / len(z)))


def _judged(
    pose: RelativePose,
    factors: Sequence[Any],
    T: np.ndarray,
    options: PhotometricOptions,
) -> RelativePose:
    """The refined motion ``T``, or that of the flow where the images cannot be believed."""
    factor: ImageFactor = factors[0]
    prior: PriorFactor = factors[1]
    images, flow = factor.linearize(T).H, prior.information
    shift = prior.offset(T)
    report = PhotometricReport(
        True,
        shift=shift,
        shift_sigma=float(np.sqrt(shift @ flow @ shift)),
        image_information=images,
        flow_information=flow,
        depth_information=sum((f.linearize(T).H for f in factors[2:]), np.zeros((6, 6))),
        gain=factor.gain,
        offset=factor.offset + MID_GREY * (1 - factor.gain),
        agreement=factor.agreement,
        uneven_light=factor.uneven_light,
    )
    covariance = positive_inverse(images + prior.linearize(T).H + report.depth_information)
    if covariance is None:
        return _unchanged(pose, "rejected", "the joint information is not definite", report)
    if factor.seen < MIN_SEEN:
        what = f"{100 * factor.seen:.0f} % of the pixels are seen by both cameras"
        return _unchanged(pose, "no_match", what, report)
    correlated = factor.correlation()
    if not correlated >= options.min_correlation:
        what = f"the two images do not match along the motion ({correlated:.2f} correlated)"
        return _unchanged(pose, "no_match", what, report)
    if np.linalg.eigvals(np.linalg.solve(flow, images)).real.max() < MIN_GAIN:
        return _unchanged(pose, "", "the images add little to what the flow already knows", report)
    if report.shift_sigma > MAX_SHIFT:
        what = f"they lead {report.shift_sigma:.1f} standard deviations away from the flow's motion"
        return _unchanged(pose, "rejected", what, report)
    T = pose_matrix(T[:3])
    remarks = []
    if report.uneven_light:
        remarks.append("the light changed differently over the image, evened out")
    if report.agreement < MIN_AGREEMENT:
        remarks.append(
            "parts of the image disagree about the motion (rolling shutter, lens, depth?), "
            "weighed down"
        )
    status = pose.status
    if remarks and not status.message:
        status = replace(status, message=f"images: {'; '.join(remarks)}")
    return pose.replace(
        T_curr_prev=T,
        covariance=covariance,
        status=status,
        translation_direction_valid=direction_is_known(T, covariance),
        terms=(*pose.terms, "images"),
        photometric=report,
    )


def _unchanged(
    pose: RelativePose, reason: str, message: str, report: PhotometricReport | None = None
) -> RelativePose:
    report = replace(
        report or PhotometricReport(False), taken=False, reason=reason, message=message
    )
    if reason and not pose.status.message:
        pose = pose.replace(status=replace(pose.status, message=f"images not used: {message}"))
    return pose.replace(photometric=report)
