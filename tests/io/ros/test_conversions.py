"""Poses, twists and covariances in the frames of ROS: numbers worked by hand."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

import hybridvo as hvo
from hybridvo.core.geometry import invert, make_transform, se3_exp
from hybridvo.core.results import Reason, RelativePose, Step
from hybridvo.io.ros import conversions as ros
from hybridvo.tracking.chains import PathCovariance

# body axes in optical ones: x is z, y is -x, z is -y
BODY = np.array([[0.0, 0, 1], [-1, 0, 0], [0, -1, 0]])
AHEAD = ros.base_mount("base", make_transform(BODY, np.array([1.0, 0, 0])))
"""The camera looks ahead, a metre in front of the base."""
TURN = Rotation.from_euler("y", 90, degrees=True).as_matrix()
"""To the right, about the optical y axis, which points down."""


def shift(x: float, y: float, z: float) -> np.ndarray:
    return make_transform(np.eye(3), np.array([x, y, z]))


def test_optical_axes_become_body_axes() -> None:
    mount = ros.optical_mount("optical")
    # 1 m to the right, 2 m down, 3 m ahead
    T = ros.pose_in_odom(shift(1, 2, 3), mount)
    np.testing.assert_allclose(T[:3, 3], [3, -1, -2])
    np.testing.assert_allclose(T[:3, :3], BODY)


def test_the_base_swings_round_a_camera_that_turns() -> None:
    # the camera stays a metre ahead of the origin and looks to the right, along -y: the base,
    # a metre behind it, is at (1, 1)
    T = ros.pose_in_odom(make_transform(TURN, np.zeros(3)), AHEAD)
    np.testing.assert_allclose(T[:3, 3], [1, 1, 0], atol=1e-15)
    angles = Rotation.from_matrix(T[:3, :3]).as_euler("xyz", degrees=True)
    np.testing.assert_allclose(angles, [0, 0, -90], atol=1e-12)


def test_variances_go_with_their_axes() -> None:
    mount = ros.optical_mount("optical")
    variances = np.diag([1.0, 2, 3, 4, 5, 6])
    pose = ros.pose_in_odom(np.eye(4), mount)
    turned = ros.pose_covariance(variances, pose, mount)
    np.testing.assert_allclose(turned, np.diag([3.0, 1, 2, 6, 4, 5]), atol=1e-15)
    # after a turn to the right, ahead is -y of odom, and left is x
    pose = ros.pose_in_odom(make_transform(TURN, np.zeros(3)), mount)
    turned = ros.pose_covariance(variances, pose, mount)
    np.testing.assert_allclose(turned, np.diag([1.0, 3, 2, 4, 6, 5]), atol=1e-15)


def test_a_doubtful_turn_moves_the_base_sideways() -> None:
    # turned by yaw about the camera, the base moves by yaw x (-1, 0, 0) = -yaw along y
    covariance = np.zeros((6, 6))
    covariance[4, 4] = 0.01
    turned = ros.pose_covariance(covariance, np.eye(4), AHEAD)
    expected = np.zeros((6, 6))
    expected[1, 1] = expected[5, 5] = 0.01
    expected[1, 5] = expected[5, 1] = -0.01
    np.testing.assert_allclose(turned, expected, atol=1e-15)


def test_pose_covariance_by_sampling() -> None:
    rng = np.random.default_rng(3)
    turn = Rotation.from_rotvec([0.3, -0.8, 0.4]).as_matrix()
    mount = ros.base_mount("base", make_transform(turn, np.array([0.5, -1, 2])))
    T_world_cam = se3_exp(np.array([1.0, -2, 3, 0.3, 0.8, -0.4]))
    T = ros.pose_in_odom(T_world_cam, mount)
    samples = rng.normal(size=(400, 6)) @ (rng.normal(size=(6, 6)) * 1e-5).T
    seen = np.empty_like(samples)
    for row, d in zip(seen, samples, strict=True):
        disturbed = invert(se3_exp(d) @ invert(T_world_cam))
        moved = ros.pose_in_odom(disturbed, mount)
        row[:3] = moved[:3, 3] - T[:3, 3]
        row[3:] = Rotation.from_matrix(moved[:3, :3] @ T[:3, :3].T).as_rotvec()
    ours, theirs = (x.T @ x / len(x) for x in (samples, seen))
    expected = ros.pose_covariance(ours, T, mount)
    # exact to first order in 1e-5
    np.testing.assert_allclose(theirs, expected, atol=1e-3 * np.abs(expected).max())


def test_the_twist_is_in_the_axes_of_the_child() -> None:
    # 0.1 m ahead in a twentieth of a second are 2 m/s; a variance is divided by its square
    covariance = np.diag([1.0, 2, 3, 4, 5, 6])
    velocity, variances = ros.twist(shift(0, 0, -0.1), covariance, 0.05, AHEAD)
    np.testing.assert_allclose(velocity, [2, 0, 0, 0, 0, 0], atol=1e-15)
    # of the axes of rotation, only that along the arm moves nothing
    np.testing.assert_allclose(
        np.diag(variances), 400 * np.array([3, 1 + 5, 2 + 4, 6, 4, 5])
    )


def steps() -> list[Step]:
    """Five frames; the motion to the third failed, and the next one spans it."""
    rng = np.random.default_rng(5)
    found = [
        Step(0, 0.0, np.eye(4), RelativePose(covariance=np.zeros((6, 6))), None)
    ]
    for index, prev in ((1, 0), (2, 1), (3, 1), (4, 3)):
        A = 0.01 * rng.normal(size=(6, 6))
        motion = RelativePose(se3_exp(0.3 * rng.normal(size=6)), A @ A.T)
        if index == 2:
            motion = RelativePose.failed(Reason.LOW_INLIERS, "nothing fits")
        found.append(Step(index, 0.1 * index, np.eye(4), motion, prev))
    return found


def test_the_covariance_of_the_path_is_that_of_its_factors() -> None:
    path = PathCovariance()
    walked = steps()
    along = [path.add(step) for step in walked]
    for n in (1, 2, 4, 5):
        np.testing.assert_allclose(
            along[n - 1], hvo.chain_covariance(walked[:n]), rtol=1e-12, atol=0
        )
    # metres: a failed motion says nothing, until the next one spans it
    assert along[2][0, 0] > 1e4 > 1 > along[3][0, 0]
