"""What is published, and what is read: in the types of rosbags, sent and read again."""

from __future__ import annotations

from array import array
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from hybridvo import InputError
from hybridvo.core.errors import FormatError
from hybridvo.core.geometry import make_transform
from hybridvo.core.results import (
    MovingObject,
    Reason,
    RelativePose,
    Status,
    Step,
)
from hybridvo.io.ros import outputs
from hybridvo.io.ros.conversions import Twist
from hybridvo.io.ros.follower import Moving, Report
from hybridvo.io.ros.frames import FrameReader, stamp_ns
from hybridvo.io.ros.parameters import NodeOptions, read_parameters
from tests import bags
from tests.io.ros.msgs import Types

HALF = np.sqrt(0.5)
QUARTER = np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])
"""By 90 degrees about z."""


@pytest.fixture(params=[1, 2], ids=["ros1", "ros2"])
def types(request: pytest.FixtureRequest) -> Types:
    return Types(request.param)


def header(types: Types, seconds: int = 7, nanoseconds: int = 90) -> Any:
    time = types.make(
        "builtin_interfaces/msg/Time", sec=seconds, nanosec=nanoseconds
    )
    return types.make("std_msgs/msg/Header", stamp=time, frame_id="optical")


def step_of(index: int, motion: RelativePose | None = None) -> Step:
    motion = motion or RelativePose(np.eye(4), np.diag([4e-4] * 3 + [1e-4] * 3))
    return Step(index, index / 30, np.eye(4), motion, index - 1)


def report(types: Types, motion: RelativePose | None = None) -> Report:
    motion = motion or RelativePose(np.eye(4), np.diag([4e-4] * 3 + [1e-4] * 3))
    return Report(
        header(types),
        "base",
        make_transform(QUARTER, np.array([1.0, 2, 3])),
        np.arange(36.0).reshape(6, 6),
        Twist(np.arange(1.0, 7.0), np.diag([1.0, 2, 3, 4, 5, 6])),
        Step(12, 7.0, np.eye(4), motion, 11),
        None,
        None,
        2,
    )


@pytest.mark.parametrize("failed", [False, True])
def test_a_path_holds_poses_as_they_were_put_right(
    types: Types, failed: bool
) -> None:
    path = outputs.RecentPath(
        9, "odom", lambda: types.make("geometry_msgs/msg/PoseStamped")
    )
    failure = RelativePose.failed(Reason.NO_FLOW, "dark") if failed else None
    path.add(report(types))
    path.add(report(types, failure)._replace(step=step_of(13, failure)))
    moved = make_transform(np.eye(3), np.array([7.0, 8, 9]))
    after = replace(step_of(14), corrected=step_of(13))
    path.add(report(types)._replace(step=after, T_odom_before=moved))
    message = types.make("nav_msgs/msg/Path")
    path.fill(message, report(types))
    got = [pose.pose.position.x for pose in types.sent(message).poses]
    # what failed is not in the path, and the pose before it stays
    assert got == ([1, 1] if failed else [1, 7, 1])


def test_odometry(types: Types) -> None:
    message = types.make("nav_msgs/msg/Odometry")
    outputs.fill_odometry(message, report(types), "odom")
    got = types.sent(message)
    assert (got.header.frame_id, got.child_frame_id) == ("odom", "base")
    assert stamp_ns(got) == 7_000_000_090
    place = got.pose.pose.position
    assert (place.x, place.y, place.z) == (1, 2, 3)
    q = got.pose.pose.orientation
    np.testing.assert_allclose((q.x, q.y, q.z, q.w), (0, 0, HALF, HALF))
    # row by row, the mean of itself and its transposed: entry (0, 1) of 1 and 6
    assert got.pose.covariance.tolist()[:3] == [0, 3.5, 7]
    twist = got.twist.twist
    assert (twist.linear.x, twist.linear.z) == (1, 3)
    assert (twist.angular.x, twist.angular.z) == (4, 6)
    assert got.twist.covariance.reshape(6, 6)[5, 5] == 6


