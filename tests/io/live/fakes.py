"""The parts of three SDKs that the drivers call, made up: no camera is needed.

Where an SDK is installed, a test compares the names here with its own.
"""

from __future__ import annotations

from datetime import timedelta
from types import SimpleNamespace
from typing import Any, ClassVar

import numpy as np

WIDTH, HEIGHT = 16, 12
FOCAL = 20.0


def bgr() -> np.ndarray:
    """(H, W, 3): blue 30, green 20, red 10."""
    return np.full((HEIGHT, WIDTH, 3), (30, 20, 10), np.uint8)


def millimetres(value: int = 1500) -> np.ndarray:
    return np.full((HEIGHT, WIDTH), value, np.uint16)


# -- depthai -----------------------------------------------------------------------------


class Dai:
    """``import depthai``, version 3."""

    class CameraBoardSocket:
        CAM_A = "A"
        CAM_B = "B"
        CAM_C = "C"

    class Platform:
        RVC2 = "RVC2"
        RVC4 = "RVC4"

    class Clock:
        time = timedelta(seconds=50.25)

        @classmethod
        def now(cls) -> timedelta:
            return cls.time

    class IMUSensor:
        ACCELEROMETER_RAW = "accelerometer"
        GYROSCOPE_RAW = "gyroscope"

    class CalibrationHandler:
        def getImuToCameraExtrinsics(self, socket: str) -> list[list[float]]:
            assert socket == Dai.CameraBoardSocket.CAM_A
            if Dai.Device.mount is None:
                raise RuntimeError(
                    "IMU calibration data is not available on device yet."
                )
            return [[*row, 0.5] for row in Dai.Device.mount] + [[0, 0, 0, 1]]

    class Device:
        platform = "RVC2"
        absent = False
        imu = ""
        mount: ClassVar[Any] = None

        def __init__(self, name: str = "") -> None:
            if self.absent:
                raise RuntimeError("No available devices")
            self.name = name
            self.light: dict[str, float] = {}
            self.closed = False

        def getPlatform(self) -> str:
            return self.platform

        def getConnectedIMU(self) -> str:
            return self.imu

        def readCalibration(self) -> Any:
            return Dai.CalibrationHandler()

        def setIrLaserDotProjectorIntensity(self, value: float) -> None:
            self.light["dots"] = value

        def setIrFloodLightIntensity(self, value: float) -> None:
            self.light["flood"] = value

        def close(self) -> None:
            self.closed = True

    class Pipeline:
        last: Any = None

        def __init__(self, device: Any) -> None:
            type(self).last = self
            self.device = device
            self.nodes: list[Any] = []
            self.state = "built"

        def create(self, kind: Any) -> Any:
            self.nodes.append(kind())
            return self.nodes[-1]

        def start(self) -> None:
            self.state = "started"

        def stop(self) -> None:
            self.state = "stopped"

        def getDefaultDevice(self) -> Any:
            return self.device

    class MessageQueue:
        def __init__(self) -> None:
            self.waiting: list[Any] = []

        def get(self, timeout: timedelta) -> Any:
            assert isinstance(timeout, timedelta)
            return self.waiting.pop(0) if self.waiting else None

        def tryGetAll(self) -> list[Any]:
            given = list(self.waiting)
            self.waiting.clear()
            return given

    class IMUReport:
        def __init__(self, stamp: float, values: tuple[float, ...]) -> None:
            self.stamp = stamp
            self.x, self.y, self.z = values

        def getTimestamp(self) -> timedelta:
            return timedelta(seconds=self.stamp)

    class IMUPacket:
        def __init__(self, acceleration: Any, rate: Any) -> None:
            self.acceleroMeter = acceleration
            self.gyroscope = rate

    class IMUData:
        def __init__(self, *packets: Any) -> None:
            self.packets = packets

    class ImgFrame:
        def __init__(self, pixels: np.ndarray, stamp: float, number: int) -> None:
            self.pixels = pixels
            self.stamp = stamp
            self.number = number

        def getCvFrame(self) -> np.ndarray:
            return self.pixels

        def getFrame(self) -> np.ndarray:
            return self.pixels

        def getTimestamp(self) -> timedelta:
            return timedelta(seconds=self.stamp)

        def getSequenceNum(self) -> int:
            return self.number

        def getTransformation(self) -> Any:
            return Dai.ImgTransformation()

    class ImgTransformation:
        def getIntrinsicMatrix(self) -> list[list[float]]:
            return [[FOCAL, 0, 7.5], [0, FOCAL + 1, 5.5], [0, 0, 1]]


class Output:
    """An output of a node: links are kept."""

    def __init__(self, owner: Any) -> None:
        self.owner = owner
        self.links: list[Any] = []
        self.queue: Any = None

    def link(self, target: Any) -> None:
        self.links.append(target)

    def createOutputQueue(self, maxSize: int, blocking: bool) -> Any:
        # frames would queue; readings of the IMU must
        assert blocking is False
        assert (maxSize == 1) != isinstance(self.owner, Nodes.IMU)
        self.queue = Dai.MessageQueue()
        return self.queue


