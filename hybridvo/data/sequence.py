"""Opening a sequence: a folder finds its reader; frames become pairs, or another size."""

from __future__ import annotations

import itertools
import os
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from hybridvo.data.base import Sequence, looks_for
from hybridvo.data.folder import FolderSequence
from hybridvo.data.kinect import SevenScenesSequence, TumSequence
from hybridvo.data.kitti import KittiSequence
from hybridvo.data.lists import shown
from hybridvo.data.rendered import SintelSequence, TartanAirSequence
from hybridvo.errors import InputError
from hybridvo.flow import file_flow, with_flow
from hybridvo.types import Camera, Frame, FramePair

READERS: dict[str, type[Sequence]] = {
    "sintel": SintelSequence,
    "tartanair": TartanAirSequence,
    "7scenes": SevenScenesSequence,
    "folder": FolderSequence,
    "kitti": KittiSequence,
    "tum": TumSequence,
}
"""Kind -> reader, in the order in which a folder is tried."""
OWN_DATA = (
    "Own data: hybridvo needs metric depth for each image. Put images into rgb/, depth registered "
    "to them into depth/, and describe the camera with 'hybridvo init DIR' (kind 'folder')."
)


def open_sequence(
    path: str | os.PathLike[str],
    dataset: str | None = None,
    camera: str | os.PathLike[str] | Camera | None = None,
    depth_scale: float | None = None,
    mask: str | os.PathLike[str] | None = None,
) -> Sequence:
    """Open a sequence folder as its data set ships it.

    ``dataset``, one of ``READERS``, is detected by default. Instead of the data set's own:
    ``camera`` is ``fx,fy,cx,cy`` in pixels, a file (``camera.yaml``, ROS ``camera_info``, RealSense
    intrinsics) or a camera, ``depth_scale`` the stored units per metre. ``mask``: folder of images.
    """
    if dataset is not None and dataset not in READERS:
        names = ", ".join(READERS)
        raise InputError(f"dataset: '{dataset}' is unknown; known: {names}. {OWN_DATA}")
    folder = Path(path)
    try:
        return _reader(folder, dataset)(folder.absolute(), camera, depth_scale, mask)
    except OSError as error:  # a file that is missing, a folder that may not be read
        raise InputError(f"{str(folder)[:200]}: cannot be read: {str(error)[:200]}.") from None


def _reader(folder: Path, dataset: str | None) -> type[Sequence]:
    """The reader that is asked for, else the first that knows a folder."""
    known = (reader for reader in READERS.values() if reader.knows(folder))
    if reader := next(known, None) if dataset is None else READERS[dataset]:
        return reader
    if not folder.is_dir():
        got = "a file" if folder.exists() else "no such folder"
        raise InputError(f"{folder}: expected a sequence folder, got {got}.")
    if (folder / "rgb").is_dir() and (folder / "depth").is_dir():
        return FolderSequence
    inside = shown(sorted(path.name for path in folder.iterdir()))
    raise InputError(
        f"{folder}: no frames: no known data set. It holds: {inside or 'nothing'}. Looked for:"
        + "".join(f"\n  {looks_for(reader)}" for reader in READERS.values())
        + f"\nSay which with dataset=... (--dataset) if the names differ. {OWN_DATA}"
    )


def iter_pairs(
    sequence: Sequence,
    flow: Callable[[Frame, Frame], Any] | None = None,
    *,
    start: int = 0,
    stop: int | None = None,
    stride: int = 1,
) -> Iterator[FramePair]:
    """Consecutive pairs of a sequence; each frame is read once, two are in memory.

    ``flow`` None takes the flow files (None where one is missing); a callable (prev, curr), such as
    ``hybridvo.dis_flow()``, gives a FlowField or (H, W, 2) px.
    """
    if stride < 1 or start < 0:
        raise InputError(f"iter_pairs: expected start >= 0 and stride >= 1, got {start}, {stride}.")
    if flow is None:
        sequence.check_flow(stride)
        flow = file_flow(sequence)
    frames = map(sequence.frame, range(len(sequence))[start:stop:stride])
    source = sequence.depth_source
    pairs = (FramePair(*two, None, depth_source=source) for two in itertools.pairwise(frames))
    return (with_flow(pair, flow) for pair in pairs)


def resize_camera(camera: Camera, height: int, width: int) -> Camera:
    """Camera of the same view with another image size in pixels."""
    # pixel (0, 0) is a centre: u' = s (u + 0.5) - 0.5, for the principal point too
    sx, sy = width / camera.width, height / camera.height
    cx, cy = sx * (camera.cx + 0.5) - 0.5, sy * (camera.cy + 0.5) - 0.5
    return Camera(camera.fx * sx, camera.fy * sy, cx, cy, height, width)


def resize_frame(frame: Frame, height: int, width: int) -> Frame:
    """Frame of another size: image by area (or bilinear when it grows), the rest by nearest."""
    shrinks = height <= frame.camera.height and width <= frame.camera.width

    def resized(image: np.ndarray | None, mode: int = cv2.INTER_NEAREST_EXACT) -> np.ndarray | None:
        if image is None:
            return None
        plain = image.view(np.uint8) if image.dtype == bool else image
        return cv2.resize(plain, (width, height), interpolation=mode).astype(image.dtype)

    return replace(
        frame,
        rgb=resized(frame.rgb, cv2.INTER_AREA if shrinks else cv2.INTER_LINEAR),
        depth=resized(frame.depth),
        camera=resize_camera(frame.camera, height, width),
        depth_variance=resized(frame.depth_variance),
        mask=resized(frame.mask),
    )
