"""Colour and depth of two cameras, brought onto the pixels of one image."""

from __future__ import annotations

import cv2
import numpy as np

from hybridvo.core.types import Camera
from hybridvo.io.data.registration import register_depth
from hybridvo.io.data.resize import resize_camera
from hybridvo.io.data.sequence import UndistortionMaps, undistort
from hybridvo.io.data.streams import FrameImages, Lens


class TwoCameras:
    """A camera of colour and one of depth, whose images become one frame.

    Frames look from the place of the colour camera, without distortion. Where colour has several
    times the resolution of depth, its images are made smaller by a whole factor: what lies between
    the pixels of depth has no depth.

    Args:
        colour: The camera of colour, as it takes images.
        depth: The camera of depth, likewise.
        T_colour_depth: (4, 4) maps points of the depth camera into the colour camera, metres.

    Attributes:
        camera: The pinhole camera of the frames.

    Example:
        >>> import numpy as np
        >>> colour = Lens(Camera(1000.0, 1000.0, 639.5, 479.5, height=960, width=1280))
        >>> depth = Lens(Camera(500.0, 500.0, 319.5, 239.5, height=480, width=640))
        >>> TwoCameras(colour, depth, np.eye(4)).camera.shape
        (480, 640)
    """

    def __init__(
        self, colour: Lens, depth: Lens, T_colour_depth: np.ndarray
    ) -> None:
        self.camera = _smaller(colour.camera, depth.camera)
        self._taken = colour
        self._depth_camera = depth.camera
        self._T = T_colour_depth
        self._colour_maps = _maps(
            Lens(self.camera, colour.distortion, colour.model)
        )
        self._depth_maps = _maps(depth)
        is_one = np.allclose(T_colour_depth, np.eye(4))
        self._is_registered = is_one and depth.camera == self.camera

    def images(
        self, rgb: np.ndarray | None, depth: np.ndarray | None
    ) -> FrameImages:
        """Return the images of a frame.

        Args:
            rgb: (H, W, 3) uint8 as the colour camera takes it, or None.
            depth: (h, w) float32 metres as the depth camera takes it, or None.

        Returns:
            Both on the pixels of ``camera``, with a mask where the lens of colour sees less.
        """
        mask = None
        if rgb is not None:
            rgb = self._resized(rgb)
        if rgb is not None and self._colour_maps is not None:
            rgb, _, mask = undistort(self._colour_maps, rgb, None, None)
        if depth is not None and self._depth_maps is not None:
            _, depth, _ = undistort(self._depth_maps, None, depth, None)
        if depth is not None and not self._is_registered:
            depth = register_depth(depth, self._depth_camera, self._T, self.camera)
        return FrameImages(rgb, depth, mask=mask)

    def _resized(self, rgb: np.ndarray) -> np.ndarray:
        if rgb.shape[:2] == self.camera.shape:
            return rgb
        size = (self.camera.width, self.camera.height)
        return cv2.resize(rgb, size, interpolation=cv2.INTER_AREA)


def _smaller(colour: Camera, depth: Camera) -> Camera:
    """Return the camera of colour at about the resolution of depth."""
    factor = max(1, round(colour.fx / depth.fx))
    height = max(1, colour.height // factor)
    width = max(1, colour.width // factor)
    return resize_camera(colour, height, width)


def _maps(lens: Lens) -> UndistortionMaps | None:
    """Return the way out of the distortion of a lens; None where there is none."""
    return None if lens.is_straight else lens.maps()
