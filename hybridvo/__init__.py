"""hybridvo: optical flow, depth and intrinsics in; metric camera motion with covariance out.

Importing does nothing but define names: each public name loads its module on first use, so that
``import hybridvo`` costs milliseconds and sets no thread count, no device and no handler.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:  # what type checkers and editors see of the names below
    from hybridvo.api import estimate as estimate
    from hybridvo.api import refine as refine
    from hybridvo.chains import chain_covariance as chain_covariance
    from hybridvo.chains import to_g2o_information as to_g2o_information
    from hybridvo.data.open import iter_pairs as iter_pairs
    from hybridvo.data.open import open_sequence as open_sequence
    from hybridvo.data.resize import resize_frame as resize_frame
    from hybridvo.errors import InputError as InputError
    from hybridvo.evaluation.metrics import evaluate as evaluate
    from hybridvo.flow import FlowField as FlowField
    from hybridvo.flow import dis_flow as dis_flow
    from hybridvo.geometry import to_gtsam_covariance as to_gtsam_covariance
    from hybridvo.geometry import to_ros_covariance as to_ros_covariance
    from hybridvo.inertial import gyro_prior as gyro_prior
    from hybridvo.network.pwvo import PWVO as PWVO
    from hybridvo.network.selection import select as select
    from hybridvo.odometry import Odometry as Odometry
    from hybridvo.options import Options as Options
    from hybridvo.refinement.batched_pose import BatchedPose as BatchedPose
    from hybridvo.results import MotionPrior as MotionPrior
    from hybridvo.results import Reason as Reason
    from hybridvo.results import RelativePose as RelativePose
    from hybridvo.results import State as State
    from hybridvo.results import Status as Status
    from hybridvo.results import Step as Step
    from hybridvo.trajectory import Trajectory as Trajectory
    from hybridvo.types import Camera as Camera
    from hybridvo.types import Frame as Frame
    from hybridvo.types import FramePair as FramePair
    from hybridvo.types import PairBatch as PairBatch

__version__ = "0.2.0.dev0"

_HOME = {
    name: module
    for module, names in {
        "types": "Camera Frame FramePair PairBatch",
        "results": "MotionPrior Reason RelativePose State Status Step",
        "options": "Options",
        "errors": "InputError",
        "refinement.batched_pose": "BatchedPose",
        "network.pwvo": "PWVO",
        "network.selection": "select",
        "odometry": "Odometry",
        "trajectory": "Trajectory",
        "api": "estimate refine",
        "data.open": "open_sequence iter_pairs",
        "data.resize": "resize_frame",
        "flow": "FlowField dis_flow",
        "evaluation.metrics": "evaluate",
        "chains": "chain_covariance to_g2o_information",
        "inertial": "gyro_prior",
        "geometry": "to_gtsam_covariance to_ros_covariance",
    }.items()
    for name in names.split()
}

__all__ = ["__version__", *_HOME]

if not TYPE_CHECKING:  # which would take any name for known

    def __getattr__(name: str) -> Any:
        if name not in _HOME:
            raise AttributeError(f"module 'hybridvo' has no attribute {name!r}")
        module = importlib.import_module(f"hybridvo.{_HOME[name]}")
        globals()[name] = value = getattr(module, name)
        return value


def __dir__() -> list[str]:
    return sorted(__all__)
