"""What ``hybridvo doctor`` finds in clocks, rates, live cameras, and depth of another lens."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from hybridvo.core.errors import InputError
from hybridvo.core.types import Camera, Frame
from hybridvo.io.cameras.base import CameraLost, EndOfFrames, Reading
from hybridvo.io.data.open import open_sequence
from hybridvo.run.cli import main
from hybridvo.run.commands.diagnosis.capture import Captured, capture
from hybridvo.run.commands.diagnosis.clocks import (
    Curve,
    find_offset,
    image_motions,
    one_clock,
)
from hybridvo.run.commands.diagnosis.rate import camera_rate, gaps, jitter
from hybridvo.run.commands.diagnosis.registration import zoomed_registration
from hybridvo.run.commands.diagnosis.rolling_shutter import rolling_shutter
from hybridvo.run.commands.doctor import diagnose_camera
from hybridvo.tracking.camera_drift import Mean
from hybridvo.tracking.passes import PixelTimes

CAMERA = Camera(150.0, 150.0, 79.5, 59.5, height=120, width=160)
RATE = 30


# -- clocks ------------------------------------------------------------------------------


def swing(seconds: np.ndarray) -> np.ndarray:
    """(N, 2) px: where a camera looks that turns to and fro."""
    right = 25 * np.sin(4.0 * seconds) + 6 * np.sin(9.0 * seconds)
    down = 8 * np.sin(6.0 * seconds)
    return np.stack([right, down], axis=-1)


def swinging(late_s: float, count: int = 75, size: float = 1.0) -> Captured:
    """Frames of a camera whose depth is older than its image by some seconds."""
    rng = np.random.default_rng(3)
    noise = rng.uniform(0, 255, (240, 280, 3)).astype(np.float32)
    scene = 128 + 8 * (cv2.GaussianBlur(noise, (0, 0), 3) - 128)
    relief = cv2.GaussianBlur(rng.uniform(0, 1, (240, 280)), (0, 0), 5)
    metres = 1.0 + 2 * cv2.normalize(relief, None, 0, 1, cv2.NORM_MINMAX)
    stamps = np.arange(count) / RATE
    seen = size * swing(stamps)
    measured = size * swing(stamps - late_s)
    frames = []
    for stamp, at, depth_at in zip(stamps, seen, measured, strict=True):
        rgb = np.clip(window(scene, at), 0, 255).astype(np.uint8)
        depth = window(metres, depth_at).astype(np.float32)
        frames.append(Frame(rgb, depth, CAMERA, stamp))
    return Captured("swinging", frames)


def window(picture: np.ndarray, at: np.ndarray) -> np.ndarray:
    """The part of a picture that a camera sees which looks at a place."""
    move = np.float32([[1, 0, 60 + at[0]], [0, 1, 60 + at[1]]])
    flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
    return cv2.warpAffine(picture, move, (160, 120), flags=flags)


@pytest.mark.parametrize("late_ms", [0, 47, -80])
def test_the_offset_of_the_clocks_is_found(late_ms: int) -> None:
    answer = one_clock(swinging(late_ms / 1000), pairs=70)
    assert answer.differs == (late_ms != 0)
    ms, std = map(int, re.findall(r"(\d+) \+- (\d+) ms", answer.message)[0])
    # the flow's noise gives 3 ms
    assert ms == pytest.approx(abs(late_ms), abs=4)
    assert std <= 5
    if late_ms:
        # depth that comes late was measured early
        sign = "-" if late_ms > 0 else ""
        assert f"pass --depth-lag-ms {sign}{ms}" in answer.message


@pytest.mark.parametrize("late_ms", [100, -67, 47])
def test_maps_are_matched_anew_by_whole_frames(
    late_ms: int, tmp_path: Path
) -> None:
    """What is less than most of a frame stays: it is one lag for all."""
    root = tmp_path / "rgbd_dataset_freiburg3_swinging"
    rows: dict[str, list[str]] = {"rgb": [], "depth": []}
    for name in rows:
        (root / name).mkdir(parents=True)
    for i, frame in enumerate(swinging(0.0).frames):
        cv2.imwrite(str(root / "rgb" / f"{i}.png"), frame.rgb[..., ::-1])
        units = np.round(5000 * frame.depth).astype(np.uint16)
        cv2.imwrite(str(root / "depth" / f"{i}.png"), units)
        rows["rgb"].append(f"{frame.timestamp + 5:.6f} rgb/{i}.png\n")
        late = frame.timestamp + 5 + late_ms / 1000
        rows["depth"].append(f"{late:.6f} depth/{i}.png\n")
    for name, lines in rows.items():
        (root / f"{name}.txt").write_text("".join(lines))
    sequence = open_sequence(root, camera="150,150,79.5,59.5")
    answer = one_clock(sequence, pairs=60)
    assert answer.differs and answer.option is not None
    option, value = answer.option
    whole = {100: 100, -67: -67, 47: 33}[late_ms]
    assert option == "--depth-offset-ms" and int(value) == pytest.approx(
        whole, abs=1
    )
    again = open_sequence(
        root, camera="150,150,79.5,59.5", depth_offset_ms=float(value)
    )
    left = one_clock(again, pairs=60)
    assert left.option is None or left.option[0] == "--depth-lag-ms"


def test_stamps_of_depth_of_its_own_are_used() -> None:
    """Depth is 47 ms older than its image, and its stamps say so."""
    captured = swinging(0.047)
    captured.depth_timestamps = captured.timestamps - 0.047
    answer = one_clock(captured, pairs=70)
    assert answer.differs is False
    assert int(re.findall(r"comes (\d+) ", answer.message)[0]) <= 4


def test_a_camera_that_stands_tells_nothing_of_its_clocks() -> None:
    answer = one_clock(swinging(0.047, size=0.0, count=30), pairs=25)
    assert answer.differs is None and "to and fro" in answer.message
    assert one_clock(swinging(0.047, count=10), pairs=25).differs is None


def test_motions_that_are_not_alike_tell_nothing(rng: np.random.Generator) -> None:
    stamps = np.arange(80) / RATE
    first = Curve(stamps, rng.standard_normal((79, 2)))
    second = Curve(stamps, rng.standard_normal((79, 2)))
    offset = find_offset(first, second)
    assert offset is None or offset.correlation < 0.9


def test_jitter_of_the_stamps_moves_no_offset() -> None:
    """Stamps as a Kinect's, of three unequal intervals: a plain quotient errs by 25 ms."""
    count = 99
    true_s = np.arange(count + 1) / RATE
    stamps = true_s + np.tile([0.0, 0.0024, 0.0012], 34)[: count + 1]
    colour = Curve(stamps, np.diff(swing(true_s), axis=0))
    depth = Curve(stamps, np.diff(swing(true_s - 0.0333), axis=0))
    offset = find_offset(colour, depth)
    assert offset.seconds == pytest.approx(0.0333, abs=0.002)


