"""Intel RealSense, by pyrealsense2: depth registered to colour, or infrared stereo as it is."""

from __future__ import annotations

import time
from typing import Any

import numpy as np

from hybridvo.core.errors import InputError
from hybridvo.core.types import Camera
from hybridvo.io.cameras.base import CameraLost, FrameMaker, Reading, load_sdk
from hybridvo.io.cameras.settings import CameraSettings
from hybridvo.io.data.streams import Lens


class RealSenseCamera:
    """A RealSense of the D400 series.

    Args:
        settings: what to request of it. With ``image="infrared"`` the left infrared image takes the
            place of colour: depth is measured in its pixels, and its shutter is global; switch
            the projector off (``emitter_enabled: 0``), whose dots move with the camera.
        device: a device of the SDK; by default the first one, or that of ``settings.serial``.

    Raises:
        InputError: pyrealsense2 is not installed, or an option is unknown.

    Example:
        >>> camera = RealSenseCamera(read_preset("d435"))  # doctest: +SKIP
    """

    name = "realsense"

    def __init__(
        self, settings: CameraSettings | None = None, device: Any = None
    ) -> None:
        self._rs = load_sdk("pyrealsense2", "realsense")
        self._settings = settings or CameraSettings(driver="realsense")
        self.fps = float(self._settings.fps)
        for option in self._settings.options:
            if not hasattr(self._rs.option, option):
                raise InputError(f"realsense: no option is called {option!r}.")
        self._device = device
        self._pipeline: Any = None

    def open(self) -> None:
        """Start the streams."""
        rs = self._rs
        settings = self._settings
        config = rs.config()
        pipeline = rs.pipeline()
        if self._device is not None:
            pipeline.set_device(self._device)
        elif not rs.context().query_devices().size():
            # start would wait for one, for a quarter of a minute
            raise CameraLost("no device connected")
        if settings.serial:
            config.enable_device(settings.serial)
        depth_size = settings.depth_size
        config.enable_stream(
            rs.stream.depth, *depth_size, rs.format.z16, settings.fps
        )
        self._is_color = settings.image == "color"
        if self._is_color:
            stream = rs.stream.color
            config.enable_stream(
                stream, *settings.size, rs.format.rgb8, settings.fps
            )
        else:
            # the left one, in whose pixels depth is measured
            stream = rs.stream.infrared
            config.enable_stream(stream, 1, *depth_size, rs.format.y8, settings.fps)
        profile = pipeline.start(config)
        self._pipeline = pipeline
        self._align = rs.align(stream) if self._is_color else None
        image = profile.get_stream(stream, 0 if self._is_color else 1)
        self._maker = FrameMaker(self._lens(image), settings)
        for sensor in profile.get_device().query_sensors():
            for name, value in settings.options.items():
                option = getattr(rs.option, name)
                if sensor.supports(option):
                    sensor.set_option(option, value)

    def _lens(self, profile: Any) -> Lens:
        """The intrinsics that the camera states of a stream."""
        found = profile.as_video_stream_profile().get_intrinsics()
        camera = Camera(
            fx=found.fx,
            fy=found.fy,
            cx=found.ppx,
            cy=found.ppy,
            height=found.height,
            width=found.width,
        )
        return Lens(camera, tuple(found.coeffs), found.model.name.replace("_", " "))

    def read(self, timeout_s: float) -> Reading | None:
        """Wait for the next pair of image and depth."""
        came, frames = self._pipeline.try_wait_for_frames(int(1000 * timeout_s))
        if not came:
            return None
        if self._align is not None:
            frames = self._align.process(frames)
            image = frames.get_color_frame()
        else:
            image = frames.get_infrared_frame(1)
        if not image:
            return Reading(None, note="a frame without image")
        depth = frames.get_depth_frame()
        metres = None
        if depth:
            units = np.float32(depth.get_units())
            metres = np.asanyarray(depth.get_data()) * units
        stamp = image.get_timestamp() / 1000
        age = 0.0
        # the other clocks are the computer's
        hardware = self._rs.timestamp_domain.hardware_clock
        if image.get_frame_timestamp_domain() != hardware:
            age = time.time() - stamp
        frame = self._maker.frame(np.array(image.get_data()), metres, stamp)
        return Reading(frame, age, image.get_frame_number())

    def close(self) -> None:
        """Stop the streams."""
        if self._pipeline is not None:
            pipeline = self._pipeline
            self._pipeline = None
            pipeline.stop()
