"""What messages hold: images, depth, cameras, poses and stamps. Pure functions of messages.

A message is whatever has the fields of the ROS message: of ``rosbags``, of ROS itself, or a fake.
"""

from __future__ import annotations

import struct
from collections.abc import Iterable
from typing import Any, NamedTuple

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

from hybridvo.core.errors import FormatError
from hybridvo.core.types import Camera
from hybridvo.io.data.bags.rvl import decode_rvl
from hybridvo.io.data.image_io import MAX_IMAGE_PIXELS, decode_bytes
from hybridvo.io.data.streams import Lens, check_lens

IMAGE_TYPE = "sensor_msgs/msg/Image"
COMPRESSED_TYPE = "sensor_msgs/msg/CompressedImage"
IMAGE_TYPES = (IMAGE_TYPE, COMPRESSED_TYPE)
INFO_TYPE = "sensor_msgs/msg/CameraInfo"
TF_TYPES = ("tf2_msgs/msg/TFMessage", "tf/msg/tfMessage")
POSE_TYPES = (
    "geometry_msgs/msg/PoseStamped",
    "geometry_msgs/msg/PoseWithCovarianceStamped",
    "geometry_msgs/msg/TransformStamped",
    "nav_msgs/msg/Odometry",
)
IMU_TYPE = "sensor_msgs/msg/Imu"
TRANSFORM_TYPE = "geometry_msgs/msg/Transform"
"""RealSense's recorder writes the extrinsics of a stream as a bare transform."""
VALUE_TYPES = ("std_msgs/msg/Float32", "std_msgs/msg/String")
"""By which RealSense's recorder writes an option of the camera, in ROS 1 and in ROS 2."""


class PixelFormat(NamedTuple):
    """How an encoding stores a pixel, and what makes RGB or grey of it."""

    dtype: str
    channels: int
    # a code of cv2.cvtColor; None where nothing is to be done
    conversion: int | None


COLOUR_ENCODINGS = {
    "rgb8": PixelFormat("u1", 3, None),
    "bgr8": PixelFormat("u1", 3, cv2.COLOR_BGR2RGB),
    "8uc3": PixelFormat("u1", 3, cv2.COLOR_BGR2RGB),
    "rgba8": PixelFormat("u1", 4, cv2.COLOR_RGBA2RGB),
    "bgra8": PixelFormat("u1", 4, cv2.COLOR_BGRA2RGB),
    "8uc4": PixelFormat("u1", 4, cv2.COLOR_BGRA2RGB),
    "mono8": PixelFormat("u1", 1, None),
    "8uc1": PixelFormat("u1", 1, None),
    "mono16": PixelFormat("u2", 1, None),
    "16uc1": PixelFormat("u2", 1, None),
    # OpenCV names a Bayer pattern by its second row
    "bayer_rggb8": PixelFormat("u1", 1, cv2.COLOR_BayerBG2RGB),
    "bayer_bggr8": PixelFormat("u1", 1, cv2.COLOR_BayerRG2RGB),
    "bayer_gbrg8": PixelFormat("u1", 1, cv2.COLOR_BayerGR2RGB),
    "bayer_grbg8": PixelFormat("u1", 1, cv2.COLOR_BayerGB2RGB),
    "yuv422": PixelFormat("u1", 2, cv2.COLOR_YUV2RGB_UYVY),
    "uyvy": PixelFormat("u1", 2, cv2.COLOR_YUV2RGB_UYVY),
    "yuv422_yuy2": PixelFormat("u1", 2, cv2.COLOR_YUV2RGB_YUYV),
    "yuyv": PixelFormat("u1", 2, cv2.COLOR_YUV2RGB_YUYV),
}
"""Encodings of colour and grey images, in lower case."""
DEPTH_ENCODINGS = {
    "16uc1": PixelFormat("u2", 1, None),
    "mono16": PixelFormat("u2", 1, None),
    "z16": PixelFormat("u2", 1, None),
    "32fc1": PixelFormat("f4", 1, None),
}
"""Encodings of depth, in lower case: whole numbers are millimetres, floats are metres (REP 118)."""
CONFIG_HEADER = struct.Struct("<iff")
"""Before the data of ``compressedDepth``: its format, and the two numbers of its quantisation."""
ROS1_HEADER = struct.Struct("<III")
"""Number, seconds and nanoseconds, with which the header of a ROS 1 message begins."""


