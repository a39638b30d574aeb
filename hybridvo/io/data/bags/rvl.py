"""RVL, the run-length code of depth of A. Wilson (2017), as ROS' ``compressedDepth`` uses it."""

from __future__ import annotations

import struct

import numpy as np

from hybridvo.compiled.numba_tools import as_contiguous, njit
from hybridvo.core.errors import FormatError
from hybridvo.io.data.image_io import MAX_IMAGE_PIXELS

SIZE = struct.Struct("<ii")  # columns and rows, before the code


def decode_rvl(data: bytes, where: str) -> np.ndarray:
    """Return depth (H, W) uint16 of columns, rows and the code itself.

    Raises:
        FormatError: The code ends before the image is full, or runs beyond it.
    """
    if len(data) < SIZE.size:
        raise FormatError(f"{where}: {len(data)} bytes are too few.")
    width, height = SIZE.unpack_from(data)
    if width <= 0 or height <= 0 or width * height > MAX_IMAGE_PIXELS:
        raise FormatError(f"{where}: declares {width}x{height} pixels.")
    body = data[SIZE.size :]
    # a run of any length takes a few bytes: only what follows decides whether they fit
    words = np.frombuffer(body[: len(body) // 4 * 4], "<u4")
    depth = np.zeros(width * height, np.uint16)
    count = _decode(as_contiguous(words, np.uint32), depth)
    if count < len(depth):
        raise FormatError(f"{where}: damaged: {count} of {len(depth)} pixels.")
    return depth.reshape(height, width)


@njit(nogil=True)
def _next_value(words, position):
    """Decode a number from its nibbles; returns it and the next position, negative at the end.

    Of each nibble three bits belong to the number, the lowest first; the fourth states that more
    nibbles follow. A word holds eight nibbles, the first in its highest bits.
    """
    value = np.int64(0)
    for bits in range(0, 33, 3):
        if position >= 8 * len(words):
            return value, -1
        shift = 28 - 4 * (position % 8)
        nibble = (np.int64(words[position // 8]) >> shift) & 15
        position += 1
        value |= (nibble & 7) << bits
        if nibble < 8:
            return value, position
    return value, -1


@njit(nogil=True)
def _decode(words, depth):
    """Fill ``depth``: runs of zeros and of differences in turn; returns how many pixels fitted."""
    position = 0
    pixel = 0
    previous = np.int64(0)
    while pixel < len(depth):
        zeros, position = _next_value(words, position)
        if position < 0:
            return pixel
        if zeros > len(depth) - pixel:
            return pixel
        pixel += zeros
        if pixel == len(depth):
            return pixel
        others, position = _next_value(words, position)
        if position < 0:
            return pixel
        if others > len(depth) - pixel or zeros + others == 0:
            return pixel
        for _ in range(others):
            coded, position = _next_value(words, position)
            if position < 0:
                return pixel
            # the sign stands in the lowest bit
            previous += (coded >> 1) ^ -(coded & 1)
            depth[pixel] = previous & 0xFFFF
            pixel += 1
    return pixel
