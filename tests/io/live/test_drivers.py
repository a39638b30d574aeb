"""The drivers for OAK, Orbbec and OpenNI, with mocks of their SDKs; no camera is needed.

What a mock cannot show: whether the camera does what it is asked. docs/live.md says so.
"""

from __future__ import annotations

import sys
import time
from collections import defaultdict
from collections.abc import Iterable
from datetime import timedelta
from types import SimpleNamespace
from typing import Any, NamedTuple
from unittest.mock import MagicMock, call

import cv2
import numpy as np
import pytest

import hybridvo as hvo
from hybridvo.io.cameras.base import CameraLost
from hybridvo.io.cameras.choose import choose_camera
from hybridvo.io.cameras.oak import OakCamera
from hybridvo.io.cameras.opencv import OpenCVCamera
from hybridvo.io.cameras.orbbec import OrbbecCamera
from hybridvo.io.cameras.settings import CameraSettings, read_preset

WIDTH, HEIGHT = 16, 12
FOCAL = 20.0
CAMERA = hvo.Camera(FOCAL, FOCAL + 1, 7.5, 5.5, height=HEIGHT, width=WIDTH)
BGR = np.full((HEIGHT, WIDTH, 3), (30, 20, 10), np.uint8)
MILLIMETRES = np.full((HEIGHT, WIDTH), 1500, np.uint16)
MOUNT = [[0.0, 1, 0], [-1, 0, 0], [0, 0, 1]]
"""An inertial sensor whose x points up in the image."""


def settings(driver: str, **more: Any) -> CameraSettings:
    return CameraSettings(driver=driver, width=WIDTH, height=HEIGHT, **more)


def has_names(kind: Any, names: str) -> bool:
    return all(hasattr(kind, name) for name in names.split())


# -- OAK ---------------------------------------------------------------------------------


class Oak(NamedTuple):
    dai: MagicMock
    nodes: dict[Any, list[MagicMock]]
    """Nodes of the pipeline, by their kind."""

    def only(self, kind: Any) -> MagicMock:
        (node,) = self.nodes[kind]
        return node

    def queue(self, kind: Any) -> MagicMock:
        return self.only(kind).out.createOutputQueue.return_value


@pytest.fixture
def oak(monkeypatch: pytest.MonkeyPatch) -> Oak:
    dai = MagicMock()
    nodes = defaultdict(list)

    def create(kind: Any) -> MagicMock:
        node = MagicMock(inputs={"image": "sync.image", "depth": "sync.depth"})
        node.build.return_value = node
        nodes[kind].append(node)
        return node

    dai.Pipeline.return_value.create.side_effect = create
    dai.Clock.now.return_value = timedelta(seconds=50.25)
    device = dai.Device.return_value
    device.getConnectedIMU.return_value = ""
    monkeypatch.setitem(sys.modules, "depthai", dai)
    return Oak(dai, nodes)


def oak_frame(stamp: float) -> dict[str, MagicMock]:
    image = MagicMock()
    image.getCvFrame.return_value = BGR
    image.getTimestamp.return_value = timedelta(seconds=stamp)
    image.getSequenceNum.return_value = 8
    K = [[FOCAL, 0, 7.5], [0, FOCAL + 1, 5.5], [0, 0, 1]]
    image.getTransformation().getIntrinsicMatrix.return_value = K
    depth = MagicMock()
    depth.getFrame.return_value = MILLIMETRES
    return {"image": image, "depth": depth}


def with_imu(oak: Oak, R_cam_imu: Any) -> OakCamera:
    device = oak.dai.Device.return_value
    device.getConnectedIMU.return_value = "BNO086"
    calibration = device.readCalibration.return_value
    T = [[*row, 0.5] for row in R_cam_imu] + [[0, 0, 0, 1]]
    calibration.getImuToCameraExtrinsics.return_value = T
    camera = OakCamera(settings("oak"))
    camera.open()
    calibration.getImuToCameraExtrinsics.assert_called_once_with(
        oak.dai.CameraBoardSocket.CAM_A
    )
    return camera


