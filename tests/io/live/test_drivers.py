"""The drivers for OAK, Orbbec and OpenNI, with fakes of their SDKs; no camera is needed.

What a fake cannot show: whether the camera does what it is asked. docs/live.md says so.
"""

from __future__ import annotations

import inspect
import sys
import time
from collections.abc import Iterator
from datetime import timedelta
from typing import Any

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
from tests.io.live.fakes import (
    FOCAL,
    HEIGHT,
    WIDTH,
    Capture,
    Dai,
    Nodes,
    Ob,
    Output,
    bgr,
    millimetres,
)

CAMERA = hvo.Camera(FOCAL, FOCAL + 1, 7.5, 5.5, HEIGHT, WIDTH)


def settings(driver: str, **more: Any) -> CameraSettings:
    return CameraSettings(driver=driver, width=WIDTH, height=HEIGHT, **more)


def public(kind: type) -> list[str]:
    """Names of the SDK's that a fake class has."""
    own = (
        *("absent", "last", "platform", "state", "time", "connected", "bent"),
        *("imu", "mount", "motion", "sensors", "MotionFrame"),
    )
    return [name for name in vars(kind) if name[0] != "_" and name not in own]


def check_names(fake: type, real: Any, where: str) -> None:
    """Every name of a fake must be one of the SDK's."""
    for name in public(fake):
        assert hasattr(real, name), f"{where}.{name}"
        inner = getattr(fake, name)
        if inspect.isclass(inner):
            check_names(inner, getattr(real, name), f"{where}.{name}")


# -- OAK ---------------------------------------------------------------------------------


@pytest.fixture
def dai(monkeypatch: pytest.MonkeyPatch) -> type[Dai]:
    monkeypatch.setitem(sys.modules, "depthai", Dai)  # type: ignore[arg-type]
    monkeypatch.setattr(Dai.Device, "platform", "RVC2")
    monkeypatch.setattr(Dai.Device, "absent", False)
    monkeypatch.setattr(Dai.Device, "imu", "")
    monkeypatch.setattr(Dai.Device, "mount", None)
    return Dai


def node(kind: type) -> Any:
    return next(n for n in Dai.Pipeline.last.nodes if isinstance(n, kind))


def test_the_fake_of_depthai_has_no_name_of_its_own() -> None:
    real = pytest.importorskip("depthai", exc_type=ImportError)
    check_names(Dai, real, "depthai")
    check_names(Output, real.Node.Output, "Output")
    stereo = Nodes.StereoDepth()
    for name in ("left", "right", "inputAlignTo", "depth"):
        assert hasattr(stereo, name) and hasattr(real.node.StereoDepth, name)
    for name in ("input", "inputAlignTo", "outputAligned"):
        assert hasattr(real.node.ImageAlign, name)
    for name in ("inputs", "out"):
        assert hasattr(real.node.Sync, name)
    check_names(Nodes.IMU, real.node.IMU, "IMU")
    for name in ("acceleroMeter", "gyroscope"):
        assert hasattr(real.IMUPacket, name)
    assert hasattr(real.IMUData, "packets")
    for name in ("x", "y", "z"):
        assert hasattr(real.IMUReportAccelerometer, name)
        assert hasattr(real.IMUReportGyroscope, name)


def test_oak_asks_for_registered_depth_and_straight_colour(dai) -> None:
    options = {"subpixel": 0, "dot_projector": 0.5, "flood_light": 0.25}
    asked = settings("oak", depth_width=640, depth_height=400, options=options)
    camera = OakCamera(asked)
    camera.open()
    pipeline = Dai.Pipeline.last
    cameras = [n for n in pipeline.nodes if isinstance(n, Nodes.Camera)]
    assert [n.socket for n in cameras] == ["A", "B", "C"]
    assert [n.asked for n in cameras] == [
        ((WIDTH, HEIGHT), 30.0, True),
        ((640, 400), 30.0, None),
        ((640, 400), 30.0, None),
    ]
    image, left, right = (n.output for n in cameras)
    assert image.links == ["sync.image", "stereo.inputAlignTo"]
    assert (left.links, right.links) == (["stereo.left"], ["stereo.right"])
    stereo = node(Nodes.StereoDepth)
    assert stereo.depth.links == ["sync.depth"]
    assert stereo.switches == {
        "left_right_check": True,
        "subpixel": False,
        "extended_disparity": False,
    }
    # half the time from frame to frame
    assert node(Nodes.Sync).interval == timedelta(seconds=0.5 / 30)
    assert pipeline.device.light == {"dots": 0.5, "flood": 0.25}
    assert pipeline.state == "started"
    camera.close()
    assert pipeline.state == "stopped" and pipeline.device.closed
    camera.close()


