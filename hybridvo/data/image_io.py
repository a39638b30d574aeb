"""Readers and writers of image, depth, flow and camera files; damaged ones are a FormatError."""

from __future__ import annotations

import math
import struct
from pathlib import Path

import cv2
import numpy as np

from hybridvo.errors import FormatError, InputError
from hybridvo.files import atomic_write, read_bytes
from hybridvo.geometry import pose_matrix
from hybridvo.trajectory import FILE_TOLERANCE
from hybridvo.types import MAX_PIXELS, as_rigid

TAG_BYTES = struct.pack("<f", 202021.25)  # how .flo, .dpt and .cam files begin
PNG_MAGIC, JPEG_MAGIC = b"\x89PNG\r\n\x1a\n", b"\xff\xd8"
UNKNOWN_FLOW = 1e9  # px, Middlebury's mark: longer flow is unknown


def read_rgb(path: str | Path) -> np.ndarray:
    """Read a PNG or JPEG as (H, W, 3) uint8 RGB; grey is repeated, alpha is dropped."""
    return cv2.cvtColor(_decode(path, cv2.IMREAD_COLOR), cv2.COLOR_BGR2RGB)


def read_mask_png(path: str | Path) -> np.ndarray:
    """Read a PNG or JPEG as a mask (H, W) bool, True where it is not zero."""
    return np.asarray(_decode(path, cv2.IMREAD_GRAYSCALE) > 0)


def read_png(path: str | Path, dtype: type, channels: int, what: str) -> np.ndarray:
    """Read a PNG of a given dtype and number of channels, which stay in OpenCV's order."""
    # IMREAD_UNCHANGED is -1: it leaves orientation alone and cannot be combined with other flags
    image = _decode(path, cv2.IMREAD_UNCHANGED)
    got = 1 if image.ndim == 2 else image.shape[2]
    if image.dtype != dtype or got != channels:
        expected = f"{what} ({np.dtype(dtype)}, {channels} channels)"
        raise FormatError(f"{path}: expected {expected}, got {image.dtype} with {got} channels.")
    return image


def read_depth(path: str | Path) -> np.ndarray:
    """Read depth (H, W) as stored: float32 (``.dpt``, ``.npy``) or unsigned (PNG, ``.npy``)."""
    suffix = Path(path).suffix.lower()
    if suffix == ".dpt":
        return _read_tagged(path, "<f4", 1)[:, :, 0]
    if suffix != ".npy":
        return read_png(path, np.uint16, 1, "a 16-bit depth PNG")
    depth = read_npy(path)
    if depth.dtype.kind not in "fu":
        raise FormatError(f"{path}: expected depth as floating point or unsigned integers.")
    return depth


def read_flow(path: str | Path) -> tuple[np.ndarray, np.ndarray | None]:
    """Read flow (H, W, 2), px, and where it is valid, (H, W) or None: .flo, .npy, KITTI's PNG."""
    suffix = Path(path).suffix.lower()
    if suffix == ".flo":
        flow = _read_tagged(path, "<f4", 2)
        with np.errstate(invalid="ignore"):
            known = (np.abs(flow) < UNKNOWN_FLOW).all(axis=2)
        return flow, None if known.all() else known
    if suffix == ".npy":
        return read_npy(path, channels=2).astype(np.float32, copy=False), None
    flow, image = read_flow_png(path, (2, 1, 0))
    valid: np.ndarray = image > 0
    flow[~valid] = np.nan
    return flow, valid


def read_flow_png(path: str | Path, order: tuple[int, int, int]) -> tuple[np.ndarray, np.ndarray]:
    """Read flow (H, W, 2), px, and mask of a 16-bit PNG; ``order``: its channels of u, v, mask."""
    u, v, mask = np.moveaxis(read_png(path, np.uint16, 3, "a 16-bit flow PNG"), 2, 0)[[*order]]
    return (np.dstack([u, v]).astype(np.float32) - np.float32(32768)) / np.float32(64), mask


def read_cam(path: str | Path) -> tuple[np.ndarray, np.ndarray]:
    """Read the intrinsics K (3, 3) and T_cam_world (4, 4) of a Sintel ``.cam`` file."""
    values = _read_tagged(path, "<f8")
    if not np.isfinite(values[:9]).all():
        raise FormatError(f"{path}: expected finite intrinsics, got {values[:9].tolist()}.")
    return values[:9].reshape(3, 3), as_pose(values[9:].reshape(3, 4), str(path))


def as_pose(stored: np.ndarray, where: str) -> np.ndarray:
    """Check the pose (3, 4) of a file and return it as (4, 4) with an exact rotation."""
    try:
        return pose_matrix(as_rigid(np.vstack([stored, (0, 0, 0, 1)]), where, FILE_TOLERANCE)[:3])
    except InputError as error:
        raise FormatError(str(error)) from None


