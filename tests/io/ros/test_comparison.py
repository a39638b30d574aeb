"""Whether the poses of a node are those of a run: with real bags and a real run."""

from __future__ import annotations

import importlib.util
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest
import yaml
from scipy.spatial.transform import Rotation

import hybridvo as hvo
from hybridvo.core.trajectory import Trajectory, read_trajectory
from hybridvo.io.ros.comparison import (
    difference,
    node_parameters,
    play_qos,
    recorded_odometry,
    used_topics,
)
from hybridvo.io.ros.conversions import optical_mount, pose_in_odom
from hybridvo.io.ros.parameters import read_parameters
from hybridvo.run.cli import main
from tests import bags
from tests.io.ros import scenes
from tests.io.ros.test_ros2 import PACKAGE

METHOD = "run.method=hybrid-flow"
"""Seconds of a test, not minutes."""


@pytest.fixture(scope="module")
def bag(tmp_path_factory: pytest.TempPathFactory) -> Path:
    root = tmp_path_factory.mktemp("drive")
    return scenes.write(root, "mcap", scenes.scene(), imu=True)


@pytest.fixture(scope="module")
def path(bag: Path, tmp_path_factory: pytest.TempPathFactory) -> Trajectory:
    """What ``hybridvo run`` writes of the bag."""
    out = tmp_path_factory.mktemp("run") / "run"
    command = ["run", str(bag), "--out", str(out), "-q", "--set", METHOD]
    assert main(command) in (0, 3)
    return read_trajectory(out / "trajectory.tum")


def heard(
    root: Path,
    path: Trajectory,
    *,
    kind: str = "mcap",
    left_out: int = 0,
    shift: float = 0.0,
    turn: float = 0.0,
) -> Path:
    """A recording of what a node publishes whose poses are those of the run, or a little off."""
    writer = bags.Writer(root, kind, "heard")
    mount = optical_mount("")
    for i in range(left_out, len(path)):
        T = pose_in_odom(path.T_world_cam[i], mount)
        xyz = T[:3, 3] + [0, shift * (i == 2), 0]
        R = T[:3, :3] @ Rotation.from_rotvec([0, 0, turn]).as_matrix()
        xyzw = Rotation.from_matrix(R).as_quat()
        message = writer.odometry(xyz, xyzw, bags.stamp(i), scenes.OPTICAL)
        writer.write("/odom", message, bags.stamp(i) + 50_000_000)
    return writer.close()


@pytest.mark.parametrize("kind", ["mcap", "sqlite3", "ros1"])
def test_the_same_poses_are_found_to_be_the_same(
    tmp_path: Path, path: Trajectory, kind: str
) -> None:
    recording = heard(tmp_path, path, kind=kind)
    found = difference(recorded_odometry(recording, "/odom"), path)
    assert (found.compared, found.missing, found.further) == (scenes.FRAMES, 0, 0)
    # the text of a pose has 17 digits
    assert found.metres < 1e-12 and found.degrees < 1e-9
    assert found.is_within(1e-6, 1e-4)


def test_the_largest_difference_is_named(tmp_path: Path, path: Trajectory) -> None:
    recording = heard(tmp_path, path, shift=0.002, turn=np.deg2rad(0.5))
    found = difference(recorded_odometry(recording, "/odom"), path)
    assert found.metres == pytest.approx(0.002, rel=1e-6)
    assert found.degrees == pytest.approx(0.5, rel=1e-6)
    assert found.frame == 2
    assert str(found) == (
        "6 poses compared: largest difference 0.002 m (frame 2), 0.5 deg"
    )
    assert found.is_within(0.0021, 0.51)
    assert not found.is_within(0.0019, 0.51)
    assert not found.is_within(0.0021, 0.49)


def test_frames_that_one_of_them_lacks_are_a_difference(
    tmp_path: Path, path: Trajectory
) -> None:
    messages = recorded_odometry(heard(tmp_path, path, left_out=1), "/odom")
    found = difference(messages, path)
    assert (found.compared, found.missing) == (5, 1)
    assert not found.is_within(1.0, 180.0)
    assert str(found).endswith("1 frames of the run were not published")
    short = Trajectory(path.timestamps[:3], path.T_world_cam[:3])
    found = difference(messages, short)
    assert (found.compared, found.missing, found.further) == (2, 1, 3)
    assert "3 published poses are of no frame of the run" in str(found)


def test_the_node_gets_what_the_run_uses(bag: Path, tmp_path: Path) -> None:
    used = used_topics(bag)
    assert used == (bags.RGB, bags.DEPTH, bags.INFO, scenes.IMU, scenes.FRAMES)
    parameters = node_parameters(used, [METHOD])
    # as ROS reads them
    typed = {name: yaml.safe_load(text) for name, text in parameters.items()}
    node, options = read_parameters(typed)
    assert (node.topic_imu, node.info) == (scenes.IMU, bags.INFO)
    assert node.queue_size > scenes.FRAMES and node.reliable
    assert options.run.method == "hybrid-flow"
    qos = play_qos(used)
    assert set(qos) == {*used[:4], "/tf_static"}
    assert qos["/tf_static"]["durability"] == "transient_local"
    assert {each["reliability"] for each in qos.values()} == {"reliable"}

    plain = used_topics(bags.plain_bag(tmp_path, "mcap"))
    assert plain.imu == ""
    assert "topic_imu" not in node_parameters(plain)
    with pytest.raises(hvo.InputError, match="--set: expected group"):
        node_parameters(plain, ["refine"])


# -- the program -------------------------------------------------------------------------


@pytest.fixture
def program() -> ModuleType:
    file = PACKAGE / "hybridvo_ros" / "compare.py"
    spec = importlib.util.spec_from_file_location("hybridvo_ros_compare", file)
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.mark.parametrize(("shift", "code"), [(0.0, 0), (0.001, 1)])
def test_the_program_compares_a_recording(
    bag: Path,
    path: Trajectory,
    tmp_path: Path,
    program: ModuleType,
    capsys: pytest.CaptureFixture[str],
    shift: float,
    code: int,
) -> None:
    recording = heard(tmp_path, path, shift=shift)
    given = [str(bag), "--heard", str(recording), "--out", str(tmp_path / "out")]
    assert program.main([*given, "--set", METHOD]) == code
    assert "6 poses compared: largest difference" in capsys.readouterr().out
