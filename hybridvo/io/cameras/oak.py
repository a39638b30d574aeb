"""Luxonis OAK-D, by depthai 3: depth registered to colour without distortion, on the device."""

from __future__ import annotations

import time
from datetime import timedelta
from typing import Any

import numpy as np

from hybridvo.core.errors import InputError
from hybridvo.core.types import Camera
from hybridvo.io.cameras.base import FrameMaker, Reading, load_sdk
from hybridvo.io.cameras.inertial import IMU_RATE_HZ, CameraImu, ImuBuffer
from hybridvo.io.cameras.settings import CameraSettings
from hybridvo.io.data.streams import Lens

# messages of the IMU that wait for a frame: half a second and more
IMU_MESSAGES = 100

SWITCHES = ("left_right_check", "subpixel", "extended_disparity")
"""Options of the stereo node, 0 or 1."""
LIGHTS = ("dot_projector", "flood_light")
"""Options of the infrared lights of the Pro models, from 0 to 1."""
NO_IMU = ("", "NONE")
"""What the SDK calls an IMU that is not there."""


class OakCamera:
    """An OAK-D of any series.

    Args:
        settings: what to request of it. ``options`` are ``left_right_check``, ``subpixel`` and
            ``extended_disparity`` (0 or 1), ``dot_projector`` and ``flood_light`` (0 to 1).

    Raises:
        InputError: depthai is not installed, or an option is unknown.

    Example:
        >>> camera = OakCamera(read_preset("oak_d_pro"))  # doctest: +SKIP
    """

    name = "oak"

    def __init__(self, settings: CameraSettings | None = None) -> None:
        self._dai = load_sdk("depthai", "oak")
        self._settings = settings or CameraSettings(driver="oak")
        self.fps = float(self._settings.fps)
        for option in self._settings.options:
            if option not in (*SWITCHES, *LIGHTS):
                raise InputError(f"oak: no option is called {option!r}.")
        self._pipeline: Any = None

    def open(self) -> None:
        """Build the pipeline on the device and start it."""
        dai = self._dai
        settings = self._settings
        serial = settings.serial
        device = dai.Device(serial) if serial else dai.Device()
        pipeline = dai.Pipeline(device)
        self._pipeline = pipeline
        self._maker: FrameMaker | None = None
        image = self._image(dai.CameraBoardSocket.CAM_A, settings.size, True)
        stereo = pipeline.create(dai.node.StereoDepth)
        left = self._image(dai.CameraBoardSocket.CAM_B, settings.depth_size)
        right = self._image(dai.CameraBoardSocket.CAM_C, settings.depth_size)
        left.link(stereo.left)
        right.link(stereo.right)
        options = settings.options
        stereo.setLeftRightCheck(bool(options.get("left_right_check", True)))
        stereo.setSubpixel(bool(options.get("subpixel", True)))
        stereo.setExtendedDisparity(bool(options.get("extended_disparity", False)))
        sync = pipeline.create(dai.node.Sync)
        sync.setSyncThreshold(timedelta(seconds=0.5 / settings.fps))
        image.link(sync.inputs["image"])
        self._register(device, stereo, image).link(sync.inputs["depth"])
        self._queue = sync.out.createOutputQueue(1, False)
        self._imu_queue: Any = None
        self._imu = CameraImu(lambda: self._add_imu(device))
        pipeline.start()
        if "dot_projector" in options:
            device.setIrLaserDotProjectorIntensity(options["dot_projector"])
        if "flood_light" in options:
            device.setIrFloodLightIntensity(options["flood_light"])

    def _image(self, socket: Any, size: tuple[int, int], straight: bool = False):
        """The images of one camera of the device; ``straight``: without distortion."""
        camera = self._pipeline.create(self._dai.node.Camera).build(socket)
        fps = float(self._settings.fps)
        if straight:
            return camera.requestOutput(size, fps=fps, enableUndistortion=True)
        return camera.requestOutput(size, fps=fps)

    def _register(self, device: Any, stereo: Any, image: Any) -> Any:
        """Depth in the pixels of the image; the newer chips have a node of their own for it."""
        dai = self._dai
        if device.getPlatform() != dai.Platform.RVC4:
            image.link(stereo.inputAlignTo)
            return stereo.depth
        align = self._pipeline.create(dai.node.ImageAlign)
        stereo.depth.link(align.input)
        image.link(align.inputAlignTo)
        return align.outputAligned

    def _add_imu(self, device: Any) -> ImuBuffer | None:
        """Add the device's IMU to the pipeline, if it has one that was calibrated."""
        dai = self._dai
        if not self._settings.imu or device.getConnectedIMU() in NO_IMU:
            return None
        calibration = device.readCalibration()
        T_cam_imu = np.array(
            calibration.getImuToCameraExtrinsics(dai.CameraBoardSocket.CAM_A)
        )
        R_cam_imu = T_cam_imu[:3, :3]
        if np.array_equal(R_cam_imu, np.eye(3)):
            raise InputError(
                "the device's calibration does not state how it is mounted: it has an identity "
                "in that place"
            )
        buffer = ImuBuffer(R_cam_imu)
        imu = self._pipeline.create(dai.node.IMU)
        sensors = [dai.IMUSensor.ACCELEROMETER_RAW, dai.IMUSensor.GYROSCOPE_RAW]
        imu.enableIMUSensor(sensors, IMU_RATE_HZ)
        imu.setBatchReportThreshold(1)
        imu.setMaxBatchReports(10)
        self._imu_queue = imu.out.createOutputQueue(IMU_MESSAGES, False)
        self._readings = buffer
        return buffer

    def _take_readings(self) -> None:
        """Keep what the IMU measured, by the computer's clock."""
        if self._imu_queue is None:
            return
        offset = time.time() - self._dai.Clock.now().total_seconds()
        for message in self._imu_queue.tryGetAll():
            for packet in message.packets:
                rate = packet.gyroscope
                stamp = offset + rate.getTimestamp().total_seconds()
                self._readings.add_rate(stamp, (rate.x, rate.y, rate.z))
                force = packet.acceleroMeter
                stamp = offset + force.getTimestamp().total_seconds()
                self._readings.add_acceleration(stamp, (force.x, force.y, force.z))

    def read(self, timeout_s: float) -> Reading | None:
        """Wait for the next pair of image and depth."""
        group = self._queue.get(timedelta(seconds=timeout_s))
        if group is None:
            return None
        image = group["image"]
        bgr = image.getCvFrame()
        if self._maker is None:
            self._maker = FrameMaker(self._lens(image, bgr.shape), self._settings)
        metres = np.asarray(group["depth"].getFrame(), np.float32) / 1000
        age = (self._dai.Clock.now() - image.getTimestamp()).total_seconds()
        rgb = np.ascontiguousarray(bgr[:, :, ::-1])
        frame = self._maker.frame(rgb, metres, time.time() - age)
        self._take_readings()
        return self._imu.added_to(Reading(frame, age, image.getSequenceNum()))

    def _lens(self, image: Any, shape: tuple[int, ...]) -> Lens:
        """The intrinsics of an image after all that the device has done to it."""
        K = image.getTransformation().getIntrinsicMatrix()
        height, width = shape[:2]
        return Lens(
            Camera(K[0][0], K[1][1], K[0][2], K[1][2], height=height, width=width)
        )

    def close(self) -> None:
        """Stop the pipeline and let the device go."""
        if self._pipeline is not None:
            pipeline = self._pipeline
            self._pipeline = None
            pipeline.stop()
            pipeline.getDefaultDevice().close()
