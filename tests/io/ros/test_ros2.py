"""The node of ROS 2 with a made-up rclpy; its messages go through rosbags' own code."""

from __future__ import annotations

import importlib.util
import re
import runpy
import sys
import xml.etree.ElementTree as ET
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
from hybridvo.io.ros.frames import stamp_ns
from hybridvo.io.ros.parameters import read_parameters
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


def tracked(bag: Path) -> list[hvo.Step]:
    options = load_options(
        assignments=["refine.cutoff=2.5", "run.method=hybrid-flow"]
    )
    tracker = hvo.Odometry(method="hybrid-flow", options=options)
    return [tracker.track(frame) for frame in open_sequence(bag)]


def pose(message: Any) -> np.ndarray:
    inner = message.pose.pose
    q = inner.orientation
    T = np.eye(4)
    T[:3, :3] = Rotation.from_quat([q.x, q.y, q.z, q.w]).as_matrix()
    T[:3, 3] = inner.position.x, inner.position.y, inner.position.z
    return T


def test_what_comes_out_of_a_bag(
    monkeypatch: pytest.MonkeyPatch, bag: Path
) -> None:
    node = node_of(
        monkeypatch,
        base_frame=scenes.BASE,
        publish_tf=True,
        publish_mask=True,
        publish_objects=True,
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
        np.testing.assert_allclose(pose(message), T, atol=1e-12)
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
    np.testing.assert_allclose(pose(first)[:3, :3], expected, atol=1e-12)
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


def test_frames_wait_for_their_camera(
    monkeypatch: pytest.MonkeyPatch, bag: Path
) -> None:
    node = node_of(monkeypatch)
    play(node, bag, skip=(bags.INFO,))
    assert node.said == [f"waiting for a CameraInfo on {bags.INFO}"]


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


def test_a_thread_of_its_own_tracks(
    monkeypatch: pytest.MonkeyPatch, bag: Path
) -> None:
    node = node_of(monkeypatch)
    node.start()
    node.stop()
    assert not node._thread.is_alive()


def test_the_package_names_what_the_node_imports() -> None:
    """``rosdep`` installs what package.xml names."""
    source = (PACKAGE / "hybridvo_ros" / "odometry.py").read_text(encoding="utf-8")
    imported = set(re.findall(r"^(?:from|import) (\w+)", source, re.MULTILINE))
    of_ros = imported - set(sys.stdlib_module_names) - {"hybridvo"}
    for package in (PACKAGE, PACKAGE.parents[1] / "ros1/hybridvo_ros"):
        tree = ET.parse(package / "package.xml")
        named = {element.text for element in tree.iter("exec_depend")}
        missing = of_ros - named - {"rclpy"}
        assert not missing
        released = hvo.__version__.partition(".dev")[0]
        assert tree.findtext("version") == released
    assert "rclpy" in of_ros


def started_by(file: Path, monkeypatch: pytest.MonkeyPatch) -> dict[str, Any]:
    """The parameters that a launch file of ROS 2 gives to the node."""
    modules = {
        name: MagicMock()
        for name in (
            *("launch", "launch.actions", "launch.substitutions"),
            *("launch.launch_description_sources", "launch_ros"),
            *("launch_ros.actions", "launch_ros.parameter_descriptions"),
            "launch_ros.substitutions",
        )
    }
    for name, module in modules.items():
        monkeypatch.setitem(sys.modules, name, module)
    runpy.run_path(str(file))["generate_launch_description"]()
    (node,) = modules["launch_ros.actions"].Node.call_args_list
    assert (node.kwargs["package"], node.kwargs["executable"]) == NODE_2
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
        assert "base_frame" in parameters, name
        for parameter in parameters:
            value = {"publish_tf": True, "queue_size": 3, "reliable": True}
            read_parameters({parameter: value.get(parameter, "x")})


def test_ages_with_a_bag_are_by_its_time(monkeypatch: pytest.MonkeyPatch) -> None:
    given = started_by(PACKAGE / "launch" / "bag.launch.py", monkeypatch)
    assert given["use_sim_time"] is True
    (play,) = sys.modules["launch.actions"].ExecuteProcess.call_args_list
    assert "--clock" in play.kwargs["cmd"]
    launch = PACKAGE.parents[1] / "ros1/hybridvo_ros/launch/bag.launch"
    tree = ET.parse(launch).getroot()
    global_parameters = {
        p.get("name"): p.get("value") for p in tree.findall("param")
    }
    assert global_parameters["/use_sim_time"] == "true"
    (play,) = (n for n in tree.iter("node") if n.get("type") == "play")
    assert "--clock" in play.get("args", "").split()


def test_the_packages_of_ros_1_hold_every_command_of_the_page() -> None:
    page = (PACKAGE.parents[1] / "docs/ros.md").read_text(encoding="utf-8")
    makefile = (PACKAGE.parents[1] / "Makefile").read_text(encoding="utf-8")
    for text in (page, makefile):
        assert "python3-rostopic" in text


def test_the_entry_point_is_there() -> None:
    text = (PACKAGE / "setup.py").read_text(encoding="utf-8")
    assert "odometry = {NAME}.odometry:main" in text
    source = (PACKAGE / "hybridvo_ros" / "odometry.py").read_text(encoding="utf-8")
    assert "\ndef main(" in source
