"""The motion of a pair by its images and depth maps alone, without flow.

Reduced images and the depth maps are followed coarse to fine from a start; the
result is refined at full size. The probability that it is the camera's motion rests
on two things: how precise it is, and how much of the texture lies in regions that
it leaves unexplained.
"""

from __future__ import annotations

from typing import NamedTuple

import cv2
import numpy as np

from hybridvo.core.belief import Belief, resized
from hybridvo.core.geometry import projection_rows, transform_points
from hybridvo.core.options import RefineOptions
from hybridvo.core.results import PhotometricReport, RelativePose
from hybridvo.core.stages import stage
from hybridvo.core.types import FramePair
from hybridvo.flow.frame_images import blurred, squared_gradient
from hybridvo.flow.providers import have_texture
from hybridvo.judge.choice import direct_probability
from hybridvo.solver.calibration import (
    DIRECT_PRIOR_STD,
    FLAT_GRADIENT,
    LIGHT_SIDE,
    MAX_HIDDEN,
    MIN_BELIEVED,
    MIN_FOLLOWING,
    MIN_PLANE_POINTS,
    NOISE_GREY,
    NOISE_SHIFT_PX,
    REGION_SIDE,
    SHARED_DEPTH_NOISE,
    UNEXPLAINED_FLOOR,
)
from hybridvo.solver.coarse_images import follow_images
from hybridvo.solver.planes import PlaneFactor, PlanesAt
from hybridvo.solver.products import weighted_products
from hybridvo.solver.refine_images import refine_photometric
from hybridvo.solver.rows import PlaneRow
from hybridvo.solver.visibility import visibility

# points of the depth maps at most, where reduced images are followed
REDUCED_POINTS = 1250
# (6, 6) m^2 and rad^2: of the motion without the images
PRIOR_COVARIANCE = np.diag(np.repeat(DIRECT_PRIOR_STD, 3) ** 2)
# guards divisions where no point is inside the image
TINY = 1e-6


class Remembered(NamedTuple):
    """What is believed of a view, for where the view alone does not decide."""

    belief: Belief
    # probability by all of the view from which the belief is not asked
    enough: float


class PointResiduals(NamedTuple):
    """What the two images show of moved points (N,)."""

    inside: np.ndarray  # bool: visible inside the current image
    # grey levels, less the change of brightness around the point
    residual: np.ndarray
    # of the previous image, (grey levels over two pixels)^2
    squared_gradient: np.ndarray
    # standard deviation of where the point is seen, px
    shift_px: np.ndarray


def direct_start(
    pair: FramePair,
    T_start: np.ndarray | None = None,
    min_probability: float = 0.5,
    options: RefineOptions | None = None,
    belief: Belief | None = None,
) -> RelativePose | None:
    """Estimate the motion on which images and depth maps agree.

    Args:
        pair: two frames; their flow is not used.
        T_start: (4, 4) T_curr_prev to start from; None: the identity.
        min_probability: smallest probability of being the camera's motion.
        options: of the refinement: cutoff of the robust kernels, number of tiles.
        belief: which pixels of the first frame are static. The motion is then sought on these,
            and what they leave unexplained decides where all of the view does not.

    Returns:
        The motion with covariance, weights and probability; None where an image or
        a depth map is missing, where they do not match, or where the probability is
        smaller.
    """
    options = options or RefineOptions()
    frames = (pair.prev, pair.curr)
    if any(frame.rgb is None or frame.depth is None for frame in frames):
        return None
    ones = np.ones(pair.prev.camera.shape, np.float32)
    weights = ones if belief is None else resized(belief.weights, ones.shape)
    few_planes = PlaneFactor(pair, weights, 0.0, options, REDUCED_POINTS)
    if len(few_planes.index) < MIN_PLANE_POINTS:
        return None
    T = np.eye(4) if T_start is None else T_start
    T, gain = follow_images(pair, T, weights, few_planes, options)

    # rejected early where it would not be right even if it were precise
    planes = PlaneFactor(pair, ones, 1.0, options)
    known = None if belief is None else Remembered(belief, min_probability)
    coarse = _as_it_is(pair, T, gain, planes, options, known=known)
    if coarse.probability < min_probability:
        return None
    answer = _refined(pair, coarse, planes, options, known=known)
    if answer is None or answer.probability < min_probability:
        return None
    return answer


@stage("images alone")
def direct_near(
    pair: FramePair,
    T_near: np.ndarray,
    options: RefineOptions,
    belief: Belief | None = None,
) -> RelativePose | None:
    """Estimate the motion by images and depth maps from one that is right but for details.

    Args:
        pair: two frames; their flow is not used.
        T_near: (4, 4) T_curr_prev, off by less than the structures of the images.
        options: of the refinement: cutoff of the robust kernels, number of tiles.
        belief: which pixels of the first frame are static.

    Returns:
        The motion as :func:`direct_start` states it, however probable; None where an image or a
        depth map is missing, or where they do not match.
    """
    frames = (pair.prev, pair.curr)
    if any(frame.rgb is None or frame.depth is None for frame in frames):
        return None
    ones = np.ones(pair.prev.camera.shape, np.float32)
    planes = PlaneFactor(pair, ones, 1.0, options)
    if len(planes.index) < MIN_PLANE_POINTS:
        return None
    noise = SHARED_DEPTH_NOISE
    known = None if belief is None else Remembered(belief, 1.0)
    near = _as_it_is(pair, T_near, 1.0, planes, options, noise, known)
    return _refined(pair, near, planes, options, noise, known)


