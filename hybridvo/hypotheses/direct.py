"""The motion of a pair by its images and depth maps alone, without flow.

Reduced images and the depth maps are followed coarse to fine from a start; the
result is refined at full size. The probability that it is the camera's motion rests on how exact
it is, on how far the regions of the image lie beside it, and on how much of the texture lies in
regions that it leaves unexplained.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from hybridvo.core.belief import Belief, resized
from hybridvo.core.geometry import transform_points
from hybridvo.core.options import RefineOptions
from hybridvo.core.results import PhotometricReport, RelativePose
from hybridvo.core.types import FramePair
from hybridvo.flow.providers import have_texture
from hybridvo.hypotheses.calibration import DIRECT_INFLATION
from hybridvo.hypotheses.direct_evidence import (
    TINY,
    PointResiduals,
    compare_points,
    ego_flow_std,
    following,
    shift_of_regions,
    unexplained_texture,
)
from hybridvo.judge.calibration import DIRECT_PROBABILITY
from hybridvo.judge.choice import (
    DirectEvidence,
    direct_evidence,
    direct_probability,
    exact_probability,
)
from hybridvo.solver.calibration import (
    DIRECT_PRIOR_STD,
    MAX_HIDDEN,
    MIN_BELIEVED,
    MIN_PLANE_POINTS,
)
from hybridvo.solver.coarse_images import follow_images
from hybridvo.solver.covariance import covariance_of_sources
from hybridvo.solver.planes import PlaneFactor, PlanesAt
from hybridvo.solver.refine_images import refine_photometric
from hybridvo.solver.visibility import visibility

# points of the depth maps at most, where reduced images are followed
REDUCED_POINTS = 1250
# (6, 6) m^2 and rad^2: of the motion without the images
PRIOR_COVARIANCE = np.diag(np.repeat(DIRECT_PRIOR_STD, 3) ** 2)
PRIOR_INFORMATION = np.linalg.inv(PRIOR_COVARIANCE)


def direct_start(
    pair: FramePair,
    T_start: np.ndarray | None = None,
    min_probability: float = DIRECT_PROBABILITY,
    options: RefineOptions | None = None,
    belief: Belief | None = None,
    is_near: bool = False,
) -> RelativePose | None:
    """Estimate the motion on which images and depth maps agree.

    Args:
        pair: two frames; their flow is not used.
        T_start: (4, 4) T_curr_prev to start from; None: the identity.
        min_probability: smallest probability of being the camera's motion.
        options: of the refinement: cutoff of the robust kernels, number of tiles.
        belief: which pixels of the first frame are static. The motion is then sought on these,
            and what they leave unexplained decides where all of the view does not.
        is_near: whether the start is what the most reduced images show.

    Returns:
        The motion with covariance, weights and probability; None where an image or
        a depth map is missing, where they do not match, or where the probability is
        smaller.
    """
    options = options or RefineOptions()
    if not (pair.prev.is_rgbd and pair.curr.is_rgbd):
        return None
    ones = np.ones(pair.prev.camera.shape, np.float32)
    weights = ones if belief is None else resized(belief.weights, ones.shape)
    few_planes = PlaneFactor(pair, weights, 0.0, options, REDUCED_POINTS)
    if len(few_planes.index) < MIN_PLANE_POINTS:
        return None
    T = np.eye(4) if T_start is None else T_start
    T, gain = follow_images(pair, T, weights, few_planes, options, is_near)

    # rejected early where it would not be right even if it were precise
    planes = PlaneFactor(pair, ones, 1.0, options)
    coarse = _as_it_is(pair, T, gain, planes, options, belief)
    if coarse.probability < min_probability:
        return None
    answer = _refined(pair, coarse, planes, options, belief)
    if answer is None or answer.probability < min_probability:
        return None
    return answer.replace(covariance=DIRECT_INFLATION * answer.covariance)


def _as_it_is(
    pair: FramePair,
    T: np.ndarray,
    gain: float,
    planes: PlaneFactor,
    options: RefineOptions,
    belief: Belief | None,
) -> RelativePose:
    """A motion that is not refined, with the weights of its pixels and its probability."""
    motion = RelativePose(
        T_curr_prev=T,
        covariance=np.zeros((6, 6)),
        photometric=PhotometricReport(gain=gain),
        method="direct",
    )
    return _judged(pair, motion, planes, options.cutoff, belief, is_refined=False)


def _refined(
    pair: FramePair,
    coarse: RelativePose,
    planes: PlaneFactor,
    options: RefineOptions,
    belief: Belief | None,
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
        # images without texture agree with any motion: that they do is no evidence of it
        structure = planes.structure(planes.at(refined.T_curr_prev))
        by_depth = covariance_of_sources(PRIOR_INFORMATION, structure.common)
        refined = refined.replace(covariance=by_depth)
    return _judged(pair, refined, planes, options.cutoff, belief)


# -- its probability -------------------------------------------------------------------


def _judged(
    pair: FramePair,
    motion: RelativePose,
    planes: PlaneFactor,
    cutoff: float,
    belief: Belief | None,
    is_refined: bool = True,
) -> RelativePose:
    """A motion with the weights of the pixels that follow it, and its probability.

    Args:
        pair: two frames.
        motion: with covariance.
        planes: the points of the depth maps.
        cutoff: of the robust kernel, standard deviations.
        belief: which pixels of the first frame are static; asked where all of the view does not
            show enough.
        is_refined: else it is judged as if it were exact.
    """
    at = planes.at(motion.T_curr_prev)
    images = compare_points(pair, planes, at, motion)
    follows = following(images, at, cutoff)
    view = _SeenPoints(planes, images, follows, pair.prev.camera.width, is_refined)
    std_px = ego_flow_std(pair, planes.points[images.inside], motion)
    evidence = view.evidence(std_px)
    count = max(int(np.count_nonzero(images.inside)), 1)
    judged = motion.replace(
        inlier_ratio=int(np.count_nonzero(follows)) / count,
        probability=direct_probability(evidence),
        evidence=evidence,
        depth_noise=_depth_noise(at),
        terms=("images", "depth") if at.determine_motion else ("images",),
    )
    if belief is not None:
        if judged.probability < DIRECT_PROBABILITY:
            judged = _by_belief(pair, judged, view, std_px, belief)
        follows = follows & (belief.weights[planes.cells] > MIN_BELIEVED)
    weights = resized(planes.on_grid(follows), pair.prev.camera.shape)
    return judged.replace(weights=weights)


class _SeenPoints(NamedTuple):
    """What the images show of a motion at the points of the depth maps."""

    planes: PlaneFactor
    images: PointResiduals
    follows: np.ndarray  # (N,) bool
    width: int  # of the image, px
    is_refined: bool

    def evidence(
        self, std_px: float, static: np.ndarray | float = 1.0
    ) -> DirectEvidence:
        """What speaks for the motion.

        Args:
            std_px: standard deviation of the ego flow, px.
            static: (N,) probability of each point to be static, by which it counts.
        """
        images = self.images
        shift = 0.0
        if self.is_refined:
            shift = shift_of_regions(images, self.planes, static)
        unexplained = unexplained_texture(images, self.follows, self.planes, static)
        width = self.width
        return direct_evidence(
            std_px / width, images.mean_flow_px / width, shift, unexplained
        )


def _by_belief(
    pair: FramePair,
    motion: RelativePose,
    view: _SeenPoints,
    std_px: float,
    belief: Belief,
) -> RelativePose:
    """A motion with the probability by what is believed static, where that is larger.

    What something nearer hides, or what no depth is measured of any more, does not speak against
    a motion, unless that were more than half of all that is known.
    """
    images = view.images
    moved = transform_points(motion.T_curr_prev, view.planes.points)
    there = visibility(moved, pair.curr, motion.depth_noise)
    counts = there.is_measured & ~there.is_hidden
    static = belief.static_weights[view.planes.cells]
    in_view = static * images.inside
    hidden = np.sum(in_view * ~counts) / np.maximum(np.sum(in_view), TINY)
    if hidden > MAX_HIDDEN:
        return motion
    remembered = images._replace(inside=images.inside & counts)
    evidence = view._replace(images=remembered).evidence(std_px, static)
    probability = belief.probability_of(exact_probability(evidence))
    if probability <= motion.probability:
        return motion
    return motion.replace(
        probability=probability,
        evidence=evidence,
        terms=(*motion.terms, "memory"),
    )


def _depth_noise(at: PlanesAt) -> float:
    """Standard deviation of log depth: both depth maps contribute to a distance."""
    z = at.surface_depth
    z = z[z > 0]
    if not len(z):
        return 0.0
    return float(np.median(at.noise(z) / z) / np.sqrt(2))
