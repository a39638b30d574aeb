"""Sequences of RGB-D frames: what every reader offers, and how a folder finds its reader."""

from __future__ import annotations

import difflib
import inspect
import os
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, Protocol, runtime_checkable

import numpy as np

from hybridvo.data.folder import FolderSequence
from hybridvo.data.kitti import KittiSequence
from hybridvo.data.seven_scenes import SevenScenesSequence
from hybridvo.data.sintel import SintelSequence
from hybridvo.data.tartanair import TartanAirSequence
from hybridvo.data.tum_rgbd import TumSequence
from hybridvo.errors import InputError
from hybridvo.types import Camera, Frame, FramePair

__all__ = ["DATASETS", "Sequence", "iter_pairs", "open_sequence"]


@runtime_checkable
class Sequence(Protocol):
    """Frames in time order, read when asked for.

    Attributes:
        kind: sintel, tartanair, tum, 7scenes, kitti or folder.
        name: what reports call it. root: its folder.
        timestamps: (N,) float64 seconds, strictly increasing.
        depth_source: ``true`` (synthetic, an oracle), ``sensor``, ``stereo`` or ``file``.
        flow_is_true: whether its flow files are ground truth (an oracle).
        poses: (N, 4, 4) T_world_cam in camera axes, NaN rows where a frame has no truth, or None.
    """

    kind: str
    name: str
    root: Path
    timestamps: np.ndarray
    depth_source: str
    flow_is_true: bool
    poses: np.ndarray | None

    @property
    def has_flow(self) -> bool:
        """Whether there are flow files."""

    @property
    def notices(self) -> tuple[str, ...]:
        """Things the user should know."""

    def __len__(self) -> int: ...

    def camera(self, index: int) -> Camera:
        """Camera of frame ``index``."""

    def frame(self, index: int) -> Frame:
        """Frame ``index``; raises FormatError, InputError or FileNotFoundError if broken."""

    def flow(self, index: int) -> tuple[np.ndarray, np.ndarray | None]:
        """Flow (H, W, 2) px from ``index`` to ``index + 1``, and (H, W) bool valid or None."""

    def files(self) -> list[Path]:
        """Every file that it reads."""


READERS = (
    SintelSequence,
    TartanAirSequence,
    SevenScenesSequence,
    FolderSequence,
    KittiSequence,
    TumSequence,
)
"""In the order in which a folder is tried."""
DATASETS = tuple(reader.kind for reader in READERS)


def open_sequence(
    path: str | os.PathLike[str], dataset: str | None = None, **options: Any
) -> Sequence:
    """Open a sequence folder as its data set ships it.

    Args:
        path: the folder, or one of its image, depth or flow folders.
        dataset: one of ``DATASETS``; detected from the files by default.
        **options: keyword arguments of the reader, such as ``strict=True``.

    Raises:
        InputError: no such folder, one that cannot be read, an unknown data set or option, a layout
            that no reader knows (with what was looked for), or a sequence without frames.
        FormatError: a list or calibration file that is damaged.
    """
    if dataset is not None and dataset not in DATASETS:
        close = difflib.get_close_matches(dataset, DATASETS, n=1)
        hint = f" (did you mean '{close[0]}'?)" if close else ""
        raise InputError(f"dataset: '{dataset}' is unknown{hint}; known: {', '.join(DATASETS)}.")
    folder = Path(path)
    try:
        return _open(folder, dataset, options)
    except FileNotFoundError as error:
        raise InputError(f"{folder}: {error.filename or error} is missing.") from None
    except OSError as error:  # a name that is too long, a folder that may not be read
        reason = error.strerror or str(error)
        raise InputError(f"{str(folder)[:200]}: cannot be read: {reason}.") from None


def _open(folder: Path, dataset: str | None, options: dict[str, Any]) -> Sequence:
    """The sequence of a folder by the named reader, or by the first that knows it."""
    if dataset is not None:
        reader = next(r for r in READERS if r.kind == dataset)
    else:
        found = next((r for r in READERS if r.matches(folder)), None)
        if found is None:
            raise InputError(_nothing_found(folder))
        reader = found
    known = [name for name in inspect.signature(reader).parameters if name != "path"]
    for name in options:
        if name not in known:
            raise InputError(
                f"option '{name}' is unknown to the {reader.kind} reader; "
                f"known: {', '.join(known)}."
            )
    # Sintel may be opened through an image folder that was never downloaded.
    if not folder.is_dir() and reader is not SintelSequence:
        raise InputError(_nothing_found(folder))
    return reader(folder, **options)