def test_oak_4_registers_depth_by_a_node_of_its_own(dai, monkeypatch) -> None:
    monkeypatch.setattr(Dai.Device, "platform", "RVC4")
    OakCamera(settings("oak")).open()
    image = node(Nodes.Camera).output
    assert image.links == ["sync.image", "align.inputAlignTo"]
    assert node(Nodes.StereoDepth).depth.links == ["align.input"]
    assert node(Nodes.ImageAlign).outputAligned.links == ["sync.depth"]


def test_oak_hands_out_what_comes(dai) -> None:
    camera = OakCamera(settings("oak"))
    camera.open()
    queue = node(Nodes.Sync).out.queue
    assert camera.read(0.1) is None
    image = Dai.ImgFrame(bgr(), 50.0, 8)
    queue.waiting.append(
        {"image": image, "depth": Dai.ImgFrame(millimetres(), 50.01, 8)}
    )
    before = time.time()
    reading = camera.read(0.1)
    made = reading.frame
    assert made.camera == CAMERA
    assert made.rgb[0, 0].tolist() == [10, 20, 30]
    np.testing.assert_allclose(made.depth, 1.5)
    # the device's clock is mapped to the computer's
    assert reading.age_s == pytest.approx(0.25)
    assert before - 0.25 <= made.timestamp <= time.time() - 0.25
    assert reading.number == 8


def test_oak_without_a_device_or_with_an_unknown_option(dai, monkeypatch) -> None:
    with pytest.raises(hvo.InputError, match="no option is called 'laser'"):
        OakCamera(settings("oak", options={"laser": 1}))
    monkeypatch.setattr(Dai.Device, "absent", True)
    camera = OakCamera(settings("oak"))
    with pytest.raises(RuntimeError, match="No available devices"):
        camera.open()
    camera.close()


def test_oak_of_a_serial_number(dai) -> None:
    camera = choose_camera("oak:1844301")
    camera.open()
    assert Dai.Pipeline.last.device.name == "1844301"


MOUNT = [[0.0, 1, 0], [-1, 0, 0], [0, 0, 1]]
"""An inertial sensor whose x points up in the image."""


def packet(stamp: float, turn: float) -> Any:
    """What an OAK's IMU reads while it turns about its x."""
    acceleration = Dai.IMUReport(stamp + 0.001, (9.8, 0.0, 0.0))
    return Dai.IMUPacket(acceleration, Dai.IMUReport(stamp, (turn, 0.0, 0.0)))


def give_an_image(stamp: float) -> None:
    image = Dai.ImgFrame(bgr(), stamp, 8)
    depth = Dai.ImgFrame(millimetres(), stamp, 8)
    node(Nodes.Sync).out.queue.waiting.append({"image": image, "depth": depth})


def test_oak_hands_over_its_imu(dai, monkeypatch) -> None:
    monkeypatch.setattr(Dai.Device, "imu", "BNO086")
    monkeypatch.setattr(Dai.Device, "mount", MOUNT)
    camera = OakCamera(settings("oak"))
    camera.open()
    imu = node(Nodes.IMU)
    assert imu.asked == {
        "sensors": ["accelerometer", "gyroscope"],
        "rate": 200,
        "batch": 1,
        "most": 10,
    }
    give_an_image(50.0)
    packets = [packet(49.97 + 0.005 * k, 0.1 * k) for k in range(4)]
    imu.out.queue.waiting += [Dai.IMUData(*packets[:2]), Dai.IMUData(*packets[2:])]
    reading = camera.read(0.1)
    samples = reading.imu
    assert reading.note == "" and samples is not None
    # by the clock of the frame, which was taken 0.03 s after the first of them
    late = reading.frame.timestamp - samples.stamps
    np.testing.assert_allclose(late, [0.03, 0.025, 0.02, 0.015], atol=1e-3)
    np.testing.assert_allclose(samples.rates[:, 0], [0, 0.1, 0.2, 0.3])
    np.testing.assert_array_equal(samples.R_cam_imu, MOUNT)
    # at rest it reads upwards, which is -y of the image
    up = samples.R_cam_imu @ samples.accelerations[-1]
    np.testing.assert_allclose(up, [0, -9.8, 0])
    give_an_image(50.03)
    assert camera.read(0.1).imu is None


