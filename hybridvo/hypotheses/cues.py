"""Hand-made cues of which motion is the camera's.

A moving object is compact, in depth as well, and mostly inside the image. The static
scene is behind it, has a large extent in depth, and reaches the border of the image. Its
residuals are as small as the noise of the flow allows; a compromise between two motions
has larger ones.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from hybridvo.core.geometry import agreement
from hybridvo.core.results import Hypothesis, MotionPrior
from hybridvo.hypotheses.calibration import CUE_WEIGHTS
from hybridvo.hypotheses.refit import MIN_TOTAL
from hybridvo.solver import kernels
from hybridvo.solver.pixels import PixelGrid

# Smallest flow noise by which inliers are decided, px: below it all motions count as equally
# sharp.
MIN_INLIER_NOISE_PX = 0.05
# Width of the band along the border of the image for the cue of border coverage, over the shorter
# side of the image.
BORDER_WIDTH = 0.06
# Added to inlier ratios before their logarithm is a cue: none at all is finite.
CUE_MIN_INLIER_RATIO = 0.01
# Added in quadrature to the standard deviation of log depth before its logarithm is a cue.
CUE_MIN_DEPTH_STD = 0.03


class Cues(NamedTuple):
    """The cues of N motions, (N,) each; the names are those of ``CUE_WEIGHTS``.

    Attributes:
        inlier_ratio: log of the fraction of the usable pixels that follow the motion.
        border_coverage: log of the same fraction along the border of the image.
        depth_extent: log of the standard deviation of the inliers' log depth.
        mean_log_depth: mean log depth of the inliers, metres.
        flow_noise: log of the standard deviation of the inliers' flow, px.
    """

    inlier_ratio: np.ndarray
    border_coverage: np.ndarray
    depth_extent: np.ndarray
    mean_log_depth: np.ndarray
    flow_noise: np.ndarray


def compute_cues(grid: PixelGrid, motions: Sequence[Hypothesis]) -> Cues:
    """Compute the cues of motions from their inliers on a grid."""
    usable = np.flatnonzero(grid.weight > 0)
    per_motion = [motion.inliers.ravel()[usable] for motion in motions]
    inliers = np.stack(per_motion).astype(np.float64)
    total = np.maximum(inliers.sum(axis=1), MIN_TOTAL)
    inlier_ratio = total / max(len(usable), 1)

    is_border = _border_band(grid).ravel()[usable]
    border_ratio = inliers[:, is_border].sum(axis=1) / max(is_border.sum(), 1)

    log_depth = np.log(grid.samples[kernels.Z, usable])
    mean_log_depth = (inliers * log_depth).sum(axis=1) / total
    deviation = log_depth - mean_log_depth[:, None]
    depth_variance = (inliers * deviation**2).sum(axis=1) / total

    noise_px = [max(x.flow_noise_px, MIN_INLIER_NOISE_PX) for x in motions]
    return Cues(
        inlier_ratio=np.log(inlier_ratio + CUE_MIN_INLIER_RATIO),
        border_coverage=np.log(border_ratio + CUE_MIN_INLIER_RATIO),
        depth_extent=0.5 * np.log(depth_variance + CUE_MIN_DEPTH_STD**2),
        mean_log_depth=mean_log_depth,
        flow_noise=np.log(noise_px),
    )


def _border_band(grid: PixelGrid) -> np.ndarray:
    """(h, w) bool: the pixels of the grid along the border of the image."""
    h, w, _ = grid.shape
    width = max(1, round(BORDER_WIDTH * min(h, w)))
    is_border = np.ones((h, w), np.bool_)
    is_border[width:-width, width:-width] = False
    return is_border


def cue_scores(cues: Cues) -> np.ndarray:
    """(N,) log odds of each motion to be the camera's, up to a constant."""
    weighted = [CUE_WEIGHTS[name] * cue for name, cue in cues._asdict().items()]
    return np.sum(weighted, axis=0)


def prior_scores(motions: Sequence[Hypothesis], prior: MotionPrior) -> np.ndarray:
    """(N,) what the agreement with the expected motion adds to those log odds."""
    agreements = [
        agreement(motion.T_curr_prev, prior.T_curr_prev, prior.covariance)
        for motion in motions
    ]
    return CUE_WEIGHTS["prior"] * np.array(agreements)