def unexplained_by(motion: RelativePose) -> float:
    """Fraction of the texture in regions that a motion of this module leaves unexplained."""
    return float(np.exp(motion.evidence[1]) - UNEXPLAINED_FLOOR)


def _as_it_is(
    pair: FramePair,
    T: np.ndarray,
    gain: float,
    planes: PlaneFactor,
    options: RefineOptions,
    depth_noise: float = 0.0,
    known: Remembered | None = None,
) -> RelativePose:
    """A motion that is not refined, with the weights of its pixels and its probability."""
    motion = RelativePose(
        T_curr_prev=T,
        covariance=np.zeros((6, 6)),
        photometric=PhotometricReport(gain=gain),
        method="direct",
    )
    cutoff = options.cutoff
    return _with_probability(pair, motion, planes, cutoff, depth_noise, known)


def _refined(
    pair: FramePair,
    coarse: RelativePose,
    planes: PlaneFactor,
    options: RefineOptions,
    depth_noise: float = 0.0,
    known: Remembered | None = None,
) -> RelativePose | None:
    """A motion refined on the pixels that follow it, with covariance and probability."""
    start = RelativePose(
        T_curr_prev=coarse.T_curr_prev,
        covariance=PRIOR_COVARIANCE,
        weights=coarse.weights,
        method="direct",
    )
    refined = refine_photometric(pair, start, 1.0, options)
    if refined.photometric is None or not refined.photometric.taken:
        return None
    if not have_texture(pair.prev, pair.curr):
        refined = refined.replace(covariance=_covariance_by_depth(planes, refined))
    cutoff = options.cutoff
    return _with_probability(pair, refined, planes, cutoff, depth_noise, known)


def _covariance_by_depth(planes: PlaneFactor, motion: RelativePose) -> np.ndarray:
    """(6, 6) covariance of a motion by the depth maps alone.

    Images without texture agree with any motion: that they do is no evidence of it.
    """
    structure = planes.structure(planes.at(motion.T_curr_prev))
    return np.linalg.inv(np.linalg.inv(PRIOR_COVARIANCE) + structure.common)


# -- which points follow a motion, and its probability -----------------------------


def _with_probability(
    pair: FramePair,
    motion: RelativePose,
    planes: PlaneFactor,
    cutoff: float,
    depth_noise: float,
    known: Remembered | None = None,
) -> RelativePose:
    """A motion with the weights of the pixels that follow it, and its probability.

    The evidence is the standard deviation of the ego flow, px, by the motion's
    covariance, and the log of the fraction of the texture that lies in unexplained
    regions. ``depth_noise``: relative standard deviation of the depth.
    """
    assert motion.photometric is not None
    at = planes.at(motion.T_curr_prev)
    images = _point_residuals(pair, planes, at, motion, depth_noise)
    follows = _follows(images, at, cutoff)
    unexplained = _unexplained_texture(images, follows, planes)
    moved = transform_points(motion.T_curr_prev, planes.points[images.inside])
    count = max(len(moved), 1)
    J = np.concatenate(projection_rows(moved, pair.curr.camera))
    rows = np.ascontiguousarray(J.T, np.float32)
    products = weighted_products(rows, np.ones(len(J), np.float32))
    std_px = np.sqrt(np.sum(products * motion.covariance) / count)
    evidence = (float(std_px), float(np.log(unexplained + UNEXPLAINED_FLOOR)))
    judged = motion.replace(
        inlier_ratio=float(np.count_nonzero(follows) / count),
        probability=direct_probability(evidence),
        evidence=evidence,
        depth_noise=_depth_noise(at),
        terms=("images", "depth") if at.determine_motion else ("images",),
    )
    if known is not None:
        belief = known.belief
        if judged.probability < known.enough:
            judged = _by_belief(pair, judged, planes, images, follows, belief)
        follows = follows & (belief.weights[planes.cells] > MIN_BELIEVED)
    weights = resized(planes.on_grid(follows), pair.prev.camera.shape)
    return judged.replace(weights=weights)


