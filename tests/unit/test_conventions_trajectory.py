"""Conventions of trajectories, with numbers worked by hand."""

from __future__ import annotations

import numpy as np

from hybridvo.geometry import euler_deg_to_matrix, make_transform
from hybridvo.trajectory import Trajectory, chain, read_trajectory, write_tum


def test_forward_motion_moves_the_camera_along_world_z():
    # the camera goes 1 m forward: points come 1 m nearer, so T_curr_prev has t = (0, 0, -1)
    forward = make_transform(np.eye(3), np.array([0.0, 0.0, -1.0]))
    trajectory = Trajectory.from_relative([forward, forward], [0.0, 0.1, 0.2])
    np.testing.assert_allclose(trajectory.positions, [[0, 0, 0], [0, 0, 1], [0, 0, 2]])


def test_turn_right_then_forward():
    # turning right by 90 deg about y (down): what was ahead (0, 0, 1) is now at the left (-1, 0, 0)
    turn = make_transform(euler_deg_to_matrix(np.array([0.0, -90.0, 0.0])), np.zeros(3))
    np.testing.assert_allclose(turn[:3, :3] @ [0, 0, 1], [-1, 0, 0], atol=1e-15)
    forward = make_transform(np.eye(3), np.array([0.0, 0.0, -1.0]))
    trajectory = Trajectory.from_relative([turn, forward], [0.0, 1.0, 2.0])
    # after the turn, forward is to the right of the world: +x
    np.testing.assert_allclose(trajectory.positions[2], [1, 0, 0], atol=1e-15)


def test_chain_is_t_world_prev_times_inverse_of_t_curr_prev():
    T_world_prev = make_transform(np.eye(3), np.array([10.0, 0.0, 0.0]))
    T_curr_prev = make_transform(np.eye(3), np.array([-1.0, 2.0, 0.0]))
    np.testing.assert_allclose(chain(T_world_prev, T_curr_prev)[:3, 3], [11, -2, 0])


def test_world_is_the_first_camera_unless_given():
    assert (Trajectory.from_relative([], [0.0]).T_world_cam[0] == np.eye(4)).all()
    first = make_transform(np.eye(3), np.array([1.0, 2.0, 3.0]))
    given = Trajectory.from_relative([np.eye(4)], [0.0, 1.0], first)
    np.testing.assert_allclose(given.positions, [[1, 2, 3], [1, 2, 3]])


def test_tum_files_hold_camera_to_world_and_quaternions_xyzw(tmp_path):
    # 90 deg about z: q = (0, 0, sin 45, cos 45) in xyzw
    T = make_transform(np.array([[0, -1, 0], [1, 0, 0], [0, 0, 1.0]]), np.array([1.0, 2.0, 3.0]))
    write_tum(Trajectory([4.0], T[None]), tmp_path / "t")
    row = [float(value) for value in (tmp_path / "t").read_text().split()]
    np.testing.assert_allclose(row, [4, 1, 2, 3, 0, 0, 0.5**0.5, 0.5**0.5], atol=1e-15)
    np.testing.assert_allclose(read_trajectory(tmp_path / "t").T_world_cam[0], T, atol=1e-15)


def test_stamps_above_1e14_are_nanoseconds(tmp_path):
    (tmp_path / "t").write_text("2e14 0 0 0 0 0 0 1\n")
    assert read_trajectory(tmp_path / "t").timestamps[0] == 2e5
    (tmp_path / "t").write_text("1e14 0 0 0 0 0 0 1\n")
    assert read_trajectory(tmp_path / "t").timestamps[0] == 1e14