@pytest.mark.parametrize(
    ("mount", "why"),
    [
        (None, "IMU calibration data is not available"),
        (np.eye(3).tolist(), "does not state how it is mounted"),
        ([[2.0, 0, 0], [0, 2, 0], [0, 0, 2]], "R_cam_imu"),
    ],
)
def test_oak_whose_imu_cannot_be_used_says_why_once(
    dai, monkeypatch, mount, why: str
) -> None:
    monkeypatch.setattr(Dai.Device, "imu", "BMI270")
    monkeypatch.setattr(Dai.Device, "mount", mount)
    camera = OakCamera(settings("oak"))
    camera.open()
    give_an_image(50.0)
    give_an_image(50.03)
    first = camera.read(0.1)
    assert first.imu is None and first.frame is not None
    assert first.note.startswith("its IMU is not used: ") and why in first.note
    assert camera.read(0.1).note == ""


@pytest.mark.parametrize(("name", "is_wanted"), [("NONE", True), ("BNO086", False)])
def test_oak_without_an_imu_or_with_it_switched_off(
    dai, monkeypatch, name: str, is_wanted: bool
) -> None:
    monkeypatch.setattr(Dai.Device, "imu", name)
    camera = OakCamera(settings("oak", imu=is_wanted))
    camera.open()
    assert not [n for n in Dai.Pipeline.last.nodes if isinstance(n, Nodes.IMU)]
    give_an_image(50.0)
    reading = camera.read(0.1)
    assert (reading.imu, reading.note) == (None, "")


# -- Orbbec ------------------------------------------------------------------------------


@pytest.fixture
def ob(monkeypatch: pytest.MonkeyPatch) -> type[Ob]:
    monkeypatch.setitem(sys.modules, "pyorbbecsdk", Ob)  # type: ignore[arg-type]
    monkeypatch.setattr(Ob, "connected", [Ob.Device("first"), Ob.Device("second")])
    monkeypatch.setattr(Ob, "bent", {})
    monkeypatch.setattr(Ob, "sensors", ["color", "depth"])
    monkeypatch.setattr(Ob.Pipeline, "motion", None)
    return Ob


def test_the_fake_of_pyorbbecsdk_has_no_name_of_its_own() -> None:
    real = pytest.importorskip("pyorbbecsdk", exc_type=ImportError)
    check_names(Ob, real, "pyorbbecsdk")
    for name in ("fx", "fy", "cx", "cy", "width", "height"):
        assert hasattr(real.OBCameraIntrinsic, name)
    for name in ("k1", "k2", "k3", "k4", "k5", "k6", "p1", "p2"):
        assert hasattr(real.OBCameraDistortion, name)
    assert hasattr(real.OBExtrinsic, "rot")
    for kind in (real.AccelFrame, real.GyroFrame):
        check_names(Ob.MotionFrame, kind, kind.__name__)


def test_orbbec_asks_for_both_streams_in_time(ob) -> None:
    options = {
        "OB_PROP_LASER_BOOL": 1,
        "OB_PROP_COLOR_AUTO_EXPOSURE_PRIORITY_INT": 0,
    }
    camera = OrbbecCamera(
        settings("orbbec", depth_width=320, depth_height=288, options=options)
    )
    camera.open()
    pipeline = Ob.Pipeline.last
    assert [(s.sensor, s.asked) for s in pipeline.config.streams] == [
        ("color", (WIDTH, HEIGHT, "RGB", 30)),
        ("depth", (320, 288, "Y16", 30)),
    ]
    assert pipeline.config.mode == "full"
    assert pipeline.is_synced
    assert pipeline.device.name == "first"
    assert pipeline.device.set == {"laser": True, "priority": 0, "global": True}
    camera.close()
    assert pipeline.state == "stopped"
    camera.close()


def test_orbbec_hands_out_what_comes(ob) -> None:
    camera = OrbbecCamera(settings("orbbec"))
    camera.open()
    pipeline = Ob.Pipeline.last
    assert camera.read(0.1) is None
    now = time.time()
    stamped = Ob.ColorFrame(round((now - 0.5) * 1e6), round(now * 1e6))
    arrived = Ob.ColorFrame(0, round((now - 0.1) * 1e6))
    for color in (stamped, arrived):
        pipeline.waiting.append(Ob.FrameSet(color, Ob.DepthFrame()))
    reading = camera.read(0.1)
    made = reading.frame
    assert made.camera == CAMERA
    assert made.rgb[0, 0].tolist() == [10, 20, 30]
    # 750 units of 2 mm
    np.testing.assert_allclose(made.depth, 1.5)
    assert made.timestamp == pytest.approx(now - 0.5, abs=1e-5)
    assert 0.5 <= reading.age_s + 1e-5
    assert reading.number == 41
    stamped.data[:] = 0
    assert (made.rgb[..., 2] == 30).all()
    # a camera without such a clock: the time of arrival
    assert camera.read(0.1).frame.timestamp == pytest.approx(now - 0.1, abs=1e-5)