def _by_belief(
    pair: FramePair,
    motion: RelativePose,
    planes: PlaneFactor,
    images: PointResiduals,
    follows: np.ndarray,
    belief: Belief,
) -> RelativePose:
    """A motion with the probability by what is believed static, where that is larger.

    What something nearer hides, or what no depth is measured of any more, does not speak against
    a motion, unless that were more than half of all that is known.
    """
    moved = transform_points(motion.T_curr_prev, planes.points)
    there = visibility(moved, pair.curr, motion.depth_noise)
    counts = there.is_measured & ~there.is_hidden
    static = belief.static_weights[planes.cells]
    in_view = static * images.inside
    hidden = np.sum(in_view * ~counts) / np.maximum(np.sum(in_view), TINY)
    if hidden > MAX_HIDDEN:
        return motion
    remembered = images._replace(inside=images.inside & counts)
    unexplained = _unexplained_texture(remembered, follows, planes, static)
    std_px = motion.evidence[0]
    evidence = (std_px, float(np.log(unexplained + UNEXPLAINED_FLOOR)))
    inside = direct_probability(evidence)
    probability = belief.probability_of(inside)
    if probability <= motion.probability:
        return motion
    return motion.replace(
        probability=probability,
        evidence=evidence,
        terms=(*motion.terms, "memory"),
    )


def _point_residuals(
    pair: FramePair,
    planes: PlaneFactor,
    at: PlanesAt,
    motion: RelativePose,
    depth_noise: float,
) -> PointResiduals:
    """Differences of the images at the points of the depth maps, at a motion."""
    assert motion.photometric is not None
    height, width = pair.prev.camera.shape
    grey_prev = blurred(pair.prev)
    grey_curr = blurred(pair.curr)
    v, u = planes.index.T
    x = at.rows[PlaneRow.U]
    y = at.rows[PlaneRow.V]
    inside = (x >= 0) & (x <= width - 1) & (y >= 0) & (y <= height - 1)
    read = cv2.remap(grey_curr, x, y, cv2.INTER_LINEAR).reshape(-1)
    residual = read - motion.photometric.gain * grey_prev[v, u]
    # brightness may change over the image
    change = _around(planes, np.where(inside, residual, 0), LIGHT_SIDE)
    covered = _around(planes, inside, LIGHT_SIDE)
    residual -= change / np.maximum(covered, TINY)
    gradient2 = squared_gradient(grey_prev, v, u)
    shift_px = np.full(len(planes.points), NOISE_SHIFT_PX)
    if depth_noise > 0:
        parallax = _parallax(pair, planes.points, motion.T_curr_prev)
        shift_px = np.hypot(NOISE_SHIFT_PX, depth_noise * parallax)
    return PointResiduals(inside, residual, gradient2, shift_px)


def _parallax(
    pair: FramePair, points: np.ndarray, T_curr_prev: np.ndarray
) -> np.ndarray:
    """(N,) px by which a point moves in the image for each unit of its log depth."""
    turned = points @ T_curr_prev[:3, :3].T
    moved = turned + T_curr_prev[:3, 3]
    camera = pair.curr.camera
    z = np.maximum(moved[:, 2], TINY)
    x = camera.fx * (turned[:, 0] - moved[:, 0] * turned[:, 2] / z) / z
    y = camera.fy * (turned[:, 1] - moved[:, 1] * turned[:, 2] / z) / z
    return np.asarray(np.hypot(x, y))


def _follows(images: PointResiduals, at: PlanesAt, cutoff: float) -> np.ndarray:
    """(N,) whether the grey value and the depth of a point follow the motion.

    ``cutoff`` is that of the robust kernel, in standard deviations.
    """
    # the gradient is taken over two pixels
    shift_variance = (images.shift_px / 2) ** 2 * images.squared_gradient
    limit2 = cutoff**2 * (NOISE_GREY**2 + shift_variance)
    residual = images.residual
    by_grey = limit2 / (limit2 + residual * residual)
    by_depth = np.where(at.surface_depth > 0, at.rows[PlaneRow.ROBUST], 1.0)
    return np.asarray(images.inside & (by_grey * by_depth > MIN_FOLLOWING))


def _unexplained_texture(
    images: PointResiduals,
    follows: np.ndarray,
    planes: PlaneFactor,
    static: np.ndarray | float = 1.0,
) -> float:
    """Fraction of the texture in regions of which most does not follow the motion.

    ``static``: (N,) probability of each point to be static, by which its texture counts.
    """
    gradient2 = images.squared_gradient
    texture = static * gradient2 / (gradient2 + FLAT_GRADIENT**2)
    texture = np.where(images.inside, texture, 0.0)
    not_following = _around(planes, texture * ~follows, REGION_SIDE)
    all_around = _around(planes, texture, REGION_SIDE)
    unexplained = not_following > 0.5 * all_around
    return float(texture[unexplained].sum() / np.maximum(texture.sum(), TINY))


def _around(planes: PlaneFactor, values: np.ndarray, side: int) -> np.ndarray:
    """(N,) averages of values (N,) of the points over a square around each."""
    averaged = cv2.blur(planes.on_grid(values), (side, side))
    return np.asarray(averaged[planes.cells])


def _depth_noise(at: PlanesAt) -> float:
    """Standard deviation of log depth: both depth maps contribute to a distance."""
    z = at.surface_depth
    z = z[z > 0]
    if not len(z):
        return 0.0
    return float(np.median(at.noise(z) / z) / np.sqrt(2))
