"""Velocities with covariance for PX4: MAVLink's ODOMETRY, as its EKF2 fuses them.

python examples/px4_odometry.py realsense udpout:127.0.0.1:14540
"""

from __future__ import annotations

import sys
from typing import Any

import numpy as np

import hybridvo as hvo
from hybridvo.io.cameras.choose import choose_camera
from hybridvo.io.live import stream
from hybridvo.io.ros.conversions import base_mount, twist

T_FRD_CAM = np.eye(4)
"""From the camera (right, down, ahead) to the vehicle (ahead, right, down), m."""
T_FRD_CAM[:3, :3] = [[0, 0, 1], [1, 0, 0], [0, 1, 0]]
MOUNT = base_mount("base_link", T_FRD_CAM)
UNKNOWN = float("nan")
SPEEDS = ("vx", "vy", "vz", "rollspeed", "pitchspeed", "yawspeed")
FRAMES = {"frame_id": 20, "child_frame_id": 12, "estimator_type": 2}
"""MAV_FRAME_LOCAL_FRD, MAV_FRAME_BODY_FRD, MAV_ESTIMATOR_TYPE_VISION."""


def odometry(step: hvo.Step, seconds: float, resets: int = 0) -> dict[str, Any]:
    """The fields of the message: the velocity of a step that took some seconds."""
    motion = twist(step.T_curr_prev, step.covariance, seconds, MOUNT)
    return FRAMES | {
        "time_usec": int(1e6 * step.timestamp),
        **dict.fromkeys("xyz", UNKNOWN),
        "q": [UNKNOWN] * 4,
        **dict(zip(SPEEDS, motion.velocity.tolist(), strict=True)),
        "pose_covariance": [UNKNOWN] * 21,
        # rows of the upper triangle: variances are at 0, 6, 11, 15, 18 and 20
        "velocity_covariance": motion.covariance[np.triu_indices(6)].tolist(),
        "reset_counter": resets,
        "quality": round(100 * step.probability) if step.usable else -1,
    }


def main(camera: str, link: str) -> None:
    """Track a camera and send each step."""
    from pymavlink import mavutil  # pip install pymavlink

    send = mavutil.mavlink_connection(link).mav.odometry_send
    stamps: dict[int, float] = {}
    for live in stream(choose_camera(camera), hvo.Odometry()):
        step = live.step
        stamps[step.index] = step.timestamp
        if step.prev_index is not None:
            send(**odometry(step, step.timestamp - stamps[step.prev_index]))


if __name__ == "__main__":
    if len(sys.argv) != 3:
        sys.exit("expected a camera and a link, as in the first lines of this file")
    main(*sys.argv[1:])