class Info(NamedTuple):
    """What a ``CameraInfo`` states."""

    lens: Lens  # of the images as they are taken
    rectified: Camera  # of the images of an ``image_rect`` topic
    frame: str  # of reference


def stamp_ns(raw: bytes, is_ros1: bool) -> int:
    """Return the stamp of the header with which a message begins, nanoseconds.

    Only the first bytes are looked at, for an image may have millions.
    """
    try:
        if is_ros1:
            _, seconds, nanoseconds = ROS1_HEADER.unpack_from(raw)
        else:
            # the second byte of CDR's encapsulation gives the order of bytes
            order = "<" if raw[1] & 1 else ">"
            seconds, nanoseconds = struct.unpack_from(f"{order}iI", raw, 4)
    except (struct.error, IndexError):
        raise FormatError("a message ends within its header.") from None
    return seconds * 10**9 + nanoseconds


def plain_ros1_image(data: bytes) -> bytes:
    """Return an Image of ROS 1 without what a writer appended to it.

    RealSense's recorder appends the unit of depth, four bytes that the definition does not have.
    Data that is no Image is returned as it is.
    """
    try:
        place = ROS1_HEADER.size
        # the frame of reference, and the encoding behind the size of the image
        for after in (8, 5):
            (length,) = struct.unpack_from("<I", data, place)
            place += 4 + length + after
        (length,) = struct.unpack_from("<I", data, place)
    except struct.error:
        return data
    return data[: place + 4 + length]


def encoding_of(message: Any) -> str:
    """Return the encoding or format of an image, in lower case."""
    text = getattr(message, "encoding", None) or getattr(message, "format", "")
    return str(text).lower().strip()


def is_depth_encoding(encoding: str) -> bool:
    """Return whether an encoding is one of depth rather than of colour."""
    first = encoding.partition(";")[0].strip()
    return "compresseddepth" in encoding or first in ("16uc1", "32fc1", "z16")


def colour_image(message: Any) -> np.ndarray:
    """Return an Image or CompressedImage as (H, W, 3) RGB or (H, W) grey, uint8.

    Raises:
        FormatError: An encoding that is not known, or data that does not fit it.
    """
    encoding = encoding_of(message)
    if not hasattr(message, "encoding"):
        data = bytes(message.data)
        bgr = decode_bytes(data, cv2.IMREAD_COLOR, f"format '{encoding[:60]}'")
        return cv2.cvtColor(bgr, cv2.COLOR_BGR2RGB)
    pixel = COLOUR_ENCODINGS.get(encoding)
    if pixel is None:
        raise _unknown_encoding("colour", encoding, COLOUR_ENCODINGS)
    image = _pixels(message, pixel)
    if pixel.dtype == "u2":
        return (image >> 8).astype(np.uint8)
    if pixel.conversion is None:
        return image
    return cv2.cvtColor(image, pixel.conversion)


def depth_image(message: Any) -> np.ndarray:
    """Return an Image or CompressedImage of depth as it is stored.

    Returns:
        (H, W) uint16 in the sensor's unit, or float32 metres, 0 or NaN where unknown.

    Raises:
        FormatError: An encoding that is not known, or data that does not fit it.
    """
    encoding = encoding_of(message)
    if hasattr(message, "encoding"):
        pixel = DEPTH_ENCODINGS.get(encoding)
        if pixel is None:
            raise _unknown_encoding("depth", encoding, DEPTH_ENCODINGS)
        return _pixels(message, pixel)
    data = bytes(message.data)
    if "compresseddepth" in encoding:
        return _compressed_depth(data, encoding)
    where = f"format '{encoding[:60]}'"
    image = decode_bytes(data, cv2.IMREAD_UNCHANGED, where)
    if image.dtype != np.uint16 or image.ndim != 2:
        got = f"{image.dtype} with {1 if image.ndim == 2 else image.shape[2]} channels"
        raise FormatError(f"{where}: expected depth of 16 bits, got {got}.")
    return image


