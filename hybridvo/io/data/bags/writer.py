"""Writing a bag of ROS 1 or ROS 2: colour, registered depth, camera, and true poses."""

from __future__ import annotations

import contextlib
from importlib.util import find_spec
from pathlib import Path
from typing import Any, Literal

import numpy as np
from scipy.spatial.transform import Rotation

from hybridvo.core.errors import InputError, OutputError
from hybridvo.core.types import Camera
from hybridvo.io.data.bags.messages import IMAGE_TYPE, INFO_TYPE

Ros = Literal["ros1", "ros2"]
RGB_TOPIC = "/camera/color/image_raw"
DEPTH_TOPIC = "/camera/aligned_depth_to_color/image_raw"
INFO_TOPIC = "/camera/color/camera_info"
TRUTH_TOPIC = "/ground_truth/camera"
"""Topics by the names of RealSense's node; that of true poses is ``T_world_cam``."""
CAMERA_FRAME = "camera_color_optical_frame"
WORLD_FRAME = "world"
POSE_TYPE = "geometry_msgs/msg/TransformStamped"


class BagWriter:
    """Writes messages into a new bag: a file of ROS 1, or a folder of ROS 2 (mcap).

    Args:
        path: The file, or the folder; it must not be there.
        ros: Which of the two.

    Raises:
        InputError: rosbags is not installed.
        OutputError: The bag cannot be written.
    """

    def __init__(self, path: Path, ros: Ros) -> None:
        if find_spec("rosbags") is None:
            raise InputError(
                f"{path}: bags are written by rosbags: pip install 'hybridvo[bags]'."
            )
        from rosbags import rosbag1, rosbag2
        from rosbags.typesys import Stores, get_typestore

        self.path = path
        self.is_ros1 = ros == "ros1"
        store = Stores.ROS1_NOETIC if self.is_ros1 else Stores.ROS2_HUMBLE
        self._types = get_typestore(store)
        self._connections: dict[str, Any] = {}
        if self.is_ros1:
            self._writer: Any = rosbag1.Writer(path)
        else:
            mcap = rosbag2.StoragePlugin.MCAP
            self._writer = rosbag2.Writer(path, version=8, storage_plugin=mcap)
        with self._errors():
            path.parent.mkdir(parents=True, exist_ok=True)
            self._writer.open()

    def close(self) -> None:
        """Write the index, without which the bag is not whole."""
        with self._errors():
            self._writer.close()

    def discard(self) -> None:
        """Close a bag that did not become whole; its file is left."""
        # errors of many kinds
        with contextlib.suppress(Exception):
            self._writer.close()

    def image(
        self, topic: str, pixels: np.ndarray, encoding: str, stamp: float
    ) -> None:
        """Write an image, (H, W) or (H, W, 3), in a type that ``encoding`` names."""
        height, width = pixels.shape[:2]
        data = np.ascontiguousarray(pixels).view(np.uint8).reshape(height, -1)
        self._write(
            topic,
            IMAGE_TYPE,
            stamp,
            height=height,
            width=width,
            encoding=encoding,
            is_bigendian=0,
            step=data.shape[1],
            data=data.reshape(-1),
        )

    def camera(self, camera: Camera, stamp: float) -> None:
        """Write the camera of images without distortion."""
        K = camera.K.astype(np.float64)
        P = np.hstack([K, np.zeros((3, 1))])
        numbers = {"d": np.zeros(5), "k": K, "r": np.eye(3), "p": P}
        matrices: dict[str, Any] = {
            name.upper() if self.is_ros1 else name: matrix.reshape(-1)
            for name, matrix in numbers.items()
        }
        roi = self._make(
            "sensor_msgs/msg/RegionOfInterest",
            x_offset=0,
            y_offset=0,
            height=0,
            width=0,
            do_rectify=False,
        )
        self._write(
            INFO_TOPIC,
            INFO_TYPE,
            stamp,
            height=camera.height,
            width=camera.width,
            distortion_model="plumb_bob",
            binning_x=0,
            binning_y=0,
            roi=roi,
            **matrices,
        )

    def pose(self, T_world_cam: np.ndarray, stamp: float) -> None:
        """Write a true pose (4, 4) of the camera."""
        x, y, z = T_world_cam[:3, 3].tolist()
        rotation = Rotation.from_matrix(T_world_cam[:3, :3])
        qx, qy, qz, qw = rotation.as_quat(canonical=True).tolist()
        transform = self._make(
            "geometry_msgs/msg/Transform",
            translation=self._make("geometry_msgs/msg/Vector3", x=x, y=y, z=z),
            rotation=self._make(
                "geometry_msgs/msg/Quaternion", x=qx, y=qy, z=qz, w=qw
            ),
        )
        self._write(
            TRUTH_TOPIC,
            POSE_TYPE,
            stamp,
            frame=WORLD_FRAME,
            child_frame_id=CAMERA_FRAME,
            transform=transform,
        )

    def _write(
        self,
        topic: str,
        kind: str,
        stamp: float,
        frame: str = CAMERA_FRAME,
        **fields: Any,
    ) -> None:
        when = round(stamp * 10**9)
        if when < 0:
            raise InputError(
                f"{self.path}: a bag holds times from 1970 on, got a stamp of {stamp} s."
            )
        seconds, nanoseconds = divmod(when, 10**9)
        time = self._make(
            "builtin_interfaces/msg/Time", sec=seconds, nanosec=nanoseconds
        )
        number = {"seq": 0} if self.is_ros1 else {}
        header = self._make(
            "std_msgs/msg/Header", stamp=time, frame_id=frame, **number
        )
        message = self._make(kind, header=header, **fields)
        code = (
            self._types.serialize_ros1
            if self.is_ros1
            else self._types.serialize_cdr
        )
        with self._errors():
            if topic not in self._connections:
                self._connections[topic] = self._writer.add_connection(
                    topic, kind, typestore=self._types
                )
            connection = self._connections[topic]
            # ROS has no time 0
            self._writer.write(connection, max(when, 1), bytes(code(message, kind)))

    def _make(self, kind: str, **fields: Any) -> Any:
        return self._types.types[kind](**fields)

    @contextlib.contextmanager
    def _errors(self) -> Any:
        """Turn the errors of rosbags and of the disk into an OutputError."""
        from rosbags.rosbag1 import WriterError as Error1
        from rosbags.rosbag2 import WriterError as Error2

        try:
            yield
        except (OSError, Error1, Error2) as error:
            reason = getattr(error, "strerror", None) or error
            raise OutputError(
                f"{self.path}: cannot be written: {reason}."
            ) from error
