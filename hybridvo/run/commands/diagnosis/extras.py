"""The extras of the package: what each is for, and whether it is installed."""

from __future__ import annotations

from importlib.util import find_spec
from typing import NamedTuple


class Extra(NamedTuple):
    """Packages that only some users need."""

    about: str  # for what they are
    modules: tuple[str, ...]  # by which they are imported


EXTRAS = {
    "bags": Extra("ROS 1, ROS 2 and RealSense recordings", ("rosbags",)),
    "record3d": Extra("recordings of Record3D", ("liblzfse",)),
    "kinect": Extra("recordings of an Azure Kinect", ("av",)),
    "realsense": Extra("live RealSense cameras", ("pyrealsense2",)),
    "oak": Extra("live OAK cameras", ("depthai",)),
    "orbbec": Extra("live Orbbec cameras", ("pyorbbecsdk",)),
    "onnx": Extra("depth, flow and masks by networks", ("onnxruntime",)),
    "lab": Extra("compare, demo, show, train, errors of a run", ("hybridvo_lab",)),
    "report": Extra("report.html of compare", ("plotly", "jinja2")),
    "viz": Extra("--view and --rrd: a run in the Rerun viewer", ("rerun",)),
    "evo": Extra("its plots of the paths of runs", ("evo",)),
    "train": Extra("training, and refine on batches", ("kornia", "pypose")),
    "cluster": Extra("--cluster", ("distributed",)),
    "graph": Extra("the example of a pose graph", ("gtsam",)),
    "baselines": Extra("the method poselib", ("poselib",)),
    "peers": Extra(
        "odometry of others to compare with", ("small_gicp", "kiss_icp", "open3d")
    ),
}
"""Those of ``pyproject.toml`` that are no matter of hybridvo's own development."""


def missing_extras() -> dict[str, str]:
    """Return, for each extra, what is missing with the remedy; empty where it is installed."""
    found = {}
    for name, extra in EXTRAS.items():
        absent = [each for each in extra.modules if find_spec(each) is None]
        found[name] = ""
        if absent:
            remedy = f"pip install 'hybridvo[{name}]'"
            found[name] = f"{extra.about}: no {', '.join(absent)}; {remedy}"
    return found
