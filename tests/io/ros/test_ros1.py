"""The node of ROS 1 for real: a master, a bag that is played, and what a recorder hears.

``make test-ros`` installs ROS 1 from the packages of Debian 12.
"""

from __future__ import annotations

import csv
import os
import shutil
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any
from xmlrpc.client import ServerProxy

import numpy as np
import pytest
from rosbags.rosbag1 import Reader
from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from scipy.spatial.transform import Rotation

import hybridvo as hvo
from hybridvo.core.geometry import invert
from hybridvo.core.options import load_options
from hybridvo.core.trajectory import read_trajectory
from hybridvo.io.data.open import open_sequence
from hybridvo.io.masks import mask_of
from hybridvo.run.cli import main
from tests import bags
from tests.io.ros import scenes

pytestmark = [
    pytest.mark.ros,
    # on a busy machine the node needs minutes to load its network
    pytest.mark.timeout(1800),
    pytest.mark.skipif(
        not shutil.which("roscore"), reason="ROS 1 is not installed: make test-ros"
    ),
]
NODE = Path(__file__).resolve().parents[3] / "ros1/hybridvo_ros/scripts/odometry"
LONG_S = 600.0
"""Until the node has loaded its network, and until it has tracked a bag, at the latest."""
BODY = np.array([[0.0, 0, 1, 0], [-1, 0, 0, 0], [0, -1, 0, 0], [0, 0, 0, 1]])


class Ros:
    """A master, and programs that end with it."""

    def __init__(self, home: Path) -> None:
        with socket.socket() as probe:
            probe.bind(("127.0.0.1", 0))
            port = probe.getsockname()[1]
        self.uri = f"http://127.0.0.1:{port}"
        root = str(NODE.parents[3])
        programs = f"{Path(sys.executable).parent}:{os.environ['PATH']}"
        self.env = os.environ | {
            # roslaunch starts the node by /usr/bin/env python3
            "PATH": programs,
            "ROS_PACKAGE_PATH": f"{root}/ros1:/usr/share",
            "ROS_MASTER_URI": self.uri,
            "ROS_IP": "127.0.0.1",
            "ROS_HOME": str(home),
            "PYTHONPATH": root,
            "OMP_NUM_THREADS": "1",
        }
        self.home = home
        self.programs: list[subprocess.Popen] = []
        self.start("roscore", "-p", str(port))
        self.wait_for(lambda: call(self.uri, "getPid")[0] == 1)

    def start(self, *command: str) -> subprocess.Popen:
        log = self.home / f"{len(self.programs)}.log"
        with log.open("w") as file:
            program = subprocess.Popen(
                command, env=self.env, stdout=file, stderr=file, text=True
            )
        self.programs.append(program)
        return program

    def wait_for(self, is_so: Any) -> None:
        """Wait until something is so, or fail with what the programs wrote."""
        deadline = time.monotonic() + LONG_S
        while time.monotonic() < deadline:
            try:
                if is_so():
                    return
            except OSError:
                pass
            time.sleep(0.05)
        pytest.fail(self.logs())

    def logs(self) -> str:
        return "\n".join(file.read_text() for file in self.home.glob("*.log"))

    def listeners(self, node: str) -> set[str]:
        """The topics on which somebody is connected to a node."""
        code, _, uri = call(self.uri, "lookupNode", node)
        if code != 1:
            return set()
        _, _, connections = call(uri, "getBusInfo")
        return {topic for _, _, way, _, topic, *_ in connections if way == "o"}

    def stop(self) -> None:
        for program in reversed(self.programs):
            program.terminate()
            program.wait(LONG_S)


def call(uri: str, name: str, *given: str) -> Any:
    """What a master, or a node, answers: a code, a sentence, a value."""
    with ServerProxy(uri) as server:
        return getattr(server, name)("/test", *given)


@pytest.fixture
def ros(tmp_path: Path) -> Iterator[Ros]:
    home = tmp_path / "ros"
    home.mkdir()
    started = Ros(home)
    yield started
    started.stop()


