"""The node of ROS 2 with a made-up rclpy; its messages go through rosbags' own code."""

from __future__ import annotations

import importlib.util
import re
import runpy
import sys
import xml.etree.ElementTree as ET
from dataclasses import fields
from pathlib import Path
from types import ModuleType
from typing import Any
from unittest.mock import MagicMock

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import hybridvo as hvo
from hybridvo.core.geometry import invert
from hybridvo.core.options import load_options
from hybridvo.io.data.open import open_sequence
from hybridvo.io.ros.conversions import optical_mount, pose_in_odom
from hybridvo.io.ros.frames import stamp_ns
from hybridvo.io.ros.inbox import Inbox
from hybridvo.io.ros.parameters import NodeOptions, read_parameters
from tests import bags
from tests.io.ros import fake_ros2, scenes

PACKAGE = Path(__file__).resolve().parents[3] / "ros2/hybridvo_ros"
NODE_2 = ("hybridvo_ros", "odometry")
"""Package and executable."""
GIVEN = {
    "topic_rgb": bags.RGB,
    "topic_depth": bags.DEPTH,
    "queue_size": 100,
    "refine.cutoff": 2.5,
    # seconds of a test, not minutes
    "run.method": "hybrid-flow",
}


@pytest.fixture(scope="module")
def bag(tmp_path_factory: pytest.TempPathFactory) -> Path:
    root = tmp_path_factory.mktemp("drive")
    return scenes.write(root, "mcap", scenes.scene())


