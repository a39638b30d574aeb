"""Readers and writers of image, depth, flow and camera files; damaged ones are a FormatError."""

from __future__ import annotations

import io
import struct
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np

from hybridvo.core.checks import as_rigid
from hybridvo.core.errors import FormatError, InputError
from hybridvo.core.files import (
    atomic_write,
    file_size,
    make_folder,
    read_bytes,
    read_head,
    read_text,
)
from hybridvo.core.geometry import pose_matrix
from hybridvo.core.trajectory import FILE_TOLERANCE

TAG_BYTES = struct.pack("<f", 202021.25)
"""The first bytes of .flo, .dpt and .cam files."""
PNG_MAGIC = b"\x89PNG\r\n\x1a\n"
"""The first bytes of a PNG."""
JPEG_MAGIC = b"\xff\xd8"
"""The first bytes of a JPEG."""
JPEG_SCAN = b"\xff\xda"
"""What starts the pixels of a JPEG: one scan, or several of a progressive one."""
UNKNOWN_FLOW = 1e9
"""Length of flow, pixels, from which it is unknown: Middlebury's mark."""
FLOW_PNG_OFFSET = 32768
"""The number that stands for no flow in the PNGs of KITTI and TartanAir."""
FLOW_PNG_SCALE = 64
"""Steps per pixel of flow in these PNGs."""
CV_CHANNELS = (2, 1, 0)
"""Places of the first, second and third channel of a PNG in OpenCV's order."""

# Limits on what a file may cost before it is known to belong to the sequence.

MAX_IMAGE_PIXELS = 2**26
"""Pixels of the largest image that is read: 8192x8192, 200 MB of colour."""
HEAD_BYTES = 2**20
"""Bytes in which a file must state its size. A camera's notes stand before it."""
NPY_HEAD_BYTES = 2**16
"""Bytes in which a .npy file must state its shape: the longest header of format 1."""
JPEG_PIXELS_PER_BYTE = 512
"""Most pixels that a byte of a JPEG can hold: a block of 8x8 takes at least a bit."""
MAX_JPEG_SCANS = 100
"""Most scans of a JPEG: an encoder makes ten at most. A decoder goes over all of the image for
each, and a scan of no content has some bytes."""
PNG_BITS_PER_BYTE = 8 * 1032
"""Most bits that a byte of a PNG can hold: the limit of deflate."""
MAX_MATRIX_BYTES = 2**12
"""Bytes of a text of 16 numbers."""
MAX_BYTES_PER_PIXEL = 8
"""Bytes of a pixel with four values of 16 bits, which are not compressed."""
PNG_HEADER_BYTES = 33
"""Bytes of a PNG up to the end of its first chunk, which states the size."""

Size = tuple[int, int] | None
"""Height and width that a file must have, in pixels; None where they are not known."""


class ImageHeader(NamedTuple):
    """What a PNG or JPEG states before its pixels."""

    height: int  # pixels
    width: int  # pixels
    bits: int  # of each value
    channels: int
    max_pixels_per_byte: float  # most pixels that a byte of the file can hold


def image_size(path: str | Path) -> tuple[int, int]:
    """Read the size of an image or a map from the header of its file.

    Args:
        path: A PNG, JPEG, ``.npy``, ``.flo`` or ``.dpt`` file.

    Returns:
        Height and width, pixels.

    Raises:
        FormatError: The file is of another kind, damaged, or too large.
    """
    suffix = Path(path).suffix.lower()
    if suffix in (".dpt", ".flo"):
        height, width = _tagged_size(path)
    elif suffix == ".npy":
        shape = _npy_header(path).shape
        height, width = shape[:2] if len(shape) >= 2 else (0, 0)
    else:
        header = read_header(path)
        height = header.height
        width = header.width
    _check_size(path, height, width, None)
    return height, width


def read_header(path: str | Path, size: Size = None) -> ImageHeader:
    """Read the header of a PNG or JPEG.

    Args:
        path: The file.
        size: The size that it must have.

    Raises:
        FormatError: The file is of another kind, has another size, or is shorter than its pixels
            need.
    """
    head = read_head(path, HEAD_BYTES)
    return _checked_header(path, head, file_size(path), size)


def read_rgb(path: str | Path, size: Size = None) -> np.ndarray:
    """Read a PNG or JPEG as (H, W, 3) uint8 RGB; grey is repeated, alpha is dropped."""
    bgr = _decode(path, cv2.IMREAD_COLOR, size)
    return cv2.cvtColor(bgr, cv2.COLOR_BGR2RGB)