@pytest.mark.slow
def test_depth_that_belongs_to_an_earlier_frame(shared_data: Path) -> None:
    """A real camera whose depth is paired two frames late: 67 ms more than as it was recorded."""
    sequence = open_sequence(shared_data / "tum" / "rgbd_dataset_freiburg1_rpy_100")
    measured = image_motions(sequence, 60)
    assert measured is not None
    colour, depth = measured
    late = Curve(depth.stamps[2:], depth.steps[:-2])
    difference = (
        find_offset(colour, late).seconds - find_offset(colour, depth).seconds
    )
    true = np.mean(depth.stamps[2:] - depth.stamps[:-2])
    # its standard deviation is 5 ms
    assert difference == pytest.approx(true, abs=0.01)


# -- registration ------------------------------------------------------------------------


def test_depth_of_another_focal_length(shared_data: Path) -> None:
    """The calibration of the recording says 534.3 / 567.9 = 0.941."""
    folder = shared_data / "tripod" / "unregistered"
    frames = []
    for number in range(3, 36, 8):
        bgr = cv2.imread(str(folder / "rgb" / f"{number:06d}.jpg"))
        stored = cv2.imread(str(folder / "depth" / f"{number:06d}.png"), -1)
        camera = Camera(
            534.3,
            534.7,
            308.6,
            242.1,
            height=stored.shape[0],
            width=stored.shape[1],
        )
        rgb = np.ascontiguousarray(bgr[..., ::-1])
        frames.append(Frame(rgb, np.float32(stored / 1000), camera, number / 5))
    answer = zoomed_registration(Captured("unregistered", frames))
    assert answer is not None and answer.differs
    assert "scaled by 0.94:" in answer.message


# -- rates -------------------------------------------------------------------------------


def test_dropped_frames_are_counted() -> None:
    stamps = np.delete(np.arange(20) / 10, [4, 5, 11, 14])
    found = gaps(stamps)
    assert found.differs
    assert "3 of 15 intervals are gaps (4 frames)" in found.message


def test_stamps_that_jitter(rng: np.random.Generator) -> None:
    even = np.arange(40) / 10
    assert jitter(even).differs is False
    # a lost frame is no jitter
    assert jitter(np.delete(even, 7)).differs is False
    shaken = even + rng.uniform(-0.04, 0.04, 40)
    found = jitter(shaken)
    assert found.differs and "arrival" in found.message
    assert jitter(even[:2]).differs is None


def test_the_rate_of_a_camera() -> None:
    slow = swinging(0.0, count=31)
    slow.asked_fps = 60
    slow.lost = 29
    found = camera_rate(slow)
    assert found.differs
    assert "30 frames a second; 29 never came" in found.message
    assert "60 requested" in found.message
    slow.asked_fps = 30
    assert camera_rate(slow).differs is False


