"""Motions in the frames of ROS: poses, twists and their covariances. Pure functions."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from hybridvo.core.geometry import adjoint, invert, se3_log, to_ros_covariance

T_BODY_OPTICAL = np.array(
    [
        [0.0, 0.0, 1.0, 0.0],
        [-1.0, 0.0, 0.0, 0.0],
        [0.0, -1.0, 0.0, 0.0],
        [0.0, 0.0, 0.0, 1.0],
    ]
)
"""Points of an optical frame (x right, y down, z forward) in ROS's body axes (x forward, y left,
z up; REP 103), at the same place."""


class Mount(NamedTuple):
    """How the frame whose pose is published is fixed to the camera.

    Attributes:
        T_odom_world: (4, 4) from the first camera to the frame in which poses are published.
        T_child_cam: (4, 4) from the camera to the frame whose pose is published.
        child: the name of that frame.
    """

    T_odom_world: np.ndarray
    T_child_cam: np.ndarray
    child: str


def optical_mount(frame: str) -> Mount:
    """Return the mount of an optical frame: odom has body axes, and starts at the camera.

    Args:
        frame: Its name.
    """
    return Mount(T_BODY_OPTICAL, np.eye(4), frame)


def base_mount(frame: str, T_base_cam: np.ndarray) -> Mount:
    """Return the mount of a robot's base: odom is where the base is at first.

    Args:
        frame: Its name.
        T_base_cam: (4, 4) from the camera's optical frame to it.
    """
    return Mount(T_base_cam, T_base_cam, frame)


def pose_in_odom(T_world_cam: np.ndarray, mount: Mount) -> np.ndarray:
    """Return the pose (4, 4) of the child frame in odom.

    Args:
        T_world_cam: (4, 4), relative to the first camera.
        mount: How the child is fixed to the camera.

    Example:
        >>> ahead = np.eye(4)
        >>> ahead[2, 3] = 1.0  # a metre along the optical axis
        >>> pose_in_odom(ahead, optical_mount("camera"))[:3, 3].tolist()
        [1.0, 0.0, 0.0]
    """
    return mount.T_odom_world @ T_world_cam @ invert(mount.T_child_cam)


def pose_covariance(
    covariance: np.ndarray, T_odom_child: np.ndarray, mount: Mount
) -> np.ndarray:
    """Return the covariance of a ``PoseWithCovariance``: (x, y, z, rotations) in odom's axes.

    Args:
        covariance: (6, 6) of delta in ``Exp(delta) T_cam_world``, m and rad.
        T_odom_child: (4, 4) the pose.
        mount: How the child is fixed to the camera.

    Returns:
        (6, 6), m^2, m rad, rad^2.
    """
    A = adjoint(mount.T_child_cam)
    return to_ros_covariance(A @ covariance @ A.T, T_odom_child)


class Twist(NamedTuple):
    """A mean velocity in the axes of the child frame.

    Attributes:
        velocity: (6,) m/s along x, y, z; rad/s about them.
        covariance: (6, 6) of it.
    """

    velocity: np.ndarray
    covariance: np.ndarray


def twist(
    T_curr_prev: np.ndarray,
    covariance: np.ndarray,
    seconds: float,
    mount: Mount,
) -> Twist:
    """Return the mean velocity of the child frame during a motion.

    It is the constant twist that leads from the one pose to the other. Its covariance is that
    of the motion over the time; that the frame turns meanwhile is left out, which changes it by
    the fraction that the angle is of a radian.

    Args:
        T_curr_prev: (4, 4) the camera's motion, m.
        covariance: (6, 6) of delta in ``Exp(delta) T_curr_prev``, m and rad.
        seconds: How long it took, more than 0.
        mount: How the child is fixed to the camera.
    """
    X = mount.T_child_cam
    T_prev_curr = X @ invert(T_curr_prev) @ invert(X)
    A = adjoint(X)
    return Twist(se3_log(T_prev_curr) / seconds, A @ covariance @ A.T / seconds**2)
