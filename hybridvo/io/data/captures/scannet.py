"""The readers of ScanNet: its ``.sens`` files, and the folders that its SensReader exports."""

from __future__ import annotations

import contextlib
import struct
import zlib
from pathlib import Path
from typing import IO, NamedTuple

import cv2
import numpy as np

from hybridvo.core.errors import FormatError, InputError, format_errors
from hybridvo.core.files import file_size
from hybridvo.core.geometry import invert
from hybridvo.core.types import Camera
from hybridvo.io.data import lists
from hybridvo.io.data.camera_file import parse_camera
from hybridvo.io.data.image_io import (
    as_pose,
    decode_bytes,
    image_size,
    numbers_of_matrix,
    read_depth,
    read_matrix,
    read_rgb,
)
from hybridvo.io.data.sequence import in_metres
from hybridvo.io.data.streams import (
    FrameImages,
    Lens,
    StreamSequence,
    units_per_metre,
)
from hybridvo.io.data.two_cameras import TwoCameras

MILLIMETRES = 1000.0
"""Units per metre of ScanNet's depth maps."""
COLOUR_CAMERAS = ("intrinsic/intrinsic_color.txt", "intrinsic_color.txt")
"""Where an export may have the camera of colour."""
DEPTH_CAMERAS = ("intrinsic/intrinsic_depth.txt", "intrinsic_depth.txt")
"""Where it may have that of depth."""


class ScanNetSequence(StreamSequence):
    """A folder that ScanNet's SensReader exports: ``color depth pose intrinsic``.

    Images have about twice the pixels of depth, and are made smaller to them. The poses
    (BundleFusion's) are the ground truth.
    """

    kind = "scannet"
    depth_scale = MILLIMETRES
    markers = tuple(("color", "depth", name) for name in COLOUR_CAMERAS)

    def files(self) -> list[Path]:
        """Return images, maps, poses and the cameras."""
        listed = [*self.rgb_files, *self.depth_files, *self._pose_files]
        cameras = [self.root / name for name in (*COLOUR_CAMERAS, *DEPTH_CAMERAS)]
        return sorted(
            {path for path in (*listed, *cameras) if path and path.is_file()}
        )

    def _open(self) -> None:
        root = self.root
        rgb = lists.numbered_files(root / "color", r"(\d+)\.(?:jpg|jpeg|png)")
        depth = lists.numbered_files(root / "depth", r"(\d+)\.png")
        poses = lists.numbered_files(root / "pose", r"(\d+)\.txt")
        if not rgb or not depth:
            lacking = "color/0.jpg" if not rgb else "depth/0.png"
            raise InputError(
                f"{root}: no frames: expected {lacking} and so on, as SensReader writes them."
            )
        numbers = self._list_numbered(rgb, depth)
        self._pose_files = [poses.get(number) for number in numbers]
        if poses:
            self._read_poses(self._pose_files, read_matrix)
        self._units = units_per_metre(self._given_scale, MILLIMETRES, self.warnings)
        first = numbers[0]
        colour_size = image_size(rgb.get(first) or min(rgb.values()))
        depth_size = image_size(depth.get(first) or min(depth.values()))
        self._sizes = colour_size, depth_size
        self._cameras = TwoCameras(*self._lenses(), np.eye(4))
        self._camera = self._cameras.camera

    def _lenses(self) -> tuple[Lens, Lens]:
        """The cameras of colour and of depth, which see the same view."""
        colour_size, depth_size = self._sizes
        depth_camera = self._stated(DEPTH_CAMERAS, depth_size)
        if self._given_camera is not None:
            found = parse_camera(self._given_camera, colour_size, self.warnings)
            colour = Lens(found.camera, tuple(found.distortion))
        elif colour_size == depth_size and depth_camera is not None:
            # images that were made smaller after the export
            colour = Lens(depth_camera)
        else:
            stated = self._stated(COLOUR_CAMERAS, colour_size)
            if stated is None:
                expected = " or ".join(COLOUR_CAMERAS)
                raise InputError(f"{self.root}: expected {expected}.")
            colour = Lens(stated)
        if depth_camera is not None:
            return colour, Lens(depth_camera)
        if colour_size != depth_size:
            raise InputError(
                f"{self.root}: depth is {depth_size[1]}x{depth_size[0]}, colour "
                f"{colour_size[1]}x{colour_size[0]} pixels: expected {DEPTH_CAMERAS[0]}, the "
                "camera of depth."
            )
        return colour, colour

    def _stated(
        self, names: tuple[str, ...], size: tuple[int, int]
    ) -> Camera | None:
        """The camera in one of some files of 4x4 numbers; None where there is none."""
        for name in names:
            path = self.root / name
            if path.is_file():
                with format_errors(path):
                    K = numbers_of_matrix(path)[:3, :3]
                    return Camera.from_matrix(K, *size)
        return None

    def _images(self, index: int) -> FrameImages:
        colour_size, depth_size = self._sizes
        rgb_file = self.rgb_files[index]
        depth_file = self.depth_files[index]
        rgb = None if rgb_file is None else read_rgb(rgb_file, colour_size)
        depth = None
        if depth_file is not None and self._needs_depth:
            depth = in_metres(read_depth(depth_file, depth_size), self._units)
        return self._cameras.images(rgb, depth)


