"""The state of a tracker: everything that another one needs to go on, as flat arrays."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass, field, fields, is_dataclass
from enum import Enum
from typing import Any, cast, get_args, get_type_hints

import numpy as np

from hybridvo.errors import InputError
from hybridvo.results import Reason, State
from hybridvo.tracking.motion_model import MotionModel
from hybridvo.tracking.window import Window
from hybridvo.types import Frame


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
        """The state that :meth:`to_arrays` wrote.

        Raises:
            InputError: an array is missing or has another shape.
        """

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