def heard(
    ros: Ros,
    bag: Path,
    out: Path,
    topics: tuple[str, ...],
    *options: str,
    imu: bool = False,
) -> dict[str, list[Any]]:
    """Play a bag to the node; returns what it published, by topic."""
    if imu:
        options += (f"_topic_imu:={scenes.IMU}",)
    ros.start(sys.executable, str(NODE), "_queue_size:=1000", *options)
    recorder = record(ros, out, topics)
    ros.wait_for(lambda: ros.listeners("/hybridvo") >= set(topics))
    if imu:
        # nothing has been tracked: it counts, and changes nothing
        reset = ros.start("rosservice", "call", "/hybridvo/reset")
        assert reset.wait(LONG_S) == 0, ros.logs()
    played = [bags.RGB, bags.DEPTH, bags.INFO, "/tf_static", *imu * [scenes.IMU]]
    play = ros.start(
        *("rosbag", "play", "--wait-for-subscribers", str(bag)),
        *("--topics", *played),
    )
    assert play.wait(LONG_S) == 0, ros.logs()
    return recorded(ros, recorder, bag, out)


def record(ros: Ros, out: Path, topics: tuple[str, ...]) -> subprocess.Popen:
    return ros.start("rosbag", "record", "-O", str(out), *topics)


def recorded(
    ros: Ros, recorder: subprocess.Popen, bag: Path, out: Path
) -> dict[str, list[Any]]:
    """What was recorded when every frame of a bag was tracked."""
    frames = len(open_sequence(bag))
    ros.wait_for(lambda: published(ros) >= frames)
    recorder.send_signal(signal.SIGINT)
    # the recorder is a child of this program, and gives the file its name at its end
    assert recorder.wait(LONG_S) == 0
    ros.wait_for(out.exists)
    return messages(out)


def published(ros: Ros) -> int:
    """How many messages of type Odometry the node sent to the recorder."""
    code, _, uri = call(ros.uri, "lookupNode", "/hybridvo")
    if code != 1:
        return 0
    _, _, (published, *_) = call(uri, "getBusStats")
    counts = [
        sum(connection[2] for connection in connections)
        for topic, _, connections in published
        if topic == "/odom"
    ]
    return sum(counts)


def messages(path: Path) -> dict[str, list[Any]]:
    store = get_typestore(Stores.ROS1_NOETIC)
    content = "geometry_msgs/TransformStamped[] transforms"
    store.register(get_types_from_msg(content, "tf2_msgs/msg/TFMessage"))
    found: dict[str, list[Any]] = {}
    with Reader(path) as reader:
        for connection, _, data in reader.messages():
            message = store.deserialize_ros1(data, connection.msgtype)
            found.setdefault(connection.topic, []).append(message)
    return found


def run(bag: Path, out: Path, *options: str) -> tuple[np.ndarray, list[dict]]:
    """Poses and rows of ``hybridvo run``."""
    assert main(["run", str(bag), "--out", str(out), "-q", *options]) in (0, 3)
    with (out / "steps.csv").open() as file:
        rows = list(csv.DictReader(file))
    return read_trajectory(out / "trajectory.tum").T_world_cam, rows


def values(array: Any) -> dict[str, str]:
    (status,) = array.status
    return {value.key: value.value for value in status.values}


