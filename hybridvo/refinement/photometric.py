"""Photometric refinement: the motion that the flow found, made sharper by the images themselves.

The flow brings the motion close; the images hold far more than the flow. The residual of a
weighted static pixel, ``I_curr(pi(T X)) - gain I_prev - offset``, joins as information: the flow's
(and the second depth's) covariance becomes a prior of Student's form around the motion of the
refinement, and the 6x6 normal equations of both add up, each with its estimated noise. A guard
keeps the motion of the flow where the images do not lower the joint cost, do not match, or lead
outside of what the flow allows. Definition of the term:
:mod:`hybridvo.refinement.photometric_kernels`.
"""

from __future__ import annotations

import time
from dataclasses import replace
from typing import Any

import numpy as np

from hybridvo.errors import InputError
from hybridvo.options import PhotometricOptions
from hybridvo.refinement import photometric_kernels as kernels
from hybridvo.refinement.illumination import local_correlation
from hybridvo.refinement.photometric_images import MID_GREY, Level, blurred, grey_image, match_blur
from hybridvo.refinement.photometric_options import PhotometricReport
from hybridvo.refinement.photometric_problem import Problem, State, inverse, small_log
from hybridvo.refinement.pixels import as_contiguous
from hybridvo.results import RelativePose
from hybridvo.types import FramePair

PER_CELL = 4
MIN_WEIGHT = 0.25
"""Robust weight in the refinement on the flow below which a pixel is not used."""
MIN_PIXELS = 200
MIN_SEEN = 0.3
"""Share of the weight that must fall inside the current image."""
MIN_GAIN = 0.1
"""Share of the flow's information that the images must add in some direction."""
MAX_SHIFT = 9.0
"""Longest shift from the flow's motion, in its inflated standard deviations."""
SAID = ("no_texture", "no_match", "out_of_view", "outside_flow", "higher_cost", "not_finite")
"""Reasons that the status of the motion mentions."""
HALF = 0.5
"""Agreement of the parts of the image below which the status mentions it."""
COARSE_SPREAD = 0.3
"""Coarser blurs are used where the flow leaves more than this many finest blurs undecided."""
COST_NOISE = 1.0
"""A rise of the joint cost below this means nothing. Noise favours places between the pixels, where
reading averages more of it: the root of the estimating equation, which has no such bias, lies
beside the minimum of the cost."""


def refine_photometric(
    pair: FramePair,
    pose: RelativePose,
    options: PhotometricOptions | None = None,
) -> RelativePose:
    """The motion of a pair, sharpened by its two images.

    Args:
        pair: the two frames; both with images.
        pose: what :func:`hybridvo.refinement.refine.refine` found for them, with its weights and
            covariance.
        options: see :class:`PhotometricOptions`.

    Returns:
        The motion with its covariance, ``terms`` and report (``photometric``). Where images are
        missing or of no use, or the acceptance test refuses them, the motion is that of ``pose``,
        and the report and the status' message say why. Never a value that is not finite.

    Raises:
        InputError: weights of another shape than the image.
    """
    started = time.perf_counter()
    motion = _refine(pair, pose, options or PhotometricOptions())
    return motion.replace(ms=pose.ms + 1e3 * (time.perf_counter() - started))


def _unchanged(
    pose: RelativePose, reason: str, message: str, report: PhotometricReport | None = None
) -> RelativePose:
    report = replace(
        report or PhotometricReport(False), taken=False, reason=reason, message=message
    )
    if reason in SAID and pose.usable and not pose.status.message:
        pose = pose.replace(status=replace(pose.status, message=f"images not used: {message}"))
    return pose.replace(photometric=report)


def _refine(pair: FramePair, pose: RelativePose, options: PhotometricOptions) -> RelativePose:
    prev, curr = pair.prev, pair.curr
    if prev.rgb is None or curr.rgb is None:
        return _unchanged(pose, "no_images", "an image of the pair is missing")
    if not pose.usable or pose.weights is None or pose.weights_stride != 1 or prev.depth is None:
        return _unchanged(pose, "no_estimate", "there is no weighted estimate to start from")
    if pose.weights.shape != prev.camera.shape:
        raise InputError(
            f"refine_photometric: expected weights of shape {prev.camera.shape}, "
            f"got {pose.weights.shape}."
        )
    flow_information = inverse(pose.covariance * options.prior_inflation)
    if flow_information is None:
        return _unchanged(pose, "no_estimate", "the estimate has no usable covariance")
    images = match_blur(Level(grey_image(prev.rgb), grey_image(curr.rgb)))
    first = blurred(images, options.blur_px[-1])
    index = choose_pixels(first.prev, prev.depth, pose.weights, options)
    if len(index) < MIN_PIXELS:
        return _unchanged(
            pose,
            "no_texture",
            f"{len(index)} static pixels with texture and depth, {MIN_PIXELS} needed",
        )
    problem = Problem(pair, pose, index, flow_information, options)
    state = State(pose.T_curr_prev, 1.0, 0.0)
    # where the flow is sure to a fraction of the finest blur, that one is enough
    coarse = problem.spread_px() > COARSE_SPREAD * options.blur_px[-1]
    for blur in options.blur_px[:-1]:
        if not coarse:
            break
        level = blurred(images, blur)
        state = problem.solve(level, state, options.iterations)
    state = problem.solve(first, state, options.iterations)
    return _guarded(pose, problem, first, state, options)