def read_npy(path: str | Path, *, channels: int | None = None) -> np.ndarray:
    """Read (H, W) or (H, W, channels) from a ``.npy`` file, floats as float32; never unpickles."""
    try:
        array = np.load(path, mmap_mode="r", allow_pickle=False)  # reads the header alone
        trailing = Path(path).stat().st_size - array.offset - array.nbytes
    except FileNotFoundError:
        raise
    except Exception as error:  # numpy raises errors of many kinds for a damaged header
        reason = " ".join(str(error).split())[:200]
        raise FormatError(f"{path}: expected a whole .npy file of one array ({reason}).") from None
    kind, expected = array.dtype, (2, ()) if channels is None else (3, (channels,))
    if kind.kind not in "fiub" or (array.ndim, array.shape[2:]) != expected or trailing:
        wanted = f"an array of numbers of shape (H, W{', 2' * bool(channels)})"
        got = f"{kind} {array.shape} and {trailing} trailing bytes"
        raise FormatError(f"{path}: expected {wanted}, got {got}.")
    _check_pixels(path, array.shape[1], array.shape[0])
    target = np.dtype(np.float32) if kind.kind == "f" else kind.newbyteorder("=")
    with np.errstate(over="ignore", invalid="ignore"):  # float64 beyond float32 becomes inf
        return np.array(array, dtype=target, order="C", subok=False)


def write_flo(path: str | Path, flow: np.ndarray) -> None:
    """Write flow (H, W, 2), px, as ``.flo``, or depth (H, W), m, as ``.dpt``: they look alike."""
    size = struct.pack("<ii", flow.shape[1], flow.shape[0])
    with atomic_write(path, "wb") as file:
        file.write(TAG_BYTES + size + flow.astype("<f4").tobytes())


write_dpt = write_flo


def write_cam(path: str | Path, K: np.ndarray, T_cam_world: np.ndarray) -> None:
    """Write intrinsics K (3, 3) and T_cam_world (4, 4) as a Sintel ``.cam`` file."""
    with atomic_write(path, "wb") as file:
        file.write(TAG_BYTES + np.asarray(K, "<f8").tobytes())
        file.write(np.asarray(T_cam_world, "<f8")[:3].tobytes())


def _check_pixels(path: object, width: int, height: int) -> None:
    if width <= 0 or height <= 0 or width * height > MAX_PIXELS:
        expected = f"expected an image of 1 to {MAX_PIXELS} pixels"
        raise FormatError(f"{path}: {expected}, the header declares {width}x{height}.")


def _read_tagged(path: str | Path, dtype: str, channels: int | None = None) -> np.ndarray:
    """The values after the tag: (H, W, channels) of .flo and .dpt, else the 21 of .cam."""
    data = read_bytes(path)
    if not data.startswith(TAG_BYTES):
        expected = f"a little-endian file that starts with {TAG_BYTES!r}"
        raise FormatError(f"{path}: expected {expected}, got {data[:4]!r}.")
    start = 4
    shape: tuple[int, ...] = (21,)
    if channels is not None:
        width, height = struct.unpack("<ii", data[4:12].ljust(8, b"\0"))
        _check_pixels(path, width, height)
        start, shape = 12, (height, width, channels)
    size = start + math.prod(shape) * np.dtype(dtype).itemsize
    if len(data) != size:
        problem = "truncated" if len(data) < size else "trailing bytes"
        raise FormatError(f"{path}: {problem}: expected {size} bytes, got {len(data)}.")
    return np.frombuffer(data, dtype, offset=start).reshape(shape).astype(dtype[1:])


def _decode(path: str | Path, flags: int) -> np.ndarray:
    """Decoded PNG or JPEG in OpenCV's channel order, after a look at its two ends."""
    data = read_bytes(path)
    is_png = data.startswith(PNG_MAGIC) and len(data) >= 33
    if is_png:
        _check_pixels(path, *struct.unpack(">II", data[16:24]))
    elif not data.startswith(JPEG_MAGIC):
        raise FormatError(f"{path}: expected a whole PNG or JPEG image, got {data[:8]!r}.")
    # OpenCV fills what is missing of a JPEG with grey: look for the closing marker after the pixels
    pixels, closing = (b"IDAT", b"IEND") if is_png else (b"\xff\xda", b"\xff\xd9")
    if data.rfind(closing) <= data.rfind(pixels):
        raise FormatError(f"{path}: truncated: {len(data)} bytes end too early.")
    try:  # orientation is ignored: the intrinsics belong to the pixels as they are stored
        image = cv2.imdecode(np.frombuffer(data, np.uint8), flags | cv2.IMREAD_IGNORE_ORIENTATION)
    except cv2.error:
        image = None
    if image is None:
        raise FormatError(f"{path}: damaged: the image cannot be decoded.")
    return image
