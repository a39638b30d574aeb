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
    from hybridvo.core.errors import InputError as InputError
    from hybridvo.core.geometry import to_gtsam_covariance as to_gtsam_covariance
    from hybridvo.core.geometry import to_ros_covariance as to_ros_covariance
    from hybridvo.core.gravity import Gravity as Gravity
    from hybridvo.core.imu import ImuSamples as ImuSamples
    from hybridvo.core.laboratory import evaluate as evaluate
    from hybridvo.core.options import Options as Options
    from hybridvo.core.results import Edge as Edge
    from hybridvo.core.results import MotionPrior as MotionPrior
    from hybridvo.core.results import MovingObject as MovingObject
    from hybridvo.core.results import Reason as Reason
    from hybridvo.core.results import RelativePose as RelativePose
    from hybridvo.core.results import Rival as Rival
    from hybridvo.core.results import State as State
    from hybridvo.core.results import Status as Status
    from hybridvo.core.results import Step as Step
    from hybridvo.core.trajectory import Trajectory as Trajectory
    from hybridvo.core.types import Camera as Camera
    from hybridvo.core.types import Frame as Frame
    from hybridvo.core.types import FramePair as FramePair
    from hybridvo.core.types import PairBatch as PairBatch
    from hybridvo.flow.providers import FlowField as FlowField
    from hybridvo.flow.providers import dis_flow as dis_flow
    from hybridvo.io.data.open import iter_pairs as iter_pairs
    from hybridvo.io.data.open import open_sequence as open_sequence
    from hybridvo.io.data.resize import resize_frame as resize_frame
    from hybridvo.io.example import example_frames as example_frames
    from hybridvo.io.g2o import write_g2o as write_g2o
    from hybridvo.network.pwvo import PWVO as PWVO
    from hybridvo.network.selection import select as select
    from hybridvo.odometry import Odometry as Odometry
    from hybridvo.solver.torch.batched_pose import BatchedPose as BatchedPose
    from hybridvo.solver.torch.tools import PoseSeed as PoseSeed
    from hybridvo.tracking.chains import chain_covariance as chain_covariance
    from hybridvo.tracking.chains import to_g2o_information as to_g2o_information
    from hybridvo.tracking.inertial import gyro_prior as gyro_prior
    from hybridvo.tracking.passes import track_in_passes as track_in_passes

__version__ = "0.2.0"

_HOME = {
    name: module
    for module, names in {
        "core.types": "Camera Frame FramePair PairBatch",
        "core.results": (
            "Edge MotionPrior MovingObject Reason RelativePose Rival State Status Step"
        ),
        "core.imu": "ImuSamples",
        "core.laboratory": "evaluate",
        "core.gravity": "Gravity",
        "core.options": "Options",
        "core.errors": "InputError",
        "solver.torch.batched_pose": "BatchedPose",
        "solver.torch.tools": "PoseSeed",
        "network.pwvo": "PWVO",
        "network.selection": "select",
        "odometry": "Odometry",
        "core.trajectory": "Trajectory",
        "api": "estimate refine",
        "io.data.open": "open_sequence iter_pairs",
        "io.data.resize": "resize_frame",
        "io.example": "example_frames",
        "io.g2o": "write_g2o",
        "flow.providers": "FlowField dis_flow",
        "tracking.chains": "chain_covariance to_g2o_information",
        "tracking.inertial": "gyro_prior",
        "tracking.passes": "track_in_passes",
        "core.geometry": "to_gtsam_covariance to_ros_covariance",
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