def read_mask_png(path: str | Path, size: Size = None) -> np.ndarray:
    """Read a PNG or JPEG as a mask (H, W) bool, True where it is not zero."""
    grey = _decode(path, cv2.IMREAD_GRAYSCALE, size)
    return np.asarray(grey > 0)


def read_png(
    path: str | Path, dtype: type, channels: int, what: str, size: Size = None
) -> np.ndarray:
    """Read a PNG that must have a given type and number of channels.

    Args:
        path: The file.
        dtype: The type of its values.
        channels: The number of its channels, which stay in OpenCV's order.
        what: What is expected, for a message.
        size: The size that it must have.

    Returns:
        (H, W) for one channel, else (H, W, channels).
    """
    # IMREAD_UNCHANGED is -1: it ignores orientation, and cannot be combined with other flags.
    image = _decode(path, cv2.IMREAD_UNCHANGED, size)
    got = 1 if image.ndim == 2 else image.shape[2]
    if image.dtype != dtype or got != channels:
        expected = f"{what} ({np.dtype(dtype)}, {channels} channels)"
        raise FormatError(
            f"{path}: expected {expected}, got {image.dtype} with {got} channels."
        )
    return image


def decode_bytes(
    data: bytes, flags: int, where: str, size: Size = None
) -> np.ndarray:
    """Decode a PNG or JPEG that is in memory.

    Args:
        data: All bytes of the image.
        flags: OpenCV's flags.
        where: Where the bytes come from, for a message.
        size: The size that it must have.

    Returns:
        The image in OpenCV's channel order.

    Raises:
        FormatError: The bytes are damaged, or the image has another size.
    """
    _checked_header(where, data[:HEAD_BYTES], len(data), size)
    return _decode_whole(where, data, flags)


def read_depth(path: str | Path, size: Size = None) -> np.ndarray:
    """Read depth (H, W) as stored: float32 (``.dpt``, ``.npy``) or unsigned (PNG, ``.npy``)."""
    suffix = Path(path).suffix.lower()
    if suffix == ".dpt":
        return _read_map(path, 1, size)[:, :, 0]
    if suffix != ".npy":
        header = read_header(path, size)
        if header.bits <= 8:
            raise FormatError(
                f"{path}: expected a 16-bit depth PNG, got 8 bits with "
                f"{header.channels} channels: 8 bits are a picture of depth, not metres; "
                "store what the sensor measured, or .npy in metres."
            )
        return read_png(path, np.uint16, 1, "a 16-bit depth PNG", size)
    depth = read_npy(path, size=size)
    if depth.dtype.kind not in "fu":
        raise FormatError(
            f"{path}: expected depth as floating point or unsigned integers."
        )
    return depth


def read_flow(
    path: str | Path, size: Size = None
) -> tuple[np.ndarray, np.ndarray | None]:
    """Read flow from a ``.flo`` or ``.npy`` file, or from a PNG in KITTI's form.

    Args:
        path: The file.
        size: The size that it must have.

    Returns:
        The flow (H, W, 2), pixels, and where it is valid, (H, W) bool; None if it is everywhere.
    """
    suffix = Path(path).suffix.lower()
    if suffix == ".flo":
        flow = _read_map(path, 2, size)
        with np.errstate(invalid="ignore"):
            valid = (np.abs(flow) < UNKNOWN_FLOW).all(axis=2)
        return flow, None if valid.all() else valid
    if suffix == ".npy":
        flow = read_npy(path, channels=2, size=size)
        return flow.astype(np.float32, copy=False), None
    flow, mask = read_flow_png(path, CV_CHANNELS, size)
    valid = np.asarray(mask > 0)
    flow[~valid] = np.nan
    return flow, valid


def read_flow_png(
    path: str | Path, order: tuple[int, int, int], size: Size = None
) -> tuple[np.ndarray, np.ndarray]:
    """Read flow and a mask from a PNG with three channels of 16 bits.

    Args:
        path: The file.
        order: Which channels, in OpenCV's order, hold u, v and the mask.
        size: The size that it must have.

    Returns:
        The flow (H, W, 2) float32, pixels, and the mask (H, W) as it is stored.
    """
    image = read_png(path, np.uint16, 3, "a 16-bit flow PNG", size)
    u_channel, v_channel, mask_channel = order
    stored = image[:, :, [u_channel, v_channel]].astype(np.float32)
    offset = np.float32(FLOW_PNG_OFFSET)
    flow = (stored - offset) / np.float32(FLOW_PNG_SCALE)
    return flow, image[:, :, mask_channel]


