"""What a tracker needs to go on where another one stopped, in memory and as text."""

from __future__ import annotations

import base64
import json
import zlib
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from hybridvo.tracking.key_frame import KeyFrame
from hybridvo.tracking.motion_history import MotionHistory
from hybridvo.tracking.pose_graph import Edge
from hybridvo.tracking.window import Window
from hybridvo.types import Frame, Reason, State, Status

__all__ = ["Anchor", "dump_anchor", "load_anchor"]


@dataclass(frozen=True, eq=False)
class Anchor:
    """State of a tracker after a frame.

    Args:
        frame: the last frame that could be read; None before the first one.
        T_world_cam: (4, 4) its pose; read-only.
        T_world_last: (4, 4) pose last handed out: another one than ``T_world_cam`` after frames
            that could not be read.
        history: the motions found so far.
        gap: frames that could not be read since ``frame``.
        lost: motions that failed since the last one found.
        images: state of the tracker's :class:`PhotometricMonitor`, or None.
        window: key frames and their graph; None where the tracker keeps none.
    """

    frame: Frame | None
    T_world_cam: np.ndarray
    T_world_last: np.ndarray
    history: MotionHistory = field(default_factory=MotionHistory)
    gap: int = 0
    lost: int = 0
    images: dict[str, Any] | None = None
    window: Window | None = None

    def __post_init__(self) -> None:
        for name in ("T_world_cam", "T_world_last"):
            own = np.array(getattr(self, name))
            own.flags.writeable = False
            object.__setattr__(self, name, own)


def dump_anchor(anchor: Anchor, before: Anchor | None = None) -> dict[str, Any]:
    """JSON-ready content of an anchor; of its frames the indices alone.

    Args:
        anchor: what to write.
        before: the anchor written last: key frames that are still the same are not written again.
    """
    history, window = anchor.history, anchor.window
    out: dict[str, Any] = {
        "index": None if anchor.frame is None else anchor.frame.index,
        "T_world_cam": anchor.T_world_cam.ravel(),
        "T_world_last": anchor.T_world_last.ravel(),
        "T_last": None if history.T_last is None else history.T_last.ravel(),
        "spread": None if history.spread is None else history.spread.ravel(),
        "changes": [history.weight, history.changes],
        "gap": anchor.gap,
        "lost": anchor.lost,
        "images": anchor.images,
        "place": None,
        "keys": None,
    }
    if window is None:
        return out
    out["place"] = [window.T_last_key.ravel(), window.covariance.ravel()]
    known = None if before is None else before.window
    if known is None or known.keys is not window.keys or known.edges is not window.edges:
        out["keys"] = _pack(window)
    return out


def load_anchor(
    stored: Mapping[str, Any], keys: str | None, frame_of: Callable[[int], Frame]
) -> Anchor:
    """The anchor that :func:`dump_anchor` wrote, to the last bit.

    Args:
        stored: what it wrote.
        keys: its entry ``keys``, or the latest one before that is not None.
        frame_of: frame of an index.
    """

    def matrix(value: Any, n: int = 4) -> np.ndarray:
        return np.array(value, dtype=np.float64).reshape(n, n)

    history = MotionHistory(
        None if stored["T_last"] is None else matrix(stored["T_last"]),
        None if stored["spread"] is None else matrix(stored["spread"], 6),
        *stored["changes"],
    )
    window = None
    if stored["place"] is not None and keys is not None:
        T, covariance = stored["place"]
        window = _unpack(keys, frame_of, matrix(T), matrix(covariance, 6))
    return Anchor(
        None if stored["index"] is None else frame_of(stored["index"]),
        matrix(stored["T_world_cam"]),
        matrix(stored["T_world_last"]),
        history,
        int(stored["gap"]),
        int(stored["lost"]),
        stored["images"],
        window,
    )


def _bits(array: np.ndarray) -> str:
    return base64.b64encode(np.ascontiguousarray(array).tobytes()).decode()


def _floats(text: str, n: int) -> np.ndarray:
    return np.frombuffer(base64.b64decode(text), np.float64).reshape(n, n).copy()


def _pack(window: Window) -> str:
    """Key frames and edges as one compressed text."""
    keys = [
        {
            "index": key.frame.index,
            "T": _bits(key.T_world_cam),
            "depth_noise": key.depth_noise,
            "shape": None if key.static is None else key.static.shape,
            "static": None if key.static is None else _bits(np.packbits(key.static)),
        }
        for key in window.keys
    ]
    edges = [_pack_edge(edge) for edge in window.edges]
    text = json.dumps({"keys": keys, "edges": edges}, separators=(",", ":"))
    return base64.b64encode(zlib.compress(text.encode())).decode()


def _unpack(
    text: str,
    frame_of: Callable[[int], Frame],
    T: np.ndarray,
    covariance: np.ndarray,
) -> Window:
    content = json.loads(zlib.decompress(base64.b64decode(text)))
    keys = []
    for key in content["keys"]:
        static: np.ndarray | None = None
        if key["static"] is not None:
            rows, columns = key["shape"]
            packed = np.frombuffer(base64.b64decode(key["static"]), np.uint8)
            static = np.unpackbits(packed, count=rows * columns).astype(np.bool_)
            static = static.reshape(rows, columns)
        keys.append(
            KeyFrame(frame_of(key["index"]), _floats(key["T"], 4), static, key["depth_noise"])
        )
    edges = tuple(_unpack_edge(edge) for edge in content["edges"])
    return Window(tuple(keys), edges, T, covariance)


def _pack_edge(edge: Edge) -> dict[str, Any]:
    return {
        "frames": [edge.prev, edge.curr],
        "T": _bits(edge.T),
        "covariance": _bits(edge.covariance),
        "status": [edge.status.state.value, edge.status.reason.value, edge.status.message],
        "kind": edge.kind,
        "weight": edge.weight,
    }


def _unpack_edge(stored: Mapping[str, Any]) -> Edge:
    state, reason, message = stored["status"]
    prev, curr = stored["frames"]
    return Edge(
        prev,
        curr,
        _floats(stored["T"], 4),
        _floats(stored["covariance"], 6),
        Status(State(state), Reason(reason), message),
        stored["kind"],
        stored["weight"],
    )
