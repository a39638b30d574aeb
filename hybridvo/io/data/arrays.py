"""The reader of stacks of arrays: an ``.npz`` file, or a folder of ``.npy`` files."""

from __future__ import annotations

import contextlib
import io
import math
import struct
import zipfile
from pathlib import Path
from typing import IO, Any, NamedTuple

import numpy as np

from hybridvo.core.checks import as_rigid
from hybridvo.core.depth_units import scale_is_unknown
from hybridvo.core.errors import FormatError, InputError, format_errors
from hybridvo.core.files import unpacked_limit
from hybridvo.core.pages import page
from hybridvo.core.trajectory import FILE_TOLERANCE, to_seconds
from hybridvo.core.types import Camera
from hybridvo.io.data.camera_file import parse_camera
from hybridvo.io.data.lists import abbreviated, assumed_rate
from hybridvo.io.data.streams import (
    FrameImages,
    Lens,
    StreamSequence,
    straightened,
    units_per_metre,
)

LARGEST_UNPACKED = 2**33
"""Bytes of an array that is unpacked into memory; others stay on the disk."""
LONGEST_HEADER = 10_000
"""Bytes of the text that states shape and type of an array."""
COMPLEX_BYTES = 16
"""Bytes of the largest number."""
LOCAL_HEADER = struct.Struct("<4s5H3I2H")
"""Before the data of a file in a zip archive; the last two are lengths of what follows it."""


