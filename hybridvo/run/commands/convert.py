"""``hybridvo convert``: any sequence written as a plain folder, in TUM's layout, or as a bag."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, Literal, NamedTuple

import cv2
import numpy as np
from rich.console import Console
from rich.progress import track
from scipy.spatial.transform import Rotation

from hybridvo.core.errors import InputError
from hybridvo.core.files import check_name, give_name, make_folder, write_lines
from hybridvo.core.types import Camera, Frame
from hybridvo.io.data.bags.writer import DEPTH_TOPIC, RGB_TOPIC, BagWriter, Ros
from hybridvo.io.data.camera_file import CALIBRATION_FILE, CAMERA_FILE
from hybridvo.io.data.image_io import write_png
from hybridvo.io.data.sequence import SATURATED, Sequence, undistort
from hybridvo.io.data.streams import Lens

UNITS = {"folder": 1000.0, "tum": 5000.0, "ros1": 1000.0, "ros2": 1000.0}
"""Stored units of depth in one metre, by layout."""
Layout = Literal["folder", "tum", "ros1", "ros2"]
PART_ENDING = ".part-"
"""What follows the name of the output in that of the folder where it is written."""
BAG_ENDING = ".bag"
"""How the file of a bag of ROS 1 ends."""
BAG_ENCODINGS = {1000.0: "16UC1", 1.0: "32FC1"}
"""How ROS calls depth of whole millimetres, and of metres, by units in a metre."""


class Names(NamedTuple):
    """The files of one frame, below the folder."""

    stamp: float  # s
    rgb: str
    depth: str  # empty where the frame has none


def convert(
    sequence: Sequence,
    out: str | Path,
    to: Layout | None = None,
    units: float | None = None,
    start: int = 0,
    stop: int | None = None,
    stride: int = 1,
    quiet: bool = True,
) -> dict[str, Any]:
    """Write a sequence as images, depth, camera, stamps and true poses.

    Distortion is out of the images, and depth that a mask takes away is 0.

    All is written into a folder beside, and gets its name when it is whole. Nothing is left of what
    fails.

    Args:
        sequence: What ``open_sequence`` returns.
        out: A new folder, or an empty one; for ``ros1`` a new file that ends in ``.bag``.
        to: ``folder`` for the layout of docs/own-data.md, ``tum`` for TUM's, ``ros1`` or ``ros2``
            for a bag; by default ``ros1`` where ``out`` ends in ``.bag``, else ``folder``.
        units: Stored units of depth in one metre; by default 1000, and 5000 for TUM. A bag holds
            1000 (16UC1), or 1: metres in floating point (32FC1).
        start: The first frame.
        stop: The frame after the last one; by default all.
        stride: Frames from one that is written to the next.
        quiet: Whether no bar shows how far it is.

    Returns:
        A summary, JSON-ready: the files, the number of frames, and warnings.

    Raises:
        InputError: The folder is not empty, a number is of no use, or there is nothing to write.
        OutputError: A file cannot be written.
    """
    path = Path(out)
    check_name(path)
    if to is None:
        to = "ros1" if path.suffix == BAG_ENDING else "folder"
    if to not in UNITS:
        raise InputError(f"--to {to}: expected {', '.join(UNITS)}.")
    _check_new(path, to)
    if stride < 1 or start < 0:
        raise InputError(
            f"convert: expected --start >= 0 and --stride >= 1, got {start}, {stride}."
        )
    scale = UNITS[to] if units is None else float(units)
    if not scale > 0:
        raise InputError(f"--units {units}: expected units per metre, 1000 for mm.")
    frames = range(len(sequence))[start:stop:stride]
    with _written_beside(path, to) as part:
        writer = _written(sequence, frames, part, to, scale, quiet)
    return {
        "files": [str(path)],
        "frames": writer.count,
        "warnings": [*sequence.warnings, *writer.warnings],
    }


@contextlib.contextmanager
def _written_beside(path: Path, to: Layout) -> Iterator[Path]:
    """Give a name for what is being written, and the right one to what is whole."""
    path = path.resolve()
    make_folder(path.parent)
    prefix = f"{path.name[:100]}{PART_ENDING}"
    with TemporaryDirectory(prefix=prefix, dir=path.parent) as folder:
        part = Path(folder) / path.name
        yield part
        # another process may have written it meanwhile
        _check_new(path, to)
        give_name(part, path)


def _written(
    sequence: Sequence,
    frames: range,
    part: Path,
    to: Layout,
    scale: float,
    quiet: bool,
) -> _Writer:
    """Write frames; returns the writer, which has counted them."""
    camera = sequence.camera(0)
    writer: _Writer
    if to == "folder" or to == "tum":
        writer = _FolderWriter(part, to, scale, camera)
    else:
        writer = _BagWriter(part, to, scale, camera)
    console = Console(stderr=True, quiet=quiet)
    try:
        for index in track(frames, sequence.name, console=console, transient=True):
            try:
                frame = sequence.frame(index)
            except (InputError, OSError) as error:
                writer.warnings.append(f"frame {index} is left out: {error}")
                continue
            pose = None if sequence.poses is None else sequence.poses[index]
            writer.add(frame, pose)
        writer.finish()
    except BaseException:
        writer.discard()
        raise
    return writer


def _check_new(path: Path, to: Layout) -> None:
    """Raise an InputError where what is written would be mixed with something else."""
    if to == "ros1":
        if path.suffix != BAG_ENDING or path.exists():
            got = "one that exists" if path.exists() else f"'{path.name}'"
            raise InputError(
                f"{path}: expected a new file that ends in {BAG_ENDING}, got {got}."
            )
    elif path.exists() and (not path.is_dir() or any(path.iterdir())):
        raise InputError(f"{path}: expected a new or an empty folder.")


class _Writer:
    """Writes frames, and at the end what belongs to all of them."""

    def __init__(self, path: Path, units: float, camera: Camera) -> None:
        self.path = path
        self.units = units
        self.camera = camera
        self.count = 0
        self.warnings: list[str] = []
        self._too_far = 0
        self._resampled = 0

    def add(self, frame: Frame, pose: np.ndarray | None) -> None:
        """Write a frame with an image, and its true pose (4, 4) where it is known."""
        if frame.rgb is None:
            self.warnings.append(
                f"frame {frame.index} is left out: it has no image"
            )
            return
        rgb = frame.rgb
        if frame.camera != self.camera:
            frame, rgb = self._resampled_frame(frame, rgb)
        is_known = pose is not None and np.isfinite(pose).all()
        self._put(frame, rgb, pose if is_known else None)
        self.count += 1

    def finish(self) -> None:
        """Complete what is written."""
        if not self.count:
            reasons = " ".join(self.warnings[:1])
            raise InputError(f"{self.path}: there is no frame to write. {reasons}")
        if self._too_far:
            limit = (SATURATED - 1) / self.units
            self.warnings.append(
                f"{self._too_far} pixels are farther than {limit:.4g} m, which 16 bits hold, and "
                "are written without depth: fewer --units"
            )
        if self._resampled:
            self.warnings.append(
                f"{self._resampled} frames of another camera are resampled to that of the first, "
                "because the layout holds one"
            )
        self._close()

    def _resampled_frame(
        self, frame: Frame, rgb: np.ndarray
    ) -> tuple[Frame, np.ndarray]:
        """A frame as the first camera would have taken it from the same place."""
        if frame.camera.shape != self.camera.shape:
            raise InputError(
                f"frame {frame.index}: its camera is not that of the first, and of another size: "
                "one file of a camera cannot hold both."
            )
        self._resampled += 1
        maps = Lens(frame.camera).maps(K=self.camera.K)
        straight, depth, mask = undistort(maps, rgb, frame.depth, frame.mask)
        taken = rgb if straight is None else straight
        new = replace(
            frame,
            rgb=taken,
            depth=depth,
            camera=self.camera,
            depth_variance=None,
            mask=mask,
        )
        return new, taken

    def discard(self) -> None:
        """Close what will not be whole."""

    def _put(self, frame: Frame, rgb: np.ndarray, pose: np.ndarray | None) -> None:
        raise NotImplementedError

    def _close(self) -> None:
        raise NotImplementedError

    def _stored(self, depth: np.ndarray) -> np.ndarray:
        """Depth in whole units, 0 where unknown or farther than they reach."""
        with np.errstate(invalid="ignore", over="ignore"):
            values = np.rint(depth.astype(np.float64) * self.units)
            is_known = np.isfinite(values) & (values > 0)
            is_near = is_known & (values < SATURATED)
        self._too_far += int(np.count_nonzero(is_known & ~is_near))
        return np.where(is_near, values, 0).astype(np.uint16)


class _BagWriter(_Writer):
    """Writes messages into a bag."""

    def __init__(self, path: Path, ros: Ros, units: float, camera: Camera) -> None:
        super().__init__(path, units, camera)
        if units not in BAG_ENCODINGS:
            raise InputError(
                f"--units {units:g}: a bag holds depth in millimetres or in metres: expected "
                "1000 or 1."
            )
        self._bag = BagWriter(path, ros)
        if camera.readout_ms:
            self.warnings.append(
                "a bag does not hold the time of a rolling shutter: read it with --readout-ms "
                f"{camera.readout_ms:g}"
            )
        if camera.depth_lag_ms:
            self.warnings.append(
                "a bag does not hold how late depth is: read it with --depth-lag-ms "
                f"{camera.depth_lag_ms:g}"
            )

    def discard(self) -> None:
        """Close the bag, which has no index."""
        self._bag.discard()

    def _put(self, frame: Frame, rgb: np.ndarray, pose: np.ndarray | None) -> None:
        stamp = frame.timestamp
        self._bag.camera(frame.camera, stamp)
        self._bag.image(RGB_TOPIC, rgb, "rgb8", stamp)
        if frame.depth is not None:
            depth = frame.depth.astype(np.float32)
            if self.units != 1:
                depth = self._stored(frame.depth)
            encoding = BAG_ENCODINGS[self.units]
            self._bag.image(DEPTH_TOPIC, depth, encoding, stamp)
        if pose is not None:
            self._bag.pose(pose, stamp)

    def _close(self) -> None:
        self._bag.close()


class _FolderWriter(_Writer):
    """Writes images into a folder, and at the end the lists of them."""

    def __init__(
        self,
        path: Path,
        layout: Literal["folder", "tum"],
        units: float,
        camera: Camera,
    ) -> None:
        super().__init__(path, units, camera)
        self.is_tum = layout == "tum"
        self.names: list[Names] = []
        self.poses: list[tuple[float, np.ndarray]] = []

    def _put(self, frame: Frame, rgb: np.ndarray, pose: np.ndarray | None) -> None:
        stem = f"{frame.timestamp:.6f}" if self.is_tum else f"{len(self.names):06d}"
        image = f"rgb/{stem}.png"
        depth = "" if frame.depth is None else f"depth/{stem}.png"
        self._write_png(image, cv2.cvtColor(rgb, cv2.COLOR_RGB2BGR))
        if frame.depth is not None:
            self._write_png(depth, self._stored(frame.depth))
        self.names.append(Names(frame.timestamp, image, depth))
        if pose is not None:
            self.poses.append((frame.timestamp, pose))

    def _close(self) -> None:
        camera_file = CALIBRATION_FILE if self.is_tum else CAMERA_FILE
        self._write_text(camera_file, self._camera_lines())
        if self.is_tum:
            self._write_list("rgb.txt", [(n.stamp, n.rgb) for n in self.names])
            depths = [(n.stamp, n.depth) for n in self.names if n.depth]
            self._write_list("depth.txt", depths)
            self._write_poses("groundtruth.txt")
            return
        stamps = [f"{name.stamp:.9f}" for name in self.names]
        self._write_text("timestamps.txt", stamps)
        self._write_poses("poses.txt")

    def _camera_lines(self) -> list[str]:
        camera = self.camera
        numbers = {
            "fx": camera.fx,
            "fy": camera.fy,
            "cx": camera.cx,
            "cy": camera.cy,
            "width": camera.width,
            "height": camera.height,
            "depth_scale": self.units,
        }
        if camera.readout_ms:
            numbers["readout_ms"] = camera.readout_ms
        if camera.depth_lag_ms:
            numbers["depth_lag_ms"] = camera.depth_lag_ms
        return [f"{name}: {value!r}" for name, value in numbers.items()]

    def _write_list(self, name: str, rows: list[tuple[float, str]]) -> None:
        lines = ["# timestamp filename"]
        lines += [f"{stamp:.6f} {path}" for stamp, path in rows]
        self._write_text(name, lines)

    def _write_poses(self, name: str) -> None:
        if not self.poses:
            return
        lines = ["# timestamp tx ty tz qx qy qz qw: camera to world"]
        for stamp, T in self.poses:
            xyzw = Rotation.from_matrix(T[:3, :3]).as_quat(canonical=True)
            values = " ".join(repr(float(value)) for value in (*T[:3, 3], *xyzw))
            lines.append(f"{stamp:.9f} {values}")
        self._write_text(name, lines)

    def _write_text(self, name: str, lines: list[str]) -> None:
        write_lines(self.path / name, lines)

    def _write_png(self, name: str, image: np.ndarray) -> None:
        path = self.path / name
        write_png(path, image)
