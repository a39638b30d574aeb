"""What a fit to flow states of itself: one set of rules for both backends."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from hybridvo.core.options import RefineOptions
from hybridvo.core.results import Reason, Status
from hybridvo.solver.calibration import (
    MIN_INLIER_RATIO,
    MIN_ROBUST_SUM,
    MIN_TILES,
    WEAK_RATIO,
)
from hybridvo.solver.covariance import MotionCovariance
from hybridvo.solver.depths import DepthAgreement
from hybridvo.solver.newton import tile_size

LEFT_SEED = Status.degraded(
    Reason.SOLVER_DIVERGED,
    "the fit to all pixels leaves the region that the covariance of its seed states; the motion "
    "is that of the seed",
)


def degeneracy(
    estimate: MotionCovariance, size: tuple[int, int], options: RefineOptions
) -> str:
    """Return what makes a motion uncertain although it is determined; empty if nothing does.

    Args:
        estimate: its covariance and the tiles behind it.
        size: (H, W) of the image.
        options: how many tiles an image has.
    """
    eigenvalues = estimate.eigenvalues
    if eigenvalues[0] < WEAK_RATIO * eigenvalues[-1]:
        return "a direction of the motion is barely determined"
    tiles_of_image = np.prod(size) / tile_size(size, options.tiles) ** 2
    if estimate.tiles < MIN_TILES <= 0.5 * tiles_of_image:
        return "the pixels cover too little of the image to measure how far their errors agree"
    return ""


class FitSummary(NamedTuple):
    """What a fit on all pixels of a pair leaves to judge it by, from either backend.

    Attributes:
        is_determined: whether the pixels determine all six directions of the motion.
        inlier_ratio: fraction of the weight within the robust kernel's cutoff; see
            :class:`~hybridvo.core.results.RelativePose`.
        followers: sum of the robust weights without the external ones: about how many
            pixels follow the motion.
        converged: whether the step that is left is shorter than the solver's tolerance.
        max_steps: steps that the solver may make.
        is_seed: whether the motion is that of the seed, because the solution lies outside of the
            region that its covariance states.
    """

    is_determined: bool
    inlier_ratio: float
    followers: float
    converged: bool
    max_steps: int
    is_seed: bool = False


def status_of(
    fit: FitSummary, depths: DepthAgreement | None, degenerate: str = ""
) -> Status:
    """Return the status of a fit: the first reason that holds, the gravest first.

    Args:
        fit: on all pixels.
        depths: how the depths of both frames compare along the motion, or None.
        degenerate: what :func:`degeneracy` states.
    """
    if not fit.is_determined:
        return Status.failed(
            Reason.DEGENERATE_GEOMETRY,
            "the pixels leave a direction of the motion undetermined",
        )
    if fit.inlier_ratio < MIN_INLIER_RATIO or fit.followers < MIN_ROBUST_SUM:
        return Status.failed(
            Reason.LOW_INLIERS,
            f"{100 * fit.inlier_ratio:.1f} % of pixels follow one motion, about "
            f"{fit.followers:.0f} of them",
        )
    if depths is not None and not depths.status.ok:
        return depths.status
    if not fit.converged:
        return Status.degraded(
            Reason.SOLVER_DIVERGED, f"not converged after {fit.max_steps} steps"
        )
    if fit.is_seed:
        return LEFT_SEED
    if degenerate:
        return Status.degraded(Reason.DEGENERATE_GEOMETRY, degenerate)
    return Status()
