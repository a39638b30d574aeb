from __future__ import annotations

import json
import re
import tomllib
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from hybridvo.core.errors import FormatError, InputError
from hybridvo.core.types import Frame
from hybridvo.io.data.image_io import read_flow
from hybridvo.run.cli import main
from hybridvo.run.commands.diagnosis import extras, speed
from hybridvo.run.commands.diagnosis.extras import EXTRAS, missing_extras
from hybridvo.run.commands.diagnosis.registration import registration
from hybridvo.run.commands.doctor import diagnose, installation
from hybridvo.run.commands.text import text_of
from hybridvo.tracking.camera_drift import MIN_CAMERA_STEPS
from hybridvo_lab.commands import demo
from hybridvo_lab.synthetic.render import SyntheticSequence
from hybridvo_lab.synthetic.scenes import make_scene


def test_doctor_compiles_the_kernels_of_a_run_and_of_the_demo(monkeypatch):
    compiled = []
    tracked = []

    class Tracker:
        def __init__(self, method: str) -> None:
            self.method = method

        def track(self, frame: Frame) -> None:
            tracked.append(self.method)

    monkeypatch.setattr("hybridvo.run.commands.doctor.warm_up", compiled.append)
    monkeypatch.setattr("hybridvo.run.commands.doctor.Odometry", Tracker)
    installation()
    assert compiled == ["hybrid", "hybrid-flow", "classical"]
    # the second motion is the first with something to remember; flow is always computed once
    assert tracked == ["hybrid"] * 3 + ["classical"] * 3


def test_what_is_installed(capsys):
    report = installation()
    assert "numpy" in report["packages"] and report["methods"]["classical"] == ""
    assert set(report["extras"]) == set(EXTRAS)
    assert main(["doctor"]) == 0 and "classical" in capsys.readouterr().out


@dataclass
class Recorded:
    """Frames in memory, with something done to them."""

    frames: list[Frame]
    poses: np.ndarray | None
    name: str = "recorded"
    broken: int = -1
    has_flow: bool = False
    kind: str = "recorded"
    warnings: list[str] = field(default_factory=list)

    @property
    def timestamps(self) -> np.ndarray:
        return np.array([frame.timestamp for frame in self.frames])

    def __len__(self) -> int:
        return len(self.frames)

    def frame(self, index: int) -> Frame:
        if index == self.broken:
            raise FormatError("frame.png: expected an image")
        return self.frames[index]


@pytest.fixture(scope="module")
def recorded() -> Recorded:
    sequence = SyntheticSequence(
        make_scene("static", 7, height=160, width=256, frames=9)
    )
    return Recorded([sequence.frame(k) for k in range(9)], sequence.poses)


def finding(report: dict[str, Any], name: str) -> dict[str, Any]:
    return next(found for found in report["findings"] if found["name"] == name)


def changed(
    recorded: Recorded, change: Callable[[int, Frame], Frame], **more: Any
) -> Any:
    frames = [change(k, frame) for k, frame in enumerate(recorded.frames)]
    return diagnose(replace(recorded, frames=frames, **more))


def test_a_clean_sequence_is_not_accused(recorded):
    report = diagnose(recorded)
    assert report["ok"], text_of("doctor", report)
    states = {found["name"]: found["state"] for found in report["findings"]}
    assert set(states.values()) == {"agrees", "cannot_tell"}
    # there is no flow on file, and there are too few frames
    unknown = {"images against flow", "clocks of colour and depth", "focal length"}
    unknown |= {"rolling shutter", "lag of depth"}
    assert {name for name in states if states[name] == "cannot_tell"} == unknown
    units = finding(report, "depth units")["message"]
    scale = re.search(r"motions are (\S+) times", units)
    assert float(scale[1]) == pytest.approx(1.0, abs=0.05)


@pytest.mark.slow
def test_units(recorded):
    report = changed(
        recorded, lambda k, f: replace(f, depth=1000 * f.depth), poses=None
    )
    assert finding(report, "depth units")["state"] == "differs"
    assert "divide by" in finding(report, "depth units")["message"]
    scaled = changed(recorded, lambda k, f: replace(f, depth=5 * f.depth))
    assert finding(scaled, "depth units")["state"] == "differs"


@pytest.fixture(scope="module")
def turning() -> list[Frame]:
    count = MIN_CAMERA_STEPS + 4
    scene = make_scene("static", 3, height=120, width=160, frames=count)
    return [scene.render(k) for k in range(count)]


@pytest.mark.slow
@pytest.mark.parametrize(("factor", "state"), [(1.0, "agrees"), (0.85, "differs")])
def test_turns_show_the_focal_length(turning, factor, state):
    def refocused(frame: Frame) -> Frame:
        camera = frame.camera
        longer = replace(camera, fx=camera.fx * factor, fy=camera.fy * factor)
        return replace(frame, camera=longer)

    report = diagnose(Recorded([refocused(frame) for frame in turning], None))
    assert finding(report, "focal length")["state"] == state


@pytest.mark.slow
def test_a_scale_that_changes_on_the_way(recorded):
    report = changed(
        recorded, lambda k, f: replace(f, depth=(5 if k >= 6 else 1) * f.depth)
    )
    found = finding(report, "depth from frame to frame")
    assert found["state"] == "differs" and "frame 5" in found["message"]


def test_what_cannot_be_seen_is_said(recorded):
    report = changed(recorded, lambda k, f: replace(f, rgb=None), poses=None)
    states = {found["name"]: found["state"] for found in report["findings"]}
    told = ("valid depth", "intrinsics", "time stamps", "jitter of the stamps")
    expected = dict.fromkeys(states, "cannot_tell") | dict.fromkeys(told, "agrees")
    assert states == expected
    text = text_of("doctor", report)
    assert report["ok"] and "9 of 13" in text and "poses.txt" in text


