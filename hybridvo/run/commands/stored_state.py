"""The state of a tracker in the journal of a run, from which ``--resume`` goes on.

A journal may come from a stranger. Only the classes that are listed here are made from it, and what
is packed unpacks to the size that it states, within a limit on all of it.
"""

from __future__ import annotations

import base64
import math
import zlib
from typing import Any

import numpy as np

from hybridvo.core.belief import Belief
from hybridvo.core.imu import ImuSamples
from hybridvo.core.types import Frame
from hybridvo.io.data.sequence import Sequence
from hybridvo.objects.followed import Thing, Things
from hybridvo.tracking.accelerometer import Accelerometer
from hybridvo.tracking.depth_scale import ScaleFilter, divided
from hybridvo.tracking.gyroscope import Gyroscope
from hybridvo.tracking.keyframes import Keyframe
from hybridvo.tracking.memory import Memory
from hybridvo.tracking.motion_model import MotionModel
from hybridvo.tracking.stamps import Clock
from hybridvo.tracking.tracker_state import Sensors, TrackerState

STATE_CLASSES = {
    kind.__name__: kind
    for kind in (
        TrackerState,
        Sensors,
        MotionModel,
        Keyframe,
        ScaleFilter,
        Clock,
        Memory,
        Belief,
        Gyroscope,
        Accelerometer,
        ImuSamples,
        Things,
        Thing,
    )
}
"""The classes that make up a tracker's state, beside frames and arrays."""
LONG_ARRAY = 64
"""Numbers from which an array is packed: the state is written after every frame."""
MOST_BYTES = 2**29
"""To which a state unpacks: of sixteen objects in images of two megapixels."""
MOST_FRAMES = 250
"""Frames that a state holds; a tracker keeps some ten beside its places, which are 200 at most."""
NUMBERS = "fiub"
"""Kinds of numpy's types that are read."""


def saved(value: Any) -> Any:
    """Return a tracker's state, or a part of it, for JSON.

    A frame becomes its index, because its files are on disk. Classes, arrays and frames become
    dictionaries, tuples become lists.
    """
    if isinstance(value, Frame):
        return {"frame": value.index, "depth_scale": value.depth_scale}
    if isinstance(value, np.ndarray) and value.size > LONG_ARRAY:
        packed = zlib.compress(np.ascontiguousarray(value).tobytes(), level=1)
        return {
            "packed": base64.b64encode(packed).decode(),
            "shape": list(value.shape),
            "dtype": str(value.dtype),
        }
    if isinstance(value, np.ndarray):
        return {"array": value.tolist(), "dtype": str(value.dtype)}
    if isinstance(value, list | tuple):
        return [saved(part) for part in value]
    name = type(value).__name__
    if name in STATE_CLASSES:
        fields = {key: saved(part) for key, part in vars(value).items()}
        return {"state": name, **fields}
    return value


def restored(value: Any, sequence: Sequence) -> Any:
    """Return what :func:`saved` was given; lists become tuples, frames are read again.

    Args:
        value: From JSON.
        sequence: The frames.

    Raises:
        Exception: Of any kind, where it is no state. A ValueError: it unpacks to more than a state
            holds, or to another size than it states.
    """
    return _Restorer(sequence).value(value)


class _Restorer:
    """Makes a state anew, and counts what it takes."""

    def __init__(self, sequence: Sequence) -> None:
        self._sequence = sequence
        self._room = MOST_BYTES
        self._frames = 0

    def value(self, value: Any) -> Any:
        """Return a value, or a part of one."""
        if isinstance(value, list):
            return tuple(self.value(part) for part in value)
        if not isinstance(value, dict):
            return value
        if "state" in value:
            fields = {
                name: self.value(part)
                for name, part in value.items()
                if name != "state"
            }
            return STATE_CLASSES[value["state"]](**fields)
        if "frame" in value:
            return self._frame(value)
        if "packed" in value:
            return self._unpacked(value)
        return np.array(value["array"], dtype=_dtype(value["dtype"]))

    def _frame(self, value: dict[str, Any]) -> Frame:
        self._frames += 1
        if self._frames > MOST_FRAMES:
            raise ValueError(f"a state of more than {MOST_FRAMES} frames.")
        return divided(self._sequence.frame(value["frame"]), value["depth_scale"])

    def _unpacked(self, value: dict[str, Any]) -> np.ndarray:
        dtype = _dtype(value["dtype"])
        shape = [int(length) for length in value["shape"]]
        size = math.prod(shape) * dtype.itemsize
        self._room -= size
        if min(shape, default=0) < 0 or self._room < 0:
            raise ValueError(f"an array of shape {shape}: more than a state holds.")
        unpacker = zlib.decompressobj()
        # one byte more shows that it would go on; none stands for no limit
        data = unpacker.decompress(base64.b64decode(value["packed"]), size + 1)
        if len(data) != size:
            raise ValueError(f"an array of shape {shape} that unpacks to another.")
        return np.frombuffer(data, dtype).reshape(shape).copy()


def _dtype(name: Any) -> np.dtype:
    """A type of numbers by its name."""
    dtype = np.dtype(str(name))
    if dtype.kind not in NUMBERS:
        raise ValueError(f"an array of {str(name)[:40]!r}: expected numbers.")
    return dtype