class Nodes:
    """``depthai.node``."""

    class Camera:
        def build(self, socket: str) -> Any:
            self.socket = socket
            return self

        def requestOutput(
            self,
            size: tuple[int, int],
            fps: float,
            enableUndistortion: bool | None = None,
        ) -> Output:
            self.asked = (size, fps, enableUndistortion)
            self.output = Output(self)
            return self.output

    class StereoDepth:
        def __init__(self) -> None:
            self.left = "stereo.left"
            self.right = "stereo.right"
            self.inputAlignTo = "stereo.inputAlignTo"
            self.depth = Output(self)
            self.switches: dict[str, bool] = {}

        def setLeftRightCheck(self, on: bool) -> None:
            self.switches["left_right_check"] = on

        def setSubpixel(self, on: bool) -> None:
            self.switches["subpixel"] = on

        def setExtendedDisparity(self, on: bool) -> None:
            self.switches["extended_disparity"] = on

    class Sync:
        def __init__(self) -> None:
            self.inputs = {"image": "sync.image", "depth": "sync.depth"}
            self.out = Output(self)

        def setSyncThreshold(self, interval: timedelta) -> None:
            self.interval = interval

    class IMU:
        def __init__(self) -> None:
            self.out = Output(self)
            self.asked: dict[str, Any] = {}

        def enableIMUSensor(self, sensors: list[str], reportRate: int) -> None:
            self.asked = {"sensors": sensors, "rate": reportRate}

        def setBatchReportThreshold(self, batchReportThreshold: int) -> None:
            self.asked["batch"] = batchReportThreshold

        def setMaxBatchReports(self, maxBatchReports: int) -> None:
            self.asked["most"] = maxBatchReports

    class ImageAlign:
        def __init__(self) -> None:
            self.input = "align.input"
            self.inputAlignTo = "align.inputAlignTo"
            self.outputAligned = Output(self)


Dai.node = Nodes  # type: ignore[attr-defined]


# -- pyorbbecsdk -------------------------------------------------------------------------