# -- .sens -------------------------------------------------------------------------------

VERSION = 4
"""The version of the format that ScanNet uses."""
MAX_NAME_BYTES = 4096
"""Bytes of the name of the sensor."""
MATRICES = struct.Struct("<64f")
"""Intrinsics and extrinsics of colour, and of depth, 4x4 each."""
SIZES = struct.Struct("<2i4IfQ")
"""Compressions of colour and depth, four lengths, units per metre, and the count of frames."""
FRAME = struct.Struct("<16f4Q")
"""Of a frame: its pose, two stamps in microseconds, and the bytes of colour and of depth."""
MAX_FRAMES = 2**20
"""Frames of a file: nine hours at 30 a second."""
MICROSECONDS = 1e6
"""Units per second of stamps."""
COLOUR_RAW = 0
DEPTH_RAW = 0
DEPTH_ZLIB = 1


class SensHead(NamedTuple):
    """What a ``.sens`` file states before its frames."""

    colour: Camera
    depth: Camera
    T_colour_depth: np.ndarray
    colour_packing: int
    depth_packing: int
    units: float  # of depth, per metre
    frame_count: int


class SensFrame(NamedTuple):
    """Where a frame of a ``.sens`` file is."""

    T_world_cam: np.ndarray  # (4, 4), not finite where tracking was lost
    stamp: int  # microseconds
    colour_at: int  # bytes from the start of the file
    colour_bytes: int
    depth_at: int
    depth_bytes: int


class SensSequence(StreamSequence):
    """A ``.sens`` file of ScanNet: frames of JPEG and of packed depth, with poses."""

    kind = "sens"
    markers = (("*.sens",),)

    @classmethod
    def knows(cls, folder: Path) -> bool:
        """Return whether a path is a ``.sens`` file, or a folder with one."""
        return sens_file(folder) is not None

    def files(self) -> list[Path]:
        """Return the file."""
        return [self._path]

    def _open(self) -> None:
        path = sens_file(self.root)
        if path is None:
            raise InputError(f"{self.root}: expected one .sens file.")
        self._path = path
        with path.open("rb") as file:
            self._head = read_sens_head(path, file)
            self._frames = read_sens_frames(path, file, self._head.frame_count)
        if len(self._frames) < self._head.frame_count:
            self._warn(
                f"the file is cut off: {len(self._frames)} of {self._head.frame_count} frames "
                "are there"
            )
        head = self._head
        self._units = units_per_metre(self._given_scale, head.units, self.warnings)
        colour = Lens(head.colour)
        if self._given_camera is not None:
            shape = head.colour.shape
            found = parse_camera(self._given_camera, shape, self.warnings)
            colour = Lens(found.camera, tuple(found.distortion))
        self._cameras = TwoCameras(colour, Lens(head.depth), head.T_colour_depth)
        self._camera = self._cameras.camera
        self.timestamps = self._stamps()
        poses = [_pose_or_unknown(frame.T_world_cam) for frame in self._frames]
        self.poses = np.array(poses).reshape(-1, 4, 4)

    def _stamps(self) -> np.ndarray:
        """The stamps of colour, s, or the count of frames where they do not increase."""
        stamps = np.array([float(frame.stamp) for frame in self._frames])
        if (np.diff(stamps) > 0).all() and len(stamps) > 1:
            return (stamps - stamps[0]) / MICROSECONDS
        rate = self.frames_per_second
        self._warn(f"no time stamps; {lists.assumed_rate(rate)}")
        return np.arange(len(self._frames)) / rate

    def _images(self, index: int) -> FrameImages:
        frame = self._frames[index]
        where = f"{self._path}: frame {index}"
        with self._path.open("rb") as file:
            colour = _piece(file, frame.colour_at, frame.colour_bytes, where)
            depth = _piece(file, frame.depth_at, frame.depth_bytes, where)
        rgb = self._colour(colour, where)
        metres = None
        if self._needs_depth:
            metres = in_metres(self._depth(depth, where), self._units)
        return self._cameras.images(rgb, metres)

    def _colour(self, data: bytes, where: str) -> np.ndarray:
        height, width = self._head.colour.shape
        if self._head.colour_packing != COLOUR_RAW:
            bgr = decode_bytes(data, cv2.IMREAD_COLOR, where, (height, width))
            return cv2.cvtColor(bgr, cv2.COLOR_BGR2RGB)
        if len(data) != 3 * height * width:
            raise FormatError(f"{where}: colour has {len(data)} bytes.")
        return np.frombuffer(data, np.uint8).reshape(height, width, 3)

    def _depth(self, data: bytes, where: str) -> np.ndarray:
        height, width = self._head.depth.shape
        count = 2 * height * width
        if self._head.depth_packing == DEPTH_ZLIB:
            try:
                # one byte more than there may be shows a map that is too large
                data = zlib.decompressobj().decompress(data, count + 1)
            except zlib.error as error:
                raise FormatError(
                    f"{where}: damaged: depth cannot be unpacked ({error})."
                ) from None
        if len(data) != count:
            raise FormatError(
                f"{where}: depth: expected {count} bytes, {width}x{height} of 16 bits, got "
                f"{len(data)}."
            )
        return np.frombuffer(data, "<u2").reshape(height, width)


