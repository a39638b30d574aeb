"""Small bags, written with rosbags' own writers, with the frames that they must read back as."""

from __future__ import annotations

import struct
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from rosbags import rosbag1, rosbag2
from rosbags.rosbag2 import StoragePlugin
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

FORMATS = ("ros1", "sqlite3", "mcap")
FRAMES = 5
SIZE = (24, 32)
K = (40.0, 41.0, 15.5, 11.5)
RGB = "/camera/color/image_raw"
DEPTH = "/camera/aligned_depth_to_color/image_raw"
INFO = "/camera/color/camera_info"
START = 1_700_000_000_000_000_000  # ns


class Writer:
    """Writes messages into a bag of one of the formats."""

    def __init__(self, root: Path, kind: str, name: str = "drive") -> None:
        self.kind = kind
        self.is_ros1 = kind == "ros1"
        store = Stores.ROS1_NOETIC if self.is_ros1 else Stores.ROS2_HUMBLE
        self.store = get_typestore(store)
        if self.is_ros1:
            content = "geometry_msgs/TransformStamped[] transforms"
            self.store.register(
                get_types_from_msg(content, "tf2_msgs/msg/TFMessage")
            )
        self.connections: dict[str, Any] = {}
        root.mkdir(parents=True, exist_ok=True)
        if self.is_ros1:
            self.path = root / f"{name}.bag"
            self.writer: Any = rosbag1.Writer(self.path)
        else:
            self.path = root / name
            plugin = StoragePlugin.MCAP if kind == "mcap" else StoragePlugin.SQLITE3
            self.writer = rosbag2.Writer(
                self.path, version=9, storage_plugin=plugin
            )
        self.writer.open()

    def close(self) -> Path:
        self.writer.close()
        return self.path

    def make(self, kind: str, **fields: Any) -> Any:
        """A message of a type such as ``sensor_msgs/msg/Image``."""
        return self.store.types[kind](**fields)

    def write(
        self, topic: str, message: Any, time: int, appended: bytes = b""
    ) -> None:
        kind = message.__msgtype__
        if topic not in self.connections:
            self.connections[topic] = self.writer.add_connection(
                topic, kind, typestore=self.store
            )
        code = (
            self.store.serialize_ros1 if self.is_ros1 else self.store.serialize_cdr
        )
        data = bytes(code(message, kind)) + appended
        self.writer.write(self.connections[topic], time, data)

    # -- messages ----------------------------------------------------------------------------------

    def header(self, stamp: int, frame: str = "color") -> Any:
        seconds, nanoseconds = divmod(stamp, 10**9)
        time = self.make(
            "builtin_interfaces/msg/Time", sec=seconds, nanosec=nanoseconds
        )
        number = {"seq": 0} if self.is_ros1 else {}
        return self.make(
            "std_msgs/msg/Header", stamp=time, frame_id=frame, **number
        )

    def image(
        self,
        pixels: np.ndarray,
        encoding: str,
        stamp: int,
        frame: str = "color",
        padding: int = 0,
        big_endian: bool = False,
    ) -> Any:
        height, width = pixels.shape[:2]
        if big_endian:
            pixels = pixels.astype(pixels.dtype.newbyteorder(">"))
        rows = np.frombuffer(pixels.tobytes(), np.uint8).reshape(height, -1)
        rows = np.pad(rows, ((0, 0), (0, padding)))
        return self.make(
            "sensor_msgs/msg/Image",
            header=self.header(stamp, frame),
            height=height,
            width=width,
            encoding=encoding,
            is_bigendian=int(big_endian),
            step=rows.shape[1],
            data=rows.reshape(-1),
        )

    def compressed(self, data: bytes, form: str, stamp: int, frame="color") -> Any:
        return self.make(
            "sensor_msgs/msg/CompressedImage",
            header=self.header(stamp, frame),
            format=form,
            data=np.frombuffer(data, np.uint8),
        )

    def info(
        self,
        k: tuple[float, float, float, float] = K,
        size: tuple[int, int] = SIZE,
        frame: str = "color",
        d: tuple[float, ...] = (),
        model: str = "plumb_bob",
        binning: int = 0,
    ) -> Any:
        fx, fy, cx, cy = k
        matrix = np.array([fx, 0, cx, 0, fy, cy, 0, 0, 1], np.float64)
        projection = np.insert(matrix, (3, 6, 9), 0.0)
        values = {
            "d": np.array(d, np.float64),
            "k": matrix,
            "r": np.eye(3).reshape(-1),
            "p": projection,
        }
        if self.is_ros1:
            values = {name.upper(): value for name, value in values.items()}
        roi = self.make(
            "sensor_msgs/msg/RegionOfInterest",
            x_offset=0,
            y_offset=0,
            height=0,
            width=0,
            do_rectify=False,
        )
        return self.make(
            "sensor_msgs/msg/CameraInfo",
            header=self.header(START, frame),
            height=size[0],
            width=size[1],
            distortion_model=model,
            binning_x=binning,
            binning_y=binning,
            roi=roi,
            **values,
        )

    def vector(self, xyz: Any, kind: str = "Vector3") -> Any:
        x, y, z = (float(value) for value in xyz)
        return self.make(f"geometry_msgs/msg/{kind}", x=x, y=y, z=z)

    def quaternion(self, xyzw: Any) -> Any:
        x, y, z, w = (float(value) for value in xyzw)
        return self.make("geometry_msgs/msg/Quaternion", x=x, y=y, z=z, w=w)

    def transform(
        self, parent: str, child: str, xyz: Any, xyzw: Any, stamp: int = START
    ) -> Any:
        inner = self.make(
            "geometry_msgs/msg/Transform",
            translation=self.vector(xyz),
            rotation=self.quaternion(xyzw),
        )
        return self.make(
            "geometry_msgs/msg/TransformStamped",
            header=self.header(stamp, parent),
            child_frame_id=child,
            transform=inner,
        )

    def tf(self, *transforms: Any) -> Any:
        return self.make("tf2_msgs/msg/TFMessage", transforms=[*transforms])

    def pose(self, xyz: Any, xyzw: Any, stamp: int) -> Any:
        inner = self.make(
            "geometry_msgs/msg/Pose",
            position=self.vector(xyz, "Point"),
            orientation=self.quaternion(xyzw),
        )
        return self.make(
            "geometry_msgs/msg/PoseStamped",
            header=self.header(stamp, "world"),
            pose=inner,
        )

    def odometry(self, xyz: Any, xyzw: Any, stamp: int, child: str) -> Any:
        pose = self.pose(xyz, xyzw, stamp).pose
        zero = np.zeros(36)
        with_covariance = self.make(
            "geometry_msgs/msg/PoseWithCovariance", pose=pose, covariance=zero
        )
        twist = self.make(
            "geometry_msgs/msg/Twist",
            linear=self.vector((0, 0, 0)),
            angular=self.vector((0, 0, 0)),
        )
        return self.make(
            "nav_msgs/msg/Odometry",
            header=self.header(stamp, "world"),
            child_frame_id=child,
            pose=with_covariance,
            twist=self.make(
                "geometry_msgs/msg/TwistWithCovariance",
                twist=twist,
                covariance=zero,
            ),
        )


