"""hybridvo: optical flow, depth and intrinsics in; metric camera motion with covariance out.

Importing does nothing but define names: each public name loads its module on first use, so that
``import hybridvo`` costs milliseconds and sets no thread count, no device and no handler.
"""

from __future__ import annotations

import importlib
from typing import Any

__version__ = "0.1.0"

_HOME = {
    name: module
    for module, names in {
        "types": "Camera Frame FramePair PairBatch",
        "results": "MotionPrior Reason RelativePose State Status Step",
        "options": "Options",
        "errors": "InputError",
        "refinement.torch_backend": "BatchedPose",
        "network.pwvo": "PWVO",
        "network.selection": "select",
        "odometry": "Odometry",
        "trajectory": "Trajectory",
        "api": "estimate refine",
        "data.sequence": "open_sequence iter_pairs resize_frame",
        "flow": "FlowField dis_flow",
        "evaluation.metrics": "evaluate",
        "geometry": "to_gtsam_covariance to_ros_covariance",
    }.items()
    for name in names.split()
}

__all__ = ["__version__", *_HOME]


def __getattr__(name: str) -> Any:
    if name not in _HOME:
        raise AttributeError(f"module 'hybridvo' has no attribute {name!r}")
    globals()[name] = value = getattr(importlib.import_module(f"hybridvo.{_HOME[name]}"), name)
    return value


def __dir__() -> list[str]:
    return sorted(__all__)
