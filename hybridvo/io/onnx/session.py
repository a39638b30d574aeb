"""Runs ONNX files: by onnxruntime, and by OpenCV where that is missing."""

from __future__ import annotations

import importlib
import logging
import math
from pathlib import Path
from typing import Any, NamedTuple, Protocol

import cv2
import numpy as np

from hybridvo.core.errors import FormatError, InputError

MISSING = "onnxruntime is not installed: pip install 'hybridvo[onnx]'"
ERRORS_ONLY = 3
"""The level of onnxruntime's log at which it prints errors."""
TYPES = {
    "tensor(float)": np.float32,
    "tensor(float16)": np.float16,
    "tensor(double)": np.float64,
    "tensor(int64)": np.int64,
    "tensor(int32)": np.int32,
    "tensor(uint8)": np.uint8,
}
"""Types of inputs by their names in onnxruntime."""
MAX_ELEMENTS = 2**28
"""Of an input or output: the largest image has 25 million."""
SHOWN = 200
"""Characters of a library's message that are shown."""
_logger = logging.getLogger(__name__)


class InputSpec(NamedTuple):
    """What an input takes.

    Attributes:
        shape: number of elements along each axis, None where it is free.
        type: of the elements.
    """

    shape: tuple[int | None, ...]
    type: Any


class Session(Protocol):
    """A network that is loaded.

    Attributes:
        inputs: by name; empty where the runtime does not list them.
        outputs: their names.
    """

    inputs: dict[str, InputSpec]
    outputs: tuple[str, ...]

    def run(self, feeds: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
        """Return every output, by its name.

        Args:
            feeds: an array for each input.

        Raises:
            InputError: an array does not fit.
        """


def open_session(path: str | Path) -> Session:
    """Load a network.

    Args:
        path: an ONNX file.

    Returns:
        The network.

    Raises:
        FormatError: the file is damaged, or of a kind that the runtime does not know.
        InputError: onnxruntime is missing, and OpenCV cannot run this file.

    Example:
        >>> open_session("depth.onnx").outputs  # doctest: +SKIP
        ('predicted_depth',)
    """
    try:
        runtime = importlib.import_module("onnxruntime")
    except ModuleNotFoundError:
        return _OpenCVSession(Path(path))
    except ImportError as error:
        raise InputError(f"onnxruntime cannot be loaded: {error}.") from None
    return _RuntimeSession(runtime, Path(path))


class _RuntimeSession:
    """A network in onnxruntime."""

    def __init__(self, runtime: Any, path: Path) -> None:
        self._path = path
        options = runtime.SessionOptions()
        options.log_severity_level = ERRORS_ONLY
        try:
            self._session = runtime.InferenceSession(
                str(path), options, providers=runtime.get_available_providers()
            )
        # onnxruntime's errors have no common class
        except Exception as error:
            raise FormatError(f"{path}: {_first_line(error)}.") from None
        self.inputs = {
            found.name: InputSpec(_sizes(found.shape), TYPES.get(found.type))
            for found in self._session.get_inputs()
        }
        outputs = self._session.get_outputs()
        for found in (*self._session.get_inputs(), *outputs):
            _check_size(path, found.name, _sizes(found.shape))
        self.outputs = tuple(found.name for found in outputs)

    def run(self, feeds: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
        try:
            arrays = self._session.run(list(self.outputs), feeds)
        except Exception as error:
            raise _does_not_fit(self._path, feeds, error) from None
        return dict(zip(self.outputs, map(np.asarray, arrays), strict=True))


class _OpenCVSession:
    """A network in OpenCV, which does not list the inputs of a file."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self.inputs: dict[str, InputSpec] = {}
        try:
            self._net: Any = cv2.dnn.readNetFromONNX(str(path))
        except cv2.error as error:
            raise InputError(
                f"{path}: {MISSING}. OpenCV cannot run this file: {_first_line(error)}."
            ) from None
        self.outputs = tuple(self._net.getUnconnectedOutLayersNames())
        _logger.warning("%s: %s; OpenCV runs it", path, MISSING)

    def run(self, feeds: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
        try:
            for name, array in feeds.items():
                self._net.setInput(np.ascontiguousarray(array), name)
            arrays = self._net.forward(self.outputs)
        except cv2.error as error:
            raise _does_not_fit(self._path, feeds, error) from None
        return dict(zip(self.outputs, map(np.array, arrays), strict=True))


def _sizes(shape: list[Any]) -> tuple[int | None, ...]:
    """Sizes of axes, None where a file gives a name instead of a number."""
    return tuple(
        size if isinstance(size, int) and size > 0 else None for size in shape
    )


def _check_size(path: Path, name: str, sizes: tuple[int | None, ...]) -> None:
    """Refuse a file of which an input or output is stated to be larger than any map."""
    if math.prod(size or 1 for size in sizes) > MAX_ELEMENTS:
        expected = f"expected at most {MAX_ELEMENTS} elements"
        raise FormatError(f"{path}: '{name}' has the shape {sizes}: {expected}.")


def _does_not_fit(
    path: Path, feeds: dict[str, np.ndarray], error: Exception
) -> InputError:
    """The error of a network that does not take what it was given."""
    given = ", ".join(
        f"{name} {array.dtype} {array.shape}" for name, array in feeds.items()
    )
    remedy = "Compare 'inputs', 'size', 'layout' of its description with the file"
    return InputError(
        f"{path}: the network does not take {given}: {_first_line(error)}. {remedy}."
    )


def _first_line(error: Exception) -> str:
    """What a library reports, short enough for one line."""
    return " ".join(str(error).split())[:SHOWN]