def test_depthai_has_the_names_that_are_called() -> None:
    dai = pytest.importorskip("depthai", exc_type=ImportError)
    nodes = "Camera StereoDepth Sync IMU ImageAlign"
    stereo = "setLeftRightCheck setSubpixel setExtendedDisparity inputAlignTo depth"
    for kind, names in (
        (dai, "Device Pipeline CameraBoardSocket Platform Clock IMUSensor node"),
        (dai.node, nodes),
        (dai.CameraBoardSocket, "CAM_A CAM_B CAM_C"),
        (dai.IMUSensor, "ACCELEROMETER_RAW GYROSCOPE_RAW"),
        (dai.Platform, "RVC4"),
        (dai.Clock, "now"),
        (dai.Node.Output, "link createOutputQueue"),
        (dai.node.Camera, "build requestOutput"),
        (dai.node.StereoDepth, f"left right {stereo}"),
        (dai.node.ImageAlign, "input inputAlignTo outputAligned"),
        (dai.node.Sync, "inputs out setSyncThreshold"),
        (
            dai.node.IMU,
            "enableIMUSensor setBatchReportThreshold setMaxBatchReports",
        ),
        (dai.Device, "getPlatform getConnectedIMU readCalibration close"),
        (dai.Device, "setIrLaserDotProjectorIntensity setIrFloodLightIntensity"),
        (dai.CalibrationHandler, "getImuToCameraExtrinsics"),
        (dai.Pipeline, "create start stop getDefaultDevice"),
        (dai.MessageQueue, "get tryGetAll"),
        (dai.ImgFrame, "getCvFrame getFrame getTimestamp getSequenceNum"),
        (dai.ImgFrame, "getTransformation"),
        (dai.ImgTransformation, "getIntrinsicMatrix"),
        (dai.IMUPacket, "acceleroMeter gyroscope"),
        (dai.IMUData, "packets"),
        (dai.IMUReportAccelerometer, "x y z getTimestamp"),
        (dai.IMUReportGyroscope, "x y z getTimestamp"),
    ):
        assert has_names(kind, names), kind


def test_oak_asks_for_registered_depth_and_straight_colour(oak: Oak) -> None:
    options = {"subpixel": 0, "dot_projector": 0.5, "flood_light": 0.25}
    size = {"depth_width": 640, "depth_height": 400}
    camera = OakCamera(settings("oak", serial="1844301", options=options, **size))
    camera.open()
    dai = oak.dai
    dai.Device.assert_called_once_with("1844301")
    image, left, right = oak.nodes[dai.node.Camera]
    sockets = dai.CameraBoardSocket
    for each, socket in ((image, "CAM_A"), (left, "CAM_B"), (right, "CAM_C")):
        each.build.assert_called_once_with(getattr(sockets, socket))
    stereo = oak.only(dai.node.StereoDepth)
    image.requestOutput.assert_called_once_with(
        (WIDTH, HEIGHT), fps=30.0, enableUndistortion=True
    )
    assert image.requestOutput.return_value.link.call_args_list == [
        call("sync.image"),
        call(stereo.inputAlignTo),
    ]
    for each, target in ((left, stereo.left), (right, stereo.right)):
        each.requestOutput.assert_called_once_with((640, 400), fps=30.0)
        each.requestOutput.return_value.link.assert_called_once_with(target)
    stereo.depth.link.assert_called_once_with("sync.depth")
    stereo.setLeftRightCheck.assert_called_once_with(True)
    stereo.setSubpixel.assert_called_once_with(False)
    stereo.setExtendedDisparity.assert_called_once_with(False)
    sync = oak.only(dai.node.Sync)
    # half the time from frame to frame, and no frame queues
    sync.setSyncThreshold.assert_called_once_with(timedelta(seconds=0.5 / 30))
    sync.out.createOutputQueue.assert_called_once_with(1, False)
    device = dai.Device.return_value
    device.setIrLaserDotProjectorIntensity.assert_called_once_with(0.5)
    device.setIrFloodLightIntensity.assert_called_once_with(0.25)
    pipeline = dai.Pipeline.return_value
    pipeline.start.assert_called_once_with()
    camera.close()
    camera.close()
    pipeline.stop.assert_called_once_with()
    pipeline.getDefaultDevice().close.assert_called_once_with()
    assert dai.node.IMU not in oak.nodes