def test_orbbec_without_an_image_or_depth(ob) -> None:
    camera = OrbbecCamera(settings("orbbec"))
    camera.open()
    Ob.Pipeline.last.waiting += [
        Ob.FrameSet(None, Ob.DepthFrame()),
        Ob.FrameSet(Ob.ColorFrame(5, 5), None),
    ]
    reading = camera.read(0.1)
    assert reading.frame is None and reading.note == "a frame without image"
    assert camera.read(0.1).frame.depth is None


def test_orbbec_takes_its_distortion_out(ob, monkeypatch) -> None:
    """The SDK's names in OpenCV's order: k1 k2 p1 p2 k3 k4 k5 k6."""
    bent = {"k1": 0.3, "k2": -0.2, "p1": 0.01, "p2": -0.01}
    monkeypatch.setattr(
        Ob, "bent", bent | {"k3": 0.1, "k4": 0.2, "k5": 0.05, "k6": 0.02}
    )
    camera = OrbbecCamera(settings("orbbec"))
    camera.open()
    coefficients = np.array([0.3, -0.2, 0.01, -0.01, 0.1, 0.2, 0.05, 0.02])
    row, column = 10, 13
    point = np.array([[(column - 7.5) / FOCAL, (row - 5.5) / (FOCAL + 1), 1.0]])
    zero = np.zeros(3)
    seen = cv2.projectPoints(point, zero, zero, CAMERA.K, coefficients)[0].ravel()
    maps = camera._maker._maps
    at = (maps.columns[row, column], maps.rows[row, column])
    assert at == pytest.approx(seen, abs=1e-3)


def test_orbbec_finds_its_device(ob, monkeypatch) -> None:
    camera = choose_camera("orbbec:second")
    camera.open()
    assert Ob.Pipeline.last.device.name == "second"
    monkeypatch.setattr(Ob, "connected", [])
    with pytest.raises(CameraLost, match="no device connected"):
        camera.open()
    for option in ("OB_PROP_NONE_BOOL", "OB_STRUCT"):
        with pytest.raises(hvo.InputError, match="no option is called"):
            OrbbecCamera(settings("orbbec", options={option: 1}))


def test_orbbec_hands_over_its_imu(ob, monkeypatch) -> None:
    monkeypatch.setattr(Ob, "sensors", ["color", "depth", "accel", "gyro"])
    monkeypatch.setattr(Ob, "mount", MOUNT)
    camera = OrbbecCamera(settings("orbbec"))
    camera.open()
    motion = Ob.Pipeline.motion
    assert motion.config.streams == ["accel", "gyro"]
    assert Ob.Pipeline.last is not motion
    now = time.time()
    for k in range(3):
        stamp = round((now - 0.02 + 0.005 * k) * 1e6)
        rate = Ob.MotionFrame(stamp, (0.1 * k, 0.0, 0.0))
        force = Ob.MotionFrame(stamp, (9.8, 0.0, 0.0))
        motion.on_frames(Ob.FrameSet(rate, force))
    # a set with one of both
    motion.on_frames(
        Ob.FrameSet(None, Ob.MotionFrame(round(now * 1e6), (9.8, 0, 0)))
    )
    color = Ob.ColorFrame(round((now - 0.005) * 1e6))
    Ob.Pipeline.last.waiting.append(Ob.FrameSet(color, Ob.DepthFrame()))
    samples = camera.read(0.1).imu
    assert samples is not None
    np.testing.assert_allclose(
        samples.stamps - now, [-0.02, -0.015, -0.01], atol=1e-5
    )
    np.testing.assert_allclose(samples.rates[:, 0], [0, 0.1, 0.2])
    up = samples.R_cam_imu @ samples.accelerations[0]
    np.testing.assert_allclose(up, [0, -9.8, 0], atol=1e-6)
    camera.close()
    assert motion.state == Ob.Pipeline.last.state == "stopped"
    camera.close()


