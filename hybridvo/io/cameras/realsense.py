"""Intel RealSense, by pyrealsense2: depth registered to colour, or infrared stereo as it is."""

from __future__ import annotations

import contextlib
import time
from typing import Any

import numpy as np

from hybridvo.core.errors import InputError
from hybridvo.core.types import Camera
from hybridvo.io.cameras.base import CameraLost, FrameMaker, Reading, load_sdk
from hybridvo.io.cameras.inertial import IMU_RATE_HZ, CameraImu, ImuBuffer
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
        self._motion_sensor: Any = None
        self._imu_is_hardware: bool | None = None

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
        self._imu = CameraImu(lambda: self._start_imu(profile, image))

    def _start_imu(self, profile: Any, image: Any) -> ImuBuffer | None:
        """Start the gyroscope and the accelerometer of a D435i or D455.

        They are taken from their sensor: with images beside them, a pipeline hands out the last
        reading alone.
        """
        if not self._settings.imu:
            return None
        rs = self._rs
        for sensor in profile.get_device().query_sensors():
            gyro = _motion_profile(rs, sensor, rs.stream.gyro)
            if gyro is not None:
                return self._start_motion(sensor, gyro, image)
        return None

    def _start_motion(self, sensor: Any, gyro: Any, image: Any) -> ImuBuffer:
        """Start a sensor of motion."""
        # the SDK states it column by column
        rotation = gyro.get_extrinsics_to(image).rotation
        buffer = ImuBuffer(np.reshape(rotation, (3, 3)).T)
        accel = _motion_profile(self._rs, sensor, self._rs.stream.accel)
        sensor.open([gyro] if accel is None else [gyro, accel])
        self._motion_sensor = sensor
        sensor.start(lambda reading: self._keep(buffer, reading))
        return buffer

    def _keep(self, buffer: ImuBuffer, reading: Any) -> None:
        """Keep a reading, in the SDK's thread."""
        rs = self._rs
        data = reading.as_motion_frame().get_motion_data()
        values = (data.x, data.y, data.z)
        stamp = reading.get_timestamp() / 1000
        if reading.get_profile().stream_type() == rs.stream.gyro:
            buffer.add_rate(stamp, values)
        else:
            buffer.add_acceleration(stamp, values)
        hardware = rs.timestamp_domain.hardware_clock
        self._imu_is_hardware = reading.get_frame_timestamp_domain() == hardware

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
        is_hardware = image.get_frame_timestamp_domain() == hardware
        if not is_hardware:
            age = time.time() - stamp
        if (
            self._imu_is_hardware is not None
            and self._imu_is_hardware != is_hardware
        ):
            self._stop_imu()
            self._imu.leave_out(
                "its clock is not that of the images; global_time_enabled: 1 in a preset "
                "gives both the computer's"
            )
        frame = self._maker.frame(np.array(image.get_data()), metres, stamp)
        reading = Reading(frame, age, image.get_frame_number())
        return self._imu.added_to(reading)

    def _stop_imu(self) -> None:
        """Stop the inertial sensors."""
        self._imu_is_hardware = None
        if self._motion_sensor is not None:
            sensor = self._motion_sensor
            self._motion_sensor = None
            # one that did not start, or is unplugged
            with contextlib.suppress(RuntimeError):
                sensor.stop()
            with contextlib.suppress(RuntimeError):
                sensor.close()

    def close(self) -> None:
        """Stop the streams."""
        self._stop_imu()
        if self._pipeline is not None:
            pipeline = self._pipeline
            self._pipeline = None
            pipeline.stop()


def _motion_profile(rs: Any, sensor: Any, stream: Any) -> Any:
    """The slowest profile of a motion stream that is fast enough; None where there is none."""
    profiles = [
        profile
        for profile in sensor.get_stream_profiles()
        if profile.stream_type() == stream
        and profile.format() == rs.format.motion_xyz32f
    ]
    if not profiles:
        return None
    fast = [profile for profile in profiles if profile.fps() >= IMU_RATE_HZ]
    if fast:
        return min(fast, key=lambda profile: profile.fps())
    return max(profiles, key=lambda profile: profile.fps())