def _compressed_depth(data: bytes, encoding: str) -> np.ndarray:
    """Depth of ``compressed_depth_image_transport``: a header, then PNG or RVL."""
    where = f"format '{encoding[:60]}'"
    if len(data) <= CONFIG_HEADER.size:
        raise FormatError(f"{where}: {len(data)} bytes are too few.")
    _, quant_a, quant_b = CONFIG_HEADER.unpack_from(data)
    body = data[CONFIG_HEADER.size :]
    if "rvl" in encoding:
        stored = decode_rvl(body, where)
    else:
        stored = decode_bytes(body, cv2.IMREAD_UNCHANGED, where)
    if stored.dtype != np.uint16 or stored.ndim != 2:
        raise FormatError(f"{where}: expected one channel of 16 bits.")
    if not encoding.startswith("32fc1"):
        return stored
    # floats are stored as quantised inverse depth
    with np.errstate(divide="ignore", invalid="ignore"):
        metres = quant_a / (stored.astype(np.float32) - np.float32(quant_b))
    return np.where(stored == 0, np.float32(np.nan), metres.astype(np.float32))


def _unknown_encoding(
    what: str, encoding: str, known: Iterable[str]
) -> FormatError:
    names = ", ".join(known)
    return FormatError(
        f"encoding '{encoding[:60]}' of {what} is not read; known: {names}."
    )


def _pixels(message: Any, pixel: PixelFormat) -> np.ndarray:
    """(H, W) or (H, W, C) of an Image, in the byte order of this machine."""
    height = int(message.height)
    width = int(message.width)
    step = int(message.step)
    dtype = np.dtype(pixel.dtype).newbyteorder(">" if message.is_bigendian else "<")
    row_bytes = width * pixel.channels * dtype.itemsize
    if not 0 < height * width <= MAX_IMAGE_PIXELS:
        expected = f"an image of 1 to {MAX_IMAGE_PIXELS} pixels"
        raise FormatError(f"expected {expected}, got {width}x{height}.")
    data = _bytes(message.data)
    if step < row_bytes or len(data) < (height - 1) * step + row_bytes:
        expected = (
            f"{height} rows of {max(step, row_bytes)} bytes for {width} pixels"
        )
        raise FormatError(
            f"expected {expected} of '{message.encoding}', got {len(data)} bytes."
        )
    # the last row may lack its padding
    rows = np.lib.stride_tricks.as_strided(
        data, (height, row_bytes), (step, 1), writeable=False
    )
    image = np.ascontiguousarray(rows).view(dtype)
    shape = (height, width, pixel.channels)
    image = image.reshape(shape[: 2 + (pixel.channels > 1)])
    return image.astype(dtype.newbyteorder("="), copy=False)


def _bytes(data: Any) -> np.ndarray:
    """The bytes (n,) of a message: an array of rosbags, bytes of ROS 1, an ``array`` of ROS 2."""
    if isinstance(data, np.ndarray):
        return data.astype(np.uint8, copy=False).reshape(-1)
    return np.frombuffer(data, np.uint8)


def camera_info(message: Any, where: str) -> Info:
    """Return what a CameraInfo states, with its region of interest and binning applied.

    Raises:
        FormatError: There is no calibration in it, or a lens that cannot be straightened.
    """
    K = np.array(_field(message, "k"), np.float64).reshape(3, 3)
    P = np.array(_field(message, "p"), np.float64).reshape(3, 4)
    D = [float(value) for value in _field(message, "d")]
    height = int(message.height)
    width = int(message.width)
    if not K[0, 0] > 0:
        raise FormatError(
            f"{where}: holds no calibration (K is 0): give --camera fx,fy,cx,cy or FILE."
        )
    if not P[0, 0] > 0:
        P = np.column_stack([K, np.zeros(3)])
    binning = max(int(message.binning_x), 1), max(int(message.binning_y), 1)
    roi = message.roi
    if int(roi.width) and int(roi.height):
        height = int(roi.height)
        width = int(roi.width)
    corner = int(roi.x_offset), int(roi.y_offset)
    height //= binning[1]
    width //= binning[0]
    taken = Camera.from_matrix(_cut(K, corner, binning), height, width)
    rectified = Camera.from_matrix(_cut(P[:, :3], corner, binning), height, width)
    lens = Lens(taken, tuple(D), str(message.distortion_model))
    frame = str(message.header.frame_id).lstrip("/")
    return Info(check_lens(lens, where), rectified, frame)


