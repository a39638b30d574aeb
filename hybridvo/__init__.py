"""hybridvo: optical flow, depth and intrinsics in; metric camera motion with covariance out.

Importing does nothing but define names: each public name loads its module on first use, so that
``import hybridvo`` costs milliseconds and sets no thread count, no device and no handler.
"""

from __future__ import annotations

import importlib
from typing import Any

__version__ = "0.1.0"

_HOME = {
    "Camera": "hybridvo.types",
    "Frame": "hybridvo.types",
    "FramePair": "hybridvo.types",
    "MotionPrior": "hybridvo.results",
    "Options": "hybridvo.options",
    "PWVO": "hybridvo.network.pwvo",
    "PairBatch": "hybridvo.types",
    "RelativePose": "hybridvo.results",
    "Status": "hybridvo.results",
    "Step": "hybridvo.results",
    "Odometry": "hybridvo.odometry",
    "Trajectory": "hybridvo.trajectory",
    "estimate": "hybridvo.estimation",
    "open_sequence": "hybridvo.data.sequence",
    "iter_pairs": "hybridvo.data.sequence",
    "refine": "hybridvo.estimation",
    "select": "hybridvo.network.selection",
    "dis_flow": "hybridvo.flow",
    "evaluate": "hybridvo.evaluation.metrics",
    "to_gtsam_covariance": "hybridvo.geometry",
    "to_ros_covariance": "hybridvo.geometry",
}

__all__ = ["__version__", *_HOME]


def __getattr__(name: str) -> Any:
    if name in _HOME:
        value = getattr(importlib.import_module(_HOME[name]), name)
        globals()[name] = value
        return value
    raise AttributeError(f"module 'hybridvo' has no attribute {name!r}")


def __dir__() -> list[str]:
    return sorted(__all__)
