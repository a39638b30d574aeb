"""Fills messages: the same fields in ROS 1 and ROS 2, so that the nodes only make and send them."""

from __future__ import annotations

import sys
from collections import deque
from collections.abc import Callable
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from hybridvo.core.results import MovingObject, State, stated_stds
from hybridvo.io.masks import object_colour
from hybridvo.io.ros.descriptions import Description
from hybridvo.io.ros.follower import Moving, Report

LEVELS = {State.OK: "OK", State.DEGRADED: "WARN", State.FAILED: "ERROR"}
"""Names of the levels of ``DiagnosticStatus``."""
NAME = "hybridvo: odometry"
"""What a ``DiagnosticStatus`` is about."""
ADD = 0
DELETE_ALL = 3
"""What is done with a ``Marker``."""
CUBE = 1
TEXT = 9
"""Kinds of a ``Marker``."""
BOXES = "hybridvo_boxes"
NUMBERS = "hybridvo_numbers"
"""Namespaces of the markers."""
TEXT_HEIGHT_M = 0.15
SMALLEST_BOX_M = 0.001
HIDDEN_ALPHA = 0.2
"""How the markers look."""
MOVES = 255
"""Value of a pixel that moves."""
LARGEST_INTEGER = 2**63 - 1
"""Of a parameter of ROS 2."""


def fill_odometry(message: Any, report: Report, odom_frame: str) -> None:
    """Fill a ``nav_msgs/Odometry``.

    Args:
        message: The message.
        report: What is known of the frame.
        odom_frame: The frame in which the pose is.
    """
    message.header.stamp = report.header.stamp
    message.header.frame_id = odom_frame
    message.child_frame_id = report.child
    _fill_pose(message.pose.pose, report.T_odom_child)
    message.pose.covariance = _row_by_row(report.covariance)
    velocity = report.twist.velocity
    _fill_xyz(message.twist.twist.linear, velocity[:3])
    _fill_xyz(message.twist.twist.angular, velocity[3:])
    message.twist.covariance = _row_by_row(report.twist.covariance)


def fill_transform(message: Any, report: Report, odom_frame: str) -> None:
    """Fill a ``geometry_msgs/TransformStamped``.

    Args:
        message: The message.
        report: What is known of the frame.
        odom_frame: The parent.
    """
    message.header.stamp = report.header.stamp
    message.header.frame_id = odom_frame
    message.child_frame_id = report.child
    moved = message.transform
    _fill_xyz(moved.translation, report.T_odom_child[:3, 3])
    _fill_rotation(moved.rotation, report.T_odom_child)


class RecentPath:
    """The latest poses, for a ``nav_msgs/Path``.

    Poses of motions that failed are left out: where the camera was then is not known. Where
    tracking begins anew the path does as well. With ``track.lag`` the pose before is put right.

    Args:
        length: How many poses are kept.
        odom_frame: The frame in which they are.
        make_pose: Makes a ``PoseStamped``.
    """

    def __init__(
        self, length: int, odom_frame: str, make_pose: Callable[[], Any]
    ) -> None:
        self._odom_frame = odom_frame
        self._make_pose = make_pose
        self._poses: deque[Any] = deque(maxlen=length)
        self._restarts = 0
        # of the frame whose pose is the newest
        self._newest: int | None = None

    def add(self, report: Report) -> None:
        """Go on by a frame."""
        if report.restarts != self._restarts:
            self._poses.clear()
        self._restarts = report.restarts
        step = report.step
        T_before = report.T_odom_before
        if step.corrected is not None and T_before is not None:
            if step.corrected.index == self._newest and self._poses:
                _fill_pose(self._poses[-1].pose, T_before)
        if not step.usable:
            return
        stamped = self._make_pose()
        stamped.header.stamp = report.header.stamp
        stamped.header.frame_id = self._odom_frame
        _fill_pose(stamped.pose, report.T_odom_child)
        self._poses.append(stamped)
        self._newest = step.index

    def fill(self, message: Any, report: Report) -> None:
        """Fill a ``nav_msgs/Path``, with the stamp of a frame."""
        message.header.stamp = report.header.stamp
        message.header.frame_id = self._odom_frame
        message.poses = list(self._poses)


def fill_descriptor(
    message: Any,
    described: Description,
    make_integer_range: Callable[..., Any],
    make_float_range: Callable[..., Any],
) -> None:
    """Fill a ``rcl_interfaces/ParameterDescriptor``.

    A node reads its parameters once: they cannot be changed while it runs.

    Args:
        message: The message.
        described: The parameter.
        make_integer_range: Makes an ``IntegerRange``.
        make_float_range: Makes a ``FloatingPointRange``.
    """
    message.name = described.name
    message.description = described.text
    message.additional_constraints = described.constraint
    message.read_only = True
    message.dynamic_typing = described.may_be_unset
    lower = described.lower
    upper = described.upper
    if lower is None:
        return
    if isinstance(described.value, int):
        largest = LARGEST_INTEGER if upper is None else int(upper)
        limits = make_integer_range(from_value=int(lower), to_value=largest, step=1)
        message.integer_range = [limits]
    else:
        highest = sys.float_info.max if upper is None else float(upper)
        limits = make_float_range(
            from_value=float(lower), to_value=highest, step=0.0
        )
        message.floating_point_range = [limits]