@pytest.fixture(scope="module")
def turning(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The drive with a gyroscope."""
    root = tmp_path_factory.mktemp("turning")
    return scenes.write(root, "mcap", scenes.scene(), imu=True)


def node_of(monkeypatch: pytest.MonkeyPatch, **given: Any) -> Any:
    """The node, with some parameters."""
    fake_ros2.install(monkeypatch, GIVEN | given)
    path = PACKAGE / "hybridvo_ros" / "odometry.py"
    spec = importlib.util.spec_from_file_location("hybridvo_ros_odometry", path)
    assert spec is not None and spec.loader is not None
    module: ModuleType = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module.OdometryNode()


def play(node: Any, bag: Path, skip: tuple[str, ...] = ()) -> None:
    """Hand all messages of a bag to the node, and let it track them."""
    from rosbags.rosbag2 import Reader

    with Reader(bag) as reader:
        for connection, _, data in reader.messages():
            if connection.topic in node.subscriptions_by_topic:
                if connection.topic in skip:
                    continue
                store = fake_ros2.TYPES.store
                message = store.deserialize_cdr(data, connection.msgtype)
                node.subscriptions_by_topic[connection.topic].callback(message)
    node.inbox.close(finish=True)
    node.work()


def tracked_by(bag: Path) -> tuple[hvo.Odometry, list[hvo.Step]]:
    """A tracker, and its steps: with the gyroscope of the bag, where there is one."""
    options = load_options(
        assignments=["refine.cutoff=2.5", "run.method=hybrid-flow"]
    )
    tracker = hvo.Odometry(method="hybrid-flow", options=options)
    sequence = open_sequence(bag)
    steps = list[hvo.Step]()
    for frame in sequence:
        last = tracker.state.sensors.last
        imu = None
        if last is not None:
            imu = sequence.imu(last.timestamp, frame.timestamp)
        steps.append(tracker.track(frame, imu=imu))
    return tracker, steps


def tracked(bag: Path) -> list[hvo.Step]:
    return tracked_by(bag)[1]


@pytest.mark.slow
def test_what_comes_out_of_a_bag(
    monkeypatch: pytest.MonkeyPatch, bag: Path
) -> None:
    node = node_of(
        monkeypatch,
        base_frame=scenes.BASE,
        publish_tf=True,
        publish_mask=True,
        publish_objects=True,
        publish_path=True,
        path_length=4,
    )
    play(node, bag)
    sent = {topic: p.sent for topic, p in node.publishers_by_topic.items()}
    steps = tracked(bag)
    mount = scenes.T_BASE_OPTICAL
    assert len(sent["odom"]) == len(steps) == scenes.FRAMES
    for i, (message, step) in enumerate(zip(sent["odom"], steps, strict=True)):
        assert stamp_ns(message) == bags.stamp(i)
        assert message.header.frame_id == "odom"
        assert message.child_frame_id == scenes.BASE
        T = mount @ step.T_world_cam @ invert(mount)
        np.testing.assert_allclose(scenes.pose(message), T, atol=1e-12)
        (status,) = sent["/diagnostics"][i].status
        said = {value.key: value.value for value in status.values}
        assert said["status"] == step.status.state.value
        assert float(said["probability"]) == pytest.approx(
            step.probability, abs=1e-5
        )
        age_ms = (fake_ros2.NOW_NS - bags.stamp(i)) / 1e6
        assert float(said["age_ms"]) == pytest.approx(age_ms, rel=1e-5)
        (transform,) = sent["/tf"][i].transforms
        assert transform.header.frame_id == "odom"
        place = message.pose.pose.position
        assert transform.transform.translation.z == place.z
    assert len(sent["~/moving"]) == scenes.FRAMES - 1
    assert stamp_ns(sent["~/moving"][0]) == bags.stamp(0)
    assert len(sent["~/objects"]) == scenes.FRAMES
    assert stamp_ns(sent["~/objects"][1].markers[0]) == bags.stamp(1)
    assert not node.said
    paths = sent["~/path"]
    assert [len(path.poses) for path in paths] == [1, 2, 3, 4, 4, 4]
    assert stamp_ns(paths[-1]) == bags.stamp(5)
    assert [stamp_ns(each) for each in paths[-1].poses] == [
        bags.stamp(i) for i in range(2, 6)
    ]
    last = paths[-1].poses[-1]
    assert last.header.frame_id == paths[-1].header.frame_id == "odom"
    assert last.pose.position == sent["odom"][-1].pose.pose.position
    assert last.pose.orientation == sent["odom"][-1].pose.pose.orientation


def test_the_gyroscope_of_a_bag_is_used_as_a_run_uses_it(
    monkeypatch: pytest.MonkeyPatch, turning: Path
) -> None:
    node = node_of(monkeypatch, topic_imu=scenes.IMU)
    assert node.subscriptions_by_topic[scenes.IMU].kind.__name__ == "Imu"
    play(node, turning)
    tracker, steps = tracked_by(turning)
    sent = node.publishers_by_topic["odom"].sent
    for message, step in zip(sent, steps, strict=True):
        # turned from optical axes to body axes and back
        T = pose_in_odom(step.T_world_cam, optical_mount(""))
        np.testing.assert_allclose(scenes.pose(message), T, atol=1e-12)
    gyroscope = node.follower._tracker.state.sensors.gyroscope
    np.testing.assert_array_equal(
        gyroscope.bias, tracker.state.sensors.gyroscope.bias
    )
    # the rotation to the camera is that of /tf_static: else it would be learned as a bias
    assert np.linalg.norm(gyroscope.bias - scenes.BIAS) < 0.5 * np.linalg.norm(
        scenes.BIAS
    )
    assert not node.said


def test_a_gyroscope_that_is_not_fixed_to_the_camera_is_not_used(
    monkeypatch: pytest.MonkeyPatch, turning: Path
) -> None:
    node = node_of(monkeypatch, topic_imu=scenes.IMU)
    play(node, turning, skip=("/tf_static",))
    assert len(node.publishers_by_topic["odom"].sent) == scenes.FRAMES
    assert node.follower._tracker.state.sensors.gyroscope is None
    assert node.said == [
        f"{scenes.IMU} is not used: no /tf_static between 'gyro' and 'color_optical'"
    ]


def test_every_parameter_is_declared_with_its_meaning_and_limits(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Given ones as well, whatever type they were given in; none can be set later."""
    node = node_of(monkeypatch, depth_scale=5000, publish_objects=True)
    described = node.descriptors
    assert {each.name for each in fields(NodeOptions)} < set(described)
    for name, descriptor in described.items():
        assert len(descriptor.description) > 10, name
        assert descriptor.read_only, name
    assert node.parameters["depth_scale"] == 5000.0
    assert type(node.parameters["depth_scale"]) is float
    (limits,) = described["queue_size"].integer_range
    assert (limits.from_value, limits.to_value, limits.step) == (1, 2**31 - 1, 1)
    # those of the tracker, with the values in force
    assert node.parameters["refine.cutoff"] == 2.5
    assert node.parameters["track.objects"] == "auto"
    assert described["track.budget_ms"].dynamic_typing
    # of a recording: they would mean nothing
    assert "run.stop" not in described


def test_a_reset_begins_at_the_origin_in_the_frame_after(
    monkeypatch: pytest.MonkeyPatch, bag: Path
) -> None:
    node = node_of(monkeypatch, publish_path=True)
    play(node, bag)
    response = node.services_by_name["~/reset"]()
    assert response.success
    assert response.message == (
        "tracking begins anew with the next frame, at the origin"
    )
    sent = node.publishers_by_topic["odom"].sent
    far = np.linalg.norm(scenes.pose(sent[-1])[:3, 3])
    node.inbox = Inbox(node.options, node.said.append)
    node._subscribe()
    play(node, bag)
    # the stamps are those of before, and yet no jump back
    assert node.said == ["reset: tracking begins anew at the origin"]
    first, second = sent[scenes.FRAMES : scenes.FRAMES + 2]
    assert far > 1e-3
    np.testing.assert_allclose(scenes.pose(first)[:3, 3], 0, atol=1e-15)
    # as after the start: where it is is known
    assert first.pose.covariance[0] == sent[0].pose.covariance[0]
    np.testing.assert_allclose(
        scenes.pose(second), scenes.pose(sent[1]), atol=1e-12
    )
    paths = node.publishers_by_topic["~/path"].sent
    assert [len(path.poses) for path in paths] == 2 * [1, 2, 3, 4, 5, 6]
    last = node.publishers_by_topic["/diagnostics"].sent[-1].status[0]
    assert {v.key: v.value for v in last.values}["restarts"] == "1"


def test_without_a_base_poses_are_of_the_optical_frame(
    monkeypatch: pytest.MonkeyPatch, bag: Path
) -> None:
    node = node_of(monkeypatch)
    play(node, bag)
    sent = node.publishers_by_topic["odom"].sent
    first = sent[0]
    assert first.child_frame_id == scenes.OPTICAL
    # how ROS turns body axes into optical ones
    expected = Rotation.from_quat(scenes.OPTICAL_XYZW).as_matrix()
    np.testing.assert_allclose(scenes.pose(first)[:3, :3], expected, atol=1e-12)
    assert set(node.publishers_by_topic) == {"odom", "/diagnostics"}
    # nothing is known of the velocity before the first motion
    assert first.twist.covariance[0] == 1e4


def test_frames_wait_for_the_place_of_the_base(
    monkeypatch: pytest.MonkeyPatch, bag: Path
) -> None:
    node = node_of(monkeypatch, base_frame="wheels")
    play(node, bag)
    assert not node.publishers_by_topic["odom"].sent
    assert node.said == [
        "waiting for a transform between 'wheels' and 'color_optical' in /tf_static"
    ]


def test_what_the_node_asks_of_ros(monkeypatch: pytest.MonkeyPatch) -> None:
    compressed = f"{bags.RGB}/compressed"
    node = node_of(monkeypatch, topic_rgb=compressed, reliable=True)
    topics = node.subscriptions_by_topic
    kinds = {topic: made.kind.__name__ for topic, made in topics.items()}
    assert kinds == {
        compressed: "CompressedImage",
        bags.DEPTH: "Image",
        bags.INFO: "CameraInfo",
        "/tf_static": "TFMessage",
    }
    assert topics[bags.DEPTH].qos.reliability == "reliable"
    # else what was sent before the node started would never come
    assert topics["/tf_static"].qos.durability == "transient local"


def started_by(file: Path, monkeypatch: pytest.MonkeyPatch) -> dict[str, Any]:
    """The parameters that a launch file of ROS 2 gives to the node."""
    modules = {
        name: MagicMock()
        for name in (
            *("launch", "launch.actions", "launch.substitutions"),
            *("launch.launch_description_sources", "launch_ros"),
            *("launch_ros.actions", "launch_ros.parameter_descriptions"),
            *("launch_ros.substitutions", "launch.conditions"),
        )
    }
    for name, module in modules.items():
        monkeypatch.setitem(sys.modules, name, module)
    runpy.run_path(str(file))["generate_launch_description"]()
    node, rviz = modules["launch_ros.actions"].Node.call_args_list
    assert (node.kwargs["package"], node.kwargs["executable"]) == NODE_2
    assert (rviz.kwargs["package"], rviz.kwargs["executable"]) == ("rviz2", "rviz2")
    assert "condition" in rviz.kwargs
    (given,) = node.kwargs["parameters"]
    return given


def test_launch_files_give_parameters_that_the_node_has(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    given = {
        file.name: list(started_by(file, monkeypatch))
        for file in (PACKAGE / "launch").glob("*.launch.py")
    }
    for file in (PACKAGE.parents[1] / "ros1/hybridvo_ros/launch").glob("*.launch"):
        (node,) = (
            node
            for node in ET.parse(file).iter("node")
            if node.get("pkg") == "hybridvo_ros"
        )
        given[file.name] = [param.attrib["name"] for param in node.iter("param")]
    assert len(given) == 4
    for name, parameters in given.items():
        assert {"base_frame", "topic_imu", "publish_path"} <= set(parameters), name
        for parameter in parameters:
            value: Any = "x"
            if parameter.startswith(("publish_", "reliable", "use_")):
                value = True
            if parameter == "queue_size":
                value = 3
            read_parameters({parameter: value})


def test_the_package_names_what_the_node_imports() -> None:
    """``rosdep`` installs what package.xml names."""
    source = (PACKAGE / "hybridvo_ros" / "odometry.py").read_text(encoding="utf-8")
    imported = set(re.findall(r"^(?:from|import) (\w+)", source, re.MULTILINE))
    of_ros = imported - set(sys.stdlib_module_names) - {"hybridvo"}
    only_of_ros_2 = {"rclpy", "rcl_interfaces"}
    ros1 = PACKAGE.parents[1] / "ros1/hybridvo_ros"
    for package, needed in ((PACKAGE, of_ros), (ros1, of_ros - only_of_ros_2)):
        tree = ET.parse(package / "package.xml")
        named = {element.text for element in tree.iter("exec_depend")}
        assert not needed - named
        released = hvo.__version__.partition(".dev")[0]
        assert tree.findtext("version") == released
    assert "rclpy" in of_ros