class ArraySequence(StreamSequence):
    """Stacks ``rgb`` (N, H, W, 3) and ``depth`` (N, H, W), ``K`` (3, 3) and ``timestamps`` (N,).

    ``poses`` (N, 4, 4) camera to world and ``depth_scale`` may be there as well. What is not packed
    stays on the disk.
    """

    kind = "arrays"
    depth_source = "file"
    markers = (("rgb.npy", "depth.npy"),)

    @classmethod
    def knows(cls, folder: Path) -> bool:
        """Return whether a path is an ``.npz`` file, or a folder of the arrays."""
        return (
            folder.suffix.lower() == ".npz"
            if folder.is_file()
            else super().knows(folder)
        )

    def _open(self) -> None:
        rgb = self._frames("rgb", "(N, H, W, 3) or (N, H, W) of uint8")
        self._rgb = rgb
        expected = "(N, H, W) of metres or integers"
        depth = self._frames("depth", expected, rgb.shape[:3])
        self._depth = depth
        if rgb.shape[:3] != depth.shape:
            raise FormatError(
                f"{self.root}: expected depth of shape {rgb.shape[:3]}, as rgb has, got "
                f"{depth.shape}."
            )
        self._take_stamps(len(rgb))
        self._take_camera_of(rgb.shape[1:3])
        self._take_poses(len(rgb))

    def _take_stamps(self, count: int) -> None:
        stamps = self._array("timestamps", (count,))
        if stamps is None:
            rate = self.frames_per_second
            self._warn(f"no array 'timestamps'; {assumed_rate(rate)}")
            self.timestamps = np.arange(count) / rate
            return
        if stamps.shape != (count,) or stamps.dtype.kind not in "fiu":
            expected = f"timestamps: expected {count} numbers, got {stamps.dtype}"
            raise FormatError(f"{self.root}: {expected} {stamps.shape}.")
        values = np.array(stamps, np.float64)
        self.timestamps = to_seconds(values, "timestamps", self.warnings)

    def _take_camera_of(self, size: tuple[int, int]) -> None:
        scale = self._array("depth_scale", (1,))
        if self._given_scale is None and scale is not None:
            self._given_scale = self._number("depth_scale", scale)
        if self._given_camera is not None:
            found = parse_camera(self._given_camera, size, self.warnings)
            self._camera = found.camera
            self._take_distortion(found.distortion)
            self._given_scale = self._given_scale or found.depth_scale
        else:
            K = self._array("K", (3, 3))
            if K is None:
                raise InputError(
                    f"{self.root}: there is no array 'K' (3, 3): give --camera fx,fy,cx,cy."
                )
            with format_errors(f"{self.root}: K"):
                self._camera = Camera.from_matrix(np.array(K), *size)
        if self._camera.shape != size:
            raise InputError(
                f"{self.root}: images are {size[1]}x{size[0]}, the camera is for "
                f"{self._camera.width}x{self._camera.height} pixels."
            )
        self._units = 1.0
        if self._depth.dtype.kind == "u" or self._given_scale is not None:
            if self._given_scale is None:
                text = scale_is_unknown(self._depth[0], "an array 'depth_scale'")
                raise InputError(f"{self.root}: {text}")
            self._units = units_per_metre(self._given_scale, 1.0, self.warnings)

    def _take_distortion(self, distortion: tuple[float, ...]) -> None:
        if any(distortion) and self._camera is not None:
            self._lens = Lens(self._camera, tuple(distortion)).maps()

    def _take_poses(self, count: int) -> None:
        poses = self._array("poses", (count, 4, 4))
        if poses is None:
            return
        if poses.shape != (count, 4, 4):
            raise FormatError(
                f"{self.root}: poses: expected shape ({count}, 4, 4), got {poses.shape}."
            )
        if poses.dtype.kind not in "fiu":
            raise FormatError(
                f"{self.root}: poses: expected numbers, got type {poses.dtype}."
            )
        known = np.isfinite(poses).all(axis=(1, 2))
        checked = np.full((count, 4, 4), np.nan)
        where = f"{self.root}: poses"
        checked[known] = as_rigid(poses[known], where, FILE_TOLERANCE, many=True)
        self.poses = checked

    def _images(self, index: int) -> FrameImages:
        rgb = np.array(self._rgb[index])
        stored = self._depth[index]
        depth = stored.astype(np.float32) / np.float32(self._units)
        if stored.dtype.kind == "u":
            depth[stored == np.iinfo(stored.dtype).max] = 0.0
        return straightened(self._lens, rgb, depth)

    def _frames(
        self, name: str, expected: str, shape: tuple[int, ...] | None = None
    ) -> np.ndarray:
        """An array that can be frames, else a FormatError."""
        array = self._array(name, shape)
        if array is None:
            there = abbreviated(self._names()) or "none"
            raise FormatError(
                f"{self.root}: no frames: there is no array '{name}'; there are: {there}. "
                f"Expected rgb, depth and K, as {page('own-data')} has them."
            )
        is_rgb = name == "rgb"
        shapes = array.ndim == 3 or (
            is_rgb and array.ndim == 4 and array.shape[3] == 3
        )
        kinds = array.dtype == np.uint8 if is_rgb else array.dtype.kind in "fu"
        if shapes and kinds and array.size:
            return array
        got = f"{array.dtype} {array.shape}"
        raise FormatError(f"{self.root}: {name}: expected {expected}, got {got}.")

    def _number(self, name: str, array: np.ndarray) -> float:
        if (
            array.size != 1
            or array.dtype.kind not in "fiu"
            or not array.reshape(-1) > 0
        ):
            raise FormatError(f"{self.root}: {name}: expected one number above 0.")
        return float(array.reshape(-1)[0])

    def _names(self) -> list[str]:
        """The names of the arrays that are there."""
        if self.root.is_dir():
            return sorted(path.stem for path in self.root.glob("*.npy"))
        with contextlib.suppress(OSError, ValueError, zipfile.BadZipFile):
            with zipfile.ZipFile(self.root) as archive:
                names = archive.namelist()
            return [name.removesuffix(".npy") for name in names]
        return []

    def _array(
        self, name: str, expected: tuple[int, ...] | None = None
    ) -> np.ndarray | None:
        """An array by its name; None where there is none.

        Args:
            name: Of the array.
            expected: Its shape, where there is one; an array with more numbers is not read.
        """
        try:
            if self.root.is_dir():
                path = self.root / f"{name}.npy"
                if not path.is_file():
                    return None
                with path.open("rb") as file:
                    return _mapped(path, file, 0, expected)
            return _from_archive(self.root, name, expected)
        except _Unlike as error:
            raise FormatError(f"{self.root}: {name}: {error}") from None
        except (InputError, OSError):
            raise
        # numpy and zipfile raise errors of many kinds for damaged files
        except Exception as error:
            reason = " ".join(str(error).split())[:200]
            raise FormatError(
                f"{self.root}: damaged: '{name}' cannot be read ({reason})."
            ) from None