def fill_status(
    message: Any,
    report: Report,
    make_value: Callable[..., Any],
    *,
    age_s: float,
    dropped: int,
) -> None:
    """Fill a ``diagnostic_msgs/DiagnosticStatus``.

    Args:
        message: The message.
        report: What is known of the frame.
        make_value: Makes a ``KeyValue`` of ``key=`` and ``value=``.
        age_s: Seconds from the stamp of the image until now.
        dropped: Frames that were not tracked for lack of time.
    """
    step = report.step
    status = step.status
    message.level = getattr(message, LEVELS[status.state])
    message.name = NAME
    message.message = ": ".join(filter(None, (str(status), status.message)))
    message.hardware_id = str(report.header.frame_id)
    std_m, std_rad = stated_stds(step.covariance)
    values = {
        "status": status.state.value,
        "reason": status.reason.value,
        "probability": _short(step.probability),
        "inlier_ratio": _short(step.motion.inlier_ratio),
        "sigma_translation_m": _short(std_m),
        "sigma_rotation_rad": _short(std_rad),
        "index": str(step.index),
        "prev_index": "" if step.prev_index is None else str(step.prev_index),
        "age_ms": _short(1000 * age_s),
        "dropped": str(dropped),
        "restarts": str(report.restarts),
        "method": step.motion.method,
    }
    message.values = [
        make_value(key=key, value=value) for key, value in values.items()
    ]


def fill_mask(
    message: Any, moving: Moving, wrap: Callable[[bytes], Any] = bytes
) -> None:
    """Fill a ``sensor_msgs/Image`` with the mask of what moves: mono8, 255 where it moves.

    Args:
        message: The message.
        moving: What moves, and on which image.
        wrap: Makes of bytes what the field ``data`` holds.
    """
    height, width = moving.mask.shape
    message.header.stamp = moving.header.stamp
    message.header.frame_id = moving.header.frame_id
    message.height = height
    message.width = width
    message.encoding = "mono8"
    message.is_bigendian = 0
    message.step = width
    message.data = wrap((MOVES * moving.mask.astype(np.uint8)).tobytes())


def fill_objects(
    message: Any, report: Report, make_marker: Callable[[], Any]
) -> None:
    """Fill a ``visualization_msgs/MarkerArray``: a box for each object, and its number.

    The boxes are along the axes of the camera, in the frame of the image. Boxes of objects that
    are gone disappear.

    Args:
        message: The message.
        report: What is known of the frame.
        make_marker: Makes a ``Marker``.
    """
    first = _marker(make_marker(), report)
    first.action = DELETE_ALL
    message.markers = [first]
    for thing in report.step.objects:
        box = _marker(make_marker(), report, thing)
        box.ns = BOXES
        box.type = CUBE
        box.scale.x, box.scale.y, box.scale.z = _at_least(thing.size)
        text = _marker(make_marker(), report, thing)
        text.ns = NUMBERS
        text.type = TEXT
        text.scale.z = TEXT_HEIGHT_M
        text.text = str(thing.id)
        message.markers += [box, text]


def _marker(message: Any, report: Report, thing: MovingObject | None = None) -> Any:
    """A ``Marker`` with stamp and frame, and with number, place and colour of an object."""
    message.header.stamp = report.header.stamp
    message.header.frame_id = report.header.frame_id
    message.pose.orientation.w = 1.0
    if thing is None:
        return message
    message.id = thing.id
    message.action = ADD
    _fill_xyz(message.pose.position, thing.centre)
    red, green, blue = object_colour(thing.id)
    message.color.r = red / 255
    message.color.g = green / 255
    message.color.b = blue / 255
    # what is only expected, or hardly believed, is hardly seen
    message.color.a = float(thing.confidence if thing.is_seen else HIDDEN_ALPHA)
    return message


def _at_least(size: np.ndarray) -> list[float]:
    """The sides of a box, metres; RViz refuses those that are 0."""
    return np.maximum(size, SMALLEST_BOX_M).tolist()


def _fill_pose(message: Any, T: np.ndarray) -> None:
    """Fill a ``Pose`` with (4, 4)."""
    _fill_xyz(message.position, T[:3, 3])
    _fill_rotation(message.orientation, T)


def _fill_xyz(message: Any, values: np.ndarray) -> None:
    """Fill a ``Point`` or a ``Vector3``."""
    message.x = float(values[0])
    message.y = float(values[1])
    message.z = float(values[2])


def _fill_rotation(message: Any, T: np.ndarray) -> None:
    """Fill a ``Quaternion`` with the rotation of (4, 4)."""
    rotation = Rotation.from_matrix(T[:3, :3])
    x, y, z, w = rotation.as_quat(canonical=True).tolist()
    message.x = x
    message.y = y
    message.z = z
    message.w = w


def _row_by_row(covariance: np.ndarray) -> np.ndarray:
    """(36,) of (6, 6), exactly symmetric."""
    symmetric = (covariance + covariance.T) / 2
    return symmetric.reshape(-1).astype(np.float64)


def _short(value: float) -> str:
    return f"{value:.6g}"
