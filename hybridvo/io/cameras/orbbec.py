"""Orbbec Femto, Gemini and Astra 2, by pyorbbecsdk2: depth registered to colour."""

from __future__ import annotations

import contextlib
import time
from typing import Any

import numpy as np

from hybridvo.core.errors import InputError
from hybridvo.core.types import Camera
from hybridvo.io.cameras.base import CameraLost, FrameMaker, Reading, load_sdk
from hybridvo.io.cameras.inertial import CameraImu, ImuBuffer
from hybridvo.io.cameras.settings import CameraSettings
from hybridvo.io.data.streams import Lens

MICROSECONDS = 1_000_000


class OrbbecCamera:
    """A camera of Orbbec's SDK 2.

    Args:
        settings: what to request of it. ``options`` are names of ``OBPropertyID`` that end in
            ``_BOOL`` or ``_INT``.

    Raises:
        InputError: pyorbbecsdk2 is not installed, or an option is unknown.

    Example:
        >>> camera = OrbbecCamera(read_preset("femto_bolt"))  # doctest: +SKIP
    """

    name = "orbbec"

    def __init__(self, settings: CameraSettings | None = None) -> None:
        self._ob = load_sdk("pyorbbecsdk", "orbbec")
        self._settings = settings or CameraSettings(driver="orbbec")
        self.fps = float(self._settings.fps)
        for option in self._settings.options:
            is_known = hasattr(self._ob.OBPropertyID, option)
            if not is_known or not option.endswith(("_BOOL", "_INT")):
                raise InputError(f"orbbec: no option is called {option!r}.")
        self._pipeline: Any = None
        self._imu_pipeline: Any = None

    def open(self) -> None:
        """Start the streams."""
        ob = self._ob
        settings = self._settings
        found = ob.Context().query_devices()
        if not found.get_count():
            raise CameraLost("no device connected")
        if settings.serial:
            device = found.get_device_by_serial_number(settings.serial)
        else:
            device = found.get_device_by_index(0)
        pipeline = ob.Pipeline(device)
        config = ob.Config()
        sensors = ob.OBSensorType
        color = pipeline.get_stream_profile_list(sensors.COLOR_SENSOR)
        depth = pipeline.get_stream_profile_list(sensors.DEPTH_SENSOR)
        fps = settings.fps
        color_profile = color.get_video_stream_profile(
            *settings.size, ob.OBFormat.RGB, fps
        )
        config.enable_stream(color_profile)
        config.enable_stream(
            depth.get_video_stream_profile(
                *settings.depth_size, ob.OBFormat.Y16, fps
            )
        )
        both = ob.OBFrameAggregateOutputMode.FULL_FRAME_REQUIRE
        config.set_frame_aggregate_output_mode(both)
        self._set_options(device)
        pipeline.enable_frame_sync()
        self._align = ob.AlignFilter(align_to_stream=ob.OBStreamType.COLOR_STREAM)
        self._maker = FrameMaker(self._lens(color_profile), settings)
        pipeline.start(config)
        self._pipeline = pipeline
        self._imu = CameraImu(lambda: self._start_imu(device, color_profile))

    def _start_imu(self, device: Any, color_profile: Any) -> ImuBuffer | None:
        """Start gyroscope and accelerometer, in a pipeline of their own as the SDK advises."""
        if not self._settings.imu:
            return None
        ob = self._ob
        kinds = ob.OBSensorType
        sensors = device.get_sensor_list()
        found = {sensors.get_type_by_index(i) for i in range(sensors.get_count())}
        if not {kinds.GYRO_SENSOR, kinds.ACCEL_SENSOR} <= found:
            return None
        pipeline = ob.Pipeline(device)
        profiles = pipeline.get_stream_profile_list(kinds.GYRO_SENSOR)
        gyro = profiles.get_stream_profile_by_index(0)
        rotation = gyro.get_extrinsic_to(color_profile).rot
        buffer = ImuBuffer(np.reshape(rotation, (3, 3)))
        config = ob.Config()
        config.enable_accel_stream()
        config.enable_gyro_stream()
        pipeline.start(config, lambda frames: self._keep(buffer, frames))
        self._imu_pipeline = pipeline
        return buffer

    def _keep(self, buffer: ImuBuffer, frames: Any) -> None:
        """Keep readings, in the SDK's thread."""
        kinds = self._ob.OBFrameType
        gyro = frames.get_frame(kinds.GYRO_FRAME)
        if gyro:
            rate = gyro.as_gyro_frame()
            values = (rate.get_x(), rate.get_y(), rate.get_z())
            buffer.add_rate(_stamp(rate), values)
        accel = frames.get_frame(kinds.ACCEL_FRAME)
        if accel:
            force = accel.as_accel_frame()
            values = (force.get_x(), force.get_y(), force.get_z())
            buffer.add_acceleration(_stamp(force), values)

    def _set_options(self, device: Any) -> None:
        """Set what the settings state, and stamps of the computer's clock where there are any."""
        for name, value in self._settings.options.items():
            option = getattr(self._ob.OBPropertyID, name)
            if name.endswith("_BOOL"):
                device.set_bool_property(option, bool(value))
            else:
                device.set_int_property(option, int(value))
        if device.is_global_timestamp_supported():
            device.enable_global_timestamp(True)

    def _lens(self, profile: Any) -> Lens:
        """The intrinsics that the camera states of its colour."""
        at = profile.get_intrinsic()
        d = profile.get_distortion()
        camera = Camera(
            at.fx, at.fy, at.cx, at.cy, height=at.height, width=at.width
        )
        coefficients = (d.k1, d.k2, d.p1, d.p2, d.k3, d.k4, d.k5, d.k6)
        return Lens(camera, coefficients, "rational_polynomial")

    def read(self, timeout_s: float) -> Reading | None:
        """Wait for the next pair of image and depth."""
        frames = self._pipeline.wait_for_frames(int(1000 * timeout_s))
        if not frames:
            return None
        frames = self._align.process(frames)
        image = frames.get_color_frame() if frames else None
        if not image:
            return Reading(None, note="a frame without image")
        shape = (image.get_height(), image.get_width())
        # copied, for the memory is the SDK's
        rgb = np.array(image.get_data()).view(np.uint8).reshape(*shape, 3)
        depth = frames.get_depth_frame()
        metres = None
        if depth:
            data = np.asarray(depth.get_data()).view(np.uint16)
            stored = data.reshape(depth.get_height(), depth.get_width())
            metres = stored * np.float32(depth.get_depth_scale() / 1000)
        stamp = _stamp(image)
        frame = self._maker.frame(rgb, metres, stamp)
        reading = Reading(frame, time.time() - stamp, image.get_index())
        return self._imu.added_to(reading)

    def close(self) -> None:
        """Stop the streams."""
        pipelines = (self._imu_pipeline, self._pipeline)
        self._imu_pipeline = None
        self._pipeline = None
        with contextlib.ExitStack() as stack:
            for pipeline in pipelines:
                if pipeline is not None:
                    stack.callback(pipeline.stop)


def _stamp(frame: Any) -> float:
    """When a frame was taken, seconds; where the camera has no such clock, when it came."""
    stamped = frame.get_global_timestamp_us() or frame.get_system_timestamp_us()
    return float(stamped / MICROSECONDS)