@pytest.mark.parametrize(
    ("sensors", "is_wanted"),
    [(["color", "depth"], True), (["gyro", "accel"], False)],
)
def test_orbbec_without_an_imu_or_with_it_switched_off(
    ob, monkeypatch, sensors: list[str], is_wanted: bool
) -> None:
    monkeypatch.setattr(Ob, "sensors", sensors)
    camera = OrbbecCamera(settings("orbbec", imu=is_wanted))
    camera.open()
    assert Ob.Pipeline.motion is None
    Ob.Pipeline.last.waiting.append(Ob.FrameSet(Ob.ColorFrame(5), None))
    reading = camera.read(0.1)
    assert (reading.imu, reading.note) == (None, "")


# -- OpenNI ------------------------------------------------------------------------------


@pytest.fixture
def openni(monkeypatch: pytest.MonkeyPatch) -> Iterator[type[Capture]]:
    monkeypatch.setattr(cv2, "VideoCapture", Capture)
    monkeypatch.setattr(cv2.videoio_registry, "hasBackend", lambda _: True)
    monkeypatch.setattr(Capture, "is_there", True)
    yield Capture


def test_an_opencv_without_openni_is_refused() -> None:
    if cv2.videoio_registry.hasBackend(cv2.CAP_OPENNI2):
        pytest.skip("this OpenCV has OpenNI")
    with pytest.raises(hvo.InputError, match="built without OpenNI 2"):
        choose_camera("opencv:0")


def test_openni_hands_out_what_comes(openni) -> None:
    options = {"CAP_PROP_OPENNI2_MIRROR": 0}
    camera = OpenCVCamera(settings("opencv", options=options), 1)
    camera.open()
    capture = Capture.last
    assert capture.opened_with == (1, cv2.CAP_OPENNI2)
    assert capture.set_to == {
        cv2.CAP_OPENNI_DEPTH_GENERATOR_REGISTRATION: 1,
        cv2.CAP_PROP_OPENNI2_SYNC: 1,
        cv2.CAP_PROP_OPENNI2_MIRROR: 0,
    }
    capture.images = {
        cv2.CAP_OPENNI_BGR_IMAGE: bgr(),
        cv2.CAP_OPENNI_DEPTH_MAP: millimetres(),
    }
    before = time.time()
    reading = camera.read(0.1)
    made = reading.frame
    # the focal length is OpenNI's, the centre that of the image
    assert made.camera == hvo.Camera(FOCAL, FOCAL, 7.5, 5.5, HEIGHT, WIDTH)
    assert made.rgb[0, 0].tolist() == [10, 20, 30]
    np.testing.assert_allclose(made.depth, 1.5)
    assert before <= made.timestamp <= time.time()
    del capture.images[cv2.CAP_OPENNI_DEPTH_MAP]
    assert camera.read(0.1).frame.depth is None
    capture.images.clear()
    assert camera.read(0.1).note == "a frame without image"
    capture.alive = False
    with pytest.raises(CameraLost, match="gives no frames"):
        camera.read(0.1)
    camera.close()
    assert capture.state == "released"
    camera.close()


def test_openni_takes_intrinsics_that_belong_to_its_images(openni) -> None:
    given = (30.0, 31.0, 7.0, 6.0)
    camera = OpenCVCamera(settings("opencv", intrinsics=given))
    camera.open()
    Capture.last.images = {cv2.CAP_OPENNI_BGR_IMAGE: bgr()}
    assert camera.read(0.1).frame.camera == hvo.Camera(*given, HEIGHT, WIDTH)
    camera = OpenCVCamera(read_preset("kinect_v2"))
    camera.open()
    Capture.last.images = {cv2.CAP_OPENNI_BGR_IMAGE: bgr()}
    with pytest.raises(hvo.InputError, match="expected images of 512x424"):
        camera.read(0.1)


def test_openni_without_a_device_or_with_an_unknown_option(
    openni, monkeypatch
) -> None:
    with pytest.raises(hvo.InputError, match="no option is called 'MIRROR'"):
        OpenCVCamera(settings("opencv", options={"MIRROR": 1}))
    monkeypatch.setattr(Capture, "is_there", False)
    with pytest.raises(CameraLost, match="no device 0"):
        OpenCVCamera(settings("opencv")).open()


@pytest.mark.parametrize("name", ["kinect_v1", "kinect_v2"])
def test_every_option_of_a_preset_is_one_of_opencv(openni, name: str) -> None:
    OpenCVCamera(read_preset(name))


def test_every_option_of_the_other_presets_is_known(dai, ob) -> None:
    OakCamera(read_preset("oak_d_pro"))
    OrbbecCamera(read_preset("femto_bolt"))