class Ob:
    """``import pyorbbecsdk``, version 2."""

    class OBSensorType:
        COLOR_SENSOR = "color"
        DEPTH_SENSOR = "depth"
        GYRO_SENSOR = "gyro"
        ACCEL_SENSOR = "accel"

    class OBFrameType:
        GYRO_FRAME = "gyro"
        ACCEL_FRAME = "accel"

    class OBFormat:
        RGB = "RGB"
        Y16 = "Y16"

    class OBStreamType:
        COLOR_STREAM = "color"

    class OBFrameAggregateOutputMode:
        FULL_FRAME_REQUIRE = "full"

    class OBPropertyID:
        OB_PROP_COLOR_AUTO_EXPOSURE_PRIORITY_INT = "priority"
        OB_PROP_LASER_BOOL = "laser"

    class Device:
        def __init__(self, name: str) -> None:
            self.name = name
            self.set: dict[str, Any] = {}

        def set_bool_property(self, option: str, value: bool) -> None:
            assert isinstance(value, bool)
            self.set[option] = value

        def set_int_property(self, option: str, value: int) -> None:
            assert isinstance(value, int)
            self.set[option] = value

        def get_sensor_list(self) -> Any:
            return Ob.SensorList()

        def is_global_timestamp_supported(self) -> bool:
            return True

        def enable_global_timestamp(self, on: bool) -> None:
            self.set["global"] = on

    class SensorList:
        def get_count(self) -> int:
            return len(Ob.sensors)

        def get_type_by_index(self, index: int) -> str:
            return Ob.sensors[index]

    class DeviceList:
        def get_count(self) -> int:
            return len(Ob.connected)

        def get_device_by_index(self, index: int) -> Any:
            return Ob.connected[index]

        def get_device_by_serial_number(self, serial: str) -> Any:
            return next(device for device in Ob.connected if device.name == serial)

    class Context:
        def query_devices(self) -> Any:
            return Ob.DeviceList()

    class Config:
        def __init__(self) -> None:
            self.streams: list[Any] = []

        def enable_stream(self, profile: Any) -> None:
            self.streams.append(profile)

        def enable_gyro_stream(self) -> None:
            self.streams.append("gyro")

        def enable_accel_stream(self) -> None:
            self.streams.append("accel")

        def set_frame_aggregate_output_mode(self, mode: str) -> None:
            self.mode = mode

    class StreamProfileList:
        def __init__(self, sensor: str) -> None:
            self.sensor = sensor

        def get_video_stream_profile(self, width, height, form, fps) -> Any:
            return Ob.VideoStreamProfile(self.sensor, (width, height, form, fps))

        def get_stream_profile_by_index(self, index: int) -> Any:
            return Ob.StreamProfile(self.sensor)

    class StreamProfile:
        def __init__(self, sensor: str) -> None:
            self.sensor = sensor

        def get_extrinsic_to(self, target: Any) -> Any:
            assert (self.sensor, target.sensor) == ("gyro", "color")
            return SimpleNamespace(rot=np.array(Ob.mount, np.float32))

    class VideoStreamProfile:
        def __init__(self, sensor: str, asked: tuple[Any, ...]) -> None:
            self.sensor = sensor
            self.asked = asked

        def get_intrinsic(self) -> Any:
            return SimpleNamespace(
                fx=FOCAL, fy=FOCAL + 1, cx=7.5, cy=5.5, width=WIDTH, height=HEIGHT
            )

        def get_distortion(self) -> Any:
            names = ("k1", "k2", "k3", "k4", "k5", "k6", "p1", "p2")
            return SimpleNamespace(**dict.fromkeys(names, 0.0) | Ob.bent)

    class Pipeline:
        last: Any = None  # that of the images
        motion: Any = None  # that of the inertial sensor

        def __init__(self, device: Any) -> None:
            self.device = device
            self.waiting: list[Any] = []
            self.state = "built"
            self.is_synced = False
            self.on_frames: Any = None

        def get_stream_profile_list(self, sensor: str) -> Any:
            return Ob.StreamProfileList(sensor)

        def enable_frame_sync(self) -> None:
            self.is_synced = True

        def start(self, config: Any, callback: Any = None) -> None:
            if callback is None:
                Ob.Pipeline.last = self
            else:
                Ob.Pipeline.motion = self
            self.config = config
            self.on_frames = callback
            self.state = "started"

        def wait_for_frames(self, milliseconds: int) -> Any:
            assert isinstance(milliseconds, int)
            return self.waiting.pop(0) if self.waiting else None

        def stop(self) -> None:
            self.state = "stopped"

    class AlignFilter:
        def __init__(self, align_to_stream: str) -> None:
            assert align_to_stream == Ob.OBStreamType.COLOR_STREAM

        def process(self, frames: Any) -> Any:
            frames.is_aligned = True
            return frames

    class FrameSet:
        def __init__(self, color: Any, depth: Any) -> None:
            self.color = color
            self.depth = depth
            self.is_aligned = False

        def get_color_frame(self) -> Any:
            assert self.is_aligned
            return self.color

        def get_depth_frame(self) -> Any:
            return self.depth

        def get_frame(self, kind: str) -> Any:
            """Of the inertial sensor, whose readings stand in place of images."""
            return self.depth if kind == Ob.OBFrameType.ACCEL_FRAME else self.color

    class MotionFrame:
        """An ``AccelFrame`` or ``GyroFrame``."""

        def __init__(self, stamp_us: int, values: tuple[float, ...]) -> None:
            self.stamp_us = stamp_us
            self.values = values

        def as_gyro_frame(self) -> Any:
            return self

        def as_accel_frame(self) -> Any:
            return self

        def get_x(self) -> float:
            return self.values[0]

        def get_y(self) -> float:
            return self.values[1]

        def get_z(self) -> float:
            return self.values[2]

        def get_global_timestamp_us(self) -> int:
            return self.stamp_us

        def get_system_timestamp_us(self) -> int:
            return 0

    class ColorFrame:
        def __init__(self, stamp_us: int = 0, arrived_us: int = 0) -> None:
            self.data = bgr()[..., ::-1].ravel().copy()
            self.stamp_us = stamp_us
            self.arrived_us = arrived_us

        def get_data(self) -> np.ndarray:
            return self.data

        def get_width(self) -> int:
            return WIDTH

        def get_height(self) -> int:
            return HEIGHT

        def get_index(self) -> int:
            return 41

        def get_global_timestamp_us(self) -> int:
            return self.stamp_us

        def get_system_timestamp_us(self) -> int:
            return self.arrived_us

    class DepthFrame:
        def get_data(self) -> np.ndarray:
            return millimetres(750).ravel().view(np.uint8)

        def get_width(self) -> int:
            return WIDTH

        def get_height(self) -> int:
            return HEIGHT

        def get_depth_scale(self) -> float:
            """Millimetres in one unit."""
            return 2.0

    connected: ClassVar[list[Any]] = []
    sensors: ClassVar[list[str]] = []
    mount: ClassVar[Any] = None
    bent: ClassVar[dict[str, float]] = {}


# -- OpenCV's OpenNI ---------------------------------------------------------------------


class Capture:
    """``cv2.VideoCapture`` of an OpenNI device."""

    last: Any = None
    is_there = True

    def __init__(self, index: int, backend: int) -> None:
        type(self).last = self
        self.opened_with = (index, backend)
        self.set_to: dict[int, float] = {}
        self.alive = True
        self.images: dict[int, np.ndarray | None] = {}
        self.state = "open"

    def isOpened(self) -> bool:
        return self.is_there

    def set(self, option: int, value: float) -> bool:
        self.set_to[option] = value
        return True

    def get(self, option: int) -> float:
        return FOCAL

    def grab(self) -> bool:
        return self.alive

    def retrieve(self, flag: int) -> tuple[bool, np.ndarray | None]:
        image = self.images.get(flag)
        return image is not None, image

    def release(self) -> None:
        self.state = "released"
