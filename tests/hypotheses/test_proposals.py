"""Motions of windows and of three pixels, and their scores, against numbers by hand and OpenCV."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from hybridvo.core.geometry import se3_exp
from hybridvo.hypotheses.proposals import (
    fit_minimal,
    fit_minimal_samples,
    fit_windows,
    score_poses,
    sum_normal_equations,
)

K = np.array([100.0, 110.0, 79.5, 59.5])
ROWS = 24
COLUMNS = 32
MOTION = se3_exp(np.array([0.05, -0.03, 0.10, 0.01, -0.02, 0.03]))[:3]
OTHER = se3_exp(np.array([-0.20, 0.05, 0.00, 0.02, 0.03, -0.01]))[:3]
ALL = np.arange(3)


def project(points: np.ndarray, pose: np.ndarray) -> np.ndarray:
    """(N, 2) px of points (N, 3), by OpenCV."""
    camera = np.array([[K[0], 0, K[2]], [0, K[1], K[3]], [0, 0, 1]])
    rotation = cv2.Rodrigues(pose[:, :3])[0]
    return cv2.projectPoints(points, rotation, pose[:, 3], camera, None)[0][:, 0]


def buffer_of(points: np.ndarray, targets: np.ndarray) -> np.ndarray:
    """A pixel buffer, in the order of rows that ``refinement.kernels`` names."""
    x, y, z = points.T
    u, v = targets.T
    one = np.ones_like(z)
    return np.stack([x / z, y / z, z, u, v, one, one, one]).astype(np.float32)


def grid_points() -> np.ndarray:
    """(N, 3) points at 3 to 5 m on a grid of rays, row by row."""
    v, u = np.mgrid[:ROWS, :COLUMNS]
    depth = 4 + np.sin(u / 3.0) * np.cos(v / 4.0)
    rays = np.stack([(u - 15.5) / 25, (v - 11.5) / 25, np.ones_like(depth)], -1)
    return (rays * depth[..., None]).reshape(-1, 3)


def error(pose: np.ndarray, true: np.ndarray) -> float:
    return float(np.abs(pose - true).max())


def test_three_pixels_give_a_shift_worked_by_hand() -> None:
    # 0.1 m to the right at 2 m and fx = 100 px are 5 px
    points = np.array([[-1.0, -0.5, 2.0], [1.0, -0.4, 2.0], [0.1, 0.8, 2.0]])
    here = np.array([[29.5, 32.0], [129.5, 37.5], [84.5, 103.5]])
    pose = np.empty((3, 4))
    assert fit_minimal(buffer_of(points, here + [5.0, 0.0]), ALL, pose, K)
    expected = np.eye(3, 4)
    expected[0, 3] = 0.1
    # float32 coordinates of 100 px are good to 1e-5 px, 1e-7 of the focal length
    np.testing.assert_allclose(pose, expected, atol=2e-6)


def test_three_pixels_give_the_motion_that_opencv_projects_with() -> None:
    points = np.array([[-1.0, -0.7, 2.0], [1.3, -0.4, 3.0], [0.1, 0.8, 2.5]])
    samples = buffer_of(points, project(points, MOTION))
    pose = np.empty((3, 4))
    assert fit_minimal(samples, ALL, pose, K)
    # what is left after three Newton steps from the identity
    assert error(pose, MOTION) < 1e-4
    assert np.abs(project(points, pose) - project(points, MOTION)).max() < 1e-2


def test_three_pixels_that_determine_no_motion_are_refused() -> None:
    points = np.array([[-1.0, -0.7, 2.0], [1.3, -0.4, 3.0], [0.1, 0.8, 2.5]])
    pose = np.empty((3, 4))
    same = points[[0, 0, 1]]
    assert not fit_minimal(buffer_of(same, project(same, MOTION)), ALL, pose, K)
    behind = points.copy()
    behind[1, 2] = -3.0
    assert not fit_minimal(buffer_of(behind, project(points, MOTION)), ALL, pose, K)


def test_normal_equations_are_those_of_numpy() -> None:
    equations = np.random.default_rng(0).normal(size=(6, 7))
    sums = np.empty(27)
    sum_normal_equations(equations, sums)
    J = equations[:, :6]
    np.testing.assert_allclose(sums[:21], (J.T @ J)[np.triu_indices(6)])
    np.testing.assert_allclose(sums[21:], J.T @ equations[:, 6])


def test_windows_give_the_motions_of_both_halves() -> None:
    points = grid_points()
    targets = project(points, MOTION)
    is_right = np.tile(np.arange(COLUMNS) >= COLUMNS // 2, ROWS)
    targets[is_right] = project(points, OTHER)[is_right]
    poses = fit_windows(buffer_of(points, targets), ROWS, COLUMNS, K)
    assert len(poses) == 12
    for true in (MOTION, OTHER):
        # exact data, but the kernel stops shrinking at 0.7 px
        assert min(error(pose, true) for pose in poses) < 1e-3


def test_minimal_samples_find_a_motion_of_one_third() -> None:
    points = grid_points()
    targets = project(points, MOTION)
    is_other = np.tile(np.arange(COLUMNS) < COLUMNS // 3, ROWS)
    targets[is_other] = project(points, OTHER)[is_other]
    samples = buffer_of(points, targets)
    rng = np.random.default_rng(0)
    poses = fit_minimal_samples(samples, ROWS, COLUMNS, K, 90, rng)
    assert 45 < len(poses) <= 90
    scores = score_poses(samples, len(points), poses, K)
    assert error(poses[np.argmax(scores)], MOTION) < 1e-2
    assert min(error(pose, OTHER) for pose in poses) < 1e-2
    samples[7, 2:] = 0.0
    assert len(fit_minimal_samples(samples, ROWS, COLUMNS, K, 90, rng)) == 0


@pytest.mark.parametrize(
    ("residual_px", "score"),
    [
        (0.0, 1.0),
        # 1 / (1 + 44.4 * 0.0225) and 1 / (1 + 1.2 * 0.0225)^2
        (0.15, 0.5 * 0.50025 + 0.5 * 0.94812),
        # 1 / (1 + 44.4 * 0.81) and 1 / (1 + 1.2 * 0.81)^2
        (0.9, 0.5 * 0.027055 + 0.5 * 0.257148),
    ],
)
def test_the_score_of_one_pixel_by_hand(residual_px: float, score: float) -> None:
    points = np.array([[0.0, 0.0, 2.0]])
    target = np.array([[79.5 + residual_px, 59.5]])
    got = score_poses(buffer_of(points, target), 1, np.eye(3, 4)[None], K)
    # the kernel is in float32: 1e-5 px of the target are 1e-4 of its sharp half
    assert got[0] == pytest.approx(score, abs=2e-4)


def test_an_exact_motion_of_few_pixels_loses_to_one_of_many() -> None:
    points = grid_points()
    targets = project(points, MOTION)
    is_other = np.tile(np.arange(COLUMNS) < COLUMNS // 3, ROWS)
    targets[is_other] = project(points, OTHER)[is_other]
    samples = buffer_of(points, targets)
    vague = se3_exp(np.array([0.0, 0.0, 0.0, 0.002, 0.0, 0.0]))[:3]
    vague = (np.vstack([vague, [0, 0, 0, 1]]) @ np.vstack([MOTION, [0, 0, 0, 1]]))[
        :3
    ]
    broken = np.full((3, 4), np.nan)
    behind = np.eye(3, 4)
    behind[2, 3] = -10.0
    poses = np.stack([OTHER, MOTION, np.eye(3, 4), vague, broken, behind])
    scores = score_poses(samples, len(points), poses, K)
    other, exact, identity, near, not_finite, nothing_in_front = scores
    assert exact > near > identity
    assert exact > other > identity
    assert exact == pytest.approx((~is_other).sum(), rel=0.02)
    assert not_finite == nothing_in_front == 0.0
    # a pixel counts by its weight
    samples[7, ~is_other] = 0.1
    exact_other = score_poses(samples, len(points), poses, K)[0]
    assert exact_other > score_poses(samples, len(points), poses, K)[1]
