"""The state of a tracker: all that another one needs to go on, and the motion it expects."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass, field, fields, is_dataclass, replace
from enum import Enum
from typing import Any, cast, get_args, get_type_hints

import numpy as np

from hybridvo.errors import InputError
from hybridvo.geometry import invert, pose_matrix, se3_log
from hybridvo.results import MotionPrior, Reason, State
from hybridvo.tracking.window import Window
from hybridvo.types import Frame

MEMORY = 10  # motions after which a change counts 1 / e of a new one
MIN_CHANGES = 3  # changes between motions to be seen before their spread means anything
INFLATION = 2.0
"""Factor on the mean square of the last changes, which tell little of the next, larger one."""
FLOOR_M, FLOOR_RAD = 1e-3, 1e-3
"""Smallest standard deviations of a prediction: no camera repeats its motion exactly."""
UNKNOWN_M, UNKNOWN_RAD = 1.0, 0.3  # standard deviations where too little is known


@dataclass(frozen=True, eq=False)
class MotionModel:
    """Constant velocity: the last motion between neighbours, and how motions change.

    ``spread`` (6, 6) is a decaying sum of squared changes, ``weight`` their decaying number.
    """

    T_last: np.ndarray | None = None
    spread: np.ndarray = field(default_factory=lambda: np.zeros((6, 6)))
    weight: float = 0.0
    changes: int = 0

    def observed(self, T_curr_prev: np.ndarray, neighbours: bool = True) -> MotionModel:
        """The model after one more motion, which follows the last one directly (``neighbours``)."""
        # a step hands its motion out as well: its array may change
        T_curr_prev = np.array(T_curr_prev)
        if self.T_last is None or not neighbours:
            return replace(self, T_last=T_curr_prev)
        change = se3_log(T_curr_prev @ invert(self.T_last))
        keep = 1.0 - 1.0 / MEMORY
        spread = keep * self.spread + np.outer(change, change)
        return MotionModel(T_curr_prev, spread, keep * self.weight + 1.0, self.changes + 1)

    def predict(self, frames: int = 1) -> MotionPrior | None:
        """The motion to the frame ``frames`` ahead; None before the first motion.

        The velocity is taken to wander by as much as it did: over n frames the variance is that of
        one change times n (n + 1) (2 n + 1) / 6.
        """
        if self.T_last is None:
            return None
        n = int(frames)
        grown = n * (n + 1) * (2 * n + 1) / 6
        T = pose_matrix(np.linalg.matrix_power(self.T_last, n)[:3])
        if self.changes < MIN_CHANGES:
            return MotionPrior(T, grown * np.diag([UNKNOWN_M**2] * 3 + [UNKNOWN_RAD**2] * 3))
        # ten changes are few for 21 numbers: half of it is even in all directions
        mean = self.spread / self.weight
        even = np.repeat([np.trace(mean[:3, :3]) / 3, np.trace(mean[3:, 3:]) / 3], 3)
        one = INFLATION * 0.5 * (mean + np.diag(even))
        return MotionPrior(T, grown * (one + np.diag([FLOOR_M**2] * 3 + [FLOOR_RAD**2] * 3)))


@dataclass(frozen=True, eq=False)
class TrackerState:
    """State of a tracker after a frame.

    Args:
        frame: the last frame that could be read; None before the first one.
        T_world_cam: (4, 4) its pose.
        T_world_last: (4, 4) pose last handed out: another one after frames that could not be read.
        gap: frames that could not be read since ``frame``. failed: motions since the last found.
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

    def to_arrays(self) -> dict[str, np.ndarray]:
        """The state as named arrays, for ``numpy.savez`` (no pickles): images, one JSON text."""
        arrays: dict[str, np.ndarray] = {}

        def plain(value: Any) -> Any:
            if isinstance(value, np.ndarray):
                arrays[name := f"array{len(arrays)}"] = value
                return {"array": name}
            if isinstance(value, tuple):
                return [plain(x) for x in value]
            if is_dataclass(value):
                return {f.name: plain(getattr(value, f.name)) for f in fields(value)}
            return value.value if isinstance(value, Enum) else value

        return {"state": np.array(json.dumps(plain(self))), **arrays}

    @classmethod
    def from_arrays(cls, arrays: Mapping[str, np.ndarray]) -> TrackerState:
        """The state that :meth:`to_arrays` wrote; InputError where an array is missing."""

        def build(kind: Any, value: Any) -> Any:
            if isinstance(value, dict) and "array" in value:
                return arrays[value["array"]]
            kind = next((k for k in get_args(kind) if k is not type(None)), kind)
            if isinstance(value, list):
                return tuple(build(kind, x) for x in value)
            if is_dataclass(kind) and value is not None:
                made, hints = cast(Any, kind), get_type_hints(kind)
                return made(**{name: build(hints[name], x) for name, x in value.items()})
            return kind(value) if kind in (State, Reason) else value

        try:
            return build(cls, json.loads(str(arrays["state"])))
        except (KeyError, ValueError, IndexError, TypeError) as error:
            raise InputError(
                f"TrackerState.from_arrays: expected the arrays of to_arrays(), got {error!r}. "
                f"Start the run anew."
            ) from None
