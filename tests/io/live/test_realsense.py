"""The RealSense driver with the real SDK, whose software device stands in for a camera."""

from __future__ import annotations

import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import hybridvo as hvo
from hybridvo.io.cameras.base import EndOfFrames
from hybridvo.io.cameras.choose import choose_camera
from hybridvo.io.cameras.realsense import RealSenseCamera
from hybridvo.io.cameras.settings import CameraSettings, read_preset
from tests.io.live.scripted import LONG_S

try:
    import pyrealsense2 as rs
except ImportError as problem:
    pytest.skip(f"pyrealsense2: {problem}", allow_module_level=True)

WIDTH, HEIGHT = 64, 48
UNITS = 0.0005
"""Metres in one unit of depth: not the usual millimetre."""
DEPTH, COLOR, INFRARED = range(3)
MOUNT = np.array([[0.0, 1, 0], [-1, 0, 0], [0, 0, 1]])
"""An inertial sensor whose x points up in the image."""


class SoftCamera:
    """A device of the SDK whose frames are made up; with an inertial sensor, if it is wanted."""

    def __init__(
        self, coefficients: tuple[float, ...] = (0.0,) * 5, imu: bool = False
    ) -> None:
        self.device = rs.software_device()
        self.device.register_info(rs.camera_info.name, "software")
        self.device.register_info(rs.camera_info.serial_number, "0001")
        self.coefficients = coefficients
        self.stereo = self.device.add_sensor("Stereo")
        self.rgb = self.device.add_sensor("RGB")
        self.profiles = [
            self._profile(self.stereo, rs.stream.depth, rs.format.z16, 2, 0),
            self._profile(self.rgb, rs.stream.color, rs.format.rgb8, 3, 0),
            self._profile(self.stereo, rs.stream.infrared, rs.format.y8, 1, 1),
        ]
        self.stereo.add_read_only_option(rs.option.depth_units, UNITS)
        gain = rs.option_range()
        gain.min, gain.max, gain.step, gain.default = 0.0, 9.0, 1.0, 5.0
        self.rgb.add_option(rs.option.gain, gain, True)
        same = rs.extrinsics()
        same.rotation = np.eye(3).ravel().tolist()
        same.translation = [0.0, 0.0, 0.0]
        self.profiles[DEPTH].register_extrinsics_to(self.profiles[COLOR], same)
        if imu:
            self.motion = self.device.add_sensor("Motion Module")
            # two rates each, of which the lower one is fast enough
            self.rates = [
                self._motion(rs.stream.gyro, 30 + k, fps)
                for k, fps in enumerate((400, 200))
            ]
            self.accelerations = [
                self._motion(rs.stream.accel, 40 + k, fps)
                for k, fps in enumerate((63, 250))
            ]
        self.device.create_matcher(rs.matchers.default)
        self.count = 0

    def _profile(self, sensor: Any, kind: Any, form: Any, bpp: int, index: int):
        lens = rs.intrinsics()
        lens.width, lens.height = WIDTH, HEIGHT
        lens.fx, lens.fy, lens.ppx, lens.ppy = 60.0, 61.0, 31.0, 23.0
        lens.model = rs.distortion.inverse_brown_conrady
        is_color = kind == rs.stream.color
        lens.coeffs = self.coefficients if is_color else (0.0,) * 5
        made = rs.video_stream()
        made.type, made.index, made.uid = kind, index, 10 + bpp
        made.width, made.height, made.fps = WIDTH, HEIGHT, 30
        made.bpp, made.fmt, made.intrinsics = bpp, form, lens
        return sensor.add_video_stream(made).as_video_stream_profile()

    def _motion(self, kind: Any, uid: int, fps: int) -> Any:
        made = rs.motion_stream()
        made.type, made.index, made.uid = kind, 0, uid
        made.fps, made.fmt = fps, rs.format.motion_xyz32f
        made.intrinsics = rs.motion_device_intrinsic()
        profile = self.motion.add_motion_stream(made)
        mount = rs.extrinsics()
        mount.rotation = MOUNT.T.ravel().tolist()  # column by column
        mount.translation = [0.01, 0.0, 0.0]
        profile.register_extrinsics_to(self.profiles[COLOR], mount)
        return profile

    def read_motion(self, stamp_s: float, rate: float, domain: Any = None) -> None:
        """Hand one reading of each inertial sensor to the SDK: it turns about its x, at rest."""
        for profile, values in (
            (self.accelerations[1], (9.8, 0.0, 0.0)),
            (self.rates[1], (rate, 0.0, 0.0)),
        ):
            data = rs.vector()
            data.x, data.y, data.z = values
            made = rs.software_motion_frame()
            made.data = data
            made.timestamp = 1000 * stamp_s
            made.domain = domain or rs.timestamp_domain.system_time
            made.profile = profile.as_motion_stream_profile()
            self.motion.on_motion_frame(made)

    def give(self, which: int, pixels: np.ndarray, stamp_s: float, domain) -> None:
        """Hand one image to the SDK."""
        made = rs.software_video_frame()
        made.pixels = pixels
        made.bpp = pixels.itemsize * (pixels.size // (WIDTH * HEIGHT))
        made.stride = made.bpp * WIDTH
        made.timestamp = 1000 * stamp_s
        made.domain = domain
        made.frame_number = self.count
        made.profile = self.profiles[which]
        if which == DEPTH:
            made.depth_units = UNITS
        sensor = self.rgb if which == COLOR else self.stereo
        sensor.on_video_frame(made)

    def give_all(
        self,
        stamp_s: float,
        domain: Any = None,
        value: int = 77,
        is_color: bool = True,
    ) -> None:
        """Hand a frame of 1.5 m depth to the SDK."""
        domain = domain or rs.timestamp_domain.system_time
        self.count += 1
        depth = np.full((HEIGHT, WIDTH), round(1.5 / UNITS), np.uint16)
        self.give(DEPTH, depth, stamp_s, domain)
        if is_color:
            color = np.full((HEIGHT, WIDTH, 3), (value, 10, 20), np.uint8)
            self.give(COLOR, color, stamp_s, domain)
        else:
            grey = np.full((HEIGHT, WIDTH), value, np.uint8)
            self.give(INFRARED, grey, stamp_s, domain)


def settings(**more: Any) -> CameraSettings:
    return CameraSettings(driver="realsense", width=WIDTH, height=HEIGHT, **more)


@pytest.fixture
def soft() -> SoftCamera:
    return SoftCamera()


@pytest.fixture
def camera(soft: SoftCamera) -> Iterator[RealSenseCamera]:
    camera = RealSenseCamera(settings(options={"gain": 7}), device=soft.device)
    camera.open()
    yield camera
    camera.close()


def test_a_frame_comes_out_as_it_went_in(
    soft: SoftCamera, camera: RealSenseCamera
) -> None:
    before = time.time()
    soft.give_all(before - 0.25)
    reading = camera.read(LONG_S)
    assert reading is not None and reading.frame is not None
    made = reading.frame
    assert made.camera == hvo.Camera(
        60.0, 61.0, 31.0, 23.0, height=HEIGHT, width=WIDTH
    )
    assert made.rgb[0, 0].tolist() == [77, 10, 20]
    # registered to colour, whose camera is the same here; its border may be lost
    assert made.depth[HEIGHT // 2, WIDTH // 2] == pytest.approx(1.5, abs=UNITS)
    assert np.mean(made.depth > 0) > 0.9
    assert made.timestamp == pytest.approx(before - 0.25, abs=1e-3)
    assert 0.25 <= reading.age_s < LONG_S
    assert reading.number == 1


def test_its_frames_are_copies(soft: SoftCamera, camera: RealSenseCamera) -> None:
    soft.give_all(1.0, value=50)
    first = camera.read(LONG_S).frame
    for k in range(40):
        soft.give_all(1.1 + k / 30, value=60)
        camera.read(LONG_S)
    assert (first.rgb[..., 0] == 50).all()


def test_a_clock_of_its_own_tells_no_age(
    soft: SoftCamera, camera: RealSenseCamera
) -> None:
    soft.give_all(12.5, rs.timestamp_domain.hardware_clock)
    reading = camera.read(LONG_S)
    assert reading.frame.timestamp == pytest.approx(12.5)
    assert reading.age_s == 0.0


@pytest.mark.parametrize("name", ["d435", "d455"])
def test_every_option_of_a_preset_is_one_of_the_sdk(name: str) -> None:
    RealSenseCamera(read_preset(name))


def test_the_left_infrared_image_takes_the_place_of_colour(
    soft: SoftCamera,
) -> None:
    camera = RealSenseCamera(settings(image="infrared"), device=soft.device)
    camera.open()
    soft.give_all(time.time(), is_color=False)
    made = camera.read(LONG_S).frame
    camera.close()
    assert (made.rgb == 77).all()
    np.testing.assert_allclose(made.depth, 1.5, atol=UNITS)


def test_distortion_is_taken_out_as_the_sdk_models_it() -> None:
    soft = SoftCamera((-0.5, 0.2, 0.01, -0.02, 0.0))
    camera = RealSenseCamera(settings(), device=soft.device)
    camera.open()
    lens = soft.profiles[COLOR].get_intrinsics()
    camera.close()
    row, column = 41, 58
    point = [(column - 31.0) / 60.0, (row - 23.0) / 61.0, 1.0]
    seen = rs.rs2_project_point_to_pixel(lens, point)
    maps = camera._maker._maps
    at = (maps.columns[row, column], maps.rows[row, column])
    assert np.hypot(column - seen[0], row - seen[1]) > 3.0
    # RealSense bends its tangential part a little differently from OpenCV
    assert np.hypot(at[0] - seen[0], at[1] - seen[1]) < 0.3


def test_what_the_sdk_records_is_played(soft: SoftCamera, tmp_path: Path) -> None:
    """The SDK's own recorder writes the file; our reader of bags plays it."""
    pytest.importorskip("rosbags")
    path = tmp_path / "walk.db3"
    recorder = rs.recorder(str(path), soft.device)
    camera = RealSenseCamera(settings(), device=recorder)
    camera.open()
    for k in range(4):
        soft.give_all(100.0 + k / 30, value=40 + k)
        assert camera.read(LONG_S) is not None
    camera.close()
    del camera, recorder
    camera = choose_camera(str(path))
    colors = []
    with pytest.raises(EndOfFrames):
        while True:
            reading = camera.read(LONG_S)
            if reading is not None and reading.frame is not None:
                colors.append(int(reading.frame.rgb[0, 0, 0]))
                assert reading.frame.camera.fx == 60.0
                middle = reading.frame.depth[HEIGHT // 2, WIDTH // 2]
                assert middle == pytest.approx(1.5, abs=UNITS)
    # frames that were due at once are left out
    assert colors and colors == sorted(set(colors))
    assert set(colors) <= {40, 41, 42, 43}


# -- the inertial sensor of a D435i ----------------------------------------------------------


def with_imu(**more: Any) -> tuple[SoftCamera, RealSenseCamera]:
    soft = SoftCamera(imu=True)
    camera = RealSenseCamera(settings(**more), device=soft.device)
    camera.open()
    return soft, camera


def test_samples_come_with_the_frame() -> None:
    soft, camera = with_imu()
    for k in range(4):
        soft.read_motion(100.0 + 0.005 * k, 0.1 * k)
    soft.give_all(100.02)
    reading = camera.read(LONG_S)
    camera.close()
    assert reading is not None and reading.note == ""
    samples = reading.imu
    assert samples is not None
    np.testing.assert_allclose(samples.stamps, 100.0 + 0.005 * np.arange(4))
    np.testing.assert_allclose(samples.rates[:, 0], [0, 0.1, 0.2, 0.3], rtol=1e-6)
    np.testing.assert_allclose(samples.R_cam_imu, MOUNT)
    # at rest it reads upwards, which is -y of the image
    up = samples.R_cam_imu @ samples.accelerations[0]
    np.testing.assert_allclose(up, [0, -9.8, 0], rtol=1e-6)


def test_readings_of_another_clock_are_not_used() -> None:
    soft, camera = with_imu()
    soft.read_motion(3.0, 0.1, rs.timestamp_domain.hardware_clock)
    soft.give_all(100.0)
    first = camera.read(LONG_S)
    soft.give_all(100.03)
    second = camera.read(LONG_S)
    camera.close()
    assert first.imu is None and second.imu is None
    assert "its clock is not that of the images" in first.note
    assert second.note == ""
