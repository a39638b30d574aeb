"""Opening a sequence with the reader of its data set, and making pairs of its frames."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from hybridvo.data import datasets
from hybridvo.data.base import Sequence, looks_for
from hybridvo.data.folder import FolderSequence
from hybridvo.data.lists import shown
from hybridvo.errors import InputError
from hybridvo.flow import file_flow, with_flow
from hybridvo.types import Camera, Frame, FramePair

READERS: dict[str, type[Sequence]] = {
    "sintel": datasets.SintelSequence,
    "tartanair": datasets.TartanAirSequence,
    "7scenes": datasets.SevenScenesSequence,
    "folder": FolderSequence,
    "kitti": datasets.KittiSequence,
    "tum": datasets.TumSequence,
}
"""The readers by kind, in the order in which a folder is tried."""
OWN_DATA = (
    "Own data: hybridvo needs metric depth for each image. Put images into rgb/, depth registered "
    "to them into depth/, and describe the camera with 'hybridvo init DIR' (kind 'folder')."
)


def open_sequence(
    path: str | Path,
    dataset: str | None = None,
    camera: str | Path | Camera | None = None,
    depth_scale: float | None = None,
    mask: str | Path | None = None,
) -> Sequence:
    """Open a sequence folder as its data set ships it.

    ``dataset`` is one of ``READERS``, by default detected. ``camera`` replaces the data set's own:
    ``fx,fy,cx,cy`` in pixels, a file (``camera.yaml``, ROS ``camera_info``, RealSense intrinsics)
    or a Camera; so does ``depth_scale``, in stored units per metre. ``mask`` is a folder of images
    that are 0 where pixels must not be used.
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
    """The reader that is asked for, else the first one that knows the folder."""
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
    """Yield the consecutive pairs of a sequence; each frame is read once, two are in memory.

    Flow comes from the files, or from ``flow``, a callable (prev, curr) such as
    ``hybridvo.dis_flow()`` that returns a FlowField or (H, W, 2) px. A pair's flow is None where
    there is none.
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
    """Return the camera of the same view with another image size in pixels."""
    # pixel (0, 0) is a centre: u' = s (u + 0.5) - 0.5, for the principal point too
    sx, sy = width / camera.width, height / camera.height
    cx, cy = sx * (camera.cx + 0.5) - 0.5, sy * (camera.cy + 0.5) - 0.5
    return Camera(camera.fx * sx, camera.fy * sy, cx, cy, height, width)


def resize_frame(frame: Frame, height: int, width: int) -> Frame:
    """Resize a frame: the image by area, or bilinearly when it grows, the rest by nearest pixel."""
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