class _Unlike(FormatError):
    """An array of another shape or type than expected, whose name the message lacks."""


class _Header(NamedTuple):
    """What is stated of an array before its values."""

    shape: tuple[int, ...]
    is_fortran: bool
    dtype: np.dtype

    @property
    def size(self) -> int:
        """Bytes of its values."""
        return math.prod(self.shape) * self.dtype.itemsize


def _from_archive(
    path: Path, name: str, expected: tuple[int, ...] | None
) -> np.ndarray | None:
    """An array in an ``.npz`` file: on the disk where it is stored as it is, else unpacked."""
    with zipfile.ZipFile(path) as archive:
        if f"{name}.npy" not in archive.namelist():
            return None
        info = archive.getinfo(f"{name}.npy")
        if info.compress_type == zipfile.ZIP_STORED:
            with path.open("rb") as file:
                file.seek(info.header_offset)
                header = LOCAL_HEADER.unpack(file.read(LOCAL_HEADER.size))
                start = (
                    info.header_offset + LOCAL_HEADER.size + header[-2] + header[-1]
                )
                return _mapped(path, file, start, expected)
        with archive.open(info) as packed:
            stated = _header(packed, expected)
        limit = min(LARGEST_UNPACKED, unpacked_limit(info.compress_size))
        if stated.size > min(limit, info.file_size):
            raise FormatError(
                f"{path}: {name}: {stated.size} bytes are too many to unpack: store it with "
                "numpy.savez, or as .npy."
            )
        with archive.open(info) as packed:
            array = np.lib.format.read_array(packed, allow_pickle=False)
            return np.asarray(array)


def _header(file: IO[bytes], expected: tuple[int, ...] | None) -> _Header:
    """What is stated of an array, of which the values come next in the file.

    Raises:
        FormatError: It is no array of numbers, or has more of them than expected.
    """
    start = file.read(np.lib.format.MAGIC_LEN)
    is_first = np.lib.format.read_magic(io.BytesIO(start)) == (1, 0)
    counted = file.read(2 if is_first else 4)
    length = int.from_bytes(counted, "little")
    if length > LONGEST_HEADER:
        raise FormatError(f"its header states {length} bytes")
    text = io.BytesIO(counted + file.read(length))
    if is_first:
        header = _Header(*np.lib.format.read_array_header_1_0(text))
    else:
        header = _Header(*np.lib.format.read_array_header_2_0(text))
    if header.dtype.hasobject:
        raise FormatError("it holds Python objects")
    is_large = header.dtype.itemsize > COMPLEX_BYTES
    if expected is None and not is_large:
        return header
    if is_large or math.prod(header.shape) > math.prod(expected or ()):
        wanted = "numbers" if expected is None else f"shape {expected}"
        raise _Unlike(f"expected {wanted}, got {header.dtype} {header.shape}.")
    return header


def _mapped(
    path: Path, file: Any, start: int, expected: tuple[int, ...] | None
) -> np.ndarray:
    """An array that begins at a place of a file, of which only what is used is read."""
    file.seek(start)
    stated = _header(file, expected)
    order: Any = "F" if stated.is_fortran else "C"
    if not stated.shape or 0 in stated.shape:
        file.seek(start)
        return np.asarray(np.lib.format.read_array(file, allow_pickle=False))
    return np.memmap(path, stated.dtype, "r", file.tell(), stated.shape, order)