@pytest.mark.parametrize(
    ("status", "level", "text"),
    [
        (Status(), 0, "ok"),
        (
            Status.degraded(Reason.LOW_INLIERS, "few"),
            1,
            "degraded(low_inliers): few",
        ),
        (Status.failed(Reason.NO_FLOW, ""), 2, "failed(no_flow)"),
    ],
)
def test_diagnostics(types: Types, status: Status, level: int, text: str) -> None:
    covariance = np.diag([4e-4] * 3 + [1e-4] * 3)
    motion = RelativePose(np.eye(4), covariance, status, probability=0.75)
    message = types.make("diagnostic_msgs/msg/DiagnosticStatus")
    key_value = types.message_class("diagnostic_msgs/msg/KeyValue")
    outputs.fill_status(
        message, report(types, motion), key_value, age_s=0.0415, dropped=3
    )
    got = types.sent(message)
    assert (got.level, got.message, got.hardware_id) == (level, text, "optical")
    said = {value.key: value.value for value in got.values}
    assert said["probability"] == "0.75"
    assert said["status"] == status.state.value
    assert said["reason"] == status.reason.value
    # the root of three variances of 4 cm^2, and of three of 1e-4 rad^2
    assert float(said["sigma_translation_m"]) == pytest.approx(0.034641, abs=1e-6)
    assert float(said["sigma_rotation_rad"]) == pytest.approx(0.0173205, abs=1e-6)
    assert (said["age_ms"], said["dropped"], said["restarts"]) == ("41.5", "3", "2")
    assert (said["index"], said["prev_index"]) == ("12", "11")


def test_mask(types: Types) -> None:
    mask = np.zeros((2, 3), bool)
    mask[0, 2] = mask[1, 0] = True
    message = types.make("sensor_msgs/msg/Image")

    def wrap(data: bytes) -> np.ndarray:
        return np.frombuffer(data, np.uint8)

    outputs.fill_mask(message, Moving(header(types, 6), mask), wrap)
    got = types.sent(message)
    assert stamp_ns(got) == 6_000_000_090
    assert (got.encoding, got.height, got.width, got.step) == ("mono8", 2, 3, 3)
    assert got.data.tolist() == [0, 0, 255, 255, 0, 0]


def test_objects(types: Types) -> None:
    cup = MovingObject(
        7,
        np.ones((2, 3), bool),
        np.eye(4),
        np.eye(6),
        Status(),
        confidence=0.75,
        centre=np.array([0.5, -0.25, 2.0]),
        size=np.array([0.25, 0.5, 0.0]),
    )
    plain = report(types)
    shown = plain._replace(step=replace(plain.step, objects=(cup,)))
    message = types.make("visualization_msgs/msg/MarkerArray")
    outputs.fill_objects(
        message, shown, types.message_class("visualization_msgs/msg/Marker")
    )
    first, box, text = types.sent(message).markers
    assert first.action == 3  # DELETEALL: those of the frame before are gone
    assert (box.type, box.id, text.type, text.text) == (1, 7, 9, "7")
    assert box.header.frame_id == "optical" and stamp_ns(box) == 7_000_000_090
    place = box.pose.position
    assert (place.x, place.y, place.z) == (0.5, -0.25, 2)
    assert (box.scale.x, box.scale.y, box.color.a) == (0.25, 0.5, 0.75)
    # RViz refuses a side of 0
    assert box.scale.z > 0


# -- what is read ------------------------------------------------------------------------


def messages(
    tmp_path: Any, kind: str = "mcap", **lens: Any
) -> tuple[Any, Any, Any]:
    writer = bags.Writer(tmp_path, kind)
    rgb = writer.image(bags.rgb(1), "bgr8", bags.stamp(1))
    depth = writer.image(bags.millimetres(1), "16UC1", bags.stamp(1))
    info = writer.info(**lens)
    writer.close()
    return rgb, depth, info


