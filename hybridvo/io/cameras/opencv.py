"""Kinect v1 and v2, Xtion and first Astras, by OpenCV's OpenNI."""

from __future__ import annotations

import time
from typing import Any

import cv2
import numpy as np

from hybridvo.core.errors import InputError
from hybridvo.core.pages import page
from hybridvo.core.types import Camera
from hybridvo.io.cameras.base import CameraLost, FrameMaker, Reading
from hybridvo.io.cameras.settings import CameraSettings
from hybridvo.io.data.streams import Lens


class OpenCVCamera:
    """A depth camera that OpenCV opens by OpenNI 2.

    Frames have the time of their arrival, for OpenNI states no other that OpenCV hands on.

    Args:
        settings: what to request of it. ``options`` are OpenCV's properties, as
            ``CAP_PROP_OPENNI2_MIRROR``. Without ``intrinsics``, the focal length is the one that
            OpenNI states, and the centre that of the image.
        index: which camera.

    Raises:
        InputError: this OpenCV was built without OpenNI, or an option is unknown.

    Example:
        >>> camera = OpenCVCamera(read_preset("kinect_v1"))  # doctest: +SKIP
    """

    name = "opencv"

    def __init__(
        self, settings: CameraSettings | None = None, index: int = 0
    ) -> None:
        self._settings = settings or CameraSettings(driver="opencv")
        self.fps = float(self._settings.fps)
        self._index = index
        self._capture: Any = None
        if not cv2.videoio_registry.hasBackend(cv2.CAP_OPENNI2):
            problem = f"OpenCV {cv2.__version__} was built without OpenNI 2"
            raise InputError(
                f"camera opencv: {problem}, as all of pip are; see {page('live')}."
            )
        for option in self._settings.options:
            if not option.startswith("CAP_PROP_") or not hasattr(cv2, option):
                raise InputError(f"opencv: no option is called {option!r}.")

    def open(self) -> None:
        """Open the device and register its depth to its image."""
        capture = cv2.VideoCapture(self._index, cv2.CAP_OPENNI2)
        if not capture.isOpened():
            raise CameraLost(f"OpenNI has no device {self._index}")
        self._capture = capture
        capture.set(cv2.CAP_OPENNI_DEPTH_GENERATOR_REGISTRATION, 1)
        capture.set(cv2.CAP_PROP_OPENNI2_SYNC, 1)
        for name, value in self._settings.options.items():
            capture.set(getattr(cv2, name), value)
        self._maker: FrameMaker | None = None

    def read(self, timeout_s: float) -> Reading | None:
        """Wait for the next pair of image and depth, as long as OpenNI does."""
        capture = self._capture
        if not capture.grab():
            raise CameraLost("OpenNI gives no frames")
        stamp = time.time()
        has_image, bgr = capture.retrieve(flag=cv2.CAP_OPENNI_BGR_IMAGE)
        has_depth, stored = capture.retrieve(flag=cv2.CAP_OPENNI_DEPTH_MAP)
        if not has_image:
            return Reading(None, note="a frame without image")
        if self._maker is None:
            self._maker = FrameMaker(self._lens(bgr.shape), self._settings)
        metres = np.asarray(stored, np.float32) / 1000 if has_depth else None
        rgb = np.ascontiguousarray(bgr[:, :, ::-1])
        return Reading(self._maker.frame(rgb, metres, stamp))

    def _lens(self, shape: tuple[int, ...]) -> Lens:
        """The intrinsics of the settings, else those of an ideal camera."""
        height, width = shape[:2]
        given = self._settings.intrinsics
        if given is not None and (width, height) != self._settings.size:
            expected = "x".join(map(str, self._settings.size))
            raise InputError(
                f"opencv: expected images of {expected}, to which the intrinsics belong, "
                f"got {width}x{height}."
            )
        if given is None:
            focal = self._capture.get(cv2.CAP_OPENNI_DEPTH_GENERATOR_FOCAL_LENGTH)
            given = (focal, focal, (width - 1) / 2, (height - 1) / 2)
        return Lens(Camera(*given, height=height, width=width))

    def close(self) -> None:
        """Let the device go."""
        if self._capture is not None:
            self._capture.release()
            self._capture = None