def sens_file(path: Path) -> Path | None:
    """Return the ``.sens`` file that a path is, or that alone is in a folder."""
    if path.is_file():
        return path if path.suffix.lower() == ".sens" else None
    inside = sorted(path.glob("*.sens")) if path.is_dir() else []
    return inside[0] if len(inside) == 1 else None


def read_sens_head(path: Path, file: IO[bytes]) -> SensHead:
    """Read what stands before the frames.

    Args:
        path: The file, for messages.
        file: The same, open at its begin; it is left at the first frame.

    Raises:
        FormatError: It is no such file, or of a form that is not read.
    """
    version, name_bytes = struct.unpack("<IQ", _exactly(file, 12, path))
    if version != VERSION or name_bytes > MAX_NAME_BYTES:
        raise FormatError(
            f"{path}: expected a .sens file of version {VERSION}, got {version}."
        )
    _exactly(file, name_bytes, path)
    numbers = np.array(MATRICES.unpack(_exactly(file, MATRICES.size, path)))
    K_colour, T_colour, K_depth, T_depth = numbers.reshape(4, 4, 4)
    colour_packing, depth_packing, *lengths, units, count = SIZES.unpack(
        _exactly(file, SIZES.size, path)
    )
    colour_width, colour_height, depth_width, depth_height = lengths
    if depth_packing not in (DEPTH_RAW, DEPTH_ZLIB):
        raise FormatError(
            f"{path}: depth is packed by method {depth_packing}: expected {DEPTH_RAW} (not "
            f"packed) or {DEPTH_ZLIB} (zlib)."
        )
    if count > MAX_FRAMES or not 0 < units < np.inf:
        raise FormatError(
            f"{path}: {count} frames of {units} units per metre cannot be."
        )
    with format_errors(path):
        colour = Camera.from_matrix(K_colour[:3, :3], colour_height, colour_width)
        depth = Camera.from_matrix(K_depth[:3, :3], depth_height, depth_width)
    # each maps points of its camera into the frame that poses are of
    T_body_colour = as_pose(T_colour[:3], f"{path}: extrinsics of colour")
    T_body_depth = as_pose(T_depth[:3], f"{path}: extrinsics of depth")
    return SensHead(
        colour,
        depth,
        invert(T_body_colour) @ T_body_depth,
        colour_packing,
        depth_packing,
        float(units),
        count,
    )


def read_sens_frames(path: Path, file: IO[bytes], count: int) -> list[SensFrame]:
    """Go over the frames of a file, without reading their images.

    Args:
        path: The file, for messages.
        file: The same, open at the first frame.
        count: Of frames that it states.

    Returns:
        Where they are; fewer than stated where the file is cut off.
    """
    size = file_size(path)
    at = file.tell()
    frames = []
    for _ in range(count):
        if at + FRAME.size > size:
            break
        file.seek(at)
        *pose, stamp, _, colour_bytes, depth_bytes = FRAME.unpack(
            file.read(FRAME.size)
        )
        colour_at = at + FRAME.size
        depth_at = colour_at + colour_bytes
        at = depth_at + depth_bytes
        if at > size:
            break
        T = np.array(pose).reshape(4, 4)
        frames.append(
            SensFrame(T, stamp, colour_at, colour_bytes, depth_at, depth_bytes)
        )
    return frames


def _pose_or_unknown(T: np.ndarray) -> np.ndarray:
    """Return a pose (4, 4) with an exact rotation; NaN where tracking was lost."""
    with contextlib.suppress(FormatError):
        return as_pose(T[:3], "")
    return np.full((4, 4), np.nan)


def _exactly(file: IO[bytes], count: int, path: Path) -> bytes:
    """Read some bytes; a FormatError where the file ends before."""
    data = file.read(count)
    if len(data) < count:
        raise FormatError(
            f"{path}: truncated: it ends in what it states of itself."
        )
    return data


def _piece(file: IO[bytes], at: int, count: int, where: str) -> bytes:
    """Read the bytes of an image."""
    file.seek(at)
    data = file.read(count)
    if len(data) < count:
        raise FormatError(f"{where}: truncated.")
    return data