def read_cam(path: str | Path) -> tuple[np.ndarray, np.ndarray]:
    """Read the intrinsics K (3, 3) and T_cam_world (4, 4) of a Sintel ``.cam`` file."""
    values = _read_tagged(path, "<f8", start=4, count=21)
    K = values[:9].reshape(3, 3)
    if not np.isfinite(K).all():
        got = values[:9].tolist()
        raise FormatError(f"{path}: expected finite intrinsics, got {got}.")
    pose = values[9:].reshape(3, 4)
    return K, as_pose(pose, str(path))


def as_pose(stored: np.ndarray, where: str) -> np.ndarray:
    """Check a pose from a file and make its rotation exact.

    Args:
        stored: (3, 4) rotation and translation, as the file has them.
        where: The file, for a message.

    Returns:
        (4, 4) the pose.

    Raises:
        FormatError: The rotation is none, or a value is not finite.
    """
    T = np.vstack([stored, (0, 0, 0, 1)])
    try:
        checked = as_rigid(T, where, FILE_TOLERANCE)
        return pose_matrix(checked[:3])
    except InputError as error:
        raise FormatError(str(error)) from None


def numbers_of_matrix(path: Path) -> np.ndarray:
    """Read a matrix (4, 4) from a text of 16 numbers; they may be infinite."""
    try:
        words = read_text(path, MAX_MATRIX_BYTES).split()
        return np.array(words, np.float64).reshape(4, 4)
    except FormatError:
        raise
    except ValueError as error:
        raise FormatError(
            f"{path}: expected 16 numbers of a 4x4 matrix ({error})."
        ) from None


def read_matrix(path: Path) -> np.ndarray:
    """Read a pose (4, 4) from a text of 16 numbers; NaN where tracking was lost."""
    T = numbers_of_matrix(path)
    if not np.isfinite(T).all():
        return np.full((4, 4), np.nan)
    return as_pose(T[:3], str(path))


def read_npy(
    path: str | Path, *, channels: int | None = None, size: Size = None
) -> np.ndarray:
    """Read an array of numbers from a ``.npy`` file; Python objects are never unpickled.

    Args:
        path: The file.
        channels: The size of the last axis; None for an array without it.
        size: The size that the first two axes must have.

    Returns:
        (H, W), or (H, W, channels). Floating-point values become float32.

    Raises:
        FormatError: The file holds something else.
    """
    header = _npy_header(path)
    _check_npy_shape(path, header, channels)
    height, width = header.shape[:2]
    _check_size(path, height, width, size)
    count = height * width * (channels or 1)
    _check_length(path, header.offset + count * header.dtype.itemsize)
    array = np.load(path, mmap_mode="r", allow_pickle=False)
    if header.dtype.kind == "f":
        target = np.dtype(np.float32)
    else:
        target = header.dtype.newbyteorder("=")
    # A float64 beyond the range of float32 becomes infinite.
    with np.errstate(over="ignore", invalid="ignore"):
        return np.array(array, dtype=target, order="C", subok=False)


def _check_npy_shape(
    path: str | Path, header: _NpyHeader, channels: int | None
) -> None:
    """Refuse an array that holds no numbers, or has another number of axes."""
    last = () if channels is None else (channels,)
    is_number = header.dtype.kind in "fiub"
    is_shape = len(header.shape) == 2 + len(last) and header.shape[2:] == last
    if is_number and is_shape:
        return
    shape = "(H, W)" if channels is None else f"(H, W, {channels})"
    if header.dtype.hasobject:
        got = "Python objects"
    else:
        got = f"{header.dtype} {header.shape}"
    raise FormatError(
        f"{path}: expected an array of numbers of shape {shape}, got {got}."
    )


def write_png(path: Path, image: np.ndarray) -> None:
    """Write a PNG, in OpenCV's order of channels, into a folder that is made if needed."""
    make_folder(path.parent)
    with atomic_write(path, "wb") as file:
        file.write(cv2.imencode(".png", image)[1].tobytes())


