"""The state of a tracker: everything that another one needs to go on, as flat arrays."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from typing import Any

import numpy as np

from hybridvo.errors import InputError
from hybridvo.results import Reason, State, Status
from hybridvo.tracking.keyframes import KeyFrame
from hybridvo.tracking.motion_model import MotionModel
from hybridvo.tracking.pose_graph import Edge
from hybridvo.tracking.window import Window
from hybridvo.types import Camera, Frame

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
        """The state as named arrays, for ``numpy.savez`` (no pickles): images, one JSON text."""
        arrays: dict[str, np.ndarray] = {}

        def frame(name: str, value: Frame | None) -> dict[str, Any] | None:
            if value is None:
                return None
            for part in IMAGES:
                if (image := getattr(value, part)) is not None:
                    arrays[f"{name}_{part}"] = image
            camera = asdict(value.camera)
            return {"camera": camera, "timestamp": value.timestamp, "index": value.index}

        def key(name: str, value: KeyFrame) -> dict[str, Any]:
            if value.static is not None:
                arrays[f"{name}_static"] = value.static
            return {"frame": frame(name, value.frame)} | _plain(value, "T_world_cam", "depth_noise")

        names = ("T_world_cam", "T_world_last", "gap", "failed", "count")
        state = _plain(self, *names) | {
            "frame": frame("frame", self.frame),
            "motion_model": _plain(self.motion_model, "T_last", "spread", "weight", "changes"),
        }
        if self.window is not None:
            state["window"] = _plain(self.window, "T_last_key", "covariance") | {
                "keys": [key(f"key{k}", value) for k, value in enumerate(self.window.keys)],
                "edges": [
                    _plain(edge, "prev", "curr", "T", "covariance", "kind", "weight")
                    | {"status": [edge.status.state.value, edge.status.reason.value]}
                    | {"message": edge.status.message}
                    for edge in self.window.edges
                ],
            }
        return arrays | {"state": np.array(json.dumps(state))}

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
        state = json.loads(str(arrays["state"]))

        def frame(name: str, value: dict[str, Any] | None) -> Frame | None:
            if value is None:
                return None
            images = {part: arrays.get(f"{name}_{part}") for part in IMAGES}
            camera = Camera(**value["camera"])
            return Frame(
                camera=camera, timestamp=value["timestamp"], index=value["index"], **images
            )

        def key(name: str, value: dict[str, Any]) -> KeyFrame:
            own = frame(name, value["frame"])
            if own is None:
                raise ValueError(f"{name}: no frame")
            T, static = np.array(value["T_world_cam"]), arrays.get(f"{name}_static")
            return KeyFrame(own, T, static, value["depth_noise"])

        window = state.pop("window", None)
        if window is not None:
            keys = tuple(key(f"key{k}", value) for k, value in enumerate(window.pop("keys")))
            edges = []
            for value in window.pop("edges"):
                kind, reason = value.pop("status")
                status = Status(State(kind), Reason(reason), value.pop("message"))
                edges.append(Edge(status=status, **_arrays(value)))
            window = Window(keys, tuple(edges), **_arrays(window))
        model = MotionModel(**_arrays(state.pop("motion_model")))
        last = frame("frame", state.pop("frame"))
        return cls(frame=last, motion_model=model, window=window, **_arrays(state))


def _plain(value: Any, *names: str) -> dict[str, Any]:
    """Attributes for JSON, arrays as lists: numbers come back as they were."""
    found = {name: getattr(value, name) for name in names}
    return {n: v.tolist() if isinstance(v, np.ndarray) else v for n, v in found.items()}


def _arrays(values: dict[str, Any]) -> dict[str, Any]:
    """The other way: lists as arrays."""
    return {n: np.array(v) if isinstance(v, list) else v for n, v in values.items()}