def _nothing_found(folder: Path) -> str:
    looked = "".join(f"\n  {reader.looks_for}" for reader in READERS)
    if not folder.exists():
        return f"{folder}: no such folder."
    if not folder.is_dir():
        return f"{folder}: expected a sequence folder, got a file."
    inside = sorted(path.name for path in folder.iterdir())
    content = ", ".join(inside[:8]) + (", ..." if len(inside) > 8 else "")
    return (
        f"{folder}: no frames: no known data set. It holds: {content or 'nothing'}. "
        f"Looked for:{looked}\nSay which with dataset=... (--dataset) if the names differ."
    )


def iter_pairs(
    sequence: Sequence,
    flow: Callable[[Frame, Frame], Any] | None = None,
    *,
    start: int = 0,
    stop: int | None = None,
    stride: int = 1,
    on_error: Callable[[int, Exception], None] | None = None,
) -> Iterator[FramePair]:
    """Consecutive pairs of a sequence; each frame is read once, two are in memory.

    Args:
        sequence: where the frames come from.
        flow: None takes the flow files; a callable (prev, curr) gives an object with the attributes
            flow, variance, valid, source and is_true.
        start: first frame.
        stop: the one after the last frame.
        stride: step between frames.
        on_error: called with the index of a frame (or of a pair's previous frame) that cannot be
            read and with the exception; that pair is left out. By default the exception is raised.

    Returns:
        Iterator of pairs. Where one flow file of many is missing, the pair's flow is None.

    Raises:
        InputError: a range without a pair; flow files asked for where there are none, or with a
            stride above 1. The iterator raises what reading a frame raises.
    """
    stop = len(sequence) if stop is None else min(stop, len(sequence))
    if stride < 1 or start < 0:
        raise InputError(f"iter_pairs: expected start >= 0 and stride >= 1, got {start}, {stride}.")
    if flow is None and not sequence.has_flow:
        raise InputError(
            f"{sequence.name}: there are no flow files; pass a flow provider (--flow dis)."
        )
    if flow is None and stride > 1:
        raise InputError(
            f"{sequence.name}: flow files lead from one frame to the next, not over a stride of "
            f"{stride}; pass a flow provider (--flow dis)."
        )
    return _pairs(sequence, flow, range(start, stop, stride), on_error)


def _pairs(
    sequence: Sequence,
    flow: Callable[[Frame, Frame], Any] | None,
    indices: range,
    on_error: Callable[[int, Exception], None] | None,
) -> Iterator[FramePair]:
    prev: Frame | None = None
    for index in indices:
        try:
            curr: Frame | None = sequence.frame(index)
        except (InputError, OSError) as error:
            if on_error is None:
                raise
            on_error(index, error)
            curr = None
        if prev is not None and curr is not None:
            pair = _pair(sequence, flow, prev, curr, on_error)
            if pair is not None:
                yield pair
                del pair
        prev = curr


def _pair(
    sequence: Sequence,
    flow: Callable[[Frame, Frame], Any] | None,
    prev: Frame,
    curr: Frame,
    on_error: Callable[[int, Exception], None] | None,
) -> FramePair | None:
    try:
        if flow is not None:
            field = flow(prev, curr)
            return FramePair(
                prev,
                curr,
                field.flow,
                field.variance,
                field.valid,
                field.source,
                field.is_true,
                sequence.depth_source,
            )
        try:
            vectors, valid = sequence.flow(prev.index)
        except FileNotFoundError:
            return FramePair(prev, curr, None, depth_source=sequence.depth_source)
        return FramePair(
            prev,
            curr,
            vectors,
            flow_valid=valid,
            flow_source="file",
            flow_is_true=sequence.flow_is_true,
            depth_source=sequence.depth_source,
        )
    except (InputError, OSError) as error:
        if on_error is None:
            raise
        on_error(prev.index, error)
        return None
