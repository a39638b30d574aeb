"""PNG and JPEG containers, checked before OpenCV decodes what is in them.

OpenCV answers a damaged file with None, with a partly grey image or with an exception, depending on
where the damage is. Here the chunks, checksums, sizes and end markers are walked first.
"""

from __future__ import annotations

import os
import stat
import struct
import zlib
from typing import IO

import cv2
import numpy as np

from hybridvo.errors import FormatError
from hybridvo.types import MAX_PIXELS

__all__ = [
    "check_image_size",
    "decode",
    "decode_exact",
    "encoded_size",
    "file_size",
    "open_file",
]

PNG_MAGIC = b"\x89PNG\r\n\x1a\n"
JPEG_MAGIC = b"\xff\xd8"
MAX_IMAGE_BYTES = 2**30
DEFLATE_MAX_RATIO = 1032
"""Deflate cannot expand by more than this factor, so a smaller PNG cannot hold its pixels."""
JPEG_MAX_PIXELS_PER_BYTE = 2048
"""Huffman coding spends a bit on each block of 64 luminance pixels: 512 a byte; with a margin for
subsampled luminance."""
JPEG_MAX_SCANS = 256
"""Each scan of a progressive JPEG passes over the whole image; writers make about ten."""


def open_file(path: str | os.PathLike[str]) -> IO[bytes]:
    """The file, open for reading; FormatError for what is no file with an end.

    Raises:
        FormatError: a folder, a pipe or a device (which could block or never end), an impossible
            name, or a file that may not be read. FileNotFoundError: no such file.
    """
    try:
        # without O_NONBLOCK a pipe that nobody writes to would block here
        flags = os.O_RDONLY | getattr(os, "O_NONBLOCK", 0) | getattr(os, "O_BINARY", 0)
        descriptor = os.open(path, flags | getattr(os, "O_CLOEXEC", 0))
    except FileNotFoundError:
        raise
    except OSError as error:
        raise FormatError(f"{path}: cannot be read: {error.strerror or error}.") from None
    except ValueError as error:  # a null byte in the name
        raise FormatError(f"{path!r}: not a file name ({error}).") from None
    mode = os.fstat(descriptor).st_mode
    if not stat.S_ISREG(mode):
        os.close(descriptor)
        what = "a folder" if stat.S_ISDIR(mode) else "a pipe or device"
        raise FormatError(f"{path}: expected a file, got {what}.")
    return os.fdopen(descriptor, "rb")


def file_size(file: IO[bytes]) -> int:
    """Bytes of an open file."""
    return os.fstat(file.fileno()).st_size


def check_image_size(path: object, width: int, height: int) -> None:
    """FormatError unless 0 < width, height and their product is within ``MAX_PIXELS``."""
    if width <= 0 or height <= 0:
        raise FormatError(
            f"{path}: expected a positive image size, got width {width}, height {height}. "
            f"The file is damaged or of another format."
        )
    if width * height > MAX_PIXELS:
        raise FormatError(
            f"{path}: the header declares {width}x{height} pixels, above the limit of {MAX_PIXELS}."
            f" The header is damaged, or the image must be tiled or resized first."
        )


def _png_header(data: bytes, path: object) -> tuple[int, int, int]:
    """(height, width, bits per pixel)."""
    if len(data) < 33 or data[12:16] != b"IHDR":
        raise FormatError(f"{path}: truncated PNG: expected a header of 33 bytes, got {len(data)}.")
    width, height, depth, color = struct.unpack(">IIBB", data[16:26])
    check_image_size(path, width, height)
    channels = {0: 1, 2: 3, 3: 1, 4: 2, 6: 4}.get(color)
    if channels is None or depth not in (1, 2, 4, 8, 16):
        raise FormatError(f"{path}: damaged PNG header: bit depth {depth}, colour type {color}.")
    return height, width, depth * channels


def _check_png(data: bytes, path: object) -> None:
    """Walk the chunks, so that a cut or a flipped byte is found before anything is decoded."""
    height, width, bits = _png_header(data, path)
    if height * width * bits // 8 > DEFLATE_MAX_RATIO * len(data):
        raise FormatError(
            f"{path}: truncated PNG: {width}x{height} pixels of {bits} bits cannot fit into "
            f"{len(data)} bytes. Copy or download the file again."
        )
    position = len(PNG_MAGIC)
    while position + 12 <= len(data):
        length, name = struct.unpack(">I4s", data[position : position + 8])
        end = position + 12 + length
        if end > len(data):
            break
        checksum = struct.unpack(">I", data[end - 4 : end])[0]
        if zlib.crc32(memoryview(data)[position + 4 : end - 4]) != checksum:
            raise FormatError(
                f"{path}: damaged PNG: the checksum of chunk {name!r} at byte {position} is wrong. "
                f"Copy or download the file again."
            )
        if name == b"IEND":
            return
        position = end
    raise FormatError(
        f"{path}: truncated PNG: {len(data)} bytes end before the closing chunk. "
        f"Copy or download the file again."
    )


