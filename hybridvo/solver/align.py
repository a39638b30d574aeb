"""The motion of a pair by its images and depth maps alone, without flow.

Reduced images and the depth maps are followed coarse to fine from a start; the
result is refined at full size. What speaks for it is how exact it is, how far the regions of the
image lie beside it, and how much of the texture lies in regions that it leaves unexplained.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from hybridvo.core.belief import Belief, resized
from hybridvo.core.geometry import transform_points
from hybridvo.core.options import RefineOptions
from hybridvo.core.results import Motion, PhotometricReport, Term
from hybridvo.core.types import FramePair
from hybridvo.flow.providers import have_texture
from hybridvo.solver.aligned_points import (
    TINY,
    RememberedEvidence,
    SeenPoints,
    ego_flow_std,
    see_points,
)
from hybridvo.solver.calibration import (
    DIRECT_PRIOR_STD,
    MAX_HIDDEN,
    MIN_BELIEVED,
    MIN_PLANE_POINTS,
)
from hybridvo.solver.coarse_images import follow_images
from hybridvo.solver.covariance import covariance_of_sources
from hybridvo.solver.plane_kernels import PlanesAt
from hybridvo.solver.planes import WeightedPlanes, planes_of
from hybridvo.solver.refine_images import refine_photometric
from hybridvo.solver.visibility import visibility

# points of the depth maps at most, where reduced images are followed
REDUCED_POINTS = 1250
# (6, 6) m^2 and rad^2: of the motion without the images
PRIOR_COVARIANCE = np.diag(np.repeat(DIRECT_PRIOR_STD, 3) ** 2)
PRIOR_INFORMATION = np.linalg.inv(PRIOR_COVARIANCE)


@dataclass(frozen=True, eq=False)
class Aligned:
    """A motion along which images and depth maps lie on each other.

    Attributes:
        motion: with what all of the view says for it.
        pair: the two frames.
        options: of the refinement.
        belief: which pixels of the first frame are static, or None.
        seen: what the images show along the motion.
        std_px: standard deviation of the ego flow, px.
    """

    motion: Motion
    pair: FramePair
    options: RefineOptions
    belief: Belief | None
    seen: SeenPoints
    std_px: float

    def refined(self) -> Aligned | None:
        """The same at full size, on the pixels that follow it; None where images add nothing."""
        pair = self.pair
        start = Motion(
            T_curr_prev=self.motion.T_curr_prev,
            covariance=PRIOR_COVARIANCE,
            weights=self.motion.weights,
        )
        motion = refine_photometric(pair, start, 1.0, self.options)
        if motion.photometric is None or not motion.photometric.taken:
            return None
        planes = self.seen.planes
        if not have_texture(pair.prev, pair.curr):
            # images without texture agree with any motion: that they do is no evidence of it
            structure = planes.structure(planes.at(motion.T_curr_prev))
            by_depth = covariance_of_sources(PRIOR_INFORMATION, structure.common)
            motion = motion.replace(covariance=by_depth)
        return _aligned(pair, motion, planes, self.options, self.belief)

    def by_belief(self) -> Motion | None:
        """The motion with what only the static part of the view says for it.

        What something nearer hides, or what no depth is measured of any more, does not speak
        against a motion.

        Returns:
            The motion; None where nothing is believed, or more than half of it is hidden.
        """
        if self.belief is None:
            return None
        seen = self.seen
        moved = transform_points(self.motion.T_curr_prev, seen.planes.points)
        there = visibility(moved, self.pair.curr, self.motion.depth_noise)
        counts = there.is_measured & ~there.is_hidden
        static = self.belief.static_weights[seen.planes.cells]
        in_view = static * seen.inside
        hidden = np.sum(in_view * ~counts) / np.maximum(np.sum(in_view), TINY)
        if hidden > MAX_HIDDEN:
            return None
        remembered = seen._replace(inside=seen.inside & counts)
        evidence = remembered.evidence(self.std_px, static)
        return self.motion.replace(
            evidence=RememberedEvidence(*evidence, self.belief.certainty),
            terms=(*self.motion.terms, Term.MEMORY),
        )


def align_images(
    pair: FramePair,
    T_start: np.ndarray | None = None,
    options: RefineOptions | None = None,
    belief: Belief | None = None,
    is_near: bool = False,
) -> Aligned | None:
    """Align reduced images and the depth maps, coarse to fine.

    Args:
        pair: two frames; their flow is not used.
        T_start: (4, 4) T_curr_prev to start from; None: the identity.
        options: of the refinement: cutoff of the robust kernels, number of tiles.
        belief: which pixels of the first frame are static; the motion is then sought on these.
        is_near: whether the start is what the most reduced images show.

    Returns:
        A rough motion, with what would speak for it if it were exact; None where an image or a
        depth map is missing, or where they do not match.
    """
    options = options or RefineOptions()
    if not (pair.prev.is_rgbd and pair.curr.is_rgbd):
        return None
    ones = np.ones(pair.prev.camera.shape, np.float32)
    weights = ones if belief is None else resized(belief.weights, ones.shape)
    few_planes = planes_of(pair, REDUCED_POINTS).weighted(weights, 0.0, options)
    if len(few_planes.index) < MIN_PLANE_POINTS:
        return None
    T = np.eye(4) if T_start is None else T_start
    T, gain = follow_images(pair, T, weights, few_planes, options, is_near)
    motion = Motion(
        T_curr_prev=T,
        covariance=np.zeros((6, 6)),
        photometric=PhotometricReport(gain=gain),
    )
    planes = planes_of(pair).weighted(ones, 1.0, options)
    return _aligned(pair, motion, planes, options, belief, is_exact=True)


def _aligned(
    pair: FramePair,
    motion: Motion,
    planes: WeightedPlanes,
    options: RefineOptions,
    belief: Belief | None,
    is_exact: bool = False,
) -> Aligned:
    """A motion with the weights of the pixels that follow it, and what speaks for it.

    Args:
        pair: two frames.
        motion: with covariance.
        planes: the points of the depth maps.
        options: of the refinement.
        belief: which pixels of the first frame are static: no others get weight.
        is_exact: whether the motion counts as exact.
    """
    at = planes.at(motion.T_curr_prev)
    seen = see_points(pair, planes, at, motion, options.cutoff, is_exact)
    std_px = ego_flow_std(pair, planes.points[seen.inside], motion)
    follows = seen.follows
    count = max(int(np.count_nonzero(seen.inside)), 1)
    inlier_ratio = int(np.count_nonzero(follows)) / count
    if belief is not None:
        follows = follows & (belief.weights[planes.cells] > MIN_BELIEVED)
    by_both = (Term.IMAGES, Term.DEPTH)
    followed = motion.replace(
        weights=resized(planes.on_grid(follows), pair.prev.camera.shape),
        inlier_ratio=inlier_ratio,
        evidence=seen.evidence(std_px),
        depth_noise=_depth_noise(at),
        terms=by_both if at.determine_motion else (Term.IMAGES,),
    )
    return Aligned(followed, pair, options, belief, seen, std_px)


def _depth_noise(at: PlanesAt) -> float:
    """Standard deviation of log depth: both depth maps contribute to a distance."""
    z = at.surface_depth
    z = z[z > 0]
    if not len(z):
        return 0.0
    return float(np.median(at.noise(z) / z) / np.sqrt(2))
