"""Settings, presets, the choice of a camera, and recordings that are played."""

from __future__ import annotations

import shutil
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

import hybridvo as hvo
from hybridvo.core.errors import FormatError
from hybridvo.io.cameras.base import EndOfFrames, FrameMaker, load_sdk
from hybridvo.io.cameras.choose import choose_camera
from hybridvo.io.cameras.folder import FolderCamera
from hybridvo.io.cameras.settings import CameraSettings, preset_names, read_preset
from hybridvo.io.data.sequence import Sequence
from hybridvo.io.data.streams import Lens
from tests.io.live.scripted import Clock


@pytest.mark.parametrize("name", preset_names())
def test_a_preset_reads(name: str) -> None:
    settings = read_preset(name)
    assert settings.max_depth_m is not None
    assert 0 < settings.min_depth_m < settings.max_depth_m


@pytest.mark.parametrize(
    ("text", "problem"),
    [
        ("driver: realsense\nwidht: 3", "widht"),
        ("driver: webcam", "driver"),
        ("driver: oak\nfps: -1", "fps"),
        ("- 3", "expected 'key: value' lines"),
        ("3: 4", "3"),
    ],
)
def test_a_preset_that_is_wrong_is_refused(
    text: str, problem: str, tmp_path: Path
) -> None:
    path = tmp_path / "mine.yaml"
    path.write_text(text)
    with pytest.raises(FormatError, match=problem) as caught:
        read_preset(path)
    assert str(path) in str(caught.value)


@pytest.mark.parametrize(
    ("name", "preset", "problem"),
    [
        (None, None, "expected --camera or --preset"),
        ("no_such_folder", None, "realsense, oak, orbbec, opencv or a folder"),
        ("opencv:front", None, "expected opencv:0"),
        ("oak", "d435", "is for realsense, not for oak"),
        (None, "zed_2i", "no driver for this camera"),
        ("tests", "d435", "a recording has none"),
    ],
)
def test_a_choice_that_cannot_be_is_refused(name, preset, problem: str) -> None:
    with pytest.raises(hvo.InputError, match=problem):
        choose_camera(name, preset)


@pytest.mark.parametrize("name", ["d436", "../d435"])
def test_an_unknown_preset_names_the_known_ones(name: str) -> None:
    with pytest.raises(hvo.InputError, match="d435, d455"):
        read_preset(name)


def test_a_broken_sdk_says_why(tmp_path: Path, monkeypatch) -> None:
    (tmp_path / "broken_sdk.py").write_text(
        "raise ImportError('libusb is missing')"
    )
    monkeypatch.syspath_prepend(str(tmp_path))
    with pytest.raises(hvo.InputError, match="cannot be loaded: libusb is missing"):
        load_sdk("broken_sdk", "realsense")


# -- frames ------------------------------------------------------------------------------


def test_depth_out_of_range_is_taken_away() -> None:
    camera = hvo.Camera(50.0, 50.0, 1.0, 0.5, height=2, width=3)
    settings = CameraSettings(min_depth_m=0.5, max_depth_m=4.0)
    depth = np.array([[0.4, 0.5, 4.0], [4.1, np.nan, 0.0]])
    made = FrameMaker(Lens(camera), settings).frame(
        np.zeros((2, 3), np.uint8), depth, 7.0
    )
    np.testing.assert_array_equal(made.depth, [[0, 0.5, 4], [0, 0, 0]])
    assert made.timestamp == 7.0
    assert made.rgb.shape == (2, 3, 3)


def test_the_shutter_is_that_of_the_settings(image_walk: Path) -> None:
    camera = hvo.Camera(50.0, 50.0, 1.0, 0.5, height=2, width=3)
    maker = FrameMaker(Lens(camera), CameraSettings(readout_ms=18.0))
    made = maker.frame(np.zeros((2, 3), np.uint8), None, 0.0)
    assert made.camera.readout_ms == 18
    # a recording has none, until the user states it
    for stated, expected in ((None, 0.0), (22.0, 22.0)):
        recording = choose_camera(str(image_walk), readout_ms=stated)
        reading = recording.read(0.1)
        assert reading is not None and reading.frame is not None
        assert reading.frame.camera.readout_ms == expected


def test_an_infrared_image_is_of_the_time_of_its_depth() -> None:
    camera = hvo.Camera(50.0, 50.0, 1.0, 0.5, height=2, width=3)
    for image, expected in (("color", (32, 7)), ("infrared", (0, 0))):
        settings = replace(read_preset("d435"), image=image, depth_lag_ms=7)
        maker = FrameMaker(Lens(camera), settings)
        made = maker.frame(np.zeros((2, 3), np.uint8), None, 0.0).camera
        assert (made.readout_ms, made.depth_lag_ms) == expected