@pytest.mark.parametrize("kind", ["ros1", "mcap"])
@pytest.mark.parametrize("as_is", [bytes, lambda data: array("B", bytes(data))])
def test_a_frame_of_messages(tmp_path: Any, kind: str, as_is: Any) -> None:
    rgb, depth, info = messages(tmp_path, kind)
    # ROS 1 has bytes, ROS 2 an array
    rgb.data = as_is(rgb.data)
    depth.data = as_is(depth.data)
    frame = FrameReader(NodeOptions()).frame(rgb, depth, info)
    np.testing.assert_array_equal(frame.rgb, bags.rgb(1)[:, :, ::-1])
    metres = bags.millimetres(1) / np.float32(1000)
    np.testing.assert_array_equal(frame.depth, metres)
    assert (frame.camera.fx, frame.camera.cy) == (bags.K[0], bags.K[3])
    assert frame.timestamp == bags.stamp(1) / 1e9


def test_distortion_is_taken_out_unless_the_topic_is_rectified(
    tmp_path: Any,
) -> None:
    given = messages(tmp_path, d=(0.1, 0, 0, 0, 0))
    bent = FrameReader(NodeOptions()).frame(*given)
    assert bent.mask is not None
    rectified = NodeOptions(topic_rgb="/camera/image_rect")
    straight = FrameReader(rectified).frame(*given)
    assert straight.mask is None
    assert not np.array_equal(bent.rgb, straight.rgb)


def test_units_and_times_are_those_of_the_parameters(tmp_path: Any) -> None:
    rgb, depth, info = messages(tmp_path / "a")
    unknown = FrameReader(NodeOptions()).frame(rgb, depth, info).camera
    assert unknown.readout_ms == unknown.depth_lag_ms == 0
    given = {"readout_ms": 25.0, "depth_lag_ms": -8.0, "depth_scale": 5000.0}
    reader = FrameReader(read_parameters(given)[0])
    told = reader.frame(rgb, depth, info)
    assert (told.camera.readout_ms, told.camera.depth_lag_ms) == (25, -8)
    assert told.depth is not None
    expected = bags.millimetres(1)[5, 5] / 5000
    assert told.depth[5, 5] == pytest.approx(expected, rel=1e-6)
    # a camera that changes is taken over
    _, _, other = messages(tmp_path / "b", k=(50.0, 50.0, 15.0, 11.0))
    assert reader.frame(rgb, depth, other).camera.fx == 50.0


def test_depth_that_is_not_registered_is_refused(tmp_path: Any) -> None:
    rgb, _, info = messages(tmp_path / "a")
    writer = bags.Writer(tmp_path / "b", "mcap")
    depth = writer.image(np.ones((10, 12), np.uint16), "16UC1", bags.stamp(1))
    writer.close()
    with pytest.raises(
        FormatError, match="depth is 12x10 pixels, the camera 32x24"
    ):
        FrameReader(NodeOptions()).frame(rgb, depth, info)


# -- parameters --------------------------------------------------------------------------


@pytest.mark.parametrize(
    "given",
    [
        {"refine.cutoff": 2.5, "track.keyframes": False, "base_frame": "base"},
        {
            "refine": {"cutoff": 2.5},
            "track": {"keyframes": "off"},
            "base_frame": "base",
            "use_sim_time": True,
            "qos_overrides./tf.subscription.depth": 5,
        },
    ],
)
def test_parameters_are_those_of_set(given: dict[str, Any]) -> None:
    node, options = read_parameters(given)
    assert node.base_frame == "base"
    assert options.refine.cutoff == 2.5
    assert options.track.keyframes == "off"


@pytest.mark.parametrize(
    ("name", "value", "said"),
    [
        ("bas_frame", "x", "bas_frame: expected one of base_frame"),
        ("refine.cut", 2, "refine.cut: unknown"),
        ("queue_size", 0, "queue_size"),
        ("depth_scale", -1.0, "depth_scale"),
    ],
)
def test_a_parameter_of_no_use_is_refused(name: str, value: Any, said: str) -> None:
    with pytest.raises(InputError, match=said):
        read_parameters({name: value})
