"""The hand-made cues and the weights of masks, worked by hand."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest

from hybridvo.core.results import Hypothesis, MotionPrior
from hybridvo.hypotheses.calibration import CUE_WEIGHTS
from hybridvo.hypotheses.cues import compute_cues, cue_scores, prior_scores
from hybridvo.hypotheses.refit import mask_coverage

ROWS = 10
COLUMNS = 20


def grid_of(depth: np.ndarray, weight: np.ndarray) -> SimpleNamespace:
    """What the cues read of a grid: depth and weight of each pixel."""
    samples = np.zeros((8, ROWS * COLUMNS), np.float32)
    samples[2] = depth.ravel()
    samples[7] = weight.ravel()
    return SimpleNamespace(
        samples=samples, weight=samples[7], shape=(ROWS, COLUMNS, 4)
    )


def hypothesis(inliers: np.ndarray, flow_noise_px: float = 0.2) -> Hypothesis:
    T = np.eye(4)
    return Hypothesis(T, "window", 0.5, flow_noise_px, 0.01, inliers)


def two_layers() -> tuple[SimpleNamespace, list[Hypothesis]]:
    """A scene at 4 and 8 m, and an object of 4 x 5 pixels at 2 m inside the image."""
    depth = np.full((ROWS, COLUMNS), 4.0)
    depth[:, 10:] = 8.0
    is_object = np.zeros((ROWS, COLUMNS), bool)
    is_object[1:5, 4:9] = True
    depth[is_object] = 2.0
    inliers = [(~is_object).astype(np.float32), is_object.astype(np.float32)]
    motions = [hypothesis(inliers[0]), hypothesis(inliers[1], 0.01)]
    return grid_of(depth, np.ones_like(depth)), motions


def test_cues_by_hand() -> None:
    grid, motions = two_layers()
    cues = compute_cues(grid, motions)
    # 180 and 20 of 200 pixels; 0.01 keeps the logarithm finite
    np.testing.assert_allclose(cues.inlier_ratio, np.log([0.91, 0.11]))
    # the border is one cell wide, and the scene's alone
    np.testing.assert_allclose(cues.border_coverage, np.log([1.01, 0.01]))
    # 80 pixels at 4 m and 100 at 8 m: variance p (1 - p) log(2)^2
    variance = 80 * 100 / 180**2 * np.log(2) ** 2
    extent = 0.5 * np.log([variance + 0.03**2, 0.03**2])
    np.testing.assert_allclose(cues.depth_extent, extent, rtol=1e-6)
    mean = [(80 * np.log(4) + 100 * np.log(8)) / 180, np.log(2)]
    np.testing.assert_allclose(cues.mean_log_depth, mean, rtol=1e-6)
    # the object's noise counts as 0.05 px
    np.testing.assert_allclose(cues.flow_noise, np.log([0.2, 0.05]))


def test_pixels_without_weight_are_in_no_cue() -> None:
    grid, motions = two_layers()
    grid.weight[grid.samples[2] == 8.0] = 0.0
    cues = compute_cues(grid, motions)
    # 80 of 100 pixels, all at 4 m
    assert cues.inlier_ratio[0] == pytest.approx(np.log(0.81))
    assert cues.mean_log_depth[0] == pytest.approx(np.log(4.0))
    assert cues.depth_extent[0] == pytest.approx(np.log(0.03))


def test_the_static_scene_scores_above_an_object() -> None:
    scores = cue_scores(compute_cues(*two_layers()))
    assert scores[0] > scores[1]


def test_the_prior_adds_its_agreement() -> None:
    prior = MotionPrior(np.eye(4), np.eye(6))
    _, motions = two_layers()
    far = motions[1]
    far.T_curr_prev[0, 3] = 6.0
    # six standard deviations on one of six axes: 1 / (1 + 36 / 6)
    expected = CUE_WEIGHTS["prior"] * np.array([1.0, 1 / 7])
    np.testing.assert_allclose(prior_scores(motions, prior), expected)


def test_coverage_is_the_share_of_the_weight() -> None:
    weight = np.ones((ROWS, COLUMNS))
    weight[:, 10:] = 3.0
    grid = grid_of(np.ones_like(weight), weight)
    mask = np.zeros((ROWS, COLUMNS), np.float32)
    mask[:, :10] = 0.5
    assert mask_coverage(grid, None) == 1.0
    # half of 100 of 400
    assert mask_coverage(grid, mask) == pytest.approx(0.125)
    grid.weight[:] = 0.0
    assert mask_coverage(grid, mask) == 0.0
