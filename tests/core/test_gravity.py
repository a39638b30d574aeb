"""The upright world: hand-worked poses, and what holds for every direction."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

import hybridvo as hvo

ALONG = np.array([0.0, 0.0, 1.0])
"""Where a camera looks, in its own axes."""
HALF = 0.5
ROOT = np.sqrt(3) / 2


def gravity(*direction: float) -> hvo.Gravity:
    down = np.array(direction) / np.linalg.norm(direction)
    return hvo.Gravity(down, 1e-4 * (np.eye(3) - np.outer(down, down)))


def upright(made: hvo.Gravity, vector: np.ndarray) -> np.ndarray:
    """A vector of the first camera in the upright world."""
    return made.T_gravity_world[:3, :3] @ vector


def test_a_level_camera_looks_along_x() -> None:
    made = gravity(0, 1, 0)
    np.testing.assert_allclose(upright(made, ALONG), [1, 0, 0], atol=1e-15)
    # its right is to the right, its lower edge is down
    np.testing.assert_allclose(upright(made, [1, 0, 0]), [0, -1, 0], atol=1e-15)
    np.testing.assert_allclose(upright(made, [0, 1, 0]), [0, 0, -1], atol=1e-15)
    np.testing.assert_array_equal(made.T_gravity_world[:3, 3], 0)


def test_a_camera_that_looks_30_degrees_down() -> None:
    # what is straight down is seen below the middle, and ahead of the camera
    made = gravity(0, ROOT, HALF)
    np.testing.assert_allclose(upright(made, ALONG), [ROOT, 0, -HALF], atol=1e-12)
    np.testing.assert_allclose(upright(made, [1, 0, 0]), [0, -1, 0], atol=1e-12)


def test_a_camera_that_is_rolled_by_30_degrees() -> None:
    # turned clockwise about where it looks: its right side hangs down
    made = gravity(HALF, ROOT, 0)
    np.testing.assert_allclose(upright(made, ALONG), [1, 0, 0], atol=1e-12)
    np.testing.assert_allclose(
        upright(made, [1, 0, 0]), [0, -ROOT, -HALF], atol=1e-12
    )


@pytest.mark.parametrize(("down", "edge"), [(1, -1), (-1, 1)])
def test_a_camera_that_looks_straight_down_or_up(down: float, edge: float) -> None:
    # the edge of the image that points ahead when the camera is tilted from the level
    made = gravity(0, 0, down)
    np.testing.assert_allclose(upright(made, ALONG), [0, 0, -down], atol=1e-15)
    np.testing.assert_allclose(upright(made, [0, edge, 0]), [1, 0, 0], atol=1e-15)


def test_the_standard_deviation_is_that_of_the_angle() -> None:
    made = gravity(0, 1, 0)
    assert made.std == pytest.approx(np.sqrt(2) * 0.01)
    said = made.summary()
    assert said["direction"] == [0.0, 1.0, 0.0]
    assert said["sigma_deg"] == pytest.approx(np.rad2deg(made.std))
    assert np.shape(said["T_gravity_world"]) == (4, 4)


@pytest.mark.slow
@given(angles=st.tuples(*[st.floats(-180, 180)] * 3))
def test_the_world_stands_upright_whatever_the_camera(angles: tuple) -> None:
    R_upright_cam = Rotation.from_euler("zyx", angles, degrees=True).as_matrix()
    down = R_upright_cam.T @ [0, 0, -1]
    T = hvo.Gravity(down, np.zeros((3, 3))).T_gravity_world
    R = T[:3, :3]
    np.testing.assert_allclose(R @ R.T, np.eye(3), atol=1e-9)
    assert np.linalg.det(R) == pytest.approx(1)
    np.testing.assert_allclose(R @ down, [0, 0, -1], atol=1e-9)
    along = R @ ALONG
    # the camera has no yaw, unless it looks nearly straight up or down
    if np.hypot(along[0], along[1]) > 0.27:
        assert np.arctan2(along[1], along[0]) == pytest.approx(0, abs=1e-9)
