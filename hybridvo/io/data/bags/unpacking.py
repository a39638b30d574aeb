"""What a bag may cost: limits on what is read, and packed data unpacked within them.

A few kilobytes of zstd, lz4 or bzip2 stand for gigabytes. Their decoders hand out what they have
piece by piece, so that it can be counted while it comes.
"""

from __future__ import annotations

import bz2
import sys
from collections.abc import Callable
from io import BufferedReader, FileIO
from pathlib import Path, PosixPath
from typing import Any

from lz4.frame import LZ4FrameDecompressor

if sys.version_info >= (3, 14):
    from compression.zstd import ZstdDecompressor
else:
    from backports.zstd import ZstdDecompressor

from hybridvo.core.errors import FormatError
from hybridvo.core.files import file_size, unpacked_limit

MAX_CHUNK_BYTES = 2**27
"""Bytes of a chunk, a part of a bag that is packed as a whole. Recorders write 1 to 4 MB."""
MAX_MESSAGE_BYTES = 2**26
"""Bytes of a message: an image of 64 MB has 22 million pixels."""
MAX_CHUNK_MESSAGES = 2**18
"""Messages in a chunk."""
MAX_TOPICS = 2**14
"""Topics of a bag, each once for every node that publishes it."""
MAX_LINE_BYTES = 2**12
"""Bytes of the line with which a file of ROS 1 begins."""
PIECE_BYTES = 2**22
"""Bytes that a decoder hands out at once."""
DECODERS: dict[str, Callable[[], Any]] = {
    "bz2": bz2.BZ2Decompressor,
    "lz4": LZ4FrameDecompressor,
    "zstd": ZstdDecompressor,
}
"""Ways of packing by their names in bags. All have the methods of ``bz2.BZ2Decompressor``."""


class BoundedFile(BufferedReader):
    """A file of which nothing larger than a chunk is read at once, whatever its records state."""

    def read(self, size: int | None = -1, /) -> bytes:
        """Read bytes; a FormatError for more than a chunk may have."""
        count = MAX_CHUNK_BYTES if size is None or size < 0 else size
        if count > MAX_CHUNK_BYTES:
            raise FormatError(
                f"a record states {count} bytes: expected at most {MAX_CHUNK_BYTES}"
            )
        return super().read(count)

    def readline(self, size: int | None = -1, /) -> bytes:
        """Read a line of at most a few thousand bytes."""
        return super().readline(MAX_LINE_BYTES)


class BoundedPath(PosixPath):
    """The path of a file of a bag, which is opened as a :class:`BoundedFile`."""

    def open(self, *_: Any, **__: Any) -> Any:
        """Open the file for reading.

        Raises:
            FormatError: It is a pipe or a device.
        """
        file_size(self)
        return BoundedFile(FileIO(self))


def unpack(data: Any, packing: str, limit: int = MAX_CHUNK_BYTES) -> bytes:
    """Unpack bytes that unpack to a limited number.

    Args:
        data: Packed bytes, of one frame or of several in a row.
        packing: A name in ``DECODERS``; empty or ``none`` for bytes as they are.
        limit: How many bytes may come out.

    Returns:
        The bytes.

    Raises:
        FormatError: There are more, they are cut off, or the packing is not known.
        Exception: What the decoder raises for damaged data.

    Example:
        >>> unpack(bz2.compress(bytes(1000)), "bz2") == bytes(1000)
        True
    """
    if packing in ("", "none"):
        return bytes(data)
    if packing not in DECODERS:
        known = ", ".join(DECODERS)
        raise FormatError(f"packed by '{packing[:40]}': expected one of {known}")
    unpacked = bytearray()
    rest = data
    while rest:
        decoder = DECODERS[packing]()
        while not decoder.eof:
            piece = decoder.decompress(rest, PIECE_BYTES)
            rest = b""
            unpacked += piece
            if len(unpacked) > limit:
                raise FormatError(
                    f"packed data unpacks to more than {limit} bytes: expected at most as many"
                )
            if not piece and decoder.needs_input:
                raise FormatError("packed data is cut off")
        rest = decoder.unused_data
    return bytes(unpacked)


def unpack_file(packed: Path, target: Path) -> None:
    """Unpack a file that zstd packed as a whole, into another file.

    Raises:
        FormatError: It is damaged, or unpacks to more than a recording does.
        OSError: It cannot be written.
    """
    limit = unpacked_limit(file_size(packed))
    count = 0
    with BoundedPath(packed).open() as source, target.open("wb") as file:
        decoder = ZstdDecompressor()
        while True:
            if decoder.eof:
                rest = decoder.unused_data
                if not rest and not source.peek(1):
                    return
                decoder = ZstdDecompressor()
            else:
                rest = source.read(PIECE_BYTES) if decoder.needs_input else b""
                if not rest and decoder.needs_input:
                    raise FormatError(f"{packed}: packed data is cut off.")
            piece = decoder.decompress(rest, PIECE_BYTES)
            count += len(piece)
            if count > limit:
                raise FormatError(
                    f"{packed}: unpacks to more than {limit} bytes, more than a recording does. "
                    "If you know where it comes from, unpack it by 'zstd -d' and name the file."
                )
            file.write(piece)