def test_oak_4_registers_depth_by_a_node_of_its_own(oak: Oak) -> None:
    dai = oak.dai
    dai.Device.return_value.getPlatform.return_value = dai.Platform.RVC4
    OakCamera(settings("oak")).open()
    align = oak.only(dai.node.ImageAlign)
    stereo = oak.only(dai.node.StereoDepth)
    stereo.depth.link.assert_called_once_with(align.input)
    align.outputAligned.link.assert_called_once_with("sync.depth")


def test_oak_hands_out_what_comes(oak: Oak) -> None:
    camera = OakCamera(settings("oak"))
    camera.open()
    oak.queue(oak.dai.node.Sync).get.side_effect = [None, oak_frame(50.0)]
    assert camera.read(0.1) is None
    before = time.time()
    reading = camera.read(0.1)
    made = reading.frame
    assert made.camera == CAMERA
    assert made.rgb[0, 0].tolist() == [10, 20, 30]
    np.testing.assert_allclose(made.depth, 1.5)
    # the device's clock is mapped to the computer's
    assert reading.age_s == pytest.approx(0.25)
    assert before - 0.25 <= made.timestamp <= time.time() - 0.25
    assert (reading.number, reading.imu, reading.note) == (8, None, "")


def oak_report(stamp: float, x: float) -> SimpleNamespace:
    seconds = timedelta(seconds=stamp)
    return SimpleNamespace(x=x, y=0.0, z=0.0, getTimestamp=lambda: seconds)


def test_oak_hands_over_its_imu(oak: Oak) -> None:
    camera = with_imu(oak, MOUNT)
    dai = oak.dai
    imu = oak.only(dai.node.IMU)
    sensors = [dai.IMUSensor.ACCELEROMETER_RAW, dai.IMUSensor.GYROSCOPE_RAW]
    imu.enableIMUSensor.assert_called_once_with(sensors, 200)
    packets = [
        SimpleNamespace(
            acceleroMeter=oak_report(49.971 + 0.005 * k, 9.8),
            gyroscope=oak_report(49.97 + 0.005 * k, 0.1 * k),
        )
        for k in range(4)
    ]
    messages = [SimpleNamespace(packets=packets[i : i + 2]) for i in (0, 2)]
    oak.queue(dai.node.IMU).tryGetAll.side_effect = [messages, []]
    frames = [oak_frame(50.0), oak_frame(50.03)]
    oak.queue(dai.node.Sync).get.side_effect = frames
    reading = camera.read(0.1)
    samples = reading.imu
    assert reading.note == "" and samples is not None
    # by the clock of the frame, which was taken 0.03 s after the first of them
    late = reading.frame.timestamp - samples.stamps
    np.testing.assert_allclose(late, [0.03, 0.025, 0.02, 0.015], atol=1e-3)
    np.testing.assert_allclose(samples.rates[:, 0], [0, 0.1, 0.2, 0.3])
    # at rest it reads upwards, which is -y of the image
    up = samples.R_cam_imu @ samples.accelerations[-1]
    np.testing.assert_allclose(up, [0, -9.8, 0])
    assert camera.read(0.1).imu is None


def test_oak_whose_imu_is_not_calibrated_says_so_once(oak: Oak) -> None:
    camera = with_imu(oak, np.eye(3))
    frames = [oak_frame(50.0), oak_frame(50.03)]
    oak.queue(oak.dai.node.Sync).get.side_effect = frames
    first = camera.read(0.1)
    assert first.imu is None and first.frame is not None
    assert "does not state how it is mounted" in first.note
    assert camera.read(0.1).note == ""


# -- Orbbec ------------------------------------------------------------------------------


class Orbbec(NamedTuple):
    ob: MagicMock
    images: MagicMock
    """The pipeline of the images."""
    motion: MagicMock
    """That of the inertial sensor."""
    devices: MagicMock
    profile: MagicMock
    """The stream of colour."""

    def has_sensors(self, *names: str) -> None:
        found = self.devices.get_device_by_index().get_sensor_list.return_value
        found.get_count.return_value = len(names)
        kinds = [getattr(self.ob.OBSensorType, name) for name in names]
        found.get_type_by_index.side_effect = kinds


