"""Cues that tell the motion of the static scene from that of an object, without any network.

One rigid object on 60 % of the image holds more pixels than the static scene, so the inlier ratio
alone decides wrongly.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from hybridvo.calibration import CUE_WEIGHTS
from hybridvo.geometry import invert, se3_log
from hybridvo.hypotheses.generate import HypothesisSet
from hybridvo.refinement import kernels
from hybridvo.results import Hypothesis, MotionPrior

BORDER = 0.06
"""Width of the border band, as a share of the image's shorter side (at least one cell)."""
SMALL = 0.2
"""Inlier ratio up to which a motion's size says nothing against it."""
DOMINANT = 0.8
"""Inlier ratio above which a motion is the camera's whatever its cues."""
MIN_NOISE_PX = 0.05
"""Noise of the flow below which motions are equally sharp."""


def cue_scores(found: HypothesisSet, motions: Sequence[Hypothesis]) -> np.ndarray:
    """Score of each motion, larger is more likely the camera's.

    Objects are compact and mostly inside the image: their share of the image exceeds their share of
    its border, and they leave parts of it empty. The static scene is behind, reaches the border
    everywhere and is as sharply rigid as the flow allows (a compromise between two motions is not).
    """
    h, w, _ = found.grid.shape
    usable = found.grid.weight > 0
    count = max(float(np.count_nonzero(usable)), 1.0)
    depth = found.grid.samples[kernels.Z, : found.grid.count]
    log_depth = np.log(np.where(usable, depth, 1.0))
    mean_log_depth = float(log_depth.sum()) / count
    band = max(1, round(BORDER * min(h, w)))
    frame = np.ones((h, w), np.bool_)
    frame[band : h - band, band : w - band] = False
    border = np.flatnonzero(usable & frame.ravel())
    cell = np.minimum(np.arange(h) * 4 // h, 3)[:, None] * 4 + np.minimum(np.arange(w) * 4 // w, 3)
    cell = cell.ravel()
    available = np.bincount(cell, usable, minlength=16)
    sharpest = min(max(m.flow_noise_px, MIN_NOISE_PX) for m in motions)
    scores = np.empty(len(motions))
    for k, motion in enumerate(motions):
        weight = np.where(usable, motion.inliers.ravel(), 0.0)
        total = float(weight.sum())
        share = total / count
        filled = np.bincount(cell, weight, minlength=16)[available > 0] / available[available > 0]
        spread = float(np.minimum(filled / 0.25, 1.0).mean()) if filled.size else 0.0
        behind = float(weight @ log_depth) / max(total, 1e-9) - mean_log_depth
        on_border = float(weight[border].sum()) / max(len(border), 1)
        cues = {
            "border": on_border,
            "excess": max(share - SMALL, 0.0),
            "spread": spread,
            "behind": behind,
            "noise": np.log(max(motion.flow_noise_px, MIN_NOISE_PX) / sharpest),
            "dominant": share > DOMINANT,
        }
        scores[k] = sum(CUE_WEIGHTS[name] * value for name, value in cues.items())
    return scores


def agreement(T_curr_prev: np.ndarray, prior: MotionPrior | None) -> float:
    """1 where a motion is the expected one, towards 0 by its distance in standard deviations."""
    if prior is None:
        return 0.0
    delta = se3_log(T_curr_prev @ invert(prior.T_curr_prev))
    return 1.0 / (1.0 + float(delta @ np.linalg.solve(prior.covariance, delta)) / len(delta))