def _jpeg_header(data: bytes, path: object) -> tuple[int, int, int]:
    """(height, width, position of the header's end)."""
    position = 2
    while position + 9 <= len(data) and data[position] == 0xFF:
        marker = data[position + 1]
        if marker == 0xFF:  # fill byte
            position += 1
            continue
        if 0xC0 <= marker <= 0xCF and marker not in (0xC4, 0xC8, 0xCC):
            height, width = struct.unpack(">HH", data[position + 5 : position + 9])
            check_image_size(path, width, height)
            return height, width, position
        position += 2 + struct.unpack(">H", data[position + 2 : position + 4])[0]
    raise FormatError(f"{path}: truncated or damaged JPEG: no image header in {len(data)} bytes.")


def _check_jpeg(data: bytes, path: object) -> None:
    height, width, start = _jpeg_header(data, path)
    if height * width > JPEG_MAX_PIXELS_PER_BYTE * len(data):
        raise FormatError(
            f"{path}: truncated JPEG: {width}x{height} pixels cannot fit into {len(data)} bytes. "
            f"Copy or download the file again."
        )
    if data.count(b"\xff\xda", start) > JPEG_MAX_SCANS:
        raise FormatError(f"{path}: damaged JPEG: more than {JPEG_MAX_SCANS} scans.")
    scan = data.find(b"\xff\xda", start)
    if scan < 0 or data.rfind(b"\xff\xd9") < scan:
        raise FormatError(
            f"{path}: truncated JPEG: {len(data)} bytes end before the closing marker. "
            f"Copy or download the file again."
        )


def decode(path: str | os.PathLike[str], flags: int) -> np.ndarray:
    """Decoded PNG or JPEG in OpenCV's channel order.

    Raises:
        FormatError: truncated, damaged or of another format. FileNotFoundError: no such file.
    """
    with open_file(path) as file:
        size = file_size(file)
        if size > MAX_IMAGE_BYTES:
            raise FormatError(f"{path}: {size} bytes, above the limit of {MAX_IMAGE_BYTES}.")
        data = file.read(size)
    if data[:8] == PNG_MAGIC:
        _check_png(data, path)
    elif data[:2] == JPEG_MAGIC:
        _check_jpeg(data, path)
    else:
        raise FormatError(
            f"{path}: expected a PNG or JPEG image, got {len(data)} bytes that start with "
            f"{data[:8]!r}. Convert the image to PNG."
        )
    try:
        # Ignore EXIF rotation: the intrinsics belong to the pixels as they are stored.
        image = cv2.imdecode(np.frombuffer(data, np.uint8), flags | cv2.IMREAD_IGNORE_ORIENTATION)
    except cv2.error as error:
        raise FormatError(f"{path}: the image cannot be decoded ({error.err}).") from None
    if image is None:
        raise FormatError(f"{path}: the image cannot be decoded. Copy or download the file again.")
    return image


def decode_exact(path: str | os.PathLike[str], dtype: type, channels: int, what: str) -> np.ndarray:
    """Decoded image whose dtype and number of channels must be these.

    Raises:
        FormatError: others, or as :func:`decode`. FileNotFoundError: no such file.
    """
    # IMREAD_UNCHANGED is -1: it leaves orientation alone and cannot be combined with other flags
    image = decode(path, cv2.IMREAD_UNCHANGED)
    got = 1 if image.ndim == 2 else image.shape[2]
    if image.dtype != dtype or got != channels:
        raise FormatError(
            f"{path}: expected {what} ({np.dtype(dtype)}, {channels} channels), got {image.dtype} "
            f"with {got} channels."
        )
    return image


def encoded_size(data: bytes, path: object) -> tuple[int, int] | None:
    """(height, width) from the first bytes of a PNG or JPEG; None for any other content.

    Raises:
        FormatError: a damaged header.
    """
    if data[:8] == PNG_MAGIC:
        return _png_header(data, path)[:2]
    if data[:2] == JPEG_MAGIC:
        return _jpeg_header(data, path)[:2]
    return None