def test_the_lens_bends_nothing_afterwards() -> None:
    """A point lands where a pinhole puts it, wherever the lens put it before."""
    camera = hvo.Camera(60.0, 60.0, 31.5, 23.5, height=48, width=64)
    distortion = (-0.5, 0.2, 0.01, -0.02, 0.0)
    point = np.array([[0.45, 0.3, 1.0]])
    zero = np.zeros(3)
    seen = cv2.projectPoints(point, zero, zero, camera.K, np.array(distortion))[0]
    straight = camera.K @ point[0]
    u, v = np.rint(seen.ravel()).astype(int)
    assert np.abs(seen.ravel() - straight[:2]).max() > 2
    image = np.zeros((48, 64), np.uint8)
    image[v - 1 : v + 2, u - 1 : u + 2] = 255
    depth = np.where(image > 0, 2.0, 1.0)
    maker = FrameMaker(Lens(camera, distortion), CameraSettings())
    made = maker.frame(image, depth, 0.0)
    rows, columns = np.nonzero(made.rgb[..., 0] > 127)
    assert np.mean(columns) == pytest.approx(straight[0], abs=0.7)
    assert np.mean(rows) == pytest.approx(straight[1], abs=0.7)
    rows, columns = np.nonzero(made.depth > 1.5)
    assert np.mean(columns) == pytest.approx(straight[0], abs=0.7)
    assert np.mean(rows) == pytest.approx(straight[1], abs=0.7)


# -- recordings --------------------------------------------------------------------------


def play(recording: Path | Sequence) -> tuple[FolderCamera, Clock]:
    clock = Clock()
    camera = FolderCamera(recording, clock=clock, sleep=clock.sleep)
    camera.open()
    return camera, clock


def test_a_recording_plays_at_its_own_rate(image_walk: Path) -> None:
    sequence = hvo.open_sequence(image_walk)
    camera, clock = play(image_walk)
    began = clock.now
    for index in range(len(sequence)):
        reading = camera.read(9.0)
        assert reading is not None and reading.frame is not None
        assert reading.number == index
        assert reading.age_s == pytest.approx(0.0, abs=1e-9)
        assert reading.frame.timestamp == sequence.timestamps[index]
        passed = sequence.timestamps[index] - sequence.timestamps[0]
        assert clock.now - began == pytest.approx(passed)
        np.testing.assert_array_equal(reading.frame.rgb, sequence[index].rgb)
    with pytest.raises(EndOfFrames):
        camera.read(9.0)


def test_frames_that_are_overtaken_are_left_out(image_walk: Path) -> None:
    sequence = hvo.open_sequence(image_walk)
    camera, clock = play(image_walk)
    assert camera.read(9.0).number == 0
    # two frames pass while nobody reads
    late = sequence.timestamps[2] - sequence.timestamps[0]
    clock.now += late + 1e-6
    reading = camera.read(9.0)
    assert reading.number == 2
    # closed and opened again, it goes on
    camera.close()
    camera.open()
    assert camera.read(9.0).number == 3


def test_a_damaged_frame_is_said(image_walk: Path, monkeypatch) -> None:
    camera, _ = play(image_walk)

    def broken(index: int):
        raise FormatError(f"{index}.png: cut off")

    monkeypatch.setattr(camera._sequence, "frame", broken)
    reading = camera.read(9.0)
    assert reading.frame is None
    assert reading.note == "frame 0: 0.png: cut off"
    assert not reading.is_gone


def test_files_that_are_gone_are_named_as_such(
    image_walk: Path, tmp_path: Path
) -> None:
    moved = tmp_path / "walk"
    shutil.copytree(image_walk, moved)
    camera, clock = play(moved)
    assert camera.read(9.0).frame is not None
    shutil.rmtree(moved)
    clock.now += 1e3
    reading = camera.read(9.0)
    assert reading.is_gone and reading.frame is None
    assert reading.note == f"files are gone since frame {reading.number}"


def test_an_image_that_is_gone_is_named_although_depth_is_there(
    image_walk: Path, tmp_path: Path
) -> None:
    recording = tmp_path / "walk"
    shutil.copytree(image_walk, recording)
    camera, _ = play(recording)
    assert camera.read(9.0).frame is not None
    for path in hvo.open_sequence(recording).rgb_files[1:]:
        path.unlink()
    reading = camera.read(9.0)
    assert reading.is_gone and reading.frame is None
    assert reading.note.startswith(f"the image of frame {reading.number} is gone")