def write_flo(path: str | Path, flow: np.ndarray) -> None:
    """Write flow (H, W, 2), pixels, as ``.flo``, or depth (H, W), metres, as ``.dpt``.

    Both kinds of files have the same form.
    """
    height, width = flow.shape[:2]
    size = struct.pack("<ii", width, height)
    with atomic_write(path, "wb") as file:
        file.write(TAG_BYTES + size + flow.astype("<f4").tobytes())


write_dpt = write_flo


def write_cam(path: str | Path, K: np.ndarray, T_cam_world: np.ndarray) -> None:
    """Write intrinsics K (3, 3) and T_cam_world (4, 4) as a Sintel ``.cam`` file."""
    with atomic_write(path, "wb") as file:
        file.write(TAG_BYTES + np.asarray(K, "<f8").tobytes())
        file.write(np.asarray(T_cam_world, "<f8")[:3].tobytes())


def _check_size(path: object, height: int, width: int, size: Size) -> None:
    """Refuse an image of another size than the sequence has, or of no possible size."""
    declares = f"the header declares {width}x{height}"
    if height <= 0 or width <= 0 or height * width > MAX_IMAGE_PIXELS:
        expected = f"expected an image of 1 to {MAX_IMAGE_PIXELS} pixels"
        raise FormatError(f"{path}: {expected}, {declares}.")
    if size is not None and (height, width) != size:
        expected = f"expected {size[1]}x{size[0]} pixels, as the camera has"
        raise FormatError(f"{path}: {expected}; {declares}.")


def _check_length(path: str | Path, expected: int) -> None:
    """Refuse a file that does not have as many bytes as its header states."""
    got = file_size(path)
    if got != expected:
        problem = "truncated" if got < expected else "trailing bytes"
        raise FormatError(
            f"{path}: {problem}: expected {expected} bytes, got {got}."
        )


class _NpyHeader(NamedTuple):
    """What a .npy file states before its values."""

    shape: tuple[int, ...]
    dtype: np.dtype
    offset: int  # bytes before the values


def _npy_header(path: str | Path) -> _NpyHeader:
    """Read the header of a .npy file."""
    head = io.BytesIO(read_head(path, NPY_HEAD_BYTES))
    try:
        version = np.lib.format.read_magic(head)
        if version == (1, 0):
            shape, _, dtype = np.lib.format.read_array_header_1_0(head)
        else:
            shape, _, dtype = np.lib.format.read_array_header_2_0(head)
    # numpy raises errors of many types for a damaged header.
    except Exception as error:
        reason = " ".join(str(error).split())[:200]
        raise FormatError(
            f"{path}: expected a whole .npy file of one array ({reason})."
        ) from None
    return _NpyHeader(shape, dtype, head.tell())


def _tagged_size(path: str | Path) -> tuple[int, int]:
    """Read the height and width, pixels, that a .flo or .dpt file states."""
    head = read_head(path, 12)
    if not head.startswith(TAG_BYTES):
        expected = f"a little-endian file that starts with {TAG_BYTES!r}"
        raise FormatError(f"{path}: expected {expected}, got {head[:4]!r}.")
    width, height = struct.unpack("<ii", head[4:].ljust(8, b"\0"))
    return height, width


def _read_map(path: str | Path, channels: int, size: Size) -> np.ndarray:
    """Read the values of a .flo or .dpt file, (H, W, channels) float32."""
    height, width = _tagged_size(path)
    _check_size(path, height, width, size)
    values = _read_tagged(path, "<f4", start=12, count=height * width * channels)
    return values.reshape(height, width, channels)


def _read_tagged(
    path: str | Path, dtype: str, start: int, count: int
) -> np.ndarray:
    """Read the values of a file that starts with the tag.

    Args:
        path: The file.
        dtype: The type of the values, with their byte order.
        start: The place of the first value, bytes.
        count: The number of the values, which must end where the file ends.
    """
    _tagged_size(path)  # checks the tag
    length = start + count * np.dtype(dtype).itemsize
    _check_length(path, length)
    data = read_bytes(path, length)
    return np.frombuffer(data, dtype, count, start).astype(dtype[1:])


def _checked_header(
    path: str | Path, head: bytes, length: int, size: Size
) -> ImageHeader:
    """Read the header of a PNG or JPEG of ``length`` bytes, and refuse one that cannot be true."""
    if head.startswith(PNG_MAGIC) and len(head) >= PNG_HEADER_BYTES:
        header = _png_header(head)
    elif head.startswith(JPEG_MAGIC):
        header = _jpeg_header(path, head)
    else:
        got = repr(head[:8]) if head else "an empty file"
        raise FormatError(f"{path}: expected a whole PNG or JPEG image, got {got}.")
    _check_size(path, header.height, header.width, size)
    pixels = header.height * header.width
    if pixels > length * header.max_pixels_per_byte:
        declared = f"{header.width}x{header.height} pixels"
        raise FormatError(
            f"{path}: truncated: {length} bytes cannot hold the {declared} "
            "that the header declares."
        )
    return header


