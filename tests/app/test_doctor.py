from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import pytest

from hybridvo.cli import main, text_of
from hybridvo.commands.doctor import diagnose, doctor
from hybridvo.data.image_io import read_flow
from hybridvo.errors import FormatError, InputError
from hybridvo.synthetic.render import SyntheticSequence
from hybridvo.synthetic.scenes import make_scene
from hybridvo.types import Frame


def test_doctor_compiles_the_kernels(monkeypatch):
    compiled = []
    monkeypatch.setattr("hybridvo.commands.doctor.warm_up", lambda: compiled.append(True))
    doctor()
    assert compiled


def test_what_is_installed(capsys):
    report, _ = doctor()
    assert "numpy" in report["packages"] and report["methods"]["refine"] == ""
    assert main(["doctor"]) == 0 and "refine" in capsys.readouterr().out


@dataclass
class Recorded:
    """Frames in memory, with something done to them."""

    frames: list[Frame]
    poses: np.ndarray | None
    name: str = "recorded"
    broken: int = -1
    has_flow: bool = False

    def __len__(self) -> int:
        return len(self.frames)

    def frame(self, index: int) -> Frame:
        if index == self.broken:
            raise FormatError("frame.png: expected an image")
        return self.frames[index]


@pytest.fixture(scope="module")
def recorded() -> Recorded:
    sequence = SyntheticSequence(make_scene("static", 7, height=160, width=256, frames=9))
    return Recorded([sequence.frame(k) for k in range(9)], sequence.poses)


def finding(report: dict[str, Any], name: str) -> dict[str, Any]:
    return next(found for found in report["findings"] if found["name"] == name)


def changed(recorded: Recorded, change: Callable[[int, Frame], Frame], **more: Any) -> Any:
    frames = [change(k, frame) for k, frame in enumerate(recorded.frames)]
    return diagnose(replace(recorded, frames=frames, **more))


def test_a_clean_sequence_is_not_accused(recorded):
    report = diagnose(recorded)
    assert report["ok"], text_of("doctor", report)
    assert len(report["findings"]) == 3 and report["pairs"] == 8
    scale = re.search(r"motions are (\S+) times", finding(report, "depth units")["message"])
    assert float(scale[1]) == pytest.approx(1.0, abs=0.05)


def test_units(recorded):
    report = changed(recorded, lambda k, f: replace(f, depth=1000 * f.depth), poses=None)
    assert finding(report, "depth units")["state"] == "differs"
    assert "divide by" in finding(report, "depth units")["message"]
    scaled = changed(recorded, lambda k, f: replace(f, depth=5 * f.depth))
    assert finding(scaled, "depth units")["state"] == "differs"


def test_a_scale_that_changes_on_the_way(recorded):
    report = changed(recorded, lambda k, f: replace(f, depth=(5 if k >= 6 else 1) * f.depth))
    found = finding(report, "depth from frame to frame")
    assert found["state"] == "differs" and "frame 5" in found["message"]


def test_what_cannot_be_seen_is_said(recorded):
    report = changed(recorded, lambda k, f: replace(f, rgb=None), poses=None)
    assert {found["state"] for found in report["findings"]} == {"cannot_tell"}
    assert report["ok"] and "3 of 3" in text_of("doctor", report)


def test_a_broken_frame_does_not_end_the_diagnosis(recorded):
    report = diagnose(replace(recorded, broken=2))
    assert report["unreadable"] and report["pairs"] == 6
    with pytest.raises(InputError, match="two frames"):
        diagnose(replace(recorded, frames=recorded.frames[:1]))


def test_exit_codes(dataset, own):
    assert main(["doctor", str(dataset), "--pairs", "2"]) == 0
    for path in (own.parents[1] / "flow" / "static").iterdir():
        flow = read_flow(path)[0]
        header = path.read_bytes()[:12]
        path.write_bytes(header + (-flow).astype("<f4").tobytes())
    assert main(["doctor", str(own)]) == 1