@pytest.fixture
def orbbec(monkeypatch: pytest.MonkeyPatch) -> Orbbec:
    ob, images, motion = MagicMock(), MagicMock(), MagicMock()
    ob.OBPropertyID = SimpleNamespace(
        OB_PROP_LASER_BOOL="laser",
        OB_PROP_COLOR_AUTO_EXPOSURE_PRIORITY_INT="priority",
        OB_STRUCT="struct",
    )
    ob.Pipeline.side_effect = [images, motion]
    ob.AlignFilter.return_value.process.side_effect = lambda frames: frames.aligned
    profiles = images.get_stream_profile_list.return_value
    profile = profiles.get_video_stream_profile.return_value
    profile.get_intrinsic.return_value = SimpleNamespace(
        fx=FOCAL, fy=FOCAL + 1, cx=7.5, cy=5.5, width=WIDTH, height=HEIGHT
    )
    bend(profile)
    devices = ob.Context().query_devices.return_value
    devices.get_count.return_value = 2
    made = Orbbec(ob, images, motion, devices, profile)
    made.has_sensors("COLOR_SENSOR", "DEPTH_SENSOR")
    monkeypatch.setitem(sys.modules, "pyorbbecsdk", ob)
    return made


def bend(profile: MagicMock, **coefficients: float) -> None:
    zeros = dict.fromkeys(("k1", "k2", "k3", "k4", "k5", "k6", "p1", "p2"), 0.0)
    stated = SimpleNamespace(**zeros | coefficients)
    profile.get_distortion.return_value = stated


def orbbec_image(stamp_us: int = 0, arrived_us: int = 0) -> MagicMock:
    image = MagicMock(data=BGR[..., ::-1].ravel().copy())
    image.get_data.return_value = image.data
    image.get_width.return_value, image.get_height.return_value = WIDTH, HEIGHT
    image.get_index.return_value = 41
    image.get_global_timestamp_us.return_value = stamp_us
    image.get_system_timestamp_us.return_value = arrived_us
    return image