def choose_pixels(
    grey: np.ndarray, depth: np.ndarray, weights: np.ndarray, options: PhotometricOptions
) -> np.ndarray:
    """(N, 2) int32 rows and columns of the pixels to use: strong gradients, evenly spread."""
    height, width = grey.shape
    cell = max(2, round(np.sqrt(height * width * PER_CELL / options.pixels)))
    cells = (height // cell + 1) * (width // cell + 1)
    index = np.empty((cells * PER_CELL, 2), np.int32)
    n = kernels.select_pixels(
        grey, as_contiguous(depth), as_contiguous(weights, np.float32),
        np.float32(MIN_WEIGHT), cell, PER_CELL, index,
    )  # fmt: skip
    return index[:n]


def _guarded(
    pose: RelativePose,
    problem: Problem,
    level: Level,
    state: State,
    options: PhotometricOptions,
) -> RelativePose:
    """The refined motion, or that of the flow where the images cannot be believed."""
    problem.set_share()
    photometric = problem.weigh(state.noise, kernels.ALL_COLUMNS)
    used = problem.w > 0
    weight = problem.buffer[kernels.W][used]
    grey = problem.buffer[kernels.GREY][used]
    seen = problem.r[used] + state.gain * grey + state.offset
    if problem.uneven_light:
        index, shape = problem.index[used], problem.pair.prev.camera.shape
        given = level.prev[index[:, 0], index[:, 1]]  # without the fields
        correlation = local_correlation(index, shape, given, seen, weight)
    else:
        correlation = _correlation(grey, seen, weight)
    H = problem.marginal()[0]
    images = problem.share * H
    shift = small_log(state.T @ problem.T_flow_inverse)
    flow = problem.flow_information
    sigma = float(np.sqrt(max(shift @ flow @ shift, 0.0)))
    depth_shift, depth_information = _depth_shift(problem)
    report = PhotometricReport(
        True,
        shift=shift,
        shift_sigma=sigma,
        image_information=images,
        flow_information=flow,
        gain=state.gain,
        offset=state.offset + MID_GREY * (1 - state.gain),
        noise_grey=state.noise,
        correlation=correlation,
        pixels=int(np.count_nonzero(used)),
        agreement=problem.agreement,
        uneven_light=problem.uneven_light,
        depth_shift_px=depth_shift,
        depth_shift_information=depth_information,
    )
    numbers: tuple[Any, ...] = (state.T, images, photometric, state.gain, state.offset)
    if not all(np.isfinite(value).all() for value in numbers):
        return _unchanged(pose, "not_finite", "the images gave no finite motion")
    if problem.seen < MIN_SEEN:
        return _unchanged(
            pose,
            "out_of_view",
            f"{100 * problem.seen:.0f} % of the pixels are seen by both cameras",
            report,
        )
    if not correlation >= options.min_correlation:
        return _unchanged(
            pose,
            "no_match",
            f"the two images do not match along the motion (correlation {correlation:.2f})",
            report,
        )
    gain = float(np.linalg.eigvals(np.linalg.solve(flow, images)).real.max())
    if gain < MIN_GAIN:
        return _unchanged(
            pose, "no_gain", "the images add little to what the flow already knows", report
        )
    if sigma > MAX_SHIFT:
        return _unchanged(
            pose,
            "outside_flow",
            f"the images lead {sigma:.1f} standard deviations away from the flow's motion",
            report,
        )
    joint = problem.cost(photometric, state.T)
    problem.project(level, replace(state, T=pose.T_curr_prev))
    problem.settle(state, 1, fixed=True)
    if not joint < problem.cost(problem.weigh(state.noise), pose.T_curr_prev) + COST_NOISE:
        return _unchanged(
            pose, "higher_cost", "the images do not lower the cost of the motion", report
        )
    covariance = inverse(images + problem.prior(state.T)[1])
    if covariance is None:
        return _unchanged(pose, "not_finite", "the joint information is not definite", report)
    T = state.T.copy()
    U, _, Vt = np.linalg.svd(T[:3, :3])
    T[:3, :3] = U @ Vt
    spread = np.sqrt(max(np.linalg.eigvalsh(covariance[:3, :3])[-1], 0.0))
    status = pose.status
    said = _remarks(report)
    if said and not status.message:
        status = replace(status, message=f"images: {said}")
    return pose.replace(
        T_curr_prev=T,
        covariance=covariance,
        status=status,
        translation_direction_valid=bool(np.linalg.norm(T[:3, 3]) > 3 * spread),
        terms=(*pose.terms, "images"),
        photometric=report,
    )


def _remarks(report: PhotometricReport) -> str:
    """What was wrong with images that were used all the same."""
    parts = []
    if report.uneven_light:
        parts.append("the light changed differently over the image, evened out")
    if report.agreement < HALF:
        parts.append(
            "parts of the image disagree about the motion (rolling shutter, lens, depth?), "
            "weighed down"
        )
    return "; ".join(parts)


def _depth_shift(problem: Problem) -> tuple[np.ndarray, np.ndarray]:
    """((2,) px, (2, 2) information) of a shift of the depth map, motion and light free."""
    c = kernels.COLUMNS
    light = np.linalg.pinv(problem.H[:c, :c], rcond=1e-12, hermitian=True)
    cross = problem.H[c:, :c] @ light
    information = problem.H[c:, c:] - cross @ problem.H[:c, c:]
    gradient = problem.g[c:] - cross @ problem.g[:c]
    covariance = inverse(information)
    if covariance is None:
        return np.zeros(2), np.zeros((2, 2))
    return covariance @ gradient, problem.share * information


def _correlation(a: np.ndarray, b: np.ndarray, weight: np.ndarray) -> float:
    """Weighted correlation; 0 where one of them is constant."""
    total = float(weight.sum())
    if total <= 0:
        return 0.0
    a = a - (weight @ a) / total
    b = b - (weight @ b) / total
    power = float(weight @ (a * a)) * float(weight @ (b * b))
    return float(weight @ (a * b)) / np.sqrt(power) if power > 0 else 0.0