def test_a_played_bag_gives_what_run_writes(ros: Ros, tmp_path: Path) -> None:
    bag = scenes.write(tmp_path / "scene", "ros1", scenes.scene())
    topics = ("/odom", "/diagnostics", "/tf", "/hybridvo/moving")
    found = heard(
        ros,
        bag,
        tmp_path / "heard.bag",
        topics,
        *(
            f"_base_frame:={scenes.BASE}",
            "_publish_tf:=true",
            "_publish_mask:=true",
        ),
        "_refine/cutoff:=2.5",
    )
    expected, rows = run(bag, tmp_path / "run", "--set", "refine.cutoff=2.5")
    assert len(found["/odom"]) == len(expected) == scenes.FRAMES
    mount = scenes.T_BASE_OPTICAL
    for i, message in enumerate(found["/odom"]):
        assert message.header.frame_id == "odom"
        assert message.child_frame_id == scenes.BASE
        stamp = message.header.stamp
        assert stamp.sec * 10**9 + stamp.nanosec == bags.stamp(i)
        # the text of a pose has 17 digits
        T = mount @ expected[i] @ invert(mount)
        np.testing.assert_allclose(scenes.pose(message), T, atol=1e-12)
        covariance = message.pose.covariance.reshape(6, 6)
        assert np.linalg.eigvalsh(covariance)[0] > 0
        said = values(found["/diagnostics"][i])
        assert said["status"] == rows[i]["status"]
        assert float(said["probability"]) == pytest.approx(
            float(rows[i]["probability"]), abs=1e-6
        )
        transform = found["/tf"][i].transforms[0]
        assert transform.child_frame_id == scenes.BASE
        assert transform.transform.translation.x == message.pose.pose.position.x

    # the twist leads from one pose to the next
    a, b = found["/odom"][1:3]
    seconds = (bags.stamp(2) - bags.stamp(1)) / 1e9
    twist = b.twist.twist
    angular = np.array([twist.angular.x, twist.angular.y, twist.angular.z])
    turned = scenes.pose(a)[:3, :3].T @ scenes.pose(b)[:3, :3]
    np.testing.assert_allclose(
        Rotation.from_matrix(turned).as_rotvec(), seconds * angular, atol=1e-9
    )
    assert_masks(found["/hybridvo/moving"], bag)


def test_a_gyroscope_a_path_and_a_reset(ros: Ros, tmp_path: Path) -> None:
    bag = scenes.write(tmp_path / "scene", "ros1", scenes.scene(), imu=True)
    topics = ("/odom", "/diagnostics", "/hybridvo/path")
    found = heard(
        ros, bag, tmp_path / "heard.bag", topics, "_publish_path:=true", imu=True
    )
    assert "success: True" in ros.logs()
    # it uses the gyroscope of a bag as well
    expected, _ = run(bag, tmp_path / "run")
    assert len(found["/odom"]) == len(expected) == scenes.FRAMES
    for message, T, said in zip(
        found["/odom"], expected, found["/diagnostics"], strict=True
    ):
        np.testing.assert_allclose(scenes.pose(message), BODY @ T, atol=1e-12)
        assert values(said)["restarts"] == "1"
    paths = found["/hybridvo/path"]
    assert [len(path.poses) for path in paths] == [1, 2, 3, 4, 5, 6]
    assert (
        paths[-1].poses[-1].pose.position == found["/odom"][-1].pose.pose.position
    )


def assert_masks(found: list[Any], bag: Path) -> None:
    """Every mask is of the image before, and says what a tracker of our own finds."""
    options = load_options(assignments=["refine.cutoff=2.5"])
    tracker = hvo.Odometry(options=options)
    sequence = open_sequence(bag)
    steps = [tracker.track(frame) for frame in sequence]
    assert [step.prev_index for step in steps] == [None, *range(len(found))]
    for i, message in enumerate(found):
        stamp = message.header.stamp
        assert stamp.sec * 10**9 + stamp.nanosec == bags.stamp(i)
        assert message.encoding == "mono8"
        mask = message.data.reshape(message.height, message.width)
        static = mask_of(sequence[i], steps[i + 1].motion.weights)
        np.testing.assert_array_equal(mask, np.where(static, 0, 255))
    assert any(message.data.any() for message in found)


def test_a_real_recording_by_the_launch_file(
    ros: Ros, shared_data: Path, tmp_path: Path
) -> None:
    """A Kinect's frames: poses of the optical frame, in axes that begin at the camera."""
    recording = shared_data / "tum" / "rgbd_dataset_freiburg1_xyz_first10"
    bag = tmp_path / "drive.bag"
    assert main(["convert", str(recording), str(bag), "-q"]) == 0
    out = tmp_path / "heard.bag"
    recorder = record(ros, out, ("/odom", "/diagnostics"))
    ros.start("roslaunch", "hybridvo_ros", "bag.launch", f"bag:={bag}", "delay:=3")
    found = recorded(ros, recorder, bag, out)
    expected, rows = run(bag, tmp_path / "run")
    for message, T, row, said in zip(
        found["/odom"], expected, rows, found["/diagnostics"], strict=True
    ):
        np.testing.assert_allclose(scenes.pose(message), BODY @ T, atol=1e-12)
        assert message.child_frame_id == "camera_color_optical_frame"
        assert values(said)["status"] == row["status"]
