"""Bounds-checked readers and writers of flow, depth, camera and image files.

Every reader compares the size that a header declares with the size of the file, in Python integers,
before it allocates anything. A file that does not fit its format raises :class:`FormatError` with
the path, what was expected, what was found and how to mend it; a file that is not there raises
``FileNotFoundError``. Bytes after the end of the data give a :class:`HybridVOWarning`, or a
:class:`FormatError` with ``strict=True``.

Formats: Middlebury and Sintel ``.flo``, Sintel ``.dpt`` and ``.cam`` (all little-endian, tag
202021.25), ``.npy``, 16-bit PNG depth and flow, 8-bit PNG and JPEG images. OpenCV decodes PNG and
JPEG, after the container itself (chunks, checksums, size, end marker) has been checked here.
"""

from __future__ import annotations

import math
import os
import re
import struct
import warnings
from pathlib import Path
from typing import IO

import cv2
import numpy as np

from hybridvo.data.encoded_image import (
    check_image_size,
    decode,
    decode_exact,
    encoded_size,
    file_size,
    open_file,
)
from hybridvo.errors import FormatError, InputError, OutputError

__all__ = [
    "HybridVOWarning",
    "image_size",
    "read_cam",
    "read_depth_rgba_png",
    "read_dpt",
    "read_flo",
    "read_flow_kitti_png",
    "read_flow_tartanair_png",
    "read_mask_png",
    "read_npy",
    "read_png16",
    "read_rgb",
    "read_text",
    "write_cam",
    "write_dpt",
    "write_flo",
    "write_flow_kitti_png",
]

SINTEL_TAG = 202021.25
TAG_BYTES = struct.pack("<f", SINTEL_TAG)
NPY_MAGIC = b"\x93NUMPY"
HEADER_BYTES = 2**18
"""How much of an image file is read to learn its size (a JPEG may carry a thumbnail first)."""
FLOW_OFFSET, FLOW_SCALE = 32768.0, 64.0


class HybridVOWarning(UserWarning):
    """Something in the input that a user should look at and that does not stop the work."""


def _check_bytes(path: object, expected: int, got: int, what: str, strict: bool) -> None:
    if got < expected:
        raise FormatError(
            f"{path}: truncated: expected {expected} bytes ({what}), got {got}. "
            f"Copy or download the file again."
        )
    if got > expected:
        message = (
            f"{path}: expected {expected} bytes ({what}), got {got}: "
            f"{got - expected} trailing bytes."
        )
        if strict:
            raise FormatError(message + " Open with strict=False to ignore them.")
        warnings.warn(message + " They are ignored.", HybridVOWarning, stacklevel=4)


def _check_tag(path: object, head: bytes, suffix: str) -> None:
    if head[:4] == TAG_BYTES:
        return
    hint = ""
    if head[:4] == TAG_BYTES[::-1]:
        hint = " The file is big-endian; Sintel and Middlebury files are little-endian."
    raise FormatError(
        f"{path}: not a {suffix} file: expected the tag {SINTEL_TAG} (bytes {TAG_BYTES!r}), "
        f"got {head[:4]!r}.{hint}"
    )


def _read_tagged_header(file: IO[bytes], path: object, suffix: str) -> tuple[int, int]:
    """(height, width) from the 12-byte header of .flo and .dpt."""
    head = file.read(12)
    if len(head) < 12:
        raise FormatError(
            f"{path}: truncated: expected a 12-byte {suffix} header, got {len(head)} bytes."
        )
    _check_tag(path, head, suffix)
    width, height = struct.unpack("<ii", head[4:])
    check_image_size(path, width, height)
    return height, width


def _read_tagged(
    path: str | os.PathLike[str], suffix: str, channels: int, strict: bool
) -> np.ndarray:
    with open_file(path) as file:
        height, width = _read_tagged_header(file, path, suffix)
        expected = 12 + 4 * channels * height * width
        what = f"{suffix} of {width}x{height}"
        size = file_size(file)
        _check_bytes(path, expected, size, what, strict)
        data = file.read(expected - 12)
    if len(data) != expected - 12:  # the file shrank after its size was read
        _check_bytes(path, expected, 12 + len(data), what, strict)
    array = np.frombuffer(data, dtype="<f4").reshape(height, width, channels)
    return array.astype(np.float32)


def read_flo(path: str | os.PathLike[str], *, strict: bool = False) -> np.ndarray:
    """(H, W, 2) float32 flow in pixels from a Middlebury or Sintel ``.flo`` file.

    Args:
        path: file with tag, width, height, then (u, v) interleaved, row by row.
        strict: trailing bytes are an error instead of a warning.

    Raises:
        FormatError: wrong tag, impossible size, truncated file. FileNotFoundError: no such file.
    """
    return _read_tagged(path, ".flo", 2, strict)


