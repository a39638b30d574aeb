"""Images on their way into a network, and its maps on their way back to the camera's pixels."""

from __future__ import annotations

from typing import NamedTuple

import cv2
import numpy as np

from hybridvo.core.errors import InputError
from hybridvo.core.types import Camera
from hybridvo.io.onnx.description import NetworkDescription
from hybridvo.io.onnx.session import InputSpec

HEIGHT_AXIS = {"nchw": -2, "nhwc": -3, "nvchw": -2}
"""The axis of the rows of an image, by layout; the columns follow it."""
MAX_PIXELS = 2**23
"""Pixels of an image that a network takes, or gives: one of 4K has 8.3 million."""


class Placement(NamedTuple):
    """Where a camera's image lies in that of a network.

    Attributes:
        image: (rows, columns) of the camera's image.
        network: (rows, columns) of the network's.
        inside: (rows, columns) that the camera's image takes there.
        corner: (row, column) of its first pixel there.
    """

    image: tuple[int, int]
    network: tuple[int, int]
    inside: tuple[int, int]
    corner: tuple[int, int]

    @property
    def scale(self) -> tuple[float, float]:
        """Pixels of the network in one of the camera, along columns u and rows v."""
        along_u = self.inside[1] / self.image[1]
        along_v = self.inside[0] / self.image[0]
        return along_u, along_v

    def camera(self, camera: Camera) -> Camera:
        """Return the camera of the network's image."""
        along_u, along_v = self.scale
        top, left = self.corner
        # pixel (0, 0) is a centre
        cx = along_u * (camera.cx + 0.5) - 0.5 + left
        cy = along_v * (camera.cy + 0.5) - 0.5 + top
        return Camera(
            along_u * camera.fx,
            along_v * camera.fy,
            cx,
            cy,
            height=self.network[0],
            width=self.network[1],
        )

    def crop(self, image: np.ndarray) -> np.ndarray:
        """Return the part of a network's map (h, w, ...) that shows the camera's image."""
        if image.shape[:2] != self.network:
            size = self.network[::-1]
            image = cv2.resize(image, size, interpolation=cv2.INTER_LINEAR)
        top, left = self.corner
        bottom = top + self.inside[0]
        return image[top:bottom, left : left + self.inside[1]]

    def back(self, image: np.ndarray) -> np.ndarray:
        """Return a network's map (h, w, ...) on the camera's pixels, interpolated linearly."""
        part = np.ascontiguousarray(self.crop(image), np.float32)
        if part.shape[:2] == self.image:
            return part
        size = self.image[::-1]
        return np.asarray(cv2.resize(part, size, interpolation=cv2.INTER_LINEAR))


def place(
    image: tuple[int, int], what: NetworkDescription, spec: InputSpec | None
) -> Placement:
    """Find where an image lies in a network's.

    Args:
        image: its rows and columns.
        what: the description of the network.
        spec: the input that takes the image, where it is known.

    Raises:
        InputError: the network's image would be too large.
    """
    network = what.size or _fixed_size(what, spec) or _free_size(image, what)
    if network[0] * network[1] > MAX_PIXELS:
        raise InputError(
            f"the network takes images of {network[1]}x{network[0]} pixels, as it or its "
            f"description states: expected at most {MAX_PIXELS} pixels."
        )
    if what.fit == "stretch":
        return Placement(image, network, network, (0, 0))
    scale = min(network[0] / image[0], network[1] / image[1])
    rows = min(network[0], max(1, round(scale * image[0])))
    columns = min(network[1], max(1, round(scale * image[1])))
    corner = ((network[0] - rows) // 2, (network[1] - columns) // 2)
    return Placement(image, network, (rows, columns), corner)


def _fixed_size(
    what: NetworkDescription, spec: InputSpec | None
) -> tuple[int, int] | None:
    """Rows and columns that a file demands, or None."""
    first = HEIGHT_AXIS[what.layout]
    if spec is None or len(spec.shape) < -first:
        return None
    rows = spec.shape[first]
    columns = spec.shape[first + 1]
    return None if rows is None or columns is None else (rows, columns)


def _free_size(image: tuple[int, int], what: NetworkDescription) -> tuple[int, int]:
    """The size of the image, or with the longest side that is wanted, in whole multiples."""
    scale = 1.0 if what.longest is None else what.longest / max(image)
    step = what.multiple_of
    rows = max(1, round(scale * image[0] / step))
    columns = max(1, round(scale * image[1] / step))
    return step * rows, step * columns


def tensor(
    rgb: np.ndarray, where: Placement, what: NetworkDescription
) -> np.ndarray:
    """Make what a network takes of an image.

    Args:
        rgb: (H, W, 3) uint8, red first.
        where: where it lies in the network's image.
        what: the description of the network.

    Returns:
        float32, with the axes of ``what.layout``.
    """
    ordered = rgb if what.channels == "rgb" else rgb[..., ::-1]
    pixels = ordered.astype(np.float32)
    rows, columns = where.inside
    if where.inside != where.image:
        shrinks = rows < where.image[0]
        method = cv2.INTER_AREA if shrinks else cv2.INTER_LINEAR
        small = cv2.resize(pixels, (columns, rows), interpolation=method)
        pixels = np.asarray(small, np.float32)
    padded = np.empty((*where.network, 3), np.float32)
    padded[:] = what.padding
    top, left = where.corner
    padded[top : top + rows, left : left + columns] = pixels
    mean = np.array(what.mean, np.float32)
    std = np.array(what.std, np.float32)
    normal = (padded - mean) / std
    if what.layout == "nhwc":
        return normal[None]
    planes = np.ascontiguousarray(normal.transpose(2, 0, 1))
    return planes[None] if what.layout == "nchw" else planes[None, None]


def channels_last(
    array: np.ndarray, what: NetworkDescription, where: str
) -> np.ndarray:
    """Return a network's map as (h, w, channels) float32.

    Args:
        array: (h, w), or with channels, and any number of axes of one element before.
        what: the description of the network.
        where: the file, for messages.

    Raises:
        InputError: it is no map.
    """
    shape = array.shape
    while array.ndim > 2 and array.shape[0] == 1:
        array = array[0]
    if array.ndim == 2:
        array = array[..., None]
    elif array.ndim == 3 and what.output_layout == "nchw":
        array = array.transpose(1, 2, 0)
    if array.ndim != 3 or not array.size:
        raise InputError(
            f"{where}: the output has shape {shape}: expected one map, as (1, 1, rows, columns). "
            "Name another one as 'output' in its description."
        )
    return np.ascontiguousarray(array, np.float32)
