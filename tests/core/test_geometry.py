"""The ego-flow error of two motions, by hand, and the examples of the docstrings."""

from __future__ import annotations

import numpy as np
import pytest

from hybridvo.core.geometry import (
    ego_flow,
    ego_flow_error,
    make_transform,
    se3_exp,
    transform_points,
    valid_depth,
)
from hybridvo.core.types import Camera

CAMERA = Camera(fx=100, fy=100, cx=2, cy=1, height=3, width=5)


def moved(x: float, y: float, z: float) -> np.ndarray:
    return make_transform(np.eye(3), np.array([x, y, z]))


def error(T: np.ndarray, T_reference: np.ndarray, depth: np.ndarray) -> float:
    return ego_flow_error(T, T_reference, depth, CAMERA, CAMERA)


def test_ego_flow_error_by_hand() -> None:
    # 3 cm to the right and 4 cm down move a point at 1 m by 3 and 4 px at f = 100
    depth = np.full(CAMERA.shape, 1.0)
    assert error(moved(0.03, 0.04, 0), np.eye(4), depth) == pytest.approx(5)
    # at 2 m by half of that; pixels without depth do not count
    depth[:, 1:] = 2.0
    depth[0, 0] = np.nan
    depth[1, 0] = 0.0
    expected = (1 * 5 + 12 * 2.5) / 13
    assert error(moved(0.03, 0.04, 0), np.eye(4), depth) == pytest.approx(expected)


def test_a_point_behind_the_camera_counts_as_the_diagonal_and_no_more() -> None:
    depth = np.full(CAMERA.shape, 1.0)
    depth[:, 0] = 3.0
    diagonal = np.hypot(3, 5)
    # 2 m ahead: the points at 1 m are behind, those at 3 m are at 1 m
    ahead = moved(0, 0, -2)
    near = np.abs(ego_flow(depth, ahead, CAMERA, CAMERA)[:, 0])
    lengths = np.minimum(np.hypot(near[:, 0], near[:, 1]), diagonal)
    expected = (lengths.sum() + 12 * diagonal) / 15
    assert error(ahead, np.eye(4), depth) == pytest.approx(expected)
    # a point just before the camera lands far outside of the image
    assert error(moved(0, 1, -0.999), np.eye(4), depth) <= diagonal


def test_points_that_the_reference_puts_behind_the_camera_do_not_count() -> None:
    depth = np.full(CAMERA.shape, 1.0)
    depth[:, 0] = 3.0
    ahead = moved(0, 0, -2)
    assert error(ahead, ahead, depth) == 0.0
    assert np.isnan(error(np.eye(4), moved(0, 0, -5), depth))
    assert np.isnan(error(np.eye(4), np.eye(4), np.zeros(CAMERA.shape)))


def test_points_are_transformed_as_homogeneous_ones(rng) -> None:
    T = se3_exp(np.array([0.1, -0.2, 0.3, 0.3, 0.2, -0.1]))
    points = rng.normal(size=(4, 2, 3))
    homogeneous = np.concatenate([points, np.ones((4, 2, 1))], axis=-1)
    expected = np.einsum("ij,abj->abi", T, homogeneous)[..., :3]
    np.testing.assert_allclose(transform_points(T, points), expected, atol=1e-12)


def test_depth_is_valid_where_finite_and_positive() -> None:
    depth = np.array([1.0, 0.0, -1.0, np.nan, np.inf])
    assert valid_depth(depth).tolist() == [True, False, False, False, False]
