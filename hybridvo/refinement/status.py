"""When a refined motion is ok, degraded or failed: one set of rules for both backends."""

from __future__ import annotations

import numpy as np

from hybridvo.calibration import MIN_INLIER_RATIO, MIN_TILES, WEAK_RATIO
from hybridvo.geometry import invert, se3_log
from hybridvo.options import RefineOptions
from hybridvo.refinement.covariance import MotionCovariance
from hybridvo.refinement.solver import tile_size
from hybridvo.results import Reason, RelativePose, Status


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


def status_of(
    is_determined: bool,
    inlier_ratio: float,
    other: Status,
    probability: float,
    min_probability: float,
    degenerate: str = "",
) -> Status:
    """Return the status of a motion: the first reason that holds, the gravest first.

    Args:
        is_determined: whether the pixels determine all six directions.
        inlier_ratio: fraction of the pixels that follow the motion.
        other: the status by other evidence, such as the current depth.
        probability: that this is the camera's motion.
        min_probability: below it the motion is degraded.
        degenerate: what :func:`degeneracy` states.
    """
    if not is_determined:
        return Status.failed(
            Reason.DEGENERATE_GEOMETRY,
            "the pixels leave a direction of the motion undetermined",
        )
    if inlier_ratio < MIN_INLIER_RATIO:
        return Status.failed(
            Reason.LOW_INLIERS,
            f"{100 * inlier_ratio:.1f} % of pixels follow one motion",
        )
    if not other.ok:
        return other
    if probability < min_probability:
        return ambiguous(probability)
    if degenerate:
        return Status.degraded(Reason.DEGENERATE_GEOMETRY, degenerate)
    return Status()


def ambiguous(probability: float) -> Status:
    """Return the status of a motion that may be an object's."""
    what = "another of the motions found could be the camera's (probability of this one"
    return Status.degraded(
        Reason.AMBIGUOUS_MOTION, f"{what} {100 * probability:.0f} %)"
    )


def inflate_ambiguous_covariance(motion: RelativePose) -> RelativePose:
    """Return an ambiguous motion with a covariance that covers the other motions as well.

    It is the second moment of a mixture: where this motion is wrong, the camera's is taken to be
    as far away as the farthest of the others or standing still.
    """
    others = [h.T_curr_prev for h in motion.hypotheses[1:]] + [np.eye(4)]
    steps = np.array([se3_log(motion.T_curr_prev @ invert(T)) for T in others])
    translation2 = np.max(np.sum(steps[:, :3] ** 2, axis=1))
    rotation2 = np.max(np.sum(steps[:, 3:] ** 2, axis=1))
    variances = np.repeat([translation2, rotation2], 3)
    inflation = (1 - motion.probability) * np.diag(variances)
    return motion.replace(covariance=motion.covariance + inflation)