def read_dpt(path: str | os.PathLike[str], *, strict: bool = False) -> np.ndarray:
    """(H, W) float32 depth from a Sintel ``.dpt`` file, in the units of the file.

    Raises:
        FormatError: wrong tag (a ``.flo`` has the same one: then the size does not fit), impossible
            size, truncated file. FileNotFoundError: no such file.
    """
    return _read_tagged(path, ".dpt", 1, strict)[:, :, 0]


def read_cam(
    path: str | os.PathLike[str], *, strict: bool = False
) -> tuple[np.ndarray, np.ndarray]:
    """Intrinsics K (3, 3) and extrinsic T_cam_world (4, 4), float64, from a Sintel ``.cam`` file.

    The file stores x ~ K [R|t] X_world: the extrinsic maps the world into the camera.

    Raises:
        FormatError: wrong tag or size, values that are not finite, or a left 3x3 block that is no
            rotation (to 1e-3). FileNotFoundError: no such file.
    """
    with open_file(path) as file:
        size = file_size(file)
        data = file.read(4 + 21 * 8)
    _check_tag(path, data, ".cam")
    expected = 4 + 21 * 8
    _check_bytes(path, expected, size if len(data) == expected else len(data), ".cam", strict)
    values = np.frombuffer(data, dtype="<f8", offset=4).astype(np.float64)
    if not np.isfinite(values).all():
        raise FormatError(f"{path}: expected finite intrinsics and extrinsics, got {values}.")
    T = np.eye(4)
    T[:3] = values[9:].reshape(3, 4)
    R = T[:3, :3]
    if np.abs(R).max() > 2 or np.abs(R @ R.T - np.eye(3)).max() > 1e-3 or np.linalg.det(R) < 0:
        raise FormatError(f"{path}: expected a rotation in [R|t], got {R.tolist()}.")
    return values[:9].reshape(3, 3), T


def _write(path: str | os.PathLike[str], data: bytes) -> None:
    try:
        Path(path).write_bytes(data)
    except OSError as error:
        raise OutputError(f"{path}: cannot be written: {error.strerror}.") from error


def _tagged_bytes(array: np.ndarray) -> bytes:
    height, width = array.shape[:2]
    return TAG_BYTES + struct.pack("<ii", width, height) + array.astype("<f4").tobytes()


def write_flo(path: str | os.PathLike[str], flow: np.ndarray) -> None:
    """Write (H, W, 2) flow in pixels as ``.flo``.

    Raises:
        InputError: another shape. OutputError: the file cannot be written.
    """
    flow = np.asarray(flow)
    if flow.ndim != 3 or flow.shape[2] != 2 or flow.size == 0:
        raise InputError(f"write_flo: expected flow of shape (H, W, 2), got {flow.shape}.")
    _write(path, _tagged_bytes(flow))


def write_dpt(path: str | os.PathLike[str], depth: np.ndarray) -> None:
    """Write (H, W) depth as ``.dpt``.

    Raises:
        InputError: another shape. OutputError: the file cannot be written.
    """
    depth = np.asarray(depth)
    if depth.ndim != 2 or depth.size == 0:
        raise InputError(f"write_dpt: expected depth of shape (H, W), got {depth.shape}.")
    _write(path, _tagged_bytes(depth))


def write_cam(path: str | os.PathLike[str], K: np.ndarray, T_cam_world: np.ndarray) -> None:
    """Write intrinsics (3, 3) and the extrinsic T_cam_world (4, 4) as ``.cam``.

    Raises:
        InputError: another shape. OutputError: the file cannot be written.
    """
    K, T = np.asarray(K, dtype="<f8"), np.asarray(T_cam_world, dtype="<f8")
    if K.shape != (3, 3) or T.shape != (4, 4):
        raise InputError(
            f"write_cam: expected K (3, 3) and T_cam_world (4, 4), got {K.shape} and {T.shape}."
        )
    _write(path, TAG_BYTES + K.tobytes() + T[:3].tobytes())


