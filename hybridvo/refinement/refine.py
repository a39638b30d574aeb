"""Refinement on flow and depth: from a start to a metric motion with covariance and status.

Minimises the ego-flow reprojection error (paper, equations 6 and 8) under a Geman-McClure kernel of
the Mahalanobis distance. Each pixel's covariance is that of its flow and of its depth, propagated;
both noise scales are estimated from the pair.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from hybridvo.calibration import MIN_TILES, WEAK_RATIO
from hybridvo.geometry import invert, se3_log
from hybridvo.options import RefineOptions
from hybridvo.refinement.coarse_fit import fit_coarse
from hybridvo.refinement.covariance import NOTHING, direction_is_known
from hybridvo.refinement.full_fit import FullFit, fit_full_grid
from hybridvo.refinement.pixels import CoarseGrid, coarse_grid
from hybridvo.results import Hypothesis, Reason, RelativePose, Status
from hybridvo.types import FramePair

MIN_INLIER_RATIO = 0.02
"""Share of the pixels that must follow the motion, else it is none."""
LOW_INLIER_RATIO = 0.25
"""Share of the pixels below which the motion is degraded."""


@dataclass(frozen=True, eq=False)
class Context:
    """What the selection knows of the motion to be refined.

    Args:
        noise: (flow px, log depth) standard deviations found with it, or None.
        coverage: share of the usable pixels' weight that the static mask leaves.
        probability, min_probability: of being the camera's motion; below which it is degraded.
        hypotheses: every motion found, the selected one first.
        iterations: Gauss-Newton steps spent so far.
    """

    noise: tuple[float, float] | None = None
    coverage: float = 1.0
    probability: float = 1.0
    min_probability: float = 0.0
    hypotheses: tuple[Hypothesis, ...] = ()
    iterations: int = 0


def refine_pair(
    pair: FramePair,
    T_init: np.ndarray,
    grid: CoarseGrid | None = None,
    weights: np.ndarray | None = None,
    options: RefineOptions | None = None,
    context: Context | None = None,
) -> RelativePose:
    """The motion of a pair near its only start (4, 4).

    ``grid``: coarse grid of the pair, with the weights; None: it is made, with ``weights`` (H, W),
    factors on the information of each pixel.
    """
    options, context = options or RefineOptions(), context or Context()
    if grid is None:
        made = coarse_grid(pair, weights, options)
        if isinstance(made, RelativePose):
            return made
        grid = made
    pose = np.ascontiguousarray(T_init[:3], dtype=np.float64)
    iterations, noise = context.iterations, context.noise
    if noise is None:
        pose, sf, sd, _, iterations = fit_coarse(
            grid.samples, grid.count, grid.pixels.K, pose, options.cutoff
        )
        noise = sf, sd
    fit = fit_full_grid(pair, grid, pose, noise, options)
    motion = fit.motion.replace(
        inlier_ratio=min(1.0, fit.motion.inlier_ratio * context.coverage),
        iterations=iterations + fit.motion.iterations,
        hypotheses=context.hypotheses,
        probability=context.probability,
    )
    status = _status(fit, motion.inlier_ratio, context)
    if not status.usable:
        nothing = {"T_curr_prev": np.eye(4), "covariance": NOTHING.copy(), "probability": 0.0}
        return motion.replace(status=status, **nothing)
    covariance = _with_doubt(fit)
    valid = direction_is_known(motion.T_curr_prev, covariance)
    return motion.replace(status=status, covariance=covariance, translation_direction_valid=valid)


def _status(fit: FullFit, share: float, context: Context) -> Status:
    """Status of a fit."""
    agreement, depth, weak = fit.depths, None, None
    if agreement is not None and agreement.doubt:
        depth = Reason.NO_VALID_DEPTH, agreement.doubt
    eigenvalues = fit.motion.information_eigenvalues
    if eigenvalues[0] < WEAK_RATIO * eigenvalues[-1]:
        weak = Reason.DEGENERATE_GEOMETRY, "a direction of the motion is barely determined"
    elif fit.tiles < MIN_TILES:
        weak = (
            Reason.DEGENERATE_GEOMETRY,
            "the pixels cover too little of the image to tell how far their errors agree",
        )
    sure = context.probability, context.min_probability
    status = status_of(fit.definite, share, depth, *sure, weak)
    if status.usable and agreement is not None and agreement.is_none:
        return Status.failed(Reason.NO_VALID_DEPTH, agreement.doubt)
    return status


def status_of(
    definite: bool,
    share: float,
    doubt: tuple[Reason, str] | None,
    probability: float,
    min_probability: float,
    weak: tuple[Reason, str] | None = None,
) -> Status:
    """Status of a motion that ``share`` of the pixels follow; the first reason that holds."""
    if not definite:
        what = "the pixels leave a direction of the motion undetermined"
        return Status.failed(Reason.DEGENERATE_GEOMETRY, what)
    if share < MIN_INLIER_RATIO:
        return Status.failed(
            Reason.LOW_INLIERS, f"{100 * share:.1f} % of the pixels follow one motion"
        )
    if doubt is not None:
        return Status.degraded(*doubt)
    if probability < min_probability:
        return Status.degraded(
            Reason.AMBIGUOUS_MOTION,
            f"another of the motions found could be the camera's (probability of this one "
            f"{100 * probability:.0f} %)",
        )
    if weak is not None:
        return Status.degraded(*weak)
    if share < LOW_INLIER_RATIO:
        return Status.degraded(
            Reason.LOW_INLIERS, f"only {100 * share:.0f} % of the pixels follow the motion"
        )
    return Status()


def _with_doubt(fit: FullFit) -> np.ndarray:
    """(6, 6) covariance with what few tiles, and two depths that differ, leave unknown."""
    covariance = fit.motion.covariance * max(1.0, MIN_TILES / max(fit.tiles, 1))
    if fit.depths is not None and fit.depths.doubt:
        t = fit.motion.T_curr_prev[:3, 3]
        share = np.log(fit.depths.ratio) ** 2 + fit.depths.spread**2
        covariance[:3, :3] += share * np.outer(t, t)
    return covariance


def widened(motion: RelativePose) -> RelativePose:
    """An ambiguous motion with a covariance that covers the other motions it may be.

    The second moment of the mixture: with its probability the camera's motion is this one; else it
    is another of those found, or none of them, taken to be as far away as they or as standing
    still. Nothing is known of the direction, so it counts alike in all.
    """
    if motion.status.reason is not Reason.AMBIGUOUS_MOTION or not motion.usable:
        return motion
    others = [h.T_curr_prev for h in motion.hypotheses[1:]] + [np.eye(4)]
    steps = np.array([se3_log(motion.T_curr_prev @ invert(T)) for T in others])
    sizes = [np.max(np.sum(steps[:, part] ** 2, axis=1)) for part in (slice(0, 3), slice(3, 6))]
    doubt = (1 - motion.probability) * np.diag(np.repeat(sizes, 3))
    return motion.replace(covariance=motion.covariance + doubt, translation_direction_valid=False)
