"""Fits of a motion inside a mask of the static scene."""

from __future__ import annotations

import numpy as np

from hybridvo.hypotheses.calibration import MASK_RAMP_END, MASK_RAMP_START
from hybridvo.hypotheses.types import Candidate, MotionSource
from hybridvo.solver import kernels
from hybridvo.solver.pixels import PixelGrid
from hybridvo.solver.robust_fit import fit_coarse

# in place of a sum of weights that is zero
MIN_TOTAL = 1e-9


def mask_weights(static_probability: np.ndarray) -> np.ndarray:
    """Convert probabilities of being static into weights of a fit, from 0 to 1.

    >>> mask_weights(np.array([0.3, 0.65, 0.95])).round(3).tolist()
    [0.0, 0.5, 1.0]
    """
    width = MASK_RAMP_END - MASK_RAMP_START
    ramp = (static_probability - MASK_RAMP_START) / width
    return np.clip(ramp, 0.0, 1.0).astype(np.float32)


def mask_coverage(grid: PixelGrid, mask: np.ndarray | None) -> float:
    """Fraction of the usable pixels' weight that a mask (h, w), or (n,), leaves."""
    if mask is None:
        return 1.0
    weight = grid.weight
    total = max(float(weight.sum()), MIN_TOTAL)
    return float(np.sum(weight * mask.reshape(-1))) / total


def fit_in_mask(
    samples: np.ndarray,
    mask: np.ndarray,
    K: np.ndarray,
    pose: np.ndarray,
    cutoff: float,
) -> Candidate:
    """Fit a motion to the pixels that a mask leaves.

    Args:
        samples: pixel buffer of a grid, see :mod:`hybridvo.solver.kernels`.
        mask: (h, w) weights from 0 to 1.
        K: (fx, fy, cx, cy) of the current camera, px.
        pose: (3, 4) ``T_curr_prev`` from which the fit starts.
        cutoff: c of the Geman-McClure kernel, in standard deviations.

    Returns:
        The motion; its entries may not be finite where the mask leaves too little.
    """
    masked = samples.copy()
    masked[kernels.W, : mask.size] *= mask.reshape(-1)
    fitted, (flow_noise_px, depth_noise), inlier_ratio, iterations = fit_coarse(
        masked, mask.size, K, pose, cutoff
    )
    return Candidate(
        fitted,
        inlier_ratio=float(inlier_ratio),
        flow_noise_px=float(flow_noise_px),
        depth_noise=float(depth_noise),
        source=MotionSource.REFIT,
        iterations=int(iterations),
    )