def _read_npy_header(file: IO[bytes], path: object) -> tuple[np.dtype, bool, tuple[int, ...]]:
    """Dtype, Fortran order and shape; the header is matched, never evaluated."""
    head = file.read(10)
    if len(head) < 10 or head[:6] != NPY_MAGIC:
        raise FormatError(f"{path}: not a .npy file: expected {NPY_MAGIC!r}, got {head[:6]!r}.")
    if head[6] == 1:
        length = struct.unpack("<H", head[8:10])[0]
    elif head[6] in (2, 3):
        rest = file.read(2)
        length = struct.unpack("<I", head[8:10] + rest)[0] if len(rest) == 2 else HEADER_BYTES
    else:
        raise FormatError(f"{path}: expected .npy version 1 to 3, got {head[6]}.{head[7]}.")
    text = file.read(min(length, HEADER_BYTES)).decode("latin-1")
    descr = re.search(r"'descr'\s*:\s*'([<>|=][fiub][0-9]{1,2})'", text)
    order = re.search(r"'fortran_order'\s*:\s*(True|False)", text)
    shape = re.search(r"'shape'\s*:\s*\(([0-9,\s]{0,80})\)", text)
    if len(text) != length or descr is None or order is None or shape is None:
        raise FormatError(
            f"{path}: expected a .npy header of a plain numeric array, got {text[:120]!r}. "
            f"Arrays of objects are not read; save with np.save(..., allow_pickle=False)."
        )
    try:
        dtype = np.dtype(descr.group(1))
        sizes = tuple(int(item) for item in shape.group(1).split(",") if item.strip())
    except (TypeError, ValueError):
        raise FormatError(f"{path}: cannot read the .npy header {text[:120]!r}.") from None
    return dtype, order.group(1) == "True", sizes


def read_npy(
    path: str | os.PathLike[str], *, channels: int | None = None, strict: bool = False
) -> np.ndarray:
    """Image stored as ``.npy``: (H, W), or (H, W, channels); never unpickles.

    Args:
        path: file written by ``np.save``.
        channels: expected length of a third axis; None for a two-dimensional array.
        strict: trailing bytes are an error instead of a warning.

    Returns:
        The array, in native byte order. Floating-point arrays come as float32.

    Raises:
        FormatError: not a ``.npy`` file, objects inside, another shape, truncated.
        FileNotFoundError: no such file.
    """
    with open_file(path) as file:
        dtype, fortran, shape = _read_npy_header(file, path)
        expected_shape = "(H, W)" if channels is None else f"(H, W, {channels})"
        if len(shape) != (2 if channels is None else 3) or shape[2:] not in ((), (channels,)):
            raise FormatError(f"{path}: expected an array of shape {expected_shape}, got {shape}.")
        check_image_size(path, shape[1], shape[0])
        count = math.prod(shape)
        start = file.tell()
        expected = start + count * dtype.itemsize
        what = f".npy {dtype} {shape}"
        _check_bytes(path, expected, file_size(file), what, strict)
        data = file.read(expected - start)
    if len(data) != expected - start:
        _check_bytes(path, expected, start + len(data), what, strict)
    array = np.frombuffer(data, dtype=dtype, count=count)
    array = array.reshape(shape, order="F" if fortran else "C")
    target = np.dtype(np.float32) if dtype.kind == "f" else dtype.newbyteorder("=")
    with np.errstate(over="ignore", invalid="ignore"):  # float64 beyond float32 becomes inf
        return np.ascontiguousarray(array, dtype=target)


def read_rgb(path: str | os.PathLike[str]) -> np.ndarray:
    """(H, W, 3) uint8 RGB from a PNG or JPEG; grey is repeated, alpha is dropped.

    EXIF orientation is not applied: the intrinsics belong to the stored pixels.

    Raises:
        FormatError: truncated, damaged or of another format. FileNotFoundError: no such file.
    """
    return cv2.cvtColor(decode(path, cv2.IMREAD_COLOR), cv2.COLOR_BGR2RGB)


def read_png16(path: str | os.PathLike[str]) -> np.ndarray:
    """(H, W) uint16 from a 16-bit PNG with one channel (depth in units of the data set).

    Raises:
        FormatError: another depth (an 8-bit preview, say), damaged. FileNotFoundError: no file.
    """
    return decode_exact(path, np.uint16, 1, "a 16-bit depth PNG")


def read_mask_png(path: str | os.PathLike[str]) -> np.ndarray:
    """(H, W) bool, True where an 8-bit PNG is not zero.

    Raises:
        FormatError: damaged or of another format. FileNotFoundError: no such file.
    """
    return np.asarray(decode(path, cv2.IMREAD_GRAYSCALE) > 0)


def read_depth_rgba_png(path: str | os.PathLike[str]) -> np.ndarray:
    """(H, W) float32 metres from a TartanAir V2 depth PNG (four bytes of a little-endian float).

    The writer handed the bytes to OpenCV as they lie in memory, so OpenCV's own channel order
    gives them back.

    Raises:
        FormatError: not an 8-bit PNG of four channels, damaged. FileNotFoundError: no such file.
    """
    image = decode_exact(path, np.uint8, 4, "a float32 depth PNG of TartanAir V2")
    return np.ascontiguousarray(image).view("<f4")[:, :, 0].astype(np.float32)