# -- a live camera -----------------------------------------------------------------------


class Scripted:
    """A camera that hands out readings and raises errors, one at each tick of its clock."""

    name = "scripted"

    def __init__(self, *script: Reading | Exception | None) -> None:
        self.script = iter(script)
        self.time_s = 0.0
        self.closed = 0

    def open(self) -> None:
        pass

    def read(self, timeout_s: float) -> Reading | None:
        self.time_s += 0.1
        item = next(self.script, EndOfFrames())
        if isinstance(item, Exception):
            raise item
        return item

    def close(self) -> None:
        self.closed += 1

    def clock(self) -> float:
        return self.time_s


def reading(stamp: float, number: int | None = None) -> Reading:
    wall = np.full(CAMERA.shape, 2.0, np.float32)
    grey = np.full((*CAMERA.shape, 3), 90, np.uint8)
    return Reading(Frame(grey, wall, CAMERA, stamp), number=number)


def test_frames_that_never_came_are_counted() -> None:
    camera = Scripted(
        reading(0.0, 5),
        None,
        reading(0.1, 6),
        reading(0.1, 7),
        Reading(None, number=8, note="a frame without image"),
        reading(0.4, 11),
    )
    captured = capture(camera, 10.0, clock=camera.clock)
    assert captured.timestamps.tolist() == [0.0, 0.1, 0.4]
    assert [captured.frame(k).index for k in range(3)] == [0, 1, 2]
    assert captured.lost == 2
    assert len(captured.refused) == 2
    assert "without image" in captured.refused[1]
    assert camera.closed == 1


def test_a_capture_ends_in_time() -> None:
    camera = Scripted(*(reading(k / 10) for k in range(50)))
    assert len(capture(camera, 1.0, clock=camera.clock)) in (10, 11, 12)


def test_a_camera_that_is_lost_on_the_way() -> None:
    camera = Scripted(reading(0.0), CameraLost("cable"), reading(1.0))
    captured = capture(camera, 10.0, clock=camera.clock)
    assert len(captured) == 1
    assert captured.refused == ["the camera was lost: cable"]


@pytest.mark.parametrize(
    ("script", "reason"),
    [
        ([CameraLost("no device connected")], "no device connected"),
        ([None] * 50, "no frames for 3 s"),
        ([], "no frames"),
    ],
)
def test_a_camera_without_frames(script: list, reason: str) -> None:
    camera = Scripted(*script)
    with pytest.raises(InputError, match=f"scripted: .*{reason}"):
        capture(camera, 10.0, clock=camera.clock)
    assert camera.closed == 1


@pytest.mark.slow
def test_the_doctor_looks_at_a_camera(monkeypatch, capsys) -> None:
    frames = swinging(0.06, count=40).frames
    camera = Scripted(*(Reading(each, number=k) for k, each in enumerate(frames)))
    chosen = "hybridvo.run.commands.doctor.choose_camera"
    monkeypatch.setattr(chosen, lambda name, preset, **stated: camera)
    assert main(["doctor", "--camera", "realsense", "--pairs", "10"]) == 1
    shown = capsys.readouterr()
    assert "turn it to and fro" in shown.err
    lines = shown.out.splitlines()
    clocks = next(line for line in lines if "clocks" in line)
    assert clocks.startswith("DIFFERS") and "--depth-lag-ms -6" in clocks
    rate = next(line for line in lines if "rate of the camera" in line)
    assert "30 frames a second; 30 requested" in rate


def test_what_no_camera_can_be_asked() -> None:
    with pytest.raises(InputError, match="--seconds 0"):
        diagnose_camera("realsense", seconds=0)
    assert main(["doctor", "--camera", "/nowhere"]) == 2


# -- the rolling shutter -----------------------------------------------------------------


@pytest.mark.parametrize(
    ("found_ms", "stated_ms", "said"),
    [
        (20, 0, "state --readout-ms 20, or --passes 3"),
        (20, 30, "state --readout-ms 20"),
        (0, 30, "state --readout-ms 0"),
        (-9, 0, "are the images upside down?"),
        (0, 0, "or none"),
    ],
)
def test_what_is_said_of_a_readout_can_be_done(
    found_ms: float, stated_ms: float, said: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    camera = replace(CAMERA, readout_ms=stated_ms)
    frames = [replace(each, camera=camera) for each in swinging(0.0, 3).frames]
    monkeypatch.setattr(
        "hybridvo.run.commands.diagnosis.rolling_shutter.find_times",
        lambda frames: PixelTimes(Mean(found_ms, 1.0, 40)),
    )
    answer = rolling_shutter(Captured("swinging", frames), 3)
    assert answer.message.endswith(said)
