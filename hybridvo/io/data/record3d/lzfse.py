"""How many bytes LZFSE data unpacks to, from the headers of its blocks, before it is unpacked."""

from __future__ import annotations

import struct

from hybridvo.core.errors import FormatError

WORD = struct.Struct("<I")
PAIR = struct.Struct("<II")
COMPRESSED = struct.Struct("<IQQQ")
"""Of a block ``bvx2`` behind its name: bytes unpacked, and three words of packed fields."""
NAME_BYTES = 4
RAW_HEAD_BYTES = 8
LZVN_HEAD_BYTES = 12
COUNT_BITS = (1 << 20) - 1
PAYLOAD_SHIFT = 20
MATCHES_SHIFT = 40
LONGEST_MATCH = 2359
"""Bytes that one match of a block ``bvx2`` may copy."""
POSSIBLE_PER_BYTE = 600
"""Bytes that the matches of honest data could copy at most, for one that they do copy: a match of
four bytes could be of 2359."""


def unpacked_size(data: bytes, limit: int) -> int:
    """Return how many bytes some LZFSE data states to unpack to.

    Args:
        data: Blocks, the last of which is marked as such.
        limit: How many bytes are expected at most.

    Raises:
        FormatError: There are more than ``limit``, or the blocks could write many times as much
            as they state.
        struct.error: The data is cut off.
    """
    place = 0
    total = 0
    possible = 0
    while True:
        name = data[place : place + NAME_BYTES]
        if name == b"bvx$":
            return total
        head = place + NAME_BYTES
        if name == b"bvx-":
            (size,) = WORD.unpack_from(data, head)
            possible += size
            place += RAW_HEAD_BYTES + size
        elif name == b"bvxn":
            size, payload = PAIR.unpack_from(data, head)
            possible += size
            place += LZVN_HEAD_BYTES + payload
        elif name == b"bvx2":
            size, first, second, third = COMPRESSED.unpack_from(data, head)
            literals = first & COUNT_BITS
            matches = first >> MATCHES_SHIFT & COUNT_BITS
            possible += literals + LONGEST_MATCH * matches
            place += third & (1 << 32) - 1
            place += first >> PAYLOAD_SHIFT & COUNT_BITS
            place += second >> MATCHES_SHIFT & COUNT_BITS
        else:
            # "bvx1" has not been written since LZFSE was published
            raise FormatError(f"LZFSE: expected a block, got {name!r}")
        total += size
        if total > limit:
            raise FormatError(
                f"unpacks to {total} bytes or more: expected at most {limit}"
            )
        if possible > POSSIBLE_PER_BYTE * limit:
            raise FormatError("could unpack to far more bytes than it states")