def _flow_from_png16(encoded: np.ndarray) -> np.ndarray:
    return (encoded.astype(np.float32) - np.float32(FLOW_OFFSET)) / np.float32(FLOW_SCALE)


def read_flow_kitti_png(path: str | os.PathLike[str]) -> tuple[np.ndarray, np.ndarray]:
    """KITTI flow PNG: (H, W, 2) float32 px and (H, W) bool valid.

    R = 64 u + 2^15, G = 64 v + 2^15, B = 1 where valid. Flow at invalid pixels is NaN.

    Raises:
        FormatError: not a 16-bit PNG of three channels, damaged. FileNotFoundError: no such file.
    """
    image = decode_exact(path, np.uint16, 3, "a 16-bit flow PNG")
    flow = _flow_from_png16(image[:, :, 2:0:-1])
    valid: np.ndarray = image[:, :, 0] > 0
    flow[~valid] = np.nan
    return flow, valid


def write_flow_kitti_png(
    path: str | os.PathLike[str], flow: np.ndarray, valid: np.ndarray | None = None
) -> None:
    """Write (H, W, 2) flow in pixels as a KITTI 16-bit PNG (1/64 px steps, |flow| < 512 px).

    Args:
        path: file to write.
        flow: pixels; values that are not finite or too long become invalid.
        valid: (H, W) bool, or None for all valid.

    Raises:
        InputError: another shape. OutputError: the file cannot be written.
    """
    flow = np.asarray(flow, dtype=np.float64)
    if flow.ndim != 3 or flow.shape[2] != 2 or flow.size == 0:
        raise InputError(f"write_flow_kitti_png: expected shape (H, W, 2), got {flow.shape}.")
    with np.errstate(invalid="ignore"):
        encoded = np.round(flow * FLOW_SCALE + FLOW_OFFSET)
        inside = np.logical_and.reduce((encoded >= 0) & (encoded <= 65535), axis=2)
    if valid is not None:
        inside &= np.asarray(valid, dtype=bool)
    encoded = np.where(inside[..., None], encoded, 0)
    bgr = np.dstack([inside, encoded[..., 1], encoded[..., 0]]).astype(np.uint16)
    _write(path, cv2.imencode(".png", bgr)[1].tobytes())


def read_flow_tartanair_png(path: str | os.PathLike[str]) -> tuple[np.ndarray, np.ndarray]:
    """TartanAir V2 flow PNG: (H, W, 2) float32 px and (H, W) bool valid.

    The channels u, v, mask stand in OpenCV's order (not in KITTI's); mask 0 means valid.

    Raises:
        FormatError: not a 16-bit PNG of three channels, damaged. FileNotFoundError: no such file.
    """
    image = decode_exact(path, np.uint16, 3, "a 16-bit flow PNG")
    valid: np.ndarray = image[:, :, 2] == 0
    return _flow_from_png16(image[:, :, :2]), valid


def image_size(path: str | os.PathLike[str]) -> tuple[int, int]:
    """(height, width) from the header of a PNG, JPEG, ``.npy``, ``.flo`` or ``.dpt`` file.

    Raises:
        FormatError: none of these, or a damaged header. FileNotFoundError: no such file.
    """
    with open_file(path) as file:
        head = file.read(8)
        file.seek(0)
        if head[:6] == NPY_MAGIC:
            _, _, shape = _read_npy_header(file, path)
            if len(shape) not in (2, 3):
                raise FormatError(f"{path}: expected an image, got an array of shape {shape}.")
            check_image_size(path, shape[1], shape[0])
            return shape[0], shape[1]
        if head[:4] == TAG_BYTES:
            return _read_tagged_header(file, path, Path(path).suffix)
        data = file.read(HEADER_BYTES)
    size = encoded_size(data, path)
    if size is not None:
        return size
    raise FormatError(f"{path}: expected a PNG, JPEG, .npy, .flo or .dpt file, got bytes {head!r}.")


def read_text(path: str | os.PathLike[str], *, limit: int = 2**26) -> str:
    """Text of a list or calibration file of at most ``limit`` bytes.

    Bytes that are not UTF-8 survive as surrogates, so that file names in a list keep their bytes.

    Raises:
        FormatError: longer than ``limit``. FileNotFoundError: no such file.
    """
    with open_file(path) as file:
        size = file_size(file)
        if size > limit:
            raise FormatError(f"{path}: {size} bytes, above the limit of {limit} for a text file.")
        return file.read(limit).decode("utf-8-sig", errors="surrogateescape")
