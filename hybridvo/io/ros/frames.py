"""Messages with images into frames."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from hybridvo.core.errors import FormatError
from hybridvo.core.types import Camera, Frame
from hybridvo.io.data.bags import messages as ros
from hybridvo.io.data.bags.topics import is_rectified
from hybridvo.io.data.sequence import UndistortionMaps, undistort
from hybridvo.io.data.streams import Lens, units_per_metre
from hybridvo.io.ros.parameters import NodeOptions


def stamp_ns(message: Any) -> int:
    """Return the stamp of a message's header, ns."""
    return ros.time_ns(message.header.stamp)


class FrameReader:
    """Makes frames of messages: without the lens' distortion, depth in metres.

    Args:
        options: Which topics the messages are of, and the unit of depth.
    """

    def __init__(self, options: NodeOptions) -> None:
        self._options = options
        self._lens: Lens | None = None
        self._maps: UndistortionMaps | None = None
        self._units = units_per_metre(options.depth_scale, 1.0, [])

    def frame(self, rgb: Any, depth: Any, info: Any) -> Frame:
        """Make a frame.

        Args:
            rgb: An ``Image`` or ``CompressedImage``.
            depth: Another one, of depth that is registered to colour.
            info: The ``CameraInfo`` of colour.

        Returns:
            The frame, with the stamp of colour, s.

        Raises:
            FormatError: A message is of a kind that is not read, or they do not fit together.
        """
        camera = self._camera_of(info)
        image = ros.colour_image(rgb)
        metres = self._metres(ros.depth_image(depth))
        for what, shape in (("colour", image.shape[:2]), ("depth", metres.shape)):
            if shape != camera.shape:
                raise FormatError(
                    f"{what} is {shape[1]}x{shape[0]} pixels, the camera {camera.width}x"
                    f"{camera.height}: {self._options.info} must belong to "
                    f"{self._options.topic_rgb}, and depth be registered to it (RealSense: "
                    "align_depth.enable, topic aligned_depth_to_color)."
                )
        mask = None
        straight: np.ndarray | None = image
        straight_depth: np.ndarray | None = metres
        if self._maps is not None:
            straight, straight_depth, mask = undistort(
                self._maps, image, metres, None
            )
        return Frame(
            straight, straight_depth, camera, stamp_ns(rgb) / 1e9, mask=mask
        )

    def _camera_of(self, info: Any) -> Camera:
        """The camera of the images without distortion; its maps are kept while it is the same."""
        said = ros.camera_info(info, self._options.info)
        lens = said.lens
        if is_rectified(self._options.topic_rgb):
            lens = Lens(said.rectified)
        if lens != self._lens:
            self._maps = None if lens.is_straight else lens.maps()
            self._lens = lens
        # no message states them
        return replace(
            lens.camera,
            readout_ms=self._options.readout_ms,
            depth_lag_ms=self._options.depth_lag_ms,
        )

    def _metres(self, stored: np.ndarray) -> np.ndarray:
        """Depth (H, W) float32, 0 or NaN where it is unknown."""
        if stored.dtype == np.float32:
            return stored
        metres = stored.astype(np.float32) / np.float32(self._units)
        metres[stored == np.iinfo(stored.dtype).max] = 0.0
        return metres