def _png_header(head: bytes) -> ImageHeader:
    """Read the first chunk of a PNG."""
    width, height, bits, colour = struct.unpack(">IIBB", head[16:26])
    values_of_colour = {0: 1, 2: 3, 3: 1, 4: 2, 6: 4}
    values_per_pixel = values_of_colour.get(colour, 1)
    # Colour type 3 is a palette: one value stands for three channels.
    channels = 3 if colour == 3 else values_per_pixel
    bits_per_pixel = max(bits * values_per_pixel, 1)
    max_pixels_per_byte = PNG_BITS_PER_BYTE / bits_per_pixel
    return ImageHeader(height, width, bits, channels, max_pixels_per_byte)


def _jpeg_header(path: str | Path, head: bytes) -> ImageHeader:
    """Walk through the segments of a JPEG to the one that states the size, as a decoder does."""
    at = 2
    while (at := head.find(b"\xff", at)) >= 0 and len(head) >= at + 10:
        marker = head[at + 1]
        if _starts_frame(marker):
            bits, height, width, channels = struct.unpack(
                ">BHHB", head[at + 4 : at + 10]
            )
            return ImageHeader(height, width, bits, channels, JPEG_PIXELS_PER_BYTE)
        if marker in (0xD9, 0xDA):
            # the end of the image, or its pixels before any size
            break
        if marker == 0xFF:
            # a fill byte
            at += 1
        elif marker in (0x00, 0x01) or 0xD0 <= marker <= 0xD8:
            # a marker without content
            at += 2
        else:
            length = int.from_bytes(head[at + 2 : at + 4], "big")
            at += 2 + length
    raise FormatError(
        f"{path}: truncated or damaged: the JPEG does not state its size."
    )


def _starts_frame(marker: int) -> bool:
    """Return whether a JPEG marker starts the segment that states the size."""
    # C4, C8 and CC are tables and extensions among the frame markers.
    return 0xC0 <= marker <= 0xCF and marker not in (0xC4, 0xC8, 0xCC)


def _decode(path: str | Path, flags: int, size: Size) -> np.ndarray:
    """Decode a PNG or JPEG in OpenCV's channel order, after a check of its header and its end."""
    header = read_header(path, size)
    pixels = header.height * header.width
    data = read_bytes(path, pixels * MAX_BYTES_PER_PIXEL + HEAD_BYTES)
    return _decode_whole(path, data, flags)


def _decode_whole(path: str | Path, data: bytes, flags: int) -> np.ndarray:
    """Decode all bytes of a PNG or JPEG, whose header was checked."""
    _check_end(path, data)
    _check_scans(path, data)
    # Orientation is ignored: the intrinsics belong to the pixels as they are stored.
    flags |= cv2.IMREAD_IGNORE_ORIENTATION
    try:
        image = cv2.imdecode(np.frombuffer(data, np.uint8), flags)
    except cv2.error:
        image = None
    if image is None:
        raise FormatError(f"{path}: damaged: the image cannot be decoded.")
    return image


def _check_end(path: str | Path, data: bytes) -> None:
    """Refuse an image whose closing marker is missing.

    OpenCV fills the missing part of a JPEG with grey and does not state it.
    """
    if data.startswith(PNG_MAGIC):
        pixels = b"IDAT"
        closing = b"IEND"
    else:
        pixels = JPEG_SCAN
        closing = b"\xff\xd9"
    if data.rfind(closing) <= data.rfind(pixels):
        raise FormatError(f"{path}: truncated: {len(data)} bytes end too early.")


def _check_scans(path: str | Path, data: bytes) -> None:
    """Refuse a JPEG of so many scans that decoding it would last."""
    scans = 0 if data.startswith(PNG_MAGIC) else data.count(JPEG_SCAN)
    if scans > MAX_JPEG_SCANS:
        raise FormatError(
            f"{path}: expected a JPEG of at most {MAX_JPEG_SCANS} scans, got {scans}. If you know "
            "where it comes from, save it anew without 'progressive'."
        )
