"""The container and the environment of pixi: they name what the package needs. Neither was run."""

from __future__ import annotations

import re
import tomllib
import xml.etree.ElementTree as ET
from pathlib import Path
from typing import Any

import pytest

ROOT = Path(__file__).resolve().parents[3]
PACKAGE = ROOT / "ros2" / "hybridvo_ros"
OF_ROS_BASE = {
    *("diagnostic_msgs", "geometry_msgs", "nav_msgs", "sensor_msgs", "std_srvs"),
    *("launch", "launch_ros", "rcl_interfaces", "rclpy", "tf2_msgs"),
    *("ros2bag", "visualization_msgs"),
}
"""What the metapackage ros_base brings (REP 2001), of what the package needs."""


def needed() -> set[str]:
    tree = ET.parse(PACKAGE / "package.xml")
    return {str(element.text) for element in tree.iter("exec_depend")}


@pytest.fixture
def pixi() -> dict[str, Any]:
    return tomllib.loads((ROOT / "pixi.toml").read_text(encoding="utf-8"))


def conda_names(names: set[str]) -> set[str]:
    return {f"ros-jazzy-{name.replace('_', '-')}" for name in names}


def test_the_container_has_what_the_package_needs() -> None:
    text = (ROOT / "ros2" / "Containerfile").read_text(encoding="utf-8")
    assert "FROM ros:jazzy-ros-base" in text
    assert conda_names(needed() - OF_ROS_BASE) <= set(text.split())
    for line in re.findall(r"^COPY (.+)$", text, re.MULTILINE):
        for source in line.split()[:-1]:
            assert (ROOT / source).exists(), source
    # a folder that the build hook or the wheel needs, and is not there, would fail late
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))
    wheel = project["tool"]["hatch"]["build"]["targets"]["wheel"]
    needs = [*wheel["force-include"], wheel["hooks"]["custom"]["path"]]
    copied = " ".join(re.findall(r"^COPY (.+)$", text, re.MULTILINE)).split()
    for path in [*needs, project["project"]["readme"]]:
        assert path.split("/")[0] in copied, path


def test_the_environment_of_pixi_has_what_the_package_needs(
    pixi: dict[str, Any],
) -> None:
    feature = pixi["feature"]["ros2"]
    assert conda_names(needed() - OF_ROS_BASE) <= set(feature["dependencies"])
    assert "ros-jazzy-ros-base" in feature["dependencies"]
    assert feature["dependencies"]["python"] == "3.12.*"
    assert pixi["environments"] == {"ros2": ["ros2"]}
    # the present one is as it was
    assert pixi["workspace"]["channels"] == ["conda-forge"]
    assert set(pixi["dependencies"]) == {"python", "pytorch"}
    assert set(feature["platforms"]) <= set(pixi["workspace"]["platforms"])
    for channel in feature["channels"]:
        assert "/" not in channel


def test_one_command_compares(pixi: dict[str, Any]) -> None:
    task = pixi["feature"]["ros2"]["tasks"]["compare-ros2"]
    assert task["cmd"] == "python -m hybridvo_ros.compare"
    assert "ros2/hybridvo_ros:" in task["env"]["PYTHONPATH"]
    page = (ROOT / "docs" / "ros.md").read_text(encoding="utf-8")
    container = (ROOT / "ros2" / "Containerfile").read_text(encoding="utf-8")
    assert "pixi run -e ros2 compare-ros2 drive" in page
    assert "ros2 run hybridvo_ros compare /bag" in page
    assert "ros2 run hybridvo_ros compare /bag" in container


def test_the_page_says_first_which_ros_is_not_supported() -> None:
    page = (ROOT / "docs" / "ros.md").read_text(encoding="utf-8")
    first = page.partition("\n## ")[0]
    assert "Humble" in first and "Python 3.10" in first
    assert len(first.splitlines()) < 15
