"""The state of a tracker: everything that another one needs to go on, as flat arrays."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from hybridvo.errors import InputError
from hybridvo.results import Reason, State, Status
from hybridvo.tracking.keyframes import KeyFrame
from hybridvo.tracking.motion_model import MotionModel
from hybridvo.tracking.pose_graph import Edge
from hybridvo.tracking.window import Window
from hybridvo.types import Camera, Frame

CAMERA = ("fx", "fy", "cx", "cy", "height", "width")
IMAGES = ("rgb", "depth", "depth_variance", "mask")


@dataclass(frozen=True, eq=False)
class TrackerState:
    """State of a tracker after a frame.

    Args:
        frame: the last frame that could be read; None before the first one.
        T_world_cam: (4, 4) its pose; read-only.
        T_world_last: (4, 4) pose last handed out: another one than ``T_world_cam`` after frames
            that could not be read.
        motion_model: of the motions found so far.
        gap: frames that could not be read since ``frame``.
        failed: motions that failed since the last one found.
        count: frames seen.
        window: key frames and their graph; None where the tracker keeps none.
    """

    frame: Frame | None = None
    T_world_cam: np.ndarray = field(default_factory=lambda: np.eye(4))
    T_world_last: np.ndarray = field(default_factory=lambda: np.eye(4))
    motion_model: MotionModel = field(default_factory=MotionModel)
    gap: int = 0
    failed: int = 0
    count: int = 0
    window: Window | None = None

    def __post_init__(self) -> None:
        for name in ("T_world_cam", "T_world_last"):
            own = np.array(getattr(self, name))
            own.flags.writeable = False
            object.__setattr__(self, name, own)

    def to_arrays(self) -> dict[str, np.ndarray]:
        """The state as named arrays, for ``numpy.savez`` (no pickles)."""
        model = self.motion_model
        out: dict[str, Any] = {
            "T_world_cam": self.T_world_cam,
            "T_world_last": self.T_world_last,
            "counts": [self.gap, self.failed, self.count, model.changes],
            "model_weight": model.weight,
            "model_T_last": model.T_last,
            "model_spread": model.spread,
        }
        out |= _frame_arrays("frame", self.frame)
        if self.window is not None:
            window = self.window
            out |= {"window_T": window.T_last_key, "window_covariance": window.covariance}
            for k, key in enumerate(window.keys):
                out |= _frame_arrays(f"key{k}", key.frame)
                out |= {
                    f"key{k}_T": key.T_world_cam,
                    f"key{k}_static": key.static,
                    f"key{k}_noise": key.depth_noise,
                }
            edges = window.edges
            out |= {
                "edge_frames": np.array([(e.prev, e.curr) for e in edges]).reshape(-1, 2),
                "edge_T": np.array([e.T for e in edges]).reshape(-1, 4, 4),
                "edge_covariance": np.array([e.covariance for e in edges]).reshape(-1, 6, 6),
                "edge_weight": [e.weight for e in edges],
                "edge_text": np.array(
                    [
                        (e.kind, e.status.state.value, e.status.reason.value, e.status.message)
                        for e in edges
                    ],
                    dtype=np.str_,
                ).reshape(-1, 4),
            }
        return {name: np.asarray(value) for name, value in out.items() if value is not None}

    @classmethod
    def from_arrays(cls, arrays: Mapping[str, np.ndarray]) -> TrackerState:
        """The state that :meth:`to_arrays` wrote.

        Raises:
            InputError: an array is missing or has another shape.
        """
        try:
            return cls._read(dict(arrays))
        except (KeyError, ValueError, IndexError, TypeError) as error:
            raise InputError(
                f"TrackerState.from_arrays: expected the arrays of to_arrays(), got {error!r}. "
                f"Start the run anew."
            ) from None

    @classmethod
    def _read(cls, arrays: dict[str, np.ndarray]) -> TrackerState:
        gap, failed, count, changes = (int(x) for x in arrays["counts"])
        model = MotionModel(
            arrays.get("model_T_last"),
            arrays.get("model_spread"),
            float(arrays["model_weight"]),
            changes,
        )
        window = None
        if "window_T" in arrays:
            keys: list[KeyFrame] = []
            while f"key{len(keys)}_T" in arrays:
                name = f"key{len(keys)}"
                frame = _read_frame(name, arrays)
                if frame is None:
                    raise ValueError(f"{name}: no frame")
                static, noise = arrays.get(f"{name}_static"), float(arrays[f"{name}_noise"])
                keys.append(KeyFrame(frame, arrays[f"{name}_T"], static, noise))
            names = ("edge_frames", "edge_T", "edge_covariance", "edge_weight", "edge_text")
            edges = tuple(
                Edge(
                    int(frames[0]), int(frames[1]), T, covariance,
                    Status(State(str(text[1])), Reason(str(text[2])), str(text[3])),
                    str(text[0]), float(weight),
                )
                for frames, T, covariance, weight, text in zip(
                    *(arrays[name] for name in names), strict=True
                )
            )  # fmt: skip
            window = Window(tuple(keys), edges, arrays["window_T"], arrays["window_covariance"])
        return cls(
            _read_frame("frame", arrays),
            arrays["T_world_cam"],
            arrays["T_world_last"],
            model,
            gap,
            failed,
            count,
            window,
        )


def _frame_arrays(name: str, frame: Frame | None) -> dict[str, Any]:
    if frame is None:
        return {}
    images = {f"{name}_{part}": getattr(frame, part) for part in IMAGES}
    camera = [getattr(frame.camera, part) for part in CAMERA]
    return images | {f"{name}_camera": camera, f"{name}_at": [frame.timestamp, frame.index]}


def _read_frame(name: str, arrays: Mapping[str, np.ndarray]) -> Frame | None:
    if f"{name}_camera" not in arrays:
        return None
    fx, fy, cx, cy, height, width = arrays[f"{name}_camera"].tolist()
    camera = Camera(fx, fy, cx, cy, int(height), int(width))
    images = {part: arrays.get(f"{name}_{part}") for part in IMAGES}
    timestamp, index = arrays[f"{name}_at"]
    return Frame(camera=camera, timestamp=float(timestamp), index=int(index), **images)
