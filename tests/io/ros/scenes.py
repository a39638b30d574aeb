"""A rendered drive as a bag: images, depth, camera, and a robot's fixed frames."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from hybridvo_lab.synthetic.render import Scene
from hybridvo_lab.synthetic.scenes import make_scene
from tests import bags

FRAMES = 6
SIZE = (120, 160)
BASE, LINK, OPTICAL = "base_link", "camera_link", "color_optical"
IMU = "/camera/gyro/sample"
IMU_FRAME = "gyro"
IMU_XYZW = (0.0, 0.0, np.sqrt(0.5), np.sqrt(0.5))
"""Its axes are turned by 90 degrees about the z axis of the camera's body."""
SAMPLE_NS = 5_000_000
BIAS = np.array([0.02, -0.01, 0.03])
"""Of the gyroscope, rad/s."""
OPTICAL_XYZW = (-0.5, 0.5, -0.5, 0.5)
"""How ROS turns body axes into optical ones: roll -90, yaw -90 degrees."""
MOUNT_XYZ = (0.3, 0.05, 0.8)
MOUNT_XYZW = (0.0, np.sin(0.1), 0.0, np.cos(0.1))
"""The camera looks down by 0.2 rad."""
T_BASE_OPTICAL = np.array(
    [
        # the optical z axis is body x, turned down: cos and -sin of 0.2
        [0.0, -np.sin(0.2), np.cos(0.2), 0.3],
        [-1.0, 0.0, 0.0, 0.05],
        [0.0, -np.cos(0.2), -np.sin(0.2), 0.8],
        [0.0, 0.0, 0.0, 1.0],
    ]
)


def scene(kind: str = "light") -> Scene:
    height, width = SIZE
    return make_scene(kind, 3, height=height, width=width, frames=FRAMES)


def imu_message(writer: bags.Writer, rates: np.ndarray, stamp: int) -> Any:
    """A sample of a sensor that is only a gyroscope, rad/s about its axes."""
    zero = np.zeros(9)
    return writer.make(
        "sensor_msgs/msg/Imu",
        header=writer.header(stamp, IMU_FRAME),
        orientation=writer.quaternion((0, 0, 0, 1)),
        orientation_covariance=zero,
        angular_velocity=writer.vector(rates),
        angular_velocity_covariance=zero,
        linear_acceleration=writer.vector((0, 0, 0)),
        linear_acceleration_covariance=zero,
    )


def write_imu(writer: bags.Writer, drawn: Scene) -> None:
    """Write what a gyroscope measures while the scene is seen, with a bias."""
    R_link_optical = Rotation.from_quat(OPTICAL_XYZW)
    R_link_imu = Rotation.from_quat(IMU_XYZW)
    R_imu_cam = (R_link_imu.inv() * R_link_optical).as_matrix()
    R_world_cam = drawn.T_world_cam[:, :3, :3]
    last = bags.stamp(FRAMES)
    for stamp in range(bags.START - SAMPLE_NS, last, SAMPLE_NS):
        moment = (stamp - bags.START) * 30 // 10**9
        i = int(np.clip(moment, 0, FRAMES - 2))
        turn = Rotation.from_matrix(R_world_cam[i].T @ R_world_cam[i + 1])
        rates = R_imu_cam @ turn.as_rotvec() * 30 + BIAS
        writer.write(IMU, imu_message(writer, rates, stamp), stamp)


def write(root: Path, kind: str, drawn: Scene, *, imu: bool = False) -> Path:
    """Write a bag of ``FRAMES`` frames; its transforms come first."""
    writer = bags.Writer(root, kind)
    fixed = writer.tf(
        writer.transform(BASE, LINK, MOUNT_XYZ, MOUNT_XYZW),
        writer.transform(LINK, OPTICAL, (0, 0, 0), OPTICAL_XYZW),
        writer.transform(LINK, IMU_FRAME, (0, 0, 0), IMU_XYZW),
    )
    writer.write("/tf_static", fixed, bags.START - 100_000_000)
    camera = drawn.camera
    k = (camera.fx, camera.fy, camera.cx, camera.cy)
    for i in range(FRAMES):
        time = bags.stamp(i)
        frame = drawn.render(i)
        depth = np.where(np.isfinite(frame.depth), 1000 * frame.depth, 0)
        millimetres = depth.clip(0, 65000).astype(np.uint16)
        info = writer.info(k, SIZE, OPTICAL)
        writer.write(bags.INFO, info, time)
        image = writer.image(frame.rgb, "rgb8", time, OPTICAL)
        writer.write(bags.RGB, image, time + 1)
        image = writer.image(millimetres, "16UC1", time, OPTICAL)
        writer.write(bags.DEPTH, image, time + 2)
    if imu:
        write_imu(writer, drawn)
    return writer.close()


def pose(message: Any) -> np.ndarray:
    inner = message.pose.pose
    q = inner.orientation
    T = np.eye(4)
    T[:3, :3] = Rotation.from_quat([q.x, q.y, q.z, q.w]).as_matrix()
    T[:3, 3] = inner.position.x, inner.position.y, inner.position.z
    return T