def stamp(i: int) -> int:
    return START + i * 33_333_333


def rgb(i: int, size: tuple[int, int] = SIZE) -> np.ndarray:
    return np.random.default_rng(i).integers(0, 256, (*size, 3), dtype=np.uint8)


def millimetres(i: int, size: tuple[int, int] = SIZE) -> np.ndarray:
    ramp = np.arange(size[0] * size[1], dtype=np.uint16).reshape(size)
    depth = 1500 + ramp % 700 + 10 * i
    depth[0, :3] = 0
    return depth.astype(np.uint16)


def plain_bag(
    root: Path, kind: str, frames: int = FRAMES, size: tuple[int, int] = SIZE
) -> Path:
    """A bag of rgb8 and 16UC1 with a CameraInfo, as a RealSense node publishes them."""
    writer = Writer(root, kind)
    for i in range(frames):
        time = stamp(i) + 5_000_000
        writer.write(INFO, writer.info(size=size), time)
        writer.write(RGB, writer.image(rgb(i, size), "rgb8", stamp(i)), time + 1)
        depth = writer.image(millimetres(i, size), "16UC1", stamp(i))
        writer.write(DEPTH, depth, time + 2)
    return writer.close()


def png_bytes(image: np.ndarray) -> bytes:
    return cv2.imencode(".png", image)[1].tobytes()


def rvl_bytes(depth: np.ndarray) -> bytes:
    """Depth by the paper's encoder (A. Wilson, Fast Lossless Depth Image Compression, 2017)."""
    nibbles: list[int] = []

    def put(value: int) -> None:
        while True:
            nibble = value & 7
            value >>= 3
            nibbles.append(nibble | (8 if value else 0))
            if not value:
                return

    values = depth.reshape(-1).astype(int).tolist()
    at = 0
    previous = 0
    while at < len(values):
        zeros = at
        while zeros < len(values) and values[zeros] == 0:
            zeros += 1
        put(zeros - at)
        others = zeros
        while others < len(values) and values[others] != 0:
            others += 1
        put(others - zeros)
        for value in values[zeros:others]:
            delta = value - previous
            put(2 * delta if delta >= 0 else -2 * delta - 1)
            previous = value
        at = others
    nibbles += [0] * (-len(nibbles) % 8)
    words = [
        sum(nibble << (28 - 4 * k) for k, nibble in enumerate(nibbles[i : i + 8]))
        for i in range(0, len(nibbles), 8)
    ]
    height, width = depth.shape
    return struct.pack("<ii", width, height) + struct.pack(
        f"<{len(words)}I", *words
    )
