"""What a child does: it opens one recording and reads its frames on request, or reports on it."""

from __future__ import annotations

import importlib
import mmap
import os
from collections.abc import Iterator
from dataclasses import asdict
from multiprocessing import reduction
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from hybridvo.core.errors import FormatError, InputError
from hybridvo.core.types import Camera, Frame
from hybridvo.io.data.confined.limits import Limits, allow_one_request, apply_limits
from hybridvo.io.data.confined.syscalls import refuse_network_and_programs
from hybridvo.io.data.confined.wire import form_of, receive, send
from hybridvo.io.data.sequence import Sequence

STATED = ("kind", "name", "warnings", "assumed", "height", "width")
"""Attributes of a sequence that are sent as they are."""
SOURCES = ("depth_source", "flow_is_true", "depth_scale", "frames_per_second")
"""Attributes of its class, likewise."""
FILES = ("rgb_files", "depth_files", "flow_files", "mask_files")
"""Lists of paths."""
ARRAYS = (
    *("timestamps", "depth_timestamps", "poses"),
    *("imu_samples", "R_cam_imu", "T_cam_frame"),
)
"""Arrays of numbers, or None."""
IMAGES = ("rgb", "depth", "depth_variance", "mask")
"""What a frame is made of."""
ALIGNMENT = 64
"""Bytes between the places at which an image may begin."""
PIXEL_BYTES = 24
"""Of all images of a frame: 3 of colour, 8 of depth, 8 of its variance, one of the mask."""


def serve(connection: Connection) -> None:
    """Answer requests until the other end closes.

    Args:
        connection: To the process of the run.
    """
    cv2.setNumThreads(1)
    request, _ = receive(connection)
    limits = Limits(**request["limits"])
    apply_limits(limits)
    # where the system cannot, the other limits hold: SECURITY.md
    refuse_network_and_programs()
    allow_one_request(limits)
    try:
        if request["do"] == "report":
            send(connection, {"report": report(request)})
            return
        sequence = opened(request)
        message, arrays = description(sequence)
    except Exception as error:
        send(connection, {"failure": failure(error)})
        return
    send(connection, message, arrays)
    handle = reduction.recv_handle(connection)
    memory = mmap.mmap(handle, 0)
    os.close(handle)
    while True:
        request, _ = receive(connection)
        allow_one_request(limits)
        try:
            answer = _answer(sequence, request, memory)
        except Exception as error:
            answer = {"failure": failure(error)}
        send(connection, answer)


def _answer(
    sequence: Sequence, request: dict[str, Any], memory: mmap.mmap
) -> dict[str, Any]:
    """Do what is requested."""
    if request["do"] == "files":
        return {"files": [str(path) for path in sequence.files()]}
    frame = sequence.frame(request["index"])
    return {"images": put(frame, memory)}


def put(frame: Frame, memory: mmap.mmap) -> dict[str, list[Any]]:
    """Write the images of a frame into the shared memory.

    Returns:
        Of each its form and its place.
    """
    places = {}
    place = 0
    for name in IMAGES:
        image = getattr(frame, name)
        if image is None:
            continue
        shared = np.frombuffer(memory, image.dtype, image.size, place)
        shared.reshape(image.shape)[...] = image
        places[name] = [form_of(image), place]
        place += -(-image.nbytes // ALIGNMENT) * ALIGNMENT
    return places


def memory_bytes(height: int, width: int) -> int:
    """Return the bytes that the images of a frame take at most."""
    return PIXEL_BYTES * height * width + len(IMAGES) * ALIGNMENT


def report(request: dict[str, Any]) -> Any:
    """Return what the function that a request names states of a recording."""
    module = importlib.import_module(request["module"])
    return getattr(module, request["function"])(Path(request["root"]))


def opened(request: dict[str, Any]) -> Sequence:
    """Open the sequence that a request names."""
    module = importlib.import_module(request["module"])
    reader = getattr(module, request["reader"])
    mask = request["mask"]
    sequence: Sequence = reader(
        Path(request["root"]),
        given_camera(request["camera"]),
        request["depth_scale"],
        None if mask is None else Path(mask),
        needs_depth=request["needs_depth"],
        **request["chosen"],
    )
    return sequence


def camera_message(camera: str | Path | Camera | None) -> Any:
    """Return a camera as the user gave it, JSON-ready."""
    if isinstance(camera, Camera):
        return asdict(camera)
    return [str(camera)] if isinstance(camera, Path) else camera


def given_camera(message: Any) -> str | Path | Camera | None:
    """Return a camera as the user gave it, from :func:`camera_message`."""
    if isinstance(message, dict):
        return Camera(**message)
    if isinstance(message, list):
        return Path(message[0])
    return None if message is None else str(message)


def description(
    sequence: Sequence,
) -> tuple[dict[str, Any], dict[str, np.ndarray]]:
    """Return what is known of a sequence without its frames: JSON-ready, and as arrays."""
    message = {name: getattr(sequence, name) for name in (*STATED, *SOURCES)}
    for name in FILES:
        paths = getattr(sequence, name)
        message[name] = [None if path is None else str(path) for path in paths]
    topics = getattr(sequence, "topics", None)
    is_one_camera = type(sequence).camera is Sequence.camera
    count = 1 if is_one_camera else len(sequence)
    message |= {
        "topics": None if topics is None else topics._asdict(),
        "chosen": getattr(sequence, "chosen", {}),
        "cameras": [asdict(sequence.camera(index)) for index in range(count)],
        "opened_with": sequence.opened_with(),
    }
    arrays = {
        name: np.ascontiguousarray(getattr(sequence, name), np.float64)
        for name in ARRAYS
        if getattr(sequence, name) is not None
    }
    return message, arrays


# -- errors ------------------------------------------------------------------------------


def failure(error: Exception) -> dict[str, Any]:
    """Describe an exception, JSON-ready."""
    if any(_is_of_memory(each) for each in _causes(error)):
        text = str(error) if isinstance(error, InputError) else ""
        return {"type": "memory", "text": text}
    if isinstance(error, InputError):
        kind = FormatError if isinstance(error, FormatError) else InputError
        return {"type": kind.__name__, "text": str(error)}
    if isinstance(error, OSError):
        text = "" if error.errno else str(error)
        return {
            "type": "OSError",
            "text": text,
            "number": error.errno,
            "reason": error.strerror,
            "file": None if error.filename is None else str(error.filename),
        }
    if isinstance(error, IndexError):
        return {"type": "IndexError", "text": str(error)}
    return {"type": "unexpected", "text": f"{type(error).__name__}: {error}"}


def _causes(error: BaseException | None) -> Iterator[BaseException]:
    """Yield an exception and those during which it was raised."""
    while error is not None:
        yield error
        error = error.__cause__ or error.__context__


def _is_of_memory(error: BaseException) -> bool:
    """Return whether there was no memory left."""
    # SQLite and OpenCV have errors of their own
    is_other = type(error).__name__ == "NoMemError" or "Insufficient memory" in str(
        error
    )
    return isinstance(error, MemoryError) or is_other
