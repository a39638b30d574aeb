"""Messages between the process of a run and the child that reads for it.

A message is a JSON object, and arrays as bytes behind it. Nothing in it can run code: what a
child sends is checked as if a stranger had sent it.
"""

from __future__ import annotations

import json
import math
import os
import struct
from collections.abc import Callable, Mapping
from multiprocessing.connection import Connection
from typing import Any

import numpy as np

from hybridvo.core.errors import FormatError

LENGTHS = struct.Struct("<QQ")
"""Bytes of the JSON object, and of the arrays."""
MAX_MESSAGE = 2**29
"""Bytes: two million frames with their poses."""
POLL_S = 1.0
"""Seconds between two looks at a child from which nothing comes."""
DTYPES = ("|u1", "|b1", "<f4", "<f8")
"""Types of numbers in arrays."""


def send(
    connection: Connection,
    message: Mapping[str, Any],
    arrays: Mapping[str, np.ndarray] | None = None,
) -> None:
    """Send a message.

    Args:
        connection: To the other process.
        message: JSON-ready.
        arrays: By name, of any shape.

    Raises:
        OSError: The other process is gone.
    """
    arrays = arrays or {}
    forms = {name: form_of(array) for name, array in arrays.items()}
    text = json.dumps({**message, "arrays": forms}).encode("ascii")
    content = b"".join(array.tobytes() for array in arrays.values())
    data = memoryview(LENGTHS.pack(len(text), len(content)) + text + content)
    while data:
        data = data[os.write(connection.fileno(), data) :]


def receive(
    connection: Connection, still_waiting: Callable[[], None] | None = None
) -> tuple[dict[str, Any], dict[str, np.ndarray]]:
    """Wait for a message.

    Args:
        connection: To the other process.
        still_waiting: Called every second; ends the waiting by an exception.

    Returns:
        The message, and its arrays by name.

    Raises:
        EOFError: The other process is gone.
        FormatError: It sent something else.
    """
    lengths = LENGTHS.unpack(_read(connection, LENGTHS.size, still_waiting))
    if sum(lengths) > MAX_MESSAGE:
        raise FormatError(f"a message of {sum(lengths)} bytes is too long.")
    text = _read(connection, lengths[0], still_waiting)
    content = _read(connection, lengths[1], still_waiting)
    try:
        message = json.loads(text)
    except (ValueError, RecursionError):
        message = None
    if not isinstance(message, dict):
        raise FormatError("a message is no JSON object.")
    arrays = {}
    place = 0
    for name, form in dict(message.pop("arrays", {})).items():
        arrays[name] = array_at(content, place, form)
        place += arrays[name].nbytes
    return message, arrays


def _read(
    connection: Connection, count: int, still_waiting: Callable[[], None] | None
) -> bytearray:
    """Read so many bytes."""
    data = bytearray()
    while len(data) < count:
        while still_waiting is not None and not connection.poll(POLL_S):
            still_waiting()
        part = os.read(connection.fileno(), min(count - len(data), MAX_MESSAGE))
        if not part:
            raise EOFError
        data += part
    return data


def form_of(array: np.ndarray) -> list[Any]:
    """Return type and shape of an array, JSON-ready."""
    return [array.dtype.str, list(array.shape)]


def array_at(memory: Any, place: int, form: Any) -> np.ndarray:
    """Return the array at a place of some memory, which it shares.

    Args:
        memory: Bytes.
        place: Where it begins.
        form: As :func:`form_of` has it.

    Raises:
        FormatError: There can be no such array.
    """
    is_form = isinstance(form, list) and len(form) == 2 and form[0] in DTYPES
    shape: Any = form[1] if is_form else None
    is_shape = isinstance(shape, list) and all(
        type(length) is int and length >= 0 for length in shape
    )
    if not is_shape:
        raise FormatError(f"no such array: {str(form)[:80]}.")
    dtype = np.dtype(form[0])
    count = math.prod(shape)
    if place < 0 or place + count * dtype.itemsize > len(memory):
        raise FormatError(f"an array {str(form)[:80]} is larger than its memory.")
    return np.frombuffer(memory, dtype, count, place).reshape(shape)