def _field(message: Any, name: str) -> Any:
    """A field that ROS 1 writes with a capital letter, ROS 2 with a small one."""
    return (
        getattr(message, name, None)
        if hasattr(message, name)
        else getattr(message, name.upper())
    )


def _cut(
    K: np.ndarray, corner: tuple[int, int], binning: tuple[int, int]
) -> np.ndarray:
    """Intrinsics of a region of the image, of which so many pixels are binned into one."""
    cut = K.copy()
    for axis in (0, 1):
        cut[axis, 2] -= corner[axis]
        cut[axis] /= binning[axis]
        # pixel (0, 0) is a centre
        cut[axis, 2] += (1 / binning[axis] - 1) / 2
    return cut


def rigid(translation: Any, rotation: Any) -> np.ndarray | None:
    """Return (4, 4) of a ROS vector and quaternion; None where they are no transform."""
    xyz = [float(getattr(translation, axis)) for axis in "xyz"]
    xyzw = [float(getattr(rotation, axis)) for axis in "xyzw"]
    if not np.isfinite(xyz + xyzw).all() or not 0.5 < np.linalg.norm(xyzw) < 2:
        return None
    T = np.eye(4)
    T[:3, :3] = Rotation.from_quat(xyzw).as_matrix()
    T[:3, 3] = xyz
    return T


class StampedPose(NamedTuple):
    """A pose in a message: ``T_parent_child`` at a time."""

    stamp: int  # ns
    T: np.ndarray  # (4, 4)
    child: str  # the frame whose pose it is, "" where the message does not state


def time_ns(stamp: Any) -> int:
    """Return a time of ROS, ns; rospy names its parts otherwise than ROS 2 and ``rosbags``."""
    if hasattr(stamp, "secs"):
        return int(stamp.secs) * 10**9 + int(stamp.nsecs)
    return int(stamp.sec) * 10**9 + int(stamp.nanosec)


def stamped_pose(message: Any) -> StampedPose | None:
    """Return the pose in a message of one of ``POSE_TYPES``; None where it is not valid."""
    when = time_ns(message.header.stamp)
    child = str(getattr(message, "child_frame_id", "")).lstrip("/")
    if hasattr(message, "transform"):
        transform = message.transform
        T = rigid(transform.translation, transform.rotation)
    else:
        pose = message.pose
        pose = getattr(pose, "pose", pose)  # with a covariance beside it
        T = rigid(pose.position, pose.orientation)
    return None if T is None else StampedPose(when, T, child)


def imu_row(message: Any) -> list[float]:
    """Return stamp, ns, rates, rad/s, and accelerations, m/s^2, of a message of an inertial sensor.

    A recorder of the gyroscope alone leaves accelerations at 0.
    """
    when = time_ns(message.header.stamp)
    turned = message.angular_velocity
    pushed = message.linear_acceleration
    parts = (turned.x, turned.y, turned.z, pushed.x, pushed.y, pushed.z)
    return [float(when), *(float(part) for part in parts)]


def transform_between(
    edges: dict[tuple[str, str], np.ndarray], target: str, source: str
) -> np.ndarray | None:
    """Return ``T_target_source`` by way of known transforms; None where they do not connect.

    Args:
        edges: (parent, child) -> (4, 4) ``T_parent_child``, as in ``/tf_static``.
        target: A frame of reference.
        source: Another one.

    Returns:
        (4, 4), or None.
    """
    neighbours: dict[str, dict[str, np.ndarray]] = {}
    for (parent, child), T in edges.items():
        neighbours.setdefault(parent, {})[child] = T
        neighbours.setdefault(child, {})[parent] = np.linalg.inv(T)
    reached = {target: np.eye(4)}
    waiting = [target]
    while waiting:
        here = waiting.pop()
        if here == source:
            return reached[here]
        for there, T in neighbours.get(here, {}).items():
            if there not in reached:
                reached[there] = reached[here] @ T
                waiting.append(there)
    return None