@pytest.mark.slow
def test_depth_that_is_hardly_there(recorded):
    def sparse(k: int, f: Frame) -> Frame:
        few = np.zeros_like(f.depth)
        few[::8, ::4] = f.depth[::8, ::4]
        return replace(f, depth=few)

    found = finding(changed(recorded, sparse), "valid depth")
    assert found["state"] == "differs" and "3.1 %" in found["message"]
    empty = changed(
        recorded, lambda k, f: replace(f, depth=0 * f.depth) if k == 4 else f
    )
    found = finding(empty, "valid depth")
    assert found["state"] == "differs" and "1 of 8" in found["message"]


@pytest.mark.slow
@pytest.mark.parametrize("shift", [(0, 30), (0, -30), (14, 0)])
def test_depth_that_is_not_registered(recorded, shift):
    """The remedy is by how much, in the image's pixels, x to the right and y down."""
    moved = changed(
        recorded, lambda k, f: replace(f, depth=np.roll(f.depth, shift, (0, 1)))
    )
    found = finding(moved, "depth beside images")
    assert found["state"] == "differs"
    x, column, y, row = re.search(
        r"lie (\d+) px (left|right) and (\d+) px (up|down) of", found["message"]
    ).groups()
    across = int(x) * (1 if column == "right" else -1)
    along = int(y) * (1 if row == "down" else -1)
    assert abs(across - shift[1]) <= 2 and abs(along - shift[0]) <= 2


def test_a_shift_that_is_ok_says_why():
    """As on every Kinect: a best shift that is no better than none is none."""
    where = np.zeros((61, 61))
    where[30, 16] = 1.0  # 14 px left
    at_once = registration([where])
    assert at_once.differs and "14 px left and 0 px down" in at_once.message
    where[30, 30] = 0.99
    assert registration([where]).differs is False
    where[30, 31] = 3.0
    assert registration([where]).differs is False


@pytest.mark.parametrize(("scale", "size"), [(2.0, "512x320"), (4 / 3, "341x213")])
def test_intrinsics_of_another_resolution_are_a_question(recorded, scale, size):
    def other(k: int, f: Frame) -> Frame:
        c = f.camera
        place = {
            name: scale * (getattr(c, name) + 0.5) - 0.5 for name in ("cx", "cy")
        }
        focal = {name: scale * getattr(c, name) for name in ("fx", "fy")}
        return replace(f, camera=replace(c, **focal, **place))

    few = replace(recorded, frames=recorded.frames[:2])
    found = finding(changed(few, other), "intrinsics")
    assert found["state"] == "cannot_tell" and size in found["message"]


@pytest.mark.slow
def test_images_without_focus_and_without_texture(recorded):
    def blurred(k: int, f: Frame) -> Frame:
        return replace(f, rgb=cv2.GaussianBlur(f.rgb, (0, 0), 3))

    found = finding(changed(recorded, blurred), "texture and focus")
    assert found["state"] == "differs" and "blurred" in found["message"]
    flat = changed(
        recorded, lambda k, f: replace(f, rgb=120 + f.rgb // 64), poses=None
    )
    found = finding(flat, "texture and focus")
    assert found["state"] == "differs" and "texture" in found["message"]


def test_a_broken_frame_does_not_end_the_diagnosis(recorded):
    report = diagnose(replace(recorded, broken=2))
    assert report["unreadable"] and report["pairs"] == 6
    assert not report["ok"]
    assert "nothing differs" not in text_of("doctor", report)
    with pytest.raises(InputError, match="two frames"):
        diagnose(replace(recorded, frames=recorded.frames[:1]))


def test_exit_codes(dataset, own):
    assert main(["doctor", str(dataset), "--pairs", "2"]) == 0
    for path in (own.parents[1] / "flow" / "static").iterdir():
        flow = read_flow(path)[0]
        header = path.read_bytes()[:12]
        path.write_bytes(header + (-flow).astype("<f4").tobytes())
    assert main(["doctor", str(own)]) == 1


def test_every_extra_is_listed_and_a_missing_one_has_its_remedy(monkeypatch):
    content = tomllib.loads(Path("pyproject.toml").read_text(encoding="utf-8"))
    stated = set(content["project"]["optional-dependencies"])
    assert set(EXTRAS) == stated - {"all", "docs", "dev"}
    monkeypatch.setattr(extras, "find_spec", lambda name: name == "rosbags" or None)
    found = missing_extras()
    assert found["bags"] == ""
    assert found["onnx"].endswith("no onnxruntime; pip install 'hybridvo[onnx]'")


def test_how_fast_a_sequence_is_tracked_and_by_which_stages(image_walk, capsys):
    assert main(["doctor", "--speed", str(image_walk), "--json"]) == 0
    report = json.loads(capsys.readouterr().out)
    assert report["frames_per_second"] > 0
    assert report["frame_ms"]["p95_ms"] >= report["frame_ms"]["median_ms"]
    assert {"reading", "judge", "other"} <= set(report["stages"])
    assert "frames a second" in text_of("doctor", report)
    assert main(["doctor", "--speed", "--preset", "d435", "-q"]) == 2
    assert "live --rate auto" in capsys.readouterr().err


def test_the_demo_is_tracked_where_no_sequence_is_named(monkeypatch):
    monkeypatch.setattr(speed, "SPEED_FRAMES", 6)
    monkeypatch.setattr(demo, "HEIGHT", 60)
    monkeypatch.setattr(demo, "WIDTH", 80)
    report = speed.speed()
    assert (report["motions"], report["size"]) == (1, [80, 60])
