"""Photometric refinement: the motion that the flow found, made sharper by the images themselves.

The flow brings the motion close; the images hold far more than the flow. They join as information:
the flow's (and the second depth's) covariance becomes a prior of Student's form around the motion
of the refinement, and the 6x6 normal equations of both add up. The motion of the flow stays where
the images do not match along the motion, or lead outside of what the flow allows.
"""

from __future__ import annotations

import time
from dataclasses import dataclass, replace

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
from hybridvo.refinement.solver import PriorFactor, gauss_newton, positive_inverse
from hybridvo.results import RelativePose
from hybridvo.types import FramePair

BLURS = (2.0, 1.0)
"""Standard deviations of the blur, px, coarse to fine."""
STEPS = (3, 2)
"""Most Gauss-Newton steps under each blur, between which light, noise and scale are estimated."""
PIXELS = 16_000
"""About how many are used: the strongest gradients of evenly spread cells."""
PRIOR_INFLATION = 8.0
"""Factor on the covariance of the flow's motion, whose errors are alike far beyond the tiles."""
MIN_CORRELATION = 0.5
"""Of the two images along the motion; below it they do not match."""
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
    """What came of the images of one pair.

    Args:
        taken: whether the motion was changed.
        reason: of a refusal, in a word: ``no_texture``, ``no_match`` (the images are not of one
            scene along the motion) or ``rejected`` (the flow excludes where they lead); empty where
            taken, not tried or not needed. message: the same for people.
        gain, offset: of the current image over the previous one; offset in grey levels.
        agreement: factor in (0, 1] on the information of the images by which the parts of the
            image, held against each other, lowered it.
        uneven_light: whether gain and offset had to vary over the image.
    """

    taken: bool
    reason: str = ""
    message: str = ""
    gain: float = 1.0
    offset: float = 0.0
    agreement: float = 1.0
    uneven_light: bool = False


def refine_photometric(
    pair: FramePair,
    pose: RelativePose,
    blurs: tuple[float, ...] = BLURS,
    prior_inflation: float = PRIOR_INFLATION,
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
    started, shape = time.perf_counter(), pair.prev.camera.shape
    if pose.weights is not None and pose.weights.shape != shape:
        got = pose.weights.shape
        raise InputError(f"refine_photometric: expected weights of shape {shape}, got {got}.")
    motion = _refine(pair, pose, blurs, pose.covariance * prior_inflation)
    return motion.replace(ms=pose.ms + 1e3 * (time.perf_counter() - started))


def _refine(
    pair: FramePair, pose: RelativePose, blurs: tuple[float, ...], covariance: np.ndarray
) -> RelativePose:
    prev, curr, T, weights = pair.prev, pair.curr, pose.T_curr_prev, pose.weights
    if prev.rgb is None or curr.rgb is None:
        return _judged(pose, PhotometricReport(False, "", "an image of the pair is missing"))
    if not pose.usable or weights is None or prev.depth is None:
        what = "there is no weighted estimate to start from"
        return _judged(pose, PhotometricReport(False, "", what))
    flow_information = positive_inverse(covariance)
    if flow_information is None:
        what = "the estimate has no usable covariance"
        return _judged(pose, PhotometricReport(False, "", what))
    index = choose_pixels(blurred(prev, blurs[-1]), prev.depth, weights, PIXELS)
    if len(index) < MIN_PIXELS:
        what = f"{len(index)} static pixels with texture and depth, {MIN_PIXELS} needed"
        return _judged(pose, PhotometricReport(False, "no_texture", what))
    images, flow = ImageFactor(pair, pose, index), PriorFactor(T, flow_information)
    planes = [] if curr.depth is None else [PlaneFactor(pair, weights, MIN_WEIGHT)]
    planes = [factor for factor in planes if factor.estimate(T)]
    # where the flow is sure to a fraction of the finest blur, that one is enough
    if _spread_px(pair, index, covariance) < COARSE_SPREAD * blurs[-1]:
        blurs = blurs[-1:]
    for blur in blurs:
        images.use(blurred(prev, blur), blurred(curr, blur), T)
        for steps in STEPS:
            T = gauss_newton((images, flow, *planes), T, steps, tolerance=0.1).T
            images.estimate(T)
            for factor in planes:
                factor.estimate(T)
    H = images.linearize(T).H
    joint = sum((factor.linearize(T).H for factor in planes), H + flow.linearize(T).H)
    joint_covariance = positive_inverse(joint)
    reason, message = "rejected", "the joint information is not definite"
    if joint_covariance is not None:
        reason, message = _doubt(images, flow, T, H)
    report = PhotometricReport(
        not message,
        reason,
        message,
        gain=images.gain,
        offset=images.offset + MID_GREY * (1 - images.gain),
        agreement=images.agreement,
        uneven_light=images.uneven_light,
    )
    return _judged(pose, report, T, joint_covariance)


def _spread_px(pair: FramePair, index: np.ndarray, covariance: np.ndarray) -> float:
    """How far a covariance (6, 6) lets the pixels move in the image, root mean square, px."""
    v, u = index[:: max(1, len(index) // 200)].T
    K, z = pair.prev.camera, np.asarray(pair.prev.depth)[v, u].astype(np.float64)
    points = np.stack([(u - K.cx) / K.fx * z, (v - K.cy) / K.fy * z, z], axis=1)
    J = np.stack(projection_rows(points, pair.curr.camera))
    return float(np.sqrt(np.einsum("cnp,pq,cnq->", J, covariance, J) / len(z)))


def _doubt(
    images: ImageFactor, flow: PriorFactor, T: np.ndarray, information: np.ndarray
) -> tuple[str, str]:
    """Why the motion to which the images lead cannot be believed: (in a word, in a sentence)."""
    if images.seen < MIN_SEEN:
        return "no_match", f"{100 * images.seen:.0f} % of the pixels are seen by both cameras"
    correlated = images.correlation()
    if not correlated >= MIN_CORRELATION:
        what = f"the two images do not match along the motion ({correlated:.2f} correlated)"
        return "no_match", what
    if np.linalg.eigvals(np.linalg.solve(flow.information, information)).real.max() < MIN_GAIN:
        return "", "the images add little to what the flow already knows"
    shift = flow.offset(T)
    away = float(np.sqrt(shift @ flow.information @ shift))
    if away > MAX_SHIFT:
        what = f"they lead {away:.1f} standard deviations away from the flow's motion"
        return "rejected", what
    return "", ""


def _judged(
    pose: RelativePose,
    report: PhotometricReport,
    T: np.ndarray | None = None,
    covariance: np.ndarray | None = None,
) -> RelativePose:
    """The refined motion, or that of the flow where the images were not taken; with a remark."""
    remark = f"images not used: {report.message}" if report.reason else ""
    if report.taken and T is not None and covariance is not None:
        remarks = []
        if report.uneven_light:
            remarks.append("the light changed differently over the image, evened out")
        if report.agreement < MIN_AGREEMENT:
            remarks.append(
                "parts of the image disagree about the motion (rolling shutter, lens, depth?), "
                "weighed down"
            )
        remark = f"images: {'; '.join(remarks)}" if remarks else ""
        T, terms = pose_matrix(T[:3]), (*pose.terms, "images")
        pose = pose.replace(T_curr_prev=T, covariance=covariance, terms=terms)
    if remark and not pose.status.message:
        pose = pose.replace(status=replace(pose.status, message=remark))
    return pose.replace(photometric=report)