def orbbec_depth() -> MagicMock:
    """750 units of 2 mm."""
    depth = MagicMock()
    depth.get_data.return_value = (MILLIMETRES // 2).ravel().view(np.uint8)
    depth.get_width.return_value, depth.get_height.return_value = WIDTH, HEIGHT
    depth.get_depth_scale.return_value = 2.0
    return depth


def orbbec_frames(color: Any, depth: Any) -> SimpleNamespace:
    aligned = MagicMock()
    aligned.get_color_frame.return_value = color
    aligned.get_depth_frame.return_value = depth
    return SimpleNamespace(aligned=aligned)


def orbbec_motion(stamp_us: int, x: float) -> MagicMock:
    made = MagicMock()
    made.as_gyro_frame.return_value = made.as_accel_frame.return_value = made
    made.get_x.return_value = x
    made.get_y.return_value = made.get_z.return_value = 0.0
    made.get_global_timestamp_us.return_value = stamp_us
    return made


def test_pyorbbecsdk_has_the_names_that_are_called() -> None:
    ob = pytest.importorskip("pyorbbecsdk", exc_type=ImportError)
    streams = "get_stream_profile_list enable_frame_sync start stop wait_for_frames"
    stamps = "get_global_timestamp_us get_system_timestamp_us"
    device = "get_sensor_list set_bool_property set_int_property"
    clock = "is_global_timestamp_supported enable_global_timestamp"
    enable = "enable_stream enable_accel_stream enable_gyro_stream"
    for kind, names in (
        (ob.OBSensorType, "COLOR_SENSOR DEPTH_SENSOR GYRO_SENSOR ACCEL_SENSOR"),
        (ob.OBFrameType, "GYRO_FRAME ACCEL_FRAME"),
        (ob.OBFormat, "RGB Y16"),
        (ob.OBStreamType, "COLOR_STREAM"),
        (ob.OBPropertyID, "OB_PROP_LASER_BOOL"),
        (ob.OBPropertyID, "OB_PROP_COLOR_AUTO_EXPOSURE_PRIORITY_INT"),
        (ob.OBFrameAggregateOutputMode, "FULL_FRAME_REQUIRE"),
        (ob.Context, "query_devices"),
        (
            ob.DeviceList,
            "get_count get_device_by_index get_device_by_serial_number",
        ),
        (ob.Device, f"{device} {clock}"),
        (ob.SensorList, "get_count get_type_by_index"),
        (ob.Config, f"{enable} set_frame_aggregate_output_mode"),
        (
            ob.StreamProfileList,
            "get_video_stream_profile get_stream_profile_by_index",
        ),
        (ob.VideoStreamProfile, "get_intrinsic get_distortion"),
        (ob.StreamProfile, "get_extrinsic_to"),
        (ob.OBCameraIntrinsic, "fx fy cx cy width height"),
        (ob.OBCameraDistortion, "k1 k2 k3 k4 k5 k6 p1 p2"),
        (ob.OBExtrinsic, "rot"),
        (ob.Pipeline, streams),
        (ob.AlignFilter, "process"),
        (ob.FrameSet, "get_color_frame get_depth_frame get_frame"),
        (ob.ColorFrame, f"get_data get_width get_height get_index {stamps}"),
        (ob.DepthFrame, "get_data get_width get_height get_depth_scale"),
        (ob.AccelFrame, f"get_x get_y get_z {stamps}"),
        (ob.GyroFrame, f"get_x get_y get_z {stamps}"),
    ):
        assert has_names(kind, names), kind


def test_orbbec_asks_for_both_streams_in_time(orbbec: Orbbec) -> None:
    auto_exposure = "OB_PROP_COLOR_AUTO_EXPOSURE_PRIORITY_INT"
    options = {"OB_PROP_LASER_BOOL": 1, auto_exposure: 0}
    size = {"depth_width": 320, "depth_height": 288}
    camera = OrbbecCamera(settings("orbbec", options=options, **size))
    camera.open()
    ob, images = orbbec.ob, orbbec.images
    sensors = ob.OBSensorType
    assert images.get_stream_profile_list.call_args_list == [
        call(sensors.COLOR_SENSOR),
        call(sensors.DEPTH_SENSOR),
    ]
    profiles = images.get_stream_profile_list.return_value
    assert profiles.get_video_stream_profile.call_args_list == [
        call(WIDTH, HEIGHT, ob.OBFormat.RGB, 30),
        call(320, 288, ob.OBFormat.Y16, 30),
    ]
    config = ob.Config.return_value
    config.set_frame_aggregate_output_mode.assert_called_once_with(
        ob.OBFrameAggregateOutputMode.FULL_FRAME_REQUIRE
    )
    images.enable_frame_sync.assert_called_once_with()
    color = ob.OBStreamType.COLOR_STREAM
    ob.AlignFilter.assert_called_once_with(align_to_stream=color)
    orbbec.devices.get_device_by_index.assert_called_with(0)
    device = orbbec.devices.get_device_by_index.return_value
    device.set_bool_property.assert_called_once_with("laser", True)
    device.set_int_property.assert_called_once_with("priority", 0)
    device.enable_global_timestamp.assert_called_once_with(True)
    images.start.assert_called_once_with(config)
    orbbec.motion.start.assert_not_called()
    camera.close()
    camera.close()
    images.stop.assert_called_once_with()


def test_orbbec_hands_out_what_comes(orbbec: Orbbec) -> None:
    camera = OrbbecCamera(settings("orbbec"))
    camera.open()
    now = time.time()
    stamped = orbbec_image(round((now - 0.5) * 1e6), round(now * 1e6))
    arrived = orbbec_image(0, round((now - 0.1) * 1e6))
    orbbec.images.wait_for_frames.side_effect = [
        None,
        orbbec_frames(stamped, orbbec_depth()),
        orbbec_frames(arrived, None),
        orbbec_frames(None, orbbec_depth()),
    ]
    assert camera.read(0.1) is None
    orbbec.images.wait_for_frames.assert_called_once_with(100)
    reading = camera.read(0.1)
    made = reading.frame
    assert made.camera == CAMERA
    assert made.rgb[0, 0].tolist() == [10, 20, 30]
    np.testing.assert_allclose(made.depth, 1.5)
    assert made.timestamp == pytest.approx(now - 0.5, abs=1e-5)
    assert 0.5 <= reading.age_s + 1e-5
    assert (reading.number, reading.imu, reading.note) == (41, None, "")
    # its memory is the SDK's
    stamped.data[:] = 0
    assert (made.rgb[..., 2] == 30).all()
    # a camera without such a clock: the time of arrival
    second = camera.read(0.1).frame
    assert second.timestamp == pytest.approx(now - 0.1, abs=1e-5)
    assert second.depth is None
    assert camera.read(0.1).note == "a frame without image"


def test_orbbec_takes_its_distortion_out(orbbec: Orbbec) -> None:
    """The SDK's names in OpenCV's order: k1 k2 p1 p2 k3 k4 k5 k6."""
    names = ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")
    coefficients = np.array([0.3, -0.2, 0.01, -0.01, 0.1, 0.2, 0.05, 0.02])
    bend(orbbec.profile, **dict(zip(names, coefficients.tolist(), strict=True)))
    camera = OrbbecCamera(settings("orbbec"))
    camera.open()
    row, column = 10, 13
    point = np.array([[(column - 7.5) / FOCAL, (row - 5.5) / (FOCAL + 1), 1.0]])
    zero = np.zeros(3)
    seen = cv2.projectPoints(point, zero, zero, CAMERA.K, coefficients)[0].ravel()
    maps = camera._maker._maps
    at = (maps.columns[row, column], maps.rows[row, column])
    assert at == pytest.approx(seen, abs=1e-3)


def test_orbbec_finds_its_device(orbbec: Orbbec) -> None:
    camera = choose_camera("orbbec:second")
    camera.open()
    by_serial = orbbec.devices.get_device_by_serial_number
    by_serial.assert_called_once_with("second")
    assert orbbec.ob.Pipeline.call_args == call(by_serial.return_value)
    orbbec.devices.get_count.return_value = 0
    with pytest.raises(CameraLost, match="no device connected"):
        camera.open()


def test_orbbec_hands_over_its_imu(orbbec: Orbbec) -> None:
    orbbec.has_sensors("COLOR_SENSOR", "ACCEL_SENSOR", "GYRO_SENSOR")
    profiles = orbbec.motion.get_stream_profile_list.return_value
    gyro = profiles.get_stream_profile_by_index.return_value
    gyro.get_extrinsic_to.return_value.rot = np.array(MOUNT, np.float32)
    camera = OrbbecCamera(settings("orbbec"))
    camera.open()
    gyro.get_extrinsic_to.assert_called_once_with(orbbec.profile)
    on_frames = orbbec.motion.start.call_args[0][1]
    kinds = orbbec.ob.OBFrameType
    now = time.time()
    for k in range(3):
        stamp = round((now - 0.02 + 0.005 * k) * 1e6)
        rate = orbbec_motion(stamp, 0.1 * k)
        force = orbbec_motion(stamp, 9.8)
        both = {kinds.GYRO_FRAME: rate, kinds.ACCEL_FRAME: force}
        on_frames(SimpleNamespace(get_frame=both.get))
    # a set with one of both
    one = {kinds.ACCEL_FRAME: orbbec_motion(round(now * 1e6), 9.8)}
    on_frames(SimpleNamespace(get_frame=one.get))
    image = orbbec_image(round((now - 0.005) * 1e6))
    frames = orbbec_frames(image, orbbec_depth())
    orbbec.images.wait_for_frames.side_effect = [frames]
    samples = camera.read(0.1).imu
    assert samples is not None
    times = samples.stamps - now
    np.testing.assert_allclose(times, [-0.02, -0.015, -0.01], atol=1e-5)
    np.testing.assert_allclose(samples.rates[:, 0], [0, 0.1, 0.2])
    up = samples.R_cam_imu @ samples.accelerations[0]
    np.testing.assert_allclose(up, [0, -9.8, 0], atol=1e-6)
    camera.close()
    orbbec.motion.stop.assert_called_once_with()
    orbbec.images.stop.assert_called_once_with()


# -- OpenNI ------------------------------------------------------------------------------


@pytest.fixture
def capture(monkeypatch: pytest.MonkeyPatch) -> MagicMock:
    made = MagicMock()
    made.get.return_value = FOCAL
    made.retrieve.side_effect = lambda flag: (
        flag in made.images,
        made.images.get(flag),
    )
    made.images = {cv2.CAP_OPENNI_BGR_IMAGE: BGR}
    monkeypatch.setattr(cv2, "VideoCapture", MagicMock(return_value=made))
    monkeypatch.setattr(cv2.videoio_registry, "hasBackend", lambda _: True)
    return made


def opened(given: CameraSettings) -> OpenCVCamera:
    camera = OpenCVCamera(given, 1)
    camera.open()
    return camera


def test_an_opencv_without_openni_is_refused() -> None:
    if cv2.videoio_registry.hasBackend(cv2.CAP_OPENNI2):
        pytest.skip("this OpenCV has OpenNI")
    with pytest.raises(hvo.InputError, match="built without OpenNI 2"):
        choose_camera("opencv:0")


def test_openni_hands_out_what_comes(capture: MagicMock) -> None:
    camera = opened(settings("opencv", options={"CAP_PROP_OPENNI2_MIRROR": 0}))
    cv2.VideoCapture.assert_called_once_with(1, cv2.CAP_OPENNI2)
    assert capture.set.call_args_list == [
        call(cv2.CAP_OPENNI_DEPTH_GENERATOR_REGISTRATION, 1),
        call(cv2.CAP_PROP_OPENNI2_SYNC, 1),
        call(cv2.CAP_PROP_OPENNI2_MIRROR, 0),
    ]
    capture.images[cv2.CAP_OPENNI_DEPTH_MAP] = MILLIMETRES
    before = time.time()
    made = camera.read(0.1).frame
    # the focal length is OpenNI's, the centre that of the image
    assert made.camera == hvo.Camera(
        FOCAL, FOCAL, 7.5, 5.5, height=HEIGHT, width=WIDTH
    )
    assert made.rgb[0, 0].tolist() == [10, 20, 30]
    np.testing.assert_allclose(made.depth, 1.5)
    assert before <= made.timestamp <= time.time()
    del capture.images[cv2.CAP_OPENNI_DEPTH_MAP]
    assert camera.read(0.1).frame.depth is None
    capture.images.clear()
    assert camera.read(0.1).note == "a frame without image"
    capture.grab.return_value = False
    with pytest.raises(CameraLost, match="gives no frames"):
        camera.read(0.1)
    camera.close()
    camera.close()
    capture.release.assert_called_once_with()
    capture.isOpened.return_value = False
    with pytest.raises(CameraLost, match="no device 1"):
        camera.open()


def test_openni_takes_intrinsics_that_belong_to_its_images(
    capture: MagicMock,
) -> None:
    given = (30.0, 31.0, 7.0, 6.0)
    camera = opened(settings("opencv", intrinsics=given))
    assert camera.read(0.1).frame.camera == hvo.Camera(
        *given, height=HEIGHT, width=WIDTH
    )
    with pytest.raises(hvo.InputError, match="512x424"):
        opened(read_preset("kinect_v2")).read(0.1)


# -- options -----------------------------------------------------------------------------


@pytest.mark.usefixtures("oak", "orbbec", "capture")
def test_options_are_those_of_the_sdk() -> None:
    OakCamera(read_preset("oak_d_pro"))
    OrbbecCamera(read_preset("femto_bolt"))
    OpenCVCamera(read_preset("kinect_v1"))
    wrong: Iterable[tuple[Any, str]] = (
        (OakCamera, "laser"),
        (OrbbecCamera, "OB_PROP_NONE_BOOL"),
        (OrbbecCamera, "OB_STRUCT"),
        (OpenCVCamera, "MIRROR"),
    )
    for make, option in wrong:
        with pytest.raises(hvo.InputError, match=f"no option is called '{option}'"):
            make(settings("oak", options={option: 1}))
